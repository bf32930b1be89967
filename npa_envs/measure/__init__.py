"""Measurements and their records: speed, accuracy, robustness, quality, interaction."""
