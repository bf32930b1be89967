"""SPH operators as torch functions: the one place that knows both torch and Warp."""

from npa_envs.sph.actions import apply_actions
from npa_envs.sph.cameras import Cameras, cameras_of_poses, look_at, orbit
from npa_envs.sph.fields import PerceptionFields, perceive, perception_fields
from npa_envs.sph.gaussians import GaussianPictures, render_gaussians
from npa_envs.sph.periodic_splat import periodic_splat
from npa_envs.sph.species import SpeciesFields, perceive_species, species_fields
from npa_envs.sph.splat import splat
from npa_envs.sph.warmup import warmup
from npa_envs.sph.worlds import world_mean

__all__ = [
    "Cameras",
    "GaussianPictures",
    "PerceptionFields",
    "SpeciesFields",
    "apply_actions",
    "cameras_of_poses",
    "look_at",
    "orbit",
    "perceive",
    "perceive_species",
    "perception_fields",
    "periodic_splat",
    "render_gaussians",
    "species_fields",
    "splat",
    "warmup",
    "world_mean",
]
