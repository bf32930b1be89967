"""Texture losses that see shapes: patches matched with patches, and features with features.

They compare all channels of an image at once, so that what lies inside of what counts, too.
"""

from __future__ import annotations

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
        """Return the image's channels and the rectified answers at every second place.

        Args:
            wrap: Whether their opposite edges meet; otherwise places near them are left out.
        """
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
        stride = -(-field.shape[-1] // PLACES)
        return field[..., ::stride, ::stride].flatten(2).transpose(1, 2)
