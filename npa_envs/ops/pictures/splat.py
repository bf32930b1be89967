"""Pictures of 2D worlds as a differentiable torch operator, and their losses in fused kernels."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from npa_envs.checks import (
    MAX_SIDE,
    check_world,
    checked_count,
    checked_number,
    checked_positive,
    checked_side,
)
from npa_envs.errors import NPAError, shown
from npa_envs.kernels.cuda.sort import BLOCKS, sort_small_splats
from npa_envs.kernels.lanes_and_memory import CUDA_BLOCK
from npa_envs.kernels.pictures.pixel_errors import (
    BLOCK_TILES,
    ROUND_TILES,
    gather_errors,
    sum_errors,
)
from npa_envs.kernels.pictures.splat import (
    CHANNELS,
    FOOTPRINT,
    GROUP_HEIGHT,
    GROUP_WIDTH,
    PATCH_SIGMAS,
    TILE_LANES,
    group_count,
    make_view,
    splat_kernels,
)
from npa_envs.ops.backend import KernelRequest, multiprocessor_count
from npa_envs.ops.custom_op import check_derivatives, custom_op, once_differentiable
from npa_envs.ops.launch import SCALARS, aligned, launch
from npa_envs.ops.sort import MAX_INDEX, block_capacity, slice_count
from npa_envs.ops.world_mean import average, average_sums

MAX_SPOT = 1e6
"""Largest standard deviation of a Gaussian [pixels], and largest inverse of one."""


class Splats(NamedTuple):
    """Particles to draw, in contiguous tensors; colours are the last three states + `shift`."""

    x: Tensor
    """Positions [length units], shape [B, N, 2]."""
    states: Tensor
    """States, dimensionless, shape [B, N, C]."""
    shift: float = 0.0
    """Added to the last three states to give colours, dimensionless."""
    goal: Tensor | None = None
    """Point to which each world's mean is moved [length units], shape [1, 2]; None: not moved."""

    @property
    def total(self) -> int:
        """Particles of all worlds, B N."""
        return self.x.shape[0] * self.x.shape[1]

    def arguments(self) -> tuple[Any, ...]:
        """Kernel arguments: N, positions [B N, 2], states [B N, C], shift."""
        return self.x.shape[1], self.x.view(-1, 2), self.states.view(self.total, -1), self.shift

    def means_and_goal(self) -> tuple[Tensor | None, Tensor | None]:
        """Kernel arguments: each world's mean position, [B, 2], and the goal; or None, None."""
        return None if self.goal is None else average(self.x), self.goal


def splat_lanes(device: torch.device) -> int:
    """Return the number of threads that share a tile, or a particle, on a device."""
    return TILE_LANES if device.type == "cuda" else 1


def device_kernels(like: Tensor) -> Any:
    """Return the kernels of `splat` for a tensor's dtype and device."""
    return splat_kernels(SCALARS[like.dtype], splat_lanes(like.device))


def _check_size(largest: int, world_count: int, view: Any) -> None:
    if largest >= MAX_INDEX:
        raise NPAError(
            f"pictures must stay below {MAX_INDEX} numbers in one batch, got {world_count} "
            f"worlds of {view.resolution} x {view.resolution} pixels: split the batch"
        )


def sort_splats(splats: Splats, view: Any) -> tuple[Tensor, Tensor, Tensor]:
    """Sort splats by cell; return each cell's first, all footprints [B N, 8], all particles [B N].

    The first and particles are indices. A footprint is a splat in pixels of `view` (`make_view`).
    """
    x, total = splats.x, splats.total
    world_count, particle_count, _ = x.shape
    cell_total = world_count * view.cell_count
    _check_size(max(cell_total, x.numel()), world_count, view)
    footprints = x.new_empty(total, FOOTPRINT)
    original_index = torch.empty(total, dtype=torch.int32, device=x.device)
    request = KernelRequest(x.device, x.dtype, particle_count, view.cell_count, 2)
    capacity = block_capacity(request, x)
    if capacity:
        starts = original_index.new_empty(cell_total + 1)
        slices = slice_count(x.device, world_count, particle_count)
        kernel, block = sort_small_splats(capacity), BLOCKS[capacity]
        threads, written = world_count * slices * block, (starts, footprints, original_index)
        contents = (slices, *splats.arguments(), splats.goal)
        launch(kernel, threads, x.device, view, *contents, *written, block_dim=block)
        return written
    kernels, contents, moves = device_kernels(x), splats.arguments(), splats.means_and_goal()
    cell, arrival, arrived = torch.empty(3, total, dtype=torch.int32, device=x.device).unbind()
    counts = torch.zeros(cell_total + 1, dtype=torch.int32, device=x.device)
    counted = (cell, arrival, counts)
    launch(kernels.count_splats, total, x.device, view, *contents[:2], *moves, *counted)
    starts = torch.cumsum(counts, 0, dtype=torch.int32)
    launch(kernels.place_splats, total, x.device, cell, arrival, starts, arrived)
    sorted_splats = (cell, arrived, starts, footprints, original_index)
    launch(kernels.order_splats, total, x.device, view, *contents, *moves, *sorted_splats)
    return starts, footprints, original_index


def scatter_splats(splats: Splats, view: Any) -> tuple[Tensor, Tensor, Tensor]:
    """Return pictures [B, R, R, 4], and footprints and particles as `sort_splats`, on a CPU."""
    x, total = splats.x, splats.total
    picture = x.new_empty(x.shape[0], view.resolution, view.resolution, CHANNELS)
    footprints = x.new_empty(total, FOOTPRINT)
    original_index = torch.empty(total, dtype=torch.int32, device=x.device)
    scratch = x.new_empty(x.shape[0], min(2 * view.radius + 1, view.resolution))
    drawn = (scratch, picture, footprints, original_index)
    contents = (*splats.arguments(), *splats.means_and_goal())
    launch(device_kernels(x).scatter_splats, x.shape[0], x.device, view, *contents, *drawn)
    return picture, footprints, original_index


@custom_op("npa::splat")
def _splat(
    x: Tensor,
    colour: Tensor,
    resolution: int,
    pixel_size: float,
    sigma: float,
    low: float,
    high: float,
) -> tuple[Tensor, Tensor, Tensor]:
    view = make_view(SCALARS[x.dtype], int(resolution), pixel_size, sigma, low, high)
    splats = Splats(x, colour)
    if x.device.type != "cuda":
        return scatter_splats(splats, view)
    _check_size(x.shape[0] * CHANNELS * view.resolution**2, x.shape[0], view)
    starts, footprints, original_index = sort_splats(splats, view)
    picture = x.new_empty(x.shape[0], view.resolution, view.resolution, CHANNELS)
    groups = x.shape[0] * group_count(view.resolution)
    threads = groups * GROUP_WIDTH * GROUP_HEIGHT * TILE_LANES
    flat = picture.view(-1, CHANNELS)
    launch(device_kernels(x).gather_splats, threads, x.device, view, starts, footprints, flat)
    return picture, footprints, original_index


@custom_op("npa::splat_backward")
def _splat_backward(
    picture_bar: Tensor,
    footprints: Tensor,
    original_index: Tensor,
    pixel_size: float,
    sigma: float,
    low: float,
    high: float,
) -> tuple[Tensor, Tensor]:
    world_count, resolution = picture_bar.shape[:2]
    total = footprints.shape[0]
    positions_bar = footprints.new_empty(total, 2)
    colours_bar = footprints.new_empty(total, 3)
    launch(
        device_kernels(footprints).pull_back_splats,
        (total, splat_lanes(footprints.device)),
        footprints.device,
        make_view(SCALARS[footprints.dtype], int(resolution), pixel_size, sigma, low, high),
        total // world_count,
        footprints,
        original_index,
        aligned(picture_bar).view(-1, CHANNELS),
        positions_bar,
        colours_bar,
    )
    return positions_bar, colours_bar


class _Splat(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, colour: Tensor, resolution: int, *view: float) -> Tensor:
        picture: Tensor
        picture, *saved = _splat(x, colour, resolution, *view)
        ctx.view = view
        ctx.shapes = (x.shape, colour.shape)
        ctx.save_for_backward(*saved)
        return picture

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, picture_bar: Tensor) -> tuple[Tensor | None, ...]:
        positions_bar, colours_bar = _splat_backward(picture_bar, *ctx.saved_tensors, *ctx.view)
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
    sigma R h / (hi - lo) pixels, and its weights sum to (R h / (hi - lo))^2, so particles at the
    density of the target's pixels give a density of about 1 (as in the 2D loss of arXiv
    2601.16096).

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
        weights. Row r is at y = lo + r / (R - 1) (hi - lo), so y points to higher rows.

    Raises:
        NPAError: A shape does not fit or a number is out of its range.
    """
    check_particles(x, colour, 3)
    window = checked_window(resolution, pixel_size, sigma, lo, hi)
    picture: Tensor = _Splat.apply(  # type: ignore[no-untyped-call]
        x.contiguous(), colour.contiguous(), *window
    )
    return picture


def check_particles(x: Tensor, colour: Tensor, width: int | None) -> None:
    """Check x [B, N, 2] and colours [B, N, width]; `width` None: states of 3 channels or more."""
    check_world(x, colour)
    check_derivatives(x=x, colour=colour)
    fits = colour.shape[2] >= 3 if width is None else colour.shape[2] == width
    if x.shape[2] != 2 or not fits:
        names = "x and states" if width is None else "x and colour"
        last = "C of at least 3" if width is None else width
        raise NPAError(
            f"{names} must have shapes [B, N, 2] and [B, N, {last}], "
            f"got {tuple(x.shape)} and {tuple(colour.shape)}"
        )


def checked_window(
    resolution: int, pixel_size: float, sigma: float, low: float, high: float
) -> tuple[int, float, float, float, float]:
    """Return these arguments of `splat`, where `low` is `lo`, as checked Python numbers."""
    if checked_count("resolution", resolution) < 2:
        raise NPAError(f"resolution must be at least 2 pixels, got {resolution}")
    side = checked_side("resolution", resolution)
    pixel, spread = checked_positive("pixel_size", pixel_size), checked_positive("sigma", sigma)
    begin, end = checked_number("lo", low), checked_number("hi", high)
    if not (begin < end and math.isfinite(end - begin)):
        raise NPAError(f"the window must have lo < hi, got lo={begin:g} and hi={end:g}")
    pixels = side * pixel / (end - begin)
    for name, size in (("a pixel of the target", pixels), ("sigma", spread * pixels)):
        if not 1.0 / MAX_SPOT <= size <= MAX_SPOT:
            raise NPAError(
                f"{name} must have a size in [{1.0 / MAX_SPOT:g}, {MAX_SPOT:g}] pixels of "
                f"the picture, got {size:g}: choose pixel_size, sigma and the window alike"
            )
    if not abs(begin) <= MAX_SPOT * side * (end - begin):
        raise NPAError(
            f"the window must not be tiny compared to its distance from the origin, got "
            f"lo={begin:g} and hi={end:g}: move the particles to the origin"
        )
    return side, pixel, spread, begin, end


def periodic_splat(
    x: Tensor,
    colour: Tensor,
    *,
    resolution: int,
    pixel_size: float,
    sigma: float = 1.0,
    lo: float = -1.0,
    hi: float = 1.0,
) -> Tensor:
    """Draw 2D worlds in a periodic box as pictures that tile without a seam; differentiable.

    As `splat`, but the R pixels of a row divide the box evenly: pixel q is centred at
    lo + (q + 1/2) (hi - lo) / R, and the first pixel follows the last. Particles outside the box
    are drawn at their images inside it. Pictures are bit for bit the same in every batch.

    Worlds are drawn by the kernels of `splat` on a canvas with margins. Pixels of a margin are then
    added to those on the opposite side. Arguments, results and errors are those of `splat`; `lo`
    and `hi` are the edges of the box in both directions.
    """
    check_particles(x, colour, 3)
    resolution, pixel_size, sigma, lo, hi = checked_window(resolution, pixel_size, sigma, lo, hi)
    step = (hi - lo) / resolution
    # A particle at the upper edge may round to the pixel after the last one.
    margin = math.ceil(PATCH_SIGMAS * sigma * pixel_size / step) + 1
    side = resolution + 2 * margin
    if side > MAX_SIDE:
        raise NPAError(
            f"Gaussians must be so small that the picture and its margins stay within "
            f"{MAX_SIDE} pixels, got {shown(side)}: choose a smaller sigma or pixel_size"
        )
    # The images are subtracted without gradient: the result has the gradient of the position.
    boxes = ((x.detach() - lo) / (hi - lo)).floor()
    canvas = splat(
        x - boxes * (hi - lo),
        colour,
        resolution=side,
        # Pixels and Gaussians have the same sizes on the canvas as in the box.
        pixel_size=pixel_size * (side - 1) / side,
        sigma=sigma,
        lo=lo + (0.5 - margin) * step,
        hi=hi + (margin - 0.5) * step,
    )
    return _sum_periods(_sum_periods(canvas, 1, margin, resolution), 2, margin, resolution)


def _sum_periods(canvas: Tensor, dim: int, margin: int, period: int) -> Tensor:
    """Return sums of pixels a `period` apart along `dim`, in order from the end of the margin."""
    length = canvas.shape[dim]
    shape = list(canvas.shape)
    shape[dim] = period
    folded = canvas.new_zeros(shape)
    begin = 0
    while begin < length:
        pixel = (begin - margin) % period
        count = min(period - pixel, length - begin)
        folded.narrow(dim, pixel, count).add_(canvas.narrow(dim, begin, count))
        begin += count
    return folded


# Losses against a target, without gradient: on CUDA no picture is written.

BLOCKS_OF_PROCESSOR = 4
"""Blocks per multiprocessor that gather errors in parallel."""


@custom_op("npa::picture_losses", of_all=True)
def _picture_losses(
    x: Tensor,
    states: Tensor,
    goal: Tensor,
    target: Tensor,
    shift: float,
    pixel_size: float,
    sigma: float,
    low: float,
    high: float,
) -> Tensor:
    world_count, device, scalar = x.shape[0], x.device, SCALARS[x.dtype]
    view = make_view(scalar, int(target.shape[0]), pixel_size, sigma, low, high)
    splats = Splats(x, states, shift, goal.view(1, 2))
    if device.type == "cuda":
        starts, footprints, _ = sort_splats(splats, view)
        tile_total = view.tile_columns * view.tile_rows
        partial_sums = x.new_empty(world_count, tile_total, 2, dtype=torch.float64)
        # Fewer tiles for a block if many would leave multiprocessors idle.
        tile_count, fewest = BLOCK_TILES, BLOCKS_OF_PROCESSOR * multiprocessor_count(device)
        while tile_count > ROUND_TILES and world_count * tile_total < fewest * tile_count:
            tile_count //= 2
        threads = world_count * -(-tile_total // tile_count) * CUDA_BLOCK
        pixels = aligned(target).view(-1, CHANNELS)
        gathered = (tile_count, starts, footprints, pixels, partial_sums)
        launch(gather_errors(scalar), threads, device, view, *gathered)
    else:
        picture, *_ = scatter_splats(splats, view)
        rows = (world_count, view.resolution)
        partial_sums = x.new_empty(*rows, 2, dtype=torch.float64)
        launch(sum_errors(scalar), rows, device, picture, target.contiguous(), partial_sums)
    return average_sums(partial_sums, view.resolution**2, x)


def picture_losses(
    x: Tensor,
    states: Tensor,
    target: Tensor,
    *,
    goal: Tensor,
    shift: float,
    pixel_size: float,
    sigma: float = 1.0,
    lo: float = -1.0,
    hi: float = 1.0,
) -> tuple[Tensor, Tensor]:
    """Return errors of worlds' pictures, which are compared with a target; without gradient.

    Each world's mean position is moved to `goal` and drawn as by `splat`; colours are the last
    three states plus `shift`. With d the difference from the target and e = |d| + d^2, a pixel's
    density error is e of the densities, its colour error is the mean of e over the colours times
    exp(-(density error)). The target has shape [R, R, 4], the goal [2].

    Returns:
        Means over the pixels of the density error and of the colour error, shape [B] each, bit for
        bit the same in every batch.
    """
    check_particles(x, states, None)
    resolution = target.shape[0] if target.ndim else 0
    if tuple(target.shape) != (resolution, resolution, CHANNELS) or tuple(goal.shape) != (2,):
        raise NPAError(
            f"target and goal must have shapes [R, R, {CHANNELS}] and [2], "
            f"got {tuple(target.shape)} and {tuple(goal.shape)}"
        )
    window = checked_window(resolution, pixel_size, sigma, lo, hi)
    x, states, target, goal = (t.detach() for t in (x, states, target.to(x), goal.to(x)))
    losses = _picture_losses(
        x.contiguous(), states.contiguous(), goal.contiguous(), target, shift, *window[1:]
    )
    return losses[:, 0], losses[:, 1]
