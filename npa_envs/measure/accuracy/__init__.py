"""What `npa-envs stress` does: hard cases, what is expected of each, and where things break."""
