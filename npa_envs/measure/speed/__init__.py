"""Benchmarks: run time against error, the paper's table, scaling, and what a call launches."""
