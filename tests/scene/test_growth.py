"""Parts of scenes that are drawn larger."""

from __future__ import annotations

import numpy as np
import pytest

from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import GrownSource, growth
from synthetic import random_scene


@pytest.mark.parametrize(("there", "whole", "factor"), [(7, 7, 1.0), (1, 256, 2.0), (100, 25_600, 2.0)])
def test_the_factor(there: int, whole: int, factor: float) -> None:
    assert np.exp(growth(there, whole)) == pytest.approx(factor) and growth(there, whole).dtype == np.float32


def test_only_scales_grow() -> None:
    source = random_scene(40, 3, 1)
    grown = GrownSource(source, 80)
    rows, fields = slice(5, 25), list(FIELD)
    before, after = source.read(rows, fields), grown.read(rows, fields)
    for name, values in before.items():
        added = growth(40, 80) if name == "log_scales" else np.float32(0)
        np.testing.assert_array_equal(after[name], values + added)
    np.testing.assert_array_equal(source.read(rows, ["log_scales"])["log_scales"], before["log_scales"])
    assert (grown.count, grown.sh_degree, grown.sh_count) == (source.count, source.sh_degree, source.sh_count)
    assert set(grown.read(rows, ["means"])) == {"means"}
    assert GrownSource(source.select(np.zeros(0, np.int64)), 80).count == 0
