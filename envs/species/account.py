"""What each agent has lost so far, and what a step pays it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from npa_envs.envs.species.task import SpeciesTask

Losses = dict[str, NDArray[np.float64]]
"""Named parts of every agent's loss, shape [agents] each."""


class Account:
    """The losses of all agents, now and before, and rewards for what fell.

    Args:
        task: Says how rewards are settled.
        species: Species of each agent, shape [agents].
        team: Whether each is paid the mean of all.
    """

    def __init__(self, task: SpeciesTask, species: NDArray[np.int64], team: bool) -> None:
        self._task = task
        self._species = species
        self._team = team
        self._parts: Losses = {}
        self._before: Losses = {}
        self._total = self._at_start = self._carried = np.zeros(len(species))

    def open(self, losses: Losses) -> None:
        """Begin an episode.

        Args:
            losses: Of all agents.
        """
        self.carry_over(losses)
        self._at_start = self._total
        self._carried = np.zeros(len(self._total))

    def carry_over(self, losses: Losses) -> None:
        """Count from other losses on, at no reward.

        Args:
            losses: Of all agents; of those that ended nobody asks.
        """
        self._parts = self._before = losses
        total = _sum(losses)
        self._carried = self._carried + (total - self._total)
        self._total = total

    def pay(self, losses: Losses, live: NDArray[np.int64], fled: list[int]) -> NDArray[np.float64]:
        """Take down the losses after a step, and return rewards of the live agents.

        Args:
            losses: Of all agents.
            live: Numbers of the agents that acted.
            fled: Numbers of those that left the world in this step.
        """
        total = _sum(losses)
        # Leaving the world must not pay, even where an empty picture is better than the start, nor
        # give back what a death added at no charge.
        least = self._at_start + np.maximum(self._carried, 0.0)
        total[fled] = np.maximum(total, least)[fled]
        earned = (self._total - total)[live]
        if self._team:
            earned[:] = earned.mean()
        self._parts, self._before, self._total = losses, self._parts, total
        return self._task.settle(earned, self._species[live])

    def info(self, agent: int) -> dict[str, Any]:
        """Return what `info` says of an agent's losses.

        Args:
            agent: Its number.
        """
        parts = {f"loss_{name}": float(values[agent]) for name, values in self._parts.items()}
        return {"species": int(self._species[agent]), "loss": float(self._total[agent])} | parts

    def step_info(self, agent: int) -> dict[str, Any]:
        """Return what `info` says of an agent's losses, and how much each part fell in the step.

        Args:
            agent: Its number.
        """
        fallen = {
            f"reward_{name}": float(self._before[name][agent] - values[agent])
            for name, values in self._parts.items()
        }
        return self.info(agent) | fallen


def _sum(losses: Losses) -> NDArray[np.float64]:
    total: NDArray[np.float64] = np.sum(list(losses.values()), axis=0)
    return total
