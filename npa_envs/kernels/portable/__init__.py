"""Kernels in plain Warp for CPU and CUDA, float32 and float64: the formulas of `reference.py`."""
