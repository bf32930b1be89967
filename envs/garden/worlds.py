"""The parts of living worlds: a rule runs the particles, an action touches the whole world."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from npa_envs.envs.core.referee import WorldReferee
from npa_envs.envs.core.task import Start
from npa_envs.envs.core.worlds import BatchedWorlds, Parts, not_finite
from npa_envs.world.randomness import StreamId, WorldRandom


class RuleAction:
    """What the task's `step` makes of brushes or codes, then the rule's steps.

    On a CPU worlds are stepped one after the other, as there a rule's products change in the last
    bit with the number of worlds.

    Args:
        worlds: Whose particles.
    """

    recorded = False

    def __init__(self, worlds: BatchedWorlds) -> None:
        self._task, self._physics, self._random = worlds.task, worlds.physics, worlds.random
        self._x, self._s, self._diverged = worlds.x, worlds.s, worlds.referee.diverged

    def apply(self, action: Tensor) -> None:
        """Apply actions, shape [B, K, W]."""
        action = action.to(self._x.device)
        if not bool(torch.isfinite(action).all()):
            raise not_finite(action)
        diverged = torch.zeros_like(self._diverged, dtype=torch.bool)
        limits = self._physics.position_limit, self._physics.state_limit
        for own, new, limit in zip((self._x, self._s), self._stepped(action), limits, strict=True):
            # NaN is not within any limit.
            diverged |= ~(new.abs() < limit).flatten(1).all(dim=1)
            own.copy_(torch.nan_to_num(new, nan=0.0).clamp(-limit, limit))
        self._diverged.copy_(diverged)

    def _stepped(self, action: Tensor) -> tuple[Tensor, Tensor]:
        x, s = self._x, self._s
        if x.is_cuda or len(x) == 1:
            stepped: tuple[Tensor, Tensor] = self._task.step(x, s, action, self._random)
            return stepped
        worlds = []
        for k in range(len(x)):
            one = slice(k, k + 1)
            random = self._random.take(one)
            worlds.append(self._task.step(x[one], s[one], action[one], random))
        self._random.sync_with(random, self._task.config.rule_steps)
        x, s = (torch.cat(part) for part in zip(*worlds, strict=True))
        return x, s

    def updated(self) -> Tensor:
        """Living worlds refuse `tell_updated`."""
        raise NotImplementedError


class GardenObserver:
    """What the task observes of a whole world.

    Args:
        worlds: Whose observations.
    """

    perceives_alone = False

    def __init__(self, worlds: BatchedWorlds) -> None:
        self._observe = worlds.task.observe

    def observe(
        self, worlds: BatchedWorlds, perceived: Tensor | None, out: Tensor | None
    ) -> Tensor:
        """Return the observations of all worlds as they are, shape [B, O]."""
        seen: Tensor = self._observe(worlds.x, worlds.s, worlds.loss, worlds.referee.context)
        return seen if out is None else out.copy_(seen)

    def begun(self, worlds: BatchedWorlds, index: Tensor, start: Start) -> Tensor:
        """Return the observations of worlds that began an episode."""
        return worlds.perceive()[index]


class GardenReferee(WorldReferee):
    """Pays what the task says a world is worth; arguments are those of `WorldReferee`."""

    def __init__(self, task: Any, x: Tensor, s: Tensor, episode_steps: int | None) -> None:
        super().__init__(task, x, s, episode_steps)
        self.context = torch.zeros(len(x), task.context_count, device=x.device)
        """What each world keeps of its start, as its task says, shape [B, M]."""

    @property
    def pays_last_step_alone(self) -> bool:
        """Whether an episode's last step is the only one that is paid."""
        return super().pays_last_step_alone and not self.task.pays_each_step

    def begin(self, worlds: Tensor, start: Start, random: WorldRandom, *, check: bool) -> None:
        """Begin episodes in some worlds, and keep the task's context of their starts."""
        super().begin(worlds, start, random, check=check)
        draws, loss = random.take(worlds).substream(StreamId.GOAL), self.report.numbers[1][worlds]
        self.context[worlds] = self.task.episode_context(start, loss, draws)

    def judge(self) -> None:
        """Write rewards, losses and endings of the worlds as they now are."""
        super().judge()
        loss, (ended, late) = self.report.numbers[1], self.report.endings[:2]
        reward = self.task.reward(self.x, self.s, loss, self.context)
        if self.pays_last_step_alone:
            last = ended | late
            if self.episode_steps is None:
                last = last | (self.elapsed == self.task.config.episode_steps)
            reward = torch.where(last, reward, 0.0)
        self.task.next_goals(self.elapsed, self.context, self.goal)
        self.report.numbers[0].copy_(reward)
        if self.x.is_cuda and len(self.x) == 1:
            self.host_numbers.copy_(self.report.numbers, non_blocking=True)

    def extra_info(self) -> dict[str, Tensor]:
        """Return what infos hold besides, shape [B, ...] each."""
        told: dict[str, Tensor] = self.task.context_info(self.x, self.s, self.context)
        return told


LIVING = Parts(RuleAction, GardenObserver, GardenReferee)
"""Worlds whose particles a rule runs."""
