"""Prepared steps: on a CPU, rollouts of small worlds that repeat make launches prepared once.

A step of a small world is some 50 µs of work, and several times as much of Python: checks, memory,
arguments of launches. From the third call with the same shapes and options on, a rollout without
gradients goes back and forth between two places in memory, by launches between tensors that stay.
The same kernels run on the same numbers. Recorded rollouts on CUDA are the same idea.
"""

from __future__ import annotations

import collections
import threading
from collections.abc import Callable, Hashable, Iterable
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils._python_dispatch import is_in_torch_dispatch_mode

from npa_envs.ops.launch import LaunchTape
from npa_envs.ops.sort import sorts_at_once
from npa_envs.rule.network import Network
from npa_envs.world.recorded import LAUNCHED_FIRST, CallKind, Particles, counted

LARGEST_TOTAL = 4096
"""Particles of all worlds, at most: larger ones hide what is saved."""

MOST_KINDS = 32
"""Kinds of calls that are remembered."""


Advance = Callable[[Network, Particles, Tensor | None], Particles]
"""Launches one step of worlds with an update mask, [B, N], and a network."""


class _Stand:
    """Stands for a network while a step is recorded: notes what it is given, and where."""

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
    """Steps of worlds of one shape.

    Args:
        advance: Launches a step.
        worlds: Worlds of that shape; they are left as they are.
        row_width: Columns of a row of perception.
        update_width: Columns of an update.
        masked: Whether some particles are updated only.
    """

    def __init__(
        self, advance: Advance, worlds: Particles, row_width: int, update_width: int, masked: bool
    ) -> None:
        # With all particles active there is a row for each.
        self._mask = torch.ones(worlds.x.shape[:2], dtype=torch.uint8) if masked else None
        # Whatever the strides of the worlds: what is made contiguous in a step is on no tape.
        dense = torch.contiguous_format
        here = Particles(*(torch.empty_like(v, memory_format=dense).copy_(v) for v in worlds))
        there, after = self._record(advance, here, row_width, update_width)
        back, last = self._record(advance, after, row_width, update_width)
        for old, new in zip(last, here, strict=True):
            back.tape.move(back.tape.places(old), new)
        self._places = here, after
        self._steps = there, back

    def _record(
        self, advance: Advance, worlds: Particles, row_width: int, update_width: int
    ) -> tuple[_Step, Particles]:
        tape = LaunchTape()
        stand = _Stand(tape, row_width, update_width)
        with tape.recording():
            after = advance(stand, worlds, self._mask)
        return _Step(tape, stand.split, stand.rows, tape.places(stand.updates)), after

    def run(
        self,
        network: Network,
        worlds: Particles,
        masks: Iterable[Tensor | None],
        keep: Callable[[int], bool],
    ) -> list[Particles]:
        """Step worlds once with each mask; return copies of those to keep, by the steps done."""
        for place, value in zip(self._places[0], worlds, strict=True):
            place.copy_(value)
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
            if keep(number + 1):
                after = self._places[(number + 1) % 2]
                kept.append(Particles(*(value.clone() for value in after)))
        return kept


_kinds: collections.OrderedDict[Hashable, CallKind[PreparedSteps]] = collections.OrderedDict()
"""Kinds of calls so far, the least recently used first."""

_lock = threading.Lock()


def may_prepare(worlds: Particles) -> bool:
    """Return whether steps of worlds may be prepared: small, on a CPU, without gradients."""
    x, s, _ = worlds
    return (
        not torch.compiler.is_compiling()
        and not torch.is_grad_enabled()
        and x.device.type == "cpu"
        and x.shape[0] * x.shape[1] <= LARGEST_TOTAL
        and sorts_at_once(*x.shape[:2])
        and type(x) is Tensor
        and type(s) is Tensor
        and not is_in_torch_dispatch_mode()
    )


def run_prepared(
    key: Hashable,
    make: Callable[[], PreparedSteps],
    run: Callable[[PreparedSteps], list[Particles]],
) -> list[Particles] | None:
    """Run prepared steps; None where calls of this kind are too few so far.

    Args:
        key: What the prepared steps depend on.
        make: Prepares them.
        run: Runs them.
    """
    with _lock:
        kind = counted(_kinds, key, CallKind, _kinds.pop, MOST_KINDS)
    if kind.calls <= LAUNCHED_FIRST:
        return None
    # Another thread may have taken the last one meanwhile.
    try:
        prepared = kind.free.pop()
    except IndexError:
        with torch.inference_mode(False), torch.no_grad():
            prepared = make()
    try:
        return run(prepared)
    finally:
        kind.free.append(prepared)
