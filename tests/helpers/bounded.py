"""Numbers that carry how far float32 arithmetic may be from them: first order, one unit roundoff for each operation.

Formulas written for float32 arrays (the twins) run on them as they are, once `fma`, `dot3` and `fexp2` are those of this module.
Only the errors of such a run count; what is compared with them is worked out elsewhere.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from reference_renderer import EPS, EXP2_ERROR


class Bounded(np.lib.mixins.NDArrayOperatorsMixin):
    """Exact values, and bounds on the errors of what float32 makes of them ([...] f64 each)."""

    def __init__(self, value: Any, error: Any = 0.0) -> None:
        self.value = np.asarray(value, np.float64)
        self.error = np.broadcast_to(np.asarray(error, np.float64), self.value.shape)

    @classmethod
    def of(cls, given: Any) -> Bounded:
        """Constants and cameras are rounded to float32 once."""
        return given if isinstance(given, Bounded) else cls(given, EPS * np.abs(given))

    def rounded(self) -> Bounded:
        """After one operation."""
        return Bounded(self.value, self.error + EPS * abs(self.value))

    def __getitem__(self, key: Any) -> Bounded:
        return Bounded(self.value[key], self.error[key])

    def __len__(self) -> int:
        return len(self.value)

    def __iter__(self) -> Iterator[Bounded]:
        return (self[k] for k in range(len(self)))

    @property
    def T(self) -> Bounded:
        return Bounded(self.value.T, self.error.T)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *given: Any, **words: Any) -> Any:
        if method != "__call__" or words or ufunc not in RULES:
            return NotImplemented
        return RULES[ufunc](*map(Bounded.of, given))

    def __array_function__(self, function: Any, types: Any, given: Sequence[Any], words: Any) -> Any:
        return FUNCTIONS[function](*given) if function in FUNCTIONS and not words else NotImplemented


def _sum(a: Bounded, b: Bounded) -> Bounded:
    return Bounded(a.value + b.value, a.error + b.error).rounded()


def _product(a: Bounded, b: Bounded) -> Bounded:
    error = abs(a.value) * b.error + abs(b.value) * a.error + a.error * b.error
    return Bounded(a.value * b.value, error).rounded()


def _ratio(a: Bounded, b: Bounded) -> Bounded:
    value = a.value / b.value
    return Bounded(value, (a.error + abs(value) * b.error) / (abs(b.value) - b.error)).rounded()


def _root(a: Bounded) -> Bounded:
    value = np.sqrt(a.value)
    return Bounded(value, a.error / np.maximum(value, 1e-300)).rounded()


def _pick(first: np.ndarray, a: Bounded, b: Bounded) -> Bounded:
    return Bounded(np.where(first, a.value, b.value), np.where(first, a.error, b.error))


RULES: dict[np.ufunc, Any] = {
    np.add: _sum,
    np.subtract: lambda a, b: _sum(a, -b),
    np.multiply: _product,
    np.divide: _ratio,
    np.sqrt: _root,
    np.negative: lambda a: Bounded(-a.value, a.error),
    np.absolute: lambda a: Bounded(abs(a.value), a.error),
    np.fmax: lambda a, b: _pick(a.value >= b.value, a, b),
    np.fmin: lambda a, b: _pick(a.value <= b.value, a, b),
    np.greater: lambda a, b: a.value > b.value,
    np.equal: lambda a, b: a.value == b.value,
}
FUNCTIONS: dict[Any, Any] = {
    np.where: lambda first, a, b: _pick(first, Bounded.of(a), Bounded.of(b)),
    np.stack: lambda parts: stacked(parts),
    np.zeros_like: lambda a: Bounded(np.zeros_like(a.value)),
    np.full_like: lambda a, number: Bounded.of(np.full_like(a.value, number)),
}


def stacked(parts: Sequence[Bounded]) -> Bounded:
    """Along a new first axis."""
    return Bounded(np.stack([part.value for part in parts]), np.stack([part.error for part in parts]))


def fma(a: Any, b: Any, c: Any) -> Bounded:
    """`a * b + c`, rounded once."""
    a, b, c = map(Bounded.of, (a, b, c))
    error = abs(a.value) * b.error + abs(b.value) * a.error + a.error * b.error + c.error
    return Bounded(a.value * b.value + c.value, error).rounded()


def dot3(*parts: Any) -> Bounded:
    """As that of the twins."""
    ax, ay, az, bx, by, bz = map(Bounded.of, parts)
    return fma(az, bz, fma(ay, by, ax * bx))


def fexp2(x: Any) -> Bounded:
    """2^x."""
    x = Bounded.of(x)
    value = np.exp2(x.value)
    return Bounded(value, value * (np.log(2) * x.error + EXP2_ERROR))
