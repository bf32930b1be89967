"""Pictures of worlds, without legend or axes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.checks import (
    check_world,
    checked_finite,
    checked_flag,
    checked_positive,
    number_tensor,
)  # fmt: skip
from npa_envs.errors import NPAError, shown, suggest
from npa_envs.ops import periodic_splat, splat
from npa_envs.ops.pictures.splat import checked_window
from npa_envs.render.colours import (
    Background,
    background_colour,
    density_colours,
    state_colours,
    to_uint8,
)
from npa_envs.rule.rule import COLOUR_OFFSET

STYLES = ("particles", "density", "states")
"""Styles of pictures: the particles' own colours, their density, their hidden states."""

COLOUR_CHANNELS = 3
"""The last channels of a state, which are its colour less `COLOUR_OFFSET`."""

LAYERS = 24
"""Layers of a 3D world from near to far, with equal numbers of particles."""

OPACITY = 5.0
"""Optical depth of a layer of density 1 in 3D (dimensionless)."""

BEAD = 0.7
"""Size of a particle in 3D over its size in 2D, where spots must close the gaps."""

SHADE = 0.45
"""Share of light that a particle at the far end of the view loses."""


def draw_worlds(
    x: Tensor,
    s: Tensor,
    *,
    style: str = "particles",
    resolution: int = 256,
    pixel_size: float,
    sigma: float = 1.0,
    centre: Tensor | Sequence[float] | None = None,
    half_width: float = 1.0,
    periodic: bool = False,
    azimuth: float = 0.0,
    elevation: float = 20.0,
    background: Background = "white",
) -> NDArray[np.uint8]:
    """Draw worlds: every particle is a soft spot, y is up.

    Nothing is fitted to a frame or a batch, so colours mean the same in every picture. Particles
    whose position (or state, where the style shows it) is not finite are left out. 3D worlds are
    drawn without perspective: near particles cover far ones, and far ones are darker.

    Args:
        x: Particle positions [length units], shape [B, N, D], D = 2 or 3, on any device.
        s: Particle states (dimensionless), shape [B, N, C].
        style: "particles" shows the last three channels plus 0.5 as red, green and blue, clipped;
            "density" the density, with that of the target's pixels in the middle of the colour ramp
            (in 3D along the line of sight, with half the depth of the view full); "states" all
            other channels, each by a hue (grey: a blank particle).
        resolution: Pixels R along each side, 2 or more.
        pixel_size: Side of a pixel of the target, or usual distance between particles [length
            units].
        sigma: Standard deviation of a particle's spot in `pixel_size`, dimensionless.
        centre: Middle of the picture [length units], shape [D] or [B, D]; None is the origin.
        half_width: From the middle of the picture to its edge [length units].
        periodic: 2D only: the picture is a periodic box, whose edges are joined.
        azimuth: 3D only: angle of the camera around the vertical axis [degrees], counterclockwise
            from above; at 0 x points right and z towards the viewer.
        elevation: 3D only: angle of the camera above the horizon [degrees].
        background: As of `to_uint8`.

    Returns:
        Pixels of shape [B, R, R, 3]; the first row is the highest y.
    """
    check_world(x, s)
    if not isinstance(style, str) or style not in STYLES:
        raise NPAError(
            f"style must be one that exists, got {shown(style)}: {suggest(style, STYLES)}"
        )
    half_width = checked_positive("half_width", half_width)
    periodic = checked_flag("periodic", periodic)
    azimuth = checked_finite("azimuth", azimuth, " [degrees]")
    elevation = checked_finite("elevation", elevation, " [degrees]")
    resolution, pixel_size, sigma, *_ = checked_window(
        resolution, pixel_size, sigma, -half_width, half_width
    )
    if periodic and x.shape[2] != 2:
        raise NPAError(f"periodic pictures are of 2D worlds, got D = {x.shape[2]}: leave it out")
    behind = background_colour(background)
    with torch.no_grad():
        places = (x - _middle(centre, x)).float()
        colour = _colours(s.float(), style)
        depth = None
        if x.shape[2] == 3:
            places, depth = _seen_from(places, azimuth, elevation)
        limit = 1e3 * (half_width + sigma * pixel_size)
        visible = (places.abs() <= limit).all(-1, keepdim=True)
        if style != "density":
            visible = visible & s.isfinite().all(-1, keepdim=True)
        # A periodic box draws every finite position; NaN draws nothing.
        nowhere = math.nan if periodic else limit
        places, colour = places.where(visible, nowhere), colour.where(visible, 0.0)
        draw = partial(
            periodic_splat if periodic else splat,
            resolution=resolution, pixel_size=pixel_size, lo=-half_width, hi=half_width,
        )  # fmt: skip
        if style == "density":
            density = draw(places, colour, sigma=sigma)[..., 3]
            if depth is not None:
                density = density * (pixel_size / half_width)
            return density_colours(density.flip(-2), behind)
        if depth is None:
            return to_uint8(draw(places, colour, sigma=sigma), behind)
        depth = depth.where(visible, 0.0)
        light = 1.0 - SHADE * (0.5 - 0.5 * depth / half_width).clamp(0.0, 1.0)
        beads = partial(draw, sigma=BEAD * sigma)
        return to_uint8(_stack_layers(beads, places, depth, colour * light), behind)


def _middle(centre: Tensor | Sequence[float] | None, x: Tensor) -> Tensor:
    world_count, _, space_dim = x.shape
    if centre is None:
        return x.new_zeros(space_dim)
    middle = number_tensor("centre", centre).to(x)
    if middle.shape not in ((space_dim,), (world_count, space_dim)):
        raise NPAError(
            f"centre must have shape [{space_dim}] or [{world_count}, {space_dim}], "
            f"got {tuple(middle.shape)}: for example x.mean(dim=1)"
        )
    return middle if middle.ndim == 1 else middle[:, None]


def _colours(s: Tensor, style: str) -> Tensor:
    if style == "density":
        return s.new_zeros(*s.shape[:2], 3)
    if style == "states":
        return state_colours(s[..., :-COLOUR_CHANNELS])
    if s.shape[2] < COLOUR_CHANNELS:
        raise NPAError(
            f"style 'particles' needs states of at least 3 channels, got {s.shape[2]}: "
            "draw the style 'density'"
        )
    return (s[..., -COLOUR_CHANNELS:] + COLOUR_OFFSET).clamp(0.0, 1.0)


def _seen_from(x: Tensor, azimuth: float, elevation: float) -> tuple[Tensor, Tensor]:
    """Return places on the picture, [B, N, 2], and distances towards the viewer, [B, N, 1]."""
    turn, tilt = (math.radians(angle % 360.0) for angle in (azimuth, elevation))
    right, height, outward = x.unbind(-1)
    across = math.cos(turn) * right - math.sin(turn) * outward
    ahead = math.sin(turn) * right + math.cos(turn) * outward
    up = math.cos(tilt) * height - math.sin(tilt) * ahead
    near = math.sin(tilt) * height + math.cos(tilt) * ahead
    return torch.stack((across, up), dim=-1), near[..., None]


def _stack_layers(
    draw: Callable[[Tensor, Tensor], Tensor], places: Tensor, depth: Tensor, colour: Tensor
) -> Tensor:
    """Lay splats of particles at about the same depth over each other, the nearest on top."""
    order = depth.argsort(dim=1, descending=True, stable=True)
    places = places.gather(1, order.expand_as(places))
    colour = colour.gather(1, order.expand_as(colour))
    picture, through = places.new_zeros(()), places.new_ones(())
    layers = min(LAYERS, places.shape[1])
    for part, tint in zip(
        places.tensor_split(layers, 1), colour.tensor_split(layers, 1), strict=True
    ):
        layer = draw(part, tint)
        density = layer[..., 3:]
        passing = torch.exp(-OPACITY * density)
        share = through * (1.0 - passing)
        picture = picture + share * layer / density.clamp(min=torch.finfo(density.dtype).tiny)
        through = through * passing
    return picture
