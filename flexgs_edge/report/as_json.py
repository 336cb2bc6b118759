"""Write results as JSON. Figures are rounded to the digits that matter; null stands for a missing figure."""

import json
from typing import Any

from flexgs_edge.goals.promise import KeptPromise
from flexgs_edge.goals.steps import Step
from flexgs_edge.goals.target import Measurement
from flexgs_edge.quality.view_quality import Quality, ViewQuality
from flexgs_edge.report.run_info import SIMILARITIES, fields_json


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
        **_measured_json(found),
        "worst": _measured_json(found.worst) if found and found.worst else None,
        "usual_drop": rounded(found.usual if found else None),
        "ssim_drop": rounded(found.ssim_drop if found else None, 5),
        "made_gap": rounded(found.made_gap if found else None),
        "holds": step.holds,
        "estimated": step.estimated,
        "seconds": round(step.seconds, 3),
    }


def _measured_json(found: Measurement | None) -> dict[str, float | None]:
    """The figures of a measurement. Those over covered pixels are null where the plain ones decide."""
    covered = None if found is None else found.covered
    return {
        "drop": rounded(found.drop if found else None),
        "fidelity": rounded(found.fidelity if found else None),
        "modelled_drop": rounded(found.modelled_drop if found else None),
        "covered_fidelity": rounded(covered.fidelity if covered else None),
        "covered_modelled_drop": rounded(covered.modelled_drop if covered else None),
    }


def promise_json(promise: KeptPromise | None) -> dict[str, Any] | None:
    """Return the bounds beside the target as JSON values."""
    if promise is None:
        return None
    parts = [
        fields_json(
            part, "words", found=rounded(part.found, 5), allowed=rounded(part.allowed, 5), share=rounded(part.share)
        )
        for part in promise.parts
    ]
    return fields_json(promise, held=promise.held, share=rounded(promise.share), parts=parts)


def quality_json(quality: Quality) -> dict[str, Any]:
    """Return the means, the worst view and every view as JSON values.

    null stands for identical images, for no photo, or for a figure that was not measured.
    """
    worst, worst_flip = quality.worst, quality.worst_flip
    return {
        **_figures_json(quality),
        "usual_drop": rounded(quality.usual_drop),
        "modelled_drop": rounded(quality.modelled_drop),
        "covered_modelled_drop": rounded(quality.covered_modelled_drop),
        "covered_decides": quality.covered_decides,
        "base_psnr": quality.base_psnr,
        "worst_flip": rounded(worst_flip.flip_original, 5) if worst_flip else None,
        "identical_views": quality.identical,
        "made": None if quality.made is None else _made_json(quality.made),
        "worst": _view_json(worst) if worst else None,
        "views": [_view_json(view) for view in quality.views],
    }


def _figures_json(found: Quality | ViewQuality) -> dict[str, float | None]:
    """The figures that views and their means share."""
    decibels = ("drop", "fidelity", "covered_fidelity", "psnr", "original_psnr")
    figures = {name: rounded(getattr(found, name)) for name in decibels} | {"coverage": rounded(found.coverage, 6)}
    for name in SIMILARITIES:
        pairs = {name: f"{name}_photo", f"original_{name}": f"original_{name}", f"{name}_fidelity": f"{name}_original"}
        figures |= {key: rounded(getattr(found, own), 5) for key, own in pairs.items()}
    return figures


def _made_json(made: Quality) -> dict[str, Any]:
    """Fidelity at generated poses."""

    def both(found: Quality | ViewQuality) -> dict[str, Any]:
        return {"fidelity": rounded(found.fidelity), "covered_fidelity": rounded(found.covered_fidelity)}

    return {**both(made), "views": [{"name": view.name, **both(view)} for view in made.views]}


def _view_json(view: ViewQuality) -> dict[str, Any]:
    return {
        "name": view.name,
        **_figures_json(view),
        "loss": rounded(view.loss),
        "far_base": rounded(view.far_base),
        "exposure": None if view.exposure is None else [round(stops, 3) for stops in view.exposure],
        "mse": view.error,
    }


def rounded(value: float | None, digits: int = 4) -> float | None:
    """Round a figure to the digits that matter; `None` stays `None`."""
    return None if value is None else round(value, digits)
