"""SOG scenes: every field by the format's formulas, both versions, zips and folders, and what is wrong with damaged ones."""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexgs_edge.errors import FormatError
from flexgs_edge.io.exact_pictures import picture_size, read_pixels, write_pixels
from flexgs_edge.io.exchange import read_foreign
from flexgs_edge.scene.check import check_scene
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import SceneSource
from sog_files import coded, meta_of, random_pictures, sog_bytes, write_folder, zipped


def planes_of(source: SceneSource) -> dict[str, np.ndarray]:
    return source.read(slice(0, source.count), list(FIELD))


def by_formula(meta: dict[str, Any], pictures: dict[str, np.ndarray], row: int) -> dict[str, list[float]]:
    """The values of a row, one by one."""

    def pixel(name: str, at: int = row) -> list[int]:
        return [int(value) for value in pictures[name].reshape(-1, 4)[at]]

    def ramp(part: dict[str, Any], channel: int, code: int) -> float:
        lowest, highest = part["mins"], part["maxs"]
        if isinstance(lowest, list):
            lowest, highest = lowest[channel], highest[channel]
        return lowest + (highest - lowest) * code / 255

    found: dict[str, list[float]] = {"means": []}
    for axis in range(3):
        code = pixel("means_l")[axis] + 256 * pixel("means_u")[axis]
        lowest, highest = meta["means"]["mins"][axis], meta["means"]["maxs"][axis]
        log = lowest + (highest - lowest) * code / 65535
        found["means"].append(math.copysign(math.exp(abs(log)) - 1, log))
    *small, tag = pixel("quats")
    stored = [(value / 255 - 0.5) * math.sqrt(2) for value in small]
    stored.insert(tag - 252, math.sqrt(1 - sum(value * value for value in stored)))
    found["quats"] = stored
    scales, colours = pixel("scales")[:3], pixel("sh0")
    if meta.get("version") == 2:
        found["log_scales"] = [meta["scales"]["codebook"][code] for code in scales]
        found["sh_dc"] = [meta["sh0"]["codebook"][code] for code in colours[:3]]
        share = min(max(colours[3] / 255, 1 / (1 + math.exp(7))), 1 / (1 + math.exp(-7)))
        found["opacity_logits"] = [math.log(share / (1 - share))]
    else:
        found["log_scales"] = [ramp(meta["scales"], i, code) for i, code in enumerate(scales)]
        found["sh_dc"] = [ramp(meta["sh0"], i, code) for i, code in enumerate(colours[:3])]
        found["opacity_logits"] = [ramp(meta["sh0"], 3, colours[3])]
    found["sh_rest"] = []
    if "shN" in meta:
        label = pixel("shN_labels")[0] + 256 * pixel("shN_labels")[1]
        width = pictures["shN_centroids"].shape[1] // 64
        line = pictures["shN_centroids"][label // 64, label % 64 * width :][:width].tolist()
        for channel in range(3):
            for entry in line:
                code = entry[channel]
                found["sh_rest"].append(
                    meta["shN"]["codebook"][code] if "codebook" in meta["shN"] else ramp(meta["shN"], 0, code)
                )
    return found


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize(
    ("degree", "entries", "kind"), [(0, 1, "webp"), (1, 300, "png"), (2, 65, "webp"), (3, 5, "webp")]
)
def test_values(tmp_path: Path, version: int, degree: int, entries: int, kind: str) -> None:
    pictures = random_pictures(37, degree, seed=degree, entries=entries, width=8)
    meta = meta_of(version, 37, degree, entries, kind)
    place = tmp_path / "a.sog"
    place.write_bytes(
        zipped(meta, {f"{name}.{kind}": coded(picture, kind.upper()) for name, picture in pictures.items()})
    )
    source = read_foreign(place)
    assert (source.count, source.sh_degree, source.notes, dict(source.settings)) == (37, degree, (), {})
    assert 0 < source.held_bytes < 37 * 40 + (entries + 65) * 4 * 45
    planes = planes_of(source)
    for row in range(37):
        for field, values in by_formula(meta, pictures, row).items():
            np.testing.assert_allclose(planes[field][:, row], values, rtol=2e-6, atol=1e-6, err_msg=f"{field} {row}")
    some = np.array([3, 4, 9, 30])
    for field, plane in source.read(some, list(FIELD)).items():
        np.testing.assert_array_equal(plane, planes[field][:, some])


def test_a_folder_holds_the_same_scene(tmp_path: Path) -> None:
    (tmp_path / "a.sog").write_bytes(sog_bytes(2, 20, 3))
    folder = planes_of(read_foreign(write_folder(tmp_path / "scene", 2, 20, 3)))
    for field, plane in planes_of(read_foreign(tmp_path / "a.sog")).items():
        np.testing.assert_array_equal(plane, folder[field])


def test_what_other_writers_do(tmp_path: Path) -> None:
    """A folder in the zip, a packed zip, a first entry of null, and no word on bands and entries."""
    meta = meta_of(2, 9, 2)
    pictures = {f"{name}.webp": coded(picture) for name, picture in random_pictures(9, 2).items()}
    (tmp_path / "plain.sog").write_bytes(zipped(meta, pictures))
    plain = planes_of(read_foreign(tmp_path / "plain.sog"))
    del meta["shN"]["bands"], meta["shN"]["count"]
    step = (meta["sh0"]["codebook"][255] - meta["sh0"]["codebook"][1]) / 255
    meta["sh0"]["codebook"][0] = None
    meta["antialias"] = True
    with zipfile.ZipFile(tmp_path / "other.sog", "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in {**pictures, "meta.json": json.dumps(meta).encode()}.items():
            archive.writestr(f"scene/{name}", data)
    source = read_foreign(tmp_path / "other.sog")
    assert source.settings == {"antialiased": True}
    for field, plane in planes_of(source).items():
        np.testing.assert_allclose(plane, plain[field], atol=step / 50)


def test_labels_beyond_the_palette_are_no_sh(tmp_path: Path) -> None:
    pictures = random_pictures(9, 1)
    pictures["shN_labels"].reshape(-1, 4)[4, 1] = 200
    place = tmp_path / "a.sog"
    place.write_bytes(zipped(meta_of(2, 9, 1), {f"{name}.webp": coded(picture) for name, picture in pictures.items()}))
    source = read_foreign(place)
    assert source.notes == ("1 rows name no entry of the SH palette: read without SH",)
    rest = planes_of(source)["sh_rest"]
    assert not rest[:, 4].any() and rest[:, [0, 8]].all()


def test_quaternions_without_a_mode_are_reported(tmp_path: Path) -> None:
    pictures = random_pictures(9, 0)
    pictures["quats"].reshape(-1, 4)[5, 3] = 251
    place = tmp_path / "a.sog"
    place.write_bytes(zipped(meta_of(2, 9, 0), {f"{name}.webp": coded(picture) for name, picture in pictures.items()}))
    assert check_scene(read_foreign(place), drop_invalid=True).count == 8
    assert not planes_of(read_foreign(place))["quats"][:, 5].any()


def changed(**values: Any) -> Callable[[dict[str, Any]], None]:
    """Values by dotted names; `...` removes the field."""

    def change(meta: dict[str, Any]) -> None:
        for path, value in values.items():
            *way, key = path.split("__")
            part = meta
            for name in way:
                part = part[name]
            if value is ...:
                del part[key]
            else:
                part[key] = value

    return change


@pytest.mark.parametrize(
    ("version", "change", "words"),
    [
        (2, changed(version=3), "meta.json: version: expected a whole number from 1 to 2, found 3"),
        (2, changed(version="2"), "version: expected a whole number"),
        (2, changed(count=...), "count: expected a whole number from 0 to 2147483647, found no such field"),
        (2, changed(count=-1), "count: expected a whole number"),
        (2, changed(count=True), "count: expected a whole number"),
        (2, changed(count=17), "means_l.webp: expected a picture of 17 to .* pixels.*found 4x3"),
        (2, changed(count=10**9), "1000000000 Gaussians cannot be in pictures of .* bytes"),
        (2, changed(antialias="yes"), "antialias: expected true or false, found 'yes'"),
        (2, changed(means=...), "means: expected an object, found no such field"),
        (2, changed(means=[1]), r"means: expected an object, found \[1\]"),
        (2, changed(means__mins=[0, 0]), r"means.mins: expected 3 finite numbers, found \[0, 0\]"),
        (2, changed(means__maxs=[0, 0, float("nan")]), "means.maxs: expected 3 finite numbers"),
        (2, changed(means__maxs=[0, 0, 10**400]), "means.maxs: expected 3 finite numbers"),
        (2, changed(means__files=["means_l.webp"]), "means.files: expected 2 file names"),
        (2, changed(means__files=["means_l.webp", 3]), "means.files: expected 2 file names"),
        (2, changed(quats__files="q"), "quats.files: expected 1 file name, found 'q'"),
        (2, changed(scales__codebook=...), "scales.codebook: expected 1 to 256 finite numbers, found no such field"),
        (2, changed(scales__codebook=[0.0] * 257), "scales.codebook: expected 1 to 256 finite numbers"),
        (2, changed(sh0__codebook=[0.0, None]), "sh0.codebook: expected 1 to 256 finite numbers"),
        (2, changed(shN__bands=4), "shN.bands: expected a whole number from 0 to 3"),
        (2, changed(shN__bands=2), "shN_centroids.webp: expected a picture 512 pixels wide, for 2 bands, found 192x1"),
        (2, changed(shN__count=65), "shN_centroids.webp: expected 2 to 1024 rows of pixels, for 65 entries, found 1"),
        (2, changed(shN__files=["sh0.webp", "shN_labels.webp"]), "sh0.webp: expected a picture 192 pixels wide"),
        (2, changed(sh0__files=["sh1.webp"]), r"'sh1.webp': not in the zip; found \['means_l.webp'"),
        (2, changed(sh0__files=["shN_centroids.webp"]), None),
        (1, changed(means__shape=...), "means.shape: expected a list that begins with the count"),
        (1, changed(means__shape=["9"]), "means.shape: expected a list"),
        (1, changed(scales__mins=[1, 2]), "scales.mins: expected 3 finite numbers"),
        (1, changed(sh0__maxs=[1, 2, 3]), "sh0.maxs: expected 4 finite numbers"),
        (1, changed(shN__maxs="1"), "shN.maxs: expected a finite number, found '1'"),
    ],
)
def test_wrong_fields_are_named(tmp_path: Path, version: int, change: Any, words: str | None) -> None:
    pictures = {f"{name}.webp": coded(picture) for name, picture in random_pictures(9, 1).items()}
    meta = meta_of(version, 9, 1)
    change(meta)
    place = tmp_path / "a.sog"
    place.write_bytes(zipped(meta, pictures))
    if words is None:  # another picture with enough pixels is as good
        assert read_foreign(place).count == 9
        return
    with pytest.raises(FormatError, match=f"a.sog: .*{words}"):
        read_foreign(place)


@pytest.mark.parametrize(
    "text", [b"", b"{", b"[]", b"3", b"\xff\xfe", b"[" * 100_000, b'{"count":' + b"9" * 5000 + b"}"], ids=range(7)
)
def test_what_is_no_meta(tmp_path: Path, text: bytes) -> None:
    (tmp_path / "meta.json").write_bytes(text)
    with pytest.raises(FormatError, match="meta.json: "):
        read_foreign(tmp_path / "meta.json")


def test_damaged_zips(tmp_path: Path) -> None:
    place, data = tmp_path / "a.sog", sog_bytes(2)
    for length in [*range(0, len(data), 97), len(data) - 1]:
        place.write_bytes(data[:length])
        with pytest.raises(FormatError, match=r"a.sog: expected a zip .* is it complete"):
            read_foreign(place)
    at = data.index(b"VP8L") + 30
    place.write_bytes(data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :])
    with pytest.raises(FormatError, match=r"means_l.webp: cannot be unpacked \(Bad CRC-32"):
        read_foreign(place)
    with zipfile.ZipFile(place, "w") as archive:
        archive.writestr("readme.txt", "hello")
    with pytest.raises(FormatError, match=r"expected a zip with meta.json, found \['readme.txt'\]"):
        read_foreign(place)


def test_bombs_are_refused(tmp_path: Path) -> None:
    """Claims of great sizes, before anything is allocated."""
    place = tmp_path / "a.sog"
    with zipfile.ZipFile(place, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("meta.json", b" " * 50_000_000)
    with pytest.raises(FormatError, match="claim to unpack to 50000000: no picture does that"):
        read_foreign(place)
    pictures = {f"{name}.webp": coded(picture) for name, picture in random_pictures(9, 1).items()}
    wide = bytearray(pictures["scales.webp"])
    wide[21:25] = (16383 << 14 | 16383).to_bytes(4, "little")
    for name in ("scales.webp", "shN_centroids.webp"):
        place.write_bytes(zipped(meta_of(2, 9, 1), {**pictures, name: bytes(wide)}))
        with pytest.raises(FormatError, match=f"{name}: expected a picture .* found 16384x16384"):
            read_foreign(place)


@pytest.mark.parametrize(
    "name", ["../sh0.webp", "/sh0.webp", "a/../../sh0.webp", "link.webp", "a\\b", "\0", "x" * 300, "none.webp"]
)
def test_files_outside_the_folder_are_not_read(tmp_path: Path, name: str) -> None:
    place = write_folder(tmp_path / "scene", 2, 9, 0)
    (tmp_path / "sh0.webp").write_bytes((tmp_path / "scene" / "sh0.webp").read_bytes())
    (tmp_path / "scene" / "link.webp").symlink_to(tmp_path / "sh0.webp")
    meta = json.loads(place.read_bytes())
    meta["sh0"]["files"] = ["/".join([str(tmp_path), "sh0.webp"]) if name == "/sh0.webp" else name]
    place.write_text(json.dumps(meta))
    with pytest.raises(FormatError, match=r"meta.json: '.*(expected the name of a file in its folder|no such file)"):
        read_foreign(place)


def test_pictures_keep_every_value() -> None:
    """Also colours of transparent pixels."""
    pixels = np.random.default_rng(1).integers(0, 256, (12, 20, 4), np.uint8)
    pixels[:6, :, 3] = 0
    for data in (write_pixels(pixels), coded(pixels), coded(pixels, "PNG")):
        assert picture_size(data, "x") == (20, 12)
        np.testing.assert_array_equal(read_pixels(data, "x"), pixels)
    assert write_pixels(pixels) == write_pixels(pixels.copy())


def test_other_pictures(tmp_path: Path) -> None:
    from PIL import Image

    pixels = np.random.default_rng(1).integers(0, 256, (12, 20, 4), np.uint8)
    place = io.BytesIO()
    Image.fromarray(pixels).save(place, "WEBP", quality=80)
    with zipfile.ZipFile(tmp_path / "a.sog", "w") as archive:
        for name, picture in random_pictures(9, 0).items():
            archive.writestr(f"{name}.webp", place.getvalue() if name == "sh0" else coded(picture))
        archive.writestr("meta.json", json.dumps(meta_of(2, 9, 0)))
    source = read_foreign(tmp_path / "a.sog")
    assert source.notes == ("lossy pictures, so that values are not what was written: sh0.webp",)
    deep, moving = io.BytesIO(), io.BytesIO()
    Image.fromarray(np.zeros((4, 4), np.uint16)).save(deep, "PNG")
    frames = [Image.fromarray(pixels), Image.fromarray(255 - pixels)]
    frames[0].save(moving, "WEBP", save_all=True, append_images=frames[1:], lossless=True)
    for data, words in (
        (b"", "expected a WebP or PNG picture, found bytes b''"),
        (b"GIF89a0000000", "expected a WebP or PNG"),
        (coded(pixels)[:22], "no whole picture"),
        (deep.getvalue(), "expected a picture of 8-bit channels, found 16 bits"),
        (moving.getvalue(), "found an animation"),
    ):
        with pytest.raises(FormatError, match=words):
            picture_size(data, "x")
    for data in (coded(pixels)[:-40], coded(pixels, "PNG")[:-60]):
        with pytest.raises(FormatError, match="x: the picture cannot be decoded .* is it complete"):
            read_pixels(data, "x")


def test_wild_files(wild: Path) -> None:
    """Written by other programs; the numbers are those that splat-transform reads."""
    logo = read_foreign(wild / "pc-logo" / "meta.json")
    assert (logo.count, logo.sh_degree, logo.notes) == (307128, 0, ())
    means = logo.read(slice(0, logo.count), ["means"])["means"]
    assert np.abs(means).max() < np.expm1(1.3301653)
    robot = read_foreign(wild / "playbot5.sog")
    assert (robot.count, robot.sh_degree, robot.notes) == (3000, 2, ())
    assert check_scene(logo).count == 307128 and check_scene(robot).count == 3000
