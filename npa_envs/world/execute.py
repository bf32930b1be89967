"""The ways of running a rollout: at rest, CUDA graph, CPU tape, loop. All give the same numbers."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor
from torch.utils._python_dispatch import is_in_torch_dispatch_mode
from torch.utils.checkpoint import checkpoint

from npa_envs.checks import check_finite_positions
from npa_envs.errors import NPAError
from npa_envs.ops.launch import Tape
from npa_envs.ops.physics import Physics
from npa_envs.ops.sort import sorts_at_once
from npa_envs.rule.network import Network
from npa_envs.rule.rule import NPARule
from npa_envs.world.cuda_graph import draws_alone
from npa_envs.world.divergence import DivergenceWatch
from npa_envs.world.particles import Particles, combined
from npa_envs.world.randomness import Randomness
from npa_envs.world.recorded import LAUNCHED_FIRST, CallKinds, CudaGraph, rule_form, run_recorded
from npa_envs.world.steps import (
    DivisionStep,
    Draws,
    RuleStep,
    SpeciesSpec,
    StaticStep,
    Step,
    make_species_step,
    skip_draws,
)

Memory = Literal["store", "recompute", "minimal"]

STORED_INTERVAL: dict[Memory, int] = {"store": 1, "recompute": 3, "minimal": 2**31}
"""The last step and every so-manyth before it store what the backward pass reads."""

FEWEST_STATIC = 3
"""Steps of a rollout, at least, for which static worlds are prepared."""

FEWEST_RESTING = 256
"""Steps of a rollout, at least, that is checked for worlds at rest."""

LARGEST_TOTAL = 4096
"""Particles of all worlds, at most, whose steps are on a tape: larger ones hide the host's time."""

MOST_KINDS = 32
"""Kinds of calls on tapes that are remembered."""

FIRST_PART = {"cpu": 64, "cuda": 1024}
"""Steps until the next check, by device; each further part is twice as long. A GPU idles during a
check."""


class RolloutSpec(NamedTuple):
    """A checked rollout without its tensors; hashable: recordings have it in their keys."""

    steps: int
    physics: Physics
    detach_positions: bool = True
    memory: Memory = "store"
    keep_every: int | None = None
    """Worlds are kept after each so many steps; None: at the end alone."""
    species: tuple[SpeciesSpec, ...] = ()
    """Where several rules share a world."""
    by_species: bool = False
    """Rules perceive each species' density and density gradient."""

    def make_step(self, rules: Sequence[NPARule], particles: Particles) -> Step:
        """Return the step of these worlds."""
        if self.species:
            return make_species_step(
                rules,
                self.species,
                self.physics.constants(),
                particles.x,
                by_species=self.by_species,
                detach_positions=self.detach_positions,
            )
        (rule,) = rules
        physics = self.physics.constants()
        moving = physics.moving or physics.position_noise > 0.0 or not self.detach_positions
        if not moving and self.steps >= FEWEST_STATIC:
            return StaticStep(rule, physics, particles.x)
        # A rule without a network runs as the module that it is.
        made = DivisionStep if rule.divides else RuleStep
        return made(rule, rule.network(), physics, self.detach_positions)

    def run(
        self,
        rules: Sequence[NPARule],
        particles: Particles,
        source: Randomness | None,
        watch: DivergenceWatch | None = None,
    ) -> Particles:
        """Launch the rollout of checked worlds: from a tape on a CPU, in a loop otherwise.

        Raises:
            DivergedError: A world diverged under a watch.
        """
        step = self.make_step(rules, particles)
        if type(step) is RuleStep and watch is None:
            taped = run_taped(step, particles, source, self.steps, self.keep_every)
            if taped is not None:
                return taped
        particles = step.enter(particles)
        keep_every = self.keep_every
        interval = STORED_INTERVAL[self.memory] if torch.is_grad_enabled() else 1
        kept: list[Particles] = []
        # While a graph is recorded, torch's state cannot be read, and its draws are the graph's.
        recorded = particles.x.is_cuda and torch.cuda.is_current_stream_capturing()
        with_modules = not all(rule.has_network() for rule in rules)
        redraw = with_modules and not recorded
        if with_modules and recorded and not draws_alone():
            # Recomputed, a module that draws would draw otherwise.
            interval = 1
        again = None
        # A compiled function reads copies.
        if interval > 1 and not torch.compiler.is_compiling():
            again = RecomputedSteps(step.advance, rules, {"x": particles.x, "s": particles.s})
        # Worlds keep their dtype under autocast: the kernels read what the rules write.
        with torch.autocast(particles.x.device.type, enabled=False):
            for number, draws in enumerate(step.draw(particles.x, self.steps, source)):
                if (self.steps - 1 - number) % interval > 0:
                    particles = checkpoint(
                        again or step.advance,
                        particles,
                        draws,
                        use_reentrant=False,
                        preserve_rng_state=redraw,
                    )
                else:
                    particles = step.advance(particles, draws)
                if watch is not None:
                    after = step.leave(particles.map(Tensor.detach))
                    watch.look(after.x, after.s)
                if keep_every is not None and (number + 1) % keep_every == 0:
                    kept.append(step.leave(particles))
            if again is not None:
                again.end_forward()
            if self.steps == 0:
                # What is returned is the caller's to write to.
                particles = particles.map(torch.clone)
            particles = step.leave(particles) if keep_every is None else combined(torch.stack, kept)
        if watch is not None:
            watch.raise_diverged()
        return particles


class RecomputedSteps:
    """Steps of a rollout that its backward pass runs again.

    These read the rule and the first worlds where they are. Gradients would silently be wrong if
    they had changed meanwhile, which is refused.
    """

    def __init__(
        self, advance: Callable[..., Any], rules: Sequence[NPARule], worlds: dict[str, Tensor]
    ) -> None:
        self._advance = advance
        self._worlds = worlds
        # Plain rules are run by copies of their weights, except for those of the fates.
        self._rules = [(rule, rule.divides or not rule.is_plain()) for rule in rules]
        self._read: dict[str, Any] | None = None
        """What has been read, by name, from the end of the forward pass on."""

    def __call__(self, *arguments: Any) -> Any:
        """Run one step, forward or again."""
        if self._read is None:
            return self._advance(*arguments)
        for name, value in self._readings():
            if name not in self._read or self._read[name][1] != _reading(value):
                raise NPAError(
                    f"{name} must stay as it is between a rollout that recomputes steps and its "
                    "backward pass, got another: call backward() before it changes, or take "
                    "memory='store'"
                )
        try:
            return self._advance(*arguments)
        finally:
            # A module may change its own buffers, as those of normalisation.
            self.end_forward()

    def end_forward(self) -> None:
        """Note what has been read."""
        # Tensors are held, so that no other one gets the same memory.
        self._read = {name: (value, _reading(value)) for name, value in self._readings()}

    def _readings(self) -> Iterator[tuple[str, Any]]:
        """Yield what steps read, by name: tensors and other values."""
        yield from self._worlds.items()
        for number, (rule, with_weights) in enumerate(self._rules):
            of_rule = "the rule" if len(self._rules) == 1 else f"rule {number}"
            for name, value in rule.hyper_parameters().items():
                yield f"{name} of {of_rule}", value
            for path, module in rule.named_modules() if with_weights else ():
                place = f"{path}." if path else ""
                own = {**vars(module), **module._parameters, **module._buffers}
                for name, value in own.items():
                    if isinstance(value, Tensor | bool | int | float | str):
                        yield f"{place}{name} of {of_rule}", value


def _reading(value: Any) -> Any:
    """Return what changes with each write to a tensor; of other values, themselves."""
    if not isinstance(value, Tensor):
        return value
    return value.data_ptr(), None if value.is_inference() else value._version


def execute(
    spec: RolloutSpec,
    rules: Sequence[NPARule],
    particles: Particles,
    source: Randomness | None,
    *,
    graph: CudaGraph = "auto",
    watch: DivergenceWatch | None = None,
) -> Particles:
    """Run a checked rollout, in the first of the ways that can be taken.

    A watch checks the worlds after each step, which then are launched.
    """
    if watch is not None or not _may_rest(spec, rules, particles):
        return run_all_steps(spec, rules, particles, source, graph=graph, watch=watch)
    # In parts, to skip the steps after all worlds are at rest.
    left, part = spec.steps, FIRST_PART[particles.x.device.type]
    while left and not resting(rules, particles, spec.physics, graph).all():
        own = spec._replace(steps=min(part, left))
        particles = run_all_steps(own, rules, particles, source, graph=graph)
        left, part = left - own.steps, 2 * part
        if left and not particles.x.isfinite().all():
            # A world has diverged, which the next call refuses, and not this one.
            return spec._replace(steps=left).run(rules, particles, source)
    # Whoever draws next gets what comes after all steps.
    skip_draws(particles.x, spec.physics, left, source)
    # What is returned is the caller's to write to.
    return particles.map(torch.clone) if left == spec.steps else particles


def run_all_steps(
    spec: RolloutSpec,
    rules: Sequence[NPARule],
    particles: Particles,
    source: Randomness | None,
    *,
    graph: CudaGraph = "auto",
    watch: DivergenceWatch | None = None,
) -> Particles:
    """Run a checked rollout, as `execute`, whether or not worlds are at rest."""
    x, s, *_ = particles
    if watch is None:
        recorded = run_recorded(spec, rules, x, s, source, cuda_graph=graph)
        if recorded is not None:
            return recorded
    check_finite_positions(x)
    if x.is_cuda and torch.is_grad_enabled():
        # Gradients are added up as a recording adds them: first those of this rollout.
        x, s = x.view_as(x), s.view_as(s)
    return spec.run(rules, Particles(x, s, x.new_zeros(x.shape[:2])), source, watch)


def resting(
    rules: Sequence[NPARule], particles: Particles, physics: Physics, graph: CudaGraph
) -> Tensor:
    """Return which worlds stay as they are if all particles are updated, bool, shape [B]."""
    spec = RolloutSpec(1, physics._replace(update_prob=1.0))
    with torch.no_grad():
        after = run_all_steps(spec, rules, particles, None, graph=graph)
    same_x, same_s = after.x == particles.x, after.s == particles.s
    return same_x.flatten(1).all(dim=1) & same_s.flatten(1).all(dim=1)


def _may_rest(spec: RolloutSpec, rules: Sequence[NPARule], particles: Particles) -> bool:
    """Return whether a rollout checks if its worlds are at rest, whose steps are skipped."""
    return (
        len(rules) == 1
        and not spec.species
        and rules[0].dead_zone > 0.0
        and rules[0].has_network()
        and not rules[0].divides
        and spec.steps >= FEWEST_RESTING
        and spec.keep_every is None
        and spec.physics.position_noise == 0.0
        and particles.path_length is None
        and not torch.is_grad_enabled()
        and not torch.compiler.is_compiling()
        and not (particles.x.is_cuda and torch.cuda.is_current_stream_capturing())
    )


# Small worlds on a CPU: a step is some 50 µs of work, and several times as much of Python, for
# checks, memory and arguments of launches. From the third call with the same shapes and options on,
# a rollout without gradients goes back and forth between two places in memory, by launches on a
# tape. The same kernels run on the same numbers. Recorded rollouts on CUDA are the same idea.


class _TapedStep:
    """A step from one place in memory to another; while recorded, the stand-in for its network."""

    def __init__(self, step: RuleStep, particles: Particles, mask: Tensor | None) -> None:
        assert step.network is not None
        self.row_width = step.network.row_width
        self._update_width = step.network.update_width
        self.tape = Tape()
        stand_in: Any = self
        with self.tape.recording():
            step = dataclasses.replace(step, network=stand_in)
            self.after = step.advance(particles, Draws(mask, None))
        self.places = self.tape.argument_slots(self._updates)

    def __call__(self, rows: Tensor) -> Tensor:
        """Note what the network reads, [B N, row_width], and its place on the tape."""
        self.rows = rows
        self.split = len(self.tape)
        self._updates = rows.new_zeros(len(rows), self._update_width)
        return self._updates


class TapedSteps:
    """Steps of worlds of one shape, back and forth between two places in memory."""

    def __init__(self, step: RuleStep, particles: Particles) -> None:
        # With all particles active there is a row for each.
        masked = step.physics.update_prob < 1.0
        self._mask = torch.ones(particles.x.shape[:2], dtype=torch.uint8) if masked else None
        # Whatever the strides of the worlds: what is made contiguous in a step is on no tape.
        first = particles.map(lambda value: value.clone(memory_format=torch.contiguous_format))
        there = _TapedStep(step, first, self._mask)
        back = _TapedStep(step, there.after, self._mask)
        for old, new in zip(back.after.tensors(), first.tensors(), strict=True):
            back.tape.move(back.tape.argument_slots(old), new)
        self._places = first, there.after
        self._steps = there, back

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
            step.tape.move(step.places, updates)
            step.tape.replay(step.split)
            if (number + 1) % every == 0:
                kept.append(self._places[(number + 1) % 2].map(torch.clone))
        return kept


_kinds = CallKinds()

_lock = threading.Lock()
"""Held while the above changes."""


def run_taped(
    step: RuleStep,
    particles: Particles,
    source: Randomness | None,
    steps: int,
    keep_every: int | None,
) -> Particles | None:
    """Run a rollout by taped steps; None where calls of its kind are too few so far.

    Only steps of small worlds on a CPU, without gradients, may be on a tape.
    """
    x, s, *_ = particles
    if (
        torch.compiler.is_compiling()
        or torch.is_grad_enabled()
        or x.device.type != "cpu"
        or x.shape[0] * x.shape[1] > LARGEST_TOTAL
        or step.network is None
        or step.physics.position_noise > 0.0
        or steps == 0
        or not sorts_at_once(*x.shape[:2])
        or type(x) is not Tensor
        or type(s) is not Tensor
        or is_in_torch_dispatch_mode()
    ):
        return None
    key = (step.physics, rule_form(step.rule), x.shape, s.shape[2], x.dtype)
    with _lock:
        kind = _kinds.count(key, MOST_KINDS)
    if kind.calls <= LAUNCHED_FIRST:
        return None
    # Another thread may have taken the last one meanwhile.
    try:
        taped = kind.free.pop()
    except IndexError:
        with torch.inference_mode(False), torch.no_grad():
            taped = TapedSteps(step, particles)
    masks = (draws.mask for draws in step.draw(x, steps, source))
    try:
        with torch.autocast("cpu", enabled=False):
            kept = taped.run(step.network, particles, masks, keep_every or steps)
    finally:
        kind.free.append(taped)
    return kept[0] if keep_every is None else combined(torch.stack, kept)
