"""Several scenes in one command: what is done, what fails, what is left behind."""

from __future__ import annotations

import gc
import json
import logging
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest

import flexgs_edge
from flexgs_edge.commands.compress import compress
from flexgs_edge.commands.compress_all import compress_all
from flexgs_edge.errors import InputError, TargetError
from flexgs_edge.io.ply import write_ply
from flexgs_edge.progress import Progress, T
from flexgs_edge.report.results import BatchResult
from flexgs_edge.scene.source import SceneSource
from synthetic import random_scene
from tiny_project import write_cameras

BLIND: dict[str, Any] = {"method": "paper", "cameras": "none", "prune_rate": 0.0, "sh_rate": 0.0}
"""Nothing is drawn, so that a scene takes milliseconds."""
DRAWN: dict[str, Any] = {"method": "paper", "holdout": 4, "prune_rate": 0.2, "sh_rate": 0.3}


@pytest.fixture
def scans(tmp_path: Path) -> Path:
    """Three scenes, one of them cut short."""
    folder = tmp_path / "scans"
    folder.mkdir()
    for seed, name in enumerate("abc"):
        write_ply(folder / f"{name}.ply", random_scene(60 + seed, seed=seed))
    (folder / "b.ply").write_bytes((folder / "b.ply").read_bytes()[:-9])
    return folder


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_bad_scene_does_not_stop_the_others(scans: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    out = tmp_path / "out"
    result = compress_all([scans, tmp_path / "none.ply"], out, **BLIND)
    assert names(out) == ["a.fgs", "c.fgs"] and names(scans) == ["a.ply", "b.ply", "c.ply"]
    assert [item.input for item in result.items] == [str(scans / f"{name}.ply") for name in "abc"] + [
        str(tmp_path / "none.ply")
    ]
    assert [item.exit_code for item in result.items] == [0, 2, 0, 2] and result.exit_code == 2
    assert [item.input for item in result.failed] == [str(scans / "b.ply"), str(tmp_path / "none.ply")]
    first, bad, _, missing = json.loads(json.dumps(result.to_json(), allow_nan=False))
    assert first == result.results[0].to_json() and first["output"] == str(out / "a.fgs")
    assert bad == {"input": {"path": str(scans / "b.ply")}, "error": result.items[1].error, "exit_code": 2}
    assert "truncated" in bad["error"] and "no such file" in missing["error"]
    said = [record.getMessage() for record in caplog.records if record.levelno == logging.ERROR]
    assert [line.split(": ")[:2] for line in said] == [[item.input, "error"] for item in result.failed]
    lines = result.summary().splitlines()
    assert len(lines) == 6 and "FAILED: truncated" in lines[2] and lines[5].startswith("2 of 4 scenes done, 2 failed: ")
    assert (
        lines[1].split()[:2] == [str(scans / "a.ply"), str(out / "a.fgs")]
        and f"{result.results[0].ratio:.2f}x" in lines[1]
    )


def test_the_files_are_those_of_single_runs(scans: Path, tmp_path: Path) -> None:
    write_cameras(scans / "cameras.json")
    result = compress_all([scans / "a.ply", scans / "c.ply"], tmp_path / "out", **DRAWN)
    assert result.exit_code == 0 and not result.failed
    for name, found in zip("ac", result.results, strict=True):
        compress(scans / f"{name}.ply", tmp_path / f"{name}.fgs", **DRAWN)
        assert (tmp_path / f"{name}.fgs").read_bytes() == (tmp_path / "out" / f"{name}.fgs").read_bytes()
        assert found.quality is not None and f"modelled drop {found.quality.modelled_drop:.3f} dB" in result.summary()


def test_a_target_out_of_reach_is_the_scenes_own(scans: Path, tmp_path: Path) -> None:
    write_cameras(scans / "cameras.json")
    words: dict[str, Any] = {"method": "paper", "effort": "fast", "holdout": 4, "max_size": 1}
    with pytest.raises(TargetError):
        compress(scans / "a.ply", tmp_path / "a.fgs", **words)
    result = compress_all([scans / "a.ply"], tmp_path / "out", **words)
    assert [item.exit_code for item in result.items] == [3] and result.exit_code == 2
    assert not (tmp_path / "out").exists()


def test_files_that_exist_fail_first_and_stay(scans: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "c.fgs").write_text("precious")
    seen: list[BatchResult] = []
    result = compress_all([scans / "a.ply", scans / "c.ply"], out, after=seen.append, **BLIND)
    assert [[item.input for item in each.items] for each in seen] == [
        [str(scans / "c.ply")],
        [str(scans / "a.ply"), str(scans / "c.ply")],
    ]
    assert "the file exists" in str(result.items[1].error) and "-f" in str(result.items[1].error)
    assert (out / "c.fgs").read_text() == "precious" and result.exit_code == 2
    assert compress_all([scans / "a.ply", scans / "c.ply"], out, force=True, **BLIND).exit_code == 0
    assert (out / "c.fgs").read_bytes()[:4] != b"prec"


def test_no_input_is_replaced(scans: Path) -> None:
    (scans / "b.ply").unlink()
    assert compress_all(scans, scans, **BLIND).exit_code == 0
    assert names(scans) == ["a.fgs", "a.ply", "c.fgs", "c.ply"]
    again = compress_all(scans, scans, **BLIND)
    assert [item.input[-5:] for item in again.failed] == ["a.ply", "c.ply"], "earlier outputs are no inputs"
    before = (scans / "a.fgs").read_bytes()
    named = compress_all(scans / "a.fgs", scans, force=True, **BLIND)
    assert "one of the inputs" in str(named.items[0].error) and (scans / "a.fgs").read_bytes() == before


def test_scenes_of_one_name(scans: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    model = other / "m" / "point_cloud" / "iteration_7" / "point_cloud.ply"
    model.parent.mkdir(parents=True)
    write_ply(model, random_scene(50))
    write_ply(other / "a.ply", random_scene(51))
    result = compress_all([scans / "a.ply", other], tmp_path / "out", **BLIND)
    assert result.exit_code == 0 and names(tmp_path / "out") == ["m.fgs", "other-a.ply.fgs", "scans-a.ply.fgs"]
    assert [found.scene.count for found in result.results] == [60, 51, 50]


def test_a_dry_run_writes_nothing(scans: Path, tmp_path: Path) -> None:
    dry = compress_all(scans, None, dry_run=True, **BLIND)
    assert names(tmp_path) == ["scans"] and len(dry.results) == 2 and dry.exit_code == 2
    real = compress_all(scans, tmp_path / "out", **BLIND)
    assert [found.size for found in dry.results] == [found.size for found in real.results]
    assert "nothing was written (--dry-run)" in dry.summary() and "--dry-run" not in real.summary()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ({"report": "page"}, "--report page belongs to one scene"),
        ({"cameras": "poses.json"}, "--cameras poses.json belongs"),
        ({"images": "photos"}, "--images photos belongs"),
        ({"method": "paper", "score_cache": "s.npz"}, "--score-cache s.npz belongs"),
        ({"resume": True}, "--resume belongs"),
        ({"format": "xyz"}, "--format xyz: expected one of"),
        ({"format": "spz", "layers": 2}, "has no layers"),
    ],
)
def test_what_does_not_fit_several_scenes_is_refused_early(
    words: dict[str, Any], says: str, scans: Path, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=says):
        compress_all(scans, tmp_path / "out", **words)
    assert names(tmp_path) == ["scans"]


def test_a_single_scene_may_have_its_own_options(scans: Path, tmp_path: Path) -> None:
    poses = write_cameras(tmp_path / "poses.json")
    result = compress_all(scans / "a.ply", tmp_path / "out", cameras=str(poses), **DRAWN)
    assert result.exit_code == 0 and result.results[0].views is not None
    assert result.results[0].views.cameras == str(poses)


def test_where_nothing_can_be_written(scans: Path, tmp_path: Path) -> None:
    for output, says in (
        (None, "-o OUT/ is missing"),
        ("", "-o OUT/ is missing"),
        (tmp_path / "all.fgs", "all.fgs/ to mean a folder"),
        (tmp_path / "all.spz", "all.spz/ to mean a folder"),
        (tmp_path / "no" / "out", "make it first"),
        (scans / "a.ply", "all"),
    ):
        with pytest.raises(InputError, match=None if says == "all" else says):
            compress_all(scans, output, **BLIND)
    assert names(tmp_path) == ["scans"]
    assert compress_all(scans, f"{tmp_path}/all.fgs/", **BLIND).exit_code == 2 and (tmp_path / "all.fgs").is_dir()


class Breaking(Progress):
    """Raises an error the first time that a file is measured."""

    def __init__(self, error: type[BaseException], before: int = 0) -> None:
        super().__init__(enabled=False)
        self.error, self.before = error, before

    def track(self, items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
        if label == "comparing views":
            self.before -= 1
            if self.before == -1:
                raise self.error
        yield from items


def test_a_fault_of_ours_does_not_stop_the_others(
    scans: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_cameras(scans / "cameras.json")
    result = compress_all(scans, tmp_path / "out", progress=Breaking(ZeroDivisionError), **DRAWN)
    assert [item.exit_code for item in result.items] == [1, 2, 0] and result.exit_code == 1
    assert "internal error: ZeroDivisionError: " in str(result.items[0].error)
    assert names(tmp_path / "out") == ["c.fgs"] and "Traceback" not in caplog.text


def test_an_interruption_leaves_what_is_done(scans: Path, tmp_path: Path) -> None:
    write_cameras(scans / "cameras.json")
    seen: list[BatchResult] = []
    with pytest.raises(KeyboardInterrupt):
        compress_all(scans, tmp_path / "out", None, Breaking(KeyboardInterrupt, 1), after=seen.append, **DRAWN)
    assert names(tmp_path / "out") == ["a.fgs"]
    assert len(seen[-1].results) == 1 and len(seen[-1].failed) == 1
    assert "1 of 3 scenes done, 1 failed, 1 not begun or not finished: " in seen[-1].summary()
    with pytest.raises(KeyboardInterrupt):
        compress_all(scans / "a.ply", tmp_path / "none", progress=Breaking(KeyboardInterrupt), **DRAWN)
    assert not (tmp_path / "none").exists()


def test_a_scene_is_let_go_before_the_next(scans: Path, tmp_path: Path) -> None:
    """Without the collector's own runs, so that nothing else lets it go."""
    write_cameras(scans / "cameras.json")
    before = {id(each) for each in gc.get_objects() if isinstance(each, SceneSource)}
    left: list[list[SceneSource]] = []

    def look(result: BatchResult) -> None:
        left.append([each for each in gc.get_objects() if isinstance(each, SceneSource) and id(each) not in before])

    gc.disable()
    try:
        result = compress_all(scans, tmp_path / "out", None, Breaking(ZeroDivisionError), after=look, **DRAWN)
    finally:
        gc.enable()
    assert [item.exit_code for item in result.items] == [1, 2, 0] and left == [[], [], []]


def test_it_is_public() -> None:
    assert flexgs_edge.compress_all is compress_all and flexgs_edge.BatchResult is BatchResult
