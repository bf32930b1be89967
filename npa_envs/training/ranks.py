"""Processes that train one rule together, each on its part of the worlds; random streams."""

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
"""Largest number of iterations between two checks of all processes whether to stop."""

AGREE_SECONDS = 2.0
"""Time between two such checks, unless an iteration takes longer [s]: launchers kill a process 30 s
after they asked it to stop."""


class Ranks:
    """This process (`rank`) among the `count` processes of a run.

    Pool and batch are cut into as many sections as the batch has worlds. Section k belongs to rank
    k % count, so that each process has young and old worlds.
    """

    def __init__(self, rank: int = 0, count: int = 1, *, together: bool = False) -> None:
        self.rank = rank
        self.count = count
        self.together = together
        """Whether the processes are torch's default group, even if there is only one."""
        self._parent = os.getppid()
        self._checked_at: tuple[int, float] | None = None
        self._next_check = 0

    @classmethod
    def current(cls) -> Ranks:
        """Return the processes of torch's default group, or a single process without a group."""
        if dist.is_available() and dist.is_initialized():
            return cls(dist.get_rank(), dist.get_world_size(), together=True)
        return cls()

    @property
    def first(self) -> bool:
        """Whether this is rank 0, which reads and writes the run's files."""
        return self.rank == 0

    def check(self, config: TrainConfig[Any]) -> None:
        """Check that a run can be divided among the processes."""
        batch, pool = config.world_count, config.pool_size
        self.check_even("world_count", batch)
        if pool % batch:
            raise NPAError(
                f"pool_size must be a multiple of world_count in a run of several processes, got "
                f"{pool} and {batch}: set pool_size={pool // batch * batch}"
            )

    def check_even(self, name: str, worlds: int) -> None:
        """Check that a number of worlds, called `name` in the error, is divisible by `count`."""
        if worlds % self.count:
            nearest = max(worlds // self.count, 1) * self.count
            raise NPAError(
                f"{name} must be a multiple of the number of processes, got {worlds} and "
                f"{self.count}: set {name}={nearest}"
            )

    def indices(self, total: int, section: int = 1) -> Tensor:
        """Return the indices of this process's worlds, on the CPU, int64, shape [total / count]."""
        return self.local(torch.arange(total), section)

    def local(self, worlds: Tensor, section: int) -> Tensor:
        """Return this process's part of all worlds, which come in sections of `section` worlds."""
        parts = worlds.view(-1, self.count, section, *worlds.shape[1:])
        return parts[:, self.rank].flatten(0, 1)

    def collected(self, worlds: Tensor, section: int) -> Tensor:
        """Gather the worlds of all processes on rank 0, on the CPU; others get their own worlds.

        With one process `worlds` is returned unchanged.
        """
        if self.count == 1:
            return worlds
        mine = worlds.detach().cpu().contiguous()
        parts = [torch.empty_like(mine) for _ in range(self.count)] if self.first else None
        with self._lost_process_error():
            dist.gather(mine, parts)
        if parts is None:
            return mine
        sections = [part.view(-1, section, *part.shape[1:]) for part in parts]
        return torch.stack(sections, 1).flatten(0, 2)

    def broadcast(self, value: ValueT) -> ValueT:
        """Return rank 0's value on all processes."""
        if not self.together:
            return value
        values = [value]
        with self._lost_process_error():
            dist.broadcast_object_list(values)
        return values[0]

    def any(self, flag: bool) -> bool:
        """Return whether the flag is set on any process."""
        if not self.together:
            return flag
        return bool(self._all_reduce(torch.tensor(int(flag)), "MAX"))

    def agree_to_stop(self, requested: bool, iteration: int) -> bool:
        """Return whether to stop before an iteration, because any process was requested to."""
        if not self.together:
            return requested
        if self._checked_at is not None and self._checked_at[0] < iteration < self._next_check:
            return False
        now, took = time.monotonic(), math.inf
        if self._checked_at is not None and iteration > self._checked_at[0]:
            took = (now - self._checked_at[1]) / (iteration - self._checked_at[0])
        # The launcher stops its processes; if it was killed, they stop by themselves.
        stop = requested or os.getppid() != self._parent
        largest = self._all_reduce(torch.tensor([float(stop), took], dtype=torch.float64), "MAX")
        interval = min(max(int(AGREE_SECONDS / max(float(largest[1]), 1e-9)), 1), AGREE_INTERVAL)
        self._checked_at, self._next_check = (iteration, now), iteration + interval
        return bool(largest[0])

    def reduce(self, means: Sequence[Tensor], total: Tensor | None = None) -> None:
        """Replace tensors by their means, and `total` by its sum, over all processes, in place.

        All of `means` have one dtype. CUDA is not synchronised.
        """
        if not self.together:
            return
        parts = [mean.reshape(-1) for mean in means]
        if total is not None:
            parts.append(total.reshape(1).to(means[0]))
        flat = self._all_reduce(torch.cat(parts))
        if total is not None:
            total.copy_(flat[-1])
        flat /= self.count
        reduced = torch.split(flat, [len(part) for part in parts])
        for mean, values in zip(means, reduced, strict=False):
            mean.copy_(values.view(mean.shape))

    def mean(self, value: Tensor) -> Tensor:
        """Return the mean of a tensor over all processes; all of them must call it."""
        mean = value.detach().clone()
        self.reduce([mean])
        return mean

    def check_same(self, tensors: Sequence[Tensor]) -> None:
        """Check that tensors are the same on all processes, bit for bit."""
        if self.count == 1:
            return
        flat = torch.cat([tensor.detach().reshape(-1).double().cpu() for tensor in tensors])
        low, high = (self._all_reduce(flat.clone(), op) for op in ("MIN", "MAX"))
        differing = int((low != high).sum())
        if differing:
            raise NPAError(
                f"the parameters must be the same on all {self.count} processes, but {differing} "
                f"of {len(flat)} differ, by at most {float((high - low).max()):.3g}: the last "
                "checkpoint is intact; resume it, and look for a faulty device or for processes "
                "with different versions of a library"
            )

    def _all_reduce(self, tensor: Tensor, op: str = "SUM") -> Tensor:
        """Reduce a tensor over all processes, in place, and return it."""
        with self._lost_process_error():
            dist.all_reduce(tensor, op=getattr(dist.ReduceOp, op))
        return tensor

    @contextlib.contextmanager
    def _lost_process_error(self) -> Iterator[None]:
        try:
            yield
        except RuntimeError as error:
            if isinstance(error, torch.OutOfMemoryError):
                raise
            raise LostProcessError(
                f"process {self.rank} of {self.count} has lost another one, which has ended or "
                f"cannot be reached ({shown(error)}): the last checkpoint is intact; see what "
                "the other process printed, then resume"
            ) from error


ALONE = Ranks()


# Random streams: one for the whole batch, or one for each world.


@dataclass(frozen=True)
class RunRandomness:
    """Random sources of a run: `of_batch` for one process, `by_world` for several.

    `schedule`, on the CPU, draws numbers of steps and initial weights; `pool` the first worlds;
    `worlds` which worlds a batch has, their damage and seeds; `masks` which particles are updated.
    Of one process they are generators. With several, each world has streams that depend on the
    seed, the world's index among those of all processes, and the iteration: they are the same for
    any number of processes, and checkpoints need not store them.
    """

    schedule: torch.Generator
    pool: Randomness
    worlds: Randomness
    masks: Randomness

    @classmethod
    def of_batch(
        cls, config: TrainConfig[Any], device: torch.device, schedule: torch.Generator
    ) -> RunRandomness:
        """Return generators that all worlds of a batch share, for a run of one process."""
        worlds = torch.Generator(device).manual_seed(config.seed + 1)
        masks = torch.Generator(device).manual_seed(config.seed + 2)
        return cls(schedule, worlds, worlds, masks)

    @classmethod
    def by_world(
        cls, config: TrainConfig[Any], device: torch.device, schedule: torch.Generator, ranks: Ranks
    ) -> RunRandomness:
        """Return random streams of each world, for a run of several processes."""
        batch, pool = config.world_count, config.pool_size

        def streams(purpose: int, total: int, indices: Tensor) -> WorldRandom:
            return world_streams((config.seed, purpose), total, indices, device)

        of_batch = ranks.indices(batch)
        return cls(
            schedule,
            pool=streams(0, pool, ranks.indices(pool, pool // batch)),
            worlds=streams(1, batch, of_batch),
            masks=streams(2, batch, of_batch),
        )

    def _sources(self) -> dict[str, Randomness]:
        return {"schedule": self.schedule, "worlds": self.worlds, "masks": self.masks}

    def state_dict(self) -> dict[str, Tensor]:
        """Return the states of all generators, for a checkpoint."""
        sources = self._sources().items()
        return {name: own.get_state() for name, own in sources if isinstance(own, torch.Generator)}

    def load_state_dict(self, states: Mapping[str, Tensor], iteration: int) -> None:
        """Restore what `state_dict` returned after `iteration`."""
        for name, source in self._sources().items():
            if isinstance(source, torch.Generator):
                source.set_state(states[name])
            else:
                source.episodes.fill_(iteration)


def world_streams(
    seed: Sequence[int], total: int, indices: Tensor, device: torch.device
) -> WorldRandom:
    """Return the streams of the worlds at `indices` among `total`, whatever the others are."""
    keys = np.random.default_rng(seed).integers(2**64, size=total, dtype=np.uint64)
    return WorldRandom.from_keys(torch.from_numpy(keys.view(np.int64))[indices].to(device))


def restart(*sources: Randomness) -> None:
    """Begin the next episode of streams by world; generators are left unchanged."""
    for source in sources:
        if isinstance(source, WorldRandom):
            source.restart()


def registered(source: Randomness) -> torch.Generator | None:
    """Return the generator to register with a CUDA graph, or None for streams by world."""
    return source if isinstance(source, torch.Generator) else None


# Processes that torchrun starts.


@contextlib.contextmanager
def joined_ranks() -> Iterator[Ranks]:
    """Join the other processes that torchrun has started, within the block.

    Each process sees one CUDA device, by its local rank; call this before anything uses CUDA.
    Within the block, a process that is lost ends all others (see `Heartbeat`), so the process that
    hosts the store must leave last. Without torchrun there is a single process.
    """
    if not dist.is_available() or not dist.is_torchelastic_launched():
        yield Ranks()
        return
    # CUDA builds of torch have NCCL, but it fails on machines without a GPU. device_count asks
    # NVML, which does not initialise CUDA.
    has_gpus = torch.cuda.device_count() >= int(os.environ["LOCAL_WORLD_SIZE"])
    backend = "cpu:gloo,cuda:nccl" if dist.is_nccl_available() and has_gpus else "gloo"
    if torch.cuda.device_count() > 0:
        rank, visible = int(os.environ["LOCAL_RANK"]), os.environ.get("CUDA_VISIBLE_DEVICES")
        devices = [str(rank)] if visible is None else visible.split(",")[rank : rank + 1]
        os.environ["CUDA_VISIBLE_DEVICES"] = ",".join(devices)
    try:
        dist.init_process_group(backend)
        ranks = Ranks.current()
        heartbeat = None
        if ranks.count > 1:
            # A separate connection: that of the group blocks while the group waits.
            address, port = os.environ["MASTER_ADDR"], int(os.environ["MASTER_PORT"])
            store = dist.TCPStore(address, port, wait_for_workers=False)  # type: ignore[attr-defined]
            # Torchrun may keep the store when it restarts processes.
            prefix = ranks.broadcast(uuid.uuid4().hex)
            own = dist.PrefixStore(prefix, store)  # type: ignore[attr-defined]
            heartbeat = Heartbeat(own, ranks.rank, ranks.count)
    except (RuntimeError, ValueError) as error:
        raise NPAError(
            f"the processes that torchrun starts must reach each other, but this one cannot "
            f"({shown(error)}): see its options --rdzv-endpoint and --master-addr"
        ) from error
    finished = False
    try:
        yield ranks
        finished = True
    finally:
        if heartbeat is not None:
            heartbeat.end(finished=finished)
    # Not after an error: others may be gone. Recorded graphs keep references to the group.
    gc.collect()
    dist.destroy_process_group()


BEAT_SECONDS = 5.0
"""Time between two heartbeats [s]."""

SILENT_BEATS = 8
"""Number of missed heartbeats after which a process is lost."""

LOST_CODE = 2
"""Exit code of a process that has lost another one, that of errors on the command line."""

_FINISHED = -(2**62)


class Heartbeat:
    """Ends this process, with a message, when another one sends no heartbeats.

    Collectives would wait up to NCCL's timeout of 10 minutes for a process that was stopped or
    whose machine is gone. Time is counted in this process's own heartbeats, so that a process that
    was suspended does not blame others. Threads send heartbeats while a process waits or computes.
    """

    def __init__(self, store: Any, rank: int, count: int) -> None:
        self._store, self._rank = store, rank
        self._beats = [0] * count
        self._ended = threading.Event()
        self._finished = self._store_gone = False
        # Two threads, as a store that does not answer blocks the one that reads it.
        self._threads = [
            threading.Thread(target=task, daemon=True) for task in (self._beat, self._watch)
        ]
        for thread in self._threads:
            thread.start()

    def end(self, *, finished: bool) -> None:
        """Stop watching; with `finished`, let the others go on without this process."""
        self._finished = finished
        self._ended.set()
        for thread in self._threads:
            thread.join(BEAT_SECONDS)

    def _beat(self) -> None:
        try:
            while not self._ended.is_set():
                for other in range(len(self._beats)):
                    self._beats[other] = self._store.add(str(other), int(other == self._rank))
                self._ended.wait(BEAT_SECONDS)
            if self._finished:
                self._store.add(str(self._rank), _FINISHED)
        except RuntimeError:
            # From now on all processes that have not left seem silent.
            self._store_gone = True

    def _watch(self) -> None:
        count = len(self._beats)
        last, silent = self._beats.copy(), [0] * count
        while not self._ended.wait(BEAT_SECONDS):
            beats = self._beats.copy()
            for other in range(count):
                alive = other == self._rank or beats[other] != last[other] or beats[other] < 0
                silent[other] = 0 if alive else silent[other] + 1
            last = beats
            lost = [str(other) for other in range(count) if silent[other] >= SILENT_BEATS]
            if lost:
                why = (
                    "as the store of the processes is gone"
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
                # The main thread may block in a collective for ever.
                os._exit(LOST_CODE)
