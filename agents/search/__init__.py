"""Search for rules that nobody asked for: quality-diversity over rules and pairs of species."""
