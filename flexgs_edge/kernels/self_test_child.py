"""Test one device in a process of its own: `python -m flexgs_edge.kernels.self_test_child INDEX NAME FORM...`.

Forms that are named are left out. Prints the name of each form and kernel before it is built, and the verdict as JSON at the end.
"""

from __future__ import annotations

import contextlib
import json
import resource
import sys
from collections.abc import Sequence
from dataclasses import asdict

from flexgs_edge.kernels.choose_device import list_devices, probed
from flexgs_edge.kernels.form_probe import measure_forms
from flexgs_edge.kernels.launch_record import load_record
from flexgs_edge.kernels.self_test import first_words, verdict
from flexgs_edge.kernels.tested import FORM, MARK
from flexgs_edge.kernels.verdict import Verdict


def test(index: int, name: str, without: Sequence[str] = ()) -> Verdict:
    """Test the device with this index; another name means that devices came or went.

    The fastest form of the kernels is taken that gives the right bits. If none is left to try, the verdict says nothing.
    """
    devices = list_devices(self_test=False)
    if index >= len(devices) or devices[index].name != name:
        return Verdict(f"the device is gone: [{index}] is no longer {name}")
    info = probed(devices[index])
    if not info.usable:
        return Verdict(info.self_test)
    measured, failed = measure_forms(info, without, lambda form: _say(f"{FORM}{form}"))
    record = load_record()
    reasons = [first_words(failed)]
    for one in measured:
        _say(f"{FORM}{one.form}")
        said = verdict(record, one.backend, _say)
        if said == "ok":
            return Verdict(said, info.loop_steps, str(one.form))
        reasons.append(said)
    return Verdict(next(filter(None, [*reasons[1:], reasons[0]]), ""), info.loop_steps)


def _say(text: str) -> None:
    print(f"{MARK}{text}", flush=True)


if __name__ == "__main__":
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    _say(json.dumps(asdict(test(int(sys.argv[1]), sys.argv[2], sys.argv[3:]))))
