"""Rollouts: worlds in time, one step of a rule after the other; differentiable."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple, TypedDict, Unpack, overload

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from npa_envs.checks import (
    Box,
    check_world,
    checked_count,
    checked_flag,
)
from npa_envs.errors import NPAError, shown
from npa_envs.ops.opaque import check_derivatives
from npa_envs.ops.physics import Physics, physics
from npa_envs.ops.static import prepare_static
from npa_envs.ops.update import wrapped
from npa_envs.rule.network import Network
from npa_envs.rule.rule import NPARule, check_rule
from npa_envs.world.cuda_graph import draws_alone
from npa_envs.world.divergence import DivergenceWatch, OnDivergence, make_watch
from npa_envs.world.division import living
from npa_envs.world.prepared import PreparedSteps, may_prepare, run_prepared
from npa_envs.world.randomness import (
    Randomness,
    check_generator,
)
from npa_envs.world.recomputed import RecomputedSteps
from npa_envs.world.recorded import CudaGraph, Particles, check_cuda_graph, rule_form, run_call
from npa_envs.world.steps import (
    DivisionStep,
    RuleStep,
    Step,
    rule_terms,
    skip_draws,
)

Memory = Literal["store", "recompute", "minimal"]


class RolloutOptions(TypedDict, total=False):
    """What rollouts of one rule and of several take by name; `rollout` says what it means."""

    eps: float | None
    box: Box
    dt: float
    position_noise: float
    detach_positions: bool
    memory: Memory
    generator: Randomness | None
    on_divergence: OnDivergence
    keep_every: int | None
    cuda_graph: CudaGraph


STORED_INTERVAL: dict[Memory, int] = {"store": 1, "recompute": 3, "minimal": 2**31}
"""The last step and every so-manyth before it store what the backward pass reads."""

FEWEST_STATIC = 3
"""Steps from which on it pays to prepare worlds whose particles never move."""

FEWEST_RESTING = 256
"""Steps from which on it pays to ask whether worlds are at rest."""

FIRST_PART = {"cpu": 64, "cuda": 1024}
"""Steps after which that is asked again, by device; the next parts are twice as long each. A GPU
idles while it is asked."""


def check_memory(memory: Memory) -> None:
    """Check what the backward pass shall read."""
    if not isinstance(memory, str) or memory not in STORED_INTERVAL:
        raise NPAError(f"memory must be 'store', 'recompute' or 'minimal', got {shown(memory)}")


def checked_physics(
    rule: NPARule,
    x: Tensor,
    s: Tensor,
    *,
    eps: float | None,
    box: Box,
    update_prob: float = 1.0,
    dt: float,
    position_noise: float = 0.0,
) -> Physics:
    """Check that worlds and a rule fit, and return the constants of its rollouts."""
    check_world(x, s)
    check_derivatives(x=x, s=s, rule=rule)
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
    return physics(
        rule.space_dim,
        rule.state_dim,
        x.dtype,
        eps=eps,
        eps0=rule.eps0,
        box=box,
        terms=rule_terms(rule),
        moving=not rule.static,
        alpha=rule.alpha,
        update_prob=update_prob,
        dt=dt,
        position_noise=position_noise,
    )


def run_steps(
    step: Step,
    rules: Sequence[NPARule],
    worlds: Particles,
    steps: int,
    *,
    generator: Randomness | None,
    memory: Memory,
    keep_every: int | None = None,
    watch: DivergenceWatch | None = None,
    with_modules: bool = False,
) -> Particles:
    """Repeat a step on checked worlds; return them in the caller's order.

    Args:
        step: What to repeat.
        rules: The rules that it runs.
        worlds: The worlds, in the order that the step takes them in.
        steps: Number of steps T.
        generator: Source of the draws.
        memory: What the backward pass reads is stored or recomputed.
        keep_every: Return the worlds after each so many steps, one after the other in a first
            dimension; None: the last ones.
        watch: What looks at the worlds after each step, or None.
        with_modules: A rule is run as a module, which may draw: recomputed steps draw the same.

    Raises:
        DivergedError: The watch has seen a world diverge.
    """
    interval = STORED_INTERVAL[memory] if torch.is_grad_enabled() else 1
    kept: list[Particles] = []
    # While a graph is recorded, torch's state cannot be read, and its draws are the graph's.
    recorded = worlds.x.is_cuda and torch.cuda.is_current_stream_capturing()
    redraw = with_modules and not recorded
    if with_modules and recorded and not draws_alone():
        # Recomputed, a module that draws would draw otherwise.
        interval = 1
    again = None
    # What a compiler has taken reads copies.
    if interval > 1 and not torch.compiler.is_compiling():
        again = RecomputedSteps(step.advance, rules, {"x": worlds.x, "s": worlds.s})
    # Worlds keep their dtype under autocast: the kernels read what the rules write.
    with torch.autocast(worlds.x.device.type, enabled=False):
        for number, draws in enumerate(step.draws(worlds.x, steps, generator)):
            if (steps - 1 - number) % interval > 0:
                worlds = checkpoint(
                    again or step.advance,
                    *worlds,
                    *draws,
                    use_reentrant=False,
                    preserve_rng_state=redraw,
                )
            else:
                mask, noise, rows, births = draws
                worlds = step.advance(*worlds, mask, noise, rows, births)
            if watch is not None:
                seen = step.ordered(Particles(*(value.detach() for value in worlds)))
                watch.look(seen.x, seen.s)
            if keep_every is not None and (number + 1) % keep_every == 0:
                kept.append(step.ordered(worlds))
        if again is not None:
            again.end_forward()
        if steps == 0:
            # What is returned is the caller's to write to.
            worlds = Particles(*(value.clone() for value in worlds))
        if keep_every is None:
            worlds = step.ordered(worlds)
        else:
            worlds = Particles(*map(torch.stack, zip(*kept, strict=True)))
    if watch is not None:
        watch.raise_diverged()
    return worlds


class RolloutCall(NamedTuple):
    """What a checked call of `rollout` asks for besides its tensors."""

    steps: int
    physics: Physics
    detach_positions: bool
    memory: Memory
    keep_every: int | None

    def run(
        self,
        rules: Sequence[NPARule],
        worlds: Particles,
        generator: Randomness | None,
        watch: DivergenceWatch | None = None,
    ) -> Particles:
        """Launch the rollout of one rule."""
        (rule,) = rules
        physics = self.physics.constants()
        # Any other rule runs as the module that it is.
        network = rule.network()
        if self._stays():
            # Before all else: a rollout in parts prepares the later ones from wrapped positions.
            worlds = worlds._replace(x=wrapped(worlds.x, physics.box))
            static = prepare_static(worlds.x, physics)
        else:
            static = None
        preparable = network is not None and static is None and not rule.divides
        if network is not None and preparable and watch is None and may_prepare(worlds):
            prepared = self._run_prepared(rule, network, worlds, generator)
            if prepared is not None:
                return prepared
        if static is not None:
            worlds = Particles(*map(static.sort, worlds))
        if rule.divides:
            # What lies in dead slots must not reach gradients either: 0 times NaN is NaN.
            blank = torch.where(living(worlds.s)[..., None], worlds.s, 0.0)
            worlds = worlds._replace(s=blank)
        own = RuleStep(rule, network, physics, self.detach_positions, static)
        return run_steps(
            DivisionStep(own) if rule.divides else own,
            rules,
            worlds,
            self.steps,
            generator=generator,
            memory=self.memory,
            keep_every=self.keep_every,
            watch=watch,
            with_modules=network is None,
        )

    def _run_prepared(
        self, rule: NPARule, network: Network, worlds: Particles, generator: Randomness | None
    ) -> Particles | None:
        """Run the rollout by prepared steps; None where it is to be launched."""
        physics, steps, every = self.physics, self.steps, self.keep_every or self.steps
        if physics.position_noise > 0.0 or steps == 0:
            return None
        x, s, _ = worlds

        def advance(network: Network, worlds: Particles, mask: Tensor | None) -> Particles:
            step = RuleStep(rule, network, physics)
            return step.advance(*worlds, mask, None, None, None)

        def make() -> PreparedSteps:
            widths = network.row_width, network.update_width
            return PreparedSteps(advance, worlds, *widths, physics.update_prob < 1.0)

        def run(prepared: PreparedSteps) -> list[Particles]:
            draws = RuleStep(rule, network, physics).draws(x, steps, generator)
            with torch.autocast("cpu", enabled=False):
                return prepared.run(
                    network, worlds, (draw.mask for draw in draws), lambda done: done % every == 0
                )

        key = (physics, rule_form(rule), x.shape, s.shape[2], x.dtype)
        kept = run_prepared(key, make, run)
        if kept is None:
            return None
        if self.keep_every is None:
            return kept[0]
        return Particles(*map(torch.stack, zip(*kept, strict=True)))

    def _stays(self) -> bool:
        """Return whether positions stay where they are, and it pays to prepare them."""
        physics = self.physics
        moving = physics.moving or physics.position_noise > 0.0 or not self.detach_positions
        return not moving and self.steps >= FEWEST_STATIC


def _check_one_species(rule: NPARule) -> None:
    if rule.species_count:
        raise NPAError(
            f"the rule must not perceive species by themselves, got species_count="
            f"{rule.species_count}: run it with npa_envs.rollout_species"
        )


def _resting(rule: NPARule, worlds: Particles, physics: Physics, cuda_graph: CudaGraph) -> Tensor:
    """Return which worlds stay as they are if all particles are updated, bool, shape [B]."""
    call = RolloutCall(1, physics._replace(update_prob=1.0), True, "store", None)
    x, s, _ = worlds
    with torch.no_grad():
        after = run_call(call, (rule,), x, s, None, cuda_graph=cuda_graph, watch=None)
    return (after.x == x).flatten(1).all(dim=1) & (after.s == s).flatten(1).all(dim=1)


def _may_rest(call: RolloutCall, rule: NPARule, x: Tensor) -> bool:
    """Return whether a rollout asks whether its worlds are at rest: their steps are left out."""
    return (
        rule.dead_zone > 0.0
        and rule.has_network()
        and not rule.divides
        and call.steps >= FEWEST_RESTING
        and call.keep_every is None
        and call.physics.position_noise == 0.0
        and not torch.is_grad_enabled()
        and not torch.compiler.is_compiling()
        and not (x.is_cuda and torch.cuda.is_current_stream_capturing())
    )


def _run_until_rest(
    call: RolloutCall,
    rule: NPARule,
    worlds: Particles,
    generator: Randomness | None,
    cuda_graph: CudaGraph,
) -> Particles:
    """Run a rollout in parts, and leave out what comes when all worlds are at rest."""
    left, part = call.steps, FIRST_PART[worlds.x.device.type]
    while left and not _resting(rule, worlds, call.physics, cuda_graph).all():
        own = call._replace(steps=min(part, left))
        x, s, _ = worlds
        worlds = run_call(own, (rule,), x, s, generator, cuda_graph=cuda_graph, watch=None)
        left, part = left - own.steps, 2 * part
        if left and not worlds.x.isfinite().all():
            # A world has diverged, which the next call refuses, and not this one.
            return call._replace(steps=left).run((rule,), worlds, generator)
    # Whoever draws next gets what comes after all steps.
    skip_draws(worlds.x, call.physics, left, generator)
    # What is returned is the caller's to write to.
    return Particles(*(value.clone() for value in worlds)) if left == call.steps else worlds


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


def at_rest(
    rule: NPARule,
    x: Tensor,
    s: Tensor,
    *,
    eps: float | None = None,
    box: Box = None,
    dt: float = 1.0,
) -> Tensor:
    """Return which worlds no step changes any more.

    All particles of such a world are updated at once and stay as they are, so they stay whichever
    of them a step updates. On CUDA in float32 that is exact; elsewhere torch's products over fewer
    rows may round an update otherwise that lies on the edge of the dead zone. Rules with a
    `dead_zone` bring worlds to rest.

    Args:
        rule: The rule, one whose particles do not divide; dtype and device of x.
        x: Particle positions [length units], shape [B, N, D].
        s: Particle states, dimensionless, shape [B, N, C].
        eps: As for `rollout`.
        box: As for `rollout`; in one, only positions within it can be at rest.
        dt: As for `rollout`.

    Returns:
        Bool, shape [B], on x's device.

    Raises:
        NPAError: As `rollout`, or the rule divides.
    """
    check_rule(rule)
    if rule.divides:
        raise NPAError(
            "at_rest is for rules whose particles do not divide, got one with divides=True: its "
            "worlds change by chance"
        )
    _check_one_species(rule)
    made = checked_physics(rule, x, s, eps=eps, box=box, dt=dt)
    return _resting(rule, Particles(x, s, x.new_zeros(x.shape[:2])), made, "auto")


@overload
def rollout(
    rule: NPARule,
    x: Tensor,
    s: Tensor,
    steps: int,
    *,
    update_prob: float = ...,
    return_path_length: Literal[False] = ...,
    **options: Unpack[RolloutOptions],
) -> tuple[Tensor, Tensor]: ...


@overload
def rollout(
    rule: NPARule,
    x: Tensor,
    s: Tensor,
    steps: int,
    *,
    update_prob: float = ...,
    return_path_length: Literal[True],
    **options: Unpack[RolloutOptions],
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

    With gradients disabled, rollouts of 256 steps or more leave out the steps of worlds that a rule
    with a `dead_zone` has brought to rest (`at_rest` tells which those are). They wait for the
    answer at the beginning, and then after 64, 192, 448, ... steps on a CPU and after 1024, 3072,
    ... on CUDA.

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
    _check_one_species(rule)
    made = checked_physics(
        rule, x, s, eps=eps, box=box, update_prob=update_prob, dt=dt, position_noise=position_noise
    )
    detach_positions = checked_flag("detach_positions", detach_positions)
    check_generator(generator, x.device, x.shape[0])
    if rule.divides and made.box is not None:
        raise NPAError(
            f"box must be None where particles divide, got {shown(box)}: the dead need a place far "
            "from all others"
        )
    call = RolloutCall(steps, made, detach_positions, memory, kept)
    watch = make_watch(on_divergence, x, s)
    if watch is None and not return_path_length and _may_rest(call, rule, x):
        worlds = Particles(x, s, x.new_zeros(x.shape[:2]))
        after = _run_until_rest(call, rule, worlds, generator, cuda_graph)
    else:
        after = run_call(call, (rule,), x, s, generator, cuda_graph=cuda_graph, watch=watch)
    return (after.x, after.s, after.path_length) if return_path_length else (after.x, after.s)
