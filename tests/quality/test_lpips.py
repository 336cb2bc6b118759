"""LPIPS: what the package is given, what becomes of its figures, and what is said when it or its weights are missing."""

from __future__ import annotations

import importlib.util
import json
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from flexgs_edge.commands.evaluate import evaluate
from flexgs_edge.errors import BudgetError, InputError
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.progress import Progress, T
from flexgs_edge.quality.lpips import BACKBONE, LPIPS_SIDE, Lpips
from tiny_project import make_project, write_photos

TORCH = """
import contextlib, os
tracing = True
class hub:
    get_dir = staticmethod(lambda: os.environ["TORCH_HOME"] + "/hub")
class Tensor:
    def __init__(self, array): self.array = array
from_numpy = Tensor
@contextlib.contextmanager
def no_grad():
    global tracing
    tracing = False
    yield
    tracing = True
"""
LPIPS = """
import os, warnings
import torch
calls = []
class LPIPS:
    def __init__(self, net, version, verbose, eval_mode):
        warnings.warn("deprecated")
        assert (net, version, verbose, eval_mode) == ("alex", "0.1", False, True)
        place = torch.hub.get_dir() + "/checkpoints/WEIGHTS"
        if not os.path.isfile(place):
            raise OSError("<urlopen error no network>")
        if not open(place).read():
            raise EOFError("Ran out of input")
        self.trained = True
    def requires_grad_(self, wanted):
        self.trained = wanted
        return self
    def __call__(self, a, b):
        calls.append((a.array, b.array, torch.tracing, self.trained))
        return abs(a.array - b.array).mean()
""".replace("WEIGHTS", BACKBONE)
NAMES = ("lpips", "torch", "torchvision")
LIMIT = 8 * 2**30


def forget(monkeypatch: pytest.MonkeyPatch) -> None:
    """Modules imported so far come back when the test ends."""
    for name in [name for name in sys.modules if name.split(".")[0] in NAMES]:
        monkeypatch.delitem(sys.modules, name)


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Stand-ins for torch and lpips that record their arguments; the file of weights."""
    forget(monkeypatch)
    packages, weights = tmp_path / "packages", tmp_path / "torch" / "hub" / "checkpoints" / BACKBONE
    packages.mkdir()
    (packages / "torch.py").write_text(TORCH)
    (packages / "lpips.py").write_text(LPIPS)
    weights.parent.mkdir(parents=True)
    weights.write_text("weights")
    monkeypatch.syspath_prepend(packages)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    yield weights
    for name in NAMES:
        sys.modules.pop(name, None)


def calls() -> list[tuple[np.ndarray, np.ndarray, bool, bool]]:
    found: list[tuple[np.ndarray, np.ndarray, bool, bool]] = sys.modules["lpips"].calls  # type: ignore[attr-defined]
    return found


def test_what_the_network_is_given(fake: Path) -> None:
    rng = np.random.default_rng(1)
    image, reference = rng.normal(0.5, 0.5, (2, 33, 40, 3)).astype(np.float32)
    reference = reference.transpose(2, 0, 1).copy().transpose(1, 2, 0)  # renders are planes seen from the side
    distance = Lpips(MemoryBudget(LIMIT), 33 * 40)(image, reference)
    ((first, second, tracing, trained),) = calls()
    for given, source in ((first, image), (second, reference)):
        assert given.shape == (1, 3, 33, 40) and given.dtype == np.float32 and given.flags.c_contiguous
        assert given.min() == -1.0 and given.max() == 1.0  # clamped: the noise goes beyond both ends
        np.testing.assert_allclose(given[0, 1], 2 * np.clip(source[:, :, 1], 0, 1) - 1, atol=1e-6)
    assert not tracing and not trained
    assert distance == pytest.approx(abs(first - second).mean())


def test_pictures_that_have_no_distance(fake: Path) -> None:
    measure = Lpips(MemoryBudget(LIMIT), 10_000)
    small = np.zeros((LPIPS_SIDE - 1, 50, 3), np.float32)
    assert measure(small, small) is None and not calls()
    with pytest.raises(InputError, match=r"\(40, 50, 3\) and \(30, 50, 3\) cannot be compared"):
        measure(small, np.zeros((40, 50, 3), np.float32))


def test_memory_is_taken_and_given_back(fake: Path) -> None:
    budget = MemoryBudget(LIMIT)
    measure = Lpips(budget, 10**6)
    assert budget.used >= 300 * 10**6
    measure.close()
    assert budget.used == 0
    with pytest.raises(BudgetError, match="LPIPS needs .* use --memory-limit"):
        Lpips(MemoryBudget(100 * 2**20), 10**6)


@pytest.mark.parametrize("missing", ["lpips", "torch"])
def test_a_missing_package(fake: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, missing: str) -> None:
    (tmp_path / "packages" / f"{missing}.py").write_text(f"raise ModuleNotFoundError(\"No module named '{missing}'\")")
    with pytest.raises(InputError, match=rf"'{missing}'.*pip install 'flexgs-edge\[lpips\]'"):
        Lpips(MemoryBudget(LIMIT), 1)


def test_libraries_that_do_not_fit(fake: Path, tmp_path: Path) -> None:
    (tmp_path / "packages" / "lpips.py").write_text("raise RuntimeError('operator torchvision::nms does not exist')")
    with pytest.raises(InputError, match="torch and torchvision do not fit each other: operator torchvision::nms"):
        Lpips(MemoryBudget(LIMIT), 1)


def test_missing_and_broken_weights(fake: Path) -> None:
    fake.write_text("")
    with pytest.raises(InputError, match=f"{fake}: the weights of AlexNet cannot be read .Ran out of input.; remove"):
        Lpips(MemoryBudget(LIMIT), 1)
    fake.unlink()
    with pytest.raises(InputError, match=f"no network.*get https://.*/{BACKBONE} .*put it at {fake} .TORCH_HOME"):
        Lpips(MemoryBudget(LIMIT), 1)


def larger_project(folder: Path, photos: bool) -> Path:
    """The tiny scene with four views of 80x60, since AlexNet sees nothing smaller than 31 pixels."""
    project = make_project(folder, photos=False)
    cameras = json.loads((project / "cameras.json").read_text())[:4]
    for camera in cameras:
        for key in ("width", "height", "fx", "fy"):
            camera[key] *= 2
    (project / "cameras.json").write_text(json.dumps(cameras))
    if photos:
        write_photos(project / "images", project / "point_cloud.ply", project / "cameras.json")
    return project


@pytest.mark.parametrize("photos", [True, False])
def test_evaluate_reports_every_pair(fake: Path, tmp_path: Path, photos: bool) -> None:
    first = larger_project(tmp_path / "first", photos) / "point_cloud.ply"
    second = make_project(tmp_path / "second", photos=False, degree=0) / "point_cloud.ply"
    options: dict[str, Any] = {"holdout": 2}
    result = evaluate(second, first, lpips=True, **options)
    pairs = calls()
    assert len(pairs) == (3 if photos else 1) * 2
    record = result.to_json()["quality"]
    expected = [abs(a - b).mean() for a, b, *_ in pairs]
    for i, view in enumerate(record["views"]):
        mine = expected[3 * i : 3 * i + 3] if photos else [expected[i], None, None]
        for key, value in zip(("lpips_fidelity", "lpips", "original_lpips"), mine, strict=True):
            assert view[key] == (None if value is None else pytest.approx(value, abs=1e-5))
    for key in ("lpips_fidelity", "lpips", "original_lpips"):
        values = [view[key] for view in record["views"]]
        assert record[key] == (None if values[0] is None else pytest.approx(sum(values) / 2, abs=2e-5))
    text = result.summary()
    assert ("LPIPS to ref." in text) and f"LPIPS {record['lpips_fidelity']:.3f}" in text
    assert ("->" in text.split("LPIPS", 1)[1].split("\n")[0]) == photos
    # Not asked for: not measured, not mentioned.
    plain = evaluate(second, first, **options)
    assert len(calls()) == len(pairs) and plain.to_json()["quality"]["lpips_fidelity"] is None
    assert "LPIPS" not in plain.summary()


class Undrawn(Progress):
    """Fails where views begin to be drawn."""

    def track(self, items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
        raise AssertionError("drawn in vain")


def test_missing_packages_stop_before_any_drawing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    forget(monkeypatch)
    monkeypatch.setitem(sys.modules, "lpips", None)  # an import of it then fails
    scene = make_project(tmp_path / "scene", photos=False) / "point_cloud.ply"
    progress = Undrawn(enabled=False)
    with pytest.raises(InputError, match="--lpips needs the packages"):
        evaluate(scene, scene, lpips=True, device="numpy", memory_limit=LIMIT, progress=progress)
    with pytest.raises(AssertionError, match="drawn in vain"):
        evaluate(scene, scene, device="numpy", memory_limit=LIMIT, progress=progress)


def real_package() -> ModuleType:
    for name in NAMES:
        if importlib.util.find_spec(name) is None:
            pytest.skip(f"{name} is not installed: pip install 'flexgs-edge[lpips]'")
    import torch

    return torch  # type: ignore[no-any-return]


@pytest.mark.filterwarnings("ignore")
def test_the_real_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With random weights in AlexNet's place, since the trained ones are a download."""
    torch = real_package()
    import lpips
    import torchvision

    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    (tmp_path / "hub" / "checkpoints").mkdir(parents=True)
    torch.manual_seed(0)
    torch.save(torchvision.models.alexnet(weights=None).state_dict(), tmp_path / "hub" / "checkpoints" / BACKBONE)
    measure = Lpips(MemoryBudget(LIMIT), 64 * 48)
    rng = np.random.default_rng(3)
    image = rng.random((48, 64, 3), np.float32)
    noise = rng.normal(0, 1, image.shape).astype(np.float32)
    assert measure(image, image) == 0.0
    near, far = (measure(image + scale * noise, image) for scale in (0.01, 0.2))
    assert near is not None and far is not None and 0.0 < near < far
    network = lpips.LPIPS(net="alex", verbose=False)
    a, b = (torch.from_numpy(x.transpose(2, 0, 1)[None].copy()) for x in (np.clip(image + 0.2 * noise, 0, 1), image))
    assert far == pytest.approx(float(network(a, b, normalize=True)), rel=1e-4)
    least = rng.random((LPIPS_SIDE, LPIPS_SIDE, 3), np.float32)
    assert measure(least, 1 - least) is not None and measure(least[1:], least[1:]) is None
