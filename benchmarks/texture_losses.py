"""Train a texture's rule with each loss, and measure every rule by all losses; see --help.

Worlds grow from seeds that training did not see. Beside the rules stands what each of them begins
with: grey particles at random places. JSON holds the table and how it was made, the picture shows
the target and one grown world of each rule. A loss whose weights are missing is left out, and the
report says so.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.files import write_text
from npa_envs.measure.speed.report import script_facts
from npa_envs.render import to_uint8, write_filmstrip
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.losses.texture import TEXTURE_LOSSES
from npa_envs.tasks.texture import Texture
from npa_envs.training import TrainConfig, preset, train
from npa_envs.world.rollout import rollout

FIRST_SEED = 1_000_000
"""The first grown world's number; training uses others."""

PICTURE_SIDE = 256
"""Least pixels on each side of a picture."""

QUICK: dict[str, Any] = {"iterations": 150, "milestones": (110,), "picture_interval": 0}
"""Fields over the preset `fast`: half a minute a loss on one core."""


def available(losses: list[str], base: TrainConfig[Any]) -> tuple[list[Texture], dict[str, str]]:
    """Return a task for each loss that can be had, and why the others cannot."""
    tasks, missing = [], {}
    for name in losses:
        task = Texture(replace(base.task, loss=name), device=base.device)
        try:
            task.metric(*grey(task, 1))
        except NPAError as error:
            missing[name] = str(error).replace(str(Path.home()), "~")
            print(f"left out {name}: {error}", flush=True)
        else:
            tasks.append(task)
    return tasks, missing


def grey(task: Texture, world_count: int) -> tuple[Tensor, Tensor]:
    """Return unseen seeds, one a world."""
    device = task.target_picture.device
    worlds = [
        task.seed(1, generator=torch.Generator(device).manual_seed(FIRST_SEED + k), device=device)
        for k in range(world_count)
    ]
    return torch.cat([x for x, _ in worlds]), torch.cat([s for _, s in worlds])


@torch.no_grad()
def grown(rule: NPARule, task: Texture, world_count: int, steps: int) -> tuple[Tensor, Tensor]:
    """Return worlds that a rule has grown from unseen seeds."""
    x, s = grey(task, world_count)
    return rollout(
        rule,
        x,
        s,
        steps,
        eps=task.eps,
        box=task.box,
        update_prob=task.update_prob,
        generator=torch.Generator(x.device).manual_seed(FIRST_SEED),
    )


@torch.no_grad()
def measured(tasks: list[Texture], x: Tensor, s: Tensor) -> dict[str, dict[str, float]]:
    """Return the parts of each loss, means of the worlds, by the loss's name."""
    found = {}
    for task in tasks:
        colour, density = task.texture_losses(x, s)
        found[task.metric_name] = {
            "loss": float(task.metric(x, s).mean()),
            "colour": float(colour.mean()),
            "density": float(density.mean()),
        }
    return found


def drawn(task: Texture, x: Tensor, s: Tensor) -> Any:
    """Return the picture of the first world, large enough to be looked at."""
    side = max(PICTURE_SIDE, task.config.resolution)
    shown = Texture(replace(task.config, resolution=side), device=task.target_picture.device)
    return to_uint8(shown.picture(x[:1], s[:1])[0])


def print_row(name: str, losses: dict[str, dict[str, float]], seconds: float) -> None:
    """Print one line of the table."""
    cells = "".join(f"{values['loss']:14.4f}" for values in losses.values())
    print(f"{name:14}{cells}{seconds:10.0f}", flush=True)


def options() -> argparse.Namespace:
    """Return what the command line says."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--target", default="dots", help="a built-in texture or a picture")
    parser.add_argument("--losses", nargs="+", choices=TEXTURE_LOSSES, default=list(TEXTURE_LOSSES))
    parser.add_argument("--preset", default="paper", help="what the runs start from")
    parser.add_argument("--quick", action="store_true", help="preset fast, short: a CPU will do")
    parser.add_argument("--iterations", type=int, help="default: the preset's")
    parser.add_argument("--vgg-weights", default="", help="file of VGG16's weights")
    parser.add_argument("--steps", type=int, default=256, help="steps that worlds grow")
    parser.add_argument("--worlds", type=int, default=8, help="grown worlds")
    parser.add_argument("--seed", type=int, default=0, help="randomness of training")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads of torch")
    parser.add_argument("--commit", default="unknown", help="commit that is measured")
    parser.add_argument("--runs", type=Path, default=Path("runs/texture_losses"))
    parser.add_argument("--output", type=Path, default=Path("runs/texture_losses/report.json"))
    parser.add_argument("--picture", type=Path, default=Path("runs/texture_losses/grown.png"))
    return parser.parse_args()


def main() -> None:
    """Train, measure, print a table, write JSON and a picture."""
    arguments = options()
    torch.set_num_threads(arguments.threads)
    fields: dict[str, Any] = dict(QUICK) if arguments.quick else {}
    if arguments.iterations:
        # Milestones stay at their shares of the run.
        base = preset("fast" if arguments.quick else arguments.preset, "texture", **fields)
        share = arguments.iterations / base.iterations
        stones = sorted({max(1, round(share * stone)) for stone in base.milestones})
        fields |= {"iterations": arguments.iterations, "milestones": tuple(stones)}
    base = preset(
        "fast" if arguments.quick else arguments.preset,
        "texture",
        **fields,
        target=arguments.target,
        vgg_weights=arguments.vgg_weights,
        seed=arguments.seed,
        device=arguments.device,
        tensorboard=False,
    )
    tasks, missing = available(arguments.losses, base)
    if not tasks:
        sys.exit("no loss can be had")
    x, s = grey(tasks[0], arguments.worlds)
    rows = [{"trained_with": None, "seconds": 0.0, "measured_by": measured(tasks, x, s)}]
    target = Texture(replace(tasks[0].config, resolution=PICTURE_SIDE)).target_picture
    frames, captions = [to_uint8(target), drawn(tasks[0], x, s)], ["target", "step 0"]
    names = "".join(f"{task.metric_name:>14}" for task in tasks)
    print(f"{'trained with':14}{names}{'seconds':>10}")
    print_row("nothing", rows[0]["measured_by"], 0.0)
    for task in tasks:
        config = replace(base, task=task.config, out=arguments.runs / task.metric_name)
        start = time.perf_counter()
        result = train(config, "texture", overwrite=True, progress=sys.stderr.isatty())
        if result.interrupted:
            sys.exit("interrupted")
        seconds = time.perf_counter() - start
        x, s = grown(result.rule.float(), task, arguments.worlds, arguments.steps)
        found = measured(tasks, x, s)
        print_row(task.metric_name, found, seconds)
        rows.append({"trained_with": task.metric_name, "seconds": seconds, "measured_by": found})
        frames.append(drawn(task, x, s))
        captions.append(f"{task.metric_name}, step {arguments.steps}")
    report = {
        **script_facts(arguments.commit, torch.device(arguments.device)),
        "target": arguments.target,
        "particle_count": base.task.particle_count,
        "resolution": base.task.resolution,
        "iterations": base.total_iterations,
        "steps": arguments.steps,
        "worlds": arguments.worlds,
        "left_out": missing,
        "rows": rows,
    }
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.picture.parent.mkdir(parents=True, exist_ok=True)
    write_text(arguments.output, json.dumps(report, indent=1, allow_nan=False) + "\n")
    write_filmstrip(arguments.picture, frames, captions)
    print(f"wrote {arguments.output} and {arguments.picture}")


if __name__ == "__main__":
    main()
