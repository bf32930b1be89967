"""Draw the pictures and films of the environments' pages: a shipped rule at work.

    python docs/scripts/draw_environment_pictures.py [NAME ...]

It writes `docs/images/env_*_strip.webp` and `docs/images/env_*.webp` and takes five minutes on a
CPU. Draw anew when an environment changes.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from films import FPS, IMAGES, STILL, Frame

from npa_envs import load_rule
from npa_envs.agents import RulePolicy, SpreadPolicy
from npa_envs.agents.garden_policies import (
    GradientGardener,
    ScriptedGardener,
    ScriptedShepherd,
    StillGardener,
)
from npa_envs.agents.shapeshifter_policies import RecognisingShapeshifter
from npa_envs.registration import CODED, ENVIRONMENTS, GARDENS, Registration
from npa_envs.render import write_filmstrip, write_webp

PICTURE_SIZE = 192
FILM_SIZE = {1: 320, 2: 256, 3: 224}
"""Pixels on each side, by how many worlds a film shows side by side."""

SEED = 3


class Film(NamedTuple):
    """What the picture of an environment shows."""

    steps: tuple[int, ...]
    """Steps after which the world is shown."""

    rows: tuple[dict[str, Any], ...]
    """Keywords of `gymnasium.make`, one set for each row of the picture."""

    caption: str
    """What one sees."""

    rule: str | None = "gecko"
    """The shipped rule that acts; None: `policies`."""

    policies: tuple[Callable[[Any], Callable[[Any], Any]], ...] = (SpreadPolicy,)
    """What acts in each row where no rule does, made for its environment."""


def sampling(env: Any) -> Callable[[Any], Any]:
    """Return a policy that acts at random, the same at each run."""
    env.action_space.seed(SEED)
    return lambda _: env.action_space.sample()


def film_steps(last: int) -> list[int]:
    """Return the steps that a film shows, all at first and fewer later; it rests at both ends."""
    moments = [*range(32), *range(32, 64, 2), *range(64, last, 4), last]
    return [0] * STILL + [step for step in moments if step <= last] + [last] * 2 * STILL


FILMS = {
    "Morphogenesis2D": Film(
        steps=(0, 8, 16, 32, 64, 128, 256),
        rows=({},),
        caption="An episode of the shipped rule `gecko`.",
    ),
    "Pictures2D": Film(
        steps=(0, 8, 16, 32, 64, 128, 256),
        rows=({"targets": ("heart",)}, {"targets": ("flower",)}, {"targets": ("octopus",)}),
        caption="Three episodes that ask for another picture each; the shipped rule of each acts.",
        rule=None,
        policies=tuple(
            partial(RulePolicy, load_rule(name)) for name in ("heart", "flower", "octopus")
        ),
    ),
    "Regeneration2D": Film(
        steps=(0, 2, 8, 32, 64, 128),
        rows=({"damage": "wipe"}, {"damage": "cut"}, {"damage": "clump"}),
        caption="The rule `gecko-v0`, which has grown these worlds, heals what was wiped, a cut, "
        "and a clump. Episodes go on after success here, so that all of the healing can be seen.",
        rule="gecko-v0",
    ),
    "Texture": Film(
        steps=(0, 2, 8, 16, 32, 64, 128),
        rows=({"target": "cells", "particle_count": 2048},),
        caption="An episode of the shipped rule `cells`.",
        rule="cells",
    ),
    "PointClassification": Film(
        steps=(0, 4, 8, 12, 16, 24, 32),
        rows=({"rule": "digits"},),
        caption="An episode of the shipped rule `digits`: particles agree on what they form.",
        rule="digits",
    ),
    "Morphogenesis3D": Film(
        steps=(0, 2, 8, 16, 32, 64, 128),
        rows=(
            {
                "target": "duck",
                "readout": "duck-v0",
                "particle_count": 16384,
                "eps": 0.1,
                "eps0": 0.1,
                "alpha": 1.0,
                "state_dim": 24,
                "seed_radius": 0.7,
                "sigma": 0.02,
                "opacity": 0.15,
            },
        ),
        caption="An episode of the rule `duck-v0`, while the camera goes round.",
        rule="duck-v0",
    ),
    "Gardener2D": Film(
        steps=(0, 4, 8, 16, 24, 32),
        rows=({}, {}, {}),
        caption="The same weather three times: nobody does anything, `ScriptedGardener` pushes, "
        "`GradientGardener` plans.",
        rule=None,
        policies=(StillGardener, ScriptedGardener, GradientGardener),
    ),
    "Shepherd2D": Film(
        steps=(0, 4, 8, 16, 24, 32),
        rows=({"aim": "move"}, {"aim": "turn", "target": "gecko"}, {"aim": "reshape"}),
        caption="`ScriptedShepherd` moves a heart, turns a gecko and reshapes a heart.",
        rule=None,
        policies=(ScriptedShepherd, ScriptedShepherd, ScriptedShepherd),
    ),
    "Shapeshifter2D": Film(
        steps=(0, 15, 31, 47, 63),
        rows=({}, {}),
        caption="`RecognisingShapeshifter` says the codes of the goals, which change every 16 "
        "steps; below, one that acts at random.",
        rule=None,
        policies=(RecognisingShapeshifter, sampling),
    ),
}
"""By the names of the environments."""


def picture_path(registration: Registration) -> Path:
    """Return where the picture of an environment is."""
    return IMAGES / f"env_{registration.name.lower()}_strip.webp"


def film_path(registration: Registration) -> Path:
    """Return where the film of an environment is."""
    return IMAGES / f"env_{registration.name.lower()}.webp"


def film_episode(registration: Registration, film: Film, row: int, size: int) -> dict[int, Frame]:
    """Return the pictures of one episode, uint8, shape [size, size, 3], by step."""
    last = max(film.steps)
    env = gymnasium.make(
        registration.id,
        max_episode_steps=last + 1,
        render_mode="rgb_array",
        render_size=size,
        success_loss=0.0,
        **film.rows[row],
    )
    policy = film.policies[row](env) if film.rule is None else RulePolicy(load_rule(film.rule), env)
    observation, _ = env.reset(seed=SEED)
    shown = {*film.steps, *film_steps(last)}
    frames = {}
    for step in range(last + 1):
        if step in shown:
            frames[step] = np.asarray(env.render())
        observation, *_ = env.step(policy(observation))
    env.close()
    return frames


def caption(keywords: dict[str, Any], step: int) -> str:
    """Return what stands below a picture of a strip."""
    values = (v[0] if isinstance(v, tuple) else v for v in keywords.values())
    words = dict.fromkeys(filter(str.isalpha, map(str, values)))
    return ", ".join((*words, f"step {step}"))


def main(names: list[str]) -> None:
    """Draw the pictures and films of the environments, all of them if none is named."""
    for registration in (*ENVIRONMENTS, *GARDENS, *CODED):
        if names and registration.name not in names:
            continue
        film = FILMS[registration.name]
        rows = range(len(film.rows))
        strips = [film_episode(registration, film, row, PICTURE_SIZE) for row in rows]
        write_filmstrip(
            picture_path(registration),
            [frames[step] for frames in strips for step in film.steps],
            [caption(row, step) for row in film.rows for step in film.steps],
            columns=len(film.steps),
        )
        size = FILM_SIZE[len(film.rows)]
        worlds = [film_episode(registration, film, row, size) for row in rows]
        steps = film_steps(max(film.steps))
        write_webp(
            film_path(registration),
            [np.hstack([frames[step] for frames in worlds]) for step in steps],
            FPS,
        )


if __name__ == "__main__":
    main(sys.argv[1:])
