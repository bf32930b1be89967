"""How good trained rules are, in numbers."""
