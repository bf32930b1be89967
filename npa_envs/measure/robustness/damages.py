"""What is done to grown worlds: batched, around a random place, across the seam of a box."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from npa_envs.ops import world_mean
from npa_envs.tasks.damage import DAMAGE_SIZES, clump, cut, erase_state, random_particle
from npa_envs.world.randomness import WorldRandom

STATE_NOISE = 0.3
"""Standard deviation of what is added to every state (dimensionless)."""

Box = tuple[float, ...] | None
Change = Callable[[Tensor, Tensor, WorldRandom, Box], tuple[Tensor, Tensor]]
"""Makes other worlds of positions [B, N, D], states [B, N, C], randomness and sides of the box."""


@dataclass(frozen=True)
class Damage:
    """Something done to worlds."""

    name: str
    """What it is called."""
    summary: str
    """What it is, in a few words."""
    apply: Change
    """Does it, to copies."""
    static: bool
    """Whether it can be done to worlds whose particles do not move by themselves."""
    halves: bool = False
    """Whether half of the particles are left; else all are."""
    beyond: bool = False
    """Whether it is beyond what rules are asked to heal."""


def wrapped(x: Tensor, box: Box) -> Tensor:
    """Return positions where a periodic box has them, in open space as they are.

    Args:
        x: Positions [length units], shape [B, N, D].
        box: Sides of the box around the origin [length units], or None.
    """
    if box is None:
        return x
    sides = x.new_tensor(box)
    return x - sides * torch.round(x / sides)


def erase(x: Tensor, s: Tensor, random: WorldRandom, box: Box) -> tuple[Tensor, Tensor]:
    """Set all states in a disk around a random particle to zero, a ball in 3D.

    Args:
        x: Positions [length units], shape [B, N, D].
        s: States, shape [B, N, C].
        random: Streams of B worlds.
        box: Sides of the periodic box [length units], or None.
    """
    away = wrapped(x - random_particle(x, random)[:, None], box)
    centre = torch.zeros_like(x[:, 0])
    return x, erase_state(away, s, centre=centre, radius=DAMAGE_SIZES["erase"])


def slit(x: Tensor, s: Tensor, random: WorldRandom, box: Box) -> tuple[Tensor, Tensor]:
    """Open a slit at a random angle: through the middle, in a box through a random particle.

    For the arguments see `erase`.
    """
    centre = world_mean(x) if box is None else random_particle(x, random)
    normal = random.normal(x.shape[2], dtype=x.dtype)
    away = wrapped(x - centre[:, None], box)
    origin = torch.zeros_like(centre)
    away, s = cut(away, s, centre=origin, normal=normal, gap=DAMAGE_SIZES["cut"])
    return wrapped(away + centre[:, None], box), s


def pull_together(x: Tensor, s: Tensor, random: WorldRandom, box: Box) -> tuple[Tensor, Tensor]:
    """Pull all particles in a disk around a random one to its place; arguments as of `erase`."""
    centre = random_particle(x, random)
    away = wrapped(x - centre[:, None], box)
    origin = torch.zeros_like(centre)
    away, s = clump(away, s, centre=origin, radius=DAMAGE_SIZES["clump"], factor=1.0)
    return wrapped(away + centre[:, None], box), s


def add_state_noise(x: Tensor, s: Tensor, random: WorldRandom, box: Box) -> tuple[Tensor, Tensor]:
    """Add normal noise to all states; arguments as of `erase`."""
    return x, s + STATE_NOISE * random.normal(*s.shape[1:], dtype=s.dtype)


def remove_half(x: Tensor, s: Tensor, random: WorldRandom, box: Box) -> tuple[Tensor, Tensor]:
    """Leave N // 2 particles, chosen at random; arguments as of `erase`."""
    return _lowest_half(x, s, random.uniform(x.shape[1]))


def remove_side(x: Tensor, s: Tensor, random: WorldRandom, box: Box) -> tuple[Tensor, Tensor]:
    """Leave the N // 2 particles on one side of a line at a random angle, a plane in 3D.

    For the arguments see `erase`; in a box the line runs through its middle, up to rounding.
    """
    normal = random.normal(x.shape[2], dtype=x.dtype)
    return _lowest_half(x, s, (x * normal[:, None]).sum(-1))


def _lowest_half(x: Tensor, s: Tensor, key: Tensor) -> tuple[Tensor, Tensor]:
    """Leave the particles with the lower keys [B, N], in the order that they have."""
    kept = key.argsort(dim=1)[:, : x.shape[1] // 2].sort(dim=1).values[..., None]
    return x.take_along_dim(kept, dim=1), s.take_along_dim(kept, dim=1)


DAMAGES = {
    damage.name: damage
    for damage in (
        Damage("erase", "states in a disk of radius 0.2 set to 0", erase, static=True),
        Damage("cut", "a slit of width 0.1", slit, static=False),
        Damage("clump", "a disk of radius 0.2 pulled to a point", pull_together, static=False),
        Damage("noise", "noise of 0.3 on every state", add_state_noise, static=True, beyond=True),
        Damage("half", "half of the particles removed", remove_half, static=True, halves=True),
        Damage(
            "side", "all on one side removed", remove_side, static=True, halves=True, beyond=True
        ),
    )
}
"""Every damage by its name."""
