"""Train two rules apart and together, and measure each by its own particles; see --help.

The runs, each in its own folder: separate-0 and separate-1 learn alone, each in its own worlds;
`together` learns both rules in the world that they share; with --frozen, in frozen-0 the first
rule is that of separate-0 and stays as it is while the second one learns beside it, in frozen-1
the other way round. All have the same schedule, iterations, seed and particles of each species.
--only trains one of them, so that several processes can share the work; without it whatever is
missing is trained, and then all is measured: in worlds that start from the same unseen seeds.
Stopped runs go on where they were. JSON holds the table and how it was made, the picture shows one
world of each way to share it.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import sys
from collections.abc import Sequence
from dataclasses import fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from npa_envs.devices import check_device
from npa_envs.files import write_text
from npa_envs.measure.speed.report import script_facts
from npa_envs.render import draw_worlds, write_filmstrip
from npa_envs.rule.files import load_rule
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.co_morphogenesis2d import CoMorphogenesis2D, CoMorphogenesis2DConfig
from npa_envs.training import RunFolder, TrainConfig, override, preset, train, train_together
from npa_envs.training.checkpoint import check_same_run, load_checkpoint
from npa_envs.world.randomness import WorldRandom
from npa_envs.world.species import rollout_species

FIRST_SEED = 1_000_000
"""The first measured world's number; training uses others."""

SEPARATE, FROZEN = ("separate-0", "separate-1"), ("frozen-0", "frozen-1")
RUNS = (*SEPARATE, "together", *FROZEN)
"""Every run, in an order in which each finds what it needs."""

ALONE, APART, TOGETHER = "separate, alone", "separate, shared world", "together, shared world"
"""What is measured: rules trained apart, alone and put together, and rules trained together."""

PICTURE_SIDE = 192
"""Pixels on each side of a picture."""


class Run(NamedTuple):
    """A run of training."""

    task_name: str
    config: TrainConfig[Any]


def plan(arguments: argparse.Namespace) -> dict[str, Run]:
    """Return every run by its name."""
    common = {"seed": arguments.seed, "tensorboard": False, "picture_interval": 0}
    base = preset(arguments.preset, "co_morphogenesis2d", device=arguments.device, **common)
    if arguments.repeats:
        base = override(base, repeats=arguments.repeats)
    if arguments.iterations:
        # Milestones stay at their shares of the run.
        share = arguments.iterations / base.iterations
        stones = sorted({max(1, round(share * stone)) for stone in base.milestones})
        base = override(base, iterations=arguments.iterations, milestones=stones)
    count = arguments.particle_count
    counts = {"particle_count": count, "target_point_count": count} if count else {}
    species = [{"target": target, **counts} for target in arguments.targets]
    base = override(base, species=species, distance=arguments.distance)
    together = {name: replace(base, out=arguments.runs / name) for name in ("together", *FROZEN)}
    runs = {name: Run("co_morphogenesis2d", config) for name, config in together.items()}
    schedule = {field.name: getattr(base, field.name) for field in fields(TrainConfig)}
    for name, own in zip(SEPARATE, base.task.species, strict=True):
        schedule |= {"task": own, "out": arguments.runs / name}
        runs[name] = Run("morphogenesis2d", TrainConfig(**schedule))
    return runs


def finished(run: Run) -> float | None:
    """Return how long a run took [s], None where it is not finished; wherever it was trained."""
    path = RunFolder(run.config.out).checkpoint
    if not path.is_file():
        return None
    content = load_checkpoint(path)
    device = content["config"].get("device", run.config.device)
    check_same_run(content, run.task_name, replace(run.config, device=device), path)
    done = content["iteration"] == run.config.total_iterations
    return float(content["seconds"]) if done else None


def rules_of(run: Run, device: torch.device) -> list[NPARule]:
    """Return the rules that a finished run has left."""
    folder = RunFolder(run.config.out)
    paths = [folder.rule]
    if run.task_name == "co_morphogenesis2d":
        paths = [folder.rule_of(number) for number in range(len(run.config.task.species))]
    return [load_rule(path, device=device).float().requires_grad_(False) for path in paths]


def trained(name: str, runs: dict[str, Run], max_seconds: float | None) -> float:
    """Train what is missing of a run, and return how long all of it took [s]."""
    run = runs[name]
    seconds = finished(run)
    if seconds is None:
        begun = RunFolder(run.config.out).checkpoint.is_file()
        options: dict[str, Any] = {"resume": begun, "max_seconds": max_seconds}
        options["progress"] = sys.stderr.isatty()
        print(f"{name}: {run.config.total_iterations} iterations", flush=True)
        if name in FROZEN:
            result = train_together(run.config, beside_frozen(name, runs), **options)
        else:
            result = train(run.config, run.task_name, **options)
        seconds = finished(run)
        if seconds is None:
            sys.exit(f"{name} stopped at iteration {result.iteration}: the same command goes on")
    print(f"{name}: {seconds:.0f} s", flush=True)
    return seconds


def beside_frozen(name: str, runs: dict[str, Run]) -> list[NPARule]:
    """Return what a run starts from whose one rule was trained alone and does not learn any more.

    The other one is untrained, with the weights that it begins with in `together`.
    """
    stays = FROZEN.index(name)
    alone = runs[SEPARATE[stays]]
    if finished(alone) is None:
        sys.exit(f"{name} needs the rule of {SEPARATE[stays]}: train that first")
    generator = torch.Generator().manual_seed(alone.config.seed)
    rules = CoMorphogenesis2D(runs[name].config.task).make_rules(generator)
    (rules[stays],) = rules_of(alone, torch.device("cpu"))
    return rules


class Nursery:
    """Grows species from the same unseen seeds, alone or in one world, and measures each.

    Args:
        config: The species and where they are seeded.
        steps: When they are measured, increasing.
        world_count: Worlds B.
        device: Where to run.
    """

    def __init__(
        self,
        config: CoMorphogenesis2DConfig,
        steps: Sequence[int],
        world_count: int,
        device: torch.device,
    ) -> None:
        self.config, self.steps = config, steps
        self.rows: list[dict[str, Any]] = []
        """The table so far; None stands for the infinite loss of a world that blew up."""
        self.frames: list[Any] = []
        """Pictures of the first of each shared world: its seed, and one at each step."""
        self.captions: list[str] = []
        """One for each picture."""
        self._task = CoMorphogenesis2D(config, device=device)
        self._seeds, self._device = range(FIRST_SEED, FIRST_SEED + world_count), device

    @torch.no_grad()
    def grow(self, living: str, rules: Sequence[NPARule], species: Sequence[int]) -> None:
        """Grow some species in worlds of their own, and note what becomes of them.

        Args:
            living: What the table calls it.
            rules: One for each of these species.
            species: Their numbers.
        """
        counts = [self.config.counts[k] for k in species]
        random = WorldRandom(self._seeds, device=self._device)
        everything = self._task.seed(len(self._seeds), generator=random, device=self._device)
        # Where a species is alone it starts just where it does beside the other one.
        split = [tensor.split(self.config.counts, dim=1) for tensor in everything]
        x, s = (torch.cat([parts[k] for k in species], dim=1) for parts in split)
        lost = torch.zeros(len(x), dtype=torch.bool, device=self._device)
        losses: list[dict[str, list[float]]] = [{} for _ in species]
        self._shoot(living, x, s, 0, species)
        for now, then in pairwise((0, *self.steps)):
            new_x, new_s = rollout_species(
                rules, x, s, then - now, counts=counts, density_counts=counts,
                update_prob=self._task.update_prob, generator=random,
            )  # fmt: skip
            # A world that blew up must not keep the others from being measured.
            fine = new_x.isfinite().all(dim=(1, 2)) & new_s.isfinite().all(dim=(1, 2))
            x = torch.where(fine[:, None, None], new_x, x)
            s = torch.where(fine[:, None, None], new_s, s)
            lost |= ~fine
            self._shoot(living, x, s, then, species)
            parts = zip(species, losses, x.split(counts, 1), s.split(counts, 1), strict=True)
            for number, own, own_x, own_s in parts:
                metric = self._task.tasks[number].metric(own_x, own_s)
                own[str(then)] = metric.masked_fill(lost, math.inf).tolist()
        for number, own in zip(species, losses, strict=True):
            target = self.config.species[number].target
            means = {step: statistics.fmean(values) for step, values in own.items()}
            print(f"{living:24}{target:10}" + "".join(f"{m:12.4f}" for m in means.values()))
            row = {"rules": living, "species": number, "target": target}
            row["loss"] = {step: finite(mean) for step, mean in means.items()}
            row["loss_of_worlds"] = {step: [*map(finite, own[step])] for step in own}
            self.rows.append(row)

    def _shoot(self, living: str, x: Tensor, s: Tensor, step: int, species: Sequence[int]) -> None:
        """Take a picture of the first world, where it is a shared one."""
        if len(species) < 2:
            return
        size, width = 0.5 * math.sqrt(4.0 / x.shape[1]), 1.2 + 0.5 * self.config.distance
        shown = {"resolution": PICTURE_SIDE, "pixel_size": size, "half_width": width}
        self.frames.extend(draw_worlds(x[:1], s[:1], **shown))
        self.captions.append(f"{living.split(',')[0]}, step {step}")


def finite(value: float) -> float | None:
    """Return a number as JSON can hold it."""
    return value if math.isfinite(value) else None


def options() -> argparse.Namespace:
    """Return what the command line says."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--targets", nargs=2, default=["ring", "heart"], help="names or pictures")
    parser.add_argument("--distance", type=float, default=0.8, help="between the seeds' centres")
    parser.add_argument("--preset", default="paper", help="what the runs start from")
    parser.add_argument("--iterations", type=int, help="of a repeat; default: the preset's")
    parser.add_argument("--repeats", type=int, help="of the schedule; default: the preset's")
    parser.add_argument("--particle-count", type=int, help="of each species")
    parser.add_argument("--seed", type=int, default=0, help="randomness of training")
    parser.add_argument("--only", choices=RUNS, help="train this run and measure nothing")
    parser.add_argument("--frozen", action="store_true", help="also learn beside a rule that stays")
    parser.add_argument("--max-seconds", type=float, help="for each run; the same command goes on")
    parser.add_argument("--steps", type=int, nargs="+", default=[128, 512, 1024], help="measured")
    parser.add_argument("--worlds", type=int, default=8, help="measured")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads of torch")
    parser.add_argument("--commit", default="unknown", help="commit that is measured")
    parser.add_argument("--runs", type=Path, default=Path("runs/joint_training"))
    parser.add_argument("--output", type=Path, default=Path("runs/joint_training/report.json"))
    parser.add_argument("--picture", type=Path, default=Path("runs/joint_training/grown.png"))
    return parser.parse_args()


def main() -> None:
    """Train what is missing, measure, print a table, write JSON and a picture."""
    arguments = options()
    arguments.steps = sorted(set(arguments.steps))
    torch.set_num_threads(arguments.threads)
    runs = plan(arguments)
    every = RUNS if arguments.frozen else (*SEPARATE, "together")
    wanted = (arguments.only,) if arguments.only else every
    seconds = {name: trained(name, runs, arguments.max_seconds) for name in wanted}
    if arguments.only:
        return
    config = runs["together"].config
    device = check_device(arguments.device)
    nursery = Nursery(config.task, arguments.steps, arguments.worlds, device)
    print(f"{'rules':24}{'target':10}" + "".join(f"{f'step {k}':>12}" for k in arguments.steps))
    apart = [rules_of(runs[name], device)[0] for name in SEPARATE]
    for number, rule in enumerate(apart):
        nursery.grow(ALONE, [rule], [number])
    nursery.grow(APART, apart, [0, 1])
    nursery.grow(TOGETHER, rules_of(runs["together"], device), [0, 1])
    for name in FROZEN if arguments.frozen else ():
        nursery.grow(name, rules_of(runs[name], device), [0, 1])
    report = {
        **script_facts(arguments.commit, device),
        "targets": arguments.targets,
        "distance": arguments.distance,
        "particle_counts": config.task.counts,
        "preset": arguments.preset,
        "iterations": config.total_iterations,
        "seed": arguments.seed,
        "worlds": arguments.worlds,
        "training_seconds": seconds,
        "rows": nursery.rows,
    }
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.picture.parent.mkdir(parents=True, exist_ok=True)
    write_text(arguments.output, json.dumps(report, indent=1, allow_nan=False) + "\n")
    columns = 1 + len(arguments.steps)
    write_filmstrip(arguments.picture, nursery.frames, nursery.captions, columns=columns)
    print(f"wrote {arguments.output} and {arguments.picture}")


if __name__ == "__main__":
    main()
