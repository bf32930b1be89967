"""Losses, rewards and endings of a batch of worlds, without Gymnasium."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from npa_envs.envs.core.config import EnvConfig
from npa_envs.envs.core.state import WorldState
from npa_envs.envs.core.task import (
    EnvTask,
    Start,
    check_finite,
    checked_losses,
    checked_tensor,
)
from npa_envs.errors import shown
from npa_envs.world.actions import (
    DIVERGED,
    SUCCESS,
    TIME_LIMIT,
    EpisodeRules,
    PreparedJudgement,
    with_mean_reward,
)
from npa_envs.world.cuda_graph import makes_plain_tensors, pinned_like

FLAGS = ("success", "diverged")
"""Names of the first two endings in `info`."""


def total(parts: Tensor) -> Tensor:
    """Return the sum of the parts of a loss, [K, B], in their order, which torch's is not."""
    first, *rest = parts.unbind()
    for part in rest:
        first = first + part
    return first


def reason(ending: int) -> str | None:
    """Return why an episode ended, in words, or None where it has not."""
    words = {DIVERGED: "diverged", SUCCESS: "success", TIME_LIMIT: "time limit"}
    return next((word for bit, word in words.items() if ending & bit), None)


class StepReport(NamedTuple):
    """What a step returns of each world, in one buffer: one copy instead of twenty."""

    buffer: Tensor
    """All that follows, uint8."""
    numbers: Tensor
    """Reward; loss; its parts; their improvements in the last step; shape [2 + 2 K, B]."""
    endings: Tensor
    """Terminated; truncated; success; diverged; bool, shape [4, B]."""
    everyone: Tensor
    """True for every world, bool, shape [B]."""

    @classmethod
    def empty(cls, world_count: int, part_count: int, device: torch.device) -> StepReport:
        """Return the report of B worlds whose loss has K parts: zeros."""
        rows = 4 * (2 + 2 * part_count) + 3 + len(FLAGS)
        buffer = torch.zeros(rows * world_count, dtype=torch.uint8, device=device)
        report = cls.over(buffer, world_count)
        report.everyone.fill_(True)
        return report

    @classmethod
    def over(cls, buffer: Tensor, world_count: int) -> StepReport:
        """Return the report that a buffer holds."""
        flag_rows = 3 + len(FLAGS)
        rows = buffer.view(-1, world_count)
        numbers = buffer[: -flag_rows * world_count].view(torch.float32).view(-1, world_count)
        flags = rows[-flag_rows:].view(torch.bool)
        return cls(buffer, numbers, flags[:-1], flags[-1])

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        """Pickle the buffer alone: views that are pickled apart no longer share its memory."""
        return StepReport.over, (self.buffer, len(self.everyone))

    def copy(self) -> StepReport:
        """Return a copy that later steps leave alone."""
        return self.over(self.buffer.clone(), len(self.everyone))


class JudgedWorlds(WorldState):
    """B worlds of one task, judged by one launch a step, in float32.

    Args:
        task_type: Gives starts and losses.
        config: The environment's configuration.
        world_count: Worlds B.
        episode_steps: Steps after which an episode is cut off, or None for never.

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
        """Steps after which an episode is cut off, or None for never."""
        x, s, device = self.x, self.s, self.device

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.zeros(world_count, *shape, dtype=dtype, device=device)

        self.elapsed = zeros(dtype=torch.int32)
        """Steps since the start of each episode, shape [B]."""
        self.particle_loss = zeros(count) if config.reward == "particle" else None
        """Each particle's share of the loss, shape [B, N], where rewards are shared out."""
        self.particle_reward = zeros(count) if config.per_particle_reward else None
        """Each particle's own reward of the last step, shape [B, N], where it has one."""
        self._before = (x.clone(), s.clone()) if config.reward == "marginal" else None
        self.goal = zeros(dtype=torch.int64)
        """Each world's goal, shape [B], where worlds differ in that."""
        self.aimed: EnvTask[Any] = self.task.toward(self.goal)
        """The task with losses for these goals."""
        self._start_loss = zeros()
        self._success_loss = zeros()
        self.diverged = zeros(dtype=torch.uint8)
        """Whether a number of each world left its bounds in the last step, shape [B]."""
        self.enabled = torch.ones(1, dtype=torch.uint8, device=device)
        """0 where the last actions were not finite and so not applied, shape [1]."""
        self.part_names: tuple[str, ...] = ()
        """Names of the parts of the loss, known once worlds have been placed."""
        self.report = StepReport.empty(world_count, 0, device)
        """What a step returns besides the observation."""
        # Each world's ending, then whether the actions were finite.
        self._endings = torch.zeros(world_count + 1, dtype=torch.uint8, device=device)
        self._judgement: PreparedJudgement | None = None
        self._make_host_copies()

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what the next step makes anew, and what cannot be pickled."""
        return self.__dict__ | dict.fromkeys(("_judgement", "host_endings", "host_numbers"))

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Make the host's copies again."""
        self.__dict__.update(state)
        self._make_host_copies()

    def _make_host_copies(self) -> None:
        """Make what the host reads: on CUDA pinned memory that the device copies to."""
        read = (self._endings, self.report.numbers)
        self.host_endings, self.host_numbers = map(pinned_like, read) if self.x.is_cuda else read

    @property
    def pays_last_step_alone(self) -> bool:
        """Whether an episode's last step is the only one that is paid."""
        return bool(self.task.config.reward == "sparse")

    def begin(self, worlds: Tensor, start: Start, *, check: bool) -> None:
        """Begin episodes in some worlds, int64, [M].

        `check` looks whether losses are finite, which waits for the device.
        """
        self.elapsed.index_fill_(0, worlds, 0)
        self.place(worlds, start)
        if check:
            self.check_losses(worlds)
        self._start_loss[worlds] = self.report.numbers[1][worlds]
        if start.success_loss is None:
            self._success_loss.index_fill_(0, worlds, -torch.inf)
        else:
            self._success_loss[worlds] = start.success_loss

    @torch.no_grad()
    @makes_plain_tensors
    def place(self, worlds: Tensor, start: Start) -> None:
        """Put particles into some worlds, int64, shape [M], at no reward."""
        x, s = start.x.contiguous(), start.s.contiguous()
        task = self.task
        if self.aimed is not task:
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
        still = torch.zeros_like(values)
        numbers = torch.cat((still[:1], total(values)[None], values, still))
        self.report.numbers.index_copy_(1, worlds, numbers)
        if self.particle_loss is not None:
            self.particle_loss[worlds] = self._shares(task, x, s)
        if self._before is not None:
            for kept, placed in zip(self._before, (x, s), strict=True):
                kept.index_copy_(0, worlds, placed)
        if self.particle_reward is not None:
            self.particle_reward.index_fill_(0, worlds, 0.0)
        self.report.endings.index_fill_(1, worlds, False)

    def judge(self) -> None:
        """Write rewards, losses and endings of the worlds as they now are."""
        task = self.aimed
        losses = task.losses(self.x, self.s)
        parts = torch.stack(checked_losses(task, losses, len(self.x), self.part_names))
        if self._judgement is None:
            self._judgement = self._make_judgement()
        if self.particle_reward is None:
            self._judgement(parts)
        else:
            reward, own = self.report.numbers[0], self._particle_gains(task)
            self._judgement(parts, (~torch.isfinite(own).all(dim=1)).byte())
            if self._before is not None:
                own = with_mean_reward(own, reward)
            # Worlds that left their bounds are paid as a whole.
            whole = self.diverged.bool() & (task.config.on_divergence != "ignore")
            own = torch.where(whole[:, None], reward[:, None], own)
            self.particle_reward.copy_(torch.where(self.enabled.bool(), own, self.particle_reward))
        if self.x.is_cuda:
            self.host_endings.copy_(self._endings, non_blocking=True)
            if len(self.x) == 1:
                self.host_numbers.copy_(self.report.numbers, non_blocking=True)
        self.enabled.fill_(1)

    def _particle_gains(self, task: EnvTask[Any]) -> Tensor:
        """Return what each particle has earned in a step, shape [B, N], and keep what it is now."""
        now = self.x, self.s
        if self._before is not None:
            gains = task.particle_gains(self._before, now)
            gains = checked_tensor(task, "particle_losses", "shares", gains, self.x.shape[:2])
            for kept, new in zip(self._before, now, strict=True):
                kept.copy_(new)
            return gains
        assert self.particle_loss is not None, "particles are paid by shares or by actions"
        shares = self._shares(task, *now)
        gains = self.particle_loss - shares
        self.particle_loss.copy_(shares)
        return gains

    def _shares(self, task: EnvTask[Any], x: Tensor, s: Tensor) -> Tensor:
        shares = task.particle_losses(x, s)
        return checked_tensor(task, "particle_losses", "shares", shares, x.shape[:2])

    def _make_judgement(self) -> PreparedJudgement:
        config = self.task.config
        paid = (self.episode_steps or config.episode_steps) if config.reward == "sparse" else None
        return PreparedJudgement(
            EpisodeRules(self.episode_steps, paid, config.on_divergence),
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
        numbers = self.report.numbers[2 : 2 + len(self.part_names), worlds]
        parts = {
            f"part {shown(name)}": part for name, part in zip(self.part_names, numbers, strict=True)
        }
        check_finite(self.task, "losses", parts)
        if self.particle_loss is not None:
            check_finite(self.task, "particle_losses", {"shares": self.particle_loss[worlds]})

    def restore_pay(self, worlds: Tensor) -> Callable[[], None]:
        """Return what gives worlds that begin anew the last step's rewards, flags and time back."""
        paid, elapsed = self.report.copy(), self.elapsed.clone()
        own = None if self.particle_reward is None else self.particle_reward.clone()

        def restore() -> None:
            self.elapsed.copy_(elapsed)
            numbers, before = self.report.numbers, paid.numbers
            improvements = slice(2 + len(self.part_names), None)
            for rows in (0, improvements):
                numbers[rows, worlds] = before[rows, worlds]
            self.report.endings.copy_(paid.endings)
            if own is not None and self.particle_reward is not None:
                self.particle_reward.copy_(own)
            if len(self.x) == 1:
                # Of several the host reads none, and this waits for the device.
                self.host_numbers.copy_(numbers)

        return restore

    @property
    def loss(self) -> Tensor:
        """Losses as they are, shape [B]."""
        return self.report.numbers[1]

    def extra_info(self) -> dict[str, Tensor]:
        """Return what infos hold besides since the reset, shape [B, ...] each."""
        return self.aimed.extra_info(self.s)
