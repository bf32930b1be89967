"""Rollouts: a rule applied to worlds for a number of steps; differentiable."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, get_args

from torch import Tensor

from npa_envs.checks import (
    Box,
    check_world,
    checked_choice,
    checked_count,
    checked_flag,
    checked_once,
)
from npa_envs.errors import NPAError, shown
from npa_envs.ops.custom_op import check_derivatives
from npa_envs.ops.physics import Boundary, Physics, make_physics
from npa_envs.rule.rule import NPARule, check_rule
from npa_envs.world.capture_cache import CUDA_GRAPH_CHOICES, CudaGraph
from npa_envs.world.divergence import OnDivergence, make_watch
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import Randomness, check_generator
from npa_envs.world.rollout_execution import Memory, RolloutSpec, execute, resting
from npa_envs.world.steps import SpeciesSpec

__all__ = ["Memory", "at_rest", "rollout", "step"]


def checked_physics(rule: NPARule, worlds: Particles, **options: Any) -> Physics:
    """Check that worlds fit a rule and the options are allowed; return the rollout's constants.

    The options are those of `make_physics` that are not the rule's.
    """
    x, s, *_ = worlds
    of_rule = rule.space_dim, rule.state_dim, rule.eps0, rule.terms, rule.static, rule.alpha
    constants = _physics(x, s, rule.hidden.weight, *of_rule, **options)
    check_derivatives(x=x, s=s, rule=rule)
    return constants


@checked_once
def _physics(x: Tensor, s: Tensor, weight: Tensor, *of_rule: Any, **options: Any) -> Physics:
    space_dim, state_dim, eps0, terms, static, alpha = of_rule
    check_world(x, s)
    if (x.shape[2], s.shape[2]) != (space_dim, state_dim):
        raise NPAError(
            f"x and s must have the rule's {space_dim} coordinates and {state_dim} "
            f"channels, got {tuple(x.shape)} and {tuple(s.shape)}: for example "
            f"s = torch.zeros(*x.shape[:2], {state_dim})"
        )
    if weight.dtype != x.dtype or weight.device != x.device:
        raise NPAError(
            f"the rule must share dtype and device with x, got {weight.dtype} on {weight.device} "
            f"and {x.dtype} on {x.device}: move it with rule.to(x)"
        )
    options = {"eps": None, "terms": terms, "moving": not static, "alpha": alpha} | options
    return make_physics(space_dim, state_dim, x.dtype, eps0=eps0, **options)


def _check_rule_of_one_species(rule: NPARule) -> None:
    check_rule(rule)
    if rule.species_count:
        raise NPAError(
            f"the rule must not perceive species separately, got species_count="
            f"{rule.species_count}: run it with npa_envs.rollout_species"
        )


def returned_fields(after: Particles) -> tuple[Tensor, ...]:
    """Return x, s and, unless they are None, path lengths."""
    return (after.x, after.s) if after.path_length is None else (*after.per_particle(),)


def step(
    rule: NPARule,
    x: Tensor,
    s: Tensor,
    *,
    eps: float | None = None,
    box: Box = None,
    boundary: Boundary | None = None,
    update_prob: float = 0.5,
    dt: float = 1.0,
    position_noise: float = 0.0,
    detach_positions: bool = True,
    generator: Randomness | None = None,
    on_divergence: OnDivergence = "ignore",
    cuda_graph: CudaGraph = "auto",
) -> tuple[Tensor, Tensor]:
    """Advance worlds by one step: `rollout` with steps=1, whose arguments and errors it has.

    Returns:
        Positions [length units], shape [B, N, D], and states, dimensionless, shape [B, N, C].
    """
    after = rollout_particles(
        rule,
        Particles(x, s),
        1,
        eps=eps,
        box=box,
        boundary=boundary,
        update_prob=update_prob,
        dt=dt,
        position_noise=position_noise,
        detach_positions=detach_positions,
        generator=generator,
        on_divergence=on_divergence,
        cuda_graph=cuda_graph,
    )
    return after.x, after.s


def at_rest(
    rule: NPARule,
    x: Tensor,
    s: Tensor,
    *,
    eps: float | None = None,
    box: Box = None,
    boundary: Boundary | None = None,
    dt: float = 1.0,
) -> Tensor:
    """Return which worlds are not changed by any further step.

    A world is at rest if an update of all its particles changes none of them; then an update of
    some changes none either. On CUDA in float32 that is exact; elsewhere torch's products over
    fewer rows may round an update at the edge of the dead zone differently. Rules with a
    `dead_zone` bring worlds to rest.

    All other arguments and errors are those of `rollout`.

    Args:
        rule: The rule, one whose particles do not divide; dtype and device of x.
        box: As for `rollout`; in one, only positions within it can be at rest.

    Returns:
        Bool, shape [B], on x's device.

    Raises:
        NPAError: As `rollout`, or the rule divides.
    """
    _check_rule_of_one_species(rule)
    if rule.divides:
        raise NPAError(
            "at_rest is for rules whose particles do not divide, got one with divides=True: its "
            "worlds change by chance"
        )
    worlds = Particles(x, s)
    constants = checked_physics(rule, worlds, eps=eps, box=box, boundary=boundary, dt=dt)
    return resting((rule,), worlds, constants, "auto")


def rollout(
    rule: NPARule,
    x: Tensor,
    s: Tensor,
    steps: int,
    *,
    eps: float | None = None,
    box: Box = None,
    boundary: Boundary | None = None,
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
) -> tuple[Tensor, ...]:
    """Run a rule for a number of steps; differentiable, and particle i stays particle i.

    Each step draws m ~ Bernoulli(update_prob) for every particle, perceives the particles with
    m = 1 and updates them: x ← x + m dt Δx (+ noise), s ← s + m dt Δs, with
    Δx = alpha eps δ / (1 + |δ|) and [δ ; Δs] = rule(z) (arXiv 2601.16096, section 3).

    With gradients disabled, rollouts of 256 steps or more skip the steps of worlds that a rule with
    a `dead_zone` has brought to rest, as `at_rest` returns. They check, and wait for the device, at
    the beginning and after 64, 192, 448, ... steps on a CPU, after 1024, 3072, ... on CUDA.

    With a rule that `divides`, particle i is slot i, whose particle may die and be replaced by
    another one's child (`npa_envs.world.division`).

    Args:
        rule: The rule; dtype and device of x.
        x: Particle positions [length units], shape [B, N, D].
        s: Particle states, dimensionless, shape [B, N, C].
        steps: Number of steps T, 0 or more.
        eps: Perception radius [length units]; default: the rule's eps0.
        box: Sides of a box centred on the origin [length units], or None for open space.
        boundary: "periodic": particles perceive nearest images, and positions are wrapped.
            "reflecting": particles perceive as in open space, and positions beyond a wall of the
            box are mirrored at it, repeatedly if needed. "open": there is no box. Default:
            "periodic" with a box, "open" without one.
        update_prob: Probability p of each particle's update in a step, in (0, 1].
        dt: Time step, dimensionless.
        position_noise: Standard deviation of the noise added to every position in each step
            [length units].
        detach_positions: Perception does not back-propagate into positions (the paper's choice): a
            gradient by x is then a partial one. The moment correction has none in any case.
        memory: "store" stores all tensors of the backward pass. "recompute" recomputes two steps in
            three: about half the memory, and the time of two thirds of a forward pass more.
            "minimal" recomputes all but the last step: least memory, and the time of a forward pass
            more. Gradients are the same.
        generator: Source of the masks and the noise, on x's device; default: torch's global one. A
            `WorldRandom` advances by one step before each step, so that every world draws the same
            numbers as in a batch of one.
        on_divergence: What to do if values of a world become infinite or NaN. "ignore" costs
            nothing; the next call raises an error for such positions. "raise" checks each step on
            the device, and waits for the result once, at the end.
        keep_every: Return the worlds after every so many steps, a divisor of `steps`: the
            trajectory. Results have one more dimension at the front, of size steps / keep_every.
        cuda_graph: On CUDA, replay repeated calls instead of launching their kernels one by one.
            That takes a tenth of the CPU time, and results are the same. "auto" captures from the
            third call with the same shapes and options on. A network of one's own must then be a
            function of perception, parameters and buffers, as its Python code no longer runs; it is
            launched if its first replay gives other numbers. True captures from the second call on,
            also rules with hooks; False captures nothing: see docs/performance.md. "whole" is
            "auto", but one kernel runs all steps of many small worlds, with other roundings: see
            `npa_envs/ops/backend.py`.
        return_path_length: Also return the length of each particle's path.

    Returns:
        Positions [length units], shape [B, N, D]; states, dimensionless, shape [B, N, C]; and where
        asked the length of each particle's path [length units], shape [B, N].

    Raises:
        NPAError: Shapes, dtypes or devices do not fit each other or the rule, a position is not
            finite (only `on_divergence="raise"` checks states), or a number is out of its range.
        DivergedError: A world diverged and `on_divergence` is "raise"; the message says which, in
            which step, and which number of which particle.
    """
    after = rollout_particles(
        rule,
        Particles(x, s),
        steps,
        eps=eps,
        box=box,
        boundary=boundary,
        update_prob=update_prob,
        dt=dt,
        position_noise=position_noise,
        detach_positions=detach_positions,
        memory=memory,
        generator=generator,
        on_divergence=on_divergence,
        keep_every=keep_every,
        cuda_graph=cuda_graph,
        return_path_length=return_path_length,
    )
    return returned_fields(after)


def take_physics(options: dict[str, Any]) -> dict[str, Any]:
    """Remove a rollout's options of physics that all species share from `options`; return them."""
    names = ("eps", "box", "boundary", "dt", "position_noise")
    return {name: options.pop(name) for name in names if name in options}


def rollout_particles(
    rule: NPARule, worlds: Particles, steps: int, *, update_prob: float = 0.5, **options: Any
) -> Particles:
    """Run a rule as `rollout` does, with its options; return worlds with all their fields."""
    _check_rule_of_one_species(rule)
    physics = take_physics(options)
    constants = checked_physics(rule, worlds, update_prob=update_prob, **physics)
    box = physics.get("box")
    if rule.divides and box is not None:
        raise NPAError(
            f"box must be None where particles divide, got {shown(box)}: the dead need a place far "
            "from all others"
        )
    return run_rules((rule,), worlds, steps, constants, **options)


def run_rules(
    rules: Sequence[NPARule],
    worlds: Particles,
    steps: int,
    constants: Physics,
    species: Sequence[SpeciesSpec] = (),
    *,
    per_species: bool = False,
    world_by_world: bool = False,
    detach_positions: bool = True,
    memory: Memory = "store",
    generator: Randomness | None = None,
    on_divergence: OnDivergence = "ignore",
    keep_every: int | None = None,
    cuda_graph: CudaGraph = "auto",
    return_path_length: bool = False,
) -> Particles:
    """Check the options of a rollout and run it; path lengths are None unless asked for."""
    options = steps, constants, detach_positions, memory, keep_every, per_species, world_by_world
    spec = _checked_spec(*options)
    if species:
        # Not by `_replace`, which torch.compile cannot trace.
        spec = RolloutSpec(*spec[:5], tuple(species), *spec[6:])
    checked_choice("cuda_graph", cuda_graph, CUDA_GRAPH_CHOICES)
    check_generator(generator, worlds.x.device, worlds.x.shape[0])
    after = execute(
        spec,
        rules,
        worlds.with_fields(goal=None),
        generator,
        cuda_graph=cuda_graph,
        watch=make_watch(on_divergence, worlds),
        with_paths=return_path_length,
    )
    path_length = after.path_length if return_path_length else None
    return after.with_fields(path_length=path_length, goal=worlds.goal)


@checked_once
def _checked_spec(
    steps: int,
    constants: Physics,
    detach_positions: bool,
    memory: Memory,
    keep_every: int | None,
    *of_species: bool,
) -> RolloutSpec:
    """Return the options of a rollout of one species after checking them."""
    steps = checked_count("steps", steps)
    if keep_every is not None:
        keep_every = checked_count("keep_every", keep_every)
        if keep_every == 0 or steps == 0 or steps % keep_every:
            raise NPAError(
                f"steps must be a multiple of keep_every, got {steps} and {keep_every}: the last "
                f"world kept is the one at the end"
            )
    checked_choice("memory", memory, get_args(Memory))
    detached = checked_flag("detach_positions", detach_positions)
    return RolloutSpec(steps, constants, detached, memory, keep_every, (), *of_species)
