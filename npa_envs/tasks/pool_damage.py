"""What is done to worlds of the pool before a rollout, so that a rule learns to heal it."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor

from npa_envs.ops import world_mean
from npa_envs.tasks.damage import clump, cut, erase_state, random_particle
from npa_envs.tasks.strays import scatter, tear
from npa_envs.world.randomness import Randomness, uniform_draws

SHARE = 0.25
"""Share of the worlds that are clumped, that are cut, that lose a flake (dimensionless)."""


class PoolDamage(Protocol):
    """What a task's configuration says of it; 0 is none."""

    @property
    def damage_radius(self) -> float:
        """Radius of the ball whose states become zero, in every world [length units]."""

    @property
    def clump_radius(self) -> float:
        """Radius of the ball whose particles are pulled to one point [length units]."""

    @property
    def cut_gap(self) -> float:
        """Width of the slit through the middle [length units]."""

    @property
    def flake_radius(self) -> float:
        """Largest radius of the flake that is torn off and thrown out [length units]."""

    @property
    def stray_share(self) -> float:
        """Probability of each particle to be thrown out (dimensionless)."""


def hurt(
    x: Tensor, s: Tensor, damage: PoolDamage, *, generator: Randomness
) -> tuple[Tensor, Tensor]:
    """Return worlds that are damaged at random places; nothing waits for the device.

    Args:
        x: Particle positions [length units], shape [B, N, D].
        s: Particle states (dimensionless), shape [B, N, C].
        damage: What is done.
        generator: Source of randomness, on the device of `x`; a `WorldRandom` of B worlds does to
            each world what it would do to it alone.
    """
    if damage.damage_radius > 0.0:
        centre = random_particle(x, generator)
        s = erase_state(x, s, centre=centre, radius=damage.damage_radius)
    if damage.clump_radius > 0.0:
        centre = random_particle(x, generator)
        hit = (uniform_draws(generator, (len(x), 1), x)[:, 0] < SHARE).to(x.dtype)
        x, s = clump(x, s, centre=centre, radius=damage.clump_radius * hit, factor=1.0)
    if damage.cut_gap > 0.0:
        # Directions need not be spread evenly, and of a zero vector nothing is cut.
        normal = 2.0 * uniform_draws(generator, (len(x), x.shape[2]), x) - 1.0
        hit = (uniform_draws(generator, (len(x), 1), x)[:, 0] < SHARE).to(x.dtype)
        x, s = cut(x, s, centre=world_mean(x), normal=normal, gap=damage.cut_gap * hit)
    if damage.flake_radius > 0.0:
        x = tear(x, radius=damage.flake_radius, chance=SHARE, generator=generator)
    if damage.stray_share > 0.0:
        x = scatter(x, share=damage.stray_share, generator=generator)
    return x, s
