"""Rewards of single particles: a class for each value of `reward=` that has them."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from npa_envs.envs.core.task import EnvTask, checked_tensor
from npa_envs.world.environment_steps import world_mean
from npa_envs.world.particles import Particles


class ParticleRewards:
    """Base class: rewards of the particles of B worlds; a step calls `gains`, then `write`."""

    loss: Tensor | None = None
    """Each particle's loss, shape [B, N], if it is stored."""

    def __init__(self, particles: Particles) -> None:
        self.reward = torch.zeros_like(particles.x[..., 0])
        """Each particle's reward of the last step, shape [B, N]."""

    def place(self, world_indices: Tensor, task: EnvTask[Any], placed: Particles) -> None:
        """Set rewards to 0 in worlds, int64 [B'], whose particles `placed` replaces."""
        self.reward.index_fill_(0, world_indices, 0.0)

    def gains(self, task: EnvTask[Any], particles: Particles) -> Tensor:
        """Return what each particle gained by the step that ended at `particles`, [B, N]."""
        raise NotImplementedError

    def write(self, gains: Tensor, reward: Tensor, by_world: Tensor, enabled: Tensor) -> None:
        """Write the rewards of a step from `gains`, [B, N], and the worlds' rewards, [B].

        Particles of worlds in `by_world`, bool [B], get the world's reward. Nothing changes unless
        `enabled`, uint8 [1].
        """
        rewards = torch.where(by_world[:, None], reward[:, None], gains)
        self.reward.copy_(torch.where(enabled.bool(), rewards, self.reward))


class LossDecreases(ParticleRewards):
    """`reward="particle"`: the decrease of each particle's own loss."""

    def __init__(self, particles: Particles) -> None:
        super().__init__(particles)
        self.loss: Tensor = torch.zeros_like(self.reward)

    def place(self, world_indices: Tensor, task: EnvTask[Any], placed: Particles) -> None:
        """Set rewards to 0, and store the losses of the placed particles."""
        super().place(world_indices, task, placed)
        self.loss[world_indices] = self._losses(task, placed)

    def gains(self, task: EnvTask[Any], particles: Particles) -> Tensor:
        """Return the decrease of each particle's loss, [B, N]; store the new losses."""
        losses = self._losses(task, particles)
        gains = self.loss - losses
        self.loss.copy_(losses)
        return gains

    def _losses(self, task: EnvTask[Any], particles: Particles) -> Tensor:
        losses = task.particle_losses(particles.x, particles.s)
        return checked_tensor(task, "particle_losses", "losses", losses, particles.x.shape[:2])


class MarginalGains(ParticleRewards):
    """`reward="marginal"`: what each particle's action contributed to the world's reward."""

    def __init__(self, particles: Particles) -> None:
        super().__init__(particles)
        self._before = particles.map(torch.clone)

    def place(self, world_indices: Tensor, task: EnvTask[Any], placed: Particles) -> None:
        """Set rewards to 0, and store the placed particles."""
        super().place(world_indices, task, placed)
        self._before.put_(world_indices, placed)

    def gains(self, task: EnvTask[Any], particles: Particles) -> Tensor:
        """Return the task's `particle_gains`, [B, N]; store the new particles."""
        gains = task.particle_gains(self._before[:2], particles[:2])
        gains = checked_tensor(task, "particle_gains", "gains", gains, self.reward.shape)
        self._before.copy_(particles)
        return gains

    def write(self, gains: Tensor, reward: Tensor, by_world: Tensor, enabled: Tensor) -> None:
        """Write gains, shifted by a constant in each world so that their mean is its reward."""
        missed = reward - world_mean(gains[..., None])[:, 0]
        super().write(gains + missed[:, None], reward, by_world, enabled)


PARTICLE_REWARDS: dict[str, type[ParticleRewards]] = {
    "particle": LossDecreases,
    "marginal": MarginalGains,
}
"""How single particles are rewarded, by `reward=`; "dense" and "sparse" reward worlds alone."""
