"""Colours (red, green, blue) of pictures, densities and hidden states."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import ImageColor
from torch import Tensor

from npa_envs.checks import as_list, check_dense, checked_number
from npa_envs.errors import NPAError, shown

Background = str | tuple[float, float, float]


def to_uint8(picture: Tensor, background: Background = "white") -> NDArray[np.uint8]:
    """Return pixels of pictures that `splat` returns, over a background, with y upwards.

    A pixel is the mean colour of its particles where the density is above 1, and their colour mixed
    with the background where it is below 1. Pixels that are not finite are background.

    Args:
        picture: Sums of red, green and blue, and the density (dimensionless), [..., R, R, 4], on
            any device; the first row is the lowest y.
        background: A colour name such as "black", "#rrggbb", or red, green and blue in [0, 1].

    Returns:
        Pixels on the CPU, shape [..., R, R, 3]; the first row is the highest y.
    """
    if not isinstance(picture, Tensor):
        raise NPAError(
            f"picture must be a torch tensor, got {type(picture).__name__}: give what splat returns"
        )
    if picture.ndim < 3 or picture.shape[-1] != 4 or not picture.is_floating_point():
        raise NPAError(
            "picture must be a floating tensor of shape [..., R, R, 4] (colour sums, density), "
            f"got {picture.dtype} {tuple(picture.shape)}: give what splat returns"
        )
    check_dense("picture", picture)
    background_rgb = background_colour(background)
    fields = picture.detach().float()
    fields = fields.where(fields.isfinite().all(dim=-1, keepdim=True), 0.0)
    sums, density = fields[..., :3], fields[..., 3:]
    covered = (sums / density.clamp(min=1)).unbind(-1)
    uncovered = 1 - density[..., 0].clamp(0, 1)
    # By channel: a tensor of the background would be copied to the device for each frame.
    channels = [c + uncovered * level for c, level in zip(covered, background_rgb, strict=True)]
    visible = torch.stack(channels, dim=-1)
    pixels = (visible.clamp(0, 1) * 255).round().to(torch.uint8).flip(-3)
    return pixels.cpu().numpy()


def background_colour(background: Background) -> tuple[float, float, float]:
    """Return red, green and blue in [0, 1] of a colour name, "#rrggbb", or a triple in [0, 1]."""
    if isinstance(background, str):
        try:
            red, green, blue = ImageColor.getrgb(background)[:3]
        except ValueError as error:
            raise NPAError(
                f"background must be a colour, got {shown(background)}: "
                "give 'white', 'black', another name of CSS, or '#rrggbb'"
            ) from error
        return red / 255, green / 255, blue / 255
    parts = as_list(background) or []
    channels = [checked_number("a channel of background", part) for part in parts]
    if len(channels) != 3 or not all(0 <= channel <= 1 for channel in channels):
        raise NPAError(
            f"background must be red, green and blue in [0, 1], got {shown(background)}: "
            "for white give (1, 1, 1)"
        )
    return channels[0], channels[1], channels[2]


# Colours of densities (a ramp) and of states, in OKLab (B. Ottosson, 2020), whose distances are
# about perceptual.

RAMP_STOPS = ("#2a1858", "#792a86", "#cc4a70", "#f2985f", "#fbe6bd")
"""Colours of densities from dark to light; over a light background in reverse order."""

RAMP_LENGTH = 1024
"""Number of colours of densities, which `ramp` interpolates between `RAMP_STOPS`."""

GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
"""Angle between the hues of successive channels [rad], which spreads any number of them evenly."""

STATE_CHROMA = 0.16
"""Maximum |a| and |b| of a state's colour in OKLab (dimensionless)."""

STATE_GAIN = 2.8
"""Factor on states before tanh, which limits their colours (dimensionless)."""

_LMS_FROM_RGB = (
    (0.4122214708, 0.5363325363, 0.0514459929),
    (0.2119034982, 0.6806995451, 0.1073969566),
    (0.0883024619, 0.2817188376, 0.6299787005),
)
_LAB_FROM_ROOTS = (
    (0.2104542553, 0.7936177850, -0.0040720468),
    (1.9779984951, -2.4285922050, 0.4505937099),
    (0.0259040371, 0.7827717662, -0.8086757660),
)
_ROOTS_FROM_LAB, _RGB_FROM_LMS = (
    np.linalg.inv(matrix).tolist() for matrix in (_LAB_FROM_ROOTS, _LMS_FROM_RGB)
)


def density_colours(density: Tensor, background: tuple[float, float, float]) -> NDArray[np.uint8]:
    """Return colours, uint8, [..., 3], of finite densities >= 0 (dimensionless), shape [...].

    Density 0 has the colour `background`, 1 the middle of `ramp`, and infinity its end.
    """
    position = 1.0 - torch.exp2(-density.clamp(min=0.0))
    entry = (position * (RAMP_LENGTH - 1)).round().to(torch.int32).cpu().numpy()
    colours: NDArray[np.uint8] = ramp(background)[entry]
    return colours


@functools.lru_cache(maxsize=16)
def ramp(background: tuple[float, float, float]) -> NDArray[np.uint8]:
    """Return colours of rising densities, from the background on, uint8, [RAMP_LENGTH, 3]."""
    stops = [[int(stop[k : k + 2], 16) / 255 for k in (1, 3, 5)] for stop in RAMP_STOPS]
    first = oklab(torch.tensor([background], dtype=torch.float64))
    # Over a light background the ramp gets darker with density.
    if first[0, 0] > 0.6:
        stops.reverse()
    knots = torch.cat([first, oklab(torch.tensor(stops, dtype=torch.float64))]).numpy()
    lengths = np.cumsum([0.0, *np.linalg.norm(np.diff(knots, axis=0), axis=1)])
    along = np.linspace(0.0, lengths[-1], RAMP_LENGTH)
    lab = np.stack([np.interp(along, lengths, knots[:, k]) for k in range(3)], axis=1)
    colours = (srgb(torch.from_numpy(lab)) * 255).round().to(torch.uint8).numpy()
    # The cached array must not change.
    colours.setflags(write=False)
    return colours


def state_colours(hidden: Tensor) -> Tensor:
    """Return red, green and blue in [0, 1], [..., 3], for states of H >= 0 channels, [..., H].

    Each channel adds its own hue and lightness, a negative value the opposite ones. Zeros are grey.
    """
    zeros = hidden.new_zeros(hidden.shape[:-1])
    angles = [channel * GOLDEN_ANGLE for channel in range(hidden.shape[-1])]
    weights = [(math.cos(1.5 * a + 1.0), math.cos(a), math.sin(a)) for a in angles]
    # In a fixed order: that of a matrix product depends on the device and on B.
    terms = [[w[k] * hidden[..., c] for c, w in enumerate(weights)] for k in range(3)]
    gain = STATE_GAIN / math.sqrt(max(len(angles), 1))
    pull = [torch.tanh(sum(part, zeros) * gain) for part in terms]
    lab = (0.67 + 0.2 * pull[0], STATE_CHROMA * pull[1], STATE_CHROMA * pull[2])
    return srgb(torch.stack(lab, dim=-1))


def oklab(rgb: Tensor) -> Tensor:
    """Return coordinates (L, a, b) in OKLab, [..., 3], of sRGB colours in [0, 1], [..., 3]."""
    linear = torch.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    return _mix(_mix(linear, _LMS_FROM_RGB).pow(1.0 / 3.0), _LAB_FROM_ROOTS)


def srgb(lab: Tensor) -> Tensor:
    """Return sRGB colours, clipped to [0, 1], [..., 3], of OKLab's (L, a, b), [..., 3]."""
    linear = _mix(_mix(lab, _ROOTS_FROM_LAB).pow(3.0), _RGB_FROM_LMS).clamp(0.0, 1.0)
    curved = 1.055 * linear.clamp(min=0.0031308).pow(1.0 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, 12.92 * linear, curved)


def _mix(channels: Tensor, matrix: Sequence[Sequence[float]]) -> Tensor:
    red, green, blue = channels.unbind(-1)
    return torch.stack([r * red + g * green + b * blue for r, g, b in matrix], dim=-1)
