"""What a step of a batch of worlds returns: rewards, losses and endings."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from npa_envs.envs.core.task import EnvTask, checked_tensor
from npa_envs.world.environment_steps import DIVERGED, SUCCESS, TIME_LIMIT, world_mean
from npa_envs.world.particles import Particles

FLAG_ROWS = 5
"""Rows of flags in a report: the four of `StepReport.endings`, and `all_worlds`."""


def total(terms: Tensor) -> Tensor:
    """Return the sum of the terms of a loss, [terms, B], in their order.

    `torch.sum` may add in another order, which depends on the number of worlds.
    """
    return functools.reduce(torch.add, terms.unbind())


def named_terms(prefix: str, names: tuple[str, ...], rows: Any) -> dict[str, Any]:
    """Return rows, one for each term of a loss, by their names in infos: `prefix_name`."""
    return {f"{prefix}_{name}": row for name, row in zip(names, rows, strict=True)}


def reason(ending: int) -> str | None:
    """Return `info["reason"]` for the flags of an ending; None if the episode goes on."""
    names = {DIVERGED: "diverged", SUCCESS: "success", TIME_LIMIT: "time limit"}
    return next((name for bit, name in names.items() if ending & bit), None)


class StepReport(NamedTuple):
    """Rewards, losses and flags of each world, as views of one buffer that is copied at once."""

    buffer: Tensor
    """The memory of the fields below, uint8."""
    numbers: Tensor
    """The rows of the next four fields, float32, shape [2 + 2 terms, B]."""
    reward: Tensor
    """Rewards of the last step, shape [B]."""
    loss: Tensor
    """Losses, shape [B]."""
    terms: Tensor
    """The terms of each loss, shape [terms, B]."""
    improvements: Tensor
    """Decrease of each term of the loss in the last step, shape [terms, B]."""
    endings: Tensor
    """Terminated, truncated, success, diverged, bool, shape [4, B]."""
    all_worlds: Tensor
    """True for every world, bool, shape [B]: the mask of infos that all worlds have."""

    @classmethod
    def empty(cls, world_count: int, term_count: int, device: torch.device) -> StepReport:
        """Return a `StepReport` of zeros, for B worlds whose loss has some terms."""
        rows = 4 * (2 + 2 * term_count) + FLAG_ROWS
        buffer = torch.zeros(rows * world_count, dtype=torch.uint8, device=device)
        report = cls.from_buffer(buffer, world_count)
        report.all_worlds.fill_(True)
        return report

    @classmethod
    def from_buffer(cls, buffer: Tensor, world_count: int) -> StepReport:
        """Return a `StepReport` whose tensors are views of `buffer`, uint8."""
        numbers, flags = buffer.view(-1, world_count).tensor_split((-FLAG_ROWS,))
        numbers = numbers.flatten().view(torch.float32).view(-1, world_count)
        flags = flags.view(torch.bool)
        terms, improvements = numbers[2:].chunk(2)
        rows = (numbers[0], numbers[1], terms, improvements)
        return cls(buffer, numbers, *rows, flags[:-1], flags[-1])

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        # Unpickled views would not share the buffer's memory.
        return StepReport.from_buffer, (self.buffer, len(self.all_worlds))

    def copy(self) -> StepReport:
        """Return a copy of the report, which later steps do not overwrite."""
        return self.from_buffer(self.buffer.clone(), len(self.all_worlds))


class ParticleRewards:
    """Rewards of single particles: the decrease of their own losses, or their marginal gains."""

    def __init__(self, particles: Particles, *, by_loss: bool) -> None:
        self.reward = torch.zeros_like(particles.x[..., 0])
        """Each particle's reward of the last step, shape [B, N]."""
        self.loss = torch.zeros_like(self.reward) if by_loss else None
        """Each particle's loss, shape [B, N]; None for marginal gains."""
        self._before = particles if by_loss else particles.map(torch.clone)

    def place(self, worlds: Tensor, task: EnvTask[Any], particles: Particles) -> None:
        """Store the new particles of the worlds of indices `worlds`, int64 [B']; rewards are 0."""
        self.reward.index_fill_(0, worlds, 0.0)
        if self.loss is None:
            self._before.put_(worlds, particles)
        else:
            self.loss[worlds] = self._losses(task, particles)

    def gains(self, task: EnvTask[Any], particles: Particles) -> Tensor:
        """Return what each particle gained in a step, [B, N]; store these particles."""
        if self.loss is None:
            gains = task.particle_gains(self._before[:2], particles[:2])
            gains = checked_tensor(task, "particle_gains", "gains", gains, self.reward.shape)
            self._before.copy_(particles)
            return gains
        losses = self._losses(task, particles)
        gains = self.loss - losses
        self.loss.copy_(losses)
        return gains

    def write(self, gains: Tensor, reward: Tensor, by_world: Tensor, enabled: Tensor) -> None:
        """Write the rewards of a step from `gains`, [B, N], and the worlds' rewards, [B].

        Particles of worlds in `by_world`, bool [B], get the world's reward. Nothing changes unless
        `enabled`, uint8 [1].
        """
        if self.loss is None:
            # The same for all, so that a world's mean is its reward.
            missed = reward - world_mean(gains[..., None])[:, 0]
            gains = gains + missed[:, None]
        rewards = torch.where(by_world[:, None], reward[:, None], gains)
        self.reward.copy_(torch.where(enabled.bool(), rewards, self.reward))

    def _losses(self, task: EnvTask[Any], particles: Particles) -> Tensor:
        losses = task.particle_losses(particles.x, particles.s)
        return checked_tensor(task, "particle_losses", "losses", losses, particles.x.shape[:2])
