"""Particles that divide and die: worlds of slots, living and dead, whose tensors keep their shape.

The first state of a slot is its life: 1 where its particle lives, 0 where it is dead. Nothing here
waits for the device.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from npa_envs.ops.world_mean import world_mean
from npa_envs.rule.rule import LIFE

FEWEST_OFFSPRING = 1e-3
"""Expected offspring below which nothing is to be learned from life."""

CHILD_DISTANCE = 0.5
"""Root mean square distance of a child from its parent, in perception radii."""

PARKING_DISTANCE = 65536.0
"""Where the dead are parked: coordinates in perception radii."""

PARKING_GAP = 2.5
"""Distance between two of the dead, in perception radii: five cells, so each is in another one."""


class Births(NamedTuple):
    """What a step draws where particles divide."""

    uniform: Tensor
    """Decides on each particle's fate, uniform in [0, 1), shape [B, N]."""
    direction: Tensor
    """Where the child of a particle goes, standard normal, shape [B, N, D]."""


def living(s: Tensor) -> Tensor:
    """Return which slots hold a living particle, bool, shape [B, N]."""
    return s[..., LIFE].detach() > 0.5


def parked(x: Tensor, alive: Tensor, eps: float) -> Tensor:
    """Return positions with the dead far away from all others and from each other."""
    count, space_dim = x.shape[1:]
    side = 1
    while side**space_dim < count:
        side *= 2
    slot = torch.arange(count, device=x.device)
    place = torch.stack([slot // side**d % side for d in range(space_dim)], dim=-1)
    far = eps * (PARKING_DISTANCE + PARKING_GAP * place.to(x.dtype))
    return torch.where(alive[..., None], x, far)


def divided(
    x: Tensor,
    s: Tensor,
    path_length: Tensor,
    *,
    division_probabilities: tuple[Tensor, Tensor],
    updated: Tensor,
    births: Births,
    eps: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Let updated particles divide, stay or die; differentiable.

    A child is born with states of 0: who it is it learns from those around it. Parent and child
    move apart from where the parent was, each half of the way. The k-th child of a world takes its
    k-th dead slot; where there are more children than slots, the last are not born, and their
    parents stay where they are. The last living particle of a world does not die. Dead slots get
    states of 0, and the mean position of the living, so that means over all slots are those of the
    living.

    Fates are discrete. What is differentiable is life: its value stays 1, and at each update it is
    multiplied by m / m', with m = 1 + p - d the expected number of particles that come of one, p
    and d its probabilities to divide and to die, and m' the same without gradient. It is all that
    children inherit. So the gradient of a sum over the living, weighted by life, is on average that
    of its expected value, as long as particles do not feel each other and of what parent and child
    share: a birth is credited as if the child were like its parent.

    Args:
        path_length: How far each particle travelled [length units], shape [B, N]; of children 0.
        division_probabilities: Of each particle to divide and to die, shape [B, N] each.
        updated: Which living particles were updated, bool, shape [B, N].
        births: What was drawn.

    Returns:
        Positions, states and path lengths, which do not count how parent and child move apart.
    """
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
    # Who has no child is written to an entry that nobody reads.
    parent_of_rank = own.new_zeros(len(x), count + 1)
    parent_of_rank.scatter_(1, torch.where(parents, child_rank, count), own)
    source = torch.where(born, parent_of_rank.gather(1, slot_rank.clamp_min(0)), own)

    room = parents | (children < slots)
    offspring = (1.0 + torch.where(room, divide, 0.0) - die).clamp_min(FEWEST_OFFSPRING)
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
    # The dead are at the mean of the living. Where none lives, all are at the origin.
    share = alive[..., None].to(x.dtype)
    middle = world_mean(x * share) / world_mean(share).clamp_min(0.5 / count)
    x = torch.where(alive[..., None], x, middle[:, None])
    return x, s, torch.where(alive & ~born, path_length, 0.0)
