"""Write results as JSON. Figures are rounded to the digits that matter; null stands for a missing figure."""

from __future__ import annotations

import json
from typing import Any

from flexgs_edge.goals.promise import KeptPromise
from flexgs_edge.goals.steps import Step
from flexgs_edge.goals.target import Measurement
from flexgs_edge.quality.view_quality import Quality, ViewQuality


def json_text(record: dict[str, Any] | list[Any]) -> str:
    """Format a record as `--json` and reports write it."""
    return json.dumps(record, indent=2, allow_nan=False) + "\n"


def step_json(step: Step) -> dict[str, Any]:
    """Return a step of the search as JSON values."""
    found = step.measurement
    return {
        "phase": step.phase,
        "prune_rate": step.choice.prune / 1000,
        "sh_rate": step.choice.sh / 1000,
        "size": step.size,
        "drop": rounded(found.drop if found else None),
        "fidelity": rounded(found.fidelity if found else None),
        "modelled_drop": rounded(found.modelled_drop if found else None),
        **_covered_json(found),
        "worst": _worst_json(found.worst) if found and found.worst else None,
        "usual_drop": rounded(found.usual if found else None),
        "ssim_drop": rounded(found.ssim_drop if found else None, 5),
        "made_gap": rounded(found.made_gap if found else None),
        "holds": step.holds,
        "estimated": step.estimated,
        "seconds": round(step.seconds, 3),
    }


def promise_json(promise: KeptPromise | None) -> dict[str, Any] | None:
    """Return the bounds beside the target as JSON values."""
    if promise is None:
        return None
    return {
        "held": promise.held,
        "decided": promise.decided,
        "share": rounded(promise.share),
        "parts": [
            {
                "name": part.name,
                "found": rounded(part.found, 5),
                "allowed": rounded(part.allowed, 5),
                "share": rounded(part.share),
                "held": part.held,
            }
            for part in promise.parts
        ],
    }


def _worst_json(worst: Measurement) -> dict[str, float | None]:
    return {
        "drop": rounded(worst.drop),
        "fidelity": rounded(worst.fidelity),
        "modelled_drop": rounded(worst.modelled_drop),
        **_covered_json(worst),
    }


def _covered_json(found: Measurement | None) -> dict[str, float | None]:
    """The figures over covered pixels; null where the plain ones decide."""
    covered = None if found is None else found.covered
    return {
        "covered_fidelity": rounded(covered.fidelity if covered else None),
        "covered_modelled_drop": rounded(covered.modelled_drop if covered else None),
    }


def quality_json(quality: Quality) -> dict[str, Any]:
    """Return the means, the worst view and every view as JSON values.

    null stands for identical images, for no photo, or for a figure that was not measured.
    """
    worst, worst_flip = quality.worst, quality.worst_flip
    return {
        "drop": rounded(quality.drop),
        "usual_drop": rounded(quality.usual_drop),
        "fidelity": rounded(quality.fidelity),
        "modelled_drop": rounded(quality.modelled_drop),
        "coverage": rounded(quality.coverage, 6),
        "covered_fidelity": rounded(quality.covered_fidelity),
        "covered_modelled_drop": rounded(quality.covered_modelled_drop),
        "covered_decides": quality.covered_decides,
        "base_psnr": quality.base_psnr,
        "psnr": rounded(quality.psnr),
        "original_psnr": rounded(quality.original_psnr),
        "ssim": rounded(quality.ssim_photo, 5),
        "original_ssim": rounded(quality.original_ssim, 5),
        "ssim_fidelity": rounded(quality.ssim_original, 5),
        "lpips": rounded(quality.lpips_photo, 5),
        "original_lpips": rounded(quality.original_lpips, 5),
        "lpips_fidelity": rounded(quality.lpips_original, 5),
        "flip": rounded(quality.flip_photo, 5),
        "original_flip": rounded(quality.original_flip, 5),
        "flip_fidelity": rounded(quality.flip_original, 5),
        "worst_flip": rounded(worst_flip.flip_original, 5) if worst_flip else None,
        "identical_views": quality.identical,
        "made": None if quality.made is None else _made_json(quality.made),
        "worst": _view_json(worst) if worst else None,
        "views": [_view_json(view) for view in quality.views],
    }


def _made_json(made: Quality) -> dict[str, Any]:
    """Fidelity at made poses."""
    return {
        "fidelity": rounded(made.fidelity),
        "covered_fidelity": rounded(made.covered_fidelity),
        "views": [
            {"name": view.name, "fidelity": rounded(view.fidelity), "covered_fidelity": rounded(view.covered_fidelity)}
            for view in made.views
        ],
    }


def _view_json(view: ViewQuality) -> dict[str, Any]:
    return {
        "name": view.name,
        "drop": rounded(view.drop),
        "loss": rounded(view.loss),
        "far_base": rounded(view.far_base),
        "exposure": None if view.exposure is None else [round(stops, 3) for stops in view.exposure],
        "fidelity": rounded(view.fidelity),
        "coverage": rounded(view.coverage, 6),
        "covered_fidelity": rounded(view.covered_fidelity),
        "psnr": rounded(view.psnr),
        "original_psnr": rounded(view.original_psnr),
        "ssim": rounded(view.ssim_photo, 5),
        "original_ssim": rounded(view.original_ssim, 5),
        "ssim_fidelity": rounded(view.ssim_original, 5),
        "lpips": rounded(view.lpips_photo, 5),
        "original_lpips": rounded(view.original_lpips, 5),
        "lpips_fidelity": rounded(view.lpips_original, 5),
        "flip": rounded(view.flip_photo, 5),
        "original_flip": rounded(view.original_flip, 5),
        "flip_fidelity": rounded(view.flip_original, 5),
        "mse": view.error,
    }


def rounded(value: float | None, digits: int = 4) -> float | None:
    """Round a figure to the digits that matter; `None` stays `None`."""
    return None if value is None else round(value, digits)
