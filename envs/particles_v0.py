"""Particles as agents, as PettingZoo's functions: `parallel_env`, `env`, `raw_env` and `batched`.

Importing this module registers the ids of `ENVIRONMENTS` with PettingZoo (1.27 or newer).
"""

from __future__ import annotations

from typing import Any

from npa_envs.envs.core.config import as_python
from npa_envs.envs.multi.parallel import CrowdEnv, in_turns, register
from npa_envs.envs.multi.shipped_tasks import SETTINGS, TASKS, task_type
from npa_envs.envs.multi.vector import MultiSpeciesVectorEnv
from npa_envs.envs.multispecies_v0 import settings
from npa_envs.errors import NPAError, check_known
from npa_envs.registration import SPECIES, SPECIES_SIZES

ENVIRONMENTS = {name.replace("-v0", "Particles-v0"): task for name, task in SPECIES.items()}
"""Names of tasks by the ids that `pettingzoo.make` takes."""

SMALL = {
    row.id.replace("Small", "ParticlesSmall"): row.id for row in SPECIES_SIZES if "Small" in row.id
}
"""Ids of small worlds by the ids that `pettingzoo.make` takes."""

PARTICLE_COUNT = 64
"""Default number of particles."""

MAX_CROWD = 512
"""Maximum number of agents; each has an entry in five dicts per step."""


class ParticlesEnv(CrowdEnv):
    """Few particles that share one world, each an agent.

    ## Description

    These are the worlds and tasks of [several species](MultiSpecies.md), with the same seeds and
    the same physics. But every particle is an agent: `particle_0`, `particle_1`, ... in the order
    of their species. Each has an entry in five dicts per step, so there are at most 512. For more
    particles, let species be the agents.

    | `task` | Id |
    |---|---|
    | `"mixing"` | `npa/MixingParticles-v0` |
    | `"segregation"` | `npa/SegregationParticles-v0` |
    | `"co_morphogenesis"` | `npa/CoMorphogenesisParticles-v0` |
    | `"invasion"` | `npa/InvasionParticles-v0` |
    | `"symbiosis"` | `npa/SymbiosisParticles-v0` |

    `npa/SegregationParticlesSmall-v0` and so on have the settings of `npa/SegregationSmall-v0`. A
    policy that all particles share learns there by the defaults of PPO. All functions take the ids,
    and so does `pettingzoo.make`, of PettingZoo 1.27 or newer, once `npa_envs.envs.particles_v0` is
    imported.

    ## Observation space

    `Box(-64, 64, (P,), float32)` with P = 4C + 2: a particle's row of its species' observation.

    ## Action space

    `Box(-1, 1, (A,), float32)` with A = 2 + C: a particle's row of its species' action.

    ## Reward

    Each particle has its own loss, and its reward is the decrease of this loss in the step.

    | Task | Loss of a particle | Term |
    |---|---|---|
    | mixing | 1 minus the entropy around it | `separation` |
    | segregation | the entropy around it | `mixture` |
    | co_morphogenesis | its part of its species' splat loss | `picture` |
    | invasion | species 0: its part of the splat loss; others: -Σ / their number | `picture` |
    | symbiosis | its part of the splat loss of all particles | `picture` |

    A part comes from the errors of the pixels that a particle covers. Errors of pixels that no
    particle covers are divided equally. The mean of all parts is the splat loss, up to rounding,
    and Σ is their sum. With `reward="team"` every particle gets the mean of all rewards. In an
    invasion rewards sum to zero.

    ## Episode end

    As for [several species](MultiSpecies.md#episode-end), particle by particle: one that is out of
    bounds leaves the world by itself; all those of a species that `deaths` names end together.

    ## Info

    As for [several species](MultiSpecies.md#info), of the particle.

    | Key | Value |
    |---|---|
    | `species` | the particle's species, from 0 on |
    | `loss` | its current loss |
    | `loss_separation`, ... | the same by the name of its term, see above |
    | `reward_separation`, ... | its decrease in this step |
    | `reason` | why its episode ended, a number of [these words](MultiSpecies.md#info); 0 before |

    ## Arguments

    Those of [several species](MultiSpecies.md#arguments), of `npa_envs.envs.particles_v0` instead;
    `particle_count` is 64 by default and 512 at most. `particles_v0.batched(..., world_count=B)`
    steps B worlds together: a particle's observations are [B, P], its actions [B, A].
    """

    metadata: Any = CrowdEnv.metadata | {"name": "npa_particles_v0"}

    def __init__(self, task: str = "mixing", **config: Any) -> None:
        super().__init__(task, config, by_particle=True)


class ParticlesVectorEnv(MultiSpeciesVectorEnv):
    """Worlds of `ParticlesEnv`, stepped together: `MultiSpeciesVectorEnv` with other agents.

    Observations of an agent have shape [B, P], actions [B, A], rewards and flags [B].
    """

    metadata = ParticlesEnv.metadata
    _of_particles = True


def parallel_env(
    task: str = "mixing", species_count: int | None = None, **config: Any
) -> ParticlesEnv:
    """Return an environment in which all particles act at once.

    Arguments are those of `multispecies_v0.parallel_env`.
    """
    return ParticlesEnv(**_settings(task, species_count, config))


def batched(
    task: str = "mixing",
    species_count: int | None = None,
    *,
    world_count: int = 1,
    autoreset_mode: str = "same-step",
    **config: Any,
) -> ParticlesVectorEnv:
    """Return many worlds, stepped together; world k is `parallel_env` by itself.

    Arguments are those of `multispecies_v0.batched`.
    """
    keywords = _settings(task, species_count, config)
    return ParticlesVectorEnv(world_count=world_count, autoreset_mode=autoreset_mode, **keywords)


def _settings(task: str, species_count: int | None, config: dict[str, Any]) -> dict[str, Any]:
    """Return keywords as `multispecies_v0.settings`, with few particles."""
    own = ENVIRONMENTS | SMALL
    check_known("task must be a known word, got", task, (*own, *SETTINGS, *TASKS))
    keywords = settings(own.get(task, task), species_count, config)
    if not as_python(keywords.get("particle_counts")):
        keywords.setdefault("particle_count", PARTICLE_COUNT)
    fields = {name: value for name, value in keywords.items() if name != "task"}
    count = sum(task_type(keywords["task"]).config_type.from_keywords(fields).counts)
    if count > MAX_CROWD:
        raise NPAError(
            f"particle_count must be at most {MAX_CROWD} where every particle is an agent, "
            f"got {count}: make species the agents with npa_envs.envs.multispecies_v0"
        )
    return keywords


raw_env, env = in_turns(parallel_env)


for _id, _task in (ENVIRONMENTS | SMALL).items():
    register(_id, __name__, {"task": _task})
