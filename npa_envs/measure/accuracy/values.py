"""Hard values of states: tiny, huge, infinite, no number; none may reach another world."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.measure.accuracy.checks import Check, Finding, Session, in_2d_and_3d
from npa_envs.measure.accuracy.scenes import EPS, LIMITS, STATE_DIM, perceived, relative_error
from npa_envs.ops import perceive
from npa_envs.rule.files import load_rule
from npa_envs.world.rollout import rollout

POWERS = range(-30, 31, 2)
"""Scales of states that are tried, as powers of ten."""

SAFE_POWERS = (-30, 30)
"""Scales within which nothing may go wrong in float32."""

WORLD, PARTICLE = 1, 7
"""The particle that something is wrong with, and its world, of `WORLD_COUNT`."""

WORLD_COUNT, PARTICLE_COUNT, STEPS = 3, 150, 8


def values_checks() -> list[Check]:
    """Return the checks of the group `values`."""
    by_dimension = {
        "scale": (
            "states of 1e-30 to 1e30 are perceived as the float64 reference has them, forwards and "
            "backwards; beyond, the largest scale is told",
            _run_scale,
        ),
        "infinite_channel": (
            "a channel that is infinite at one particle changes no bit of other channels, of "
            "particles that do not see it, and of other worlds",
            _run_infinite_channel,
        ),
    }
    return [
        *in_2d_and_3d("values", by_dimension),
        Check(
            "values/gradient_of_nan",
            "cotangents and states that are NaN in one world change no bit of other worlds' "
            "gradients by states and positions",
            _run_gradient,
        ),
        Check(
            "values/nan_state",
            "NaN in one state spreads in its own world only; other worlds' rollouts keep every bit",
            _run_nan_state,
        ),
        Check(
            "values/nan_position",
            "a position that is NaN is refused, by an error that names its world and particle",
            _run_nan_position,
        ),
        Check(
            "values/blown_up",
            "positions that a rollout has made NaN are reported by the next call, with their world",
            _run_blown_up,
        ),
    ]


def _worlds(session: Session, space_dim: int, state_dim: int) -> tuple[Tensor, Tensor]:
    """Return worlds with about 20 neighbours, half of them out of sight of the other half."""
    generator = torch.Generator().manual_seed(session.seed)
    shape = (WORLD_COUNT, PARTICLE_COUNT)
    side = EPS * (3.0 if space_dim == 2 else 2.4)
    x = torch.rand(*shape, space_dim, generator=generator) * side
    x[:, PARTICLE_COUNT // 2 :, 0] += 2.0
    s = 0.5 * torch.randn(*shape, state_dim, generator=generator)
    return x.to(session.device), s.to(session.device)


def differing(value: Tensor, expected: Tensor) -> float:
    """Return how many numbers of two tensors are not the same; NaN is the same as NaN."""
    same = (value == expected) | (value.isnan() & expected.isnan())
    return float((~same).sum())


def _run_scale(space_dim: int, session: Session) -> Finding:
    x, s = (tensor[:1] for tensor in _worlds(session, space_dim, STATE_DIM))
    figures = {}
    right = []
    for power in POWERS:
        scaled = s * 10.0**power
        found = perceived(x, scaled, None)
        expected = perceived(x.cpu().double(), scaled.cpu().double(), None, by_reference=True)
        names = [f"{what}_float32" for what in found._fields]
        errors = [relative_error(a, b) for a, b in zip(found, expected, strict=True)]
        figures[f"z_1e{power:+d}"] = errors[0]
        if all(error <= LIMITS[name] for error, name in zip(errors, names, strict=True)):
            right.append(power)
    low, high = SAFE_POWERS
    figures["wrong"] = float(sum(low <= power <= high and power not in right for power in POWERS))
    largest = max(
        (power for power in right if set(range(low, power, 2)) <= set(right)), default=low
    )
    return Finding(figures, {"wrong": 0.0}, holds=f"float32: states of 1e{low} to 1e{largest:+d}")


def _run_infinite_channel(space_dim: int, session: Session) -> Finding:
    x, s = _worlds(session, space_dim, 16)
    clean = perceive(x, s, EPS)
    broken = s.clone()
    broken[WORLD, PARTICLE, 2] = math.inf
    z = perceive(x, broken, EPS)
    gradients = torch.arange(32, 32 + 16 * space_dim).view(16, space_dim)
    touched = torch.zeros(z.shape[2], dtype=torch.bool)
    touched[[2, 18, *gradients[2].tolist()]] = True
    touched = touched.to(z.device)
    others = torch.arange(WORLD_COUNT, device=z.device) != WORLD
    away = (x[WORLD] - x[WORLD, PARTICLE]).norm(dim=-1) > EPS
    figures = {
        "other_worlds": differing(z[others], clean[others]),
        "other_channels": differing(z[..., ~touched], clean[..., ~touched]),
        "out_of_sight": differing(z[WORLD, away], clean[WORLD, away]),
        "touched_numbers": float((~z.isfinite()).sum()),
    }
    return Finding(figures, dict.fromkeys(list(figures)[:3], 0.0))


def _run_gradient(session: Session) -> Finding:
    x, s = _worlds(session, 2, 16)
    others = torch.arange(WORLD_COUNT, device=x.device) != WORLD

    def gradients(broken: bool) -> tuple[Tensor, ...]:
        given_x, given_s = x.clone(), s.clone()
        if broken:
            given_s[WORLD, PARTICLE, 0] = math.nan
        given_x.requires_grad_()
        given_s.requires_grad_()
        z = perceive(given_x, given_s, EPS, detach_positions=False)
        weights = torch.randn(z.shape, generator=torch.Generator().manual_seed(3)).to(z)
        if broken:
            weights[WORLD, PARTICLE + 1] = math.nan
        return torch.autograd.grad((z * weights).sum(), (given_s, given_x))

    pairs = list(zip(gradients(True), gradients(False), strict=True))
    figures = {
        name: differing(found[others], clean[others])
        for name, (found, clean) in zip(("states", "positions"), pairs, strict=True)
    }
    return Finding(figures, dict.fromkeys(figures, 0.0))


def _broken_rollout(session: Session) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Return worlds after some steps that began with NaN in a state, and without it."""
    rule = load_rule("gecko", device=session.device).float()
    x, s = _worlds(session, 2, rule.state_dim)
    broken = s.clone()
    broken[WORLD, PARTICLE, 0] = math.nan

    @torch.no_grad()
    def run(states: Tensor) -> tuple[Tensor, Tensor]:
        return rollout(rule, x, states, STEPS, generator=session.generator())

    return run(broken), run(s)


def _run_nan_state(session: Session) -> Finding:
    (x, s), (clean_x, clean_s) = _broken_rollout(session)
    others = torch.arange(WORLD_COUNT, device=x.device) != WORLD
    lost = (~s[WORLD].isfinite()).any(-1) | (~x[WORLD].isfinite()).any(-1)
    away = (clean_x[WORLD] - clean_x[WORLD, PARTICLE]).norm(dim=-1) > (2 * STEPS) * EPS
    figures = {
        "other_worlds_x": differing(x[others], clean_x[others]),
        "other_worlds_s": differing(s[others], clean_s[others]),
        "out_of_reach": float((lost & away).sum()),
        "not_found": float(not bool(lost.any())),
        "lost_particles": float(lost.sum()),
    }
    return Finding(figures, dict.fromkeys(list(figures)[:4], 0.0))


def _unreported(calls: dict[str, Callable[[], Any]], named: str) -> Finding:
    """Return a finding that counts the calls that are not refused by an error with some words."""
    figures = {}
    for name, call in calls.items():
        try:
            call()
            figures[name] = 1.0
        except NPAError as error:
            figures[name] = float(named not in str(error))
    return Finding(figures, dict.fromkeys(figures, 0.0))


def _run_nan_position(session: Session) -> Finding:
    rule = load_rule("gecko", device=session.device).float()
    x, s = _worlds(session, 2, rule.state_dim)
    x[WORLD, PARTICLE, 1] = math.nan
    calls: dict[str, Callable[[], Any]] = {
        "perceive": partial(perceive, x, s, EPS),
        "rollout": partial(rollout, rule, x, s, 1),
    }
    return _unreported(calls, f"world {WORLD}, particle {PARTICLE}")


def _run_blown_up(session: Session) -> Finding:
    rule = load_rule("gecko", device=session.device).float()
    (x, s), _ = _broken_rollout(session)
    if bool(x.isfinite().all()):
        return Finding({"rollout": 1.0}, {"rollout": 0.0}, note="NaN in a state moved no particle")
    return _unreported({"rollout": partial(rollout, rule, x, s, 1)}, f"world {WORLD}")
