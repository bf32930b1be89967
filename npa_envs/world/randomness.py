"""Randomness of batched worlds: one stream for each world, the same on every device."""

from __future__ import annotations

import copy
import enum
import math
import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from npa_envs.checks import DTYPES, check_dense, check_device, checked_count, checked_number
from npa_envs.errors import NPAError, shown
from npa_envs.ops.random_numbers import WORD_COUNT, draw, mixed_keys
from npa_envs.ops.sort import MAX_INDEX


@enum.unique
class StreamId(enum.IntEnum):
    """What the package's random streams are for; arguments of `WorldRandom.substream`.

    Numbers below 1000 are reserved for the package; use others in your own code.
    """

    GROWTH = 1
    """A trained rule grows the world that an episode starts from."""
    DAMAGE = 2
    """Damage during an episode."""
    POLICY = 3
    """A policy acts at random."""
    SPECIES = 4
    """Tags that distinguish particles."""
    GOAL = 5
    """The goal of an episode."""
    OPPONENT = 6
    """An opponent that the environment plays acts at random."""
    TEST = 7
    """Starts of evaluation episodes, separate from those of training."""


class WorldRandom:
    """Random streams of batched worlds.

    Random numbers depend on their world's seed, episode and step, and on how many calls in this
    step came before, but never on other worlds: world k of a batch draws the numbers that it draws
    as a batch of one. Integers and uniform numbers are the same on every device, bit for bit, and
    normal numbers up to the last bit. Nothing waits for the device, and a CUDA graph that begins
    with `advance` draws new numbers at each replay.

    Args:
        seeds: Seed of each world, integers of at least 0; a single integer makes one world.
        device: Device on which the numbers are drawn.

    Raises:
        NPAError: A seed is not an integer of at least 0, there is no seed, or no such device.

    Attributes:
        keys: Key of each world, the seed's first 64 random bits, int64, shape [B].
        episodes: Number of each world's episode, from 0 on, int32, shape [B].
        steps: Number of each world's step in its episode, from 0 on, int32, shape [B]; start worlds
            are drawn in step 0.
    """

    def __init__(self, seeds: int | Sequence[int], *, device: str | torch.device = "cpu") -> None:
        several = isinstance(seeds, Sequence | np.ndarray) and getattr(seeds, "ndim", 1) != 0
        entries: list[Any] = list(seeds) if several else [seeds]  # type: ignore[arg-type]
        if not entries:
            raise NPAError("seeds must hold at least one seed, got none: give one for each world")
        # The first draw of NumPy's generator is what Gymnasium's seeding gives as well.
        keys = [
            np.random.default_rng(checked_count("a seed", seed)).integers(2**64, dtype=np.uint64)
            for seed in entries
        ]
        bits = torch.from_numpy(np.array(keys, dtype=np.uint64).view(np.int64))
        self._start(bits.to(check_device(device)))

    def _start(self, keys: Tensor) -> None:
        self.keys = keys
        self.episodes = torch.zeros(keys.shape, dtype=torch.int32, device=keys.device)
        self.steps = torch.zeros_like(self.episodes)
        self._draw_count = 0

    @classmethod
    def from_keys(cls, keys: Tensor) -> WorldRandom:
        """Return streams with given keys, at episode 0 and step 0.

        Args:
            keys: Any 64 bits for each world, int64, shape [B]; copied.

        Raises:
            NPAError: The keys are not an int64 tensor of shape [B].
        """
        if not isinstance(keys, Tensor) or keys.dtype != torch.int64 or keys.ndim != 1:
            is_tensor = isinstance(keys, Tensor)
            got = f"{keys.dtype} {tuple(keys.shape)}" if is_tensor else type(keys).__name__
            raise NPAError(
                f"keys must be an int64 tensor of shape [B], got {got}: "
                f"make streams from integers with WorldRandom(seeds)"
            )
        check_dense("keys", keys)
        streams = cls.__new__(cls)
        streams._start(keys.clone(memory_format=torch.contiguous_format))
        return streams

    @property
    def device(self) -> torch.device:
        """Device on which the numbers are drawn."""
        return self.keys.device

    @property
    def world_count(self) -> int:
        """Number of worlds B."""
        return self.keys.shape[0]

    def advance(self, steps: int = 1) -> None:
        """Advance every world by a number of steps, in place.

        Args:
            steps: Number of steps; 0 restarts the current step, whose random numbers are repeated.

        Raises:
            NPAError: `steps` is not an integer of at least 0.
        """
        self.steps += checked_count("steps", steps)
        self._draw_count = 0

    def undo_advance(self, steps: int = 1) -> None:
        """Go back by a number of steps, whose random numbers the next `advance` repeats."""
        self.steps -= steps

    def restart(self) -> None:
        """Begin the next episode of every world at step 0, in place, with new random numbers."""
        self.episodes += 1
        self.steps.zero_()
        self._draw_count = 0

    def take(self, worlds: Tensor | slice) -> WorldRandom:
        """Return a copy of the streams of some worlds: indices, int64, 1D, or a slice."""
        taken = copy.copy(self)
        taken.keys = self.keys[worlds].clone()
        taken.episodes = self.episodes[worlds].clone()
        taken.steps = self.steps[worlds].clone()
        return taken

    def take_steps(self, count: int) -> WorldRandom:
        """Return copies of the streams for each of the next `count` steps, as streams [count B].

        They draw these steps' numbers after `advance`, and then belong into `sync_with`.
        """
        taken = copy.copy(self)
        taken.keys = self.keys.expand(count, -1).flatten()
        taken.episodes = self.episodes.expand(count, -1).flatten()
        ahead = torch.arange(count, dtype=self.steps.dtype, device=self.device)
        taken.steps = (ahead[:, None] + self.steps).flatten()
        return taken

    def substream(self, purpose: int) -> WorldRandom:
        """Return new streams, independent of these and of those of other purposes.

        They begin at these streams' current episode and step, and advance separately. Two calls
        within a step with one purpose return the same streams. These streams do not change.

        Args:
            purpose: Any integer of at least 0; the package uses those of `StreamId`.

        Raises:
            NPAError: `purpose` is not an integer of at least 0.
        """
        streams = type(self).__new__(type(self))
        streams.keys = mixed_keys(self.keys, checked_count("purpose", purpose))
        streams.episodes, streams.steps = self.episodes.clone(), self.steps.clone()
        streams._draw_count = 0
        return streams

    def put(self, worlds: Tensor | slice, other: WorldRandom) -> None:
        """Write the keys, episodes and steps of other streams into some worlds, in place.

        `worlds` are indices, int64, 1D, or a slice. From the next `advance` on they draw the other
        streams' numbers. Until then they draw no number twice: worlds share the count of calls.
        """
        self.keys[worlds] = other.keys
        self.episodes[worlds] = other.episodes
        self.steps[worlds] = other.steps
        self._draw_count = max(self._draw_count, other._draw_count)

    def sync_with(self, other: WorldRandom, steps: int) -> None:
        """Set these streams to the state of `other`, a copy of them that is `steps` ahead."""
        self.steps += steps
        self._draw_count = other._draw_count

    def uniform(self, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        """Return numbers uniform in [0, 1), shape [B, *shape].

        Args:
            shape: Shape of each world's numbers.
            dtype: `torch.float32`, with 24 random bits, or `torch.float64`, with 53.

        Raises:
            NPAError: A size is not an integer of at least 0, or the dtype is another one.
        """
        return self._drawn("uniform", shape, dtype)

    def normal(self, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        """Return standard normal numbers, always finite, shape [B, *shape].

        Arguments and errors are those of `uniform`.
        """
        return self._drawn("normal", shape, dtype)

    def bernoulli(self, probability: float, *shape: int) -> Tensor:
        """Return random ones and zeros, uint8, shape [B, *shape].

        Args:
            probability: Probability of a one, in [0, 1], rounded to a multiple of 2^-32.

        Raises:
            NPAError: The probability is not in [0, 1], or as `uniform`.
        """
        chance = checked_number("probability", probability)
        if not 0.0 <= chance <= 1.0:
            raise NPAError(f"probability must lie in [0, 1], got {probability}: try 0.5")
        return self._drawn("bernoulli", shape, torch.uint8, round(chance * WORD_COUNT))

    def integers(self, high: int, *shape: int) -> Tensor:
        """Return integers uniform in [0, high), int64, shape [B, *shape].

        Args:
            high: One more than the largest, from 1 to 2^63 - 1.

        Raises:
            NPAError: `high` is out of range, or as `uniform`.
        """
        limit = checked_count("high", high)
        if not 1 <= limit < 2**63:
            raise NPAError(f"high must lie in [1, 2^63 - 1], got {high}: draw from [0, high)")
        return self._drawn("integers", shape, torch.int64, limit)

    def _drawn(
        self, kind: str, shape: tuple[int, ...], dtype: torch.dtype, bound: int = 0
    ) -> Tensor:
        if kind in ("uniform", "normal") and dtype not in DTYPES:
            raise NPAError(f"dtype must be torch.float32 or torch.float64, got {dtype}")
        count = math.prod(checked_count("a size", size) for size in shape)
        if count * self.world_count > MAX_INDEX:
            raise NPAError(
                f"a draw must have at most {MAX_INDEX} numbers, got {count} for each of "
                f"{self.world_count} worlds: draw several times"
            )
        index = self._draw_count
        self._draw_count += 1
        drawn: Tensor = draw(self.keys, self.episodes, self.steps, index, kind, count, dtype, bound)
        return drawn.view(self.world_count, *shape)


Randomness = torch.Generator | WorldRandom
"""Sources of random numbers."""


def torch_generator(generator: Randomness | None, device: torch.device) -> torch.Generator:
    """Return the given torch generator, or if it is None torch's default one of a CUDA device."""
    if generator is None:
        return torch.cuda.default_generators[device.index]
    assert isinstance(generator, torch.Generator)
    return generator


_reserving = threading.Lock()
"""Lock held while a generator's offset is read and advanced: threads may share a generator."""


def reserve_draws(source: torch.Generator, count: int) -> int:
    """Increase a CUDA generator's offset by `count`, and return the former offset."""
    with _reserving:
        begin = source.get_offset()
        source.set_offset(begin + count)
    return begin


def give_back_draws(source: torch.Generator, begin: int, count: int) -> None:
    """Undo `reserve_draws`, which returned `begin`, unless the generator was used since."""
    with _reserving:
        if source.get_offset() == begin + count:
            source.set_offset(begin)


def check_generator(generator: Randomness | None, device: torch.device, world_count: int) -> None:
    """Check type, device and number of worlds of a source of random numbers; None is allowed."""
    if generator is None:
        return
    if not isinstance(generator, Randomness):
        raise NPAError(
            f"generator must be a torch.Generator or a WorldRandom, got {type(generator).__name__}"
            f": make it with torch.Generator({shown(device.type)}).manual_seed(0)"
        )
    its, hint = generator.device, f"torch.Generator({shown(device.type)})"
    wrong = its.type != device.type
    if isinstance(generator, WorldRandom):
        wrong |= None not in (its.index, device.index) and its.index != device.index
        hint = f"WorldRandom(seeds, device={shown(str(device))})"
    if wrong:
        raise NPAError(
            f"generator must be on the worlds' device, {device}, got {its}: make it with {hint}"
        )
    if isinstance(generator, WorldRandom) and generator.world_count != world_count:
        raise NPAError(
            f"generator must have one stream for each world, B = {world_count}, "
            f"got {generator.world_count}: make it with {hint} of {world_count} seeds"
        )


def uniform_draws(generator: Randomness | None, shape: Sequence[int], like: Tensor) -> Tensor:
    """Return random numbers uniform in [0, 1), shape [B, ...], of `like`'s dtype and device."""
    if isinstance(generator, WorldRandom):
        return generator.uniform(*shape[1:], dtype=like.dtype)
    return torch.rand(tuple(shape), generator=generator, device=like.device, dtype=like.dtype)


def normal_draws(generator: Randomness | None, shape: Sequence[int], like: Tensor) -> Tensor:
    """Return standard normal random numbers, shape [B, ...], of `like`'s dtype and device."""
    if isinstance(generator, WorldRandom):
        return generator.normal(*shape[1:], dtype=like.dtype)
    return torch.randn(tuple(shape), generator=generator, device=like.device, dtype=like.dtype)
