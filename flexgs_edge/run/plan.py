"""Plan a run of `compress` before any work: the views that decide and report, the target, and the scores it needs."""

from __future__ import annotations

from dataclasses import dataclass

from flexgs_edge.errors import InputError
from flexgs_edge.goals.promise import MadePoses, Promised
from flexgs_edge.goals.steps import Choice
from flexgs_edge.goals.target import Figure, Target
from flexgs_edge.run.inputs import CheckedScene
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.view_set import WITHOUT_VIEWS, ViewSet

EVERYTHING = Choice(0, 0)


@dataclass(frozen=True)
class Plan:
    """Views, target and scores of a run."""

    # Views that decide when the search stops: the held-out views, or the training views with `--select train`.
    decide: list[int]
    # Views that the final figures come from: the held-out views, or the training views if none are held out.
    report: list[int]
    figure: Figure  # the kind of drop that decides: `drop` against photos, else `modelled drop`
    target: Target | None  # `None` for fixed rates
    needs_scores: bool  # whether the method computes importance scores

    @classmethod
    def make(cls, options: CompressOptions, scene: CheckedScene, views: ViewSet | None) -> Plan:
        fixed = options.fixed
        needs_scores = fixed != EVERYTHING and options.method == "paper"
        if views is None:
            if options.method != "paper":
                raise InputError(
                    f"{WITHOUT_VIEWS}. Views are needed to measure what each Gaussian is worth; without them only "
                    "--method paper with both rates 0 works"
                )
            if fixed is None or needs_scores:
                why = "to score Gaussians and to judge the result" if fixed is None else "to score Gaussians"
                raise InputError(
                    f"{WITHOUT_VIEWS}. Views are needed {why}; without them only --prune-rate 0 and --sh-rate 0 work"
                )
            return cls([], [], "modelled drop", None, needs_scores)
        if options.select == "test" and not views.held_out:
            raise InputError(
                "--holdout 0 leaves no view to decide on: use --select train as well, or another --holdout"
            )
        if not views.train and (options.method != "paper" or needs_scores or options.select == "train"):
            raise InputError(
                f"{views.cameras_from}: {len(views.cameras)} views, all of them held out (every {options.holdout}th by name): "
                "give more views, or --holdout 0 --select train"
            )
        on_train = options.select == "train"
        figure: Figure = "drop" if views.photos is not None and not on_train else "modelled drop"
        return cls(
            decide=views.train if on_train else views.held_out,
            report=views.held_out or views.train,
            figure=figure,
            target=options.target(figure, scene.ply_bytes),
            needs_scores=needs_scores,
        )

    @property
    def makes_poses(self) -> bool:
        """Whether the promise is about made poses too."""
        target = self.target
        return isinstance(target, Promised) and any(isinstance(part, MadePoses) for part in target.parts)

    @property
    def decided_by(self) -> str | None:
        """Name of the deciding figure: `drop`, `modelled drop`, `fidelity` or `size`; `None` for fixed rates."""
        if self.target is None:
            return None
        return "size" if self.target.limit_bytes is not None else self.target.figure

    @staticmethod
    def kind_of(indices: list[int], views: ViewSet | None) -> str:
        """Name of the kind of views at `indices`: `held-out`, `training` or `none`."""
        if not indices or views is None:
            return "none"
        return "held-out" if indices == views.held_out else "training"
