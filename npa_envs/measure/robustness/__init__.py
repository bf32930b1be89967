"""Measurements of `npa-envs robustness`: losses under other conditions, and after damage."""
