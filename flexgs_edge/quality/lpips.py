"""LPIPS, the perceptual distance of Zhang et al. (CVPR 2018). The package `lpips` is loaded only if it is asked for."""

import pickle
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from flexgs_edge.errors import InputError
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.memory.process import current_rss

LPIPS_SIDE = 31  # Smallest side of an image: AlexNet's five layers then leave one pixel
LOAD_BYTES = 1100 * 2**20
"""Bound on the memory that loading takes at its peak: the libraries, and two copies of the weights.
docs/results/tuning.md#memory"""
WORK_BYTES = 300  # Bound on the bytes a pixel that a comparison takes for a moment: docs/results/tuning.md#memory
BACKBONE = "alexnet-owt-7be5be79.pth"
"""torchvision's file of AlexNet's weights, 244 MB; the package `lpips` holds its own weights."""
BACKBONE_URL = f"https://download.pytorch.org/models/{BACKBONE}"


class Lpips:
    """Perceptual distance of two images: 0 for identical ones, smaller is better (AlexNet, version 0.1, on the CPU).

    `budget`: memory for the libraries and for images of `pixels` pixels is taken from it until `close`. `pixels`:
    pixels of the largest image. Raises `InputError` if a package or the weights of AlexNet are missing; the message
    tells what to install, or where to put the file. Raises `BudgetError` if they do not fit into the memory limit.
    """

    def __init__(self, budget: MemoryBudget, pixels: int) -> None:
        budget.require("LPIPS", LOAD_BYTES)
        before = current_rss()
        self._torch, self._model = _load()
        self._budget, self._taken = budget, max(current_rss() - before, 0) + WORK_BYTES * pixels
        budget.take("LPIPS", self._taken)

    def __call__(self, image: np.ndarray, reference: np.ndarray) -> float | None:
        """LPIPS of two [H, W, 3] images, clamped to [0, 1] first; `None` if a side is shorter than 31 pixels."""
        if image.shape != reference.shape:
            raise InputError(f"LPIPS: images of shape {reference.shape} and {image.shape} cannot be compared")
        if min(image.shape[:2]) < LPIPS_SIDE:
            return None
        with self._torch.no_grad():
            distance = self._model(self._tensor(image), self._tensor(reference))
        return float(distance)

    def _tensor(self, image: np.ndarray) -> Any:
        """[1, 3, H, W] f32 in [-1, 1]."""
        planes = np.clip(image.transpose(2, 0, 1)[None], 0.0, 1.0, dtype=np.float32, order="C")
        planes *= 2.0
        planes -= 1.0
        return self._torch.from_numpy(planes)

    def close(self) -> None:
        """Free the network, and give its memory back to the budget."""
        self._model = None
        self._budget.give(self._taken)
        self._taken = 0


def _load() -> tuple[Any, Any]:
    """Load the torch module and the network."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import lpips
            import torch
    except ImportError as error:
        raise InputError(
            f"--lpips needs the packages lpips, torch and torchvision ({error}): pip install 'flexgs-edge[lpips]'"
        ) from error
    except RuntimeError as error:  # torchvision was built for another version of torch
        raise InputError(f"--lpips: torch and torchvision do not fit each other: {_first(error)}") from error
    place = Path(torch.hub.get_dir()) / "checkpoints" / BACKBONE
    try:
        with warnings.catch_warnings():  # the package calls torchvision in a deprecated way
            warnings.simplefilter("ignore")
            model = lpips.LPIPS(net="alex", version="0.1", verbose=False, eval_mode=True)
    except (OSError, RuntimeError, ValueError, KeyError, EOFError, pickle.UnpicklingError) as error:
        if place.is_file():
            raise InputError(
                f"--lpips: {place}: the weights of AlexNet cannot be read ({_first(error)}); remove the file and run again, "
                f"or put the one from {BACKBONE_URL} there"
            ) from error
        raise InputError(
            f"--lpips: the weights of AlexNet could not be downloaded ({_first(error)}): get {BACKBONE_URL} where there is a "
            f"network and put it at {place} (TORCH_HOME names another folder for hub/checkpoints)"
        ) from error
    return torch, model.requires_grad_(False)


def _first(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return lines[0][:200] if lines else type(error).__name__
