"""The views that judge: what they keep, and what they need not draw."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager

import numpy as np
import pytest

from fits import use_fit
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.progress import Stopwatch
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.run.inputs import companions_of, load_scene, resolve_drawing
from flexgs_edge.run.open_renderer import open_renderer
from flexgs_edge.run.options import ViewOptions
from flexgs_edge.run.quality_evaluator import QualityEvaluator
from flexgs_edge.run.run import Run
from flexgs_edge.run.view_set import find_views
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource, SceneSource
from tiny_project import COUNT, make_project

VIEWS = [0, 3, 8]
Judged = tuple[QualityEvaluator, SceneSource, Renderer, MemoryBudget]
MakeJudge = Callable[..., AbstractContextManager[Judged]]


@pytest.fixture(scope="module")
def judged(tmp_path_factory: pytest.TempPathFactory) -> MakeJudge:
    """Makes a judge over three views of the tiny scene."""
    project = make_project(tmp_path_factory.mktemp("tiny") / "scene")
    companions, scene = companions_of(project / "point_cloud.ply"), load_scene(project / "point_cloud.ply")
    options = resolve_drawing(ViewOptions(), scene, companions)
    views = find_views(options, companions, scene.source)
    assert views is not None

    @contextmanager
    def open_judge(**words: bool) -> Iterator[Judged]:
        budget = MemoryBudget(2**28)
        with open_renderer(Run(options, scene, views, None, budget, Stopwatch())) as renderer:
            before = budget.used
            judge = QualityEvaluator(renderer, scene.source, views, VIEWS, **words)
            with renderer.load(scene.source) as loaded:
                judge.prepare(loaded)
            yield judge, scene.source, renderer, budget
            renderer.release()
            judge.close()
            assert budget.used == before

    return open_judge


def half_of(source: SceneSource) -> dict[str, np.ndarray]:
    return source.select(np.arange(0, COUNT, 2)).read(slice(0, COUNT // 2), list(FIELD))


def counting(judge: QualityEvaluator) -> list[DeviceScene]:
    """The scenes whose views the judge draws from now on."""
    drawn: list[DeviceScene] = []
    in_turn = judge.renderer.in_turn

    def counted(scene: DeviceScene, cameras: Sequence[Camera]) -> Iterator[Camera]:
        drawn.append(scene)
        return in_turn(scene, cameras)

    judge.renderer.in_turn = counted  # type: ignore[method-assign]
    return drawn


def test_references_that_do_not_fit_are_drawn_again(judged: MakeJudge, monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    for share in (4, 10**9):
        monkeypatch.setattr("flexgs_edge.run.quality_evaluator.SHARE", share)
        with judged() as (judge, source, renderer, _):
            with renderer.load(source.select(np.arange(0, COUNT, 2))) as loaded:
                found.append(judge.compare(loaded))
            assert judge.kept == (3 if share == 4 else 0)
    assert found[0] == found[1]


def test_one_that_reports_draws_nothing_twice(judged: MakeJudge) -> None:
    with judged(reports=True) as (judge, source, renderer, _):
        drawn, planes = counting(judge), half_of(source)

        def compare(planes: dict[str, np.ndarray], resident: bool = True, with_ssim: bool = True) -> object:
            with renderer.load(MemorySource(planes)) as loaded:
                if resident:
                    renderer.render(loaded, judge.cameras[0])
                return judge.compare(loaded, with_ssim=with_ssim)

        first = compare(planes)
        assert len(drawn) == 1 and compare(planes) == first and len(drawn) == 1
        # Not on the backend yet: nobody knows what it is.
        assert compare(planes, resident=False) == first and len(drawn) == 2
        assert compare(planes, with_ssim=False) != first and len(drawn) == 3
        # A bit of one number is another scene.
        planes["log_scales"][0, 5] = np.nextafter(planes["log_scales"][0, 5], np.float32(9))
        compare(planes)
        assert len(drawn) == 4


def test_flip_is_added_to_what_is_known(judged: MakeJudge) -> None:
    found = []
    for first in (False, True):
        with judged(reports=True) as (judge, source, renderer, _):
            drawn = counting(judge)
            with renderer.load(MemorySource(half_of(source))) as loaded:
                renderer.render(loaded, judge.cameras[0])
                known = judge.compare(loaded, with_ssim=True, flip=first)
                assert (known.flip_original is not None) == first
                found.append(judge.compare(loaded, with_ssim=True, flip=True))
                assert judge.compare(loaded, with_ssim=True) == found[-1]
            assert len(drawn) == (1 if first else 2)
    assert found[0] == found[1] and found[0].flip_photo is not None and found[0].ssim_photo is not None


def test_streamed_scenes_are_known_again_once_they_were_drawn(
    judged: MakeJudge, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_fit(monkeypatch, whole_views=False)
    with judged(reports=True) as (judge, source, renderer, _):
        drawn, planes = counting(judge), half_of(source)

        def compare(planes: dict[str, np.ndarray]) -> object:
            with renderer.load(MemorySource(planes)) as loaded:
                renderer.render(loaded, judge.cameras[0])
                return judge.compare(loaded, with_ssim=True)

        first = compare(planes)
        assert len(drawn) == 1 and compare(planes) == first and len(drawn) == 1
        planes["sh_dc"][0, 5] = np.nextafter(planes["sh_dc"][0, 5], np.float32(9))
        compare(planes)
        assert len(drawn) == 2
