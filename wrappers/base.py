"""Base classes and functions of wrappers and adapters; `ParticleRows`, a row for each particle."""

from __future__ import annotations

from abc import abstractmethod
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeVar

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Space
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.envs.core.base import per_world
from npa_envs.envs.core.single import NPAEnv
from npa_envs.envs.core.vector import AUTORESET_MODES, BatchedSpaces, NPAVectorEnv
from npa_envs.errors import NPAError, shown

if TYPE_CHECKING:
    AnyWrapper = gymnasium.Wrapper[Any, Any, Any, Any]
    AnyObservationWrapper = gymnasium.ObservationWrapper[Any, Any, Any]
    AnyVectorEnv = VectorEnv[Any, Any, Any]
    AnyVectorWrapper = VectorWrapper[Any, Any, Any, Any, Any]
else:
    # Older releases of Gymnasium have no type parameters.
    AnyWrapper, AnyObservationWrapper = gymnasium.Wrapper, gymnasium.ObservationWrapper
    AnyVectorEnv, AnyVectorWrapper = VectorEnv, VectorWrapper


MAKE_VECTOR = "make it with gym.make_vec(..., vectorization_mode='vector_entry_point')"
"""How to make a vector environment, for error messages."""

BaseEnv = TypeVar("BaseEnv", bound=NPAEnv | NPAVectorEnv)

VectorStep = tuple[Any, Any, Any, Any, dict[str, Any]]
"""Observations, rewards, terminations, truncations and infos of a step of many worlds."""


def base_env(env: Any, wrapper: str, cls: type[BaseEnv]) -> BaseEnv:
    """Return the environment of class `cls` under all wrappers of `env`; errors name `wrapper`."""
    base = getattr(env, "unwrapped", None)
    if isinstance(base, cls):
        return base
    if cls is NPAEnv:
        what, hint = "an environment", "make one with gym.make('npa/...')"
        if isinstance(base, NPAVectorEnv):
            hint = f"use Vector{wrapper} for vector environments"
    else:
        what, hint = "a vector environment", MAKE_VECTOR
        if isinstance(base, NPAEnv) and wrapper.startswith("Vector"):
            hint = f"use {wrapper.removeprefix('Vector')} for a single environment"
    raise NPAError(f"env must be {what} of npa_envs, got {type(base).__name__}: {hint}")


def vector_env(env: Any, wrapper: str) -> NPAVectorEnv:
    """Return this package's vector environment under all wrappers; errors name `wrapper`."""
    return base_env(env, wrapper, NPAVectorEnv)


def torch_env(env: Any, adapter: str) -> NPAVectorEnv:
    """Unwrap a vector environment whose steps return new torch tensors; errors name `adapter`."""
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


def autoreset_mode(env: AnyVectorEnv) -> AutoresetMode:
    """Return a vector environment's autoreset mode."""
    return AutoresetMode(env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP))


RESTARTS = {
    "same-step": "restart worlds in the step that ends their episodes",
    "next-step": "restart worlds in the step after the last one",
    "disabled": "leave restarts to the adapter",
}
"""What environments of each autoreset mode do."""


def check_autoreset(mode: AutoresetMode, name: str, made: str = "") -> None:
    """Check that an environment's autoreset mode is the one called `name`; errors advise `made`."""
    if mode is not AUTORESET_MODES[name]:
        hint = f"make it with {made}autoreset_mode={shown(name)}"
        raise NPAError(f"env must {RESTARTS[name]}, got {mode}: {hint}")


def as_tensor(values: Any) -> Tensor:
    """Return an array or tensor as a tensor, without a copy."""
    return values if isinstance(values, Tensor) else torch.from_numpy(np.asarray(values))


def to_host(values: Any) -> NDArray[Any]:
    """Return an array or tensor as an array; waits for the device."""
    return values.cpu().numpy() if isinstance(values, Tensor) else np.asarray(values)


def check_tensor(values: Any, wrapper: str) -> None:
    """Check that `values`, which an environment returned to a wrapper, are a tensor."""
    if not isinstance(values, Tensor):
        raise NPAError(
            f"{wrapper} needs torch tensors, got {type(values).__name__}: make the environment "
            f"with output='torch', or use gymnasium.wrappers.vector.{wrapper.removeprefix('Torch')}"
        )


def world_indices(mask: NDArray[np.bool_], device: torch.device) -> Tensor:
    """Return the indices of the B' worlds at which a mask [B] is True, int64, shape [B']."""
    return torch.from_numpy(np.flatnonzero(mask)).to(device)


def own_rewards(infos: dict[str, Any]) -> Any:
    """Return each particle's reward of the last step, shape [B, N]; None if rewards are of worlds.

    With same-step autoreset the rewards of worlds that restarted are taken from `final_info`.
    """
    rewards = infos.get("particle_reward")
    last = infos.get("final_info", {}).get("particle_reward")
    if rewards is None or last is None:
        return last if rewards is None else rewards
    which = as_tensor(infos["_final_info"])[:, None]
    return torch.where(which, as_tensor(last), as_tensor(rewards))


def row_space(space: Any) -> Box:
    """Return the space of a row, which is one particle's, for a world's space of shape [N, ...]."""
    if not isinstance(space, Box) or len(space.shape) < 2:
        raise NPAError(
            "rows need an environment that gives and takes one for each particle, got the space "
            f"{shown(space)}: gardens and shapeshifters are for wrappers of worlds, such as "
            "WorldVecEnv"
        )
    return Box(space.low[0], space.high[0], dtype=np.float32)


def check_row_actions(actions: Any, *shape: int) -> None:
    """Raise NPAError if `actions` have another shape: they could be read as those of other rows."""
    if tuple(np.shape(actions)) != shape:
        raise NPAError(
            f"actions must have shape [rows, A] = {shape}, got {tuple(np.shape(actions))}: "
            "one for each row"
        )


class ParticleRowsBase:
    """Base class of adapters in which each particle is a row: w N + i is particle i of world w.

    A row's reward is its particle's if the environment has those, else its world's.
    """

    num_envs: int

    def set_env(self, env: Any, base: NPAVectorEnv, mode: str) -> None:
        """Set the environment whose particles are rows, and check its autoreset mode.

        `base` is the one under its wrappers; `mode` is the mode's name.
        """
        check_autoreset(autoreset_mode(env), mode)
        self.vector_env = env
        self.world_count = base.num_envs
        self.particle_count = base.config.particle_count
        """Particles N of a world."""
        self.num_envs = self.world_count * self.particle_count

    def step_worlds(self, actions: Any) -> VectorStep:
        """Step all worlds by actions [B N, A]; return rows' results [B N, ...] and the infos."""
        check_row_actions(actions, self.num_envs, *self.vector_env.single_action_space.shape[1:])
        by_world = actions.reshape(self.world_count, self.particle_count, -1)
        observations, rewards, ended, cut, infos = self.vector_env.step(by_world)
        by_particle = own_rewards(infos)
        rewards = self.spread(rewards) if by_particle is None else by_particle.reshape(-1)
        rows = observations.reshape(self.num_envs, -1)
        return rows, rewards, self.spread(ended), self.spread(cut), infos

    def spread(self, values: Any) -> Any:
        """Repeat the value of each world, [B], for its N rows, shape [B N]."""
        if isinstance(values, Tensor):
            return values.repeat_interleave(self.particle_count, output_size=self.num_envs)
        return np.repeat(values, self.particle_count)


class ParticleRows(ParticleRowsBase, BatchedSpaces):
    """The particles of a vector environment as the rows of another one, with NumPy arrays.

    Row w N + i is particle i of world w: it observes that particle's perception, shape [P], gives
    its action, shape [A], and gets its own reward where the environment was made with
    `reward="particle"`, else its world's. The particles of a world begin and end their episodes
    together, and a new one begins in the step after (next-step autoreset).

    For libraries that train one policy on the rows of any Gymnasium vector environment. Infos are
    empty.

    Args:
        env: A vector environment of this package, wrapped or not, with next-step autoreset.
    """

    # Gymnasium closes deleted objects, also if the constructor failed and nothing is open.
    closed = True

    def __init__(self, env: AnyVectorEnv) -> None:
        self.set_env(env, vector_env(env, type(self).__name__), "next-step")
        self.metadata = env.metadata
        self.render_mode = env.render_mode
        self.single_observation_space = row_space(env.single_observation_space)
        self.single_action_space = row_space(env.single_action_space)
        self.closed = False

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start episodes in all worlds; return the rows' observations, [B N, P], and no infos.

        World w begins the sequence of `seed` + w; None: each world's next episode. `options` are
        not used, as rows cannot restart without the others of their world.
        """
        observations, _ = self.vector_env.reset(seed=seed)
        return to_host(observations).reshape(self.num_envs, -1), {}

    def step(self, actions: Any) -> VectorStep:
        """Step all worlds by actions [B N, A]; return the rows' results and no infos.

        Raises NPAError for actions of a wrong shape, and DivergedError for actions that are not
        finite; the worlds then stay as they are.
        """
        rows, rewards, ended, cut, _ = self.step_worlds(actions)
        return to_host(rows), to_host(rewards).astype(np.float64), to_host(ended), to_host(cut), {}

    def render(self) -> Any:
        """Return the environment's pictures of the worlds."""
        return self.vector_env.render()

    def close_extras(self, **kwargs: Any) -> None:
        """Close the environment."""
        self.vector_env.close(**kwargs)


class EpisodeClock:
    """Counts steps of each world of a vector environment, and notes restarts, on the CPU.

    With `AutoresetMode.SAME_STEP` it waits for the device only in steps in which episodes end.
    """

    def __init__(self, env: AnyVectorEnv) -> None:
        mode = autoreset_mode(env)
        self.same_step = mode is AutoresetMode.SAME_STEP
        """Whether worlds restart in the step that ends their episodes."""
        self._next_step = mode is AutoresetMode.NEXT_STEP
        self.elapsed = np.zeros(env.num_envs, dtype=np.int64)
        """Steps since the start of the running episode, shape [B]."""
        self.lengths = np.zeros_like(self.elapsed)
        """Length, after the last step, of the episode that the step belonged to, shape [B]."""
        self.ended = np.zeros(env.num_envs, dtype=bool)
        """Whether the last step ended an episode, shape [B]."""
        self.restarted = np.zeros_like(self.ended)
        """Whether the last observation is the first of an episode, shape [B]."""
        self.observed = np.ones_like(self.ended)
        """Whether the last observation is new, shape [B]; a reset of other worlds repeats it."""

    def reset(self, options: dict[str, Any] | None) -> None:
        """Restart the counters of the worlds in `options["reset_mask"]`, by default of all."""
        mask = None if options is None else options.get("reset_mask")
        self.restarted = np.ones_like(self.ended) if mask is None else to_host(mask).copy()
        self.observed = self.restarted
        self.elapsed = np.where(self.restarted, 0, self.elapsed)
        self.lengths = self.elapsed.copy()
        self.ended = self.ended & ~self.restarted

    def step(self, terminations: Any, truncations: Any, infos: dict[str, Any]) -> None:
        """Count a step, which returned these flags, arrays or tensors [B], and infos."""
        self.observed = np.ones_like(self.ended)
        self.restarted = self.ended if self._next_step else np.zeros_like(self.ended)
        self.lengths = np.where(self.restarted, 0, self.elapsed + 1)
        self.elapsed = self.lengths.copy()
        if self.same_step and "final_obs" not in infos:
            self.ended = np.zeros_like(self.ended)
            return
        self.ended = to_host(terminations | truncations).copy()
        if self.same_step:
            self.restarted = self.ended
            self.elapsed[self.ended] = 0


class ChangesObservations:
    """Mixin of wrappers that change observations, of one world or many."""

    def update(self, observations: Any) -> None:
        """Add new observations, [N, P] or [B', N, P], to the wrapper's statistics."""

    @abstractmethod
    def changed(self, observations: Any) -> Any:
        """Return observations of the environment, [N, P] or [B, N, P], changed by the wrapper."""


class Observations(ChangesObservations, AnyObservationWrapper):
    """Base class of wrappers that change the observations of one world."""

    def observation(self, observation: Any) -> Any:
        """Update the statistics with an observation and return it changed; Gymnasium calls it."""
        self.update(observation)
        return self.changed(observation)


class EpisodeWrapper(AnyVectorWrapper):
    """Base of vector wrappers: override `after_reset` and `after_step`; `clock` counts steps."""

    def __init__(self, env: AnyVectorEnv) -> None:
        if not isinstance(env, VectorEnv):
            raise NPAError(
                f"{type(self).__name__} needs a vector environment, got {type(env).__name__}: "
                f"{MAKE_VECTOR}"
            )
        super().__init__(env)
        self.clock = EpisodeClock(env)
        """Step counts and restarts of the worlds."""

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start episodes; return the environment's results, changed by `after_reset`."""
        # A copy, as wrappers of Gymnasium remove the mask from the dict.
        observations, infos = self.env.reset(seed=seed, options=options and dict(options))
        self.clock.reset(options)
        return self.after_reset(observations, infos)

    def step(self, actions: Any) -> VectorStep:
        """Step all worlds; return the environment's results, changed by `after_step`."""
        outcome: VectorStep = self.env.step(actions)
        self.clock.step(*outcome[2:])
        return self.after_step(outcome)

    @abstractmethod
    def after_reset(self, observations: Any, infos: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        """Return observations and infos of a reset as the wrapper changes them.

        `clock` has counted the reset already.
        """

    @abstractmethod
    def after_step(self, outcome: VectorStep) -> VectorStep:
        """Return the results of a step, `outcome` of the environment, as the wrapper changes them.

        `clock` has counted the step already.
        """


class RewardSums(EpisodeWrapper):
    """Base class of wrappers that sum the rewards of each running episode."""

    gamma = 1.0
    """Factor on the sum in each step (dimensionless)."""

    sums: Tensor | None = None
    """Sums of the rewards of the running episodes, float64, shape [B]; None before a step."""

    @abstractmethod
    def use_sums(self, rewards: Tensor, sums: Tensor) -> tuple[Tensor, dict[str, Any]]:
        """Return the wrapper's rewards [B] of a step, and entries that its infos get.

        `sums` [B] include the step's rewards; those of episodes that ended are not reset yet.
        """

    def after_reset(self, observations: Any, infos: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        """Set the sums of rewards of worlds that restarted to 0; return the arguments unchanged."""
        self.reset_sums(self.clock.restarted)
        return observations, infos

    def after_step(self, outcome: VectorStep) -> VectorStep:
        """Add a step's rewards to the sums; return it with the rewards and infos of `use_sums`."""
        observations, rewards, terminations, truncations, infos = outcome
        check_tensor(rewards, type(self).__name__)
        sums = rewards.double()
        if self.sums is not None:
            sums = self.sums * self.gamma + sums
        self.sums = sums
        rewards, entries = self.use_sums(rewards, sums)
        # With next-step autoreset the step that restarts belongs to no episode.
        self.reset_sums(self.clock.restarted)
        return observations, rewards, terminations, truncations, infos | entries

    def reset_sums(self, worlds: NDArray[np.bool_]) -> None:
        """Set the sums of the worlds at which a mask [B] is True to zero."""
        if self.sums is not None and worlds.any():
            self.sums = self.sums.index_fill(0, world_indices(worlds, self.sums.device), 0.0)


class VectorObservations(ChangesObservations, EpisodeWrapper):
    """Base class of wrappers that change observations of many worlds, final ones included."""

    @cached_property
    def observation_space(self) -> Space[Any]:  # type: ignore[override]
        """Space of all worlds' observations, made at the first use as it is large."""
        return batch_space(self.single_observation_space, self.num_envs)

    def after_reset(self, observations: Any, infos: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        """Return the changed observations of a reset, and its infos."""
        return self._updated(observations), infos

    def after_step(self, outcome: VectorStep) -> VectorStep:
        """Return a step's results with its observations and final observations changed."""
        observations, rewards, terminations, truncations, infos = outcome
        observations = self._updated(observations)
        if "final_obs" in infos:
            infos = infos | {"final_obs": self._changed_last(infos["final_obs"])}
        return observations, rewards, terminations, truncations, infos

    def _changed_last(self, last: Any) -> Any:
        """Return last observations changed; arrays of worlds are objects, as environments' are."""
        if isinstance(last, Tensor) or last.dtype != object:
            return self.changed(last)
        which = np.array([one is not None for one in last])
        some = last[which.argmax()]
        return per_world(self.changed(np.stack([some if w is None else w for w in last])), which)

    def _updated(self, observations: Any) -> Any:
        """Update the statistics with the new observations, and return all observations, changed."""
        observed: Any = self.clock.observed
        if observed.all():
            self.update(observations)
        else:
            if isinstance(observations, Tensor):
                observed = world_indices(observed, observations.device)
            self.update(observations[observed])
        return self.changed(observations)


class WrapperBase(RecordConstructorArgs):
    """First base class of wrappers that exist twice: for one world, and as "Vector..." for many.

    It checks the class of the environment, and records `arguments` for the environment's spec.
    """

    def __init__(self, env: Any, **arguments: Any) -> None:
        self.many = isinstance(self, EpisodeWrapper)
        cls: Any = NPAVectorEnv if self.many else NPAEnv
        self._base: Any = base_env(env, type(self).__name__, cls)
        RecordConstructorArgs.__init__(self, **arguments)
        # The next class in the method resolution order is Gymnasium's wrapper.
        super(RecordConstructorArgs, self).__init__(env)  # type: ignore[call-arg]
        self.space_name = "single_observation_space" if self.many else "observation_space"
        """Name of the space of one world's observations."""
