"""Rollouts of small worlds on a CPU that replay the launches of earlier ones.

In a step of such worlds Python takes several times as long as kernels. From the third call with the
same shapes and options on, a rollout replays the recorded launches of two steps. The first reads
one buffer and writes another; the second does the reverse. With gradients each step has launches
and buffers of its own, which its backward pass reads: the whole rollout is one autograd function.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import is_in_torch_dispatch_mode

from npa_envs.ops.custom_op import once_differentiable
from npa_envs.ops.launch import RecordedLaunches
from npa_envs.ops.perceive import Rows, saved_perception
from npa_envs.ops.perception_passes import perceive_rows_backward, search_threads
from npa_envs.ops.sort import sorts_at_once
from npa_envs.ops.update import update_particles, update_particles_backward
from npa_envs.rule.folded_network import FoldedRule, layers_backward, run_layers, without_small
from npa_envs.world.capture_cache import LAUNCHED_FIRST, CallGroup, CallGroups
from npa_envs.world.particles import Particles, combined
from npa_envs.world.randomness import Randomness, WorldRandom
from npa_envs.world.rule_settings import rule_form
from npa_envs.world.steps import Draws, RuleStep, active_counts

MAX_REPLAYED_PARTICLES = 4096
"""Maximum number of particles B N; the steps of larger batches take most time in kernels."""

MAX_STORED_PARTICLES = 2**16
"""Maximum number of particles of all steps of a rollout with gradients."""

STEPS_DRAWN_TOGETHER = 16
"""Number of steps whose random numbers are drawn by one launch of each kind."""

MAX_REPLAYED_GROUPS, MAX_TRAINED_GROUPS = 32, 4
"""Maximum number of groups of calls whose launches are kept, without and with gradients."""

Drawn = Iterable[tuple[Draws, list[int]]]
"""Random numbers of each step, with the numbers of active particles of each world."""


class _ReplayedStep:
    """The recorded launches of one step and, if there are `bars`, of its backward pass.

    The network is not recorded: it reads some of `rows`, and `update` receives its outputs.
    """

    def __init__(
        self, step: RuleStep, particles: Particles, mask: Tensor | None, bars: Particles | None
    ) -> None:
        x, s, path, *_ = particles
        network, physics, total = step.network, step.physics, x.shape[:2].numel()
        assert network is not None
        self.x, masked = x, mask is not None
        self.forward, self.backward = RecordedLaunches(), RecordedLaunches()
        with self.forward.recording():
            options = masked, total, network.row_width, physics, bars is not None
            saved, row_particle = saved_perception(x, s, mask, None, None, *options)
            self.split, self.rows = len(self.forward), saved.perception
            self.update = x.new_zeros(total, network.update_width)
            rows = Rows(saved.row_of, row_particle, saved.starts, total if masked else 0)
            after = update_particles(self.update, x, s, path, rows, physics)  # type: ignore[arg-type]
            self.after = particles.moved(*after)
        if bars is None:
            return
        with self.backward.recording():
            world_bars, of_rows = bars.per_particle(), rows[1:]
            self.update_bar = update_particles_backward(self.update, *world_bars, *of_rows, physics)
            self.rows_bar = torch.zeros_like(self.rows)
            of_perception, sizes = [*saved[:-1]], (x.shape[1], s.shape[2], masked)
            states_bar, _ = perceive_rows_backward(
                self.rows_bar, of_perception, [], *sizes, physics
            )
            self.states_bar = states_bar.view_as(s)


class ReplayedSteps:
    """Recorded steps of worlds of one shape, in one rollout at a time.

    Without gradients they are two: from a first buffer to a second one, and back.
    """

    def __init__(self, step: RuleStep, particles: Particles, training: bool) -> None:
        # With all particles active there is a row for each.
        masked = step.physics.update_prob < 1.0
        self._mask = torch.ones(particles.x.shape[:2], dtype=torch.uint8) if masked else None
        # Contiguous: a copy that a step would have to make is not recorded.
        first = particles.map(lambda value: torch.zeros(value.shape, dtype=value.dtype))
        first.copy_(particles)
        self.bars = first.map(torch.zeros_like) if training else None
        self.first = first
        self.steps: list[_ReplayedStep] = []
        if not training:
            there = _ReplayedStep(step, first, self._mask, None)
            back = _ReplayedStep(step, there.after, self._mask, None)
            for old, new in zip(back.after.tensors(), first.tensors(), strict=True):
                back.forward.move(back.forward.argument_slots(old), new)
            back.after, self.steps = first, [there, back]

    def run(
        self,
        step: RuleStep,
        particles: Particles,
        drawn: Drawn,
        every: int,
        network: Callable[[Tensor, list[int]], Tensor],
    ) -> list[Particles]:
        """Make a step with each draw; return copies of worlds every `every` steps.

        `network` maps rows to updates, and is given the numbers of rows of each world.
        """
        self.first.copy_(particles)
        trajectory: list[Particles] = []
        for number, ((mask, noise, *_), counts) in enumerate(drawn):
            if self._mask is not None and mask is not None:
                self._mask.copy_(mask)
            if self.bars is not None and number == len(self.steps):
                before = self.steps[-1].after if self.steps else self.first
                self.steps.append(_ReplayedStep(step, before, self._mask, self.bars))
            own = self.steps[number if self.bars is not None else number % 2]
            count = max(sum(counts), 1)
            own.forward.replay(0, own.split, last_count=search_threads(count, on_cpu=True))
            own.update[:count].copy_(network(own.rows[:count], counts))
            if noise is not None:
                own.x.add_(noise)
            own.forward.replay(own.split)
            if (number + 1) % every == 0:
                trajectory.append(own.after.map(torch.clone))
        return trajectory


class _Use:
    """A rollout's use of recorded steps: they are free again when this object is deleted."""

    def __init__(self, group: CallGroup, step: RuleStep, particles: Particles, train: bool) -> None:
        self._free = group.free
        # Another thread may have taken the last one in the meantime.
        try:
            self.steps: ReplayedSteps = group.free.pop()
        except IndexError:
            with torch.inference_mode(False), torch.no_grad():
                self.steps = ReplayedSteps(step, particles, train)

    def __del__(self) -> None:
        self._free.append(self.steps)


class _ReplayedRollout(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, use: _Use, step: RuleStep, drawn: Drawn, every: int, *tensors: Tensor
    ) -> tuple[Tensor, ...]:
        weights, dead_zone = tensors[:2], step.network.dead_zone  # type: ignore[union-attr]
        ctx.use, ctx.dead_zone, ctx.hidden = use, dead_zone, []
        ctx.save_for_backward(*weights)

        def network(rows: Tensor, _: list[int]) -> Tensor:
            hidden, update = run_layers(rows, *weights)
            ctx.hidden.append(hidden)
            return without_small(update, dead_zone)

        (after,) = use.steps.run(step, Particles(*tensors[2:]), drawn, every, network)
        return after.per_particle()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *worlds_bar: Tensor) -> tuple[Tensor | None, ...]:
        bars, weights = ctx.use.steps.bars, ctx.saved_tensors
        needs, sums = (True, *ctx.needs_input_grad[4:6]), [None, None]
        bars.copy_(Particles(*worlds_bar))
        for own, hidden in zip(
            reversed(ctx.use.steps.steps[: len(ctx.hidden)]), reversed(ctx.hidden), strict=True
        ):
            count = len(hidden)
            own.backward.replay(0, 1)
            bar = own.update_bar[:count]
            if ctx.dead_zone > 0.0:
                update = own.update[:count]
                bar = torch.ops.aten.hardshrink_backward(bar, update, ctx.dead_zone)
            rows_bar, *found = layers_backward(bar, own.rows[:count], hidden, *weights, needs=needs)
            pairs: Any = zip(sums, found, strict=True)
            sums = [b if a is None else a.add_(b) for a, b in pairs]
            own.rows_bar[:count].copy_(rows_bar)
            own.backward.replay(1)
            bars.s.add_(own.states_bar)
        return None, None, None, None, *sums, *(value.clone() for value in bars.per_particle())


def _can_train(step: RuleStep, particles: Particles, steps: int) -> bool:
    """Return whether the backward pass of a rollout can be replayed: that of a plain rule."""
    return (
        type(step.network) is FoldedRule
        and step.network.arranged is None
        and step.detach_positions
        and step.physics.boundary != "reflecting"
        and not (step.world_by_world and particles.x.shape[0] > 1)
        and particles.x.shape[:2].numel() * steps <= MAX_STORED_PARTICLES
    )


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


_groups, _trained_groups = CallGroups(), CallGroups()
_groups_lock = threading.Lock()


def replay_launches(
    step: RuleStep,
    particles: Particles,
    generator: Randomness | None,
    steps: int,
    keep_every: int | None,
    stores: bool,
) -> Particles | None:
    """Run a rollout by replaying recorded launches; None if the caller must launch its steps.

    Only small worlds on a CPU are replayed, and not in the first `LAUNCHED_FIRST` calls with the
    same shapes and options. With gradients, `stores` must be true: all steps are stored.
    """
    x, s, *_ = particles
    training = torch.is_grad_enabled()
    if (
        torch.compiler.is_compiling()
        or (training and not (stores and keep_every is None and _can_train(step, particles, steps)))
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
        if training:
            group = _trained_groups.count(key, MAX_TRAINED_GROUPS)
        else:
            group = _groups.count(key, MAX_REPLAYED_GROUPS)
    if group.calls <= LAUNCHED_FIRST:
        return None
    use, drawn = _Use(group, step, particles, training), _draws(step, x, steps, generator)
    autocast = torch.is_autocast_enabled("cpu")
    with torch.autocast("cpu", enabled=False) if autocast else contextlib.nullcontext():
        if training:
            weights = step.network.hidden_weight, step.network.output_weight  # type: ignore[union-attr]
            tensors = *weights, *particles.per_particle()
            after = _ReplayedRollout.apply(use, step, drawn, steps, *tensors)  # type: ignore[no-untyped-call]
            return particles.moved(*after)
        every = keep_every or steps
        trajectory = use.steps.run(step, particles, drawn, every, step.updates_of)
    return trajectory[0] if keep_every is None else combined(torch.stack, trajectory)
