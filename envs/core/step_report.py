"""Episodes of a batch of worlds, and what a step reports: rewards, losses and endings."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from npa_envs.checks import checked_tensor
from npa_envs.world.cuda_graph import makes_plain_tensors, pinned_like
from npa_envs.world.environment_steps import (
    DIVERGED,
    SUCCESS,
    TIME_LIMIT,
    EpisodeRules,
    EpisodeUpdate,
    world_mean,
)
from npa_envs.world.particles import Particles

if TYPE_CHECKING:
    from npa_envs.envs.core.task import EnvTask

FLAG_ROWS = 2
"""Rows of a report's buffer, float32, whose bytes are the eight rows of `StepReport.flags`."""

TRUE_ROW = 4
"""Row of `StepReport.flags` that is always True."""


def total(terms: Tensor) -> Tensor:
    """Return the sum of the terms, [terms, B], in their order; that of `torch.sum` depends on B."""
    return functools.reduce(torch.add, terms.unbind())


def named_terms(prefix: str, names: tuple[str, ...], rows: Any) -> dict[str, Any]:
    """Return the row of each term of a loss by its name in infos, `prefix_name`."""
    return {f"{prefix}_{name}": row for name, row in zip(names, rows, strict=True)}


def reason(ending: int) -> str | None:
    """Return `info["reason"]` for bits such as `SUCCESS`; None for 0, an episode that continues."""
    names = {DIVERGED: "diverged", SUCCESS: "success", TIME_LIMIT: "time limit"}
    return next((name for bit, name in names.items() if ending & bit), None)


class StepNumbers(NamedTuple):
    """Reward and losses after a step: tensors or arrays [B], or numbers of a single world."""

    reward: Any
    """Reward of the last step."""
    loss: Any
    """Loss after it."""
    terms: Any
    """The terms of the loss, one row per term."""
    improvements: Any
    """Decrease of each term in the last step, one row per term."""

    @classmethod
    def from_rows(cls, rows: Any) -> StepNumbers:
        """Return by name the rows of `StepReport.numbers`, or of one of its columns."""
        term_count = len(rows) // 2 - 1
        return cls(rows[0], rows[1], rows[2 : 2 + term_count], rows[2 + term_count :])


class StepReport(NamedTuple):
    """Rewards, losses and flags of B worlds after a step: views of one buffer, to copy at once."""

    buffer: Tensor
    """The memory of the fields below, float32, shape [rows, B]."""
    numbers: Tensor
    """Reward, loss, its terms and their decreases, float32, shape [2 + 2 terms, B]."""
    flags: Tensor
    """Terminated, truncated, success, diverged, True, and unused rows, bool, shape [8, B]."""
    named: StepNumbers
    """The rows of `numbers` by name."""

    @classmethod
    def empty(cls, world_count: int, term_count: int, device: torch.device) -> StepReport:
        """Return a `StepReport` of zeros for B worlds; their loss has `term_count` terms."""
        rows = 2 + 2 * term_count + FLAG_ROWS
        report = cls.from_buffer(torch.zeros(rows, world_count, device=device, dtype=torch.float32))
        report.flags[TRUE_ROW].fill_(True)
        return report

    @classmethod
    def from_buffer(cls, buffer: Tensor) -> StepReport:
        """Return a `StepReport` whose tensors are views of `buffer`, float32."""
        flags = buffer[-FLAG_ROWS:].view(torch.bool).view(-1, buffer.shape[1])
        numbers = buffer[:-FLAG_ROWS]
        return cls(buffer, numbers, flags, StepNumbers.from_rows(numbers))

    @property
    def end_flags(self) -> Tensor:
        """Terminated, truncated, success, diverged, bool, shape [4, B]."""
        return self.flags[:TRUE_ROW]

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        # Unpickled views would not share the buffer's memory.
        return StepReport.from_buffer, (self.buffer,)

    def copy(self) -> StepReport:
        """Return a copy of the report, which later steps do not overwrite."""
        return self.from_buffer(self.buffer.clone())


class WorldEpisodes:
    """Current episodes of B worlds: their steps, losses, rewards and endings, also on the host.

    After a step `update` computes them. It reads `enabled`, uint8 [1]: whether the step was made;
    and `diverged`, uint8 [B]: in which worlds it diverged.
    """

    def __init__(self, rules: EpisodeRules, enabled: Tensor, diverged: Tensor) -> None:
        self._rules, self._enabled, self._diverged = rules, enabled, diverged
        self.elapsed = torch.zeros_like(diverged, dtype=torch.int32)
        """Steps since the start of each episode, shape [B]."""
        self._start_loss = torch.zeros_like(diverged, dtype=torch.float32)
        self._success_loss = torch.zeros_like(self._start_loss)
        # Each world's ending, then `enabled`.
        self._ending_bits = diverged.new_zeros(len(diverged) + 1)
        self.term_names: tuple[str, ...] = ()
        """Names of the terms of the loss, known once worlds have been placed."""
        self.report = StepReport.empty(len(diverged), 0, diverged.device)
        """What a step returns apart from the observation."""
        self.can_succeed = False
        """Whether any episode so far had a loss at which it succeeds."""
        self._attach()

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | dict.fromkeys(("update", "host_ending_bits", "host_numbers"))

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._attach()

    @makes_plain_tensors
    def _attach(self) -> None:
        """Make `update` and the host's copies for the tensors of the current `report`."""
        read = (self._ending_bits, self.report.numbers)
        self.host_ending_bits, self.host_numbers = (
            map(pinned_like, read) if self._ending_bits.is_cuda else read
        )
        self.update = EpisodeUpdate(
            self._rules,
            enabled=self._enabled,
            diverged=self._diverged,
            first_loss=self._start_loss,
            success_loss=self._success_loss,
            elapsed=self.elapsed,
            numbers=self.report.numbers,
            flags=self.report.end_flags,
            ending_bits=self._ending_bits,
        )

    def put_losses(self, world_indices: Tensor, names: tuple[str, ...], terms: Tensor) -> None:
        """Store the named terms, [terms, B'], of losses of replaced worlds, and rewards of 0."""
        if not self.term_names:
            self.term_names = names
            self.report = StepReport.empty(len(self.elapsed), len(names), terms.device)
            self._attach()
        zeros = torch.zeros_like(terms)
        numbers = torch.cat((zeros[:1], total(terms)[None], terms, zeros))
        self.report.numbers.index_copy_(1, world_indices, numbers)
        self.report.end_flags.index_fill_(1, world_indices, False)

    def begin(self, world_indices: Tensor, success_loss: Tensor | None) -> None:
        """Begin episodes of worlds, int64 [B'], to succeed at `success_loss`, [B']; None: never."""
        self.elapsed.index_fill_(0, world_indices, 0)
        self._start_loss[world_indices] = self.report.named.loss[world_indices]
        self.can_succeed |= success_loss is not None
        if success_loss is None:
            self._success_loss.index_fill_(0, world_indices, -torch.inf)
        else:
            self._success_loss[world_indices] = success_loss

    @contextlib.contextmanager
    def continued(self, world_indices: Tensor) -> Iterator[None]:
        """Keep steps, rewards and endings while the `with` block restarts worlds, int64 [B']."""
        before, elapsed = self.report.copy(), self.elapsed.clone()
        yield
        self.elapsed.copy_(elapsed)
        now, earlier = self.report.named, before.named
        now.reward[world_indices] = earlier.reward[world_indices]
        now.improvements[:, world_indices] = earlier.improvements[:, world_indices]
        self.report.end_flags.copy_(before.end_flags)
        if len(self.elapsed) == 1:
            # The host reads the numbers of a single world only; this synchronises.
            self.host_numbers.copy_(self.report.numbers)

    def copy_to_host(self) -> None:
        """Begin to copy endings, and the numbers of a single world, to the host."""
        if self._ending_bits.is_cuda:
            self.host_ending_bits.copy_(self._ending_bits, non_blocking=True)
            if len(self.elapsed) == 1:
                self.host_numbers.copy_(self.report.numbers, non_blocking=True)


class ParticleRewards:
    """Base class: a reward for each particle; a step calls `gains`, then `write`."""

    loss: Tensor | None = None
    """Each particle's loss, shape [B, N], if it is stored."""

    def __init__(self, particles: Particles) -> None:
        self.reward = torch.zeros_like(particles.x[..., 0])
        """Each particle's reward of the last step, shape [B, N]."""

    def place(self, world_indices: Tensor, task: EnvTask[Any], placed: Particles) -> None:
        """Set rewards to 0 in worlds, [B'], with new particles `placed`; `task` has their goals."""
        self.reward.index_fill_(0, world_indices, 0.0)

    def gains(self, task: EnvTask[Any], particles: Particles) -> Tensor:
        """Return each particle's reward of a step, [B, N], for `write`; `particles`: after it."""
        raise NotImplementedError

    def write(self, gains: Tensor, reward: Tensor, by_world: Tensor, enabled: Tensor) -> None:
        """Store `gains`, [B, N], as the particles' rewards of a step.

        In worlds of `by_world`, bool [B], each particle gets the world's `reward`, [B], instead.
        Nothing is stored if `enabled`, uint8 [1], is 0.
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
        """Return each particle's reward, the decrease of its loss, [B, N]; store the new losses."""
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
        """Return each particle's reward, the task's `particle_gains`, [B, N]; store `particles`."""
        gains = task.particle_gains(self._before[:2], particles[:2])
        gains = checked_tensor(task, "particle_gains", "gains", gains, self.reward.shape)
        self._before.copy_(particles)
        return gains

    def write(self, gains: Tensor, reward: Tensor, by_world: Tensor, enabled: Tensor) -> None:
        """Store rewards: `gains` plus a number for each world, so that their mean is its reward."""
        missed = reward - world_mean(gains[..., None])[:, 0]
        super().write(gains + missed[:, None], reward, by_world, enabled)


class RewardKind(NamedTuple):
    """What a value of `reward=` rewards, and when."""

    last_step_only: bool
    """True: minus the loss, in the last step of an episode; False: its decrease, in each step."""
    particle_rewards: type[ParticleRewards] | None
    """What computes rewards of single particles; None: only worlds are rewarded."""


REWARDS = {
    "dense": RewardKind(last_step_only=False, particle_rewards=None),
    "sparse": RewardKind(last_step_only=True, particle_rewards=None),
    "particle": RewardKind(last_step_only=False, particle_rewards=LossDecreases),
    "marginal": RewardKind(last_step_only=False, particle_rewards=MarginalGains),
}
"""Values of `reward=` in environments of one species; the docstring of `NPAEnv` explains each."""
PARTICLE_REWARDS = tuple(word for word, kind in REWARDS.items() if kind.particle_rewards)
"""Values of `reward=` that reward single particles."""
