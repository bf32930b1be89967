"""MS-SSIM: how alike the structure of pictures is at several sizes (Wang et al. 2003)."""

from __future__ import annotations

import torch
from torch import Tensor

from npa_envs.errors import NPAError

WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
"""Powers of the sizes, from fine to coarse (Wang et al. 2003)."""

WINDOW = 11
"""Pixels along each side of the window, at most."""

SPREAD = 1.5
"""Standard deviation of a window of 11 pixels [pixels]; smaller ones keep the proportion."""

STEADIED = (0.01**2, 0.03**2)
"""What is added to products of means, and of deviations, of pictures in [0, 1]."""

FLOOR = 1e-4
"""Least similarity of a size: below it, where the power is steep, nothing is learned from it."""


class MultiScaleSimilarity:
    """MS-SSIM of pictures in [0, 1].

    Windows and halving are products with a matrix from both sides, which tens of pictures want at
    once, and similarities are multiplied as a sum of logarithms: the derivative of a product waits
    for the device, and is not finite where a size's similarity is 0.
    """

    def __init__(self, resolution: int, *, device: str | torch.device = "cpu") -> None:
        least = 2 ** len(WEIGHTS[1:])
        if resolution < least:
            raise NPAError(
                f"resolution must be at least {least} pixels for MS-SSIM, got {resolution}: raise "
                "it, or set ssim_weight to 0"
            )
        sizes = [resolution]
        for _ in WEIGHTS[1:]:
            sizes.append((sizes[-1] + 1) // 2)
        self._windows = [_window(size).float().to(device) for size in sizes]
        self._halvings = [_halving(size).to(device) for size in sizes[:-1]]

    def __call__(self, found: Tensor, wanted: Tensor) -> Tensor:
        """Return how alike pictures [..., R, R] of one channel are, at most 1, shape [...]."""
        total = found.new_zeros(found.shape[:-2])
        last = len(WEIGHTS) - 1
        for size, (weight, window) in enumerate(zip(WEIGHTS, self._windows, strict=True)):
            whole, contrast = _similarity(found, wanted, window.to(found))
            share = whole if size == last else contrast
            total = total + weight * share.clamp_min(FLOOR).log()
            if size < last:
                halving = self._halvings[size].to(found)
                found, wanted = _from_both_sides(found, halving), _from_both_sides(wanted, halving)
        return total.exp()


def _similarity(found: Tensor, wanted: Tensor, window: Tensor) -> tuple[Tensor, Tensor]:
    """Return SSIM of pictures at one size, and its factor of contrast and structure alone."""
    mean, square, product = _from_both_sides(
        torch.stack((found, found.square(), found * wanted)), window
    )
    goal, goal_square = _from_both_sides(torch.stack((wanted, wanted.square())), window)
    of_means, of_deviations = STEADIED
    together, apart = mean * goal, mean.square() + goal.square()
    spread = square + goal_square - apart
    contrast = (2.0 * (product - together) + of_deviations) / (spread + of_deviations)
    light = (2.0 * together + of_means) / (apart + of_means)
    return (light * contrast).mean(dim=(-2, -1)), contrast.mean(dim=(-2, -1))


def _from_both_sides(pictures: Tensor, matrix: Tensor) -> Tensor:
    """Return matrixᵀ picture matrix of each, turned over: rows are columns, as in all of them."""
    return (pictures @ matrix).mT @ matrix


def _window(size: int) -> Tensor:
    """Return the weights of a window's places along a side, [size, places], where it fits in."""
    width = min(WINDOW, size - 1 + size % 2)
    place = torch.arange(width, dtype=torch.float64) - width // 2
    weights = torch.exp(-0.5 * (place * (WINDOW / (SPREAD * width))) ** 2)
    matrix = torch.zeros(size, size - width + 1, dtype=torch.float64)
    for first in range(matrix.shape[1]):
        matrix[first : first + width, first] = weights / weights.sum()
    return matrix


def _halving(size: int) -> Tensor:
    """Return the weights of half as many pixels; an odd side begins with half a pixel, of 0."""
    half = (size + 1) // 2
    return 0.5 * torch.eye(half).repeat_interleave(2, dim=0)[size % 2 :]
