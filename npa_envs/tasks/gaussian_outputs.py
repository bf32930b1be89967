"""The 3D Gaussians that draw particles, made from the outputs of a rule's read-out."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

OUTPUTS = 20
"""Outputs of a read-out: 4 rotation, 3 log-anisotropy, 1 opacity, colour of degree 1 (9), 0 (3)."""

HARMONIC_0 = 0.5 * math.sqrt(1.0 / math.pi)
"""Value of the spherical harmonic of degree 0 (dimensionless)."""


class Gaussians(NamedTuple):
    """One 3D Gaussian for each particle: arguments of `render_gaussians`, without positions."""

    scales: Tensor
    """Standard deviations [length units], shape [B, N, 3]."""
    quaternions: Tensor
    """Rotations (w, x, y, z), shape [B, N, 4]."""
    opacities: Tensor
    """In [0, 1], shape [B, N]."""
    colours: Tensor
    """Spherical harmonics up to degree 1, dimensionless, shape [B, N, 4, 3]."""
    stretch: Tensor
    """log(scales / sigma), dimensionless, shape [B, N, 3]; `render_gaussians` does not take it."""


def appearance(outputs: Tensor, sigma: float, anisotropy: float, opacity: float) -> Gaussians:
    """Return the Gaussian that draws each particle, from K outputs of its rule, [B, N, K].

    If K is 20, four are added to the quaternion (1, 0, 0, 0), three stretch the axes, one changes
    the opacity, nine are coefficients of view-dependent colour, and the last three, plus 0.5, are
    the colour. For any other K Gaussians are round, and the last three outputs, plus 0.5, are the
    colour. The other arguments are the fields of `Morphogenesis3DConfig` with these names.
    """
    lead = outputs.shape[:-1]
    # The renderer adds one half, as `NPARule.colour` does.
    flat = outputs[..., None, -3:]
    if outputs.shape[-1] == OUTPUTS:
        rotation, stretch, log_odds, turning = torch.split(outputs[..., :17], [4, 3, 1, 9], dim=-1)
        upright = torch.ones_like(rotation[..., :1])
        quaternions = torch.cat((rotation[..., :1] + upright, rotation[..., 1:]), dim=-1)
        stretch = anisotropy * torch.tanh(stretch)
        opacities = torch.sigmoid(log_odds[..., 0] + math.log(opacity / (1.0 - opacity)))
        degree_one = turning.reshape(*lead, 3, 3)
    else:
        quaternions = outputs.new_zeros(*lead, 4)
        stretch = outputs.new_zeros(*lead, 3)
        opacities = outputs.new_full(lead, opacity)
        degree_one = outputs.new_zeros(*lead, 3, 3)
    colours = torch.cat((flat / HARMONIC_0, degree_one), dim=-2)
    return Gaussians(sigma * torch.exp(stretch), quaternions, opacities, colours, stretch)
