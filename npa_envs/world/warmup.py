"""Compilation of kernels before they are needed: worlds of every kind run once."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

from npa_envs.checks import DTYPES, entries
from npa_envs.devices import check_device
from npa_envs.errors import NPAError, shown
from npa_envs.ops import orbit, perceive, render_gaussians, splat, world_mean
from npa_envs.ops.backend import SHARED_WORLD
from npa_envs.ops.episodes import EpisodeRules, EpisodeUpdate
from npa_envs.ops.perceive import build_neighbours
from npa_envs.ops.physics import Limits, Physics
from npa_envs.ops.pictures.losses import picture_losses
from npa_envs.ops.pictures.triangles import nearest_triangles
from npa_envs.ops.update import ActedWorlds, PreparedActions
from npa_envs.rule.rule import NPARule
from npa_envs.world.execute import MIN_STATIC
from npa_envs.world.randomness import WorldRandom
from npa_envs.world.rollout import rollout


def warmup(
    device: str | torch.device = "cpu",
    *,
    space_dims: Iterable[int] = (2,),
    dtypes: Iterable[torch.dtype] = (torch.float32,),
    state_dim: int = 16,
) -> None:
    """Compile and load every kernel that worlds of these kinds need; cached on disk by Warp.

    Args:
        device: Device to compile for.
        space_dims: Space dimensions, 2 or 3 each.
        dtypes: `torch.float32`, `torch.float64` or both.
        state_dim: State channels C; kernels serve groups of 4, 8 or 16 channels.

    Raises:
        NPAError: There is no such device, or no such kernels.
    """
    device = check_device(device)
    space_dims = _chosen("space_dims", space_dims, (2, 3))
    dtypes = _chosen("dtypes", dtypes, DTYPES)
    random = WorldRandom([0], device=device)
    random.integers(2, 1)
    _update_episodes(device)
    for dtype, space_dim in itertools.product(dtypes, space_dims):
        random.uniform(1, dtype=dtype)
        x, s = (
            torch.zeros(1, 1, size, dtype=dtype, device=device) for size in (space_dim, state_dim)
        )
        world_mean(s)
        leaves = x.clone().requires_grad_(), s.clone().requires_grad_()
        perceive(*leaves, 0.1, detach_positions=False).sum().backward()  # type: ignore[no-untyped-call]
        # Small, medium and large worlds run different kernels.
        for count in (2, SHARED_WORLD, SHARED_WORLD + 1):
            worlds = x.expand(-1, count, -1), s.expand(-1, count, -1)
            _observe(*worlds)
            _roll_out(*worlds, random)
        _act(x, s)
        _roll_out(x, s, random, static=True)
        for chiral in (False, True)[: 4 - space_dim]:
            _roll_out(x, s, random, equivariant=True, chiral=chiral)
        if space_dim == 2:
            colours = x.new_zeros(1, 1, 3).requires_grad_()
            splat(x, colours, resolution=8, pixel_size=0.1).sum().backward()  # type: ignore[no-untyped-call]
        else:
            _draw_views(x)


def _chosen(name: str, value: Any, known: tuple[Any, ...]) -> list[Any]:
    """Return the values given, one or several, after checking that each is known."""
    chosen = entries(value)
    if not chosen or not all(value in known for value in chosen):
        raise NPAError(f"{name} must be some of {known}, got {shown(value)}: name one or both")
    return chosen


def _update_episodes(device: torch.device) -> None:
    number, flag = torch.zeros(1, device=device), torch.zeros(1, dtype=torch.uint8, device=device)
    update = EpisodeUpdate(
        EpisodeRules(None, None, "terminate"),
        enabled=flag,
        diverged=flag,
        first_loss=number,
        success_loss=number,
        elapsed=number.int(),
        numbers=number.new_zeros(4, 1),
        flags=flag.new_zeros(4, 1, dtype=torch.bool),
        endings=flag.new_zeros(2),
    )
    update(number[None])


def _physics(x: Tensor, s: Tensor) -> Physics:
    limits = Limits(1.0, 1.0, 1.0, 1.0)
    return Physics(x.shape[2], s.shape[2], 0.1, 0.1, max_displacement=0.1, limits=limits)


def _observe(x: Tensor, s: Tensor) -> None:
    build_neighbours(x, s, _physics(x, s)).perceive()
    if x.shape[2] == 2:
        target, middle = x.new_zeros(8, 8, 4), x.new_zeros(2)
        picture_losses(x, s, target, goal=middle, shift=0.0, pixel_size=0.1)


def _act(x: Tensor, s: Tensor) -> None:
    physics = _physics(x, s)
    enabled, diverged = torch.ones(2, 1, dtype=torch.uint8, device=x.device)
    worlds = ActedWorlds(x.clone(), s.clone(), None, None, enabled, diverged)
    PreparedActions(worlds, physics)(x.new_zeros(1, 1, physics.action_dim))


def _roll_out(x: Tensor, s: Tensor, random: WorldRandom, **form: bool) -> None:
    """Run a rule on all and on some particles, with and without gradients."""
    with torch.random.fork_rng(devices=[]):
        rule = NPARule(x.shape[2], s.shape[2], **form).to(x)
    # Static worlds are sorted in advance for a few steps or more.
    steps, noise = (MIN_STATIC, 0.0) if rule.static else (1, 0.01)
    for update_prob, gradients in itertools.product((0.5, 1.0), (False, True)):
        states = s.clone().requires_grad_(gradients)
        options: Any = {"update_prob": update_prob, "position_noise": noise, "generator": random}
        with torch.set_grad_enabled(gradients):
            _, states = rollout(rule, x, states, steps, **options)
        if gradients:
            states.sum().backward()


def _draw_views(x: Tensor) -> None:
    """Draw worlds, and meshes as targets, by cameras."""
    cameras = orbit(1, width=16, height=16).to(x)
    colours = x.new_zeros(1, 1, 4, 3).requires_grad_()
    scales, quaternions, opacities = x.new_ones(1, 1, 3), x.new_ones(1, 1, 4), x.new_ones(1, 1)
    pictures = render_gaussians(x, scales, quaternions, opacities, colours, cameras)
    pictures.image.sum().backward()  # type: ignore[no-untyped-call]
    corners = torch.zeros(1, 3, dtype=torch.float64, device="cpu")
    nearest_triangles(
        corners[..., None].expand(-1, -1, 2),
        corners,
        corners[0, :, None].expand(-1, 3),
        torch.arange(3, device="cpu")[None],
        corners[:, :1] == 0.0,
        width=1,
        height=1,
    )
