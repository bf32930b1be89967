"""Rollouts of small worlds without gradients, on a CPU, that replay the launches of earlier ones.

In a step of such worlds Python takes several times as long as kernels. From the third call with the
same shapes and options on, a rollout replays the recorded launches of two steps. The first reads
one buffer and writes another; the second does the reverse.
"""

from __future__ import annotations

import contextlib
import dataclasses
import threading
from collections.abc import Iterable, Iterator
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import is_in_torch_dispatch_mode

from npa_envs.ops.launch import RecordedLaunches
from npa_envs.ops.perception_passes import perception_threads
from npa_envs.ops.sort import sorts_at_once
from npa_envs.world.capture_cache import LAUNCHED_FIRST, CallGroups
from npa_envs.world.particles import Particles, combined
from npa_envs.world.randomness import Randomness, WorldRandom
from npa_envs.world.rule_settings import rule_form
from npa_envs.world.steps import Draws, RuleStep, active_counts

MAX_REPLAYED_PARTICLES = 4096
"""Maximum number of particles B N; the steps of larger batches take most time in kernels."""

STEPS_DRAWN_TOGETHER = 16
"""Number of steps whose random numbers are drawn by one launch of each kind."""

MAX_REPLAYED_GROUPS = 32
"""Maximum number of groups of calls whose launches are kept."""


class _ReplayedStep:
    """The recorded launches of one step, which reads one buffer of worlds and writes another.

    The network is not recorded: during the recording this object is called in its place.
    """

    def __init__(self, step: RuleStep, particles: Particles, mask: Tensor | None) -> None:
        assert step.network is not None
        self.row_width = step.network.row_width
        self._update_width = step.network.update_width
        self.launches = RecordedLaunches()
        stand_in: Any = self
        with self.launches.recording():
            step = dataclasses.replace(step, network=stand_in, world_by_world=False)
            self.after = step.advance(particles, Draws(mask, None))
        self.slots = self.launches.argument_slots(self._updates)

    def __call__(self, rows: Tensor) -> Tensor:
        """Store the network's input rows and before which launch it runs; return zero updates."""
        self.rows = rows
        self.split = len(self.launches)
        self._updates = rows.new_zeros(len(rows), self._update_width)
        return self._updates


class ReplayedSteps:
    """Two recorded steps of worlds of one shape: from a first buffer to a second one, and back."""

    def __init__(self, step: RuleStep, particles: Particles) -> None:
        # With all particles active there is a row for each.
        masked = step.physics.update_prob < 1.0
        self._mask = torch.ones(particles.x.shape[:2], dtype=torch.uint8) if masked else None
        # Contiguous: a copy that a step would have to make is not recorded.
        first = particles.map(lambda value: value.clone(memory_format=torch.contiguous_format))
        there = _ReplayedStep(step, first, self._mask)
        back = _ReplayedStep(step, there.after, self._mask)
        for old, new in zip(back.after.tensors(), first.tensors(), strict=True):
            back.launches.move(back.launches.argument_slots(old), new)
        self._buffers = first, there.after
        self._steps = there, back

    def run(
        self,
        rule_step: RuleStep,
        particles: Particles,
        drawn: Iterable[tuple[Draws, list[int]]],
        every: int,
    ) -> list[Particles]:
        """Make a step with each draw; return copies of worlds every `every` steps.

        With a draw come the numbers of active particles of each world.
        """
        self._buffers[0].copy_(particles)
        trajectory: list[Particles] = []
        for number, ((mask, noise, *_), counts) in enumerate(drawn):
            step = self._steps[number % 2]
            if self._mask is not None and mask is not None:
                self._mask.copy_(mask)
            count = max(sum(counts), 1)
            step.launches.replay(0, step.split, last_count=perception_threads(count))
            # Kept alive until the launch has read it.
            updates = rule_step.updates_of(step.rows[:count], counts)
            step.launches.move(step.slots, updates)
            if noise is not None:
                self._buffers[number % 2].x.add_(noise)
            step.launches.replay(step.split)
            if (number + 1) % every == 0:
                trajectory.append(self._buffers[(number + 1) % 2].map(torch.clone))
        return trajectory


def _draws(
    step: RuleStep, x: Tensor, steps: int, generator: Randomness | None
) -> Iterator[tuple[Draws, list[int]]]:
    """Yield what `step.draw` yields, with numbers of active particles of each world.

    Streams of worlds are drawn for several steps at once.
    """
    if not isinstance(generator, WorldRandom):
        for draws in step.draw(x, steps, generator):
            yield draws, active_counts(draws.mask, x.shape)
        return
    for first in range(0, steps, STEPS_DRAWN_TOGETHER):
        count = min(STEPS_DRAWN_TOGETHER, steps - first)
        streams = generator.take_steps(count)
        like = x[:1, :1, :1].expand(count * len(x), *x.shape[1:])
        together = step.draw_step(like, streams)[:2]
        drawn = [
            [None] * count if values is None else values.view(count, len(x), *values.shape[1:])
            for values in together
        ]
        generator.sync_with(streams, count)
        counts = active_counts(together[0], like.shape)
        each = [counts[k : k + len(x)] for k in range(0, len(counts), len(x))]
        yield from zip(map(Draws, *drawn), each, strict=True)


_groups = CallGroups()
_groups_lock = threading.Lock()


def replay_launches(
    step: RuleStep,
    particles: Particles,
    generator: Randomness | None,
    steps: int,
    keep_every: int | None,
) -> Particles | None:
    """Run a rollout by replaying recorded launches; None if the caller must launch its steps.

    Only small worlds on a CPU are replayed, without gradients, and not in the first
    `LAUNCHED_FIRST` calls with the same shapes and options.
    """
    x, s, *_ = particles
    if (
        torch.compiler.is_compiling()
        or torch.is_grad_enabled()
        or x.device.type != "cpu"
        or x.shape[0] * x.shape[1] > MAX_REPLAYED_PARTICLES
        or step.network is None
        or steps == 0
        or not sorts_at_once(*x.shape[:2])
        or type(x) is not Tensor
        or type(s) is not Tensor
        or is_in_torch_dispatch_mode()
    ):
        return None
    key = (step.physics, rule_form(step.rule), x.shape, s.shape[2], x.dtype)
    with _groups_lock:
        group = _groups.count(key, MAX_REPLAYED_GROUPS)
    if group.calls <= LAUNCHED_FIRST:
        return None
    # Another thread may have taken the last one in the meantime.
    try:
        replayed_steps = group.free.pop()
    except IndexError:
        with torch.inference_mode(False), torch.no_grad():
            replayed_steps = ReplayedSteps(step, particles)
    try:
        drawn = _draws(step, x, steps, generator)
        autocast = torch.is_autocast_enabled("cpu")
        with torch.autocast("cpu", enabled=False) if autocast else contextlib.nullcontext():
            trajectory = replayed_steps.run(step, particles, drawn, keep_every or steps)
    finally:
        group.free.append(replayed_steps)
    return trajectory[0] if keep_every is None else combined(torch.stack, trajectory)
