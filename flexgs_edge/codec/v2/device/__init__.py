"""Encode and decode version 2 chunks by OpenCL kernels, with the bytes that NumPy gives."""
