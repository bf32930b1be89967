"""The task of 2D morphogenesis of several species, each by its own rule, in one world."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor

from npa_envs.checks import check_non_negative
from npa_envs.errors import NPAError
from npa_envs.rule.rule import COLOUR_OFFSET, NPARule
from npa_envs.tasks.base import ParticleTask
from npa_envs.tasks.morphogenesis2d import (
    MORPHOGENESIS2D_PRESETS,
    SPECIES_RUN,
    Morphogenesis2D,
    Morphogenesis2DConfig,
)
from npa_envs.tasks.train_config import JointTrainConfig
from npa_envs.world.particles import Particles, combined
from npa_envs.world.randomness import Randomness


@dataclass(frozen=True, kw_only=True)
class CoMorphogenesis2DConfig:
    """Settings of several pictures that grow in one world, each by its own rule."""

    species: tuple[Morphogenesis2DConfig, ...] = (
        Morphogenesis2DConfig(),
        Morphogenesis2DConfig(target="heart"),
    )
    """The configuration of each species' task. All have the same eps, update_prob and state_dim."""

    distance: float = 0.0
    """Distance between the centres of successive species' start disks, along x [length units]."""

    def __post_init__(self) -> None:
        species = self.species if isinstance(self.species, tuple | list) else ()
        if len(species) < 2 or not all(isinstance(s, Morphogenesis2DConfig) for s in species):
            types = ", ".join(type(config).__name__ for config in species) or "nothing"
            raise NPAError(
                f"species must hold two Morphogenesis2DConfig or more, got {types}: one for each "
                "species"
            )
        for name in ("eps", "update_prob", "state_dim"):
            values = [getattr(config, name) for config in species]
            if len(set(values)) > 1:
                raise NPAError(f"species must agree in {name}, got {values}: change one of them")
        check_non_negative(self, "distance")

    @property
    def counts(self) -> tuple[int, ...]:
        """Number of particles of each species."""
        return tuple(config.particle_count for config in self.species)

    @property
    def centres(self) -> tuple[float, ...]:
        """x coordinate of the centre of each species' start disk [length units]; mean 0."""
        middle = 0.5 * (len(self.species) - 1)
        return tuple(self.distance * (k - middle) for k in range(len(self.species)))


class CoMorphogenesis2D(ParticleTask[Any]):
    """The task of growing several pictures in one world, each by its own rule.

    The particles of one picture are a species; they have consecutive indices.
    """

    def __init__(
        self,
        config: CoMorphogenesis2DConfig | None = None,
        *,
        device: str | torch.device = "cpu",
    ) -> None:
        self.config = config or CoMorphogenesis2DConfig()
        self.species_counts = self.config.counts
        self.tasks = [Morphogenesis2D(species, device=device) for species in self.config.species]
        """The task of each species."""

    @property
    def eps(self) -> float:
        """Perception radius [length units]."""
        return self.tasks[0].eps

    @property
    def update_prob(self) -> float:
        """Probability of a particle's update in a step, dimensionless."""
        return self.tasks[0].update_prob

    def make_rules(self, generator: torch.Generator) -> list[NPARule]:
        """Return an untrained rule for each species, on the CPU."""
        return [task.make_rule(generator) for task in self.tasks]

    def make_rule(self, generator: torch.Generator) -> NPARule:
        """Raise NPAError: each species has its own rule, made by `make_rules`."""
        raise NPAError(
            f"{len(self.tasks)} species need as many rules, not one: "
            "train them with npa_envs.training.train_together"
        )

    def seed(
        self, world_count: int, *, generator: Randomness, device: str | torch.device = "cpu"
    ) -> Particles:
        """Return initial worlds: each species uniform in its start disk, all states zero."""
        return together(
            [
                _shifted(task.seed(world_count, generator=generator, device=device), centre)
                for task, centre in zip(self.tasks, self.config.centres, strict=True)
            ]
        )

    def damage(self, worlds: Particles, generator: Randomness) -> Particles:
        """Return worlds after the random damage of each species' task."""
        species = zip(self.tasks, worlds.split(self.config.counts), strict=True)
        return together([task.damage(each, generator) for task, each in species])

    def with_process_mean(self, mean: Callable[[Tensor], Tensor]) -> Self:
        """Return a copy in which each species' task averages over training processes by `mean`."""
        return self._copy_with(tasks=[task.with_process_mean(mean) for task in self.tasks])

    def loss(self, worlds: Particles) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the sum of the species' training losses, and terms of species k as "k.term"."""
        total = worlds.x.new_zeros(())
        terms: dict[str, Tensor] = {}
        for k, species in enumerate(worlds.split(self.config.counts)):
            # Positions relative to the centre of the species, around which its loss bounds them.
            loss, species_terms = self.tasks[k].loss(_shifted(species, -self.config.centres[k]))
            total = total + loss
            terms |= {f"{k}.{name}": term for name, term in species_terms.items()}
        return total, terms

    def picture(self, x: Tensor, s: Tensor) -> Tensor:
        """Return pictures of all species, [B, R, R, 4], at the resolution of the first one."""
        return self.tasks[0].picture(x, s, centred=False)

    @property
    def target_picture(self) -> Tensor:
        """The picture of all targets, each around its species' start disk; shape [R, R, 4]."""
        targets = []
        for task, centre in zip(self.tasks, self.config.centres, strict=True):
            # States are colours only.
            target = Particles(task.target.points[None], task.target.colours[None] - COLOUR_OFFSET)
            targets.append(_shifted(target, centre))
        x, s, *_ = together(targets)
        return self.picture(x, s)[0]


def _shifted(worlds: Particles, distance: float) -> Particles:
    """Return worlds moved along the x axis by a distance [length units]."""
    x, y = worlds.x.unbind(dim=-1)
    return worlds._replace(x=torch.stack((x + distance, y), dim=-1))


def together(species: Sequence[Particles]) -> Particles:
    """Return worlds with the particles of all species, one species after the other."""
    return combined(lambda fields: torch.cat(fields, 1), species)


PRESET_DISTANCE = 0.8
"""`distance` of every preset [length units]: the pictures overlap."""


_RUNS: Mapping[str, Mapping[str, Any]] = {
    "best": {
        "optimiser": "adamw", "learning_rate": 2e-3, "weight_decay": 0.0,
        "max_age_range": (64, 16_384), "damage_and_keep_share": 0.0, "damage_share": 0.25,
        "stillness_min_age": 512, "stillness_power": 1.0, "dead_zone": 0.0, "iterations": 8000,
        "wound_chance": 0.0, "wound_weight": 0.0,
    },
    "fast": {**SPECIES_RUN, "learning_rate": 4e-3},
}  # fmt: skip
"""Settings of the runs that docs/species.md measured, by AdamW."""

_SPECIES: Mapping[str, Mapping[str, Any]] = {
    "best": {"cut_share": 0.25, "cut_anywhere": False},
    "fast": {"hidden_dim": 64},
}
"""Settings of each species in those measurements."""


def _joint_preset(name: str) -> JointTrainConfig[CoMorphogenesis2DConfig]:
    """Return the preset of 2D morphogenesis of this name, with a heart as second species."""
    preset = MORPHOGENESIS2D_PRESETS[name]
    first = replace(preset.task, **_SPECIES.get(name, {}))
    species = (first, replace(first, target="heart"))
    task = CoMorphogenesis2DConfig(species=species, distance=PRESET_DISTANCE)
    # A preset names no initial rules of species.
    run = {**vars(preset), "task": task, "initial_rule": "", **_RUNS.get(name, {})}
    return JointTrainConfig(**{**run, "out": Path("runs/co_morphogenesis2d")})


CO_MORPHOGENESIS2D_PRESETS = {
    name: _joint_preset(name) for name in ("paper", "best", "fast", "tiny")
}
"""Each preset of 2D morphogenesis, with as many particles of a second species, by AdamW."""
