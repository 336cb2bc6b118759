"""Read `.ksplat` files (GaussianSplats3D), version 0.1: packed at level 0, 1 or 2.

A header of 4096 bytes is followed by section headers of 1024 bytes each, then the sections. A section has the sizes of its
partly filled buckets, the centres of its buckets, then the Gaussians, bucket by bucket. Level 0 holds float32. Levels 1 and 2
hold positions as 16 bits around their bucket's centre and float16; level 2 has SH of 8 bits. All is little endian.
"""

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flexgs_edge.constants import SH_C0
from flexgs_edge.errors import FormatError
from flexgs_edge.io.decoded import PartsSource, opacity_logits
from flexgs_edge.io.reading import Reading
from flexgs_edge.io.splat import logs
from flexgs_edge.scene.fields import sh_rest_count
from flexgs_edge.scene.source import Rows

_HEADER_BYTES, _SECTION_BYTES, _CENTRE_BYTES = 4096, 1024, 12
_MAX_DEGREE = 3
_SH_RANGE = 1.5  # SH of level 2 reach so far on both sides, unless the header says otherwise
_POSITION_RANGE = 32767  # Code of a bucket's centre, unless the section says otherwise


@dataclass(frozen=True)
class _Level:
    """Types of the values at one level of compression."""

    position: str
    real: str
    sh: str

    @property
    def parts(self) -> dict[str, tuple[str, int]]:
        """Type and number of values by field, in the order of a row."""
        return {
            "means": (self.position, 3),
            "log_scales": (self.real, 3),
            "quats": (self.real, 4),
            "sh_dc": ("u1", 3),
            "opacity_logits": ("u1", 1),
        }

    def place(self, field: str, sh_width: int) -> tuple[str, slice]:
        """Type of a field, and its bytes in a row."""
        at = 0
        for name, (kind, width) in {**self.parts, "sh_rest": (self.sh, sh_width)}.items():
            stop = at + np.dtype(kind).itemsize * width
            if name == field:
                return kind, slice(at, stop)
            at = stop
        raise AssertionError(field)


_LEVELS = (_Level("<f4", "<f4", "<f4"), _Level("<u2", "<f2", "<f2"), _Level("<u2", "<f2", "u1"))


@dataclass(frozen=True)
class _Section:
    """Gaussians with the same layout."""

    table: np.ndarray  # [n, bytes of a row] u8
    sh_degree: int  # 0 to 3
    ends: np.ndarray  # [buckets] i64, the row behind each bucket that has Gaussians
    centres: np.ndarray  # [buckets, 3] f32
    step: float  # unit of the positions, scene units
    middle: int  # code of a bucket's centre


class KsplatSource(PartsSource):
    """A `.ksplat`: its sections, decoded when they are read."""

    def __init__(
        self, name: str, level: int, sections: list[_Section], sh_range: tuple[float, float], held_bytes: int
    ) -> None:
        sizes, degrees = [len(section.table) for section in sections], [section.sh_degree for section in sections]
        super().__init__(name, sizes, degrees, held_bytes)
        self._level, self._sections, self._sh_range = _LEVELS[level], sections, sh_range

    def decode_part(self, number: int, rows: Rows, field: str) -> np.ndarray:
        section = self._sections[number]
        kind, place = self._level.place(field, 3 * sh_rest_count(section.sh_degree))
        codes: np.ndarray = np.ascontiguousarray(section.table[rows, place]).view(kind).T
        if field == "means" and kind != "<f4":
            numbers = np.arange(rows.start, rows.stop) if isinstance(rows, slice) else rows
            centres = section.centres[np.searchsorted(section.ends, numbers, side="right")]
            return np.asarray((codes.astype(np.float64) - section.middle) * section.step + centres.T)
        if field == "log_scales":
            return logs(codes)
        if field == "sh_dc":
            return np.asarray((codes / 255.0 - 0.5) / SH_C0)
        if field == "opacity_logits":
            return opacity_logits(codes / 255.0)
        if field == "sh_rest":
            low, high = self._sh_range
            values = low + codes / 255.0 * (high - low) if kind == "u1" else codes
            return np.asarray(values[np.argsort(_sh_places(section.sh_degree))])
        return codes


def _sh_places(degree: int) -> list[int]:
    """Our channel of each SH value of a row: the file has degree by degree, within it channel by channel."""
    places = list[int]()
    for each in range(1, degree + 1):
        for channel in range(3):
            start = channel * sh_rest_count(degree) + sh_rest_count(each - 1)
            places += range(start, start + 2 * each + 1)
    return places


def read_ksplat(path: Path, name: str, reading: Reading) -> KsplatSource:
    """Open a `.ksplat`; see `Format.reader`. Raises `FormatError` if the file breaks the format."""
    data = np.fromfile(path, np.uint8)
    if len(data) < _HEADER_BYTES:
        raise FormatError(
            f"{name}: truncated: expected a header of {_HEADER_BYTES} bytes, found {len(data)}; is it complete?"
        )
    major, minor, most_sections, _, _, count, level = struct.unpack_from("<BB2xIIIIH", data.data)
    low, high = struct.unpack_from("<ff", data.data, 36)
    if major != 0 or minor < 1:
        raise FormatError(f"{name}: byte 0, version: expected 0.1, found {major}.{minor}")
    if level >= len(_LEVELS):
        raise FormatError(f"{name}: byte 20, compression level: expected 0 to 2, found {level}")
    at = _HEADER_BYTES + most_sections * _SECTION_BYTES
    if at > len(data):
        raise FormatError(
            f"{name}: truncated: byte 4 promises {most_sections} sections, {at} bytes with their headers; found "
            f"{len(data)}; is it complete?"
        )
    sections = []
    for number in range(most_sections):
        section, at = _section(data, at, number, level, name)
        if section is not None:
            sections.append(section)
    found = sum(len(section.table) for section in sections)
    if found != count:
        raise FormatError(f"{name}: byte 16, number of Gaussians: the sections have {found}, found {count}")
    source = KsplatSource(name, level, sections, (low or -_SH_RANGE, high or _SH_RANGE), data.nbytes)
    if at < len(data):
        source.notes = (f"{len(data) - at} bytes behind the data ignored",)
    return source


def _section(data: np.ndarray, at: int, number: int, level: int, name: str) -> tuple[_Section | None, int]:
    """A section whose data begin at `at`, None if it is empty; and the end of its data."""
    place = _HEADER_BYTES + number * _SECTION_BYTES
    count, most, capacity, buckets, block, centre_bytes, middle, full, partial, degree = struct.unpack_from(
        "<IIIIfH2xI4xIIH", data[place : place + _SECTION_BYTES].tobytes()
    )
    where = f"{name}: section {number}"
    if degree > _MAX_DEGREE:
        raise FormatError(f"{where}: byte {place + 40}, SH degree: expected 0 to {_MAX_DEGREE}, found {degree}")
    if count > most:
        raise FormatError(f"{where}: byte {place}, number of Gaussians: expected at most {most}, found {count}")
    if level and buckets and centre_bytes != _CENTRE_BYTES:
        raise FormatError(
            f"{where}: byte {place + 20}, bytes of a bucket: expected {_CENTRE_BYTES}, found {centre_bytes}"
        )
    row_bytes = _LEVELS[level].place("sh_rest", 3 * sh_rest_count(degree))[1].stop
    start = at + 4 * partial + centre_bytes * buckets
    if start + count * row_bytes > len(data):
        raise FormatError(
            f"{where}: truncated: {count} Gaussians and {buckets} buckets need {start + count * row_bytes - at} bytes from "
            f"byte {at}; found {max(0, len(data) - at)}; is the file complete?"
        )
    # Room for further Gaussians may be missing at the end of the file.
    end = min(start + most * row_bytes, len(data))
    if not count:
        return None, end
    ends, centres = np.zeros(0, np.int64), np.zeros((0, 3), np.float32)
    if level:
        # Larger buckets hold no more than all Gaussians, so that sums stay small.
        capacity = min(capacity, count)
        sizes = np.minimum(data[at : at + 4 * partial].view("<u4"), count).astype(np.int64)
        held = full * capacity + int(sizes.sum())
        if full + partial > buckets or held < count:
            raise FormatError(
                f"{where}: byte {place + 8}, buckets: expected room for {count} Gaussians in {buckets} buckets; found "
                f"{full} full and {partial} other buckets with room for {held}"
            )
        ends = np.concatenate([np.arange(1, full + 1) * capacity, full * capacity + np.cumsum(sizes)])
        centres = data[at + 4 * partial : start].view("<f4").reshape(-1, 3)
    table = data[start : start + count * row_bytes].reshape(count, row_bytes)
    middle = middle or _POSITION_RANGE
    return _Section(table, degree, ends, centres, block / 2 / middle, middle), end
