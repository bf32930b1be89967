"""The SPH operators in plain torch, O(N^2), any floating dtype: the reference of the tests.

The code follows the formulas of arXiv 2601.16096, section 3; autograd computes the adjoints. It
allocates B N^2 C D numbers, enough for a few hundred particles. Positions x [B, N, D], the
perception radius eps and the sides of a periodic box are in length units, states s [B, N, C] are
dimensionless.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

MOMENT_THRESHOLD = 1e-3
"""Smallest |det M| that is inverted, dimensionless."""

MOMENT_SOFTENING = 1e-2
"""τ: the det M at which the smooth inverse is midway between M^-1 and I, dimensionless."""


class ReferenceFields(NamedTuple):
    """SPH fields, not scaled by eps0; shapes and units as in `npa_envs.PerceptionFields`."""

    rho: Tensor
    blur: Tensor
    grad0: Tensor
    moment: Tensor
    grad1: Tensor
    drho: Tensor


def differences(x: Tensor, box: tuple[float, ...] | None = None) -> Tensor:
    """Return r_ji = x_j - x_i [length units], the minimum image in a box, shape [B, N, N, D]."""
    r = x[:, None, :, :] - x[:, :, None, :]
    if box is not None:
        sides = torch.tensor(box, dtype=x.dtype, device=x.device)
        r = r - sides * torch.round(r / sides).detach()
    return r


def reflected(x: Tensor, box: tuple[float, ...]) -> Tensor:
    """Return positions reflected at the walls of a box: a triangle wave of each coordinate."""
    sides = torch.tensor(box, dtype=x.dtype, device=x.device)
    return 0.5 * sides - (torch.remainder(x + 0.5 * sides, 2.0 * sides) - sides).abs()


def smoothing_kernel(squared_distance: Tensor, eps: float, space_dim: int) -> Tensor:
    """Return the Poly6 kernel W [1 / length^D], zero outside its support."""
    norm = 4.0 / math.pi / eps**8 if space_dim == 2 else 315.0 / (64.0 * math.pi) / eps**9
    inside = squared_distance < eps * eps
    return torch.where(inside, norm * (eps * eps - squared_distance) ** 3, 0.0)


def spiky_gradient(r: Tensor, eps: float) -> Tensor:
    """Return the spiky gradient kernel K(r) [1 / length^(D+1)], zero at r = 0 and outside.

    In 2D its factor is 30 / (pi eps^5): the gradient of the normalised spiky kernel, whose own
    factor is 10 / (pi eps^5).
    """
    space_dim = r.shape[-1]
    norm = 30.0 / math.pi / eps**5 if space_dim == 2 else 45.0 / math.pi / eps**6
    squared = (r * r).sum(dim=-1, keepdim=True)
    inside = (squared < eps * eps) & (squared > 0.0)
    # Masked before dividing: gradients of 0 / 0 would be NaN even where it is not chosen.
    distance = torch.where(inside, squared, 1.0).sqrt()
    return torch.where(inside, norm * (eps - distance) ** 2 / distance * r, 0.0)


def log_scale(v: Tensor) -> Tensor:
    """Return L(v) = log(1 + |v|) v / |v| of vectors in the last dimension; 0 at 0."""
    largest = v.detach().abs().amax(dim=-1, keepdim=True)
    # Scaled so that the square does not overflow.
    unit = torch.where(largest > 1e18, largest, 1.0)
    v = v / unit
    squared = (v * v).sum(dim=-1, keepdim=True)
    nonzero = squared > 0.0
    length = torch.where(nonzero, squared, 1.0).sqrt()
    return torch.where(nonzero, torch.log1p(unit * length) / length, 1.0) * v


def threshold_inverse(moment: Tensor) -> Tensor:
    """Return M^-1 where |det M| >= `MOMENT_THRESHOLD`, else the identity, shape [..., D, D]."""
    invertible = torch.linalg.det(moment).abs() >= MOMENT_THRESHOLD
    unit = torch.eye(moment.shape[-1], dtype=moment.dtype, device=moment.device).expand_as(moment)
    inverse: Tensor = torch.linalg.inv(torch.where(invertible[..., None, None], moment, unit))
    return inverse


def adjugate(moment: Tensor) -> Tensor:
    """Return adj M, det M M^-1 if M is invertible, of symmetric matrices M, shape [..., D, D]."""
    trace = torch.diagonal(moment, dim1=-2, dim2=-1).sum(dim=-1)[..., None, None]
    unit = torch.eye(moment.shape[-1], dtype=moment.dtype, device=moment.device)
    if moment.shape[-1] == 2:
        return trace * unit - moment
    # By the Cayley-Hamilton theorem.
    square = moment @ moment
    square_trace = torch.diagonal(square, dim1=-2, dim2=-1).sum(dim=-1)[..., None, None]
    return square - trace * moment + 0.5 * (trace * trace - square_trace) * unit


def smooth_inverse(moment: Tensor) -> Tensor:
    """Return (det M adj M + τ² I) / (det² M + τ²) of symmetric matrices, shape [..., D, D].

    It is w M^-1 + (1 - w) I with w = det² M / (det² M + τ²), written without the inverse.
    """
    determinant: Tensor = torch.linalg.det(moment)[..., None, None]
    softening = MOMENT_SOFTENING**2
    unit = torch.eye(moment.shape[-1], dtype=moment.dtype, device=moment.device)
    blend = determinant * adjugate(moment) + softening * unit
    return blend / (determinant * determinant + softening)


def fields(
    x: Tensor,
    s: Tensor,
    eps: float,
    box: tuple[float, ...] | None = None,
    moment_inverse: str = "threshold",
) -> ReferenceFields:
    """Return the SPH fields of every particle, differentiable in x and s."""
    r = differences(x, box)
    weight = smoothing_kernel((r * r).sum(dim=-1), eps, x.shape[2])
    kernel = spiky_gradient(r, eps)
    rho = weight.sum(dim=2)
    volume = 1.0 / rho
    blur = torch.einsum("bij,bj,bjc->bic", weight, volume, s)
    offset = s[:, None, :, :] - s[:, :, None, :]
    grad0 = torch.einsum("bj,bijc,bijd->bicd", volume, offset, kernel)
    moment = torch.einsum("bj,bijd,bije->bide", volume, r, kernel)
    inverse = smooth_inverse(moment) if moment_inverse == "smooth" else threshold_inverse(moment)
    return ReferenceFields(rho, blur, grad0, moment, grad0 @ inverse, kernel.sum(dim=2))


def perceive(
    x: Tensor,
    s: Tensor,
    eps: float,
    eps0: float,
    box: tuple[float, ...] | None = None,
    detach_positions: bool = True,
    moment_inverse: str = "threshold",
) -> Tensor:
    """Return perception vectors z, shape [B, N, P]; arguments as `npa_envs.perceive`."""
    if detach_positions:
        x = x.detach()
    scale = eps / eps0
    particle_count, space_dim = x.shape[1:]
    values = fields(x, s, eps, box, moment_inverse)
    gradient = values.grad0 + (values.grad1 - values.grad0).detach()
    return torch.cat(
        (
            s,
            values.blur,
            log_scale(scale * gradient).flatten(2),
            log_scale(scale ** (1 + space_dim) * values.drho / particle_count),
        ),
        dim=-1,
    )


def splat(
    x: Tensor,
    colour: Tensor,
    *,
    resolution: int,
    pixel_size: float,
    sigma: float = 1.0,
    lo: float = -1.0,
    hi: float = 1.0,
    patch_sigmas: float = 3.0,
) -> Tensor:
    """Return pictures of 2D worlds, shape [B, R, R, 4]; arguments as `npa_envs.ops.splat`.

    A particle's square patch reaches `patch_sigmas` standard deviations to each side.
    """
    pixels = resolution * pixel_size / (hi - lo)
    deviation = sigma * pixels
    radius = math.ceil(patch_sigmas * deviation)
    position = (x - lo) / (hi - lo) * (resolution - 1)
    centre = torch.floor(position + 0.5)
    patch = torch.arange(-radius, radius + 1, dtype=x.dtype, device=x.device)
    grid = torch.arange(resolution, dtype=x.dtype, device=x.device)

    def gaussian(offset: Tensor) -> Tensor:
        return torch.exp(-0.5 * (offset / deviation) ** 2)

    patch_sum = gaussian((centre - position)[..., None] + patch).sum(dim=-1).prod(dim=-1)
    covered = (grid - centre[..., None]).abs() <= radius
    along = torch.where(covered, gaussian(grid - position[..., None]), 0.0)
    weight = along[..., 1, :, None] * along[..., 0, None, :]
    weight = weight * (pixels * pixels / patch_sum)[..., None, None]
    channels = torch.cat((colour, torch.ones_like(colour[..., :1])), dim=-1)
    return torch.einsum("bnyx,bnc->byxc", weight, channels)
