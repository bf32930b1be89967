"""Worlds that several species share: tasks, and the parts of PettingZoo's environments.

`npa_envs.envs.multispecies_v0` and `npa_envs.envs.particles_v0` are the way in. A task says where
species begin and how far each of them is from its goal; `npa_envs.world.environment_steps` moves
the particles. Nothing but `parallel` needs PettingZoo.
"""

from npa_envs.envs.multi.shipped_tasks import TASKS, task_type
from npa_envs.envs.multi.species_task import Population, SpeciesConfig, SpeciesTask
from npa_envs.envs.multi.species_worlds import AGENT_REASONS

__all__ = ["AGENT_REASONS", "TASKS", "Population", "SpeciesConfig", "SpeciesTask", "task_type"]
