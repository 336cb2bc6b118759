"""OpenCL devices: choice, self-test, and the session that owns everything on one of them."""
