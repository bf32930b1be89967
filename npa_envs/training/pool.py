"""The pool of worlds that a rule is trained on."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from npa_envs.tasks.base import Worlds
from npa_envs.world.randomness import Randomness, WorldRandom

RUNAWAY_LIMIT = 10.0
"""A world with a larger |x| or |s| is replaced by a seed."""


class WorldPool:
    """Worlds that live on between batches, on the device, so that a rule learns to be stable.

    Args:
        runaway_limit: A world with a larger |x| or |s|, or one that is not finite, is not kept.
        max_age_range: Steps that the world in the first place lives, and that in the last, all
            others between; None: for ever.
        places: Places of these worlds among those of all processes, int64, shape [W]; None: they
            are all.
    """

    def __init__(
        self,
        x: Tensor,
        s: Tensor,
        goal: Tensor | None = None,
        *,
        runaway_limit: float,
        max_age_range: tuple[int, int] | None = None,
        places: Tensor | None = None,
        total: int | None = None,
    ) -> None:
        self.x = x
        """Positions [length units], shape [W, N, D]."""
        self.s = s
        """States (dimensionless), shape [W, N, C]."""
        self.goal = goal
        """Goals, int64, shape [W], or None."""
        self.age = (
            None if max_age_range is None else torch.zeros_like(x[:, 0, 0], dtype=torch.int64)
        )
        """Steps since the seed, or since a life began by damage, int64, shape [W], or None."""
        self.lifetime: Tensor | None = None
        """Age at which the world of each place has lived, int64, shape [W], or None."""
        if max_age_range is not None:
            lo, hi = map(math.log, max_age_range)
            logarithms = torch.linspace(lo, hi, total or len(x), dtype=torch.float64)
            own = logarithms if places is None else logarithms[places]
            self.lifetime = own.exp().round().to(x.device, torch.int64)
        self._runaway_limit = runaway_limit

    def sample(self, world_count: int, generator: Randomness) -> Tensor:
        """Draw different worlds: one of each of B equal sections.

        From a generator and where they have no max_age_range, B of all worlds instead.

        Returns:
            Their indices, shape [B].
        """
        size = len(self.x) // world_count
        first = torch.arange(0, size * world_count, size, device=self.x.device)
        if isinstance(generator, WorldRandom):
            return first + generator.integers(size, 1)[:, 0]
        # The largest of random numbers: unlike randperm, one short kernel and no host copy.
        keys = torch.rand(len(self.x), generator=generator, device=self.x.device)
        if self.age is None:
            return keys.topk(world_count).indices
        return first + keys.view(world_count, size).argmax(dim=1)

    def ages_of(self, index: Tensor) -> tuple[Tensor, Tensor]:
        """Return worlds' ages, and which have reached their `max_age_range`, shape [B] each."""
        assert self.age is not None, "made with max_age_range"
        assert self.lifetime is not None, "made with max_age_range"
        age = self.age.index_select(0, index)
        return age, age >= self.lifetime.index_select(0, index)

    def read(self, index: Tensor) -> Worlds:
        """Return copies of the worlds at `index` [B]: x [B, N, D], s [B, N, C] and goals [B]."""
        goal = None if self.goal is None else self.goal.index_select(0, index)
        return self.x.index_select(0, index), self.s.index_select(0, index), goal

    def write(
        self, index: Tensor, worlds: Worlds, fresh: Worlds, age: Tensor | None = None
    ) -> Tensor:
        """Put worlds back; those that are not finite or run away are replaced by fresh ones.

        Args:
            fresh_x: Positions of seeds, shape [B, N, D].
            fresh_s: States of seeds, shape [B, N, C].
            goals: Goals of the worlds and of the seeds, shape [B], where the pool has such.
            age: Steps of the worlds since their seeds, int64, shape [B], with `max_age_range`.

        Returns:
            Which worlds were replaced, shape [B], bool.
        """
        (x, s, goal), (fresh_x, fresh_s, fresh_goal) = worlds, fresh
        farthest = torch.maximum(_largest(x), _largest(s))
        # A comparison with NaN is false, so what is not finite is not kept either.
        keep = farthest <= self._runaway_limit
        mask = keep[:, None, None]
        self.x.index_copy_(0, index, torch.where(mask, x, fresh_x))
        self.s.index_copy_(0, index, torch.where(mask, s, fresh_s))
        if self.goal is not None and goal is not None and fresh_goal is not None:
            self.goal.index_copy_(0, index, torch.where(keep, goal, fresh_goal))
        if self.age is not None and age is not None:
            self.age.index_copy_(0, index, age.masked_fill(~keep, 0))
        return ~keep


def _largest(worlds: Tensor) -> Tensor:
    """Return each world's largest absolute value, NaN where there is one; shape [B]."""
    largest: Tensor = torch.linalg.vector_norm(worlds.flatten(1), math.inf, dim=1)
    return largest
