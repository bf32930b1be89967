"""The batch of worlds behind every environment: actions, observations, restarts.

Gymnasium is not known in this module. A single environment is a batch of one; world k of a batch
is, bit for bit, that world alone.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.checks import number_tensor
from npa_envs.envs.core.config import EnvConfig, WorldConfig
from npa_envs.envs.core.memory import check_memory
from npa_envs.envs.core.referee import StepReport, WorldReferee
from npa_envs.envs.core.task import (
    EnvTask,
    GlobalDraws,
    Start,
    WorldTask,
    check_finite,
    check_start,
    starter,
)
from npa_envs.errors import DivergedError, NPAError
from npa_envs.world.actions import (
    DIVERGED,
    NOT_FINITE,
    Actions,
    NeighbourState,
    build_neighbours,
)
from npa_envs.world.cuda_graph import (
    GraphedCallable,
    SideStream,
    WeakFunction,
    makes_plain_tensors,
    pinned_like,
    to_device_async,
)
from npa_envs.world.divergence import LARGEST_REPORT, term_name
from npa_envs.world.randomness import WorldRandom

FEW_PARTICLES = 8192
"""Particles of all worlds up to which a step on CUDA is one graph: larger ones hide launches."""


def check_default_dtype() -> None:
    """Check that what tasks make by default is float32, as the worlds are."""
    dtype = torch.get_default_dtype()
    if dtype != torch.float32:
        raise NPAError(
            f"environments need torch's default dtype to be torch.float32, got {dtype}: call "
            "torch.set_default_dtype(torch.float32), and give other tensors their dtype"
        )


class WorldState:
    """Particles of B worlds on a device, a stream of randomness for each world."""

    def __init__(
        self,
        config: WorldConfig,
        task_type: type[WorldTask[Any]],
        world_count: int,
        particle_count: int,
        extra_bytes: int,
    ) -> None:
        check_default_dtype()
        self.device = device = config.torch_device
        self.world_count = world_count
        self.particle_count = particle_count
        self.physics = physics = config.physics(task_type.space_dim, static=task_type.static)
        """The worlds' constants."""
        check_memory(world_count, particle_count, physics, device, extra_bytes)
        self.x = torch.zeros(world_count, particle_count, physics.space_dim, device=device)
        """Positions [length units], shape [B, N, D]."""
        self.s = torch.zeros(world_count, particle_count, physics.state_dim, device=device)
        """States, dimensionless, shape [B, N, C]."""
        keys = torch.zeros(world_count, dtype=torch.int64, device=device)
        self.random = WorldRandom.from_keys(keys)
        """One stream of randomness for each world."""

    def next_streams(self, worlds: Tensor, keys: Tensor | None) -> WorldRandom:
        """Return the streams of randomness that some worlds', [M], next episodes begin with.

        Those with keys, int64, shape [M], are new and begin with their first episode; without, each
        world goes on to its next one.
        """
        if keys is not None:
            return WorldRandom.from_keys(keys.to(self.device))
        random = self.random.take(worlds)
        random.restart()
        return random

    def checked_particles(self, x: Any, s: Any, world_count: int, particle_count: int) -> Start:
        """Return particles to be put into M worlds of N, float32 on the device."""
        given, physics = [], self.physics
        for name, value, width, limit, limit_name in (
            ("x", x, physics.space_dim, physics.limits.position, "position_limit"),
            ("s", s, physics.state_dim, physics.limits.state, "observation_limit"),
        ):
            tensor = number_tensor(name, value).to(self.device, torch.float32)
            wanted = (world_count, particle_count, width)
            if tuple(tensor.shape) != wanted:
                raise NPAError(
                    f"{name} must have shape {wanted} (worlds, particles, entries), "
                    f"got {tuple(tensor.shape)}: see env.unwrapped.particles()"
                )
            if not bool((tensor.abs() <= limit).all()):
                raise NPAError(
                    f"{name} must be finite and within {limit_name} = {limit:g}, got numbers up to "
                    f"{float(tensor.abs().max())}: clip it, or make the environment with a larger "
                    "limit"
                )
            given.append(tensor)
        return Start(*given)

    def device_context(self) -> contextlib.AbstractContextManager[Any]:
        """Return a context in which the worlds' device is the current one."""
        if not self.x.is_cuda or torch.cuda.current_device() == self.device.index:
            return contextlib.nullcontext()
        return torch.cuda.device(self.device)


class Action(Protocol):
    """What an action does to worlds, in place."""

    recorded: bool
    """Whether a step may be recorded on CUDA: it is that of an `Actions`."""

    def apply(self, action: Tensor) -> None:
        """Apply actions to all worlds, float32, shape [B, ...]."""

    def updated(self) -> Tensor:
        """Return which particles the last step updated, bool, shape [B, N]."""


class Observer(Protocol):
    """What is observed of worlds."""

    perceives_alone: bool
    """Whether that is what particles perceive, and nothing else."""

    def observe(
        self, worlds: BatchedWorlds, perceived: Tensor | None, out: Tensor | None
    ) -> Tensor:
        """Return the observations of all worlds, written to `out`.

        `perceived` is what particles perceive, [B, N, P], where a step has computed it already.
        """

    def begun(self, worlds: BatchedWorlds, index: Tensor, start: Start) -> Tensor:
        """Return the observations of worlds that began an episode, int64, [M]."""


class ParticleAction(Actions):
    """A displacement and a state step for each particle."""

    recorded = True

    def __init__(self, worlds: BatchedWorlds) -> None:
        referee = worlds.referee
        super().__init__(
            worlds.x,
            worlds.s,
            worlds.physics,
            worlds.random,
            enabled=referee.enabled,
            diverged=referee.diverged,
        )


class Perception:
    """What each particle perceives, then the task's `target_rows` for the world's goal."""

    def __init__(self, worlds: BatchedWorlds) -> None:
        self._target: Tensor | None = worlds.task.target_rows
        self.perceives_alone = self._target is None

    def observe(
        self, worlds: BatchedWorlds, perceived: Tensor | None, out: Tensor | None
    ) -> Tensor:
        """Return perception, shape [B, N, P], with target columns [B, N, P + T]."""
        if self._target is None and perceived is None:
            return build_neighbours(worlds.x, worlds.s, worlds.physics).perceive(out)
        if perceived is None:
            perceived = build_neighbours(worlds.x, worlds.s, worlds.physics).perceive()
        rows = self._with_target(perceived, worlds.referee.goal)
        return rows if out is None else out.copy_(rows)

    def begun(self, worlds: BatchedWorlds, index: Tensor, start: Start) -> Tensor:
        """Return the observations of worlds that began an episode."""
        rows = build_neighbours(start.x, start.s, worlds.physics).perceive()
        return self._with_target(rows, worlds.referee.goal[index])

    def _with_target(self, rows: Tensor, goal: Tensor) -> Tensor:
        if self._target is None:
            return rows
        columns = self._target[goal][:, None].expand(-1, rows.shape[1], -1)
        return torch.cat((rows, columns), dim=-1)


class Parts(NamedTuple):
    """What a batch of worlds is made of."""

    action: Callable[[BatchedWorlds], Action]
    observer: Callable[[BatchedWorlds], Observer]
    referee: type[WorldReferee]


PARTICLES = Parts(ParticleAction, Perception, WorldReferee)
"""Worlds whose particles act and perceive."""


class BatchedWorlds(WorldState):
    """B worlds of one task, stepped together. All tensors stay where they are between steps.

    Args:
        task_type: Gives starts and losses.
        config: The environment's configuration.
        world_count: Worlds B.
        episode_steps: Steps after which an episode is cut off, or None for never.

    Raises:
        NPAError: The worlds do not fit into memory.
    """

    @makes_plain_tensors
    def __init__(
        self,
        task_type: type[EnvTask[Any]],
        config: EnvConfig,
        world_count: int,
        episode_steps: int | None = None,
    ) -> None:
        parts: Parts = task_type.parts or PARTICLES
        # Memory is checked before the task is made, which may make a target of as many points.
        extra, count = task_type.extra_bytes(config, world_count), config.particle_count
        super().__init__(config, task_type, world_count, count, extra)
        self.task: Any = task_type(config, self.device)
        self.referee = parts.referee(self.task, self, episode_steps)
        """What judges the worlds."""
        self.action: Any = parts.action(self)
        """What an action does."""
        self.observer = parts.observer(self)
        """What is observed."""
        self._perceived: Tensor | None = None
        """What is perceived, [B, N, P], where a step is one graph."""
        self._host_perceived: Tensor | None = None
        """The same of a single world that is returned as arrays, in pinned memory."""
        self._host_is_current = False
        """Whether that is of the last step, after which no world began anew."""
        self._neighbours: NeighbourState | None = None
        self._make_graphs()
        self._resets = GraphedResets(
            self._start_and_sort, world_count, self.device, recorded=self.task.start_is_short
        )
        self._side_stream = SideStream(self.device) if self.device.type == "cuda" else None

    def _make_graphs(self) -> None:
        if self.action.recorded:
            self._draw = GraphedCallable(self.action.draw, self.device)
        self._look = GraphedCallable(self._judge_and_sort, self.device)
        self._act = GraphedCallable(self._act_and_look, self.device)

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what only the next step needs, and which cannot be pickled."""
        none = dict.fromkeys(("_neighbours", "_perceived", "_host_perceived"))
        return self.__dict__ | none | {"_host_is_current": False}

    def limit_steps(self, episode_steps: int | None) -> None:
        """Cut episodes off after so many steps from now on, or never."""
        if episode_steps != self.episode_steps:
            self.referee.limit_steps(episode_steps)
            self._make_graphs()

    @property
    def episode_steps(self) -> int | None:
        """Steps after which an episode is cut off, or None for never."""
        return self.referee.episode_steps

    @property
    def elapsed(self) -> Tensor:
        """Steps since the start of each episode, int32, shape [B]."""
        return self.referee.elapsed

    @property
    def report(self) -> StepReport:
        """What a step returns besides the observation."""
        return self.referee.report

    @property
    def part_names(self) -> tuple[str, ...]:
        """Names of the parts of the loss, known once worlds have been placed."""
        return self.referee.part_names

    @property
    def particle_reward(self) -> Tensor | None:
        """Each particle's own reward of the last step, shape [B, N], where it has one."""
        return self.referee.particle_reward

    @property
    def target_dim(self) -> int:
        """Columns of an observation's rows behind perception, T."""
        rows = self.task.target_rows
        return 0 if rows is None else int(rows.shape[1])

    @property
    def reward(self) -> Tensor:
        """Rewards of the last step, shape [B]."""
        return self.report.numbers[0]

    @property
    def loss(self) -> Tensor:
        """Losses as they are, shape [B]."""
        return self.report.numbers[1]

    @torch.no_grad()
    @makes_plain_tensors
    def start(self, worlds: Tensor, keys: Tensor | None = None) -> Start:
        """Start episodes in some worlds, int64, shape [M], and return their particles.

        Keys are those of `next_streams`.
        """
        random = self.next_streams(worlds, keys)
        check_default_dtype()
        # The first start is not recorded: the host may look.
        task, first = self.task, not self.part_names
        draws, check = GlobalDraws(task) if first else None, first or not self.x.is_cuda
        start: Start = task.start(random)
        check_start(task, start, len(worlds), (self.x.shape, self.s.shape))
        if draws is not None:
            draws.check(starter(task))
        if check:
            check_finite(task, starter(task), {"positions": start.x, "states": start.s})
        self.random.put(worlds, random)
        self.referee.begin(worlds, start, self.random, check=check)
        if draws is not None:
            draws.check("losses")
        return start

    def _start_and_sort(self, worlds: Tensor) -> NeighbourState:
        start = self.start(worlds)
        return build_neighbours(start.x, start.s, self.physics, places=worlds)

    def restart(self, worlds: NDArray[np.int64], observation: Tensor) -> None:
        """Start the next episodes of some worlds, [M], and write what is observed there."""
        if self.action.recorded and self.observer.perceives_alone:
            self._resets(worlds, observation)
            return
        index = to_device_async(worlds, self.device)
        start = self.start(index)
        observation[index] = self.observer.begun(self, index, start)

    @torch.no_grad()
    @makes_plain_tensors
    def place(self, worlds: Tensor, start: Start) -> None:
        """Put particles into some worlds, int64, shape [M], at no reward."""
        self.referee.place(worlds, start)

    @torch.no_grad()
    @makes_plain_tensors
    def perceive(self, out: Tensor | None = None) -> Tensor:
        """Return what is observed in all worlds as they are, shape [B, ...], written to `out`."""
        return self.observer.observe(self, None, out)

    @torch.no_grad()
    @makes_plain_tensors
    def reseed(self, worlds: NDArray[np.int64], observation: Tensor) -> None:
        """Start some worlds, [M], anew within their episodes; the last step's pay and flags stay.

        What is observed in them is written into the observation of all, shape [B, ...].
        """
        self._host_is_current = False
        restore = self.referee.restore_pay(to_device_async(worlds, self.x.device))
        self.restart(worlds, observation)
        restore()

    def step(self, action: Tensor, out: Tensor | None = None) -> tuple[NDArray[np.uint8], Tensor]:
        """Apply actions to all worlds; return their endings, [B], and what is observed, [B, ...].

        The endings, one byte a world, and of a single world its numbers are all that the host
        reads. On CUDA the worlds are judged and sorted side by side, and the device perceives while
        the host reads.

        Args:
            action: Float32, shape [B, ...], on any device.
            out: Where to write what is observed; a new tensor otherwise.

        Raises:
            DivergedError: An action is not finite; the worlds, and what is reported of them, are
                then as they were.
            NPAError: The task's losses are not finite.
        """
        observation = self.queue(action, out)
        if self._side_stream is not None:
            self._side_stream.wait()
        read: NDArray[np.uint8] = self.referee.host_endings.numpy()
        if not read[-1]:
            self.random.steps -= 1
            raise not_finite(action)
        endings = read[:-1].copy()
        if (endings & NOT_FINITE).any():
            self.referee.check_losses(torch.arange(self.world_count, device=self.device))
            raise NPAError(
                f"losses of {type(self.task).__name__} must be finite before a step as well as "
                "after it: mend them, then reset"
            )
        return endings, observation

    @torch.no_grad()
    @makes_plain_tensors
    def queue(self, action: Tensor, out: Tensor | None = None) -> Tensor:
        """Do what `step` does but wait for the device, and return what is observed there then."""
        alone = self.observer.perceives_alone
        if not self.action.recorded:
            self.action.apply(action)
            self.referee.judge()
        elif self.x.is_cuda and self.x.shape[:2].numel() <= FEW_PARTICLES:
            # To copy actions takes less than to launch what one graph then does.
            self.action.hold(action)
            self._act()
            assert self._side_stream is not None, "it was CUDA just now"
            assert self._perceived is not None, "it was perceived just now"
            self._side_stream.mark()
            if not alone:
                return self.observer.observe(self, self._perceived, out)
            self._host_is_current = self._host_perceived is not None
            if out is not None:
                return out.copy_(self._perceived)
            return self._perceived if self._host_is_current else self._perceived.clone()
        else:
            self._draw()
            self.action.apply(action)
            self._look()
        if self._side_stream is not None:
            # The host learns the endings while the device perceives.
            self._side_stream.mark()
        if not self.action.recorded:
            return self.observer.observe(self, None, out)
        assert self._neighbours is not None, "the worlds were sorted just now"
        if alone:
            return self._neighbours.perceive(out)
        return self.observer.observe(self, self._neighbours.perceive(), out)

    def _act_and_look(self) -> None:
        """Apply the actions that are held; judge the worlds and, next to that, perceive."""
        self.action.draw()
        self.action.apply_held()
        with self._judging_on_side():
            if self._perceived is None:
                self._perceived = self.x.new_empty(*self.x.shape[:2], self.physics.perception_dim)
                returns_arrays = self.world_count == 1 and self.task.config.output == "numpy"
                if returns_arrays and self.observer.perceives_alone:
                    self._host_perceived = pinned_like(self._perceived)
            build_neighbours(self.x, self.s, self.physics).perceive(self._perceived)
            if self._host_perceived is not None:
                self._host_perceived.copy_(self._perceived, non_blocking=True)

    def _judge_and_sort(self) -> None:
        """Judge the worlds and, next to that, sort them."""
        with self._judging_on_side():
            self._neighbours = build_neighbours(self.x, self.s, self.physics)

    @contextlib.contextmanager
    def _judging_on_side(self) -> Iterator[None]:
        """Judge the worlds, on CUDA overlapped with what is launched inside."""
        with contextlib.nullcontext() if self._side_stream is None else self._side_stream.overlap():
            self.referee.judge()
        yield
        if self._side_stream is not None:
            self._side_stream.join()

    def extras(self, when: str) -> dict[str, Tensor]:
        """Return what infos hold besides, shape [B, ...] each: since a "reset", or of a "step"."""
        if when == "reset":
            return self.referee.extra_info()
        return {"updated": self.action.updated()} if self.task.config.tell_updated else {}

    def host_observation(self, observation: Tensor) -> Tensor:
        """Return the observation of a single world after a step, on the host if it is there.

        A world that is returned as arrays is there by the end of the step.
        """
        if not self._host_is_current or self._host_perceived is None:
            return observation
        # The next step writes over it. NumPy copies it in this thread: torch would wait for others
        # to wake, which can take milliseconds.
        return torch.from_numpy(self._host_perceived.numpy().copy())

    def host_numbers(self) -> list[float]:
        """Return the numbers of a single world's report after a step."""
        numbers: list[float] = self.referee.host_numbers.numpy()[:, 0].tolist()
        return numbers

    def guarded(self, endings: NDArray[np.uint8], observation: Tensor) -> NDArray[np.uint8]:
        """Do what `on_divergence` says about worlds that diverged; return what ends episodes.

        Nothing is read from the device, and nothing run, where none did.

        Returns:
            Endings, shape [B], without divergence where that ends no episode.
        """
        way = self.task.config.on_divergence
        diverged = endings & DIVERGED != 0
        if way == "terminate" or not diverged.any():
            return endings
        if way == "raise":
            raise DivergedError(self._divergence_message(np.flatnonzero(diverged)))
        if way == "reset":
            # Where the time is up, the next episode comes anyway.
            going_on = np.flatnonzero(endings == DIVERGED)
            if len(going_on):
                self.reseed(going_on, observation)
        return endings & ~np.uint8(DIVERGED)

    def pictures(self, count: int) -> NDArray[np.uint8]:
        """Return pictures of the first worlds, uint8, shape [count, R, R, 3]."""
        steps = self.elapsed[:count].cpu().numpy()
        pictures: NDArray[np.uint8] = self.task.draw(self.x[:count], self.s[:count], steps)
        return pictures

    def _divergence_message(self, diverged: NDArray[np.int64]) -> str:
        """Return an error's message about worlds that diverged."""
        physics, lines = self.physics, []
        for world in diverged[:LARGEST_REPORT].tolist():
            numbers = torch.cat((self.x[world], self.s[world]), dim=1)
            outside = self.x[world].abs() >= physics.limits.position
            held = torch.cat((outside, self.s[world].abs() >= physics.limits.state), dim=1)
            line = f"world {world} in step {int(self.elapsed[world])}"
            if bool(held.any()):
                particle, entry = held.nonzero()[0].tolist()
                line += (
                    f": {term_name(entry, physics.space_dim)} of particle {particle} got to "
                    f"{numbers[particle, entry].item():g} "
                    f"({int(held.any(dim=1).sum())} such particles)"
                )
            lines.append(line)
        if len(diverged) > LARGEST_REPORT:
            lines.append(f"and {len(diverged) - LARGEST_REPORT} more worlds")
        return (
            f"numbers must stay within position_limit = {physics.limits.position:g} and "
            f"observation_limit = {physics.limits.state:g}, but left them in {'; '.join(lines)}: "
            "take smaller actions, raise the limits, or choose on_divergence='terminate' or 'reset'"
        )


def not_finite(action: Tensor) -> DivergedError:
    """Return the error about actions, shape [B, K, W], with a number that is not finite."""
    bad = ~torch.isfinite(action)
    world, particle, entry = (int(k) for k in bad.nonzero()[0])
    return DivergedError(
        f"action must be finite, got {action[world, particle, entry].item()} at world {world}, "
        f"particle {particle}, entry {entry} ({int(bad.sum())} such numbers): check the policy"
    )


GROWTH = 4
"""Each recorded size is so many times the one before it."""


class GraphedResets:
    """Starts of next episodes, on CUDA as one graph and one launch instead of some hundred.

    A recorded start serves a fixed number of worlds. Fewer are filled up by repeating the last one:
    it is then started twice in the same way, which is the same as once. `start` is a method of an
    object that others keep.
    """

    def __init__(
        self,
        start: Callable[[Tensor], NeighbourState],
        world_count: int,
        device: torch.device,
        *,
        recorded: bool,
    ) -> None:
        self._start = WeakFunction(start)
        self._world_count = world_count
        self._device = device
        self._recorded = recorded and device.type == "cuda"
        self._chunks: dict[int, _GraphedReset] = {}

    def __getstate__(self) -> dict[str, Any]:
        """Leave out recorded starts, which cannot be pickled."""
        return self.__dict__ | {"_chunks": {}}

    @makes_plain_tensors
    def __call__(self, worlds: NDArray[np.int64], observation: Tensor) -> None:
        """Start the next episodes of some worlds, [M], and write what is perceived, [B, N, P]."""
        if not self._recorded:
            self._start()(to_device_async(worlds, self._device)).perceive(observation)
            return
        size = 1
        while size < len(worlds):
            size = min(size * GROWTH, self._world_count)
        if size not in self._chunks:
            self._chunks[size] = _GraphedReset(self._start, size, self._device)
        filled = np.full(size, worlds[-1])
        filled[: len(worlds)] = worlds
        self._chunks[size].restart(to_device_async(filled, self._device), observation)


class _GraphedReset:
    """The recorded start of a fixed number of worlds."""

    def __init__(self, start: WeakFunction, size: int, device: torch.device) -> None:
        self._start = start
        self._index = torch.zeros(size, dtype=torch.int64, device=device)
        self._replayed = GraphedCallable(self._run, device)

    def restart(self, worlds: Tensor, observation: Tensor) -> None:
        """Start the next episodes of as many worlds as the chunk is for."""
        self._index.copy_(worlds)
        self._replayed()
        self._surveyed.perceive(observation)

    def _run(self) -> None:
        self._surveyed: NeighbourState = self._start()(self._index)
