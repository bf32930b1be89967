"""What each agent has lost so far, and what a step pays it."""

from __future__ import annotations

import torch
from torch import Tensor

from npa_envs import world_mean
from npa_envs.envs.species.task import SpeciesTask
from npa_envs.envs.worlds import total

Parts = dict[str, Tensor]
"""Named parts of every agent's loss, shape [B, A] each."""


class Account:
    """The losses of all agents in B worlds, now and before, and rewards for what fell.

    Args:
        task: Says how rewards are settled.
        species: Species of each agent, int64, shape [A].
        world_count: Worlds B.
        team: Whether each is paid the mean of all.
    """

    def __init__(self, task: SpeciesTask, species: Tensor, world_count: int, *, team: bool) -> None:
        self._task = task
        self._species = species
        self._team = team
        self.part_names: tuple[str, ...] = ()
        """Names of the parts, known once an episode was opened."""
        shape = world_count, len(species)
        zeros = torch.zeros(shape, dtype=torch.float64, device=species.device)
        self.loss = zeros
        """Every agent's loss, float64, shape [B, A]."""
        self._parts = self._before = zeros[None]
        self._at_start = self._carried = zeros

    def open(self, parts: Parts, worlds: Tensor) -> None:
        """Begin episodes in some worlds.

        Args:
            parts: Of all agents there, shape [M, A] each.
            worlds: Which worlds, int64, shape [M].
        """
        opened = _stacked(parts)
        if not self.part_names:
            self.part_names = tuple(parts)
            self._parts = self._before = self.loss.expand(len(parts), -1, -1)
        loss = total(opened)
        self._parts = self._parts.index_copy(1, worlds, opened)
        self._before = self._before.index_copy(1, worlds, opened)
        self.loss = self.loss.index_copy(0, worlds, loss)
        self._at_start = self._at_start.index_copy(0, worlds, loss)
        self._carried = self._carried.index_fill(0, worlds, 0.0)

    def carry_over(self, parts: Parts) -> None:
        """Count from other losses on, at no reward.

        Args:
            parts: Of all agents; of those that ended nobody asks.
        """
        self._parts = self._before = _stacked(parts)
        loss = total(self._parts)
        self._carried = self._carried + (loss - self.loss)
        self.loss = loss

    def pay(self, parts: Parts, live: Tensor, fled: Tensor) -> Tensor:
        """Take down the losses after a step, and return rewards, 0 for those that did not act.

        Args:
            parts: Of all agents.
            live: Which agents acted, bool, shape [B, A].
            fled: Which left their world in this step, bool, shape [B, A].

        Returns:
            Rewards, float64, shape [B, A].
        """
        now = _stacked(parts)
        loss = total(now)
        # Leaving the world must not pay, even where an empty picture is better than the start, nor
        # give back what a death added at no charge.
        least = self._at_start + self._carried.clamp_min(0.0)
        loss = torch.where(fled, torch.maximum(loss, least), loss)
        earned = torch.where(live, self.loss - loss, 0.0)
        if self._team:
            share = live.shape[1] / live.sum(dim=1).clamp_min(1)
            mean = world_mean(earned[..., None])[:, 0] * share
            earned = torch.where(live, mean[:, None], 0.0)
        self._parts, self._before, self.loss = now, self._parts, loss
        return self._task.settle(earned, live, self._species)

    def numbers(self) -> dict[str, Tensor]:
        """Return what `info` says of losses, float64, shape [B, A] each."""
        parts = {
            f"loss_{name}": part for name, part in zip(self.part_names, self._parts, strict=True)
        }
        return {"loss": self.loss} | parts

    def step_numbers(self) -> dict[str, Tensor]:
        """Return what `info` says of losses, and how much each part fell in the step, likewise."""
        fallen = self._before - self._parts
        own = {f"reward_{name}": part for name, part in zip(self.part_names, fallen, strict=True)}
        return self.numbers() | own


def _stacked(parts: Parts) -> Tensor:
    return torch.stack(list(parts.values())).double()
