"""Diagnosis of a run whose loss is not finite: which iteration, which worlds."""

from __future__ import annotations

import copy
import math
from pathlib import Path
from typing import Any

import torch
from torch import nn

from npa_envs.errors import DivergedError, shown
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import Task


def divergence_error(
    task: Task, rule: NPARule, snapshot: dict[str, Any], diagnosis: Path
) -> DivergedError:
    """Return the error that ends a run whose loss is not finite.

    Args:
        snapshot: `LossMeter.snapshot()`.
        diagnosis: Where the snapshot was written.
    """
    terms = [name for name, value in snapshot["terms"].items() if not math.isfinite(value)]
    visible = [name for name in terms if name != "loss"] or terms
    worlds = bad_worlds(task, rule, snapshot)
    where = f"world{'s' * (len(worlds) > 1)} {', '.join(map(str, worlds))}" if worlds else "no one"
    return DivergedError(
        f"the loss must stay finite, but {' and '.join(visible)} was not in iteration "
        f"{snapshot['iteration']} ({snapshot['steps']} steps, {where} of the batch): lower "
        "learning_rate, or use fewer steps; the worlds and the rule are in "
        f"{shown(str(diagnosis))}, the last good checkpoint is untouched"
    )


def bad_worlds(task: Task, rule: NPARule, snapshot: dict[str, Any]) -> list[int]:
    """Return which worlds of the batch alone give a loss that is not finite.

    Args:
        snapshot: `LossMeter.snapshot()`, with `x` [B, N, D] and `s` [B, N, C] after the rollout,
            the `parameters` at that time, and `goal` [B] where the task has goals.
    """
    rule = copy.deepcopy(rule).cpu()
    trained = [parameter for parameter in rule.parameters() if parameter.requires_grad]
    nn.utils.vector_to_parameters(snapshot["parameters"], trained)
    task = task.for_rule(rule)
    x, s, goal = snapshot["x"], snapshot["s"], snapshot.get("goal")
    found = []
    for world in range(len(x)):
        one = slice(world, world + 1)
        finite = bool(torch.isfinite(x[one]).all() and torch.isfinite(s[one]).all())
        if finite:
            with torch.no_grad():
                aimed = task.toward(None if goal is None else goal[one])
                total, parts = aimed.loss(x[one], s[one], torch.zeros_like(x[one][..., 0]))
            finite = all(bool(torch.isfinite(v).all()) for v in (total, *parts.values()))
        if not finite:
            found.append(world)
    return found
