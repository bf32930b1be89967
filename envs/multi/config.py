"""What every environment of several species can be told: flat keywords, checked before all else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Literal, Self

import numpy as np
from torch import Tensor

from npa_envs.envs.core.config import LARGEST, Boundary, EnvConfig, Output
from npa_envs.errors import NPAError, suggest
from npa_envs.render import STYLES
from npa_envs.tasks.checks import check_non_negative, check_positive, is_whole
from npa_envs.world.actions import MomentInverse

Reward = Literal["individual", "team"]

Perception = Literal["shared", "per_species"]

PERCEPTIONS = ("shared", "per_species")
"""Whether particles perceive species one by one besides all of them."""

OnDivergence = Literal["terminate", "raise", "ignore"]

DIVERGENCES = ("terminate", "raise", "ignore")
"""What becomes of agents that are out of bounds with all their particles."""

REWARDS = ("individual", "team")
"""Whose improvement an agent is paid for."""

SPECIES_STYLE = "species"
"""Style of pictures in which each species has one colour."""

OWN_FIELDS = ("reward", "render_style", "particle_count")
"""Fields that one world's configuration has as well, with another meaning."""

LARGEST_COUNT = 64
"""No more species than this: their tags are smoothed as states."""


@dataclass(frozen=True, kw_only=True)
class SpeciesConfig:
    """The fields that all tasks of several species share; a task adds its own.

    Lengths are in length units: pictures show [-1, 1] x [-1, 1] and what species need besides.
    """

    species_count: int = 2
    """Species K."""

    particle_count: int = 1024
    """Particles of all species together, N; they are shared out evenly."""

    particle_counts: tuple[int, ...] = ()
    """Particles of each species, where these differ; empty: equal shares of `particle_count`."""

    state_dim: int = 16
    """State channels of a particle, C; the last three are its colour (less 0.5)."""

    eps: float = 0.1
    """Perception radius ε [length units]."""

    eps0: float = 0.1
    """Radius ε0 that perception is scaled to: that of the rules run here [length units]."""

    alpha: float = 0.5
    """Largest displacement in one step, as a fraction of ε (dimensionless)."""

    state_scale: float = 1.0
    """State step of an action of 1 (dimensionless)."""

    update_prob: float = 0.5
    """Probability p that a particle's action takes effect in a step (dimensionless)."""

    dt: float = 1.0
    """Time step (dimensionless)."""

    position_noise: float = 0.0
    """Standard deviation of the noise added to every position in a step [length units]."""

    moment_inverse: MomentInverse = "threshold"
    """How observed state gradients are corrected: "threshold", the paper's, which jumps where
    neighbours come to lie on a line; or "smooth", for rules that are trained with it."""

    perception: Perception = "shared"
    """"shared": particles perceive each other whatever their species; "per_species": they also
    perceive the density and the density gradient of each species."""

    boundary: Boundary = "open"
    """"open" space, or a "periodic" box into which positions are wrapped."""

    box_size: float = 2.0
    """Side of the periodic box around the origin [length units]."""

    observation_limit: float = 64.0
    """Observations and states are clipped to ± this (dimensionless)."""

    position_limit: float = 4.0
    """Coordinates are clipped to ± this; a particle held there is out of bounds [length units]."""

    on_divergence: OnDivergence = "terminate"
    """What becomes of an agent all of whose particles are out of bounds: "terminate" takes it out
    of the world; "raise" is an error that names it; "ignore" lets it go on, held at the limits."""

    seed_radius: float = 0.2
    """Radius of the disk that each species starts in [length units]."""

    seed_distance: float = 0.4
    """Distance between the centres of neighbouring disks, which lie in a row [length units]."""

    deaths: tuple[tuple[int, int], ...] = ()
    """Pairs (species, step): the species is removed at the end of that step."""

    reward: Reward = "individual"
    """"individual": each agent is paid for its own improvement; "team": for the mean of all."""

    max_cycles: int = 256
    """Steps after which the episode is cut off for all."""

    device: str = "cpu"
    """Where the world lives: "cpu", "cuda" or "cuda:1"."""

    output: Output = "numpy"
    """Arrays that come out: "numpy", or "torch" tensors on the device."""

    render_mode: str | None = None
    """None, "rgb_array" or "human" (a window, with pygame)."""

    render_style: str = "species"
    """What pictures show: "species" (a colour each), "particles" (their own colours), "density" or
    "states" (hidden channels)."""

    render_size: int = 256
    """Pixels on each side of a rendered picture."""

    def __post_init__(self) -> None:
        """Check every field.

        Raises:
            NPAError: A field has the wrong type or lies outside its range, or this machine does not
                have the device.
        """
        check_positive(self, int, "species_count", "particle_count", "max_cycles")
        if self.species_count > LARGEST_COUNT:
            raise NPAError(
                f"species_count must be at most {LARGEST_COUNT}, got {self.species_count}: "
                "give each of fewer species more particles"
            )
        self._check_counts()
        check_positive(self, float, "seed_radius")
        check_non_negative(self, "seed_distance")
        self._check_deaths()
        if self.perception not in PERCEPTIONS:
            hint = suggest(str(self.perception), PERCEPTIONS)
            raise NPAError(f"perception must be a known word, got {self.perception!r}: {hint}")
        if self.reward not in REWARDS:
            hint = suggest(str(self.reward), REWARDS)
            raise NPAError(f"reward must be a known word, got {self.reward!r}: {hint}")
        if self.on_divergence not in DIVERGENCES:
            hint = suggest(str(self.on_divergence), DIVERGENCES)
            raise NPAError(
                f"on_divergence must be a known word, got {self.on_divergence!r}: {hint}"
            )
        styles = (SPECIES_STYLE, *STYLES)
        if self.render_style not in styles:
            hint = suggest(str(self.render_style), styles)
            raise NPAError(f"render_style must be a known word, got {self.render_style!r}: {hint}")
        # The world checks its own fields; it knows no pictures of species.
        box = self.world.box
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, int | float) and value > LARGEST:
                raise NPAError(f"{field.name} must be at most {LARGEST:g}, got {value}")
        half = self.position_limit if box is None else 0.5 * box
        if self.seed_span >= half:
            raise NPAError(
                f"seed_radius and seed_distance must keep all disks within {half:g}, got disks up "
                f"to {self.seed_span:g}: worlds would begin out of bounds"
            )

    @cached_property
    def world(self) -> EnvConfig:
        """The configuration of the world as any task's, which checks what they share."""
        names = [field.name for field in fields(EnvConfig) if field.name not in OWN_FIELDS]
        shared = {name: getattr(self, name) for name in names if hasattr(self, name)}
        if self.render_style != SPECIES_STYLE:
            shared["render_style"] = self.render_style
        return EnvConfig(particle_count=sum(self.counts), **shared)

    @property
    def counts(self) -> tuple[int, ...]:
        """Particles of each species at the start of an episode."""
        if self.particle_counts:
            return self.particle_counts
        share, rest = divmod(self.particle_count, self.species_count)
        return tuple(share + int(k < rest) for k in range(self.species_count))

    @property
    def seed_span(self) -> float:
        """How far from the origin particles start at most [length units]."""
        return self.seed_radius + 0.5 * (self.species_count - 1) * self.seed_distance

    @classmethod
    def from_keywords(cls, keywords: dict[str, Any]) -> Self:
        """Return the configuration with some fields changed.

        Args:
            keywords: Fields by name; lists and arrays are taken for tuples.

        Raises:
            NPAError: There is no field of that name, or a field is wrong.
        """
        known = [field.name for field in fields(cls)]
        for name in keywords:
            if name not in known:
                elsewhere = {"seed": "give it to reset(seed=...)"}
                raise NPAError(
                    f"unknown keyword {name!r}: {elsewhere.get(name, suggest(name, known))}"
                )
        changes = {name: plain(value) for name, value in keywords.items()}
        if "particle_count" in changes and changes.get("particle_counts"):
            raise NPAError(
                "particle_count and particle_counts exclude each other: "
                "particle_counts gives the number of each species"
            )
        return replace(cls(), **changes)

    def _check_counts(self) -> None:
        given = self.particle_counts
        whole = isinstance(given, tuple) and all(is_whole(count) for count in given)
        if given and (not whole or len(given) != self.species_count or min(given) < 1):
            raise NPAError(
                f"particle_counts must be {self.species_count} whole numbers of at least 1, one "
                f"for each of species_count = {self.species_count}, got {given!r}: for example "
                f"particle_counts={(64,) * self.species_count}"
            )
        if not given and self.particle_count < self.species_count:
            raise NPAError(
                f"particle_count must be at least species_count = {self.species_count}, got "
                f"{self.particle_count}: each species needs a particle"
            )

    def _check_deaths(self) -> None:
        rule = (
            "deaths must be pairs (species, step), each species from 0 to "
            f"{self.species_count - 1} at most once, each step at least 1"
        )
        given = self.deaths
        pairs = isinstance(given, tuple) and all(
            isinstance(pair, tuple) and len(pair) == 2 and all(is_whole(k) for k in pair)
            for pair in given
        )
        fits = pairs and all(0 <= k < self.species_count and step > 0 for k, step in given)
        if not fits or len({k for k, _ in given}) < len(given):
            raise NPAError(f"{rule}, got {given!r}: for example deaths=((1, 50),)")


def plain(value: Any) -> Any:
    """Return a value as fields have it: NumPy's numbers as Python's, lists and arrays as tuples.

    Args:
        value: Of any type; others are left as they are.
    """
    if isinstance(value, np.generic | np.ndarray | Tensor):
        value = value.tolist()
    if isinstance(value, Sequence) and not isinstance(value, str):
        return tuple(plain(entry) for entry in value)
    return value
