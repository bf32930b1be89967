"""Learners of policies behind one interface, imported as `npa_envs.agents.learning`.

`train(method, problem, budget, seed)` runs any of `METHODS` on a `Problem`, an environment with its
keywords, and returns rules and a learning curve. A method's module is imported when it is used.

What the methods share: `problem.py` makes the worlds, `rule_set.py` has the rules as functions,
`progress.py` budget, learning curve and checkpoints, `actor_critic.py` parts of PPO and SHAC.
"""

from __future__ import annotations

import inspect
import json
import pkgutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import torch

from npa_envs.agents.learning.problem import EVALUATION_SEEDS, Problem, check_run_seed
from npa_envs.agents.learning.progress import Budget, CurvePoint, Progress, check_finite
from npa_envs.agents.learning.rule_set import RuleSet, RuleSetPolicy
from npa_envs.errors import MissingDependencyError, NPAError, check_known, shown, suggest
from npa_envs.training.process_group import ProcessGroup

__all__ = [
    "GARDEN_METHODS",
    "KEPT_METHODS",
    "METHODS",
    "Budget",
    "CurvePoint",
    "Problem",
    "Progress",
    "RuleSet",
    "RuleSetPolicy",
    "Trained",
    "check_finite",
    "method_options",
    "methods_for",
    "train",
]

METHODS: dict[str, str] = {
    "gradient": "npa_envs.agents.learning.gradient:train",
    "shac": "npa_envs.agents.learning.shac:train",
    "ppo": "npa_envs.agents.learning.ppo:train",
    "ppo_world": "npa_envs.agents.learning.sb3:train",
    "evolution": "npa_envs.agents.learning.evolution:train",
    "clone": "npa_envs.agents.learning.clone:train",
    "random": "npa_envs.agents.learning.untrained_methods:train_random",
    "zero": "npa_envs.agents.learning.untrained_methods:train_zero",
    "scripted": "npa_envs.agents.learning.untrained_methods:train_scripted",
}
"""Methods: functions `f(progress, ...)` of a `Progress` that return a `RuleSet` or policy. Options
are keyword-only arguments, or a dataclass, the default of `options`. You may add methods."""

KEPT_METHODS = ("ppo", "shac")
"""Methods whose runs can be written to a folder, resumed, and shared by several processes."""

GARDEN_METHODS: dict[str, str] = {
    "gradient": "npa_envs.agents.learning.untrained_methods:tend_gradient",
    "ppo_world": "npa_envs.agents.learning.sb3:train_garden_ppo",
    "sac": "npa_envs.agents.learning.sb3:train_garden_sac",
    "random": "npa_envs.agents.learning.untrained_methods:train_random",
    "zero": "npa_envs.agents.learning.untrained_methods:train_zero",
    "scripted": "npa_envs.agents.learning.untrained_methods:tend_scripted",
}
"""Methods for gardens, where a rule updates the particles and actions are of brushes."""

UNLEARNED = {"codes": "codes", "central": "numbers for all particles"}
"""What actions are that no method learns, by `Problem.controlled`; other libraries learn them."""


class Trained(NamedTuple):
    """What `train` returns: rules or a policy, and the learning curve."""

    rules: RuleSet | None
    """The rules, on the run's device; None if the method returns a policy."""
    log: list[CurvePoint]
    policy: Callable[[Any], Any]
    """Maps observations, [B, N, P], to actions, [B, N, A]; or a dict of agents' observations, as of
    PettingZoo's parallel environments, to a dict of their actions."""

    def save(self, folder: str | Path) -> list[Path]:
        """Write the rules, or a policy that has `save`, into a folder; return the files' paths."""
        save = getattr(self.policy if self.rules is None else self.rules, "save", None)
        return [] if save is None else save(folder)


def train(
    method: str,
    problem: Problem,
    budget: Budget,
    seed: int,
    *,
    device: str | torch.device = "cpu",
    start: RuleSet | None = None,
    evaluation_seeds: Iterable[int] = EVALUATION_SEEDS,
    curve_points: int = 20,
    on_point: Callable[[CurvePoint], None] = lambda _: None,
    on_stop: Callable[[], None] = lambda: None,
    out: str | Path | None = None,
    resume: bool = False,
    overwrite: bool = False,
    **options: Any,
) -> Trained:
    """Learn a problem by a method, within a budget.

    Where `torch.distributed` has a default process group, all its processes must call this, and
    learn together, by `KEPT_METHODS` only: each has some of the worlds, and rank 0 writes.

    Args:
        method: A name from `methods_for(problem)`, or your own function, "package.module:function".
        problem: The problem to learn.
        budget: Time or particle-steps to learn for.
        seed: Seed of all random numbers, from 0 to 99: runs with different seeds learn in different
            worlds, and none in those of evaluations.
        device: Device of worlds, rules and evaluations.
        start: Rules to begin with, such as `RuleSet.of(problem, "heart")`; copied. None: new ones.
        evaluation_seeds: Seeds of the episodes that measure the learning curve.
        curve_points: Number of points of the curve after the first, at equal parts of the budget.
        on_point: Called with each point of the curve as soon as it is known.
        on_stop: Called when a signal stops a run with `out` before its budget is spent.
        out: Folder for checkpoint, rules and curve, by `KEPT_METHODS` only; SIGTERM and Ctrl-C then
            save before they stop the run. None: nothing is written.
        resume: Continue from the checkpoint in `out`, on any number of processes.
        overwrite: Start again although `out` contains a run; its files are removed.
        options: Options of the method, as listed by `method_options`.

    Raises:
        NPAError: The method or an option is unknown, the method cannot learn this problem, cannot
            be resumed or distributed, or `start` does not fit. Or as for
            `npa_envs.training.run_folder.Run`.
        DivergedError: The rules' weights have become infinite or NaN.
        MissingDependencyError: The method needs a library that is not installed.
    """
    function = _checked_function(method, problem, budget, options)
    check_run_seed(seed)
    several = ProcessGroup.current().count > 1
    if method not in KEPT_METHODS and (several or out is not None):
        wanted = "be shared by processes" if several else "be kept in a folder (out)"
        raise NPAError(
            f"method {shown(method)} cannot {wanted}: take one of {', '.join(KEPT_METHODS)}"
        )
    if out is None and (resume or overwrite):
        raise NPAError("resume and overwrite need a folder: give out='runs/heart'")
    settings = {"method": method, "problem": problem.to_json(), "seed": seed, "options": options}
    settings |= {"started": start is not None}
    progress = Progress(
        problem,
        budget,
        seed,
        device=device,
        evaluation_seeds=evaluation_seeds,
        curve_points=curve_points,
        on_point=on_point,
        initial=start,
        out=None if out is None else Path(out),
        run=None if out is None else json.loads(json.dumps(settings)),
        resume=resume,
        overwrite=overwrite,
        on_stop=on_stop,
    )
    defaults = _default_options(function)
    result = function(
        progress, **(options if defaults is None else {"options": replace(defaults, **options)})
    )
    if isinstance(result, RuleSet):
        # Gradients may keep the memory of CUDA graphs.
        result.zero_grad()
        return Trained(result, progress.log, result.policy())
    return Trained(None, progress.log, result)


def _checked_function(
    method: str, problem: Problem, budget: Budget, options: Mapping[str, Any]
) -> Callable[..., Any]:
    """Return the function of a method that can learn the problem and has these options."""
    for value, cls, make in (
        (problem, Problem, "Problem(env_id='npa/Mixing-v0', episode_steps=96)"),
        (budget, Budget, "Budget(particle_steps=10**6)"),
    ):
        if not isinstance(value, cls):
            name = cls.__name__
            raise NPAError(
                f"{name.lower()} must be a {name}, got {shown(value)}: make it with {make}"
            )
    if problem.controlled in UNLEARNED and method in GARDEN_METHODS | METHODS:
        raise NPAError(
            f"method {shown(method)} cannot learn {UNLEARNED[problem.controlled]}, the actions of "
            f"{problem.env_id}: give a function of your own, 'package.module:function', or take "
            "another library"
        )
    function = _function(method, methods_for(problem))
    known = _options_of(function)
    for name in options:
        check_known(f"method {shown(method)} has no option", name, known)
    return function


def methods_for(problem: Problem) -> dict[str, str]:
    """Return `METHODS`, or `GARDEN_METHODS` in a garden, or none for `UNLEARNED` actions."""
    if problem.controlled in UNLEARNED:
        return {}
    return GARDEN_METHODS if problem.controlled == "brushes" else METHODS


def method_options(method: str) -> dict[str, Any]:
    """Return the options of a method, with their defaults.

    Args:
        method: From `METHODS` or else `GARDEN_METHODS`; or a function, "package.module:function".
    """
    return _options_of(_function(method, GARDEN_METHODS | METHODS))


def _options_of(function: Callable[..., Any]) -> dict[str, Any]:
    defaults = _default_options(function)
    if defaults is not None:
        return {field.name: getattr(defaults, field.name) for field in fields(defaults)}
    parameters = inspect.signature(function).parameters.values()
    return {p.name: p.default for p in parameters if p.kind is p.KEYWORD_ONLY}


def _default_options(function: Callable[..., Any]) -> Any:
    parameter = inspect.signature(function).parameters.get("options")
    default = None if parameter is None else parameter.default
    return default if is_dataclass(default) else None


def _function(method: str, table: dict[str, str]) -> Callable[..., Any]:
    if not isinstance(method, str) or (method not in table and ":" not in method):
        raise NPAError(
            f"method must be a known word, got {shown(method)}: {suggest(method, table)}"
        )
    try:
        function: Callable[..., Any] = pkgutil.resolve_name(table.get(method, method))
    except MissingDependencyError:
        raise
    except (ImportError, AttributeError, ValueError) as error:
        raise NPAError(
            "a method of your own must be 'package.module:function' that Python can import, got "
            f"{shown(method)} ({error}): run in the module's folder, or install it"
        ) from error
    return function
