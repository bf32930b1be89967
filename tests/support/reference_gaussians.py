"""3D Gaussian splatting in plain torch, O(pixels x Gaussians): the reference of its tests.

Every Gaussian is evaluated at every pixel, without tiles; autograd computes the adjoints. A picture
allocates N H W K numbers.
"""

from __future__ import annotations

import torch
from torch import Tensor

MIN_ALPHA = 1.0 / 255.0
MAX_ALPHA = 0.99
MIN_PASSING = 1e-4
CLAMP_MARGIN = 0.3
HARMONICS = (0.28209479177387814, 0.4886025119029199)
"""Factors of the real spherical harmonics of degree 0 and 1: 1/2 sqrt(1/pi), 1/2 sqrt(3/pi)."""


def rotations(quaternions: Tensor) -> Tensor:
    """Return rotation matrices [..., 3, 3] of quaternions (w, x, y, z) of any length, [..., 4]."""
    w, x, y, z = (quaternions / quaternions.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def directed_colours(coefficients: Tensor, directions: Tensor) -> Tensor:
    """Return colours [N, 3] of harmonics [N, 4, 3] in viewing directions, unit vectors [N, 3]."""
    x, y, z = directions.unbind(-1)
    basis = torch.stack((torch.full_like(x, HARMONICS[0] / HARMONICS[1]), -y, z, -x), dim=-1)
    return (HARMONICS[1] * torch.einsum("nk,nkc->nc", basis, coefficients) + 0.5).clamp(min=0.0)


def projected(
    positions: Tensor,
    spreads: Tensor,
    intrinsics: Tensor,
    width: int,
    height: int,
    dilation: float,
) -> tuple[Tensor, Tensor]:
    """Return means [N, 2] and covariances [N, 2, 2] in the picture [pixels, pixels squared].

    `positions` and `spreads`, roots of covariances, are in the camera's frame [length units],
    intrinsics in pixels.
    """
    focal, middle = intrinsics[:2], intrinsics[2:]
    depth = positions[:, 2:]
    ratio = positions[:, :2] / depth
    size = torch.tensor([width, height], dtype=positions.dtype)
    margin = CLAMP_MARGIN * 0.5 * size / focal
    near_view = ratio.clamp(-middle / focal - margin, (size - middle) / focal + margin)
    jacobian = torch.cat(
        ((focal / depth)[..., None] * torch.eye(2), (-focal * near_view / depth)[..., None]), -1
    )
    root = jacobian @ spreads
    covariance = root @ root.mT + dilation * torch.eye(2, dtype=positions.dtype)
    return focal * ratio + middle, covariance


def blended(alphas: Tensor, colours: Tensor) -> tuple[Tensor, Tensor]:
    """Return composited colours [H, W, K] and transmittance [H, W] of sorted alphas [N, H, W]."""
    alphas = torch.where(alphas >= MIN_ALPHA, alphas, 0.0)
    after = torch.cumprod(1.0 - alphas, dim=0)
    alphas = torch.where(after >= MIN_PASSING, alphas, 0.0)
    after = torch.cumprod(1.0 - alphas, dim=0)
    before = torch.cat((torch.ones_like(after[:1]), after[:-1]))
    return torch.einsum("nhw,nhw,nk->hwk", alphas, before, colours), after[-1]


def draw(
    means: Tensor,
    scales: Tensor,
    quaternions: Tensor,
    opacities: Tensor,
    colours: Tensor,
    *,
    view: Tensor,
    intrinsics: Tensor,
    width: int,
    height: int,
    near: float,
    dilation: float = 0.3,
) -> tuple[Tensor, Tensor]:
    """Return one picture [H, W, K], without background, and its transmittance [H, W].

    Arguments are those of `npa_envs.ops.render_gaussians` for one world, with one camera's
    world-to-camera matrix [4, 4] and fx, fy, cx, cy [4].
    """
    rotation, shift = view[:3, :3], view[:3, 3]
    positions = means @ rotation.mT + shift
    visible = positions[:, 2] >= near
    # Replaced before dividing, so that gradients of hidden ones are not 0 times infinity.
    positions = torch.where(visible[:, None], positions, positions.new_tensor([0.0, 0.0, 1.0]))
    spreads = rotation @ rotations(quaternions) * scales[:, None, :]
    centres, covariance = projected(positions, spreads, intrinsics, width, height, dilation)
    if colours.ndim == 3:
        directions = means + rotation.mT @ shift
        colours = directed_colours(colours, directions / directions.norm(dim=-1, keepdim=True))
    rows = torch.arange(height, dtype=means.dtype) + 0.5
    columns = torch.arange(width, dtype=means.dtype) + 0.5
    pixels = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), dim=-1)
    offset = pixels - centres[:, None, None, :]
    power = torch.einsum("nhwi,nij,nhwj->nhw", offset, torch.linalg.inv(covariance), offset)
    alphas = (opacities[:, None, None] * torch.exp(-0.5 * power)).clamp(max=MAX_ALPHA)
    alphas = torch.where(visible[:, None, None], alphas, 0.0)
    order = torch.argsort(positions[:, 2].detach(), stable=True)
    return blended(alphas[order], colours[order])
