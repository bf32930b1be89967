"""Methods of `train` that train no weights: random, zero, scripted and planning policies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from npa_envs.agents.evaluation import evaluate_policy
from npa_envs.agents.garden_policies import (
    BrushPolicy,
    GradientGardener,
    RandomGardener,
    ScriptedGardener,
    ScriptedShepherd,
    StillGardener,
)
from npa_envs.agents.learning.problem import world_seeds
from npa_envs.agents.learning.progress import Progress
from npa_envs.agents.policies import (
    MendPolicy,
    PaintPolicy,
    Policy,
    RandomPolicy,
    SpreadPolicy,
    ZeroPolicy,
    target_colour,
)
from npa_envs.checks import is_real
from npa_envs.envs.shepherd2d import ShepherdTask
from npa_envs.errors import NPAError, shown

SCRIPTED: tuple[Callable[..., Policy], ...] = (PaintPolicy, SpreadPolicy, MendPolicy)
"""Scripted policies of particles that `train_scripted` tries."""

GAINS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, -0.01, -0.03, -0.1, -0.3)
"""Gains, as of `SpreadPolicy`, at which `train_scripted` tries each scripted policy."""


def train_random(progress: Progress) -> Policy | UnboundGardener:
    """Evaluate and return the policy that acts at random; no particle-steps are spent."""
    return _evaluate_once(progress, RandomPolicy, RandomGardener, seed=progress.seed)


def train_zero(progress: Progress) -> Policy | UnboundGardener:
    """Evaluate and return the policy that does nothing; no particle-steps are spent."""
    return _evaluate_once(progress, ZeroPolicy, StillGardener)


def _evaluate_once(
    progress: Progress, policy: Callable[..., Policy], gardener: Any, **options: int
) -> Policy | UnboundGardener:
    """Make a `policy(env)`, or in a garden a `gardener(env)`; evaluate it once, and return it."""
    check_no_start(progress)
    result: Policy | UnboundGardener
    if progress.problem.controlled == "brushes":
        result = UnboundGardener(lambda env: gardener(env, **options))
    else:
        result = policy(progress.problem.make_envs(1, device=progress.device), **options)
    progress.start(result)
    return result


def train_scripted(progress: Progress, *, gains: Sequence[float] = GAINS) -> Policy:
    """Return the policy of the highest mean return: `ZeroPolicy`, or one of `SCRIPTED` at a gain.

    Each policy is tried for one episode in each of the problem's `num_envs` worlds, with the same
    seeds, which evaluations do not use. No policy is tried once the budget is spent.
    """
    check_no_start(progress)
    if not isinstance(gains, list | tuple) or not all(map(is_real, gains)):
        raise NPAError(
            f"gains must be a list of finite numbers, got {shown(gains)}: for example [0.03, 0.1]"
        )
    problem = progress.problem
    envs = problem.make_envs(device=progress.device)
    seeds = world_seeds(progress.seed, problem.num_envs)
    best: Policy = ZeroPolicy(envs)
    progress.start(best)

    def mean_return_of(policy: Policy) -> float:
        episodes = evaluate_policy(envs, policy, seeds)
        # All worlds are stepped until the last episode is over.
        steps = int(episodes.steps.max())
        progress.advance(steps * problem.num_envs * problem.particle_count)
        return episodes.mean_return

    highest = mean_return_of(best)
    scripts = [cls for cls in SCRIPTED if cls is not PaintPolicy or target_colour(envs) is not None]
    for policy in (cls(envs, gain=gain) for cls in scripts for gain in gains):
        if progress.over:
            break
        mean_return = mean_return_of(policy)
        if mean_return > highest:
            best, highest = policy, mean_return
    progress.look(best, force=True)
    return best


def check_no_start(progress: Progress) -> None:
    """Raise an NPAError if the run was given rules to begin with, `start`."""
    if progress.initial is not None:
        if progress.problem.controlled == "brushes":
            raise NPAError("start must be None in a garden, where the world's rule is not learned")
        raise NPAError(
            "start must be None for a method that learns nothing: choose 'gradient', 'ppo', "
            "'evolution' or 'clone'"
        )


# Gardens.


@dataclass(frozen=True)
class UnboundGardener:
    """A gardener before it has a garden: `made_for(env)` makes the policy that reads its worlds."""

    made_for: Callable[[Any], BrushPolicy]

    def __call__(self, observation: Any) -> Any:
        """Raise an NPAError: an observation does not say which worlds it is of."""
        raise NPAError(
            "this gardener reads the worlds: call made_for(env), and then what that returns"
        )


def tend_scripted(progress: Progress) -> Policy | UnboundGardener:
    """Evaluate and return the scripted gardener, in `npa/Shepherd2D-v0` the scripted shepherd."""
    shepherd = issubclass(progress.problem.task_type, ShepherdTask)
    return _evaluate_once(progress, ZeroPolicy, ScriptedShepherd if shepherd else ScriptedGardener)


def tend_gradient(progress: Progress) -> Policy | UnboundGardener:
    """Evaluate and return the gardener that plans by the gradient through the physics."""
    return _evaluate_once(progress, ZeroPolicy, GradientGardener, seed=progress.seed)
