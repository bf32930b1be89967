"""Kernels in plain Warp, for CPU and CUDA, float32 and float64: read them beside the reference."""
