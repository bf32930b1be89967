"""Tasks: what to grow, from which seed, and how far it is from the goal."""
