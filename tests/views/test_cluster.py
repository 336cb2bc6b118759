"""`--cluster`: workers draw what is scored and compared, with the bytes of one machine, also when they are killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from flexgs_edge._version import __version__
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.errors import InputError
from flexgs_edge.io.ply import write_ply
from flexgs_edge.memory.storage import IN_MEMORY
from flexgs_edge.methods.best.costs import PART_NAMES, cost_parts, cost_sums, measure_costs, put_costs
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.views import cluster, worker
from flexgs_edge.views.cluster import Cluster
from flexgs_edge.views.render_context import RenderContext
from flexgs_edge.views.sums import ViewSums
from flexgs_edge.views.worker import Drawing
from kernel_fixtures import large_budget, open_form
from synthetic import look_from, make_camera, random_scene
from tiny_project import write_cameras

DRAWING = Drawing("numpy", None, 0.2, (0.0, 0.0, 0.0), False)
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


@pytest.fixture(scope="module")
def distributed() -> None:
    pytest.importorskip("distributed", reason="pip install 'flexgs-edge[cluster]' for tests of --cluster")


def cameras() -> list[Camera]:
    views = []
    for seed in range(4):
        rotation, translation = look_from(seed)
        views.append(make_camera(rotation=rotation, translation=translation, name=f"v{seed}"))
    rotation, _ = look_from(1)
    return [*views, make_camera(rotation=rotation, translation=(0.0, 0.0, -50.0), name="nothing")]


class Here:
    """Draws where it is asked, by the same functions as a worker, and loses the scene once."""

    def __init__(self) -> None:
        self.lost = 0

    def nthreads(self) -> dict[str, int]:
        return {"here": 1}

    def scatter(self, values: list[object], **_: object) -> list[object]:
        return values

    def submit(self, function: object, *words: object, pure: bool) -> object:
        client = self

        class Future:
            def result(self) -> object:
                client.lost += 1
                if client.lost == 3:
                    raise cluster.CancelledError
                return function(*words)  # type: ignore[operator]

        return Future()

    def cancel(self, futures: list[object]) -> None:
        pass


def test_sums_and_pictures_are_those_of_one_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without Dask: what workers do, put together, a lost scene sent again, and views in their order."""
    source = random_scene(900, 5, 2)
    workers = Cluster.__new__(Cluster)
    workers._client, workers._drawing, workers._lost = Here(), DRAWING, RuntimeError  # type: ignore[assignment]
    found = []
    for draws in (None, workers):
        renderer = Renderer(open_form("numpy"), large_budget())
        bench = RenderContext(renderer, draws)
        with renderer.load(source, 100) as scene:
            costs = measure_costs(bench, scene, cameras())
            found.append([costs.removal, costs.weight2, costs.sh, costs.sh_mean])
        with renderer.load(source) as scene:
            found[-1] += list(bench.images(scene, cameras()))
            assert (renderer._buffers is None) == (draws is not None), "nothing is drawn here where others do"
        renderer.release()
    assert workers._client.lost > 2 * len(cameras())  # type: ignore[attr-defined]
    for plain, drawn in zip(*found, strict=True):
        np.testing.assert_array_equal(drawn, plain)
        assert drawn.strides == plain.strides, "sums over pixels go along the memory"


def test_a_view_of_nothing_adds_nothing() -> None:
    """A worker with little memory sends no rows of a view that shows none."""
    renderer = Renderer(open_form("numpy"), large_budget())
    with renderer.load(random_scene(90, 5, 1), 100) as scene:
        found = []
        for drawn in (True, False):
            sums = ViewSums(RenderContext(renderer), scene, [cost_sums(renderer, 1)])
            sums.add_view(renderer.removal_sums(scene, cameras()[0]), cameras()[0])
            if drawn:
                sums._add_drawn([], cameras()[-1])
            costs = cost_parts(1, scene.count, IN_MEMORY)
            for rows, (part,) in sums.parts():
                put_costs(costs, rows, part)
            found.append([getattr(costs, name) for name in PART_NAMES])
            sums.release()
    assert found[0][0].any()
    for empty, plain in zip(*found, strict=True):
        np.testing.assert_array_equal(empty, plain)


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"pip install 'flexgs-edge\[cluster\]'"):
        Cluster("tcp://10.0.0.5:8786", DRAWING)


def test_workers_keep_the_scene_that_was_sent_last() -> None:
    desk, source = worker._Desk(), random_scene(50, 1)
    renderer, first = desk.ready(("a", source), DRAWING)
    assert desk.ready(("a", source), DRAWING) == (renderer, first)
    again, second = desk.ready(("b", source), DRAWING)
    assert again is renderer and second is not first
    assert desk.ready(("b", source), Drawing(**{**vars(DRAWING), "near": 0.3}))[0].near == 0.3
    assert worker.worker_version() == __version__


def compress(folder: Path, name: str, *words: str) -> subprocess.Popen[str]:
    """A run of its own: what Dask says in warnings is not this program's."""
    command = [sys.executable, "-m", "flexgs_edge", "compress", str(folder / "point_cloud.ply"), "-f"]
    command += ["-o", str(folder / f"{name}.fgs"), "--effort", "fast", "--min-fidelity", "38", "--best-effort", *words]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=ENVIRONMENT)


def finished(run: subprocess.Popen[str]) -> None:
    """Wait for a run, which is to succeed."""
    try:
        said = run.communicate(timeout=200)
    finally:
        run.kill()
    assert run.returncode == 0, said


def test_a_killed_worker_changes_nothing(distributed: None, tmp_path: Path) -> None:
    from distributed import Client, LocalCluster

    write_ply(tmp_path / "point_cloud.ply", random_scene(6000, 8, 3, size=-4.0))
    write_cameras(tmp_path / "cameras.json")
    finished(compress(tmp_path, "plain"))
    expected = (tmp_path / "plain.fgs").read_bytes()

    words = {"n_workers": 2, "threads_per_worker": 1, "memory_limit": 0, "dashboard_address": None}
    with LocalCluster(**words, env={"POCL_MAX_PTHREAD_COUNT": "1"}) as local, Client(local) as client:
        before = set(client.run(os.getpid).values())
        drawn = compress(tmp_path, "drawn", "--cluster", local.scheduler_address)
        tasks = 0
        while tasks < 3 and drawn.poll() is None:  # into the first views
            time.sleep(0.01)
            tasks = sum(client.run_on_scheduler(_tasks_done).values())
        assert drawn.poll() is None
        os.kill(min(before), signal.SIGKILL)
        finished(drawn)
        client.wait_for_workers(2)
        assert len(before & set(client.run(os.getpid).values())) == 1
    assert (tmp_path / "drawn.fgs").read_bytes() == expected


def _tasks_done(dask_scheduler: object) -> dict[str, int]:
    """Tasks that each worker has begun or finished."""
    states = dask_scheduler.workers.values()  # type: ignore[attr-defined]
    return {state.address: len(state.processing) + len(state.has_what) for state in states}


def test_nobody_answers(distributed: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            "from test_cluster import *; cluster.CONNECT_SECONDS = 2; Cluster('tcp://127.0.0.1:9', DRAWING)",
        ],
        capture_output=True,
        text=True,
        env=ENVIRONMENT,
        check=False,
    )
    assert "InputError: --cluster tcp://127.0.0.1:9: no cluster of workers with flexgs-edge answers" in done.stderr
