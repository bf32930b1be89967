"""Tasks: what to grow, from which initial worlds, and how far they are from the goal."""
