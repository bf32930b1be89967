"""A wrapper that makes the infos of PettingZoo environments numeric, for TorchRL."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from npa_envs.errors import importing

with importing("PettingZoo", "NumericInfos", "pip install 'npa-envs[envs]'"):
    from pettingzoo.utils.wrappers import BaseParallelWrapper

Infos = dict[str, dict[str, Any]]


class NumericInfos(BaseParallelWrapper):  # type: ignore[misc]
    """Reduce the infos of every step to the entries that `reset` returns, all numbers.

    TorchRL's `PettingZooWrapper` expects the entries of `reset` in every step, and makes a tensor
    of each. Losses and their terms stay; entries of steps only (`reward_...`, `reason`) are
    dropped.

    Args:
        env: A parallel environment of `npa_envs.envs.multispecies_v0` or `particles_v0`.
    """

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], Infos]:
        """Start an episode, as the environment does."""
        observations, infos = self.env.reset(seed=seed, options=options)
        self._names = {agent: tuple(info) for agent, info in infos.items()}
        return observations, infos

    def step(self, actions: Mapping[str, Any]) -> tuple[Any, ...]:
        """Step the world, as the environment does, and keep only numeric infos."""
        *outcome, infos = self.env.step(actions)
        numeric = {a: {name: info[name] for name in self._names[a]} for a, info in infos.items()}
        return (*outcome, numeric)
