"""Perception brought to one scale, group by group, alike for all particles."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.utils import RecordConstructorArgs
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.tasks.checks import is_real
from npa_envs.world.actions import Physics
from npa_envs.wrappers.base import (
    AnyVectorEnv,
    AnyWrapper,
    VectorObservations,
    single_env,
    vector_env,
)
from npa_envs.wrappers.statistics import RunningMoments, as_tensor, like

DEFAULT_CLIP, DEFAULT_EPSILON = 10.0, 1e-8


class PerceptionStatistics:
    """Running statistics of perception vectors z = [s; s̄; L(∇s); L(∇ρ)].

    There is one scale for each channel of the states, the smoothed states and the state gradients,
    and one for the density gradient, each shared by all particles. States are centred as well.
    Gradients are not, and the components of one have one scale, so that directions stay what they
    are.

    Args:
        physics: The constants of the world that is perceived.
        clip: What is normalised is clipped to plus and minus this (dimensionless).
        epsilon: Added to variances (dimensionless).

    Raises:
        NPAError: `clip` or `epsilon` is not finite or not positive.
    """

    def __init__(
        self, physics: Physics, *, clip: float = DEFAULT_CLIP, epsilon: float = DEFAULT_EPSILON
    ) -> None:
        for name, value in (("clip", clip), ("epsilon", epsilon)):
            if not is_real(value) or value <= 0:
                raise NPAError(f"{name} must be a finite number greater than 0, got {value!r}")
        self.clip, self.epsilon = float(clip), float(epsilon)
        self.space_dim, self.state_dim = physics.space_dim, physics.state_dim
        self.perception_dim = physics.perception_dim
        self.moments = RunningMoments(3 * self.state_dim + 1)
        """Of the states, smoothed states, state gradients (C each) and the density gradient."""

    def update(self, observation: Any) -> None:
        """Take in what particles perceive.

        Args:
            observation: Array or tensor of shape [..., P].
        """
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
        """Return perception on one scale, clipped, as new float32 numbers.

        Args:
            observation: Array or tensor of shape [..., P].
        """
        z = as_tensor(observation)
        mean = self._spread(self.moments.mean).to(z)
        scale = self._spread((self.moments.var + self.epsilon).rsqrt()).to(z)
        return like(((z - mean) * scale).clamp_(-self.clip, self.clip), observation)

    def space(self, space: Box) -> Box:
        """Return the space of normalised observations.

        Args:
            space: The space of the observations as they are.

        Raises:
            NPAError: It holds more than perception.
        """
        if len(space.shape) != 2 or space.shape[1] != self.perception_dim:
            raise NPAError(
                f"observations must be perception vectors, shape [N, {self.perception_dim}], got "
                f"shape {space.shape}: normalise before other wrappers change them"
            )
        return Box(-self.clip, self.clip, space.shape, np.float32)

    def _spread(self, statistics: Tensor) -> Tensor:
        """Return the number of each entry of a perception vector, shape [P]."""
        centred = 2 * self.state_dim
        gradients = statistics[centred:].repeat_interleave(self.space_dim)
        return torch.cat((statistics[:centred], gradients))


def shared_or_new(
    statistics: PerceptionStatistics | None,
    physics: Physics,
    clip: float | None,
    epsilon: float | None,
) -> PerceptionStatistics:
    """Return the given statistics, or new ones.

    Args:
        statistics: Those of another wrapper, or None.
        physics: The constants of the world that is perceived.
        clip: That of the new ones; None: the default.
        epsilon: Likewise.

    Raises:
        NPAError: There are statistics and other numbers beside them, or a number is wrong.
    """
    named = (("clip", clip), ("epsilon", epsilon))
    given = {name: value for name, value in named if value is not None}
    if statistics is None:
        return PerceptionStatistics(physics, **given)
    if not isinstance(statistics, PerceptionStatistics):
        raise NPAError(
            f"statistics must be those of another wrapper, got {type(statistics).__name__}: "
            "give wrapper.statistics, or load a state with load_state_dict"
        )
    for name, value in given.items():
        raise NPAError(
            f"{name} belongs to statistics, which has {getattr(statistics, name):g}, got "
            f"{value!r} as well: leave {name} out"
        )
    return statistics


def checked_training(training: bool) -> bool:
    """Return whether statistics go on, which must be said by a bool."""
    if not isinstance(training, bool | np.bool_):
        raise NPAError(f"training must be True or False, got {training!r}")
    return bool(training)


def recorded(statistics: PerceptionStatistics, training: bool) -> dict[str, Any]:
    """Return the arguments from which a wrapper alike, with new statistics, can be made."""
    return {"clip": statistics.clip, "epsilon": statistics.epsilon, "training": training}


class KeepsStatistics:
    """What both wrappers offer for saving and loading their statistics."""

    statistics: PerceptionStatistics
    """The running statistics."""

    def state_dict(self) -> dict[str, Tensor]:
        """Return the statistics, for `torch.save` or safetensors."""
        return self.statistics.moments.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Take over the statistics of another wrapper.

        Args:
            state: What its `state_dict` returned.

        Raises:
            NPAError: It belongs to other observations.
        """
        self.statistics.moments.load_state_dict(state)


class NormalizePerception(KeepsStatistics, AnyWrapper, RecordConstructorArgs):
    """Bring perception to one scale, by running statistics.

    The environment's spec holds how, and not the statistics: save those with `state_dict`.

    Args:
        env: An environment of this package.
        clip: What is normalised is clipped to plus and minus this (dimensionless); None: to 10, or
            as `statistics` has it.
        epsilon: Added to variances (dimensionless); None: 1e-8, or as `statistics` has it.
        training: Whether the statistics follow what is seen.
        statistics: Those of another wrapper, to share; None makes new ones.

    Raises:
        NPAError: The environment or a number is wrong, or `clip` or `epsilon` is given although
            `statistics` has its own.

    Attributes:
        training: Whether the statistics follow what is seen; set it to False to freeze them.
        statistics: The running statistics.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        *,
        clip: float | None = None,
        epsilon: float | None = None,
        training: bool = True,
        statistics: PerceptionStatistics | None = None,
    ) -> None:
        physics = single_env(env, type(self).__name__).worlds.physics
        self.statistics = shared_or_new(statistics, physics, clip, epsilon)
        RecordConstructorArgs.__init__(self, **recorded(self.statistics, training))
        super().__init__(env)
        self.training = checked_training(training)
        assert isinstance(env.observation_space, Box), "environments of this package have boxes"
        self.observation_space = self.statistics.space(env.observation_space)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode; as for the environment itself."""
        observation, info = self.env.reset(seed=seed, options=options)
        return self._normalized(observation), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step; as for the environment itself."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self._normalized(observation), reward, terminated, truncated, info

    def _normalized(self, observation: Any) -> Any:
        if self.training:
            self.statistics.update(observation)
        return self.statistics.normalize(observation)


class VectorNormalizePerception(KeepsStatistics, VectorObservations, RecordConstructorArgs):
    """`NormalizePerception` for vector environments, of NumPy arrays or tensors on a device.

    Final observations are normalised and not counted, nor are those of worlds that a reset leaves
    alone. Nothing waits for the device.

    Args:
        env: A vector environment of this package.
        clip: What is normalised is clipped to plus and minus this (dimensionless); None: to 10, or
            as `statistics` has it.
        epsilon: Added to variances (dimensionless); None: 1e-8, or as `statistics` has it.
        training: Whether the statistics follow what is seen.
        statistics: Those of another wrapper, to share; None makes new ones.

    Raises:
        NPAError: The environment or a number is wrong, or `clip` or `epsilon` is given although
            `statistics` has its own.

    Attributes:
        training: Whether the statistics follow what is seen; set it to False to freeze them.
        statistics: The running statistics.
    """

    def __init__(
        self,
        env: AnyVectorEnv,
        *,
        clip: float | None = None,
        epsilon: float | None = None,
        training: bool = True,
        statistics: PerceptionStatistics | None = None,
    ) -> None:
        physics = vector_env(env, type(self).__name__).worlds.physics
        self.statistics = shared_or_new(statistics, physics, clip, epsilon)
        RecordConstructorArgs.__init__(self, **recorded(self.statistics, training))
        super().__init__(env)
        self.training = checked_training(training)
        assert isinstance(env.single_observation_space, Box), "ours are boxes"
        self.single_observation_space = self.statistics.space(env.single_observation_space)

    def observations(self, observations: Any) -> Any:
        """Return observations normalised, and count them while training."""
        if self.training:
            self.statistics.update(self.new_ones(observations))
        return self.statistics.normalize(observations)

    def final_observations(self, observations: Any) -> Any:
        """Return observations normalised."""
        return self.statistics.normalize(observations)
