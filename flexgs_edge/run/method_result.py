"""The record that a method returns, and the settings that its file stores."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from flexgs_edge._version import __version__
from flexgs_edge.cameras.auto import CloseUp
from flexgs_edge.cameras.start import START
from flexgs_edge.codec.sections import canonical_json
from flexgs_edge.goals.steps import Choice, SearchResult, Step
from flexgs_edge.goals.target import Covered, Measurement
from flexgs_edge.grid.step_sizes import StepSizes
from flexgs_edge.packed.bitpack import BitSpec
from flexgs_edge.quality.view_quality import Quality
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.run import Run

MARGIN = 16  # Room for numbers of the header that grow by a digit with the settings, such as its own length


@dataclass(frozen=True)
class MethodResult:
    """A finished file: its size, the search that found it, and its quality.

    `count`, `sh_count`, `sh_degree`: Gaussians, those with SH above degree 0, and the highest SH degree.
    """

    size: int  # bytes of the file
    count: int
    sh_count: int
    sh_degree: int
    choice: Choice  # prune rate and SH rate, in thousandths
    search: SearchResult | None  # every step of the search; `None` for fixed rates
    quality: Quality | None  # quality of the decoded file over the report views; `None` without views
    trained: float | None  # fidelity of the decoded file on training views, dB; `None` if not measured
    lost: tuple[CloseUp, ...] = ()  # what automatic views show small, and looks wrong from near by
    bits: BitSpec | None = None  # bits per attribute (`paper`)
    groups: Mapping[str, int] | None = None  # quantization groups per array (`paper`)
    step_sizes: StepSizes | None = None  # quantization step sizes (`best`)
    scores_reused: bool = False  # whether the scores came from the cache
    preview_bytes: int = 0  # bytes of the file that are its preview (`best`); 0 if it has none


def make_settings(
    run: Run[CompressOptions], search: SearchResult | None, bits: BitSpec | None = None
) -> dict[str, Any]:
    """Collect the settings that a `.fgs` file stores.

    Every run and machine must store the same settings, so they hold no times, paths or devices.

    `run`: gives the options, the plan and the scene. `search`: `None` for fixed rates. `bits`: bits per attribute (`paper`).
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
