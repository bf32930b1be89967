"""Losses, rewards and episode ends of a batch of worlds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from npa_envs.envs.core.config import EnvConfig
from npa_envs.envs.core.state import WorldState
from npa_envs.envs.core.task import EnvTask, Start, check_finite, checked_losses, checked_tensor
from npa_envs.errors import shown
from npa_envs.world.actions import (
    DIVERGED,
    SUCCESS,
    TIME_LIMIT,
    EpisodeRules,
    EpisodeUpdate,
    with_mean_reward,
)
from npa_envs.world.cuda_graph import makes_plain_tensors, pinned_like

FLAGS = ("success", "diverged")
"""Names in `info` of the flags that are no part of what Gymnasium's `step` returns."""

REWARD, LOSS, FIRST_PART = 0, 1, 2
"""Rows of `StepReport.numbers`: the reward, the loss, and the first of the loss's K parts."""


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
    """Reward, loss, its K parts, and the last step's fall of each part, shape [2 + 2 K, B]."""
    endings: Tensor
    """Terminated, truncated, success, diverged, bool, shape [4, B]."""
    everyone: Tensor
    """True for every world, bool, shape [B]: the mask of infos that all worlds have."""

    @classmethod
    def empty(cls, world_count: int, part_count: int, device: torch.device) -> StepReport:
        """Return a report of zeros, of B worlds whose loss has K parts."""
        rows = 4 * (2 + 2 * part_count) + 3 + len(FLAGS)
        buffer = torch.zeros(rows * world_count, dtype=torch.uint8, device=device)
        report = cls.over(buffer, world_count)
        report.everyone.fill_(True)
        return report

    @classmethod
    def over(cls, buffer: Tensor, world_count: int) -> StepReport:
        """Return a report whose tensors are views of a buffer."""
        flag_rows = 3 + len(FLAGS)
        rows = buffer.view(-1, world_count)
        numbers = buffer[: -flag_rows * world_count].view(torch.float32).view(-1, world_count)
        flags = rows[-flag_rows:].view(torch.bool)
        return cls(buffer, numbers, flags[:-1], flags[-1])

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        """Pickle the buffer alone: unpickled views would not share its memory."""
        return StepReport.over, (self.buffer, len(self.everyone))

    def copy(self) -> StepReport:
        """Return a copy that later steps do not overwrite."""
        return self.over(self.buffer.clone(), len(self.everyone))


class RewardedWorlds(WorldState):
    """B worlds of one task with their losses, rewards and episode ends, in float32.

    Args:
        task_type: Class of the task, which defines starts and losses.
        config: The environment's configuration.
        world_count: Worlds B.
        episode_steps: Steps after which an episode is truncated; None: never.

    Raises:
        NPAError: The worlds do not fit into memory.
    """

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
        x, s, device = self.x, self.s, self.device

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.zeros(world_count, *shape, dtype=dtype, device=device)

        self.elapsed = zeros(dtype=torch.int32)
        """Steps since the start of each episode, shape [B]."""
        self.particle_loss = zeros(count) if config.reward == "particle" else None
        """Each particle's loss, shape [B, N], with `reward="particle"`."""
        self.particle_reward = zeros(count) if config.per_particle_reward else None
        """Each particle's reward of the last step, shape [B, N], where particles have rewards."""
        self._before = (x.clone(), s.clone()) if config.reward == "marginal" else None
        self.goal = zeros(dtype=torch.int64)
        """Index of each world's goal, shape [B]; zeros where the task has one goal."""
        self.goal_task: EnvTask[Any] = self.task.toward(self.goal)
        """The task with losses for the worlds' goals."""
        self._start_loss = zeros()
        self._success_loss = zeros()
        self.diverged = zeros(dtype=torch.uint8)
        """1 where a position or state of the world left its bounds in the last step, shape [B]."""
        self.enabled = torch.ones(1, dtype=torch.uint8, device=device)
        """0 if the last actions were not finite and so not applied, shape [1]."""
        self.part_names: tuple[str, ...] = ()
        """Names of the parts of the loss, known once worlds have been placed."""
        self.report = StepReport.empty(world_count, 0, device)
        """What a step returns apart from the observation."""
        # Each world's ending, then whether the actions were finite.
        self._endings = torch.zeros(world_count + 1, dtype=torch.uint8, device=device)
        self._evaluation: EpisodeUpdate | None = None
        self._make_host_copies()

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without what the next step makes again, or what cannot be pickled."""
        return self.__dict__ | dict.fromkeys(("_evaluation", "host_endings", "host_numbers"))

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the state, and make the host's copies again."""
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
        self.place(worlds, start)
        if check:
            self.check_losses(worlds)
        self._start_loss[worlds] = self.report.numbers[LOSS][worlds]
        if start.success_loss is None:
            self._success_loss.index_fill_(0, worlds, -torch.inf)
        else:
            self._success_loss[worlds] = start.success_loss

    @torch.no_grad()
    @makes_plain_tensors
    def place(self, worlds: Tensor, start: Start) -> None:
        """Replace the particles of some worlds, int64, shape [M], without a reward."""
        x, s = start.x.contiguous(), start.s.contiguous()
        task = self.task
        if self.goal_task is not task:
            goal = self.goal[worlds] if start.goal is None else start.goal
            self.goal.index_copy_(0, worlds, goal)
            task = task.toward(goal)
        parts = task.losses(x, s)
        values = torch.stack(checked_losses(task, parts, len(x), self.part_names))
        if not self.part_names:
            self.part_names = tuple(parts)
            self.report = StepReport.empty(len(self.x), len(parts), x.device)
            self._make_host_copies()
        self.x.index_copy_(0, worlds, x)
        self.s.index_copy_(0, worlds, s)
        zeros = torch.zeros_like(values)
        numbers = torch.cat((zeros[:1], total(values)[None], values, zeros))
        self.report.numbers.index_copy_(1, worlds, numbers)
        if self.particle_loss is not None:
            self.particle_loss[worlds] = self._particle_losses(task, x, s)
        if self._before is not None:
            for before, placed in zip(self._before, (x, s), strict=True):
                before.index_copy_(0, worlds, placed)
        if self.particle_reward is not None:
            self.particle_reward.index_fill_(0, worlds, 0.0)
        self.report.endings.index_fill_(1, worlds, False)

    def evaluate(self) -> None:
        """Write rewards, losses and endings for the current particles into `report`."""
        task = self.goal_task
        losses = task.losses(self.x, self.s)
        parts = torch.stack(checked_losses(task, losses, len(self.x), self.part_names))
        if self._evaluation is None:
            self._evaluation = self._make_evaluation()
        if self.particle_reward is None:
            self._evaluation(parts)
        else:
            reward, own = self.report.numbers[REWARD], self._particle_gains(task)
            self._evaluation(parts, (~torch.isfinite(own).all(dim=1)).byte())
            if self._before is not None:
                own = with_mean_reward(own, reward)
            # In worlds that left their bounds each particle gets the world's reward.
            whole = self.diverged.bool() & (task.config.on_divergence != "ignore")
            own = torch.where(whole[:, None], reward[:, None], own)
            self.particle_reward.copy_(torch.where(self.enabled.bool(), own, self.particle_reward))
        if self.x.is_cuda:
            self.host_endings.copy_(self._endings, non_blocking=True)
            if len(self.x) == 1:
                self.host_numbers.copy_(self.report.numbers, non_blocking=True)
        self.enabled.fill_(1)

    def _particle_gains(self, task: EnvTask[Any]) -> Tensor:
        """Return each particle's reward of a step, shape [B, N]; the next step counts from now."""
        now = self.x, self.s
        if self._before is not None:
            gains = task.particle_gains(self._before, now)
            gains = checked_tensor(task, "particle_gains", "gains", gains, self.x.shape[:2])
            for before, new in zip(self._before, now, strict=True):
                before.copy_(new)
            return gains
        assert self.particle_loss is not None, "particles have rewards by losses or by gains"
        losses = self._particle_losses(task, *now)
        gains = self.particle_loss - losses
        self.particle_loss.copy_(losses)
        return gains

    def _particle_losses(self, task: EnvTask[Any], x: Tensor, s: Tensor) -> Tensor:
        losses = task.particle_losses(x, s)
        return checked_tensor(task, "particle_losses", "losses", losses, x.shape[:2])

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
        end = FIRST_PART + len(self.part_names)
        numbers = self.report.numbers[FIRST_PART:end, worlds]
        parts = {
            f"part {shown(name)}": part for name, part in zip(self.part_names, numbers, strict=True)
        }
        check_finite(self.task, "losses", parts)
        if self.particle_loss is not None:
            check_finite(self.task, "particle_losses", {"losses": self.particle_loss[worlds]})

    def reward_restorer(self, worlds: Tensor) -> Callable[[], None]:
        """Return a function that undoes what a restart does to rewards, flags and step counts."""
        before, elapsed = self.report.copy(), self.elapsed.clone()
        own = None if self.particle_reward is None else self.particle_reward.clone()

        def restore() -> None:
            self.elapsed.copy_(elapsed)
            numbers = self.report.numbers
            improvements = slice(FIRST_PART + len(self.part_names), None)
            for rows in (REWARD, improvements):
                numbers[rows, worlds] = before.numbers[rows, worlds]
            self.report.endings.copy_(before.endings)
            if own is not None and self.particle_reward is not None:
                self.particle_reward.copy_(own)
            if len(self.x) == 1:
                # The host reads the numbers of a single world alone; this synchronises.
                self.host_numbers.copy_(numbers)

        return restore

    @property
    def loss(self) -> Tensor:
        """Each world's current loss, shape [B]."""
        return self.report.numbers[LOSS]

    def extra_info(self) -> dict[str, Tensor]:
        """Return further entries of infos, of resets and steps, shape [B, ...] each."""
        return self.goal_task.extra_info(self.s)
