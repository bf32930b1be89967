"""Rules of many pictures compared with rules of one picture of the same recipe.

`pictures` draws emoji that no other experiment uses, for training and held out; `ways` trains on
the same pictures with three ways to give a rule its code; `train` trains rules of many pictures
(KINDS) and controls of one picture each, in parallel; `measure` runs all of them on unseen seeds:
losses with the right code, with another code and after a switch, and PSNR of pictures grown by
codes of an encoder. Each writes its results to OUT.

    python benchmarks/many_pictures.py pictures --out PICTURES
    python benchmarks/many_pictures.py ways --targets FOLDER --out OUT
    python benchmarks/many_pictures.py train --targets FOLDER --controls 12 --out OUT --device cuda
    python benchmarks/many_pictures.py measure --held-out FOLDER --out OUT --device cuda
"""

from __future__ import annotations

import argparse
import math
import random
import statistics
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from emoji_sets import DRAWN, single_emoji
from recipe_arms import SECOND, SIZES
from recipes import train_side_by_side
from torch import Tensor, nn

import npa_envs
from npa_envs.measure.benchmark_records import machine, write_record
from npa_envs.measure.quality import (
    MEDIAN,
    PICTURE_CHECKPOINTS,
    PictureRow,
    grown,
    picture_rows,
    psnr,
)
from npa_envs.rule.files import rule_metadata
from npa_envs.tasks.many_pictures import ManyPictures, named_targets
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D
from npa_envs.training import Trainer, preset
from npa_envs.training.task_of_rule import trained_config

KINDS: Mapping[str, Mapping[str, Any]] = {
    "codes": {},
    "wide": {"code_dim": 16, "hidden_dim": 256},
    "encoder": {"encoder": True, "code_dim": 16, "hidden_dim": 256},
    "encoder-32": {"encoder": True, "code_dim": 32, "hidden_dim": 256},
}
"""Rules of many pictures: 8 learned numbers a picture and as many hidden units as the controls; 16
and more units; 16 that are read from the picture, and 32."""

LOCAL: Mapping[str, Any] = {"particle_count": 256, "target_point_count": 256}
"""Worlds of the preset `fast` with half of its particles: for one core."""

MANY_FIELDS = (
    "world_count",
    "pool_size",
    "fresh_share",
    "learning_rate",
    "hidden_dim",
    "code_dim",
    "switch_share",
    "weight_decay",
)
"""Further options of rules of many pictures."""

SEEDS = tuple(range(1000, 1004))
"""Seeds of the worlds that rules are measured on."""

STEP = PICTURE_CHECKPOINTS[1]
"""Steps after which rules are compared with each other."""

TRAINED, HELD_OUT = 60, 20
"""Default numbers of pictures for training, and held-out ones."""


def draw_pictures(arguments: argparse.Namespace) -> None:
    """Write random emoji as PNG files, always the same ones of the same font."""
    emoji = single_emoji()
    taken = random.Random(0).sample(list(emoji), 2 * DRAWN)
    left = [name for name in emoji if name not in taken]
    drawn = random.Random(1).sample(left, TRAINED + HELD_OUT)
    rest = [name for name in left if name not in drawn]
    more = random.Random(3).sample(rest, max(0, arguments.count - TRAINED))
    train, held_out = (drawn[:TRAINED] + more)[: arguments.count], drawn[TRAINED:]
    folders = {"development": taken[:DRAWN], "train": train, "held-out": held_out}
    for folder, names in folders.items():
        (arguments.out / folder).mkdir(parents=True, exist_ok=True)
        for name in names:
            emoji[name].save(arguments.out / folder / f"{name}.png", optimize=True)


class Film(npa_envs.NPARule):
    """A rule whose hidden units are scaled by its code: FiLM (arXiv 1709.07871)."""

    def __init__(self, *args: Any, **told: Any) -> None:
        super().__init__(*args, **told)
        self.scale = nn.Linear(self.code_dim, self.hidden_dim)
        nn.init.zeros_(self.scale.weight)
        nn.init.zeros_(self.scale.bias)

    def forward(self, perception: Tensor) -> Tensor:
        """Map perception vectors to updates."""
        scale = 1.0 + self.scale(perception[..., : self.code_dim])
        return self.updates(torch.relu(scale * self.hidden(perception)))

    def updates(self, hidden: Tensor) -> Tensor:
        """Return updates, which are 0 for the code."""
        return nn.functional.linear(hidden, self.update_weight)


class Hyper(Film):
    """A rule whose first layer a linear hypernetwork changes by a matrix of rank 8."""

    def __init__(self, *args: Any, **told: Any) -> None:
        super().__init__(*args, **told)
        del self.scale
        self.down = nn.Linear(self.perception_dim, 8, bias=False)
        self.middle = nn.Linear(self.code_dim, 64)
        self.up = nn.Linear(8, self.hidden_dim, bias=False)
        for module in (self.down, self.middle, self.up):
            nn.init.xavier_uniform_(module.weight, gain=0.3)

    def forward(self, perception: Tensor) -> Tensor:
        """Map perception vectors to updates."""
        weights = self.middle(perception[..., : self.code_dim]).unflatten(-1, (8, 8))
        changed = (weights @ self.down(perception)[..., None])[..., 0]
        return self.updates(torch.relu(self.hidden(perception) + self.up(changed)))


WAYS: Mapping[str, type[npa_envs.NPARule]] = {
    "concatenation": npa_envs.NPARule,
    "film": Film,
    "hypernetwork": Hyper,
}
"""Ways to give a rule its code: only as further perceived channels, or also as these."""


class WayTask(ManyPictures):
    """A task of many pictures whose rule is of a given kind."""

    kind: type[npa_envs.NPARule] = npa_envs.NPARule

    def make_rule(self, generator: torch.Generator) -> npa_envs.NPARule:
        """Return an untrained rule of the kind."""
        config = self.config
        with torch.random.fork_rng(devices=()):
            torch.manual_seed(int(torch.randint(2**31, (), generator=generator)))
            return self.kind(hidden_dim=config.hidden_dim, eps0=config.eps, **self.rule_shape)


def fields_of(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the settings of all runs of a call."""
    if arguments.size == "local":
        fields = dict(LOCAL)
    elif arguments.size == "fast":
        # Few numbers of steps: few graphs.
        fields = {"steps": (23, 25)}
    else:
        fields = {**SECOND, **SIZES[arguments.size]}
        if arguments.size != "tiny":
            # Few numbers of steps: few graphs.
            fields["steps"] = (62, 64)
    if arguments.iterations:
        fields["iterations"] = arguments.iterations
    fields |= {"repeats": 1, "tensorboard": False, "picture_interval": 0, "log_interval": 50}
    if arguments.optimiser:
        fields["optimiser"] = arguments.optimiser
    if arguments.max_age_range:
        fields |= {"max_age_range": tuple(arguments.max_age_range), "damage_share": 0.5}
    return fields | {"checkpoint_interval": 10**9, "device": arguments.device}


def base_of(arguments: argparse.Namespace) -> str:
    """Return the preset that runs begin from."""
    return "fast" if arguments.size in ("local", "fast") else "paper"


def many_fields(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the further settings of rules of many pictures."""
    fields: dict[str, Any] = {"targets": tuple(arguments.targets)}
    for name in MANY_FIELDS:
        value = getattr(arguments, name)
        if value is not None:
            fields[name] = value
    if arguments.many_iterations:
        fields["iterations"] = arguments.many_iterations
    return fields


def ways(arguments: argparse.Namespace) -> None:
    """Train and measure rules of the pictures by each way."""
    found: dict[str, Any] = {}
    for name in arguments.kinds or WAYS:
        told = fields_of(arguments) | many_fields(arguments)
        out = arguments.out / "runs" / name
        config = preset(base_of(arguments), **told, out=out)
        task = WayTask(config.task, device=arguments.device)
        task.kind = WAYS[name]
        begun = time.process_time()
        trainer = Trainer(task, config, task_name="morphogenesis2d", overwrite=True)
        result = trainer.run(progress=False, max_seconds=arguments.longest)
        rows = measured(result.rule, config.task, arguments.device)
        found[name] = {
            "iterations": result.iteration,
            "processor_seconds": round(time.process_time() - begun, 1),
            "weights": result.rule.weight_count,
            "rows": rows,
        }
        print(name, result.iteration, median_losses(rows), flush=True)
        write_record(arguments.out / "ways.json", record(arguments, found))


def record(arguments: argparse.Namespace, found: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of a record."""
    told = {
        name: [str(Path(one).name) for one in value] if name == "targets" else value
        for name, value in vars(arguments).items()
        if name not in ("out", "held_out", "command")
    }
    return {"machine": machine(torch.device(arguments.device)), "told": told, "rules": found}


def tasks_of(rule: npa_envs.NPARule, config: Any, device: str) -> list[Morphogenesis2D]:
    """Return the task of each picture that a rule has a code for."""
    sources = named_targets(config.targets)
    return [
        Morphogenesis2D(replace(config, target=source, targets=()), device=device).for_rule(rule)
        for source in sources.values()
    ]


def measured(rule: npa_envs.NPARule, config: Any, device: str) -> list[dict[str, Any]]:
    """Return the rows of a rule's pictures."""
    tasks = tasks_of(rule, config, device)
    return [asdict(row) for row in picture_rows(rule, tasks, seeds=SEEDS, device=device)]


def median_losses(rows: Sequence[Mapping[str, Any]]) -> dict[int, str]:
    """Return the median loss and the median shuffled loss at each step, for people."""
    return {
        row["step"]: f"{row['loss']:.3f}, shuffled {row['shuffled']:.3f}"
        for row in rows
        if row["target"] == MEDIAN
    }


def train(arguments: argparse.Namespace) -> None:
    """Train rules of many pictures, and then the controls in parallel.

    With `--many-seconds` the rules of many pictures train for so long, and their cosines fall with
    the time. `--share K N` trains every Nth control from the Kth on.
    """
    told, many = fields_of(arguments), many_fields(arguments)
    sources = named_targets(arguments.targets)
    chosen = random.Random(2).sample(list(sources), min(arguments.controls, len(sources)))
    kinds = {kind: told | many | KINDS[kind] for kind in arguments.kinds or KINDS if kind != "none"}
    clock = arguments.many_seconds or math.inf
    if arguments.many_seconds:
        for fields in kinds.values():
            fields["iterations"] = 10**6
    first, step = arguments.share
    controls = {f"control-{name}": told | {"target": sources[name]} for name in chosen[first::step]}
    for wanted, own_clock in ((kinds, clock), (controls, math.inf)):
        if not wanted:
            continue
        configs = [
            preset(base_of(arguments), **fields, out=arguments.out / "runs" / name)
            for name, fields in wanted.items()
        ]
        trainers, seconds = train_side_by_side(configs, arguments.longest, arguments.out, own_clock)
        told_iterations = [t.iteration for t in trainers]
        print(f"{[*wanted]}: {told_iterations} iterations, {seconds:.1f} s together", flush=True)


@torch.no_grad()
def measure(arguments: argparse.Namespace) -> None:
    """Measure all rules in the folder."""
    found: dict[str, Any] = {}
    device = arguments.device
    for path in sorted(arguments.out.glob("*.safetensors")):
        metadata = rule_metadata(path)
        rule = npa_envs.load_rule(path, device=device)
        config = trained_config(path, metadata).task
        row: dict[str, Any] = {"iterations": int(metadata["iteration"])}
        if rule.codes is None:
            row["rows"] = control_rows(rule, config, device)
            print(path.stem, {entry["step"]: round(entry["loss"], 3) for entry in row["rows"]})
        else:
            row["rows"] = measured(rule, config, device)
            row["switched"] = switched_rows(rule, tasks_of(rule, config, device), device)
            medians = (
                statistics.median(entry[kind] for entry in row["switched"])
                for kind in ("switched", "always")
            )
            print(path.stem, median_losses(row["rows"]), "switched, always:", *medians, flush=True)
            if rule.codes.encoder is not None and arguments.held_out:
                row["held_out"] = held_out_rows(rule, config, arguments.held_out, device)
                ratios = [entry["psnr"] for entry in row["held_out"]]
                print(path.stem, "held out", round(statistics.mean(ratios), 2), "dB", flush=True)
        found[path.stem] = row
        content = {"machine": machine(torch.device(device)), "rules": found}
        write_record(arguments.out / "many_pictures.json", content)
    print("ratios of medians", ratios_of(found))


def switched_rows(
    rule: npa_envs.NPARule, tasks: Sequence[Morphogenesis2D], device: str
) -> list[dict[str, Any]]:
    """Return the loss of each picture in worlds that were the next one, and got its code at `STEP`.

    As many steps later, beside that of worlds that had its code from the start, at `STEP`.
    """
    (before,) = grown(rule, tasks, checkpoints=(STEP,), seeds=SEEDS, device=device)
    x, s = (torch.roll(part, -1, dims=0) for part in before[:2])
    coded = torch.stack([task.with_target_code(own) for task, own in zip(tasks, s, strict=True)])
    x, s = npa_envs.rollout(
        rule,
        x.flatten(0, 1),
        coded.flatten(0, 1),
        STEP,
        eps=tasks[0].eps,
        update_prob=tasks[0].update_prob,
        generator=npa_envs.WorldRandom([*SEEDS] * len(tasks), device=device),
    )
    worlds = zip(tasks, x.split(len(SEEDS)), s.split(len(SEEDS)), *before[:2], strict=True)
    return [
        {
            "target": task.target.name,
            "switched": task.metric(own_x, own_s).mean().item(),
            "always": task.metric(old_x, old_s).mean().item(),
        }
        for task, own_x, own_s, old_x, old_s in worlds
    ]


def control_rows(rule: npa_envs.NPARule, config: Any, device: str) -> list[dict[str, Any]]:
    """Return the worlds of a rule of one picture."""
    task = Morphogenesis2D(config, device=device)
    rows = []
    worlds = grown(rule, [task], seeds=SEEDS, device=device)
    for step, (x, s, *_) in zip(PICTURE_CHECKPOINTS, worlds, strict=True):
        loss = task.metric(x[0], s[0]).mean().item()
        ratio = psnr(task.picture(x[0], s[0]), task.target_picture).mean().item()
        rows.append({"step": step, "target": task.target.name, "loss": loss, "psnr": ratio})
    return rows


def held_out_rows(
    rule: npa_envs.NPARule, config: Any, held_out: Sequence[str], device: str
) -> list[dict[str, Any]]:
    """Return a row for each unseen picture, grown from the code that the rule's encoder gives it.

    Beside it are the PSNR of an empty picture, and of the trained picture that comes closest.
    """
    known = tasks_of(rule, config, device)
    tasks = [
        Morphogenesis2D(replace(config, target=source, targets=()), device=device).for_rule(rule)
        for source in named_targets(held_out).values()
    ]
    rows = picture_rows(rule, tasks, checkpoints=(STEP,), seeds=SEEDS, device=device)
    return [asdict(row) | floors(row, task, known) for row, task in zip(rows, tasks, strict=False)]


def floors(
    row: PictureRow, task: Morphogenesis2D, known: Sequence[Morphogenesis2D]
) -> dict[str, Any]:
    """Return the PSNR of an empty picture, and of the closest trained picture, to a target [dB]."""
    target = task.target_picture
    blank = psnr(torch.zeros_like(target)[None], target).item()
    nearest = max(known, key=lambda other: psnr(other.target_picture[None], target).item())
    closest = psnr(nearest.target_picture[None], target).item()
    return {"blank": blank, "nearest": nearest.target.name, "nearest_psnr": closest}


def ratios_of(found: Mapping[str, Any]) -> dict[str, float]:
    """Return the median loss of each rule of many pictures over the controls', where both are."""
    controls = {
        entry["target"]: entry["loss"]
        for name, row in found.items()
        for entry in row["rows"]
        if name.startswith("control-") and entry["step"] == STEP
    }
    if not controls:
        return {}
    alone = statistics.median(controls.values())
    ratios = {}
    for name, row in found.items():
        if not name.startswith("control-"):
            own = [
                entry["loss"]
                for entry in row["rows"]
                if entry["step"] == STEP and entry["target"] in controls
            ]
            ratios[name] = round(statistics.median(own) / alone, 3)
    return ratios


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("command", choices=("pictures", "ways", "train", "measure"))
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--targets", nargs="+", default=("gecko", "heart"))
    parser.add_argument("--held-out", nargs="+", default=())
    parser.add_argument(
        "--count", type=int, default=TRAINED, help="pictures that are drawn to train"
    )
    parser.add_argument("--kinds", nargs="*", default=())
    parser.add_argument("--controls", type=int, default=12)
    parser.add_argument("--size", choices=("local", *SIZES), default="local")
    parser.add_argument("--iterations", type=int, default=0)
    parser.add_argument("--many-iterations", type=int, default=0)
    parser.add_argument("--longest", type=float, default=math.inf)
    parser.add_argument("--many-seconds", type=float, default=0.0)
    parser.add_argument("--max-age-range", type=int, nargs=2, help="ages of worlds, of all rules")
    parser.add_argument("--optimiser", help="of all rules; default: the preset's")
    parser.add_argument("--share", type=int, nargs=2, default=(0, 1))
    for name in MANY_FIELDS:
        kind = float if name.endswith(("share", "rate", "decay")) else int
        parser.add_argument(f"--{name.replace('_', '-')}", type=kind)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    commands = {"pictures": draw_pictures, "ways": ways, "train": train, "measure": measure}
    commands[arguments.command](arguments)


if __name__ == "__main__":
    main()
