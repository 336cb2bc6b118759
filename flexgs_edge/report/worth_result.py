"""Result of `info --errors`: what each channel of a file is worth."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from flexgs_edge.report.info_result import InfoResult
from flexgs_edge.report.run_info import ViewsInfo
from flexgs_edge.units import format_size

ONE_LESS, DROPPED = "one bit less", "dropped"
"""The two changes that we make to a channel."""


@dataclass(frozen=True)
class WorthChange:
    """A reduced channel: the bytes it saves in the file, fidelity and modelled drop, dB.

    The fidelity is `None` if no render changes.
    """

    channel: str
    change: str
    bytes_saved: int
    fidelity: float | None
    modelled_drop: float


@dataclass(frozen=True)
class WorthResult:
    """Contents of a file, and what each of its channels is worth.

    Parameters
    ----------
    info : InfoResult
        Result of `info`.
    views : ViewsInfo
        All views of the run.
    used, kind : int, str
        Number and kind of the views drawn: `held-out` or `training`.
    base_psnr : float
        Assumed PSNR of the original against its photos, for the modelled drop, dB.
    changes : tuple of WorthChange
        In the order of the channels.
    """

    info: InfoResult
    views: ViewsInfo
    used: int
    kind: str
    base_psnr: float
    changes: tuple[WorthChange, ...]

    def to_json(self) -> dict[str, Any]:
        """Return the record of `info` as JSON values, with the key `errors` added."""
        views = {**self.views.to_json(), "used": self.used, "kind": self.kind}
        changes = [asdict(change) for change in self.changes]
        return {**self.info.to_json(), "errors": {"views": views, "base_psnr": self.base_psnr, "changes": changes}}

    def summary(self) -> str:
        """Return the text that the command prints."""
        return self.info.summary() + self.table()

    def table(self) -> str:
        """Return the part of the summary about what each channel is worth."""
        items = {(item.channel, item.change): item for item in self.changes}
        rows: list[tuple[str, ...]] = [("", *("saves", "fidelity", "drop") * 2)]
        for channel in dict.fromkeys(item.channel for item in self.changes):
            pair = (_cells(items.get((channel, change)), self.info.size) for change in (ONE_LESS, DROPPED))
            rows.append((channel, *(cell for cells in pair for cell in cells)))
        widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
        drawn = f"{self.used} {self.kind} view{'' if self.used == 1 else 's'}"
        lines = [
            "",
            f"what each is worth, on {drawn} of {self.views.cameras}:",
            f"{'':<{widths[0]}}  {'one bit less:':<{sum(widths[1:4]) + 4}}  dropped:",
        ]
        for row in rows:
            cells = (cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))
            lines.append("  ".join([row[0].ljust(widths[0]), *cells]))
        lines += [
            "one bit less: at twice the step. dropped: SH of this degree and higher gone; opacity, dc and scale at their mean,",
            "rotations gone. saves: bytes of the whole file. fidelity: PSNR in dB against this file's own renders, over the",
            f"pixels that they cover; drop: the modelled drop in dB that goes with it, from a base of {self.base_psnr:g} dB.",
        ]
        return "\n".join(lines) + "\n"


def _cells(item: WorthChange | None, size: int) -> tuple[str, str, str]:
    if item is None:
        return "-", "-", "-"
    fidelity = "same" if item.fidelity is None else f"{item.fidelity:.2f}"
    share = f"{format_size(item.bytes_saved)} {100 * item.bytes_saved / size:5.1f} %"
    return share, fidelity, f"{item.modelled_drop:.3f}"
