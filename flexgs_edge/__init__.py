"""NumPy + OpenCL toolkit that compresses trained 3D Gaussian splatting scenes."""
