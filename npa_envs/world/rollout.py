"""Rollouts: worlds in time, one step of a rule after the other; differentiable."""

from __future__ import annotations

import functools
import math
import threading
from collections.abc import Callable, Iterator, Sequence
from types import NoneType
from typing import Literal, NamedTuple, Protocol, overload

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from npa_envs.errors import NPAError, shown
from npa_envs.ops.checks import (
    Box,
    check_scale,
    check_world,
    checked_box,
    checked_count,
    checked_eps,
    checked_flag,
    checked_number,
)
from npa_envs.ops.perceive import (
    PerceptionOptions,
    Terms,
    perceive_rows,
    update_some_at_a_time,
)
from npa_envs.ops.static import StaticRows, StaticWorlds, prepare_static, static_rows
from npa_envs.ops.update import update_particles
from npa_envs.rule.network import Network
from npa_envs.rule.rule import LIFE, NPARule, check_rule
from npa_envs.world.cuda_graph import Beside
from npa_envs.world.divergence import DivergenceWatch, OnDivergence, make_watch
from npa_envs.world.division import Births, divided, living, parked
from npa_envs.world.prepared import PreparedSteps, may_prepare, run_prepared
from npa_envs.world.randomness import (
    Randomness,
    WorldRandom,
    check_generator,
    normal_draws,
    uniform_draws,
)
from npa_envs.world.recorded import CudaGraph, Worlds, check_cuda_graph, rule_form, run_call

Memory = Literal["store", "recompute", "minimal"]

STORED_INTERVAL: dict[Memory, float] = {"store": 1, "recompute": 3, "minimal": math.inf}
"""The last step and every so-manyth before it store what the backward pass reads."""

FEWEST_STATIC = 3
"""Steps from which on it pays to prepare worlds whose particles never move."""

ROWS_TOGETHER = 2**24
"""Rows of static worlds that are given together, at most, if they are of several steps."""

ROWS_KEPT = 2**24
"""Rows of perception that are kept for the network all together, at most."""

MOST_AHEAD = 4
"""Steps whose draws a recording makes beside the steps before them, at most: these take memory."""

OVERFLOW_LOG_PROBABILITY = 34.5
"""Row capacities hold with probability 1 - exp(-34.5), about 1 - 1e-15, for each step."""


class StepOptions(NamedTuple):
    """Everything about a step that stays the same over a rollout, checked."""

    eps: float
    box: tuple[float, ...] | None
    update_prob: float
    dt: float
    position_noise: float
    detach_positions: bool


def row_capacity(particle_total: int, update_prob: float) -> int:
    """Return how many rows hold the active particles of a step, without reading their number.

    Bernstein's inequality bounds the number of active particles; a graph of kernels needs a shape
    that does not depend on the draw. On the CPU the exact number is used instead.

    Args:
        particle_total: Particles of all worlds, B N.
        update_prob: Probability p with which each is active.
    """
    mean = particle_total * update_prob
    variance = mean * (1.0 - update_prob)
    slack = OVERFLOW_LOG_PROBABILITY / 3.0
    margin = slack + math.sqrt(slack * slack + 2.0 * OVERFLOW_LOG_PROBABILITY * variance)
    return min(particle_total, math.ceil(mean + margin))


def row_count(mask: Tensor | None, x: Tensor, options: StepOptions) -> int:
    """Return how many rows hold the active particles of a step of worlds at x; no mask: all."""
    total = x.shape[0] * x.shape[1]
    if mask is None:
        return total
    # Counting is free on the CPU; on CUDA it would stall the stream.
    return row_capacity(total, options.update_prob) if mask.is_cuda else max(int(mask.sum()), 1)


def check_memory(memory: Memory) -> None:
    """Check what the backward pass shall read."""
    if not isinstance(memory, str) or memory not in STORED_INTERVAL:
        raise NPAError(f"memory must be 'store', 'recompute' or 'minimal', got {shown(memory)}")


def checked_options(
    rule: NPARule,
    x: Tensor,
    s: Tensor,
    eps: float | None,
    box: Box,
    update_prob: float,
    dt: float,
    position_noise: float,
    detach_positions: bool,
) -> StepOptions:
    """Check what `rollout` was given, and return what stays the same over it; its errors."""
    check_world(x, s)
    if (x.shape[2], s.shape[2]) != (rule.space_dim, rule.state_dim):
        raise NPAError(
            f"x and s must have the rule's {rule.space_dim} coordinates and {rule.state_dim} "
            f"channels, got {tuple(x.shape)} and {tuple(s.shape)}"
        )
    weight = rule.hidden.weight
    if weight.dtype != x.dtype or weight.device != x.device:
        raise NPAError(
            f"the rule must share dtype and device with x, got {weight.dtype} on {weight.device} "
            f"and {x.dtype} on {x.device}: move it with rule.to(x)"
        )
    given = (eps, box, update_prob, dt, position_noise, detach_positions)
    # Numbers of other types may change, and tensors are no keys.
    plain = all(type(value) in (float, int, bool, NoneType) for value in given)
    known = plain and not torch.compiler.is_compiling()
    check = _known_numbers if known else _checked_numbers
    return check(rule.space_dim, rule.eps0, x.dtype, *given)


def _checked_numbers(
    space_dim: int,
    eps0: float,
    dtype: torch.dtype,
    eps: float | None,
    box: Box,
    update_prob: float,
    dt: float,
    position_noise: float,
    detach_positions: bool,
) -> StepOptions:
    radius = checked_eps("eps", eps0 if eps is None else eps, dtype)
    check_scale(radius, eps0, space_dim, dtype)
    update_prob = checked_number("update_prob", update_prob)
    dt = checked_number("dt", dt)
    position_noise = checked_number("position_noise", position_noise)
    if not 0.0 < update_prob <= 1.0:
        raise NPAError(f"update_prob must lie in (0, 1], got {update_prob}")
    if not (math.isfinite(dt) and dt > 0.0):
        raise NPAError(f"dt must be positive and finite, got {dt}")
    if not (math.isfinite(position_noise) and position_noise >= 0.0):
        raise NPAError(f"position_noise must be finite and not negative, got {position_noise}")
    detach_positions = checked_flag("detach_positions", detach_positions)
    sides = checked_box(box, space_dim, radius)
    return StepOptions(radius, sides, update_prob, dt, position_noise, detach_positions)


_known_numbers = functools.lru_cache(maxsize=256, typed=True)(_checked_numbers)


def draw_step(x: Tensor, options: StepOptions, generator: Randomness | None) -> Draws:
    """Draw a step's update mask and position noise, in this order."""
    mask = noise = None
    if isinstance(generator, WorldRandom):
        generator.advance()
        if options.update_prob < 1.0:
            mask = generator.bernoulli(options.update_prob, x.shape[1])
        if options.position_noise > 0.0:
            noise = generator.normal(*x.shape[1:], dtype=x.dtype)
            noise *= options.position_noise
        return Draws(mask, noise)
    if options.update_prob < 1.0:
        mask = torch.empty(x.shape[:2], dtype=torch.uint8, device=x.device)
        mask.bernoulli_(options.update_prob, generator=generator)
    if options.position_noise > 0.0:
        noise = torch.randn(x.shape, dtype=x.dtype, device=x.device, generator=generator)
        noise *= options.position_noise
    return Draws(mask, noise)


def drawn_steps(draw: Callable[[], Draws], like: Tensor, steps: int) -> Iterator[Draws]:
    """Yield what each of some steps draws, in the same order everywhere.

    In a CUDA graph some steps' draws are made while the steps before them run.

    Args:
        draw: Returns what the next step draws.
        like: A tensor on the worlds' device.
        steps: Number of steps.
    """
    # Asked in this order: a compiler cannot trace what a stream does.
    recording = not torch.compiler.is_compiling() and like.is_cuda
    if not (recording and torch.cuda.is_current_stream_capturing()):
        for _ in range(steps):
            yield draw()
        return
    beside = Beside.of_thread(like.device, threading.get_ident())
    ready, rest = [draw()], steps - 1
    while rest > 0:
        # Their memory comes from steps that are over by then: these streams take turns in it.
        count = min(3 * len(ready), MOST_AHEAD, rest)
        with beside.aside():
            coming = [draw() for _ in range(count)]
        yield from ready
        beside.join()
        ready, rest = coming, rest - count
    yield from ready


def rule_terms(rule: NPARule) -> Terms:
    """Return the groups of the perception vector that a rule reads."""
    inverse = rule.moment_inverse if rule.moment_correction else None
    return Terms(rule.state_gradient, inverse, rule.density_gradient)


class Draws(NamedTuple):
    """What a step draws."""

    mask: Tensor | None
    """Update mask, uint8, shape [B, N]; None: all particles are updated."""
    noise: Tensor | None
    """Position noise [length units], shape [B, N, D], or None."""
    rows: StaticRows | None = None
    """Rows of the active particles, where particles never move."""
    births: Births | None = None
    """What fates and children hang on, where particles divide."""


class Step(Protocol):
    """What a rollout repeats: draws, and an advance that follows from them alone."""

    def draws(self, x: Tensor, steps: int, generator: Randomness | None) -> Iterator[Draws]:
        """Draw what each of some steps of worlds at x draws."""

    def advance(
        self,
        x: Tensor,
        s: Tensor,
        path_length: Tensor,
        mask: Tensor | None,
        noise: Tensor | None,
        rows: StaticRows | None,
        births: Births | None,
    ) -> Worlds:
        """Return the worlds after one step with these draws."""

    def ordered(self, worlds: Worlds) -> Worlds:
        """Return worlds of the rollout in the caller's order of particles."""


class RuleStep(NamedTuple):
    """The step of one rule: perceive the active particles, run the network, update."""

    rule: NPARule
    network: Network | None
    """The rule's weights as they are run; None: it runs as the module that it is."""
    options: StepOptions
    static: StaticWorlds | None = None
    """Where particles never move: worlds in sorted order, prepared once."""

    def draws(self, x: Tensor, steps: int, generator: Randomness | None) -> Iterator[Draws]:
        """Draw each step's update mask and position noise."""
        if self.static is None:
            yield from drawn_steps(lambda: draw_step(x, self.options, generator), x, steps)
            return
        # The rows of static worlds are given some steps at a time, in few launches.
        total = x.shape[0] * x.shape[1]
        together = max(min(16, ROWS_TOGETHER // total), 1)
        for first in range(0, steps, together):
            count = min(together, steps - first)
            drawn = [draw_step(x, self.options, generator) for _ in range(count)]
            masks = [draws.mask for draws in drawn if draws.mask is not None]
            if masks:
                capacity = row_capacity(total, self.options.update_prob)
                rows = static_rows(self.static, x.detach(), masks, capacity)
                drawn = [Draws(None, None, own) for own in rows]
            yield from drawn

    def advance(
        self,
        x: Tensor,
        s: Tensor,
        path_length: Tensor,
        mask: Tensor | None,
        noise: Tensor | None,
        rows: StaticRows | None,
        births: Births | None,
    ) -> Worlds:
        """Return the worlds after one step with these draws."""
        rule, options = self.rule, self.options
        network = rule if self.network is None else self.network
        width = rule.perception_dim if self.network is None else self.network.row_width
        count = len(rows.row_source) if rows is not None else row_count(mask, x, options)
        huge = count > ROWS_KEPT and not torch.is_grad_enabled() and self.static is None
        if huge and not torch.compiler.is_compiling():
            sides = None if options.box is None else list(options.box)
            asked = PerceptionOptions(
                count, width, options.eps, options.eps / rule.eps0, sides, rule_terms(rule)
            )
            update, active = update_some_at_a_time(x, s, mask, network, asked)
        else:
            perception, active = perceive_rows(
                x.detach() if options.detach_positions else x,
                s,
                mask=mask,
                row_capacity=count,
                row_width=width,
                eps=options.eps,
                eps0=rule.eps0,
                box=options.box,
                terms=rule_terms(rule),
                static=self.static,
                static_rows=rows,
            )
            update = network(perception)
        return Worlds(
            *update_particles(
                update,
                x if noise is None else x + noise,
                s,
                path_length,
                rows=active,
                reach=rule.alpha * options.eps,
                dt=options.dt,
                moving=not rule.static,
                box=options.box,
            )
        )

    def ordered(self, worlds: Worlds) -> Worlds:
        """Return worlds of the rollout in the caller's order of particles."""
        return worlds if self.static is None else Worlds(*map(self.static.unsort, worlds))


class DivisionStep(NamedTuple):
    """The step of a rule whose particles divide: that of the living, and then their fates."""

    step: RuleStep
    """The step of the living."""

    def draws(self, x: Tensor, steps: int, generator: Randomness | None) -> Iterator[Draws]:
        """Draw each step's update mask, position noise, fates and directions of children."""
        yield from drawn_steps(lambda: self._draw(x, generator), x, steps)

    def _draw(self, x: Tensor, generator: Randomness | None) -> Draws:
        drawn = draw_step(x, self.step.options, generator)
        chance = uniform_draws(generator, x.shape[:2], x)
        return drawn._replace(births=Births(chance, normal_draws(generator, x.shape, x)))

    def advance(
        self,
        x: Tensor,
        s: Tensor,
        path_length: Tensor,
        mask: Tensor | None,
        noise: Tensor | None,
        rows: StaticRows | None,
        births: Births | None,
    ) -> Worlds:
        """Return the worlds after one step with these draws."""
        assert births is not None, "drawn above"
        eps = self.step.options.eps
        alive = living(s)
        updated = alive if mask is None else alive & mask.bool()
        life, rest = s[..., : LIFE + 1], s[..., LIFE + 1 :]
        # Life is no weight of what is perceived, so perception gives it no gradient.
        perceived = torch.cat((life.detach(), rest), dim=-1)
        after = self.step.advance(
            parked(x, alive, eps), perceived, path_length, updated.byte(), noise, rows, None
        )
        # A rule does not change life.
        new_s = torch.cat((life, after.s[..., LIFE + 1 :]), dim=-1)
        return Worlds(
            *divided(
                after.x,
                new_s,
                after.path_length,
                fates=self.step.rule.fates(new_s),
                updated=updated,
                births=births,
                eps=eps,
            )
        )

    def ordered(self, worlds: Worlds) -> Worlds:
        """Return worlds of the rollout in the caller's order of particles."""
        return worlds


def run_steps(
    step: Step,
    worlds: Worlds,
    steps: int,
    *,
    generator: Randomness | None,
    memory: Memory,
    keep_every: int | None = None,
    watch: DivergenceWatch | None = None,
) -> Worlds:
    """Repeat a step on checked worlds; return them in the caller's order.

    Args:
        step: What to repeat.
        worlds: The worlds, in the order that the step takes them in.
        steps: Number of steps T.
        generator: Source of the draws.
        memory: What the backward pass reads is stored or recomputed.
        keep_every: Return the worlds after each so many steps, one after the other in a first
            dimension; None: the last ones.
        watch: What looks at the worlds after each step, or None.

    Raises:
        DivergedError: The watch has seen a world diverge.
    """
    interval = STORED_INTERVAL[memory] if torch.is_grad_enabled() else 1
    kept: list[Worlds] = []
    # Worlds keep their dtype under autocast: the kernels read what the rules write.
    with torch.autocast(worlds.x.device.type, enabled=False):
        for number, draws in enumerate(step.draws(worlds.x, steps, generator)):
            if (steps - 1 - number) % interval > 0:
                worlds = checkpoint(
                    step.advance, *worlds, *draws, use_reentrant=False, preserve_rng_state=False
                )
            else:
                mask, noise, rows, births = draws
                worlds = step.advance(*worlds, mask, noise, rows, births)
            if watch is not None:
                seen = step.ordered(Worlds(*(value.detach() for value in worlds)))
                watch.look(seen.x, seen.s)
            if keep_every is not None and (number + 1) % keep_every == 0:
                kept.append(step.ordered(worlds))
        if keep_every is None:
            worlds = step.ordered(worlds)
        else:
            worlds = Worlds(*map(torch.stack, zip(*kept, strict=True)))
    if watch is not None:
        watch.raise_diverged()
    return worlds


class RolloutCall(NamedTuple):
    """What a checked call of `rollout` asks for besides its tensors."""

    steps: int
    options: StepOptions
    memory: Memory
    keep_every: int | None

    def run(
        self,
        rules: Sequence[NPARule],
        worlds: Worlds,
        generator: Randomness | None,
        watch: DivergenceWatch | None = None,
    ) -> Worlds:
        """Launch the rollout of one rule."""
        (rule,) = rules
        # Any other rule runs as the module that it is.
        network = rule.network()
        static = _prepare_static(rule, worlds.x, self.steps, self.options)
        preparable = network is not None and static is None and not rule.divides
        if network is not None and preparable and watch is None and may_prepare(worlds):
            prepared = self._run_prepared(rule, network, worlds, generator)
            if prepared is not None:
                return prepared
        if static is not None:
            worlds = Worlds(*map(static.sort, worlds))
        if rule.divides:
            # What lies in dead slots must not reach gradients either: 0 times NaN is NaN.
            blank = torch.where(living(worlds.s)[..., None], worlds.s, 0.0)
            worlds = worlds._replace(s=blank)
        own = RuleStep(rule, network, self.options, static)
        return run_steps(
            DivisionStep(own) if rule.divides else own,
            worlds,
            self.steps,
            generator=generator,
            memory=self.memory,
            keep_every=self.keep_every,
            watch=watch,
        )

    def _run_prepared(
        self, rule: NPARule, network: Network, worlds: Worlds, generator: Randomness | None
    ) -> Worlds | None:
        """Run the rollout by prepared steps; None where it is to be launched."""
        options, steps, every = self.options, self.steps, self.keep_every or self.steps
        if options.position_noise > 0.0 or steps == 0:
            return None
        x, s, _ = worlds

        def advance(network: Network, worlds: Worlds, mask: Tensor | None) -> Worlds:
            step = RuleStep(rule, network, options)
            return step.advance(*worlds, mask, None, None, None)

        def make() -> PreparedSteps:
            widths = network.row_width, network.update_width
            return PreparedSteps(advance, worlds, *widths, options.update_prob < 1.0)

        def run(prepared: PreparedSteps) -> list[Worlds]:
            draws = RuleStep(rule, network, options).draws(x, steps, generator)
            with torch.autocast("cpu", enabled=False):
                return prepared.run(
                    network, worlds, (draw.mask for draw in draws), lambda done: done % every == 0
                )

        key = (options, rule_form(rule), x.shape, s.shape[2], x.dtype)
        kept = run_prepared(key, make, run)
        if kept is None:
            return None
        if self.keep_every is None:
            return kept[0]
        return Worlds(*map(torch.stack, zip(*kept, strict=True)))


def _prepare_static(
    rule: NPARule, x: Tensor, steps: int, options: StepOptions
) -> StaticWorlds | None:
    """Compute what follows from positions, where they stay and it pays."""
    moving = not rule.static or options.position_noise > 0.0 or not options.detach_positions
    if moving or steps < FEWEST_STATIC:
        return None
    return prepare_static(
        x, rule.state_dim, eps=options.eps, box=options.box, terms=rule_terms(rule)
    )


def checked_keep_every(keep_every: int | None, steps: int) -> int | None:
    """Return after how many steps worlds are kept, each time.

    Raises:
        NPAError: It is no divisor of the number of steps.
    """
    if keep_every is None:
        return None
    kept = checked_count("keep_every", keep_every)
    if kept == 0 or steps == 0 or steps % kept:
        raise NPAError(
            f"steps must be a multiple of keep_every, got {steps} and {kept}: the last world kept "
            f"is the one at the end"
        )
    return kept


def step(
    rule: NPARule,
    x: Tensor,
    s: Tensor,
    *,
    eps: float | None = None,
    box: Box = None,
    update_prob: float = 0.5,
    dt: float = 1.0,
    position_noise: float = 0.0,
    detach_positions: bool = True,
    generator: Randomness | None = None,
    on_divergence: OnDivergence = "ignore",
    cuda_graph: CudaGraph = "auto",
) -> tuple[Tensor, Tensor]:
    """Advance worlds by one step: `rollout` with steps=1; its arguments and errors.

    Returns:
        Positions [length units], shape [B, N, D], and states, dimensionless, shape [B, N, C].
    """
    return rollout(
        rule,
        x,
        s,
        1,
        eps=eps,
        box=box,
        update_prob=update_prob,
        dt=dt,
        position_noise=position_noise,
        detach_positions=detach_positions,
        generator=generator,
        on_divergence=on_divergence,
        cuda_graph=cuda_graph,
    )


@overload
def rollout(
    rule: NPARule,
    x: Tensor,
    s: Tensor,
    steps: int,
    *,
    eps: float | None = ...,
    box: Box = ...,
    update_prob: float = ...,
    dt: float = ...,
    position_noise: float = ...,
    detach_positions: bool = ...,
    memory: Memory = ...,
    generator: Randomness | None = ...,
    on_divergence: OnDivergence = ...,
    keep_every: int | None = ...,
    cuda_graph: CudaGraph = ...,
    return_path_length: Literal[False] = ...,
) -> tuple[Tensor, Tensor]: ...


@overload
def rollout(
    rule: NPARule,
    x: Tensor,
    s: Tensor,
    steps: int,
    *,
    eps: float | None = ...,
    box: Box = ...,
    update_prob: float = ...,
    dt: float = ...,
    position_noise: float = ...,
    detach_positions: bool = ...,
    memory: Memory = ...,
    generator: Randomness | None = ...,
    on_divergence: OnDivergence = ...,
    keep_every: int | None = ...,
    cuda_graph: CudaGraph = ...,
    return_path_length: Literal[True],
) -> tuple[Tensor, Tensor, Tensor]: ...


def rollout(
    rule: NPARule,
    x: Tensor,
    s: Tensor,
    steps: int,
    *,
    eps: float | None = None,
    box: Box = None,
    update_prob: float = 0.5,
    dt: float = 1.0,
    position_noise: float = 0.0,
    detach_positions: bool = True,
    memory: Memory = "store",
    generator: Randomness | None = None,
    on_divergence: OnDivergence = "ignore",
    keep_every: int | None = None,
    cuda_graph: CudaGraph = "auto",
    return_path_length: bool = False,
) -> tuple[Tensor, Tensor] | tuple[Tensor, Tensor, Tensor]:
    """Run a rule for a number of steps; differentiable, and particle i stays particle i.

    Each step draws m ~ Bernoulli(update_prob) for every particle, perceives the particles with
    m = 1 and updates them: x ← x + m dt Δx (+ noise), s ← s + m dt Δs, with
    Δx = alpha eps δ / (1 + |δ|) and [δ ; Δs] = rule(z) (arXiv 2601.16096, section 3).

    With a rule that `divides`, particle i is slot i, whose particle may die and be replaced by
    another one's child (`npa_envs.world.division`).

    Args:
        rule: The rule; dtype and device of x.
        x: Particle positions [length units], shape [B, N, D].
        s: Particle states, dimensionless, shape [B, N, C].
        steps: Number of steps T, 0 or more.
        eps: Perception radius [length units]; default: the rule's eps0.
        box: Sides of a periodic box centred on the origin [length units], into which positions are
            wrapped, or None for open space.
        update_prob: Probability p of each particle's update in a step, in (0, 1].
        dt: Time step, dimensionless.
        position_noise: Standard deviation of the noise added to every position in each step
            [length units].
        detach_positions: Perception does not back-propagate into positions (the paper's choice).
        memory: "store" keeps what the backward pass reads. "recompute" computes two steps in three
            again: about half the memory, and two thirds of a forward pass more time. "minimal"
            recomputes all but the last step: least memory, and a forward pass more time. Gradients
            are the same.
        generator: Source of the masks and the noise, on x's device; default: torch's global one. A
            `WorldRandom` advances by one step before the draws of each step, so that every world
            draws the same numbers as alone.
        on_divergence: What to do if numbers of a world become infinite or NaN. "ignore" costs
            nothing; the next call refuses such positions. "raise" checks each step on the device,
            and waits for the result once, at the end.
        keep_every: Return the worlds after every so many steps, a divisor of `steps`: the
            trajectory. Results have one more dimension at the front, of size steps / keep_every.
        cuda_graph: On CUDA, replay repeated calls instead of launching their kernels one by one.
            The host then needs a tenth of the time, and the numbers are the same. "auto" records
            plain rules, from the third call with the same shapes and options on. True also records
            rules with a network of their own, whose Python code then no longer runs. False records
            nothing. See docs/performance.md.
        return_path_length: Also return how far each particle travelled.

    Returns:
        Positions [length units], shape [B, N, D]; states, dimensionless, shape [B, N, C]; and where
        asked the length of each particle's path [length units], shape [B, N].

    Raises:
        NPAError: Shapes, dtypes or devices do not fit each other or the rule, a position is not
            finite, or a number is out of its range.
        DivergedError: A world diverged and `on_divergence` is "raise"; the message says which, in
            which step, and which number of which particle.
    """
    steps = checked_count("steps", steps)
    kept = checked_keep_every(keep_every, steps)
    check_memory(memory)
    check_cuda_graph(cuda_graph)
    check_rule(rule)
    if rule.species_count:
        raise NPAError(
            f"the rule must not perceive species by themselves, got species_count="
            f"{rule.species_count}: run it with npa_envs.rollout_species"
        )
    options = checked_options(
        rule, x, s, eps, box, update_prob, dt, position_noise, detach_positions
    )
    check_generator(generator, x.device, x.shape[0])
    if rule.divides and options.box is not None:
        raise NPAError(
            f"box must be None where particles divide, got {shown(box)}: the dead need a place far "
            "from all others"
        )
    after = run_call(
        RolloutCall(steps, options, memory, kept),
        (rule,),
        x,
        s,
        generator,
        cuda_graph=cuda_graph,
        watch=make_watch(on_divergence, x, s),
    )
    return (after.x, after.s, after.path_length) if return_path_length else (after.x, after.s)
