"""Wrappers with running statistics of perception, observations, rewards and episodes.

"Torch..." wrappers are those of `gymnasium.wrappers.vector` for tensors on a device, with all three
autoreset modes.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.checks import is_real, is_whole
from npa_envs.errors import NPAError, shown, suggest
from npa_envs.world.actions import Physics
from npa_envs.wrappers.base import (
    AnyVectorEnv,
    EpisodeWrapper,
    Observations,
    VectorObservations,
    VectorStep,
    WrapperBase,
    as_tensor,
    autoreset_mode,
    check_vector_env,
    like,
    world_indices,
)

PRIOR_COUNT = 1e-4
"""Weight, in samples, of the initial mean 0 and variance 1, as in Gymnasium."""


class RunningMoments:
    """Mean and variance of all samples so far, float64, without synchronising."""

    def __init__(self, *shape: int) -> None:
        self.mean = torch.zeros(shape, dtype=torch.float64)
        self.var = torch.ones(shape, dtype=torch.float64)
        self.count = PRIOR_COUNT

    def update(self, mean: Tensor, var: Tensor, count: int) -> None:
        """Add a batch of samples by its mean, biased variance and count; takes its device."""
        old_mean, old_var = self.mean.to(mean.device), self.var.to(mean.device)
        total = self.count + count
        delta = mean.double() - old_mean
        self.mean = old_mean + delta * (count / total)
        spread = old_var * self.count + var.double() * count
        self.var = (spread + delta.square() * (self.count * count / total)) / total
        self.count = total

    def state_dict(self) -> dict[str, Tensor]:
        """Return mean, variance and count, float64, on the CPU."""
        count = torch.tensor(self.count, dtype=torch.float64)
        return {"mean": self.mean.cpu().clone(), "var": self.var.cpu().clone(), "count": count}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Set the state that `state_dict` returned."""
        wanted = {"mean": self.mean.shape, "var": self.var.shape, "count": torch.Size()}
        for name in state.keys() ^ wanted.keys():
            fault = "unknown" if name in state else "missing"
            raise NPAError(f"{fault} statistic {shown(name)}: {suggest(name, wanted)}")
        given = {name: torch.as_tensor(state[name], dtype=torch.float64) for name in wanted}
        for name, shape in wanted.items():
            if given[name].shape != shape:
                raise NPAError(
                    f"{name} must have shape {tuple(shape)}, got {tuple(given[name].shape)}: "
                    "load the statistics of an environment with the same observations"
                )
        self.mean, self.var = given["mean"].clone(), given["var"].clone()
        self.count = float(given["count"])


DEFAULT_CLIP, DEFAULT_EPSILON = 10.0, 1e-8


class PerceptionStatistics:
    """Running statistics of perception vectors z = [s; s̄; L(∇s); L(∇ρ)].

    There is one scale for each channel of the states, the smoothed states and the state gradients,
    and one for the density gradient, each shared by all particles. States are centred as well.
    Gradients are not, and the components of one have one scale, so that directions stay what they
    are.
    """

    def __init__(
        self, physics: Physics, *, clip: float = DEFAULT_CLIP, epsilon: float = DEFAULT_EPSILON
    ) -> None:
        self.clip, self.epsilon = above_zero("clip", clip), above_zero("epsilon", epsilon)
        self.space_dim, self.state_dim = physics.space_dim, physics.state_dim
        self.perception_dim = physics.perception_dim
        self.moments = RunningMoments(3 * self.state_dim + 1)
        """Of the states, smoothed states, state gradients (C each) and the density gradient."""

    def update(self, observation: Any) -> None:
        """Take in what particles perceive, an array or tensor of shape [..., P]."""
        z = as_tensor(observation).flatten(0, -2)
        var, mean = torch.var_mean(z, dim=0, correction=0)
        centred = 2 * self.state_dim
        # About zero, which is the mean of a direction that the world does not prefer.
        square = (var + mean.square())[centred:]
        gradients = square[: -self.space_dim].view(self.state_dim, self.space_dim).mean(dim=1)
        density = square[-self.space_dim :].mean(dim=0, keepdim=True)
        self.moments.update(
            torch.cat((mean[:centred], torch.zeros_like(square[: self.state_dim + 1]))),
            torch.cat((var[:centred], gradients, density)),
            len(z),
        )

    def normalize(self, observation: Any) -> Any:
        """Return perception, shape [..., P], normalised and clipped, as new float32 values."""
        z = as_tensor(observation)
        mean = self._spread(self.moments.mean).to(z)
        scale = self._spread((self.moments.var + self.epsilon).rsqrt()).to(z)
        return like(((z - mean) * scale).clamp_(-self.clip, self.clip), observation)

    def space(self, space: Any) -> Box:
        """Return the space of normalised observations for a space of observations."""
        shape = (*(space.shape or ()),)
        if len(shape) != 2 or shape[1] != self.perception_dim:
            raise NPAError(
                f"observations must be perception vectors, shape [N, {self.perception_dim}], got "
                f"shape {shape}: normalise before other wrappers change them"
            )
        return Box(-self.clip, self.clip, shape, np.float32)

    def _spread(self, statistics: Tensor) -> Tensor:
        """Expand statistics to the entries of a perception vector, shape [P]."""
        centred = 2 * self.state_dim
        gradients = statistics[centred:].repeat_interleave(self.space_dim)
        return torch.cat((statistics[:centred], gradients))


class _NormalizesPerception(WrapperBase):
    """Mixin that normalises perception by its statistics, for one world or many."""

    statistics: PerceptionStatistics
    training: bool
    new_observations: Callable[[Any], Any]

    def __init__(
        self,
        env: Any,
        *,
        clip: float | None = None,
        epsilon: float | None = None,
        training: bool = True,
        statistics: PerceptionStatistics | None = None,
    ) -> None:
        base, named = self.base_of(env), (("clip", clip), ("epsilon", epsilon))
        given = {name: value for name, value in named if value is not None}
        if statistics is None:
            statistics = PerceptionStatistics(base.worlds.physics, **given)
        elif not isinstance(statistics, PerceptionStatistics):
            raise NPAError(
                f"statistics must be those of another wrapper, got {type(statistics).__name__}: "
                "give wrapper.statistics, or load a state with load_state_dict"
            )
        elif given:
            name, value = next(iter(given.items()))
            raise NPAError(
                f"{name} belongs to statistics, which has {getattr(statistics, name):g}, got "
                f"{shown(value)} as well: leave {name} out"
            )
        if not isinstance(training, bool | np.bool_):
            raise NPAError(f"training must be True or False, got {shown(training)}")
        super().__init__(env, clip=statistics.clip, epsilon=statistics.epsilon, training=training)
        self.statistics, self.training = statistics, bool(training)
        setattr(self, self.space_name, statistics.space(getattr(env, self.space_name)))

    def state_dict(self) -> dict[str, Tensor]:
        """Return the statistics, for `torch.save` or safetensors."""
        return self.statistics.moments.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Set the statistics that another wrapper's `state_dict` returned."""
        self.statistics.moments.load_state_dict(state)

    def observations(self, observations: Any) -> Any:
        """Return observations normalised; while training, first add new ones to the statistics."""
        if self.training:
            self.statistics.update(self.new_observations(observations))
        return self.statistics.normalize(observations)

    def final_observations(self, observations: Any) -> Any:
        """Return observations normalised."""
        return self.statistics.normalize(observations)


class NormalizePerception(_NormalizesPerception, Observations):
    """Normalise perception by running statistics that all particles share.

    The environment's spec has the arguments, not the statistics: save those with `state_dict`.

    Args:
        env: An environment of this package.
        clip: Normalised values are clipped to plus and minus this (dimensionless); None: 10, or
            that of `statistics`.
        epsilon: Added to variances (dimensionless); None: 1e-8, or that of `statistics`.
        training: Whether new observations update the statistics.
        statistics: Those of another wrapper, to share; None: new ones.

    Raises:
        NPAError: The environment or a number is wrong, or `clip` or `epsilon` is given although
            `statistics` has its own.

    Attributes:
        training: Whether new observations update the statistics; set it to False to freeze them.
        statistics: The running statistics.
    """


class VectorNormalizePerception(_NormalizesPerception, VectorObservations):
    """`NormalizePerception` for vector environments, of NumPy arrays or tensors on a device.

    Final observations are normalised and not counted, nor are repeated ones after a reset of some
    worlds. Nothing synchronises. Arguments, errors and attributes are those of
    `NormalizePerception`, except `env`, a vector environment of this package.
    """


class TorchRecordEpisodeStatistics(EpisodeWrapper):
    """Keep track of returns and lengths of episodes.

    A step in which episodes end has `infos["episode"]` with the tensors `r` (returns), `l` (lengths
    in steps) and `t` (time [s]), shape [B], 0 for the other worlds, and `infos["_episode"]`, True
    where an episode ended.

    Args:
        env: A vector environment with torch tensors.
        buffer_length: Episodes in the queues.
        stats_key: The key in `infos`.

    Raises:
        NPAError: `env` is no vector environment, or `buffer_length` no whole number of at least 1.
    """

    def __init__(
        self, env: AnyVectorEnv, buffer_length: int = 100, stats_key: str = "episode"
    ) -> None:
        check_vector_env(env, type(self).__name__)
        super().__init__(env)
        if not is_whole(buffer_length) or not 1 <= buffer_length < 2**31:
            raise NPAError(
                "buffer_length must be a whole number of at least 1 and below 2^31, got "
                f"{shown(buffer_length)}"
            )
        self._key = stats_key
        self.episode_count = 0
        """Episodes that have ended."""
        self.episode_returns: Tensor | None = None
        """Sum of the rewards of each running episode, float64, shape [B]."""
        self.length_queue: deque[int] = deque(maxlen=buffer_length)
        """Lengths of the last episodes [steps]."""
        self.time_queue: deque[float] = deque(maxlen=buffer_length)
        """Times that the last episodes took [s]."""
        self._returns: deque[float] = deque(maxlen=buffer_length)
        # On the device until they are read; each entry has at least one episode.
        self._unread: deque[Tensor] = deque(maxlen=buffer_length)
        self._began = np.full(env.num_envs, time.perf_counter())

    @property
    def return_queue(self) -> deque[float]:
        """Returns of the last episodes; reading it synchronises."""
        if self._unread:
            self._returns.extend(torch.cat(tuple(self._unread)).tolist())
            self._unread.clear()
        return self._returns

    def after_reset(self, observations: Any, infos: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        """Set the sums of new episodes to zero."""
        self._restart(self.clock.restarted)
        return observations, infos

    def after_step(self, outcome: VectorStep) -> VectorStep:
        """Sum the rewards, and report the episodes that ended."""
        observations, rewards, terminations, truncations, infos = outcome
        check_tensor(rewards, type(self).__name__)
        returns = rewards.double()
        if self.episode_returns is not None:
            returns = self.episode_returns + returns
        self.episode_returns = returns
        if self.clock.ended.any():
            infos = infos | self._ended(returns, rewards.device)
        # With next-step autoreset the step that restarts belongs to no episode.
        self._restart(self.clock.restarted)
        return observations, rewards, terminations, truncations, infos

    def _ended(self, returns: Tensor, device: torch.device) -> dict[str, Any]:
        ended, lengths = self.clock.ended, self.clock.lengths
        seconds = np.where(ended, np.round(time.perf_counter() - self._began, 6), 0.0)
        mask = torch.from_numpy(ended).to(device)
        self.episode_count += int(ended.sum())
        self.length_queue.extend(lengths[ended].tolist())
        self.time_queue.extend(seconds[ended].tolist())
        self._unread.append(returns[world_indices(ended, device)])
        episode = {
            "r": torch.where(mask, returns, 0.0),
            "l": torch.from_numpy(np.where(ended, lengths, 0)).to(device),
            "t": torch.from_numpy(seconds).to(device),
        }
        return {self._key: episode, f"_{self._key}": mask}

    def _restart(self, worlds: NDArray[np.bool_]) -> None:
        self._began[worlds] = time.perf_counter()
        self.episode_returns = forgotten(self.episode_returns, worlds)


class TorchNormalizeObservation(VectorObservations):
    """Centre each entry of the observations and scale it to unit variance, by running statistics.

    As in Gymnasium each particle has its own statistics; `VectorNormalizePerception` shares them.
    Final observations are normalised and not counted, nor are repeated ones after a reset of some
    worlds.

    Args:
        env: A vector environment with torch tensors.
        epsilon: Added to variances (dimensionless).

    Raises:
        NPAError: `epsilon` is not finite or not positive.
    """

    def __init__(self, env: AnyVectorEnv, epsilon: float = 1e-8) -> None:
        check_vector_env(env, type(self).__name__)
        super().__init__(env)
        self.epsilon = above_zero("epsilon", epsilon)
        shape = env.single_observation_space.shape
        assert shape is not None, "only arrays can be normalised"
        self.single_observation_space = Box(-np.inf, np.inf, shape, np.float32)
        self.obs_rms = RunningMoments(*shape)
        """Running mean and variance of each entry."""
        self.update_running_mean = True
        """Whether new observations update the statistics."""

    def observations(self, observations: Any) -> Any:
        """Return observations normalised, and count them unless frozen."""
        check_tensor(observations, type(self).__name__)
        if self.update_running_mean:
            new = self.new_observations(observations)
            var, mean = torch.var_mean(new, dim=0, correction=0)
            self.obs_rms.update(mean, var, len(new))
        return self.final_observations(observations)

    def final_observations(self, observations: Any) -> Any:
        """Return observations normalised."""
        scale = (self.obs_rms.var + self.epsilon).rsqrt().to(observations)
        return (observations - self.obs_rms.mean.to(observations)) * scale


class TorchNormalizeReward(EpisodeWrapper):
    """Divide rewards by the running standard deviation of the discounted return.

    The return restarts at zero with each episode.

    Args:
        env: A vector environment with torch tensors.
        gamma: Discount of the return, in [0, 1] (dimensionless).
        epsilon: Added to the variance (dimensionless).

    Raises:
        NPAError: `gamma` is not in [0, 1], or `epsilon` is not finite or not positive.
    """

    def __init__(self, env: AnyVectorEnv, gamma: float = 0.99, epsilon: float = 1e-8) -> None:
        check_vector_env(env, type(self).__name__)
        super().__init__(env)
        if not is_real(gamma) or not 0.0 <= gamma <= 1.0:
            raise NPAError(f"gamma must lie in [0, 1], got {shown(gamma)}: try 0.99")
        self.gamma, self.epsilon = gamma, above_zero("epsilon", epsilon)
        self.return_rms = RunningMoments()
        """Running mean and variance of the discounted return."""
        self.accumulated_reward: Tensor | None = None
        """Discounted return of each running episode, float64, shape [B]."""
        self.update_running_mean = True
        """Whether new rewards update the statistics."""
        self._same_step = autoreset_mode(env) is AutoresetMode.SAME_STEP

    def after_reset(self, observations: Any, infos: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        """Set the returns of new episodes to zero."""
        self.accumulated_reward = forgotten(self.accumulated_reward, self.clock.restarted)
        return observations, infos

    def after_step(self, outcome: VectorStep) -> VectorStep:
        """Return rewards divided by the standard deviation of the discounted return."""
        observations, rewards, terminations, truncations, infos = outcome
        check_tensor(rewards, type(self).__name__)
        clock = self.clock
        before = self.accumulated_reward
        returns = rewards.double() if before is None else before * self.gamma + rewards.double()
        counted = returns
        if not self._same_step and clock.restarted.any():
            # With next-step autoreset the step that restarts belongs to no episode.
            counted = returns[world_indices(~clock.restarted, returns.device)]
        if self.update_running_mean and len(counted):
            var, mean = torch.var_mean(counted, dim=0, correction=0)
            self.return_rms.update(mean, var, len(counted))
        self.accumulated_reward = forgotten(returns, clock.restarted)
        scale = (self.return_rms.var + self.epsilon).rsqrt().to(rewards)
        return observations, rewards * scale, terminations, truncations, infos


def forgotten(sums: Tensor | None, worlds: NDArray[np.bool_]) -> Tensor | None:
    """Return sums of each world, shape [B], set to 0 in some of them."""
    if sums is None or not worlds.any():
        return sums
    return sums.index_fill(0, world_indices(worlds, sums.device), 0.0)


def check_tensor(values: Any, wrapper: str) -> None:
    """Check that an environment returned a tensor to a wrapper."""
    if not isinstance(values, Tensor):
        raise NPAError(
            f"{wrapper} needs torch tensors, got {type(values).__name__}: make the environment "
            f"with output='torch', or use gymnasium.wrappers.vector.{wrapper.removeprefix('Torch')}"
        )


def above_zero(name: str, value: float) -> float:
    """Return the argument of this name, checked: finite and greater than 0."""
    if not is_real(value) or value <= 0:
        raise NPAError(f"{name} must be a finite number greater than 0, got {shown(value)}")
    return float(value)
