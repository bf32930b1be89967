"""Parallel runs on one device, each on a separate CUDA stream, for other scripts."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch

from npa_envs.training import Trainer


def stream_of(device: str | torch.device) -> Any:
    """Return a new CUDA stream of a device; on a CPU a context that does nothing."""
    device = torch.device(device)
    return torch.cuda.Stream(device) if device.type == "cuda" else contextlib.nullcontext()


def on(stream: Any) -> Any:
    """Return a context in which CUDA work goes to what `stream_of` returned."""
    return torch.cuda.stream(stream) if isinstance(stream, torch.cuda.Stream) else stream


def iterate_together(
    trainers: Sequence[Trainer],
    streams: Sequence[Any],
    longest: float = math.inf,
    *,
    clock: float = math.inf,
    ahead: int = 16,
    at: Callable[[int], None] | None = None,
) -> float:
    """Train several rules, an iteration of each in turn; return the duration [s].

    Each trainer has its stream of `streams`. Training stops after `longest` seconds, or `clock`
    seconds, in which the learning rate's cosine falls. Each `ahead` iterations the host waits for
    the device. `at` is called with the number of each iteration before it begins.
    """
    cuda = trainers[0].config.device.startswith("cuda")
    begun = time.perf_counter()
    for number in range(max(trainer.config.total_iterations for trainer in trainers)):
        if number % ahead == 0 and cuda:
            # The host would run ahead of the time that the device needs.
            torch.cuda.synchronize()
        elapsed = time.perf_counter() - begun
        if elapsed >= min(longest, clock):
            break
        if at is not None:
            at(number)
        for trainer, stream in zip(trainers, streams, strict=True):
            if trainer.iteration < trainer.config.total_iterations:
                with on(stream):
                    trainer.iterate(elapsed / clock)
    if cuda:
        torch.cuda.synchronize()
    return time.perf_counter() - begun
