"""Whether a device rounds quotients and roots, which OpenCL does not ask for: docs/devices.md#quotients-and-roots."""

from __future__ import annotations

import numpy as np
import pyopencl as cl

from flexgs_edge.kernels.choose_device import DeviceInfo
from flexgs_edge.kernels.session import Session
from flexgs_edge.memory.budget import MemoryBudget

SOURCE = """
__kernel void divide(__global const float *a, __global const float *b, __global float *out) {
  const size_t i = get_global_id(0), n = get_global_size(0);
  out[i] = a[i] / b[i];
  out[n + i] = sqrt(a[i]);
}
"""
COUNT = 8192
"""Numbers that are divided. Without the option, an H200 has 29 % of the quotients wrong, and 17 % of the roots."""


def rounding_options(info: DeviceInfo) -> tuple[str, ...]:
    """Build options that make the device round, where it offers this."""
    offers = cl.device_fp_config.CORRECTLY_ROUNDED_DIVIDE_SQRT
    rounds = info.handle is not None and info.handle.single_fp_config & offers
    return ("-cl-fp32-correctly-rounded-divide-sqrt",) if rounds else ()


def rounds_division(info: DeviceInfo) -> bool:
    """Whether the device's own quotients and roots are those of NumPy.

    Raises
    ------
    DeviceError
        If the device does not build or run the kernel.
    """
    random = np.random.default_rng(1)
    values = random.uniform(0.5, 2.0, (2, COUNT)) * 2.0 ** random.integers(-30, 30, (2, COUNT))
    a, b = values.astype(np.float32)
    session = Session(info, MemoryBudget(1 << 40))
    kernel = session.kernel(SOURCE, "divide", rounding_options(info), "bbb")
    arrays = [session.array(shape, np.float32) for shape in (a.shape, b.shape, (2, COUNT))]
    try:
        for array, given in zip(arrays, (a, b), strict=False):
            session.write(array, given)
        session.launch("divide", kernel, (COUNT,), (1,), tuple(arrays))
        found = session.read(arrays[-1])
    finally:
        for array in arrays:
            array.release()
    return bool(np.array_equal(found, np.stack([a / b, np.sqrt(a)])))
