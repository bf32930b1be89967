"""The processes that train one rule together, and the random streams of a run."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor

from npa_envs.errors import LostProcessError, NPAError, shown
from npa_envs.tasks.train_config import TrainConfig
from npa_envs.world.randomness import Randomness, WorldRandom

ValueT = TypeVar("ValueT")


class ProcessGroup:
    """The `count` processes of a run, of which this one is number `rank`.

    Pool and batch are cut into as many sections as the batch has worlds. Section k belongs to rank
    k % count, so that each process has young and old worlds.
    """

    def __init__(self, rank: int = 0, count: int = 1, *, distributed: bool = False) -> None:
        self.rank = rank
        self.count = count
        self.distributed = distributed
        """Whether the processes are torch's default group, which may have only one process."""
        self._parent = os.getppid()

    @classmethod
    def current(cls) -> ProcessGroup:
        """Return the processes of torch's default group, or a single process without a group."""
        if dist.is_available() and dist.is_initialized():
            return cls(dist.get_rank(), dist.get_world_size(), distributed=True)
        return cls()

    @property
    def first(self) -> bool:
        """Whether this is rank 0, which reads and writes the run's files."""
        return self.rank == 0

    def check(self, config: TrainConfig[Any]) -> None:
        """Raise NPAError unless batch and pool of a run can be divided among the processes."""
        batch, pool = config.world_count, config.pool_size
        self.check_even("world_count", batch)
        if pool % batch:
            raise NPAError(
                f"pool_size must be a multiple of world_count in a run of several processes, got "
                f"{pool} and {batch}: set pool_size={pool // batch * batch}"
            )

    def check_even(self, name: str, worlds: int) -> None:
        """Raise NPAError unless a number of worlds, called `name`, is divisible by `count`."""
        if worlds % self.count:
            nearest = max(worlds // self.count, 1) * self.count
            raise NPAError(
                f"{name} must be a multiple of the number of processes, got {worlds} and "
                f"{self.count}: set {name}={nearest}"
            )

    def indices(self, total: int, section: int = 1) -> Tensor:
        """Return the indices of this process's worlds among `total`, by `local`, on the CPU."""
        return self.local(torch.arange(total), section)

    def local(self, worlds: Tensor, section: int) -> Tensor:
        """Return this process's rows of all worlds: every `count`-th section, of `section` rows."""
        sections = worlds.view(-1, self.count, section, *worlds.shape[1:])
        return sections[:, self.rank].flatten(0, 1)

    def gathered(self, worlds: Tensor, section: int) -> Tensor:
        """Return all processes' rows on rank 0, and this process's on other ranks, on the CPU.

        It is the inverse of `local`. With one process `worlds` is returned unchanged.
        """
        if self.count == 1:
            return worlds
        local = worlds.detach().cpu().contiguous()
        by_rank = [torch.empty_like(local) for _ in range(self.count)] if self.first else None
        with self._lost_process_error():
            dist.gather(local, by_rank)
        if by_rank is None:
            return local
        sections = [worlds.view(-1, section, *worlds.shape[1:]) for worlds in by_rank]
        return torch.stack(sections, 1).flatten(0, 2)

    def broadcast(self, value: ValueT) -> ValueT:
        """Return rank 0's value on all processes."""
        if not self.distributed:
            return value
        values = [value]
        with self._lost_process_error():
            dist.broadcast_object_list(values)
        return values[0]

    def any(self, flag: bool) -> bool:
        """Return whether `flag` is True on any process."""
        if not self.distributed:
            return flag
        return bool(self._all_reduce(torch.tensor(int(flag)), "MAX"))

    def agree_to_stop(self, requested: bool) -> bool:
        """Return whether any process was requested to stop, or has lost its launcher."""
        return self.any(requested or (self.distributed and os.getppid() != self._parent))

    def reduce(self, means: Sequence[Tensor], total: Tensor | None = None) -> None:
        """Replace tensors by their means, and `total` by its sum, over all processes, in place.

        All of `means` have one dtype. CUDA is not synchronised.
        """
        if not self.distributed:
            return
        pieces = [mean.reshape(-1) for mean in means]
        if total is not None:
            pieces.append(total.reshape(1).to(means[0]))
        flat = self._all_reduce(torch.cat(pieces))
        if total is not None:
            total.copy_(flat[-1])
        flat /= self.count
        reduced = torch.split(flat, [len(piece) for piece in pieces])
        for mean, values in zip(means, reduced, strict=False):
            mean.copy_(values.view(mean.shape))

    def check_same(self, tensors: Sequence[Tensor]) -> None:
        """Raise NPAError unless tensors have the same values on all processes."""
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


ALONE = ProcessGroup()
"""The only process of a run without a group."""


class RunRandomness:
    """Random generators of a run, by what they draw.

    `run`, on the CPU, draws numbers of steps and initial weights; `pool` the first worlds; `worlds`
    which worlds a batch has, their damage and start worlds; `masks` which particles are updated.

    By default they are torch generators, whose states checkpoints store. With `per_world_streams`,
    which runs of several processes need, all but `run` have a stream for each world. Streams depend
    on the run's seed, the world's index among those of all processes, and the iteration, so they
    are the same for any number of processes, and checkpoints need not store them.
    """

    def __init__(
        self,
        config: TrainConfig[Any],
        device: torch.device,
        run_generator: torch.Generator,
        processes: ProcessGroup,
        *,
        per_world_streams: bool,
    ) -> None:
        batch, pool = config.world_count, config.pool_size

        def streams(purpose: int, total: int, section: int = 1) -> Randomness:
            if not per_world_streams:
                return torch.Generator(device).manual_seed(config.seed + purpose)
            indices = processes.indices(total, section)
            return world_streams((config.seed, purpose), total, indices, device)

        self.run = run_generator
        self.worlds = streams(1, batch)
        self.masks = streams(2, batch)
        self.pool = streams(0, pool, pool // batch) if per_world_streams else self.worlds

    def _by_name(self) -> dict[str, Randomness]:
        return {"schedule": self.run, "worlds": self.worlds, "masks": self.masks}

    def state_dict(self) -> dict[str, Tensor]:
        """Return the states of torch generators by name, for a checkpoint."""
        randoms = self._by_name().items()
        return {name: one.get_state() for name, one in randoms if isinstance(one, torch.Generator)}

    def load_state_dict(self, states: Mapping[str, Tensor], iteration: int) -> None:
        """Restore what `state_dict` returned after `iteration`."""
        for name, random in self._by_name().items():
            if isinstance(random, torch.Generator):
                random.set_state(states[name])
            else:
                random.episodes.fill_(iteration)


def world_streams(
    seed: Sequence[int], total: int, indices: Tensor, device: torch.device
) -> WorldRandom:
    """Return the random streams of worlds at `indices` of `total`, by `seed` and their indices."""
    keys = np.random.default_rng(seed).integers(2**64, size=total, dtype=np.uint64)
    return WorldRandom.from_keys(torch.from_numpy(keys.view(np.int64))[indices].to(device))


def begin_episodes(*randoms: Randomness) -> None:
    """Begin the next episode of each `WorldRandom`, in place; torch generators do not change."""
    for random in randoms:
        if isinstance(random, WorldRandom):
            random.restart()


def generator_to_register(random: Randomness) -> torch.Generator | None:
    """Return `random` if it is a torch generator, which CUDA graphs must register; else None."""
    return random if isinstance(random, torch.Generator) else None
