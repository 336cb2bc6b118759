"""Devices that leave loops early: what is left is the same bits, and what cannot be done is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flexgs_edge.errors import DeviceError
from flexgs_edge.kernels.choose_device import LEAST_STEPS, SELF_TEST, run_self_test
from flexgs_edge.kernels.opencl import LIMITED_BLOCKS, STEPS_A_PAIR, OpenCLBackend
from flexgs_edge.render.renderer import Renderer
from kernel_fixtures import default_device, draw, large_budget, open_form, same_bits
from synthetic import make_camera, random_scene

LIMITED = replace(default_device(), loop_steps=65535, name="short loops")


@pytest.mark.parametrize(
    ("end", "verdict", "steps"),
    [
        ("steps", "ok", 0),
        ("min(steps, 65535u)", "ok", 65535),
        ("300u", f"loops end after 300 steps, {LEAST_STEPS} are", 0),
    ],
)
def test_the_limit_is_found(end: str, verdict: str, steps: int) -> None:
    source = SELF_TEST.replace("i < steps", f"i < {end}")
    assert source != SELF_TEST or end == "steps"
    found, limit = run_self_test(default_device().context, source)
    assert found.startswith(verdict) and limit == steps


def test_same_bits_in_batches() -> None:
    limited = OpenCLBackend(LIMITED, large_budget())
    assert limited.form == "gpu" and limited.width == 1 and limited.threads == 0
    assert limited.sort_blocks == limited.tile_blocks == LIMITED_BLOCKS
    assert limited.most_pairs == 65535 // STEPS_A_PAIR
    source, camera = random_scene(3000, 1, 1, size=-2, opacity=-3), make_camera(70, 50)
    expected = draw(open_form("w16"), source, camera)
    renderer = Renderer(limited, large_budget())
    with renderer.load(source) as scene:
        drawn = renderer.render(scene, camera)
        assert renderer._drawn is not None and len(renderer._drawn.batches) > 1
    renderer.release()
    assert same_bits(drawn, expected)


def test_what_takes_too_many_steps() -> None:
    """A wrong picture is worse than none: the message has the limit, and what to do."""
    limited = OpenCLBackend(LIMITED, large_budget())
    ends = limited.array((4000 * LIMITED_BLOCKS + 1,), np.uint32)
    limited.launch("exclusive_scan", (1,), 3000, LIMITED_BLOCKS, ends)
    with pytest.raises(
        DeviceError, match="short loops .* leaves loops after 65535 steps, .*another device, or views of"
    ):
        limited.launch("exclusive_scan", (1,), 4000, LIMITED_BLOCKS, ends)
    with pytest.raises(DeviceError, match="sort_count needs 67048: use another device, or a smaller scene"):
        limited.launch("sort_count", (LIMITED_BLOCKS,), 1_040_000, 0, ends, ends)
    ends.release()
