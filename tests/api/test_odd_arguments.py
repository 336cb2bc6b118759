"""Arguments of the Python interface that cannot be used: an error of ours that names them, before any work."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import flexgs_edge
from flexgs_edge.errors import InputError
from flexgs_edge.run.options import CompressOptions
from synthetic import make_camera

SCENE = flexgs_edge.Scene.from_arrays(
    means=np.random.default_rng(0).normal((0, 0, 6), 1, (40, 3)), log_scales=np.full((40, 3), -2.0),
    quats=np.tile([1.0, 0, 0, 0], (40, 1)), opacity_logits=np.full(40, 2.0), sh_dc=np.zeros((40, 3)),
)  # fmt: skip


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ({"memory_limit": "1kB"}, "memory_limit='1kB': expected a whole number or None, found str"),
        ({"max_size": "8XB"}, "max_size='8XB': expected a whole number or None, found str"),
        ({"max_size": 2.5}, "max_size=2.5: expected a whole number"),
        ({"device": 99}, "device=99: expected a string or None, found int"),
        ({"background": (0, 0)}, r"background=\(0, 0\): expected three numbers or None, found tuple"),
        ({"background": "red"}, "background='red': expected three numbers"),
        ({"holdout": True}, "holdout=True: expected a whole number, found bool"),
        ({"resume": "no"}, "resume='no': expected True or False"),
        ({"max_worst_drop": []}, r"max_worst_drop=\[\]: expected a number or a string or None, found list"),
        ({"cameras": 3}, "cameras=3: expected a path or a sequence, found int"),
        ({"cameras": [make_camera(), None]}, r"cameras\[1\]=None: expected Camera, found NoneType"),
        ({"images": 3}, "images=3: expected a path or a sequence, found int"),
        ({"images": [[1, 2]]}, r"images\[0\]=\[1, 2\]: expected ndarray, found list"),
    ],
    ids=str,
)
def test_options(words: dict[str, Any], says: str) -> None:
    with pytest.raises(InputError, match=says):
        flexgs_edge.encode(SCENE, effort="fast", **words)


def test_numbers_of_numpy_and_paths_are_as_good() -> None:
    options = CompressOptions(
        holdout=np.int64(4),  # type: ignore[arg-type]
        near=np.float32(0.5),  # type: ignore[arg-type]
        drop_invalid=np.bool_(True),  # type: ignore[arg-type]
        background=np.zeros(3),  # type: ignore[arg-type]
        cameras=Path("cameras.json"),  # type: ignore[arg-type]
    )
    assert options.holdout == 4


def test_images_may_come_from_a_generator() -> None:
    cameras = [make_camera(name=f"v{place}") for place in range(3)]
    photos = (np.zeros((30, 40, 3), np.uint8) for _ in cameras)
    words: dict[str, Any] = {"images": photos, "device": "numpy", "trust_views": True}
    _, result = flexgs_edge.encode(SCENE, cameras=cameras, effort="fast", **words)
    assert result.quality is not None and result.quality.drop is not None


@pytest.mark.parametrize("value", [3, None, [1]])
def test_files(value: Any) -> None:
    with pytest.raises(InputError, match=r"file=.*: expected bytes or a path"):
        flexgs_edge.decode(value)
    with pytest.raises(InputError, match=r"path=.*: expected a path"):
        flexgs_edge.Scene.open(value)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_a_fork_after_opencl_is_refused_and_one_before_works() -> None:
    """PoCL's threads are not in the child, which would wait for them for ever."""
    program = (
        "import os, sys\n"
        "from flexgs_edge.errors import DeviceError\n"
        "from flexgs_edge.kernels.choose_device import list_devices\n"
        "def child():\n"
        "    try:\n"
        "        list_devices(self_test=False)\n"
        "    except DeviceError as error:\n"
        "        os._exit(7 if 'forked' in str(error) else 8)\n"
        "    os._exit(0)\n"
        "def forked():\n"
        "    pid = os.fork()\n"
        "    if not pid:\n"
        "        child()\n"
        "    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])\n"
        "print(forked())\n"
        "list_devices(self_test=False)\n"
        "print(forked())\n"
    )
    root = str(Path(flexgs_edge.__file__).parents[1])
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "PYTHONPATH": root},
        timeout=120,
        capture_output=True,
        text=True,
    )
    assert done.stdout.split() == ["0", "7"], done.stderr
