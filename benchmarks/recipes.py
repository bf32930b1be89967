"""Recipes of training compared: choices switched on and off, on pictures that nobody tuned for.

An arm is a recipe with one choice changed. `run` trains every arm on every picture of a folder and
measures the rules as `npa-envs evaluate --healing` does, with seeds that training never saw; on a
GPU several runs share the device, each on a stream of its own. Every finished run is a line of
JSON, so that a stopped call goes on where it was. `pictures` draws the emoji; `warm-up` compiles
all kernels and tests that runs side by side learn bit for bit what they learn alone; `merge` makes
one record, one sheet of pictures and one archive of rules of what several processes left; `report`
prints the tables and draws the figure; `follow` says what the decay of a rule's world is; `long`
runs finished rules for 100 000 steps within the bounds of `npa-envs stress`.

    python benchmarks/recipes.py pictures --out PICTURES
    python benchmarks/recipes.py warm-up --device cuda --out OUT
    python benchmarks/recipes.py run --pictures PICTURES/development --device cuda --out OUT
    python benchmarks/recipes.py merge --out OUT
    python benchmarks/recipes.py report OUT/recipes.json --figure recipes.png
    python benchmarks/recipes.py follow RULE --target PICTURE.png
    python benchmarks/recipes.py long --pictures PICTURES/test --device cuda --out OUT
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import random
import shutil
import statistics
import sys
import tarfile
import tempfile
import time
import unicodedata
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from side_by_side import iterate_together, on, stream_of
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.files import write_bytes
from npa_envs.measure.accuracy import habitats
from npa_envs.measure.plots import new_figure, number_plainly, png
from npa_envs.measure.quality import Runner, evaluate, healing
from npa_envs.measure.record import machine, write_record
from npa_envs.render.colours import to_uint8
from npa_envs.rule.files import load_rule, save_rule
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D, Morphogenesis2DTrainConfig
from npa_envs.tasks.targets.emoji import render_emoji
from npa_envs.training import Trainer, preset, task_entry
from npa_envs.world.recorded import release_recordings
from npa_envs.world.rollout import rollout

SEEDS = tuple(range(1000, 1008))
"""Seeds of the worlds that rules are measured on."""

STEPS = (64, 128, 256, 512, 1024, 2048, 4096)
"""Steps at which they are measured, before `LAST`."""

LAST = 20_000
"""The last step at which worlds are measured; of full size alone in the first three rounds."""

QUARTERS = (0.2, 0.4, 0.6, 0.8)
"""Milestones of the paper's schedule, as shares of its length."""

SIDE_BY_SIDE = 6
"""Runs of which the first is compared with one that has the device for itself."""

PACES: Mapping[str, Sequence[int]] = {"small": (1, 6), "full": (1, 3)}
"""How many runs side by side are timed."""

Fields = Mapping[str, Any]

SIZES: Mapping[str, Fields] = {
    "full": {"particle_count": 4096, "target_point_count": 4096, "iterations": 10_000},
    "small": {
        "particle_count": 1024,
        "target_point_count": 1024,
        "resolution": 128,
        "eps": 0.14,
        "seed_radius": 0.28,
        "iterations": 3000,
    },
    "fast": {},
    "tiny": {
        "particle_count": 128,
        "target_point_count": 128,
        "resolution": 32,
        "hidden_dim": 16,
        "eps": 0.3,
        "iterations": 6,
        "steps": (4, 6),
        "lifetimes": (4, 64),
        "pool_size": 16,
    },
}
"""Worlds: as in the preset `paper`; a quarter of its particles, which see as many others and
begin in a disk as large, as they see; as in `fast`; and a test of the script."""

STRAYS: Fields = {
    "stray_share": 2e-4,
    "stray_weight": 10.0,
    "bound_weight": 10.0,
    "drift_weight": 1.0,
    "clump_radius": 0.2,
    "cut_gap": 0.1,
}
"""What keeps worlds together for 100 000 steps, and heals clumps and cuts."""

NO_STRAYS: Fields = dict.fromkeys(STRAYS, 0.0) | {"bound_weight": 100.0}

FIRST: Fields = {
    **STRAYS,
    "lifetimes": (64, 16_384),
    "pool_size": 64,
    "schedule": "cosine",
    "learning_rate": 1e-3,
    "average": 0.999,
    "blur_levels": 3,
    "steps": (48, 80),
}
"""The first candidate: worlds of all ages, all of them damaged."""

SECOND: Fields = {
    **FIRST,
    "average": 0.0,
    "blur_levels": 0,
    "damage_share": 0.5,
    "stray_share": 5e-5,
}
"""The second candidate: half of the worlds are left to themselves; what did not help is gone.

Its damaged worlds were those of every other place of the pool, the longest-lived ones too."""

THIRD: Fields = SECOND | {
    "lifetimes": (256, 32_768),
    "damage_share": 0.25,
    "stray_share": 2e-4,
}
"""The third candidate: fewer seeds, older worlds, and only worlds of short lives are damaged."""

FIFTH: Fields = THIRD | {
    "lifetimes": (128, 32_768),
    "pool_size": 32,
    "ageing_steps": 512,
    "damage_radius": 0.2,
    "initial_rule": "heart",
}
"""The fifth candidate: a rule that has learned to grow and to last learns another picture."""

SEVENTH: Fields = {
    **STRAYS,
    "seed_interval": 1,
    "fresh_share": 0.5,
    "pool_size": 64,
    "steps": (32, 64),
    "schedule": "cosine",
    "learning_rate": 2e-3,
    "initial_rule": "heart",
}
"""What serves `fast`, in large: half of the worlds are seeds, none is old. Not at full size."""

EIGHTH: Fields = {
    **STRAYS,
    "lifetimes": (64, 16_384),
    "pool_size": 64,
    "steps": (48, 80),
    "schedule": "cosine",
    "learning_rate": 2e-3,
    "damage_share": 0.25,
    "damage_radius": 0.2,
    "rest_weight": 2.0,
    "initial_rule": "heart",
}
"""The eighth candidate: grown worlds are to rest."""

FAST_BEFORE: Fields = {
    **NO_STRAYS,
    "learning_rate": 2e-3,
    "schedule": "milestones",
    "milestones": (1500, 2100),
    "seed_interval": 2,
    "initial_rule": "",
}
"""The preset `fast` as it was when its arms were compared, laid over what it is."""

FAST_FIRST: Fields = {
    "lifetimes": (24, 2048),
    "pool_size": 16,
    "schedule": "cosine",
    "average": 0.99,
    "blur_levels": 2,
}
"""The first candidate in small."""

FAST_SECOND: Fields = FAST_FIRST | {"average": 0.0, "blur_levels": 0, "damage_share": 0.5}
"""The second candidate in small."""

FAST_STRAYS: Fields = STRAYS | {"stray_share": 1e-3}
"""As `STRAYS`, of fewer particles."""

FAST_FIFTH: Fields = {
    **FAST_STRAYS,
    "learning_rate": 4e-3,
    "schedule": "cosine",
    "initial_rule": "gecko-512",
}
"""The preset `fast` after the third round, which begins with a rule that has learned a gecko."""

FAST_SIXTH: Fields = FAST_FIFTH | {"seed_interval": 1}
"""Half of the worlds are seeds: the preset `fast`."""

FAST_EIGHTH: Fields = {
    **FAST_FIFTH,
    "learning_rate": 2e-3,
    "lifetimes": (24, 256),
    "damage_share": 0.5,
    "rest_age": 64,
    "rest_weight": 0.5,
}
"""The eighth candidate in small: of two worlds one is young and damaged, one grown and at rest."""

ARMS: Mapping[str, Fields] = {
    "paper": {},
    "paper, seeds every 3rd": {"seed_interval": 3},
    "first": FIRST,
    "first, no ages, seeds every 3rd": {
        **FIRST,
        "lifetimes": (0, 0),
        "pool_size": 512,
        "seed_interval": 3,
    },
    "first, no average": FIRST | {"average": 0.0},
    "first, no blur": FIRST | {"blur_levels": 0},
    "first, no strays": FIRST | NO_STRAYS,
    "first, milestones": FIRST | {"schedule": "milestones"},
    "first, rate 2e-3": FIRST | {"learning_rate": 2e-3},
    "second": SECOND,
    "second, no strays": SECOND | NO_STRAYS,
    "second, share 0.25": SECOND | {"damage_share": 0.25},
    "second, share 1": SECOND | {"damage_share": 1.0},
    "second, rate 2e-3": SECOND | {"learning_rate": 2e-3},
    "second, steps 96 to 128": SECOND | {"steps": (96, 128), "iterations": 1700},
    "second, lifetimes to 65536": SECOND | {"lifetimes": (64, 65_536)},
    "second, hidden 256": SECOND | {"hidden_dim": 256},
    "second, 4 worlds": SECOND | {"world_count": 4, "iterations": 6000},
    "third": THIRD,
    "third, no strays": THIRD | NO_STRAYS,
    "third, lifetimes from 64": THIRD | {"lifetimes": (64, 32_768)},
    "fifth": FIFTH,
    "fifth, untrained": FIFTH | {"initial_rule": ""},
    "fifth, no ageing": FIFTH | {"ageing_steps": 0},
    "fifth, rate 5e-4": FIFTH | {"learning_rate": 5e-4},
    "seventh": SEVENTH,
    "eighth": EIGHTH,
    "eighth, rest 1": EIGHTH | {"rest_weight": 1.0},
    "eighth, no rest": EIGHTH | {"rest_weight": 0.0},
    "eighth, rest 0.5": EIGHTH | {"rest_weight": 0.5},
    "eighth, rate 1e-3": EIGHTH | {"learning_rate": 1e-3},
    "eighth, rate 4e-3": EIGHTH | {"learning_rate": 4e-3},
    "eighth, share 0.5": EIGHTH | {"damage_share": 0.5},
    "eighth, steps 32 to 64": EIGHTH | {"steps": (32, 64), "lifetimes": (32, 16_384)},
    "eighth, damage 0.1": EIGHTH | {"damage_radius": 0.1},
    "seventh, untrained, rate 3e-3": SEVENTH
    | {"initial_rule": "", "learning_rate": 3e-3, "steps": (48, 50), "iterations": 1500},
}
"""Arms of `full` and `small`: what each changes of the preset `paper`."""

FAST_ARMS: Mapping[str, Fields] = {
    "fast": {},
    "fast, share 0.5": {"damage_share": 0.5},
    "fast, rate 4e-3": {"learning_rate": 4e-3},
    "first": FAST_FIRST,
    "first, no ages": FAST_FIRST | {"lifetimes": (0, 0), "pool_size": 32},
    "first, no average": FAST_FIRST | {"average": 0.0},
    "first, no blur": FAST_FIRST | {"blur_levels": 0},
    "first, milestones": FAST_FIRST | {"schedule": "milestones"},
    "first, strays": FAST_FIRST | STRAYS,
    "first, rate 1e-3": FAST_FIRST | {"learning_rate": 1e-3},
    "second": FAST_SECOND,
    "second, rate 4e-3": FAST_SECOND | {"learning_rate": 4e-3},
    "second, no damage": FAST_SECOND | {"damage": False},
    "second, strays": FAST_SECOND | FAST_STRAYS,
    "second, steps 32 to 48": FAST_SECOND | {"steps": (32, 48), "iterations": 1440},
    "second, 4 worlds": FAST_SECOND | {"world_count": 4, "iterations": 1200},
    "second, lifetimes from 96": FAST_SECOND | {"lifetimes": (96, 2048)},
    "second, hidden 128": FAST_SECOND | {"hidden_dim": 128},
    "fast, rate 8e-3": {"learning_rate": 8e-3},
    "fast, rate 4e-3, strays": FAST_STRAYS | {"learning_rate": 4e-3},
    "fast, rate 4e-3, strays, cosine": {
        **FAST_STRAYS,
        "learning_rate": 4e-3,
        "schedule": "cosine",
    },
    "third": {
        **FAST_SECOND,
        **FAST_STRAYS,
        "learning_rate": 4e-3,
        "lifetimes": (96, 4096),
        "steps": (24, 40),
        "iterations": 1800,
    },
    "fifth": FAST_FIFTH,
    "fifth, rate 2e-3": FAST_FIFTH | {"learning_rate": 2e-3},
    "sixth": FAST_SIXTH,
    "sixth, rate 2e-3": FAST_SIXTH | {"learning_rate": 2e-3},
    "sixth, share 0.5": FAST_SIXTH | {"damage_share": 0.5},
    "eighth": FAST_EIGHTH,
    "eighth, rate 4e-3": FAST_EIGHTH | {"learning_rate": 4e-3},
    "eighth, no rest": FAST_EIGHTH | {"rest_weight": 0.0},
    "eighth, rest 2": FAST_EIGHTH | {"rest_weight": 2.0},
    "eighth, to 4096": FAST_EIGHTH | {"lifetimes": (24, 4096), "rest_age": 512},
    "sixth, untrained": FAST_SIXTH | {"initial_rule": ""},
}
"""Arms of `fast`: what each changes of it as it was; the preset is the sixth now."""


@dataclass(frozen=True)
class Run:
    """One training run."""

    size: str
    """A name of `SIZES`."""
    arm: str
    """A name of `ARMS`, or of `FAST_ARMS`."""
    picture: str
    """Stem of the picture's file."""
    seed: int
    """Seed of the run."""

    @property
    def name(self) -> str:
        """What its files are called."""
        return (
            f"{self.size}-{self.arm.replace(' ', '_').replace(',', '')}-{self.picture}-{self.seed}"
        )


def configuration(
    run: Run, picture: Path, out: Path, device: str, changes: Fields
) -> Morphogenesis2DTrainConfig:
    """Return what a run is told."""
    fields: dict[str, Any] = {"repeats": 1, "tensorboard": False, "picture_interval": 0}
    if run.size == "fast":
        fields |= FAST_BEFORE | FAST_ARMS[run.arm]
    else:
        arm = ARMS[run.arm]
        # An arm's own number of iterations is meant for small worlds.
        fields |= SIZES[run.size] | arm if run.size == "small" else arm | SIZES[run.size]
    fields |= changes
    if run.size != "fast" and fields.get("schedule") != "cosine":
        fields["milestones"] = tuple(round(share * fields["iterations"]) for share in QUARTERS)
    fields |= {"out": out, "device": device, "seed": run.seed, "target": str(picture)}
    fields["checkpoint_interval"] = 10**9
    return preset("fast" if run.size == "fast" else "paper", **fields)


def train_side_by_side(
    configs: Sequence[Morphogenesis2DTrainConfig],
    longest: float = math.inf,
    kept: Path | None = None,
    clock: float = math.inf,
) -> tuple[list[Trainer], float]:
    """Train several rules, an iteration of each in turn; return the trainers and the seconds.

    Args:
        configs: What they are told.
        longest: Stop after this time [s], finished or not.
        kept: Folder that the rules are copied to every 512 iterations and at the end, by the names
            of the runs' folders.
        clock: Time in which their cosines fall [s], and training ends.
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
    """Copy the rules of runs to a folder."""
    for trainer in trainers:
        trainer.save()
        shutil.copy(trainer.folder.rule, folder / f"{trainer.config.out.name}.safetensors")


def measured(trainer: Trainer, size: str, last_step: int = LAST) -> dict[str, Any]:
    """Return growth and, where `last_step` is `LAST`, healing of a rule, by all worlds' means."""
    task: Any = trainer.task
    rule = trainer.kept_rule
    device = trainer.config.device
    steps = (4, 8) if size == "tiny" else (*STEPS, LAST)
    steps = tuple(step for step in steps if step <= last_step)
    grow, heal = (8, 8) if size == "tiny" else (1024, 500)
    rows, healed = [], []
    # A rule may diverge; then what came before is kept.
    while steps and not rows:
        with contextlib.suppress(NPAError):
            rows = evaluate(rule, task, checkpoints=steps, seeds=SEEDS, device=device)
        steps = steps[:-1]
    with contextlib.suppress(NPAError):
        if last_step == LAST:
            healed = healing(
                rule, task, grow_steps=grow, heal_steps=heal, seeds=SEEDS, device=device
            )
    if trainer.config.device.startswith("cuda"):
        release_recordings()
    found = {"growth": [asdict(row) for row in rows], "healing": [asdict(row) for row in healed]}
    pool = trainer.pool
    if pool.age is not None:
        with torch.no_grad():
            losses = task.metric(pool.x, pool.s).tolist()
        # What training saw last, place by place: age and loss.
        pairs = zip(pool.age.tolist(), losses, strict=True)
        found["pool"] = [[age, round(loss, 4)] for age, loss in pairs]
    return found


@torch.no_grad()
def strip(trainer: Trainer, steps: Sequence[int]) -> np.ndarray[Any, Any]:
    """Return pictures of the target and of one world as it grows, side by side."""
    task: Any = trainer.task
    rule = trainer.kept_rule
    device = torch.device(trainer.config.device)
    runner = Runner(rule, task, device, SEEDS[0], None)
    x, s = task.seed(1, generator=torch.Generator(device).manual_seed(SEEDS[0]), device=device)
    frames, before = [task.target_picture[None]], 0
    for step in steps:
        x, s = runner.run(x, s, step - before)
        frames.append(task.picture(x, s))
        before = step
    picture = to_uint8(torch.cat([frame.cpu() for frame in frames]))
    side = max(1, picture.shape[1] // 128)
    return np.concatenate(list(picture[:, ::side, ::side]), axis=1)


def read_lines(folder: Path) -> list[dict[str, Any]]:
    """Return the finished runs that lie in a folder."""
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
    """Return which run a line is of."""
    return Run(*(line[name] for name in ("size", "arm", "picture", "seed")))


def groups_of(runs: Iterable[Run], together: int) -> Iterator[list[Run]]:
    """Yield runs of one size, a few at a time."""
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
    if (out / "check.json").exists() and not json.loads((out / "check.json").read_text())["same"]:
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
                rule = trainer.kept_rule
                save_rule(rule, out / f"rule-{run.name}.safetensors")
                if arguments.strips:
                    steps = (4, 8) if run.size == "tiny" else (32, 64, 128, 512, 4096)
                    Image.fromarray(strip(trainer, steps)).save(out / f"strip-{run.name}.png")
                    if arguments.device.startswith("cuda"):
                        release_recordings()
                with (out / f"runs-{arguments.process}.jsonl").open("a") as file:
                    file.write(json.dumps(line) + "\n")
                losses = " ".join(f"{r['step']}:{r['loss']:.3f}" for r in line["growth"])
                print(f"{run.name} {seconds:.0f} s  {losses}", flush=True)
            del trainers
        longest = max(longest, time.perf_counter() - begun)


def warm_up(arguments: argparse.Namespace) -> None:
    """Compile kernels, and see whether runs side by side learn what they learn alone."""
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
    print((arguments.out / "check.json").read_text(), flush=True)


BLOCKS = (
    (0x1F300, 0x1F5FF),
    (0x1F600, 0x1F64F),
    (0x1F680, 0x1F6FF),
    (0x1F900, 0x1F9FF),
    (0x1FA70, 0x1FAFF),
)
"""Code points of pictures in Unicode, first and last."""

SKIN_TONES = (0x1F3FB, 0x1F3FF)
"""Those of them that change others."""

DRAWN = 12
"""Pictures to develop on, and as many to test."""


def single_emoji() -> dict[str, Image.Image]:
    """Return the picture of every emoji of one character that the installed font draws, by name."""
    emoji = {}
    for code in (code for first, last in BLOCKS for code in range(first, last + 1)):
        name = unicodedata.name(chr(code), "")
        if name and not SKIN_TONES[0] <= code <= SKIN_TONES[1]:
            with contextlib.suppress(NPAError):
                emoji[name.lower().replace(" ", "-")] = render_emoji(chr(code))
    return emoji


def draw_pictures(arguments: argparse.Namespace) -> None:
    """Write emoji, drawn at random but always the same of the same font, as PNG files."""
    emoji = single_emoji()
    drawn = random.Random(0).sample(list(emoji), 2 * DRAWN)
    for number, name in enumerate(drawn):
        folder = arguments.out / ("development" if number < DRAWN else "test")
        folder.mkdir(parents=True, exist_ok=True)
        emoji[name].save(folder / f"{name}.png", optimize=True)


def merge(arguments: argparse.Namespace) -> None:
    """Make one record, one sheet and one archive of what several processes left in a folder."""
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
        (out / "strips.txt").write_text("\n".join(path.stem for path in strips) + "\n")
    for path in strips:
        path.unlink()


MOTIONS = ("place", "angle", "affine", "deformation")
"""What a grown picture is moved by to be more like its target."""

GRID = 8
"""Displacements along each side of the field that a picture is deformed by."""


def moved(x: Tensor, motion: str, place: Tensor, affine: Tensor, field: Tensor) -> Tensor:
    """Return the positions of one world [1, N, 2] moved as far as a motion allows."""
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
    """Return the splat loss of one world moved so that it is least, by 60 steps of Adam."""
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
    """Print what of one world's loss, as it grows old, lies in motions of the whole."""
    rule = load_rule(arguments.rule)
    task = Morphogenesis2D(preset(arguments.preset, target=arguments.target).task)
    generator = torch.Generator().manual_seed(SEEDS[0])
    x, s = task.seed(1, generator=generator)
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
    home: habitats.Habitat, steps: int, generators: Sequence[torch.Generator]
) -> dict[str, Any]:
    """Return losses and figures of all worlds of a habitat, each against itself when settled.

    Args:
        home: The worlds.
        steps: How long they are run.
        generators: Of the run, and of the steps that tell the energy.
    """
    settled = min(habitats.SETTLED, steps // 2)
    marks = [
        round(settled * (steps / settled) ** (k / habitats.MARKS))
        for k in range(habitats.MARKS + 1)
    ]
    run = habitats.LongRun(home, generators[0], home.options())
    count = len(home.x)
    first: list[dict[str, float]] = [{} for _ in range(count)]
    largest: list[dict[str, float]] = [{} for _ in range(count)]
    over: dict[int, str] = {}
    losses = {}
    centroids = home.x.mean(1)
    for step, x, s in run.marks(marks):
        losses[step] = home.task.metric(x, s).tolist()
        if step == settled:
            centroids = x.mean(1)
        for k in range(count):
            found = habitats.measured(home, x[k : k + 1], s[k : k + 1], generators[1])
            if not found["not_finite"]:
                first[k] = first[k] or dict(found)
                found["drift"] = float((x[k].mean(0) - centroids[k]).norm())
                for key, unit in (("extent", "extent"), ("energy", "energy"), ("drift", "extent")):
                    found[key] /= max(first[k][unit], 1e-12)
            beyond = [n for n, bound in habitats.BOUNDS.items() if not found.get(n, 0.0) <= bound]
            if beyond:
                over.setdefault(k, f"{', '.join(beyond)} at step {step}")
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


def run_long(arguments: argparse.Namespace) -> None:
    """Run the rules that `run` has left for very long, a line of JSON each."""
    device = torch.device(arguments.device)
    for path in sorted(arguments.out.glob("rule-*.safetensors")):
        picture = next(p for p in arguments.pictures.glob("*.png") if f"-{p.stem}-" in path.name)
        config = preset(arguments.preset, target=str(picture)).task
        task = task_entry("morphogenesis2d").make(config, device)
        rule = load_rule(path, device=device).float().requires_grad_(False)
        seeds = [
            task.seed(1, generator=torch.Generator(device).manual_seed(seed), device=device)
            for seed in SEEDS
        ]
        x, s = (torch.cat(parts) for parts in zip(*seeds, strict=True))
        home = habitats.Habitat(rule, task, x.float(), s.float(), habitats.SETTLED)
        generators = [torch.Generator(device).manual_seed(seed) for seed in (1, 2)]
        line = {"picture": picture.stem} | endurance(home, arguments.steps, generators)
        with (arguments.out / "long.jsonl").open("a") as file:
            file.write(json.dumps(line) + "\n")
        print(f"{picture.stem}: {line['worlds_within']} of {len(SEEDS)} {line['over']}", flush=True)


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
        count = max(sum(r["world_count"] for r in rows), 1)
        share = sum(r["worlds_healed"] for r in rows) / count
        lines.append(f"| {' | '.join([*cells, f'{worst:.3f}', f'{share:.0%}'])} |")
    return "\n".join(lines)


def draw(runs: Sequence[Mapping[str, Any]]) -> bytes:
    """Return a PNG of the arms' mean losses against steps from the seed, a panel a size."""
    sizes = [size for size in SIZES if any(run["size"] == size for run in runs)]
    figure, ((*panels,),) = new_figure(1, len(sizes), (5.6 * len(sizes), 6.5))
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
    """Print the tables of a record, and draw its figure where asked."""
    runs = json.loads(arguments.record.read_text("utf-8"))["runs"]
    if arguments.figure:
        write_bytes(arguments.figure, draw(runs))
    for size in SIZES:
        if any(run["size"] == size for run in runs):
            print(f"\n{size}\n\n{table(runs, size)}")


def main() -> None:
    """Do what the command line says."""
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
    own = commands.add_parser("long")
    own.set_defaults(main=run_long)
    own.add_argument("--out", type=Path, required=True, help="folder of `run`")
    own.add_argument("--pictures", type=Path, required=True, help="folder of PNG files")
    own.add_argument("--device", default="cpu")
    own.add_argument("--preset", default="paper", help="what the world is like")
    own.add_argument("--steps", type=int, default=habitats.STEPS)
    own = commands.add_parser("report")
    own.set_defaults(main=report)
    own.add_argument("record", type=Path)
    own.add_argument("--figure", type=Path, help="a PNG file of the arms' losses over steps")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    arguments.main(arguments)


if __name__ == "__main__":
    sys.exit(main())
