"""2D morphogenesis of several species that share one world."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from npa_envs.checks import check_non_negative
from npa_envs.errors import NPAError
from npa_envs.rule.rule import COLOUR_OFFSET, NPARule
from npa_envs.tasks.base import ParticleTask
from npa_envs.tasks.morphogenesis2d import (
    HALF_SEEDS,
    MORPHOGENESIS2D_PRESETS,
    Morphogenesis2D,
    Morphogenesis2DConfig,
    Morphogenesis2DTrainConfig,
)
from npa_envs.tasks.train_config import JointTrainConfig
from npa_envs.world.particles import Particles, combined
from npa_envs.world.randomness import Randomness


@dataclass(frozen=True, kw_only=True)
class CoMorphogenesis2DConfig:
    """Several pictures that grow in one world, each by its own rule."""

    species: tuple[Morphogenesis2DConfig, ...] = (
        Morphogenesis2DConfig(),
        Morphogenesis2DConfig(target="heart"),
    )
    """The configuration of each species' task. All have the same eps, update_prob and state_dim."""

    distance: float = 0.0
    """Distance between the centres of neighbouring seeds, on the x axis [length units]."""

    def __post_init__(self) -> None:
        """Check every field."""
        species = self.species if isinstance(self.species, tuple | list) else ()
        if len(species) < 2 or not all(isinstance(s, Morphogenesis2DConfig) for s in species):
            came = ", ".join(type(config).__name__ for config in species) or "nothing"
            raise NPAError(
                f"species must hold two Morphogenesis2DConfig or more, got {came}: one for each "
                "species"
            )
        for name in ("eps", "update_prob", "state_dim"):
            values = [getattr(config, name) for config in species]
            if len(set(values)) > 1:
                raise NPAError(f"species must agree in {name}, got {values}: change one of them")
        check_non_negative(self, "distance")

    @property
    def counts(self) -> tuple[int, ...]:
        """Particles of each species."""
        return tuple(config.particle_count for config in self.species)

    @property
    def centres(self) -> tuple[float, ...]:
        """First coordinate of each seed's centre [length units]; their mean is 0."""
        middle = 0.5 * (len(self.species) - 1)
        return tuple(self.distance * (k - middle) for k in range(len(self.species)))


class CoMorphogenesis2D(ParticleTask[Any]):
    """`Morphogenesis2D` of every species, each on its own particles.

    Worlds contain the particles of all species, one species after the other.
    """

    def __init__(
        self,
        config: CoMorphogenesis2DConfig | None = None,
        *,
        device: str | torch.device = "cpu",
    ) -> None:
        self.config = config or CoMorphogenesis2DConfig()
        self.tasks = [Morphogenesis2D(own, device=device) for own in self.config.species]
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
        """Raise NPAError: each species has its own rule (`make_rules`)."""
        raise NPAError(
            f"{len(self.tasks)} species need as many rules, not one: "
            "train them with npa_envs.training.train_together"
        )

    def seed(
        self, world_count: int, *, generator: Randomness, device: str | torch.device = "cpu"
    ) -> Particles:
        """Return fresh worlds: each species uniform in its own disk, all states zero."""
        seeds = [task.seed(world_count, generator=generator, device=device) for task in self.tasks]
        positions = [
            torch.stack((x[..., 0] + centre, x[..., 1]), dim=-1)
            for (x, *_), centre in zip(seeds, self.config.centres, strict=True)
        ]
        return Particles(torch.cat(positions, 1), torch.cat([one.s for one in seeds], 1))

    def damage(self, worlds: Particles, generator: Randomness) -> Particles:
        """Return the worlds with each species damaged independently."""
        damaged = [
            task.damage(Particles(x, s), generator)
            for task, x, s in zip(self.tasks, *self._split(worlds.x, worlds.s), strict=True)
        ]
        return combined(lambda parts: torch.cat(parts, 1), damaged)

    def loss(self, x: Tensor, s: Tensor, path_length: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the sum of the species' training losses and its parts, named "k.part"."""
        total = x.new_zeros(())
        parts: dict[str, Tensor] = {}
        split = zip(self.tasks, self.config.centres, *self._split(x, s, path_length), strict=True)
        for number, (task, centre, own_x, own_s, own_path) in enumerate(split):
            # Positions relative to the seed: the loss bounds each species around its own.
            relative = torch.stack((own_x[..., 0] - centre, own_x[..., 1]), dim=-1)
            loss, own_parts = task.loss(relative, own_s, own_path)
            total = total + loss
            parts |= {f"{number}.{name}": value for name, value in own_parts.items()}
        return total, parts

    def picture(self, x: Tensor, s: Tensor) -> Tensor:
        """Return each world's picture with all species, shape [B, R, R, 4].

        It spans [-1, 1] x [-1, 1], at the resolution of the first species.
        """
        return self.tasks[0].picture(x, s, centred=False)

    @property
    def target_picture(self) -> Tensor:
        """The picture of all targets, each around its species' seed; shape [R, R, 4]."""
        positions, states = [], []
        for task, centre in zip(self.tasks, self.config.centres, strict=True):
            points, colours = task.target.points, task.target.colours
            positions.append(points + points.new_tensor((centre, 0.0)))
            states.append(colours.new_zeros(len(colours), task.config.state_dim))
            states[-1][:, -3:] = colours - COLOUR_OFFSET
        return self.picture(torch.cat(positions)[None], torch.cat(states)[None])[0]

    def metrics(self, x: Tensor, s: Tensor) -> Tensor:
        """Return each species' splat loss in each world, shape [B, K]."""
        split = zip(self.tasks, *self._split(x, s), strict=True)
        return torch.stack([task.metric(own_x, own_s) for task, own_x, own_s in split], dim=1)

    def metric(self, x: Tensor, s: Tensor) -> Tensor:
        """Return each world's mean splat loss of its species, shape [B]."""
        return self.metrics(x, s).mean(dim=1)

    def _split(self, *tensors: Tensor) -> list[tuple[Tensor, ...]]:
        """Return each tensor's parts, species by species."""
        return [torch.split(tensor, list(self.config.counts), dim=1) for tensor in tensors]


DISTANCE = 0.8
"""Distance between the seeds' centres in every preset [length units]: the pictures overlap."""


_MEASURED: Mapping[str, Mapping[str, Any]] = {
    "best": {
        "optimiser": "adamw",
        "learning_rate": 2e-3,
        "weight_decay": 0.0,
        "max_age_range": (64, 16_384),
        "damage_and_keep_share": 0.0,
        "damage_share": 0.25,
        "stillness_min_age": 512,
        "stillness_power": 1.0,
        "dead_zone": 0.0,
    },
    "fast": {**HALF_SEEDS, "learning_rate": 4e-3},
}
"""Settings of each preset that docs/species.md measured, by AdamW."""

_OWN: Mapping[str, Mapping[str, Any]] = {"best": {"cut_share": 0.25}, "fast": {"hidden_dim": 64}}
"""Settings of each species in those measurements."""


def _with_neighbour(
    name: str, alone: Morphogenesis2DTrainConfig, neighbour: str
) -> JointTrainConfig[CoMorphogenesis2DConfig]:
    """Return the run of a species together with a second one that grows `neighbour`."""
    own = dataclasses.replace(alone.task, **_OWN.get(name, {}))
    species = (own, dataclasses.replace(own, target=neighbour))
    run = {field.name: getattr(alone, field.name) for field in dataclasses.fields(alone)}
    run["task"] = CoMorphogenesis2DConfig(species=species, distance=DISTANCE)
    # A preset names no initial rules of species.
    run |= {"initial_rule": "", "out": Path("runs/co_morphogenesis2d")}
    return JointTrainConfig(**{**run, **_MEASURED.get(name, {})})


CO_MORPHOGENESIS2D_PRESETS: Mapping[str, JointTrainConfig[CoMorphogenesis2DConfig]] = {
    name: _with_neighbour(name, alone, "heart") for name, alone in MORPHOGENESIS2D_PRESETS.items()
}
"""Each preset of 2D morphogenesis, with as many particles of a second species, by AdamW."""
