"""Draw what a search found, `docs/images/search_elites.webp`: a strip of frames for each elite.

    python docs/scripts/draw_search.py runs/search/elites/3-4-1.safetensors ...

Worlds are those of seeds that the search did not see, and go on four times as long.
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import torch

import npa_envs
from npa_envs.render import draw_worlds, write_filmstrip
from npa_envs.rule.files import rule_metadata
from npa_envs.tasks.seeds import uniform_ball

IMAGE = Path(__file__).resolve().parents[1] / "images" / "search_elites.webp"
SEED = 1_000_000
STEPS = (16, 64, 96, 128, 256, 512)


@torch.no_grad()
def main() -> None:
    """Draw the rules that the command line names."""
    frames, captions = [], []
    for path in map(Path, sys.argv[1:]):
        rule, metadata = npa_envs.load_rule(path), rule_metadata(path)
        world = json.loads(metadata["world"])
        count, radius = world["particle_count"], world["seed_radius"]
        random = npa_envs.WorldRandom([SEED])
        x = uniform_ball(1, count, 2, radius, generator=random)
        s = x.new_zeros(1, count, rule.state_dim)
        done = 0
        for steps in STEPS:
            x, s = npa_envs.rollout(
                rule, x, s, steps - done, update_prob=world["update_prob"], generator=random
            )
            done = steps
            (frame,) = draw_worlds(
                x,
                s,
                resolution=128,
                pixel_size=math.sqrt(math.pi / count) * radius,
                centre=x.mean(dim=1),
                half_width=0.8,
            )
            frames.append(frame)
            captions.append(f"{path.stem}, step {steps}")
    write_filmstrip(IMAGE, frames, captions, columns=len(STEPS))


if __name__ == "__main__":
    main()
