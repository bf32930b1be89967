"""Pictures of particle worlds in 2D and 3D, one of each world (`draw_worlds`)."""

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
from npa_envs.errors import NPAError, check_known
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
"""What pictures show: the particles' own colours, their density, or their hidden states."""

COLOUR_CHANNELS = 3
"""The last 3 channels of a state are red, green and blue, minus `COLOUR_OFFSET` each."""

LAYERS = 24
"""Number of layers that a 3D world is divided into by depth, with equally many particles each."""

OPACITY = 5.0
"""Optical depth of a layer of density 1 in 3D (dimensionless)."""

BEAD = 0.7
"""Factor on `sigma` of particles in 3D (dimensionless); in 2D wider splats close gaps."""

SHADE = 0.45
"""Fraction by which 3D particles at the far end of the view are darker than at the near end."""


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
    """Return a picture of each world: every particle is a Gaussian splat, y is up.

    The picture of a world does not depend on the other worlds. Particles whose position is not
    finite are left out; so are those whose state is not finite, unless the style is "density". 3D
    worlds are drawn in parallel projection: near particles cover far ones, and far ones are darker.

    Args:
        x: Particle positions [length units], shape [B, N, D], D = 2 or 3, on any device.
        s: Particle states (dimensionless), shape [B, N, C].
        style: "particles" shows the last three channels plus 0.5 as red, green and blue, clipped;
            "density" the sum of the splats (in 3D times `pixel_size` / `half_width`), where 1 is
            the middle of a colour ramp; "states" all other channels, each with its own hue, and
            grey where they are 0.
        resolution: Pixels R along each side, 2 or more.
        pixel_size: Side of a pixel of the target, or usual distance of neighbours [length units].
        sigma: Standard deviation of a particle's splat / `pixel_size` (dimensionless).
        centre: Middle of the picture [length units], shape [D] or [B, D]; None: the origin.
        half_width: Distance from the middle of the picture to its edge [length units].
        periodic: 2D only: whether the picture is a periodic box, whose sides are 2 `half_width`.
        azimuth: 3D only: angle of the camera around the vertical axis [degrees], counterclockwise
            from above; at 0 x points right and z towards the viewer.
        elevation: 3D only: angle of the camera above the horizon [degrees].
        background: A colour name, "#rrggbb", or red, green and blue in [0, 1].

    Returns:
        Pixels of shape [B, R, R, 3]; the first row is the highest y.
    """
    check_world(x, s)
    check_known("style must be one that exists, got", style, STYLES)
    half_width = checked_positive("half_width", half_width)
    periodic = checked_flag("periodic", periodic)
    azimuth = checked_finite("azimuth", azimuth, " [degrees]")
    elevation = checked_finite("elevation", elevation, " [degrees]")
    resolution, pixel_size, sigma, *_ = checked_window(
        resolution, pixel_size, sigma, -half_width, half_width
    )
    if periodic and x.shape[2] != 2:
        raise NPAError(f"periodic pictures are of 2D worlds, got D = {x.shape[2]}: leave it out")
    background_rgb = background_colour(background)
    draw = partial(
        periodic_splat if periodic else splat,
        resolution=resolution, pixel_size=pixel_size, lo=-half_width, hi=half_width,
    )  # fmt: skip
    with torch.no_grad():
        points, depth = (x - _middle(centre, x)).float(), None
        if x.shape[2] == 3:
            points, depth = _projected(points, azimuth, elevation)
        far = 1e3 * (half_width + sigma * pixel_size)
        visible = (points.abs() <= far).all(-1, keepdim=True)
        if style != "density":
            visible = visible & s.isfinite().all(-1, keepdim=True)
        # A periodic splat draws every finite position; NaN draws nothing.
        points = points.where(visible, math.nan if periodic else far)
        colour = _colours(s.float(), style).where(visible, 0.0)
        if style == "density":
            density = draw(points, colour, sigma=sigma)[..., 3]
            scale = 1.0 if depth is None else pixel_size / half_width
            return density_colours((density * scale).flip(-2), background_rgb)
        if depth is None:
            return to_uint8(draw(points, colour, sigma=sigma), background_rgb)
        depth = depth.where(visible, 0.0)
        shaded = colour * (1.0 - SHADE * (0.5 - 0.5 * depth / half_width).clamp(0.0, 1.0))
        beads = partial(draw, sigma=BEAD * sigma)
        return to_uint8(_stack_layers(beads, points, depth, shaded), background_rgb)


def _middle(centre: Tensor | Sequence[float] | None, x: Tensor) -> Tensor:
    world_count, _, space_dim = x.shape
    middle = number_tensor("centre", [0.0] * space_dim if centre is None else centre).to(x)
    if middle.shape not in ((space_dim,), (world_count, space_dim)):
        raise NPAError(
            f"centre must have shape [{space_dim}] or [{world_count}, {space_dim}], "
            f"got {tuple(middle.shape)}: for example x.mean(dim=1)"
        )
    return middle if middle.ndim == 1 else middle[:, None]


def _colours(s: Tensor, style: str) -> Tensor:
    """Return red, green and blue in [0, 1] of each particle in a style, [B, N, 3]."""
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


def _projected(x: Tensor, azimuth: float, elevation: float) -> tuple[Tensor, Tensor]:
    """Return coordinates right and up in the picture, [B, N, 2], and to the viewer, [B, N, 1]."""
    turn, tilt = (math.radians(angle % 360.0) for angle in (azimuth, elevation))
    right, height, outward = x.unbind(-1)
    across = math.cos(turn) * right - math.sin(turn) * outward
    ahead = math.sin(turn) * right + math.cos(turn) * outward
    up = math.cos(tilt) * height - math.sin(tilt) * ahead
    near = math.sin(tilt) * height + math.cos(tilt) * ahead
    return torch.stack((across, up), dim=-1), near[..., None]


def _stack_layers(
    draw: Callable[[Tensor, Tensor], Tensor], points: Tensor, depth: Tensor, colour: Tensor
) -> Tensor:
    """Return pictures [B, R, R, 4] (colours times alpha, alpha) of layers, the nearest on top."""
    order = depth.argsort(dim=1, descending=True, stable=True)
    particles = torch.cat((points, colour), dim=-1)
    particles = particles.gather(1, order.expand_as(particles))
    picture, transmittance = points.new_zeros(()), points.new_ones(())
    for layer_particles in particles.tensor_split(min(LAYERS, points.shape[1]), 1):
        layer = draw(layer_particles[..., :2], layer_particles[..., 2:])
        density = layer[..., 3:]
        passed = torch.exp(-OPACITY * density)
        weight = transmittance * (1.0 - passed)
        picture = picture + weight * layer / density.clamp(min=torch.finfo(density.dtype).tiny)
        transmittance = transmittance * passed
    return picture
