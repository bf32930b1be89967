"""Losses, rewards and episode ends of a batch of worlds."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from npa_envs.envs.core.config import EnvConfig
from npa_envs.envs.core.task import EnvTask, Start, check_finite, checked_losses, checked_tensor
from npa_envs.envs.core.world_state import WorldState
from npa_envs.errors import NPAError, shown
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


def total(terms: Tensor) -> Tensor:
    """Return the sum of the terms of a loss, [K, B], one after the other.

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
    """Reward, loss, its K terms, and each term's decrease in the last step, shape [2 + 2 K, B]."""
    endings: Tensor
    """Terminated, truncated, success, diverged, bool, shape [4, B]."""
    all_worlds: Tensor
    """True for every world, bool, shape [B]: the mask of infos that all worlds have."""

    @classmethod
    def empty(cls, world_count: int, term_count: int, device: torch.device) -> StepReport:
        """Return a `StepReport` of zeros, for B worlds whose loss has K terms."""
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
        return cls(buffer, numbers, flags[:-1], flags[-1])

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        # Unpickled views would not share the buffer's memory.
        return StepReport.from_buffer, (self.buffer, len(self.all_worlds))

    def copy(self) -> StepReport:
        """Return a copy of the report, which later steps do not overwrite."""
        return self.from_buffer(self.buffer.clone(), len(self.all_worlds))

    @property
    def reward(self) -> Tensor:
        """Rewards of the last step, shape [B]."""
        return self.numbers[0]

    @property
    def loss(self) -> Tensor:
        """Losses, shape [B]."""
        return self.numbers[1]

    @property
    def terms(self) -> Tensor:
        """The terms of each loss, shape [K, B]."""
        return self.numbers[2 : 1 + len(self.numbers) // 2]

    @property
    def improvements(self) -> Tensor:
        """Decrease of each term of the loss in the last step, shape [K, B]."""
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
        """Store the new particles of the worlds of indices `worlds`, int64 [M]; rewards are 0."""
        self.reward.index_fill_(0, worlds, 0.0)
        if self.loss is None:
            self._before.put_(worlds, particles)
        else:
            self.loss[worlds] = self._losses(task, particles)

    def step_rewards(self, task: EnvTask[Any], particles: Particles) -> Tensor:
        """Return each particle's reward of a step, [B, N]; store these particles for the next."""
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
        limits = [steps for steps in (episode_steps, config.episode_steps) if steps is not None]
        self.episode_steps = min(limits, default=None)
        """Steps after which an episode is truncated; None: never."""
        if self.rewards_last_step_only and self.episode_steps is None:
            raise NPAError(
                "episode_steps must be given where reward='sparse' comes in the last step, got "
                "None: for example episode_steps=64, and the same number as max_episode_steps of "
                "gymnasium.make"
            )

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
        self.term_names: tuple[str, ...] = ()
        """Names of the terms of the loss, known once worlds have been placed."""
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
        """Begin episodes with `start` in the worlds of indices `worlds`, int64 [M].

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
        """Replace the particles of the worlds of indices `worlds`, int64 [M], without a reward.

        Worlds keep their goals if `placed` has none.
        """
        task, goal = self.task, placed.goal
        placed = placed._replace(goal=None).map(Tensor.contiguous)
        if self.goal_task is not task:
            goal = self.goal[worlds] if goal is None else goal
            self.goal.index_copy_(0, worlds, goal)
            task = task.with_goal(goal)
        terms = task.losses(placed.x, placed.s)
        values = torch.stack(checked_losses(task, terms, len(placed.x), self.term_names))
        if not self.term_names:
            self.term_names = tuple(terms)
            self.report = StepReport.empty(self.world_count, len(terms), self.device)
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
        terms = torch.stack(checked_losses(task, losses, len(self.x), self.term_names))
        if self._evaluation is None:
            self._evaluation = self._make_evaluation()
        if particle_rewards is None:
            self._evaluation(terms)
        else:
            gains = particle_rewards.step_rewards(task, self.particles)
            self._evaluation(terms, (~torch.isfinite(gains).all(dim=1)).byte())
            reward = self.report.reward
            if task.config.reward == "marginal":
                gains = with_mean_reward(gains, reward)
            # In worlds that left their bounds each particle gets the world's reward.
            by_world = self.diverged.bool() & (task.config.on_divergence != "ignore")
            gains = torch.where(by_world[:, None], reward[:, None], gains)
            gains = torch.where(self.enabled.bool(), gains, particle_rewards.reward)
            particle_rewards.reward.copy_(gains)
        rewards = self.task_rewards()
        if rewards is not None:
            if self.rewards_last_step_only:
                terminated, truncated = self.report.endings[:2]
                rewards = torch.where(terminated | truncated, rewards, 0.0)
            self.report.reward.copy_(rewards)
        if self.x.is_cuda:
            self.host_endings.copy_(self._endings, non_blocking=True)
            if self.world_count == 1:
                self.host_numbers.copy_(self.report.numbers, non_blocking=True)
        self.enabled.fill_(1)

    def task_rewards(self) -> Tensor | None:
        """Return the task's own rewards of a step, [B]; None: they are the loss's decrease."""
        return None

    def _make_evaluation(self) -> EpisodeUpdate:
        config = self.task.config
        rewarded_step = self.episode_steps if self.rewards_last_step_only else None
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
        """Check that the losses of the worlds of indices `worlds`, int64 [M], are finite."""
        terms = zip(self.term_names, self.report.terms[:, worlds], strict=True)
        check_finite(self.task, "losses", {f"term {shown(name)}": term for name, term in terms})
        if self.particle_rewards is not None and self.particle_rewards.loss is not None:
            losses = self.particle_rewards.loss[worlds]
            check_finite(self.task, "particle_losses", {"losses": losses})

    @property
    def loss(self) -> Tensor:
        """Each world's current loss, shape [B]."""
        return self.report.loss

    def extra_info(self) -> dict[str, Tensor]:
        """Return what the task adds to infos of resets and steps, by name, [B, ...] each."""
        return self.goal_task.extra_info(self.s)
