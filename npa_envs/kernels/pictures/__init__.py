"""Kernels that draw particles: splats in 2D, Gaussians in 3D."""
