"""Makers of worlds whose size and loss are known functions of the multiplier."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from flexgs_edge.goals.target import Measurement, Target
from flexgs_edge.methods.best.search import Candidate

AT, BYTES = 1e-4, 4000
"""The multiplier at which the worlds lose 1 dB, and the bytes that they take there."""


class World:
    """Loss and size as functions of the multiplier; products are their numbers.

    Parameters
    ----------
    loss, size : callable
        Drop in dB and bytes of a multiplier.
    guess : float, optional
        What probes expect, as a multiple of the loss. Default: there are none.
    """

    close = 0.03

    def __init__(
        self,
        loss: Callable[[float], float],
        size: Callable[[float], float],
        guess: float | None = None,
        start: float = AT,
    ) -> None:
        self.loss, self.size, self.guess, self.begins = loss, size, guess, start
        self.made: list[float] = []
        self.probed = self.trimmed = 0
        self.freed: list[int] = []
        self.seen: list[list[int]] = []
        self.worst = 1.0
        """The worst view's drop over the mean, until poses beside it are scored."""

    def start(self, target: Target) -> float:
        return self.begins

    def probe(self, multiplier: float, target: Target) -> float | None:
        if self.guess is None:
            return None
        self.probed += 1
        drop = self.guess * self.loss(multiplier)
        return target.excess(round(self.size(multiplier)), Measurement(drop, 40.0, drop))

    def make(self, multiplier: float, target: Target) -> tuple[Candidate, int]:
        self.made.append(multiplier)
        drop, size = self.loss(multiplier), round(self.size(multiplier))
        worst = self.worst * drop
        quality = Measurement(drop, 40.0, drop, Measurement(worst, 35.0, worst), losses=(drop, worst, drop))
        return Candidate(multiplier, size // 7, 0, size, quality, target.excess(size, quality), 0.0), len(self.made)

    def trim(
        self, chosen: Candidate, product: int, target: Target, tell: Callable[[Candidate], None], most: int
    ) -> tuple[Candidate, int]:
        self.trimmed += 1
        assert most >= 0
        if most and chosen.excess < -self.close:
            chosen = replace(chosen, size=chosen.size - 1, excess=chosen.excess / 2)
            tell(chosen)
        return chosen, product

    def see(self, views: Sequence[int]) -> bool:
        if len(self.seen) == 2:
            return False
        self.seen.append(list(views))
        self.worst = 1.0
        return True

    def discard(self, product: int) -> None:
        self.freed.append(product)


def powers(loss: float = 0.6, size: float = -0.45, scale: float = 1.0, **words: float) -> World:
    return World(lambda m: (m / scale / AT) ** loss, lambda m: BYTES * (m / scale / AT) ** size, **words)
