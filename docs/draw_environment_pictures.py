"""Draw the pictures of the environments' pages, `docs/images/env_*.png`: a shipped rule at work.

    python docs/draw_environment_pictures.py

It takes three minutes on a CPU. Draw anew when an environment changes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from npa_envs import load_rule
from npa_envs.agents import Policy, RulePolicy, SpreadPolicy
from npa_envs.registration import ENVIRONMENTS, Registration
from npa_envs.render import write_filmstrip

IMAGES = Path(__file__).resolve().parent / "images"
PICTURE_SIZE = 192
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
    """The shipped rule that acts; None: `policy`."""

    policy: type[Policy] = SpreadPolicy
    """What acts where no rule does."""


FILMS = {
    "Morphogenesis2D": Film(
        steps=(0, 8, 16, 32, 64, 128, 256),
        rows=({},),
        caption="An episode of the shipped rule `gecko`: the world after so many steps.",
    ),
    "Regeneration2D": Film(
        steps=(0, 2, 8, 32, 64, 128),
        rows=({"damage": "erase"}, {"damage": "cut"}, {"damage": "clump"}),
        caption="Episodes of the shipped rule `gecko`, one row for each kind of damage. They go on "
        "after success here, so that all of the healing can be seen.",
    ),
    "Texture": Film(
        steps=(0, 2, 8, 16, 32, 64, 128),
        rows=({"target": "cells", "particle_count": 4096},),
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
                "readout": "duck",
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
        caption="An episode of the shipped rule `duck`, while the camera goes round.",
        rule="duck",
    ),
}
"""By the names of the environments."""


def picture_path(registration: Registration) -> Path:
    """Return where the picture of an environment is."""
    return IMAGES / f"env_{registration.name.lower()}.png"


def film_episode(
    registration: Registration, film: Film, keywords: dict[str, Any]
) -> list[tuple[str, np.ndarray]]:
    """Return captions and pictures, uint8, shape [R, R, 3], of one episode."""
    env = gymnasium.make(
        registration.id,
        max_episode_steps=max(film.steps) + 1,
        render_mode="rgb_array",
        render_size=PICTURE_SIZE,
        success_loss=0.0,
        **keywords,
    )
    policy = film.policy(env) if film.rule is None else RulePolicy(load_rule(film.rule), env)
    observation, _ = env.reset(seed=SEED)
    shots = []
    for step in range(max(film.steps) + 1):
        if step in film.steps:
            words = dict.fromkeys(filter(str.isalpha, map(str, keywords.values())))
            caption = ", ".join((*words, f"step {step}"))
            shots.append((caption, np.asarray(env.render())))
        observation, *_ = env.step(policy(observation))
    env.close()
    return shots


def main() -> None:
    """Draw all pictures."""
    for registration in ENVIRONMENTS:
        film = FILMS[registration.name]
        shots = [shot for row in film.rows for shot in film_episode(registration, film, row)]
        captions, frames = zip(*shots, strict=True)
        write_filmstrip(picture_path(registration), frames, captions, columns=len(film.steps))


if __name__ == "__main__":
    main()
