"""OpenCL contexts and built programs, which all sessions of this process share: a second scene of a batch builds nothing."""

from __future__ import annotations

import time
import warnings

import pyopencl as cl

_CONTEXTS: dict[int, cl.Context] = {}
"""By device."""
_PROGRAMS: dict[tuple[int, str, tuple[str, ...]], tuple[cl.Context, cl.Program]] = {}
"""By context, source and options. Each keeps its context, so that no other one takes its number."""


def context_of(device: cl.Device) -> cl.Context:
    """The context of `device`; raises `cl.Error`."""
    if device.int_ptr not in _CONTEXTS:
        _CONTEXTS[device.int_ptr] = cl.Context([device])
    return _CONTEXTS[device.int_ptr]


def built_program(context: cl.Context, source: str, options: tuple[str, ...]) -> tuple[cl.Program, float]:
    """The program of `source`, built with `options`, and the seconds that building took: 0 if this process had it.

    Raises `cl.Error` if it does not build.
    """
    key, seconds = (context.int_ptr, source, options), 0.0
    if key not in _PROGRAMS:
        start = time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # CompilerWarning on any build log, such as PoCL's remarks
            built = cl.Program(context, source).build(options=["-cl-std=CL1.2", *options], cache_dir=False)  # type: ignore[arg-type]
        _PROGRAMS[key], seconds = (context, built), time.perf_counter() - start
    return _PROGRAMS[key][1], seconds
