"""The batch of worlds behind every environment: steps, losses, endings, restarts.

Gymnasium is not known here. A single environment is a batch of one; world k of a batch is, bit for
bit, that world alone.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.checks import number_tensor
from npa_envs.envs.core.config import EnvConfig, WorldConfig
from npa_envs.envs.core.memory import check_memory
from npa_envs.envs.core.task import EnvTask, Start, WorldTask
from npa_envs.envs.core.task_checks import (
    GlobalDraws,
    check_finite,
    check_start,
    checked_losses,
    checked_shares,
    starter,
)
from npa_envs.errors import DivergedError, NPAError, shown
from npa_envs.world.actions import (
    DIVERGED,
    NOT_FINITE,
    SUCCESS,
    TIME_LIMIT,
    Actions,
    EpisodeRules,
    NeighbourState,
    PreparedJudgement,
    build_neighbours,
    with_mean_reward,
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

FLAGS = ("success", "diverged")
"""Names of the first two endings in `info`."""


def total(parts: Tensor) -> Tensor:
    """Return the sum of the parts of a loss, [K, B], in their order, which torch's is not."""
    first, *rest = parts.unbind()
    for part in rest:
        first = first + part
    return first


def check_default_dtype() -> None:
    """Check that what tasks make by default is float32, as the worlds are.

    Raises:
        NPAError: It is another dtype.
    """
    dtype = torch.get_default_dtype()
    if dtype != torch.float32:
        raise NPAError(
            f"environments need torch's default dtype to be torch.float32, got {dtype}: call "
            "torch.set_default_dtype(torch.float32), and give other tensors their dtype"
        )


class WorldState:
    """Particles of B worlds on a device, a stream of randomness for each world.

    Args:
        config: The environment's configuration.
        task_type: Says how many dimensions there are, and whether particles move.
        world_count: Worlds B.
        particle_count: Particles of each, N.
        extra_bytes: Memory that the task needs besides.

    Raises:
        NPAError: The worlds do not fit into memory.
    """

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
        """Return particles to be put into M worlds of N, float32 on the device.

        Raises:
            NPAError: A shape is another one, or a number is not finite or beyond its limit.
        """
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
        # Memory is asked for before the task, which may make a target of as many points.
        extra, count = task_type.extra_bytes(config, world_count), config.particle_count
        super().__init__(config, task_type, world_count, count, extra)
        device = self.device
        self.task = task_type(config, device)
        self.episode_steps = episode_steps

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.zeros(world_count, *shape, dtype=dtype, device=device)

        self.elapsed = zeros(dtype=torch.int32)
        """Steps since the start of each episode, shape [B]."""
        self.particle_loss = zeros(count) if config.reward == "particle" else None
        """Each particle's share of the loss, shape [B, N], where rewards are shared out."""
        self.particle_reward = zeros(count) if config.per_particle_reward else None
        """Each particle's own reward of the last step, shape [B, N], where it has one."""
        paid_by_action = config.reward == "marginal"
        self._before = (self.x.clone(), self.s.clone()) if paid_by_action else None
        self._goal = zeros(dtype=torch.int64)
        self._aimed = self.task.toward(self._goal)
        self._start_loss = zeros()
        self._success_loss = zeros()
        self._diverged = zeros(dtype=torch.uint8)
        self._enabled = torch.ones(1, dtype=torch.uint8, device=device)
        self.part_names: tuple[str, ...] = ()
        """Names of the parts of the loss, known once worlds have been placed."""
        self.report = StepReport.empty(world_count, 0, device)
        """What a step hands out besides the observation."""
        # Each world's ending, then whether the actions were finite.
        self._endings = torch.zeros(world_count + 1, dtype=torch.uint8, device=device)
        self._host_endings, self._host_numbers = self._for_host()
        self._perceived: Tensor | None = None
        """What is perceived, [B, N, P], where a step is one graph."""
        self._host_perceived: Tensor | None = None
        """The same of a single world that is handed out as arrays, in pinned memory."""
        self._told_perceived = False
        """Whether that is of the last step, after which no world began anew."""
        self._actions = Actions(
            self.x,
            self.s,
            self.physics,
            self.random,
            enabled=self._enabled,
            diverged=self._diverged,
        )
        self._surveyed: NeighbourState | None = None
        self._judgement: PreparedJudgement | None = None
        self._draw = GraphedCallable(self._actions.draw, device)
        self._look = GraphedCallable(self._judge_and_sort, device)
        self._act = GraphedCallable(self._act_and_look, device)
        self.restart = GraphedResets(
            self._start_and_sort, world_count, device, recorded=self.task.start_is_short
        )
        """Starts the next episodes of some worlds: restart(indices, observation)."""
        self._side_stream = SideStream(device) if device.type == "cuda" else None

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what only the next step needs, and which cannot be pickled."""
        places = ("_host_endings", "_host_numbers", "_perceived", "_host_perceived")
        none = dict.fromkeys(("_surveyed", "_judgement", *places))
        return self.__dict__ | none | {"_told_perceived": False}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Make again what was left out."""
        self.__dict__.update(state)
        self._host_endings, self._host_numbers = self._for_host()

    def _for_host(self) -> tuple[Tensor, Tensor]:
        """Return where the host reads endings and numbers: on CUDA pinned memory for copies."""
        told = (self._endings, self.report.numbers)
        if self.device.type == "cpu":
            return told
        endings, numbers = map(pinned_like, told)
        return endings, numbers

    def limit_steps(self, episode_steps: int | None) -> None:
        """Cut episodes off after so many steps from now on, or never."""
        if episode_steps != self.episode_steps:
            self.episode_steps = episode_steps
            self._judgement = None
            self._look = GraphedCallable(self._judge_and_sort, self.device)
            self._act = GraphedCallable(self._act_and_look, self.device)

    @property
    def reward(self) -> Tensor:
        """Rewards of the last step, shape [B]."""
        return self.report.numbers[0]

    @property
    def loss(self) -> Tensor:
        """Losses as they are, shape [B]."""
        return self.report.numbers[1]

    @property
    def pays_last_step_alone(self) -> bool:
        """Whether an episode's last step is the only one that is paid."""
        sparse: bool = self.task.config.reward == "sparse"
        return sparse

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
        draws = GlobalDraws(task) if first else None
        start = task.start(random)
        check_start(task, start, len(worlds), (self.x.shape, self.s.shape))
        if draws is not None:
            draws.check(starter(task))
        if first or not self.x.is_cuda:
            check_finite(task, starter(task), {"positions": start.x, "states": start.s})
        self.random.put(worlds, random)
        self.elapsed.index_fill_(0, worlds, 0)
        self.place(worlds, start)
        if draws is not None:
            draws.check("losses")
        if first or not self.x.is_cuda:
            self._check_losses(worlds)
        self._start_loss[worlds] = self.loss[worlds]
        if start.success_loss is None:
            self._success_loss.index_fill_(0, worlds, -torch.inf)
        else:
            self._success_loss[worlds] = start.success_loss
        return start

    def _start_and_sort(self, worlds: Tensor) -> NeighbourState:
        start = self.start(worlds)
        return build_neighbours(start.x, start.s, self.physics, places=worlds)

    @torch.no_grad()
    @makes_plain_tensors
    def place(self, worlds: Tensor, start: Start) -> None:
        """Put particles into some worlds, int64, shape [M], at no reward."""
        x, s = start.x.contiguous(), start.s.contiguous()
        task = self.task
        if self._aimed is not task:
            goal = self._goal[worlds] if start.goal is None else start.goal
            self._goal.index_copy_(0, worlds, goal)
            task = task.toward(goal)
        parts = task.losses(x, s)
        values = torch.stack(checked_losses(task, parts, len(x), self.part_names))
        if not self.part_names:
            self.part_names = tuple(parts)
            self.report = StepReport.empty(self.world_count, len(parts), x.device)
            self._host_endings, self._host_numbers = self._for_host()
        self.x.index_copy_(0, worlds, x)
        self.s.index_copy_(0, worlds, s)
        still = torch.zeros_like(values)
        numbers = torch.cat((still[:1], total(values)[None], values, still))
        self.report.numbers.index_copy_(1, worlds, numbers)
        if self.particle_loss is not None:
            shares = checked_shares(task, task.particle_losses(x, s), (len(x), x.shape[1]))
            self.particle_loss[worlds] = shares
        if self._before is not None:
            for kept, placed in zip(self._before, (x, s), strict=True):
                kept.index_copy_(0, worlds, placed)
        if self.particle_reward is not None:
            self.particle_reward.index_fill_(0, worlds, 0.0)
        self.report.endings.index_fill_(1, worlds, False)

    @torch.no_grad()
    @makes_plain_tensors
    def perceive(self, out: Tensor | None = None) -> Tensor:
        """Return what is perceived in all worlds as they are, shape [B, N, P], written to `out`."""
        return build_neighbours(self.x, self.s, self.physics).perceive(out)

    @torch.no_grad()
    @makes_plain_tensors
    def reseed(self, worlds: NDArray[np.int64], observation: Tensor) -> None:
        """Start some worlds, [M], anew within their episodes; the last step's pay and flags stay.

        What is perceived in them is written into the observation of all, shape [B, N, P].
        """
        index = to_device_async(worlds, self.x.device)
        self._told_perceived = False
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
        if self.world_count == 1:
            # Of several the host reads none, and this waits for the device.
            self._host_numbers.copy_(numbers)

    def step(self, action: Tensor, out: Tensor | None = None) -> tuple[NDArray[np.uint8], Tensor]:
        """Apply actions to all worlds; return their endings, [B], and what is perceived, [B, N, P].

        The endings, one byte a world, and of a single world its numbers are all that the host
        reads. On CUDA the worlds are judged and sorted side by side, and the device perceives while
        the host reads.

        Args:
            action: Float32, shape [B, N, A], on any device.
            out: Where to write what is perceived; a new tensor otherwise.

        Raises:
            DivergedError: An action is not finite; the worlds, and what is reported of them, are
                then as they were.
            NPAError: The task's losses are not finite.
        """
        observation = self.queue(action, out)
        if self._side_stream is not None:
            self._side_stream.wait()
        told: NDArray[np.uint8] = self._host_endings.numpy()
        if not told[-1]:
            self.random.steps -= 1
            raise self._not_finite(action)
        endings = told[:-1].copy()
        if (endings & NOT_FINITE).any():
            everyone = torch.arange(self.world_count, device=self.device)
            self._check_losses(everyone)
            raise NPAError(
                f"losses of {type(self.task).__name__} must be finite before a step as well as "
                "after it: mend them, then reset"
            )
        return endings, observation

    @torch.no_grad()
    @makes_plain_tensors
    def queue(self, action: Tensor, out: Tensor | None = None) -> Tensor:
        """Do what `step` does but wait for the device, and return what is perceived there then."""
        if self.x.is_cuda and self.x.shape[:2].numel() <= FEW_PARTICLES:
            # To copy actions takes less than to launch what one graph then does.
            self._actions.hold(action)
            self._act()
            assert self._side_stream is not None, "it was CUDA just now"
            assert self._perceived is not None, "it was perceived just now"
            self._side_stream.mark()
            self._told_perceived = self._host_perceived is not None
            if out is not None:
                return out.copy_(self._perceived)
            return self._perceived if self._told_perceived else self._perceived.clone()
        else:
            self._draw()
            self._actions.apply(action)
            self._look()
        if self._side_stream is not None:
            # The host learns the endings while the device perceives.
            self._side_stream.mark()
        assert self._surveyed is not None, "the worlds were sorted just now"
        return self._surveyed.perceive(out)

    def _act_and_look(self) -> None:
        """Apply the actions that are held; judge the worlds and, beside that, perceive."""
        self._actions.draw()
        self._actions.apply_held()
        with self._judging_beside():
            if self._perceived is None:
                self._perceived = self.x.new_empty(*self.x.shape[:2], self.physics.perception_dim)
                if self.world_count == 1 and self.task.config.output == "numpy":
                    self._host_perceived = pinned_like(self._perceived)
            build_neighbours(self.x, self.s, self.physics).perceive(self._perceived)
            if self._host_perceived is not None:
                self._host_perceived.copy_(self._perceived, non_blocking=True)

    def _judge_and_sort(self) -> None:
        """Judge the worlds and, beside that, sort them."""
        with self._judging_beside():
            self._surveyed = build_neighbours(self.x, self.s, self.physics)

    @contextlib.contextmanager
    def _judging_beside(self) -> Iterator[None]:
        """Judge the worlds, on CUDA beside what is launched inside."""
        with contextlib.nullcontext() if self._side_stream is None else self._side_stream.overlap():
            self._judge_worlds()
        yield
        if self._side_stream is not None:
            self._side_stream.join()

    def _judge_worlds(self) -> None:
        """Write rewards, losses and endings of the worlds as they now are."""
        task = self._aimed
        losses = task.losses(self.x, self.s)
        parts = torch.stack(checked_losses(task, losses, self.world_count, self.part_names))
        if self._judgement is None:
            self._judgement = self._make_judgement()
        if self.particle_reward is None:
            self._judgement(parts)
        else:
            own = self._particle_gains(task)
            self._judgement(parts, (~torch.isfinite(own).all(dim=1)).byte())
            if self._before is not None:
                own = with_mean_reward(own, self.reward)
            # Worlds that left their bounds are paid as a whole.
            whole = self._diverged.bool() & (self.task.config.on_divergence != "ignore")
            own = torch.where(whole[:, None], self.reward[:, None], own)
            happened = self._enabled.bool()
            self.particle_reward.copy_(torch.where(happened, own, self.particle_reward))
        if self._side_stream is not None:
            self._host_endings.copy_(self._endings, non_blocking=True)
            if self.world_count == 1:
                self._host_numbers.copy_(self.report.numbers, non_blocking=True)
        self._enabled.fill_(1)

    def _particle_gains(self, task: EnvTask[Any]) -> Tensor:
        """Return what each particle has earned in a step, shape [B, N], and keep what it is now."""
        shape = self.world_count, self.particle_count
        if self._before is not None:
            gains = checked_shares(task, task.particle_gains(self._before, (self.x, self.s)), shape)
            for kept, now in zip(self._before, (self.x, self.s), strict=True):
                kept.copy_(now)
            return gains
        assert self.particle_loss is not None, "particles are paid by shares or by actions"
        shares = checked_shares(task, task.particle_losses(self.x, self.s), shape)
        gains = self.particle_loss - shares
        self.particle_loss.copy_(shares)
        return gains

    def _make_judgement(self) -> PreparedJudgement:
        config = self.task.config
        paid = (self.episode_steps or config.episode_steps) if config.reward == "sparse" else None
        return PreparedJudgement(
            EpisodeRules(self.episode_steps, paid, config.on_divergence),
            enabled=self._enabled,
            diverged=self._diverged,
            first_loss=self._start_loss,
            success_loss=self._success_loss,
            elapsed=self.elapsed,
            numbers=self.report.numbers,
            flags=self.report.endings,
            endings=self._endings,
        )

    def extras(self, when: str) -> dict[str, Tensor]:
        """Return what infos tell besides, shape [B, ...] each: since a "reset", or of a "step"."""
        if when == "reset":
            return self._aimed.extra_info(self.s)
        return {"updated": self._actions.updated()} if self.task.config.tell_updated else {}

    def told_observation(self, observation: Tensor) -> Tensor:
        """Return what is perceived in a single world after a step, [1, N, P]: where it is told.

        Of worlds that are handed out as arrays the host knows it by the end of the step.
        """
        told = self._host_perceived if self._told_perceived else None
        if told is None:
            return observation
        # The next step writes over what is told. NumPy copies it in this thread: torch would wait
        # for others to wake, which can take milliseconds.
        return torch.from_numpy(told.numpy().copy())

    def extra_info(self) -> list[float]:
        """Return the numbers of a single world's report after a step."""
        numbers: list[float] = self._host_numbers.numpy()[:, 0].tolist()
        return numbers

    def guarded(self, endings: NDArray[np.uint8], observation: Tensor) -> NDArray[np.uint8]:
        """Do what `on_divergence` says about worlds that diverged; return what ends episodes.

        Nothing is read from the device, and nothing run, where none did.

        Args:
            endings: What `step` returned, of the worlds that were to act, shape [B].
            observation: What is perceived, shape [B, N, P]; changed where worlds are reset.

        Returns:
            Endings, shape [B], without divergence where that ends no episode.

        Raises:
            DivergedError: A world diverged, and `on_divergence` is "raise".
        """
        way = self.task.config.on_divergence
        diverged = endings & DIVERGED != 0
        if way == "terminate" or not diverged.any():
            return endings
        if way == "raise":
            raise DivergedError(self._told(np.flatnonzero(diverged)))
        if way == "reset":
            # Where the time is up, the next episode comes anyway.
            going_on = np.flatnonzero(endings == DIVERGED)
            if len(going_on):
                self.reseed(going_on, observation)
        return endings & ~np.uint8(DIVERGED)

    def _check_losses(self, worlds: Tensor) -> None:
        """Check that the losses of some worlds, int64, shape [M], are finite."""
        numbers = self.report.numbers[2 : 2 + len(self.part_names), worlds]
        parts = {
            f"part {shown(name)}": part for name, part in zip(self.part_names, numbers, strict=True)
        }
        check_finite(self.task, "losses", parts)
        if self.particle_loss is not None:
            check_finite(self.task, "particle_losses", {"shares": self.particle_loss[worlds]})

    def pictures(self, count: int) -> NDArray[np.uint8]:
        """Return pictures of the first worlds, uint8, shape [count, R, R, 3]."""
        steps = self.elapsed[:count].cpu().numpy()
        pictures: NDArray[np.uint8] = self.task.draw(self.x[:count], self.s[:count], steps)
        return pictures

    def _not_finite(self, action: Tensor) -> DivergedError:
        bad = ~torch.isfinite(action)
        world, particle, entry = (int(k) for k in bad.nonzero()[0])
        return DivergedError(
            f"action must be finite, got {action[world, particle, entry].item()} at world {world}, "
            f"particle {particle}, entry {entry} ({int(bad.sum())} such numbers): check the policy"
        )

    def _told(self, diverged: NDArray[np.int64]) -> str:
        """Return an error's message about worlds that diverged."""
        physics, told = self.physics, []
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
            told.append(line)
        if len(diverged) > LARGEST_REPORT:
            told.append(f"and {len(diverged) - LARGEST_REPORT} more worlds")
        return (
            f"numbers must stay within position_limit = {physics.limits.position:g} and "
            f"observation_limit = {physics.limits.state:g}, but left them in {'; '.join(told)}: "
            "take smaller actions, raise the limits, or choose on_divergence='terminate' or 'reset'"
        )


class StepReport(NamedTuple):
    """What a step says of each world, in one buffer: it is handed out by one copy, not twenty."""

    buffer: Tensor
    """All that follows, uint8."""
    numbers: Tensor
    """Reward; loss; its parts; their improvements in the last step; shape [2 + 2 K, B]."""
    endings: Tensor
    """Terminated; truncated; success; diverged; bool, shape [4, B]."""
    everyone: Tensor
    """True for every world, bool, shape [B]."""

    @classmethod
    def empty(cls, world_count: int, part_count: int, device: torch.device) -> StepReport:
        """Return the report of B worlds whose loss has K parts: zeros."""
        rows = 4 * (2 + 2 * part_count) + 3 + len(FLAGS)
        buffer = torch.zeros(rows * world_count, dtype=torch.uint8, device=device)
        report = cls.over(buffer, world_count)
        report.everyone.fill_(True)
        return report

    @classmethod
    def over(cls, buffer: Tensor, world_count: int) -> StepReport:
        """Return the report that a buffer holds."""
        flag_rows = 3 + len(FLAGS)
        rows = buffer.view(-1, world_count)
        numbers = buffer[: -flag_rows * world_count].view(torch.float32).view(-1, world_count)
        flags = rows[-flag_rows:].view(torch.bool)
        return cls(buffer, numbers, flags[:-1], flags[-1])

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        """Pickle the buffer alone: views that are pickled apart no longer share its memory."""
        return StepReport.over, (self.buffer, len(self.everyone))

    def copy(self) -> StepReport:
        """Return a copy that later steps leave alone."""
        return self.over(self.buffer.clone(), len(self.everyone))


def reason(ending: int) -> str | None:
    """Return why an episode ended, in words, or None where it has not."""
    words = {DIVERGED: "diverged", SUCCESS: "success", TIME_LIMIT: "time limit"}
    return next((word for bit, word in words.items() if ending & bit), None)


GROWTH = 4
"""Each recorded size is so many times the one before it."""


class GraphedResets:
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
