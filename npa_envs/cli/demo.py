"""`npa-envs demo`: the main job at a glance, on a CPU in about a minute."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from npa_envs.cli.output import (
    StepBar,
    parse_options,
    torch_threads,
    writable_folder,
)
from npa_envs.errors import NPAError

GROW_STEPS = 512
HEAL_STEPS = 384
FRAME_STEPS = 8

SMALL_RUN: dict[str, Any] = {
    "world_count": 4,
    "seed_radius": 0.2,
    "particle_count": 256,
    "target_point_count": 256,
    "eps": 0.28,
    "hidden_dim": 64,
    "resolution": 48,
    "steps": (12, 24),
    "iterations": 400,
    "learning_rate": 5e-3,
    "pool_size": 8,
}
"""Fields over the preset `fast`: the target is learned in half a minute on one core."""

SCREEN = 192
"""Pixels on each side of the small rule's pictures; its loss saw fewer."""


@dataclass(frozen=True, kw_only=True)
class DemoOptions:
    """Grow a shipped rule from its seed, cut it, wipe a part and let it heal each time; then train
    a small rule from a picture."""

    out: Path = Path("demo")
    """Folder to write to; created where missing."""

    rule: str = "gecko"
    """The rule to grow: a shipped one, a file, or the folder of a run."""

    target: str = "heart"
    """The picture to train on: a built-in name, an emoji or a path."""

    train_seconds: float = 30.0
    """Time for the training [s]."""

    seed: int = 0
    """Randomness."""

    device: str = "cpu"
    """Where to run: cpu, cuda, cuda:1."""

    progress: bool = True
    """Show progress bars."""


def main(arguments: Sequence[str]) -> int:
    """Show what the words after `npa-envs demo` ask for; return 0."""
    options = parse_options(DemoOptions, "demo", arguments)
    from npa_envs.files import write_text

    if not 1.0 <= options.train_seconds <= 3600.0:
        raise NPAError(f"train_seconds must lie in [1, 3600], got {options.train_seconds}")
    start = time.perf_counter()
    writable_folder(options.out)
    report = DemoReport()
    # On worlds as small as these several threads gain little, and on a busy machine they wait for
    # each other at every operation: a step then takes several times as long.
    with torch_threads(1):
        grow_and_heal(options, report)
        train_small(options, report)
    report.line(f"all of it took {time.perf_counter() - start:.0f} s")
    path = options.out / "report.txt"
    write_text(path, "\n".join(report.lines) + "\n")
    print(f"  wrote {path}")
    return 0


class DemoReport:
    """What the demo says, on the screen and in a file."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        """All that was said."""

    def line(self, text: str) -> None:
        """Print a line and keep it."""
        print(text, flush=True)
        self.lines.append(text)

    def wrote(self, *paths: Path) -> None:
        """Say which files were written."""
        for path in paths:
            self.line(f"  wrote {path}")


def grow_and_heal(options: DemoOptions, report: DemoReport) -> None:
    """Grow the shipped rule, damage it twice, and film how it heals.

    Raises:
        NPAError: The rule cannot be loaded, or a file cannot be written.
    """
    import torch

    from npa_envs.cli.film import WorldFilm, film_world, write_film
    from npa_envs.measure.quality import measure
    from npa_envs.rule.files import load_rule
    from npa_envs.tasks.damage import DamageEvent, damage_worlds
    from npa_envs.training import check_device
    from npa_envs.training.trained_tasks import task_of_rule

    device = check_device(options.device)
    rule = load_rule(options.rule, device=device).float()
    trained = task_of_rule(options.rule, rule, device)
    generator = torch.Generator(device).manual_seed(options.seed)
    x, s, goal = trained.task.seed(1, generator=generator, device=device)
    task = trained.task.toward(goal)
    report.line(f"{options.rule}: {x.shape[1]} particles, {rule.weight_count} weights")

    def figures(step: int) -> str:
        if trained.doubt is not None:
            return f"no figures ({trained.doubt})"
        return measure(task, x, s, step).figures

    lines, film, step = [], WorldFilm(), 0
    with StepBar(GROW_STEPS + 2 * HEAL_STEPS, show=options.progress) as bar:
        for kind, steps in ((None, GROW_STEPS), ("cut", HEAL_STEPS), ("wipe", HEAL_STEPS)):
            if kind is not None:
                damage = DamageEvent(step, kind)
                x, s = damage_worlds(x, s, kind=kind, generator=generator)
                s = task.coded(s)
                film.shoot(task, x, s, f"step {step}: {damage.text}", mark=True)
                lines.append(f"  {damage.text}: {figures(step)}")
            start = time.perf_counter()
            x, s, film = film_world(
                rule, task, x, s, steps, generator=generator, every=FRAME_STEPS,
                first_step=step, film=film, progress=bar.advance,
            )  # fmt: skip
            seconds, step = time.perf_counter() - start, step + steps
            done = "grown" if kind is None else "healed"
            lines.append(f"  {done} for {steps} steps in {seconds:4.1f} s: {figures(step)}")
    for line in lines:
        report.line(line)
    name = Path(options.rule.rpartition("#")[2]).stem
    report.wrote(*write_film(film, options.out, name))


def train_small(options: DemoOptions, report: DemoReport) -> None:
    """Train a small rule from a picture, and film what it learned.

    Raises:
        NPAError: The target cannot be loaded, or a file cannot be written.
    """
    import torch

    from npa_envs.cli.film import film_world, write_film
    from npa_envs.measure.quality import measure
    from npa_envs.render import to_uint8, write_filmstrip
    from npa_envs.tasks.morphogenesis2d import HALF_SEEDS
    from npa_envs.training import (
        RunFolder,
        check_device,
        override,
        preset,
        task_entry,
        train,
    )

    task_name = "morphogenesis2d"
    config = preset(
        "fast",
        task_name,
        target=options.target,
        seed=options.seed,
        device=options.device,
        out=options.out / "training",
        # So short a run learns most from seeds; nothing has to last.
        **HALF_SEEDS,
        **SMALL_RUN,
    )
    report.line(f"training on {options.target}: {config.task.particle_count} particles")
    start = time.perf_counter()
    result = train(
        config,
        task_name,
        overwrite=True,
        progress=options.progress,
        max_seconds=options.train_seconds,
    )
    if result.interrupted:
        raise KeyboardInterrupt
    report.line(f"  {result.iteration} iterations in {time.perf_counter() - start:.1f} s")
    device = check_device(options.device)
    task = task_entry(task_name).make(override(config, resolution=SCREEN).task, device)
    generator = torch.Generator(device).manual_seed(options.seed + 1)
    x, s, _ = task.seed(1, generator=generator, device=device)
    steps = 4 * config.steps[1]
    with StepBar(steps, show=options.progress) as bar:
        x, s, film = film_world(
            result.rule, task, x, s, steps, generator=generator, every=1, progress=bar.advance
        )
    row = measure(task, x, s, steps)
    report.line(f"  grown for {steps} steps: {row.figures}")
    name = f"trained-{Path(options.target).stem}"
    report.wrote(*write_film(film, options.out, name))
    comparison = options.out / f"{name}-comparison.png"
    frames = [to_uint8(task.target_picture), film.frames[-1]]
    write_filmstrip(comparison, frames, ["target", f"step {steps}"])
    report.wrote(comparison, RunFolder(result.folder).rule)
