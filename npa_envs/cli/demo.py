"""`npa-envs demo`: the main job at a glance, on a CPU in about a minute."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from npa_envs.cli import common
from npa_envs.errors import NPAError

if TYPE_CHECKING:
    import torch

GROW_STEPS, HEAL_STEPS, FRAME_STEPS = 512, 384, 8

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


@dataclass(frozen=True, kw_only=True)
class DemoOptions(common.RunOptions):
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


def main(arguments: Sequence[str]) -> int:
    """Grow, heal and train, and print and write what came of it."""
    options = common.parse_options(DemoOptions, "demo", arguments)
    from npa_envs.files import write_text

    if not 1.0 <= options.train_seconds <= 3600.0:
        raise NPAError(f"train_seconds must lie in [1, 3600], got {options.train_seconds}")
    start = time.perf_counter()
    device = options.place()
    path = common.writable_folder(options.out) / "report.txt"
    lines: list[str] = []

    def say(text: str) -> None:
        print(text, flush=True)
        lines.append(text)

    # Worlds as small as these gain little from several threads, which wait for each other.
    with common.torch_threads(1):
        grow_and_heal(options, device, say)
        train_small(options, device, say)
    say(f"all of it took {time.perf_counter() - start:.0f} s")
    write_text(path, "\n".join(lines) + "\n")
    print(f"  wrote {path}")
    return 0


def grow_and_heal(options: DemoOptions, device: torch.device, say: Callable[[str], None]) -> None:
    """Grow the shipped rule, damage it twice, and film how it heals."""
    import torch

    from npa_envs.cli.film import WorldFilm, film_world, write_film
    from npa_envs.measure.quality import measure
    from npa_envs.rule.files import load_rule
    from npa_envs.tasks.damage import DamageEvent, damage_worlds
    from npa_envs.training.task_of_rule import task_of_rule

    rule = load_rule(options.rule, device=device).float()
    trained = task_of_rule(options.rule, rule, device)
    generator = torch.Generator(device).manual_seed(options.seed)
    x, s, _, goal = trained.task.seed(1, generator=generator, device=device)
    task = trained.task.toward(goal)
    say(f"{options.rule}: {x.shape[1]} particles, {rule.weight_count} weights")

    def figures(step: int) -> str:
        if trained.doubt is not None:
            return f"no figures ({trained.doubt})"
        return measure(task, x, s, step).figures

    lines, film, step = [], WorldFilm(), 0
    with common.StepBar(GROW_STEPS + 2 * HEAL_STEPS, show=options.progress) as bar:
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
    name = Path(options.rule.rpartition("#")[2]).stem
    for line in [*lines, *(f"  wrote {path}" for path in write_film(film, options.out, name))]:
        say(line)


def train_small(options: DemoOptions, device: torch.device, say: Callable[[str], None]) -> None:
    """Train a small rule from a picture, and film it."""
    import torch

    from npa_envs.cli.film import film_world, write_film
    from npa_envs.measure.quality import measure
    from npa_envs.render import to_uint8, write_filmstrip
    from npa_envs.tasks.morphogenesis2d import HALF_SEEDS
    from npa_envs.training import RunFolder, override, preset, task_entry, train

    task_name = "morphogenesis2d"
    config = preset(
        "fast",
        task_name,
        target=options.target,
        seed=options.seed,
        device=options.device,
        out=options.out / "training",
        # So short a run learns most from seeds.
        **HALF_SEEDS,
        **SMALL_RUN,
    )
    say(f"training on {options.target}: {config.task.particle_count} particles")
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
    say(f"  {result.iteration} iterations in {time.perf_counter() - start:.1f} s")
    # The loss saw fewer pixels.
    task = task_entry(task_name).make(override(config, resolution=192).task, device)
    generator = torch.Generator(device).manual_seed(options.seed + 1)
    x, s, *_ = task.seed(1, generator=generator, device=device)
    steps = 4 * config.steps[1]
    with common.StepBar(steps, show=options.progress) as bar:
        x, s, film = film_world(
            result.rule, task, x, s, steps, generator=generator, every=1, progress=bar.advance
        )
    say(f"  grown for {steps} steps: {measure(task, x, s, steps).figures}")
    name = f"trained-{Path(options.target).stem}"
    paths = write_film(film, options.out, name)
    comparison = options.out / f"{name}-comparison.png"
    frames = [to_uint8(task.target_picture), film.frames[-1]]
    write_filmstrip(comparison, frames, ["target", f"step {steps}"])
    for path in (*paths, comparison, RunFolder(result.folder).rule):
        say(f"  wrote {path}")
