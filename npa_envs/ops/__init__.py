"""SPH operators as torch functions: the one place that knows both torch and Warp.

In all modules `x_bar` is dL/dx, the gradient of the loss L with respect to x.
"""

from npa_envs.ops.perceive import PerceptionFields, perceive, perception_fields
from npa_envs.ops.pictures.cameras import Cameras, cameras_of_poses, look_at, orbit
from npa_envs.ops.pictures.gaussians import GaussianPictures, render_gaussians
from npa_envs.ops.pictures.splat import periodic_splat, splat
from npa_envs.ops.species_density import SpeciesFields, perceive_species, species_fields
from npa_envs.ops.update import apply_actions
from npa_envs.ops.warmup import warmup
from npa_envs.ops.world_mean import world_mean

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
