"""Pictures of periodic worlds: what leaves one edge comes in at the opposite one."""

from __future__ import annotations

import math

from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.kernels.lens import PATCH_SIGMAS
from npa_envs.sph.splat import check_particles, check_window, splat


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
        NPAError: A shape does not fit, a number is out of its range, or a particle's patch is wider
            than the box.
    """
    check_particles(x, colour, 3)
    check_window(resolution, pixel_size, sigma, lo, hi)
    step = (hi - lo) / resolution
    # A particle at the upper edge may round to the pixel behind the last one.
    margin = math.ceil(PATCH_SIGMAS * sigma * pixel_size / step) + 1
    if margin > resolution:
        raise NPAError(
            f"pixel_size times sigma must be small against the box, got {pixel_size} and {sigma} "
            f"in a box of side {hi - lo:g}: a particle's patch may reach at most around it once"
        )
    side = resolution + 2 * margin
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
    return _folded(_folded(canvas, 1, margin), 2, margin)


def _folded(canvas: Tensor, dim: int, margin: int) -> Tensor:
    """Return the canvas with its margins along a dimension added to the opposite sides."""
    low, inside, high = canvas.split((margin, canvas.shape[dim] - 2 * margin, margin), dim=dim)
    folded = inside.clone()
    folded.narrow(dim, inside.shape[dim] - margin, margin).add_(low)
    folded.narrow(dim, 0, margin).add_(high)
    return folded
