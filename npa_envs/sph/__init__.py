"""SPH operators as torch functions: the one place that knows both torch and Warp."""

from npa_envs.sph.fields import PerceptionFields, perceive, perception_fields
from npa_envs.sph.splat import splat
from npa_envs.sph.warmup import warmup

__all__ = ["PerceptionFields", "perceive", "perception_fields", "splat", "warmup"]
