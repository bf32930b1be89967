"""What draws Gaussians: the project's own kernels, or gsplat, behind one interface."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import torch
from torch import Tensor

from npa_envs.errors import MissingDependencyError, NPAError
from npa_envs.ops import Cameras, render_gaussians
from npa_envs.tasks.appearance import Gaussians


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
