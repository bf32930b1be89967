"""Gradients: how they grow with the steps, finite differences of hard scenes, float32's errors."""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from npa_envs.measure.accuracy.checks import Check, Finding, Session
from npa_envs.measure.accuracy.habitats import Habitat, habitat
from npa_envs.measure.accuracy.scenes import EPS, SIDE, Scene, relative_error, scenes
from npa_envs.ops import perceive
from npa_envs.rule.rule import NPARule
from npa_envs.world.rollout import rollout

RULES = ("gecko", "dots", "digits", "duck")
"""One rule of each task."""

QUICK_RULES = ("gecko", "dots")
"""Rules of a quick run."""

STEPS, QUICK_STEPS = 512, 32
"""The longest rollouts that are differentiated."""

QUICK_SHARE = 0.25
"""Particles of a quick run, over what others of it have."""

COMPARED_STEPS = 128
"""The longest ones that are also run in float64."""

ONE_STEP_ERROR = 1e-5
"""Relative error of float32 that one step may have, forwards and backwards."""

USABLE_ERROR = 1e-2
"""Relative error of float32 up to which it is told how many steps a gradient takes."""

DIFFERENCE = 1e-6
"""Relative distance between a directional derivative and a finite difference in float64."""


class Outcome(NamedTuple):
    """A rollout, and gradients of a random linear functional of where it ends."""

    x: Tensor
    """Positions [length units], shape [B, N, D]."""
    s: Tensor
    """States, shape [B, N, C]."""
    by_weights: Tensor
    """Gradient by all of the rule's weights, shape [1, W]."""
    by_states: Tensor
    """Gradient by the states at the start, shape [B, N, C]."""


def gradients_checks(*, quick: bool) -> list[Check]:
    """Return the checks of the group `gradients`; when quick only of some rules."""
    checks = []
    for name in QUICK_RULES if quick else RULES:
        checks += [
            Check(
                f"gradients/norm/{name}",
                "gradients of a functional by weights and by states at the start are finite "
                "whatever the number of steps; their norms are told",
                partial(_run_norm, name),
            ),
            Check(
                f"gradients/float32/{name}",
                "one step in float32 is within 1e-5 of one in float64, also its gradients; after "
                "how many steps they still agree to 1e-2 is told",
                partial(_run_float32, name),
            ),
        ]
    for space_dim in (2, 3):
        for periodic in (False, True):
            where = f"{space_dim}d/{'periodic' if periodic else 'open'}"
            checks.append(
                Check(
                    f"gradients/finite_differences/{where}",
                    "in float64, derivatives along smooth motions and along random states are what "
                    "finite differences say, in every hard scene",
                    partial(_run_differences, space_dim, periodic),
                )
            )
    return checks


def powers_of_two(most: int) -> list[int]:
    """Return 1, 2, 4, ... up to a number."""
    return [2**k for k in range(int(math.log2(most)) + 1)]


def outcome(home: Habitat, session: Session, steps: int, dtype: torch.dtype) -> Outcome:
    """Return a rollout from the seed and its gradients; the same masks in every dtype."""
    rule = NPARule(**home.rule.hyper_parameters()).to(home.x.device)
    rule.load_state_dict(home.rule.state_dict())
    rule.to(dtype)
    start = home.s.to(dtype).requires_grad_()
    x, s, path_length = rollout(
        rule,
        home.x.to(dtype),
        start,
        steps,
        generator=session.generator(1),
        memory="minimal" if steps > 8 else "store",
        return_path_length=True,
        **home.options(),
    )
    weights = torch.Generator().manual_seed(3)
    worlds = torch.cat((x, s, path_length[..., None]), dim=2)
    # A mean over particles, so that norms at different N can be compared.
    terms = worlds * torch.randn(worlds.shape, generator=weights).to(worlds)
    loss = terms.sum(-1).mean()
    network = [*rule.hidden.parameters(), *rule.output.parameters()]
    by_states, *by_weights = torch.autograd.grad(loss, [start, *network])
    flat = [gradient.flatten() for gradient in by_weights]
    return Outcome(x.detach(), s.detach(), torch.cat(flat)[None], by_states)


def _home(session: Session, name: str) -> Habitat:
    return habitat(session, name, particles=QUICK_SHARE if session.quick else 1.0, looks=False)


def _run_norm(name: str, session: Session) -> Finding:
    home = _home(session, name)
    figures: dict[str, float] = {}
    not_finite = 0.0
    for steps in powers_of_two(QUICK_STEPS if session.quick else STEPS):
        found = outcome(home, session, steps, torch.float32)
        figures[f"weights_{steps}"] = float(found.by_weights.norm())
        figures[f"states_{steps}"] = float(found.by_states.norm())
        for gradient in (found.by_weights, found.by_states):
            not_finite = max(not_finite, float((~gradient.isfinite()).double().mean()))
    return Finding(figures | {"not_finite": not_finite}, {"not_finite": 0.0})


def _run_float32(name: str, session: Session) -> Finding:
    home = _home(session, name)
    counts = powers_of_two(QUICK_STEPS if session.quick else COMPARED_STEPS)
    figures: dict[str, float] = {}
    usable = dict.fromkeys(Outcome._fields, 0)
    for steps in counts:
        found = outcome(home, session, steps, torch.float32)
        exact = outcome(home, session, steps, torch.float64)
        for what, value, right in zip(Outcome._fields, found, exact, strict=True):
            figures[f"{what}_{steps}"] = error = relative_error(value, right)
            if error <= USABLE_ERROR and usable[what] in (0, steps // 2):
                usable[what] = steps
    limits = {f"{what}_1": ONE_STEP_ERROR for what in Outcome._fields}
    told = ", ".join(f"{what} {steps}" for what, steps in usable.items())
    return Finding(figures, limits, holds=f"steps within 1e-2, of {counts[-1]}: {told}")


def _run_differences(space_dim: int, periodic: bool, session: Session) -> Finding:
    figures = {}
    for scene in scenes(space_dim, periodic=periodic, seed=session.seed):
        for what in ("states", "positions"):
            # Far away there is no number beside a coordinate that is near enough to it.
            if (scene.name, what) != ("far", "positions"):
                figures[f"{scene.name}_{what}"] = _difference(scene, session, what)
    return Finding(figures, dict.fromkeys(figures, DIFFERENCE))


def _difference(scene: Scene, session: Session, what: str) -> float:
    """Return how far a directional derivative is from a finite difference, relatively.

    Positions move along a smooth periodic field that is 0 at the origin: particles in one place
    stay together, and those that nearly touch do so in proportion. The correction by the moment
    matrix is a stopped gradient and is left out.
    """
    x, s = scene.x.to(session.device), scene.s.to(session.device)
    generator = torch.Generator().manual_seed(6)
    if what == "states":
        along = torch.randn(s.shape, generator=generator).to(s)
    else:
        mixing = torch.randn(x.shape[2], x.shape[2], generator=generator).to(x)
        along = torch.sin(2.0 * math.pi * x / (scene.box[0] if scene.box else SIDE)) @ mixing * EPS

    def functional(moved_x: Tensor, moved_s: Tensor) -> Tensor:
        z = perceive(
            moved_x, moved_s, EPS, EPS, scene.box, detach_positions=False, moment_correction=False
        )
        weights = torch.randn(z.shape, generator=torch.Generator().manual_seed(3)).to(z)
        return (z * weights).sum()

    def at(way: float) -> Tensor:
        moved = way * along
        return functional(x, s + moved) if what == "states" else functional(x + moved, s)

    # Second derivatives jump at ε: an error in proportion, for pairs that lie there.
    change = 1e-7
    quotient = float(at(change) - at(-change)) / (2.0 * change)
    given = (s if what == "states" else x).clone().requires_grad_()
    value = functional(x, given) if what == "states" else functional(given, s)
    (gradient,) = torch.autograd.grad(value, given)
    slope = float((gradient * along).sum())
    # The terms may cancel: then their size is what the difference is small against.
    size = float((gradient * along).abs().sum())
    return abs(slope - quotient) / size if size > 0.0 else abs(quotient)
