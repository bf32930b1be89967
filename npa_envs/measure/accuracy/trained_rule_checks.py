"""Checks of trained rules in worlds of their tasks: 100 000 steps, gradients, CUDA graphs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.measure.accuracy.check_runner import (
    RULE_CHECKS,
    CheckResult,
    CheckSession,
    Skipped,
    check,
)
from npa_envs.measure.accuracy.scenes import differing, relative_error
from npa_envs.measure.quality import RuleRunner
from npa_envs.rule.files import load_rule, rule_file, rule_metadata
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import Task
from npa_envs.training.task_of_rule import task_of_rule, trained_config
from npa_envs.world.brushes import nearest_image
from npa_envs.world.cuda_graph import capture
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import WorldRandom
from npa_envs.world.rollout import rollout_particles

CHECKED_TASKS = ("morphogenesis2d", "morphogenesis3d", "texture", "point_classification")
"""Names of the tasks whose rules can be checked."""

QUICK_PARTICLES, QUICK_CLOUD = 1024, 128
"""Maximum number of particles in a world, and in a cloud of points, in a quick run."""

MIN_VIEWS: dict[str, Any] = {"resolution": 16, "training_views": 1, "held_out_views": 1}
"""Fields of a 3D task's configuration for few, small views of its target, as no check uses it."""


class RuleWorlds(NamedTuple):
    """A trained rule in float32, its task, and start worlds of the task (with goals, if any)."""

    rule: NPARule
    task: Task
    worlds: Particles


def task_name(rule: str) -> str:
    """Return the task that a rule (shipped name or file) was trained on, one of `CHECKED_TASKS`."""
    metadata = rule_metadata(rule_file(rule))
    if metadata.get("task") not in CHECKED_TASKS:
        raise NPAError(
            f"the rule's file must name the task of its training, {rule!r} names "
            f"{metadata.get('task')!r}: give a rule that npa-envs train has saved"
        )
    return metadata["task"]


def rule_worlds(
    session: CheckSession, name: str, *, world_count: int = 1, particles: float = 1.0
) -> RuleWorlds:
    """Return a rule (shipped, or a file) with `world_count` start worlds of its task.

    `particles` is a factor on the number of particles that the rule was trained with, which a quick
    session limits. The rule and its task are cached in the session.
    """
    if (name, particles) not in session.cache:
        rule = load_rule(name, device=session.device).float().requires_grad_(False)
        fields = {} if rule.space_dim == 2 else MIN_VIEWS
        path = rule_file(name)
        count = int(trained_config(path, rule_metadata(path)).task.particle_count)
        # Farthest point sampling of clouds is slow.
        most = QUICK_CLOUD if task_name(name) == "point_classification" else QUICK_PARTICLES
        count = max(1, round(particles * (min(count, most) if session.quick else count)))
        trained = task_of_rule(name, rule, session.device, particle_count=count, **fields)
        session.cache[name, particles] = rule, trained.task
    rule, task = session.cache[name, particles]
    x, s, *_, goal = task.seed(world_count, generator=session.generator(), device=session.device)
    return RuleWorlds(rule, task.with_goal(goal), Particles(x.float(), s.float(), goal=goal))


# The group `time`: every shipped rule for 100 000 steps.

LONG_RUN_STEPS, QUICK_STEPS = 100_000, 200
"""Steps of the run, and of a quick one."""

SETTLED = 512
"""Step of the settled world, which later ones are compared with; a short run's middle if sooner."""

MARKS = 16
"""Number of measurements after the settled world's."""

ENERGY_STEPS = 16
"""Steps that energies are averaged over: of a world at rest single steps differ a hundredfold."""

BOUNDS = {
    "not_finite": 0.0,
    "extent": 2.0,
    "overflow": 0.1,
    "largest_state": 8.0,
    "energy": 4.0,
    "drift": 1.0,
}
"""Upper bounds of the metrics of a world, from the settled one on (all dimensionless).

- `not_finite`: how many numbers of positions and states are infinite or NaN.
- `extent`: longest side of the particles' bounding box / that of the settled world.
- `overflow`: mean |s - clip(s, -1, 1)|, how far states are beyond [-1, 1].
- `largest_state`: the largest |s|.
- `energy`: mean over particles of a step's |Δx|²/ε² + mean Δs² / that of the settled world.
- `drift`: distance of the centroid from the settled one's / settled extent; in open space only.
"""


def mark_steps(steps: int) -> list[int]:
    """Return the steps of measurements, the settled world's to `steps`, logarithmically spaced."""
    settled = min(SETTLED, steps // 2)
    return [round(settled * (steps / settled) ** (k / MARKS)) for k in range(MARKS + 1)]


def measured(runner: RuleRunner, worlds: Particles) -> dict[str, float]:
    """Return the metrics of `BOUNDS` except drift, before they are `relative`.

    Energies are those of the next `ENERGY_STEPS` steps. Worlds with NaN have only `not_finite`.
    """
    with torch.no_grad():
        x, s, *_ = worlds
        not_finite = (~x.isfinite()).sum() + (~s.isfinite()).sum()
        if int(not_finite):
            return {"not_finite": float(not_finite)}
        energy = torch.zeros((), device=x.device)
        for _ in range(ENERGY_STEPS):
            after = runner.run(worlds, 1)
            moved = nearest_image(after.x - worlds.x, runner.task.box)
            energy += (moved / runner.task.eps).square().sum(-1).mean()
            energy += (after.s - worlds.s).square().mean()
            worlds = after
        return {
            "not_finite": 0.0,
            "extent": float((x.amax(1) - x.amin(1)).amax()),
            "overflow": float((s - s.clamp(-1.0, 1.0)).abs().mean()),
            "largest_state": float(s.abs().max()),
            "energy": float(energy / ENERGY_STEPS),
        }


def relative(metrics: Mapping[str, float], settled: Mapping[str, float]) -> dict[str, float]:
    """Return metrics whose extent, energy and drift are divided by the settled world's."""
    units = {"extent": "extent", "energy": "energy", "drift": "extent"}
    # In a world at rest the energy is rounding.
    return {
        name: value / max(settled[units[name]], 1e-12) if name in units else value
        for name, value in metrics.items()
    }


def exceeded(metrics: Mapping[str, float], limits: Mapping[str, float]) -> str:
    """Return the names of metrics that are NaN or above their limits, with commas, "" if none."""
    return ", ".join(name for name, limit in limits.items() if not metrics.get(name, 0.0) <= limit)


@check("time", registry=RULE_CHECKS)
def _run_long(name: str, session: CheckSession) -> CheckResult:
    """No number becomes infinite or NaN; the extent at most doubles, updates have at most four
    times the energy of the settled world's, states stay within 8 and on average within 1.1, the
    centroid moves by an extent at most."""
    start = rule_worlds(session, name)
    steps = QUICK_STEPS if session.quick else LONG_RUN_STEPS
    runner, energy_runner = (
        RuleRunner(start.rule, start.task, session.generator(number)) for number in (1, 2)
    )
    open_space = start.task.box is None and not start.rule.static
    metrics: dict[str, float] = {"steps": float(steps), "particles": float(start.worlds.x.shape[1])}
    limits = {key: limit for key, limit in BOUNDS.items() if key != "drift" or open_space}
    settled: dict[str, float] = {}
    centroid = start.worlds.x.mean(1)
    note = ""
    for step, worlds in runner.at(mark_steps(steps), start.worlds):
        current = measured(energy_runner, worlds)
        if not current["not_finite"]:
            if not settled:
                settled, centroid = dict(current), worlds.x.mean(1)
            if open_space:
                current["drift"] = float((worlds.x.mean(1) - centroid).norm(dim=-1).max())
            current = relative(current, settled)
        for key, value in current.items():
            metrics[key] = max(value, metrics.get(key, 0.0))
        over = exceeded(current, limits)
        if over and not note:
            note = f"{over} above the bound at step {step}"
        if current["not_finite"]:
            break
    return CheckResult(metrics, limits, note=note)


# The group `gradients`: growth with the steps, errors of float32.

GRADIENT_STEPS, QUICK_GRADIENT_STEPS = [2**k for k in range(10)], [2**k for k in range(6)]
"""Steps of the rollouts that gradients are computed through, and of a quick session's."""


class RolloutOutcome(NamedTuple):
    """Worlds after a rollout, and gradients of a random linear functional of them.

    Gradients are by all W weights of the rule, [1, W], and by the initial states, [B, N, C].
    """

    x: Tensor
    s: Tensor
    by_weights: Tensor
    by_states: Tensor


def outcome(
    start: RuleWorlds, session: CheckSession, steps: int, dtype: torch.dtype
) -> RolloutOutcome:
    """Roll out in `dtype`, by update masks that all dtypes share; return worlds and gradients."""
    rule = NPARule(**start.rule.hyper_parameters()).to(start.worlds.x.device)
    rule.load_state_dict(start.rule.state_dict())
    rule.to(dtype)
    first_states = start.worlds.s.to(dtype).requires_grad_()
    x, s, lengths, *_ = rollout_particles(
        rule,
        start.worlds._replace(x=start.worlds.x.to(dtype), s=first_states),
        steps,
        generator=session.generator(1),
        memory="minimal" if steps > 8 else "store",
        return_path_length=True,
        **start.task.rollout_options,
    )
    weights = torch.Generator().manual_seed(3)
    assert lengths is not None, "they are asked for"
    worlds = torch.cat((x, s, lengths[..., None]), dim=2)
    # A mean over particles, so that norms at different N can be compared.
    terms = worlds * torch.randn(worlds.shape, generator=weights).to(worlds)
    loss = terms.sum(-1).mean()
    network = [*rule.hidden.parameters(), *rule.output.parameters()]
    by_states, *by_weights = torch.autograd.grad(loss, [first_states, *network])
    flat = [gradient.flatten() for gradient in by_weights]
    return RolloutOutcome(x.detach(), s.detach(), torch.cat(flat)[None], by_states)


def _gradient_worlds(session: CheckSession, name: str) -> RuleWorlds:
    return rule_worlds(session, name, particles=0.25 if session.quick else 1.0)


@check("gradients/norm", registry=RULE_CHECKS)
def _run_norm(name: str, session: CheckSession) -> CheckResult:
    """Gradients of a rollout by weights and by initial states are finite whatever the number of
    steps; their norms are reported."""
    start = _gradient_worlds(session, name)
    metrics: dict[str, float] = {}
    not_finite = 0.0
    for steps in QUICK_GRADIENT_STEPS if session.quick else GRADIENT_STEPS:
        result = outcome(start, session, steps, torch.float32)
        metrics[f"weights_{steps}"] = float(result.by_weights.norm())
        metrics[f"states_{steps}"] = float(result.by_states.norm())
        for gradient in (result.by_weights, result.by_states):
            not_finite = max(not_finite, float((~gradient.isfinite()).double().mean()))
    return CheckResult(metrics | {"not_finite": not_finite}, {"not_finite": 0.0})


@check("gradients/float32", registry=RULE_CHECKS)
def _run_float32(name: str, session: CheckSession) -> CheckResult:
    """One step in float32 is within 1e-5 of one in float64, also its gradients; after how many
    steps they still agree to 1e-2 is reported."""
    start = _gradient_worlds(session, name)
    if start.rule.divides:
        raise Skipped("random numbers by which particles divide are others in float64")
    counts = QUICK_GRADIENT_STEPS if session.quick else GRADIENT_STEPS[:8]
    metrics: dict[str, float] = {}
    usable = dict.fromkeys(RolloutOutcome._fields, 0)
    for steps in counts:
        single = outcome(start, session, steps, torch.float32)
        exact = outcome(start, session, steps, torch.float64)
        for what, value, right in zip(RolloutOutcome._fields, single, exact, strict=True):
            metrics[f"{what}_{steps}"] = error = relative_error(value, right)
            if error <= 1e-2 and usable[what] in (0, steps // 2):
                usable[what] = steps
    limits = {f"{what}_1": 1e-5 for what in RolloutOutcome._fields}
    text = ", ".join(f"{what} {steps}" for what, steps in usable.items())
    return CheckResult(metrics, limits, holds=f"steps within 1e-2, of {counts[-1]}: {text}")


@check("precision/graph")
@torch.no_grad()
def _run_graph(session: CheckSession) -> CheckResult:
    """A rollout of 16 steps captured in a CUDA graph equals an eager one bit for bit."""
    if not session.cuda:
        raise Skipped("graphs are CUDA's: run it with --device cuda")
    start = rule_worlds(session, "gecko", world_count=3)
    worlds = start.worlds
    random = WorldRandom([0, 1, 2], device=session.device)
    result = worlds.map(torch.empty_like)
    runner = RuleRunner(start.rule, start.task, random)

    def run() -> None:
        result.copy_(runner.run(worlds, 16))

    run()
    eager = result.map(torch.clone)
    metrics = {"positions": 0.0, "states": 0.0}
    graph = capture(run, session.device, warm_up=run)
    for _ in range(2):
        random.steps.zero_()
        result.map(Tensor.zero_)
        graph.replay()
        metrics["positions"] += differing(result.x, eager.x)
        metrics["states"] += differing(result.s, eager.s)
    return CheckResult(metrics, dict.fromkeys(metrics, 0.0))
