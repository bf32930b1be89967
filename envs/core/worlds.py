"""The batch of worlds of an environment: episode starts, steps, rewards and observations.

A single environment is a batch of one. Results of a world do not depend on the others, bit for bit.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from npa_envs import world_mean
from npa_envs.envs.core.config import EnvConfig
from npa_envs.envs.core.graphed_steps import GraphedStarts, GraphedSteps
from npa_envs.envs.core.step_report import REWARDS, ParticleRewards, WorldEpisodes
from npa_envs.envs.core.task import (
    EnvTask,
    Start,
    check_finite,
    check_start,
    checked_losses,
    no_global_draws,
    start_method,
)
from npa_envs.envs.core.world_state import WorldState, check_default_dtype, not_finite
from npa_envs.errors import NPAError, shown
from npa_envs.rule.rule import COLOUR_OFFSET
from npa_envs.world.cuda_graph import SideStream, makes_plain_tensors, to_device_async
from npa_envs.world.environment_steps import (
    DIVERGED,
    NOT_FINITE,
    Actions,
    EpisodeRules,
    NeighbourState,
    flag_unless_finite,
)
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import WorldRandom


class BatchedWorlds(WorldState):
    """Base class: B worlds of one task, with their steps, losses, rewards and episode ends.

    Subclasses define what actions do (`queue`) and what is observed (`perceive`). All tensors keep
    their memory between steps, as CUDA graphs need. Methods that replace particles of some worlds:

    | Method | Called by | Does |
    |---|---|---|
    | `restart` | `step` of vectors, `reseed` | `start`, then observes these worlds |
    | `reseed` | `handle_diverged` | `restart`, but the episodes continue |
    | `start` | `reset` of environments, `restart` | draws and checks a `Start`, then `begin` |
    | `begin` | `start` | `place`, then a new episode |
    | `place` | `place_particles`, `begin` | replaces particles, goals and losses |
    """

    random_steps = 1
    """Steps by which `queue` advances the random streams."""

    @makes_plain_tensors
    def __init__(
        self,
        task_type: type[EnvTask[Any]],
        config: EnvConfig,
        world_count: int,
        episode_steps: int | None = None,
    ) -> None:
        # Memory is checked before the task is made, which may make a target of as many points.
        extra, count = task_type.extra_bytes(config, world_count), config.particle_count
        super().__init__(config, task_type, world_count, count, extra)
        device = self.device
        self.task: EnvTask[Any] = task_type(config, device)
        self.goal = torch.zeros(world_count, dtype=torch.int64, device=device)
        """Index of each world's goal, int64, [B]; zeros where the task has one goal."""
        self.goal_task: EnvTask[Any] = self.task.with_goal(self.goal)
        """The task with losses for the worlds' goals."""

        limits = [steps for steps in (episode_steps, config.episode_steps) if steps is not None]
        self.episode_steps = min(limits, default=None)
        """Steps after which an episode is truncated; None: never."""
        self.side_stream = SideStream(device) if device.type == "cuda" else None
        """CUDA stream of evaluations; the host waits for its mark to read a step's results."""
        rewards_last = self.task.rewards_last_step_only
        if rewards_last and self.episode_steps is None:
            raise NPAError(
                "episode_steps must be given where reward='sparse' comes in the last step, got "
                "None: for example episode_steps=64, and the same number as max_episode_steps of "
                "gymnasium.make"
            )
        self.enabled = torch.ones(1, dtype=torch.uint8, device=device)
        """0 if the last actions were not finite and so not applied, shape [1]."""
        self.diverged = torch.zeros(world_count, dtype=torch.uint8, device=device)
        """1 where a position or state of the world left its bounds in the last step, shape [B]."""
        rewarded_step = self.episode_steps if rewards_last else None
        rules = EpisodeRules(self.episode_steps, rewarded_step, config.on_divergence)
        self.episodes = WorldEpisodes(rules, self.enabled, self.diverged)
        kind = REWARDS[config.reward].particle_rewards
        self.particle_rewards: ParticleRewards | None = kind(self.particles) if kind else None
        """Rewards of single particles, where they have any."""

    @torch.no_grad()
    @makes_plain_tensors
    def start(self, world_indices: Tensor, keys: Tensor | None = None) -> Start:
        """Start episodes in worlds, int64 [B'], and return these; `keys`: as in `next_streams`."""
        random = self.next_streams(world_indices, keys)
        check_default_dtype()
        if not self.episodes.term_names:
            # The first episodes: the task must draw from no global generator.
            with no_global_draws(self.task, start_method(self.task)):
                start = self.task.start(random)
            with no_global_draws(self.task, "losses"):
                return self._begun(world_indices, random, start, check=True)
        # On CUDA a start may be captured as a graph, so that checks must not synchronise.
        start = self.task.start(random)
        return self._begun(world_indices, random, start, check=not self.x.is_cuda)

    def _begun(self, indices: Tensor, random: WorldRandom, start: Start, *, check: bool) -> Start:
        check_start(self.task, start, len(indices), (self.x.shape, self.s.shape))
        if check:
            name = start_method(self.task)
            check_finite(self.task, name, {"positions": start.x, "states": start.s})
        self.random.put(indices, random)
        self.begin(indices, start, check=check)
        return start

    def begin(self, world_indices: Tensor, start: Start, *, check: bool) -> None:
        """Begin episodes of worlds, int64 [B'], at `start`; `check`: losses must be finite."""
        self.place(world_indices, Particles(start.x, start.s, goal=start.goal))
        if check:
            self.check_losses(world_indices)
        self.episodes.begin(world_indices, start.success_loss)

    @torch.no_grad()
    @makes_plain_tensors
    def place(self, world_indices: Tensor, placed: Particles) -> None:
        """Replace particles of worlds, int64 [B'], and goals if given, without a reward."""
        task, goal = self.task, placed.goal
        placed = placed._replace(goal=None).map(Tensor.contiguous)
        if self.goal_task is not task:
            goal = self.goal[world_indices] if goal is None else goal
            self.goal.index_copy_(0, world_indices, goal)
            task = task.with_goal(goal)
        losses = task.losses(placed.x, placed.s)
        terms = checked_losses(task, losses, len(placed.x), self.episodes.term_names)
        self.episodes.put_losses(world_indices, tuple(losses), torch.stack(terms))
        self.particles.put_(world_indices, placed)
        if self.particle_rewards is not None:
            self.particle_rewards.place(world_indices, task, placed)

    def restart(self, world_indices: NDArray[np.int64], observation: Tensor) -> None:
        """Start the next episodes of worlds, [B']; write their rows of `observation`, [B, ...]."""
        index = to_device_async(world_indices, self.device)
        self.start(index)
        observation[index] = self.perceive()[index]

    def perceive(self, out: Tensor | None = None) -> Tensor:
        """Return all worlds' current observations, shape [B, ...], in `out` if it is given."""
        raise NotImplementedError

    @torch.no_grad()
    @makes_plain_tensors
    def reseed(self, world_indices: NDArray[np.int64], observation: Tensor) -> None:
        """Restart worlds, [B'], within their episodes; write their rows of `observation`."""
        rewards = self.particle_rewards
        before = None if rewards is None else rewards.reward.clone()
        with self.episodes.continued(to_device_async(world_indices, self.device)):
            self.restart(world_indices, observation)
        if rewards is not None and before is not None:
            rewards.reward.copy_(before)

    def step(self, action: Tensor, out: Tensor | None = None) -> tuple[NDArray[np.uint8], Tensor]:
        """Apply actions; return ending bits, [B], and observations, [B, ...], in `out` if given.

        Bits are `SUCCESS`, `DIVERGED` and `TIME_LIMIT`; 0: the episode continues.

        Raises:
            DivergedError: An action is not finite; worlds and report are not changed.
            NPAError: The task's losses are not finite.
        """
        observation = self.queue(action, out)
        if self.side_stream is not None:
            self.side_stream.wait()
        read: NDArray[np.uint8] = self.episodes.host_ending_bits.numpy()
        if not read[-1]:
            # The step was not made: the next one draws its random numbers again.
            self.random.undo_advance(self.random_steps)
            raise not_finite(action, of_particles=action.shape[1] == self.particle_count)
        ending_bits = read[:-1].copy()
        if (ending_bits & NOT_FINITE).any():
            self.check_losses(torch.arange(self.world_count, device=self.device))
            raise NPAError(
                f"losses of {type(self.task).__name__} must be finite before and after a step: "
                "correct them, then reset"
            )
        return ending_bits, observation

    def queue(self, action: Tensor, out: Tensor | None = None) -> Tensor:
        """Step the worlds, mark `side_stream`; return observations, [B, ...], in `out` if given."""
        raise NotImplementedError

    def host_observation(self, observation: Tensor) -> Tensor:
        """Return the last step's observation, or its copy on the host if the step made one."""
        return observation

    def evaluate(self) -> None:
        """Write rewards, losses and endings for the current particles into `episodes.report`."""
        losses = self.goal_task.losses(self.x, self.s)
        terms = checked_losses(self.task, losses, len(self.x), self.episodes.term_names)
        self.write_rewards(torch.stack(terms))
        self.episodes.copy_to_host()
        self.enabled.fill_(1)

    def write_rewards(self, terms: Tensor) -> None:
        """Write rewards and endings for new losses, whose terms are `terms`, [terms, B]."""
        rewards = self.particle_rewards
        if rewards is None:
            self.episodes.update(terms)
            return
        gains = rewards.gains(self.goal_task, self.particles)
        self.episodes.update(terms, (~torch.isfinite(gains).all(dim=1)).byte())
        # In worlds that left their bounds each particle gets the world's reward.
        by_world = self.diverged.bool() & (self.task.config.on_divergence != "ignore")
        rewards.write(gains, self.episodes.report.named.reward, by_world, self.enabled)

    def check_losses(self, world_indices: Tensor) -> None:
        """Raise an `NPAError` unless the losses of worlds, int64 [B'], are finite."""
        stored = self.episodes.report.named.terms[:, world_indices]
        terms = zip(self.episodes.term_names, stored, strict=True)
        check_finite(self.task, "losses", {f"term {shown(name)}": term for name, term in terms})
        if self.particle_rewards is not None and self.particle_rewards.loss is not None:
            losses = self.particle_rewards.loss[world_indices]
            check_finite(self.task, "particle_losses", {"losses": losses})

    @property
    def loss(self) -> Tensor:
        """Each world's current loss, shape [B]."""
        loss: Tensor = self.episodes.report.named.loss
        return loss

    def extra_info(self) -> dict[str, Tensor]:
        """Return values that the task adds to infos of resets and steps, by name, [B, ...] each."""
        return self.goal_task.extra_info(self.s)

    def step_info(self) -> dict[str, Tensor]:
        """Return values of particles for infos of steps, by name, [B, N] each."""
        return {}

    def handle_diverged(self, bits: NDArray[np.uint8], observation: Tensor) -> NDArray[np.uint8]:
        """Apply `on_divergence` to worlds that diverged; return their ending bits, [B]."""
        on_divergence = self.task.config.on_divergence
        diverged = bits & DIVERGED != 0
        if on_divergence == "terminate" or not diverged.any():
            return bits
        if on_divergence == "raise":
            raise self.divergence_error(np.flatnonzero(diverged), self.episodes.elapsed)
        if on_divergence == "reset":
            # Worlds that are also truncated start their next episode anyway.
            only_diverged = np.flatnonzero(bits == DIVERGED)
            if len(only_diverged):
                self.reseed(only_diverged, observation)
        return bits & ~np.uint8(DIVERGED)

    def pictures(self, count: int) -> NDArray[np.uint8]:
        """Return pictures of the first worlds, uint8, shape [count, R, R, 3]."""
        first = self.particles.map(lambda value: value[:count])
        return self.task.draw(first, self.episodes.elapsed[:count].cpu().numpy())


class ParticleWorlds(BatchedWorlds):
    """Worlds in which each particle moves and changes its state by its row of an action.

    A particle's row of the observation is what it perceives, then the columns of the task's
    `target_rows` for its world's goal, if the task has them.
    """

    @makes_plain_tensors
    def __init__(
        self,
        task_type: type[EnvTask[Any]],
        config: EnvConfig,
        world_count: int,
        episode_steps: int | None = None,
    ) -> None:
        super().__init__(task_type, config, world_count, episode_steps)
        self._actions = Actions(
            self.x, self.s, self.physics, self.random, enabled=self.enabled, diverged=self.diverged
        )
        returns_arrays = world_count == 1 and config.output == "numpy"
        self.steps = GraphedSteps(
            self.particles,
            self.physics,
            self._actions,
            self.evaluate,
            self.side_stream,
            to_host=returns_arrays and self.task.target_rows is None,
        )
        """Applies the actions of a step, on CUDA by graphs."""
        self._graphed_starts = GraphedStarts(self._start_and_sort, world_count)

    @torch.no_grad()
    @makes_plain_tensors
    def queue(self, action: Tensor, out: Tensor | None = None) -> Tensor:
        """Step the worlds without synchronising; return observations, in `out` if it is given."""
        self.steps.act(action)
        return self._observed(self.steps, out)

    @torch.no_grad()
    @makes_plain_tensors
    def perceive(self, out: Tensor | None = None) -> Tensor:
        """Return all worlds' current observations, shape [B, N, P], in `out` if it is given."""
        return self._observed(NeighbourState(self.x, self.s, self.physics), out)

    def _observed(self, perceived: NeighbourState | GraphedSteps, out: Tensor | None) -> Tensor:
        """Return perceptions and any columns of the targets, [B, N, P], in `out` if it is given."""
        if self.task.target_rows is None:
            return perceived.perceive(out)
        rows = self._with_target(perceived.perceive(), self.goal)
        return rows if out is None else out.copy_(rows)

    def _with_target(self, rows: Tensor, goal: Tensor) -> Tensor:
        assert self.task.target_rows is not None, "only of tasks that observe their targets"
        columns = self.task.target_rows[goal][:, None].expand(-1, rows.shape[1], -1)
        return torch.cat((rows, columns), dim=-1)

    @makes_plain_tensors
    def restart(self, world_indices: NDArray[np.int64], observation: Tensor) -> None:
        """Start the next episodes of worlds, [B']; write their rows of `observation`, [B, N, P]."""
        self.steps.host_is_current = False
        if self.task.target_rows is not None:
            index = to_device_async(world_indices, self.device)
            start = self.start(index)
            rows = NeighbourState(start.x, start.s, self.physics).perceive()
            observation[index] = self._with_target(rows, self.goal[index])
        elif self.x.is_cuda and self.task.start_is_short:
            self._graphed_starts(world_indices, observation)
        else:
            self._start_and_sort(to_device_async(world_indices, self.device)).perceive(observation)

    def _start_and_sort(self, world_indices: Tensor) -> NeighbourState:
        start = self.start(world_indices)
        return NeighbourState(start.x, start.s, self.physics, world_indices=world_indices)

    def host_observation(self, observation: Tensor) -> Tensor:
        """Return the last step's observation, or its copy on the host if the step made one."""
        copied = self.steps.host_perceived
        if not self.steps.host_is_current or copied is None:
            return observation
        # The next step overwrites it. NumPy copies in this thread; torch would wake others, which
        # can take milliseconds.
        return torch.from_numpy(copied.numpy().copy())

    def step_info(self) -> dict[str, Tensor]:
        """Return `particle_reward` and `updated` for infos, if configured, [B, N] each."""
        info: dict[str, Tensor] = {}
        if self.particle_rewards is not None:
            info["particle_reward"] = self.particle_rewards.reward
        if self.task.config.tell_updated:
            info["updated"] = self._actions.updated()
        return info


class CentralWorlds(ParticleWorlds):
    """Worlds in which one controller acts at the places of a grid, and observes a coarse picture.

    A particle's row of the action is interpolated bilinearly between the places around it; outside
    of the grid it is that of the nearest point of its edge.
    """

    @torch.no_grad()
    @makes_plain_tensors
    def queue(self, action: Tensor, out: Tensor | None = None) -> Tensor:
        """Step worlds by finite actions, [B, P², A]; return pictures, in `out` if it is given."""
        size, action = self.task.config.place_count, action.to(self.device)
        flag_unless_finite(action, self.enabled)
        rows = action.reshape(self.world_count, size, size, -1)
        grid, where = rows.permute(0, 3, 1, 2), self._in_square()[:, :, None]
        sampled = F.grid_sample(grid, where, padding_mode="border", align_corners=True)
        self.steps.act(sampled[..., 0].transpose(1, 2).contiguous())
        return self.perceive(out)

    @torch.no_grad()
    @makes_plain_tensors
    def perceive(self, out: Tensor | None = None) -> Tensor:
        """Return all worlds' pictures, shape [B, 4 G²], in `out` if it is given."""
        size, limit = self.task.config.picture_size, self.physics.limits.perception
        pixels = torch.linspace(-1.0, 1.0, size, device=self.device)
        apart = (self._in_square()[..., None] - pixels).abs()
        across, up = (1.0 - apart * (0.5 * (size - 1))).clamp_min(0.0).unbind(dim=2)
        weights = up[..., None] * across[..., None, :]
        colours = self.s[..., -3:] + COLOUR_OFFSET
        values = torch.cat((colours, torch.ones_like(colours[..., :1])), dim=-1)
        values = weights[..., None] * values[:, :, None, None]
        observed = (size**2 * world_mean(values.flatten(2))).clamp(-limit, limit)
        return observed if out is None else out.copy_(observed)

    def _in_square(self) -> Tensor:
        """Return positions, [B, N, 2], where the square of pictures and places is [-1, 1]²."""
        scaled: Tensor = (self.x - self.task.place_middle) / self.task.config.place_reach
        return scaled.clamp(-1.0, 1.0)

    restart = BatchedWorlds.restart
    host_observation = BatchedWorlds.host_observation
