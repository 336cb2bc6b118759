"""Targets of a search: a largest loss of quality, or a largest size.

A target gives each measured point its `excess`: by how much the point misses. Zero or less holds. The excess rises
smoothly with compression, so that the search may interpolate in it.
"""

import math
from dataclasses import dataclass
from typing import Literal, Protocol

from flexgs_edge.errors import InputError
from flexgs_edge.units import format_size

Figure = Literal["drop", "modelled drop", "fidelity"]
"""The figure that decides: drop against photos, modelled drop, or fidelity (PSNR against the original's renders)."""

IDENTICAL_DB = 200.0  # Fidelity of identical renders in comparisons; it is never reported


@dataclass(frozen=True)
class Covered:
    """Fidelity and modelled drop over the part of the pictures that the original covers, in dB."""

    fidelity: float | None  # PSNR against the original's renders; `None` if they are identical
    modelled_drop: float  # drop modelled from that error


@dataclass(frozen=True)
class Measurement:
    """Quality of one point of a search, means over the views that decide, in dB."""

    # Drop against the photos, where a view that gains counts as 0, and one that its photo cannot judge by its modelled
    # drop; `None` without photos.
    drop: float | None
    fidelity: float | None  # PSNR against the original's renders; `None` if they are identical
    modelled_drop: float  # drop modelled from the error against the original's renders
    worst: "Measurement | None" = None  # quality of the worst view alone
    # The same figures over covered pixels, which decide in place of the plain ones; `None` if the plain ones decide.
    covered: Covered | None = None
    # Mean over the views of the drop that decides, where a view that gains counts as 0; `None` if not known.
    usual: float | None = None
    ssim_drop: float | None = None  # SSIM lost, against photos or modelled; `None` if not measured
    made_gap: float | None = None  # how much less fidelity made poses have, dB; `None` if not measured
    # Drop of each view that decides, dB, in their order; `None` for views with hardly any coverage.
    losses: tuple[float | None, ...] = ()

    def figure(self, figure: Figure) -> float | None:
        """The figure of this name that decides, dB; `None` if renders are identical or photos are missing."""
        if figure == "drop":
            return self.drop
        decides = self if self.covered is None else self.covered
        return decides.fidelity if figure == "fidelity" else decides.modelled_drop

    def loss(self, figure: Figure) -> float:
        """The figure of this name that decides, as a number that grows as quality falls."""
        value = self.figure(figure)
        if figure == "fidelity":
            return -IDENTICAL_DB if value is None else -value
        if value is None:
            raise InputError("the drop against photos was asked to decide, but there are no photos")
        return value


class Target(Protocol):
    """A target, as searches use it."""

    @property
    def figure(self) -> Figure: ...

    @property
    def limit_bytes(self) -> int | None:
        """Largest allowed size, or `None` if quality decides."""

    def excess(self, size: int, measurement: Measurement | None) -> float:
        """By how much a point misses; zero or less holds."""

    def describe(self) -> str:
        """The target in words, for the summary and for messages."""

    def report(self, size: int, measurement: Measurement | None) -> str:
        """The figure of a point that the target is about, in words."""


@dataclass(frozen=True)
class MaxDrop:
    """Lose at most `limit` dB against photos (`figure="drop"`), or modelled (`figure="modelled drop"`)."""

    limit: float
    figure: Figure = "drop"
    limit_bytes: int | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.limit) and self.limit > 0.0):
            raise InputError(f"--max-drop {self.limit:g}: expected a drop above 0 dB (1.0 is the usual choice)")

    def excess(self, size: int, measurement: Measurement | None) -> float:
        assert measurement is not None
        return log_loss(measurement.loss(self.figure), self.limit)

    def describe(self) -> str:
        return f"{self.figure} <= {self.limit:g} dB"

    def report(self, size: int, measurement: Measurement | None) -> str:
        assert measurement is not None
        return f"{self.figure} {measurement.loss(self.figure):.3f} dB at {format_size(size)}"


def log_loss(loss: float, limit: float) -> float:
    """The excess of a loss: log of `loss` over `limit`, both in the same unit.

    The error grows about exponentially with the rates, so that this is nearly linear in them. The floor allows for
    drops at or below zero (the compressed scene beats the original), which hold by far.
    """
    return math.log(max(loss / limit, 0.02))


@dataclass(frozen=True)
class MinFidelity:
    """Keep a PSNR of at least `limit` dB against the original's renders."""

    limit: float
    figure: Figure = "fidelity"
    limit_bytes: int | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.limit) and 0.0 < self.limit < IDENTICAL_DB):
            raise InputError(
                f"--min-fidelity {self.limit:g}: expected decibels between 0 and {IDENTICAL_DB:g} (40 is about 1 dB of drop)"
            )

    def excess(self, size: int, measurement: Measurement | None) -> float:
        assert measurement is not None
        return (self.limit + measurement.loss("fidelity")) * (math.log(10.0) / 10.0)

    def describe(self) -> str:
        return f"fidelity >= {self.limit:g} dB"

    def report(self, size: int, measurement: Measurement | None) -> str:
        assert measurement is not None
        found = measurement.figure("fidelity")
        fidelity = "identical" if found is None else f"{found:.3f} dB"
        return f"fidelity {fidelity} at {format_size(size)}"


@dataclass(frozen=True)
class MaxSize:
    """Stay within `limit_bytes`; among points that fit, `figure` tells the best."""

    limit_bytes: int
    figure: Figure = "modelled drop"
    words: str = ""

    def __post_init__(self) -> None:
        if self.limit_bytes < 1:
            raise InputError(f"a size limit of {self.limit_bytes} bytes: expected at least 1 byte")

    def excess(self, size: int, measurement: Measurement | None) -> float:
        return math.log(size / self.limit_bytes)

    def describe(self) -> str:
        return self.words or f"size <= {format_size(self.limit_bytes)}"

    def report(self, size: int, measurement: Measurement | None) -> str:
        value = None if measurement is None else measurement.figure(self.figure)
        return f"{size} bytes ({format_size(size)})" + ("" if value is None else f", {self.figure} {value:.3f} dB")


def min_ratio(ratio: float, ply_bytes: int, figure: Figure = "modelled drop") -> MaxSize:
    """The size target of `--min-ratio`: bytes of the PLY / ratio, rounded down.

    >>> min_ratio(10.0, 2480).limit_bytes
    248
    """
    if not (math.isfinite(ratio) and ratio >= 1.0):
        raise InputError(f"--min-ratio {ratio:g}: expected a ratio of 1 or more")
    limit = int(ply_bytes / ratio)
    return MaxSize(max(limit, 1), figure, f"ratio >= {ratio:g} (size <= {format_size(limit)})")
