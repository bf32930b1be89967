"""The batch of living worlds behind every garden: brushes, the rule's steps, what is seen."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.envs.core.config import EnvConfig
from npa_envs.envs.core.task import EnvTask, Start
from npa_envs.envs.core.worlds import BatchedWorlds
from npa_envs.envs.garden.task import GardenTask
from npa_envs.world.cuda_graph import makes_plain_tensors, to_device_async
from npa_envs.world.randomness import StreamId


class BrushedWorlds(BatchedWorlds):
    """B worlds of one garden, stepped together.

    On a CPU worlds are stepped one after the other, as there a rule's products change in the last
    bit with the number of worlds.

    Args:
        task_type: A subclass of `GardenTask`.
        config: The environment's configuration.
        world_count: Worlds B.
        episode_steps: Steps after which an episode is cut off, or None for never.

    Raises:
        NPAError: The worlds do not fit into memory.
    """

    task: GardenTask[Any]

    @makes_plain_tensors
    def __init__(
        self,
        task_type: type[EnvTask[Any]],
        config: EnvConfig,
        world_count: int,
        episode_steps: int | None = None,
    ) -> None:
        super().__init__(task_type, config, world_count, episode_steps)
        self.context = torch.zeros(world_count, self.task.context_count, device=self.device)
        """What each world keeps of its start, as its task says, shape [B, M]."""
        self.restart = self._restart  # type: ignore[assignment]

    @property
    def pays_last_step_alone(self) -> bool:
        """Whether an episode's last step is the only one that is paid."""
        return super().pays_last_step_alone and not self.task.pays_each_step

    @torch.no_grad()
    @makes_plain_tensors
    def perceive(self, out: Tensor | None = None) -> Tensor:
        """Return what is seen of all worlds as they are, shape [B, ...], written to `out`."""
        seen = self.task.observe(self.x, self.s, self.loss, self.context)
        return seen if out is None else out.copy_(seen)

    def _restart(self, worlds: NDArray[np.int64], observation: Tensor) -> None:
        """Start the next episodes of some worlds, [M], and write what is seen of them."""
        index = to_device_async(worlds, self.device)
        self.start(index)
        observation[index] = self.perceive()[index]

    @torch.no_grad()
    @makes_plain_tensors
    def queue(self, action: Tensor, out: Tensor | None = None) -> Tensor:
        """Use the brushes, let the rule run, and judge; return what is seen, shape [B, ...]."""
        action = action.to(self.device)
        if not bool(torch.isfinite(action).all()):
            raise self._not_finite(action)
        x, s = self._lived(action)
        self._write(x, s)
        self._judge_worlds()
        if self._side_stream is not None:
            self._side_stream.mark()
        return self.perceive(out)

    def _lived(self, action: Tensor) -> tuple[Tensor, Tensor]:
        if self.device.type != "cpu" or self.world_count == 1:
            return self.task.step(self.x, self.s, action, self.random)
        lived = []
        for k in range(self.world_count):
            one = slice(k, k + 1)
            random = self.random.take(one)
            lived.append(self.task.step(self.x[one], self.s[one], action[one], random))
        self.random.sync_with(random, self.task.config.rule_steps)
        x, s = (torch.cat(part) for part in zip(*lived, strict=True))
        return x, s

    def _write(self, x: Tensor, s: Tensor) -> None:
        """Take worlds over, with numbers that left their bounds held there and told of."""
        physics = self.physics
        diverged = torch.zeros_like(self._diverged, dtype=torch.bool)
        for mine, new, limit in (
            (self.x, x, physics.limits.position),
            (self.s, s, physics.limits.state),
        ):
            # NaN is not within any limit.
            diverged |= ~(new.abs() < limit).flatten(1).all(dim=1)
            mine.copy_(torch.nan_to_num(new, nan=0.0).clamp(-limit, limit))
        self._diverged.copy_(diverged)

    def _judge_worlds(self) -> None:
        """Write rewards, losses and endings of the worlds as they now are."""
        super()._judge_worlds()
        self.report.numbers[0].copy_(self._rewards())
        if self._side_stream is not None and self.world_count == 1:
            self._host_numbers.copy_(self.report.numbers, non_blocking=True)

    def _rewards(self) -> Tensor:
        """Return what worlds earn in this step, shape [B]."""
        earned = self.task.reward(self.x, self.s, self.loss, self.context)
        if not self.pays_last_step_alone:
            return earned
        last = self.report.endings[0] | self.report.endings[1]
        if self.episode_steps is None:
            last = last | (self.elapsed == self.task.config.episode_steps)
        return torch.where(last, earned, 0.0)

    @torch.no_grad()
    @makes_plain_tensors
    def start(self, worlds: Tensor, keys: Tensor | None = None) -> Start:
        """Start episodes in some worlds, int64, shape [M], and return their particles."""
        start = super().start(worlds, keys)
        random = self.random.take(worlds).substream(StreamId.GOAL)
        self.context[worlds] = self.task.episode_context(start, self.loss[worlds], random)
        return start

    def extras(self, when: str) -> dict[str, Tensor]:
        """Return what infos tell besides, shape [B, ...] each: since a "reset", or of a "step"."""
        return self.task.context_info(self.x, self.s, self.context) if when == "reset" else {}
