"""Base classes and functions of wrappers and adapters."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Space
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.envs.core.single import NPAEnv
from npa_envs.envs.core.vector import AUTORESET_MODES, NPAVectorEnv
from npa_envs.errors import NPAError, shown

if TYPE_CHECKING:
    AnyWrapper = gymnasium.Wrapper[Any, Any, Any, Any]
    AnyVectorEnv = VectorEnv[Any, Any, Any]
    AnyVectorWrapper = VectorWrapper[Any, Any, Any, Any, Any]
else:
    # Older releases of Gymnasium have no type parameters.
    AnyWrapper, AnyVectorEnv, AnyVectorWrapper = gymnasium.Wrapper, VectorEnv, VectorWrapper


MAKE_VECTOR = "make it with gym.make_vec(..., vectorization_mode='vector_entry_point')"
"""How to make a vector environment, for error messages."""

VectorStep = tuple[Any, Any, Any, Any, dict[str, Any]]
"""Observations, rewards, terminations, truncations and infos of a step of many worlds."""


def single_env(env: Any, wrapper: str) -> NPAEnv:
    """Return this package's environment below wrappers; `wrapper` is named in errors."""
    base = getattr(env, "unwrapped", None)
    if isinstance(base, NPAEnv):
        return base
    cure = "make one with gym.make('npa/...')"
    if isinstance(base, NPAVectorEnv):
        cure = f"use Vector{wrapper} for vector environments"
    raise NPAError(f"env must be an environment of npa_envs, got {type(base).__name__}: {cure}")


def vector_env(env: Any, wrapper: str) -> NPAVectorEnv:
    """Return this package's vector environment below wrappers; `wrapper` is named in errors."""
    base = getattr(env, "unwrapped", None)
    if isinstance(base, NPAVectorEnv):
        return base
    cure = MAKE_VECTOR
    if isinstance(base, NPAEnv) and wrapper.startswith("Vector"):
        cure = f"use {wrapper.removeprefix('Vector')} for a single environment"
    raise NPAError(
        f"env must be a vector environment of npa_envs, got {type(base).__name__}: {cure}"
    )


def torch_env(env: Any, adapter: str) -> NPAVectorEnv:
    """Return this package's vector environment with tensors that an adapter can keep."""
    base = vector_env(env, adapter)
    if base.config.output != "torch":
        raise NPAError(
            f"{adapter} needs torch tensors, got output={shown(base.config.output)}: "
            "make the environment with output='torch'"
        )
    if not base.copies:
        raise NPAError(
            f"{adapter} needs new tensors in each step, got copy=False: "
            "make the environment with copy=True, the default"
        )
    return base


def check_vector_env(env: Any, wrapper: str) -> None:
    """Check that a wrapper's argument is a Gymnasium vector environment."""
    if not isinstance(env, VectorEnv):
        raise NPAError(
            f"{wrapper} needs a vector environment, got {type(env).__name__}: {MAKE_VECTOR}"
        )


def check_untouched(env: Any, wrapper: str) -> None:
    """Check that the wrappers below do not change the observation space."""
    name = "single_observation_space" if isinstance(env, VectorEnv) else "observation_space"
    own, given = getattr(env, name), getattr(env.unwrapped, name)
    if own != given:
        raise NPAError(
            f"env must give observations as the environment makes them, {given}, got {own}: "
            f"put {wrapper} under the wrappers that change observations"
        )


def autoreset_mode(env: AnyVectorEnv) -> AutoresetMode:
    """Return a vector environment's autoreset mode."""
    return AutoresetMode(env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP))


def check_autoreset(mode: AutoresetMode, word: str, rule: str) -> None:
    """Check that an environment has the autoreset mode of this name; `rule` explains it."""
    if mode is not AUTORESET_MODES[word]:
        raise NPAError(f"env must {rule}, got {mode}: make it with autoreset_mode={shown(word)}")


def check_same_step(mode: AutoresetMode) -> None:
    """Check that worlds restart in the step that ends their episodes."""
    check_autoreset(mode, "same-step", "restart worlds in the step that ends their episodes")


def as_tensor(values: Any) -> Tensor:
    """Return an array or tensor as a tensor, without a copy."""
    return values if isinstance(values, Tensor) else torch.from_numpy(np.asarray(values))


def like(result: Tensor, values: Any) -> Any:
    """Return a tensor in the type of `values`: array or tensor."""
    return result if isinstance(values, Tensor) else result.numpy()


def to_host(values: Any) -> NDArray[Any]:
    """Return an array or tensor as an array; synchronises with the device."""
    return values.cpu().numpy() if isinstance(values, Tensor) else np.asarray(values)


def world_indices(mask: NDArray[np.bool_], device: torch.device) -> Tensor:
    """Return the indices at which a mask, [B], is True, int64, shape [M]."""
    return torch.from_numpy(np.flatnonzero(mask)).to(device)


def own_rewards(infos: dict[str, Any]) -> Any:
    """Return each particle's reward of the last step, shape [B, N]; None without such rewards.

    With same-step autoreset the rewards of worlds that restarted are in their final infos.
    """
    rewards = infos.get("particle_reward")
    last = infos.get("final_info", {}).get("particle_reward")
    if rewards is None or last is None:
        return rewards
    which = as_tensor(infos["_final_info"])[:, None]
    return torch.where(which, as_tensor(last), as_tensor(rewards))


def row_space(space: Any) -> Box:
    """Return the space of one particle, from a world's box of shape [N, ...]."""
    if not isinstance(space, Box) or len(space.shape) < 2:
        raise NPAError(
            "rows need an environment that gives and takes one for each particle, got the space "
            f"{shown(space)}: gardens and shapeshifters are for wrappers of worlds, such as "
            "WorldVecEnv"
        )
    return Box(space.low[0], space.high[0], dtype=np.float32)


def check_row_actions(actions: Any, *wanted: int) -> None:
    """Check the shape of actions; a wrong one could be read as actions of other rows."""
    if tuple(np.shape(actions)) != wanted:
        raise NPAError(
            f"actions must have shape [rows, A] = {wanted}, got {tuple(np.shape(actions))}: "
            "one for each row"
        )


class ParticleRowsBase:
    """Base class of adapters whose row w N + i is particle i of world w of a vector environment.

    A row's reward is its particle's if there is one, else its world's.
    """

    num_envs: int

    def set_env(self, env: Any, base: NPAVectorEnv) -> None:
        """Set the environment whose particles are rows; `base` is the one below its wrappers."""
        self.vector_env = env
        """The environment whose particles these are."""
        self.world_count = base.num_envs
        """Worlds B."""
        self.particle_count = base.config.particle_count
        """Particles N of a world."""
        self.num_envs = self.world_count * self.particle_count

    def step_worlds(self, actions: Any) -> VectorStep:
        """Step all worlds by actions of rows, [B N, A]; return the rows' outcome, [B N, ...]."""
        check_row_actions(actions, self.num_envs, *self.vector_env.single_action_space.shape[1:])
        by_world = actions.reshape(self.world_count, self.particle_count, -1)
        observations, rewards, ended, cut, infos = self.vector_env.step(by_world)
        by_particle = own_rewards(infos)
        rewards = self.spread(rewards) if by_particle is None else by_particle.reshape(-1)
        rows = observations.reshape(self.num_envs, -1)
        return rows, rewards, self.spread(ended), self.spread(cut), infos

    def spread(self, values: Any) -> Any:
        """Repeat values of worlds, [B], for each of their rows, shape [B N]."""
        if isinstance(values, Tensor):
            return values.repeat_interleave(self.particle_count, output_size=self.num_envs)
        return np.repeat(values, self.particle_count)


class EpisodeClock:
    """Step counts and restarts of each world of a vector environment, on the host.

    With `AutoresetMode.SAME_STEP` it synchronises only in steps in which episodes end.
    """

    def __init__(self, env: AnyVectorEnv) -> None:
        self._mode = autoreset_mode(env)
        self.elapsed = np.zeros(env.num_envs, dtype=np.int64)
        """Steps since the start of the running episode, shape [B]."""
        self.lengths = np.zeros_like(self.elapsed)
        """Steps, after the last one, of the episode that it belonged to, shape [B]."""
        self.ended = np.zeros(env.num_envs, dtype=bool)
        """Whether the last step ended an episode, shape [B]."""
        self.restarted = np.zeros_like(self.ended)
        """Whether the last observation is the first of an episode, shape [B]."""
        self.observed = np.ones_like(self.ended)
        """Whether the last observation is new, shape [B]; not if a reset was of other worlds."""

    def reset(self, options: dict[str, Any] | None) -> None:
        """Restart the counters of the worlds in the option `reset_mask`; without it, of all."""
        mask = None if options is None else options.get("reset_mask")
        self.restarted = np.ones_like(self.ended) if mask is None else to_host(mask).copy()
        self.observed = self.restarted
        self.elapsed = np.where(self.restarted, 0, self.elapsed)
        self.lengths = self.elapsed.copy()
        self.ended = self.ended & ~self.restarted

    def step(self, terminations: Any, truncations: Any, infos: dict[str, Any]) -> None:
        """Update for a step with these results, arrays or tensors, shape [B]."""
        self.observed = np.ones_like(self.ended)
        next_step = self._mode is AutoresetMode.NEXT_STEP
        self.restarted = self.ended if next_step else np.zeros_like(self.ended)
        self.lengths = np.where(self.restarted, 0, self.elapsed + 1)
        self.elapsed = self.lengths.copy()
        same_step = self._mode is AutoresetMode.SAME_STEP
        if same_step and "final_obs" not in infos:
            self.ended = np.zeros_like(self.ended)
            return
        self.ended = to_host(terminations | truncations).copy()
        if same_step:
            self.restarted = self.ended
            self.elapsed[self.ended] = 0


class Observations(AnyWrapper):
    """Base class of wrappers that change the observations of one world."""

    restarted = False
    """Whether the last observation is the first of an episode."""

    @abstractmethod
    def observations(self, observations: Any) -> Any:
        """Return what the wrapper makes of a world's observation, shape [N, P]."""

    def new_observations(self, observations: Any) -> Any:
        """Return the observation, which is always new."""
        return observations

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode; as for the environment itself."""
        observation, info = self.env.reset(seed=seed, options=options)
        self.restarted = True
        return self.observations(observation), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step; as for the environment itself."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.restarted = False
        return self.observations(observation), reward, terminated, truncated, info


class EpisodeWrapper(AnyVectorWrapper):
    """Base class of wrappers of vector environments with an `EpisodeClock`."""

    def __init__(self, env: AnyVectorEnv) -> None:
        super().__init__(env)
        self.clock = EpisodeClock(env)
        """Step counts and restarts of the worlds."""

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start episodes; as for the environment itself."""
        # A copy, as wrappers of Gymnasium remove the mask from the dict.
        observations, infos = self.env.reset(seed=seed, options=options and dict(options))
        self.clock.reset(options)
        return self.after_reset(observations, infos)

    def step(self, actions: Any) -> VectorStep:
        """Step; as for the environment itself."""
        outcome: VectorStep = self.env.step(actions)
        self.clock.step(*outcome[2:])
        return self.after_step(outcome)

    @abstractmethod
    def after_reset(self, observations: Any, infos: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        """Return the results of a reset, after the clock's update."""

    @abstractmethod
    def after_step(self, outcome: VectorStep) -> VectorStep:
        """Return the results of a step, after the clock's update."""


class VectorObservations(EpisodeWrapper):
    """Base class of wrappers that change observations of many worlds, final ones included."""

    @property
    def observation_space(self) -> Space[Any]:
        """Space of all worlds' observations; large, so made at the first use."""
        if self._observation_space is None:
            self._observation_space = batch_space(self.single_observation_space, self.num_envs)
        return self._observation_space

    @observation_space.setter
    def observation_space(self, space: Space[Any]) -> None:
        self._observation_space = space

    def new_observations(self, observations: Any) -> Any:
        """Return the rows of observations, [B, N, P], that are new, [M, N, P]."""
        observed = self.clock.observed
        if observed.all():
            return observations
        if isinstance(observations, Tensor):
            return observations[world_indices(observed, observations.device)]
        return observations[observed]

    @abstractmethod
    def observations(self, observations: Any) -> Any:
        """Return the observations of all worlds, shape [B, N, P], changed."""

    @abstractmethod
    def final_observations(self, observations: Any) -> Any:
        """Return the final observations, [B, N, P], changed; called after `observations`."""

    def after_reset(self, observations: Any, infos: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        """Return changed observations and infos."""
        return self.observations(observations), infos

    def after_step(self, outcome: VectorStep) -> VectorStep:
        """Return changed observations, the final ones included, and the rest as it is."""
        observations, rewards, terminations, truncations, infos = outcome
        observations = self.observations(observations)
        if "final_obs" in infos:
            infos = infos | {"final_obs": self.final_observations(infos["final_obs"])}
        return observations, rewards, terminations, truncations, infos


class WrapperBase(RecordConstructorArgs):
    """Mixin of a wrapper of one world and of its vector form; their first base class."""

    def __init__(self, env: Any, **recorded: Any) -> None:
        self.many = isinstance(self, EpisodeWrapper)
        """Whether there are many worlds."""
        self._base = self.base_of(env)
        RecordConstructorArgs.__init__(self, **recorded)
        # The next class in the method resolution order is Gymnasium's wrapper.
        super(RecordConstructorArgs, self).__init__(env)  # type: ignore[call-arg]
        self.space_name = "single_observation_space" if self.many else "observation_space"
        """Name of the space of one world's observations."""

    def base_of(self, env: Any) -> Any:
        """Return this package's environment below wrappers, single or vector."""
        find = vector_env if isinstance(self, EpisodeWrapper) else single_env
        return find(env, type(self).__name__)

    @property
    def restarted_worlds(self) -> NDArray[np.bool_]:
        """Worlds whose last observation is the first of an episode, shape [B]."""
        mask: Any = self.clock.restarted if self.many else [self.restarted]  # type: ignore[attr-defined]
        return np.asarray(mask)
