"""`info`, `verify` and `trim` on files of both versions: one record, its text, and what damage does."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from camera_files import write_inria
from flexgs_edge.cli import app
from flexgs_edge.codec.open_fgs import read_header
from flexgs_edge.codec.v1.container import write_container
from flexgs_edge.codec.v2.container import channel_bytes, write_grid
from flexgs_edge.codec.v2.grid_source import GridSource
from flexgs_edge.codec.v2.header import Channels
from flexgs_edge.commands.evaluate import evaluate
from flexgs_edge.commands.info import info
from flexgs_edge.commands.render import render_views
from flexgs_edge.commands.trim import trim
from flexgs_edge.commands.verify import verify
from flexgs_edge.errors import FormatError, InputError, TargetError
from flexgs_edge.grid.grid_scene import GridScene, from_grid
from flexgs_edge.io.ply import write_ply
from flexgs_edge.run.inputs import load_scene
from flexgs_edge.scene.source import GrownSource
from grid_scenes import make_grid
from quantized_scenes import make_scene, quantize_all
from scene_files import open_scene
from synthetic import look_from, make_camera

SETTINGS = {"source_count": 4000, "source_sh_degree": 2, "target": "drop <= 1 dB"}


def written(folder: Path, count: int = 900, degree: int = 2, layers: int = 3) -> tuple[Path, GridScene]:
    grid = make_grid(count, degree, layers=layers)
    write_grid(folder / "a.fgs", grid, SETTINGS, chunk_rows=256)
    return folder / "a.fgs", grid


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as left:
        app.main([str(argument) for argument in arguments])
    assert isinstance(left.value.code, int)
    return left.value.code


def test_info_of_version_2_shares_every_byte_out(tmp_path: Path) -> None:
    path, grid = written(tmp_path)
    found = json.loads(json.dumps(info(path).to_json(), allow_nan=False))
    assert (found["version"], found["count"], found["sh_count"]) == (2, 900, grid.sh_count)
    assert found["size"] == path.stat().st_size
    assert found["bits_per_gaussian"] == round(8 * path.stat().st_size / 900, 3)
    channels = found["channels"]
    assert list(channels) == ["position", "scale", "rotation", "opacity", "dc", "sh degree", "sh 1", "sh 2"]
    assert sum(channel["bytes"] for channel in channels.values()) + found["overhead_bytes"] == found["size"]
    taken = channel_bytes(path)
    assert channels["position"]["bytes"] == pytest.approx(taken["position"] + taken["repeats"], abs=0.5)
    for name, channel in channels.items():
        parts = [value for part, value in taken.items() if part.startswith(name) and name != "position"]
        if parts:
            assert channel["bytes"] == pytest.approx(sum(parts), abs=0.5)
    for degree in (1, 2):
        channel = channels[f"sh {degree}"]
        assert channel["rows"] == np.count_nonzero(grid.sh_degrees >= degree) < 900
        assert channel["step"] == grid.step_sizes.sh[degree - 1]
        assert channel["bits_per_row"] == pytest.approx(8 * channel["bytes"] / channel["rows"], rel=0.01)
        assert channel["bits_per_gaussian"] < channel["bits_per_row"]
    assert channels["position"]["step"] == grid.step_sizes.position and channels["sh degree"]["step"] is None
    assert found["cut_from"] is None and found["chroma"] == grid.step_sizes.chroma
    assert [layer["rows"] for layer in found["layers"]] == np.bincount(grid.layer).tolist()
    chunks = sum(
        section.length
        for section in verify(path).sections
        if section.name.startswith("chunk ") and "table" not in section.name
    )
    assert sum(layer["bytes"] for layer in found["layers"]) == chunks
    assert found["ratio"] == pytest.approx(4000 * 4 * (3 + 3 + 3 + 24 + 1 + 3 + 4) / found["size"], rel=1e-3)


def test_text_of_version_2_comes_from_the_record(tmp_path: Path) -> None:
    path, _ = written(tmp_path)
    found = info(path)
    text = found.summary()
    for word in ("fgs version 2", "sh degree", "bits a Gaussian", "layers:      3", "target: drop <= 1 dB", "chroma"):
        assert word in text
    rows = {line.split("  ")[0]: line.split() for line in text.splitlines()}
    for name, channel in found.channels.items():
        assert rows[name][-1] == str(channel["bytes"])


@pytest.mark.parametrize(("count", "degree"), [(0, 0), (1, 0), (1, 4), (40, 0)])
def test_info_of_small_scenes(tmp_path: Path, count: int, degree: int) -> None:
    path, grid = written(tmp_path, count, degree, layers=1)
    found = info(path)
    assert found.count == count and found.sh_count == grid.sh_count
    assert sum(channel["bytes"] for channel in found.channels.values()) + found.overhead_bytes == found.size
    assert "layers:" not in found.summary() and "cut from:" not in found.summary()


def test_info_of_version_1_reads_the_header_only(tmp_path: Path) -> None:
    path = tmp_path / "a.fgs"
    write_container(path, quantize_all(make_scene(70, 1)), {})
    data = bytearray(path.read_bytes())
    data[-100] ^= 1
    path.write_bytes(data)
    found = info(path)
    assert found.version == 1 and "layers" not in found.to_json() and found.channels["rest"]["bits"] == 4
    assert "fgs version 1" in found.summary()


def test_verify_of_version_2_names_the_damaged_part(tmp_path: Path) -> None:
    path, _ = written(tmp_path)
    found = verify(path)
    sections = found.sections
    assert found.ok and found.to_json()["ok"] and "every checksum holds" in found.summary()
    assert sum(section.length for section in sections) == path.stat().st_size
    for damaged in sections[2:]:
        data = bytearray(path.read_bytes())
        data[damaged.offset + damaged.length // 2] ^= 4
        (tmp_path / "b.fgs").write_bytes(data)
        bad = list(verify(tmp_path / "b.fgs").damaged)
        assert bad == ([damaged.name] if damaged.name != "chunk table" else ["chunks", "chunk table"])


def test_info_decodes_files_that_were_cut_alone(tmp_path: Path) -> None:
    path, _ = written(tmp_path)
    told = info(path)
    cut = tmp_path / "cut.fgs"
    trim(path, cut, told.layers[0]["bytes"] + told.overhead_bytes + 2000)
    assert read_header(cut).channels is None
    assert info(cut).channels["position"]["bytes"] < told.channels["position"]["bytes"]
    # A chunk that nobody looks at may be damaged: verify finds it, and so does info where it has to decode.
    data = bytearray(path.read_bytes())
    data[verify(path).sections[3].offset] ^= 4
    path.write_bytes(data)
    assert info(path) == told
    data = bytearray(cut.read_bytes())
    data[verify(cut).sections[3].offset] ^= 4
    cut.write_bytes(data)
    with pytest.raises(FormatError, match="checksum"):
        info(cut)


def test_the_header_agrees_with_the_symbols(tmp_path: Path) -> None:
    path, grid = written(tmp_path)
    found = read_header(path).channels
    assert found == Channels.of(channel_bytes(path), [int(np.count_nonzero(grid.sh_degrees >= d)) for d in (1, 2)])


def test_trim_keeps_whole_layers(tmp_path: Path) -> None:
    path, grid = written(tmp_path)
    first, second, _ = info(path).layers
    most = path.stat().st_size
    sizes = []
    for layers in (3, 2, 1):
        out = tmp_path / f"{layers}.fgs"
        found = trim(path, out, most)
        assert (found.layers, found.size) == (layers, out.stat().st_size) and found.size <= most
        assert f"kept  {layers} of 3 layers, {found.count} of 900" in found.summary()
        source = open_scene(out)
        expected = from_grid(grid.take(grid.layer < layers), fields=("means", "sh_dc"))
        got = source.read(slice(0, source.count), ["means", "sh_dc"])
        for name, plane in expected.items():
            np.testing.assert_array_equal(got[name], plane)
        sizes.append(found.size)
        most = found.size - 1
    assert path.read_bytes() == (tmp_path / "3.fgs").read_bytes()
    cut = info(tmp_path / "1.fgs")
    assert cut.cut_from == {"bytes": path.stat().st_size, "count": 900, "layers": 3}
    assert f"cut from:    {path.stat().st_size} bytes, 900 Gaussians in 3 layers" in cut.summary()
    # A cut file that is cut again remembers the first one.
    trim(tmp_path / "2.fgs", tmp_path / "again.fgs", sizes[1] - 1)
    assert (tmp_path / "again.fgs").read_bytes() == (tmp_path / "1.fgs").read_bytes()
    with pytest.raises(TargetError, match=f"first layer needs {sizes[2]} bytes, {most} are allowed"):
        trim(path, tmp_path / "none.fgs", most)
    assert not (tmp_path / "none.fgs").exists() and not list(tmp_path.glob("*.tmp*"))


def test_cut_files_are_drawn_larger(tmp_path: Path) -> None:
    """As docs/drawing.md says, by `render` and by `evaluate`."""
    path, _ = written(tmp_path)
    cut, grown = tmp_path / "cut.fgs", tmp_path / "grown.ply"
    trim(path, cut, path.stat().st_size - 1)
    source = open_scene(cut)
    assert load_scene(path).drawn.count == 900 and load_scene(cut).drawn.count == source.count < 900
    write_ply(grown, GrownSource(source, 900), double=True)
    poses = [dict(zip(("rotation", "translation"), look_from(seed), strict=True)) for seed in (1, 2)]
    cameras = [make_camera(64, 48, name=f"v{k}", **pose).moved(-source.origin) for k, pose in enumerate(poses)]
    words: dict[str, Any] = {"cameras": str(write_inria(tmp_path / "cameras.json", cameras))}
    pictures = [
        [Path(file).read_bytes() for file in render_views(scene, tmp_path / scene.stem, None, **words).files]
        for scene in (cut, grown, path)
    ]
    assert pictures[0] == pictures[1] != pictures[2]
    write_ply(tmp_path / "plain.ply", source)
    scenes = cut, grown, tmp_path / "plain.ply"
    lost = [evaluate(scene, path, holdout=0, **words).quality.fidelity for scene in scenes]
    assert lost[0] == pytest.approx(lost[1], rel=1e-6) and lost[0] != pytest.approx(lost[2], rel=1e-3)


def test_trim_refuses(tmp_path: Path) -> None:
    path, _ = written(tmp_path, 50)
    old = tmp_path / "v1.fgs"
    write_container(old, quantize_all(make_scene(20, 1)), {})
    (tmp_path / "kept.fgs").write_text("precious")
    cases = [
        (path, "out.ply", 10**6, r"ends in \.fgs"),
        (path, "kept.fgs", 10**6, "exists"),
        (path, "out.fgs", 0, "--max-size 0"),
        (old, "out.fgs", 10**6, "version 1 has no layers"),
        (tmp_path / "none.fgs", "out.fgs", 10**6, r"none\.fgs"),
        (tmp_path / "scene.ply", "out.fgs", 10**6, r"expected a \.fgs file"),
    ]
    for source, out, size, message in cases:
        with pytest.raises(InputError, match=message):
            trim(source, tmp_path / out, size)
    with pytest.raises(InputError, match="another file"):
        trim(path, path, 10**6, force=True)
    assert (tmp_path / "kept.fgs").read_text() == "precious" and not (tmp_path / "out.fgs").exists()


def test_trim_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, _ = written(tmp_path)
    least = trim(path, tmp_path / "least.fgs", info(path).layers[0]["bytes"] + info(path).overhead_bytes + 64).size
    assert run("trim", path, "-o", tmp_path / "b.fgs", "--max-size", least, "--json", "-", "-q") == 0
    out = capsys.readouterr()
    record = json.loads(out.out)
    assert record["command"] == "trim" and record["layers"] == 1 and "kept  1 of 3" in out.err
    assert GridSource(tmp_path / "b.fgs").count == record["count"]
    assert run("verify", tmp_path / "b.fgs", "-q") == 0 and run("info", tmp_path / "b.fgs", "-q") == 0
    capsys.readouterr()
    assert run("trim", path, "-o", tmp_path / "c.fgs", "--max-size", least - 1) == 3
    assert "first layer needs" in capsys.readouterr().err and not (tmp_path / "c.fgs").exists()
    assert run("trim", path, "-o", tmp_path / "b.fgs", "--max-size", "1MB") == 2
    assert run("trim", path, "-o", tmp_path / "b.fgs", "--max-size", "1MB", "-f") == 0
    assert run("trim", path, "-o", tmp_path / "d.fgs", "--max-size", "lots") == 2
