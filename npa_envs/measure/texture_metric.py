"""The metric of textures: a picture's distance from the target, by no loss that training uses.

It has three parts: shapes in patches after local contrast normalisation, local contrasts, and
colours, each at three lengths. Each is divided by that between a quarter of the target and all.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.tasks.losses.texture import patches, quantiles
from npa_envs.tasks.texture import Texture

REFERENCE = 256
"""Resolution [pixels] at which `LENGTHS` hold; at others they are scaled with it."""
LENGTHS = (8, 24, 64)
"""Sides of patches [pixels]."""
SAMPLES = 8
"""Number of samples along the side of a patch, at lower resolutions one pixel each."""
MATCHED = 96
"""Number of patches of the target with which all patches of a picture are compared."""
QUANTILES = 256
"""Number of quantiles of each distribution over a picture."""
MEAN_WEIGHT = 10.0
"""Weight of the distribution over all matched patches, against that of each."""
COLOUR_DIRECTIONS = 8
"""Number of random directions on which colours and density are projected."""
COVERED = 0.3
"""Density from which a pixel has its particles' mean colour."""
FAINT = 0.03
"""Local contrast below which shapes count less: a standard deviation of colours in [0, 1]."""
NOISE_SHARE = 0.002
"""Fraction of the distance of grey noise that is the least unit of each distance."""
LEAST = (0.0, math.log(1.16) ** 2, 0.05**2)
"""Least units of shapes, contrasts (by a factor) and colours: differences that are hard to see."""
DRAWINGS = 3
"""Number of drawings of the target by particles whose distributions are averaged."""


@dataclass(frozen=True)
class TextureRow:
    """Distances of worlds' pictures from the target at `step`, means over the worlds.

    1 is the distance of a quarter of the target from all of it, as particles draw it. `shapes` are
    distances of patches of equal contrast, `contrasts` those of local contrasts, `colours` those
    of colours and density. `ratio` is the mean of the three, `ratio_worst` the largest world's.
    """

    step: int
    ratio: float
    ratio_worst: float
    shapes: float
    contrasts: float
    colours: float


class TextureMetric:
    """Computes distances of pictures from the target of a texture task; others raise NPAError.

    Shapes are told by patches of the target: how like each of these the patches of a picture are,
    as a distribution over all places. All random choices are the same each time.
    """

    def __init__(self, task: object) -> None:
        if not isinstance(task, Texture):
            raise NPAError(
                f"the texture metric compares textures, got {type(task).__name__}: leave out "
                "--judge, or give a rule of the task texture"
            )
        self._task = task
        wrap = task.target.tiles
        generator = torch.Generator().manual_seed(0)
        turned = torch.randn(4, COLOUR_DIRECTIONS, generator=generator)
        like = task.target_picture
        self._turned = (turned / turned.norm(dim=0)).to(like)
        first, *drawn = (task.drawing(1000 + k, shifted=False) for k in range(1 + DRAWINGS))
        self._matched: list[Tensor] = []
        for rows, _, _ in _levels(first, wrap):
            chosen = torch.randperm(len(rows), generator=generator)[:MATCHED]
            self._matched.append(rows[chosen.to(rows.device)].T)
        fields = [self._fields(picture, wrap) for picture in drawn]
        self._expected = [
            torch.stack([_distribution(field) for field in same]).mean(0)
            for same in zip(*fields, strict=True)
        ]
        noise = torch.rand(1, *like.shape[:2], 2, generator=generator)
        grey, density = noise[..., :1].to(like), noise[..., 1:].to(like)
        noisy = self._fields(torch.cat((grey * density,) * 3 + (density,), dim=3), True)
        units = torch.maximum(
            torch.stack([self._distances(quarter) for quarter in _quarters(fields[0])]).mean(0),
            NOISE_SHARE * self._distances(noisy),
        )
        self._units = torch.maximum(units, torch.tensor(LEAST).to(units))

    @torch.no_grad()
    def __call__(self, pictures: Tensor) -> Tensor:
        """Return shapes, contrasts, colours (`TextureRow`) of each picture, float64, [B, 3]."""
        like = self._task.target_picture
        if pictures.shape[1:] != like.shape:
            raise NPAError(
                f"pictures must have shape [B, R, R, 4] with R as the target's "
                f"{self._task.config.resolution}, got {tuple(pictures.shape)}"
            )
        distances = [self._distances(self._fields(p[None].to(like), True)) for p in pictures]
        return (torch.stack(distances) / self._units).mean(1)

    def row(self, x: Tensor, s: Tensor, step: int) -> TextureRow:
        """Return the row of worlds x and s at `step`, as the task draws them."""
        ratios = self(self._task.picture(x, s))
        each = ratios.mean(1)
        shapes, contrasts, colours = ratios.mean(0).tolist()
        return TextureRow(step, each.mean().item(), each.max().item(), shapes, contrasts, colours)

    def _fields(self, picture: Tensor, wrap: bool) -> list[Tensor]:
        """Return likeness to matched patches, log contrast and colours for each length, [F, S, S].

        S is the number of places along a side.
        """
        fields = []
        for (rows, variance, colours), matched in zip(
            _levels(picture, wrap), self._matched, strict=True
        ):
            side = math.isqrt(len(rows))
            likeness = (rows @ matched).T.reshape(-1, side, side)
            if wrap:  # The last row and column are the first again.
                likeness = likeness[:, :-1, :-1]
            fields += [likeness, 0.5 * variance.log()[None]]
            fields.append((self._turned.T @ colours.flatten(1)).view(-1, *colours.shape[1:]))
        return fields

    def _distances(self, fields: list[Tensor]) -> Tensor:
        """Return distances of fields from the target's, float64, [lengths, 3]."""
        distances = []
        for number, (field, expected) in enumerate(zip(fields, self._expected, strict=True)):
            apart = (_distribution(field) - expected).double()
            weight = MEAN_WEIGHT if number % 3 == 0 else 0.0
            distances.append(apart.square().mean() + weight * apart.mean(0).square().mean())
        return torch.stack(distances).view(-1, 3)


def _levels(picture: Tensor, wrap: bool) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Yield patches [M, E], local variance [S, S] and colours with density [4, S, S] by length.

    `picture` is one, [1, R, R, 4]. Patches have equal contrast and length 1, but for faint ones.
    """
    channels = picture[0].movedim(-1, 0)
    sums, density = channels[:3], channels[3:]
    # Mean colours of particles: where these are dense or sparse is noise.
    even = torch.cat((sums / density.clamp_min(COVERED), 0.5 * (density / COVERED).clamp_max(1.0)))
    shown = torch.cat((sums / density.clamp_min(1.0), 0.5 * density.clamp_max(1.0)))
    resolution = picture.shape[1]
    for length in LENGTHS:
        side = min(resolution, round(SAMPLES * REFERENCE / length))
        smaller = _area_means(side, resolution).to(picture)
        around = _gaussian_means(side, 0.5 * SAMPLES, wrap).to(picture)
        image = smaller @ even @ smaller.T
        apart = image - around @ image @ around.T
        variance = (around @ apart.square().sum(0) @ around.T).clamp_min(0.0)
        rows = patches((apart / (variance + FAINT**2).sqrt())[None], SAMPLES, stride=1, wrap=wrap)
        rows = rows[0] / (rows[0].norm(dim=1, keepdim=True) + 1e-3)
        near = _gaussian_means(side, 1.5, wrap).to(picture) @ smaller
        yield rows, variance + (0.5 * FAINT) ** 2, near @ shown @ near.T


def _area_means(count: int, resolution: int) -> Tensor:
    """Return the matrix [count, R] that takes means of R pixels over `count` equal intervals."""
    edges = torch.arange(count + 1, dtype=torch.float64) * resolution / count
    pixels = torch.arange(resolution, dtype=torch.float64)
    shared = torch.minimum(edges[1:, None], pixels + 1.0) - torch.maximum(edges[:-1, None], pixels)
    return shared.clamp_min(0.0) * count / resolution


def _gaussian_means(side: int, sigma: float, wrap: bool) -> Tensor:
    """Return the matrix [side, side] of means weighted by a Gaussian of `sigma` samples."""
    places = torch.arange(side, dtype=torch.float64)
    away = places[:, None] - places
    if wrap:
        away = away - side * (away / side).round()
    weights = torch.exp(-0.5 * (away / sigma).square())
    return weights / weights.sum(1, keepdim=True)


def _distribution(field: Tensor) -> Tensor:
    """Return the quantiles of a field [F, S, S] over its places, [F, QUANTILES]."""
    return quantiles(field.flatten(1), QUANTILES)


def _quarters(fields: list[Tensor]) -> Iterator[list[Tensor]]:
    """Yield the fields [F, S, S] of each quarter of a picture."""
    for down, across in itertools.product((0, 1), repeat=2):
        yield [field.chunk(2, 1)[down].chunk(2, 2)[across] for field in fields]
