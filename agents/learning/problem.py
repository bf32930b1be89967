"""Problems to learn: an environment with its keywords, and seeds of the worlds of runs.

`Problem.make_envs` makes its worlds for reinforcement learning, `DifferentiableTask` for gradients.
The worlds of runs have the seeds `world_seeds`; the worlds of evaluations have larger ones.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple, Self

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from torch import Tensor

from npa_envs.agents.evaluation import TIME_LIMIT
from npa_envs.agents.learning.rule_set import ClampedRule, RuleSet, species_of
from npa_envs.agents.policies import spans_of
from npa_envs.checks import check_device, check_positive, is_whole
from npa_envs.envs.core.config import EnvConfig, Interface
from npa_envs.envs.core.step_report import PARTICLE_REWARDS
from npa_envs.envs.core.task import Controls, EnvTask
from npa_envs.envs.core.vector import NPAVectorEnv, worlds_to_reset
from npa_envs.envs.multi.shipped_tasks import task_settings
from npa_envs.envs.multi.shipped_tasks import task_type as species_task_type
from npa_envs.envs.multi.species_task import Population, SpeciesConfig, SpeciesTask
from npa_envs.envs.multi.vector import MultiSpeciesVectorEnv
from npa_envs.errors import NPAError, shown, suggest
from npa_envs.registration import ALL, SPECIES_SIZES
from npa_envs.registration import SPECIES as SPECIES_TASKS
from npa_envs.tasks.base import ParticleTask
from npa_envs.world.cuda_graph import to_device_async
from npa_envs.world.environment_steps import Physics
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import Randomness, WorldRandom
from npa_envs.world.rollout import rollout_particles
from npa_envs.world.species import species_particles

WORLDS_PER_SEED = 10_000
"""Number of worlds' seeds for each seed of a run: run k has the seeds from k times this on."""

FIRST_EVALUATION_SEED = 1_000_000
"""Smallest seed of the worlds of evaluations; runs learn in worlds with smaller seeds."""

RUN_SEED_COUNT = FIRST_EVALUATION_SEED // WORLDS_PER_SEED
"""Number of seeds of runs: a run's seed is below it."""

EVALUATION_SEEDS = range(FIRST_EVALUATION_SEED, FIRST_EVALUATION_SEED + 16)
"""Seeds of the worlds of evaluations."""

DEFAULT_STEPS = 256
"""Steps of an episode where an environment's registration has no limit."""

KEY_RANGE = -(2**63), 2**63 - 1
"""Range of the keys of worlds' random streams."""

SPECIES_IDS = (*SPECIES_TASKS, *(size.id for size in SPECIES_SIZES))
"""Ids of environments of several species."""

RESERVED_KEYWORDS = {
    "num_envs": "set the field num_envs of Problem",
    **dict.fromkeys(
        ("max_episode_steps", "max_cycles", "episode_steps"),
        "set the field episode_steps of Problem",
    ),
    "device": "it is given to train and make_envs",
    "output": "learners are given tensors",
    "observe_target": "rules read what particles perceive, and no target",
}
"""Keywords of environments that problems do not take: what to do instead, by keyword."""


@dataclass(frozen=True, kw_only=True)
class Problem:
    """An environment to learn in, with its keywords and sizes."""

    env_id: str
    """Id of an environment: this library's, "npa/Mixing-v0", or your own, known to Gymnasium."""
    keywords: Mapping[str, Any] = field(default_factory=dict)
    """Keywords of `gym.make` or `multispecies_v0.batched`, of JSON's types."""
    episode_steps: int
    """Steps after which an episode is truncated."""
    num_envs: int = 16
    """Worlds B in which learners act at the same time."""
    hidden_dim: int = 128
    """Width of the hidden layer of new rules."""

    def __post_init__(self) -> None:
        check_positive(self, int, "episode_steps", "num_envs", "hidden_dim")
        if not isinstance(self.keywords, Mapping):
            raise NPAError(
                f"keywords must map names to values, got {type(self.keywords).__name__}: "
                "for example keywords={'target': 'heart'}"
            )
        for name in self.keywords:
            if name in RESERVED_KEYWORDS:
                raise NPAError(f"keywords must not have {shown(name)}: {RESERVED_KEYWORDS[name]}")
        if (reward := self.keywords.get("reward")) in PARTICLE_REWARDS:
            raise NPAError(
                f"keywords must not have reward={reward!r}: ask make_envs for "
                f"particle_rewards={reward!r}"
            )
        try:
            keywords = json.loads(json.dumps(dict(self.keywords)))
        except (TypeError, ValueError) as error:
            raise NPAError(
                f"keywords must have values of JSON's types, got {shown(dict(self.keywords))}: "
                f"give numbers, text and lists ({error})"
            ) from error
        object.__setattr__(self, "keywords", keywords)
        # Raises on unknown ids and wrong keywords.
        _ = self.config

    @property
    def controlled(self) -> Controls:
        """What actions are of: "particles", "species", "brushes", "codes", or "central" control."""
        if getattr(self.config, "control", "particles") == "central":
            return "central"
        return self.task_type.controls

    @cached_property
    def registration(self) -> RegisteredEnv:
        """Task and keywords that `env_id` stands for."""
        return registration_of(self.env_id)

    @property
    def task_type(self) -> type[EnvTask[Any]] | type[SpeciesTask]:
        """Class of the environment's task."""
        return self.registration.task_type

    @cached_property
    def config(self) -> EnvConfig | SpeciesConfig:
        """The environment's configuration, on the CPU."""
        keywords = self.registration.keywords | dict(self.keywords)
        if self.registration.species_task is not None:
            keywords["max_cycles"] = self.episode_steps
        elif keywords.get("reward") == "sparse":
            keywords["episode_steps"] = self.episode_steps
        return self.task_type.config_type.from_keywords(keywords)

    @property
    def physics(self) -> Physics:
        """Physical constants of the worlds."""
        return self.config.physics(self.task_type.space_dim, static=self.task_type.static)

    @property
    def interface(self) -> Interface:
        """Meaning of the columns of its environments' observations and actions."""
        return self.config.interface(self.physics)

    @property
    def counts(self) -> tuple[int, ...]:
        """Number of particles of each species that acts; one number without species."""
        config = self.config
        if isinstance(config, SpeciesConfig):
            return config.agent_particle_counts
        return (config.particle_count,)

    @property
    def particle_count(self) -> int:
        """Number of particles of a world that act, N."""
        return sum(self.counts)

    def make_task(self, device: str | torch.device = "cpu") -> EnvTask[Any] | SpeciesTask:
        """Return the environment's task on a device: it makes start worlds and computes losses."""
        device = check_device(device)
        return self.task_type(replace(self.config, device=str(device)), device)

    def make_envs(
        self,
        num_envs: int | None = None,
        *,
        device: str | torch.device = "cpu",
        particle_rewards: str | None = None,
        tell_updated: bool = False,
        copy: bool = True,
    ) -> NPAVectorEnv | ConcatenatedSpeciesEnv:
        """Return a batch of worlds, whose observations, actions, rewards and flags are tensors.

        `reset(seed=0)` returns observations, [B, N, P], and infos; `step(actions)`, of [B, N, A],
        returns observations, rewards, terminations and truncations, [B] each, and infos. Worlds
        restart in the step that ends their episodes: then `infos["final_obs"]`, [B, N, P], has the
        last observations where `infos["_final_obs"]`, [B], is true.

        Args:
            num_envs: Worlds B; None: the problem's.
            device: Device of the worlds.
            particle_rewards: Adds `infos["particle_reward"]`, [B, N]: "particle", the decrease of
                each particle's own loss, or "marginal", the difference that its action makes. With
                several species it is always there: the reward of the particle's species.
            tell_updated: Adds `infos["updated"]`, [B, N]: which actions took effect; not with
                several species.
            copy: Return new tensors; False: where possible those that the next step overwrites.

        Raises:
            NPAError: Worlds do not fit into memory, or `device` or `particle_rewards` is wrong.
        """
        count = self.num_envs if num_envs is None else num_envs
        device = str(check_device(device))
        keywords = dict(self.keywords)
        if self.registration.species_task is not None:
            return ConcatenatedSpeciesEnv(
                self.registration.species_task,
                world_count=count,
                max_cycles=self.episode_steps,
                device=device,
                output="torch",
                **self.registration.keywords | keywords,
            )
        if particle_rewards:
            if keywords.get("reward", "dense") != "dense":
                raise NPAError(
                    "particle_rewards needs the problem's reward to be 'dense', got "
                    f"{shown(keywords['reward'])}: leave it out of keywords"
                )
            keywords["reward"] = particle_rewards
        if tell_updated:
            keywords["tell_updated"] = True
        envs = gymnasium.make_vec(
            self.env_id,
            num_envs=count,
            vectorization_mode="vector_entry_point",
            max_episode_steps=self.episode_steps,
            autoreset_mode="same-step",
            output="torch",
            device=device,
            copy=copy,
            **keywords,
        ).unwrapped
        assert isinstance(envs, NPAVectorEnv), "checked by `registration_of`"
        return envs

    def to_json(self) -> str:
        """Return the problem as one line of JSON, for `from_json`."""
        return json.dumps(asdict(self), sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> Problem:
        """Return the problem that `to_json` wrote."""
        try:
            return cls(**json.loads(text))
        except (TypeError, json.JSONDecodeError) as error:
            raise NPAError(
                f"text must be a problem in JSON, got {shown(text)} ({error}): give what "
                "Problem.to_json returned"
            ) from error


class DifferentiableTask(ParticleTask[Any]):
    """The worlds of a problem's episodes, with a loss and rollouts through which gradients flow.

    It has the methods of a task that training calls: `seed`, `loss` and `rollout`; it has no
    pictures and no metric. All species must share one loss, and no particle may leave a world.
    """

    def __init__(self, problem: Problem, device: torch.device) -> None:
        super().__init__()
        self.problem, self.config, self.physics = problem, problem.config, problem.physics
        task = problem.make_task(device)
        self.inner: Any = task
        """The environment's task."""
        self._species = species_of(problem.counts).to(device)
        self._clamped: tuple[RuleSet, list[ClampedRule]] | None = None
        if not isinstance(task, SpeciesTask):
            return
        if type(task).final_rewards is not SpeciesTask.final_rewards:
            raise NPAError(
                "a method that follows gradients must have one loss to descend, but in "
                f"{problem.env_id} species gain rewards at each other's expense: learn by 'ppo' "
                "with the reward of each particle"
            )
        if problem.keywords.get("deaths"):
            raise NPAError(
                "a method that follows gradients must keep all particles, got "
                f"deaths={shown(problem.keywords['deaths'])}: "
                "leave deaths out, or learn by 'ppo' or 'evolution'"
            )

    @property
    def box(self) -> tuple[float, ...] | None:
        """Sides of the periodic box [length units]; None: open space."""
        return self.physics.periodic_box

    @property
    def start_is_short(self) -> bool:
        """Whether start worlds are made by little work, not by long rollouts."""
        return not isinstance(self.inner, EnvTask) or self.inner.start_is_short

    def seed(
        self, world_count: int, *, generator: Randomness, device: str | torch.device = "cpu"
    ) -> Particles:
        """Return `world_count` worlds at the start of an episode, with their goals, if any."""
        if isinstance(generator, WorldRandom):
            keys = generator.integers(KEY_RANGE[1])
        else:
            keys = torch.randint(*KEY_RANGE, (world_count,), generator=generator, device=device)
        x, s, *rest = self.inner.start(WorldRandom.from_keys(keys))
        return Particles(x, s, goal=rest[1] if rest else None)

    def with_goal(self, goal: Tensor | None) -> Self:
        """Return a copy whose losses are for these goals of worlds, shape [B]; None: the task."""
        return self if goal is None else self._copy_with(inner=self.inner.with_goal(goal))

    def compare(self, worlds: Particles) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss and its terms by name, averaged over worlds and species, shape []."""
        losses = {name: loss.mean() for name, loss in self._losses(worlds).items()}
        return torch.stack(list(losses.values())).sum(), losses

    def penalties(self, *_: Any) -> dict[str, tuple[float, Tensor]]:
        """Return no penalties: environments have none."""
        return {}

    def world_losses(self, worlds: Particles) -> Tensor:
        """Return the loss of each world, averaged over its species, shape [B]."""
        losses = self.with_goal(worlds.goal)._losses(worlds)
        total = torch.stack(list(losses.values())).sum(dim=0)
        return total.flatten(1).mean(dim=1) if total.dim() > 1 else total

    def rollout(self, rules: Any, worlds: Particles, steps: int, /, **options: Any) -> Particles:
        """Return worlds after steps of a `RuleSet`; `options` are those of `npa_envs.rollout`."""
        physics, config = self.physics, self.config
        if self._clamped is None or self._clamped[0] is not rules:
            # Made once, as captured rollouts identify rules by `id`.
            limit = physics.limits.state_scale
            self._clamped = rules, [ClampedRule(rule, limit) for rule in rules]
        rule: Any = self._clamped[1]
        options |= {
            "dt": physics.dt,
            "position_noise": physics.position_noise,
            "box": physics.box,
            "boundary": physics.boundary,
        }
        if isinstance(config, SpeciesConfig):
            options |= {"counts": config.counts, "perception": config.perception}
            run: Any = species_particles
        else:
            run, (rule,) = rollout_particles, rule
        after: Particles = run(rule, worlds, steps, **options)
        return after

    def _losses(self, worlds: Particles) -> Mapping[str, Tensor]:
        """Return the terms of worlds' losses by name, shape [B], or [B, S] of S species."""
        x, s, *_ = worlds
        losses: Mapping[str, Tensor]
        if isinstance(self.inner, SpeciesTask):
            losses = self.inner.losses(Population(x, s, self.problem.counts, self._species))
        else:
            losses = self.inner.losses(x, s)
        needed = torch.is_grad_enabled() and (x.requires_grad or s.requires_grad)
        if needed and not any(loss.requires_grad for loss in losses.values()):
            raise NPAError(
                f"the losses of {type(self.inner).__name__} must be differentiable for "
                "a method that follows gradients, but no gradient leads from them to positions or "
                "states: compute them by torch's operations, or learn by 'ppo' or 'evolution'"
            )
        return losses


# Worlds of several species.

LEFT_WORLD = "left the world"
"""Reason why the episode of a species ended that diverged."""


class ConcatenatedSpeciesEnv(MultiSpeciesVectorEnv):
    """Worlds of several species as one agent, with observations [B, N, P] and actions [B, N, A].

    It has the attributes of `NPAVectorEnv` that learners need. Reward and loss of a world are means
    over its species; a species that ended keeps its last loss. A world terminates once all of its
    species have; its reason is that of the first one, or "left the world" if any diverged. Infos of
    a step have for each particle, [B, N]: `particle_reward`, the reward of its species; `acted`,
    whether its species had not ended before; `particle_terminated`, whether it terminates now.
    """

    def __init__(self, task: str, **config: Any) -> None:
        super().__init__(task, **config)
        self.episode_steps = self.max_cycles
        self.task, physics = self.worlds.task, self.worlds.physics
        self.metadata = self.metadata | {"autoreset_mode": AutoresetMode.SAME_STEP}
        counts, interface = self.config.agent_particle_counts, self.config.interface(physics)
        self.spans = dict(zip(self.agents, spans_of(counts), strict=True))
        limit, observed = physics.limits.perception, (sum(counts), interface.perception_dim)
        self.single_observation_space = Box(-limit, limit, observed, np.float32)
        acted = sum(counts), interface.action_dim
        self.single_action_space = Box(-1.0, 1.0, acted, np.float32)
        self._counts = torch.tensor(counts, device=self.worlds.device)
        self._loss = torch.zeros(self.num_envs, len(counts), device=self.worlds.device)
        self._reasons = np.full(self.num_envs, None, dtype=object)

    @property
    def unwrapped(self) -> ConcatenatedSpeciesEnv:
        """The environment itself."""
        return self

    def reset(  # type: ignore[override]
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Tensor, dict[str, Any]]:
        """Start episodes as `MultiSpeciesVectorEnv.reset` does; infos have `loss`, [B]."""
        observations, infos = super().reset(seed, options)
        chosen = worlds_to_reset(options, self.num_envs)
        self._reasons[chosen] = None
        # In worlds that are not reset, infos have no loss of species that ended.
        losses, index = self._stacked(infos, "loss"), to_device_async(chosen, self._loss.device)
        self._loss = self._loss.index_copy(0, index, losses[index])
        return self._concatenated(observations), {"loss": self._loss.mean(dim=1)}

    def step(  # type: ignore[override]
        self, actions: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Apply actions in [-1, 1], [B, N, A]; return observations, rewards, flags and infos."""
        by_species = {agent: actions[:, span] for agent, span in self.spans.items()}
        observations, *results, infos = super().step(by_species)
        rewards, terminated, truncated = (
            torch.stack([result[agent] for agent in self.agents], dim=1) for result in results
        )
        acted = self._stacked(infos, "acted")
        self._loss = torch.where(acted, self._stacked(infos, "loss"), self._loss)
        info: dict[str, Any] = {
            "loss": self._loss.mean(dim=1),
            "particle_reward": self._by_particle(rewards),
            "acted": self._by_particle(acted),
            "particle_terminated": self._by_particle(terminated),
        }
        # Why each world ends: the first reason of a species, or "left the world" of any.
        for agent in self.agents:
            reasons = infos[agent].get("reason")
            if reasons is not None:
                new = reasons != None  # noqa: E711
                known = (self._reasons != None) & (self._reasons != TIME_LIMIT)  # noqa: E711
                replaced = (new & ~known) | (reasons == LEFT_WORLD)
                self._reasons = np.where(replaced, reasons, self._reasons)
        cut, first = truncated.any(dim=1), infos[self.agents[0]]
        over = first.get("_final_obs", torch.zeros_like(cut))
        if "final_obs" in first:
            last = {agent: infos[agent]["final_obs"] for agent in self.agents}
            ended = over.cpu().numpy()
            reasons = self._reasons.copy()
            reasons[~ended] = self._reasons[ended] = None
            final = {"loss": info["loss"], "_loss": over, "reason": reasons}
            info |= {"final_obs": self._concatenated(last), "_final_obs": over}
            info |= {"final_info": final, "_final_info": over}
        observation, reward = self._concatenated(observations), rewards.mean(dim=1)
        return observation, reward, over & ~cut, over & cut, info

    def _concatenated(self, values: Mapping[str, Tensor]) -> Tensor:
        return torch.cat([values[agent] for agent in self.agents], dim=1)

    def _stacked(self, infos: Mapping[str, Mapping[str, Any]], name: str) -> Tensor:
        return torch.stack([infos[agent][name] for agent in self.agents], dim=1)

    def _by_particle(self, values: Tensor) -> Tensor:
        """Repeat the values of species, [B, species], for each of their particles, [B, N]."""
        count = self.single_action_space.shape[0]
        return values.repeat_interleave(self._counts, dim=1, output_size=count)


# Ids of environments, and seeds.


class RegisteredEnv(NamedTuple):
    """What an environment id stands for: the class of its task, and settings."""

    task_type: type[EnvTask[Any]] | type[SpeciesTask]
    keywords: dict[str, Any]
    """Fields of the environment's configuration."""
    steps: int
    """Steps after which an episode is truncated; `DEFAULT_STEPS` without a limit."""
    species_task: str | None = None
    """Name of the task of several species; None: there is one species."""


def registration_of(env_id: Any) -> RegisteredEnv:
    """Return task class and settings of an environment id; NPAError if it cannot be batched."""
    if isinstance(env_id, str) and env_id in SPECIES_IDS:
        name, keywords = task_settings(env_id)
        steps = keywords.pop("max_cycles", DEFAULT_STEPS)
        return RegisteredEnv(species_task_type(name), keywords, steps, name)
    spec = gymnasium.registry.get(env_id) if isinstance(env_id, str) else None
    entry: Any = None if spec is None else spec.vector_entry_point
    if isinstance(entry, str):
        entry = gymnasium.envs.registration.load_env_creator(entry)
    if spec is None or not (isinstance(entry, type) and issubclass(entry, NPAVectorEnv)):
        known = [environment.id for environment in ALL]
        raise NPAError(
            f"env_id must be of an environment of many worlds, got {shown(env_id)}: "
            f"{suggest(env_id, [*known, *SPECIES_IDS])}"
        )
    steps = DEFAULT_STEPS if spec.max_episode_steps is None else spec.max_episode_steps
    return RegisteredEnv(entry.task_type, dict(spec.kwargs), steps)


def check_run_seed(seed: Any) -> None:
    """Check that the seed of a run is a whole number from 0 to below `RUN_SEED_COUNT`."""
    if not is_whole(seed) or not 0 <= seed < RUN_SEED_COUNT:
        raise NPAError(
            f"seed must be a whole number from 0 to {RUN_SEED_COUNT - 1}, as the worlds of "
            f"later ones are those of evaluations, got {shown(seed)}: give seed=0"
        )


def world_seeds(seed: int, count: int, resumption: int = 0) -> list[int]:
    """Return the seeds of `count` worlds of the run with `seed`; no other run has these.

    `resumption` is the number of resumes of the run; seeds repeat after `WORLDS_PER_SEED` worlds.
    """
    check_run_seed(seed)
    if count > WORLDS_PER_SEED:
        raise NPAError(
            f"num_envs must be at most {WORLDS_PER_SEED}, got {count}: more would share their "
            "seeds with the next run"
        )
    first = seed * WORLDS_PER_SEED
    return [first + (resumption * count + world) % WORLDS_PER_SEED for world in range(count)]
