"""Checks of perception where it is hard. The docstring of a check is the result that it expects."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import torch
from torch import Tensor

from npa_envs import reference
from npa_envs.errors import NPAError
from npa_envs.measure.accuracy.check_runner import Check, CheckResult, CheckSession, check
from npa_envs.measure.accuracy.scenes import (
    EPS,
    LIMITS,
    PRECISIONS,
    SIDE,
    STATE_DIM,
    PerceptionOutcome,
    Scene,
    against_reference,
    differing,
    error_limits,
    functional_weights,
    not_finite,
    perceived,
    perception_errors,
    relative_error,
    scenes,
    states_at,
    threshold_scenes,
)
from npa_envs.ops import perceive, perception_fields
from npa_envs.rule.files import load_rule
from npa_envs.rule.rule import LIFE, NPARule
from npa_envs.world.division import living
from npa_envs.world.rollout import rollout

NEAR_THRESHOLD = 1e-3
"""Within this relative distance from the threshold, perception must change by twice it at most."""


def scene_checks() -> list[Check]:
    """Return a check of each `Scene`: perception and its gradients against the reference."""
    return [
        Check(
            f"geometry/{scene.name}/{space_dim}d/{'periodic' if periodic else 'open'}",
            f"{scene.summary}: all is finite, as the float64 reference has it",
            partial(_run_scene, scene),
        )
        for space_dim in (2, 3)
        for periodic in (False, True)
        for scene in scenes(space_dim, periodic=periodic)
    ]


def _run_scene(scene: Scene, session: CheckSession) -> CheckResult:
    expected = perceived(scene.x, scene.s, scene.box, by_reference=True)
    metrics: dict[str, float] = {}
    for name, dtype in PRECISIONS.items():
        x, s = (tensor.to(session.device, dtype) for tensor in (scene.x, scene.s))
        metrics |= perception_errors(perceived(x, s, scene.box), expected, name)
    return CheckResult(metrics, error_limits(scene.x, scene.s, scene.box, expected))


@check("geometry/threshold", 2, 3)
def _run_threshold(space_dim: int, session: CheckSession) -> CheckResult:
    """A moment matrix near the threshold of its inverse is either inverted or not inverted."""
    x, offsets = threshold_scenes(space_dim, reference.MOMENT_THRESHOLD)
    s = states_at(x)
    fields = reference.fields(x, s, EPS)
    corrected = fields.grad0 @ torch.linalg.pinv(fields.moment)
    right = reference.perceive(x, s, EPS, EPS)
    on_other_side = right.clone()
    start, end = 2 * STATE_DIM, (2 + space_dim) * STATE_DIM
    inverted = torch.linalg.det(fields.moment).abs() >= reference.MOMENT_THRESHOLD
    other = torch.where(inverted[..., None, None], fields.grad0, corrected)
    on_other_side[..., start:end] = reference.log_scale(other).flatten(2)
    metrics, limits = {}, {}
    for name, dtype in PRECISIONS.items():
        z = perceive(x.to(session.device, dtype), s.to(session.device, dtype), EPS).cpu().double()
        # Either result is right for a determinant that rounding may move over the threshold.
        near = offsets.abs() <= 1e2 * torch.finfo(dtype).eps / reference.MOMENT_THRESHOLD
        errors, errors_of_other = (
            ((z - exact).norm(dim=-1) / exact.norm(dim=-1))[:, 0]
            for exact in (right, on_other_side)
        )
        corner = torch.where(near, torch.minimum(errors, errors_of_other), errors)
        metrics[f"z_{name}"] = float(corner.max())
        limits[f"z_{name}"] = LIMITS[f"z_{name}"]
    return CheckResult(metrics, limits)


@check("geometry/smooth_inverse", 2, 3)
def _run_smooth_inverse(space_dim: int, session: CheckSession) -> CheckResult:
    """With moment_inverse='smooth' perception matches the float64 reference, and is continuous at
    the determinant where the inverse with a threshold jumps."""
    x, offsets = threshold_scenes(space_dim, reference.MOMENT_THRESHOLD)
    # The same states in all worlds, so that only the determinant differs.
    s = states_at(x)[:1].expand(len(x), -1, -1)
    exact = reference.perceive(x, s, EPS, EPS, moment_inverse="smooth")
    near = offsets.abs() <= NEAR_THRESHOLD
    metrics: dict[str, float] = {}
    limits: dict[str, float] = {}
    for name, dtype in PRECISIONS.items():
        y, u = (tensor.to(session.device, dtype) for tensor in (x, s))
        smooth = perceive(y, u, EPS, moment_inverse="smooth").cpu().double()
        metrics[f"z_{name}"] = relative_error(smooth, exact)
        corner = smooth[near, 0]
        jump = corner.diff(dim=0).norm(dim=-1).max() / corner.norm(dim=-1).max()
        metrics[f"jump_{name}"] = float(jump)
        limits |= {f"z_{name}": LIMITS[f"z_{name}"], f"jump_{name}": 2.0 * NEAR_THRESHOLD}
    return CheckResult(metrics, limits)


@check("geometry/crowd", 2, 3)
def _run_crowd(space_dim: int, session: CheckSession) -> CheckResult:
    """With very many particles in one cell, densities match float64, all numbers are finite, and
    the gradient of the smoothed states' sum by each state is 1."""
    count, sampled = 2_000 if session.quick else 1_000_000 if session.cuda else 20_000, 32
    generator = torch.Generator().manual_seed(0)
    x = 0.01 + (torch.rand(1, count, space_dim, generator=generator) - 0.5) * (EPS / 4.0)
    s = torch.randn(1, count, 4, generator=generator)
    x, s = x.to(session.device), s.to(session.device).requires_grad_()
    rho = perception_fields(x, s, EPS).rho[0]
    z = perceive(x, s, EPS)
    (by_states,) = torch.autograd.grad(z[..., 4:8].sum(), s)
    away = x[0, :sampled, None].double() - x[0].double()
    weight = reference.smoothing_kernel(away.square().sum(-1), EPS, space_dim)
    exact = weight.sum(1)
    smoothed_state = weight @ (s.detach()[0].double() / rho.double()[:, None])
    # Σ_i of the smoothed states is Σ_j v_j s_j Σ_i W_ij = Σ_j s_j, so its gradient is 1 everywhere.
    # Sums of N terms of one sign have rounding errors of about √N roundings.
    limit = 4.0 * count**0.5 * 2.0**-24
    return CheckResult(
        {
            "not_finite": not_finite((rho, z, by_states)),
            "density": float(((rho[:sampled].double() - exact) / exact).abs().max()),
            "smoothed": relative_error(z[:, :sampled, 4:8], smoothed_state[None]),
            "adjoint": float((by_states.double() - 1.0).abs().max()),
        },
        {"not_finite": 0.0, "density": limit, "smoothed": limit, "adjoint": limit},
    )


@check("geometry/nearest", 2, 3)
def _run_nearest(space_dim: int, session: CheckSession) -> CheckResult:
    """Two particles at least 1e-19 length units apart (float32) are perceived as two, closer ones
    as coincident; all numbers are finite down to denormal distances."""
    broken, holds = 0.0, 0
    s = states_at(torch.empty(1, 2, space_dim))
    for power in range(1, 45):
        x = torch.zeros(1, 2, space_dim)
        x[0, 1, 0] = 10.0**-power if power > 1 else 0.5 * EPS
        outcome, expected = against_reference(x, s, None, session.device)
        broken += not_finite(outcome)
        errors = perception_errors(outcome, expected)
        if holds == power - 1 and all(error <= LIMITS[name] for name, error in errors.items()):
            holds = power
    metrics = {"not_finite": broken, "nearest": 10.0**-holds}
    limits = {"not_finite": 0.0, "nearest": 1e-19 * (1.0 + 1e-9)}
    return CheckResult(metrics, limits, holds=f"float32: from 1e-{holds} on")


@check("geometry/outside", 2, 3)
def _run_outside(space_dim: int, session: CheckSession) -> CheckResult:
    """Particles outside of a periodic box are perceived as their images inside, up to the rounding
    of their float32 coordinates; all numbers are finite."""
    generator = torch.Generator().manual_seed(0)
    inside = (torch.rand(1, 60, space_dim, generator=generator) - 0.5) * SIDE
    s = torch.randn(1, 60, STATE_DIM, generator=generator)
    box = (SIDE,) * space_dim
    metrics: dict[str, float] = {}
    limits = {"not_finite": 0.0}
    broken, farthest = 0.0, 0.0
    for offset in (0.0, 1.0, 10.0, 1e2, 1e3, 1e4, 1e6, 1e12, 1e30):
        x = inside.clone()
        x[:, ::2, 0] += offset
        # The reference has the images of coordinates rounded to float32.
        outcome, expected = against_reference(x, s, box, session.device)
        broken += not_finite(outcome)
        if offset <= 1e4:
            metrics[f"z_{offset:g}"] = error = relative_error(outcome.z, expected.z)
            allowed = error_limits(x.double(), s.double(), box, expected)
            limits[f"z_{offset:g}"] = allowed["z_float32"]
            farthest = offset if error <= 1e-3 else farthest
    metrics["not_finite"] = broken
    return CheckResult(
        metrics, limits, holds=f"float32: z within 1e-3 up to {farthest:g} sides away"
    )


# The group `values`: unusual states, which must not affect other worlds.

POWERS = range(-30, 31, 2)
"""Powers of ten by which states are multiplied."""

WORLD, OTHER_WORLDS, PARTICLE = 1, [0, 2], 7
"""Index of the world with a broken particle, of the other worlds, and of the particle."""

WORLD_COUNT, PARTICLE_COUNT, NAN_STEPS = 3, 150, 8
"""Numbers of worlds and of particles in each, and steps of a rollout that starts with a NaN."""


def _worlds(session: CheckSession, space_dim: int, state_dim: int) -> tuple[Tensor, Tensor]:
    """Return positions and states of worlds in two distant halves; particles have 20 neighbours."""
    generator = torch.Generator().manual_seed(0)
    shape = (WORLD_COUNT, PARTICLE_COUNT)
    side = EPS * (3.0 if space_dim == 2 else 2.4)
    x = torch.rand(*shape, space_dim, generator=generator) * side
    x[:, PARTICLE_COUNT // 2 :, 0] += 2.0
    s = 0.5 * torch.randn(*shape, state_dim, generator=generator)
    return x.to(session.device), s.to(session.device)


@check("values/scale", 2, 3)
def _run_scale(space_dim: int, session: CheckSession) -> CheckResult:
    """Perception and gradients of states of 1e-30 to 1e30 match the float64 reference; the largest
    scale up to which they do is reported."""
    x, s = (tensor[:1] for tensor in _worlds(session, space_dim, STATE_DIM))
    right = []
    for power in POWERS:
        scaled = s * 10.0**power
        errors = perception_errors(*against_reference(x, scaled, None, session.device))
        if all(error <= LIMITS[name] for name, error in errors.items()):
            right.append(power)
    low = POWERS[0]
    largest = max((p for p in right if set(range(low, p, 2)) <= set(right)), default=low)
    text = f"float32: states of 1e{low} to 1e{largest:+d}"
    return CheckResult({"wrong": float(len(POWERS) - len(right))}, {"wrong": 0.0}, holds=text)


@check("values/infinite_channel", 2, 3)
def _run_infinite_channel(space_dim: int, session: CheckSession) -> CheckResult:
    """A channel that is infinite at one particle changes no bit of other channels, of particles
    that do not perceive it, and of other worlds."""
    x, s = _worlds(session, space_dim, 16)
    clean = perceive(x, s, EPS)
    broken = s.clone()
    broken[WORLD, PARTICLE, 2] = math.inf
    z = perceive(x, broken, EPS)
    gradients = torch.arange(32, 32 + 16 * space_dim).view(16, space_dim)
    touched = torch.zeros(z.shape[2], dtype=torch.bool)
    touched[[2, 18, *gradients[2].tolist()]] = True
    touched = touched.to(z.device)
    away = (x[WORLD] - x[WORLD, PARTICLE]).norm(dim=-1) > EPS
    metrics = {
        "other_worlds": differing(z[OTHER_WORLDS], clean[OTHER_WORLDS]),
        "other_channels": differing(z[..., ~touched], clean[..., ~touched]),
        "out_of_sight": differing(z[WORLD, away], clean[WORLD, away]),
    }
    return CheckResult(metrics, dict.fromkeys(metrics, 0.0))


@check("values/dead", 2, 3)
@torch.no_grad()
def _run_dead(space_dim: int, session: CheckSession) -> CheckResult:
    """Numbers in the slots of dead particles, also NaN, change no bit of a rollout; one particle
    that divides fills its world, whose numbers stay finite."""
    torch.manual_seed(0)
    rule = NPARule(space_dim, STATE_DIM, eps0=EPS, divides=True).to(session.device)
    x, s = _worlds(session, space_dim, STATE_DIM)
    x, s = torch.zeros_like(x), torch.zeros_like(s)
    s[:, 0, LIFE] = 1.0
    other_x, other_s = _worlds(session, space_dim, STATE_DIM)
    other_s[:] = math.nan
    other_x[:, 0], other_s[:, 0] = x[:, 0], s[:, 0]
    steps = 100 if session.quick else 10_000
    clean, filled = (
        rollout(rule, *worlds, steps, generator=session.generator())
        for worlds in ((x, s), (other_x, other_s))
    )
    metrics = {
        "x": differing(filled[0], clean[0]),
        "s": differing(filled[1], clean[1]),
        "not_finite": not_finite(clean),
        "empty_slots": float((~living(clean[1])).sum(dim=1).max()),
    }
    # A few die at any time.
    return CheckResult(metrics, {"x": 0.0, "s": 0.0, "not_finite": 0.0, "empty_slots": 5.0})


@check("values/gradient_of_nan")
def _run_gradient(session: CheckSession) -> CheckResult:
    """Cotangents and states that are NaN in one world change no bit of other worlds' gradients
    by states and positions."""
    x, s = _worlds(session, 2, 16)
    broken, weights = s.clone(), functional_weights(x, s)
    broken[WORLD, PARTICLE, 0] = math.nan
    clean = perceived(x, s, None, weights=weights)
    weights[WORLD, PARTICLE + 1] = math.nan
    result = perceived(x, broken, None, weights=weights)
    metrics = {
        "states": differing(result.states[OTHER_WORLDS], clean.states[OTHER_WORLDS]),
        "positions": differing(result.positions[OTHER_WORLDS], clean.positions[OTHER_WORLDS]),
    }
    return CheckResult(metrics, dict.fromkeys(metrics, 0.0))


@check("values/nan_state")
@torch.no_grad()
def _run_nan_state(session: CheckSession) -> CheckResult:
    """NaN in one state spreads in its own world only; other worlds' rollouts keep every bit."""
    rule = load_rule("gecko", device=session.device).float()
    x, clean = _worlds(session, 2, rule.state_dim)
    with_nan = clean.clone()
    with_nan[WORLD, PARTICLE, 0] = math.nan
    (x, s), (clean_x, clean_s) = (
        rollout(rule, x, states, NAN_STEPS, generator=session.generator())
        for states in (with_nan, clean)
    )
    broken = (~s[WORLD].isfinite()).any(-1) | (~x[WORLD].isfinite()).any(-1)
    away = (clean_x[WORLD] - clean_x[WORLD, PARTICLE]).norm(dim=-1) > (2 * NAN_STEPS) * EPS
    metrics = {
        "other_worlds_x": differing(x[OTHER_WORLDS], clean_x[OTHER_WORLDS]),
        "other_worlds_s": differing(s[OTHER_WORLDS], clean_s[OTHER_WORLDS]),
        "out_of_reach": float((broken & away).sum()),
        "not_found": float(not bool(broken.any())),
    }
    return CheckResult(metrics, dict.fromkeys(metrics, 0.0))


@check("values/nan_position")
def _run_nan_position(session: CheckSession) -> CheckResult:
    """A position that is NaN is rejected, by an error that names its world and particle."""
    rule = load_rule("gecko", device=session.device).float()
    x, s = _worlds(session, 2, rule.state_dim)
    x[WORLD, PARTICLE, 1] = math.nan
    calls: dict[str, Callable[[], Any]] = {
        "perceive": partial(perceive, x, s, EPS),
        "rollout": partial(rollout, rule, x, s, 1),
    }
    metrics = {}
    for name, call in calls.items():
        try:
            call()
            metrics[name] = 1.0
        except NPAError as error:
            metrics[name] = float(f"world {WORLD}, particle {PARTICLE}" not in str(error))
    return CheckResult(metrics, dict.fromkeys(metrics, 0.0))


# The group `gradients`: finite differences.


@check("gradients/finite_differences", *itertools.product((2, 3), (False, True)))
def _run_differences(space_dim: int, periodic: bool, session: CheckSession) -> CheckResult:
    """In float64, derivatives along smooth motions and along random states agree with finite
    differences, in every hard scene."""
    metrics = {}
    for scene in scenes(space_dim, periodic=periodic):
        for what in ("states", "positions"):
            # Far from 0 floating-point numbers are too sparse.
            if (scene.name, what) != ("far", "positions"):
                metrics[f"{scene.name}_{what}"] = _difference(scene, session, what)
    return CheckResult(metrics, dict.fromkeys(metrics, 1e-6))


def _difference(scene: Scene, session: CheckSession, what: str) -> float:
    """Return the relative error of a directional derivative against a finite difference.

    The derivative is by `what`, "states" or "positions". Positions move along a smooth periodic
    field that is 0 at the origin, so that coincident particles stay together. Perception is without
    moment correction, through which no gradient flows.
    """
    x, s = scene.x.to(session.device), scene.s.to(session.device)
    weights = functional_weights(x, s)
    generator = torch.Generator().manual_seed(6)
    if what == "states":
        along = torch.randn(s.shape, generator=generator).to(s)
    else:
        mixing = torch.randn(x.shape[2], x.shape[2], generator=generator).to(x)
        along = torch.sin(2.0 * math.pi * x / (scene.box[0] if scene.box else SIDE)) @ mixing * EPS

    def functional(varied: Tensor) -> Tensor:
        worlds = (x, varied) if what == "states" else (varied, s)
        z = perceive(*worlds, EPS, EPS, scene.box, detach_positions=False, moment_correction=False)
        return (z * weights).sum()

    start = s if what == "states" else x
    # Second derivatives jump at ε, which causes an error in proportion to `change`.
    change = 1e-7
    rise = functional(start + change * along) - functional(start - change * along)
    quotient = float(rise) / (2.0 * change)
    varied = start.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(functional(varied), varied)
    slope = float((gradient * along).sum())
    # The terms may cancel, so the error is relative to the sum of their absolute values.
    size = float((gradient * along).abs().sum())
    return abs(slope - quotient) / size if size > 0.0 else abs(quotient)


# The group `precision`: changes that must have little or no effect.

TWO_ERRORS = 2.0
"""Maximum distance of two results / the error that the group `geometry` allows for one."""


def _every_scene(space_dim: int, session: CheckSession) -> Iterator[tuple[Scene, Tensor, Tensor]]:
    """Yield every scene, and its positions and states in float32 on the session's device."""
    for periodic in (False, True):
        for scene in scenes(space_dim, periodic=periodic):
            x, s = (tensor.to(session.device, torch.float32) for tensor in (scene.x, scene.s))
            yield scene, x, s


@check("precision/order", 2, 3)
def _run_order(space_dim: int, session: CheckSession) -> CheckResult:
    """Particles in another order perceive the same up to rounding, in every hard scene."""
    worst, wrong = [], []
    for scene, x, s in _every_scene(space_dim, session):
        order = torch.randperm(x.shape[1], generator=torch.Generator().manual_seed(7))
        order = order.to(session.device)
        weights = functional_weights(x, s)
        moved = perceived(x[:, order], s[:, order], scene.box, weights=weights[:, order])
        back = PerceptionOutcome(*(tensor[:, order.argsort()] for tensor in moved))
        distances = perception_errors(back, perceived(x, s, scene.box, weights=weights))
        exact = perceived(scene.x, scene.s, scene.box, by_reference=True)
        allowed = error_limits(scene.x, scene.s, scene.box, exact)
        # max() of a tensor never ignores NaN.
        worst.append(torch.tensor([distances[key] / allowed[key] for key in distances]).max())
        if not worst[-1] <= TWO_ERRORS:
            wrong.append(f"{scene.name}/{'open' if scene.box is None else 'periodic'}")
    return CheckResult(
        {"over_allowed_error": float(torch.stack(worst).max())},
        {"over_allowed_error": TWO_ERRORS},
        note=f"too far apart: {', '.join(wrong)}" if wrong else "",
    )


@check("precision/repeated", 2, 3)
def _run_repeated(space_dim: int, session: CheckSession) -> CheckResult:
    """Perception and gradients of every hard scene are the same bits when repeated."""
    metrics = dict.fromkeys(PerceptionOutcome._fields, 0.0)
    for scene, x, s in _every_scene(space_dim, session):
        first, second = (perceived(x, s, scene.box) for _ in range(2))
        for what, a, b in zip(PerceptionOutcome._fields, first, second, strict=True):
            metrics[what] += differing(a, b)
    return CheckResult(metrics, dict.fromkeys(metrics, 0.0))


@check("precision/batch", 2, 3)
def _run_batch(space_dim: int, session: CheckSession) -> CheckResult:
    """Each world of a batch gets bit for bit the perception that it gets alone."""
    metrics = {"open": 0.0, "periodic": 0.0}
    for periodic in (False, True):
        every = scenes(space_dim, periodic=periodic)
        batch = [scene for scene in every if scene.name != "tight_box"]
        # Repeat each scene's particles until all worlds have equally many.
        count = max(scene.x.shape[1] for scene in batch)
        x = torch.cat([scene.x.repeat(1, count, 1)[:, :count] for scene in batch])
        x, s = (tensor.to(session.device, torch.float32) for tensor in (x, states_at(x)))
        together = perceive(x, s, EPS, box=batch[0].box)
        for k in range(len(x)):
            alone = perceive(x[k : k + 1], s[k : k + 1], EPS, box=batch[0].box)
            metrics["periodic" if periodic else "open"] += differing(together[k], alone[0])
    return CheckResult(metrics, dict.fromkeys(metrics, 0.0))
