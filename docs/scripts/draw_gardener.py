"""Draw the film of the tutorial of gardeners: the same weather, with nobody and with what learned.

    python benchmarks/garden_learning.py npa/Gardener2DSmall-v0 ppo --steps 30000 --seeds 0 --save
    python docs/scripts/draw_gardener.py runs/gardens/ppo_0.zip

It writes `docs/images/tutorial_gardener.webp` and takes some seconds on a CPU.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from draw_environment_pictures import FILM_SIZE, film_steps
from films import FPS, IMAGES, Frame
from stable_baselines3 import PPO

import npa_envs  # noqa: F401 (registers the environments)
from npa_envs.agents.garden_policies import StillGardener
from npa_envs.render import write_webp

IMAGE = IMAGES / "tutorial_gardener.webp"
SEED, STEPS = 100, 32


def film(make: Callable[[Any], Callable[[Any], Any]]) -> list[Frame]:
    """Return the pictures of an episode, uint8, shape [size, size, 3]."""
    shown = {"render_mode": "rgb_array", "render_size": FILM_SIZE[2]}
    env = gymnasium.make("npa/Gardener2DSmall-v0", max_episode_steps=STEPS + 1, **shown)
    act = make(env)
    observation, _ = env.reset(seed=SEED)
    frames = [np.asarray(env.render())]
    for _ in range(STEPS):
        observation, *_ = env.step(act(observation))
        frames.append(np.asarray(env.render()))
    return [frames[step] for step in film_steps(STEPS)]


def main(path: str) -> None:
    """Draw the film of a policy's file."""
    model = PPO.load(path, device="cpu")
    alone = film(StillGardener)
    learned = film(lambda env: lambda seen: model.predict(seen, deterministic=True)[0])
    write_webp(IMAGE, [np.hstack(pair) for pair in zip(alone, learned, strict=True)], FPS)


if __name__ == "__main__":
    main(sys.argv[1])
