"""A wrapper of PettingZoo environments whose infos hold numbers alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from npa_envs.errors import MissingDependencyError

try:
    from pettingzoo.utils.wrappers import BaseParallelWrapper
except ImportError as error:
    raise MissingDependencyError(
        "NumericInfos needs PettingZoo: pip install 'npa-envs[envs]'"
    ) from error

Infos = dict[str, dict[str, Any]]


class NumericInfos(BaseParallelWrapper):  # type: ignore[misc]
    """Infos that have the same entries at reset and in every step, numbers all of them.

    TorchRL's `PettingZooWrapper` takes the entries that there are at reset for all that there will
    ever be, and makes a tensor of each. So losses and their parts stay, and what is known after a
    step only (`reward_...`, `reason`) is left out.

    Args:
        env: A parallel environment of `npa_envs.envs.multispecies_v0` or `particles_v0`.
    """

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], Infos]:
        """Start an episode; as for the environment itself."""
        observations, infos = self.env.reset(seed=seed, options=options)
        self._kept = {agent: tuple(info) for agent, info in infos.items()}
        return observations, infos

    def step(self, actions: Mapping[str, Any]) -> tuple[Any, ...]:
        """Step; as for the environment itself."""
        *outcome, infos = self.env.step(actions)
        kept = {a: {name: info[name] for name in self._kept[a]} for a, info in infos.items()}
        return (*outcome, kept)
