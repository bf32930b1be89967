"""Draw the picture of the page on several species, `docs/images/env_multispecies.png`.

    python docs/draw_species_pictures.py

It takes a few seconds on a CPU. Draw anew when an environment changes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from npa_envs import load_rule
from npa_envs.agents import RulePolicy
from npa_envs.envs import multispecies_v0
from npa_envs.render import write_filmstrip

IMAGE = Path(__file__).resolve().parent / "images" / "env_multispecies.png"
STEPS = (0, 8, 16, 32, 64, 128)
CAPTION = (
    "The shipped rule `gecko` acts. Above: two species grow their geckos side by side. Below, in "
    "colours of species: the first one is invaded by a second that acts at random."
)
WORLDS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("co_morphogenesis", {"targets": ("gecko", "gecko")}),
    ("invasion", {"render_style": "species"}),
)


def film(task: str, keywords: dict[str, Any]) -> list[tuple[str, np.ndarray]]:
    """Return captions and pictures, uint8, shape [R, R, 3], of one episode."""
    keywords = {"render_mode": "rgb_array", "render_size": 192} | keywords
    env = multispecies_v0.parallel_env(task, max_cycles=max(STEPS) + 1, **keywords)
    policy = RulePolicy(load_rule("gecko"))
    random = np.random.default_rng(0)
    observations, _ = env.reset(seed=3)
    shots = []
    for step in range(max(STEPS) + 1):
        if step in STEPS:
            shots.append((f"{task}, step {step}", np.asarray(env.render())))
        actions = {agent: policy(seen) for agent, seen in observations.items()}
        if task == "invasion":
            shape = actions["species_1"].shape
            actions["species_1"] = random.uniform(-1.0, 1.0, shape).astype(np.float32)
        observations, *_ = env.step(actions)
    return shots


if __name__ == "__main__":
    drawn = [shot for task, keywords in WORLDS for shot in film(task, keywords)]
    captions, frames = zip(*drawn, strict=True)
    write_filmstrip(IMAGE, frames, captions, columns=len(STEPS))
