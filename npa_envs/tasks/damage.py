"""Damage that a rule should heal: wiped, cut, clumped and noisy worlds, and escaped particles.

No function reads a value back from the device, so all may be captured in a CUDA graph.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from npa_envs.checks import check_positive, check_world, checked_number
from npa_envs.errors import NPAError, check_known, shown
from npa_envs.ops import world_mean
from npa_envs.tasks.seeds import drawn_indices, uniform_ball
from npa_envs.world.brushes import Sides, clump, cut, wipe_state
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import Randomness, check_generator, normal_draws, uniform_draws

DAMAGE_SIZES = {"wipe": 0.2, "cut": 0.1, "clump": 0.2, "noise": 0.05}
"""Kinds of damage -> default size [length units]: states in a ball are set to 0 (radius), a slit is
cut through the middle (width), particles in a ball are pulled together (radius), all are displaced
(standard deviation). `npa/Regeneration2D-v0` wipes more by default: 0.3."""

CLUMP_FACTOR = 0.9
"""Fraction of its distance from the ball's centre by which "clump" moves a particle inwards."""


def check_damage(kind: object, where: str = "") -> None:
    """Raise NPAError unless `kind` is in `DAMAGE_SIZES`; its message says `where` it stood."""
    check_known("unknown damage", kind, DAMAGE_SIZES, where)


@dataclass(frozen=True)
class DamageEvent:
    """Damage of a world after a number of steps."""

    step: int
    """Steps since the initial world."""
    kind: str
    """One of `DAMAGE_SIZES`."""
    size: float | None = None
    """Radius, width or standard deviation [length units]; None: that of `DAMAGE_SIZES`."""

    def __post_init__(self) -> None:
        check_damage(self.kind)
        check_positive(self, int, "step", at_least=0)
        if self.size is not None:
            check_positive(self, float, "size")

    @property
    def text(self) -> str:
        """The damage in a few words, for captions."""
        return f"{self.kind} {DAMAGE_SIZES[self.kind] if self.size is None else self.size:g}"

    def __str__(self) -> str:
        """The text that `parse_damage` reads as this event."""
        return f"{self.step}:{self.kind}" + ("" if self.size is None else f":{self.size!r}")


def parse_damage(text: str) -> DamageEvent:
    """Return the event of "STEP:KIND" or "STEP:KIND:SIZE", such as "500:wipe:0.3"."""
    if not isinstance(text, str):
        raise NPAError(f"damage must be text, got {shown(text)}: for example '300:cut'")
    step, _, damage = text.partition(":")
    kind, *sizes = damage.split(":")
    if kind and step.isdecimal():
        check_damage(kind, f" in {shown(text)}")
    if kind and len(sizes) < 2:
        with suppress(ValueError):
            return DamageEvent(int(step), kind, *map(float, sizes))
    raise NPAError(
        f"damage must be STEP:KIND or STEP:KIND:SIZE with a positive size, got {shown(text)}: "
        "for example 300:cut or 500:wipe:0.3"
    )


class Wound(NamedTuple):
    """A wound in each of B worlds."""

    kind: str
    """"wipe", states of zero in a ball, "cut", a slit, or "clump", a ball drawn together."""
    centre: Tensor
    """Its middle [length units], shape [B, D]."""
    size: float
    """Radius of the ball or width of the slit [length units]."""
    normal: Tensor | None = None
    """Direction across a cut, shape [B, D]."""

    def inflict(
        self, x: Tensor, s: Tensor, box: Sides = None, *, factor: float = CLUMP_FACTOR
    ) -> tuple[Tensor, Tensor]:
        """Return wounded x and s, in a periodic box or open space; `factor` is that of `clump`."""
        centre, size = self.centre, self.size
        if self.normal is not None:
            return cut(x, s, centre=centre, normal=self.normal, gap=size, box=box)
        if self.kind == "clump":
            return clump(x, s, centre=centre, radius=size, factor=factor, box=box)
        return x, wipe_state(x, s, centre=centre, radius=size, box=box)

    def distance(self, points: Tensor) -> Tensor:
        """Return the distance of points [B, M, D] from what it has moved or wiped, [B, M].

        Inside it is negative. A cut moves what is within its width on both sides.
        """
        away = points - self.centre[:, None]
        if self.normal is None:
            length: Tensor = torch.linalg.vector_norm(away, dim=-1)
            return length - self.size
        across = self.normal / torch.linalg.vector_norm(self.normal, dim=-1, keepdim=True)
        height: Tensor = (away * across[:, None]).sum(-1).abs()
        return height - self.size


def random_wound(
    kind: str, size: float, x: Tensor, generator: Randomness | None, *, anywhere: bool = False
) -> Wound:
    """Return a wound around a random particle of each world; a cut has a random angle.

    A cut runs through the middle of the world, or with `anywhere` also through a random particle.
    """
    if kind != "cut":
        return Wound(kind, random_particle(x, generator), size)
    centre = random_particle(x, generator) if anywhere else world_mean(x)
    return Wound(kind, centre, size, normal_draws(generator, (len(x), x.shape[2]), x))


def damage_worlds(
    worlds: Particles,
    *,
    kind: str,
    size: float | None = None,
    box: Sides = None,
    generator: Randomness | None = None,
) -> Particles:
    """Return worlds damaged around a random particle, or cut through the middle at a random angle.

    `kind` is one of `DAMAGE_SIZES`, which has the default of `size` and says what it means. Damage
    continues across the edges of a periodic `box` [length units]; positions may leave it, and the
    next step wraps them. `generator` is on the worlds' device.
    """
    x, s, *_ = worlds
    check_damage(kind)
    check_world(x, s)
    check_generator(generator, x.device, x.shape[0])
    size = DAMAGE_SIZES[kind] if size is None else checked_number("size", size)
    if not 0 <= size <= torch.finfo(x.dtype).max:
        raise NPAError(f"the size of a damage must be finite and at least 0, got {size}: try 0.1")
    if kind == "noise":
        return worlds._replace(x=x + size * normal_draws(generator, x.shape, x))
    x, s = random_wound(kind, size, x, generator).inflict(x, s, box)
    return worlds._replace(x=x, s=s)


def random_particle(x: Tensor, generator: Randomness | None = None) -> Tensor:
    """Return the position of a random particle of each world [length units], shape [B, D]."""
    chosen = drawn_indices(x.shape[1], x.shape[0], generator, x.device)
    return x.take_along_dim(chosen[:, None, None], dim=1).squeeze(1)


# A particle that escapes has no neighbours: a rule that was trained without such particles may let
# it drift for ever, too slowly to notice in a picture. Training displaces some particles far out of
# their worlds and penalises their paths, so that the rule learns to let them rest.

DAMAGE_CHANCE = 0.25
"""Probability of each of clumping, cutting and tearing off for a world (dimensionless)."""

NEAREST, FARTHEST = 2.0, 4.0
"""Range of distances from the origin to which particles are displaced [length units]."""


def tear_off(x: Tensor, *, radius: float, generator: Randomness) -> Tensor:
    """Return positions [B, N, D] after a random quarter of the worlds has lost a flake.

    A flake is a ball around a random particle, of a random radius up to `radius` [length units]. It
    is moved out of the world in one piece, to `far_points`. Its particles perceive each other, and
    may drift on where a lone particle has learned to rest.
    """
    centre = random_particle(x, generator)
    uniform = uniform_draws(generator, (len(x), 2), x)
    flake_radius = torch.where(uniform[:, :1] < DAMAGE_CHANCE, radius * uniform[:, 1:], -1.0)
    torn = (x - centre[:, None]).norm(dim=-1) <= flake_radius
    return torch.where(torn[..., None], x + (far_points(x, 1, generator) - centre[:, None]), x)


def far_points(x: Tensor, count: int, generator: Randomness) -> Tensor:
    """Return points at random distances, `NEAREST` to `FARTHEST`, from the origin, [B, count, D].

    B is the number of worlds of positions `x`, which also give D, device and dtype.
    """
    ball = uniform_ball(
        len(x), count, x.shape[2], 1.0, generator=generator, device=x.device, dtype=x.dtype
    )
    length: Tensor = ball.norm(dim=-1, keepdim=True)
    return ball * ((NEAREST + (FARTHEST - NEAREST) * length) / length.clamp_min(1e-12))
