"""Texture losses that were tried and are not in the package: of a trained network, of plenoptic.

Importing this module gives them names, so that `benchmarks/textures.py` can compare them and their
sums with the others:

- `formula_ot`: relaxed optimal transport of what the network of `benchmarks/formula_network.py`
  sees; the environment variable FORMULA_WEIGHTS names its file;
- `pyramid_statistics`: those of Portilla and Simoncelli (2000), by the library plenoptic 2.1.1
  (`pip install plenoptic`).
"""

from __future__ import annotations

import os
from typing import cast

import torch
from formula_network import FormulaFeatures
from torch import Tensor

from npa_envs.tasks.losses.pieces import (
    TextureDistance,
    check_size,
    moment_distance,
    relaxed_transport,
)
from npa_envs.tasks.losses.shapes import PLACES
from npa_envs.tasks.losses.texture import TEXTURE_LOSSES, LossEntry

NOISE = 0.01
"""Standard deviation of what is added to pictures: flat ones have no such statistics."""


class LevelTransport(TextureDistance):
    """Relaxed optimal transport of features and their moments, level by level, as `vgg_ot`.

    Args:
        target: The texture (dimensionless), shape [4, R, R].
        features: What is compared.
        tiles: Whether the target's opposite edges meet.
    """

    def __init__(self, target: Tensor, features: FormulaFeatures, *, tiles: bool) -> None:
        check_size(target)
        super().__init__(target)
        self._features = features
        self._expected = [rows_of(field) for field in features(target[None], wrap=tiles)]

    def compare(self, images: Tensor) -> Tensor:
        """Return the distance of each of some checked images, [B]."""
        total = images.new_zeros(len(images))
        fields = self._features(images, wrap=True)
        for field, expected in zip(fields, self._expected, strict=True):
            found = rows_of(field)
            total = total + relaxed_transport(found, expected) + moment_distance(found, expected)
        return total / len(self._expected)


def rows_of(field: Tensor) -> Tensor:
    """Return what is seen at some places, [B, M, F]."""
    stride = -(-field.shape[-1] // PLACES)
    return field[..., ::stride, ::stride].flatten(2).transpose(1, 2)


class PyramidStatistics(TextureDistance):
    """Squared difference of a steerable pyramid's statistics, relative to the target's squares.

    Of each channel by itself: the library does not say how channels go together.

    Args:
        target: The texture (dimensionless), shape [K, R, R].
        seed: What the noise is drawn from.
    """

    def __init__(self, target: Tensor, *, seed: int) -> None:
        import plenoptic

        check_size(target)
        super().__init__(target)
        side = target.shape[-1]
        self._model = plenoptic.models.PortillaSimoncelli(
            (side, side), n_scales=4 if side >= 128 else 3, n_orientations=4, spatial_corr_width=7
        ).to(target.device)
        generator = torch.Generator().manual_seed(seed)
        self._noise = NOISE * torch.randn(target.shape, generator=generator).to(target)
        self._expected = self._model(target[None] + self._noise)

    def compare(self, images: Tensor) -> Tensor:
        """Return the distance of each of some checked images, [B]."""
        away = self._model(images + self._noise) - self._expected
        return (away.square().sum(2) / self._expected.square().sum(2)).mean(1)


cast("dict[str, LossEntry]", TEXTURE_LOSSES).update(
    formula_ot=LossEntry(
        "relaxed optimal transport of what a network trained on formula-made pictures sees",
        lambda target, options: LevelTransport(
            target, FormulaFeatures(os.environ["FORMULA_WEIGHTS"], target), tiles=options.tiles
        ),
        joint=True,
    ),
    pyramid_statistics=LossEntry(
        "statistics of Portilla and Simoncelli; needs plenoptic",
        lambda target, options: PyramidStatistics(target, seed=options.seed),
        joint=True,
    ),
)
