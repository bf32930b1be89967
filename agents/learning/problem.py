"""Problems to learn: an environment with its keywords, its worlds, and the seeds of runs.

Every run learns in worlds of its own, and none in those of evaluations.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, get_args

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from torch import Tensor

from npa_envs.agents.evaluation import TIME_LIMIT
from npa_envs.agents.learning.rules import RuleSet
from npa_envs.agents.policies import Interface, spans_of
from npa_envs.checks import check_positive, is_whole
from npa_envs.devices import check_device
from npa_envs.envs.core.config import EnvConfig
from npa_envs.envs.core.task import EnvTask
from npa_envs.envs.core.vector import NPAVectorEnv, worlds_to_reset
from npa_envs.envs.garden.task import GardenTask
from npa_envs.envs.multi.task import SpeciesConfig, SpeciesTask
from npa_envs.envs.multi.tasks import ENVIRONMENTS as SPECIES_TASKS
from npa_envs.envs.multi.tasks import task_settings
from npa_envs.envs.multi.tasks import task_type as species_task_type
from npa_envs.envs.multi.vector import MultiSpeciesVectorEnv
from npa_envs.envs.shapeshifter2d import ShapeshifterTask
from npa_envs.errors import NPAError, shown, suggest
from npa_envs.registration import ALL, SPECIES_SIZES
from npa_envs.world.actions import Physics
from npa_envs.world.cuda_graph import to_device_async

WORLDS_PER_SEED = 10_000
"""Distance of the worlds' seeds of one run from those of the next."""

FIRST_EVALUATION_SEED = 1_000_000
"""Seeds from here on are for evaluations."""

RUNS = FIRST_EVALUATION_SEED // WORLDS_PER_SEED
"""Runs that have worlds of their own: their seeds are below this."""

EVALUATION_SEEDS = range(FIRST_EVALUATION_SEED, FIRST_EVALUATION_SEED + 16)
"""Seeds of evaluations, far from those that learners begin their worlds with."""

LEFT = "left the world"
"""Reason for the end of a species that diverged."""

DEFAULT_STEPS = 256
"""Steps of an episode where an id is registered without a limit."""

SPECIES = (*SPECIES_TASKS, *(size.id for size in SPECIES_SIZES))
"""Ids of species tasks."""

RowRewards = Literal["particle", "marginal"]
"""Rewards of environments that pay each particle."""

ROW_REWARDS = get_args(RowRewards)

ELSEWHERE = {
    "num_envs": "it is a field of Problem",
    "world_count": "the field num_envs of Problem says how many",
    "max_episode_steps": "the field episode_steps of Problem says how many",
    "max_cycles": "the field episode_steps of Problem says how many",
    "episode_steps": "it is a field of Problem",
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
    """An environment to learn in. It can be written as JSON, and read again, by `to_json`.

    Raises:
        NPAError: There is no such environment, a keyword is unknown or wrong, or a number is out of
            its range.
    """

    env_id: str
    """Of `npa_envs.registration`, or of a species task: "npa/Mixing-v0"; or of an environment of
    one's own that is registered with Gymnasium."""
    keywords: Mapping[str, Any] = field(default_factory=dict)
    """Further keywords of `gym.make` or `multispecies_v0.batched`, of JSON's types."""
    episode_steps: int
    """Steps after which an episode is cut off."""
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
        # Unknown ids and wrong keywords are errors now, not in the middle of a comparison.
        _ = self.config

    def __hash__(self) -> int:
        """Return a number that is the same for equal problems."""
        return hash(self.to_json())

    @property
    def is_species(self) -> bool:
        """Whether several species share a world."""
        return isinstance(self.env_id, str) and self.env_id in SPECIES

    @property
    def is_garden(self) -> bool:
        """Whether a rule runs the particles, and actions are those of brushes."""
        return not self.is_species and issubclass(self.env_type.task_type, GardenTask)

    @property
    def chooses_codes(self) -> bool:
        """Whether a rule of many pictures runs the particles, and an action is a code."""
        return not self.is_species and issubclass(self.env_type.task_type, ShapeshifterTask)

    @cached_property
    def env_type(self) -> type[NPAVectorEnv]:
        """Class of the environment of many worlds, where one species is alone."""
        spec = gymnasium.registry.get(self.env_id) if isinstance(self.env_id, str) else None
        entry: Any = None if spec is None else spec.vector_entry_point
        if isinstance(entry, str):
            entry = gymnasium.envs.registration.load_env_creator(entry)
        if not (isinstance(entry, type) and issubclass(entry, NPAVectorEnv)):
            known = [environment.id for environment in ALL]
            raise NPAError(
                f"env_id must be of an environment of many worlds, got {shown(self.env_id)}: "
                f"{suggest(self.env_id, [*known, *SPECIES])}"
            )
        return entry

    @property
    def task_type(self) -> type[EnvTask[Any]] | type[SpeciesTask]:
        """Class of the task."""
        if self.is_species:
            return species_task_type(task_settings(self.env_id)[0])
        return self.env_type.task_type

    @property
    def settings(self) -> dict[str, Any]:
        """Keywords that belong to the id."""
        if self.is_species:
            settings = task_settings(self.env_id)[1]
            settings.pop("max_cycles", None)
            return settings
        return dict(gymnasium.spec(self.env_id).kwargs)

    @cached_property
    def config(self) -> EnvConfig | SpeciesConfig:
        """The environment's configuration, on the CPU."""
        config_type = self.task_type.config_type
        given = self.settings | dict(self.keywords)
        if self.is_species:
            given["max_cycles"] = self.episode_steps
        elif given.get("reward") == "sparse":
            given["episode_steps"] = self.episode_steps
        return config_type.from_keywords(given)

    @property
    def physics(self) -> Physics:
        """The worlds' constants."""
        return self.config.physics(self.task_type.space_dim, static=self.task_type.static)

    @property
    def interface(self) -> Interface:
        """What observations and actions mean, column by column."""
        config = self.config
        if isinstance(config, SpeciesConfig) and config.perception == "per_species":
            return Interface.of(self.physics, config.species_count)
        return Interface.of(self.physics)

    @property
    def counts(self) -> tuple[int, ...]:
        """Particles of each species that is an agent; of the only one where it is alone."""
        config = self.config
        if isinstance(config, SpeciesConfig):
            return config.played_counts
        return (config.particle_count,)

    @property
    def particle_count(self) -> int:
        """Particles of a world that are acted upon, N."""
        return sum(self.counts)

    def make_task(self, device: str | torch.device = "cpu") -> EnvTask[Any] | SpeciesTask:
        """Return the task by itself, starts and losses, for worlds on a device.

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
        """Return worlds to act in, batched on a device; all that goes in and out are tensors there.

        `reset(seed=0)` returns observations, [B, N, P], and infos; `step(actions)`, of [B, N, A],
        returns observations, rewards, terminations and truncations, [B] each, and infos. Worlds
        restart in the step that ends their episodes: then `infos["final_obs"]`, [B, N, P], has the
        last observations where `infos["_final_obs"]`, [B], is true.

        Args:
            num_envs: Worlds B; None: the problem's.
            device: Where they live.
            row_rewards: Give `infos["particle_reward"]`, [B, N], the reward of each particle:
                "particle", its own share of the improvement, or "marginal", the loss of its world
                without its action. Of several species each particle always has the reward of its
                species.
            tell_updated: Give `infos["updated"]`, [B, N], whose actions took effect in each step;
                not for several species.
            copy: Hand out new tensors; False: where possible the same ones in each step,
                overwritten by the next.

        Raises:
            NPAError: The worlds do not fit into memory, there is no such device, or `row_rewards`
                contradicts the problem's keywords.
        """
        count = self.num_envs if num_envs is None else num_envs
        place = str(check_device(device))
        if self.is_species:
            return ConcatenatedSpeciesEnv(
                task_settings(self.env_id)[0],
                count,
                self.episode_steps,
                place,
                self.settings | dict(self.keywords),
            )
        given = dict(self.keywords)
        if row_rewards:
            if given.get("reward", "dense") != "dense":
                raise NPAError(
                    "row_rewards needs the problem's reward to be 'dense', got "
                    f"{shown(given['reward'])}: leave it out of keywords"
                )
            given["reward"] = row_rewards
        if tell_updated:
            given["tell_updated"] = True
        envs: Any = gymnasium.make_vec(
            self.env_id,
            num_envs=count,
            vectorization_mode="vector_entry_point",
            max_episode_steps=self.episode_steps,
            autoreset_mode="same-step",
            output="torch",
            device=place,
            copy=copy,
            **given,
        )
        made: NPAVectorEnv = envs.unwrapped
        return made

    def new_rules(self, seed: int) -> RuleSet:
        """Return untrained rules, one for each species; as `RuleSet.new`."""
        return RuleSet.new(self, seed)

    def to_json(self) -> str:
        """Return the problem as JSON, on one line."""
        return json.dumps(asdict(self), sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> Problem:
        """Return the problem that `to_json` wrote.

        Raises:
            NPAError: The text is no problem in JSON.
        """
        try:
            return cls(**json.loads(text))
        except (TypeError, json.JSONDecodeError) as error:
            raise NPAError(
                f"text must be a problem in JSON, got {shown(text)} ({error}): give what "
                "Problem.to_json returned"
            ) from error


def registered_steps(env_id: str) -> int:
    """Return the steps after which episodes of an id are cut off; 256 where it has no limit."""
    if env_id in SPECIES:
        steps = task_settings(env_id)[1].get("max_cycles")
    else:
        steps = getattr(gymnasium.registry.get(env_id), "max_episode_steps", None)
    return DEFAULT_STEPS if steps is None else int(steps)


def check_run_seed(seed: Any) -> None:
    """Check the seed of a run, which has worlds of its own: it is below `RUNS`."""
    if not is_whole(seed) or not 0 <= seed < RUNS:
        raise NPAError(
            f"seed must be a whole number from 0 to {RUNS - 1}, as the worlds of later ones are "
            f"those of evaluations, got {shown(seed)}: give seed=0"
        )


def world_seeds(seed: int, count: int, part: int = 0) -> list[int]:
    """Return the seeds of the worlds that a run learns in, which no other run has.

    Each part of a run, from one stop to the next, has others, as long as there are enough.
    """
    check_run_seed(seed)
    if count > WORLDS_PER_SEED:
        raise NPAError(
            f"worlds must be at most {WORLDS_PER_SEED}, got {count}: more would share their "
            "seeds with the next run"
        )
    first = seed * WORLDS_PER_SEED
    return [first + (part * count + world) % WORLDS_PER_SEED for world in range(count)]


class ConcatenatedSpeciesEnv:
    """Worlds of several species whose particles stand one after the other: [B, N, P], [B, N, A].

    It has the interface of `NPAVectorEnv` as far as learners need it. Reward and loss of a world
    are the means over its species; a species that ended keeps the loss that it had then. A world
    terminates where all of its species have ended by themselves. The reason is that of the first
    species that ended by itself, or "left the world" where one did. Every step's infos also have
    of each particle's species, in [B, N], its reward in `particle_reward`, whether it was alive in
    `acted`, and whether it ended by itself now in `particle_terminated`.
    """

    def __init__(
        self, task: str, num_envs: int, episode_steps: int, device: str, keywords: Mapping[str, Any]
    ) -> None:
        self.species_env = env = MultiSpeciesVectorEnv(
            task,
            world_count=num_envs,
            max_cycles=episode_steps,
            device=device,
            output="torch",
            **keywords,
        )
        self.num_envs, self.config, self.render_mode = num_envs, env.config, env.render_mode
        self.task = env.worlds.task
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        self.worlds, self.episode_steps = env.worlds, episode_steps
        counts = env.config.played_counts
        self.spans = dict(zip(env.agents, spans_of(counts), strict=True))
        self.single_observation_space = _concatenated_space(env.single_observation_spaces)
        self.single_action_space = _concatenated_space(env.single_action_spaces)
        self._counts = torch.tensor(counts, device=device)
        self._loss = torch.zeros(num_envs, len(counts), device=device)
        self._reasons = np.full(num_envs, None, dtype=object)

    @property
    def unwrapped(self) -> ConcatenatedSpeciesEnv:
        """The environment itself."""
        return self

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Tensor, dict[str, Any]]:
        """Start episodes as `MultiSpeciesVectorEnv.reset`; infos have `loss`."""
        rows, infos = self.species_env.reset(seed, options)
        chosen = worlds_to_reset(options, self.num_envs)
        self._reasons[chosen] = None
        # Infos are silent about species that have ended in worlds that go on.
        losses, index = self._stacked(infos, "loss"), to_device_async(chosen, self._loss.device)
        self._loss = self._loss.index_copy(0, index, losses[index])
        return self._concatenated(rows), {"loss": self._loss.mean(dim=1)}

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Apply actions, [B, N, A], in [-1, 1], and perceive; wrong ones leave the worlds alone."""
        by_species = {agent: actions[:, span] for agent, span in self.spans.items()}
        rows, rewards, terminations, truncations, infos = self.species_env.step(by_species)
        paid, ended, cut = (
            torch.stack(list(part.values()), dim=1) for part in (rewards, terminations, truncations)
        )
        acted, late = self._stacked(infos, "acted"), cut.any(dim=1)
        self._loss = torch.where(acted, self._stacked(infos, "loss"), self._loss)
        found: dict[str, Any] = {
            "loss": self._loss.mean(dim=1),
            "particle_reward": self._by_particle(paid),
            "acted": self._by_particle(acted),
            "particle_terminated": self._by_particle(ended),
        }
        # Why the first species of each world ended, or that one left the world.
        for agent in self.spans:
            own = infos[agent].get("reason")
            if own is not None:
                given = own != None  # noqa: E711
                held = (self._reasons != None) & (self._reasons != TIME_LIMIT)  # noqa: E711
                self._reasons = np.where((given & ~held) | (own == LEFT), own, self._reasons)
        first = infos[self.species_env.agents[0]]
        over = first.get("_final_obs", torch.zeros_like(late))
        if "final_obs" in first:
            last = {agent: infos[agent]["final_obs"] for agent in self.spans}
            which = over.cpu().numpy()
            reasons = self._reasons.copy()
            reasons[~which] = None
            self._reasons[which] = None
            final = {"loss": found["loss"], "_loss": over, "reason": reasons}
            found |= {"final_obs": self._concatenated(last), "_final_obs": over}
            found |= {"final_info": final, "_final_info": over}
        return self._concatenated(rows), paid.mean(dim=1), over & ~late, over & late, found

    def close(self) -> None:
        """Close the window, if there is one."""
        self.species_env.close()

    def _concatenated(self, rows: Mapping[str, Tensor]) -> Tensor:
        return torch.cat([rows[agent] for agent in self.spans], dim=1)

    def _stacked(self, infos: Mapping[str, Mapping[str, Any]], name: str) -> Tensor:
        return torch.stack([infos[agent][name] for agent in self.spans], dim=1)

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
