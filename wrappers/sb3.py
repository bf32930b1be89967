"""Adapters to Stable-Baselines3: particles, or worlds, as the rows of a `VecEnv`."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NoReturn

import numpy as np
import torch
from gymnasium.spaces import Box, Space
from gymnasium.vector import VectorWrapper
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.envs.core.vector import NPAVectorEnv
from npa_envs.envs.multi.vector import MultiSpeciesVectorEnv
from npa_envs.errors import NPAError, check_known, importing, shown
from npa_envs.wrappers.base import (
    MAKE_VECTOR,
    AnyVectorEnv,
    as_tensor,
    autoreset_mode,
    check_autoreset,
    check_row_actions,
    own_rewards,
    row_space,
    vector_env,
)

with importing("Stable-Baselines3", "a VecEnv", "pip install 'npa-envs[sb3]'"):
    from stable_baselines3.common.vec_env import VecEnv


RowSteps = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]
"""Observations, rewards, endings and infos of rows."""


class SharedInfo(dict[str, Any]):
    """The read-only empty info shared by all rows whose episode continues."""

    def _refuse(self, *_: Any, **__: Any) -> NoReturn:
        raise NPAError(
            "info of a row whose episode continues is shared by all such rows: "
            "put a copy into the list, infos[row] = dict(infos[row])"
        )

    __setitem__ = __ior__ = setdefault = update = _refuse


class RowVecEnv(VecEnv):
    """Base class of `VecEnv`s with R rows for each of B worlds; subclasses say what a row is."""

    def __init__(
        self,
        env: Any,
        world_count: int,
        row_count: int,
        observation_space: Space[Any],
        action_space: Space[Any],
    ) -> None:
        self.vector_env = env
        self.world_count = world_count
        self.row_count = row_count
        """Rows of a world, R."""
        self.spec = getattr(env, "spec", None)
        self.shared_info: dict[str, Any] = SharedInfo()
        """The info of all rows whose episodes continue."""
        self._actions: NDArray[np.float32] | None = None
        self._observations: Any = None
        super().__init__(world_count * row_count, observation_space, action_space)

    def reset(self) -> Any:
        """Start episodes in all worlds and return the rows' observations, shape [B R, ...]."""
        # World k takes the seed of world 0 plus k.
        seed, options = self._seeds[0], self._options[0] or None
        self._observations, _ = self.vector_env.reset(seed=seed, options=options)
        self._reset_seeds()
        self._reset_options()
        return self._row_observations(self._observations)

    @abstractmethod
    def _row_observations(self, observations: Any) -> Any:
        """Return rows' observations [B' R, ...] for the observations of B' worlds, all or some."""

    def step_async(self, actions: NDArray[Any]) -> None:
        """Store the actions of all rows, shape [B R, A], for `step_wait`."""
        check_row_actions(actions, self.num_envs, *(self.action_space.shape or ()))
        self._actions = actions.reshape(self.world_count, self.row_count, -1)

    def taken_actions(self) -> NDArray[np.float32]:
        """Return the actions that `step_async` stored, shape [B, R, A], and delete them."""
        if self._actions is None:
            raise NPAError("step_wait needs actions: call step_async, or step")
        actions, self._actions = self._actions, None
        return actions

    def infos(self, rows: NDArray[np.int64], entries: Mapping[str, Any]) -> list[dict[str, Any]]:
        """Return the info of each row: the empty one, except in the rows of index `rows`.

        Each of their `entries` has one value for each of these rows.
        """
        infos: list[dict[str, Any]] = [self.shared_info] * self.num_envs
        for k, row in enumerate(rows.tolist()):
            infos[row] = {name: values[k] for name, values in entries.items()}
        return infos

    def close(self) -> None:
        """Close the environment."""
        self.vector_env.close()

    def seed(self, seed: int | None = None) -> list[int | None]:
        """Set the seeds of the next reset, seed + k for world k; return that of each row's world.

        A row is a world, or a particle of one. If `seed` is None, it is random.
        """
        first = int(np.random.default_rng().integers(2**32) if seed is None else seed)
        worlds = np.arange(self.world_count).repeat(self.row_count)
        self._seeds = [first + world for world in worlds.tolist()]
        return self._seeds

    def get_images(self) -> list[NDArray[np.uint8] | None]:
        """Return a square RGB picture of each world; an empty list without a render mode."""
        pictures: Any = self.vector_env.render()
        return list(pictures or ())

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the environment or its wrappers, once for each row."""
        return self._for_rows(getattr(self._holder(attr_name), attr_name), indices)

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute on the wrapper or environment that has it, else on the innermost."""
        if len(set(self._get_indices(indices))) != self.num_envs:
            raise NPAError("indices must be all rows, which share one environment: give None")
        try:
            holder = self._holder(attr_name)
        except AttributeError:
            holder = getattr(self.vector_env, "unwrapped", self.vector_env)
        setattr(holder, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the environment once, and return its result for each row."""
        result = getattr(self._holder(method_name), method_name)(*method_args, **method_kwargs)
        return self._for_rows(result, indices)

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """Return for each row whether the environment is wrapped with `wrapper_class`."""
        wrapped = any(isinstance(layer, wrapper_class) for layer in self._layers())
        return self._for_rows(wrapped, indices)

    def _for_rows(self, value: Any, indices: Any) -> list[Any]:
        return [value] * len(list(self._get_indices(indices)))

    def _layers(self) -> Iterator[Any]:
        layer: Any = self.vector_env
        while isinstance(layer, VectorWrapper):
            yield layer
            layer = layer.env
        yield layer

    def _holder(self, name: str) -> Any:
        for layer in self._layers():
            if hasattr(layer, name):
                return layer
        raise AttributeError(f"{self.vector_env} has no attribute {name!r}")


def on_host(*batches: Any) -> list[NDArray[Any]]:
    """Copy arrays or tensors to arrays on the CPU; each device is waited for at most once."""
    copies = []
    for values in batches:
        tensor = as_tensor(values)
        # Pinned memory comes from torch's cache and returns to it with the array.
        copy = torch.empty(
            tensor.shape, dtype=tensor.dtype, device="cpu", pin_memory=tensor.is_cuda
        )
        copies.append(copy.copy_(tensor, non_blocking=tensor.is_cuda))
    for device in {v.device for v in batches if isinstance(v, Tensor) and v.is_cuda}:
        torch.cuda.current_stream(device).synchronize()
    return [copy.numpy() for copy in copies]


class _EpisodeRows(RowVecEnv):
    """Base class for rows that begin and end their episodes with their world."""

    bootstrap = True
    """Whether infos mark truncation by the step limit."""

    per_particle_reward = True
    """Whether rows get their particles' rewards, if there are any."""

    def step_wait(self) -> RowSteps:
        """Step all worlds; return the rows' observations, rewards, done flags and infos."""
        shape = self.vector_env.single_action_space.shape
        actions = self.taken_actions().reshape(self.world_count, *shape)
        observations, rewards, terminations, truncations, infos = self.vector_env.step(actions)
        by_particle = own_rewards(infos) if self.per_particle_reward else None
        rewards, ended, cut = on_host(
            rewards if by_particle is None else by_particle, terminations, truncations
        )
        if by_particle is None:
            rewards = np.repeat(rewards, self.row_count)
        done = ended | cut
        row_infos = self._end_infos(np.flatnonzero(done), cut & ~ended, infos)
        rewards = rewards.reshape(self.num_envs).astype(np.float32, copy=False)
        rows = self._row_observations(observations)
        return rows, rewards, np.repeat(done, self.row_count), row_infos

    def _row_observations(self, observations: Any) -> Any:
        if isinstance(observations, Mapping):
            return dict(zip(observations, on_host(*observations.values()), strict=True))
        return on_host(observations)[0].reshape(-1, *(self.observation_space.shape or ()))

    def _end_infos(
        self, worlds: NDArray[np.int64], cut: NDArray[np.bool_], infos: dict[str, Any]
    ) -> list[dict[str, Any]]:
        """Return the infos of all rows after a step in which the episodes of `worlds` ended.

        `cut` [B] is True where an episode was truncated.
        """
        if not len(worlds):
            return [self.shared_info] * self.num_envs
        count, final = self.row_count, infos["final_info"]
        entries: dict[str, Any] = {}
        inner = self.vector_env.unwrapped
        # The first one of a `SyncVectorEnv`; those in other processes cannot be asked.
        worlds_of = getattr(getattr(inner, "envs", [inner])[0].unwrapped, "worlds", None)
        episodes = getattr(worlds_of, "episodes", None)
        can_succeed = episodes is None or episodes.can_succeed
        success = final.get("is_success", final.get("success") if can_succeed else None)
        if success is not None:
            entries["is_success"] = on_host(success)[0][worlds].repeat(count).tolist()
        if self.bootstrap:
            entries["TimeLimit.truncated"] = cut[worlds].repeat(count).tolist()
            entries["terminal_observation"] = self._last_observations(infos["final_obs"], worlds)
        rows = (worlds[:, None] * count + np.arange(count)).reshape(-1)
        return self.infos(rows, entries)

    def _last_observations(self, final: Any, worlds: NDArray[np.int64]) -> Any:
        """Return, for each row of `worlds`, the last observation of the episode that ended."""
        if isinstance(final, Mapping):
            last = {n: values[worlds] for n, values in self._row_observations(final).items()}
            return [{name: rows[k] for name, rows in last.items()} for k in range(len(worlds))]
        if not isinstance(final, Tensor) and final.dtype == object:
            some = list(final[worlds])
            return some if isinstance(some[0], dict) else self._row_observations(np.stack(some))
        # Only ended worlds are copied.
        rows = as_tensor(final)
        return self._row_observations(rows[torch.from_numpy(worlds).to(rows.device)])


class ParticleVecEnv(_EpisodeRows):
    """The particles of a vector environment as the rows of a Stable-Baselines3 `VecEnv`.

    Row w N + i is particle i of world w: it observes that particle's perception, shape [P], gives
    its action, shape [A], and gets its own reward where the environment was made with
    `reward="particle"`; with any other reward each row gets its world's. So all particles share one
    policy, with the observation of a rule. A step is one batched step, and copies the observations
    to the CPU once (on CUDA make the environment with `output="torch"`: the copy is then pinned).

    Rows of a finished world have their own infos, with `terminal_observation`,
    `TimeLimit.truncated` and, if episodes can succeed, `is_success`; the others share a read-only
    empty one. Attributes and methods are those of the whole environment, the same for each row.

    Stable-Baselines3 counts rows: 8 worlds of 1024 particles are 8192 steps at once. Its defaults
    are made for a few rows; with PPO set for example `n_steps=32, batch_size=4096`.

    Args:
        env: A vector environment of this package, wrapped or not, with same-step autoreset.
        bootstrap: Whether infos mark truncation by the step limit, so that Stable-Baselines3
            bootstraps the value there. On-policy algorithms do that row by row, which takes seconds
            for many thousand rows; False: truncation counts as termination.
    """

    def __init__(self, env: AnyVectorEnv, *, bootstrap: bool = True) -> None:
        base = vector_env(env, type(self).__name__)
        check_autoreset(autoreset_mode(env), "same-step")
        self.bootstrap = bootstrap
        self.particle_count = base.config.particle_count
        super().__init__(
            env, base.num_envs, self.particle_count, row_space(env.single_observation_space),
            row_space(env.single_action_space),
        )  # fmt: skip


class WorldVecEnv(_EpisodeRows):
    """The worlds of a vector environment as the rows of a Stable-Baselines3 `VecEnv`.

    A row is a world. Rule-driven worlds, such as `npa/Gardener2D-v0`, have small observations and
    actions, which suit Stable-Baselines3's own policies; dictionary observations stay dictionaries.

    Where actions belong to particles, a row's observation is the perception of all of them, shape
    [N, P], and its action all their actions, [N, A]. Stable-Baselines3's own policies draw those
    from one Gaussian of N A dimensions, which cannot learn: after a small update the ratio of two
    likelihoods is near zero or overflows. Take a policy that averages log-likelihoods over
    particles, such as `npa_envs.agents.learning.sb3.WorldRulePolicy`. Infos are those of
    `ParticleVecEnv`.

    Args:
        env: A vector environment, wrapped or not, with same-step autoreset.
    """

    per_particle_reward = False

    def __init__(self, env: Any) -> None:
        if not hasattr(env, "single_action_space"):
            raise NPAError(f"env must be a vector environment, got {env}: {MAKE_VECTOR}")
        ours = isinstance(env.unwrapped, NPAVectorEnv)
        if ours and hasattr(env, "possible_agents"):
            raise NPAError(
                f"env must have one agent, got {type(env).__name__} with {env.possible_agents}: "
                "let one learn in gym.make_vec('npa/Gardener2D-v0'), or step both by hand"
            )
        made = "" if ours else "vectorization_mode='vector_entry_point', "
        check_autoreset(autoreset_mode(env), "same-step", made)
        super().__init__(
            env, env.num_envs, 1, env.single_observation_space, env.single_action_space
        )


SpeciesPolicy = Callable[[Any], Any]
"""Takes a species' observations, shape [B, N_k, P], and returns its actions, [B, N_k, A]."""


class RowPolicy:
    """A Stable-Baselines3 model that was trained on rows, as the policy of a species or a world.

    Args:
        model: The model; training it further changes the policy.
        deterministic: Whether it acts by its mean instead of a random action.
        tag: One-hot species to append to each row, shape [species]; None: nothing.
    """

    def __init__(
        self, model: Any, *, deterministic: bool = False, tag: NDArray[np.float32] | None = None
    ) -> None:
        if not callable(getattr(model, "predict", None)):
            raise NPAError(
                f"model must be one of Stable-Baselines3, got {shown(model)}: load it first, "
                "stable_baselines3.PPO.load('model.zip')"
            )
        self.model = model
        self.deterministic = deterministic
        self.tag = tag

    def __call__(self, observations: Any) -> NDArray[np.float32]:
        """Return actions [B, N, A] for observations [B, N, P]."""
        (observed,) = on_host(observations)
        rows = observed.reshape(-1, observed.shape[-1])
        if self.tag is not None:
            rows = np.hstack((rows, np.broadcast_to(self.tag, (len(rows), len(self.tag)))))
        actions, _ = self.model.predict(rows, deterministic=self.deterministic)
        return np.asarray(actions, np.float32).reshape(*observed.shape[:-1], -1)


def last_axis(space: Box) -> Box:
    """Return the box of one row, for a box of rows, [N, P], or of one row, [P]."""
    low, high = (bound.reshape(-1, bound.shape[-1])[0] for bound in (space.low, space.high))
    return Box(low, high, dtype=np.float32)


class SpeciesVecEnv(RowVecEnv):
    """Particles of several species as the rows of a Stable-Baselines3 `VecEnv`.

    Without `others` all particles of all species are rows and share one policy; each observation
    ends with a one-hot tag of the species. With `others` those species act by the given policies,
    and the particles of the remaining species are the rows, without tags: so species can be trained
    in turn.

    A world's rows are sorted by species. Each row gets its species' reward. Rows of a species that
    ended are done; until the world's next episode their observations and rewards are zeros, and
    their actions are ignored. When the world ends they are done again.

    Args:
        env: From `multispecies_v0.batched`, or from `particles_v0.batched`, whose rows get their
            own rewards and end by themselves; with same-step autoreset.
        others: Policies of the species, or particles, that are not rows, by name.
    """

    def __init__(
        self, env: MultiSpeciesVectorEnv, *, others: Mapping[str, SpeciesPolicy] | None = None
    ) -> None:
        if not isinstance(env, MultiSpeciesVectorEnv):
            raise NPAError(
                f"env must be a batch of worlds of several species, got {type(env).__name__}: "
                "make one with npa_envs.envs.multispecies_v0.batched or particles_v0.batched"
            )
        check_autoreset(env.autoreset_mode, "same-step")
        self.others = dict(others or {})
        """Policies of species that are not rows."""
        for name, policy in self.others.items():
            if not callable(policy):
                raise NPAError(
                    f"others must be functions of observations, got {type(policy).__name__} for "
                    f"{shown(name)}: RowPolicy(model) makes one of a model"
                )
            check_known("others must name species, got", name, env.possible_agents)
        self.rows_of = [name for name in env.possible_agents if name not in self.others]
        """Species whose particles are rows, in order."""
        if not self.rows_of:
            raise NPAError("others must not name all species: at least one has to be rows")
        spaces = env.single_observation_spaces
        self._counts = np.array([math.prod(spaces[name].shape[:-1]) for name in self.rows_of])
        observed = last_axis(spaces[self.rows_of[0]])
        self._tags = None
        if not self.others:
            species = env.worlds.agent_species[: len(self.rows_of)]
            self._tag_of = np.eye(species.max() + 1, dtype=np.float32)[species]
            tags = self._tag_of.repeat(self._counts, axis=0)
            self._tags = torch.from_numpy(tags).to(env.worlds.device)
            tag = np.ones(tags.shape[1], np.float32)
            observed = Box(np.append(observed.low, 0.0 * tag), np.append(observed.high, tag))
        acted = last_axis(env.single_action_spaces[self.rows_of[0]])
        super().__init__(env, env.world_count, int(self._counts.sum()), observed, acted)

    def step_wait(self) -> RowSteps:
        """Step all worlds; return the rows' observations, rewards, done flags and infos.

        The policies in `others` choose the actions of their species.
        """
        if self._observations is None:
            raise NPAError("step needs worlds: call reset first")
        row_actions = np.split(self.taken_actions(), np.cumsum(self._counts)[:-1], axis=1)
        spaces = self.vector_env.single_action_spaces
        actions: dict[str, Any] = {
            name: rows.reshape(-1, *spaces[name].shape)
            for name, rows in zip(self.rows_of, row_actions, strict=True)
        }
        for name, policy in self.others.items():
            actions[name] = policy(self._observations[name])
        observed, rewards, terminations, truncations, infos = self.vector_env.step(actions)
        self._observations = observed
        live = {name: as_tensor(infos[name]["live"]) for name in self.rows_of}
        row_observations, row_rewards, ended, cut = on_host(
            torch.where(self._repeated(live)[..., None], self._rows(observed), 0.0),
            self._repeated(rewards), self._repeated(terminations), self._repeated(truncations),
        )  # fmt: skip
        done = ended | cut
        first = infos[self.rows_of[0]]
        if "final_obs" in first:
            (restarted,) = on_host(first["_final_obs"])
            done |= restarted[:, None]
        rows, entries = np.flatnonzero(done), {}
        if len(rows):
            last = {name: infos[name].get("final_obs", observed[name]) for name in self.rows_of}
            entries["terminal_observation"] = self._row_observations(last)[rows]
            entries["TimeLimit.truncated"] = (cut & ~ended).reshape(-1)[rows].tolist()
        return (
            row_observations.reshape(self.num_envs, -1),
            row_rewards.reshape(-1),
            done.reshape(-1),
            self.infos(rows, entries),
        )

    def _row_observations(self, observations: Any) -> Any:
        return on_host(self._rows(observations))[0].reshape(self.num_envs, -1)

    def policy(self, model: Any, species: str, *, deterministic: bool = False) -> RowPolicy:
        """Return a model that was trained on these rows as the policy of one species.

        Args:
            model: The model.
            species: Name of the species, or particle, one of `rows_of`.
            deterministic: Whether it acts by its mean instead of a random action.
        """
        check_known("species must be one whose particles are rows, got", species, self.rows_of)
        tag = None
        if self._tags is not None:
            tag = self._tag_of[self.rows_of.index(species)]
        return RowPolicy(model, deterministic=deterministic, tag=tag)

    def _rows(self, by_species: Mapping[str, Any]) -> Tensor:
        """Return the rows' observations [B, R, P]; tags are appended if all species are rows."""
        parts = (as_tensor(by_species[name]) for name in self.rows_of)
        # Observations of particles have no dimension of rows.
        rows = torch.cat([part.view(len(part), -1, part.shape[-1]) for part in parts], dim=1)
        if self._tags is None:
            return rows
        return torch.cat((rows, self._tags.to(rows.device).expand(len(rows), -1, -1)), dim=2)

    def _repeated(self, by_species: Mapping[str, Any]) -> Tensor:
        """Repeat each species' values, [B], for its particles: R in each of B worlds, [B, R]."""
        values = [as_tensor(by_species[name]) for name in self.rows_of]
        return torch.cat(
            [value[:, None].expand(-1, n) for value, n in zip(values, self._counts, strict=True)],
            dim=1,
        )
