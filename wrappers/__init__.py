"""Adapters between environments and the libraries that train on them, as `npa_envs.wrappers`.

Holds Gymnasium wrappers, and adapters to Stable-Baselines3, TorchRL, RSL-RL and RLlib.
They use the public API only. Names are imported when they are first used, so that none of these
libraries is needed for the others.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from npa_envs.wrappers.damage import DamageEvents, VectorDamageEvents
    from npa_envs.wrappers.normalize import NormalizePerception, VectorNormalizePerception
    from npa_envs.wrappers.numeric_infos import NumericInfos as NumericInfos
    from npa_envs.wrappers.row_vector import ParticleRows
    from npa_envs.wrappers.rsl_rl import RslRlParticleEnv as RslRlParticleEnv
    from npa_envs.wrappers.sb3 import ParticleVecEnv as ParticleVecEnv
    from npa_envs.wrappers.sb3 import RowPolicy as RowPolicy
    from npa_envs.wrappers.sb3 import SpeciesVecEnv as SpeciesVecEnv
    from npa_envs.wrappers.sb3 import WorldVecEnv as WorldVecEnv
    from npa_envs.wrappers.species import SpeciesTags, VectorSpeciesTags
    from npa_envs.wrappers.statistics import (
        TorchNormalizeObservation,
        TorchNormalizeReward,
        TorchRecordEpisodeStatistics,
    )
    from npa_envs.wrappers.torchrl import NPATorchRLEnv as NPATorchRLEnv

__all__ = [
    "DamageEvents",
    "NormalizePerception",
    "ParticleRows",
    "SpeciesTags",
    "TorchNormalizeObservation",
    "TorchNormalizeReward",
    "TorchRecordEpisodeStatistics",
    "VectorDamageEvents",
    "VectorNormalizePerception",
    "VectorSpeciesTags",
]
# A star imports all of them, and must need none of the libraries that are optional.
ON_REQUEST = (
    "NPATorchRLEnv",
    "NumericInfos",
    "ParticleVecEnv",
    "RowPolicy",
    "RslRlParticleEnv",
    "SpeciesVecEnv",
    "WorldVecEnv",
)


def __getattr__(name: str) -> Any:
    if name not in __all__ and name not in ON_REQUEST:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name == "NPATorchRLEnv":
        from npa_envs.wrappers import torchrl

        return torchrl.NPATorchRLEnv
    if name == "RslRlParticleEnv":
        from npa_envs.wrappers import rsl_rl

        return rsl_rl.RslRlParticleEnv
    if name in ("ParticleVecEnv", "RowPolicy", "SpeciesVecEnv", "WorldVecEnv"):
        from npa_envs.wrappers import sb3

        return getattr(sb3, name)
    if name == "NumericInfos":
        from npa_envs.wrappers import numeric_infos

        return numeric_infos.NumericInfos
    from npa_envs.wrappers import damage, normalize, row_vector, species, statistics

    holders = (damage, normalize, row_vector, species, statistics)
    return next(getattr(module, name) for module in holders if hasattr(module, name))


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *ON_REQUEST})
