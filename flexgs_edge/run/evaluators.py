"""The views that decide and those that report, prepared together and asked for the final figures."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any

from flexgs_edge.cameras.auto import CloseUp
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.goals.promise import MADE_GAP
from flexgs_edge.memory.storage import Storage
from flexgs_edge.packed.quantize import QuantizedScene
from flexgs_edge.quality.view_quality import Quality
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.run.decoding import ahead, coding_device
from flexgs_edge.run.few_poses import MOST, FewPoses, evenly, made_poses
from flexgs_edge.run.quality_evaluator import QualityEvaluator
from flexgs_edge.run.run import Run
from flexgs_edge.scene.source import SceneSource

LEAST_NEAR = 30.0
"""What views show small looks wrong from near by if it has less fidelity than this, dB, and `MADE_GAP` less than the rest."""


class Evaluators(AbstractContextManager["Evaluators"]):
    """The judge that decides and the one that reports, the same object unless training poses decide; close when done.

    `run`: planned, with views. `renderer`: draws.
    """

    def __init__(self, run: Run[Any], renderer: Renderer) -> None:
        assert run.plan is not None
        self._run, self._renderer, self._plan = run, renderer, run.plan
        self.report = self._judge(run.plan.report, reports=True)
        on_train = run.plan.decide != run.plan.report
        self.decide = self._judge(run.plan.decide, reports=False) if on_train else self.report
        self.training: FewPoses | None = None
        self._made: FewPoses | None = None
        self._close_ups: FewPoses | None = None
        self.lost: tuple[CloseUp, ...] = ()  # Views from near by of what was measured last that look wrong
        self.trained: float | None = None  # Fidelity of what was measured last on training poses, dB

    def _judge(self, indices: list[int], reports: bool) -> QualityEvaluator:
        run = self._run
        words = {"with_photos": reports, "base_psnr": run.options.base_psnr, "finetuned": run.options.finetunes}
        return QualityEvaluator(self._renderer, run.source, run.seen, indices, reports=reports, **words)

    @property
    def storage(self) -> Storage:
        """Where large arrays of the run lie."""
        return self._renderer.storage

    @contextmanager
    def original(self) -> Iterator[DeviceScene]:
        """The original, loaded once: its references are drawn at the start, and it is released at the end."""
        run, renderer = self._run, self._renderer
        views, made = run.seen, None
        if self._plan.makes_poses:
            with run.clock.stage("load"):
                made = made_poses(renderer, run.source, self.decide.cameras)
        with run.clock.stage("load"):
            device_scene = renderer.load(run.source)
        with device_scene:
            with run.clock.stage("references"):
                self.report.prepare(device_scene, run.progress)
                if self.decide is not self.report:
                    self.decide.prepare(device_scene, run.progress)
                if views.train and self._plan.report == views.held_out:
                    cameras = evenly(views.of(views.train), MOST)
                    self.training = self._few(device_scene, cameras)
                if views.close_ups:
                    self._close_ups = self._few(device_scene, [each.camera for each in views.close_ups])
                if made is not None:
                    self.decide.made = self.report.made = self._made = self._few(device_scene, made)
            yield device_scene
        renderer.release()

    def _few(self, original: DeviceScene, cameras: Sequence[Camera]) -> FewPoses:
        covered_decides, progress = self.report.covered_decides, self._run.progress
        return FewPoses(self._renderer, original, cameras, covered_decides, progress)

    def prepare(self) -> None:
        """Draw the references, where nothing else is asked of the original."""
        with self.original():
            pass

    def measure(self, source: SceneSource) -> Quality:
        """Quality of a decoded file."""
        renderer, budget = self._renderer, self._run.budget
        with ahead(source, budget, coding_device(renderer.backend, budget, source.count, source.sh_degree)):
            return self._compare(lambda: renderer.load(source))

    def measure_quantized(self, quantized: QuantizedScene) -> Quality:
        """Quality of codes that are dequantized on the device."""
        return self._compare(lambda: self._renderer.load_quantized(quantized))

    def _compare(self, load: Callable[[], DeviceScene]) -> Quality:
        """Quality of what `load` brings to the device, over the views that report and (fidelity only) some training poses."""
        run = self._run
        with run.clock.stage("measure"), load() as scene:
            # First, since it brings the scene to the backend: the judge then sees whether it is what the search measured.
            if self.training is not None:
                self.trained = self.training.quality(scene).deciding_fidelity
            quality = self.report.compare(scene, with_ssim=True, progress=run.progress, flip=True)
            if self._close_ups is not None:
                bound = min(LEAST_NEAR, (quality.deciding_fidelity or LEAST_NEAR) - MADE_GAP)
                found = zip(run.seen.close_ups, self._close_ups.quality(scene).views, strict=True)
                self.lost = tuple(each for each, view in found if (view.covered_fidelity or bound) < bound)
            if run.reporter is not None:
                run.reporter.look(self.report, scene, quality, run.clock, run.progress)
        return quality

    def decided(self) -> None:
        """Give the memory of the judge that decides back, where another one reports."""
        if self.decide is not self.report:
            self.decide.close()

    def close(self) -> None:
        """Remove what the original looked like from training poses and made ones."""
        for few in (self.training, self._made, self._close_ups):
            if few is not None:
                few.close()

    def __exit__(self, *exc: object) -> None:
        self.close()
