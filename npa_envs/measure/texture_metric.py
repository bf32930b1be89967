"""The metric of textures: a picture's distance from the target, by no loss that training uses.

It has three parts: patches, power spectra, colours of pairs of pixels. Each is divided by that of
particles that draw the target itself, or by 2 % of that of grey noise if this is larger.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.tasks.losses.texture import quantiles
from npa_envs.tasks.texture import Texture, colour_image

REFERENCE = 128
"""Resolution [pixels] at which the lengths below hold; at others they are scaled with it."""
PATCH = 24
"""Side of a patch [pixels], which no training loss uses."""
DIRECTIONS = 64
"""Number of random directions that patches are projected on."""
BANDS = 7
"""Number of bands of the wave number, `BAND_RATIO` wide each, up to half a wave per pixel."""
BAND_RATIO = math.sqrt(2.0)
ORIENTATIONS = 8
"""Number of orientations of waves in half a turn."""
PAIR_DISTANCES = (1, 2, 4, 6, 9, 13, 19, 28)
"""Distances of the pairs of pixels whose colours are counted [pixels]."""
PAIR_DIRECTIONS = ((0, 1), (1, 1), (1, 0), (1, -1))
"""Directions of these pairs: rows down, columns to the right."""
DRAWINGS = 4
"""Number of drawings of the target by particles, whose mean distance is the unit."""


@dataclass(frozen=True)
class TextureRow:
    """Distances of worlds' pictures from the target at `step`, means over the worlds.

    1 is the distance of particles that draw the target itself. `patches` are sliced Wasserstein
    distances of patches, `spectra` distances of oriented power spectra, `colours` those of the
    colours of pairs of pixels. `ratio` is the mean of the three, `ratio_worst` the largest world's.
    """

    step: int
    ratio: float
    ratio_worst: float
    patches: float
    spectra: float
    colours: float


class TextureMetric:
    """Computes distances of pictures from the target of a texture task; others raise NPAError.

    It uses float64 and the same random directions each time, so that CPU and GPU agree.
    """

    def __init__(self, task: object) -> None:
        if not isinstance(task, Texture):
            raise NPAError(
                f"the texture metric compares textures, got {type(task).__name__}: leave out "
                "--judge, or give a rule of the task texture"
            )
        self._task = task
        resolution = task.config.resolution
        self._scale = resolution / REFERENCE
        device = task.target_picture.device
        generator = torch.Generator().manual_seed(0)
        self._side = max(2, min(resolution, round(PATCH * self._scale)))
        # Spectra of filters that project patches on random directions, [DIRECTIONS, 4, ...].
        size = DIRECTIONS, 4, self._side, self._side
        directions = torch.randn(size, generator=generator).double()
        directions /= directions.flatten(1).norm(dim=1)[:, None, None, None]
        filters = torch.zeros(DIRECTIONS, 4, resolution, resolution, dtype=torch.float64)
        filters[..., : self._side, : self._side] = directions
        self._filters: Tensor = torch.fft.rfft2(filters.to(device)).conj()
        bins = _wave_bins(resolution)[:, None] == torch.arange(1, 1 + BANDS * ORIENTATIONS)
        self._bins = bins.double().to(device)
        wrap = task.target.tiles
        self._window = torch.ones(resolution, resolution, dtype=torch.float64, device=device)
        if not wrap:
            ramp = torch.hann_window(resolution, periodic=False, dtype=torch.float64)
            self._window = torch.outer(ramp, ramp).to(device)
        target = _images(task.drawable[None])
        self._palette = _typical_colours(target[0].flatten(1).T, 12)
        self._patches = self._projections(target, wrap)
        self._spectra = self._amplitudes(target)
        self._colours = self._counts(target, wrap)
        noise = torch.rand(DRAWINGS, resolution, resolution, 2, generator=generator)
        grey, density = noise[..., :1].to(device), noise[..., 1:].to(device)
        noisy = torch.cat((grey * density,) * 3 + (density,), dim=3)
        drawn = torch.cat([task.drawing(1000 + number) for number in range(DRAWINGS)])
        least = 0.02 * self._distances(_images(noisy)).mean(0)
        self._units = torch.maximum(self._distances(_images(drawn)).mean(0), least)

    @torch.no_grad()
    def __call__(self, pictures: Tensor) -> Tensor:
        """Return patches, spectra, colours (`TextureRow`) of each picture, float64, [B, 3]."""
        if pictures.shape[1:] != self._task.target_picture.shape:
            raise NPAError(
                f"pictures must have shape [B, R, R, 4] with R as the target's "
                f"{self._task.config.resolution}, got {tuple(pictures.shape)}"
            )
        images = _images(pictures.to(self._task.target_picture.device))
        return self._distances(images) / self._units

    def row(self, x: Tensor, s: Tensor, step: int) -> TextureRow:
        """Return the row of worlds x and s at `step`, as the task draws them."""
        ratios = self(self._task.picture(x, s))
        each = ratios.mean(1)
        patches, spectra, colours = ratios.mean(0).tolist()
        return TextureRow(step, each.mean().item(), each.max().item(), patches, spectra, colours)

    def _distances(self, images: Tensor) -> Tensor:
        distances = []
        for image in images[:, None]:
            patches = (self._projections(image, True) - self._patches).square().mean()
            spectra = (self._amplitudes(image) - self._spectra).square().sum()
            colours = (self._counts(image, True).sqrt() - self._colours.sqrt()).square().sum()
            distances.append(torch.stack((patches, spectra, colours)))
        return torch.stack(distances)

    def _projections(self, image: Tensor, wrap: bool) -> Tensor:
        """Project an R x R image's patches on directions; return quantiles, [DIRECTIONS, R²]."""
        waves = torch.fft.rfft2(image)
        projected = torch.fft.irfft2((waves * self._filters).sum(1), s=image.shape[-2:])
        count = image.shape[-1] ** 2
        if not wrap:  # Only patches that do not cross the image's edges.
            inside = image.shape[-1] - self._side + 1
            projected = projected[:, :inside, :inside]
        return quantiles(projected.flatten(1), count)

    def _amplitudes(self, image: Tensor) -> Tensor:
        """Return the square root of the power in each channel and each bin of waves, [4, bins]."""
        flat = (image - image.mean(dim=(2, 3), keepdim=True)) * self._window
        power = torch.fft.fft2(flat, norm="forward").abs().square() / self._window.square().mean()
        sums: Tensor = power[0].flatten(1) @ self._bins
        return sums.sqrt()

    def _counts(self, image: Tensor, wrap: bool) -> Tensor:
        """Return fractions of pairs of pixels with each two of K colours, [pairs, K, K]."""
        away = (image[0].movedim(0, -1)[..., None, :] - self._palette).square().sum(-1)
        near = torch.exp(-0.5 * away / 0.15**2)
        # One more entry for colours that are near no other.
        near = torch.cat((near, torch.full_like(near[..., :1], 0.05)), dim=-1)
        near = near / near.sum(-1, keepdim=True)
        result = []
        side = near.shape[0]
        for distance, (down, across) in itertools.product(PAIR_DISTANCES, PAIR_DIRECTIONS):
            steps = max(1, round(distance * self._scale))
            moved = near.roll((-down * steps, -across * steps), dims=(0, 1))
            start = near
            if not wrap:
                rows = slice(0, side - down * steps)
                columns = slice(max(0, -across * steps), side - max(0, across * steps))
                start, moved = near[rows, columns], moved[rows, columns]
            start, moved = start.flatten(0, 1), moved.flatten(0, 1)
            result.append(start.T @ moved / len(start))
        return torch.stack(result)


def _images(pictures: Tensor) -> Tensor:
    """Return red, green, blue and density of pictures [B, R, R, 4], float64, [B, 4, R, R]."""
    channels = pictures.double().movedim(-1, 1)
    # The plain density, no power of it, as the faintest parts of edges should count little.
    return torch.cat((colour_image(channels), channels[:, 3:]), dim=1)


def _wave_bins(resolution: int) -> Tensor:
    """Return each wave's bin by wave number and orientation, from 1 on, int64, [R²]; 0: none."""
    waves = torch.fft.fftfreq(resolution, dtype=torch.float64)
    down, across = torch.meshgrid(waves, waves, indexing="ij")
    length = torch.hypot(down, across)
    longest = 0.5 * REFERENCE / resolution
    band = BANDS + torch.floor(torch.log(length / longest + 1e-300) / math.log(BAND_RATIO))
    # The first and the last band take all longer and all shorter waves.
    band = band.clamp(0, BANDS - 1)
    turn = torch.atan2(down, across) % math.pi
    orientation = torch.floor(turn / math.pi * ORIENTATIONS + 0.5) % ORIENTATIONS
    bins = 1 + band * ORIENTATIONS + orientation
    return torch.where(length > 0.0, bins, torch.zeros_like(bins)).long().flatten()


def _typical_colours(colours: Tensor, count: int) -> Tensor:
    """Return `count` = K typical colours [K, F] of colours [M, F], the centres of k-means."""
    centres = colours.mean(0, keepdim=True)
    for _ in range(count - 1):
        away = torch.cdist(colours, centres).amin(1)
        centres = torch.cat((centres, colours[away.argmax()][None]))
    for _ in range(20):
        nearest = torch.cdist(colours, centres).argmin(1)
        chosen = torch.nn.functional.one_hot(nearest, count).to(colours)
        sums, sizes = chosen.T @ colours, chosen.sum(0)[:, None]
        centres = torch.where(sizes > 0.0, sums / sizes.clamp_min(1.0), centres)
    return centres
