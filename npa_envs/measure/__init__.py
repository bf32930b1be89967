"""What is measured, and what is kept of it: speed, accuracy, robustness, quality, interaction."""
