"""Methods that learn nothing, for particles and gardens: what learning curves are compared with."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from npa_envs.agents.evaluation import evaluate_policy
from npa_envs.agents.gardening import (
    BrushPolicy,
    GradientGardener,
    RandomGardener,
    ScriptedGardener,
    ScriptedShepherd,
    StillGardener,
)
from npa_envs.agents.learning.problem import Problem, world_seeds
from npa_envs.agents.learning.progress import Progress
from npa_envs.agents.learning.rules import RuleSet
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
"""Policies to choose from."""

GAINS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, -0.01, -0.03, -0.1, -0.3)
"""Displacements at a perceived c^{1+D} ∇ρ / N of 1, as fractions of α ε; below 0 they gather."""


def train_random(
    problem: Problem,
    progress: Progress,
    seed: int,
    *,
    device: torch.device,
    start: RuleSet | None = None,
) -> Policy:
    """Return the policy that acts at random; nothing is spent.

    Raises:
        NPAError: There is something to start from.
    """
    _check_no_start(start)
    policy = RandomPolicy(problem.make_envs(1, device=device), seed)
    progress.start(policy)
    return policy


def train_zero(
    problem: Problem,
    progress: Progress,
    seed: int,
    *,
    device: torch.device,
    start: RuleSet | None = None,
) -> Policy:
    """Return the policy that does nothing; errors of `train_random`."""
    _check_no_start(start)
    policy = ZeroPolicy(problem.make_envs(1, device=device))
    progress.start(policy)
    return policy


def train_scripted(
    problem: Problem,
    progress: Progress,
    seed: int,
    *,
    device: torch.device,
    start: RuleSet | None = None,
    gains: Sequence[float] = GAINS,
) -> Policy:
    """Return the scripted policy that fits best.

    Doing nothing, and all of `SCRIPTED` that the problem's task allows at each gain (a fraction of
    α ε; negative ones gather), play one episode in each of the problem's worlds, from seeds that
    evaluations do not use, until all have done so or the budget is spent. The best one is taken,
    which may be doing nothing.

    Raises:
        NPAError: There is something to start from, or gains are no finite numbers.
    """
    _check_no_start(start)
    if not isinstance(gains, list | tuple) or not all(map(is_real, gains)):
        raise NPAError(
            f"gains must be a list of finite numbers, got {shown(gains)}: for example [0.03, 0.1]"
        )
    envs = problem.make_envs(device=device)
    seeds = world_seeds(seed, problem.num_envs)
    best: Policy = ZeroPolicy(envs)
    progress.start(best)

    def tried(policy: Policy) -> float:
        episodes = evaluate_policy(envs, policy, seeds)
        # All worlds go on until the last episode is over.
        steps = int(episodes.steps.max())
        progress.advance(steps * problem.num_envs * problem.particle_count)
        return episodes.mean_return

    most = tried(best)
    for policy in _candidates(envs, gains):
        if progress.over:
            break
        mean_return = tried(policy)
        if mean_return > most:
            best, most = policy, mean_return
    progress.look(best, force=True)
    return best


def _candidates(envs: Any, gains: Sequence[float]) -> Iterator[Policy]:
    for make in SCRIPTED:
        if make is PaintPolicy and target_colour(envs) is None:
            continue
        for gain in gains:
            yield make(envs, gain=gain)


def _check_no_start(start: RuleSet | None) -> None:
    if start is not None:
        raise NPAError(
            "start must be None for a method that learns nothing: choose 'gradient', 'ppo', "
            "'evolution' or 'clone'"
        )


# Gardens.


@dataclass(frozen=True)
class Tending:
    """A gardener that looks at worlds, not at observations: it is made for each environment."""

    made_for: Callable[[Any], BrushPolicy]
    """Makes it."""

    def __call__(self, observation: Any) -> Any:
        """Refuse: observations do not say which worlds they are of."""
        raise NPAError(
            "this gardener looks at worlds: call made_for(env), and then what that returns"
        )


def _tending(
    make: Callable[[Any], BrushPolicy], progress: Progress, start: RuleSet | None
) -> Tending:
    """Return a gardener after an evaluation; nothing is learned and nothing is spent."""
    check_no_garden_start(start)
    policy = Tending(make)
    progress.start(policy)
    return policy


def tend_zero(
    problem: Problem,
    progress: Progress,
    seed: int,
    *,
    device: torch.device,
    start: RuleSet | None = None,
) -> Tending:
    """Return the gardener that does nothing.

    Raises:
        NPAError: There are rules to start from.
    """
    return _tending(StillGardener, progress, start)


def tend_random(
    problem: Problem,
    progress: Progress,
    seed: int,
    *,
    device: torch.device,
    start: RuleSet | None = None,
) -> Tending:
    """Return the gardener that acts at random; errors of `tend_zero`."""
    return _tending(lambda env: RandomGardener(env, seed), progress, start)


def tend_scripted(
    problem: Problem,
    progress: Progress,
    seed: int,
    *,
    device: torch.device,
    start: RuleSet | None = None,
) -> Tending:
    """Return the scripted gardener, or the scripted shepherd; errors of `tend_zero`."""
    shepherd = issubclass(problem.env_type.task_type, ShepherdTask)
    return _tending(ScriptedShepherd if shepherd else ScriptedGardener, progress, start)


def tend_gradient(
    problem: Problem,
    progress: Progress,
    seed: int,
    *,
    device: torch.device,
    start: RuleSet | None = None,
) -> Tending:
    """Return the gardener that plans by the world's gradient; errors of `tend_zero`."""
    return _tending(lambda env: GradientGardener(env, seed=seed), progress, start)


def check_no_garden_start(start: RuleSet | None) -> None:
    """Check that there is nothing to begin with.

    Raises:
        NPAError: There are rules.
    """
    if start is not None:
        raise NPAError("start must be None in a garden, where the world's rule is not learned")
