"""MS-SSIM: the similarity of pictures of worlds to a target at several sizes of the pictures."""

from __future__ import annotations

import torch
from torch import Tensor

from npa_envs.errors import NPAError

SIZE_EXPONENTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
"""Exponents of the five picture sizes' similarities, from fine to coarse (Wang et al. 2003)."""

WINDOW_SIDE = 11
"""Side of the window in which statistics are taken [pixels]; smaller in smaller pictures."""

WINDOW_SPREAD = 1.5
"""Standard deviation of the Gaussian window [pixels]; in proportion smaller in smaller windows."""

STABILISERS = (0.01**2, 0.03**2)
"""Constants C1 and C2 of SSIM for pictures in [0, 1]: they keep quotients finite."""

MIN_SIMILARITY = 1e-4
"""Least value of a size's similarity, to which smaller ones are raised, without gradient."""


class MultiScaleSimilarity:
    """MS-SSIM of pictures of R x R pixels in [0, 1]: a product of similarities at five sizes.

    Windowed means and smaller sizes are computed by matrix products, which are fast for tens of
    pictures. The product is computed by logarithms: the derivative of torch's product synchronises,
    and is not finite where a similarity is 0.
    """

    def __init__(self, resolution: int, *, device: str | torch.device = "cpu") -> None:
        least = 2 ** len(SIZE_EXPONENTS[1:])
        if resolution < least:
            raise NPAError(
                f"resolution must be at least {least} pixels for MS-SSIM, got {resolution}: raise "
                "it, or set ssim_weight to 0"
            )
        sizes = [resolution]
        for _ in SIZE_EXPONENTS[1:]:
            sizes.append((sizes[-1] + 1) // 2)
        self._windows = [_window_matrix(size).float().to(device) for size in sizes]
        self._halvings = [_halving_matrix(size).to(device) for size in sizes[:-1]]

    def __call__(self, pictures: Tensor, target: Tensor) -> Tensor:
        """Return the similarity to `target`, at most 1, of pictures [..., R, R]; shape [...]."""
        total = pictures.new_zeros(pictures.shape[:-2])
        last = len(SIZE_EXPONENTS) - 1
        for size, (weight, window) in enumerate(zip(SIZE_EXPONENTS, self._windows, strict=True)):
            whole, contrast = _similarity(pictures, target, window.to(pictures))
            factor = whole if size == last else contrast
            total = total + weight * factor.clamp_min(MIN_SIMILARITY).log()
            if size < last:
                halving = self._halvings[size].to(pictures)
                pictures = _from_both_sides(pictures, halving)
                target = _from_both_sides(target, halving)
        return total.exp()


def _similarity(pictures: Tensor, target: Tensor, window: Tensor) -> tuple[Tensor, Tensor]:
    """Return the SSIM at one size, and its part without brightness, shape [...] each."""
    mean, square, product = _from_both_sides(
        torch.stack((pictures, pictures.square(), pictures * target)), window
    )
    target_mean, target_square = _from_both_sides(torch.stack((target, target.square())), window)
    of_means, of_deviations = STABILISERS
    mixed, squares = mean * target_mean, mean.square() + target_mean.square()
    spread = square + target_square - squares
    contrast = (2.0 * (product - mixed) + of_deviations) / (spread + of_deviations)
    light = (2.0 * mixed + of_means) / (squares + of_means)
    return (light * contrast).mean(dim=(-2, -1)), contrast.mean(dim=(-2, -1))


def _from_both_sides(pictures: Tensor, matrix: Tensor) -> Tensor:
    """Return (matrixᵀ picture matrix)ᵀ for each picture."""
    return (pictures @ matrix).mT @ matrix


def _window_matrix(size: int) -> Tensor:
    """Return a matrix [size, positions]: a column has the window's weights at one position."""
    width = min(WINDOW_SIDE, size - 1 + size % 2)
    offset = torch.arange(width, dtype=torch.float64) - width // 2
    weights = torch.exp(-0.5 * (offset * (WINDOW_SIDE / (WINDOW_SPREAD * width))) ** 2)
    matrix = torch.zeros(size, size - width + 1, dtype=torch.float64)
    for first in range(matrix.shape[1]):
        matrix[first : first + width, first] = weights / weights.sum()
    return matrix


def _halving_matrix(size: int) -> Tensor:
    """Return the matrix [size, half] that averages pairs of pixels.

    Before an odd number of pixels it assumes a 0.
    """
    half = (size + 1) // 2
    return 0.5 * torch.eye(half).repeat_interleave(2, dim=0)[size % 2 :]
