"""Warp kernels: cells, perception, its adjoints, updates and pictures. Imports warp alone."""
