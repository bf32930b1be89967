"""Adapters between environments and the libraries that train on them, as `npa_envs.wrappers`.

Holds Gymnasium wrappers, and adapters to Stable-Baselines3, RLlib and TorchRL.
They use the public API only. Names are imported when they are first used, so that none of these
libraries is needed for the others.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from npa_envs.wrappers.damage import DamageEvents, VectorDamageEvents
    from npa_envs.wrappers.normalize import NormalizePerception, VectorNormalizePerception
    from npa_envs.wrappers.numeric_infos import NumericInfos as NumericInfos
    from npa_envs.wrappers.particles import ParticleVecEnv as ParticleVecEnv
    from npa_envs.wrappers.species import SpeciesTags, VectorSpeciesTags
    from npa_envs.wrappers.species_rows import RowPolicy as RowPolicy
    from npa_envs.wrappers.species_rows import SpeciesVecEnv as SpeciesVecEnv
    from npa_envs.wrappers.statistics import (
        TorchNormalizeObservation,
        TorchNormalizeReward,
        TorchRecordEpisodeStatistics,
    )
    from npa_envs.wrappers.world_rows import WorldVecEnv as WorldVecEnv

__all__ = [
    "DamageEvents",
    "NormalizePerception",
    "SpeciesTags",
    "TorchNormalizeObservation",
    "TorchNormalizeReward",
    "TorchRecordEpisodeStatistics",
    "VectorDamageEvents",
    "VectorNormalizePerception",
    "VectorSpeciesTags",
]
# A star imports all of them, and must need neither Stable-Baselines3 nor PettingZoo.
ON_REQUEST = ("NumericInfos", "ParticleVecEnv", "RowPolicy", "SpeciesVecEnv", "WorldVecEnv")


def __getattr__(name: str) -> Any:
    if name == "ParticleVecEnv":
        from npa_envs.wrappers import particles

        return particles.ParticleVecEnv
    if name == "NumericInfos":
        from npa_envs.wrappers import numeric_infos

        return numeric_infos.NumericInfos
    if name == "WorldVecEnv":
        from npa_envs.wrappers import world_rows

        return world_rows.WorldVecEnv
    if name in ON_REQUEST:
        from npa_envs.wrappers import species_rows

        return getattr(species_rows, name)
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from npa_envs.wrappers import damage, normalize, species, statistics

    holders = (damage, normalize, species, statistics)
    return next(getattr(module, name) for module in holders if hasattr(module, name))


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *ON_REQUEST})
