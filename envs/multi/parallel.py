"""One world as a PettingZoo environment: agents own particles, and all act at once."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.utils import seeding
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.envs.core.screen import Screen
from npa_envs.envs.core.spaces import to_output
from npa_envs.envs.core.vector import world_keys
from npa_envs.envs.multi.episodes import Episodes
from npa_envs.envs.multi.pettingzoo import ParallelEnv
from npa_envs.envs.multi.pictures import SpeciesView
from npa_envs.envs.multi.spaces import agent_spaces, joined_actions, state_space
from npa_envs.envs.multi.tasks.table import task_type
from npa_envs.errors import NPAError, suggest

Flags = dict[str, bool]
Infos = dict[str, dict[str, Any]]
Outcome = tuple[dict[str, Any], dict[str, float], Flags, Flags, Infos]
"""What a step returns: observations, rewards, terminations, truncations, infos."""


class CrowdEnv(ParallelEnv):  # type: ignore[misc]
    """A world whose particles belong to agents; subclasses say to which.

    Args:
        task: A name from `npa_envs.envs.multi.TASKS`.
        keywords: Fields of the task's configuration.

    Raises:
        NPAError: There is no such task, a keyword is unknown or wrong, or the world does not fit
            into memory.
    """

    metadata: ClassVar[dict[str, Any]] = {
        "name": "npa_crowd",
        "render_modes": ["rgb_array", "human"],
        "render_fps": 25,
        "is_parallelizable": True,
    }

    def __init__(self, task: str, keywords: dict[str, Any]) -> None:
        self._episodes = episodes = Episodes(task, keywords, 1, by_particle=not self.rows)
        self.config = episodes.config
        self.render_mode = self.config.render_mode
        self.max_cycles = self.config.max_cycles
        """Steps after which the episode is cut off for all."""
        self.worlds = worlds = episodes.worlds
        """The particles: a batch of one world."""
        self._task_name = task
        self.possible_agents = [f"{self.agent_word}_{k}" for k in range(worlds.agent_count)]
        self.agents: list[str] = []
        self._live: list[int] = []
        sizes = [span.stop - span.start for span in episodes.spans]
        rows = [(count,) if self.rows else () for count in sizes]
        self.observation_spaces, self.action_spaces = agent_spaces(
            worlds.physics, worlds.perception_dim, self.possible_agents, rows
        )
        self.state_space = state_space(worlds.physics, worlds.particle_count)
        """Space of `state`: float32, shape [N, 2 + C + 1]."""
        self.np_random: np.random.Generator | None = None
        self._started = False
        self._screen = Screen(SpeciesView(worlds), self.metadata["render_fps"])

    agent_word: ClassVar[str]
    """Agents are called this, with a number behind it."""

    rows: ClassVar[bool]
    """Whether agents are species, whose observations and actions have a row for each particle."""

    def observation_space(self, agent: str) -> Box:
        """Return the space of an agent's observations, the same object each time.

        Args:
            agent: One of `possible_agents`.

        Raises:
            NPAError: There is no such agent.
        """
        self._check_agent(agent)
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Box:
        """Return the space of an agent's actions, the same object each time.

        Args:
            agent: One of `possible_agents`.

        Raises:
            NPAError: There is no such agent.
        """
        self._check_agent(agent)
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], Infos]:
        """Start an episode with all agents.

        Args:
            seed: Begin the sequence of episodes that belongs to this number; without it the
                sequence goes on.
            options: Not used.

        Returns:
            Observations, and each agent's loss with its parts.

        Raises:
            gymnasium.error.Error: The seed is no integer of at least 0.
        """
        key = None
        if seed is not None or self.np_random is None:
            self.np_random, _ = seeding.np_random(seed)
            key = world_keys(None, 1, self.np_random)
        with self.worlds.here():
            observation = self._episodes.start(np.arange(1), key)
        self._count_agents()
        self._started = True
        self._show()
        infos = self._infos(self._episodes.account.numbers())
        return self._handed_out(observation), infos

    def step(self, actions: Mapping[str, Any]) -> Outcome:
        """Apply the actions of all live agents, take those that ended out of the world, perceive.

        Args:
            actions: One for each live agent, as its action space says.

        Returns:
            Observations, rewards, whether an agent's episode ended by itself, whether it was cut
            off, and infos: of all agents that acted.

        Raises:
            NPAError: The episode is over, or an action is missing, not wanted, or of another
                shape; the world is then as it was.
            DivergedError: An action is not finite, and the world is as it was; or an agent is out
                of bounds, and `on_divergence` is "raise".
        """
        if not self.agents:
            raise NPAError("step needs a live agent, and there is none: call reset first")
        worlds, acted, live = self.worlds, self.agents, self._live
        shapes = [self.action_spaces[agent].shape for agent in acted]
        action = joined_actions(actions, acted, shapes, worlds.device)
        with worlds.here():
            outcome = self._episodes.step(self._everyones(action))
        ended, late = outcome.endings[0] > 0, bool(outcome.late[0])
        infos = self._infos(outcome.numbers)
        for k, agent in zip(live, acted, strict=True):
            if ended[k] or late:
                infos[agent]["reason"] = outcome.reasons[0, k]
        observations = self._handed_out(outcome.observation)
        paid = outcome.rewards[0].tolist()
        rewards = {agent: paid[k] for k, agent in zip(live, acted, strict=True)}
        terminations = {agent: bool(ended[k]) for k, agent in zip(live, acted, strict=True)}
        self._count_agents()
        self._show()
        return observations, rewards, terminations, dict.fromkeys(acted, late), infos

    def state(self) -> Any:
        """Return what there is to know of the world, for central critics; see `state_space`.

        Returns:
            A row [position ; state ; 1] for each particle that an episode starts with, zeros for
            those that are gone, shape [N, 2 + C + 1].

        Raises:
            NPAError: There is no world yet.
        """
        if not self._started:
            raise NPAError("state needs a world: call reset first")
        return to_output(self.worlds.state()[0], self.config.output)

    def render(self) -> NDArray[np.uint8] | None:
        """Return the world's picture, shape [R, R, 3], in the mode "rgb_array"."""
        if not self._started:
            raise NPAError("render needs a world: call reset first")
        pictures = self._screen.render()
        return None if pictures is None else pictures[0]

    def close(self) -> None:
        """Close the window, if there is one."""
        self._screen.close()

    def particles(self) -> tuple[Tensor, Tensor]:
        """Return copies of positions [length units], [N now, 2], and states, [N now, C]."""
        there = self.worlds.population(0)
        return there.x[0], there.s[0]

    def place_particles(self, x: Any, s: Any) -> dict[str, Any]:
        """Replace the particles of all live agents, at no reward, and return the observations.

        Args:
            x: Positions [length units], shape [N now, 2].
            s: States, dimensionless, shape [N now, C].

        Raises:
            NPAError: A shape is another one, or a number is not finite or beyond its limit.
        """
        if not self.agents:
            raise NPAError("particles need live agents: call reset first")
        with self.worlds.here():
            self.worlds.place(_one_world("x", x), _one_world("s", s))
            observation = self._episodes.carry_over()
        self._show()
        return self._handed_out(observation)

    def _count_agents(self) -> None:
        """Take down who is to act next."""
        self._live = np.flatnonzero(self._episodes.live[0]).tolist()
        self.agents = [self.possible_agents[k] for k in self._live]

    def _everyones(self, action: Tensor) -> Tensor:
        """Return actions of live agents, [N now, A], with zeros for all others, [1, N, A]."""
        count = self.worlds.particle_count
        if len(action) == count:
            return action[None]
        everyone = action.new_zeros(1, count, action.shape[1])
        live = self._episodes.live[0][self.worlds.owner]
        everyone[0, torch.from_numpy(live).to(action.device)] = action
        return everyone

    def _infos(self, numbers: dict[str, Tensor]) -> Infos:
        """Return what `info` says of live agents' losses."""
        rows = torch.stack(list(numbers.values()))[:, 0].tolist()
        columns = dict(zip(numbers, rows, strict=True))
        species = self._episodes.species
        return {
            agent: {"species": int(species[k])} | {name: row[k] for name, row in columns.items()}
            for k, agent in zip(self._live, self.agents, strict=True)
        }

    def _handed_out(self, observation: Tensor) -> dict[str, Any]:
        """Return the rows of what all particles perceive, [1, N, P], that are of `agents`."""
        rows, spans = to_output(observation[0], self.config.output), self._episodes.spans
        return {
            agent: rows[spans[k]] if self.rows else rows[spans[k].start]
            for k, agent in zip(self._live, self.agents, strict=True)
        }

    def _show(self) -> None:
        self._screen.show(f"{self.metadata['name']}: {self._task_name}")

    def _check_agent(self, agent: str) -> None:
        if agent not in self.observation_spaces:
            hint = suggest(str(agent), self.possible_agents[:8])
            raise NPAError(f"agent must be one that exists, got {agent!r}: {hint}")


def _one_world(name: str, value: Any) -> Tensor:
    try:
        return torch.as_tensor(value)[None]
    except (TypeError, ValueError, RuntimeError) as error:
        raise NPAError(
            f"{name} must be an array of numbers, got {type(value).__name__}: see env.particles()"
        ) from error


# Who the agents are: species, or particles.


LARGEST_CROWD = 512
"""No more agents than this: each costs a place in five dicts a step."""


class MultiSpeciesEnv(CrowdEnv):
    """Species that share one world, each an agent that controls all of its particles.

    ## Description

    A world holds particles of K species in the plane, those of each one after the other. Each
    particle has a position and a state of C numbers, of which the last three, plus 0.5, are its
    colour. In every step each agent tells all of its particles where to move and how to change
    their states.

    Particles perceive each other whatever their species, as in the paper: states and densities
    around a particle are those of all. So species influence each other only by what they let others
    perceive, and a species that wants to be told apart has to mark its particles by their states.
    All of them perceive in one pass over the world.

    | `task` | Id | What it is about |
    |---|---|---|
    | `"mixing"` | `npa/Mixing-v0` | species that start side by side are to mix |
    | `"segregation"` | `npa/Segregation-v0` | species that start all mixed are to part |
    | `"co_morphogenesis"` | `npa/CoMorphogenesis-v0` | each grows a picture of its own |
    | `"invasion"` | `npa/Invasion-v0` | species 0 grows a picture, the others keep it from it |
    | `"symbiosis"` | `npa/Symbiosis-v0` | all grow one picture that takes all particles |

    `parallel_env` has all agents act at once. `env` and `raw_env` have them act in turn, by
    PettingZoo's own conversion: the world moves on after the last one; `env` also clips actions
    into their space. The ids are for `pettingzoo.make`, of PettingZoo 1.27 or newer, once
    `npa_envs.envs.multispecies_v0` is imported: both `"parallel"` and `"aec"` are there. `batched`
    steps [many worlds at once](../species.md#many-worlds-at-once), to train on.

    A trained rule is a policy for one species:
    `npa_envs.agents.RulePolicy(npa_envs.load_rule("gecko"))`. Where all species follow the same
    rule, the episode is its rollout. That species disturb each other can be seen in an invasion by
    the defaults: after 150 steps of this rule the loss of species 0 was 0.66 beside invaders that
    did nothing, 0.85 beside some that followed the same rule, and 0.94 beside some that acted at
    random (means of three seeds).

    ## Observation space

    `Box(-64, 64, (N_k, P), float32)` with P = 4C + 2, for species k: a row for each of its
    particles, always in the same order. The columns are those of
    [`npa/Morphogenesis2D-v0`](Morphogenesis2D.md#observation-space). Nothing tells a particle's
    species.

    With `perception="per_species"` K (1 + D) columns follow: what particles perceive of each
    species, its density c² ρ_k / N for k = 0, 1, ..., and then, species after species, its density
    gradient, scaled as that of all is. A species that is gone has zeros there. It takes a second
    pass over the world. See [several rules in one world](../species.md#telling-species-apart).

    ## Action space

    `Box(-1, 1, (N_k, A), float32)` with A = 2 + C, for species k. The columns, and what they do,
    are those of [`npa/Morphogenesis2D-v0`](Morphogenesis2D.md#action-space). Every live agent has
    to give an action, and no other may: see `agents`. What is missing, unwanted, of another shape
    or not finite raises `NPAError` and leaves the world as it was.

    ## Reward

    Each species k has a loss L_k, and its reward is L_k before the step minus L_k after it.

    | Task | L_k | Parts |
    |---|---|---|
    | mixing | 1 less the mean entropy around its particles | `separation` |
    | segregation | the mean entropy around its particles | `mixture` |
    | co_morphogenesis | its particles' splat loss against `targets[k]` | `density`, `colour` |
    | invasion | L_0: the splat loss of species 0; L_k: -L_0 / (K - 1) | `density`, `colour` |
    | symbiosis | for all: the splat loss of all particles | `density`, `colour` |

    The entropy around a particle is -Σ f_k ln f_k / ln K, where f_k is the share of species k among
    the SPH-weighted neighbours within ε, itself included: 0 where it sees its own species alone, 1
    where it sees all in equal parts. K counts the species that there were at the start. The splat
    loss is that of [`npa/Morphogenesis2D-v0`](Morphogenesis2D.md#reward); it moves a picture's
    middle onto the target's, so where the whole thing lies does not count.

    With `reward="team"` every live agent is paid the mean of all; the parts in `info` stay its own.
    In an invasion rewards sum to zero: what species 0 gains, the live invaders lose in equal parts,
    and "team" is refused.

    Rewards telescope but for deaths: particles that are taken out change the others' losses, which
    is nobody's merit and not paid. In the step in which a species leaves the world L_k counts as at
    least its value at the start and what deaths added to it, so that leaving never pays; the parts
    in `info` are as they are.

    ## Starting state

    Each species is uniform in a disk of radius `seed_radius`, all states are zero. The disks'
    centres lie in a row along x, `seed_distance` apart, their middle at the origin.
    `reset(seed=k)` begins the sequence of episodes that belongs to k, and `reset()` goes on with
    the next one.

    ## Episode end

    | Cause | Ends | Returned as | `info["reason"]` |
    |---|---|---|---|
    | a pair of `deaths` names the species and this step | the species | terminated | `"removed"` |
    | all its particles are out of bounds | the species | terminated | `"left the world"` |
    | one side of an invasion is gone | all | terminated | `"no opponent"` |
    | `max_cycles` steps are done | all | truncated | `"time limit"` |

    A particle is out of bounds where a coordinate is held at ±`position_limit` or a state at
    ±`observation_limit`; while others of its species are not, it stays and may come back. A species
    that ends is taken out of `agents` and, but for the survivors of an invasion, out of the world:
    the observations that the others get in that step are already without it, its own last one is
    with it. No species comes back before `reset`.

    ## Info

    One dict for each agent that acted.

    | Key | In | Value |
    |---|---|---|
    | `species` | reset, step | the agent's species, from 0 on |
    | `loss` | reset, step | L_k as it is now |
    | `loss_separation`, ... | reset, step | its parts, by their names above |
    | `reward_separation`, ... | step | how much each part fell in this step |
    | `reason` | last step | why the agent's episode ended, see above |

    ## State

    `state()` is for central critics: float32, shape [N, 2 + C + 1], a row [position; state; 1] for
    each particle that the episode began with, zeros for those that are gone. `state_space` is its
    space. `particles()` returns positions and states of those that are there, and
    `place_particles(x, s)` replaces them, at no reward.

    ## Rendering

    `render_mode="rgb_array"` makes uint8 pictures of shape [R, R, 3], R = `render_size`, with y up.
    `render_mode="human"` shows them in a window; it needs `pip install 'npa-envs[human]'` and a
    screen: without one, it warns once and goes on. With `render_style="species"` each species has a
    colour of its own; the other styles are those of the single environments.

    ## Arguments

    `task` and `species_count` come first, all else is by keyword, in `parallel_env`, `env`,
    `raw_env` and `pettingzoo.make` alike. An unknown name, or a value out of range, raises an
    `NPAError` that says what would be right.

    ## Version history

    - v0: first version.

    Args:
        task: A name from `npa_envs.envs.multi.TASKS`.
        config: Fields of the task's configuration.

    Raises:
        NPAError: A name is unknown, or a value wrong.
    """

    metadata: ClassVar[dict[str, Any]] = CrowdEnv.metadata | {"name": "npa_multispecies_v0"}
    agent_word = "species"
    rows = True

    def __init__(self, task: str = "mixing", **config: Any) -> None:
        super().__init__(task, config)


class ParticlesEnv(CrowdEnv):
    """Few particles that share one world, each an agent.

    ## Description

    The worlds and tasks of [several species](MultiSpecies.md), with the same seeds and the same
    physics, but every particle is an agent: `particle_0`, `particle_1`, ... in the order of their
    species. `info["species"]` tells which one it is of. Each agent costs places in five dicts a
    step, so there are at most 512; beyond, let species be the agents.

    | `task` | Id |
    |---|---|
    | `"mixing"` | `npa/MixingParticles-v0` |
    | `"segregation"` | `npa/SegregationParticles-v0` |
    | `"co_morphogenesis"` | `npa/CoMorphogenesisParticles-v0` |
    | `"invasion"` | `npa/InvasionParticles-v0` |
    | `"symbiosis"` | `npa/SymbiosisParticles-v0` |

    The ids are for `pettingzoo.make`, of PettingZoo 1.27 or newer, once
    `npa_envs.envs.particles_v0` is imported.

    ## Observation space

    `Box(-64, 64, (P,), float32)` with P = 4C + 2: one row of what a species would observe.

    ## Action space

    `Box(-1, 1, (A,), float32)` with A = 2 + C: one row of what a species would do.

    ## Reward

    Each particle has a loss of its own, and its reward is how much it fell in the step.

    | Task | Loss of a particle | Part |
    |---|---|---|
    | mixing | 1 less the entropy around it | `separation` |
    | segregation | the entropy around it | `mixture` |
    | co_morphogenesis | its share of its species' splat loss | `picture` |
    | invasion | species 0: its share of the splat loss; others: -Σ / their number | `picture` |
    | symbiosis | its share of the splat loss of all particles | `picture` |

    A share comes from the errors of the pixels that a particle covers; what nobody covers is shared
    by all alike. The mean of all shares is the splat loss, up to rounding, and Σ is their sum. With
    `reward="team"` every particle is paid the mean of all. In an invasion rewards sum to zero.

    ## Starting state

    As for [several species](MultiSpecies.md#starting-state).

    ## Episode end

    As for [several species](MultiSpecies.md#episode-end), particle by particle: one that is out of
    bounds leaves the world alone, and all those of a species that `deaths` names end together.

    ## Info

    | Key | In | Value |
    |---|---|---|
    | `species` | reset, step | the particle's species, from 0 on |
    | `loss` | reset, step | its loss as it is now |
    | `loss_separation`, ... | reset, step | the same by the name of its part, see above |
    | `reward_separation`, ... | step | how much that fell in this step |
    | `reason` | last step | why the particle's episode ended |

    ## State

    As for [several species](MultiSpecies.md#state).

    ## Rendering

    As for [several species](MultiSpecies.md#rendering).

    ## Arguments

    Those of [several species](MultiSpecies.md#arguments), of `npa_envs.envs.particles_v0` instead;
    `particle_count` is 64 by default and 512 at most.

    ## Version history

    - v0: first version.

    Args:
        task: A name from `npa_envs.envs.multi.TASKS`.
        config: Fields of the task's configuration.

    Raises:
        NPAError: A name is unknown, a value wrong, or there are more than 512 particles.
    """

    metadata: ClassVar[dict[str, Any]] = CrowdEnv.metadata | {"name": "npa_particles_v0"}
    agent_word = "particle"
    rows = False

    def __init__(self, task: str = "mixing", **config: Any) -> None:
        count = sum(task_type(task).config_type.from_keywords(config).counts)
        if count > LARGEST_CROWD:
            raise NPAError(
                f"particle_count must be at most {LARGEST_CROWD} where every particle is an agent, "
                f"got {count}: make species the agents with npa_envs.envs.multispecies_v0"
            )
        super().__init__(task, config)
