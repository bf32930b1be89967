"""Decay and bounds of worlds of recipes.py after many steps."""

from __future__ import annotations

import argparse
import json
import math
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from recipe_arms import SEEDS
from torch import Tensor

from npa_envs.measure.accuracy import trained_rule_checks as long_runs
from npa_envs.measure.quality import RuleRunner, healing
from npa_envs.rule.files import load_rule
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D
from npa_envs.training import preset
from npa_envs.world.capture_cache import release_captures
from npa_envs.world.particles import Particles, combined
from npa_envs.world.rollout import rollout

MOTIONS = ("place", "angle", "affine", "deformation")
"""What a grown picture is moved by to be more like its target."""

GRID = 8
"""Displacements along each side of the field that a picture is deformed by."""


def moved(x: Tensor, motion: str, place: Tensor, affine: Tensor, field: Tensor) -> Tensor:
    """Return positions [1, N, 2] of one world, shifted by `place`, turned or bent by a motion."""
    away = x - x.mean(dim=1, keepdim=True)
    if motion == "angle":
        cosine, sine = affine[0, 0].cos(), affine[0, 0].sin()
        away = away @ torch.stack([cosine, sine, -sine, cosine]).view(2, 2)
    elif motion == "affine":
        away = away + away @ affine
    elif motion == "deformation":
        wide = F.interpolate(field, scale_factor=4, mode="bicubic", align_corners=True)
        at = x.detach().clamp(-1.0, 1.0)[:, None]
        away = away + F.grid_sample(wide, at, align_corners=True)[:, :, 0].transpose(1, 2)
    return away + place


def least_loss(task: Morphogenesis2D, x: Tensor, s: Tensor, motion: str) -> float:
    """Return the least splat loss of one world moved by a motion, found by 60 steps of Adam."""
    place = task.target.points.mean(dim=0).clone().requires_grad_()
    affine = torch.zeros(2, 2, requires_grad=True)
    field = torch.zeros(1, 2, GRID, GRID, requires_grad=True)
    optimiser = torch.optim.Adam([place, affine, field], lr=0.01)
    least = math.inf
    for _ in range(60):
        picture = task.picture(moved(x, motion, place, affine, field), s, centred=False)
        # |d| + d^2 as in `Morphogenesis2D.splat_errors`, which centres pictures itself.
        size = (picture - task.target_picture).abs()
        errors = size + size * size
        density = errors[..., 3]
        colour = errors[..., :3].mean(dim=-1) * torch.exp(-density.detach())
        loss = (density + task.config.colour_weight * colour).mean()
        least = min(least, loss.item())
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return least


def follow(arguments: argparse.Namespace) -> None:
    """Print how much of an old world's loss is due to motion of the whole world."""
    rule = load_rule(arguments.rule)
    task = Morphogenesis2D(preset(arguments.preset, target=arguments.target).task)
    generator = torch.Generator().manual_seed(SEEDS[0])
    x, s, *_ = task.seed(1, generator=generator)
    before = 0
    options = {"eps": task.eps, "update_prob": task.update_prob, "generator": generator}
    print(f"step  loss  {'  '.join(MOTIONS)}  motion in 64 steps, of it the whole's")
    for step in arguments.steps:
        with torch.no_grad():
            x, s = rollout(rule, x, s, step - before, **options)
            later, _ = rollout(rule, x, s, 64, **options)
        before = step
        least = "  ".join(f"{least_loss(task, x, s, motion):.3f}" for motion in MOTIONS)
        way = (later - x)[0]
        lengths = way.norm(dim=-1).mean(), way.mean(dim=0).norm()
        print(
            f"{step}  {float(task.metric(x, s)):.3f}  {least}  {lengths[0]:.1e}  {lengths[1]:.1e}"
        )


def endurance(
    home: long_runs.RuleWorlds, steps: int, generators: Sequence[torch.Generator]
) -> dict[str, Any]:
    """Return losses and metrics of the worlds of a rule, run for `steps` steps.

    A world's metrics are divided by those of the same world at the settled step. `generators` are
    the source of the run's update masks, and that of the steps that energies are measured in.
    """
    runner, energy_runner = (RuleRunner(home.rule, home.task, each) for each in generators)
    count = len(home.worlds.x)
    settled: list[dict[str, float]] = [{} for _ in range(count)]
    largest: list[dict[str, float]] = [{} for _ in range(count)]
    over: dict[int, str] = {}
    losses: dict[int, list[float]] = {}
    centroids = home.worlds.x.mean(1)
    for step, worlds in runner.at(long_runs.mark_steps(steps), home.worlds):
        x, s, *_ = worlds
        if not losses:
            centroids = x.mean(1)
        losses[step] = home.task.metric(x, s).tolist()
        for k in range(count):
            found = long_runs.measured(energy_runner, Particles(x[k : k + 1], s[k : k + 1]))
            if not found["not_finite"]:
                settled[k] = settled[k] or dict(found)
                found["drift"] = float((x[k].mean(0) - centroids[k]).norm())
                found = long_runs.relative(found, settled[k])
            beyond = long_runs.exceeded(found, long_runs.BOUNDS)
            if beyond:
                over.setdefault(k, f"{beyond} at step {step}")
            for key, value in found.items():
                largest[k][key] = max(value, largest[k].get(key, 0.0))
    return {
        "steps": steps,
        "worlds_within": count - len(over),
        "over": over,
        "worlds": largest,
        "loss": {step: statistics.fmean(values) for step, values in losses.items()},
        "worst_loss": {step: max(values) for step, values in losses.items()},
    }


def grown_rules(arguments: argparse.Namespace) -> Iterator[tuple[str, NPARule, Morphogenesis2D]]:
    """Yield the rules of `run`: name of the picture, rule, and task."""
    device = torch.device(arguments.device)
    for path in sorted(arguments.out.glob("rule-*.safetensors")):
        picture = next(p for p in arguments.pictures.glob("*.png") if f"-{p.stem}-" in path.name)
        config = preset(arguments.preset, target=str(picture)).task
        rule = load_rule(path, device=device).float().requires_grad_(False)
        yield picture.stem, rule, Morphogenesis2D(config, device=device)


def append_line(path: Path, line: dict[str, Any]) -> None:
    """Append a line of JSON to a file."""
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")


def run_healing(arguments: argparse.Namespace) -> None:
    """Damage worlds of the rules that `run` has left, of many seeds, a line of JSON each."""
    seeds = range(SEEDS[0], SEEDS[0] + arguments.count)
    grow, heal = arguments.steps
    for picture, rule, task in grown_rules(arguments):
        rows = healing(
            rule, task, grow_steps=grow, heal_steps=heal, seeds=seeds, device=arguments.device
        )
        if task.target_picture.is_cuda:
            release_captures()
        line = {"picture": picture, "healing": [asdict(row) for row in rows]}
        append_line(arguments.out / "healing.jsonl", line)
        print(f"{picture}: {'. '.join(row.summary for row in rows)}", flush=True)


def run_long(arguments: argparse.Namespace) -> None:
    """Run the rules that `run` has left for very long, a line of JSON each."""
    device = torch.device(arguments.device)
    for picture, rule, task in grown_rules(arguments):
        seeds = [
            task.seed(1, generator=torch.Generator(device).manual_seed(seed), device=device)
            for seed in SEEDS
        ]
        worlds = combined(torch.cat, seeds).map(torch.Tensor.float)
        home = long_runs.RuleWorlds(rule, task, worlds)
        generators = [torch.Generator(device).manual_seed(seed) for seed in (1, 2)]
        line = {"picture": picture} | endurance(home, arguments.steps, generators)
        append_line(arguments.out / "long.jsonl", line)
        print(f"{picture}: {line['worlds_within']} of {len(SEEDS)} {line['over']}", flush=True)
