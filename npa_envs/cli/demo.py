"""`npa-envs demo`: growth, healing and training of a rule, on a CPU in about a minute."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from npa_envs.cli import common
from npa_envs.errors import NPAError

if TYPE_CHECKING:
    import torch

RULE = "gecko"
"""The shipped rule that grows."""

GROW_STEPS, HEAL_STEPS, FRAME_STEPS = 512, 384, 8


@dataclass(frozen=True, kw_only=True)
class DemoOptions(common.RunOptions):
    """Grow a shipped rule from its seed, damage it twice and let it heal; then train a small rule
    from a picture.

    Examples:
      npa-envs demo
      npa-envs demo --target star --train-seconds 60 --out star
    """

    out: Path = Path("demo")
    """Folder to write to; created where missing."""
    target: str = "heart"
    """The picture to train on: a built-in name, an emoji or a path."""
    train_seconds: float = 30.0
    """Time for the training [s]."""


def main(arguments: Sequence[str]) -> int:
    """Grow, heal and train rules; print and write a report."""
    options = common.parse_options(DemoOptions, "demo", arguments)
    from npa_envs.atomic_files import write_text

    if not 1.0 <= options.train_seconds <= 3600.0:
        raise NPAError(f"train_seconds must lie in [1, 3600], got {options.train_seconds}")
    device = options.checked_device()
    path = common.writable_folder(options.out) / "report.txt"
    lines: list[str] = []
    # Worlds as small as these gain little from several threads, which wait for each other.
    with common.torch_threads(1):
        for line in itertools.chain(grow_and_heal(options, device), train_small(options, device)):
            print(line, flush=True)
            lines.append(line)
    write_text(path, "\n".join(lines) + "\n")
    print(f"  wrote {path}")
    return 0


def grow_and_heal(options: DemoOptions, device: torch.device) -> Iterator[str]:
    """Grow the rule, damage it twice, write a film of it, and yield the report's lines."""
    import torch

    from npa_envs.measure.quality import measure
    from npa_envs.render.world_film import WorldFilm, film_world
    from npa_envs.rule.files import load_rule
    from npa_envs.tasks.damage import DamageEvent
    from npa_envs.training.task_of_rule import task_of_rule

    rule = load_rule(RULE, device=device).float()
    task = task_of_rule(RULE, rule, device).task
    generator = torch.Generator(device).manual_seed(0)
    worlds = task.seed(1, generator=generator, device=device)
    yield f"{RULE}: {worlds.x.shape[1]} particles, {rule.weight_count} weights"
    results, film, step = [], WorldFilm(), 0
    with common.progress_bar(GROW_STEPS + 2 * HEAL_STEPS, show=options.progress) as advance:
        for kind, steps in ((None, GROW_STEPS), ("cut", HEAL_STEPS), ("wipe", HEAL_STEPS)):
            damages = [] if kind is None else [DamageEvent(step, kind)]
            worlds, film = film_world(
                rule, task, worlds, steps, generator=generator, damages=damages, every=FRAME_STEPS,
                first_step=step, film=film, progress=advance,
            )  # fmt: skip
            step += steps
            text = "grown" if kind is None else f"healed after {damages[0].text}"
            result = measure(task, worlds.x, worlds.s, step).summary
            results.append(f"  {text} for {steps} steps: {result}")
    yield from results
    yield from (f"  wrote {path}" for path in film.write(options.out, RULE))


def train_small(options: DemoOptions, device: torch.device) -> Iterator[str]:
    """Train a small rule from a picture, write a film of it, and yield the report's lines."""
    import torch

    from npa_envs.measure.quality import measure
    from npa_envs.render.world_film import film_world
    from npa_envs.rule.files import load_rule
    from npa_envs.tasks.morphogenesis2d import SPECIES_RUN
    from npa_envs.training import RunFolder, override, preset, task_entry, train

    # One core learns the target in half a minute. A run as short as this learns most from seeds.
    config = preset(
        "fast", target=options.target, device=options.device, out=options.out / "training",
        world_count=4, seed_radius=0.2, particle_count=256, target_point_count=256, eps=0.28,
        hidden_dim=64, resolution=48, steps=(12, 24), iterations=400, learning_rate=5e-3,
        pool_size=8, **SPECIES_RUN,
    )  # fmt: skip
    yield f"training on {options.target}: {config.task.particle_count} particles"
    start = time.perf_counter()
    result = train(
        config, overwrite=True, progress=options.progress, max_seconds=options.train_seconds
    )
    if result.interrupted:
        raise KeyboardInterrupt
    yield f"  {result.iteration} iterations in {time.perf_counter() - start:.1f} s"
    # Metrics and film have more pixels than the loss.
    task = task_entry("morphogenesis2d").make(override(config, resolution=192).task, device)
    generator = torch.Generator(device).manual_seed(1)
    worlds = task.seed(1, generator=generator, device=device)
    steps = 4 * config.steps[1]
    path = RunFolder(result.folder).rule
    rule = load_rule(path, device=device)
    worlds, film = film_world(rule, task, worlds, steps, generator=generator, every=1)
    yield f"  grown for {steps} steps: {measure(task, worlds.x, worlds.s, steps).summary}"
    paths = film.write(options.out, f"trained-{Path(options.target).stem}")
    yield from (f"  wrote {path}" for path in (*paths, path))
