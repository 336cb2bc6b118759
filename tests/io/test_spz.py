"""`.spz`: round trips within its steps, what others read and wrote, and damaged files of all four versions."""

from __future__ import annotations

import gzip
import io
import struct
from pathlib import Path

import numpy as np
import pytest
import zstandard

from exchanged import degrees_apart, largest_errors, planes_of, psnr_after, refused, scene, there_and_back
from flexgs_edge.errors import FormatError, InputError
from flexgs_edge.io.exchange import near_order, read_foreign, write_foreign
from flexgs_edge.io.frames import RUB, Frame, in_frame
from flexgs_edge.io.ply import PlySource
from flexgs_edge.io.reading import Reading, Writing
from flexgs_edge.io.spz import parse_spz
from flexgs_edge.io.spz_writer import SH_STEP, fraction_bits, write_spz
from flexgs_edge.scene.check import check_scene
from flexgs_edge.scene.source import MemorySource
from synthetic import random_scene

V4 = Writing(spz_version=4)
BOUNDS = {
    "means": 2.0**-13,
    "opacity_logits": 0.501 / 255,
    "log_scales": 0.501 / 16,
    "sh_dc": 0.501 / 255 / 0.15,
    "sh_rest": SH_STEP / 256 + 1e-6,
    "quats": 0.3,
}
"""Half a step of each field; of the quaternions, degrees."""


def header(version: int = 3, count: int = 1, degree: int = 0, bits: int = 12, flags: int = 0) -> bytes:
    return struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, bits, flags, 0)


def golden(version: int, flags: int = 0) -> bytes:
    """One Gaussian, byte by byte, unpacked: at (1, -2, 0.5), turned by 90 degrees about x."""
    if version == 1:
        place = np.array([1, -2, 0.5], "<f2").tobytes()
    else:
        place = b"".join(int(value * 4096).to_bytes(3, "little", signed=True) for value in (1, -2, 0.5))
    # x is round(127.5 * 0.7071 + 127.5); from version 3 on, it is left out and y, z and w follow.
    turn = bytes([218, 128, 127]) if version < 3 else struct.pack("<I", 0 << 30 | 0 << 20 | 0 << 10 | 511)
    return (
        header(version, 1, 1, flags=flags)
        + place
        + bytes([204, 255, 0, 128, 160, 80, 0])
        + turn
        + bytes(range(124, 133))
    )


def write_v4(
    parts: list[bytes], count: int, degree: int, extensions: bytes = b"", flags: int = 0, bits: int = 12
) -> bytes:
    """Version 4, by the layout of the reference program."""
    frames = [zstandard.ZstdCompressor().compress(part) for part in parts]
    place = 32 + len(extensions)
    head = struct.pack(
        "<4sIIBBBBI12x", b"NGSP", 4, count, degree, bits, flags | 2 * bool(extensions), len(parts), place
    )
    table = b"".join(struct.pack("<QQ", len(frame), len(part)) for frame, part in zip(frames, parts))
    return head + extensions + table + b"".join(frames)


def golden_v4(extensions: bytes = b"", flags: int = 0) -> bytes:
    body, parts = golden(3)[16:], []
    for width in (9, 1, 3, 3, 4, 9):
        parts.append(body[:width])
        body = body[width:]
    return write_v4(parts, 1, 1, extensions, flags)


def files(flags: int = 0) -> dict[str, bytes]:
    packed = {f"v{version}": gzip.compress(golden(version, flags)) for version in (1, 2, 3)}
    return {**packed, "v4": golden_v4(flags=flags)}


@pytest.mark.parametrize("version", ["v1", "v2", "v3", "v4"])
def test_golden_bytes(tmp_path: Path, version: str) -> None:
    """In RDF, y and z change their signs, and so do the rotations about y and z and the SH that are odd in them."""
    path = tmp_path / "a.spz"
    path.write_bytes(files()[version])
    source = read_foreign(path)
    planes = planes_of(source)
    assert (source.count, source.sh_degree, source.notes, source.settings) == (1, 1, (), {})
    np.testing.assert_array_equal(planes["means"][:, 0], [1, 2, -0.5])
    assert planes["opacity_logits"][0, 0] == pytest.approx(np.log(0.8 / 0.2))
    np.testing.assert_allclose(planes["sh_dc"][:, 0], [0.5 / 0.15, -0.5 / 0.15, 0.5 / 255 / 0.15], rtol=1e-5)
    np.testing.assert_array_equal(planes["log_scales"][:, 0], [0, -5, -10])
    assert degrees_apart(planes["quats"], np.array([[1], [1], [0], [0]]))[0] < (
        0.8 if version in ("v1", "v2") else 1e-3
    )
    # Codes 124 to 132 are the coefficients of y, z and x, with red, green and blue of each.
    red, green, blue = np.array([[4, 1, 2], [3, 0, 3], [2, -1, 4]]) / 128
    np.testing.assert_array_equal(planes["sh_rest"][:, 0], [*red, *green, *blue])


@pytest.mark.parametrize("writing", [Writing(), V4])
@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_round_trips(tmp_path: Path, degree: int, writing: Writing) -> None:
    errors = largest_errors(*there_and_back(tmp_path / "a.spz", scene(257, degree), writing))
    for field, error in errors.items():
        assert error <= BOUNDS[field], field


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("writing", [Writing(), V4])
def test_few_gaussians(tmp_path: Path, count: int, writing: Writing) -> None:
    assert largest_errors(*there_and_back(tmp_path / "a.spz", scene(count), writing))["means"] <= BOUNDS["means"]


@pytest.mark.parametrize("writing", [Writing(), V4])
def test_pictures_stay(tmp_path: Path, writing: Writing) -> None:
    assert psnr_after(tmp_path / "a.spz", random_scene(50, degree=3), writing) > 40


def test_both_versions_hold_the_same(tmp_path: Path) -> None:
    _, third = there_and_back(tmp_path / "3.spz", scene())
    _, fourth = there_and_back(tmp_path / "4.spz", scene(), V4)
    for field, plane in third.items():
        np.testing.assert_array_equal(plane, fourth[field])


@pytest.mark.parametrize(("spread", "bits"), [(3e-4, 20), (3.0, 12), (2e3, 12), (3e4, 8), (8e6, 0)])
def test_coordinates_get_the_bits_that_they_need(tmp_path: Path, spread: float, bits: int) -> None:
    """At least 12 where they fit, more for small Gaussians."""
    source = scene(200, 0, spread=spread)
    planes = planes_of(source)
    if spread < 1:
        planes["log_scales"] = planes["log_scales"] + np.float32(np.log(spread / 3))
    source = MemorySource(planes, 0)
    assert fraction_bits(source) == bits
    before, after = there_and_back(tmp_path / "a.spz", source, Writing(force_lossy=True))
    assert np.abs(before["means"] - after["means"]).max() <= 2.0 ** -(bits + 1)


def test_the_largest_coordinates(tmp_path: Path) -> None:
    """The code next to the end is used, and no coordinate wraps round."""
    for largest in (2.0**23 - 1, 2047.9999, 2048.0, 1.0, np.float32(0.99999994), 2.0**-40, 0.0):
        planes = planes_of(scene(2, 0))
        planes["means"][:] = [[largest, -largest]] * 3
        before, after = there_and_back(tmp_path / f"{largest}.spz", MemorySource(planes, 0), Writing(force_lossy=True))
        assert np.abs(before["means"] - after["means"]).max() <= max(largest * 2.0**-22, 2.0**-31)
    planes["means"][0, 0] = 2.0**23
    with pytest.raises(
        InputError, match=r"1 of 2 Gaussians lie beyond 8388607, the largest coordinate that \.spz holds"
    ):
        write_foreign(tmp_path / "a.spz", MemorySource(planes, 0))


def test_values_beyond_the_codes(tmp_path: Path) -> None:
    planes = planes_of(scene(3, 1))
    planes["opacity_logits"][0] = [-500, 500, 0]
    planes["log_scales"][0] = [-40, 40, -np.inf]
    planes["sh_dc"][0] = [-9, 9, 0]
    planes["sh_rest"][0] = [-9, 9, 0]
    source = MemorySource(planes, 1)
    _, after = there_and_back(tmp_path / "a.spz", source)
    rows = np.argsort(near_order(source))
    np.testing.assert_allclose(after["opacity_logits"][0, rows], [-7, 7, 0], atol=0.01)
    np.testing.assert_allclose(after["log_scales"][0, rows], [-10, 5.9375, -10])
    np.testing.assert_allclose(after["sh_dc"][0, rows], [-10 / 3, 10 / 3, 0], atol=0.02)
    # This coefficient is odd in y, so that the file has it with the other sign.
    np.testing.assert_allclose(after["sh_rest"][0, rows], [-126 / 128, 1, 0])


def test_every_largest_component_and_sign(tmp_path: Path) -> None:
    """Of the rotation: also equal ones, and zeros."""
    signs = np.array(np.meshgrid(*[[-1, 1]] * 4)).reshape(4, -1)
    sizes = np.array(
        [[8, 1, 2, 3], [1, 8, 2, 3], [1, 2, 8, 3], [1, 2, 3, 8], [1, 1, 1, 1], [0, 1, 1, 0], [0, 0, 0, 1]]
    ).T
    quats = (sizes[:, :, None] * signs[:, None, :]).reshape(4, -1).astype(np.float32)
    planes = planes_of(scene(quats.shape[1], 0)) | {"quats": quats}
    before, after = there_and_back(tmp_path / "a.spz", MemorySource(planes, 0))
    assert degrees_apart(before["quats"], after["quats"]).max() <= 0.3


@pytest.mark.parametrize("version", ["v1", "v2", "v3", "v4"])
def test_antialiased_is_read(tmp_path: Path, version: str) -> None:
    path = tmp_path / "a.spz"
    path.write_bytes(files(flags=1)[version])
    assert read_foreign(path).settings == {"antialiased": True}


@pytest.mark.parametrize("version", [3, 4])
def test_antialiased_is_written(tmp_path: Path, version: int) -> None:
    for flag in (False, True):
        path = tmp_path / f"{flag}.spz"
        write_foreign(path, scene(5), writing=Writing(version, antialiased=flag))
        assert read_foreign(path).settings == ({"antialiased": True} if flag else {})


@pytest.mark.parametrize("version", [3, 4])
def test_the_same_bytes_each_time(tmp_path: Path, version: int) -> None:
    """Also of a source that is larger than one of the writer's chunks; no name and no time are in it."""
    source = scene(40_000, 0)
    first, second = io.BytesIO(), io.BytesIO()
    write_spz(first, source, Writing(version))
    write_spz(second, source.select(np.arange(40_000)), Writing(version))
    assert first.getvalue() == second.getvalue()
    found = parse_spz(first, "a.spz")
    assert np.abs(planes_of(found)["means"] - planes_of(source)["means"]).max() <= 2.0**-13
    if version == 3:
        assert first.getvalue()[3:8] == bytes(5)


def test_gaussforge_reads_the_same(tmp_path: Path) -> None:
    gaussforge = pytest.importorskip("gaussforge")
    for version, small in ((3, 1.0), (3, 1e-3), (4, 1.0)):
        planes = planes_of(scene(100, 3, seed=version))
        planes["means"] *= np.float32(small)
        planes["log_scales"] += np.float32(np.log(small))
        path = tmp_path / f"{version}-{small}.spz"
        write_foreign(path, MemorySource(planes, 3), writing=Writing(version))
        made = gaussforge.GaussForge().convert(path.read_bytes(), "spz", "ply")
        (tmp_path / "a.ply").write_bytes(made["data"])
        # That package leaves the axes as they are in the file.
        theirs, ours = planes_of(in_frame(PlySource(tmp_path / "a.ply"), RUB)), planes_of(read_foreign(path))
        for field in ("means", "log_scales", "sh_dc", "sh_rest"):
            np.testing.assert_allclose(theirs[field], ours[field], rtol=1e-5, atol=1e-6, err_msg=field)
        assert degrees_apart(theirs["quats"], ours["quats"]).max() < 0.1


def test_files_of_others(wild: Path) -> None:
    for name, notes in (("v2", 0), ("v3", 0), ("v4", 0), ("raw", 1)):
        source = read_foreign(wild / f"st-minimal-{name}.spz")
        assert (source.count, source.sh_degree, len(source.notes)) == (4, 0, notes)
        assert check_scene(source) is source
        planes = planes_of(source)
        assert set(np.abs(planes["means"]).reshape(-1).tolist()) == {0, 1}
    # The same Gaussians in both formats, each in its own frame.
    ours, theirs = (planes_of(read_foreign(wild / "ms-train3.spz")), planes_of(PlySource(wild / "ms-train3.ply")))
    np.testing.assert_allclose(ours["means"], theirs["means"], atol=2.0**-12)
    np.testing.assert_allclose(ours["log_scales"], theirs["log_scales"], atol=0.04)
    np.testing.assert_allclose(ours["sh_rest"], theirs["sh_rest"], atol=0.07)
    assert degrees_apart(ours["quats"], theirs["quats"]).max() < 1.5


def test_a_file_without_its_gzip_layer(tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    path.write_bytes(golden(3))
    source = read_foreign(path)
    assert source.notes == ("not packed by gzip, against the specification; read as it is",)
    np.testing.assert_array_equal(planes_of(source)["means"][:, 0], [1, 2, -0.5])
    assert "is it complete" in refused(path, golden(3)[:-1])


def coordinates(number: int) -> bytes:
    return struct.pack("<III", 0xADBE0003, 4, number)


@pytest.mark.parametrize("packed", [False, True])
def test_the_frame_that_a_file_states(tmp_path: Path, packed: bool) -> None:
    def made(extensions: bytes) -> bytes:
        return gzip.compress(golden(3, flags=2) + extensions) if packed else golden_v4(extensions)

    path = tmp_path / "a.spz"
    for number, place in (
        (0, [1, 2, -0.5]),
        (4, [1, 2, -0.5]),
        (6, [1, -2, 0.5]),
        (7, [-1, 2, 0.5]),
        (1, [-1, -2, -0.5]),
    ):
        path.write_bytes(made(coordinates(number)))
        source = read_foreign(path)
        np.testing.assert_array_equal(planes_of(source)["means"][:, 0], place)
        assert source.notes == ()
        # What the user says goes before.
        asked = read_foreign(path, Reading(Frame("LDF")))
        np.testing.assert_array_equal(planes_of(asked)["means"][:, 0], [-1, -2, 0.5])
    assert "RFU exchanges y and z" in refused(path, made(coordinates(12)))
    assert "expected 0 to 16, found 17" in refused(path, made(coordinates(17)))
    orbit = struct.pack("<IIfff", 0xADBE0002, 12, 0.1, 0.2, 3.0)
    path.write_bytes(made(orbit + coordinates(6) + struct.pack("<II", 0x12340001, 0)))
    assert read_foreign(path).notes == ("extensions left out: 0xADBE0002, 0x12340001",)
    np.testing.assert_array_equal(planes_of(read_foreign(path))["means"][:, 0], [1, -2, 0.5])
    path.write_bytes(made(orbit + b"\1\0\0\0\xff\xff\0\0"))
    assert read_foreign(path).notes[1] == "8 bytes of extensions are not understood and left out"


@pytest.mark.parametrize("version", ["v1", "v2", "v3", "v4"])
def test_truncations(tmp_path: Path, version: str) -> None:
    data = files()[version]
    for size in range(len(data)):
        assert "expected" in (words := refused(tmp_path / "a.spz", data[:size])) or "truncated" in words


def test_wrong_headers(tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    for version in (0, 5, 2**32 - 1):
        assert f"found {version}" in refused(path, gzip.compress(header(version)))
        assert f"found {version}" in refused(path, header(version) + bytes(100))
    assert "byte 12, SH degree: expected 0 to 4, found 5" in refused(path, gzip.compress(header(degree=5)))
    assert "bits behind the point: expected 0 to 30, found 31" in refused(path, gzip.compress(header(bits=31)))
    assert "is it complete" in refused(path, gzip.compress(header(count=2**32 - 1) + bytes(1000)))
    assert "promises 2 Gaussians" in refused(path, gzip.compress(header(count=2) + golden(3)[16:]))
    assert "at byte 0; found b'ply" in refused(path, b"ply\nformat ascii 1.0\n")
    assert "of the unpacked data, found b'ply" in refused(path, gzip.compress(b"ply\nformat ascii 1.0\n"))
    assert "found b'abcdefgh'" in refused(path, b"abcdefghijklmnopqrstuvwxyz")


def test_damaged_tables(tmp_path: Path) -> None:
    path, good = tmp_path / "a.spz", golden_v4()

    def changed(at: int, form: str, value: int) -> bytes:
        made = bytearray(good)
        struct.pack_into(form, made, at, value)
        return bytes(made)

    assert "number of arrays: expected 6, found 5" in refused(path, changed(15, "<B", 5))
    for place in (0, 31, 10**6, 2**32 - 1):
        assert "place of the table" in refused(path, changed(16, "<I", place))
    assert "size of sh_dc: expected 3 bytes, found 4" in refused(path, changed(32 + 2 * 16 + 8, "<Q", 4))
    assert "promises 18446744073709551615 bytes of means" in refused(path, changed(32, "<Q", 2**64 - 1))
    assert "zstd frame of means" in refused(path, changed(32 + 6 * 16, "<I", 0))
    parts = [bytes(width) for width in (9, 1, 3, 3, 4)]
    assert "expected 9 bytes, the zstd frame holds more than 9" in refused(
        path, write_v4([bytes(10), *parts[1:]], 1, 0).replace(struct.pack("<Q", 10), struct.pack("<Q", 9), 1)
    )


def test_bombs(tmp_path: Path) -> None:
    """Neither the claim nor the stream is believed beyond what the other says."""
    path = tmp_path / "a.spz"
    assert "more than 1048576 bytes follow" in refused(path, gzip.compress(golden(3) + bytes(10**7)))
    assert "can hold" in refused(path, gzip.compress(header(count=10**7) + bytes(10**6)))
    frames = [zstandard.ZstdCompressor().compress(bytes(width * 10**6)) for width in (9, 1, 3, 3, 4)]
    table = b"".join(struct.pack("<QQ", len(f), w * 10**6) for f, w in zip(frames, (9, 1, 3, 3, 4)))
    head = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, 10**6, 0, 12, 0, 5, 32)
    assert "a file of this size can hold" in refused(path, head + table + b"".join(frames))


def test_bytes_behind_are_noted(tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    for data in (gzip.compress(golden(3) + bytes(7)), gzip.compress(golden(3)) + bytes(7), golden_v4() + bytes(7)):
        path.write_bytes(data)
        assert read_foreign(path).notes == ("7 bytes behind the data ignored",)


def test_a_flipped_byte_of_gzip_is_found(tmp_path: Path) -> None:
    data = gzip.compress(golden(3))
    for at in range(10, len(data)):
        made = bytearray(data)
        made[at] ^= 0x10
        assert refused(tmp_path / "a.spz", bytes(made))


def test_no_gaussians(tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    for data in (gzip.compress(header(count=0)), write_v4([], 0, 0)):
        path.write_bytes(data)
        assert read_foreign(path).count == 0
        with pytest.raises(InputError, match="the scene is empty"):
            check_scene(read_foreign(path))


def test_values_that_are_not_numbers_are_reported(tmp_path: Path) -> None:
    data = bytearray(golden(1))
    data[16:18] = np.array([np.nan], "<f2").tobytes()
    path = tmp_path / "a.spz"
    path.write_bytes(gzip.compress(bytes(data)))
    with pytest.raises(InputError, match="NaN or infinity in means"):
        check_scene(read_foreign(path))


def test_rows_in_any_order(tmp_path: Path) -> None:
    write_foreign(tmp_path / "a.spz", scene(90))
    source = read_foreign(tmp_path / "a.spz")
    rows = np.array([0, 3, 4, 50, 89])
    for field, plane in planes_of(source).items():
        np.testing.assert_array_equal(source.read(rows, [field])[field], plane[:, rows])
    assert source.held_bytes == 90 * 65


def test_the_file_may_go_once_it_is_open(tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    write_foreign(path, scene(9))
    source = read_foreign(path)
    path.unlink()
    assert np.isfinite(planes_of(source)["means"]).all()
    with pytest.raises(FormatError, match="b.spz: not a .spz"):
        parse_spz(io.BytesIO(b""), "b.spz")
