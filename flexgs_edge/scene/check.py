"""Check a scene before work starts: at least one Gaussian, finite values, usable rotations; and which rows can show."""

import math
from collections.abc import Sequence

import numpy as np

from flexgs_edge.constants import ALPHA_MIN, TRANSMITTANCE_MIN
from flexgs_edge.errors import InputError
from flexgs_edge.memory.rows import BLOCK_ROWS
from flexgs_edge.progress import LOG
from flexgs_edge.scene.fields import FIELDS, OPACITY_LIMIT
from flexgs_edge.scene.source import Planes, SceneSource, SelectSource, WrappedSource

TELLING_ROWS = 32  # In scenes of fewer Gaussians, all opacities and scales may look activated by chance
_TINY = np.finfo(np.float32).tiny
SH_LARGEST = 1e15
"""Larger SH coefficients are invalid: squares of their colours leave float32, and infinity times a weight of zero is NaN."""
MOST_ALIKE = math.ceil(math.log(TRANSMITTANCE_MIN) / math.log1p(-ALPHA_MIN)) + 1
"""So many splats of one shape and place end every pixel that they reach, and one more for rounding. Later ones never show."""
SHAPE = "means", "log_scales", "quats", "opacity_logits"  # Fields that decide where a splat is how opaque
MULTIPLIERS = np.random.default_rng(0).integers(2**63, size=(11, 1), dtype=np.uint64) * np.uint64(2) + np.uint64(1)
BUCKET_BITS = 16  # Leading bits of a hash by which rows are counted first


class _Faults:
    """Invalid rows: how many for each reason, and the first of them."""

    def __init__(self) -> None:
        self.count, self.first = 0, -1
        self.reasons: dict[str, tuple[int, int]] = {}

    def add(self, start: int, bad: np.ndarray, reason: str) -> None:
        rows = np.flatnonzero(bad)
        if rows.size:
            count, first = self.reasons.get(reason, (0, start + int(rows[0])))
            self.reasons[reason] = (count + rows.size, first)

    def __str__(self) -> str:
        return ", ".join(f"{why} in {count} (first row {first})" for why, (count, first) in self.reasons.items())


def check_scene(source: SceneSource, drop_invalid: bool = False, chunk_rows: int = 65536) -> SceneSource:
    """Check every value of a scene, one chunk at a time.

    A row is invalid if a field has NaN or infinity, or an SH coefficient is beyond `SH_LARGEST`. It is also invalid if
    the norm of its quaternion is zero, or outside the range that float32 can normalise. Log-scales of -inf (flat
    splats) are valid: they are read as the smallest finite log-scale of the scene. Logits of +-inf (opacities 1 and 0)
    are valid too: they are read as +-`OPACITY_LIMIT`.

    Returns `source` itself, or a lazy source over it, with a note on the rows that were left out or clamped. A scene
    whose opacities and scales look activated is warned of. Raises `InputError` if the scene is empty or has invalid
    rows. The message tells how many, in which fields, and the first row.
    """
    if source.count == 0:
        raise InputError(f"{source.name}: the scene is empty: it has no Gaussians")
    if source.valid:
        return source
    faults = _Faults()
    keep = np.ones(source.count if drop_invalid else 0, bool)
    flat, extreme, smallest, activated = 0, 0, np.float32(np.inf), source.count >= TELLING_ROWS
    for rows in source.chunks(chunk_rows):
        bad, infinite = _check_chunk(source, rows, faults)
        if drop_invalid:
            keep[rows] = ~bad
        scales, logits = infinite["log_scales"][:, ~bad], infinite["opacity_logits"][:, ~bad]
        without = np.isneginf(scales)
        flat += int(without.any(axis=0).sum())
        extreme += int(np.isinf(logits).sum())
        activated = activated and bool((scales > 0).all() and ((logits >= 0) & (logits <= 1)).all())
        smallest = min(smallest, scales.min(initial=np.float32(np.inf), where=~without))
    if faults.count and not drop_invalid:
        raise InputError(
            f"{source.name}: {faults.count} of {source.count} Gaussians are invalid: {faults}; "
            "use --drop-invalid to leave them out"
        )
    if faults.count == source.count:
        raise InputError(f"{source.name}: all {source.count} Gaussians are invalid: {faults}")
    if faults.count:
        note = f"{faults.count} of {source.count} Gaussians left out as invalid: {faults}"
        source = SelectSource(source, np.flatnonzero(keep), (note,))
    notes = []
    if activated:
        notes.append(
            f"all {source.count} opacities lie in 0..1 and all scales above 0, so they seem to be activated already. They are "
            "read as logits and logarithms, as the format says: all Gaussians would be half transparent and larger than 1 "
            "unit. If the scene looks wrong, write log(opacity / (1 - opacity)) and log(scale) to the file"
        )
        LOG.warning("%s: %s", source.name, notes[0])
    if flat:
        if not np.isfinite(smallest):
            raise InputError(f"{source.name}: log_scales: all are -inf; expected finite values")
        notes.append(f"{flat} flat Gaussians: log-scales of -inf set to the smallest finite one, {float(smallest):.4g}")
    if extreme:
        notes.append(
            f"{extreme} Gaussians of opacity 1 or 0: logits of +-inf set to +-{OPACITY_LIMIT:g} (0.999 or 0.001)"
        )
    return _FiniteSource(source, smallest, tuple(notes)) if notes else source


def _check_chunk(source: SceneSource, rows: slice, faults: _Faults) -> tuple[np.ndarray, Planes]:
    """Find the invalid rows of a chunk; returns [n] bool, and the fields of the chunk that may be infinite."""
    bad = np.zeros(rows.stop - rows.start, bool)
    infinite: Planes = {}
    for field in FIELDS:
        values = source.read(rows, [field.name])[field.name]
        finite = np.isfinite(values)
        if field.name == "log_scales":
            finite |= np.isneginf(values)
        if field.name == "opacity_logits":
            finite |= np.isinf(values)
        if field.name in ("log_scales", "opacity_logits"):
            infinite[field.name] = values
        broken = np.asarray(~finite.all(axis=0))
        faults.add(rows.start, broken, f"NaN or infinity in {field.name}")
        bad |= broken
        if field.name in ("sh_dc", "sh_rest"):
            glaring = ~broken & (np.abs(values) > SH_LARGEST).any(axis=0)
            faults.add(rows.start, glaring, f"values beyond +-{SH_LARGEST:g} in {field.name}")
            bad |= glaring
        if field.name == "quats":
            with np.errstate(over="ignore", under="ignore", invalid="ignore"):
                norm = np.square(values).sum(axis=0, dtype=np.float32)
                useless = ~broken & ~((norm >= _TINY) & (norm < np.inf))
            faults.add(rows.start, useless, "quats of norm zero (or beyond float32)")
            bad |= useless
    faults.count += int(bad.sum())
    return bad, infinite


class _FiniteSource(WrappedSource):
    """A checked source whose infinite values are read as finite ones: log-scales of at least `floor`, and bounded logits."""

    def __init__(self, parent: SceneSource, floor: np.float32, notes: tuple[str, ...]) -> None:
        super().__init__(parent, notes)
        self.floor, self.valid = np.float32(floor), True

    def change(self, planes: Planes) -> None:
        if "log_scales" in planes:
            np.maximum(planes["log_scales"], self.floor, out=planes["log_scales"])
        if "opacity_logits" in planes:
            logits = planes["opacity_logits"]
            np.copyto(logits, np.copysign(np.float32(OPACITY_LIMIT), logits), where=np.isinf(logits))


def alive(logits: np.ndarray) -> np.ndarray:
    """[n] bool: opacity reaches 1/255. The renderer never draws the other rows, so removing them costs no quality."""
    return logits >= np.float32(-np.log(1 / ALPHA_MIN - 1) - 1e-3)


def invisible(source: SceneSource) -> InputError:
    """The error for a scene of which no row is `alive`."""
    return InputError(
        f"{source.name}: no Gaussian is opaque enough to be drawn: all {source.count} have an opacity below 1/255, and nothing "
        "would be left. Check that the file is a trained scene, with opacities before the sigmoid (logits)"
    )


def without_hidden(source: SceneSource) -> SceneSource:
    """The scene without splats that no view can show, since `MOST_ALIKE` of the same shape and place come before them.

    All pictures stay as they are. Returns `source` itself, or a lazy source over it with a note.
    """
    counts = np.zeros(1 << BUCKET_BITS, np.int64)
    for rows in source.chunks(BLOCK_ROWS):
        counts += np.bincount(_buckets(source, rows), minlength=len(counts))
    crowded = counts > MOST_ALIKE
    if not crowded.any():
        return source
    keep, known = np.ones(source.count, bool), dict[int, int]()
    for rows in source.chunks(BLOCK_ROWS):
        some = np.flatnonzero(crowded[_buckets(source, rows)])
        shapes, place, sizes = np.unique(_hashes(source, rows, SHAPE)[some], return_inverse=True, return_counts=True)
        before = np.array([known.get(shape, 0) for shape in shapes.tolist()], np.int64)
        known.update(zip(shapes.tolist(), (before + sizes).tolist(), strict=True))
        order = np.argsort(place, kind="stable")
        first = np.cumsum(sizes) - sizes - before
        keep[rows.start + some[order]] = np.arange(len(some)) - first[place[order]] < MOST_ALIKE
    if keep.all():
        return source
    hidden = int(source.count - keep.sum())
    note = f"{hidden} of {source.count} Gaussians left out: {MOST_ALIKE} of the same shape and place hide each of them"
    return SelectSource(source, np.flatnonzero(keep), (note,))


def _buckets(source: SceneSource, rows: slice) -> np.ndarray:
    """[n] i64, a number for each row that is the same for all at one place."""
    return (_hashes(source, rows, SHAPE[:1]) >> np.uint64(64 - BUCKET_BITS)).astype(np.int64)


def _hashes(source: SceneSource, rows: slice, fields: Sequence[str]) -> np.ndarray:
    """[n] u64, a hash of the bits of the fields for each row."""
    planes = source.read(rows, fields)
    words = np.concatenate([planes[field].view(np.uint32) for field in fields])
    hashes: np.ndarray = (words * MULTIPLIERS[: len(words)]).sum(axis=0, dtype=np.uint64)
    return hashes
