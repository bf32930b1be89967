"""Equivariant rules compared with plain rules of the same recipe.

`train` trains a plain rule and equivariant ones (KINDS) on each target, in parallel on one device;
`measure` runs the rules on unseen seeds: losses at the best angle over the steps, also after grown
worlds are turned by 90 degrees; `time` measures the time of a step. Each writes its results to OUT.

    python benchmarks/directions.py train --device cuda --out OUT
    python benchmarks/directions.py measure --device cuda --out OUT
    python benchmarks/directions.py time --device cuda --out OUT
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from recipe_arms import SECOND, SIZES
from recipes import train_side_by_side
from torch import Tensor

import npa_envs
from npa_envs.measure.benchmark_records import machine, write_record
from npa_envs.rule.files import rule_metadata
from npa_envs.tasks.morphogenesis2d import (
    Morphogenesis2D,
    Morphogenesis2DConfig,
    turned,
    turns,
)
from npa_envs.training import preset
from npa_envs.training.task_of_rule import trained_config
from npa_envs.world.randomness import WorldRandom

TARGETS = ("gecko", "heart", "octopus")
"""What is learned."""

KINDS: Mapping[str, Mapping[str, Any]] = {
    "plain": {},
    "chiral": {"equivariant": True},
    "mirrored": {"equivariant": True, "chiral": False},
    "framed": {"equivariant": True, "seed_across": 0.5},
    "upright": {"equivariant": True, "seed_across": 0.5, "angles": 0},
}
"""Rules: plain, equivariant, equivariant without telling left from right, and equivariant with
seeds that have a left and a right besides a head and a tail, compared at the best angle or
upright."""

SEEDS = tuple(range(1000, 1008))
"""Seeds of the worlds that rules are measured on."""

STEPS = (64, 128, 256, 512, 1024, 2048)
"""Steps at which they are measured."""

GROWN, AFTER = 512, 256
"""Steps before creatures are turned, and after."""


def train(arguments: argparse.Namespace) -> None:
    """Train all rules in parallel."""
    configs, names = [], []
    for target in arguments.targets:
        for kind in arguments.kinds:
            if arguments.runs and f"{target}-{kind}" not in arguments.runs:
                continue
            fields = {**SECOND, **SIZES[arguments.size], **KINDS[kind], "target": target}
            if arguments.size != "tiny":
                # Few numbers of steps: few graphs.
                fields["steps"] = (62, 64)
            for name in ("iterations", "initial_rule", "optimiser", "learning_rate"):
                if getattr(arguments, name):
                    fields[name] = getattr(arguments, name)
            fields |= {"repeats": 1, "tensorboard": False, "picture_interval": 0}
            fields |= {"checkpoint_interval": 10**9, "device": arguments.device}
            out = arguments.out / "runs" / f"{target}-{kind}"
            configs.append(preset("paper", **fields, out=out))
            names.append(f"{target}-{kind}")
    trainers, seconds = train_side_by_side(configs, arguments.longest, arguments.out)
    print(f"{len(names)} runs, {trainers[0].iteration} iterations, {seconds:.1f} s together")


def tasks_of(config: Morphogenesis2DConfig, device: str) -> tuple[Morphogenesis2D, Morphogenesis2D]:
    """Return the task of a run, and one that compares worlds at the best angle."""
    task = Morphogenesis2D(config, device=device)
    blind = replace(
        config,
        equivariant=True,
        chiral=config.chiral or not config.equivariant,
        angles=config.angles or Morphogenesis2DConfig.angles,
    )
    return task, Morphogenesis2D(blind, device=device)


@torch.no_grad()
def measured(rule: npa_envs.NPARule, config: Morphogenesis2DConfig, device: str) -> dict[str, Any]:
    """Return losses at `STEPS`, and later losses of grown creatures left alone or turned by 90°."""
    task, blind = tasks_of(config, device)
    random = WorldRandom(SEEDS, device=device)
    x, s, *_ = task.seed(len(SEEDS), generator=random, device=device)
    found: dict[str, Any] = {"upright": {}, "best_angle": {}}
    done, grown = 0, (x, s)
    for steps in STEPS:
        x, s = run_on(rule, task, x, s, steps - done, random)
        done = steps
        found["best_angle"][steps] = blind.metric(x, s).tolist()
        if not task.config.equivariant:
            found["upright"][steps] = task.metric(x, s).tolist()
        if steps == GROWN:
            grown = x, s
    quarter = turns(torch.tensor(0.5 * math.pi), torch.ones(())).to(x)
    x, s = grown
    tall = turned(x, quarter.expand(len(x), 2, 2))
    for name, start in (("left_alone", x), ("turned", tall)):
        # The same masks for both.
        after = run_on(rule, task, start, s, AFTER, WorldRandom(SEEDS, device=device))
        found[name] = blind.metric(*after).tolist()
        found[f"{name}_angle"] = angles(blind.best_turn(*after))
    return found


def run_on(
    rule: npa_envs.NPARule, task: Morphogenesis2D, x: Tensor, s: Tensor, steps: int, random: Any
) -> tuple[Tensor, Tensor]:
    """Return x and s of worlds `steps` steps later, with the rollout options of a task."""
    return npa_envs.rollout(
        rule, x, s, steps, eps=task.eps, update_prob=task.update_prob, generator=random
    )


def angles(turn: Tensor) -> list[float]:
    """Return the angle of each turn [degrees]."""
    found: list[float] = torch.rad2deg(torch.atan2(turn[:, 1, 0], turn[:, 0, 0])).tolist()
    return found


def measure(arguments: argparse.Namespace) -> None:
    """Measure all rules in the folder."""
    found = {}
    for path in sorted(arguments.out.glob("*.safetensors")):
        metadata = rule_metadata(path)
        rule = npa_envs.load_rule(path, device=arguments.device)
        config = trained_config(path, metadata).task
        row = measured(rule, config, arguments.device)
        row = found[path.stem] = {"iterations": int(metadata["iteration"]), **row}
        means = {step: round(statistics.mean(row["best_angle"][step]), 4) for step in STEPS}
        print(path.stem, means, "turned", round(ratio(row), 3), flush=True)
        content = {"machine": machine(torch.device(arguments.device)), "rules": found}
        write_record(arguments.out / "directions.json", content)


def ratio(row: Mapping[str, Sequence[float]]) -> float:
    """Return the loss of turned creatures / that of creatures left alone."""
    return statistics.mean(row["turned"]) / statistics.mean(row["left_alone"])


class InTorch(npa_envs.NPARule):
    """A rule that runs in plain torch: overriding `forward` switches the kernels off."""

    def forward(self, perception: Tensor) -> Tensor:
        """Map perception vectors to updates."""
        return super().forward(perception)


RULES: Mapping[str, Callable[[], npa_envs.NPARule]] = {
    "plain": npa_envs.NPARule,
    "chiral": lambda: npa_envs.NPARule(equivariant=True, chiral=True),
    "mirrored": lambda: npa_envs.NPARule(equivariant=True),
    "chiral, in torch": lambda: InTorch(equivariant=True, chiral=True),
}
"""Rules whose steps are timed."""


def time_steps(arguments: argparse.Namespace) -> None:
    """Measure the time of a step of each kind of rule, with gradients and without."""
    found: dict[str, dict[str, float]] = {}
    device, steps = torch.device(arguments.device), arguments.steps
    for count in arguments.particles:
        side = 0.7 * math.sqrt(count / 4096)
        x = (torch.rand(8, count, 2, device=device) * 2.0 - 1.0) * side
        s = torch.zeros(8, count, 16, device=device)
        for kind, make in RULES.items():
            rule = make().to(device)
            row = found[f"8 x {count}, {kind}"] = {}
            for name, backward in (("inference", False), ("training", True)):
                row[name] = seconds_of(rule, x, s, steps, backward) / steps * 1e6
                print(count, kind, name, round(row[name], 1), "µs a step", flush=True)
    content = {"machine": machine(device), "steps": found}
    write_record(arguments.out / "directions_time.json", content)


def seconds_of(rule: npa_envs.NPARule, x: Tensor, s: Tensor, steps: int, backward: bool) -> float:
    """Return the median time of a rollout [s]."""
    times = []
    for _ in range(12):
        if x.is_cuda:
            torch.cuda.synchronize()
        begun = time.perf_counter()
        with torch.set_grad_enabled(backward):
            after = npa_envs.rollout(rule, x, s, steps, cuda_graph=True)
            if backward:
                sum(part.sum() for part in after).backward()  # type: ignore[union-attr]
        if x.is_cuda:
            torch.cuda.synchronize()
        times.append(time.perf_counter() - begun)
    return statistics.median(times[5:])


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("command", choices=("train", "measure", "time"))
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--targets", nargs="+", default=TARGETS)
    parser.add_argument("--kinds", nargs="+", default=tuple(KINDS))
    parser.add_argument("--runs", nargs="*", default=(), help="such as gecko-plain; default: all")
    parser.add_argument("--size", default="small")
    parser.add_argument("--iterations", type=int, default=0)
    parser.add_argument("--optimiser", default="adamw")
    parser.add_argument("--learning-rate", type=float, default=0.0)
    parser.add_argument("--initial-rule", default="", help="file of a rule of the same kind")
    parser.add_argument("--longest", type=float, default=math.inf)
    parser.add_argument("--particles", nargs="+", type=int, default=(4096,))
    parser.add_argument("--steps", type=int, default=64)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    {"train": train, "measure": measure, "time": time_steps}[arguments.command](arguments)


if __name__ == "__main__":
    main()
