"""The tasks of several species, and the tables of their names and ids."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from npa_envs import perceive, world_mean
from npa_envs.checks import check_field
from npa_envs.envs.multi.species_task import Population, SpeciesConfig, SpeciesTask
from npa_envs.errors import NPAError, shown, suggest
from npa_envs.registration import SPECIES, SPECIES_SIZES
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D, Morphogenesis2DConfig
from npa_envs.world.randomness import StreamId, WorldRandom


class MixingTask(SpeciesTask):
    """Mix the species; a particle's loss is 1 minus the entropy of species around it."""

    def losses(self, population: Population) -> Mapping[str, Tensor]:
        """Return the mean loss of each species' particles, by name, shape [B, S]."""
        spans = [population.spans[k] for k in _present(population)]
        return {
            name: by_species([world_mean(loss[:, span, None])[:, 0] for span in spans], population)
            for name, loss in self.particle_losses(population).items()
        }

    def particle_losses(self, population: Population) -> Mapping[str, Tensor]:
        """Return 1 minus the entropy of species around each particle, by name, [B, N]."""
        return {"separation": 1.0 - self._entropy(population)}

    def _entropy(self, population: Population) -> Tensor:
        """Return the entropy of species around each particle, in [0, 1], shape [B, N].

        The fraction of species k around a particle is f_k = b_k / Σ b, where b are SPH-smoothed
        tags (1 for a particle of species k, else 0). The entropy is −Σ f_k ln f_k / ln S: 0 with
        one species in the neighbourhood, 1 with equal parts of all S.
        """
        species_count = len(population.counts)
        if population.neighbours is not None:
            smoothed = population.neighbours.smoothed_species(population.species, species_count)
            fractions = smoothed / smoothed.sum(dim=2, keepdim=True)
            summed: Tensor = torch.special.entr(fractions).sum(dim=2)
            return summed / math.log(species_count)
        indices = torch.arange(species_count, device=population.x.device)
        tags = (population.species[:, None] == indices).to(population.x)
        perceived = perceive(
            population.x,
            tags.expand(len(population.x), -1, -1).contiguous(),
            self.config.eps,
            box=self.config.periodic_box,
            detach_positions=False,
            state_gradient=False,
            moment_correction=False,
            density_gradient=False,
        )
        smoothed = perceived[..., species_count:]
        fractions = smoothed / smoothed.sum(dim=2, keepdim=True)
        # At 0 the entropy has no finite derivative, which would give NaN gradients.
        present = fractions > 0.0
        terms = torch.where(present, torch.special.entr(torch.where(present, fractions, 1.0)), 0.0)
        entropy: Tensor = terms.sum(dim=2)
        return entropy / math.log(species_count)


@dataclass(frozen=True, kw_only=True)
class SegregationConfig(SpeciesConfig):
    """`SpeciesConfig` with all species in one disk at the start."""

    seed_distance: float = 0.0


class SegregationTask(MixingTask):
    """Separate the species; a particle's loss is the entropy of species around it."""

    config_type = SegregationConfig

    def particle_losses(self, population: Population) -> Mapping[str, Tensor]:
        """Return the entropy of species around each particle, by name, [B, N]."""
        return {"mixture": self._entropy(population)}


DEFAULT_TARGETS = ("gecko", "heart", "butterfly", "flower", "octopus", "ring")
"""Default targets of species 0, 1, ...; the first one follows the last."""


@dataclass(frozen=True, kw_only=True)
class PictureLossConfig(SpeciesConfig):
    """`SpeciesConfig` with fields of the loss, which `Morphogenesis2DConfig` documents."""

    task_config_type = Morphogenesis2DConfig
    resolution: int = 64
    sigma: float = Morphogenesis2DConfig.sigma
    colour_weight: float = Morphogenesis2DConfig.colour_weight
    render_style: str = "particles"

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = self.task_config()

    def task_config(self, particle_count: int = 1, **changes: Any) -> Morphogenesis2DConfig:
        """Return the training task's configuration for so many particles, with `changes`."""
        counts = {"target_point_count": particle_count, "particle_count": particle_count}
        return self.as_config(Morphogenesis2DConfig, **counts, **changes)


@dataclass(frozen=True, kw_only=True)
class OnePictureConfig(PictureLossConfig):
    """`PictureLossConfig` with one target picture."""

    target: str = Morphogenesis2DConfig.target


class PictureLossTask(SpeciesTask):
    """Base class: the task of growing `pictures`, each a target and its number of particles."""

    def __init__(self, config: Any, device: torch.device, *pictures: tuple[str, int]) -> None:
        super().__init__(config, device)
        self.tasks = [
            Morphogenesis2D(config.task_config(count, target=target), device=device)
            for target, count in pictures
        ]
        """Training task of each picture, with its target and loss."""
        self.task = self.tasks[0]
        """The first of them, whose target scripted policies use."""

    def picture_terms(self, k: int, x: Tensor, s: Tensor) -> dict[str, Tensor]:
        """Return density error and weighted colour error from target k, by name, [B] each."""
        density, colour = self.tasks[k].splat_losses(x, s)
        return {"density": density, "colour": self.config.colour_weight * colour}

    @property
    def pixel_size(self) -> float:
        """Size of a particle in pictures: the spacing of the first target's points."""
        return self.task.target.pixel_size

    @property
    def open_half_width(self) -> float:
        """Half of a picture's side in open space [length units]; each start's target fits in."""
        return float(1.0 + 0.5 * (self.config.species_count - 1) * self.config.seed_distance)


@dataclass(frozen=True, kw_only=True)
class CoMorphogenesisConfig(PictureLossConfig):
    """`PictureLossConfig` with a target for each species."""

    targets: tuple[str, ...] = ()
    """Target of each species: built-in names (`npa-envs list`), emoji, or paths of pictures; empty:
    built-in ones."""

    seed_distance: float = 1.0
    """Distance between the centres of neighbouring disks [length units]; 0 grows pictures through
    each other, 2 side by side."""

    def __post_init__(self) -> None:
        super().__post_init__()
        names, count = self.targets, self.species_count
        named = isinstance(names, tuple) and all(isinstance(n, str) and n for n in names)
        fits = not names or (named and len(names) == count)
        rule = f"be {count} names, emoji or paths, one for each of species_count = {count}"
        check_field(self, "targets", fits, rule, f"for example targets={self._default_targets}")

    @property
    def target_names(self) -> tuple[str, ...]:
        """Target of each species: `targets`, or default ones if that is empty."""
        return self.targets or self._default_targets

    @property
    def _default_targets(self) -> tuple[str, ...]:
        return tuple(DEFAULT_TARGETS[k % len(DEFAULT_TARGETS)] for k in range(self.species_count))


class CoMorphogenesisTask(PictureLossTask):
    """Grow a picture from each species, each with its own target."""

    config_type = CoMorphogenesisConfig
    least_species = 1

    def __init__(self, config: CoMorphogenesisConfig, device: torch.device) -> None:
        super().__init__(config, device, *zip(config.target_names, config.counts, strict=True))

    def losses(self, population: Population) -> Mapping[str, Tensor]:
        """Return density error and weighted colour error of each species, by name, [B, S]."""
        terms = [self.picture_terms(k, *population.of(k)) for k in _present(population)]
        return {name: by_species([term[name] for term in terms], population) for name in terms[0]}

    def particle_losses(self, population: Population) -> Mapping[str, Tensor]:
        """Return what each particle adds to its species' splat loss, times N_k, [B, N]."""
        losses = [
            self.tasks[k].particle_contributions(*population.of(k)) for k in _present(population)
        ]
        return {"picture": torch.cat(losses, dim=1)}


@dataclass(frozen=True, kw_only=True)
class InvasionConfig(OnePictureConfig):
    """`OnePictureConfig`, and who acts for the invaders, which are all species but species 0."""

    choices = OnePictureConfig.choices | {"opponent": (None, "random")}
    fixed = OnePictureConfig.fixed | {"reward": "in invasion, where the sum of all rewards is zero"}

    opponent: str | None = None
    """Who acts for the invaders: None: agents; "random": the environment, with actions uniform in
    [-1, 1] for each particle and step."""

    @property
    def agent_particle_counts(self) -> tuple[int, ...]:
        """Particles of each species that agents control."""
        return self.counts if self.opponent is None else self.counts[:1]


class InvasionTask(PictureLossTask):
    """Species 0 grows a picture; the others, invaders, share minus its reward equally."""

    config_type = InvasionConfig

    def __init__(self, config: InvasionConfig, device: torch.device) -> None:
        super().__init__(config, device, (config.target, config.counts[0]))

    def losses(self, population: Population) -> Mapping[str, Tensor]:
        """Return the terms of losses by name, [B, S]; invaders share minus that of species 0."""
        invaders = population.counts[1:]
        present = max(sum(count > 0 for count in invaders), 1)
        return {
            name: torch.stack([loss, *[-loss / present] * len(invaders)], dim=1)
            for name, loss in self.picture_terms(0, *population.of(0)).items()
        }

    def particle_losses(self, population: Population) -> Mapping[str, Tensor]:
        """Return losses by name, [B, N]; invaders have equal ones, and a world's sum is 0."""
        losses = self.task.particle_contributions(*population.of(0))
        count, invader_count = losses.shape[1], sum(population.counts[1:])
        mean = world_mean(losses[..., None])[:, 0] * (-count / max(invader_count, 1))
        return {"picture": torch.cat((losses, mean[:, None].expand(-1, invader_count)), dim=1)}

    def with_opponent(self, action: Tensor, population: Population, random: WorldRandom) -> Tensor:
        """Return `action`, [B, N, A], with random rows for invaders if opponent="random"."""
        if self.config.opponent is None:
            return action
        drawn = 2.0 * random.substream(StreamId.OPPONENT).uniform(*action.shape[1:]) - 1.0
        return torch.where((population.species > 0)[:, None], drawn, action)

    def final_rewards(self, rewards: Tensor, live: Tensor, species: Tensor) -> Tensor:
        """Return rewards, [B, M]: `live` invaders lose in equal parts what species 0 gains."""
        invading = species > 0
        gained = torch.where(invading, 0.0, rewards).sum(dim=1, keepdim=True)
        payers = live & invading
        return torch.where(payers, -gained / payers.sum(dim=1, keepdim=True).clamp_min(1), rewards)

    def is_over(self, counts: tuple[int, ...]) -> bool:
        """Return whether species 0, or every other species, has no live agent."""
        return counts[0] == 0 or sum(counts[1:]) == 0


@dataclass(frozen=True, kw_only=True)
class SymbiosisConfig(OnePictureConfig):
    """`OnePictureConfig` with all species in one disk at the start."""

    seed_distance: float = 0.0


class SymbiosisTask(PictureLossTask):
    """All species grow one picture; the loss of each is the splat loss of all particles."""

    config_type = SymbiosisConfig
    least_species = 1

    def __init__(self, config: SymbiosisConfig, device: torch.device) -> None:
        super().__init__(config, device, (config.target, sum(config.counts)))

    def losses(self, population: Population) -> Mapping[str, Tensor]:
        """Return density error and weighted colour error by name, [B, S], equal for all species."""
        terms = self.picture_terms(0, population.x, population.s)
        count = len(population.counts)
        return {name: loss[:, None].expand(-1, count) for name, loss in terms.items()}

    def particle_losses(self, population: Population) -> Mapping[str, Tensor]:
        """Return what each particle adds to the splat loss, times N, [B, N]."""
        return {"picture": self.task.particle_contributions(population.x, population.s)}

    # There is one picture, in the middle.
    open_half_width = SpeciesTask.open_half_width


def _present(population: Population) -> list[int]:
    return [k for k, count in enumerate(population.counts) if count]


def by_species(losses: list[Tensor], population: Population) -> Tensor:
    """Return the losses of species with particles, [B] each, as [B, S], 0 for the others."""
    present, zeros = iter(losses), population.x.new_zeros(len(population.x))
    return torch.stack([next(present) if n else zeros for n in population.counts], dim=1)


TASKS: dict[str, type[SpeciesTask]] = {
    "mixing": MixingTask,
    "segregation": SegregationTask,
    "co_morphogenesis": CoMorphogenesisTask,
    "invasion": InvasionTask,
    "symbiosis": SymbiosisTask,
}
"""Tasks by the names that environments take."""

SETTINGS: dict[str, tuple[str, Mapping[str, Any]]] = {
    **{name: (task, {}) for name, task in SPECIES.items()},
    **{size.id: (size.task, size.keywords) for size in SPECIES_SIZES},
}
"""Name and keywords of the task of each id."""


def task_settings(name: str) -> tuple[str, dict[str, Any]]:
    """Return the task and the keywords of an id; a task's name has no keywords."""
    task, keywords = SETTINGS.get(name, (name, {})) if isinstance(name, str) else (name, {})
    return task, dict(keywords)


def task_type(name: str) -> type[SpeciesTask]:
    """Return the class of the task of this name."""
    if not isinstance(name, str) or name not in TASKS:
        known = [*TASKS, *SETTINGS]
        raise NPAError(f"task must be a known word, got {shown(name)}: {suggest(name, known)}")
    return TASKS[name]
