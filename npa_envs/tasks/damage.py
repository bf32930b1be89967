"""Damage that a rule should heal, in rollouts and in the training pool.

No function reads a value back from the device, so all may be captured in a CUDA graph.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass

import torch
from torch import Tensor

from npa_envs.checks import (
    check_fraction,
    check_non_negative,
    check_world,
    checked_number,
    is_real,
    is_whole,
)
from npa_envs.errors import NPAError, shown, suggest
from npa_envs.ops import world_mean
from npa_envs.tasks.seeds import drawn_indices, uniform_ball
from npa_envs.world.brushes import clump, cut, wipe_state
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import Randomness, check_generator, normal_draws, uniform_draws

DAMAGE_SIZES = {"wipe": 0.2, "cut": 0.1, "clump": 0.2, "noise": 0.05}
"""Kinds of damage with their usual size: radius, gap, radius, standard deviation [length units]."""

CLUMP_FACTOR = 0.9
"""Fraction of its distance from the centre by which clumping moves a particle inwards."""


def check_damage(kind: object) -> None:
    """Check that there is such a kind of damage."""
    if not isinstance(kind, str) or kind not in DAMAGE_SIZES:
        raise NPAError(f"unknown damage {shown(kind)}: {suggest(kind, DAMAGE_SIZES)}")


@dataclass(frozen=True)
class DamageEvent:
    """One damage of a world, after a number of steps."""

    step: int
    """Steps since the seed."""

    kind: str
    """One of `DAMAGE_SIZES`."""

    size: float | None = None
    """Radius, gap or standard deviation [length units]; None is the usual one."""

    def __post_init__(self) -> None:
        """Check every field."""
        check_damage(self.kind)
        if not is_whole(self.step) or self.step < 0:
            raise NPAError(f"step must be a whole number of at least 0, got {shown(self.step)}")
        if not is_real(self.extent) or self.extent <= 0:
            raise NPAError(f"size must be positive and finite, got {self.size}: try 0.1")

    @property
    def extent(self) -> float:
        """The size [length units], given or usual."""
        return DAMAGE_SIZES[self.kind] if self.size is None else self.size

    @property
    def text(self) -> str:
        """The damage in a few words, for captions."""
        return f"{self.kind} {self.extent:g}"

    def __str__(self) -> str:
        """The text that `parse_damage` reads as this event."""
        return f"{self.step}:{self.kind}" + ("" if self.size is None else f":{self.size!r}")


def parse_damage(text: str) -> DamageEvent:
    """Read "STEP:KIND" or "STEP:KIND:SIZE", for example "300:cut" or "500:wipe:0.3"."""
    if not isinstance(text, str):
        raise NPAError(f"damage must be text, got {shown(text)}: for example '300:cut'")
    parts = text.split(":")
    kind = parts[1] if len(parts) > 1 else ""
    if kind and kind not in DAMAGE_SIZES:
        raise NPAError(
            f"unknown damage {shown(kind)} in {shown(text)}: {suggest(kind, DAMAGE_SIZES)}"
        )
    if len(parts) in (2, 3):
        with suppress(ValueError):
            size = float(parts[2]) if len(parts) == 3 else None
            return DamageEvent(int(parts[0]), kind, size)
    raise NPAError(
        f"damage must be STEP:KIND or STEP:KIND:SIZE with a positive size, got {shown(text)}: "
        "for example 300:cut or 500:wipe:0.3"
    )


def damage_worlds(
    x: Tensor,
    s: Tensor,
    *,
    kind: str,
    size: float | None = None,
    generator: Randomness | None = None,
) -> tuple[Tensor, Tensor]:
    """Damage worlds at a random position, or cut them through the middle at a random angle.

    Args:
        x: Particle positions [length units], shape [B, N, D].
        s: Particle states (dimensionless), shape [B, N, C].
        kind: "wipe", "cut", "clump", or "noise" on every position.
        size: Radius, gap or standard deviation [length units]; None is the usual one.
        generator: Source of the random position, on the device of `x`; None is torch's own.

    Returns:
        The new positions, shape [B, N, D], and states, shape [B, N, C].

    Raises:
        NPAError: An unknown kind, a wrong shape or dtype, or a size that is negative or not finite.
    """
    check_damage(kind)
    check_world(x, s)
    check_generator(generator, x.device, x.shape[0])
    extent = DAMAGE_SIZES[kind] if size is None else checked_number("size", size)
    if not 0 <= extent <= torch.finfo(x.dtype).max:
        raise NPAError(f"the size of a damage must be finite and at least 0, got {extent}: try 0.1")
    if kind == "noise":
        return x + extent * normal_draws(generator, x.shape, x), s
    if kind == "cut":
        normal = normal_draws(generator, (len(x), x.shape[2]), x)
        return cut(x, s, centre=world_mean(x), normal=normal, gap=extent)
    centre = random_particle(x, generator)
    if kind == "clump":
        return clump(x, s, centre=centre, radius=extent, factor=CLUMP_FACTOR)
    return x, wipe_state(x, s, centre=centre, radius=extent)


def random_particle(x: Tensor, generator: Randomness | None = None) -> Tensor:
    """Return the position of a random particle of each world [length units], shape [B, D]."""
    check_world(x, x)
    check_generator(generator, x.device, x.shape[0])
    chosen = drawn_indices(x.shape[1], x.shape[0], generator, x.device)
    return x.take_along_dim(chosen[:, None, None], dim=1).squeeze(1)


# A particle that escapes has no neighbours: a rule that was trained without such particles may let
# it drift for ever, too slowly to notice in a picture. Training throws some particles out of their
# worlds and penalises their paths, so that the rule learns to let them rest.

NEAREST, FARTHEST = 2.0, 4.0
"""Range of distances from the origin to which particles are thrown [length units]."""


def displace(x: Tensor, *, share: float, generator: Randomness | None = None) -> Tensor:
    """Return positions with some particles, each with probability `share`, thrown far out."""
    world_count, particle_count, space_dim = x.shape
    check_generator(generator, x.device, world_count)
    chance = uniform_draws(generator, (world_count, particle_count, 1), x)
    ball = uniform_ball(
        world_count, particle_count, space_dim, 1.0,
        generator=generator, device=x.device, dtype=x.dtype,
    )  # fmt: skip
    return torch.where(chance < share, _outside(ball), x)


def tear_off(
    x: Tensor, *, radius: float, chance: float, generator: Randomness | None = None
) -> Tensor:
    """Return positions where some worlds lose a flake, which is thrown far out in one piece.

    Its particles perceive each other, and may drift on where a lone particle has learned to rest.
    A flake is a ball around a random particle, of a random radius up to `radius` [length units]; a
    world loses one with probability `chance`.
    """
    world_count, _, space_dim = x.shape
    centre = random_particle(x, generator)
    draws = uniform_draws(generator, (world_count, 2), x)
    flake_radius = torch.where(draws[:, :1] < chance, radius * draws[:, 1:], -1.0)
    target = uniform_ball(
        world_count, 1, space_dim, 1.0, generator=generator, device=x.device, dtype=x.dtype
    )[:, 0]
    torn = (x - centre[:, None]).norm(dim=-1) <= flake_radius
    return torch.where(torn[..., None], x + (_outside(target) - centre)[:, None], x)


def _outside(ball: Tensor) -> Tensor:
    """Map points of the unit ball [..., D] to distances from `NEAREST` to `FARTHEST`."""
    length: Tensor = ball.norm(dim=-1, keepdim=True)
    return ball * ((NEAREST + (FARTHEST - NEAREST) * length) / length.clamp_min(1e-12))


_counting: ContextVar[Callable[[Tensor], Tensor] | None] = ContextVar("counting", default=None)
"""Averages a count over all processes; None: there is one process."""


@contextmanager
def counted_together(mean: Callable[[Tensor], Tensor]) -> Iterator[None]:
    """Let `escape_motion` in the block count particles of all processes, averaged by `mean`."""
    before = _counting.set(mean)
    try:
        yield
    finally:
        _counting.reset(before)


def escape_motion(x: Tensor, path_length: Tensor) -> Tensor:
    """Return the mean path length of the particles outside of [-1, 1]^D [length units], shape [].

    It is 0 where there are none. Within `counted_together` the mean of all processes' results is
    the mean over the particles of all processes.
    """
    outside = (x.detach().abs().amax(dim=-1) > 1.0).to(x.dtype)
    count, mean = outside.sum(), _counting.get()
    if mean is not None:
        # The mean count of R processes is 0 or at least 1 / R.
        count = mean(count)
        return (outside * path_length).sum() / torch.where(count > 0.0, count, 1.0)
    return (outside * path_length).sum() / count.clamp_min(1.0)


SHARE = 0.25
"""Probability of a world to be clumped, to be cut, to lose a flake (dimensionless)."""


@dataclass(frozen=True, kw_only=True)
class PoolDamage:
    """Damage of worlds from the pool; a radius, gap or probability of 0: none of that kind."""

    damage_radius: float = 0.0
    """Radius of the ball whose state is wiped in worlds from the pool [length units]; 0: none."""

    clump_radius: float = 0.0
    """Radius of the ball whose particles are pulled to one point, in a quarter of the worlds from
    the pool [length units]; 0: none."""

    cut_gap: float = 0.0
    """Width of the slit through `cut_share` of the worlds from the pool [length units]; 0: none."""

    cut_share: float = SHARE
    """Probability of a world from the pool to be cut (dimensionless)."""

    flake_radius: float = 0.0
    """Radius up to which a ball of particles is torn off and thrown out, in a quarter of the worlds
    from the pool [length units]; 0: none."""

    escape_share: float = 0.0
    """Probability of each particle to be thrown out of worlds from the pool (dimensionless)."""

    def __post_init__(self) -> None:
        """Check every field."""
        check_fraction(self, "cut_share")
        check_non_negative(
            self, "damage_radius", "clump_radius", "cut_gap", "flake_radius", "escape_share"
        )


def damage_pool(worlds: Particles, damage: PoolDamage, *, generator: Randomness) -> Particles:
    """Return the worlds, damaged at random positions; nothing waits for the device."""
    x, s, *_ = worlds
    if damage.damage_radius > 0.0:
        centre = random_particle(x, generator)
        s = wipe_state(x, s, centre=centre, radius=damage.damage_radius)
    if damage.clump_radius > 0.0:
        centre = random_particle(x, generator)
        hit = (uniform_draws(generator, (len(x), 1), x)[:, 0] < SHARE).to(x.dtype)
        x, s = clump(x, s, centre=centre, radius=damage.clump_radius * hit, factor=1.0)
    if damage.cut_gap > 0.0:
        # Directions need not be uniform; a zero vector cuts nothing.
        normal = 2.0 * uniform_draws(generator, (len(x), x.shape[2]), x) - 1.0
        hit = (uniform_draws(generator, (len(x), 1), x)[:, 0] < damage.cut_share).to(x.dtype)
        x, s = cut(x, s, centre=world_mean(x), normal=normal, gap=damage.cut_gap * hit)
    if damage.flake_radius > 0.0:
        x = tear_off(x, radius=damage.flake_radius, chance=SHARE, generator=generator)
    if damage.escape_share > 0.0:
        x = displace(x, share=damage.escape_share, generator=generator)
    return worlds._replace(x=x, s=s)
