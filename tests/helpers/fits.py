"""Small chunks and short lists for tests: what renderers share memory by, where a test does not build them itself."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from flexgs_edge.render import fit


def use_fit(monkeypatch: pytest.MonkeyPatch, **changes: Any) -> None:
    """Renderers that are given no `Fit` take the default with these changes, on top of earlier ones."""
    monkeypatch.setattr(fit, "DEFAULT", replace(fit.DEFAULT, **changes))
