"""Texture losses that see shapes: patches matched with patches, and how features go together.

They compare all channels of an image at once, so that what lies inside of what counts, too.
"""

from __future__ import annotations

import math
from typing import Protocol

import torch
from torch import Tensor

from npa_envs.ops import world_mean
from npa_envs.tasks.losses.pieces import (
    TextureDistance,
    check_size,
    level_count,
    moment_distance,
    patches,
    pyramid,
    relaxed_transport,
)

MATCHED_PATCH = 7
"""Pixels along each side of a patch that is matched: at four sizes 7 to 56 of the image's."""

PLACES = 32
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

    Args:
        target: The texture (dimensionless), shape [K, R, R].
        tiles: Whether the target's opposite edges meet.

    Raises:
        NPAError: The target is too small.
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
            stride = -(-level.shape[-1] // PLACES)
            found = patches(level, MATCHED_PATCH, stride=stride, wrap=True)
            total = total + scale.to(total) * _matched(found, expected.to(found))
        return total / len(self._expected)


def _matched(found: Tensor, expected: Tensor) -> Tensor:
    """Return the larger of two mean squares, of patches and of their nearest ones; shape [B].

    Args:
        found: Patches of worlds, shape [B, M, F].
        expected: Patches of the target, shape [L, F].
    """
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


class Features(Protocol):
    """Numbers at each place of images."""

    def __call__(self, images: Tensor, *, wrap: bool) -> Tensor:
        """Return the fields of images [B, K, R, R], shape [B, F, H, W].

        Args:
            images: The images.
            wrap: Whether their opposite edges meet; otherwise places near them are left out.
        """


FILTER_SIZES = (3, 5, 7, 11, 15, 23, 37, 55)
"""Pixels along each side of random filters, of an image of 128 pixels."""

FILTERS = 32
"""Random filters of each size."""

REFERENCE = 128
"""Pixels along each side that filters' sizes are told for."""


class RandomFilters:
    """The image and one layer of random filters of many sizes, rectified.

    After Ustyuzhaninov, Brendel, Gatys and Bethge, arXiv 1606.00021.

    Args:
        like: An image of the shape that is to be described, [K, R, R], on the device.
        seed: What the filters are drawn from.
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
        """Return the image's channels and the rectified answers at every second place."""
        waves = torch.fft.rfft2(images)
        answers = torch.einsum("bkrc,fkrc->bfrc", waves, self.filter_waves.to(waves))
        fields = torch.fft.irfft2(answers, s=images.shape[-2:]).relu()
        found = torch.cat((images, fields), dim=1)
        inside = images.shape[-1] - (0 if wrap else self._reach - 1)
        return found[..., :inside:2, :inside:2]


SCALES = 4
"""Scales of wavelets, each twice as long as the one before."""

TURNS = 4
"""Orientations of wavelets in half a turn."""

PHASES = 4
"""Phases that a wavelet's answer is rectified at."""

HIGHEST = 0.36
"""Wave number of the shortest wavelets [waves per pixel]."""


class RectifiedWavelets:
    """The image, its blur, and oriented wavelets of several scales, rectified at four phases.

    The wavelets are those of a steerable pyramid (Portilla and Simoncelli 2000); covariances of
    their rectified answers tell what is aligned with what (Brochard, Zhang and Mallat, arXiv
    2203.07902).

    Args:
        like: An image of the shape that is to be described, [K, R, R], on the device.
    """

    def __init__(self, like: Tensor) -> None:
        side = like.shape[-1]
        waves = torch.fft.fftfreq(side, dtype=torch.float64)
        down, across = torch.meshgrid(waves, waves, indexing="ij")
        octave = torch.log2(torch.hypot(down, across).clamp_min(1e-9) / HIGHEST)
        turn = torch.atan2(down, across)
        count = max(1, min(SCALES, int(math.log2(side)) - 2))
        bank = []
        for scale in range(count):
            away = octave + scale
            band = torch.cos(0.5 * math.pi * away.clamp(-1.0, 1.0))
            if scale == 0:
                band = torch.where(away > 0.0, torch.ones_like(band), band)
            for number in range(TURNS):
                beside = torch.cos(turn - math.pi * number / TURNS).clamp_min(0.0)
                bank.append(band * beside ** (TURNS - 1))
        low = torch.cos(0.5 * math.pi * (octave + count).clamp(0.0, 1.0))
        self._margin = side // 8
        self.low = low.to(like)
        """Gain of what is left beside all bands, by frequency."""
        self.bank = torch.stack(bank).to(like)
        """Gains of the oriented bands, by frequency."""

    def __call__(self, images: Tensor, *, wrap: bool) -> Tensor:
        """Return the image's channels, their blur, and the answers, at every second place."""
        waves = torch.fft.fft2(images)
        blur = torch.fft.ifft2(waves * self.low).real
        answers = torch.fft.ifft2(waves[:, :, None] * self.bank).flatten(1, 2)
        fields = [images, blur]
        for phase in range(PHASES):
            angle = 2.0 * math.pi * phase / PHASES
            fields.append(
                2.0 * (math.cos(angle) * answers.real + math.sin(angle) * answers.imag).relu()
            )
        found = torch.cat(fields, dim=1)
        edge = 0 if wrap else self._margin
        return found[..., edge : found.shape[-2] - edge : 2, edge : found.shape[-1] - edge : 2]


SHIFTS = ((0, 0), (0, 2), (2, 0), (2, 2), (2, -2), (0, 5), (5, 0))
"""Places between two features whose products are averaged, rows and columns."""

LEAST_SQUARE = 1e-6
"""Divisor of Gram losses at least: targets that are not empty have some thousand times as much."""


class GramMatrices(TextureDistance):
    """The distance of images from a target in how features go together; satisfies `TextureLoss`.

    It is the squared difference of the features' means and of the means of their products, relative
    to the target's own squares; each feature counts relative to its own root mean square in the
    target. With shifts, of products of features at two places.

    Args:
        target: The texture (dimensionless), shape [K, R, R].
        features: What is compared.
        tiles: Whether the target's opposite edges meet.
        shifts: Places between the two features of a product.

    Raises:
        NPAError: The target is too small.
    """

    def __init__(
        self,
        target: Tensor,
        features: Features,
        *,
        tiles: bool,
        shifts: tuple[tuple[int, int], ...] = ((0, 0),),
    ) -> None:
        check_size(target)
        super().__init__(target)
        self._features = features
        self._shifts = shifts
        field = features(target[None], wrap=tiles)
        sizes = field.square().mean(dim=(0, 2, 3)).sqrt()
        scales = 1.0 / (sizes + 0.3 * sizes.mean() + 1e-6)
        # Features of an empty target have no size that others could be told by.
        self._scales = torch.where(sizes.any(), scales, 1.0)[:, None, None]
        # Features move round the torus; where the target is none, a few products lie wrong.
        self._expected = self._statistics(field)
        self._square = self._expected.square().mean().clamp_min(LEAST_SQUARE)

    def compare(self, images: Tensor) -> Tensor:
        """Return the distance of each of some checked images, [B]."""
        found = self._statistics(self._features(images, wrap=True))
        return (found - self._expected).square().mean(1) / self._square

    def _statistics(self, field: Tensor) -> Tensor:
        field = field * self._scales
        rows = field.flatten(2)
        count = rows.shape[2]
        parts = [rows.mean(2) * math.sqrt(rows.shape[1] * len(self._shifts))]
        for shift in self._shifts:
            moved = field if shift == (0, 0) else field.roll(shift, (2, 3))
            parts.append((rows @ moved.flatten(2).transpose(1, 2) / count).flatten(1))
        return torch.cat(parts, dim=1)


class FeatureTransport(TextureDistance):
    """Relaxed optimal transport of features and their moments; satisfies `TextureLoss`.

    As `vgg_ot` (Kolkin, Salavon and Shakhnarovich 2019), of features that need no weights.

    Args:
        target: The texture (dimensionless), shape [K, R, R].
        features: What is compared.
        tiles: Whether the target's opposite edges meet.

    Raises:
        NPAError: The target is too small.
    """

    def __init__(self, target: Tensor, features: Features, *, tiles: bool) -> None:
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
        stride = -(-field.shape[-1] // PLACES)
        return field[..., ::stride, ::stride].flatten(2).transpose(1, 2)
