"""OpenCL kernels and their NumPy twins, behind one interface: devices, sessions and backends."""
