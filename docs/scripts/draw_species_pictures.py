"""Draw the picture and the film of the page on several species, `docs/images/env_multispecies.*`.

    python docs/scripts/draw_species_pictures.py

It takes half a minute on a CPU. Draw anew when an environment changes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from draw_environment_pictures import FILM_SIZE, PICTURE_SIZE, film_steps
from films import FPS, IMAGES, Frame

from npa_envs import load_rule
from npa_envs.agents import RulePolicy
from npa_envs.envs import multispecies_v0
from npa_envs.render import write_filmstrip, write_webp

IMAGE = IMAGES / "env_multispecies_strip.webp"
FILM = IMAGES / "env_multispecies.webp"
STEPS = (0, 8, 16, 32, 64, 128)
CAPTION = (
    "The shipped rule `gecko` acts. First world: two species grow their geckos side by side. "
    "Second world, in colours of species: the first is invaded by another one that acts at random."
)
WORLDS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("co_morphogenesis", {"targets": ("gecko", "gecko")}),
    ("invasion", {"render_style": "species"}),
)


def film(task: str, keywords: dict[str, Any], size: int) -> dict[int, Frame]:
    """Return the pictures of one episode, uint8, shape [size, size, 3], by step."""
    keywords = {"render_mode": "rgb_array", "render_size": size} | keywords
    env = multispecies_v0.parallel_env(task, max_cycles=max(STEPS) + 1, **keywords)
    policy = RulePolicy(load_rule("gecko"))
    random = np.random.default_rng(0)
    observations, _ = env.reset(seed=3)
    shown = {*STEPS, *film_steps(max(STEPS))}
    frames = {}
    for step in range(max(STEPS) + 1):
        if step in shown:
            frames[step] = np.asarray(env.render())
        actions = {agent: policy(seen) for agent, seen in observations.items()}
        if task == "invasion":
            shape = actions["species_1"].shape
            actions["species_1"] = random.uniform(-1.0, 1.0, shape).astype(np.float32)
        observations, *_ = env.step(actions)
    return frames


if __name__ == "__main__":
    strips = {task: film(task, keywords, PICTURE_SIZE) for task, keywords in WORLDS}
    write_filmstrip(
        IMAGE,
        [frames[step] for frames in strips.values() for step in STEPS],
        [f"{task}, step {step}" for task in strips for step in STEPS],
        columns=len(STEPS),
    )
    worlds = [film(task, keywords, FILM_SIZE[len(WORLDS)]) for task, keywords in WORLDS]
    write_webp(
        FILM,
        [np.hstack([frames[step] for frames in worlds]) for step in film_steps(max(STEPS))],
        FPS,
    )
