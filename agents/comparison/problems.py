"""The tasks that methods are compared on, in sizes at which all of them have a chance.

Worlds are smaller and episodes shorter than the paper's, so that reinforcement learning and
evolution see many of them within a minute; states have few channels and change in small steps,
which leaves less to explore. The gradient, which sees through the physics, needs none of this: it
is the yardstick.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from npa_envs.agents.learning.problem import Problem
from npa_envs.errors import NPAError, suggest


class Sizes(NamedTuple):
    """A problem, and how it is made small."""

    env_id: str
    """Id of the environment."""
    keywords: Mapping[str, Any]
    """What it is told."""
    episode_steps: int
    """Length of an episode."""
    hidden_dim: int
    """Width of the rules' hidden layer."""
    quick: Mapping[str, Any]
    """Keywords of a quick one."""


GROWTH = {
    "target": "heart",
    "particle_count": 512,
    "state_dim": 8,
    "eps": 0.12,
    "eps0": 0.12,
    "state_scale": 0.1,
    "colour_weight": 20.0,
}
"""What both tasks of growth have in common: a heart, wide enough neighbourhoods, small steps."""

SMALL = {"particle_count": 64, "eps": 0.2, "eps0": 0.2, "resolution": 32}
"""What makes both of them quick."""

PROBLEMS: Mapping[str, Sizes] = {
    "morphogenesis2d": Sizes(
        "npa/Morphogenesis2D-v0",
        {**GROWTH, "seed_radius": 0.4},
        48,
        64,
        SMALL,
    ),
    "regeneration2d": Sizes(
        "npa/Regeneration2D-v0",
        {**GROWTH, "rule": "picture", "damage": "erase", "damage_size": 0.4},
        32,
        64,
        SMALL,
    ),
    "point_classification": Sizes(
        "npa/PointClassification-v0",
        {"particle_count": 256, "state_dim": 16, "state_scale": 0.1, "eps": 0.3, "eps0": 0.3},
        24,
        128,
        {"particle_count": 64},
    ),
    "mixing": Sizes(
        "npa/Mixing-v0",
        {
            "species_count": 2,
            "particle_count": 512,
            "state_dim": 8,
            "state_scale": 0.1,
            "perception": "per_species",
        },
        48,
        64,
        {"particle_count": 64, "eps": 0.2, "eps0": 0.2},
    ),
}
"""Tasks by their names."""

LEFT_OUT = frozenset({("point_classification", "scripted")})
"""Pairs (task, method) that are compared only when asked for: no scripted policy classifies."""

QUICK_STEPS = 16
"""Length of an episode of a quick problem."""


def make_problem(name: str, *, quick: bool = False) -> Problem:
    """Return a task of the comparison.

    Args:
        name: One of `PROBLEMS`.
        quick: A tiny one, for a test that everything runs.

    Raises:
        NPAError: There is no such task.
    """
    if name not in PROBLEMS:
        raise NPAError(f"unknown task {name!r}: {suggest(str(name), PROBLEMS)}")
    sizes = PROBLEMS[name]
    return Problem(
        env_id=sizes.env_id,
        keywords={**sizes.keywords, **(sizes.quick if quick else {})},
        episode_steps=QUICK_STEPS if quick else sizes.episode_steps,
        num_envs=4 if quick else 32,
        hidden_dim=16 if quick else sizes.hidden_dim,
    )
