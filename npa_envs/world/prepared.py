"""Prepared steps: on a CPU, rollouts of small worlds that repeat make launches prepared once.

A step of a small world is some 50 µs of work, and several times as much of Python: checks, memory,
arguments of launches. From the third call with the same shapes and options on, a rollout without
gradients goes back and forth between two places in memory, by launches between tensors that stay.
The same kernels run on the same numbers. Recorded rollouts on CUDA are the same idea.
"""

from __future__ import annotations

import collections
import threading
from collections.abc import Hashable, Iterable
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils._python_dispatch import is_in_torch_dispatch_mode

from npa_envs.ops.launch import LaunchTape
from npa_envs.ops.sort import sorts_at_once
from npa_envs.rule.network import Network
from npa_envs.world.particles import Particles, combined
from npa_envs.world.randomness import Randomness
from npa_envs.world.recorded import LAUNCHED_FIRST, CallKind, counted, rule_form
from npa_envs.world.steps import Draws, RuleStep

LARGEST_TOTAL = 4096
"""Particles of all worlds, at most: larger worlds hide the host's time."""

MOST_KINDS = 32
"""Kinds of calls that are remembered."""


class _Stand:
    """A network's stand-in while a step is recorded: notes its input and its place on the tape."""

    def __init__(self, tape: LaunchTape, row_width: int, update_width: int) -> None:
        self.row_width = row_width
        self.update_width = update_width
        self._tape = tape

    def __call__(self, rows: Tensor) -> Tensor:
        self.rows = rows
        self.split = len(self._tape)
        self.updates = rows.new_zeros(len(rows), self.update_width)
        return self.updates


class _Step(NamedTuple):
    """A recorded step from one place in memory to the other."""

    tape: LaunchTape
    split: int
    """Launches before the network."""
    rows: Tensor
    """What the network reads, [B N, row_width]."""
    updates: list[Any]
    """Where its outputs are read."""


class PreparedSteps:
    """Steps of worlds of one shape, back and forth between two places in memory.

    Args:
        particles: Worlds of that shape; they are left as they are.
    """

    def __init__(self, step: RuleStep, particles: Particles) -> None:
        # With all particles active there is a row for each.
        masked = step.physics.update_prob < 1.0
        self._mask = torch.ones(particles.x.shape[:2], dtype=torch.uint8) if masked else None
        # Whatever the strides of the worlds: what is made contiguous in a step is on no tape.
        first = particles.map(lambda value: value.clone(memory_format=torch.contiguous_format))
        there, after = self._record(step, first)
        back, last = self._record(step, after)
        for old, new in zip(last.tensors(), first.tensors(), strict=True):
            back.tape.move(back.tape.places(old), new)
        self._places = first, after
        self._steps = there, back

    def _record(self, step: RuleStep, particles: Particles) -> tuple[_Step, Particles]:
        assert step.network is not None
        tape = LaunchTape()
        stand = _Stand(tape, step.network.row_width, step.network.update_width)
        with tape.recording():
            after = step._replace(network=stand).advance(particles, Draws(self._mask, None))
        return _Step(tape, stand.split, stand.rows, tape.places(stand.updates)), after

    def run(
        self, network: Network, particles: Particles, masks: Iterable[Tensor | None], every: int
    ) -> list[Particles]:
        """Step worlds once with each mask; return copies of those after every so many steps."""
        self._places[0].copy_(particles)
        kept: list[Particles] = []
        for number, mask in enumerate(masks):
            step = self._steps[number % 2]
            count = len(step.rows)
            if self._mask is not None and mask is not None:
                self._mask.copy_(mask)
                count = max(int(mask.sum()), 1)
            step.tape.replay(0, step.split, last_count=count)
            # Held until the launch has read it.
            updates = network(step.rows[:count])
            step.tape.move(step.updates, updates)
            step.tape.replay(step.split)
            if (number + 1) % every == 0:
                kept.append(self._places[(number + 1) % 2].map(torch.clone))
        return kept


_kinds: collections.OrderedDict[Hashable, CallKind[PreparedSteps]] = collections.OrderedDict()
"""Kinds of calls so far, the least recently used first."""

_lock = threading.Lock()


def may_prepare(step: RuleStep, particles: Particles) -> bool:
    """Return whether steps of worlds may be prepared: small, on a CPU, without gradients."""
    x, s, *_ = particles
    return (
        not torch.compiler.is_compiling()
        and not torch.is_grad_enabled()
        and x.device.type == "cpu"
        and x.shape[0] * x.shape[1] <= LARGEST_TOTAL
        and step.network is not None
        and step.physics.position_noise == 0.0
        and sorts_at_once(*x.shape[:2])
        and type(x) is Tensor
        and type(s) is Tensor
        and not is_in_torch_dispatch_mode()
    )


def run_prepared(
    step: RuleStep,
    particles: Particles,
    source: Randomness | None,
    steps: int,
    keep_every: int | None,
) -> Particles | None:
    """Run a rollout by prepared steps; None where calls of this kind are too few so far."""
    if steps == 0:
        return None
    assert step.network is not None
    x, s, *_ = particles
    key = (step.physics, rule_form(step.rule), x.shape, s.shape[2], x.dtype)
    with _lock:
        kind = counted(_kinds, key, CallKind, _kinds.pop, MOST_KINDS)
    if kind.calls <= LAUNCHED_FIRST:
        return None
    # Another thread may have taken the last one meanwhile.
    try:
        prepared = kind.free.pop()
    except IndexError:
        with torch.inference_mode(False), torch.no_grad():
            prepared = PreparedSteps(step, particles)
    masks = (draws.mask for draws in step.draw(x, steps, source))
    try:
        with torch.autocast("cpu", enabled=False):
            kept = prepared.run(step.network, particles, masks, keep_every or steps)
    finally:
        kind.free.append(prepared)
    return kept[0] if keep_every is None else combined(torch.stack, kept)
