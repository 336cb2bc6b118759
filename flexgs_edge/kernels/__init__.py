"""OpenCL kernels and their NumPy twins: devices, sessions and the backend that is one of the two."""
