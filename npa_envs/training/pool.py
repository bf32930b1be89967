"""The pool: worlds that live on between batches, so that a rule learns to be stable."""

from __future__ import annotations

import math

import torch
from torch import Tensor


class WorldPool:
    """World states on the device; nothing in it waits for the device.

    Args:
        x: Positions of every world [length units], shape [W, N, D], W the pool's size.
        s: States, shape [W, N, C].
        goal: The goal of every world, shape [W], where the task has such.
        runaway_limit: A world with a larger |x| or |s|, or one that is not finite, is not kept.
    """

    def __init__(
        self, x: Tensor, s: Tensor, goal: Tensor | None = None, *, runaway_limit: float
    ) -> None:
        self.x = x
        """Positions [length units], shape [W, N, D]."""
        self.s = s
        """States (dimensionless), shape [W, N, C]."""
        self.goal = goal
        """Goals, int64, shape [W], or None."""
        self._runaway_limit = runaway_limit

    def sample(self, world_count: int, generator: torch.Generator) -> Tensor:
        """Draw different worlds.

        Returns:
            Their indices, shape [B].
        """
        # The largest of random numbers: unlike randperm, one short kernel and no host copy.
        keys = torch.rand(len(self.x), generator=generator, device=self.x.device)
        return keys.topk(world_count).indices

    def read(self, index: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return copies of the worlds at `index` [B]: x [B, N, D], s [B, N, C] and goals [B]."""
        goal = None if self.goal is None else self.goal.index_select(0, index)
        return self.x.index_select(0, index), self.s.index_select(0, index), goal

    def write(
        self,
        index: Tensor,
        x: Tensor,
        s: Tensor,
        fresh_x: Tensor,
        fresh_s: Tensor,
        goals: tuple[Tensor, Tensor] | None = None,
    ) -> Tensor:
        """Put worlds back; those that are not finite or run away are replaced by fresh ones.

        Args:
            index: Where to, shape [B].
            x: Positions after the rollout [length units], shape [B, N, D].
            s: States after the rollout, shape [B, N, C].
            fresh_x: Positions of seeds, shape [B, N, D].
            fresh_s: States of seeds, shape [B, N, C].
            goals: Goals of the worlds and of the seeds, shape [B], where the pool has such.

        Returns:
            Which worlds were replaced, shape [B], bool.
        """
        farthest = torch.maximum(_largest(x), _largest(s))
        # A comparison with NaN is false, so what is not finite is not kept either.
        keep = farthest <= self._runaway_limit
        mask = keep[:, None, None]
        self.x.index_copy_(0, index, torch.where(mask, x, fresh_x))
        self.s.index_copy_(0, index, torch.where(mask, s, fresh_s))
        if self.goal is not None and goals is not None:
            self.goal.index_copy_(0, index, torch.where(keep, *goals))
        return ~keep


def _largest(worlds: Tensor) -> Tensor:
    """Return each world's largest absolute value, NaN where there is one; shape [B]."""
    largest: Tensor = torch.linalg.vector_norm(worlds.flatten(1), math.inf, dim=1)
    return largest
