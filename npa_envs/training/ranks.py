"""Processes that train one rule together: each has a share of the worlds; what runs draw from."""

from __future__ import annotations

import contextlib
import gc
import math
import os
import sys
import threading
import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor

from npa_envs.errors import LostProcessError, NPAError, shown
from npa_envs.tasks.train_config import TrainConfig
from npa_envs.world.randomness import Randomness, WorldRandom

ValueT = TypeVar("ValueT")

AGREE_INTERVAL = 10
"""Iterations from one question to all processes whether to stop to the next, at most."""

AGREE_SECONDS = 2.0
"""Time from one question to the next [s], where one iteration does not take longer: launchers kill
what has not stopped 30 s after they asked."""


class Ranks:
    """This process among those of a run.

    Pool and batch are cut into as many sections as the batch has worlds. Section k belongs to
    process k modulo their number. So each process has young and old worlds.
    """

    def __init__(self, rank: int = 0, count: int = 1, *, together: bool = False) -> None:
        self.rank = rank
        self.count = count
        self.together = together
        """Whether they are torch's default group, even if there is only one."""
        self._parent = os.getppid()
        self._asked_at: tuple[int, float] | None = None
        self._next_question = 0

    @classmethod
    def current(cls) -> Ranks:
        """Return the processes of torch's default group, or this one alone where there is none."""
        if dist.is_available() and dist.is_initialized():
            return cls(dist.get_rank(), dist.get_world_size(), together=True)
        return cls()

    @property
    def first(self) -> bool:
        """Whether this is the process that reads and writes the run's files."""
        return self.rank == 0

    def check(self, config: TrainConfig[Any]) -> None:
        """Check that a run can be shared."""
        batch, pool = config.world_count, config.pool_size
        self.check_dealt("world_count", batch)
        if pool % batch:
            raise NPAError(
                f"pool_size must be a multiple of world_count in a run of several processes, got "
                f"{pool} and {batch}: set pool_size={pool // batch * batch}"
            )

    def check_dealt(self, name: str, worlds: int) -> None:
        """Check that the worlds of a batch, which the caller calls so, can be dealt out evenly."""
        if worlds % self.count:
            nearest = max(worlds // self.count, 1) * self.count
            raise NPAError(
                f"{name} must be a multiple of the number of processes, got {worlds} and "
                f"{self.count}: set {name}={nearest}"
            )

    def places(self, total: int, section: int = 1) -> Tensor:
        """Return which of all worlds are this process's, on the CPU, int64, shape [total / R]."""
        return self.own(torch.arange(total), section)

    def own(self, worlds: Tensor, section: int) -> Tensor:
        """Return this process's share of all worlds, so many of which are a section."""
        dealt = worlds.view(-1, self.count, section, *worlds.shape[1:])
        return dealt[:, self.rank].flatten(0, 1)

    def collected(self, worlds: Tensor, section: int) -> Tensor:
        """Return the worlds of all processes, on the first one and the CPU where it has others."""
        if self.count == 1:
            return worlds
        mine = worlds.detach().cpu().contiguous()
        parts = [torch.empty_like(mine) for _ in range(self.count)] if self.first else None
        with self._in_touch():
            dist.gather(mine, parts)
        if parts is None:
            return mine
        sections = [part.view(-1, section, *part.shape[1:]) for part in parts]
        return torch.stack(sections, 1).flatten(0, 2)

    def broadcast(self, value: ValueT) -> ValueT:
        """Return what the first process gives, on all of them."""
        if not self.together:
            return value
        given = [value]
        with self._in_touch():
            dist.broadcast_object_list(given)
        return given[0]

    def any(self, flag: bool) -> bool:
        """Return whether the flag is set on any process."""
        if not self.together:
            return flag
        asked = torch.tensor(int(flag))
        with self._in_touch():
            dist.all_reduce(asked, op=dist.ReduceOp.MAX)
        return bool(asked)

    def agree_to_stop(self, asked: bool, iteration: int) -> bool:
        """Return whether to stop before an iteration: any process was asked to."""
        if not self.together:
            return asked
        if self._asked_at is not None and self._asked_at[0] < iteration < self._next_question:
            return False
        now, took = time.monotonic(), math.inf
        if self._asked_at is not None and iteration > self._asked_at[0]:
            took = (now - self._asked_at[1]) / (iteration - self._asked_at[0])
        # Whoever started them would end them; where that one was killed, they end by themselves.
        wanted = asked or os.getppid() != self._parent
        answer = torch.tensor([float(wanted), took], dtype=torch.float64)
        with self._in_touch():
            dist.all_reduce(answer, op=dist.ReduceOp.MAX)
        interval = min(max(int(AGREE_SECONDS / max(float(answer[1]), 1e-9)), 1), AGREE_INTERVAL)
        self._asked_at, self._next_question = (iteration, now), iteration + interval
        return bool(answer[0])

    def reduce(self, means: Sequence[Tensor], total: Tensor | None = None) -> None:
        """Replace numbers by their means, and one by its sum, over all processes, in place.

        All means have one dtype. On CUDA the host waits for nothing.
        """
        if not self.together:
            return
        parts = [mean.reshape(-1) for mean in means]
        if total is not None:
            parts.append(total.reshape(1).to(means[0]))
        flat = torch.cat(parts)
        with self._in_touch():
            dist.all_reduce(flat)
        if total is not None:
            total.copy_(flat[-1])
        flat /= self.count
        first = 0
        for mean in means:
            mean.copy_(flat[first : first + mean.numel()].view(mean.shape))
            first += mean.numel()

    def mean(self, value: Tensor) -> Tensor:
        """Return the mean of a tensor over all processes, which all ask for it."""
        mean = value.detach().clone()
        self.reduce([mean])
        return mean

    def check_same(self, tensors: Sequence[Tensor]) -> None:
        """Check that tensors are the same on all processes, bit for bit."""
        if self.count == 1:
            return
        own = torch.cat([tensor.detach().reshape(-1).double().cpu() for tensor in tensors])
        low, high = own.clone(), own.clone()
        with self._in_touch():
            dist.all_reduce(low, op=dist.ReduceOp.MIN)
            dist.all_reduce(high, op=dist.ReduceOp.MAX)
        differing = int((low != high).sum())
        if differing:
            raise NPAError(
                f"the parameters must be the same on all {self.count} processes, but {differing} "
                f"of {len(own)} differ, by at most {float((high - low).max()):.3g}: the last "
                "checkpoint is intact; resume it, and look for a faulty device or for processes "
                "with other versions of a library"
            )

    @contextlib.contextmanager
    def _in_touch(self) -> Iterator[None]:
        try:
            yield
        except RuntimeError as error:
            if isinstance(error, torch.OutOfMemoryError):
                raise
            raise LostProcessError(
                f"process {self.rank} of {self.count} has lost another one, which has ended or "
                f"cannot be reached ({shown(error)}): the last checkpoint is intact; see what "
                "the other process said, then resume"
            ) from error


ALONE = Ranks()


# Randomness: of the batch at once, or of each world by itself.


@dataclass(frozen=True)
class RunRandomness:
    """What a run draws from.

    A process alone has one generator for all worlds and one for all masks. Where several share a
    run, each world has streams of its own, which follow from the seed, the world's number among
    those of all processes, and the iteration. So they are the same for any number of processes,
    and nothing of them has to be kept. Numbers of steps and first weights are of the schedule, on
    the CPU; which worlds a batch has, their damage and fresh ones of `worlds`.
    """

    schedule: torch.Generator
    pool: Randomness
    worlds: Randomness
    masks: Randomness

    @classmethod
    def of_batch(
        cls, config: TrainConfig[Any], device: torch.device, schedule: torch.Generator
    ) -> RunRandomness:
        """Return the randomness of a process alone."""
        worlds = torch.Generator(device).manual_seed(config.seed + 1)
        masks = torch.Generator(device).manual_seed(config.seed + 2)
        return cls(schedule, worlds, worlds, masks)

    @classmethod
    def by_world(
        cls, config: TrainConfig[Any], device: torch.device, schedule: torch.Generator, ranks: Ranks
    ) -> RunRandomness:
        """Return the randomness of worlds that several processes share."""
        batch, pool = config.world_count, config.pool_size

        def streams(purpose: int, total: int, places: Tensor) -> WorldRandom:
            return world_streams((config.seed, purpose), total, places, device)

        of_batch = ranks.places(batch)
        return cls(
            schedule,
            pool=streams(0, pool, ranks.places(pool, pool // batch)),
            worlds=streams(1, batch, of_batch),
            masks=streams(2, batch, of_batch),
        )

    def state_dict(self) -> dict[str, Tensor]:
        """Return the states of all generators, for a checkpoint."""
        named = {"schedule": self.schedule, "worlds": self.worlds, "masks": self.masks}
        return {
            name: source.get_state()
            for name, source in named.items()
            if isinstance(source, torch.Generator)
        }

    def load_state_dict(self, states: Mapping[str, Tensor], iteration: int) -> None:
        """Go on after so many iterations from what `state_dict` returned."""
        self.schedule.set_state(states["schedule"])
        for name, source in (("worlds", self.worlds), ("masks", self.masks)):
            if isinstance(source, torch.Generator):
                source.set_state(states[name])
            else:
                source.episodes.fill_(iteration)


def world_streams(
    seed: Sequence[int], total: int, places: Tensor, device: torch.device
) -> WorldRandom:
    """Return streams of this process's `places` among worlds: the same for any other share."""
    keys = np.random.default_rng(seed).integers(2**64, size=total, dtype=np.uint64)
    return WorldRandom.from_keys(torch.from_numpy(keys.view(np.int64))[places].to(device))


def restart(*sources: Randomness) -> None:
    """Begin anew what worlds draw by themselves; a generator just goes on."""
    for source in sources:
        if isinstance(source, WorldRandom):
            source.restart()


def registered(source: Randomness) -> torch.Generator | None:
    """Return what a CUDA graph has to know of: streams of worlds are tensors as all others."""
    return source if isinstance(source, torch.Generator) else None


# Processes that torchrun starts.


@contextlib.contextmanager
def joined_ranks() -> Iterator[Ranks]:
    """Join the other processes that torchrun has started, within the block.

    Each of them sees one CUDA device, that of its number on its machine. To be called before
    anything uses CUDA. Within the block, a process that gives no sign of life ends the others (see
    `Heartbeat`), so whichever process keeps the store that they meet in is to leave it last.
    Outside of torchrun, this process is alone.
    """
    if not dist.is_available() or not dist.is_torchelastic_launched():
        yield Ranks()
        return
    # Torch's builds for CUDA have NCCL on machines without a GPU too, and refuse it there. The
    # driver's manager counts, which does not start CUDA.
    has_gpus = torch.cuda.device_count() >= int(os.environ["LOCAL_WORLD_SIZE"])
    backend = "cpu:gloo,cuda:nccl" if dist.is_nccl_available() and has_gpus else "gloo"
    _choose_device(int(os.environ["LOCAL_RANK"]))
    try:
        dist.init_process_group(backend)
        ranks = Ranks.current()
        heartbeat = None
        if ranks.count > 1:
            # A connection of its own: that of the group waits where the group does.
            address, port = os.environ["MASTER_ADDR"], int(os.environ["MASTER_PORT"])
            store = dist.TCPStore(address, port, wait_for_workers=False)  # type: ignore[attr-defined]
            # Torchrun may keep the store where it starts processes again.
            prefix = ranks.broadcast(uuid.uuid4().hex)
            own = dist.PrefixStore(prefix, store)  # type: ignore[attr-defined]
            heartbeat = Heartbeat(own, ranks.rank, ranks.count)
    except (RuntimeError, ValueError) as error:
        raise NPAError(
            f"the processes that torchrun starts must reach each other, but this one cannot "
            f"({shown(error)}): see its options --rdzv-endpoint and --master-addr"
        ) from error
    left = False
    try:
        yield ranks
        left = True
    finally:
        if heartbeat is not None:
            heartbeat.end(left=left)
    # Not after an error: others may be gone. Recorded graphs hold on to the group.
    gc.collect()
    dist.destroy_process_group()


def _choose_device(number: int) -> None:
    """Let this process see one CUDA device of those that it would see, or none beyond them."""
    if torch.cuda.device_count() == 0:
        return
    seen = os.environ.get("CUDA_VISIBLE_DEVICES")
    devices = [str(number)] if seen is None else seen.split(",")[number : number + 1]
    os.environ["CUDA_VISIBLE_DEVICES"] = ",".join(devices)


BEAT_SECONDS = 5.0
"""Pause between two signs of life [s]."""

SILENT_BEATS = 8
"""A process that gave no sign in so many pauses of another one is lost."""

LOST_CODE = 2
"""Exit code of a process that has lost another one: the command line's for errors."""

_LEFT = -(2**62)


class Heartbeat:
    """Ends this process, with a message, where another one gives no sign of life.

    Collectives alone may wait for a process that was stopped, or whose machine is gone, for NCCL's
    10 minutes. Time counts in this process's own pauses: one that was stopped itself blames nobody
    for that. A process that waits or computes gives signs all the same.
    """

    def __init__(self, store: Any, rank: int, count: int) -> None:
        self._store, self._rank = store, rank
        self._signs = [0] * count
        self._ended = threading.Event()
        self._left = self._store_gone = False
        # Two, as a store that does not answer holds up whoever asks it.
        self._threads = [
            threading.Thread(target=task, daemon=True) for task in (self._beat, self._watch)
        ]
        for thread in self._threads:
            thread.start()

    def end(self, *, left: bool) -> None:
        """Watch no longer; where it has `left`, the others need not miss this process."""
        self._left = left
        self._ended.set()
        for thread in self._threads:
            thread.join(BEAT_SECONDS)

    def _beat(self) -> None:
        try:
            while not self._ended.is_set():
                for other in range(len(self._signs)):
                    self._signs[other] = self._store.add(str(other), int(other == self._rank))
                self._ended.wait(BEAT_SECONDS)
            if self._left:
                self._store.add(str(self._rank), _LEFT)
        except RuntimeError:
            # From now on all seem silent that have not left.
            self._store_gone = True

    def _watch(self) -> None:
        count = len(self._signs)
        seen, silent = self._signs.copy(), [0] * count
        while not self._ended.wait(BEAT_SECONDS):
            signs = self._signs.copy()
            for other in range(count):
                alive = other == self._rank or signs[other] != seen[other] or signs[other] < 0
                silent[other] = 0 if alive else silent[other] + 1
            seen = signs
            lost = [str(other) for other in range(count) if silent[other] >= SILENT_BEATS]
            if lost:
                why = (
                    "as the store that processes meet in is gone"
                    if self._store_gone
                    else "which was killed or stopped, or cannot be reached"
                )
                print(
                    f"npa-envs: error: process {self._rank} of {count} has heard nothing from "
                    f"process {', '.join(lost)} for {SILENT_BEATS * BEAT_SECONDS:.0f} s, {why}: "
                    "the last checkpoint is intact; resume it",
                    file=sys.stderr,
                    flush=True,
                )
                # The main thread may wait in a collective for ever.
                os._exit(LOST_CODE)
