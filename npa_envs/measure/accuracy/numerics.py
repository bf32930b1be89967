"""Checks of gradients, and of the effect of order, batches and devices on results."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from npa_envs.measure.accuracy.endurance import Habitat, habitat
from npa_envs.measure.accuracy.hard_cases import differing
from npa_envs.measure.accuracy.scenes import (
    EPS,
    SIDE,
    PerceptionOutcome,
    Scene,
    error_limits,
    functional_weights,
    perceived,
    perception_errors,
    relative_error,
    scenes,
    states_at,
)
from npa_envs.measure.accuracy.suite import RULE_CHECKS, CheckResult, CheckSession, Skipped, check
from npa_envs.measure.quality import RuleRunner
from npa_envs.ops import perceive
from npa_envs.rule.rule import NPARule
from npa_envs.world.cuda_graph import capture
from npa_envs.world.randomness import WorldRandom
from npa_envs.world.rollout import rollout

# The group `gradients`: growth with the steps, finite differences, errors of float32.

STEPS, QUICK_STEPS = 512, 32
"""Steps of the longest differentiated rollouts."""


class RolloutOutcome(NamedTuple):
    """Worlds after a rollout, and gradients of a random linear functional of them.

    Gradients are by all weights, [1, W], and by the initial states.
    """

    x: Tensor
    s: Tensor
    by_weights: Tensor
    by_states: Tensor


def powers_of_two(most: int) -> list[int]:
    """Return 1, 2, 4, ... up to `most`."""
    return [2**k for k in range(int(math.log2(most)) + 1)]


def outcome(home: Habitat, session: CheckSession, steps: int, dtype: torch.dtype) -> RolloutOutcome:
    """Run a rollout and return worlds and gradients; masks do not depend on the dtype."""
    rule = NPARule(**home.rule.hyper_parameters()).to(home.worlds.x.device)
    rule.load_state_dict(home.rule.state_dict())
    rule.to(dtype)
    start = home.worlds.s.to(dtype).requires_grad_()
    x, s, lengths = rollout(
        rule,
        home.worlds.x.to(dtype),
        start,
        steps,
        generator=session.generator(1),
        memory="minimal" if steps > 8 else "store",
        return_path_length=True,
        **home.task.rollout_options,
    )
    weights = torch.Generator().manual_seed(3)
    worlds = torch.cat((x, s, lengths[..., None]), dim=2)
    # A mean over particles, so that norms at different N can be compared.
    terms = worlds * torch.randn(worlds.shape, generator=weights).to(worlds)
    loss = terms.sum(-1).mean()
    network = [*rule.hidden.parameters(), *rule.output.parameters()]
    by_states, *by_weights = torch.autograd.grad(loss, [start, *network])
    flat = [gradient.flatten() for gradient in by_weights]
    return RolloutOutcome(x.detach(), s.detach(), torch.cat(flat)[None], by_states)


def _home(session: CheckSession, name: str) -> Habitat:
    return habitat(session, name, particles=0.25 if session.quick else 1.0)


@check("gradients/norm", registry=RULE_CHECKS)
def _run_norm(name: str, session: CheckSession) -> CheckResult:
    """Gradients of a functional by weights and by states at the start are finite whatever the
    number of steps; their norms are reported."""
    home = _home(session, name)
    figures: dict[str, float] = {}
    not_finite = 0.0
    for steps in powers_of_two(QUICK_STEPS if session.quick else STEPS):
        result = outcome(home, session, steps, torch.float32)
        figures[f"weights_{steps}"] = float(result.by_weights.norm())
        figures[f"states_{steps}"] = float(result.by_states.norm())
        for gradient in (result.by_weights, result.by_states):
            not_finite = max(not_finite, float((~gradient.isfinite()).double().mean()))
    return CheckResult(figures | {"not_finite": not_finite}, {"not_finite": 0.0})


@check("gradients/float32", registry=RULE_CHECKS)
def _run_float32(name: str, session: CheckSession) -> CheckResult:
    """One step in float32 is within 1e-5 of one in float64, also its gradients; after how many
    steps they still agree to 1e-2 is reported."""
    home = _home(session, name)
    if home.rule.divides:
        raise Skipped("particles divide by draws that are others in float64")
    counts = powers_of_two(QUICK_STEPS if session.quick else 128)
    figures: dict[str, float] = {}
    usable = dict.fromkeys(RolloutOutcome._fields, 0)
    for steps in counts:
        single = outcome(home, session, steps, torch.float32)
        exact = outcome(home, session, steps, torch.float64)
        for what, value, right in zip(RolloutOutcome._fields, single, exact, strict=True):
            figures[f"{what}_{steps}"] = error = relative_error(value, right)
            if error <= 1e-2 and usable[what] in (0, steps // 2):
                usable[what] = steps
    limits = {f"{what}_1": 1e-5 for what in RolloutOutcome._fields}
    text = ", ".join(f"{what} {steps}" for what, steps in usable.items())
    return CheckResult(figures, limits, holds=f"steps within 1e-2, of {counts[-1]}: {text}")


@check("gradients/finite_differences", *itertools.product((2, 3), (False, True)))
def _run_differences(space_dim: int, periodic: bool, session: CheckSession) -> CheckResult:
    """In float64, derivatives along smooth motions and along random states agree with finite
    differences, in every hard scene."""
    figures = {}
    for scene in scenes(space_dim, periodic=periodic, seed=session.seed):
        for what in ("states", "positions"):
            # Far from 0 floating-point numbers are too sparse.
            if (scene.name, what) != ("far", "positions"):
                figures[f"{scene.name}_{what}"] = _difference(scene, session, what)
    return CheckResult(figures, dict.fromkeys(figures, 1e-6))


def _difference(scene: Scene, session: CheckSession, what: str) -> float:
    """Return the relative error of a directional derivative against a finite difference.

    Positions move along a smooth periodic field that is 0 at the origin, so that coincident
    particles stay together. There is no moment correction, through which no gradient flows.
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
        return (z * functional_weights(x, s)).sum()

    def at(way: float) -> Tensor:
        moved = way * along
        return functional(x, s + moved) if what == "states" else functional(x + moved, s)

    # Second derivatives jump at ε, which causes an error in proportion to `change`.
    change = 1e-7
    quotient = float(at(change) - at(-change)) / (2.0 * change)
    varied = (s if what == "states" else x).clone().requires_grad_()
    value = functional(x, varied) if what == "states" else functional(varied, s)
    (gradient,) = torch.autograd.grad(value, varied)
    slope = float((gradient * along).sum())
    # The terms may cancel, so the error is relative to the sum of their absolute values.
    size = float((gradient * along).abs().sum())
    return abs(slope - quotient) / size if size > 0.0 else abs(quotient)


# The group `precision`: changes that must have little or no effect.

TWO_ERRORS = 2.0
"""Allowed distance of two results, in errors that the group `geometry` allows for one."""


def _every_scene(space_dim: int, session: CheckSession) -> Iterator[Scene]:
    for periodic in (False, True):
        yield from scenes(space_dim, periodic=periodic, seed=session.seed)


def _on(scene: Scene, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return positions and states of a scene in float32."""
    return scene.x.to(device, torch.float32), scene.s.to(device, torch.float32)


class _Distances:
    """Distances of two perceptions of the same scenes, over the error allowed for one."""

    def __init__(self) -> None:
        self.fractions: dict[str, float] = {}

    def add(self, scene: Scene, one: PerceptionOutcome, other: PerceptionOutcome) -> None:
        exact = perceived(scene.x, scene.s, scene.box, by_reference=True)
        allowed = error_limits(scene.x, scene.s, scene.box, exact)
        errors = [error / allowed[name] for name, error in perception_errors(one, other).items()]
        name = f"{scene.name}/{'open' if scene.box is None else 'periodic'}"
        # max() of a tensor never ignores NaN.
        self.fractions[name] = float(torch.tensor(errors).max())

    def result(self) -> CheckResult:
        wrong = [name for name, value in self.fractions.items() if not value <= TWO_ERRORS]
        return CheckResult(
            {"over_allowed_error": float(torch.tensor(list(self.fractions.values())).max())},
            {"over_allowed_error": TWO_ERRORS},
            note=f"too far apart: {', '.join(wrong)}" if wrong else "",
        )


@check("precision/order", 2, 3)
def _run_order(space_dim: int, session: CheckSession) -> CheckResult:
    """Particles in another order perceive the same up to rounding, in every hard scene."""
    distances = _Distances()
    for scene in _every_scene(space_dim, session):
        x, s = _on(scene, session.device)
        order = torch.randperm(x.shape[1], generator=torch.Generator().manual_seed(7))
        order = order.to(session.device)
        weights = functional_weights(x, s)
        moved = perceived(x[:, order], s[:, order], scene.box, weights=weights[:, order])
        back = PerceptionOutcome(*(tensor[:, order.argsort()] for tensor in moved))
        distances.add(scene, back, perceived(x, s, scene.box, weights=weights))
    return distances.result()


@check("precision/repeated", 2, 3)
def _run_repeated(space_dim: int, session: CheckSession) -> CheckResult:
    """Perception and gradients of every hard scene are the same bits when repeated."""
    figures = dict.fromkeys(PerceptionOutcome._fields, 0.0)
    for scene in _every_scene(space_dim, session):
        x, s = _on(scene, session.device)
        first, second = (perceived(x, s, scene.box) for _ in range(2))
        for what, a, b in zip(PerceptionOutcome._fields, first, second, strict=True):
            figures[what] += differing(a, b)
    return CheckResult(figures, dict.fromkeys(figures, 0.0))


@check("precision/batch", 2, 3)
def _run_batch(space_dim: int, session: CheckSession) -> CheckResult:
    """Every world of a batch perceives the bits that it perceives alone."""
    figures = {"open": 0.0, "periodic": 0.0}
    for periodic in (False, True):
        every = scenes(space_dim, periodic=periodic, seed=session.seed)
        some = [scene for scene in every if scene.name != "tight_box"]
        # Repeat each scene's particles until all worlds have equally many.
        count = max(scene.x.shape[1] for scene in some)
        x = torch.cat([scene.x.repeat(1, count, 1)[:, :count] for scene in some])
        x, s = (tensor.to(session.device, torch.float32) for tensor in (x, states_at(x)))
        together = perceive(x, s, EPS, box=some[0].box)
        for k in range(len(x)):
            alone = perceive(x[k : k + 1], s[k : k + 1], EPS, box=some[0].box)
            figures["periodic" if periodic else "open"] += differing(together[k], alone[0])
    return CheckResult(figures, dict.fromkeys(figures, 0.0))


@check("precision/devices")
def _run_devices(session: CheckSession) -> CheckResult:
    """A CUDA device and the CPU perceive the same up to rounding, in every hard scene."""
    if not session.cuda:
        raise Skipped("there is one device only: run it with --device cuda")

    distances = _Distances()
    for space_dim in (2, 3):
        for scene in _every_scene(space_dim, session):
            on_cuda, on_cpu = (
                perceived(*_on(scene, device), scene.box)
                for device in (session.device, torch.device("cpu"))
            )
            distances.add(scene, on_cuda, on_cpu)
    return distances.result()


@check("precision/graph")
@torch.no_grad()
def _run_graph(session: CheckSession) -> CheckResult:
    """A rollout of 16 steps recorded in a CUDA graph has the bits of one that is not."""
    if not session.cuda:
        raise Skipped("graphs are CUDA's: run it with --device cuda")
    home = habitat(session, "gecko", world_count=3)
    worlds = home.worlds
    random = WorldRandom([0, 1, 2], device=session.device)
    result = worlds.map(torch.empty_like)
    runner = RuleRunner(home.rule, home.task, random)

    def run() -> None:
        result.copy_(runner.run(worlds, 16))

    run()
    eager = result.map(torch.clone)
    figures = {"positions": 0.0, "states": 0.0}
    graph = capture(run, session.device, warm_up=run)
    for _ in range(2):
        random.steps.zero_()
        result.map(Tensor.zero_)
        graph.replay()
        figures["positions"] += differing(result.x, eager.x)
        figures["states"] += differing(result.s, eager.s)
    return CheckResult(figures, dict.fromkeys(figures, 0.0))
