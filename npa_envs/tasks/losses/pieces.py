"""What losses of pictures are made of: patches, features, transport, structure."""

from __future__ import annotations

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.ops import world_mean

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
    """Check that images have the target's shape, (K, R, R)."""
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
    """Return the square patches of images as rows, [B, M, K size²]; `wrap`: also across edges."""
    if wrap:
        reach = size // 2
        images = torch.cat((images[:, :, -reach:], images, images[:, :, :reach]), dim=2)
        images = torch.cat((images[..., -reach:], images, images[..., :reach]), dim=3)
    windows = images.unfold(2, size, stride).unfold(3, size, stride)
    return windows.permute(0, 2, 3, 1, 4, 5).flatten(3).flatten(1, 2)


def products(rows: Tensor, weights: Tensor) -> Tensor:
    """Return the rows of each image times weights, shape [B, M, F].

    Image by image: the product of a whole batch may round otherwise than that of one image, and so
    may that of numbers that lie otherwise in memory. Rows [B, M, E] are contiguous.
    """
    weights = weights.to(rows)
    tables = [one if one.data_ptr() % ALIGNMENT == 0 else one.clone() for one in rows]
    return torch.stack([table @ weights for table in tables])


def orthogonal(size: int, count: int, generator: torch.Generator) -> Tensor:
    """Return `count` directions at right angles to each other as columns, shape [size, count]."""
    normal = torch.randn(size, count, generator=generator, dtype=torch.float64)
    basis: Tensor = torch.linalg.qr(normal).Q
    return basis


def quantiles(values: Tensor, count: int) -> Tensor:
    """Return `count` evenly spread quantiles of each row of values [F, M], sorted."""
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


# Losses that see shapes: patches matched with patches, and features with features. They compare all
# channels of an image at once, so that what lies inside of what counts, too.

MATCHED_PATCH = 7
"""Pixels along each side of a patch that is matched: at four sizes 7 to 56 of the image's."""

MATCHED_PLACES = 32
"""Places along each side that patches of worlds are taken at, at most, for each size."""

TARGET_PLACES = 64
"""Places along each side of the target that they may be matched with, at most."""

EVEN = 0.01
"""Variance that is added to the target's, so that an even target can be compared with, too."""


class PatchTransport(TextureDistance):
    """Relaxed optimal transport of raw patches at several sizes; satisfies `TextureLoss`.

    At each size every patch of a world has a nearest patch of the target, and every one of the
    target a nearest one of the world. The larger of both mean squared distances counts, relative to
    the target's variance; the sizes' are averaged. So nothing may be there that the target does not
    have, and nothing may be missing. After the relaxed transport of Kolkin, Salavon and
    Shakhnarovich (2019), with patches in place of a network's features.
    """

    def __init__(self, target: Tensor, *, tiles: bool) -> None:
        check_size(target)
        super().__init__(target)
        self._expected = []
        self._scales = []
        for level in pyramid(target[None], level_count(target.shape[-1])):
            stride = -(-level.shape[-1] // TARGET_PLACES)
            rows = patches(level, MATCHED_PATCH, stride=stride, wrap=tiles)[0].contiguous()
            spread = (rows.double() - rows.double().mean(0)).square().mean()
            self._expected.append(rows)
            self._scales.append(1.0 / (spread + EVEN))

    def compare(self, images: Tensor) -> Tensor:
        """Return the distance of each of some checked images, [B]."""
        total = images.new_zeros(len(images))
        levels = pyramid(images, len(self._expected))
        for level, expected, scale in zip(levels, self._expected, self._scales, strict=True):
            stride = -(-level.shape[-1] // MATCHED_PLACES)
            found = patches(level, MATCHED_PATCH, stride=stride, wrap=True)
            total = total + scale.to(total) * _matched(found, expected.to(found))
        return total / len(self._expected)


def _matched(found: Tensor, expected: Tensor) -> Tensor:
    """Return the larger of two mean squares, of patches and of their nearest ones; shape [B]."""
    with torch.no_grad():
        squares = found.square().sum(2)[:, :, None] + expected.square().sum(1)
        costs = squares - 2.0 * (found @ expected.T)
        there, back = costs.argmin(2), costs.argmin(1)
        # What each patch of a world is nearest to, in all: how many, and their sum.
        chosen = (back[:, None] == torch.arange(found.shape[1], device=found.device)[:, None]).to(
            found
        )
        times, sums = chosen.sum(2, keepdim=True), chosen @ expected
        rest = expected.square().mean()
    forward = (found - expected[there]).square()
    # Σ (p − t)² over the target's patches, gathered by the world's: its slope has a fixed order.
    share = found.shape[1] / expected.shape[0]
    backward = share * (times * found.square() - 2.0 * found * sums)
    both = [world_mean(part.flatten(1)[..., None])[:, 0] for part in (forward, backward)]
    return torch.maximum(both[0], both[1] + rest)


FILTER_SIZES = (3, 5, 7, 11, 15, 23, 37, 55)
"""Pixels along each side of random filters, of an image of 128 pixels."""

FILTERS = 32
"""Random filters of each size."""

REFERENCE = 128
"""Pixels along each side of the images that `FILTER_SIZES` refers to."""


class RandomFilters:
    """The image and one layer of random filters of many sizes, rectified.

    After Ustyuzhaninov, Brendel, Gatys and Bethge, arXiv 1606.00021.
    """

    def __init__(self, like: Tensor, *, seed: int) -> None:
        channels, side, _ = like.shape
        generator = torch.Generator().manual_seed(seed)
        banks = []
        for size in FILTER_SIZES:
            reach = min(side, max(2, round(size * side / REFERENCE)))
            drawn = torch.randn(FILTERS, channels, reach, reach, generator=generator)
            drawn -= drawn.mean(dim=(2, 3), keepdim=True)
            bank = torch.zeros(FILTERS, channels, side, side)
            bank[..., :reach, :reach] = drawn / drawn.flatten(1).norm(dim=1)[:, None, None, None]
            banks.append(bank)
        self._reach = reach
        self.filter_waves = torch.fft.rfft2(torch.cat(banks).to(like)).conj()
        """The filters' conjugate Fourier transforms."""

    def __call__(self, images: Tensor, *, wrap: bool) -> Tensor:
        """Return channels and rectified answers at every second place; `wrap`: edges meet."""
        waves = torch.fft.rfft2(images)
        answers = torch.einsum("bkrc,fkrc->bfrc", waves, self.filter_waves.to(waves))
        fields = torch.fft.irfft2(answers, s=images.shape[-2:]).relu()
        found = torch.cat((images, fields), dim=1)
        inside = images.shape[-1] - (0 if wrap else self._reach - 1)
        return found[..., :inside:2, :inside:2]


class FeatureTransport(TextureDistance):
    """Relaxed optimal transport of features and their moments; satisfies `TextureLoss`.

    As `vgg_ot` (Kolkin, Salavon and Shakhnarovich 2019), of features that need no weights.
    """

    def __init__(self, target: Tensor, features: RandomFilters, *, tiles: bool) -> None:
        check_size(target)
        super().__init__(target)
        self._features = features
        self._expected = self._rows(features(target[None], wrap=tiles))

    def compare(self, images: Tensor) -> Tensor:
        """Return the distance of each of some checked images, [B]."""
        found = self._rows(self._features(images, wrap=True))
        expected = self._expected.to(found)
        return relaxed_transport(found, expected) + moment_distance(found, expected)

    @staticmethod
    def _rows(field: Tensor) -> Tensor:
        stride = -(-field.shape[-1] // MATCHED_PLACES)
        return field[..., ::stride, ::stride].flatten(2).transpose(1, 2)


# MS-SSIM: how alike the structure of pictures is at several sizes (Wang et al. 2003).

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
