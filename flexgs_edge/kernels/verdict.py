"""Verdicts of self-tests, kept in the user's cache folder: one small file for each device, driver and version of the kernels."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from flexgs_edge.kernels.choose_device import SELF_TEST, DeviceInfo
from flexgs_edge.kernels.cl_sources import constants_header, kernel_dir
from flexgs_edge.kernels.launch_record import RECORD

CACHE_VARIABLE = "FLEXGS_CACHE_DIR"  # Environment variable with another folder for what we keep between runs
_ABOUT = ("name", "platform", "driver", "opencl_c", "type", "native_width", "max_work_group", "local_bytes")


@dataclass(frozen=True)
class Verdict:
    """What the self-test said: `DeviceInfo.self_test`, `DeviceInfo.loop_steps` and `DeviceInfo.form`."""

    self_test: str
    loop_steps: int = 0
    form: str = ""


def cache_folder() -> Path:
    """Where verdicts lie: `devices` in FLEXGS_CACHE_DIR, or in `flexgs-edge` of the user's cache folder."""
    named = os.environ.get(CACHE_VARIABLE)
    if named:
        return Path(named) / "devices"
    caches = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(caches) / "flexgs-edge" / "devices"


def key_of(info: DeviceInfo) -> str:
    """A name for the device, its driver, our kernels and the self-test together; any change gives another one."""
    digest = hashlib.sha256(json.dumps([getattr(info, name) for name in _ABOUT]).encode())
    for text in (SELF_TEST, constants_header()):
        digest.update(text.encode())
    for file in sorted(kernel_dir().glob("*.cl*")):
        digest.update(file.name.encode() + file.read_bytes())
    digest.update(RECORD.read_bytes())
    return digest.hexdigest()[:32]


def kept_verdict(key: str) -> Verdict | None:
    """The verdict of an earlier run; None if there is none, or if its file cannot be read."""
    try:
        found = json.loads((cache_folder() / f"{key}.json").read_text(encoding="utf-8"))
        verdict = Verdict(found["self_test"], found["loop_steps"], found["form"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    sound = isinstance(verdict.self_test, str) and isinstance(verdict.form, str) and type(verdict.loop_steps) is int
    return verdict if sound else None


def keep_verdict(key: str, info: DeviceInfo, verdict: Verdict) -> str | None:
    """Keep a verdict for later runs. Returns None, or why that was not possible."""
    about: dict[str, Any] = {name: getattr(info, name) for name in _ABOUT}
    folder = cache_folder()
    temporary = None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(prefix=f"{key}.", dir=folder)
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            json.dump({**asdict(verdict), **about}, file, indent=1)
        os.replace(temporary, folder / f"{key}.json")
    except OSError as error:
        if temporary is not None and os.path.exists(temporary):
            os.unlink(temporary)
        return f"{folder}: {error.strerror or error}"
    return None
