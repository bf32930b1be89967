"""SPH operators as torch functions: the one place that knows both torch and Warp."""

from npa_envs.sph.actions import apply_actions
from npa_envs.sph.fields import PerceptionFields, perceive, perception_fields
from npa_envs.sph.periodic_splat import periodic_splat
from npa_envs.sph.splat import splat
from npa_envs.sph.warmup import warmup
from npa_envs.sph.worlds import world_mean

__all__ = [
    "PerceptionFields",
    "apply_actions",
    "perceive",
    "perception_fields",
    "periodic_splat",
    "splat",
    "warmup",
    "world_mean",
]
