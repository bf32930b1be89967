"""Losses, rewards and episode ends of a batch of worlds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from npa_envs.envs.core.config import EnvConfig
from npa_envs.envs.core.task import EnvTask, Start, check_finite, checked_losses, checked_tensor
from npa_envs.envs.core.world_state import WorldState
from npa_envs.errors import shown
from npa_envs.world.cuda_graph import makes_plain_tensors, pinned_like
from npa_envs.world.environment_steps import (
    DIVERGED,
    SUCCESS,
    TIME_LIMIT,
    EpisodeRules,
    EpisodeUpdate,
    with_mean_reward,
)
from npa_envs.world.particles import Particles

FLAGS = ("success", "diverged")
"""Names in `info` of the flags that are no part of what Gymnasium's `step` returns."""

FLAG_ROWS = 2 + len(FLAGS) + 1
"""Rows of flags in a report: terminated, truncated, `FLAGS`, and one that is always True."""


def total(parts: Tensor) -> Tensor:
    """Return the sum of the parts of a loss, [K, B], one after the other.

    `torch.sum` may add in another order, which depends on the number of worlds.
    """
    first, *rest = parts.unbind()
    for part in rest:
        first = first + part
    return first


def reason(ending: int) -> str | None:
    """Return `info["reason"]` of an ending, or None of an episode that goes on."""
    names = {DIVERGED: "diverged", SUCCESS: "success", TIME_LIMIT: "time limit"}
    return next((name for bit, name in names.items() if ending & bit), None)


class StepReport(NamedTuple):
    """Rewards, losses and flags of each world, as views of one buffer that is copied at once."""

    buffer: Tensor
    """The memory of the fields below, uint8."""
    numbers: Tensor
    """Reward, loss, its K parts, and each part's decrease in the last step, shape [2 + 2 K, B]."""
    endings: Tensor
    """Terminated, truncated, success, diverged, bool, shape [4, B]."""
    everyone: Tensor
    """True for every world, bool, shape [B]: the mask of infos that all worlds have."""

    @classmethod
    def empty(cls, world_count: int, part_count: int, device: torch.device) -> StepReport:
        """Return a report of zeros, of B worlds whose loss has K parts."""
        rows = 4 * (2 + 2 * part_count) + FLAG_ROWS
        buffer = torch.zeros(rows * world_count, dtype=torch.uint8, device=device)
        report = cls.from_buffer(buffer, world_count)
        report.everyone.fill_(True)
        return report

    @classmethod
    def from_buffer(cls, buffer: Tensor, world_count: int) -> StepReport:
        """Return a report whose tensors are views of a buffer."""
        numbers, flags = buffer.view(-1, world_count).tensor_split((-FLAG_ROWS,))
        numbers = numbers.flatten().view(torch.float32).view(-1, world_count)
        flags = flags.view(torch.bool)
        return cls(buffer, numbers, flags[:-1], flags[-1])

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        # Unpickled views would not share the buffer's memory.
        return StepReport.from_buffer, (self.buffer, len(self.everyone))

    def copy(self) -> StepReport:
        """Return a copy that later steps do not overwrite."""
        return self.from_buffer(self.buffer.clone(), len(self.everyone))

    @property
    def reward(self) -> Tensor:
        """Rewards of the last step, shape [B]."""
        return self.numbers[0]

    @property
    def loss(self) -> Tensor:
        """Losses, shape [B]."""
        return self.numbers[1]

    @property
    def parts(self) -> Tensor:
        """The parts of each loss, shape [K, B]."""
        return self.numbers[2 : 1 + len(self.numbers) // 2]

    @property
    def improvements(self) -> Tensor:
        """Decrease of each part of the loss in the last step, shape [K, B]."""
        return self.numbers[1 + len(self.numbers) // 2 :]


class ParticleRewards:
    """Rewards of single particles: the decrease of their own losses, or their marginal gains."""

    def __init__(self, particles: Particles, *, by_loss: bool) -> None:
        self.reward = torch.zeros_like(particles.x[..., 0])
        """Each particle's reward of the last step, shape [B, N]."""
        self.loss = torch.zeros_like(self.reward) if by_loss else None
        """Each particle's loss, shape [B, N]; None for marginal gains."""
        self._before = particles if by_loss else particles.map(torch.clone)

    def place(self, worlds: Tensor, task: EnvTask[Any], particles: Particles) -> None:
        """Begin with new particles in some worlds, int64, [M], which have no reward."""
        self.reward.index_fill_(0, worlds, 0.0)
        if self.loss is None:
            self._before.put_(worlds, particles)
        else:
            self.loss[worlds] = self._losses(task, particles)

    def gains(self, task: EnvTask[Any], particles: Particles) -> Tensor:
        """Return each particle's reward of a step, [B, N]; the next step counts from now."""
        if self.loss is None:
            gains = task.particle_gains(self._before[:2], particles[:2])
            gains = checked_tensor(task, "particle_gains", "gains", gains, self.reward.shape)
            self._before.copy_(particles)
            return gains
        losses = self._losses(task, particles)
        gains = self.loss - losses
        self.loss.copy_(losses)
        return gains

    def _losses(self, task: EnvTask[Any], particles: Particles) -> Tensor:
        losses = task.particle_losses(particles.x, particles.s)
        return checked_tensor(task, "particle_losses", "losses", losses, particles.x.shape[:2])


class RewardedWorlds(WorldState):
    """B worlds of one task with their losses, rewards and episode ends, in float32."""

    def __init__(
        self,
        task_type: type[EnvTask[Any]],
        config: EnvConfig,
        world_count: int,
        episode_steps: int | None = None,
    ) -> None:
        # Memory is checked before the task is made, which may make a target of as many points.
        extra, count = task_type.extra_bytes(config, world_count), config.particle_count
        super().__init__(config, task_type, world_count, count, extra)
        self.task: Any = task_type(config, self.device)
        self.episode_steps = episode_steps
        """Steps after which an episode is truncated; None: never."""

        def zeros(dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.zeros(world_count, dtype=dtype, device=self.device)

        self.elapsed = zeros(torch.int32)
        """Steps since the start of each episode, shape [B]."""
        self.particle_rewards: ParticleRewards | None = None
        """Rewards of single particles, where they have any."""
        if config.per_particle_reward:
            by_loss = config.reward == "particle"
            self.particle_rewards = ParticleRewards(self.particles, by_loss=by_loss)
        self.goal = zeros(torch.int64)
        """Index of each world's goal, shape [B]; zeros where the task has one goal."""
        self.goal_task: EnvTask[Any] = self.task.with_goal(self.goal)
        """The task with losses for the worlds' goals."""
        self._start_loss = zeros()
        self._success_loss = zeros()
        self.diverged = zeros(torch.uint8)
        """1 where a position or state of the world left its bounds in the last step, shape [B]."""
        self.enabled = torch.ones(1, dtype=torch.uint8, device=self.device)
        """0 if the last actions were not finite and so not applied, shape [1]."""
        self.part_names: tuple[str, ...] = ()
        """Names of the parts of the loss, known once worlds have been placed."""
        self.loss_names: tuple[str, ...] = ()
        """Names in `info` of the loss and its parts."""
        self.improvement_names: tuple[str, ...] = ()
        """Names in `info` of how much each part fell."""
        self.report = StepReport.empty(world_count, 0, self.device)
        """What a step returns apart from the observation."""
        # Each world's ending, then whether the actions were finite.
        self._endings = torch.zeros(world_count + 1, dtype=torch.uint8, device=self.device)
        self._evaluation: EpisodeUpdate | None = None
        self._make_host_copies()

    def __getstate__(self) -> dict[str, Any]:
        # The next step makes these again.
        return self.__dict__ | dict.fromkeys(("_evaluation", "host_endings", "host_numbers"))

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._make_host_copies()

    def _make_host_copies(self) -> None:
        """Make the tensors that the host reads: on CUDA pinned memory that the device fills."""
        read = (self._endings, self.report.numbers)
        self.host_endings, self.host_numbers = map(pinned_like, read) if self.x.is_cuda else read

    @property
    def rewards_last_step_only(self) -> bool:
        """Whether only the last step of an episode is rewarded."""
        return bool(self.task.config.reward == "sparse")

    def begin(self, worlds: Tensor, start: Start, *, check: bool) -> None:
        """Begin episodes in some worlds, int64, [M].

        `check` raises an error unless all losses are finite, which synchronises with the device.
        """
        self.elapsed.index_fill_(0, worlds, 0)
        self.place(worlds, Particles(start.x, start.s, goal=start.goal))
        if check:
            self.check_losses(worlds)
        self._start_loss[worlds] = self.loss[worlds]
        if start.success_loss is None:
            self._success_loss.index_fill_(0, worlds, -torch.inf)
        else:
            self._success_loss[worlds] = start.success_loss

    @torch.no_grad()
    @makes_plain_tensors
    def place(self, worlds: Tensor, placed: Particles) -> None:
        """Replace the particles of some worlds, int64, shape [M], without a reward.

        Worlds keep their goals if `placed` has none.
        """
        task, goal = self.task, placed.goal
        placed = Particles(placed.x.contiguous(), placed.s.contiguous())
        if self.goal_task is not task:
            goal = self.goal[worlds] if goal is None else goal
            self.goal.index_copy_(0, worlds, goal)
            task = task.with_goal(goal)
        parts = task.losses(placed.x, placed.s)
        values = torch.stack(checked_losses(task, parts, len(placed.x), self.part_names))
        if not self.part_names:
            self.part_names = tuple(parts)
            self.loss_names = ("loss", *(f"loss_{name}" for name in parts))
            self.improvement_names = tuple(f"reward_{name}" for name in parts)
            self.report = StepReport.empty(self.world_count, len(parts), self.device)
            self._make_host_copies()
        self.particles.put_(worlds, placed)
        zeros = torch.zeros_like(values)
        numbers = torch.cat((zeros[:1], total(values)[None], values, zeros))
        self.report.numbers.index_copy_(1, worlds, numbers)
        if self.particle_rewards is not None:
            self.particle_rewards.place(worlds, task, placed)
        self.report.endings.index_fill_(1, worlds, False)

    def evaluate(self) -> None:
        """Write rewards, losses and endings for the current particles into `report`."""
        task, particle_rewards = self.goal_task, self.particle_rewards
        losses = task.losses(self.x, self.s)
        parts = torch.stack(checked_losses(task, losses, len(self.x), self.part_names))
        if self._evaluation is None:
            self._evaluation = self._make_evaluation()
        if particle_rewards is None:
            self._evaluation(parts)
        else:
            gains = particle_rewards.gains(task, self.particles)
            self._evaluation(parts, (~torch.isfinite(gains).all(dim=1)).byte())
            reward = self.report.reward
            if task.config.reward == "marginal":
                gains = with_mean_reward(gains, reward)
            # In worlds that left their bounds each particle gets the world's reward.
            by_world = self.diverged.bool() & (task.config.on_divergence != "ignore")
            gains = torch.where(by_world[:, None], reward[:, None], gains)
            gains = torch.where(self.enabled.bool(), gains, particle_rewards.reward)
            particle_rewards.reward.copy_(gains)
        self.settle_rewards()
        if self.x.is_cuda:
            self.host_endings.copy_(self._endings, non_blocking=True)
            if self.world_count == 1:
                self.host_numbers.copy_(self.report.numbers, non_blocking=True)
        self.enabled.fill_(1)

    def settle_rewards(self) -> None:
        """Overwrite `report.reward` where rewards are not the fall of the loss; by default none."""

    def _make_evaluation(self) -> EpisodeUpdate:
        config = self.task.config
        sparse = config.reward == "sparse"
        rewarded_step = (self.episode_steps or config.episode_steps) if sparse else None
        return EpisodeUpdate(
            EpisodeRules(self.episode_steps, rewarded_step, config.on_divergence),
            enabled=self.enabled,
            diverged=self.diverged,
            first_loss=self._start_loss,
            success_loss=self._success_loss,
            elapsed=self.elapsed,
            numbers=self.report.numbers,
            flags=self.report.endings,
            endings=self._endings,
        )

    def check_losses(self, worlds: Tensor) -> None:
        """Check that the losses of some worlds, int64, shape [M], are finite."""
        parts = zip(self.part_names, self.report.parts[:, worlds], strict=True)
        check_finite(self.task, "losses", {f"part {shown(name)}": part for name, part in parts})
        if self.particle_rewards is not None and self.particle_rewards.loss is not None:
            losses = self.particle_rewards.loss[worlds]
            check_finite(self.task, "particle_losses", {"losses": losses})

    @property
    def loss(self) -> Tensor:
        """Each world's current loss, shape [B]."""
        return self.report.loss

    def extra_info(self) -> dict[str, Tensor]:
        """Return further entries of infos, of resets and steps, shape [B, ...] each."""
        return self.goal_task.extra_info(self.s)
