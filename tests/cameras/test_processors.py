"""Poses have the same bits on all processors. On x86, OpenBLAS and NumPy can be told to take the code for older ones."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest

from camera_files import read_inria
from flexgs_edge.cameras.generated import at_distance, poses_between
from flexgs_edge.cameras.order import covering_order
from flexgs_edge.render.ahead import camera_record

PROCESSORS = {
    "Prescott": {"OPENBLAS_CORETYPE": "Prescott", "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX2 FMA3 AVX512F"},
    "Haswell": {"OPENBLAS_CORETYPE": "Haswell"},
    "SkylakeX": {"OPENBLAS_CORETYPE": "SkylakeX"},
}
NEEDED = {"Haswell": "avx2", "SkylakeX": "avx512f"}
"""What the code for a processor takes of this one."""


def fingerprint(path: str) -> str:
    """Checksums of given and generated poses, of their records, and of the orders in which they are chosen."""
    cameras = read_inria(Path(path))
    points = np.random.default_rng(1).normal(size=(3, 500))
    generated = poses_between(cameras)
    moved = [at_distance(camera, 2.0, 0.5) for camera in cameras]
    records = [camera_record(camera, np.array([0.3, 0.1, 2.0]), 0.2) for camera in [*cameras, *generated, *moved]]
    exact = [np.stack([camera.translation, camera.center]) for camera in [*cameras, *generated, *moved]]
    orders = np.array(covering_order(cameras, points, 0.2, len(cameras)))
    parts = (np.stack(records), np.stack(exact), orders)
    return f"{[camera.name for camera in generated]} {[zlib.crc32(np.ascontiguousarray(part)) for part in parts]}"


@pytest.mark.parametrize("processor", PROCESSORS)
def test_poses_have_the_same_bits(processor: str, repository: Path) -> None:
    """The sample's cameras stand on rings, so each has two neighbours that only a rounding error tells apart."""
    known = Path("/proc/cpuinfo")
    if platform.machine() == "x86_64" and known.exists() and NEEDED.get(processor, "") not in known.read_text():
        pytest.skip(f"this processor has no {NEEDED[processor]}")
    path = str(repository / "samples" / "still_life" / "cameras.json")
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", f"import test_processors as t; print(t.fingerprint({path!r}))"],
        env={
            **os.environ,
            **PROCESSORS[processor],
            "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path]),
        },
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == fingerprint(path)
