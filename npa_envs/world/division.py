"""Particles that divide and die: worlds of N slots, so that tensors keep their shape.

A slot has a living particle or is dead. Its first state channel is its life: 1 for living, 0 for
dead. Nothing in this file waits for the device.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from npa_envs.ops.world_mean import world_mean
from npa_envs.rule.rule import LIFE
from npa_envs.world.particles import Particles

MIN_OFFSPRING = 1e-3
"""Lower limit of m in `divided`, below which life gets no gradient."""

CHILD_DISTANCE = 0.5
"""Root mean square distance of a child from its parent, in perception radii."""

PARKING_DISTANCE = 65536.0
"""Coordinate of the first dead slot during perception, in perception radii."""

PARKING_GAP = 2.5
"""Distance between dead slots, in perception radii: five cells, so each has its own cell."""


class Births(NamedTuple):
    """Random numbers that decide which particles divide or die, and where children begin."""

    uniform: Tensor
    """Decides whether each particle divides, stays or dies, uniform in [0, 1), shape [B, N]."""
    direction: Tensor
    """Direction and distance of each particle's child, standard normal, shape [B, N, D]."""


def living(s: Tensor) -> Tensor:
    """Return which slots have a living particle, bool, shape [B, N]."""
    return s[..., LIFE].detach() > 0.5


def parked(x: Tensor, alive: Tensor, eps: float) -> Tensor:
    """Return positions x with dead slots moved far from all particles and from each other."""
    count, space_dim = x.shape[1:]
    side = 1
    while side**space_dim < count:
        side *= 2
    slot = torch.arange(count, device=x.device)
    cell = torch.stack([slot // side**d % side for d in range(space_dim)], dim=-1)
    far = eps * (PARKING_DISTANCE + PARKING_GAP * cell.to(x.dtype))
    return torch.where(alive[..., None], x, far)


def divided(
    particles: Particles,
    *,
    division_probabilities: tuple[Tensor, Tensor],
    updated: Tensor,
    births: Births,
    eps: float,
) -> Particles:
    """Let updated particles divide, stay or die; return new worlds, differentiable.

    A child starts with states and a path of 0, except for its life. Parent and child move half of
    their distance each, in opposite directions from the parent's position, which paths do not
    include. The k-th child of a world takes its k-th dead slot; with more children than slots, the
    last are not born, and their parents do not move. The last living particle of a world does not
    die. Dead slots get states of 0 and the mean position of the living, so that positions have the
    same mean over all slots.

    The choice to divide or die is discrete. Life is differentiable: its value stays 1, and at each
    update it is multiplied by m / m', with m = 1 + p - d the expected number of particles after
    the update, p and d the probabilities to divide and to die, and m' the same without gradient.
    Children inherit their parent's life. So the gradient of a sum over living particles, weighted
    by life, is on average that of the sum's expected value, as far as particles do not interact
    and child and parent are alike: a birth is credited as if the child were like its parent.

    Args:
        division_probabilities: Probabilities to divide and to die, shape [B, N] each.
        updated: Which living particles were updated, bool, shape [B, N].
        births: Random numbers of the step.
    """
    x, s, *others = particles.per_particle()
    count, space_dim = x.shape[1:]
    alive = living(s)
    divide, die = division_probabilities
    dividing = updated & (births.uniform < divide.detach())
    dying = updated & (births.uniform >= 1.0 - die.detach())
    dying &= (alive & ~dying).any(dim=1, keepdim=True)

    # The k-th child of a world has rank k - 1, and so has the k-th dead slot.
    children, slots = dividing.sum(dim=1, keepdim=True), (~alive).sum(dim=1, keepdim=True)
    child_rank, slot_rank = dividing.cumsum(dim=1) - 1, (~alive).cumsum(dim=1) - 1
    parents = dividing & (child_rank < slots)
    born = ~alive & (slot_rank < children)
    own = torch.arange(count, device=x.device).expand_as(child_rank)
    # Slots without a child write to an extra entry that is not read.
    parent_of_rank = own.new_zeros(len(x), count + 1)
    parent_of_rank.scatter_(1, torch.where(parents, child_rank, count), own)
    source = torch.where(born, parent_of_rank.gather(1, slot_rank.clamp_min(0)), own)

    room = parents | (children < slots)
    offspring = (1.0 + torch.where(room, divide, 0.0) - die).clamp_min(MIN_OFFSPRING)
    life = s[..., LIFE] * torch.where(updated, offspring / offspring.detach(), 1.0)
    stays = alive & ~dying
    life = torch.where(stays, life, 0.0).gather(1, source)
    states = torch.where(stays[..., None], s[..., LIFE + 1 :], 0.0)
    s = torch.cat((life[..., None], states), dim=-1)
    half_way = 0.5 * CHILD_DISTANCE * eps / space_dim**0.5 * births.direction
    half_way = torch.where(parents[..., None], half_way, 0.0)
    children_x = (x + half_way).gather(1, source[..., None].expand_as(x))
    x = torch.where(born[..., None], children_x, x - half_way)
    alive = stays | born
    # Dead slots get the mean of the living. If none lives, all are at the origin.
    weight = alive[..., None].to(x.dtype)
    middle = world_mean(x * weight) / world_mean(weight).clamp_min(0.5 / count)
    x = torch.where(alive[..., None], x, middle[:, None])
    others = [torch.where(stays.view(*stays.shape, *[1] * (v.ndim - 2)), v, 0.0) for v in others]
    return Particles(x, s, *others)._replace(goal=particles.goal)
