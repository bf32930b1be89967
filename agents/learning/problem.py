"""Seeds of worlds: every run learns in worlds of its own, and none in those of evaluations."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import gymnasium
import torch

from npa_envs.agents.learning.joined import JoinedSpeciesEnv
from npa_envs.agents.policies import Interface
from npa_envs.devices import check_device
from npa_envs.envs.core.config import EnvConfig
from npa_envs.envs.core.task import EnvTask
from npa_envs.envs.core.vector import NPAVectorEnv
from npa_envs.envs.core.worlds import make_physics
from npa_envs.envs.multi.config import SpeciesConfig
from npa_envs.envs.multi.task import SpeciesTask
from npa_envs.envs.multi.tasks.table import ENVIRONMENTS as SPECIES
from npa_envs.envs.multi.tasks.table import task_type as species_task_type
from npa_envs.errors import NPAError, suggest
from npa_envs.registration import ENVIRONMENTS
from npa_envs.tasks.checks import check_positive
from npa_envs.world.actions import Physics

WORLDS_PER_SEED = 10_000
"""Distance of the worlds' seeds of one run from those of the next."""

FIRST_EVALUATION_SEED = 1_000_000
"""Seeds from here on are for evaluations."""

EVALUATION_SEEDS = range(FIRST_EVALUATION_SEED, FIRST_EVALUATION_SEED + 16)
"""Seeds of evaluations, far from those that learners begin their worlds with."""


def world_seeds(seed: int, count: int) -> range:
    """Return the seeds of the worlds that a run learns in, which no other run has.

    Args:
        seed: Of the run, at least 0.
        count: How many worlds.

    Raises:
        NPAError: There are too many, or the seed is so large that they are those of evaluations.
    """
    runs = FIRST_EVALUATION_SEED // WORLDS_PER_SEED
    if seed >= runs:
        raise NPAError(
            f"seed must be below {runs}, got {seed}: later ones would have worlds of evaluations"
        )
    if count > WORLDS_PER_SEED:
        raise NPAError(
            f"worlds must be at most {WORLDS_PER_SEED}, got {count}: more would share their "
            "seeds with the next run"
        )
    first = seed * WORLDS_PER_SEED
    return range(first, first + count)


# What is to be learned: an environment with its keywords, and the length of its episodes.


if TYPE_CHECKING:
    from npa_envs.agents.learning.rules import RuleSet

ELSEWHERE = {
    "num_envs": "it is a field of Problem",
    "world_count": "the field num_envs of Problem says how many",
    "max_episode_steps": "the field episode_steps of Problem says how many",
    "max_cycles": "the field episode_steps of Problem says how many",
    "episode_steps": "it is a field of Problem",
    "device": "it is given to train and make_envs",
    "output": "learners are given tensors",
    "autoreset_mode": "learners' worlds restart in the step that ends their episodes",
    "task": "the id says it",
    "perceive": "the id says it",
}
"""Keywords of environments that problems do not take, and where they are said instead."""


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
    """What `gym.make` or `multispecies_v0.batched` is given besides, of JSON's types."""

    episode_steps: int
    """Steps after which an episode is cut off."""

    num_envs: int = 16
    """Worlds B in which learners act at the same time."""

    hidden_dim: int = 128
    """Width of the hidden layer of new rules."""

    def __post_init__(self) -> None:
        """Check every field.

        Raises:
            NPAError: A field has the wrong type or lies outside its range.
        """
        check_positive(self, int, "episode_steps", "num_envs", "hidden_dim")
        if not isinstance(self.keywords, Mapping):
            raise NPAError(
                f"keywords must map names to values, got {type(self.keywords).__name__}: "
                "for example keywords={'target': 'heart'}"
            )
        for name in self.keywords:
            if name in ELSEWHERE:
                raise NPAError(f"keywords must not have {name!r}: {ELSEWHERE[name]}")
        if self.keywords.get("reward") == "particle":
            raise NPAError(
                "keywords must not have reward='particle': ask make_envs for row_rewards=True"
            )
        try:
            plain = json.loads(json.dumps(dict(self.keywords)))
        except (TypeError, ValueError) as error:
            raise NPAError(
                f"keywords must have values of JSON's types, got {dict(self.keywords)!r}: give "
                f"numbers, text and lists ({error})"
            ) from error
        object.__setattr__(self, "keywords", plain)
        # Unknown ids and wrong keywords are errors now, not in the midst of a comparison.
        _ = self.config

    def __hash__(self) -> int:
        """Return a number that is the same for equal problems."""
        return hash(self.to_json())

    @property
    def is_species(self) -> bool:
        """Whether several species share a world."""
        return self.env_id in SPECIES

    @cached_property
    def env_type(self) -> type[NPAVectorEnv]:
        """Class of the environment of many worlds, where one species is alone."""
        spec = gymnasium.registry.get(self.env_id) if isinstance(self.env_id, str) else None
        entry: Any = None if spec is None else spec.vector_entry_point
        if isinstance(entry, str):
            entry = gymnasium.envs.registration.load_env_creator(entry)
        if not (isinstance(entry, type) and issubclass(entry, NPAVectorEnv)):
            known = [environment.id for environment in ENVIRONMENTS]
            raise NPAError(
                f"env_id must be of an environment of many worlds, got {self.env_id!r}: "
                f"{suggest(str(self.env_id), [*known, *SPECIES])}"
            )
        return entry

    @property
    def task_type(self) -> type[EnvTask[Any]] | type[SpeciesTask]:
        """Class of the task."""
        if self.is_species:
            return species_task_type(SPECIES[self.env_id])
        return self.env_type.task_type

    @cached_property
    def config(self) -> EnvConfig | SpeciesConfig:
        """The environment's configuration, on the CPU."""
        given = dict(self.keywords)
        if self.is_species:
            given["max_cycles"] = self.episode_steps
        elif given.get("reward") == "sparse":
            given["episode_steps"] = self.episode_steps
        return self.task_type.config_type.from_keywords(given)

    @property
    def physics(self) -> Physics:
        """The worlds' constants."""
        config = self.config
        if isinstance(config, SpeciesConfig):
            return make_physics(config.world, EnvTask)
        task_type: Any = self.task_type
        return make_physics(config, task_type)

    @property
    def interface(self) -> Interface:
        """What observations and actions mean, column by column."""
        physics, config = self.physics, self.config
        told_apart = isinstance(config, SpeciesConfig) and config.perception == "per_species"
        return Interface(
            physics.space_dim,
            physics.state_dim,
            physics.moving,
            physics.state_scale,
            config.species_count if isinstance(config, SpeciesConfig) and told_apart else 0,
        )

    @property
    def counts(self) -> tuple[int, ...]:
        """Particles of each species; of the only one where it is alone."""
        config = self.config
        return config.counts if isinstance(config, SpeciesConfig) else (config.particle_count,)

    @property
    def particle_count(self) -> int:
        """Particles of a world, N."""
        return sum(self.counts)

    def make_task(self, device: str | torch.device = "cpu") -> EnvTask[Any] | SpeciesTask:
        """Return the task by itself: starts and losses.

        Args:
            device: Where the worlds live.

        Raises:
            NPAError: Something that the task needs cannot be loaded.
        """
        place = check_device(device)
        config = replace(self.config, device=str(place))
        made: EnvTask[Any] | SpeciesTask = self.task_type(config, place)
        return made

    def make_envs(
        self,
        num_envs: int | None = None,
        *,
        device: str | torch.device = "cpu",
        row_rewards: bool = False,
        copy: bool = True,
    ) -> NPAVectorEnv | JoinedSpeciesEnv:
        """Return worlds to act in, batched on a device; all that goes in and out are tensors there.

        `reset(seed=0)` returns observations, [B, N, P], and infos; `step(actions)`, of [B, N, A],
        returns observations, rewards, terminations and truncations, [B] each, and infos. Worlds
        restart in the step that ends their episodes: then `infos["final_obs"]`, [B, N, P], has the
        last observations where `infos["_final_obs"]`, [B], says so.

        Args:
            num_envs: Worlds B; None: the problem's.
            device: Where they live.
            row_rewards: Let `infos["particle_reward"]`, [B, N], of each step have what each
                particle is paid: its own share of the improvement, or what its species is paid.
            copy: Hand out new tensors; False: where possible the same ones in each step,
                overwritten by the next.

        Raises:
            NPAError: The worlds do not fit into memory, there is no such device, or particles are
                to be paid where the problem's keywords pay otherwise.
        """
        count = self.num_envs if num_envs is None else num_envs
        place = str(check_device(device))
        if self.is_species:
            return JoinedSpeciesEnv(
                SPECIES[self.env_id], count, self.episode_steps, place, self.keywords
            )
        given = dict(self.keywords)
        if row_rewards:
            if given.get("reward", "dense") != "dense":
                raise NPAError(
                    "row_rewards needs the problem's reward to be 'dense', got "
                    f"{given['reward']!r}: leave it out of keywords"
                )
            given["reward"] = "particle"
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
        """Return untrained rules of the right architecture, one for each species, on the CPU.

        Args:
            seed: Of their weights, at least 0; torch's own randomness is left as it is.

        Raises:
            NPAError: The seed is none.
        """
        # Here, as sets of rules know of problems.
        from npa_envs.agents.learning.rules import RuleSet

        return RuleSet.new(self, seed)

    def to_json(self) -> str:
        """Return the problem as JSON, on one line."""
        return json.dumps(asdict(self), sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> Problem:
        """Return the problem that `to_json` wrote.

        Args:
            text: JSON.

        Raises:
            NPAError: It is no problem.
        """
        try:
            fields = json.loads(text)
            return cls(**fields)
        except TypeError as error:
            raise NPAError(f"text must be a problem in JSON, got {text!r} ({error})") from error
        except json.JSONDecodeError as error:
            raise NPAError(f"text must be JSON, got {text!r} ({error})") from error
