"""Kernels for CUDA in float32 on compute capability 8.0 and above."""
