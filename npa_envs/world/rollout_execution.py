"""How a rollout runs: one of several ways with the same results; one kernel rounds otherwise.

A rollout takes the first way whose condition is met; `run_all_steps` is the last three of them:

| way                      | condition                                      | code                 |
|--------------------------|------------------------------------------------|----------------------|
| run all in one kernel    | "whole" on CUDA, no gradients, small worlds    | whole_rollout.py     |
| skip steps once at rest  | rule with dead zone, no gradients, many steps  | `execute`            |
| replay CUDA graphs       | CUDA, third call on                            | capture_cache.py     |
| replay recorded launches | CPU, small worlds, third call on               | replayed_launches.py |
| launch each step         | none                                           | `RolloutSpec.launch` |

"Third" counts calls with the same shapes and options. What a step is, `RolloutSpec.make_step`
chooses: one of several species, of static or dividing particles, or of one rule (`steps.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from npa_envs.checks import check_finite_positions
from npa_envs.errors import NPAError
from npa_envs.ops.physics import Physics
from npa_envs.rule.rule import NPARule
from npa_envs.world.capture_cache import CudaGraph, run_captured
from npa_envs.world.cuda_graph import draws_alone
from npa_envs.world.divergence import DivergenceWatch
from npa_envs.world.particles import Particles, combined
from npa_envs.world.randomness import Randomness
from npa_envs.world.replayed_launches import replay_launches
from npa_envs.world.steps import (
    DivisionStep,
    RuleStep,
    SpeciesSpec,
    SpeciesStep,
    StaticStep,
    Step,
    skip_draws,
)
from npa_envs.world.whole_rollout import run_whole

Memory = Literal["store", "recompute", "minimal"]

STORED_INTERVAL: dict[Memory, int] = {"store": 1, "recompute": 3, "minimal": 2**31}
"""The last step and every k-th step before it store the backward pass's tensors; k by `memory`."""

MIN_STATIC = 3
"""Minimum number of steps of a rollout for which static worlds are sorted in advance."""

MIN_RESTING = 256
"""Minimum number of steps of a rollout that is checked for worlds at rest."""

FIRST_PART = {"cpu": 64, "cuda": 1024}
"""Steps between the first two checks for worlds at rest, by device; they double after each."""


def execute(
    spec: RolloutSpec,
    rules: Sequence[NPARule],
    particles: Particles,
    generator: Randomness | None,
    cuda_graph: CudaGraph,
    watch: DivergenceWatch | None,
    with_paths: bool,
) -> Particles:
    """Run a checked rollout, and return what `run_all_steps` does.

    Without a watch and path lengths one kernel may run all steps, or it skips the steps after all
    worlds have come to rest.
    """
    if watch is None and not with_paths and cuda_graph == "whole":
        whole = run_whole(spec, rules, particles, generator)
        if whole is not None:
            return whole
    if watch is not None or with_paths or not _can_rest(spec, rules, particles.x):
        return run_all_steps(spec, rules, particles, generator, cuda_graph, watch)
    remaining, steps = spec.steps, FIRST_PART[particles.x.device.type]
    while remaining and not resting(rules, particles, spec.physics, cuda_graph).all():
        part = spec._replace(steps=min(steps, remaining))
        particles = run_all_steps(part, rules, particles, generator, cuda_graph)
        remaining, steps = remaining - part.steps, 2 * steps
        if remaining and not particles.x.isfinite().all():
            # A world has diverged: the next call raises an error for it, this one does not.
            part, particles = spec._replace(steps=remaining), particles.with_zero_paths()
            return part.launch(part.make_step(rules, particles), rules, particles, generator)
    # The generator ends where it would be after all steps.
    skip_draws(particles.x, spec.physics, remaining, generator)
    # The caller may write to the results.
    return particles.map(torch.clone) if remaining == spec.steps else particles


def _can_rest(spec: RolloutSpec, rules: Sequence[NPARule], x: Tensor) -> bool:
    """Return whether a rollout may skip its steps once all worlds are at rest."""
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


def resting(
    rules: Sequence[NPARule], particles: Particles, physics: Physics, cuda_graph: CudaGraph
) -> Tensor:
    """Return which worlds are at rest: an update of all particles changes none, bool, shape [B]."""
    spec = RolloutSpec(1, physics._replace(update_prob=1.0))
    with torch.no_grad():
        return run_all_steps(spec, rules, particles, None, cuda_graph).equal(particles)


def run_all_steps(
    spec: RolloutSpec,
    rules: Sequence[NPARule],
    particles: Particles,
    generator: Randomness | None,
    cuda_graph: CudaGraph,
    watch: DivergenceWatch | None = None,
) -> Particles:
    """Run all steps in the fastest way that the options allow; return the last worlds.

    With `spec.keep_every` it returns the worlds kept, stacked along a new first dimension. With a
    watch, each step is launched and then checked for divergence.
    """
    if watch is None:
        replayed = run_captured(spec, rules, particles, generator, cuda_graph=cuda_graph)
        if replayed is not None:
            return replayed
    check_finite_positions(particles.x)
    if particles.x.is_cuda and torch.is_grad_enabled():
        # Gradients are added in the order of a capture: first those of this rollout.
        particles = particles.map(lambda value: value.view_as(value))
    particles = particles.with_zero_paths()
    step = spec.make_step(rules, particles)
    if watch is None and type(step) is RuleStep:
        stores = spec.memory == "store"
        replayed = replay_launches(step, particles, generator, spec.steps, spec.keep_every, stores)
        if replayed is not None:
            return replayed
    return spec.launch(step, rules, particles, generator, watch)


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
    world_by_world: bool = False
    """Whether a rule's network runs for one world after the other (`RuleStep.updates_of`)."""

    def make_step(self, rules: Sequence[NPARule], particles: Particles) -> Step:
        """Return a new `Step` of the kind that these rules, worlds and options need."""
        physics, detach_positions = self.physics.constants(), self.detach_positions
        if self.species:
            x = particles.x
            return SpeciesStep(rules, self.species, physics, x, self.per_species, detach_positions)
        (rule,) = rules
        moving = physics.moving or physics.position_noise > 0.0 or not detach_positions
        if not moving and self.steps >= MIN_STATIC:
            return StaticStep(rule, physics, particles.x)
        # A rule with a custom network runs as its module.
        cls = DivisionStep if rule.divides else RuleStep
        return cls(rule, rule.network(), physics, detach_positions, self.world_by_world)

    def launch(
        self,
        step: Step,
        rules: Sequence[NPARule],
        particles: Particles,
        generator: Randomness | None,
        watch: DivergenceWatch | None = None,
    ) -> Particles:
        """Launch all steps of checked worlds, and return what `run_all_steps` does."""
        trajectory: list[Particles] = []
        # Worlds keep their dtype under autocast, as kernels read the rules' outputs.
        with torch.autocast(particles.x.device.type, enabled=False):
            particles = step.to_step_order(particles)
            after_each = self._worlds_after_each_step(step, rules, particles, generator)
            for number, particles in enumerate(after_each, 1):
                if watch is not None:
                    watch.check(step.to_caller_order(particles.map(Tensor.detach)))
                if self.keep_every is not None and number % self.keep_every == 0:
                    trajectory.append(step.to_caller_order(particles))
            # Without steps it is a copy, as the caller may write to the results.
            last = particles if self.steps else particles.map(torch.clone)
            after = combined(torch.stack, trajectory) if trajectory else step.to_caller_order(last)
        if watch is not None:
            watch.raise_diverged()
        return after

    def _worlds_after_each_step(
        self,
        step: Step,
        rules: Sequence[NPARule],
        particles: Particles,
        generator: Randomness | None,
    ) -> Iterator[Particles]:
        """Yield the worlds after each step; by `memory`, the backward pass recomputes some."""
        interval, restores = self._recomputation(rules, particles.x)
        advance: Callable[..., Any] = step.advance
        # A compiled function reads copies.
        if interval > 1 and not torch.compiler.is_compiling():
            advance = RecomputedSteps(step.advance, rules, particles)
        for number, draws in enumerate(step.draw(particles.x, self.steps, generator)):
            if (self.steps - 1 - number) % interval == 0:
                particles = step.advance(particles, draws)
            else:
                particles = checkpoint(
                    advance, particles, draws, use_reentrant=False, preserve_rng_state=restores
                )
            yield particles
        if isinstance(advance, RecomputedSteps):
            advance.store_versions()

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
