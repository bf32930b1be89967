"""Execution of rollouts: resting worlds, CUDA graph, CPU tape or loop, with the same results."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable, Iterable, Sequence
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
from npa_envs.rule.folded_network import Network
from npa_envs.rule.rule import NPARule
from npa_envs.world.cuda_graph import draws_alone
from npa_envs.world.divergence import DivergenceWatch
from npa_envs.world.graphed_rollouts import (
    LAUNCHED_FIRST,
    CallGroups,
    CudaGraph,
    run_captured,
)
from npa_envs.world.particles import Particles, combined
from npa_envs.world.randomness import Randomness
from npa_envs.world.rule_settings import rule_form
from npa_envs.world.steps import (
    DivisionStep,
    Draws,
    RuleStep,
    SpeciesSpec,
    SpeciesStep,
    StaticStep,
    Step,
    skip_draws,
)

Memory = Literal["store", "recompute", "minimal"]

STORED_INTERVAL: dict[Memory, int] = {"store": 1, "recompute": 3, "minimal": 2**31}
"""The last step and every k-th step before it store the tensors of the backward pass."""

MIN_STATIC = 3
"""Fewest steps of a rollout for which static worlds are sorted in advance."""

MIN_RESTING = 256
"""Fewest steps of a rollout that is checked for worlds at rest."""

MAX_TAPED_PARTICLES = 4096
"""Most particles of a batch whose steps are on a tape: in larger ones kernels take most time."""

MAX_TAPED_GROUPS = 32
"""Most groups of calls whose tapes are cached."""

FIRST_PART = {"cpu": 64, "cuda": 1024}
"""Steps until the first check for resting worlds, by device; each further part is twice as long. A
GPU idles during a check."""


class RolloutSpec(NamedTuple):
    """The checked arguments of a rollout except its tensors; hashable, for keys of captures."""

    steps: int
    physics: Physics
    detach_positions: bool = True
    memory: Memory = "store"
    keep_every: int | None = None
    """Interval in steps at which worlds are returned; None: only the last worlds."""
    species: tuple[SpeciesSpec, ...] = ()
    """The species, if several rules share a world."""
    per_species: bool = False
    """Whether rules perceive each species' density and density gradient."""

    def make_step(self, rules: Sequence[NPARule], particles: Particles) -> Step:
        """Return the `Step` that advances these worlds."""
        if self.species:
            return SpeciesStep(
                rules,
                self.species,
                self.physics.constants(),
                particles.x,
                per_species=self.per_species,
                detach_positions=self.detach_positions,
            )
        (rule,) = rules
        physics = self.physics.constants()
        moving = physics.moving or physics.position_noise > 0.0 or not self.detach_positions
        if not moving and self.steps >= MIN_STATIC:
            return StaticStep(rule, physics, particles.x)
        # A rule with a custom network runs as its module.
        cls = DivisionStep if rule.divides else RuleStep
        return cls(rule, rule.network(), physics, self.detach_positions)

    def run(
        self,
        rules: Sequence[NPARule],
        particles: Particles,
        generator: Randomness | None,
        watch: DivergenceWatch | None = None,
    ) -> Particles:
        """Launch the rollout of checked worlds: from a tape on a CPU, step by step otherwise."""
        step = self.make_step(rules, particles)
        if type(step) is RuleStep and watch is None:
            taped = run_taped(step, particles, generator, self.steps, self.keep_every)
            if taped is not None:
                return taped
        # Worlds keep their dtype under autocast, as kernels read the rules' outputs.
        with torch.autocast(particles.x.device.type, enabled=False):
            after = self._launch_steps(step, rules, particles, generator, watch)
        if watch is not None:
            watch.raise_diverged()
        return after

    def _launch_steps(
        self,
        step: Step,
        rules: Sequence[NPARule],
        particles: Particles,
        generator: Randomness | None,
        watch: DivergenceWatch | None,
    ) -> Particles:
        """Launch step by step; return the last worlds, or with `keep_every` those kept, stacked."""
        particles = step.to_step_order(particles)
        interval, restores_random_state = self._recomputation(rules, particles.x)
        recomputed = None
        # A compiled function reads copies.
        if interval > 1 and not torch.compiler.is_compiling():
            recomputed = RecomputedSteps(step.advance, rules, particles)
        trajectory: list[Particles] = []
        for number, draws in enumerate(step.draw(particles.x, self.steps, generator)):
            if (self.steps - 1 - number) % interval == 0:
                particles = step.advance(particles, draws)
            else:
                particles = checkpoint(
                    recomputed or step.advance,
                    particles,
                    draws,
                    use_reentrant=False,
                    preserve_rng_state=restores_random_state,
                )
            if watch is not None:
                watch.check(step.to_caller_order(particles.map(Tensor.detach)))
            if self.keep_every is not None and (number + 1) % self.keep_every == 0:
                trajectory.append(step.to_caller_order(particles))
        if recomputed is not None:
            recomputed.store_versions()
        if self.keep_every is not None:
            return combined(torch.stack, trajectory)
        # Without steps it is a copy, as the caller may write to the results.
        return step.to_caller_order(particles if self.steps else particles.map(torch.clone))

    def _recomputation(self, rules: Sequence[NPARule], x: Tensor) -> tuple[int, bool]:
        """Return the interval of stored steps, and whether others restore torch's random state."""
        interval = STORED_INTERVAL[self.memory] if torch.is_grad_enabled() else 1
        if all(rule.has_network() for rule in rules):
            return interval, False
        # During a capture torch's random state cannot be read, and draws belong to the graph.
        capturing = x.is_cuda and torch.cuda.is_current_stream_capturing()
        if capturing and not draws_alone():
            # Recomputed, a module that draws random numbers would draw others.
            interval = 1
        return interval, not capturing


class RecomputedSteps:
    """Steps of a rollout that its backward pass recomputes.

    They read the rule's weights and the first worlds again. If these have changed since the forward
    pass, gradients would be wrong: that is an error.
    """

    def __init__(
        self, advance: Callable[..., Any], rules: Sequence[NPARule], worlds: Particles
    ) -> None:
        self._advance = advance
        self._worlds = worlds._asdict()
        # Plain rules run with copies of their weights, except those of divisions.
        self._rules = [(rule, rule.divides or not rule.is_plain()) for rule in rules]
        self._stored: dict[str, tuple[Any, Any]] | None = None
        """All inputs and their versions at the end of the forward pass, by name."""

    def __call__(self, *arguments: Any) -> Any:
        """Run one step, in the forward pass or recomputed."""
        if self._stored is None:
            return self._advance(*arguments)
        for name, (_, version) in self._inputs().items():
            if name not in self._stored or self._stored[name][1] != version:
                raise NPAError(
                    f"{name} must not change between a rollout that recomputes steps and its "
                    "backward pass, got another: call backward() before it changes, or take "
                    "memory='store'"
                )
        try:
            return self._advance(*arguments)
        finally:
            # A module may change its own buffers, as in normalisation.
            self.store_versions()

    def store_versions(self) -> None:
        """Store the versions of all inputs."""
        # With the tensors, so that no other tensor gets their memory.
        self._stored = self._inputs()

    def _inputs(self) -> dict[str, tuple[Any, Any]]:
        """Return all inputs of the steps by name, with versions that each write changes."""
        values = dict(self._worlds)
        for number, (rule, with_weights) in enumerate(self._rules):
            suffix = " of the rule" if len(self._rules) == 1 else f" of rule {number}"
            for name, value in rule.hyper_parameters().items():
                values[name + suffix] = value
            for path, module in rule.named_modules() if with_weights else ():
                prefix = f"{path}." if path else ""
                attributes = {**vars(module), **module._parameters, **module._buffers}
                for name, value in attributes.items():
                    if isinstance(value, Tensor | bool | int | float | str):
                        values[prefix + name + suffix] = value
        return {name: (value, _version(value)) for name, value in values.items()}


def _version(value: Any) -> Any:
    """Return a tensor's address and version, which each write changes; other values unchanged."""
    if not isinstance(value, Tensor):
        return value
    return value.data_ptr(), None if value.is_inference() else value._version


def execute(
    spec: RolloutSpec,
    rules: Sequence[NPARule],
    particles: Particles,
    generator: Randomness | None,
    *,
    graph: CudaGraph = "auto",
    watch: DivergenceWatch | None = None,
    may_rest: bool = True,
) -> Particles:
    """Run a checked rollout in the fastest way that its options allow.

    With a watch, steps are launched one by one and checked for divergence. With `may_rest`, steps
    may be skipped once all worlds are at rest.
    """
    if watch is not None or not may_rest or not _can_rest(spec, rules, particles.x):
        return run_all_steps(spec, rules, particles, generator, graph=graph, watch=watch)
    # In parts, to skip the steps after all worlds are at rest.
    remaining, part = spec.steps, FIRST_PART[particles.x.device.type]
    while remaining and not resting(rules, particles, spec.physics, graph).all():
        steps = min(part, remaining)
        part_spec = spec._replace(steps=steps)
        particles = run_all_steps(part_spec, rules, particles, generator, graph=graph)
        remaining, part = remaining - steps, 2 * part
        if remaining and not particles.x.isfinite().all():
            # A world has diverged: the next call raises an error for it, this one does not.
            return spec._replace(steps=remaining).run(rules, particles.with_zero_paths(), generator)
    # The generator ends where it would be after all steps.
    skip_draws(particles.x, spec.physics, remaining, generator)
    # The caller may write to the results.
    return particles.map(torch.clone) if remaining == spec.steps else particles


def run_all_steps(
    spec: RolloutSpec,
    rules: Sequence[NPARule],
    particles: Particles,
    generator: Randomness | None,
    *,
    graph: CudaGraph = "auto",
    watch: DivergenceWatch | None = None,
) -> Particles:
    """Run a checked rollout as `execute` does, without skipping steps."""
    if watch is None:
        replayed = run_captured(spec, rules, particles, generator, cuda_graph=graph)
        if replayed is not None:
            return replayed
    check_finite_positions(particles.x)
    if particles.x.is_cuda and torch.is_grad_enabled():
        # Gradients are added in the order of a capture: first those of this rollout.
        particles = particles.map(lambda value: value.view_as(value))
    return spec.run(rules, particles.with_zero_paths(), generator, watch)


def resting(
    rules: Sequence[NPARule], particles: Particles, physics: Physics, graph: CudaGraph
) -> Tensor:
    """Return which worlds are at rest: an update of all particles changes none, bool, shape [B]."""
    spec = RolloutSpec(1, physics._replace(update_prob=1.0))
    with torch.no_grad():
        after = run_all_steps(spec, rules, particles, None, graph=graph)
    return after.equal(particles)


def _can_rest(spec: RolloutSpec, rules: Sequence[NPARule], x: Tensor) -> bool:
    """Return whether a rollout can skip the steps of worlds at rest."""
    return (
        len(rules) == 1
        and not spec.species
        and rules[0].dead_zone > 0.0
        and rules[0].has_network()
        and not rules[0].divides
        and spec.steps >= MIN_RESTING
        and spec.keep_every is None
        and spec.physics.position_noise == 0.0
        and not torch.is_grad_enabled()
        and not torch.compiler.is_compiling()
        and not (x.is_cuda and torch.cuda.is_current_stream_capturing())
    )


# Small worlds on a CPU: a step takes some 50 µs in kernels and several times as much in Python, for
# checks, memory and arguments of launches. From the third call with the same shapes and options on,
# a rollout without gradients replays launches from a tape, which go back and forth between two
# buffers. The same kernels run on the same numbers, as in captured rollouts on CUDA.


class _TapedStep:
    """A tape of the launches of one step, which reads one buffer of worlds and writes another.

    While the tape is recorded, this object is called in place of the network.
    """

    def __init__(self, step: RuleStep, particles: Particles, mask: Tensor | None) -> None:
        assert step.network is not None
        self.row_width = step.network.row_width
        self._update_width = step.network.update_width
        self.tape = Tape()
        stand_in: Any = self
        with self.tape.recording():
            step = dataclasses.replace(step, network=stand_in)
            self.after = step.advance(particles, Draws(mask, None))
        self.slots = self.tape.argument_slots(self._updates)

    def __call__(self, rows: Tensor) -> Tensor:
        """Store the network's input rows, [B N, row_width], and where on the tape it runs."""
        self.rows = rows
        self.split = len(self.tape)
        self._updates = rows.new_zeros(len(rows), self._update_width)
        return self._updates


class TapedSteps:
    """Two taped steps of worlds of one shape: from a first buffer to a second one, and back."""

    def __init__(self, step: RuleStep, particles: Particles) -> None:
        # With all particles active there is a row for each.
        masked = step.physics.update_prob < 1.0
        self._mask = torch.ones(particles.x.shape[:2], dtype=torch.uint8) if masked else None
        # Contiguous: a copy that a step would have to make is not on the tape.
        first = particles.map(lambda value: value.clone(memory_format=torch.contiguous_format))
        there = _TapedStep(step, first, self._mask)
        back = _TapedStep(step, there.after, self._mask)
        for old, new in zip(back.after.tensors(), first.tensors(), strict=True):
            back.tape.move(back.tape.argument_slots(old), new)
        self._buffers = first, there.after
        self._steps = there, back

    def run(
        self, network: Network, particles: Particles, masks: Iterable[Tensor | None], every: int
    ) -> list[Particles]:
        """Step worlds once with each update mask; return copies after `every` steps each."""
        self._buffers[0].copy_(particles)
        trajectory: list[Particles] = []
        for number, mask in enumerate(masks):
            step = self._steps[number % 2]
            count = len(step.rows)
            if self._mask is not None and mask is not None:
                self._mask.copy_(mask)
                count = max(int(mask.sum()), 1)
            step.tape.replay(0, step.split, last_count=count)
            # Kept alive until the launch has read it.
            updates = network(step.rows[:count])
            step.tape.move(step.slots, updates)
            step.tape.replay(step.split)
            if (number + 1) % every == 0:
                trajectory.append(self._buffers[(number + 1) % 2].map(torch.clone))
        return trajectory


_groups = CallGroups()

_groups_lock = threading.Lock()


def run_taped(
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
        or x.shape[0] * x.shape[1] > MAX_TAPED_PARTICLES
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
    with _groups_lock:
        group = _groups.count(key, MAX_TAPED_GROUPS)
    if group.calls <= LAUNCHED_FIRST:
        return None
    # Another thread may have taken the last one in the meantime.
    try:
        taped = group.free.pop()
    except IndexError:
        with torch.inference_mode(False), torch.no_grad():
            taped = TapedSteps(step, particles)
    masks = (draws.mask for draws in step.draw(x, steps, generator))
    try:
        with torch.autocast("cpu", enabled=False):
            trajectory = taped.run(step.network, particles, masks, keep_every or steps)
    finally:
        group.free.append(taped)
    return trajectory[0] if keep_every is None else combined(torch.stack, trajectory)
