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

    from npa_envs.world.particles import Particles

RULE = "gecko"
"""The shipped rule that grows."""

EYE, SPOTS = (0.27, 0.69), (0.05, -0.03)
"""Places of the rule's target that are damaged [length units]: an eye and the spots of the back."""

Stretches = Sequence[tuple[int, int]]
"""Pairs of a number of steps and the steps from frame to frame."""

GROWING: Stretches = ((64, 1), (64, 4), (192, 16))
HEALING: Stretches = ((32, 2), (68, 4), (400, 16))

FPS = 16.0
"""Frames per second of the film: a body stands after about 60 steps, one a frame."""

SIDE = 512
"""Side of the films' frames [pixels]."""


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
    from npa_envs.tasks.targets.picture_points import load_target

    if not 1.0 <= options.train_seconds <= 3600.0:
        raise NPAError(f"train_seconds must lie in [1, 3600], got {options.train_seconds}: try 30")
    device = options.checked_device()
    load_target(options.target)  # Refused before worlds grow.
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
    from npa_envs.measure.wounds import LocalLoss, wounded
    from npa_envs.render.world_film import WorldFilm, film_world
    from npa_envs.rule.files import load_rule
    from npa_envs.tasks.damage import Wound
    from npa_envs.training.task_of_rule import task_for_film, task_of_rule

    rule = load_rule(RULE, device=device).float()
    task = task_of_rule(RULE, rule, device).task
    drawn = task_for_film(task, RULE, rule, device, least=SIDE)
    generator = torch.Generator(device).manual_seed(0)
    worlds = task.seed(1, generator=generator, device=device)
    yield f"{RULE}: {worlds.x.shape[1]} particles, {rule.weight_count} weights"
    film, results, step = WorldFilm(), [], 0
    wounds = {
        "a cut through the spots": Wound(
            "cut", worlds.x.new_tensor([SPOTS]), 0.1, worlds.x.new_tensor([[0.8, 1.0]])
        ),
        "a wipe of an eye": Wound("wipe", worlds.x.new_tensor([EYE]), 0.2),
    }
    total = sum(steps for steps, _ in (*GROWING, *HEALING, *HEALING))
    with common.progress_bar(total, show=options.progress) as advance:

        def run(worlds: Particles, stretches: Stretches) -> Particles:
            nonlocal step
            for steps, every in stretches:
                worlds, _ = film_world(
                    rule, drawn, worlds, steps, generator=generator, every=every, first_step=step,
                    film=film, progress=advance,
                )  # fmt: skip
                step += steps
            return worlds

        worlds = run(worlds, GROWING)
        results.append(f"  grown for {step} steps: {measure(task, *worlds[:2], step).summary}")
        for name, wound in wounds.items():
            near, began = LocalLoss(task, worlds, wound), step
            worlds = wounded(task, worlds, wound)
            film.add(drawn, worlds, step, f"{wound.kind} {wound.size:g}")
            after = near(worlds)
            worlds = run(worlds, HEALING)
            end = near(worlds)
            verdict = "does not heal"
            if bool(end - near.before < 0.25 * (after - near.before)):
                verdict = "heals" if bool(end <= near.bound) else "heals but for a scar"
            worse, better = (float(loss / near.before) for loss in (after, end))
            results.append(
                f"  {name} {verdict} in {step - began} steps: the loss near it rises to "
                f"{worse:.1f} times that before, then falls to {better:.1f} times"
            )
    yield from results
    yield from (f"  wrote {path}" for path in film.write(options.out, RULE, fps=FPS))


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
    task = task_entry("morphogenesis2d").make(override(config, resolution=SIDE).task, device)
    generator = torch.Generator(device).manual_seed(1)
    worlds = task.seed(1, generator=generator, device=device)
    steps = 4 * config.steps[1]
    path = RunFolder(result.folder).rule
    rule = load_rule(path, device=device)
    worlds, film = film_world(rule, task, worlds, steps, generator=generator, every=1)
    yield f"  grown for {steps} steps: {measure(task, worlds.x, worlds.s, steps).summary}"
    # It stands after a quarter of these steps, as the loss of training begins there.
    paths = film.write(options.out, f"trained-{Path(options.target).stem}", fps=0.5 * FPS)
    yield from (f"  wrote {path}" for path in (*paths, path))
