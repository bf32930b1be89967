"""Worlds of several species, as a batch: episodes, agents' rewards, and removal of particles.

A single world is a batch of one. Results of a world do not depend on the others, bit for bit.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs import world_mean
from npa_envs.checks import number_tensor
from npa_envs.envs.core.step_report import named_terms, total
from npa_envs.envs.core.world_state import OBSERVATION_COPIES, WorldState
from npa_envs.envs.multi.shipped_tasks import task_type
from npa_envs.envs.multi.species_task import Population, SpeciesTask
from npa_envs.errors import DivergedError
from npa_envs.world.cuda_graph import (
    GraphedCallable,
    SideStream,
    makes_plain_tensors,
    to_device_async,
)
from npa_envs.world.divergence import MAX_REPORT
from npa_envs.world.environment_steps import Actions, NeighbourState, perceive_each_species
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import WorldRandom

LossTerms = dict[str, Tensor]
"""Terms of all M agents' losses by name, shape [B, M] each."""

REMOVED, LEFT, NO_OPPONENT, TIME_LIMIT = 1, 2, 3, 4
"""Causes that end an agent's episode; the last one truncates it. 0: none."""
AGENT_REASONS = np.array(
    (None, "removed", "left the world", "no opponent", "time limit", "success", "diverged"), object
)
"""Words for causes, by their numbers; the last two are of worlds with brushes."""


class AgentOutcome(NamedTuple):
    """Results of a step for all M agents of B worlds."""

    observation: Tensor
    """Perception of all particles, [B, N, P]; of agents that ended in the step, their last."""
    rewards: Tensor
    """Rewards, 0 for agents that did not act, float64, shape [B, M]."""
    numbers: dict[str, Tensor]
    """Losses, their terms, and the decrease of each term, float64, shape [B, M] each."""
    acted: NDArray[np.bool_]
    """Whether each agent acted in this step, shape [B, M]."""
    endings: NDArray[np.uint8]
    """Cause that terminated each agent's episode, 0 for none, shape [B, M]."""
    truncated: NDArray[np.bool_]
    """Whether each world is truncated, shape [B]."""

    @property
    def causes(self) -> NDArray[np.int64]:
        """Cause that ended each agent's episode in this step, 0 for none, shape [B, M]."""
        truncated = np.where(self.acted & self.truncated[:, None], TIME_LIMIT, 0)
        return np.where(self.endings > 0, self.endings, truncated)

    @property
    def reasons(self) -> NDArray[Any]:
        """The causes as words, None for none, shape [B, M]."""
        return AGENT_REASONS[self.causes]


class AgentReturns:
    """Losses of all agents in B worlds, and their rewards: the decrease of the losses in a step."""

    def __init__(self, task: SpeciesTask, species: Tensor, world_count: int, *, team: bool) -> None:
        self._task, self._species, self._team = task, species, team
        self.term_names: tuple[str, ...] = ()
        """Names of the terms of the loss; empty before the first episode."""
        zeros = species.new_zeros(world_count, len(species), dtype=torch.float64)
        self.loss = zeros
        """Every agent's loss, float64, shape [B, M]."""
        self._terms = self._terms_before = zeros[None]
        self._start_loss = zeros
        self._unrewarded = zeros
        """Changes of each loss in its episode that gave no reward, float64, shape [B, M]."""

    def begin(self, terms: LossTerms, worlds: Tensor) -> None:
        """Begin episodes in worlds, int64 [B']; `terms`: of the first losses, [B', M] each."""
        first = _stacked(terms)
        if not self.term_names:
            self.term_names = tuple(terms)
            self._terms = self._terms_before = self.loss.expand(len(terms), -1, -1)
        loss = total(first)
        self._terms = self._terms.index_copy(1, worlds, first)
        self._terms_before = self._terms_before.index_copy(1, worlds, first)
        self.loss = self.loss.index_copy(0, worlds, loss)
        self._start_loss = self._start_loss.index_copy(0, worlds, loss)
        self._unrewarded = self._unrewarded.index_fill(0, worlds, 0.0)

    def replace(self, terms: LossTerms) -> None:
        """Store losses, after particles were removed or placed, without a reward."""
        self._terms = self._terms_before = _stacked(terms)
        loss = total(self._terms)
        self._unrewarded = self._unrewarded + (loss - self.loss)
        self.loss = loss

    def step_rewards(self, terms: LossTerms, live: Tensor, diverged: Tensor) -> Tensor:
        """Store losses after a step; return rewards, float64, [B, M]: 0 for agents not `live`."""
        now = _stacked(terms)
        loss = total(now)
        # Leaving the world must not be rewarded, even if an empty picture is better than the start;
        # nor may it undo what a death added without a reward.
        least = self._start_loss + self._unrewarded.clamp_min(0.0)
        loss = torch.where(diverged, torch.maximum(loss, least), loss)
        rewards = torch.where(live, self.loss - loss, 0.0)
        if self._team:
            agents_per_live = live.shape[1] / live.sum(dim=1).clamp_min(1)
            mean = world_mean(rewards[..., None])[:, 0] * agents_per_live
            rewards = torch.where(live, mean[:, None], 0.0)
        self._terms, self._terms_before, self.loss = now, self._terms, loss
        return self._task.final_rewards(rewards, live, self._species)

    def loss_infos(self, *, stepped: bool = False) -> dict[str, Tensor]:
        """Return losses and terms, and if `stepped` each term's decrease, as in infos, [B, M]."""
        numbers = {"loss": self.loss} | named_terms("loss", self.term_names, self._terms)
        if stepped:
            numbers |= named_terms("reward", self.term_names, self._terms_before - self._terms)
        return numbers


def _stacked(terms: LossTerms) -> Tensor:
    return torch.stack(list(terms.values())).double()


class SpeciesWorlds(WorldState):
    """B worlds of a task with their M agents; particles are sorted by species.

    Removed particles are not computed. Worlds with the same remaining particles are stepped
    together, as a `WorldGroup`: all of them as long as no agent has been removed. Agents are
    species, or particles with `by_particle`.
    """

    @makes_plain_tensors
    def __init__(
        self, task: str, keywords: dict[str, Any], world_count: int, *, by_particle: bool
    ) -> None:
        task_class = task_type(task)
        self.config = config = task_class.config_type.from_keywords(keywords)
        count, appended = sum(config.counts), 0
        if config.perception == "per_species":
            # Density and density gradient of each species.
            appended = config.species_count * (1 + task_class.space_dim)
        by_species = 4 * OBSERVATION_COPIES * world_count * count * appended
        super().__init__(config, task_class, world_count, count, by_species)
        self.perception_dim = self.physics.perception_dim + appended
        """Columns of perception: P, and S (1 + D) more with per-species perception."""
        self.task = task_class(config, self.device)
        self.by_particle = by_particle
        self.species = np.repeat(np.arange(config.species_count), config.counts)
        """Species of each particle at the start of an episode, int64, shape [N]."""
        self.owner = np.arange(count) if by_particle else self.species
        """Index of the agent that owns each particle, non-decreasing, int64, shape [N]."""
        sizes = np.bincount(self.owner)
        ends = np.cumsum(sizes)
        self.spans = [slice(int(e - n), int(e)) for e, n in zip(ends, sizes, strict=True)]
        """Slice of each agent's particles."""
        self.agent_species = self.species[ends - 1]
        """Species of each agent, int64, shape [M]."""
        self.live = np.zeros((world_count, len(sizes)), dtype=bool)
        """Whether each agent acts in the next step, shape [B, M]."""
        self.present = np.zeros_like(self.live)
        """Whether each agent's particles are in its world, shape [B, M]."""
        self.running = np.zeros(world_count, dtype=bool)
        """Whether each world's episode continues; the others are not stepped, shape [B]."""
        self.elapsed = np.zeros(world_count, dtype=np.int64)
        """Steps since the start of each episode, shape [B]."""
        device = self.device
        agent_species = to_device_async(self.agent_species, device)
        team = config.reward == "team"
        self.agent_returns = AgentReturns(self.task, agent_species, world_count, team=team)
        """The agents' losses and rewards."""
        self._owner = to_device_async(self.owner, device)
        deaths = config.death_steps
        self._death_step = np.array([deaths.get(int(k), 0) for k in self.agent_species])
        self._side_stream = SideStream(device) if device.type == "cuda" else None
        self._host_diverged = torch.zeros(
            self.live.shape, dtype=torch.bool, device="cpu", pin_memory=device.type == "cuda"
        )
        # Its graphs are kept on CUDA: worlds return to it when their next episodes start.
        everything = np.arange(world_count), np.arange(count)
        self._all_worlds = WorldGroup(self, *everything, self.particles, self.random)
        self._groups: list[WorldGroup] | None = None

    def __setstate__(self, state: dict[str, Any]) -> None:
        # Pickled memory is not pinned.
        self.__dict__.update(state)
        if self._side_stream is not None:
            self._host_diverged = self._host_diverged.pin_memory()

    @torch.no_grad()
    @makes_plain_tensors
    def start(self, worlds: NDArray[np.int64], keys: Tensor | None = None) -> Tensor:
        """Start episodes in worlds, [B']; return their perception; `keys`: as in `next_streams`."""
        self._ungroup()
        index = to_device_async(worlds, self.device)
        random = self.next_streams(index, keys)
        x, s = self.task.start(random)
        self.random.put(index, random)
        self.x.index_copy_(0, index, x)
        self.s.index_copy_(0, index, s)
        self.live[worlds] = self.present[worlds] = self.running[worlds] = True
        self.elapsed[worlds] = 0
        population = self._all_worlds.population._replace(x=x.contiguous(), s=s)
        self.agent_returns.begin(self._all_worlds.loss_terms(population), index)
        return self._all_worlds.perception(population)

    @torch.no_grad()
    @makes_plain_tensors
    def step(self, action: Tensor) -> AgentOutcome:
        """Apply finite actions, [B, N, A], and remove agents that ended; return the results.

        Raises:
            DivergedError: An agent is out of bounds, and `on_divergence` is "raise".
        """
        acted = self.live.copy()
        diverged = torch.zeros_like(self._host_diverged, device=self.device)
        for group in self.groups:
            group.act(action if group is self._all_worlds else action[group.indices])
            if self.config.on_divergence != "ignore":
                diverged.index_copy_(0, group.worlds, group.diverged)
        self.elapsed[self.running] += 1
        self._host_diverged.copy_(diverged, non_blocking=True)
        if self._side_stream is not None:
            self._side_stream.mark()
        live, terms = to_device_async(acted, self.device), self.loss_terms(stepped=True)
        rewards = self.agent_returns.step_rewards(terms, live, diverged & live)
        numbers = self.agent_returns.loss_infos(stepped=True)
        observation = self.perception(stepped=True)
        # The device continues while the host reads who diverged.
        if self._side_stream is not None:
            self._side_stream.wait()
        diverged_agents = self._host_diverged.numpy() & acted
        if self.config.on_divergence == "raise" and diverged_agents.any():
            raise DivergedError(self._divergence_message(diverged_agents))
        endings = self._endings(diverged_agents)
        truncated = self.running & (self.elapsed >= self.config.max_cycles)
        self.live &= endings == 0
        if endings.any():
            observation = self._remove_ended(endings, observation)
        self.live[truncated] = False
        self._stop_finished()
        return AgentOutcome(observation, rewards, numbers, acted, endings, truncated)

    @torch.no_grad()
    @makes_plain_tensors
    def perception(self, *, stepped: bool = False) -> Tensor:
        """Return what particles perceive, [B, N, P]; zeros where they or their world ended.

        `stepped`: particles are as the last step left them, so its neighbour search is reused.
        """
        if self.groups == [self._all_worlds]:
            return self._all_worlds.perception(stepped=stepped)
        perceived = self.x.new_zeros(self.world_count, self.particle_count, self.perception_dim)
        for group in self.groups:
            perceived[group.indices] = group.perception(stepped=stepped)
        return perceived

    def loss_terms(self, *, stepped: bool = False) -> LossTerms:
        """Return the terms of all agents' losses, [B, M] each; `stepped`: of the last step."""
        terms: LossTerms = {}
        for group in self.groups:
            for name, term in (group.terms if stepped else group.loss_terms()).items():
                if name not in terms:
                    terms[name] = term.new_zeros(self.live.shape)
                terms[name].index_copy_(0, group.worlds, term)
        return terms

    @torch.no_grad()
    @makes_plain_tensors
    def place(self, x: Any, s: Any) -> Tensor:
        """Replace a single world's particles without a reward; return perception, [1, N, P]."""
        (group,) = self.groups
        population = group.population
        x, s = number_tensor("x", x)[None], number_tensor("s", s)[None]
        placed = self.checked_particles(x, s, 1, population.x.shape[1])
        population.x.copy_(placed.x)
        population.s.copy_(placed.s)
        self.agent_returns.replace(self.loss_terms())
        return self.perception()

    def population(self, world: int) -> Population:
        """Return the remaining particles of the world with this index."""
        self._copy_from_groups()
        columns = np.flatnonzero(self.present[world][self.owner])
        index = to_device_async(columns, self.device)
        particles = self.particles.map(lambda value: value[world : world + 1, index])
        return population_of(particles, self.species[columns], self.config.species_count)

    @torch.no_grad()
    @makes_plain_tensors
    def state(self) -> Tensor:
        """Return [position; state; 1] of each particle, zeros if removed, [B, N, 2 + C + 1]."""
        self._copy_from_groups()
        present = to_device_async(self.present[:, self.owner], self.device)[..., None]
        return torch.where(present, torch.cat((self.x, self.s, present.float()), dim=-1), 0.0)

    def pictures(self, count: int) -> NDArray[np.uint8]:
        """Return pictures of the first worlds, uint8, shape [count, R, R, 3]."""
        return np.concatenate([self.task.draw(self.population(k)) for k in range(count)])

    def _stop_finished(self) -> None:
        """Stop stepping worlds without a live agent, until their next episodes start."""
        finished = self.running & ~self.live.any(axis=1)
        if finished.any():
            self._ungroup()
            self.running &= ~finished

    def _endings(self, diverged: NDArray[np.bool_]) -> NDArray[np.uint8]:
        """Return the cause that terminates each agent's episode in this step, or 0, [B, M]."""
        live = self.live
        endings = np.zeros(live.shape, dtype=np.uint8)
        endings[live & (self._death_step == self.elapsed[:, None])] = REMOVED
        endings[live & diverged] = LEFT
        if not endings.any():
            return endings
        staying = live & (endings == 0)
        for world in np.flatnonzero((live & ~staying).any(axis=1)):
            present = self.agent_species[staying[world]]
            counts = np.bincount(present, minlength=self.config.species_count)
            if self.task.is_over(tuple(counts.tolist())):
                endings[world, staying[world]] = NO_OPPONENT
        return endings

    def _divergence_message(self, diverged: NDArray[np.bool_]) -> str:
        limits, word = self.physics.limits, "particle" if self.by_particle else "species"
        indices = np.argwhere(diverged)
        names = [f"{word}_{agent} of world {world}" for world, agent in indices[:MAX_REPORT]]
        more = f" and {len(indices) - len(names)} more" if len(indices) > len(names) else ""
        return (
            f"agents must have a particle within position_limit = {limits.position:g} and "
            f"observation_limit = {limits.state:g}, but {', '.join(names)}{more} had none "
            f"after step {int(self.elapsed[indices[0, 0]])}: take smaller actions, raise the "
            "limits, or choose on_divergence='terminate'"
        )

    def _remove_ended(self, endings: NDArray[np.uint8], observation: Tensor) -> Tensor:
        """Remove ended agents' particles; return `observation` as the others perceive then."""
        self._stop_finished()
        self._ungroup()
        self.present &= (endings != REMOVED) & (endings != LEFT)
        if not self.running.any():
            return observation
        # A death changes the losses of others; this is not rewarded.
        self.agent_returns.replace(self.loss_terms())
        stays = (endings == 0) & self.running[:, None]
        where = to_device_async(stays, self.device)[:, self._owner, None]
        return torch.where(where, self.perception(), observation)

    @property
    def groups(self) -> list[WorldGroup]:
        """The worlds whose episodes continue, grouped by their remaining particles."""
        if self._groups is None:
            is_whole = self.running.all() and self.present.all()
            self._groups = [self._all_worlds] if is_whole else self._grouped()
        return self._groups

    @makes_plain_tensors
    def _grouped(self) -> list[WorldGroup]:
        running = np.flatnonzero(self.running & self.present.any(axis=1))
        if not len(running):
            return []
        patterns, pattern_of = np.unique(self.present[running], axis=0, return_inverse=True)
        groups = []
        for k, present in enumerate(patterns):
            worlds = running[pattern_of.reshape(-1) == k]
            columns = np.flatnonzero(present[self.owner])
            index = to_device_async(worlds, self.device)
            indices = index[:, None], to_device_async(columns, self.device)
            particles = Particles(self.x[indices], self.s[indices])
            groups.append(WorldGroup(self, worlds, columns, particles, self.random.take(index)))
        return groups

    def _ungroup(self) -> None:
        """Copy particles from the groups; the next use of `groups` makes new ones."""
        self._copy_from_groups()
        self._groups = None

    def _copy_from_groups(self) -> None:
        """Copy particles and random streams from the groups to the tensors of all worlds."""
        for group in self._groups or ():
            if group is not self._all_worlds:
                self.x[group.indices] = group.population.x
                self.s[group.indices] = group.population.s
                self.random.put(group.worlds, group.random)


class WorldGroup:
    """Worlds of a batch with the same particles left, stepped together."""

    def __init__(
        self,
        batch: SpeciesWorlds,
        worlds: NDArray[np.int64],
        columns: NDArray[np.int64],
        particles: Particles,
        random: WorldRandom,
    ) -> None:
        device = particles.x.device
        self._task, self._physics, self._by_particle = batch.task, batch.physics, batch.by_particle
        self.random = random
        self.worlds = to_device_async(worlds, device)
        self._columns = to_device_async(columns, device)
        self.indices = self.worlds[:, None], self._columns
        """Indices of the group's particles in tensors of all worlds, [B, N, ...]."""
        species_count = batch.config.species_count
        self.population = population_of(particles, batch.species[columns], species_count)
        """The group's particles."""
        self.terms: LossTerms = {}
        """Terms of all agents' losses after the last step, shape [B', M] each."""
        self._agent_count = len(batch.agent_species)
        self.diverged = torch.zeros(len(worlds), self._agent_count, dtype=torch.bool, device=device)
        """Which agents have no particle within bounds after the last step, shape [B', M]."""
        self._owners = to_device_async(batch.owner[columns], device)
        self._neighbours: NeighbourState | None = None
        enabled = torch.ones(1, dtype=torch.uint8, device=device)
        diverged = torch.zeros(len(worlds), dtype=torch.uint8, device=device)
        flags = {"enabled": enabled, "diverged": diverged}
        self._actions = Actions(particles.x, particles.s, batch.physics, random, **flags)
        self._draw = GraphedCallable(self._actions.draw, device)
        self._evaluate_graph = GraphedCallable(self._evaluate, device)

    def __getstate__(self) -> dict[str, Any]:
        # Neighbours cannot be pickled.
        return self.__dict__ | {"_neighbours": None}

    def act(self, action: Tensor) -> None:
        """Apply finite actions, [B', N', A]; compute losses and neighbours, without waiting."""
        action = self._task.with_opponent(action, self.population, self.random)
        self._draw()
        self._actions.apply(action)
        self._evaluate_graph()

    def loss_terms(self, population: Population | None = None) -> LossTerms:
        """Return the terms of all agents' losses, float32, [B', M] each; 0 for removed agents.

        `population`: other positions and states of the same particles; None: the current ones.
        """
        population = population or self.population
        if not self._by_particle:
            return dict(self._task.losses(population))
        losses = self._task.particle_losses(population)
        shape = len(population.x), self._agent_count
        return {
            name: loss.new_zeros(shape).index_copy_(1, self._columns, loss)
            for name, loss in losses.items()
        }

    def perception(self, population: Population | None = None, *, stepped: bool = False) -> Tensor:
        """Return what particles perceive, [B', N', P]; `stepped`: with neighbours of the step."""
        x, s, counts, *_ = population or self.population
        neighbours = self._neighbours if stepped else None
        rows = (neighbours or NeighbourState(x, s, self._physics)).perceive()
        if self._task.config.perception == "per_species":
            rows = torch.cat((rows, perceive_each_species(x, counts, self._physics)), dim=-1)
        return rows

    def _evaluate(self) -> None:
        x, s, physics = self.population.x, self.population.s, self._physics
        limited = [(s, physics.limits.state)]
        # In a box positions reach the limit only by wrapping onto an edge that lies there.
        if physics.boundary == "open":
            limited.append((x, physics.limits.position))
        # A CPU can see that all are inside; CUDA would have to wait for it.
        if not x.is_cuda and all(np.abs(v.numpy()).max() < limit for v, limit in limited):
            self.diverged.zero_()
        else:
            inside = (s.abs() < physics.limits.state).all(dim=-1)
            for values, limit in limited[1:]:
                inside &= (values.abs() < limit).all(dim=-1)
            # Sums of ones are exact in any order.
            count = torch.zeros(len(inside), self._agent_count, device=inside.device)
            self.diverged = count.index_add_(1, self._owners, inside.float()) == 0.0
        if x.is_cuda or self._neighbours is None:
            self.terms = self.loss_terms()
            self._neighbours = NeighbourState(x, s, physics)
        else:
            self._neighbours.update()
            self.terms = self.loss_terms(self.population._replace(neighbours=self._neighbours))


def population_of(
    particles: Particles, species: NDArray[np.int64], species_count: int
) -> Population:
    """Return particles as a `Population`; `species`: of each particle, int64 [N]."""
    counts = tuple(np.bincount(species, minlength=species_count).tolist())
    index = to_device_async(species, particles.x.device)
    return Population(particles.x, particles.s, counts, index)
