"""Halos of one world cut into slabs: particles that neighbouring slabs would send each other.

    python benchmarks/halos.py > benchmarks/results/halos.txt

Worlds are drawn: particles uniform in a square, a disk or a cube, with ε such that one inside has k
neighbours. Cuts across the first axis leave slabs of equal numbers of particles. A step sends, to
both sides of each cut, the particles within ε of it: positions and states of 16 channels, and then
the volumes 1/ρ. The formula is that of docs/scale.md for one side of one cut.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

CHANNELS = 16
LINK = 450e9
"""Bytes a second in one direction between two H200 (NVLink 4, as the maker says)."""


def main() -> None:
    """Print a row for each world and number of slabs."""
    print(f"{'shape':6} {'N':>11} {'k':>4} {'slabs':>5} {'ε/width':>8} {'halo a cut':>10} ", end="")
    print(f"{'formula':>8} {'share':>7} {'MB a cut':>8} {'µs':>6}")
    for shape, dims, k in (("square", 2, 66), ("disk", 2, 66), ("cube", 3, 100)):
        for count in (4096, 10**6, 10**7, 10**8):
            for slabs in (2, 8):
                print(row(shape, dims, k, count, slabs), flush=True)


def row(shape: str, dims: int, k: int, count: int, slabs: int) -> str:
    """Return what is sent where a world is cut."""
    generator = np.random.default_rng(0)
    along = first_axis(shape, count, generator)
    ball, volume = (math.pi, math.pi / 4) if dims == 2 else (4 * math.pi / 3, 1.0)
    volume = volume if shape == "disk" else 1.0
    # In units of the width: ball ε^D N / volume = k.
    eps = (k * volume / (ball * count)) ** (1.0 / dims)
    cuts = np.quantile(along, np.arange(1, slabs) / slabs)
    sides = [((along >= cut - eps) & (along < cut)).sum() for cut in cuts]
    sides += [((along >= cut) & (along < cut + eps)).sum() for cut in cuts]
    halo = float(np.mean(sides))
    # The middle cut is as long as the world is wide.
    formula = count * eps / volume
    sent = halo * 4 * (dims + CHANNELS + 1)
    return (
        f"{shape:6} {count:>11,} {k:>4} {slabs:>5} {eps:>8.5f} {halo:>10,.0f} {formula:>8,.0f} "
        f"{2 * len(cuts) * halo / count:>7.2%} {sent / 1e6:>8.2f} {sent / LINK * 1e6:>6.1f}"
    )


def first_axis(shape: str, count: int, generator: np.random.Generator) -> NDArray[np.float32]:
    """Return first coordinates of particles uniform in a shape of width 1."""
    if shape != "disk":
        return generator.random(count, dtype=np.float32)
    radius = 0.5 * np.sqrt(generator.random(count, dtype=np.float32))
    angle = np.float32(2.0 * math.pi) * generator.random(count, dtype=np.float32)
    return radius * np.cos(angle) + np.float32(0.5)


if __name__ == "__main__":
    main()
