"""`NumericInfos`, which environments of PettingZoo had to wear for TorchRL."""

from __future__ import annotations

from npa_envs.errors import importing

with importing("PettingZoo", "NumericInfos", "pip install 'npa-envs[envs]'"):
    from pettingzoo.utils.wrappers import BaseParallelWrapper


class NumericInfos(BaseParallelWrapper):  # type: ignore[misc]
    """A parallel environment as it is: infos are numbers, the same in every step, without it.

    Args:
        env: A parallel environment of `npa_envs.envs`.
    """
