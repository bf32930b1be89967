"""The project's own renderer against gsplat, where that can be built (CUDA); in one run.

Four worlds of `duck-v0`, 16 384 Gaussians each, seen by four cameras at 192 x 192 pixels: the
seed, and the world at step 128. Prints the relative differences of pictures and gradients, and
medians of 20 times [µs], twice, in turn. gsplat draws one world after the other, and cannot be
recorded in a CUDA graph.

    pip install gsplat ninja
    python benchmarks/renderers.py
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable
from functools import partial

import gsplat
import torch
from drift import relative_error
from torch import Tensor

import npa_envs
from npa_envs.ops import Cameras, render_gaussians
from npa_envs.tasks.gaussian_outputs import Gaussians
from npa_envs.tasks.targets.views import some_views
from npa_envs.training.task_of_rule import task_of_rule
from npa_envs.world.cuda_graph import capture

DEVICE = torch.device("cuda")
NAMES = ("own", "gsplat")


def gsplat_renderer(x: Tensor, gaussians: Gaussians, cameras: Cameras) -> tuple[Tensor, Tensor]:
    """Draw with gsplat; not inside a CUDA graph, as it reads numbers back."""
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


def own_renderer(x: Tensor, gaussians: Gaussians, cameras: Cameras) -> tuple[Tensor, Tensor]:
    """Draw with this package."""
    pictures = render_gaussians(x, *gaussians[:4], cameras)
    return pictures.image, pictures.alpha


RENDERERS = {"own": own_renderer, "gsplat": gsplat_renderer}
"""By name."""


def median_time(call: Callable[[], object]) -> float:
    """Return the median of 20 times of a call [µs], after five that do not count."""
    times = []
    for number in range(25):
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        start.record()
        call()
        end.record()
        end.synchronize()
        if number >= 5:
            times.append(1e3 * start.elapsed_time(end))
    return statistics.median(times)


def compared(task: object, x: Tensor, s: Tensor, cameras: object) -> dict[str, object]:
    """Return differences and times of both renderers on some worlds."""
    looks = task.gaussians(s)
    fields = ("scales", "quaternions", "opacities", "colours")
    looks = looks._replace(**{f: getattr(looks, f).detach().requires_grad_() for f in fields})
    leaves = [x.detach().requires_grad_(), *(getattr(looks, f) for f in fields)]

    def pictures(name: str) -> tuple[Tensor, Tensor]:
        return RENDERERS[name](leaves[0], looks, cameras)

    drawn = {name: pictures(name) for name in NAMES}
    weights = torch.randn_like(drawn["own"][0])

    def gradients(name: str) -> tuple[Tensor, ...]:
        return torch.autograd.grad((pictures(name)[0] * weights).sum(), leaves)

    slopes = zip(("positions", *fields), *(gradients(name) for name in NAMES), strict=True)
    row: dict[str, object] = {
        "image": relative_error(drawn["own"][0], drawn["gsplat"][0]),
        "alpha": relative_error(drawn["own"][1], drawn["gsplat"][1]),
        "gradients": {field: relative_error(own, other) for field, own, other in slopes},
    }
    for number in range(2):
        for name in NAMES:

            @torch.no_grad()
            def forward(name: str = name) -> object:
                return pictures(name)

            row[f"{name} forward us {number}"] = median_time(forward)
            row[f"{name} forward and backward us {number}"] = median_time(partial(gradients, name))
            if name == "own":
                row[f"{name} forward in a graph us {number}"] = median_time(
                    capture(forward, DEVICE, generator=None, warm_up=forward).replay
                )
    return row


def main() -> None:
    """Compare both renderers on a seed and on a grown world."""
    print(f"gsplat {gsplat.__version__}, torch {torch.__version__}, {torch.cuda.get_device_name()}")
    rule = npa_envs.load_rule("duck-v0", device=DEVICE).requires_grad_(False)
    task = task_of_rule("duck-v0", rule, DEVICE).task
    generator = torch.Generator(DEVICE).manual_seed(1)
    x, s, *_ = task.seed(4, generator=generator, device=DEVICE)
    with torch.no_grad():
        grown = npa_envs.rollout(rule, x, s, 128, generator=generator)
    cameras = some_views(task.target.training, torch.arange(4, device=DEVICE)).cameras
    for what, worlds in (("seed", (x, s)), ("step 128", grown)):
        print(what, json.dumps(compared(task, *worlds, cameras), indent=1))


if __name__ == "__main__":
    main()
