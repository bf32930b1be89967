"""Draw what the shipped rules grow, `docs/images/rules_*.webp`, each beside its target.

    python docs/scripts/draw_rules.py [--only {2d,3d,textures,presets} ...]

It takes some minutes on a CPU, textures half an hour. Draw anew when a rule changes. `presets`
needs runs: `npa-envs train morphogenesis2d --target NAME --out runs/fast/NAME`, for three names.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import npa_envs
from npa_envs.render import to_uint8, write_filmstrip
from npa_envs.rule.files import shipped_rules
from npa_envs.tasks.targets.views import composited
from npa_envs.training.task_of_rule import task_for_film, task_of_rule

IMAGES = Path(__file__).resolve().parents[1] / "images"
SEED = 1_000_000
CPU = torch.device("cpu")

Shots = list[tuple[str, NDArray[np.uint8]]]


@torch.no_grad()
def grown(name: str, steps: tuple[int, ...]) -> tuple[Any, list[tuple[Tensor, Tensor]]]:
    """Return a rule's task, and an unseen world after each number of steps."""
    rule = npa_envs.load_rule(name)
    task = task_of_rule(name, rule, CPU).task
    generator = torch.Generator().manual_seed(SEED)
    x, s, *_ = task.seed(1, generator=generator)
    worlds, before = [], 0
    for mark in steps:
        x, s = npa_envs.rollout(
            rule,
            x,
            s,
            mark - before,
            update_prob=task.update_prob,
            box=task.box,
            generator=generator,
        )
        worlds.append((x, s))
        before = mark
    return task, worlds


@torch.no_grad()
def moments(name: str, steps: tuple[int, ...]) -> Shots:
    """Return the target of a rule whose worlds are pictures, and a world at some moments."""
    task, worlds = grown(name, steps)
    frames = [to_uint8(task.picture(x, s)[0]) for x, s in worlds]
    told = [f"step {step}" for step in steps]
    return [(name, to_uint8(task.target_picture)), *zip(told, frames, strict=True)]


def pictures() -> Shots:
    """Return the target and four moments of each rule of 2D morphogenesis."""
    shots: Shots = []
    for name in shipped_rules("morphogenesis2d"):
        shots += moments(name, (16, 64, 512, 2048))
    return shots


@torch.no_grad()
def presets() -> Shots:
    """Return each target, and step 512 of its rules by the presets `fast` and `best`."""
    shots: Shots = []
    for name in ("gecko", "butterfly", "octopus"):
        row: Shots = []
        for preset, source in (("fast", f"runs/fast/{name}"), ("best", name)):
            task, ((x, s),) = grown(source, (512,))
            rule = npa_envs.load_rule(source)
            task = task_for_film(task, source, rule, CPU, least=0, resolution=176)
            row.append((preset, to_uint8(task.picture(x, s)[0])))
        shots += [(name, to_uint8(task.target_picture)), *row]
    return shots


@torch.no_grad()
def things() -> Shots:
    """Return held-out views of each target above what its rule has grown at step 128."""
    shots: Shots = []
    for name in shipped_rules("morphogenesis3d"):
        task, ((x, s),) = grown(name, (128,))
        held_out = task.target.held_out
        for what, views in (
            (name, held_out.pictures),
            ("step 128", task.views(x, s, held_out.cameras)[0]),
        ):
            white = composited(views, torch.ones(3)).clamp(0.0, 1.0)
            shots += [(what, (255.0 * view).byte().numpy()) for view in white[1:11:2]]
    return shots


def textures() -> Shots:
    """Return the target and three moments of each texture, and the last as two by two tiles."""
    shots: Shots = []
    for name in shipped_rules("texture"):
        shots += moments(name, (64, 512, 4096))
        told, last = shots[-1]
        shots.append((f"{told}, 2 x 2", np.tile(last, (2, 2, 1))[::2, ::2]))
    return shots


DRAWN = {"2d": pictures, "3d": things, "textures": textures, "presets": presets}


def main() -> None:
    """Draw what is named, or everything."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--only", nargs="+", choices=DRAWN, default=DRAWN, help="default: all")
    for name in parser.parse_args().only:
        captions, frames = zip(*DRAWN[name](), strict=True)
        columns = 3 if name == "presets" else 5
        write_filmstrip(IMAGES / f"rules_{name}.webp", frames, captions, columns=columns)


if __name__ == "__main__":
    main()
