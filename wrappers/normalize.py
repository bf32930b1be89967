"""Wrappers that normalise perception, observations and rewards by running statistics.

"Torch..." wrappers are those of `gymnasium.wrappers.vector` for tensors on a device, with all three
autoreset modes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from torch import Tensor

from npa_envs.checks import checked_positive, is_real
from npa_envs.errors import NPAError, shown, suggest
from npa_envs.world.environment_steps import Physics
from npa_envs.wrappers.base import (
    AnyVectorEnv,
    Observations,
    RewardSums,
    VectorObservations,
    WrapperBase,
    as_tensor,
    check_tensor,
    world_indices,
)

PRIOR_COUNT = 1e-4
"""Weight, in samples, of the initial mean 0 and variance 1, as in Gymnasium."""


class RunningMoments:
    """Running mean and variance of samples, float64; nothing waits for the device."""

    def __init__(self, *shape: int) -> None:
        self.mean = torch.zeros(shape, dtype=torch.float64)
        self.var = torch.ones(shape, dtype=torch.float64)
        self.count = PRIOR_COUNT

    def update(self, mean: Tensor, var: Tensor, count: int) -> None:
        """Add a batch of `count` samples, given by its mean and biased variance.

        The statistics move to the batch's device.
        """
        old_mean, old_var = self.mean.to(mean.device), self.var.to(mean.device)
        total = self.count + count
        delta = mean.double() - old_mean
        self.mean = old_mean + delta * (count / total)
        spread = old_var * self.count + var.double() * count
        self.var = (spread + delta.square() * (self.count * count / total)) / total
        self.count = total

    def update_from(self, samples: Tensor) -> None:
        """Add a batch of samples, one for each index of dimension 0."""
        var, mean = torch.var_mean(samples, dim=0, correction=0)
        self.update(mean, var, len(samples))

    def state_dict(self) -> dict[str, Tensor]:
        """Return mean, variance and count, float64, on the CPU."""
        count = torch.tensor(self.count, dtype=torch.float64)
        return {"mean": self.mean.cpu().clone(), "var": self.var.cpu().clone(), "count": count}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Set mean, variance and count, as `state_dict` returned them."""
        expected = {"mean": self.mean.shape, "var": self.var.shape, "count": torch.Size()}
        for name in state.keys() ^ expected.keys():
            fault = "unknown" if name in state else "missing"
            raise NPAError(f"{fault} statistic {shown(name)}: {suggest(name, expected)}")
        values = {name: torch.as_tensor(state[name], dtype=torch.float64) for name in expected}
        for name, shape in expected.items():
            if values[name].shape != shape:
                raise NPAError(
                    f"{name} must have shape {tuple(shape)}, got {tuple(values[name].shape)}: "
                    "load the statistics of an environment with the same observations"
                )
        self.mean, self.var = values["mean"].clone(), values["var"].clone()
        self.count = float(values["count"])


class _PerceptionNormalizer(WrapperBase):
    """Mixin that normalises perception vectors z = [s; s̄; L(∇s); L(∇ρ)], of one world or many.

    There is one scale for each channel of the states, the smoothed states and the state gradients,
    and one for the density gradient, each shared by all particles. States are centred as well.
    Gradients are not, and the components of one have one scale, so that directions stay what they
    are.
    """

    def __init__(
        self, env: Any, *, clip: float = 10.0, epsilon: float = 1e-8, training: bool = True
    ) -> None:
        # A larger number is infinite in float32, the type of observations.
        self.clip = min(checked_positive("clip", clip), float(np.finfo(np.float32).max))
        self.epsilon = checked_positive("epsilon", epsilon)
        if not isinstance(training, bool | np.bool_):
            raise NPAError(f"training must be True or False, got {shown(training)}")
        super().__init__(env, clip=self.clip, epsilon=self.epsilon, training=training)
        self.training = bool(training)
        self._physics: Physics = self._base.worlds.physics
        # Of the states, smoothed states, state gradients (C each) and the density gradient.
        self.statistics = RunningMoments(3 * self._physics.state_dim + 1)
        shape: tuple[int, ...] = getattr(env, self.space_name).shape or ()
        expected = self._physics.perception_dim
        if len(shape) != 2 or shape[1] != expected:
            raise NPAError(
                f"observations must be perception vectors, shape [N, {expected}], got shape "
                f"{shape}: normalise before other wrappers change them"
            )
        setattr(self, self.space_name, Box(-self.clip, self.clip, shape, np.float32))

    def state_dict(self) -> dict[str, Tensor]:
        """Return the statistics, for `torch.save` or safetensors."""
        return self.statistics.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Set the statistics that another wrapper's `state_dict` returned."""
        self.statistics.load_state_dict(state)

    def update(self, observations: Any) -> None:
        """Add new observations, [N, P] or [B', N, P], to the statistics if `training` is True."""
        if not self.training:
            return
        z = as_tensor(observations).flatten(0, -2)
        var, mean = torch.var_mean(z, dim=0, correction=0)
        state_dim, space_dim = self._physics.state_dim, self._physics.space_dim
        centred = 2 * state_dim
        # About zero, which is the mean of a direction that the world does not prefer.
        square = (var + mean.square())[centred:]
        gradients = square[:-space_dim].view(state_dim, space_dim).mean(dim=1)
        density = square[-space_dim:].mean(dim=0, keepdim=True)
        self.statistics.update(
            torch.cat((mean[:centred], torch.zeros_like(square[: state_dim + 1]))),
            torch.cat((var[:centred], gradients, density)), len(z),
        )  # fmt: skip

    def changed(self, observations: Any) -> Any:
        """Return perception normalised and clipped, in new float32 arrays or tensors."""
        z = as_tensor(observations)
        mean = self._spread(self.statistics.mean).to(z)
        scale = self._spread((self.statistics.var + self.epsilon).rsqrt()).to(z)
        normal = ((z - mean) * scale).clamp_(-self.clip, self.clip)
        return normal if isinstance(observations, Tensor) else normal.numpy()

    def _spread(self, statistics: Tensor) -> Tensor:
        """Repeat statistics [3 C + 1], one for each gradient, for its D components: shape [P]."""
        centred = 2 * self._physics.state_dim
        gradients = statistics[centred:].repeat_interleave(self._physics.space_dim)
        return torch.cat((statistics[:centred], gradients))


class NormalizePerception(_PerceptionNormalizer, Observations):
    """Normalise perception by running statistics that all particles share.

    The environment's spec has the arguments, not the statistics: save those with `state_dict`.

    Args:
        env: An environment of this package.
        clip: Normalised values are clipped to plus and minus this (dimensionless).
        epsilon: Added to variances (dimensionless).
        training: Whether new observations update the statistics.

    Attributes:
        training: Whether new observations update the statistics; set it to False to freeze them.
        statistics: The running statistics; set it to those of another wrapper to share them.
    """


class VectorNormalizePerception(_PerceptionNormalizer, VectorObservations):
    """`NormalizePerception` for vector environments, of NumPy arrays or tensors on a device.

    Final observations are normalised and not counted, nor are repeated ones after a reset of some
    worlds. Nothing waits for the device. Arguments, errors and attributes are those of
    `NormalizePerception`, except `env`, a vector environment of this package.
    """


class TorchNormalizeObservation(VectorObservations):
    """Centre each entry of the observations and scale it to unit variance, by running statistics.

    As in Gymnasium each particle has its own statistics; `VectorNormalizePerception` shares them.
    Final observations are normalised and not counted, nor are repeated ones after a reset of some
    worlds.

    Args:
        env: A vector environment with torch tensors.
        epsilon: Added to variances (dimensionless).
    """

    def __init__(self, env: AnyVectorEnv, epsilon: float = 1e-8) -> None:
        super().__init__(env)
        self.epsilon = checked_positive("epsilon", epsilon)
        shape = env.single_observation_space.shape
        assert shape is not None, "only arrays can be normalised"
        self.single_observation_space = Box(-np.inf, np.inf, shape, np.float32)
        self.obs_rms = RunningMoments(*shape)
        """Running mean and variance of each entry."""
        self.update_running_mean = True
        """Whether new observations update the statistics."""

    def update(self, observations: Any) -> None:
        """Add new observations to the statistics if `update_running_mean` is True."""
        check_tensor(observations, type(self).__name__)
        if self.update_running_mean:
            self.obs_rms.update_from(observations)

    def changed(self, observations: Any) -> Any:
        """Return observations with mean subtracted, divided by the standard deviation."""
        scale = (self.obs_rms.var + self.epsilon).rsqrt().to(observations)
        return (observations - self.obs_rms.mean.to(observations)) * scale


class TorchNormalizeReward(RewardSums):
    """Divide rewards by the running standard deviation of the discounted return.

    The return restarts at zero with each episode.

    Args:
        env: A vector environment with torch tensors.
        gamma: Discount of the return, in [0, 1] (dimensionless).
        epsilon: Added to the variance (dimensionless).
    """

    def __init__(self, env: AnyVectorEnv, gamma: float = 0.99, epsilon: float = 1e-8) -> None:
        super().__init__(env)
        if not is_real(gamma) or not 0.0 <= gamma <= 1.0:
            raise NPAError(f"gamma must lie in [0, 1], got {shown(gamma)}: try 0.99")
        self.gamma, self.epsilon = gamma, checked_positive("epsilon", epsilon)
        self.return_rms = RunningMoments()
        """Running mean and variance of the discounted return."""
        self.update_running_mean = True
        """Whether new rewards update the statistics."""

    @property
    def accumulated_reward(self) -> Tensor | None:
        """Discounted return of each running episode, float64, shape [B]."""
        return self.sums

    def use_sums(self, rewards: Tensor, sums: Tensor) -> tuple[Tensor, dict[str, Any]]:
        """Return rewards [B] divided by the standard deviation of returns, and no infos."""
        restarted = self.clock.restarted
        if restarted.any() and not self.clock.same_step:
            # With next-step autoreset the step that restarts belongs to no episode.
            sums = sums[world_indices(~restarted, sums.device)]
        if self.update_running_mean and len(sums):
            self.return_rms.update_from(sums)
        return rewards * (self.return_rms.var + self.epsilon).rsqrt().to(rewards), {}
