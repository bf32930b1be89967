"""Rules with dividing particles, from one particle, compared with plain rules from a disk.

`train` trains on each target by the preset `best`: from a disk, and from one particle. `measure`
runs rules on unseen seeds: losses and living particles over the steps, also after half of the
particles are removed, every second one or those on one side.

    python benchmarks/division.py train --out OUT --device cuda
    python benchmarks/division.py measure OUT.json RULE [RULE ...] [--device cuda]
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from recipes import train_side_by_side
from torch import Tensor

import npa_envs
from npa_envs.measure.benchmark_records import machine, write_record
from npa_envs.rule.files import rule_metadata
from npa_envs.tasks.base import Task
from npa_envs.training import preset
from npa_envs.training.task_of_rule import task_of_rule
from npa_envs.world.division import living
from npa_envs.world.randomness import WorldRandom

SEEDS = tuple(range(1000, 1008))
"""Seeds of the worlds that rules are measured on."""

STEPS = (16, 32, 64, 128, 256, 512)
"""Steps at which they are measured."""

AFTER = (32, 64, 128, 256)
"""Steps after half of the particles are gone."""

KINDS: Mapping[str, Mapping[str, Any]] = {
    "disk": {},
    "division": {"division": True},
    "disk-96": {"steps": (95, 97)},
    "division-96": {"division": True, "steps": (95, 97)},
}
"""What `train` trains of each target: the control and a rule whose particles divide, also in longer
rollouts."""


def train(arguments: argparse.Namespace) -> None:
    """Train the rules of all targets in parallel."""
    # Few numbers of steps: few graphs.
    shared = {"steps": (62, 64)}
    changes = json.loads(arguments.fields)
    wanted = {
        f"{target}-{kind}": {**shared, **fields, **changes, "target": target}
        for target in arguments.targets
        for kind, fields in KINDS.items()
        if kind in arguments.kinds
    }
    configs = [
        preset(
            "best",
            **fields,
            iterations=arguments.iterations,
            tensorboard=False,
            picture_interval=0,
            checkpoint_interval=10**9,
            device=arguments.device,
            out=arguments.out / "runs" / name,
        )
        for name, fields in wanted.items()
    ]
    trainers, seconds = train_side_by_side(
        configs, arguments.longest, arguments.out, arguments.seconds
    )
    print(f"{[*wanted]}, {trainers[0].iteration} iterations, {seconds:.1f} s together")


def row(task: Task, x: Tensor, s: Tensor, divides: bool) -> dict[str, list[float]]:
    """Return the loss of each world, and the number of living particles in each."""
    alive = living(s).sum(dim=1) if divides else torch.full((len(x),), x.shape[1])
    return {"loss": task.metric(x, s).tolist(), "living": alive.tolist()}


@torch.no_grad()
def measured(path: Path, device: torch.device) -> dict[str, Any]:
    """Return the measurements of one rule."""
    rule = npa_envs.load_rule(path, device=device).float()
    task = task_of_rule(str(path), rule, device).task
    random = WorldRandom(SEEDS, device=device)

    def run(x: Tensor, s: Tensor, marks: Sequence[int]) -> tuple[Tensor, Tensor, dict[int, Any]]:
        rows = {}
        for before, step in zip((0, *marks), marks, strict=False):
            steps = step - before
            x, s = npa_envs.rollout(
                rule, x, s, steps, eps=task.eps, update_prob=task.update_prob, generator=random
            )
            rows[step] = row(task, x, s, rule.divides)
        return x, s, rows

    x, s, *_ = task.seed(len(SEEDS), generator=random, device=device)
    found: dict[str, Any] = {"iteration": int(rule_metadata(path)["iteration"])}
    x, s, found["grown"] = run(x, s, STEPS)
    if not rule.divides:
        return found
    alive = living(s)
    right = x[..., 0].masked_fill(~alive, -torch.inf)
    side = right >= right.quantile(1.0 - 0.5 * alive.float().mean().item(), dim=1, keepdim=True)
    second = alive & (alive.cumsum(dim=1) % 2 == 0)
    for name, gone in (("each second", second), ("one side", side & alive)):
        left = torch.where(gone[..., None], 0.0, s)
        found[name] = {0: row(task, x, left, True)} | run(x, left, AFTER)[2]
    return found


def measure(arguments: argparse.Namespace) -> None:
    """Measure all rules."""
    device = torch.device(arguments.device)
    found = {}
    for path in arguments.rules:
        name = path.stem if path.stem != "rule" else path.resolve().parent.name
        found[name] = measured(path, device)
        for when, rows in found[name].items():
            if isinstance(rows, dict):
                pairs = ((step, map(statistics.mean, row.values())) for step, row in rows.items())
                means = {step: tuple(round(mean, 4) for mean in pair) for step, pair in pairs}
                print(name, when, means, flush=True)
        write_record(arguments.out, {"machine": machine(device), "rules": found})


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True)
    training = commands.add_parser("train")
    training.set_defaults(run=train)
    training.add_argument("--out", type=Path, required=True)
    training.add_argument("--targets", nargs="+", default=("heart", "gecko"))
    training.add_argument("--kinds", nargs="+", choices=[*KINDS], default=("disk", "division"))
    training.add_argument("--iterations", type=int, default=2500)
    training.add_argument("--seconds", type=float, default=math.inf, help="of a cosine by the time")
    training.add_argument("--longest", type=float, default=math.inf)
    training.add_argument("--fields", default="{}", help="JSON object of fields for all kinds")
    measuring = commands.add_parser("measure")
    measuring.set_defaults(run=measure)
    measuring.add_argument("out", type=Path)
    measuring.add_argument("rules", type=Path, nargs="+")
    for command in (training, measuring):
        command.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    arguments.run(arguments)


if __name__ == "__main__":
    main()
