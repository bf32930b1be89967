"""Gymnasium wrappers, and adapters to training libraries, imported as `npa_envs.wrappers`.

The adapters are for Stable-Baselines3, TorchRL, RSL-RL, RLlib and Minari. Names are imported at
their first use, so that none of these libraries is needed for the others.
"""

import pkgutil
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from npa_envs.wrappers.base import ParticleRows as ParticleRows
    from npa_envs.wrappers.damage import DamageEvents as DamageEvents
    from npa_envs.wrappers.damage import VectorDamageEvents as VectorDamageEvents
    from npa_envs.wrappers.episode_statistics import (
        TorchRecordEpisodeStatistics as TorchRecordEpisodeStatistics,
    )
    from npa_envs.wrappers.normalize import NormalizePerception as NormalizePerception
    from npa_envs.wrappers.normalize import TorchNormalizeObservation as TorchNormalizeObservation
    from npa_envs.wrappers.normalize import TorchNormalizeReward as TorchNormalizeReward
    from npa_envs.wrappers.normalize import VectorNormalizePerception as VectorNormalizePerception
    from npa_envs.wrappers.rsl_rl import RslRlParticleEnv as RslRlParticleEnv
    from npa_envs.wrappers.sb3 import ParticleVecEnv as ParticleVecEnv
    from npa_envs.wrappers.sb3 import RowPolicy as RowPolicy
    from npa_envs.wrappers.sb3 import SpeciesVecEnv as SpeciesVecEnv
    from npa_envs.wrappers.sb3 import WorldVecEnv as WorldVecEnv
    from npa_envs.wrappers.species_tags import SpeciesTags as SpeciesTags
    from npa_envs.wrappers.species_tags import VectorSpeciesTags as VectorSpeciesTags
    from npa_envs.wrappers.torchrl import NPATorchRLEnv as NPATorchRLEnv

# Not in `__all__`, as a star import must not need optional libraries.
ON_REQUEST = {
    "NPATorchRLEnv": "torchrl",
    "RslRlParticleEnv": "rsl_rl",
    **dict.fromkeys(("ParticleVecEnv", "RowPolicy", "SpeciesVecEnv", "WorldVecEnv"), "sb3"),
}
_PUBLIC_NAMES = {
    "base": "ParticleRows",
    "damage": "DamageEvents VectorDamageEvents",
    "episode_statistics": "TorchRecordEpisodeStatistics",
    "normalize": "NormalizePerception TorchNormalizeObservation TorchNormalizeReward "
    "VectorNormalizePerception",
    "species_tags": "SpeciesTags VectorSpeciesTags",
}
MODULES = {name: module for module, names in _PUBLIC_NAMES.items() for name in names.split()}
__all__ = sorted(MODULES)


def __getattr__(name: str) -> Any:
    module = MODULES.get(name) or ON_REQUEST.get(name)
    if module is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return pkgutil.resolve_name(f"{__name__}.{module}:{name}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *ON_REQUEST})
