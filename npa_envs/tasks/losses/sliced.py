"""Sliced Wasserstein distances between textures: raw patches, or random filters, at several sizes.

A texture is described, size after size, by many numbers at each place. Two textures are alike where
each of these numbers is distributed alike over the places: sorted, they are compared one by one.
"""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.ops import world_mean

PATCH = 5
"""Pixels along each side of a patch."""

LEVELS = 4
"""Sizes at most, each half of the one before."""

SMALLEST = 12
"""Pixels along each side of the smallest size at least."""

PLACES = 64
"""Places along each side that are compared at most; at finer sizes some pixels are left out."""

FILTERS = 24
"""Random filters of the first layer; each gives two features, above zero and below."""

SECOND_PATCH = 3
"""Features along each side that a filter of the second layer sees."""

FLOOR = 0.01
"""Variance that is added to the target's, so that an even target can be compared with, too."""


ALIGNMENT = 64
"""Bytes that a table's address is a multiple of."""


class Descriptor(Protocol):
    """What numbers describe images."""

    def __call__(self, images: Tensor, *, wrap: bool, thinned: bool) -> list[Tensor]:
        """Return the numbers at each place of images, a table for each size, [B, M, F] each.

        Args:
            images: The images, shape [B, K, R, R].
            wrap: Whether their opposite edges meet; otherwise places near them are left out.
            thinned: Whether at most `PLACES` along each side are enough.
        """


class SlicedWasserstein:
    """The distance of images from a target; satisfies `TextureLoss`.

    For each size it is the mean over the numbers of the squared 2-Wasserstein distance between
    their distributions, relative to the target's own variance; the sizes' are added.

    Args:
        target: The texture (dimensionless), shape [K, R, R].
        descriptor: What is compared.
        tiles: Whether the target's opposite edges meet.

    Raises:
        NPAError: The target is too small.
    """

    def __init__(self, target: Tensor, descriptor: Descriptor, *, tiles: bool) -> None:
        _, height, _ = target.shape
        if height < SMALLEST:
            raise NPAError(
                f"resolution must be at least {SMALLEST} pixels, got {height}: for example 64"
            )
        self._descriptor = descriptor
        self._shape = tuple(target.shape)
        with torch.no_grad():
            # The worlds' own number of places decides how finely the target's are resolved.
            thinned = descriptor(target[None], wrap=True, thinned=True)
            described = descriptor(target[None].double(), wrap=tiles, thinned=False)
            self._quantiles = [
                quantiles(numbers[0].T, found.shape[1]).to(target)
                for numbers, found in zip(described, thinned, strict=True)
            ]
            self._scales = [1.0 / (numbers[0].var(0).mean() + FLOOR) for numbers in described]

    def __call__(self, images: Tensor) -> Tensor:
        """Return the distance of each image (dimensionless), shape [B]; differentiable.

        Args:
            images: Pictures that tile (dimensionless), shape [B, K, R, R].

        Raises:
            NPAError: They have another shape than the target.
        """
        check_images(images, self._shape)
        described = self._descriptor(images, wrap=True, thinned=True)
        total = images.new_zeros(len(images))
        for numbers, expected, scale in zip(described, self._quantiles, self._scales, strict=True):
            ordered = numbers.transpose(1, 2).contiguous().sort(dim=-1).values
            squares = (ordered - expected.to(ordered)).square()
            distance = world_mean(squares.flatten(1)[..., None])[:, 0]
            total = total + scale.to(distance) * distance
        return total


class PatchDescriptor:
    """Square patches of all channels, seen from random directions.

    There are as many directions as a patch has numbers, at right angles to each other.

    Args:
        like: An image of the shape that is to be described, [K, R, R], on the device.
        seed: What the directions are drawn from.
    """

    def __init__(self, like: Tensor, *, seed: int) -> None:
        generator = torch.Generator().manual_seed(seed)
        size = like.shape[0] * PATCH * PATCH
        self._directions = [
            orthogonal(size, size, generator).to(like) for _ in range(level_count(like.shape[-1]))
        ]

    def __call__(self, images: Tensor, *, wrap: bool, thinned: bool) -> list[Tensor]:
        """Return the patches' coordinates, [B, M, K PATCH²] for each size."""
        sizes = pyramid(images, len(self._directions))
        return [
            products(patches(level, PATCH, stride=stride_of(level, thinned), wrap=wrap), direction)
            for level, direction in zip(sizes, self._directions, strict=True)
        ]


class FilterDescriptor:
    """Two layers of random filters with rectifiers between them: edges, spots and their corners.

    The filters of the first layer sum to zero, but for one for each channel that averages; those of
    the second see its features from random directions.

    Args:
        like: An image of the shape that is to be described, [K, R, R], on the device.
        seed: What the filters are drawn from.
    """

    def __init__(self, like: Tensor, *, seed: int) -> None:
        generator = torch.Generator().manual_seed(seed)
        channels, area = like.shape[0], PATCH * PATCH
        self._levels: list[tuple[Tensor, Tensor]] = []
        for _ in range(level_count(like.shape[-1])):
            first = torch.randn(channels * area, FILTERS, generator=generator, dtype=torch.float64)
            first -= first.mean(0)
            first /= first.norm(dim=0)
            means = torch.eye(channels, dtype=torch.float64).repeat_interleave(area, 0) / PATCH
            first[:, :channels] = means
            second = orthogonal(2 * FILTERS * SECOND_PATCH**2, 2 * FILTERS, generator)
            self._levels.append((first.to(like), second.to(like)))

    def __call__(self, images: Tensor, *, wrap: bool, thinned: bool) -> list[Tensor]:
        """Return the features of both layers, [B, M, 2 FILTERS] for each size and layer."""
        result = []
        for level, (first, second) in zip(
            pyramid(images, len(self._levels)), self._levels, strict=True
        ):
            signed = products(patches(level, PATCH, stride=1, wrap=wrap), first)
            features = torch.cat((signed, -signed), dim=2).relu()
            side = level.shape[-1] - (0 if wrap else PATCH - 1)
            field = features.transpose(1, 2).reshape(len(images), -1, side, side)
            stride = stride_of(level, thinned)
            result.append(field[:, :, ::stride, ::stride].flatten(2).transpose(1, 2))
            seen = patches(field, SECOND_PATCH, stride=stride, wrap=wrap)
            result.append(products(seen, second))
        return result


def check_images(images: Tensor, shape: tuple[int, ...]) -> None:
    """Check that images have the target's shape.

    Args:
        images: What is compared.
        shape: The target's shape, (K, R, R).

    Raises:
        NPAError: They do not.
    """
    if images.ndim != 4 or tuple(images.shape[1:]) != shape:
        raise NPAError(
            f"images must have shape [B, K, R, R] with (K, R, R) = {shape} as the target, got "
            f"{tuple(images.shape)}: draw them at the target's resolution"
        )


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
        images: The images, shape [B, K, R, R].
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
        weights: Shape [E, F].
    """
    weights = weights.to(rows)
    tables = [one if one.data_ptr() % ALIGNMENT == 0 else one.clone() for one in rows]
    return torch.stack([table @ weights for table in tables])


def orthogonal(size: int, count: int, generator: torch.Generator) -> Tensor:
    """Return `count` directions at right angles to each other as columns, shape [size, count].

    Args:
        size: Numbers in each, at least `count`.
        count: Directions.
        generator: What they are drawn from, on the CPU.
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
