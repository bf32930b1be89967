"""Worlds in time: rollouts, several species, actions from outside, divergence, random streams."""
