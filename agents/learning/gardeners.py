"""Methods for gardens that learn nothing: what a learning curve is to be compared with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

from npa_envs.agents.gardening import (
    BrushPolicy,
    GradientGardener,
    RandomGardener,
    ScriptedGardener,
    ScriptedShepherd,
    StillGardener,
)
from npa_envs.agents.learning.problem import Problem
from npa_envs.agents.learning.progress import Progress
from npa_envs.agents.learning.rules import RuleSet
from npa_envs.envs.shepherd2d import ShepherdTask
from npa_envs.errors import NPAError


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
    check_no_start(start)
    policy = Tending(make)
    progress.start(policy)
    return policy


def train_zero(
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


def train_random(
    problem: Problem,
    progress: Progress,
    seed: int,
    *,
    device: torch.device,
    start: RuleSet | None = None,
) -> Tending:
    """Return the gardener that acts at random; errors of `train_zero`."""
    return _tending(lambda env: RandomGardener(env, seed), progress, start)


def train_scripted(
    problem: Problem,
    progress: Progress,
    seed: int,
    *,
    device: torch.device,
    start: RuleSet | None = None,
) -> Tending:
    """Return the scripted gardener, or the scripted shepherd; errors of `train_zero`."""
    shepherd = issubclass(problem.env_type.task_type, ShepherdTask)
    return _tending(ScriptedShepherd if shepherd else ScriptedGardener, progress, start)


def train_gradient(
    problem: Problem,
    progress: Progress,
    seed: int,
    *,
    device: torch.device,
    start: RuleSet | None = None,
) -> Tending:
    """Return the gardener that plans by the world's gradient; errors of `train_zero`."""
    return _tending(lambda env: GradientGardener(env, seed=seed), progress, start)


def check_no_start(start: RuleSet | None) -> None:
    """Check that there is nothing to begin with.

    Raises:
        NPAError: There are rules.
    """
    if start is not None:
        raise NPAError("start must be None in a garden, where the world's rule is not learned")
