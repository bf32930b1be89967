"""Pictures of 2D worlds as a differentiable torch operator."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.kernels.splat import CHANNELS, splat_kernels
from npa_envs.sph.bridge import launch, scalar_type
from npa_envs.sph.cells import make_plan, sort_worlds
from npa_envs.sph.checks import check_world

PATCH_SIGMAS = 3.0
"""A particle's patch reaches this many standard deviations from its centre."""


class _Lens:
    """Sizes that follow from a picture's resolution, window and Gaussian."""

    def __init__(
        self, resolution: int, pixel_size: float, sigma: float, low: float, high: float
    ) -> None:
        pixels = resolution * pixel_size / (high - low)
        self.falloff = 0.5 / (sigma * pixels) ** 2
        self.radius = math.ceil(PATCH_SIGMAS * sigma * pixels)
        self.area = pixels * pixels
        self.low = low
        self.pixel_length = (high - low) / (resolution - 1)
        self.reach_length = (self.radius + 0.5) * self.pixel_length


@torch.library.custom_op("npa::splat", mutates_args=())
def _splat(
    x: Tensor,
    colours: Tensor,
    resolution: int,
    pixel_size: float,
    sigma: float,
    low: float,
    high: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    lens = _Lens(resolution, pixel_size, sigma, low, high)
    total = x.shape[0] * x.shape[1]
    plan = make_plan(x, x.shape, CHANNELS, total, False, lens.reach_length, None)
    kernels = splat_kernels(plan.scalar)
    ordered = sort_worlds(plan, x, colours, None)
    footprints = x.new_empty(total, 3)
    sorted_colours = ordered.states.view(total, CHANNELS)
    launch(
        kernels.prepare_splats,
        total,
        x.device,
        ordered.positions,
        low,
        1.0 / lens.pixel_length,
        lens.falloff,
        lens.radius,
        lens.area,
        footprints,
    )
    picture = x.new_empty(x.shape[0], resolution, resolution, CHANNELS)
    launch(
        kernels.gather_splats,
        (x.shape[0], resolution, resolution),
        x.device,
        plan.domain,
        low,
        lens.pixel_length,
        lens.falloff,
        lens.radius,
        ordered.starts,
        footprints,
        sorted_colours,
        picture,
    )
    return picture, footprints, sorted_colours, ordered.source


@_splat.register_fake
def _(
    x: Tensor, colours: Tensor, resolution: int, *lens: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    total = x.shape[0] * x.shape[1]
    return (
        x.new_empty(x.shape[0], resolution, resolution, CHANNELS),
        x.new_empty(total, 3),
        x.new_empty(total, CHANNELS),
        x.new_empty(total, dtype=torch.int32),
    )


@torch.library.custom_op("npa::splat_backward", mutates_args=())
def _splat_backward(
    picture_bar: Tensor,
    footprints: Tensor,
    sorted_colours: Tensor,
    source: Tensor,
    pixel_size: float,
    sigma: float,
    low: float,
    high: float,
) -> tuple[Tensor, Tensor]:
    world_count, resolution = picture_bar.shape[:2]
    lens = _Lens(resolution, pixel_size, sigma, low, high)
    total = footprints.shape[0]
    positions_bar = footprints.new_empty(total, 2)
    colours_bar = torch.empty_like(sorted_colours)
    launch(
        splat_kernels(scalar_type(footprints.dtype)).pull_back_splats,
        total,
        footprints.device,
        total // world_count,
        resolution,
        1.0 / lens.pixel_length,
        lens.falloff,
        lens.radius,
        footprints,
        sorted_colours,
        source,
        picture_bar.contiguous(),
        positions_bar,
        colours_bar,
    )
    return positions_bar, colours_bar


@_splat_backward.register_fake
def _(
    picture_bar: Tensor, footprints: Tensor, sorted_colours: Tensor, *rest: Any
) -> tuple[Tensor, Tensor]:
    return footprints.new_empty(footprints.shape[0], 2), torch.empty_like(sorted_colours)


class _Splat(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, colours: Tensor, resolution: int, *lens: float) -> Tensor:
        picture: Tensor
        picture, *saved = _splat(x, colours, resolution, *lens)
        ctx.lens = lens
        ctx.shapes = (x.shape, colours.shape)
        ctx.save_for_backward(*saved)
        return picture

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, picture_bar: Tensor) -> tuple[Tensor | None, ...]:
        positions_bar, colours_bar = _splat_backward(picture_bar, *ctx.saved_tensors, *ctx.lens)
        x_shape, colour_shape = ctx.shapes
        gradients = (positions_bar.view(x_shape), colours_bar.view(colour_shape))
        return (*gradients, None, None, None, None, None)


def splat(
    x: Tensor,
    colour: Tensor,
    *,
    resolution: int,
    pixel_size: float,
    sigma: float = 1.0,
    lo: float = -1.0,
    hi: float = 1.0,
) -> Tensor:
    """Draw 2D worlds: each particle is a Gaussian of about one target pixel; differentiable.

    Pixel p = (x - lo) / (hi - lo) (R - 1); the Gaussian's standard deviation is
    sigma R h / (hi - lo) pixels, its weights sum to (R h / (hi - lo))^2, so that particles which
    stand as dense as the target's pixels have density about 1 (design of arXiv 2601.16096's 2D
    loss).

    Args:
        x: Particle positions [length units], shape [B, N, 2].
        colour: Particle colours, dimensionless, shape [B, N, 3].
        resolution: Pixels R along each side, 2 or more.
        pixel_size: Side h of a pixel of the target [length units].
        sigma: Standard deviation of the Gaussian in target pixels, dimensionless.
        lo: Lower edge of the window in both directions [length units].
        hi: Upper edge of the window in both directions [length units].

    Returns:
        Pictures, dimensionless, shape [B, R, R, 4]: sums of colour times weight and, last, of the
        weights. Row r lies at y = lo + r / (R - 1) (hi - lo), so y points to higher rows.

    Raises:
        NPAError: A shape does not fit or a number is out of its range.
    """
    check_world(x, colour)
    if x.shape[2] != 2 or colour.shape[2] != 3:
        raise NPAError(
            f"x and colour must have shapes [B, N, 2] and [B, N, 3], "
            f"got {tuple(x.shape)} and {tuple(colour.shape)}"
        )
    if resolution < 2:
        raise NPAError(f"resolution must be at least 2 pixels, got {resolution}")
    if not (lo < hi and math.isfinite(hi - lo)):
        raise NPAError(f"the window must have lo < hi, got lo={lo} and hi={hi}")
    for name, value in (("pixel_size", pixel_size), ("sigma", sigma)):
        if not (math.isfinite(value) and value > 0.0):
            raise NPAError(f"{name} must be positive and finite, got {value}")
    channels = torch.cat((colour, torch.ones_like(colour[..., :1])), dim=-1)
    picture: Tensor = _Splat.apply(  # type: ignore[no-untyped-call]
        x.contiguous(), channels, resolution, pixel_size, sigma, lo, hi
    )
    return picture
