"""Recipes of training compared: choices switched on and off, on random emoji.

An arm is a recipe with one choice changed. `run` trains every arm on every picture of a folder and
measures the rules as `npa-envs evaluate --healing` does, with seeds that training never saw; on a
GPU several runs share the device, each on a stream of its own. Every finished run is a line of
JSON, so that a stopped call can continue. `pictures` draws the emoji; `warm-up` compiles
all kernels and tests that runs side by side learn bit for bit what they learn alone; `merge` makes
one record, one sheet of pictures and one archive of rules of what several processes left; `report`
prints the tables and draws the figure; `sync_with` says what the decay of a rule's world is; `long`
runs finished rules for 100 000 steps within the bounds of `npa-envs stress`; `heal` wounds worlds
of 8 seeds, each at 32 places on a GPU.

    python benchmarks/recipes.py pictures --out PICTURES
    python benchmarks/recipes.py warm-up --device cuda --out OUT
    python benchmarks/recipes.py run --pictures PICTURES/development --device cuda --out OUT
    python benchmarks/recipes.py merge --out OUT
    python benchmarks/recipes.py report OUT/recipes.json --figure recipes.png
    python benchmarks/recipes.py follow RULE --target PICTURE.png
    python benchmarks/recipes.py long --pictures PICTURES/test --device cuda --out OUT
    python benchmarks/recipes.py heal --pictures PICTURES/test --device cuda --out OUT
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import shutil
import statistics
import sys
import tarfile
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from emoji_sets import draw_pictures
from old_worlds import append_line, follow, run_healing, run_long
from PIL import Image
from recipe_arms import ARMS, FAST_ARMS, SEEDS, SIZES, Run, configuration
from side_by_side import iterate_together, on, stream_of

from npa_envs.atomic_files import write_bytes
from npa_envs.errors import NPAError
from npa_envs.measure.accuracy import trained_rule_checks
from npa_envs.measure.benchmark_records import machine, write_record
from npa_envs.measure.plots import new_figure, number_plainly, png
from npa_envs.measure.quality import RuleRunner, evaluate, healing
from npa_envs.render.colours import to_uint8
from npa_envs.rule.files import save_rule
from npa_envs.tasks.morphogenesis2d import Morphogenesis2DTrainConfig
from npa_envs.training import Trainer, task_entry
from npa_envs.world.capture_cache import release_captures

STEPS = (64, 128, 256, 512, 1024, 2048, 4096)
"""Steps at which worlds are measured, before `LAST`."""

LAST = 20_000
"""The last step at which worlds are measured; of full size alone in the first three rounds."""

SIDE_BY_SIDE = 6
"""Runs of which the first is compared with one that has the device for itself."""

PACES: Mapping[str, Sequence[int]] = {"small": (1, 6), "full": (1, 3)}
"""Numbers of parallel runs to time."""


def train_side_by_side(
    configs: Sequence[Morphogenesis2DTrainConfig],
    longest: float = math.inf,
    kept: Path | None = None,
    clock: float = math.inf,
) -> tuple[list[Trainer], float]:
    """Train a rule for each configuration, in parallel; return the trainers and the duration [s].

    `longest` and `clock` are those of `iterate_together`. Every 512 iterations and at the end the
    rules are copied to the folder `kept`, by the names of the runs' folders; None: they are not.
    """
    device = torch.device(configs[0].device)
    streams, trainers = [], []
    for config in configs:
        streams.append(stream_of(device))
        with on(streams[-1]):
            task = task_entry("morphogenesis2d").make(config.task, device)
            trainers.append(Trainer(task, config, task_name="morphogenesis2d"))

    def at(number: int) -> None:
        if kept is not None and number and number % 512 == 0:
            keep(trainers, kept)

    seconds = iterate_together(trainers, streams, longest, clock=clock, ahead=64, at=at)
    if kept is not None:
        keep(trainers, kept)
    return trainers, seconds


def keep(trainers: Sequence[Trainer], folder: Path) -> None:
    """Save the rules of runs, and copy them to a folder, by the names of the runs' folders."""
    for trainer in trainers:
        trainer.save()
        shutil.copy(trainer.folder.rule, folder / f"{trainer.config.out.name}.safetensors")


def measured(trainer: Trainer, size: str, last_step: int = LAST) -> dict[str, Any]:
    """Return tables of a trained rule: growth; at a `last_step` of `LAST` healing; its pool."""
    task: Any = trainer.task
    rule = trainer.saved_rule
    worlds: dict[str, Any] = {"seeds": SEEDS, "device": trainer.config.device}
    steps = (4, 8) if size == "tiny" else (*STEPS, LAST)
    steps = tuple(step for step in steps if step <= last_step)
    grow, heal = (8, 8) if size == "tiny" else (1024, 1000)
    rows, healed = [], []
    # A rule may diverge; then what came before is kept.
    while steps and not rows:
        with contextlib.suppress(NPAError):
            rows = evaluate(rule, task, checkpoints=steps, **worlds)
        steps = steps[:-1]
    with contextlib.suppress(NPAError):
        if last_step == LAST:
            healed = healing(rule, task, grow_steps=grow, heal_steps=heal, **worlds)
    if trainer.config.device.startswith("cuda"):
        release_captures()
    found = {"growth": [asdict(row) for row in rows], "healing": [asdict(row) for row in healed]}
    pool = trainer.pool
    if pool.age is not None:
        with torch.no_grad():
            losses = task.metric(pool.worlds.x, pool.worlds.s).tolist()
        # What training saw last, place by place: age and loss.
        pairs = zip(pool.age.tolist(), losses, strict=True)
        found["pool"] = [[age, round(loss, 4)] for age, loss in pairs]
    return found


@torch.no_grad()
def strip(trainer: Trainer, steps: Sequence[int]) -> np.ndarray[Any, Any]:
    """Return a picture: the target, and beside it one world after each of `steps`, [R, W, 3]."""
    task: Any = trainer.task
    rule = trainer.saved_rule
    device = torch.device(trainer.config.device)
    runner = RuleRunner(rule, task.for_rule(rule), torch.Generator(device).manual_seed(SEEDS[0]))
    generator = torch.Generator(device).manual_seed(SEEDS[0])
    seed = task.seed(1, generator=generator, device=device)
    worlds = [now for _, now in runner.at(steps, seed)]
    frames = [task.target_picture[None], *(task.picture(now.x, now.s) for now in worlds)]
    picture = to_uint8(torch.cat([frame.cpu() for frame in frames]))
    side = max(1, picture.shape[1] // 128)
    return np.concatenate(list(picture[:, ::side, ::side]), axis=1)


def read_lines(folder: Path) -> list[dict[str, Any]]:
    """Return the results of all finished runs in a folder, one dict each."""
    merged = folder / "recipes.json"
    lines: list[dict[str, Any]] = []
    if merged.exists():
        lines = json.loads(merged.read_text("utf-8"))["runs"]
    for path in sorted(folder.glob("runs-*.jsonl")):
        for line in path.read_text("utf-8").splitlines():
            with contextlib.suppress(ValueError):
                lines.append(json.loads(line))
    return lines


def key_of(line: Mapping[str, Any]) -> Run:
    """Return the run that a line of results is of."""
    return Run(*(line[name] for name in ("size", "arm", "picture", "seed")))


def groups_of(runs: Iterable[Run], together: int) -> Iterator[list[Run]]:
    """Yield lists of at most `together` runs of one size."""
    group: list[Run] = []
    for run in runs:
        if group and (len(group) == together or group[0].size != run.size):
            yield group
            group = []
        group.append(run)
    if group:
        yield group


def run_all(arguments: argparse.Namespace) -> None:
    """Train and measure all runs of this process, a group at a time, until time is up."""
    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    deadline = time.perf_counter() + arguments.seconds
    pictures = {path.stem: path for path in sorted(arguments.pictures.glob("*.png"))}
    chosen = arguments.names or list(pictures)
    changes = json.loads(arguments.fields)
    changes = {k: tuple(v) if isinstance(v, list) else v for k, v in changes.items()}
    done = {key_of(line) for line in read_lines(out)}
    arms = arguments.arms or list(FAST_ARMS if arguments.size == "fast" else ARMS)
    runs = [
        Run(arguments.size, arm, picture, seed)
        for seed in arguments.seeds
        for arm in arms
        for picture in chosen
    ]
    together = arguments.together
    check = out / "check.json"
    if check.exists() and not json.loads(check.read_text(encoding="utf-8"))["same"]:
        together = 1
    longest = 0.0
    for group in groups_of((run for run in runs if run not in done), together):
        begun = time.perf_counter()
        if begun + longest > deadline:
            print(f"out of time before {group[0].name}", flush=True)
            return
        with tempfile.TemporaryDirectory() as folder:
            configs = [
                configuration(
                    run, pictures[run.picture], Path(folder) / run.name, arguments.device, changes
                )
                for run in group
            ]
            trainers, seconds = train_side_by_side(
                configs, arguments.longest, clock=arguments.clock
            )
            for run, trainer in zip(group, trainers, strict=True):
                line = asdict(run) | {"iterations": trainer.iteration, "seconds": seconds}
                line |= {"together": len(group), "fields": changes}
                if arguments.clock < math.inf:
                    line["clock"] = arguments.clock
                line |= measured(trainer, run.size, arguments.last_step)
                rule = trainer.saved_rule
                save_rule(rule, out / f"rule-{run.name}.safetensors")
                if arguments.strips:
                    steps = (4, 8) if run.size == "tiny" else (32, 64, 128, 512, 4096)
                    Image.fromarray(strip(trainer, steps)).save(out / f"strip-{run.name}.png")
                    if arguments.device.startswith("cuda"):
                        release_captures()
                append_line(out / f"runs-{arguments.process}.jsonl", line)
                losses = " ".join(f"{r['step']}:{r['loss']:.3f}" for r in line["growth"])
                print(f"{run.name} {seconds:.0f} s  {losses}", flush=True)
            del trainers
        longest = max(longest, time.perf_counter() - begun)


def warm_up(arguments: argparse.Namespace) -> None:
    """Compile kernels, and check that parallel runs learn the same as alone."""
    arguments.out.mkdir(parents=True, exist_ok=True)
    sizes = ["tiny"] if arguments.tiny else ["small", "full", "fast"]
    target = Path("gecko")
    weights = []
    with tempfile.TemporaryDirectory() as folder:

        def config(size: str, name: str, **fields: Any) -> Morphogenesis2DTrainConfig:
            run = Run(size, fields.pop("arm", "second"), name, fields.pop("seed", 0))
            # Few numbers of steps, each of which is a capture.
            few = fields if arguments.tiny else {"steps": (48, 50)} | fields
            return configuration(run, target, Path(folder) / name, arguments.device, few)

        for size in sizes:
            (trainer,), _ = train_side_by_side([config(size, f"{size}-first", iterations=8)])
            measured(trainer, "tiny")
        size = sizes[0]
        wide = config(size, "wide", iterations=3, hidden_dim=256)
        measured(train_side_by_side([wide])[0][0], "tiny")
        wide = config(size, "paper", iterations=8, arm="paper")
        measured(train_side_by_side([wide])[0][0], "tiny")
        for name in ("alone", "again"):
            (trainer,), _ = train_side_by_side([config(size, name, iterations=40)])
            weights.append(torch.nn.utils.parameters_to_vector(trainer.rule.parameters()))
        side = [config(size, f"side{k}", iterations=40, seed=k) for k in range(SIDE_BY_SIDE)]
        trainers, _ = train_side_by_side(side)
        weights.append(torch.nn.utils.parameters_to_vector(trainers[0].rule.parameters()))
        repeatable = torch.equal(weights[0], weights[1])
        same = torch.equal(weights[0], weights[2]) or not repeatable
        same = same and bool(torch.isfinite(weights[2]).all())
        found: dict[str, Any] = {"same": same, "repeatable": repeatable}
        write_record(arguments.out / "check.json", found)
        for size, counts in PACES.items() if arguments.paces else ():
            for count in counts:
                name = f"{size}-{count}"
                many = [config(size, f"{name}-{k}", iterations=60) for k in range(count)]
                found[f"{name}: seconds"] = train_side_by_side(many)[1]
        write_record(arguments.out / "check.json", found)
    print((arguments.out / "check.json").read_text(encoding="utf-8"), flush=True)


def merge(arguments: argparse.Namespace) -> None:
    """Merge the results of several processes into one record, one sheet and one archive."""
    out: Path = arguments.out
    record = {"machine": machine(torch.device(arguments.device)), "runs": read_lines(out)}
    write_record(out / "recipes.json", record)
    for path in out.glob("runs-*.jsonl"):
        path.unlink()
    with tarfile.open(out / "rules.tar", "w") as archive:
        for path in sorted(out.glob("rule-*.safetensors")):
            archive.add(path, path.name)
            path.unlink()
    strips = sorted(out.glob("strip-*.png"))
    if strips:
        rows = [np.asarray(Image.open(path)) for path in strips]
        width = max(row.shape[1] for row in rows)
        rows = [np.pad(r, ((0, 4), (0, width - r.shape[1]), (0, 0))) for r in rows]
        Image.fromarray(np.concatenate(rows)).save(out / "strips.png")
        (out / "strips.txt").write_text(
            "\n".join(path.stem for path in strips) + "\n", encoding="utf-8"
        )
    for path in strips:
        path.unlink()


REPORTED = (64, 128, 512, 1024, 4096, LAST)
"""Steps of the tables."""


def table(runs: Sequence[Mapping[str, Any]], size: str) -> str:
    """Return the arms of a size as a Markdown table: means over pictures and seeds, the worst."""
    arms: dict[str, list[Mapping[str, Any]]] = {}
    for run in runs:
        if run["size"] == size:
            arms.setdefault(run["arm"], []).append(run)
    steps = [n for n in REPORTED if any(_loss(r, n) is not None for a in arms.values() for r in a)]
    head = ["arm", "runs", "iterations", *map(str, steps), "worst from 128", "healed"]
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    for arm, own in arms.items():
        lengths = sorted({run["iterations"] for run in own})
        cells = [arm, str(len(own)), " to ".join(map(str, {lengths[0]: 0, lengths[-1]: 0}))]
        for step in steps:
            losses = [loss for run in own if (loss := _loss(run, step)) is not None]
            cells.append(f"{statistics.fmean(losses):.3f}" if losses else "")
        worst = max((_loss(r, n) or 0.0 for r in own for n in steps if n >= 128), default=0.0)
        rows = [row for run in own for row in run["healing"]]
        # Older records counted whole worlds.
        count = max(sum(r.get("changed", r.get("world_count")) for r in rows), 1)
        share = sum(r.get("healed", r.get("worlds_healed")) for r in rows) / count
        lines.append(f"| {' | '.join([*cells, f'{worst:.3f}', f'{share:.0%}'])} |")
    return "\n".join(lines)


def draw(runs: Sequence[Mapping[str, Any]]) -> bytes:
    """Return a PNG of the arms' mean losses against steps from the seed, a panel a size."""
    sizes = [size for size in SIZES if any(run["size"] == size for run in runs)]
    figure, ((*panels,),) = new_figure(1, len(sizes), (5.6 * len(sizes), 8.8))
    for size, panel in zip(sizes, panels, strict=True):
        own = [run for run in runs if run["size"] == size]
        for number, arm in enumerate(dict.fromkeys(run["arm"] for run in own)):
            members = [run for run in own if run["arm"] == arm]
            steps = [row["step"] for row in members[0]["growth"]]
            means = [statistics.fmean(_loss(run, step) or 0.0 for run in members) for step in steps]
            dashes = ("-", "--", ":", "-.")[number // 10 % 4]
            panel.plot(steps, means, dashes, color=f"C{number % 10}", label=arm)
        panel.set(xscale="log", yscale="log", title=size)
        panel.set(xlabel="steps from the seed", ylabel="splat loss, mean of pictures and seeds")
        number_plainly(panel.xaxis)
        number_plainly(panel.yaxis)
        panel.legend(fontsize=8, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.17))
    return png(figure)


def _loss(run: Mapping[str, Any], step: int) -> float | None:
    return next((row["loss"] for row in run["growth"] if row["step"] == step), None)


def report(arguments: argparse.Namespace) -> None:
    """Print the tables of a record, and draw its figure if requested."""
    runs = json.loads(arguments.record.read_text("utf-8"))["runs"]
    if arguments.figure:
        write_bytes(arguments.figure, draw(runs))
    for size in SIZES:
        if any(run["size"] == size for run in runs):
            print(f"\n{size}\n\n{table(runs, size)}")


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True)
    own = commands.add_parser("warm-up")
    own.set_defaults(main=warm_up)
    own.add_argument("--out", type=Path, required=True)
    own.add_argument("--device", default="cpu")
    own.add_argument("--tiny", action="store_true", help="worlds of a test")
    own.add_argument("--no-paces", dest="paces", action="store_false", help="time nothing")
    own = commands.add_parser("pictures")
    own.set_defaults(main=draw_pictures)
    own.add_argument("--out", type=Path, required=True)
    own = commands.add_parser("run")
    own.set_defaults(main=run_all)
    own.add_argument("--out", type=Path, required=True)
    own.add_argument("--pictures", type=Path, required=True, help="folder of PNG files")
    own.add_argument("--names", nargs="+", help="stems of the pictures; all")
    own.add_argument("--device", default="cpu")
    own.add_argument("--size", choices=SIZES, default="small")
    own.add_argument("--arms", nargs="+", help="all of the size")
    own.add_argument("--seeds", type=int, nargs="+", default=[0])
    own.add_argument("--together", type=int, default=1, help="runs that share the device")
    own.add_argument("--seconds", type=float, default=1e9, help="begin no run that would end later")
    own.add_argument("--longest", type=float, default=math.inf, help="seconds of a run, at most")
    own.add_argument(
        "--clock", type=float, default=math.inf, help="seconds of a cosine that follows the time"
    )
    own.add_argument("--process", default="0", help="part of the name of the file of results")
    own.add_argument("--fields", default="{}", help="JSON object of fields for all arms")
    own.add_argument("--last-step", type=int, default=LAST, help="measure no later one")
    own.add_argument("--strips", action="store_true", help="pictures of what grows")
    own = commands.add_parser("merge")
    own.set_defaults(main=merge)
    own.add_argument("--out", type=Path, required=True)
    own.add_argument("--device", default="cpu")
    own = commands.add_parser("follow")
    own.set_defaults(main=follow)
    own.add_argument("rule", help="name or file of a rule")
    own.add_argument("--target", required=True)
    own.add_argument("--preset", default="paper", help="what the world is like")
    own.add_argument("--steps", type=int, nargs="+", default=[512, 4096, 20_000])
    long, heal = commands.add_parser("long"), commands.add_parser("heal")
    for own, run in ((long, run_long), (heal, run_healing)):
        own.set_defaults(main=run)
        own.add_argument("--out", type=Path, required=True, help="folder of `run`")
        own.add_argument("--pictures", type=Path, required=True, help="folder of PNG files")
        own.add_argument("--device", default="cpu")
        own.add_argument("--preset", default="paper", help="what the world is like")
    long.add_argument("--steps", type=int, default=trained_rule_checks.LONG_RUN_STEPS)
    heal.add_argument("--count", type=int, default=8, help="seeds")
    heal.add_argument(
        "--steps", type=int, nargs=2, default=[1024, 1000], help="before and after the damage"
    )
    own = commands.add_parser("report")
    own.set_defaults(main=report)
    own.add_argument("record", type=Path)
    own.add_argument("--figure", type=Path, help="a PNG file of the arms' losses over steps")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    arguments.main(arguments)


if __name__ == "__main__":
    sys.exit(main())
