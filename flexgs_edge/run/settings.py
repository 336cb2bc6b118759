"""The settings that a `.fgs` file stores about how it was made."""

from __future__ import annotations

from typing import Any

from flexgs_edge._version import __version__
from flexgs_edge.cameras.start import START
from flexgs_edge.codec.header import canonical_json
from flexgs_edge.goals.steps import Choice, SearchResult, Step
from flexgs_edge.goals.target import Covered, Measurement
from flexgs_edge.packed.bitspec import BitSpec
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.run import Run

MARGIN = 16  # Room for numbers of the header that grow by a digit with the settings, such as its own length


def make_settings(
    run: Run[CompressOptions], search: SearchResult | None, bits: BitSpec | None = None
) -> dict[str, Any]:
    """Collect the settings that a `.fgs` file stores.

    Every run and machine must store the same settings, so they hold no times, paths or devices.

    `run`: gives the options, the plan and the scene. `search`: `None` for fixed rates. `bits`: bits per attribute
    (`paper`).
    """
    options, plan, scene, views = run.options, run.plan, run.scene, run.views
    choice = search.chosen.choice if search else options.fixed
    assert plan is not None and choice is not None and options.background is not None
    found = search.chosen.measurement if search else None
    return {
        "program": f"flexgs-edge {__version__}",
        "method": options.method,
        "score": options.score if plan.needs_scores else None,
        "prune_rate": choice.prune / 1000,
        "sh_rate": choice.sh / 1000,
        "bits": None if bits is None else options.bits if options.bits == "paper" else str(bits),
        "source_count": scene.input_count,
        "source_sh_degree": scene.source.sh_degree,
        "target": plan.target.describe() if plan.target else None,
        "decided_by": plan.decided_by,
        "reached": search.reached if search and plan.target else None,
        "select": options.select if views else None,
        "holdout": options.holdout if views else None,
        "views": len(views.cameras) if views else 0,
        "effort": options.effort if plan.target else None,
        **({} if options.distil is None else {"distil": options.distil}),
        "base_psnr": options.base_psnr,
        "quality": {
            name: None if value is None else round(value, 3) for name, value in (_means(found) if found else {}).items()
        },
        "near": options.near,
        "background": list(options.background),
        "extent": "exact",
        "antialiased": options.antialiased,
        **({} if scene.crop is None else {"crop": scene.crop.to_json()}),
        **({} if views is None else {START: views.start(scene.source).to_json()}),
    }


def settings_room(run: Run[CompressOptions]) -> int:
    """Most bytes that the settings of a searched file take in its header, before the search has found anything."""
    widest = -99.999
    quality = Measurement(widest, widest, widest, covered=Covered(widest, widest))
    step = Step(Choice(prune=999, sh=1), 0, quality, 0.0, "multiplier", 0.0)
    settings = {**make_settings(run, SearchResult(step, False, ())), "prune_rate": 0.999, "sh_rate": 0.999}
    return len(canonical_json(settings)) + MARGIN


def _means(found: Measurement) -> dict[str, float | None]:
    means = {"drop": found.drop, "fidelity": found.fidelity, "modelled_drop": found.modelled_drop}
    if found.covered is None:
        return means
    return {**means, "covered_fidelity": found.covered.fidelity, "covered_modelled_drop": found.covered.modelled_drop}
