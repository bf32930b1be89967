"""Damage that a rule should heal: erased states, cuts and clumps; batched, on the world's device.

Nothing here reads a value back from the device, so all of it may be captured in a CUDA graph.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass

import torch
from torch import Tensor

from npa_envs.errors import NPAError, suggest
from npa_envs.ops import world_mean
from npa_envs.ops.checks import DTYPES, check_dense, checked_number
from npa_envs.tasks.checks import is_real, is_whole
from npa_envs.world.randomness import Randomness, WorldRandom, check_generator, normal_draws

DAMAGE_SIZES = {"erase": 0.2, "cut": 0.1, "clump": 0.2, "noise": 0.05}
"""Kinds of damage with their usual size: radius, gap, radius, standard deviation [length units]."""

CLUMP_FACTOR = 0.9
"""Share of its distance from the centre that a particle loses when it is clumped."""


@dataclass(frozen=True)
class DamageEvent:
    """Something done to worlds after a number of steps."""

    step: int
    """Steps from the seed."""

    kind: str
    """One of `DAMAGE_SIZES`."""

    size: float | None = None
    """Radius, gap or standard deviation [length units]; None is the usual one."""

    def __post_init__(self) -> None:
        """Check every field.

        Raises:
            NPAError: The kind is unknown, the step negative, or the size not positive and finite.
        """
        if not isinstance(self.kind, str) or self.kind not in DAMAGE_SIZES:
            raise NPAError(f"unknown damage {self.kind!r}: {suggest(str(self.kind), DAMAGE_SIZES)}")
        if not is_whole(self.step) or self.step < 0:
            raise NPAError(f"step must be a whole number of at least 0, got {self.step!r}")
        if not is_real(self.extent) or self.extent <= 0:
            raise NPAError(f"size must be positive and finite, got {self.size}: try 0.1")

    @property
    def extent(self) -> float:
        """The size [length units], be it given or the usual one."""
        return DAMAGE_SIZES[self.kind] if self.size is None else self.size

    @property
    def text(self) -> str:
        """The damage in a few words, for captions."""
        return f"{self.kind} {self.extent:g}"

    def __str__(self) -> str:
        """The event as `parse_damage` reads it."""
        return f"{self.step}:{self.kind}" + ("" if self.size is None else f":{self.size!r}")


def parse_damage(text: str) -> DamageEvent:
    """Read "STEP:KIND" or "STEP:KIND:SIZE".

    Args:
        text: For example "300:cut" or "500:erase:0.3".

    Raises:
        NPAError: It is written in another way, or the kind is unknown.
    """
    if not isinstance(text, str):
        raise NPAError(f"damage must be text, got {text!r}: for example '300:cut'")
    parts = text.split(":")
    kind = parts[1] if len(parts) > 1 else ""
    if kind and kind not in DAMAGE_SIZES:
        raise NPAError(f"unknown damage {kind!r} in {text!r}: {suggest(kind, DAMAGE_SIZES)}")
    if len(parts) in (2, 3):
        with suppress(ValueError):
            size = float(parts[2]) if len(parts) == 3 else None
            return DamageEvent(int(parts[0]), kind, size)
    raise NPAError(
        f"damage must be STEP:KIND or STEP:KIND:SIZE with a positive size, got {text!r}: "
        "for example 300:cut or 500:erase:0.3"
    )


def damage_worlds(
    x: Tensor,
    s: Tensor,
    *,
    kind: str,
    size: float | None = None,
    generator: Randomness | None = None,
) -> tuple[Tensor, Tensor]:
    """Damage worlds at a random place, or cut them through the middle at a random angle.

    Args:
        x: Particle positions [length units], shape [B, N, D].
        s: Particle states (dimensionless), shape [B, N, C].
        kind: "erase", "cut", "clump", or "noise" on every position.
        size: Radius, gap or standard deviation [length units]; None is the usual one.
        generator: Where the place comes from, on the device of `x`; None is torch's own.

    Returns:
        The new positions, shape [B, N, D], and states, shape [B, N, C].

    Raises:
        NPAError: An unknown kind, a wrong shape or dtype, or a size that is negative or not finite.
    """
    if not isinstance(kind, str) or kind not in DAMAGE_SIZES:
        raise NPAError(f"unknown damage {kind!r}: {suggest(str(kind), DAMAGE_SIZES)}")
    _check_world(x, s)
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
    return x, erase_state(x, s, centre=centre, radius=extent)


def random_particle(x: Tensor, generator: Randomness | None = None) -> Tensor:
    """Return the position of one particle of each world, each as likely as the others.

    Args:
        x: Particle positions [length units], shape [B, N, D].
        generator: Where the choice comes from, on the device of `x`; None is torch's own.
            A `WorldRandom` of B worlds chooses in each world what it would choose alone.

    Returns:
        The chosen positions [length units], shape [B, D].

    Raises:
        NPAError: A wrong shape or dtype, no particles, or a generator on another device or for
            another number of worlds.
    """
    _check_positions(x)
    check_generator(generator, x.device, x.shape[0])
    world_count, particle_count, _ = x.shape
    if particle_count == 0:
        raise NPAError("x must hold at least one particle, got N = 0: give a world with particles")
    if isinstance(generator, WorldRandom):
        chosen = generator.integers(particle_count, 1, 1)
    else:
        chosen = torch.randint(
            particle_count, (world_count, 1, 1), generator=generator, device=x.device
        )
    return x.take_along_dim(chosen, dim=1).squeeze(1)


def erase_state(x: Tensor, s: Tensor, *, centre: Tensor, radius: float | Tensor) -> Tensor:
    """Return the states with those of the particles inside a ball set to zero.

    Args:
        x: Particle positions [length units], shape [B, N, D].
        s: Particle states (dimensionless), shape [B, N, C].
        centre: Centre of the ball in each world [length units], shape [B, D].
        radius: Radius of the ball [length units], a number or a tensor of shape [B].

    Returns:
        The new states, shape [B, N, C]; `s` itself is left as it is.

    Raises:
        NPAError: A wrong shape or dtype, or a radius that is negative or not finite.
    """
    _check_world(x, s)
    inside = _inside_ball(x, centre, radius)
    return s.masked_fill(inside[..., None], 0.0)


def cut(
    x: Tensor, s: Tensor, *, centre: Tensor, normal: Tensor, gap: float | Tensor
) -> tuple[Tensor, Tensor]:
    """Open a slit along a line (a plane in 3D), as a knife would.

    Particles within `gap` of the line move away from it, those on the line by half the gap and
    those at the distance `gap` not at all: none is left within half the gap, the bands beside the
    slit are twice as dense, and everything further away stays where it is.

    Args:
        x: Particle positions [length units], shape [B, N, D].
        s: Particle states (dimensionless), shape [B, N, C].
        centre: A point on the line in each world [length units], shape [B, D].
        normal: Direction across the line, of any length, shape [B, D]; a zero vector cuts nothing.
        gap: Width of the slit [length units], a number or a tensor of shape [B].

    Returns:
        The new positions, shape [B, N, D], and the states as they came.

    Raises:
        NPAError: A wrong shape or dtype, or a gap that is negative or not finite.
    """
    _check_world(x, s)
    _check_vector("centre", centre, x)
    _check_vector("normal", normal, x)
    width = _per_world("gap", gap, x)
    length = torch.linalg.vector_norm(normal, dim=-1, keepdim=True)
    # Masked before the division: a zero normal must give a shift of zero, not NaN.
    direction = normal / torch.where(length > 0, length, torch.ones_like(length))
    height = ((x - centre[:, None]) * direction[:, None]).sum(dim=-1, keepdim=True)
    side = (height >= 0).to(x.dtype) - 0.5
    push = side * (width - height.abs()).clamp_min(0.0)
    return x + push * direction[:, None], s


def clump(
    x: Tensor, s: Tensor, *, centre: Tensor, radius: float | Tensor, factor: float | Tensor
) -> tuple[Tensor, Tensor]:
    """Draw the particles inside a ball together.

    Args:
        x: Particle positions [length units], shape [B, N, D].
        s: Particle states (dimensionless), shape [B, N, C].
        centre: Centre of the ball in each world [length units], shape [B, D].
        radius: Radius of the ball [length units], a number or a tensor of shape [B].
        factor: The share of its distance from the centre that a particle loses (dimensionless),
            from 0, nothing moves, to 1, all meet in the centre; a number or a tensor of shape [B].

    Returns:
        The new positions, shape [B, N, D], and the states as they came.

    Raises:
        NPAError: A wrong shape or dtype, a radius that is negative or not finite, or a factor
            outside [0, 1].
    """
    _check_world(x, s)
    inside = _inside_ball(x, centre, radius)
    share = _per_world("factor", factor, x, highest=1.0)
    pulled = x + share * (centre[:, None] - x)
    return torch.where(inside[..., None], pulled, x), s


def _inside_ball(x: Tensor, centre: Tensor, radius: float | Tensor) -> Tensor:
    _check_vector("centre", centre, x)
    distance = torch.linalg.vector_norm(x - centre[:, None], dim=-1)
    return torch.le(distance, _per_world("radius", radius, x).squeeze(-1))


def _per_world(name: str, value: float | Tensor, x: Tensor, *, highest: float = math.inf) -> Tensor:
    """Return the number of each world in a shape [B, 1, 1] or [1, 1, 1]."""
    if isinstance(value, Tensor):
        if value.shape not in ((), (x.shape[0],)):
            raise NPAError(
                f"{name} must be a number or a tensor of shape [B] = [{x.shape[0]}], "
                f"got {list(value.shape)}: give one number for each world"
            )
        # The values stay unread: looking at them would wait for the device.
        return value.to(x).reshape(-1, 1, 1)
    value = checked_number(name, value)
    if not 0 <= value <= min(highest, torch.finfo(x.dtype).max):
        rule = "finite and at least 0" if highest == math.inf else f"in [0, {highest:g}]"
        raise NPAError(f"{name} must be {rule}, got {value}: try 0.1")
    return x.new_full((1, 1, 1), value)


def _check_positions(x: Tensor) -> None:
    if not isinstance(x, Tensor):
        raise NPAError(f"x must be a torch tensor, got {type(x).__name__}: use torch.as_tensor")
    if x.ndim != 3:
        cure = ": add a world dimension with x[None]" if x.ndim == 2 else ""
        raise NPAError(f"x must have shape [B, N, D], got {tuple(x.shape)}{cure}")
    if x.dtype not in DTYPES:
        raise NPAError(f"x must be float32 or float64, got {x.dtype}: convert it with x.float()")
    check_dense("x", x)


def _check_world(x: Tensor, s: Tensor) -> None:
    _check_positions(x)
    if not isinstance(s, Tensor):
        raise NPAError(f"s must be a torch tensor, got {type(s).__name__}: use torch.as_tensor")
    if s.ndim != 3 or s.shape[:2] != x.shape[:2]:
        raise NPAError(
            f"s must have shape [B, N, C] with the B and N of x, {tuple(x.shape[:2])}, "
            f"got {tuple(s.shape)}: give one state for each particle"
        )
    check_dense("s", s)
    if s.device != x.device:
        raise NPAError(
            f"x and s must share a device, got {x.device} and {s.device}: "
            f"convert one with .to(other)"
        )


def _check_vector(name: str, vector: Tensor, x: Tensor) -> None:
    wanted = (x.shape[0], x.shape[2])
    if vector.shape != wanted:
        raise NPAError(
            f"{name} must have shape [B, D] = {wanted}, got {tuple(vector.shape)}: "
            f"give one vector for each world, for example {name}.expand{wanted}"
        )
    if vector.device != x.device or vector.dtype != x.dtype:
        raise NPAError(
            f"{name} must be {x.dtype} on {x.device} like x, got {vector.dtype} on "
            f"{vector.device}: convert it with {name}.to(x)"
        )
