"""Problems to learn: an environment with its keywords, its worlds, and the seeds of runs.

Each run has other seeds for its worlds, and evaluations have others again.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple, get_args

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from torch import Tensor

from npa_envs.agents.evaluation import TIME_LIMIT
from npa_envs.agents.learning.rule_set import RuleSet
from npa_envs.agents.policies import Interface, spans_of
from npa_envs.checks import check_positive, is_whole
from npa_envs.devices import check_device
from npa_envs.envs.core.config import EnvConfig
from npa_envs.envs.core.task import Controls, EnvTask
from npa_envs.envs.core.vector import NPAVectorEnv, worlds_to_reset
from npa_envs.envs.multi.base import SpeciesConfig, SpeciesTask
from npa_envs.envs.multi.tasks import ENVIRONMENTS as SPECIES_TASKS
from npa_envs.envs.multi.tasks import task_settings
from npa_envs.envs.multi.tasks import task_type as species_task_type
from npa_envs.envs.multi.vector import MultiSpeciesVectorEnv
from npa_envs.errors import NPAError, shown, suggest
from npa_envs.registration import ALL, SPECIES_SIZES
from npa_envs.world.cuda_graph import to_device_async
from npa_envs.world.environment_steps import Physics

WORLDS_PER_SEED = 10_000
"""Seeds of worlds that each run has: run k has those from k times this."""

FIRST_EVALUATION_SEED = 1_000_000
"""Runs learn in worlds with smaller seeds."""

RUNS = FIRST_EVALUATION_SEED // WORLDS_PER_SEED
"""Seeds of runs are below this."""

EVALUATION_SEEDS = range(FIRST_EVALUATION_SEED, FIRST_EVALUATION_SEED + 16)
"""Seeds of the worlds of evaluations."""

LEFT = "left the world"
"""Reason for the end of a species that diverged."""

DEFAULT_STEPS = 256
"""Steps of an episode of an id that is registered without a limit."""

SPECIES = (*SPECIES_TASKS, *(size.id for size in SPECIES_SIZES))
"""Ids of species tasks."""

RowRewards = Literal["particle", "marginal"]
"""Kinds of rewards that each particle gets separately."""

ROW_REWARDS = get_args(RowRewards)

ELSEWHERE = {
    **dict.fromkeys(("num_envs", "world_count"), "set the field num_envs of Problem"),
    **dict.fromkeys(
        ("max_episode_steps", "max_cycles", "episode_steps"),
        "set the field episode_steps of Problem",
    ),
    "device": "it is given to train and make_envs",
    "output": "learners are given tensors",
    "autoreset_mode": "learners' worlds restart in the step that ends their episodes",
    "observe_target": "rules read what particles perceive, and no target",
    "task": "the id says it",
    "perceive": "the id says it",
}
"""Keywords of environments that problems do not take, and why."""


@dataclass(frozen=True, kw_only=True)
class Problem:
    """An environment to learn in, with its keywords; `to_json` and `from_json` store it.

    Raises:
        NPAError: The environment or a keyword is unknown, or a value is wrong.
    """

    env_id: str
    """Id of an environment of this library, "npa/Mixing-v0", or of your own that is registered with
    Gymnasium."""
    keywords: Mapping[str, Any] = field(default_factory=dict)
    """Keywords of `gym.make` or `multispecies_v0.batched`, of JSON's types."""
    episode_steps: int
    """Steps after which an episode is truncated."""
    num_envs: int = 16
    """Worlds B in which learners act at the same time."""
    hidden_dim: int = 128
    """Width of the hidden layer of new rules."""

    def __post_init__(self) -> None:
        """Check every field; raises NPAError."""
        check_positive(self, int, "episode_steps", "num_envs", "hidden_dim")
        if not isinstance(self.keywords, Mapping):
            raise NPAError(
                f"keywords must map names to values, got {type(self.keywords).__name__}: "
                "for example keywords={'target': 'heart'}"
            )
        for name in self.keywords:
            if name in ELSEWHERE:
                raise NPAError(f"keywords must not have {shown(name)}: {ELSEWHERE[name]}")
        if (reward := self.keywords.get("reward")) in ROW_REWARDS:
            raise NPAError(
                f"keywords must not have reward={reward!r}: ask make_envs for "
                f"row_rewards={reward!r}"
            )
        try:
            plain = json.loads(json.dumps(dict(self.keywords)))
        except (TypeError, ValueError) as error:
            raise NPAError(
                f"keywords must have values of JSON's types, got {shown(dict(self.keywords))}: "
                f"give numbers, text and lists ({error})"
            ) from error
        object.__setattr__(self, "keywords", plain)
        # Raises on unknown ids and wrong keywords.
        _ = self.config

    def __hash__(self) -> int:
        """Return a number that is the same for equal problems."""
        return hash(self.to_json())

    @property
    def actor(self) -> Controls:
        """What acts: "particles", those of several "species", "brushes", or "codes" of a rule."""
        return self.task_type.controls

    @cached_property
    def registered(self) -> Registered:
        """What the id is registered with."""
        return registered(self.env_id)

    @property
    def task_type(self) -> type[EnvTask[Any]] | type[SpeciesTask]:
        """Class of the task."""
        return self.registered.task_type

    @cached_property
    def config(self) -> EnvConfig | SpeciesConfig:
        """The environment's configuration, on the CPU."""
        keywords = self.registered.keywords | dict(self.keywords)
        if self.registered.species_task is not None:
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
        """Meaning of the columns of observations and actions."""
        config = self.config
        if isinstance(config, SpeciesConfig) and config.perception == "per_species":
            return Interface.of(self.physics, config.species_count)
        return Interface.of(self.physics)

    @property
    def counts(self) -> tuple[int, ...]:
        """Particles of each species that is an agent; one number without species."""
        config = self.config
        if isinstance(config, SpeciesConfig):
            return config.played_counts
        return (config.particle_count,)

    @property
    def particle_count(self) -> int:
        """Particles of a world that act, N."""
        return sum(self.counts)

    def make_task(self, device: str | torch.device = "cpu") -> EnvTask[Any] | SpeciesTask:
        """Return the task, which has starts and losses, for worlds on a device.

        Raises:
            NPAError: Something that the task needs cannot be loaded.
        """
        place = check_device(device)
        return self.task_type(replace(self.config, device=str(place)), place)

    def make_envs(
        self,
        num_envs: int | None = None,
        *,
        device: str | torch.device = "cpu",
        row_rewards: RowRewards | None = None,
        tell_updated: bool = False,
        copy: bool = True,
    ) -> NPAVectorEnv | ConcatenatedSpeciesEnv:
        """Return batched worlds on a device; observations, actions and the rest are tensors there.

        `reset(seed=0)` returns observations, [B, N, P], and infos; `step(actions)`, of [B, N, A],
        returns observations, rewards, terminations and truncations, [B] each, and infos. Worlds
        restart in the step that ends their episodes: then `infos["final_obs"]`, [B, N, P], has the
        last observations where `infos["_final_obs"]`, [B], is true.

        Args:
            num_envs: Worlds B; None: the problem's.
            device: Device of the worlds.
            row_rewards: Adds `infos["particle_reward"]`, [B, N]: "particle", each particle's own
                part of the improvement, or "marginal", the difference that its action makes. With
                several species it is always there: the reward of the particle's species.
            tell_updated: Adds `infos["updated"]`, [B, N]: which actions took effect; not with
                several species.
            copy: Return new tensors; False: where possible the same ones, which the next step
                overwrites.

        Raises:
            NPAError: The worlds do not fit into memory, the device is unknown, or `row_rewards`
                contradicts the problem's keywords.
        """
        count = self.num_envs if num_envs is None else num_envs
        place = str(check_device(device))
        keywords = dict(self.keywords)
        if self.registered.species_task is not None:
            return ConcatenatedSpeciesEnv(
                self.registered.species_task,
                world_count=count,
                max_cycles=self.episode_steps,
                device=place,
                output="torch",
                **self.registered.keywords | keywords,
            )
        if row_rewards:
            if keywords.get("reward", "dense") != "dense":
                raise NPAError(
                    "row_rewards needs the problem's reward to be 'dense', got "
                    f"{shown(keywords['reward'])}: leave it out of keywords"
                )
            keywords["reward"] = row_rewards
        if tell_updated:
            keywords["tell_updated"] = True
        envs = gymnasium.make_vec(
            self.env_id,
            num_envs=count,
            vectorization_mode="vector_entry_point",
            max_episode_steps=self.episode_steps,
            autoreset_mode="same-step",
            output="torch",
            device=place,
            copy=copy,
            **keywords,
        ).unwrapped
        assert isinstance(envs, NPAVectorEnv), "checked by `registered`"
        return envs

    def new_rules(self, seed: int) -> RuleSet:
        """Return `RuleSet.new` of the problem: untrained rules, one for each species."""
        return RuleSet.new(self, seed)

    def to_json(self) -> str:
        """Return the problem as JSON, on one line."""
        return json.dumps(asdict(self), sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> Problem:
        """Return the problem that `to_json` wrote.

        Raises:
            NPAError: The text is not a problem in JSON.
        """
        try:
            return cls(**json.loads(text))
        except (TypeError, json.JSONDecodeError) as error:
            raise NPAError(
                f"text must be a problem in JSON, got {shown(text)} ({error}): give what "
                "Problem.to_json returned"
            ) from error


class Registered(NamedTuple):
    """What an id is registered with."""

    task_type: type[EnvTask[Any]] | type[SpeciesTask]
    """Class of the task."""
    keywords: dict[str, Any]
    """Fields of the environment's configuration."""
    steps: int
    """Steps after which an episode is truncated; `DEFAULT_STEPS` without a limit."""
    species_task: str | None = None
    """Name of the task of several species; None: there is one species."""


def registered(env_id: Any) -> Registered:
    """Return what an id is registered with; raises NPAError if there is no batched environment."""
    if isinstance(env_id, str) and env_id in SPECIES:
        name, keywords = task_settings(env_id)
        steps = keywords.pop("max_cycles", DEFAULT_STEPS)
        return Registered(species_task_type(name), keywords, steps, name)
    spec = gymnasium.registry.get(env_id) if isinstance(env_id, str) else None
    entry: Any = None if spec is None else spec.vector_entry_point
    if isinstance(entry, str):
        entry = gymnasium.envs.registration.load_env_creator(entry)
    if spec is None or not (isinstance(entry, type) and issubclass(entry, NPAVectorEnv)):
        known = [environment.id for environment in ALL]
        raise NPAError(
            f"env_id must be of an environment of many worlds, got {shown(env_id)}: "
            f"{suggest(env_id, [*known, *SPECIES])}"
        )
    steps = DEFAULT_STEPS if spec.max_episode_steps is None else spec.max_episode_steps
    return Registered(entry.task_type, dict(spec.kwargs), steps)


def check_run_seed(seed: Any) -> None:
    """Check that the seed of a run is a whole number below `RUNS`."""
    if not is_whole(seed) or not 0 <= seed < RUNS:
        raise NPAError(
            f"seed must be a whole number from 0 to {RUNS - 1}, as the worlds of later ones are "
            f"those of evaluations, got {shown(seed)}: give seed=0"
        )


def world_seeds(seed: int, count: int, part: int = 0) -> list[int]:
    """Return the seeds of a run's worlds, which no other run has.

    part: number of resumptions. Each uses new seeds; after `WORLDS_PER_SEED` seeds they repeat.
    """
    check_run_seed(seed)
    if count > WORLDS_PER_SEED:
        raise NPAError(
            f"worlds must be at most {WORLDS_PER_SEED}, got {count}: more would share their "
            "seeds with the next run"
        )
    first = seed * WORLDS_PER_SEED
    return [first + (part * count + world) % WORLDS_PER_SEED for world in range(count)]


class ConcatenatedSpeciesEnv(MultiSpeciesVectorEnv):
    """Worlds of several species as one agent: species concatenated to [B, N, P] and [B, N, A].

    It has what learners need of the interface of `NPAVectorEnv`. Reward and loss of a world are
    means over its species; a species that ended keeps its last loss. A world terminates once all
    of its species have; its reason is that of the first one, or "left the world" if any did.
    Infos of a step have for each particle, [B, N], the `particle_reward` of its species, whether it
    was alive, `acted`, and whether it terminated in this step, `particle_terminated`.
    """

    def __init__(self, task: str, **config: Any) -> None:
        super().__init__(task, **config)
        self.num_envs, self.episode_steps = self.world_count, self.max_cycles
        self.task = self.worlds.task
        self.metadata = self.metadata | {"autoreset_mode": AutoresetMode.SAME_STEP}
        counts = self.config.played_counts
        self.spans = dict(zip(self.agents, spans_of(counts), strict=True))
        self.single_observation_space = _concatenated_space(self.single_observation_spaces)
        self.single_action_space = _concatenated_space(self.single_action_spaces)
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
        """Start episodes as `MultiSpeciesVectorEnv.reset`; infos have `loss`."""
        rows, infos = super().reset(seed, options)
        chosen = worlds_to_reset(options, self.num_envs)
        self._reasons[chosen] = None
        # In worlds that are not reset, infos have no loss of species that ended.
        losses, index = self._stacked(infos, "loss"), to_device_async(chosen, self._loss.device)
        self._loss = self._loss.index_copy(0, index, losses[index])
        return self._concatenated(rows), {"loss": self._loss.mean(dim=1)}

    def step(  # type: ignore[override]
        self, actions: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Apply actions, [B, N, A], in [-1, 1], and observe; an error changes no world."""
        by_species = {agent: actions[:, span] for agent, span in self.spans.items()}
        rows, rewards, terminations, truncations, infos = super().step(by_species)
        reward, ended, cut = (
            torch.stack(list(part.values()), dim=1) for part in (rewards, terminations, truncations)
        )
        acted, truncated = self._stacked(infos, "acted"), cut.any(dim=1)
        self._loss = torch.where(acted, self._stacked(infos, "loss"), self._loss)
        result: dict[str, Any] = {
            "loss": self._loss.mean(dim=1),
            "particle_reward": self._by_particle(reward),
            "acted": self._by_particle(acted),
            "particle_terminated": self._by_particle(ended),
        }
        for agent in self.agents:
            reasons = infos[agent].get("reason")
            if reasons is not None:
                new = reasons != None  # noqa: E711
                known = (self._reasons != None) & (self._reasons != TIME_LIMIT)  # noqa: E711
                self._reasons = np.where((new & ~known) | (reasons == LEFT), reasons, self._reasons)
        first = infos[self.agents[0]]
        over = first.get("_final_obs", torch.zeros_like(truncated))
        if "final_obs" in first:
            last = {agent: infos[agent]["final_obs"] for agent in self.agents}
            which = over.cpu().numpy()
            reasons = self._reasons.copy()
            reasons[~which] = None
            self._reasons[which] = None
            final = {"loss": result["loss"], "_loss": over, "reason": reasons}
            result |= {"final_obs": self._concatenated(last), "_final_obs": over}
            result |= {"final_info": final, "_final_info": over}
        ended, cut = over & ~truncated, over & truncated
        return self._concatenated(rows), reward.mean(dim=1), ended, cut, result

    def _concatenated(self, rows: Mapping[str, Tensor]) -> Tensor:
        return torch.cat([rows[agent] for agent in self.agents], dim=1)

    def _stacked(self, infos: Mapping[str, Mapping[str, Any]], name: str) -> Tensor:
        return torch.stack([infos[agent][name] for agent in self.agents], dim=1)

    def _by_particle(self, values: Tensor) -> Tensor:
        """Return values of species, [B, K], for each of their particles, shape [B, N]."""
        count = self.single_action_space.shape[0]
        return values.repeat_interleave(self._counts, dim=1, output_size=count)


def _concatenated_space(spaces: Mapping[str, Any]) -> Box:
    low, high = (
        np.concatenate([getattr(space, bound) for space in spaces.values()])
        for bound in ("low", "high")
    )
    return Box(low, high, dtype=np.float32)
