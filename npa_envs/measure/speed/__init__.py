"""Benchmarks of `npa-envs bench`: times, memory, scaling, and the kernels of a call."""
