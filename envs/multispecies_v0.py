"""Species as agents, as PettingZoo's functions (`parallel_env`, `env`, `raw_env`) and `batched`.

Importing this module registers the ids of `ENVIRONMENTS` with PettingZoo (1.27 or newer).
"""

from __future__ import annotations

from typing import Any

from npa_envs.envs.multi.parallel import CrowdEnv, in_turns, register
from npa_envs.envs.multi.shipped_tasks import SETTINGS, task_settings
from npa_envs.envs.multi.vector import MultiSpeciesVectorEnv
from npa_envs.registration import SPECIES

ENVIRONMENTS = SPECIES
"""Names of tasks by the ids that `pettingzoo.make` takes."""


class MultiSpeciesEnv(CrowdEnv):
    """Species that share one world, each an agent that controls all of its particles.

    ## Description

    A world has particles of S species in the plane, sorted by species. Each particle has a
    position and a state of C numbers. The last three numbers, plus 0.5, are its colour. In every
    step each agent moves all of its particles and changes their states.

    As in the paper, particles perceive particles of all species alike. Species influence each
    other only by perception, and can be told apart only by their particles' states.

    | `task` | Id | What it is about |
    |---|---|---|
    | `"mixing"` | `npa/Mixing-v0` | species that start side by side have to mix |
    | `"segregation"` | `npa/Segregation-v0` | species that start mixed have to separate |
    | `"co_morphogenesis"` | `npa/CoMorphogenesis-v0` | each species grows its own picture |
    | `"invasion"` | `npa/Invasion-v0` | species 0 grows a picture, the others disturb it |
    | `"symbiosis"` | `npa/Symbiosis-v0` | all species grow one picture together |

    `npa/MixingSmall-v0` and the like have 64 particles and episodes of 32 steps;
    `npa/InvasionSmall-v0` has 64 particles of species 0 and 32 invaders that the environment plays.
    `npa/MixingLarge-v0` and the like have 4096 particles and episodes of 256 steps, for a GPU.
    `npa_envs.registration.SPECIES_SIZES` has their keywords. All functions take ids for tasks.

    With `opponent="random"` the environment plays the invaders, by actions uniform in [-1, 1], and
    `species_0` is the only agent.

    In `parallel_env` all agents act at once. In `env` and `raw_env` they act in turn, by
    PettingZoo's own conversion, and the world is stepped after the last. `env` also clips actions
    into their space. `pettingzoo.make`, of PettingZoo 1.27 or newer, takes the ids once
    `npa_envs.envs.multispecies_v0` is imported. `batched` steps
    [many worlds at once](../species.md#many-worlds-at-once), to train on.

    A trained rule is a policy for one species:
    `npa_envs.agents.RulePolicy(npa_envs.load_rule("gecko"))`. Species disturb each other: after 150
    steps of this rule in an invasion with the defaults, the loss of species 0 was 0.66 with
    invaders that did nothing, 0.85 with invaders of the same rule, and 0.94 with random ones (means
    of three seeds).

    ## Observation space

    `Box(-64, 64, (N_k, P), float32)` with P = 4C + 2, for species k: a row for each of its
    particles, always in the same order. The columns are those of
    [`npa/Morphogenesis2D-v0`](Morphogenesis2D.md#observation-space). They do not include species.

    With `perception="per_species"` S (1 + D) more columns follow: the density c² ρ_k / N of each
    species k = 0, 1, ..., and then, species after species, its density gradient, scaled like that
    of all particles. A species that is gone has zeros there. This takes a second pass over the
    world. See [several rules in one world](../species.md#telling-species-apart).

    ## Action space

    `Box(-1, 1, (N_k, A), float32)` with A = 2 + C, for species k. The columns, and what they do,
    are those of [`npa/Morphogenesis2D-v0`](Morphogenesis2D.md#action-space). Every agent in
    `agents` has to give an action; those of agents that ended are ignored. A wrong action, or one
    that is not finite, raises `NPAError` and does not change the world.

    ## Reward

    Each species k has a loss L_k, and its reward is L_k before the step minus L_k after it.

    | Task | L_k | Terms |
    |---|---|---|
    | mixing | 1 minus the mean entropy around its particles | `separation` |
    | segregation | the mean entropy around its particles | `mixture` |
    | co_morphogenesis | its particles' splat loss against `targets[k]` | `density`, `colour` |
    | invasion | L_0: the splat loss of species 0; L_k: -L_0 / (S - 1) | `density`, `colour` |
    | symbiosis | for all: the splat loss of all particles | `density`, `colour` |

    The entropy around a particle is -Σ f_k ln f_k / ln S, where f_k is the fraction of species k
    among the SPH-weighted neighbours within ε, itself included. It is 0 with one species within ε,
    and 1 with equal parts of all. S is the number of species at the start. The splat loss is that
    of [`npa/Morphogenesis2D-v0`](Morphogenesis2D.md#reward). It moves a picture's middle onto the
    target's, so the picture's position does not count.

    There is one reward for each species: `reward="particle"`, `"marginal"` and `tell_updated` are
    for environments of one species. With `reward="team"` every live agent gets the mean of all
    rewards; the terms in `info` stay its own. In an invasion, which has no "team", species 0 gains
    as much as the live invaders lose, in equal parts.

    Rewards of an episode sum to its decrease of L_k, except at deaths: taking particles out changes
    the losses of others, and this change is not rewarded. In the step in which a species leaves the
    world, L_k counts as at least its value at the start plus what deaths added to it; the terms in
    `info` are not changed by this.

    ## Starting state

    Each species is uniform in a disk of radius `seed_radius`, all states are zero. The disks'
    centres lie in a row along x, `seed_distance` apart, their middle at the origin. Seeds are those
    of [`npa/Morphogenesis2D-v0`](Morphogenesis2D.md#starting-state).

    ## Episode end

    | Cause | Ends | Returned as | `info["reason"]` |
    |---|---|---|---|
    | a pair of `deaths` names the species and this step | the species | terminated | 1, removed |
    | all its particles are out of bounds | the species | terminated | 2, left the world |
    | one side of an invasion is gone | all | terminated | 3, no opponent |
    | `max_cycles` steps are done | all | truncated | 4, time limit |

    A particle is out of bounds if a coordinate is clipped to ±`position_limit` or a state to
    ±`observation_limit`. As long as others of its species are within bounds, it stays and may come
    back. A species that ends is removed from `agents` and, except for the survivors of an invasion,
    from the world. The others' observations of that step no longer include it; its own last
    observation still does. No species comes back before `reset`.

    ## Info

    One dict of numbers for each agent that acted, with the same keys after resets and steps.

    | Key | Value |
    |---|---|
    | `species` | the agent's species, from 0 on |
    | `loss` | the current loss L_k |
    | `loss_separation`, ... | its terms, by their names above |
    | `reward_separation`, ... | decrease of each term in this step |
    | `reason` | why the agent's episode ended, see above; 0 before |

    `npa_envs.envs.multi.AGENT_REASONS` has the word of each number of `reason`. `batched` has words
    instead of numbers, in steps in which episodes end.

    ## State

    `state()` is for central critics: float32, shape [N, 2 + C + 1], a row [position; state; 1] for
    each particle that the episode began with, and zeros for particles that are gone. `state_space`
    is its space. `particles()` returns positions and states of the particles that are there, and
    `place_particles(x, s)` replaces them, without a reward.

    ## Rendering

    As in [`npa/Morphogenesis2D-v0`](Morphogenesis2D.md#rendering). With `render_style="species"`
    each species has another colour.

    ## Arguments

    `task` and `species_count` are positional, all others are keywords of `parallel_env`, `env`,
    `raw_env` and `pettingzoo.make`. An unknown name, or a value out of range, raises an `NPAError`
    that says which values are valid.

    ## Version history

    - v0: first version.
    """

    def __init__(self, task: str = "mixing", **config: Any) -> None:
        super().__init__(task, config, by_particle=False)


def parallel_env(
    task: str = "mixing", species_count: int | None = None, **config: Any
) -> MultiSpeciesEnv:
    """Return an environment in which all species act at once.

    Args:
        task: "mixing", "segregation", "co_morphogenesis", "invasion" or "symbiosis"; or an id, such
            as "npa/MixingSmall-v0".
        species_count: Species S: agents `species_0` to `species_{S-1}`; None: 2.
        config: Fields of the task's configuration; docs/environments/MultiSpecies.md lists them.
    """
    return MultiSpeciesEnv(**settings(task, species_count, config))


def batched(
    task: str = "mixing",
    species_count: int | None = None,
    *,
    world_count: int = 1,
    autoreset_mode: str = "same-step",
    **config: Any,
) -> MultiSpeciesVectorEnv:
    """Return many worlds, stepped together on one device; world k is `parallel_env` by itself.

    Arguments are those of `parallel_env` and `MultiSpeciesVectorEnv`.
    """
    return MultiSpeciesVectorEnv(
        world_count=world_count,
        autoreset_mode=autoreset_mode,
        **settings(task, species_count, config),
    )


raw_env, env = in_turns(parallel_env)


def settings(task: str, species_count: int | None, config: dict[str, Any]) -> dict[str, Any]:
    """Return keywords of `MultiSpeciesEnv`: those of a task or an id, replaced by `config`."""
    name, keywords = task_settings(task)
    if species_count is not None:
        keywords["species_count"] = species_count
    return {"task": name, "species_count": 2} | keywords | config


for _id in SETTINGS:
    register(_id, __name__, {"task": _id})
