"""Episodes of agents in shared worlds: steps, pay, endings."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs import world_mean
from npa_envs.envs.core.worlds import total
from npa_envs.envs.multi.task import SpeciesTask
from npa_envs.envs.multi.tasks import task_type
from npa_envs.envs.multi.worlds import SpeciesWorlds
from npa_envs.errors import DivergedError
from npa_envs.world.cuda_graph import Beside, sent
from npa_envs.world.divergence import LARGEST_REPORT

Parts = dict[str, Tensor]
"""Named parts of every agent's loss, shape [B, A] each."""


REMOVED, LEFT, ALONE = 1, 2, 3
"""Why an agent's episode ends by itself; 0 where it does not."""
REASONS = np.array([None, "removed", "left the world", "no opponent", "time limit"], dtype=object)
"""The same in words, as `info["reason"]` has them; the last one is for worlds that are cut off."""


class Outcome(NamedTuple):
    """What a step brought all agents of all worlds."""

    observation: Tensor
    """What particles perceive, shape [B, N, P]; the last perception of agents that ended."""

    rewards: Tensor
    """Rewards, 0 of those that did not act, float64, shape [B, A]."""

    numbers: dict[str, Tensor]
    """Losses, their parts, and how much these fell, float64, shape [B, A] each."""

    acted: NDArray[np.bool_]
    """Which agents were alive in this step, shape [B, A]."""

    endings: NDArray[np.uint8]
    """Why agents' episodes ended by themselves, 0 where they did not, shape [B, A]."""

    late: NDArray[np.bool_]
    """Worlds that are cut off, shape [B]."""

    @property
    def reasons(self) -> NDArray[Any]:
        """Why agents' episodes ended, in words, None where they go on or went before, [B, A]."""
        late = np.where(self.acted & self.late[:, None], len(REASONS) - 1, 0)
        return REASONS[np.where(self.endings > 0, self.endings, late)]


class Episodes:
    """B worlds of a task with their agents, the same for every way in which agents are asked.

    Args:
        task: A name from `npa_envs.envs.multi.TASKS`.
        keywords: Fields of the task's configuration.
        world_count: Worlds B.
        by_particle: Whether every particle is an agent, and not every species.

    Raises:
        NPAError: There is no such task, a keyword is unknown or wrong, or the worlds do not fit
            into memory.
    """

    def __init__(
        self, task: str, keywords: dict[str, Any], world_count: int, *, by_particle: bool
    ) -> None:
        found = task_type(task)
        self.config = config = found.config_type.from_keywords(keywords)
        self.worlds = worlds = SpeciesWorlds(found, config, world_count, by_particle=by_particle)
        sizes = np.bincount(worlds.owner)
        ends = np.cumsum(sizes)
        self.spans = [slice(int(e - n), int(e)) for e, n in zip(ends, sizes, strict=True)]
        """Where each agent's particles stand."""
        self.species = worlds.species[ends - 1]
        """Species of each agent, int64, shape [A]."""
        self.live = np.zeros((world_count, len(sizes)), dtype=bool)
        """Which agents are to act next, shape [B, A]."""
        device = worlds.device
        kinds = sent(self.species, device)
        self.account = Account(worlds.task, kinds, world_count, team=config.reward == "team")
        """The agents' losses."""
        self._owner = sent(worlds.owner, device)
        self._by_particle = by_particle
        deaths = dict(config.deaths)
        self._last_step = np.array([deaths.get(int(k), 0) for k in self.species])
        self._beside = Beside(device) if device.type == "cuda" else None
        self._host_left = torch.zeros(
            self.live.shape, dtype=torch.bool, pin_memory=device.type == "cuda"
        )

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Pin memory again that the device writes to."""
        self.__dict__.update(state)
        if self._beside is not None:
            self._host_left = self._host_left.pin_memory()

    def start(self, worlds: NDArray[np.int64], keys: Tensor | None = None) -> Tensor:
        """Start episodes in some worlds, [M], with all agents; return what is perceived, [M, N, P].

        Keys are those of `SpeciesWorlds.start`.
        """
        population = self.worlds.start(worlds, keys)
        parts, seen = self.worlds.opened(population)
        self.account.open(parts, sent(worlds, self.worlds.device))
        self.live[worlds] = True
        return seen

    def step(self, action: Tensor) -> Outcome:
        """Apply actions, pay, and take agents that ended out of their worlds.

        What the host reads is whether agents left their worlds, one byte for each agent.

        Args:
            action: Finite, on the device, shape [B, N, A]; of agents that ended it is not read.

        Raises:
            DivergedError: An agent is out of bounds, and `on_divergence` is "raise".
        """
        worlds, acted = self.worlds, self.live.copy()
        worlds.act(action)
        left = worlds.left()
        if self.config.on_divergence == "ignore":
            left = torch.zeros_like(left)
        self._host_left.copy_(left, non_blocking=True)
        if self._beside is not None:
            self._beside.mark()
        live = sent(acted, worlds.device)
        rewards = self.account.pay(worlds.measured(stepped=True), live, left & live)
        numbers = self.account.step_numbers()
        observation = worlds.perceived(stepped=True)
        # The device goes on while the host learns who left.
        if self._beside is not None:
            self._beside.wait()
        fled = self._host_left.numpy() & acted
        if self.config.on_divergence == "raise" and fled.any():
            raise DivergedError(self._report(fled))
        endings = self._endings(fled)
        late = worlds.open & (worlds.elapsed >= self.config.max_cycles)
        self.live &= endings == 0
        if endings.any():
            observation = self._taken_out(endings, observation)
        self.live[late] = False
        if (worlds.open & self._deserted()).any():
            worlds.close(self._deserted())
        return Outcome(observation, rewards, numbers, acted, endings, late)

    def carry_over(self) -> Tensor:
        """Count losses from now on, at no reward, and return what is perceived, [B, N, P]."""
        self.account.carry_over(self.worlds.measured())
        return self.worlds.perceived()

    def _deserted(self) -> NDArray[np.bool_]:
        """Return in which worlds no agent is to act, shape [B]."""
        return np.asarray(~self.live.any(axis=1))

    def _endings(self, left: NDArray[np.bool_]) -> NDArray[np.uint8]:
        """Return why agents' episodes end by themselves in this step, shape [B, A]."""
        worlds, live = self.worlds, self.live
        endings = np.zeros(live.shape, dtype=np.uint8)
        endings[live & (self._last_step == worlds.elapsed[:, None])] = REMOVED
        endings[live & left] = LEFT
        staying = live & (endings == 0)
        for world in np.flatnonzero((live & ~staying).any(axis=1)):
            present = self.species[staying[world]]
            counts = np.bincount(present, minlength=self.config.species_count)
            if worlds.task.is_over(tuple(counts.tolist())):
                endings[world, staying[world]] = ALONE
        return endings

    def _report(self, fled: NDArray[np.bool_]) -> str:
        """Return an error's message about agents that are out of bounds, shape [B, A]."""
        physics, word = self.worlds.physics, "particle" if self._by_particle else "species"
        places = np.argwhere(fled)
        told = [f"{word}_{agent} of world {world}" for world, agent in places[:LARGEST_REPORT]]
        more = f" and {len(places) - len(told)} more" if len(places) > len(told) else ""
        return (
            f"agents must have a particle within position_limit = {physics.position_limit:g} and "
            f"observation_limit = {physics.state_limit:g}, but {', '.join(told)}{more} had none "
            f"after step {int(self.worlds.elapsed[places[0, 0]])}: take smaller actions, raise the "
            "limits, or choose on_divergence='terminate'"
        )

    def _taken_out(self, endings: NDArray[np.uint8], observation: Tensor) -> Tensor:
        """Take out particles of agents that ended; return what is perceived without them."""
        worlds = self.worlds
        worlds.close(self._deserted())
        worlds.remove((endings == REMOVED) | (endings == LEFT))
        if not worlds.open.any():
            return observation
        # What others lose or gain by a death is nobody's merit: the next step counts from here.
        seen = self.carry_over()
        stays = (endings == 0) & worlds.open[:, None]
        where = sent(stays, worlds.device)[:, self._owner, None]
        return torch.where(where, seen, observation)


class Account:
    """The losses of all agents in B worlds, now and before, and rewards for what fell.

    Args:
        task: Says how rewards are settled.
        species: Species of each agent, int64, shape [A].
        world_count: Worlds B.
        team: Whether each is paid the mean of all.
    """

    def __init__(self, task: SpeciesTask, species: Tensor, world_count: int, *, team: bool) -> None:
        self._task = task
        self._species = species
        self._team = team
        self.part_names: tuple[str, ...] = ()
        """Names of the parts, known once an episode was opened."""
        shape = world_count, len(species)
        zeros = torch.zeros(shape, dtype=torch.float64, device=species.device)
        self.loss = zeros
        """Every agent's loss, float64, shape [B, A]."""
        self._parts = self._before = zeros[None]
        self._at_start = self._carried = zeros

    def open(self, parts: Parts, worlds: Tensor) -> None:
        """Begin episodes in some worlds, int64, [M], by parts of all agents there, [M, A] each."""
        opened = _stacked(parts)
        if not self.part_names:
            self.part_names = tuple(parts)
            self._parts = self._before = self.loss.expand(len(parts), -1, -1)
        loss = total(opened)
        self._parts = self._parts.index_copy(1, worlds, opened)
        self._before = self._before.index_copy(1, worlds, opened)
        self.loss = self.loss.index_copy(0, worlds, loss)
        self._at_start = self._at_start.index_copy(0, worlds, loss)
        self._carried = self._carried.index_fill(0, worlds, 0.0)

    def carry_over(self, parts: Parts) -> None:
        """Count from other losses on, at no reward; of agents that ended nobody asks."""
        self._parts = self._before = _stacked(parts)
        loss = total(self._parts)
        self._carried = self._carried + (loss - self.loss)
        self.loss = loss

    def pay(self, parts: Parts, live: Tensor, fled: Tensor) -> Tensor:
        """Take down the losses after a step, and return rewards, 0 for those that did not act.

        Args:
            parts: Of all agents.
            live: Which agents acted, bool, shape [B, A].
            fled: Which left their world in this step, bool, shape [B, A].

        Returns:
            Rewards, float64, shape [B, A].
        """
        now = _stacked(parts)
        loss = total(now)
        # Leaving the world must not pay, even where an empty picture is better than the start, nor
        # give back what a death added at no charge.
        least = self._at_start + self._carried.clamp_min(0.0)
        loss = torch.where(fled, torch.maximum(loss, least), loss)
        earned = torch.where(live, self.loss - loss, 0.0)
        if self._team:
            share = live.shape[1] / live.sum(dim=1).clamp_min(1)
            mean = world_mean(earned[..., None])[:, 0] * share
            earned = torch.where(live, mean[:, None], 0.0)
        self._parts, self._before, self.loss = now, self._parts, loss
        return self._task.settle(earned, live, self._species)

    def numbers(self) -> dict[str, Tensor]:
        """Return what `info` says of losses, float64, shape [B, A] each."""
        parts = {
            f"loss_{name}": part for name, part in zip(self.part_names, self._parts, strict=True)
        }
        return {"loss": self.loss} | parts

    def step_numbers(self) -> dict[str, Tensor]:
        """Return what `info` says of losses, and how much each part fell in the step, likewise."""
        fallen = self._before - self._parts
        own = {f"reward_{name}": part for name, part in zip(self.part_names, fallen, strict=True)}
        return self.numbers() | own


def _stacked(parts: Parts) -> Tensor:
    return torch.stack(list(parts.values())).double()
