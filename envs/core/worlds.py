"""The batch of worlds of an environment: actions, observations, rewards, restarts.

A single environment is a batch of one. Results of a world do not depend on the others, bit for bit.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.envs.core.config import EnvConfig
from npa_envs.envs.core.step_report import ParticleRewards, StepReport, total
from npa_envs.envs.core.task import (
    EnvTask,
    Start,
    check_finite,
    check_no_draws,
    check_start,
    checked_losses,
    global_rng_states,
    start_method,
)
from npa_envs.envs.core.world_state import WorldState, check_default_dtype, not_finite
from npa_envs.errors import DivergedError, NPAError, shown
from npa_envs.world.cuda_graph import (
    GraphedCallable,
    SideStream,
    WeakFunction,
    makes_plain_tensors,
    pinned_like,
    to_device_async,
)
from npa_envs.world.divergence import MAX_REPORT, term_name
from npa_envs.world.environment_steps import (
    DIVERGED,
    NOT_FINITE,
    Actions,
    EpisodeRules,
    EpisodeUpdate,
    NeighbourState,
)
from npa_envs.world.particles import Particles

FEW_PARTICLES = 8192
"""Particles of all worlds up to which a step on CUDA is one graph; larger steps hide launches."""

GROWTH = 4
"""Factor between the numbers of worlds that captured starts serve."""


class BatchedWorlds(WorldState):
    """B worlds of one task, stepped together, with their losses, rewards and episode ends.

    Each particle moves and changes its state by its row of an action. Its row of the observation is
    what it perceives, then the columns of the task's `target_rows` for the world's goal. All
    tensors keep their memory between steps, as CUDA graphs need.
    """

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
        """Index of each world's goal, shape [B]; zeros where the task has one goal."""
        self.goal_task: EnvTask[Any] = self.task.with_goal(self.goal)
        """The task with losses for the worlds' goals."""

        # Episodes.
        limits = [steps for steps in (episode_steps, config.episode_steps) if steps is not None]
        self.episode_steps = min(limits, default=None)
        """Steps after which an episode is truncated; None: never."""
        if self.rewards_last_step_only and self.episode_steps is None:
            raise NPAError(
                "episode_steps must be given where reward='sparse' comes in the last step, got "
                "None: for example episode_steps=64, and the same number as max_episode_steps of "
                "gymnasium.make"
            )
        self.elapsed = torch.zeros(world_count, dtype=torch.int32, device=device)
        """Steps since the start of each episode, shape [B]."""
        self._start_loss = torch.zeros(world_count, device=device)
        self._success_loss = torch.zeros_like(self._start_loss)

        # Actions and observations.
        self.enabled = torch.ones(1, dtype=torch.uint8, device=device)
        """0 if the last actions were not finite and so not applied, shape [1]."""
        self.diverged = torch.zeros(world_count, dtype=torch.uint8, device=device)
        """1 where a position or state of the world left its bounds in the last step, shape [B]."""
        self._actions = Actions(
            self.x, self.s, self.physics, self.random, enabled=self.enabled, diverged=self.diverged
        )
        self._neighbours: NeighbourState | None = None
        self._perceived: Tensor | None = None
        """Perception, shape [B, N, P], that the graph of a step writes; None without one."""
        self._host_perceived: Tensor | None = None
        """Its copy in pinned memory, for a single world with NumPy output."""
        self._host_is_current = False
        """Whether the copy belongs to the last step, and no world restarted since."""

        # Rewards, and what a step reports.
        self.particle_rewards: ParticleRewards | None = None
        """Rewards of single particles, where they have any."""
        if config.per_particle_reward:
            by_loss = config.reward == "particle"
            self.particle_rewards = ParticleRewards(self.particles, by_loss=by_loss)
        self.term_names: tuple[str, ...] = ()
        """Names of the terms of the loss, known once worlds have been placed."""
        self.report = StepReport.empty(world_count, 0, device)
        """What a step returns apart from the observation."""
        # Each world's ending, then whether the actions were finite.
        self._endings = torch.zeros(world_count + 1, dtype=torch.uint8, device=device)
        self._prepare_report()

        # CUDA graphs of a step and of starts, and a stream beside them.
        self._draw = GraphedCallable(self._actions.draw, device)
        self._evaluate_graph = GraphedCallable(self._evaluate_and_sort, device)
        self._step_graph = GraphedCallable(self._act_and_evaluate, device)
        self._graphed_starts: dict[int, GraphedStart] = {}
        """By their numbers of worlds; empty on a CPU."""
        self._side_stream = SideStream(device) if device.type == "cuda" else None

    def __getstate__(self) -> dict[str, Any]:
        # The next step makes these again.
        none = dict.fromkeys(("_neighbours", "_evaluation", "host_endings", "host_numbers"))
        none |= dict.fromkeys(("_perceived", "_host_perceived"))
        return self.__dict__ | none | {"_host_is_current": False, "_graphed_starts": {}}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._prepare_report()

    @makes_plain_tensors
    def _prepare_report(self) -> None:
        """Make what writes the report, and the tensors that the host reads, on CUDA pinned."""
        read = (self._endings, self.report.numbers)
        self.host_endings, self.host_numbers = map(pinned_like, read) if self.x.is_cuda else read
        rewarded_step = self.episode_steps if self.rewards_last_step_only else None
        self._evaluation = EpisodeUpdate(
            EpisodeRules(self.episode_steps, rewarded_step, self.task.config.on_divergence),
            enabled=self.enabled,
            diverged=self.diverged,
            first_loss=self._start_loss,
            success_loss=self._success_loss,
            elapsed=self.elapsed,
            numbers=self.report.numbers,
            flags=self.report.endings,
            endings=self._endings,
        )

    @property
    def rewards_last_step_only(self) -> bool:
        """Whether only the last step of an episode is rewarded."""
        return bool(self.task.config.reward == "sparse")

    @torch.no_grad()
    @makes_plain_tensors
    def start(self, worlds: Tensor, keys: Tensor | None = None) -> Start:
        """Start episodes in worlds of int64 indices [B']; keys are those of `next_streams`."""
        random = self.next_streams(worlds, keys)
        check_default_dtype()
        # The first start is not captured as a graph, so that it can synchronise for checks.
        task, first = self.task, not self.term_names
        draws = global_rng_states(self.device) if first else {}
        check = first or not self.x.is_cuda
        start = task.start(random)
        check_start(task, start, len(worlds), (self.x.shape, self.s.shape))
        if first:
            check_no_draws(task, start_method(task), draws)
        if check:
            check_finite(task, start_method(task), {"positions": start.x, "states": start.s})
        self.random.put(worlds, random)
        self.begin(worlds, start, check=check)
        if first:
            check_no_draws(task, "losses", draws)
        return start

    def begin(self, worlds: Tensor, start: Start, *, check: bool) -> None:
        """Begin episodes with `start` in the worlds of indices `worlds`, int64 [B'].

        `check` raises an error unless all losses are finite, which synchronises with the device.
        """
        self.elapsed.index_fill_(0, worlds, 0)
        self.place(worlds, Particles(start.x, start.s, goal=start.goal))
        if check:
            self.check_losses(worlds)
        self._start_loss[worlds] = self.loss[worlds]
        if start.success_loss is None:
            self._success_loss.index_fill_(0, worlds, -torch.inf)
        else:
            self._success_loss[worlds] = start.success_loss

    @torch.no_grad()
    @makes_plain_tensors
    def place(self, worlds: Tensor, placed: Particles) -> None:
        """Replace the particles of the worlds of indices `worlds`, int64 [B'], without a reward.

        Worlds keep their goals if `placed` has none.
        """
        task, goal = self.task, placed.goal
        placed = placed._replace(goal=None).map(Tensor.contiguous)
        if self.goal_task is not task:
            goal = self.goal[worlds] if goal is None else goal
            self.goal.index_copy_(0, worlds, goal)
            task = task.with_goal(goal)
        terms = task.losses(placed.x, placed.s)
        values = torch.stack(checked_losses(task, terms, len(placed.x), self.term_names))
        if not self.term_names:
            self.term_names = tuple(terms)
            self.report = StepReport.empty(self.world_count, len(terms), self.device)
            self._prepare_report()
        self.particles.put_(worlds, placed)
        zeros = torch.zeros_like(values)
        numbers = torch.cat((zeros[:1], total(values)[None], values, zeros))
        self.report.numbers.index_copy_(1, worlds, numbers)
        if self.particle_rewards is not None:
            self.particle_rewards.place(worlds, task, placed)
        self.report.endings.index_fill_(1, worlds, False)

    def _start_and_sort(self, worlds: Tensor) -> NeighbourState:
        start = self.start(worlds)
        return NeighbourState(start.x, start.s, self.physics, world_indices=worlds)

    @makes_plain_tensors
    def restart(self, worlds: NDArray[np.int64], observation: Tensor) -> None:
        """Start the next episodes of worlds, indices [B']; write their rows of `observation`."""
        if self.task.target_rows is not None:
            index = to_device_async(worlds, self.device)
            start = self.start(index)
            rows = NeighbourState(start.x, start.s, self.physics).perceive()
            observation[index] = self._with_target(rows, self.goal[index])
        elif not (self.x.is_cuda and self.task.start_is_short):
            index = to_device_async(worlds, self.device)
            self._start_and_sort(index).perceive(observation)
        else:
            self._graphed_start(len(worlds))(worlds, observation)

    def _graphed_start(self, count: int) -> GraphedStart:
        """Return a graph for at least `count` worlds; few sizes serve all counts."""
        size = 1
        while size < count:
            size = min(size * GROWTH, self.world_count)
        if size not in self._graphed_starts:
            graph = GraphedStart(self._start_and_sort, size, self.device)
            self._graphed_starts[size] = graph
        return self._graphed_starts[size]

    @torch.no_grad()
    @makes_plain_tensors
    def perceive(self, out: Tensor | None = None) -> Tensor:
        """Return all worlds' current observations, shape [B, ...], in `out` if it is given."""
        return self._observed(NeighbourState(self.x, self.s, self.physics), out)

    def _observed(self, neighbours: NeighbourState, out: Tensor | None) -> Tensor:
        if self.task.target_rows is None:
            return neighbours.perceive(out)
        rows = self._with_target(neighbours.perceive(), self.goal)
        return rows if out is None else out.copy_(rows)

    def _with_target(self, rows: Tensor, goal: Tensor) -> Tensor:
        if self.task.target_rows is None:
            return rows
        columns = self.task.target_rows[goal][:, None].expand(-1, rows.shape[1], -1)
        return torch.cat((rows, columns), dim=-1)

    @torch.no_grad()
    @makes_plain_tensors
    def reseed(self, worlds: NDArray[np.int64], observation: Tensor) -> None:
        """Restart the particles of worlds, indices [B'], within their episodes, unrewarded."""
        self._host_is_current = False
        index, rewards = to_device_async(worlds, self.device), self.particle_rewards
        before, elapsed = self.report.copy(), self.elapsed.clone()
        gains = None if rewards is None else rewards.reward.clone()
        self.restart(worlds, observation)
        self.elapsed.copy_(elapsed)
        self.report.reward[index] = before.reward[index]
        self.report.improvements[:, index] = before.improvements[:, index]
        self.report.endings.copy_(before.endings)
        if rewards is not None and gains is not None:
            rewards.reward.copy_(gains)
        if self.world_count == 1:
            # The host reads the numbers of a single world alone; this synchronises.
            self.host_numbers.copy_(self.report.numbers)

    def step(self, action: Tensor, out: Tensor | None = None) -> tuple[NDArray[np.uint8], Tensor]:
        """Apply actions; return endings, [B], and observations, [B, ...], in `out` if it is given.

        The host reads the endings, one byte per world, and the report of a single world. On CUDA
        evaluation and neighbour search overlap, and the device perceives while the host reads.

        Raises:
            DivergedError: An action is not finite; worlds and report are not changed.
            NPAError: The task's losses are not finite.
        """
        observation = self.queue(action, out)
        if self._side_stream is not None:
            self._side_stream.wait()
        read: NDArray[np.uint8] = self.host_endings.numpy()
        if not read[-1]:
            self.random.steps -= 1
            raise not_finite(action)
        endings = read[:-1].copy()
        if (endings & NOT_FINITE).any():
            self.check_losses(torch.arange(self.world_count, device=self.device))
            raise NPAError(
                f"losses of {type(self.task).__name__} must be finite before and after a step: "
                "correct them, then reset"
            )
        return endings, observation

    @torch.no_grad()
    @makes_plain_tensors
    def queue(self, action: Tensor, out: Tensor | None = None) -> Tensor:
        """Apply actions as `step` does, without synchronising; return observations, [B, ...]."""
        if self.x.is_cuda and self.x.shape[:2].numel() <= FEW_PARTICLES:
            # Copying actions costs less than the launches that the graph replaces.
            self._actions.load(action)
            self._step_graph()
            assert self._side_stream is not None, "CUDA has a side stream"
            assert self._perceived is not None, "the graph writes it"
            self._side_stream.mark()
            rows = self._with_target(self._perceived, self.goal)
            self._host_is_current = self._host_perceived is not None
            if out is not None:
                return out.copy_(rows)
            # The next step overwrites what the graph writes.
            is_shared = rows is self._perceived and not self._host_is_current
            return rows.clone() if is_shared else rows
        self._draw()
        self._actions.apply(action)
        self._evaluate_graph()
        if self._side_stream is not None:
            # The host reads the endings while the device perceives.
            self._side_stream.mark()
        assert self._neighbours is not None, "the evaluation builds them"
        return self._observed(self._neighbours, out)

    def _act_and_evaluate(self) -> None:
        """Apply the stored actions, then evaluate and perceive at the same time."""
        self._actions.draw()
        self._actions.apply_loaded()
        with self._evaluating_on_side():
            if self._perceived is None:
                self._perceived = self.x.new_empty(*self.x.shape[:2], self.physics.perception_dim)
                returns_arrays = self.world_count == 1 and self.task.config.output == "numpy"
                if returns_arrays and self.task.target_rows is None:
                    self._host_perceived = pinned_like(self._perceived)
            NeighbourState(self.x, self.s, self.physics).perceive(self._perceived)
            if self._host_perceived is not None:
                self._host_perceived.copy_(self._perceived, non_blocking=True)

    def _evaluate_and_sort(self) -> None:
        """Evaluate the worlds and, at the same time, search neighbours."""
        with self._evaluating_on_side():
            self._neighbours = NeighbourState(self.x, self.s, self.physics)

    @contextlib.contextmanager
    def _evaluating_on_side(self) -> Iterator[None]:
        """Evaluate the worlds, on CUDA at the same time as what the `with` block launches."""
        with contextlib.nullcontext() if self._side_stream is None else self._side_stream.overlap():
            self.evaluate()
        yield
        if self._side_stream is not None:
            self._side_stream.join()

    def evaluate(self) -> None:
        """Write rewards, losses and endings for the current particles into `report`."""
        losses = self.goal_task.losses(self.x, self.s)
        terms = checked_losses(self.task, losses, len(self.x), self.term_names)
        self.write_rewards(torch.stack(terms))
        if self.x.is_cuda:
            self.host_endings.copy_(self._endings, non_blocking=True)
            if self.world_count == 1:
                self.host_numbers.copy_(self.report.numbers, non_blocking=True)
        self.enabled.fill_(1)

    def write_rewards(self, terms: Tensor) -> None:
        """Write rewards and endings of worlds, and of particles; `terms`: losses, [terms, B]."""
        rewards = self.particle_rewards
        if rewards is None:
            self._evaluation(terms)
            return
        gains = rewards.gains(self.goal_task, self.particles)
        self._evaluation(terms, (~torch.isfinite(gains).all(dim=1)).byte())
        # In worlds that left their bounds each particle gets the world's reward.
        by_world = self.diverged.bool() & (self.task.config.on_divergence != "ignore")
        rewards.write(gains, self.report.reward, by_world, self.enabled)

    def check_losses(self, worlds: Tensor) -> None:
        """Check that the losses of the worlds of indices `worlds`, int64 [B'], are finite."""
        terms = zip(self.term_names, self.report.terms[:, worlds], strict=True)
        check_finite(self.task, "losses", {f"term {shown(name)}": term for name, term in terms})
        if self.particle_rewards is not None and self.particle_rewards.loss is not None:
            losses = self.particle_rewards.loss[worlds]
            check_finite(self.task, "particle_losses", {"losses": losses})

    @property
    def loss(self) -> Tensor:
        """Each world's current loss, shape [B]."""
        return self.report.loss

    def extra_info(self) -> dict[str, Tensor]:
        """Return what the task adds to infos of resets and steps, by name, [B, ...] each."""
        return self.goal_task.extra_info(self.s)

    def step_info(self) -> dict[str, Tensor]:
        """Return `particle_reward` and `updated` for infos, if configured, [B, N] each."""
        info: dict[str, Tensor] = {}
        if self.particle_rewards is not None:
            info["particle_reward"] = self.particle_rewards.reward
        if self.task.config.tell_updated:
            info["updated"] = self._actions.updated()
        return info

    def host_observation(self, observation: Tensor) -> Tensor:
        """Return a single world's observation, on the host if it has been copied there."""
        if not self._host_is_current or self._host_perceived is None:
            return observation
        # The next step overwrites it. NumPy copies in this thread; torch would wake others, which
        # can take milliseconds.
        return torch.from_numpy(self._host_perceived.numpy().copy())

    def handle_diverged(self, endings: NDArray[np.uint8], observation: Tensor) -> NDArray[np.uint8]:
        """Apply `on_divergence` to worlds that diverged; return the endings, [B], that remain."""
        on_divergence = self.task.config.on_divergence
        diverged = endings & DIVERGED != 0
        if on_divergence == "terminate" or not diverged.any():
            return endings
        if on_divergence == "raise":
            raise DivergedError(self._divergence_message(np.flatnonzero(diverged)))
        if on_divergence == "reset":
            # Worlds that are also truncated start their next episode anyway.
            only_diverged = np.flatnonzero(endings == DIVERGED)
            if len(only_diverged):
                self.reseed(only_diverged, observation)
        return endings & ~np.uint8(DIVERGED)

    def pictures(self, count: int) -> NDArray[np.uint8]:
        """Return pictures of the first worlds, uint8, shape [count, R, R, 3]."""
        first = self.particles.map(lambda value: value[:count])
        return self.task.draw(first, self.elapsed[:count].cpu().numpy())

    def _divergence_message(self, diverged: NDArray[np.int64]) -> str:
        physics, lines = self.physics, []
        for world in diverged[:MAX_REPORT].tolist():
            numbers = torch.cat((self.x[world], self.s[world]), dim=1)
            outside = self.x[world].abs() >= physics.limits.position
            outside = torch.cat((outside, self.s[world].abs() >= physics.limits.state), dim=1)
            line = f"world {world} in step {int(self.elapsed[world])}"
            if bool(outside.any()):
                particle, entry = outside.nonzero()[0].tolist()
                line += (
                    f": {term_name(entry, physics.space_dim)} of particle {particle} got to "
                    f"{numbers[particle, entry].item():g} "
                    f"({int(outside.any(dim=1).sum())} such particles)"
                )
            lines.append(line)
        if len(diverged) > MAX_REPORT:
            lines.append(f"and {len(diverged) - MAX_REPORT} more worlds")
        return (
            f"numbers must stay within position_limit = {physics.limits.position:g} and "
            f"observation_limit = {physics.limits.state:g}, but left them in {'; '.join(lines)}: "
            "take smaller actions, raise the limits, or choose on_divergence='terminate' or 'reset'"
        )


class GraphedStart:
    """Starts the next episodes of worlds by one CUDA graph, instead of some hundred launches.

    It serves a fixed number of worlds. If fewer restart, the last index is repeated, and that world
    is started in the same way several times. Only a weak reference to `start` is kept.
    """

    def __init__(
        self, start: Callable[[Tensor], NeighbourState], size: int, device: torch.device
    ) -> None:
        self._start = WeakFunction(start)
        self._worlds = torch.zeros(size, dtype=torch.int64, device=device)
        self._replay = GraphedCallable(self._run, device)

    def __call__(self, worlds: NDArray[np.int64], observation: Tensor) -> None:
        """Start the next episodes of worlds, indices [B']; write what they perceive, [B, N, P]."""
        filled = np.pad(worlds, (0, len(self._worlds) - len(worlds)), mode="edge")
        self._worlds.copy_(to_device_async(filled, self._worlds.device))
        self._replay()
        self._neighbours.perceive(observation)

    def _run(self) -> None:
        self._neighbours: NeighbourState = self._start()(self._worlds)
