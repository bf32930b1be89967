"""Whether worlds fit into memory, asked before anything is allocated."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.envs.core.config import EnvConfig
from npa_envs.envs.core.report import DIVERGED, SUCCESS, TIME_LIMIT, Report
from npa_envs.envs.core.task import EnvTask, Start
from npa_envs.errors import DivergedError, NPAError
from npa_envs.world.actions import Actions, Physics, SurveyedWorlds, survey_worlds
from npa_envs.world.cuda_graph import Beside, Replayed, WeakFunction, sent
from npa_envs.world.randomness import WorldRandom

OBSERVATION_COPIES = 4
"""Observations alive at once: the rows, the arrays handed out, the last ones, one to spare."""

LARGEST_INDEX = 2**31 - 1
"""Kernels index the particles' states with 32 bits."""


LISTED_BYTES = 320
"""What CUDA keeps of a particle's neighbours, at most: a list of 128, and what is sorted."""

RECORDED_STARTS = 4 / 3
"""Particles of all recorded restarts together, which have lists of their own, to those of a batch:
1 + 1/4 + 1/16 + ..."""


def needed_bytes(
    world_count: int, particle_count: int, physics: Physics, device: torch.device
) -> int:
    """Return about how much memory worlds take while they are stepped [bytes]."""
    particles = world_count * particle_count
    worlds = 6 * (physics.space_dim + physics.state_dim)
    numbers = OBSERVATION_COPIES * physics.perception_dim + 2 * physics.action_dim + worlds + 16
    listed = LISTED_BYTES * (1.0 + RECORDED_STARTS) if device.type == "cuda" else 0.0
    return int(particles * (4 * numbers + listed))


def free_bytes(device: torch.device) -> int | None:
    """Return the memory that is free on a device [bytes], or None where nobody says."""
    if device.type == "cuda":
        free, _ = torch.cuda.mem_get_info(device)
        cached = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
        return int(free) + cached
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except (OSError, ValueError, IndexError):
        pass
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return None


def check_memory(
    world_count: int,
    particle_count: int,
    physics: Physics,
    device: torch.device,
    extra_bytes: int = 0,
) -> None:
    """Check that worlds fit into a device's memory and into the kernels' indices.

    Args:
        world_count: Worlds B.
        particle_count: Particles in each, N.
        physics: The worlds' constants.
        device: Where they shall live.
        extra_bytes: What the task needs besides.

    Raises:
        NPAError: They do not.
    """
    what = f"{world_count} world(s) of {particle_count} particles"
    cure = "choose a smaller particle_count or fewer worlds"
    if world_count * particle_count * (1 + physics.state_dim) > LARGEST_INDEX:
        raise NPAError(f"particle_count is too large: {what} exceed 32-bit indices: {cure}")
    needed = needed_bytes(world_count, particle_count, physics, device) + extra_bytes
    free = free_bytes(device)
    if free is not None and needed > free:
        raise NPAError(
            f"particle_count must fit into memory: {what} need about {needed / 2**30:.1f} GiB "
            f"with pictures and pool, and {device} has {free / 2**30:.1f} GiB free: {cure}"
        )


# Next episodes for some worlds of a batch.


GROWTH = 4
"""Each recorded size is so many times the one before it."""


class Restarts:
    """Starts of next episodes, on CUDA as one graph and one launch instead of some hundred.

    A recorded start serves a fixed number of worlds. Fewer are filled up by repeating the last one:
    it is then started twice in the same way, which is the same as once.

    Args:
        start: Starts the next episodes of worlds (indices, int64, shape [M]) and returns them made
            ready for perception in the rows of the whole batch. A method's object has to be kept
            by others.
        world_count: Worlds B.
        device: Where they live.
        recorded: Whether `start` may be recorded: it never waits for the device.
    """

    def __init__(
        self,
        start: Callable[[Tensor], SurveyedWorlds],
        world_count: int,
        device: torch.device,
        *,
        recorded: bool,
    ) -> None:
        self._start = WeakFunction(start)
        self._world_count = world_count
        self._device = device
        self._recorded = recorded and device.type == "cuda"
        self._chunks: dict[int, _Chunk] = {}

    def __getstate__(self) -> dict[str, Any]:
        """Leave out recorded starts, which cannot be pickled."""
        return self.__dict__ | {"_chunks": {}}

    def __call__(self, worlds: NDArray[np.int64], observation: Tensor) -> None:
        """Start the next episodes of some worlds.

        Args:
            worlds: Which, shape [M].
            observation: Where to write what is perceived in them, shape [B, N, P].
        """
        if not self._recorded:
            self._start()(sent(worlds, self._device)).perceive(observation)
            return
        size = 1
        while size < len(worlds):
            size = min(size * GROWTH, self._world_count)
        if size not in self._chunks:
            self._chunks[size] = _Chunk(self._start, size, self._device)
        filled = np.full(size, worlds[-1])
        filled[: len(worlds)] = worlds
        self._chunks[size].restart(sent(filled, self._device), observation)


class _Chunk:
    """The recorded start of a fixed number of worlds."""

    def __init__(self, start: WeakFunction, size: int, device: torch.device) -> None:
        self._start = start
        self._index = torch.zeros(size, dtype=torch.int64, device=device)
        self._replayed = Replayed(self._run, device)

    def restart(self, worlds: Tensor, observation: Tensor) -> None:
        """Start the next episodes of as many worlds as the chunk is for."""
        self._index.copy_(worlds)
        self._replayed()
        self._surveyed.perceive(observation)

    def _run(self) -> None:
        self._surveyed: SurveyedWorlds = self._start()(self._index)


# The batch of worlds behind every environment: steps, losses, endings, restarts.
#
# Gymnasium is not known here. A single environment is a batch of one; world k of a batch is, bit
# for bit, that world alone.


# Torch's pool of threads does not survive a fork: a forked worker, as Gymnasium's AsyncVectorEnv
# starts them, would wait for it for ever.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=lambda: torch.set_num_threads(1))


def make_physics(config: EnvConfig, task_type: type[EnvTask[Any]]) -> Physics:
    """Return the constants of the worlds that a configuration describes."""
    return Physics(
        space_dim=task_type.space_dim,
        state_dim=config.state_dim,
        eps=config.eps,
        eps0=config.eps0,
        reach=config.alpha * config.eps,
        state_scale=config.state_scale,
        update_prob=config.update_prob,
        dt=config.dt,
        position_noise=config.position_noise,
        box=None if config.box is None else (config.box,) * task_type.space_dim,
        moving=not task_type.static,
        moment_inverse=config.moment_inverse,
        perception_limit=config.observation_limit,
        position_limit=config.position_limit,
        state_limit=config.observation_limit,
    )


def total(parts: Tensor) -> Tensor:
    """Return the sum of the parts of a loss, [K, B], in their order, which torch's is not."""
    first, *rest = parts.unbind()
    for part in rest:
        first = first + part
    return first


class Worlds:
    """B worlds of one task, stepped together. All tensors stay where they are between steps.

    Args:
        task_type: Gives starts and losses.
        config: The environment's configuration.
        world_count: Worlds B.
        episode_steps: Steps after which an episode is cut off, or None for never.

    Raises:
        NPAError: The worlds do not fit into memory.
    """

    def __init__(
        self,
        task_type: type[EnvTask[Any]],
        config: EnvConfig,
        world_count: int,
        episode_steps: int | None = None,
    ) -> None:
        device = config.torch_device
        self.physics = physics = make_physics(config, task_type)
        # Before the task, which may make a target of as many points.
        extra = task_type.extra_bytes(config, world_count)
        check_memory(world_count, config.particle_count, physics, device, extra)
        self.task = task_type(config, device)
        self.world_count = world_count
        self.episode_steps = episode_steps

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.zeros(world_count, *shape, dtype=dtype, device=device)

        count = config.particle_count
        self.x = zeros(count, physics.space_dim)
        """Positions [length units], shape [B, N, D]."""
        self.s = zeros(count, physics.state_dim)
        """States, dimensionless, shape [B, N, C]."""
        self.random = WorldRandom.from_keys(zeros(dtype=torch.int64))
        """One stream of randomness for each world."""
        self.elapsed = zeros(dtype=torch.int32)
        """Steps since the start of each episode, shape [B]."""
        self.particle_loss = zeros(count) if config.reward == "particle" else None
        """Each particle's share of the loss, shape [B, N], where rewards are shared out."""
        self.particle_reward = zeros(count) if config.reward == "particle" else None
        """Each particle's own reward of the last step, shape [B, N], likewise."""
        self._goal = zeros(dtype=torch.int64)
        self._aimed = self.task.toward(self._goal)
        self._start_loss = zeros()
        self._success_loss = zeros()
        self._diverged = zeros(dtype=torch.uint8)
        self._enabled = torch.ones(1, dtype=torch.uint8, device=device)
        self.part_names: tuple[str, ...] = ()
        """Names of the parts of the loss, known once worlds have been placed."""
        self.report = Report.empty(world_count, 0, device)
        """What a step hands out besides the observation."""
        # Each world's ending, then whether the actions were finite: all that the host reads.
        self._host_endings = torch.zeros(
            world_count + 1, dtype=torch.uint8, pin_memory=device.type == "cuda"
        )
        self._actions = Actions(
            self.x,
            self.s,
            physics,
            self.random,
            enabled=self._enabled,
            diverged=self._diverged,
        )
        self._surveyed: SurveyedWorlds | None = None
        self._draw = Replayed(self._actions.draw, device)
        self._judge_and_survey = Replayed(self._look, device)
        self.restart = Restarts(
            self._start_and_survey, world_count, device, recorded=self.task.start_is_short
        )
        """Starts the next episodes of some worlds: restart(indices, observation)."""
        self._beside = Beside(device) if device.type == "cuda" else None

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what only the next step needs, and which cannot be pickled."""
        return self.__dict__ | {"_surveyed": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Pin memory again that the device writes to."""
        self.__dict__.update(state)
        if self._beside is not None:
            self._host_endings = self._host_endings.pin_memory()

    @property
    def reward(self) -> Tensor:
        """Rewards of the last step, shape [B]."""
        return self.report.numbers[0]

    @property
    def loss(self) -> Tensor:
        """Losses as they are, shape [B]."""
        return self.report.numbers[1]

    @torch.no_grad()
    def start(self, worlds: Tensor, keys: Tensor | None = None) -> Start:
        """Start episodes in some worlds and return their particles.

        Args:
            worlds: Which, int64, shape [M].
            keys: Keys of new streams of randomness, int64, shape [M], which begin with their first
                episode; None: each world goes on to its next one.
        """
        if keys is not None:
            random = WorldRandom.from_keys(keys.to(self.task.device))
        else:
            random = self.random.take(worlds)
            random.restart()
        start = self.task.start(random)
        self.random.put(worlds, random)
        self.elapsed.index_fill_(0, worlds, 0)
        self.place(worlds, start)
        self._start_loss[worlds] = self.loss[worlds]
        if start.success_loss is None:
            self._success_loss.index_fill_(0, worlds, -torch.inf)
        else:
            self._success_loss[worlds] = start.success_loss
        return start

    def _start_and_survey(self, worlds: Tensor) -> SurveyedWorlds:
        start = self.start(worlds)
        return survey_worlds(start.x, start.s, self.physics, places=worlds)

    @torch.no_grad()
    def place(self, worlds: Tensor, start: Start) -> None:
        """Put particles into some worlds, at no reward.

        Args:
            worlds: Which, int64, shape [M].
            start: Their particles.
        """
        x, s = start.x.contiguous(), start.s.contiguous()
        task = self.task
        if self._aimed is not task:
            goal = self._goal[worlds] if start.goal is None else start.goal
            self._goal.index_copy_(0, worlds, goal)
            task = task.toward(goal)
        parts = task.losses(x, s)
        if not self.part_names:
            self.part_names = tuple(parts)
            self.report = Report.empty(self.world_count, len(parts), x.device)
        self.x.index_copy_(0, worlds, x)
        self.s.index_copy_(0, worlds, s)
        values = torch.stack(list(parts.values()))
        still = torch.zeros_like(values)
        numbers = torch.cat((still[:1], total(values)[None], values, still))
        self.report.numbers.index_copy_(1, worlds, numbers)
        if self.particle_loss is not None and self.particle_reward is not None:
            self.particle_loss[worlds] = task.particle_losses(x, s)
            self.particle_reward.index_fill_(0, worlds, 0.0)
        self.report.endings.index_fill_(1, worlds, False)

    @torch.no_grad()
    def perceive(self, out: Tensor | None = None) -> Tensor:
        """Return what is perceived in all worlds as they are, shape [B, N, P].

        Args:
            out: Where to write it; a new tensor otherwise.
        """
        return survey_worlds(self.x, self.s, self.physics).perceive(out)

    @torch.no_grad()
    def reseed(self, worlds: NDArray[np.int64], observation: Tensor) -> None:
        """Start some worlds anew within their episodes; the last step's pay and flags stay.

        Args:
            worlds: Which, shape [M].
            observation: Where to write what is perceived in them, shape [B, N, P].
        """
        index = sent(worlds, self.x.device)
        paid, elapsed = self.report.copy(), self.elapsed.clone()
        own = None if self.particle_reward is None else self.particle_reward.clone()
        self.restart(worlds, observation)
        self.elapsed.copy_(elapsed)
        numbers, before = self.report.numbers, paid.numbers
        numbers[0, index] = before[0, index]
        improvements = slice(2 + len(self.part_names), None)
        numbers[improvements, index] = before[improvements, index]
        self.report.endings.copy_(paid.endings)
        if own is not None and self.particle_reward is not None:
            self.particle_reward.copy_(own)

    def here(self) -> contextlib.AbstractContextManager[Any]:
        """Return a context in which the worlds' device is the current one."""
        return (
            contextlib.nullcontext() if self._beside is None else torch.cuda.device(self.x.device)
        )

    @torch.no_grad()
    def step(self, action: Tensor, out: Tensor | None = None) -> tuple[NDArray[np.uint8], Tensor]:
        """Apply actions to all worlds; return their endings, [B], and what is perceived, [B, N, P].

        The endings are all that the host reads, one byte a world. On CUDA the worlds are judged
        and sorted side by side, and the device perceives while the host reads.

        Args:
            action: Float32, shape [B, N, A], on any device.
            out: Where to write what is perceived; a new tensor otherwise.

        Raises:
            DivergedError: An action is not finite; the worlds, and what is reported of them, are
                then as they were.
        """
        observation = self.queue(action, out)
        if self._beside is not None:
            self._beside.wait()
        if not self._host_endings[-1]:
            self.random.steps -= 1
            self.elapsed -= 1
            raise self._not_finite(action)
        return self._host_endings[:-1].numpy().copy(), observation

    @torch.no_grad()
    def queue(self, action: Tensor, out: Tensor | None = None) -> Tensor:
        """Do what `step` does but wait for the device, and return what is perceived there then."""
        self._draw()
        self._actions.apply(action)
        self._judge_and_survey()
        if self._beside is not None:
            # The host learns the endings while the device perceives.
            self._beside.mark()
        assert self._surveyed is not None, "the worlds were sorted just now"
        return self._surveyed.perceive(out)

    def _look(self) -> None:
        """Judge the worlds and, beside that, sort them."""
        self.elapsed += 1
        with contextlib.nullcontext() if self._beside is None else self._beside.aside():
            self._judge()
        self._surveyed = survey_worlds(self.x, self.s, self.physics)
        if self._beside is not None:
            self._beside.join()

    def _judge(self) -> None:
        """Write rewards, losses and endings of the worlds as they now are."""
        config, task = self.task.config, self._aimed
        diverged = self._diverged.bool()
        # Worlds that have to go on as they are pay and are paid for what they are.
        lost = torch.zeros_like(diverged) if config.on_divergence == "ignore" else diverged
        ended = diverged if config.on_divergence == "terminate" else torch.zeros_like(diverged)
        parts = torch.stack(list(task.losses(self.x, self.s).values()))
        loss = total(parts)
        # Leaving the world must not pay, even where an empty picture is better than the start.
        loss = torch.where(lost, torch.maximum(loss, self._start_loss), loss)
        success = (loss <= self._success_loss) & ~lost
        late = torch.zeros_like(success)
        if self.episode_steps is not None:
            late = self.elapsed >= self.episode_steps
        enabled = self._enabled.bool()
        endings = torch.stack((success | ended, late, success, diverged))
        self.report.endings.copy_(torch.where(enabled, endings, self.report.endings))
        improvement = self.loss - loss
        if self.particle_loss is not None and self.particle_reward is not None:
            shares = task.particle_losses(self.x, self.s)
            own = torch.where(lost[:, None], improvement[:, None], self.particle_loss - shares)
            self.particle_reward.copy_(torch.where(enabled, own, self.particle_reward))
            self.particle_loss.copy_(shares)
        reward = improvement
        if config.reward == "sparse":
            limit = self.episode_steps or config.episode_steps
            over = success | ended | (self.elapsed == limit)
            reward = torch.where(over, -loss, torch.zeros_like(loss))
        numbers = self.report.numbers
        before = numbers[2 : 2 + len(parts)]
        now = torch.cat((reward[None], loss[None], parts, before - parts))
        numbers.copy_(torch.where(enabled, now, numbers))
        ending = SUCCESS * success.byte() + DIVERGED * diverged.byte() + TIME_LIMIT * late.byte()
        self._host_endings.copy_(torch.cat((ending, self._enabled)), non_blocking=True)
        self._enabled.fill_(1)

    def _not_finite(self, action: Tensor) -> DivergedError:
        bad = ~torch.isfinite(action)
        world, particle, entry = (int(k) for k in bad.nonzero()[0])
        return DivergedError(
            f"action must be finite, got {action[world, particle, entry].item()} at world {world}, "
            f"particle {particle}, entry {entry} ({int(bad.sum())} such numbers): check the policy"
        )
