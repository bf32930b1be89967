"""Looks of particles in 3D: Gaussians from a rule's outputs, and what draws them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from npa_envs.errors import MissingDependencyError, NPAError
from npa_envs.ops import Cameras, render_gaussians

OUTPUTS = 20
"""Read-out dimensions: rotation 4, log-anisotropy 3, opacity 1, colours of degree 1 9, of 0 3."""

FLAT = 0.5 * math.sqrt(1.0 / math.pi)
"""The spherical harmonic of degree 0 (dimensionless)."""


class Gaussians(NamedTuple):
    """What `render_gaussians` takes besides positions and cameras."""

    scales: Tensor
    """Standard deviations [length units], shape [B, N, 3]."""

    quaternions: Tensor
    """Rotations (w, x, y, z), shape [B, N, 4]."""

    opacities: Tensor
    """In [0, 1], shape [B, N]."""

    colours: Tensor
    """Spherical harmonics up to degree 1, dimensionless, shape [B, N, 4, 3]."""

    stretch: Tensor
    """log(scales / sigma), dimensionless, shape [B, N, 3]."""


@dataclass(frozen=True)
class Appearance:
    """How outputs become Gaussians.

    20 outputs are a read-out's: four are added to the quaternion (1, 0, 0, 0), three stretch the
    axes, one changes the opacity, nine are colours that depend on where one looks from, and the
    last three, plus 0.5, the colour itself. Of any other number the last three, plus 0.5, are the
    colour, and particles are round.
    """

    sigma: float
    """Standard deviation of a round particle [length units]."""

    anisotropy: float
    """Largest |log(scale / sigma)| (dimensionless)."""

    opacity: float
    """Opacity of a particle whose output is 0, in (0, 1)."""

    def gaussians(self, outputs: Tensor) -> Gaussians:
        """Return the Gaussians of particles.

        Args:
            outputs: A rule's outputs (`NPARule.read_out`), dimensionless, shape [B, N, K], K >= 3.
        """
        lead = outputs.shape[:-1]
        # The renderer adds one half, as `NPARule.colour` does.
        flat = outputs[..., None, -3:]
        if outputs.shape[-1] == OUTPUTS:
            rotation, stretch, opacity, turning = torch.split(
                outputs[..., :17], [4, 3, 1, 9], dim=-1
            )
            upright = torch.ones_like(rotation[..., :1])
            quaternions = torch.cat((rotation[..., :1] + upright, rotation[..., 1:]), dim=-1)
            stretch = self.anisotropy * torch.tanh(stretch)
            rest = math.log(self.opacity / (1.0 - self.opacity))
            opacities = torch.sigmoid(opacity[..., 0] + rest)
            degree_one = turning.reshape(*lead, 3, 3)
        else:
            quaternions = outputs.new_zeros(*lead, 4)
            stretch = outputs.new_zeros(*lead, 3)
            opacities = outputs.new_full(lead, self.opacity)
            degree_one = outputs.new_zeros(*lead, 3, 3)
        colours = torch.cat((flat / FLAT, degree_one), dim=-2)
        return Gaussians(self.sigma * torch.exp(stretch), quaternions, opacities, colours, stretch)


class Renderer(Protocol):
    """Draws 3D worlds; differentiable by everything but the cameras."""

    def __call__(self, x: Tensor, gaussians: Gaussians, cameras: Cameras) -> tuple[Tensor, Tensor]:
        """Return what cameras see before a black background.

        Args:
            x: Positions [length units], shape [B, N, 3].
            gaussians: How particles look.
            cameras: V cameras, the same for all worlds.

        Returns:
            Red, green and blue, shape [B, V, H, W, 3], and alpha, shape [B, V, H, W].
        """


def own_renderer(x: Tensor, gaussians: Gaussians, cameras: Cameras) -> tuple[Tensor, Tensor]:
    """Draw with the project's own kernels: on CPU and CUDA, the same bits on every run."""
    pictures = render_gaussians(
        x,
        gaussians.scales,
        gaussians.quaternions,
        gaussians.opacities,
        gaussians.colours,
        cameras,
    )
    return pictures.image, pictures.alpha


def gsplat_renderer(x: Tensor, gaussians: Gaussians, cameras: Cameras) -> tuple[Tensor, Tensor]:
    """Draw with gsplat; on CUDA alone, and not inside a CUDA graph, as it reads numbers back.

    Raises:
        MissingDependencyError: gsplat is not installed.
        NPAError: The worlds are not on CUDA.
    """
    try:
        import gsplat
    except ImportError as error:
        raise MissingDependencyError(
            "renderer='gsplat' needs gsplat, which is not installed: pip install gsplat, or set "
            "renderer to 'own'"
        ) from error
    if not x.is_cuda:
        raise NPAError(
            f"renderer='gsplat' draws worlds on CUDA, got {x.device}: set renderer to 'own'"
        )
    if torch.cuda.is_available() and torch.cuda.is_current_stream_capturing():
        raise NPAError(
            "renderer='gsplat' cannot be recorded in a CUDA graph: set cuda_graph to False "
            "(--no-cuda-graph), or renderer to 'own'"
        )
    fx, fy, cx, cy = cameras.intrinsics.to(x.dtype).expand(cameras.count, 4).unbind(dim=-1)
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    lenses = torch.stack((fx, zero, cx, zero, fy, cy, zero, zero, one), dim=-1).view(-1, 3, 3)
    # gsplat takes zero-length rotations for numbers that are none.
    turned = gaussians.quaternions
    upright = torch.nn.functional.pad(torch.ones_like(turned[..., :1]), (0, 3))
    turned = torch.where((turned == 0.0).all(dim=-1, keepdim=True), upright, turned)
    images, alphas = [], []
    for world in range(len(x)):
        image, alpha, _ = gsplat.rasterization(
            x[world],
            turned[world],
            gaussians.scales[world],
            gaussians.opacities[world],
            gaussians.colours[world],
            cameras.world_to_camera.to(x.dtype),
            lenses,
            cameras.width,
            cameras.height,
            near_plane=cameras.near,
            sh_degree=1,
            packed=False,
        )
        images.append(image)
        alphas.append(alpha[..., 0])
    return torch.stack(images), torch.stack(alphas)


RENDERERS: Mapping[str, Renderer] = {"own": own_renderer, "gsplat": gsplat_renderer}
"""By name."""
