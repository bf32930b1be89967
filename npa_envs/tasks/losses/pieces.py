"""What texture losses are made of: sizes, patches, directions, quantiles, transport, moments."""

from __future__ import annotations

import torch
from torch import Tensor

from npa_envs.errors import NPAError

LEVELS = 4
"""Sizes at most, each half of the one before."""

SMALLEST = 12
"""Pixels along each side of the smallest size at least."""

PLACES = 64
"""Places along each side that are compared at most; at finer sizes some pixels are left out."""

ALIGNMENT = 64
"""Bytes that a table's address is a multiple of."""

TINY_SQUARE = 1e-12
"""Squared length of a feature vector below which it counts as no direction."""


def check_images(images: Tensor, shape: tuple[int, ...]) -> None:
    """Check that images have the target's shape.

    Args:
        shape: The target's shape, (K, R, R).
    """
    if images.ndim != 4 or tuple(images.shape[1:]) != shape:
        raise NPAError(
            f"images must have shape [B, K, R, R] with (K, R, R) = {shape} as the target, got "
            f"{tuple(images.shape)}: draw them at the target's resolution"
        )


def check_size(target: Tensor) -> None:
    """Check that a target, [K, R, R], is large enough to be looked at."""
    if target.shape[-1] < SMALLEST:
        raise NPAError(
            f"resolution must be at least {SMALLEST} pixels, got {target.shape[-1]}: for example 64"
        )


class TextureDistance:
    """The distance of images from a target; satisfies `TextureLoss`."""

    def __init__(self, target: Tensor) -> None:
        self._shape = tuple(target.shape)

    def __call__(self, images: Tensor) -> Tensor:
        """Return the distance of each image (dimensionless), shape [B]; differentiable.

        Without gradient images are compared one by one, so that no image depends on the others.
        """
        check_images(images, self._shape)
        if len(images) > 1 and not (torch.is_grad_enabled() and images.requires_grad):
            return torch.cat([self.compare(image[None]) for image in images])
        return self.compare(images)

    def compare(self, images: Tensor) -> Tensor:
        """Return the distance of each of some checked images, [B]."""
        raise NotImplementedError


def level_count(resolution: int) -> int:
    """Return how many sizes an image is looked at in."""
    count = 1
    while count < LEVELS and resolution % 2 == 0 and resolution // 2 >= SMALLEST:
        resolution //= 2
        count += 1
    return count


def pyramid(images: Tensor, count: int) -> list[Tensor]:
    """Return images [B, K, R, R] and `count` - 1 smaller ones, each of means of 2 x 2 pixels."""
    levels = [images]
    while len(levels) < count:
        fine = levels[-1]
        # Written out: each sum has an order of its own, whatever the size of the batch.
        rows = fine[:, :, ::2] + fine[:, :, 1::2]
        levels.append(0.25 * (rows[..., ::2] + rows[..., 1::2]))
    return levels


def stride_of(level: Tensor, thinned: bool) -> int:
    """Return how many pixels lie between places."""
    return max(1, level.shape[-1] // PLACES) if thinned else 1


def patches(images: Tensor, size: int, *, stride: int, wrap: bool) -> Tensor:
    """Return the square patches of images as rows, shape [B, M, K size²].

    Args:
        size: Pixels along each side, odd.
        stride: Pixels from one patch to the next.
        wrap: Whether patches reach across the edges; otherwise M is smaller.
    """
    if wrap:
        reach = size // 2
        images = torch.cat((images[:, :, -reach:], images, images[:, :, :reach]), dim=2)
        images = torch.cat((images[..., -reach:], images, images[..., :reach]), dim=3)
    windows = images.unfold(2, size, stride).unfold(3, size, stride)
    return windows.permute(0, 2, 3, 1, 4, 5).flatten(3).flatten(1, 2)


def products(rows: Tensor, weights: Tensor) -> Tensor:
    """Return the rows of each image times weights, shape [B, M, F].

    Image by image: the product of a whole batch may round otherwise than that of one image, and so
    may that of numbers that lie otherwise in memory.

    Args:
        rows: Contiguous rows, shape [B, M, E].
    """
    weights = weights.to(rows)
    tables = [one if one.data_ptr() % ALIGNMENT == 0 else one.clone() for one in rows]
    return torch.stack([table @ weights for table in tables])


def orthogonal(size: int, count: int, generator: torch.Generator) -> Tensor:
    """Return `count` directions at right angles to each other as columns, shape [size, count].

    Args:
        size: Numbers in each, at least `count`.
        count: Directions.
    """
    normal = torch.randn(size, count, generator=generator, dtype=torch.float64)
    basis: Tensor = torch.linalg.qr(normal).Q
    return basis


def quantiles(values: Tensor, count: int) -> Tensor:
    """Return `count` evenly spread quantiles of each row, sorted; the values themselves where fit.

    Args:
        values: Numbers, shape [F, M].
        count: Quantiles, in the middles of `count` equal shares of probability.
    """
    ordered = values.sort(dim=1).values
    total = ordered.shape[1]
    if total == count:
        return ordered
    place = (torch.arange(count, dtype=values.dtype, device=values.device) + 0.5) / count
    place = (place * total - 0.5).clamp(0.0, total - 1.0)
    low = place.floor().long()
    share = place - low
    return ordered[:, low] * (1.0 - share) + ordered[:, (low + 1).clamp(max=total - 1)] * share


def relaxed_transport(first: Tensor, second: Tensor) -> Tensor:
    """Return the relaxed earth mover's distance of rows under the cosine distance, shape [B].

    Either side may send all to the nearest of the other; the larger of both costs is taken, each
    a lower bound of the cost of transport.
    """
    costs = 1.0 - _directions(first) @ _directions(second).transpose(1, 2)
    there, back = costs.amin(dim=2).mean(dim=1), costs.amin(dim=1).mean(dim=1)
    return torch.maximum(there, back)


def moment_distance(first: Tensor, second: Tensor) -> Tensor:
    """Return the mean absolute differences of means and of covariances, added, shape [B]."""
    (mean, covariance), (other_mean, other_covariance) = _moments(first), _moments(second)
    difference = (mean - other_mean).abs().mean(dim=(1, 2))
    return difference + (covariance - other_covariance).abs().mean(dim=(1, 2))


def _directions(rows: Tensor) -> Tensor:
    return rows * (rows.square().sum(dim=-1, keepdim=True) + TINY_SQUARE).rsqrt()


def _moments(rows: Tensor) -> tuple[Tensor, Tensor]:
    mean = rows.mean(dim=1, keepdim=True)
    centred = rows - mean
    return mean, centred.transpose(1, 2) @ centred / (rows.shape[1] - 1)
