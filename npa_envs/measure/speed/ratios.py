"""Ratios of times within one run, which hold on any machine of a kind, and their check."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from npa_envs.errors import NPAError
from npa_envs.measure.speed.rollouts import composed_step, drawn_mask
from npa_envs.measure.speed.session import Session
from npa_envs.measure.speed.strategies import STRATEGIES
from npa_envs.measure.speed.workloads import Workload
from npa_envs.world.rollout import step

WORKLOAD = Workload(2, 1, 1024, 1)
"""Small enough for dense torch."""

TOLERANCE = 3.0
"""A ratio passes if it is at least the stored one divided by this: other machines, other loads."""


def ratios(session: Session) -> dict[str, float]:
    """Return how many times faster the library is than each thing it is compared with."""
    x, s = WORKLOAD.worlds(session.device)
    rule = WORKLOAD.rule(session.device)
    generator = torch.Generator(session.device).manual_seed(1)

    def time_of(run: Any, graph: bool) -> float:
        session.progress(1)
        return session.cost(run, graph=graph, generator=generator).time.median

    def perceive(name: str) -> float:
        strategy = STRATEGIES[name]
        return time_of(lambda: strategy.perceive(x, s, WORKLOAD.eps), strategy.capturable)

    def pull_back(name: str) -> float:
        strategy, states = STRATEGIES[name], s.clone().requires_grad_()
        return time_of(
            lambda: torch.autograd.grad(strategy.perceive(x, states, WORKLOAD.eps).sum(), states),
            strategy.capturable,
        )

    @torch.no_grad()
    def composed() -> None:
        mask = drawn_mask(x, WORKLOAD.update_prob, generator)
        composed_step(STRATEGIES["library"], rule, x, s, mask)

    @torch.no_grad()
    def fused() -> None:
        step(rule, x, s, update_prob=WORKLOAD.update_prob, generator=generator)

    own = perceive("library")
    return {
        "perceive: dense torch over library": perceive("dense") / own,
        "perceive: hash grid over library": perceive("hash_grid") / own,
        "gradient: dense torch over library": pull_back("dense") / pull_back("library"),
        "step: composed in torch over fused": time_of(composed, True) / time_of(fused, True),
    }


def stored_ratios(path: Path, device: torch.device) -> dict[str, float]:
    """Return the ratios that are to be held.

    Args:
        path: JSON of stored ratios: {"cpu": {name: ratio}, "cuda": {...}}.
        device: Where they will be measured: its kind is looked up.

    Raises:
        NPAError: The file cannot be read or holds nothing for this kind of device.
    """
    cure = "take `ratios` from the JSON of `npa-envs bench --quick --output DIR`"
    try:
        loaded = json.loads(path.read_text(encoding="utf-8"))
        return {str(name): float(value) for name, value in loaded[device.type].items()}
    except OSError as error:
        raise NPAError(f"cannot read {str(path)!r} ({error.strerror}): {cure}") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise NPAError(
            f"{str(path)!r} must hold ratios under {device.type!r}, got {error!r}: {cure}"
        ) from error


def missed_ratios(measured: Mapping[str, float], stored: Mapping[str, float]) -> list[str]:
    """Return a line for each stored ratio that is missed; none where all are held.

    Args:
        measured: What `ratios` returned.
        stored: What `stored_ratios` returned.
    """
    return [
        f"{name}: {measured.get(name, math.nan):.3g}, stored {value:.3g}, "
        f"at least {value / TOLERANCE:.3g} wanted"
        for name, value in stored.items()
        if not measured.get(name, math.nan) >= value / TOLERANCE
    ]
