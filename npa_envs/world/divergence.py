"""Divergence: detection on the device of worlds whose values become infinite, NaN or huge."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple, TypeVar, get_args

import torch
from torch import Tensor

from npa_envs.checks import check_world, checked_choice, checked_number
from npa_envs.errors import DivergedError, NPAError
from npa_envs.world.particles import Particles

OnDivergence = Literal["ignore", "raise"]
"""How a rollout treats worlds that diverge."""

RUNAWAY = 1e6
"""Default limit of coordinates [length units] and states (dimensionless)."""

Entry = TypeVar("Entry")

MAX_REPORT = 8
"""Maximum number of worlds that a report describes; it counts the others."""


class Divergence(NamedTuple):
    """Which worlds have diverged: flags on the worlds' device."""

    non_finite: Tensor
    """Worlds with an infinite or NaN value, bool, shape [B]."""
    runaway: Tensor
    """Worlds whose values are all finite and one beyond the limit, bool, shape [B]."""


@torch.no_grad()
def divergence(x: Tensor, s: Tensor, *, limit: float = RUNAWAY) -> Divergence:
    """Return which worlds have diverged, without waiting for the device.

    Args:
        x: Particle positions [length units], shape [B, N, D].
        s: Particle states, dimensionless, shape [B, N, C].
        limit: Largest absolute value of a coordinate [length units] or state that is not `runaway`.

    Returns:
        Flags, bool, shape [B] each. `x[~(flags.non_finite | flags.runaway)]` are the worlds that
        have not diverged.

    Raises:
        NPAError: Shapes, dtypes or devices do not fit each other, or the limit is not positive.
    """
    check_world(x, s)
    limit = checked_number("limit", limit)
    if not limit > 0.0:
        raise NPAError(f"limit must be positive, got {limit}")
    # The largest value is NaN if any value is.
    largest = torch.stack((x.abs().amax(dim=(1, 2)), s.abs().amax(dim=(1, 2)))).amax(dim=0)
    finite = largest.isfinite()
    return Divergence(~finite, finite & (largest > limit))


@torch.no_grad()
def describe_divergence(x: Tensor, s: Tensor, *, limit: float = RUNAWAY) -> str:
    """Return a line for each world that has diverged, with its first diverged value.

    It waits for the device. Arguments and errors are those of `divergence`.

    Returns:
        Lines as "world 1: states channel 3 of particle 7 is nan (2 such numbers in 1 particle)", at
        most eight of them; "" where no world has diverged.
    """
    flags = divergence(x, s, limit=limit)
    worlds = (flags.non_finite | flags.runaway).nonzero()[:, 0].tolist()

    def describe(world: int) -> str:
        values = torch.cat((x[world], s[world]), dim=1).cpu()
        bad = ~values.isfinite()
        beyond = ""
        if not bool(bad.any()):
            bad = values.abs() > limit
            beyond = f", beyond {limit:g}"
        particle, entry = bad.nonzero()[0].tolist()
        number, particles = int(bad.sum()), int(bad.any(dim=1).sum())
        return (
            f"world {world}: {term_name(entry, x.shape[2])} of particle {particle} is "
            f"{values[particle, entry].item():g}{beyond} ({number} such "
            f"number{'s' * (number > 1)} in {particles} particle{'s' * (particles > 1)})"
        )

    return "\n".join(first_reports(worlds, describe))


def first_reports(diverged: Sequence[Entry], describe: Callable[[Entry], str]) -> list[str]:
    """Return the lines of `describe` about the first diverged worlds, then a count of the rest."""
    others = len(diverged) - MAX_REPORT
    count = [f"and {others} more worlds"] if others > 0 else []
    return [describe(entry) for entry in diverged[:MAX_REPORT]] + count


def term_name(entry: int, space_dim: int) -> str:
    """Return the name of entry `entry` of a particle's D coordinates followed by its C channels."""
    is_position = entry < space_dim
    return f"positions coordinate {entry}" if is_position else f"states channel {entry - space_dim}"


class DivergenceWatch:
    """Records when and where each world first had an infinite or NaN value.

    It checks after each step, on the device; only `raise_diverged` waits for the device.
    """

    def __init__(self, worlds: Particles) -> None:
        world_count, _, self._space_dim = worlds.x.shape
        self._checks = 0
        self._first_check = torch.full((world_count,), -1, device=worlds.x.device)
        """The first check that found a value, by world; -1: none did."""
        self._values = torch.zeros_like(torch.cat((worlds.x, worlds.s), dim=2))
        """Positions and states at that check."""
        self.check(worlds)

    @torch.no_grad()
    def check(self, worlds: Particles) -> None:
        """Record worlds that are not finite for the first time: index of this check, values."""
        values = torch.cat((worlds.x, worlds.s), dim=2)
        is_first = ~values.isfinite().all(dim=(1, 2)) & (self._first_check < 0)
        self._first_check.masked_fill_(is_first, self._checks)
        self._values = torch.where(is_first[:, None, None], values, self._values)
        self._checks += 1

    def raise_diverged(self) -> None:
        """Raise DivergedError if a world has diverged, with its step; waits for the device."""
        first_checks = self._first_check.tolist()
        worlds = sorted((step, world) for world, step in enumerate(first_checks) if step >= 0)

        def describe(step_and_world: tuple[int, int]) -> str:
            step, world = step_and_world
            values = self._values[world].cpu()
            particle, entry = (~values.isfinite()).nonzero()[0].tolist()
            when = f"in step {step}" if step > 0 else "before the first step"
            name, number = term_name(entry, self._space_dim), values[particle, entry].item()
            return f"world {world}: {name} of particle {particle} was {number:g} {when}"

        if not worlds:
            return
        raise DivergedError(
            f"worlds must stay finite, but {len(worlds)} of {len(first_checks)} did not, "
            f"{'; '.join(first_reports(worlds, describe))}: "
            "take smaller steps (dt) or states, or find such worlds with npa_envs.divergence and "
            "replace them (on_divergence='ignore')"
        )


def make_watch(on_divergence: str, worlds: Particles) -> DivergenceWatch | None:
    """Return a watch for divergence of these worlds; None with `on_divergence="ignore"`."""
    if on_divergence == "ignore":
        return None
    checked_choice("on_divergence", on_divergence, get_args(OnDivergence))
    if worlds.x.is_cuda and torch.cuda.is_current_stream_capturing():
        raise NPAError(
            "on_divergence must be 'ignore' while a CUDA graph is captured, got 'raise', which "
            "waits for the device: read npa_envs.divergence after a replay"
        )
    return DivergenceWatch(worlds)
