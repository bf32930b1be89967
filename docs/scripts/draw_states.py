"""Draw how hidden states of the rule `mnist` draw together, `docs/images/states_mnist.webp`.

    python docs/scripts/draw_states.py

It reads MNIST's test clouds from `data`, where torchvision keeps them, and takes a minute on a CPU.
Draw anew when the rule changes.
"""

from __future__ import annotations

from typing import cast

import torch
from films import IMAGES, STILL

import npa_envs
from npa_envs.measure.quality import STATE_STEPS, hidden_states
from npa_envs.render import write_webp
from npa_envs.render.world_film import film_states
from npa_envs.tasks.point_classification import PointClassification
from npa_envs.training.task_of_rule import task_of_rule

NAME = "mnist"
CLOUDS, PARTICLES = 20, 3
BETWEEN = 3
"""Frames between two steps."""


def main() -> None:
    """Draw the film."""
    rule = npa_envs.load_rule(NAME)
    trained = task_of_rule(NAME, rule, torch.device("cpu"))
    task = cast(PointClassification, trained.task)
    states, label = hidden_states(rule, task, cloud_count=CLOUDS, particle_count=PARTICLES)
    frames, _ = film_states(states, label, STATE_STEPS, between=BETWEEN)
    # What is agreed comes first: it is what is seen of a film that does not play.
    write_webp(IMAGES / "states_mnist.webp", [frames[-1]] * STILL + frames, 10, quality=30)


if __name__ == "__main__":
    main()
