"""Compilation of kernels before they are needed."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import Any

import torch

from npa_envs.checks import DTYPES, as_list, check_device
from npa_envs.errors import NPAError, shown
from npa_envs.ops.backend import SHARED_WORLD
from npa_envs.ops.equivariance import MIXED_VECTORS, VectorSizes, read_rows, steer_rows
from npa_envs.ops.network import arrange_weights, run_network
from npa_envs.ops.perceive import NeighbourState, perceive, perceive_rows
from npa_envs.ops.physics import Limits, Physics
from npa_envs.ops.pictures.cameras import orbit
from npa_envs.ops.pictures.gaussians import render_gaussians
from npa_envs.ops.pictures.splat import picture_losses, splat
from npa_envs.ops.pictures.triangles import nearest_triangles
from npa_envs.ops.random_numbers import draw, mixed_keys
from npa_envs.ops.rewards_and_ends import EpisodeRules, EpisodeUpdate
from npa_envs.ops.static_worlds import prepare_static, static_rows
from npa_envs.ops.update import ActedWorlds, PreparedActions, update_particles
from npa_envs.ops.world_mean import world_mean


def warmup(
    device: str | torch.device = "cpu",
    *,
    space_dims: Iterable[int] = (2,),
    dtypes: Iterable[torch.dtype] = (torch.float32,),
    state_dim: int = 16,
) -> None:
    """Compile and load all kernels for these dimensions, dtypes and channels; Warp caches them.

    Args:
        device: Device to compile for.
        space_dims: Space dimensions, 2 or 3 each.
        dtypes: `torch.float32`, `torch.float64` or both.
        state_dim: State channels C; kernels serve groups of 4, 8 or 16 channels.

    Raises:
        NPAError: There is no such device, or no such kernels.
    """
    device = check_device(device)
    space_dims = _checked_choice("space_dims", space_dims, (2, 3))
    dtypes = _checked_choice("dtypes", dtypes, DTYPES)
    keys = torch.zeros(1, dtype=torch.int64, device=device)
    counts = torch.zeros(1, dtype=torch.int32, device=device)
    streams = keys, counts, counts, 0
    draw(*streams, "bernoulli", 1, torch.uint8, 1)
    draw(*streams, "integers", 1, torch.int64, 2)
    mixed_keys(keys, 0)
    _warm_rewards(counts)
    for dtype in dtypes:
        draw(*streams, "uniform", 1, dtype, 0)
        draw(*streams, "normal", 1, dtype, 0)
        world_mean(torch.zeros(1, 1, 1, dtype=dtype, device=device))
        for space_dim in space_dims:
            x = torch.zeros(1, 2, space_dim, dtype=dtype, device=device, requires_grad=True)
            s = torch.zeros(1, 2, state_dim, dtype=dtype, device=device, requires_grad=True)
            _warm_worlds(x, s)


def _checked_choice(name: str, value: Any, known: tuple[Any, ...]) -> list[Any]:
    choice = as_list(value)
    if not choice or not all(value in known for value in choice):
        raise NPAError(f"{name} must be some of {known}, got {shown(value)}: name one or both")
    return choice


def _warm_rewards(elapsed: torch.Tensor) -> None:
    number, flag = elapsed.float(), elapsed.byte()
    update_episodes = EpisodeUpdate(
        EpisodeRules(None, None, "terminate"),
        enabled=flag,
        diverged=flag,
        first_loss=number,
        success_loss=number,
        elapsed=elapsed.clone(),
        numbers=number.new_zeros(4, 1),
        flags=flag.new_zeros(4, 1, dtype=torch.bool),
        ending_bits=flag.new_zeros(2),
    )
    update_episodes(number[None])


def _warm_worlds(x: torch.Tensor, s: torch.Tensor) -> None:
    """Run all operators on worlds of two particles, and those of steps on larger worlds."""
    space_dim, state_dim = x.shape[2], s.shape[2]
    _pull_back(perceive(x, s, 0.1, detach_positions=False))
    limits = Limits(1.0, 1.0, 1.0, 1.0)
    physics = Physics(space_dim, state_dim, 0.1, 0.1, max_displacement=0.1, limits=limits)
    # Small, medium and large worlds run different kernels.
    for count in (2, SHARED_WORLD, SHARED_WORLD + 1):
        positions, states = (v.detach()[:, :1].expand(-1, count, -1) for v in (x, s))
        NeighbourState(positions, states, physics).perceive()
        _warm_steps(positions, states, physics)
        if space_dim == 2:
            target, middle = x.new_zeros(8, 8, 4), x.new_zeros(2)
            picture_losses(positions, states, target, goal=middle, shift=0.0, pixel_size=0.1)
    _warm_static(x, s, physics)
    _warm_network(x, physics)
    _warm_invariants(x, state_dim)
    enabled, diverged = torch.ones(2, 1, dtype=torch.uint8, device=x.device)
    acted = ActedWorlds(x.detach().clone(), s.detach().clone(), None, None, enabled, diverged)
    PreparedActions(acted, physics)(x.new_zeros(1, 2, physics.action_dim))
    if space_dim == 2:
        _pull_back(splat(x, x.new_zeros(1, 2, 3), resolution=8, pixel_size=0.1))
    else:
        _warm_views(x)


def _warm_steps(x: torch.Tensor, s: torch.Tensor, physics: Physics) -> None:
    count, width = x.shape[1], physics.perception_dim + 1
    all_active = torch.ones(x.shape[:2], dtype=torch.uint8, device=x.device)
    for mask, gradients in itertools.product((None, all_active), (False, True)):
        worlds = x, s.clone().requires_grad_(gradients)
        rows, maps = perceive_rows(*worlds, physics, mask=mask, row_capacity=count, row_width=width)
        paths = x.new_zeros(x.shape[:2])
        update = rows[:, : physics.action_dim]
        _, states, _ = update_particles(update, *worlds, paths, maps, physics)
        if gradients:
            _pull_back(states)


def _warm_static(x: torch.Tensor, s: torch.Tensor, physics: Physics) -> None:
    static = prepare_static(x, physics)
    mask = torch.ones(x.shape[:2], dtype=torch.uint8, device=x.device)
    size = {"row_capacity": x.shape[1], "row_width": physics.perception_dim + 1}
    for active in (None, *static_rows(static, x.detach(), [mask], x.shape[1])):
        rows, _ = perceive_rows(x, s, physics, mask=None, static=static, static_rows=active, **size)
        _pull_back(rows)


def _warm_network(x: torch.Tensor, physics: Physics) -> None:
    """Run the network's kernels if there are any, with and without displacements."""
    width = physics.perception_dim + 1
    for out in (physics.action_dim, physics.state_dim):
        shapes = (1, width + -width % 4), (128, width + -width % 4), (out + -out % 4, 128)
        rows, hidden, update = (x.new_zeros(shape).requires_grad_() for shape in shapes)
        for gradients in (False, True):
            with torch.set_grad_enabled(gradients):
                arranged = arrange_weights(hidden, update)
                if arranged is not None:
                    weights = torch.cat((hidden.flatten(), update.flatten()))
                    updates = run_network(rows, weights, update.shape, arranged)
        if arranged is not None:
            _pull_back(updates)


def _warm_invariants(x: torch.Tensor, state_dim: int) -> None:
    space_dim = x.shape[2]
    for chiral in (False, True)[: 4 - space_dim]:
        sizes = VectorSizes(space_dim, 2 * state_dim, state_dim + 1, MIXED_VECTORS, chiral)
        rows = x.new_zeros(1, sizes.perception_dim + 1).requires_grad_()
        mixing = x.new_zeros(sizes.perceived, sizes.mixed).requires_grad_()
        mixed, inputs = read_rows(rows, mixing, sizes, sizes.input_dim + 1)
        signs = x.new_ones(sizes.gate_count)
        _pull_back(steer_rows(inputs, mixed, signs, sizes.input_dim))


def _warm_views(x: torch.Tensor) -> None:
    cameras = orbit(1, width=16, height=16)
    scales, colours = x.new_ones(x.shape), x.new_zeros(*x.shape[:2], 4, 3)
    quaternions = x.new_ones(*x.shape[:2], 4)
    pictures = render_gaussians(
        x, scales, quaternions, x.new_ones(x.shape[:2]), colours, cameras.to(x)
    )
    _pull_back(pictures.image)
    corners = torch.zeros(3, 3, dtype=torch.float64, device="cpu")
    faces = torch.arange(3, device="cpu")[None]
    seen = faces[:, :1] == 0
    nearest_triangles(
        corners[None, :, :2], corners[:1], corners[faces], faces, seen, width=1, height=1
    )


def _pull_back(value: torch.Tensor) -> None:
    torch.autograd.backward(value.sum())
