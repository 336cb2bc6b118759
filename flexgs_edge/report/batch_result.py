"""The result of compressing several scenes: a row for each, and their sums."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from flexgs_edge.report.results import CompressResult
from flexgs_edge.report.summary import decibel, text
from flexgs_edge.units import format_size

_FAULT, _FAILED = 1, 2
_HEADINGS = ("input", "output", "as .ply", "file", "ratio", "quality", "time")


@dataclass(frozen=True)
class BatchItem:
    """One scene of several."""

    input: str  # the scene, as given or as found in a folder
    result: CompressResult | None  # `None` if the scene failed
    error: str | None = None  # why it failed
    exit_code: int = 0  # what `compress` of this scene alone would have ended with

    @property
    def reason(self) -> str:
        """The error without the name of the scene in front."""
        return (self.error or "").removeprefix(f"{self.input}: ")

    def to_json(self) -> dict[str, Any]:
        """Return the record of `compress`, or the error, as JSON values."""
        if self.result is not None:
            return self.result.to_json()
        return {"input": {"path": self.input}, "error": self.error, "exit_code": self.exit_code}


@dataclass(frozen=True)
class BatchResult:
    """Result of `compress_all`."""

    items: tuple[BatchItem, ...]  # the scenes that are done or failed, in the order of the inputs
    total: int  # Number of scenes. An interruption leaves more of them than `items`.
    seconds: float  # wall seconds of all

    @property
    def results(self) -> tuple[CompressResult, ...]:
        """The results of the scenes that are done."""
        return tuple(item.result for item in self.items if item.result is not None)

    @property
    def failed(self) -> tuple[BatchItem, ...]:
        """The scenes that failed."""
        return tuple(item for item in self.items if item.result is None)

    @property
    def exit_code(self) -> int:
        """0 if all are done, 2 if any failed, 1 if any failed by a fault of ours."""
        codes = {item.exit_code for item in self.failed}
        return _FAULT if _FAULT in codes else _FAILED if codes else 0

    def to_json(self) -> list[dict[str, Any]]:
        """Return the record of each scene as JSON values."""
        return [item.to_json() for item in self.items]

    def summary(self) -> str:
        """Return the text that the command prints."""
        rows = [_HEADINGS] + [_row(item.result) for item in self.items if item.result is not None]
        widths = [max(len(row[column]) for row in rows) for column in range(len(_HEADINGS))]
        widths[0] = max([widths[0], *(len(item.input) for item in self.items)])
        lines = [_aligned(_HEADINGS, widths)] if self.results else []
        for item in self.items:
            if item.result is None:
                lines.append(f"{item.input.ljust(widths[0])}  FAILED: {item.reason}")
            else:
                lines.append(_aligned(_row(item.result), widths))
        return text([*lines, self._sums()])

    def _sums(self) -> str:
        results, left = self.results, self.total - len(self.items)
        words = f"{len(results)} of {self.total} scenes done"
        words += f", {len(self.failed)} failed" if self.failed else ""
        words += f", {left} not begun or not finished" if left else ""
        if results:
            before, after = sum(each.scene.ply_bytes for each in results), sum(each.size for each in results)
            words += f": {format_size(before)} -> {format_size(after)} ({before / after:.2f}x)"
        words += f", {self.seconds:.1f} s"
        dry = bool(results) and all(each.output is None for each in results)
        return words + ("; nothing was written (--dry-run)" if dry else "")


def _row(result: CompressResult) -> tuple[str, ...]:
    return (
        result.scene.path,
        result.output or "-",
        format_size(result.scene.ply_bytes),
        format_size(result.size),
        f"{result.ratio:.2f}x",
        _quality(result),
        f"{result.run.seconds:.1f} s",
    )


def _quality(result: CompressResult) -> str:
    """The figure that decided, else the drop."""
    quality = result.quality
    if quality is None:
        return "-"
    missed = "" if result.reached in (True, None) else ", NOT reached"
    if result.decided_by == "fidelity":
        return f"fidelity {decibel(quality.fidelity)}{'' if quality.fidelity is None else ' dB'}{missed}"
    if quality.drop is not None and result.decided_by != "modelled drop":
        return f"drop {decibel(quality.usual_drop)} dB{missed}"
    return f"modelled drop {quality.modelled_drop:.3f} dB{missed}"


def _aligned(row: tuple[str, ...], widths: list[int]) -> str:
    """Names to the left, numbers to the right."""
    cells = [
        cell.rjust(width) if 2 <= column <= 4 or column == 6 else cell.ljust(width)
        for column, (cell, width) in enumerate(zip(row, widths, strict=True))
    ]
    return "  ".join(cells).rstrip()
