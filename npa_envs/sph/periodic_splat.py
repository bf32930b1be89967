"""Pictures of periodic worlds: what leaves one edge comes in at the opposite one."""

from __future__ import annotations

import math

from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.kernels.pictures.splat import PATCH_SIGMAS
from npa_envs.sph.checks import LARGEST_SIDE
from npa_envs.sph.splat import check_particles, checked_window, splat


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
    lo + (q + 1/2) (hi - lo) / R, and next to the last pixel is the first. Positions may lie outside
    the box; their images inside it are drawn. World k's picture is the same, bit for bit, in every
    batch.

    Worlds are drawn on a canvas that is wider by a patch on each side, by the kernels of `splat`.
    What lies in a margin is then added where it belongs, on the other side.

    Args:
        x: Particle positions [length units], shape [B, N, 2].
        colour: Particle colours, dimensionless, shape [B, N, 3].
        resolution: Pixels R along each side, 2 or more.
        pixel_size: Side h of a pixel of the target [length units].
        sigma: Standard deviation of the Gaussian in target pixels, dimensionless.
        lo: Lower edge of the box in both directions [length units].
        hi: Upper edge of the box in both directions [length units].

    Returns:
        Pictures, dimensionless, shape [B, R, R, 4]: sums of colour times weight and, last, of the
        weights, which sum to (R h / (hi - lo))^2 for each particle; y points to higher rows.

    Raises:
        NPAError: A shape does not fit or a number is out of its range.
    """
    check_particles(x, colour, 3)
    resolution, pixel_size, sigma, lo, hi = checked_window(resolution, pixel_size, sigma, lo, hi)
    step = (hi - lo) / resolution
    # A particle at the upper edge may round to the pixel behind the last one.
    margin = math.ceil(PATCH_SIGMAS * sigma * pixel_size / step) + 1
    side = resolution + 2 * margin
    if side > LARGEST_SIDE:
        raise NPAError(
            f"spots must reach across so few boxes that picture and margins stay within "
            f"{LARGEST_SIDE} pixels, got {side}: choose a smaller sigma or pixel_size"
        )
    # Whole boxes are taken off without gradient: what is left moves as the particle does.
    boxes = ((x.detach() - lo) / (hi - lo)).floor()
    canvas = splat(
        x - boxes * (hi - lo),
        colour,
        resolution=side,
        # Pixels on the canvas lie as dense as in the box, and spots are as wide.
        pixel_size=pixel_size * (side - 1) / side,
        sigma=sigma,
        lo=lo + (0.5 - margin) * step,
        hi=hi + (margin - 0.5) * step,
    )
    return _folded(_folded(canvas, 1, margin, resolution), 2, margin, resolution)


def _folded(canvas: Tensor, dim: int, margin: int, period: int) -> Tensor:
    """Return the sum of a canvas's pixels that are a period apart; the first lies in a margin."""
    length = canvas.shape[dim]
    shape = list(canvas.shape)
    shape[dim] = period
    folded = canvas.new_zeros(shape)
    begin = 0
    while begin < length:
        place = (begin - margin) % period
        count = min(period - place, length - begin)
        folded.narrow(dim, place, count).add_(canvas.narrow(dim, begin, count))
        begin += count
    return folded
