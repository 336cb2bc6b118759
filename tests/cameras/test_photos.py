"""Photos: matched by name and size, any usual pixel kind, and clear errors for the rest."""

from __future__ import annotations

import io
import os
import time
import warnings
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.photos import Photos
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.errors import InputError
from synthetic import make_camera

SAMPLE = Path(__file__).parents[2] / "samples" / "still_life"


def pixels(width: int = 12, height: int = 8, channels: int = 3, seed: int = 0) -> np.ndarray:
    shape = (height, width, channels) if channels > 1 else (height, width)
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def save(path: Path, width: int = 12, height: int = 8) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels(width, height)).save(path)
    return path


def cameras(*names: str, width: int = 12, height: int = 8) -> list[Camera]:
    return [make_camera(width, height, name=name) for name in names]


def test_photos_are_found_with_and_without_extension(tmp_path: Path) -> None:
    for name in ("a.png", "b.JPG", "c.d.jpeg", "e.PNG", "readme.txt"):
        save(tmp_path / name) if name != "readme.txt" else (tmp_path / name).touch()
    photos = Photos.open(str(tmp_path), cameras("a", "b.JPG", "c.d", "e.jpg"))
    assert [path.name for path in photos.paths] == ["a.png", "b.JPG", "c.d.jpeg", "e.PNG"]
    assert len(photos) == 4 and photos.notes == ()


def test_photos_in_folders_that_the_names_give(tmp_path: Path) -> None:
    for name in ("left/1.png", "right/1.png", "1.png"):
        save(tmp_path / name)
    photos = Photos.open(tmp_path, cameras("left/1", "right/1.png", "1"))
    assert [path.relative_to(tmp_path).as_posix() for path in photos.paths] == ["left/1.png", "right/1.png", "1.png"]


def test_names_cannot_leave_the_folder(tmp_path: Path) -> None:
    save(tmp_path / "secret.png")
    (tmp_path / "images").mkdir()
    with pytest.raises(InputError, match="no photo for 1 of 1 cameras"):
        Photos.open(tmp_path / "images", cameras("../secret"))


def test_missing_photos_are_counted_and_named(tmp_path: Path) -> None:
    save(tmp_path / "a.png")
    with pytest.raises(InputError, match="no photo for 7 of 8 cameras: b, c, d, e, f and 2 more; expected files named"):
        Photos.open(tmp_path, cameras(*"abcdefgh"))
    with pytest.raises(InputError, match="no such folder of photos"):
        Photos.open(tmp_path / "none", cameras("a"))


def test_a_few_cameras_without_photos_are_left_out(tmp_path: Path) -> None:
    for name in "acd":
        save(tmp_path / f"{name}.png")
    photos = Photos.open(tmp_path, cameras(*"abcd"))
    assert [camera.name for camera in photos.cameras] == ["a", "c", "d"] and len(photos) == 3
    assert photos.notes == (f"1 of 4 cameras left out: {tmp_path} has no photo of them",)
    with pytest.raises(InputError, match="no photo for 2 of 4 cameras: b, e.*--images none"):
        Photos.open(tmp_path, cameras(*"abce"))


def test_names_cut_at_their_first_dot(tmp_path: Path) -> None:
    save(tmp_path / "a.b.jpg")
    assert Photos.open(tmp_path, cameras("a")).paths[0].name == "a.b.jpg"
    save(tmp_path / "a.c.jpg")
    with pytest.raises(
        InputError, match=r"'a' has more than one photo \(a.b.jpg, a.c.jpg\); keep one, or use --images none"
    ):
        Photos.open(tmp_path, cameras("a"))
    with pytest.raises(InputError, match="photos of 2 of 3 cameras cannot be told apart.*a#0, a#2; use --images none"):
        Photos.open(tmp_path, cameras("a#0", "a.b.jpg", "a#2"))


def test_two_photos_for_one_camera(tmp_path: Path) -> None:
    save(tmp_path / "a.png")
    save(tmp_path / "a.jpg")
    with pytest.raises(InputError, match=r"camera 'a' has more than one photo \(a.jpg, a.png\)"):
        Photos.open(tmp_path, cameras("a"))
    assert Photos.open(tmp_path, cameras("a.png")).paths[0].name == "a.png"


def test_rgb_values_are_exact(tmp_path: Path) -> None:
    save(tmp_path / "a.png")
    found = Photos.open(tmp_path, cameras("a")).load(0)
    assert found.dtype == np.float32 and found.shape == (8, 12, 3)
    np.testing.assert_array_equal(found, pixels().astype(np.float32) / np.float32(255))


@pytest.mark.parametrize(
    ("camera", "photo"),
    [
        ((12, 8), (6, 4)),
        ((13, 9), (6, 4)),
        ((13, 9), (7, 5)),
        ((1080, 1920), (135, 240)),
        ((12, 8), (11, 8)),
        ((9, 9), (1, 1)),
    ],
)
def test_smaller_photos_scale_the_cameras(tmp_path: Path, camera: tuple[int, int], photo: tuple[int, int]) -> None:
    save(tmp_path / "a.png", *photo)
    given = cameras("a", width=camera[0], height=camera[1])
    photos = Photos.open(tmp_path, given)
    assert (photos.cameras[0].width, photos.cameras[0].height) == photo
    assert photos.cameras[0].fx == pytest.approx(given[0].fx * photo[0] / camera[0])
    assert photos.load(0).shape == (photo[1], photo[0], 3)
    (note,) = photos.notes
    assert note.startswith("cameras scaled down ") and note.endswith(f"to their photos ({photo[0]}x{photo[1]})")


def test_one_factor_for_cameras_of_different_sizes(tmp_path: Path) -> None:
    save(tmp_path / "a.png", 50, 25)
    save(tmp_path / "b.png", 33, 66)
    given = [make_camera(200, 100, name="a"), make_camera(133, 265, name="b")]
    assert [c.width for c in Photos.open(tmp_path, given).cameras] == [50, 33]


@pytest.mark.parametrize(
    ("sizes", "words"),
    [
        ([(24, 16)], "a.png: photo of 24x16 for camera 'a' of 12x8: photos may be smaller .*, never larger"),
        ([(12, 9)], "photo of 12x9 .*, never larger"),
        ([(8, 12)], "never larger"),
        ([(6, 8)], "a.png: photo of 6x8 for camera 'a' of 12x8: expected the same factor"),
        ([(12, 8), (6, 4)], r"b.png: photo of 6x4 for camera 'b' of 12x8: expected the same .*a.png \(12x8 for 12x8\)"),
        ([(12, 8), (11, 8)], "b.png: photo of 11x8"),
    ],
)
def test_sizes_that_do_not_match(tmp_path: Path, sizes: list[tuple[int, int]], words: str) -> None:
    names = "abc"[: len(sizes)]
    for name, size in zip(names, sizes, strict=True):
        save(tmp_path / f"{name}.png", *size)
    with pytest.raises(InputError, match=words):
        Photos.open(tmp_path, cameras(*names))


def test_a_width_limit_averages_areas(tmp_path: Path) -> None:
    save(tmp_path / "a.png")
    photos = Photos.open(tmp_path, cameras("a"), max_width=6)
    assert photos.notes == ("1 view scaled down to 6 pixels wide",)
    found = photos.load(0)
    mean = pixels().reshape(4, 2, 6, 2, 3).mean(axis=(1, 3)) / 255
    np.testing.assert_allclose(found, mean, atol=1e-6)
    assert (photos.cameras[0].width, photos.cameras[0].height) == (6, 4)
    assert found.dtype == np.float32


def test_alpha_is_put_on_the_background(tmp_path: Path) -> None:
    rgba = pixels(channels=4)
    Image.fromarray(rgba).save(tmp_path / "a.png")
    found = Photos.open(tmp_path, cameras("a"), background=(1.0, 0.5, 0.0)).load(0)
    alpha = rgba[:, :, 3:] / 255
    expected = rgba[:, :, :3] / 255 * alpha + np.array([1.0, 0.5, 0.0]) * (1 - alpha)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def grey(path: Path) -> np.ndarray:
    image = pixels(channels=1)
    Image.fromarray(image).save(path)
    return np.repeat(image[:, :, None], 3, axis=2) / 255


def grey16(path: Path) -> np.ndarray:
    image = pixels(channels=1).astype(np.uint16) * 257 - 3 * (pixels(channels=1) > 0).astype(np.uint16)
    Image.fromarray(image).save(path)
    return np.repeat(image[:, :, None], 3, axis=2) / 65535


def grey_alpha(path: Path) -> np.ndarray:
    image = pixels(channels=2)
    Image.fromarray(image[:, :, 0]).convert("L")
    merged = Image.merge("LA", [Image.fromarray(image[:, :, k].copy()) for k in range(2)])
    merged.save(path)
    return np.repeat((image[:, :, :1] / 255) * (image[:, :, 1:] / 255), 3, axis=2)


def palette(path: Path) -> np.ndarray:
    image = Image.fromarray(pixels()).quantize(16)
    image.save(path)
    return np.asarray(image.convert("RGB")) / 255


def palette_with_a_hole(path: Path) -> np.ndarray:
    image = Image.fromarray(pixels()).quantize(16)
    image.save(path, transparency=0)
    shown = np.asarray(image.convert("RGB")) / 255
    return shown * (np.asarray(image) != 0)[:, :, None]


def bilevel(path: Path) -> np.ndarray:
    image = Image.fromarray(pixels(channels=1)).convert("1")
    image.save(path)
    return np.repeat(np.asarray(image)[:, :, None], 3, axis=2).astype(float)


@pytest.mark.parametrize("make", [grey, grey16, grey_alpha, palette, palette_with_a_hole, bilevel])
def test_other_pixel_kinds(tmp_path: Path, make) -> None:  # type: ignore[no-untyped-def]
    expected = make(tmp_path / "a.png")
    found = Photos.open(tmp_path, cameras("a")).load(0)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_cmyk_is_read_as_colours(tmp_path: Path) -> None:
    Image.new("CMYK", (12, 8), (0, 255, 255, 0)).save(tmp_path / "a.jpg")
    found = Photos.open(tmp_path, cameras("a")).load(0)
    assert found.shape == (8, 12, 3) and found[..., 0].min() > 0.9 and found[..., 1:].max() < 0.1


def test_floats_are_refused(tmp_path: Path) -> None:
    Image.fromarray(np.ones((8, 12), np.float32)).save(tmp_path / "a.png", format="TIFF")
    with pytest.raises(InputError, match=r"a\.png: pixels are floats; expected 8-bit or 16-bit"):
        Photos.open(tmp_path, cameras("a")).load(0)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_truncated_and_broken_photos(tmp_path: Path, suffix: str) -> None:
    path = save(tmp_path / f"a{suffix}", 64, 64)
    whole = path.read_bytes()
    refused = 0
    for length in [0, 3, 20, *range(40, len(whole) - 16, max(1, len(whole) // 40))]:
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match=f"a{suffix}: (not a photo that can be read|the photo cannot be decoded)"):
            Photos.open(tmp_path, cameras("a", width=64, height=64)).load(0)
        refused += 1
    assert refused > 20


def test_a_text_file_named_like_a_photo(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_text("hello")
    with pytest.raises(InputError, match=r"a\.jpg: not a photo that can be read"):
        Photos.open(tmp_path, cameras("a"))


POSTSCRIPT = b"""%!PS-Adobe-3.0 EPSF-3.0
%%BoundingBox: 0 0 12 8
(pwned) (w) file closefile
showpage
"""


def others() -> dict[str, bytes]:
    """A picture of 12x8 pixels in every format that Pillow writes here, but those of photos, and PostScript by hand."""
    Image.init()
    found = {"PostScript": POSTSCRIPT}
    for kind in sorted(set(Image.SAVE) - {"JPEG", "MPO", "PNG", "WEBP", "TIFF"}):  # MPO: a JPEG with more behind it
        for mode in ("RGB", "P", "1"):
            # A kind of pixels that it has not, a writer that is not there; formats that Pillow will leave out.
            with suppress(OSError, ValueError), warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)
                out = io.BytesIO()
                Image.new(mode, (12, 8)).save(out, kind)
                found[kind] = out.getvalue()
                break
    return found


@pytest.mark.parametrize("kind", others())
def test_only_four_formats_are_photos(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By content, whatever the name; no other reader of Pillow is started, and so no other program."""

    def started(*_: object, **__: object) -> None:
        raise AssertionError("started")

    for other, (_, accept) in Image.OPEN.items():
        if other not in ("JPEG", "PNG", "WEBP", "TIFF"):
            monkeypatch.setitem(Image.OPEN, other, (started, accept))  # type: ignore[arg-type]
    monkeypatch.setattr("subprocess.Popen", started)
    (tmp_path / "a.png").write_bytes(others()[kind])
    start = time.process_time()
    with pytest.raises(InputError, match=r"a\.png: .*expected a whole JPEG, PNG, WebP or TIFF file, found b'"):
        Photos.open(tmp_path, cameras("a"))
    assert time.process_time() - start < 1


def test_what_a_photo_is_not_is_told(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(POSTSCRIPT)
    with pytest.raises(InputError, match="found b'%!PS-Adobe-3.0 E' at its start, as EPS has"):
        Photos.open(tmp_path, cameras("a"))


@pytest.mark.parametrize("suffix", [".webp", ".tif", ".TIFF"])
def test_webp_and_tiff_are_photos(suffix: str, tmp_path: Path) -> None:
    Image.fromarray(pixels()).save(tmp_path / f"a{suffix}", **({"lossless": True} if suffix == ".webp" else {}))
    found = Photos.open(tmp_path, cameras("a")).load(0)
    np.testing.assert_array_equal(found, pixels().astype(np.float32) / np.float32(255))


def test_what_is_no_file_is_no_photo(tmp_path: Path) -> None:
    """A pipe without a writer would be waited for."""
    os.mkfifo(tmp_path / "a.png")
    (tmp_path / "b.png").symlink_to("/dev/zero")
    (tmp_path / "c.png").symlink_to(tmp_path / "c.png")
    with pytest.raises(InputError, match="no photo for 3 of 3 cameras"):
        Photos.open(tmp_path, cameras("a", "b", "c"))


def test_nothing_is_decoded_when_opening(tmp_path: Path) -> None:
    """A photo of which little more than the header is left is no error before its pixels are asked for."""
    save(tmp_path / "a.png")
    data = (tmp_path / "a.png").read_bytes()
    (tmp_path / "a.png").write_bytes(data[: data.index(b"IDAT") + 8])
    photos = Photos.open(tmp_path, cameras("a"))
    with pytest.raises(InputError, match="the photo cannot be decoded"):
        photos.load(0)


def test_the_sample() -> None:
    photos = Photos.open(SAMPLE / "images", read_cameras(SAMPLE))
    assert (len(photos), photos.notes) == (80, ())
    image = photos.load(79)
    assert image.shape == (360, 480, 3) and 0.1 < image.mean() < 0.9


def scenes() -> Path:
    return Path(os.environ.get("FLEXGS_SCENES", Path(__file__).parents[3] / "shared" / "scenes"))


@pytest.mark.skipif(not (scenes() / "fox").is_dir(), reason="the fox scene is not here (set FLEXGS_SCENES)")
def test_fox() -> None:
    given = read_cameras(scenes() / "fox")
    photos = Photos.open(scenes() / "fox" / "images", given)
    assert len(photos) == 50 and photos.cameras == given
    assert photos.load(0).shape == (960, 540, 3)
