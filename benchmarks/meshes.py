"""Recipes of 3D morphogenesis compared on meshes that they were not developed on.

An arm is a recipe with one change. `run` trains arms on meshes, several in parallel, and evaluates
the rules as `npa-envs evaluate` on unseen seeds. Every finished run is a line of JSON with its rule
and a picture: four held-out views of the target, and of one world after 128 steps and at the end.
`draw` writes the unseen meshes as files, `particles` fits particles to a mesh without a rule,
`report` prints the runs as a table.

    python benchmarks/meshes.py draw --out MESHES
    python benchmarks/meshes.py run --out OUT --device cuda --targets rocket --arms recipe
    python benchmarks/meshes.py report --out OUT
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable, Mapping
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import torch
from mesh_shapes import ellipsoid, grid_faces, joined, painted, turned, vertex_colours
from PIL import Image
from side_by_side import iterate_together, on, stream_of
from torch import Tensor

from npa_envs.atomic_files import write_text
from npa_envs.measure.benchmark_records import as_objects, current_commit, machine
from npa_envs.measure.quality import evaluate
from npa_envs.rule.files import load_rule, save_rule
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.morphogenesis3d import Morphogenesis3D
from npa_envs.tasks.targets.meshes import FloatArray, Mesh, load_mesh
from npa_envs.tasks.targets.views import Views, composited, drawn_views, some_views
from npa_envs.tasks.train_config import TrainConfig
from npa_envs.training import Trainer, override, preset
from npa_envs.training.task_table import config_to_dict
from npa_envs.world.capture_cache import release_captures
from npa_envs.world.particles import Particles

SEEDS = tuple(range(1_000_000, 1_000_008))
"""Seeds of the worlds that rules are measured on."""

STEPS = (32, 64, 128, 512, 2048)
"""Steps at which they are measured."""

Fields = Mapping[str, Any]

RECIPE: Fields = {
    "repeats": 1,
    "iterations": 3000,
    "state_dim": 24,
    "seed_radius": 0.7,
    "blur_sigma": 0.0,
    "pool_size": 32,
    "steps": (30, 34),
    "schedule": "cosine",
    "learning_rate": 2e-3,
    "max_age_range": (32, 4096),
    "damage_share": 0.25,
    "stillness_weight": 0.5,
    "escape_share": 5e-5,
    "escape_weight": 10.0,
    "damage_radius": 0.15,
    "clump_radius": 0.2,
    "cut_gap": 0.1,
    "initial_rule": "duck-v0",
    "sigma": 0.012,
    "opacity": 0.4,
}
"""The candidate as changes of the preset `paper`: findings of 2D, and an initial rule."""

FEWER: Fields = {"particle_count": 8192, "eps": 0.126, "sigma": 0.014, "opacity": 0.6}
"""Half of the particles, with the same number of neighbours and covered area."""

FEWEST: Fields = {"particle_count": 4096, "eps": 0.159, "sigma": 0.016, "opacity": 0.8}
"""A quarter."""

ARMS: Mapping[str, Fields] = {
    "recipe": {},
    "8192": FEWER,
    "4096": FEWEST,
    "4096, untrained": {**FEWEST, "initial_rule": "", "blur_sigma": 20.0, "blur_iterations": 200},
    "4096, rate 1e-3": {**FEWEST, "learning_rate": 1e-3},
    "4096, rest 2": {**FEWEST, "stillness_weight": 2.0},
    "4096, no rest": {**FEWEST, "stillness_weight": 0.0},
    "4096, half seeds": {
        **FEWEST,
        "max_age_range": (0, 0),
        "stillness_weight": 0.0,
        "seed_interval": 1,
        "fresh_share": 0.5,
    },
    "4096, steps 16 to 20": {**FEWEST, "steps": (16, 20)},
    "best": {},
}
"""What each arm changes of `RECIPE`; `best` is the preset itself."""

FAST_BEFORE: Fields = {
    "iterations": 1200,
    "pool_size": 8,
    "optimiser": "adamw",
    "learning_rate": 2e-3,
    "schedule": "milestones",
    "seed_interval": 1,
    "max_age_range": (0, 0),
    "damage_share": 1.0,
    "stillness_min_age": 512,
    "stillness_weight": 0.0,
    "anisotropy": 0.1,
    "isotropy_weight": 0.5,
    "escape_share": 0.0,
    "escape_weight": 0.0,
    "clump_radius": 0.0,
    "cut_gap": 0.0,
}
"""The preset `fast` as it was before Muon, over which its arms are laid."""

FAST_TOGETHER: Fields = {
    "schedule": "cosine",
    "escape_share": 1e-3,
    "escape_weight": 10.0,
    "clump_radius": 0.2,
    "cut_gap": 0.1,
}
"""What the preset `fast` of 2D has, in 3D."""

FAST_REST: Fields = {
    **FAST_TOGETHER,
    "max_age_range": (16, 4096),
    "damage_share": 0.5,
    "stillness_weight": 2.0,
}
"""Of two worlds one is young and damaged, one is grown and to rest."""

FAST_MUON: Fields = {
    "schedule": "cosine",
    "optimiser": "muon",
    "learning_rate": 5e-3,
    "anisotropy": 1.0,
    "isotropy_weight": 0.02,
}
"""Muon, and particles that may stretch."""

FAST_NOW: Fields = {
    **FAST_TOGETHER,
    **FAST_MUON,
    "pool_size": 32,
    "max_age_range": (16, 256),
    "damage_share": 0.5,
    "stillness_min_age": 48,
    "stillness_weight": 0.5,
}
"""The current preset `fast` with other iterations; seeds enter by max_age_range."""

FAST_ARMS: Mapping[str, Fields] = {
    "fast": {},
    "cosine": {"schedule": "cosine"},
    "cosine, rate 4e-3": {"schedule": "cosine", "learning_rate": 4e-3},
    "together": FAST_TOGETHER,
    "rest": FAST_REST,
    "muon": FAST_MUON,
    "muon, rest": FAST_NOW,
    "sigma 0.045": {"schedule": "cosine", "sigma": 0.045, "opacity": 0.6},
    "state 24": {"schedule": "cosine", "state_dim": 24},
}
"""What each arm changes of `FAST_BEFORE`."""


def make_knot() -> Mesh:
    """Return a trefoil knot, a round tube whose colour goes once through all hues, with rings."""
    t = np.linspace(0.0, 2.0 * np.pi, 480, endpoint=False)[:, None]
    around = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
    outward = np.concatenate((np.cos(2 * t), 0.0 * t, np.sin(2 * t)), axis=1)
    upward = np.array([0.0, 1.0, 0.0])
    # Away from the circle that the knot winds around; nearly across the knot's own way.
    away = np.cos(3 * t) * outward + np.sin(3 * t) * upward
    middle = 2.0 * outward + away
    along = np.roll(middle, -1, axis=0) - np.roll(middle, 1, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    away -= (away * along).sum(axis=1, keepdims=True) * along
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    across = np.cross(along, away)
    ring = (
        np.cos(around)[None, :, None] * away[:, None]
        + np.sin(around)[None, :, None] * across[:, None]
    )
    vertices = (middle[:, None] + 0.46 * ring).reshape(-1, 3)
    hue = 0.5 + 0.45 * np.cos(t - np.array([[0.0, 2.1, 4.2]]))
    ringed = np.where(np.sin(18.0 * t) > 0.6, 0.95, hue)
    colours = np.repeat(ringed, len(around), axis=0)
    return painted(vertices, grid_faces(len(t), len(around), closed=True), colours)


def make_fish() -> Mesh:
    """Return a clownfish: orange with white bands that are edged in black, fins and eyes."""
    orange, white, black = (0.95, 0.45, 0.08), (0.96, 0.96, 0.94), (0.06, 0.06, 0.08)

    def paint(ball: FloatArray) -> FloatArray:
        along = 0.75 * ball[:, 2] + 0.06 * np.cos(2.5 * ball[:, 1])
        colours = np.broadcast_to(orange, ball.shape).copy()
        for place in (0.40, -0.05, -0.48):
            colours[np.abs(along - place) < 0.11] = black
            colours[np.abs(along - place) < 0.075] = white
        return colours

    tilt = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 120)
    ball = turned([(float(np.cos(a)), float(np.sin(a))) for a in tilt], paint, corners=240)
    parts = [Mesh(ball.vertices * (0.24, 0.42, 0.75), ball.faces, ball.colours)]
    for up in (-0.16, 0.16):
        tail = ellipsoid((0.0, 0.0, 0.0), (0.045, 0.14, 0.26), orange)
        parts.append(_tilted(tail, -2.2 * up, (0.0, up, -0.92)))
    parts.append(ellipsoid((0.0, 0.42, -0.08), (0.045, 0.16, 0.34), orange))
    parts.append(ellipsoid((0.0, -0.40, -0.20), (0.045, 0.15, 0.18), orange))
    for side in (-1.0, 1.0):
        parts.append(ellipsoid((0.25 * side, -0.10, 0.20), (0.06, 0.10, 0.17), orange))
        parts.append(ellipsoid((0.15 * side, 0.11, 0.56), (0.05, 0.07, 0.07), white))
        parts.append(ellipsoid((0.18 * side, 0.11, 0.58), (0.035, 0.04, 0.04), black))
    return joined(parts)


def _tilted(mesh: Mesh, angle: float, centre: tuple[float, float, float]) -> Mesh:
    """Return a mesh turned around the x axis by an angle, and moved."""
    turn = np.array(
        [
            [1.0, 0.0, 0.0],
            [0.0, np.cos(angle), np.sin(angle)],
            [0.0, -np.sin(angle), np.cos(angle)],
        ]
    )
    return Mesh(mesh.vertices @ turn + np.asarray(centre), mesh.faces, mesh.colours)


UNSEEN: Mapping[str, Callable[[], Mesh]] = {"fish": make_fish, "knot": make_knot}
"""Meshes that no recipe was developed on."""


def ply(mesh: Mesh) -> str:
    """Return a mesh as a PLY file's text, with a colour at each corner."""
    shades: FloatArray = (255.0 * vertex_colours(mesh).clip(0.0, 1.0)).round()
    lines = ["ply", "format ascii 1.0", f"element vertex {len(mesh.vertices)}"]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += [f"property uchar {channel}" for channel in ("red", "green", "blue")]
    lines += [f"element face {len(mesh.faces)}", "property list uchar int vertex_indices"]
    lines.append("end_header")
    for place, shade in zip(mesh.vertices, shades, strict=True):
        lines.append(" ".join([*(f"{v:.6f}" for v in place), *(f"{c:.0f}" for c in shade)]))
    lines += [f"3 {a} {b} {c}" for a, b, c in mesh.faces]
    return "\n".join(lines) + "\n"


def draw(arguments: argparse.Namespace) -> None:
    """Write the unseen meshes."""
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name, make in UNSEEN.items():
        write_text(arguments.out / f"{name}.ply", ply(make()))


def sheet(task: Morphogenesis3D, worlds: list[tuple[Tensor, Tensor]]) -> Image.Image:
    """Return four held-out views of the target, and below it of each world's first."""
    held_out: Views = task.target.held_out
    chosen = torch.linspace(1, len(held_out.pictures) - 2, 4).long().to(held_out.pictures.device)
    shown = some_views(held_out, chosen)
    rows = [shown.pictures, *(task.views(x[:1], s[:1], shown.cameras)[0] for x, s in worlds)]
    white = shown.pictures.new_ones(3)
    pictures = [composited(views, white).clamp(0.0, 1.0).cpu() for views in rows]
    flat = torch.cat([torch.cat(list(views), dim=1) for views in pictures])
    return Image.fromarray((255.0 * flat).round().byte().numpy())


def run(arguments: argparse.Namespace) -> None:
    """Train, measure and draw, a group of runs after the other."""
    arguments.out.mkdir(parents=True, exist_ok=True)
    begun = time.perf_counter()
    runs = [(arm, target) for arm in arguments.arms for target in arguments.targets]
    for first in range(0, len(runs), arguments.together):
        group = runs[first : first + arguments.together]
        if time.perf_counter() - begun > arguments.seconds:
            print(f"no time for {group}", flush=True)
            continue
        trainers, seconds = train_side_by_side(arguments, group)
        for (arm, target), trainer in zip(group, trainers, strict=True):
            measure(arguments, arm, target, trainer, seconds, len(group))
        del trainers


def configuration(arguments: argparse.Namespace, arm: str, target: str) -> TrainConfig[Any]:
    """Return the settings of a run."""
    name = f"{arm.replace(',', '').replace(' ', '_')}-{Path(target).stem}{arguments.label}"
    fixed = {"tensorboard": False, "picture_interval": 0, "checkpoint_interval": 10**9}
    fixed |= {"target": target, "device": arguments.device, "out": arguments.runs / name}
    changes = own_changes(arguments, arm)
    if arm == "best":
        return preset("best", "morphogenesis3d", **changes, **fixed)
    if changes.get("initial_rule") and "eps" in changes:
        changes["initial_rule"] = rule_for(changes["initial_rule"], changes["eps"], fixed["out"])
    base = "paper" if arguments.size == "full" else "fast"
    config = preset(base, "morphogenesis3d", **changes, **fixed)
    if config.schedule == "milestones" and arguments.size == "fast":
        marks = (2 * config.iterations // 3, 7 * config.iterations // 8)
        config = override(config, milestones=marks)
    return config


def rule_for(source: str, eps: float, folder: Path) -> str:
    """Write a rule as one of another perception radius, with the same weights; return the file."""
    rule = load_rule(source)
    changed = NPARule(**{**rule.hyper_parameters(), "eps0": eps})
    changed.load_state_dict(rule.state_dict())
    folder.parent.mkdir(parents=True, exist_ok=True)
    path = folder.with_suffix(".first.safetensors")
    save_rule(changed, path)
    return str(path)


def own_changes(arguments: argparse.Namespace, arm: str) -> dict[str, Any]:
    """Return the settings in which a run differs from its preset."""
    fast = arguments.size == "fast"
    own = FAST_BEFORE | FAST_ARMS[arm] if fast else RECIPE | ARMS[arm]
    if arm == "best":
        own = {}
    changes = {**own, **json.loads(arguments.fields)}
    return {k: tuple(v) if isinstance(v, list) else v for k, v in changes.items()}


def train_side_by_side(
    arguments: argparse.Namespace, group: list[tuple[str, str]]
) -> tuple[list[Trainer], float]:
    """Train several rules, an iteration of each in turn; return the trainers and the seconds."""
    trainers, streams = [], []
    for arm, target in group:
        config = configuration(arguments, arm, target)
        streams.append(stream_of(arguments.device))
        with on(streams[-1]):
            task = make_task(config, target, arguments.device)
            trainers.append(Trainer(task, config, task_name="morphogenesis3d", overwrite=True))
    begun = time.perf_counter()

    def at(number: int) -> None:
        if number % 200 == 0:
            print(f"iteration {number}: {time.perf_counter() - begun:.1f} s", flush=True)

    longest, clock = arguments.longest or math.inf, arguments.clock or math.inf
    return trainers, iterate_together(trainers, streams, longest, clock=clock, at=at)


def make_task(config: TrainConfig[Any], target: str, device: str) -> Morphogenesis3D:
    """Return a run's task; unseen meshes are drawn without a file, so nothing has to read one."""
    views = None
    if target in UNSEEN:
        own = config.task
        counts = own.resolution, own.training_views, own.held_out_views
        views = drawn_views(UNSEEN[target]().fitted(), target, *counts)
    return Morphogenesis3D(config.task, target=views, device=device)


def measure(
    arguments: argparse.Namespace,
    arm: str,
    target: str,
    trainer: Trainer,
    seconds: float,
    together: int,
) -> None:
    """Measure a trained rule, and write the results."""
    out, config = arguments.out, trainer.config
    rule = trainer.saved_rule
    save_rule(rule, out / f"{config.out.name}.safetensors", metadata=context_info(trainer))
    task = trainer.task.for_rule(rule)
    worlds = []

    def watch(x: Tensor, s: Tensor, step: int) -> None:
        if step in (128, arguments.steps[-1]):
            worlds.append((x, s))

    rows = evaluate(
        rule,
        task,
        checkpoints=arguments.steps,
        seeds=SEEDS[: arguments.seeds],
        device=arguments.device,
        watch=watch,
    )
    if arguments.device.startswith("cuda"):
        release_captures()
    with torch.no_grad():
        sheet(task, worlds).save(out / f"{config.out.name}.png")
    line = {"size": arguments.size, "arm": arm, "target": Path(target).stem}
    line |= {"fields": own_changes(arguments, arm), "iterations": trainer.iteration}
    line |= {"seconds": round(seconds, 1), "together": together, "clock": arguments.clock}
    line |= {"growth": as_objects(rows), **origin(arguments)}
    with (out / "meshes.jsonl").open("a", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")
    told = "  ".join(f"{row.step}: {row.psnr:.2f}" for row in rows)
    print(f"{config.out.name:32s} {trainer.iteration} in {seconds:.0f} s  {told}", flush=True)


def context_info(trainer: Trainer) -> dict[str, str]:
    """Return the task configuration in a rule's file."""
    told = config_to_dict(trainer.config)
    told = {name: told[name] for name in told if name not in ("out", "device", "initial_rule")}
    return {
        "task": trainer.task_name,
        "config": json.dumps(told),
        "iteration": str(trainer.iteration),
    }


def origin(arguments: argparse.Namespace) -> dict[str, str]:
    """Return machine and commit, for a line of results."""
    commit = arguments.commit or current_commit()
    made_on = machine(torch.device(arguments.device))
    return {"commit": commit, "date": date.today().isoformat(), "machine": made_on}


def particles(arguments: argparse.Namespace) -> None:
    """Let round particles on the surface itself follow the loss: how well can they draw at all?"""
    arguments.out.mkdir(parents=True, exist_ok=True)
    for target in arguments.targets:
        for sigma, opacity in zip(arguments.sigmas, arguments.opacities, strict=True):
            fields = {"target": target, "sigma": sigma, "opacity": opacity, "blur_sigma": 0.0}
            fields |= json.loads(arguments.fields)
            config = preset("paper", "morphogenesis3d", **fields).task
            task = Morphogenesis3D(config, device=arguments.device)
            places, shades = surface(load_mesh(target), config.particle_count)
            x = places[None].to(arguments.device).requires_grad_()
            s = (shades[None] - 0.5).to(arguments.device).requires_grad_()
            optimiser = torch.optim.Adam([{"params": [x], "lr": 2e-3}, {"params": [s], "lr": 3e-2}])
            fall = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, arguments.iterations)
            for number in range(arguments.iterations):
                task.begin(number)
                loss, _ = task.compare(Particles(x, s))
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()
                fall.step()
            with torch.no_grad():
                psnr = task.view_psnr(x, s).item()
            line = {"target": Path(target).stem, "sigma": sigma, "opacity": opacity, "psnr": psnr}
            line |= {"iterations": arguments.iterations, **origin(arguments)}
            with (arguments.out / "particles.jsonl").open("a", encoding="utf-8") as file:
                file.write(json.dumps(line) + "\n")
            print(f"{target:10s} sigma {sigma:g}, opacity {opacity:g}: {psnr:.2f} dB", flush=True)


def surface(mesh: Mesh, count: int) -> tuple[Tensor, Tensor]:
    """Return points spread evenly over a mesh [length units] and their colours, [count, 3] each."""
    random = np.random.default_rng(0)
    corners, shades = mesh.vertices[mesh.faces], mesh.colours
    sides = corners[:, 1:] - corners[:, :1]
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    face = random.choice(len(area), count, p=area / area.sum())
    share = random.dirichlet((1.0, 1.0, 1.0), count)[..., None]
    places, colours = (
        torch.from_numpy((share * values[face]).sum(axis=1)).float() for values in (corners, shades)
    )
    return places, colours


def report(arguments: argparse.Namespace) -> None:
    """Print the PSNR of all runs as a table."""
    print("| arm | mesh | iterations | seconds | " + " | ".join(map(str, arguments.steps)) + " |")
    print("|---|---|---|---|" + "---|" * len(arguments.steps))
    for text in (arguments.out / "meshes.jsonl").read_text(encoding="utf-8").splitlines():
        line = json.loads(text)
        by_step = {row["step"]: row["psnr"] for row in line["growth"]}
        cells = " | ".join(f"{by_step[s]:.1f}" if s in by_step else "" for s in arguments.steps)
        first = f"| {line['arm']} | {line['target']} | {line['iterations']} |"
        print(f"{first} {line['seconds']:.0f} | {cells} |")


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("draw", "run", "particles", "report"))
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    parser.add_argument("--targets", nargs="+", default=["rocket", "mushroom"])
    parser.add_argument("--size", choices=("full", "fast"), default="full")
    parser.add_argument("--arms", nargs="+", default=["recipe"], help="of the size")
    parser.add_argument("--sigmas", type=float, nargs="+", default=[0.02, 0.014, 0.01, 0.008])
    parser.add_argument("--opacities", type=float, nargs="+", default=[0.15, 0.3, 0.5, 0.7])
    parser.add_argument("--iterations", type=int, default=60, help="of particles without a rule")
    parser.add_argument("--fields", default="{}", help="fields to change in all arms, as JSON")
    parser.add_argument("--label", default="", help="last part of the files' names")
    parser.add_argument("--steps", type=int, nargs="+", default=list(STEPS))
    parser.add_argument("--seeds", type=int, default=len(SEEDS), help="worlds to measure")
    parser.add_argument("--longest", type=float, help="seconds of a run, at most")
    parser.add_argument("--clock", type=float, help="seconds of a cosine that follows the time")
    parser.add_argument("--together", type=int, default=1, help="runs in parallel")
    parser.add_argument("--seconds", type=float, default=1e9, help="begin no run later")
    parser.add_argument("--commit", help="what the lines name, where files are no checkout")
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    commands = {"draw": draw, "run": run, "particles": particles, "report": report}
    commands[arguments.what](arguments)


if __name__ == "__main__":
    main()
