"""Distances between pictures: by patches at several sizes, by their transport, MS-SSIM."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.ops import world_mean

LEVELS = 4
"""Largest number of image sizes, each half of the one before."""

MIN_SIDE = 12
"""Least side of the smallest image size [pixels]."""

POSITIONS = 64
"""Largest number of positions along each side that are compared; larger images are subsampled."""

ALIGNMENT = 64
"""Alignment of the matrices that are multiplied [bytes]."""


@dataclass(frozen=True)
class LossOptions:
    """Options of a texture loss."""

    tiles: bool = True
    """Whether the target's opposite edges fit together, so that patches may cross them."""

    seed: int = 0
    """Seed of the loss's directions, filters and positions."""

    vgg_weights: str = ""
    """File of VGG16's weights, for `vgg_ot`; empty: torch's usual folder of downloads."""


class TextureDistance:
    """Base class of distances between images and a target of K channels, shape [K, R, R]."""

    same_in_every_batch: bool = False
    """Whether `compare` returns the same for an image, bit for bit, in every batch."""

    def __init__(self, target: Tensor) -> None:
        if target.shape[-1] < MIN_SIDE:
            raise NPAError(
                f"resolution must be at least {MIN_SIDE} pixels, got {target.shape[-1]}: for "
                "example 64"
            )
        self._shape = tuple(target.shape)

    def __call__(self, images: Tensor) -> Tensor:
        """Return the distance of images [B, K, R, R] from the target (dimensionless), [B].

        It is differentiable. Without gradient it is the same, bit for bit, in every batch.
        """
        if images.ndim != 4 or tuple(images.shape[1:]) != self._shape:
            raise NPAError(
                f"images must have shape [B, K, R, R] with (K, R, R) = {self._shape} as the "
                f"target, got {tuple(images.shape)}: draw them at the target's resolution"
            )
        with_gradient = torch.is_grad_enabled() and images.requires_grad
        if len(images) == 1 or with_gradient or self.same_in_every_batch:
            return self.compare(images)
        return torch.cat([self.compare(image[None]) for image in images])

    def compare(self, images: Tensor) -> Tensor:
        """Return the distance of images [B, K, R, R] from the target, [B]."""
        raise NotImplementedError


def level_count(resolution: int) -> int:
    """Return at how many sizes images of a resolution [pixels] are compared."""
    count = 1
    while count < LEVELS and resolution % 2 == 0 and resolution // 2 >= MIN_SIDE:
        resolution //= 2
        count += 1
    return count


def pyramid(images: Tensor, count: int) -> list[Tensor]:
    """Return images [B, K, R, R] and `count` - 1 smaller sizes, each by means of 2 x 2 pixels."""
    levels = [images]
    while len(levels) < count:
        fine = levels[-1]
        # Written out: the order of additions is fixed, whatever the size of the batch.
        rows = fine[:, :, ::2] + fine[:, :, 1::2]
        levels.append(0.25 * (rows[..., ::2] + rows[..., 1::2]))
    return levels


def stride_of(level: Tensor, thinned: bool) -> int:
    """Return the distance [pixels] between an image's compared positions; 1 unless `thinned`."""
    return max(1, level.shape[-1] // POSITIONS) if thinned else 1


def patches(images: Tensor, size: int, *, stride: int, wrap: bool) -> Tensor:
    """Return the M square patches of images, [B, M, K size²]; `wrap`: over opposite edges."""
    if wrap:
        half = size // 2
        images = torch.cat((images[:, :, -half:], images, images[:, :, :half]), dim=2)
        images = torch.cat((images[..., -half:], images, images[..., :half]), dim=3)
    windows = images.unfold(2, size, stride).unfold(3, size, stride)
    return windows.permute(0, 2, 3, 1, 4, 5).flatten(3).flatten(1, 2)


def products(rows: Tensor, weights: Tensor) -> Tensor:
    """Return the matrix product of rows [B, M, E] and weights [E, F], shape [B, M, F].

    It is computed image by image, from aligned memory: otherwise rounding may depend on the batch.
    Rows must be contiguous.
    """
    weights = weights.to(rows)
    tables = [one if one.data_ptr() % ALIGNMENT == 0 else one.clone() for one in rows]
    return torch.stack([table @ weights for table in tables])


def orthogonal(size: int, count: int, generator: torch.Generator) -> Tensor:
    """Return `count` random orthonormal columns, shape [size, count]."""
    normal = torch.randn(size, count, generator=generator, dtype=torch.float64)
    basis: Tensor = torch.linalg.qr(normal).Q
    return basis


def quantiles(values: Tensor, count: int) -> Tensor:
    """Return evenly spaced quantiles of each row of values [F, M], rising, shape [F, count]."""
    ordered = values.sort(dim=1).values
    total = ordered.shape[1]
    if total == count:
        return ordered
    position = (torch.arange(count, dtype=values.dtype, device=values.device) + 0.5) / count
    position = (position * total - 0.5).clamp(0.0, total - 1.0)
    low = position.floor().long()
    part = position - low
    return ordered[:, low] * (1.0 - part) + ordered[:, (low + 1).clamp(max=total - 1)] * part


MATCHED_PATCH = 7
"""Side of a matched patch [pixels]; at the smallest of four sizes it spans 56 image pixels."""

WORLD_POSITIONS = 32
"""Largest number of patches of a world along each side, for each size."""

TARGET_POSITIONS = 64
"""Largest number of patches of the target along each side, for each size."""

EVEN = 0.01
"""Added to the target's variance, so that a uniform target works too."""


class PatchTransport(TextureDistance):
    """Relaxed optimal transport of raw patches at several sizes.

    At each size every patch of a world is compared with the nearest patch of the target, and every
    patch of the target with the nearest of the world. The larger of both mean squared distances,
    relative to the target's variance, is averaged over the sizes: it penalises both additional and
    missing parts. After the relaxed transport of Kolkin, Salavon and Shakhnarovich (2019), with
    patches in place of a network's features.
    """

    def __init__(self, target: Tensor, options: LossOptions) -> None:
        super().__init__(target)
        self._expected = []
        self._scales = []
        for level in pyramid(target[None], level_count(target.shape[-1])):
            stride = -(-level.shape[-1] // TARGET_POSITIONS)
            rows = patches(level, MATCHED_PATCH, stride=stride, wrap=options.tiles)[0].contiguous()
            spread = (rows.double() - rows.double().mean(0)).square().mean()
            self._expected.append(rows)
            self._scales.append(1.0 / (spread + EVEN))

    def compare(self, images: Tensor) -> Tensor:
        """Return the distance of images [B, K, R, R] from the target, [B]."""
        total = images.new_zeros(len(images))
        levels = pyramid(images, len(self._expected))
        for level, expected, scale in zip(levels, self._expected, self._scales, strict=True):
            stride = -(-level.shape[-1] // WORLD_POSITIONS)
            rows = patches(level, MATCHED_PATCH, stride=stride, wrap=True)
            total = total + scale.to(total) * _matched(rows, expected.to(rows))
        return total / len(self._expected)


def _matched(rows: Tensor, expected: Tensor) -> Tensor:
    """Return the mean squared distance to the nearest patch, the larger of both directions, [B]."""
    with torch.no_grad():
        squares = rows.square().sum(2)[:, :, None] + expected.square().sum(1)
        costs = squares - 2.0 * (rows @ expected.T)
        there, back = costs.argmin(2), costs.argmin(1)
        # The target patches to which each patch of a world is nearest: their number and sum.
        chosen = (back[:, None] == torch.arange(rows.shape[1], device=rows.device)[:, None]).to(
            rows
        )
        times, sums = chosen.sum(2, keepdim=True), chosen @ expected
        rest = expected.square().mean()
    forward = (rows - expected[there]).square()
    # Σ (p − t)² over the target's patches, gathered by the world's: its gradient has a fixed order.
    ratio = rows.shape[1] / expected.shape[0]
    backward = ratio * (times * rows.square() - 2.0 * rows * sums)
    both = [world_mean(part.flatten(1)[..., None])[:, 0] for part in (forward, backward)]
    return torch.maximum(both[0], both[1] + rest)


# MS-SSIM: structural similarity at several sizes (Wang et al. 2003).

WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
"""Exponents of the sizes, from fine to coarse (Wang et al. 2003)."""

WINDOW = 11
"""Largest side of the window [pixels]."""

SPREAD = 1.5
"""Standard deviation of a window of 11 pixels [pixels]; proportional for smaller windows."""

STABILISERS = (0.01**2, 0.03**2)
"""SSIM's constants C1 and C2 for pictures in [0, 1]."""

FLOOR = 1e-4
"""Least similarity of a size; below it the gradient is 0."""


class MultiScaleSimilarity:
    """MS-SSIM of pictures in [0, 1].

    Windowed means and smaller sizes are computed by matrix products, which are fast for tens of
    pictures. Logarithms of similarities are added up: the derivative of torch's product
    synchronises, and is not finite where a similarity is 0.
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

    def __call__(self, pictures: Tensor, target: Tensor) -> Tensor:
        """Return the similarity of pictures [..., R, R] of one channel, at most 1, shape [...]."""
        total = pictures.new_zeros(pictures.shape[:-2])
        last = len(WEIGHTS) - 1
        for size, (weight, window) in enumerate(zip(WEIGHTS, self._windows, strict=True)):
            whole, contrast = _similarity(pictures, target, window.to(pictures))
            factor = whole if size == last else contrast
            total = total + weight * factor.clamp_min(FLOOR).log()
            if size < last:
                halving = self._halvings[size].to(pictures)
                pictures = _from_both_sides(pictures, halving)
                target = _from_both_sides(target, halving)
        return total.exp()


def _similarity(pictures: Tensor, target: Tensor, window: Tensor) -> tuple[Tensor, Tensor]:
    """Return the SSIM at one size, and its factor of contrast and structure, [...] each."""
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


def _window(size: int) -> Tensor:
    """Return the weights of pixels in the window at each position along a side, in columns."""
    width = min(WINDOW, size - 1 + size % 2)
    offset = torch.arange(width, dtype=torch.float64) - width // 2
    weights = torch.exp(-0.5 * (offset * (WINDOW / (SPREAD * width))) ** 2)
    matrix = torch.zeros(size, size - width + 1, dtype=torch.float64)
    for first in range(matrix.shape[1]):
        matrix[first : first + width, first] = weights / weights.sum()
    return matrix


def _halving(size: int) -> Tensor:
    """Return the matrix that averages pairs of pixels; an odd side is padded with a 0 in front."""
    half = (size + 1) // 2
    return 0.5 * torch.eye(half).repeat_interleave(2, dim=0)[size % 2 :]
