"""What `npa-envs robustness` measures: how well rules bear other worlds, and heal damage."""
