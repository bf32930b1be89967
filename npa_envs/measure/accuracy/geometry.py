"""Hard geometry: forwards and backwards against the float64 reference, or against invariants."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from npa_envs import reference
from npa_envs.measure.accuracy.checks import Check, Finding, Session, in_2d_and_3d
from npa_envs.measure.accuracy.scenes import (
    EPS,
    LIMITS,
    PRECISIONS,
    SIDE,
    STATE_DIM,
    Perceived,
    Scene,
    error_limits,
    perceived,
    relative_error,
    scenes,
    threshold_scenes,
)
from npa_envs.ops import perceive, perception_fields

CROWD = {"quick": 2_000, "cpu": 20_000, "cuda": 1_000_000}
"""Particles in one cell."""

NEAR_THRESHOLD = 1e-3
"""Relative distances from the threshold of an inverse at which perception is to change no more."""


def geometry_checks(seed: int = 0) -> list[Check]:
    """Return the checks of the group `geometry`; random places are drawn from the seed."""
    hard = [
        Check(
            f"geometry/{scene.name}/{space_dim}d/{'periodic' if periodic else 'open'}",
            f"{scene.summary}: all is finite, as the float64 reference has it",
            partial(_run_scene, scene),
        )
        for space_dim in (2, 3)
        for periodic in (False, True)
        for scene in scenes(space_dim, periodic=periodic, seed=seed)
    ]
    others = {
        "threshold": (
            "a moment matrix at the threshold of its inverse is inverted or is not, and nothing "
            "between",
            _run_threshold,
        ),
        "smooth_inverse": (
            "perception with moment_inverse='smooth' is as the float64 reference has it, and does "
            "not jump where that by the threshold does",
            _run_smooth_inverse,
        ),
        "crowd": (
            "very many particles in one cell: densities as float64 has them, all is finite, and "
            "the smoothing's adjoint conserves what it spreads",
            _run_crowd,
        ),
        "nearest": (
            "a pair is perceived as such from 1e-19 length units on (float32), below it counts as "
            "coincident; all is finite down to denormal distances",
            _run_nearest,
        ),
        "outside": (
            "particles outside of a periodic box are perceived as their images: in float32 with "
            "the rounding of their coordinates; all is finite",
            _run_outside,
        ),
    }
    return [*hard, *in_2d_and_3d("geometry", others)]


def _run_scene(scene: Scene, session: Session) -> Finding:
    expected = perceived(scene.x, scene.s, scene.box, by_reference=True)
    figures = {}
    for name, dtype in PRECISIONS.items():
        x, s = (tensor.to(session.device, dtype) for tensor in (scene.x, scene.s))
        found = perceived(x, s, scene.box)
        for what, value, exact in zip(Perceived._fields, found, expected, strict=True):
            figures[f"{what}_{name}"] = relative_error(value, exact)
    return Finding(figures, error_limits(scene.x, scene.s, scene.box, expected))


def _run_threshold(space_dim: int, session: Session) -> Finding:
    x, offsets = threshold_scenes(space_dim, reference.MOMENT_THRESHOLD)
    s = torch.randn(*x.shape[:2], STATE_DIM, generator=torch.Generator().manual_seed(5)).double()
    fields = reference.fields(x, s, EPS)
    corrected = fields.grad0 @ torch.linalg.pinv(fields.moment)
    right = reference.perceive(x, s, EPS, EPS)
    others = right.clone()
    start, end = 2 * STATE_DIM, (2 + space_dim) * STATE_DIM
    inverted = torch.linalg.det(fields.moment).abs() >= reference.MOMENT_THRESHOLD
    other = torch.where(inverted[..., None, None], fields.grad0, corrected)
    others[..., start:end] = reference.log_scale(other).flatten(2)
    figures, limits = {}, {}
    for name, dtype in PRECISIONS.items():
        z = perceive(x.to(session.device, dtype), s.to(session.device, dtype), EPS).cpu().double()
        # Only a determinant that rounding moves over the threshold may be taken for the other one.
        near = offsets.abs() <= 1e2 * torch.finfo(dtype).eps / reference.MOMENT_THRESHOLD
        errors = (z - right).norm(dim=-1) / right.norm(dim=-1)
        errors_of_other = (z - others).norm(dim=-1) / others.norm(dim=-1)
        corner = torch.where(near, torch.minimum(errors, errors_of_other)[:, 0], errors[:, 0])
        figures[f"z_{name}"] = float(corner.max())
        limits[f"z_{name}"] = LIMITS[f"z_{name}"]
        # Rounding moved some over the threshold by making float32 of the positions.
        figures[f"other_side_{name}"] = float((errors_of_other < errors)[:, 0].sum())
    return Finding(figures, limits)


def _run_smooth_inverse(space_dim: int, session: Session) -> Finding:
    x, offsets = threshold_scenes(space_dim, reference.MOMENT_THRESHOLD)
    s = torch.randn(*x.shape[:2], STATE_DIM, generator=torch.Generator().manual_seed(5)).double()
    # All worlds carry the same states: from one to the next only a determinant changes.
    s = s[:1].expand_as(s)
    exact = reference.perceive(x, s, EPS, EPS, moment_inverse="smooth")
    near = offsets.abs() <= NEAR_THRESHOLD
    figures: dict[str, float] = {}
    limits: dict[str, float] = {}
    for name, dtype in PRECISIONS.items():
        y, t = (tensor.to(session.device, dtype) for tensor in (x, s))
        smooth = perceive(y, t, EPS, moment_inverse="smooth").cpu().double()
        figures[f"z_{name}"] = relative_error(smooth, exact)
        limits[f"z_{name}"] = LIMITS[f"z_{name}"]
        figures[f"jump_{name}"] = _largest_jump(smooth[near])
        limits[f"jump_{name}"] = 2.0 * NEAR_THRESHOLD
        figures[f"jump_by_threshold_{name}"] = _largest_jump(perceive(y, t, EPS)[near])
    return Finding(figures, limits)


def _largest_jump(z: Tensor) -> float:
    """Return how far the first particle's z [B, N, P] changes at most from world to world."""
    corner = z[:, 0].cpu().double()
    return float(corner.diff(dim=0).norm(dim=-1).max() / corner.norm(dim=-1).max())


def _run_crowd(space_dim: int, session: Session) -> Finding:
    size = "quick" if session.quick else "cuda" if session.cuda else "cpu"
    count, sampled = CROWD[size], 32
    generator = torch.Generator().manual_seed(session.seed)
    x = 0.01 + (torch.rand(1, count, space_dim, generator=generator) - 0.5) * (EPS / 4.0)
    s = torch.randn(1, count, 4, generator=generator)
    x, s = x.to(session.device), s.to(session.device).requires_grad_()
    rho = perception_fields(x, s, EPS).rho[0]
    z = perceive(x, s, EPS)
    (by_states,) = torch.autograd.grad(z[..., 4:8].sum(), s)
    away = x[0, :sampled, None].double() - x[0].double()
    weight = reference.smoothing_kernel(away.square().sum(-1), EPS, space_dim)
    exact = weight.sum(1)
    blur = weight @ (s.detach()[0].double() / rho.double()[:, None])
    # Σ_i of the smoothed states is Σ_j v_j s_j Σ_i W_ij = Σ_j s_j, so its gradient is 1 everywhere.
    finite = [tensor.isfinite().all() for tensor in (rho, z, by_states)]
    # Terms of one sign: N roundings at most, √N of them where they are as often up as down.
    limit = 4.0 * count**0.5 * 2.0**-24
    return Finding(
        {
            "particles": float(count),
            "not_finite": float(sum(not bool(all_of) for all_of in finite)),
            "density": float(((rho[:sampled].double() - exact) / exact).abs().max()),
            "smoothed": relative_error(z[:, :sampled, 4:8], blur[None]),
            "adjoint": float((by_states.double() - 1.0).abs().max()),
        },
        {"not_finite": 0.0, "density": limit, "smoothed": limit, "adjoint": limit},
    )


def _run_nearest(space_dim: int, session: Session) -> Finding:
    figures: dict[str, float] = {}
    not_finite = 0
    holds = 0
    s = torch.randn(1, 2, STATE_DIM, generator=torch.Generator().manual_seed(5)).double()
    for power in range(1, 45):
        x = torch.zeros(1, 2, space_dim)
        x[0, 1, 0] = 10.0**-power if power > 1 else 0.5 * EPS
        found = perceived(x.to(session.device), s.to(session.device, torch.float32), None)
        expected = perceived(x.double(), s, None, by_reference=True)
        not_finite += sum(int((~tensor.isfinite()).sum()) for tensor in found)
        names = ("z_float32", "states_float32", "positions_float32")
        errors = [relative_error(a, b) for a, b in zip(found, expected, strict=True)]
        if power % 4 == 0:
            figures[f"z_1e-{power}"] = errors[0]
            figures[f"positions_1e-{power}"] = errors[2]
        if holds == power - 1 and all(
            error <= LIMITS[name] for name, error in zip(names, errors, strict=True)
        ):
            holds = power
    figures |= {"not_finite": float(not_finite), "nearest": 10.0**-holds}
    limits = {"not_finite": 0.0, "nearest": 1e-19 * (1.0 + 1e-9)}
    return Finding(figures, limits, holds=f"float32: from 1e-{holds} on")


def _run_outside(space_dim: int, session: Session) -> Finding:
    generator = torch.Generator().manual_seed(session.seed)
    inside = (torch.rand(1, 60, space_dim, generator=generator) - 0.5) * SIDE
    s = torch.randn(1, 60, STATE_DIM, generator=generator)
    box = (SIDE,) * space_dim
    figures: dict[str, float] = {}
    limits = {"not_finite": 0.0}
    not_finite = 0
    farthest = 0.0
    for offset in (0.0, 1.0, 10.0, 1e2, 1e3, 1e4, 1e6, 1e12, 1e30):
        x = inside.clone()
        x[:, ::2, 0] += offset
        found = perceived(x.to(session.device), s.to(session.device), box)
        not_finite += sum(int((~tensor.isfinite()).sum()) for tensor in found)
        if offset <= 1e4:
            # The images of what float32 has made of their coordinates.
            expected = perceived(x.double(), s.double(), box, by_reference=True)
            figures[f"z_{offset:g}"] = error = relative_error(found.z, expected.z)
            allowed = error_limits(x.double(), s.double(), box, expected)
            limits[f"z_{offset:g}"] = allowed["z_float32"]
            farthest = offset if error <= 1e-3 else farthest
    figures["not_finite"] = float(not_finite)
    return Finding(figures, limits, holds=f"float32: z within 1e-3 up to {farthest:g} sides away")
