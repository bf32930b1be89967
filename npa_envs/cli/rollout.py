"""`npa-envs rollout RULE`: grows a rule from its seed and writes a film."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, cast

import tyro

from npa_envs.cli import common
from npa_envs.errors import NPAError

if TYPE_CHECKING:
    from torch import Tensor

    from npa_envs.tasks.damage import DamageEvent
    from npa_envs.training.task_of_rule import TrainedTask
    from npa_envs.world.particles import Particles


@dataclass(frozen=True, kw_only=True)
class RolloutOptions(common.RuleOptions):
    """Grow a rule from its seed, with damage, and write a GIF, an MP4 and a filmstrip.

    A 3D world also gets a turntable GIF, and files of the grown cloud as points (PLY) and as
    Gaussians (PLY, .splat).

    Examples:
      npa-envs rollout gecko --damage 300:cut 500:wipe --steps 700
      npa-envs rollout runs/heart
      npa-envs rollout gecko --resolution 512 --style points --background black
    """

    steps: int = 512
    """Steps to run."""
    damage: Annotated[tuple[tuple[str, ...], ...], tyro.conf.UseAppendAction] = ()
    """Damage during the run, STEP:KIND or STEP:KIND:SIZE: 200:cut (gap 0.1), 300:wipe (radius 0.2),
    400:clump (radius 0.2); sizes in length units."""
    out: Path | None = None
    """Folder to write to; created where missing; default: runs/rollout/NAME, of the rule or run."""
    resolution: int | None = None
    """Pixels on each side of the film; default: as trained, but at least 256."""
    style: Literal["splats", "points"] = "splats"
    """Particles as large as in training, or small separate points; those need about 512 pixels."""
    background: str = "white"
    """Colour behind the particles: a name such as black, or "#rrggbb"."""
    every: int | None = None
    """Steps between two frames; default: for about 150 frames."""
    fps: float = 25.0
    """Frames per second, 0.1 to 50."""
    seed: int = 0
    """Seed of all random numbers, 0 to 2^63 - 1; the same seed gives the same film."""


def main(arguments: Sequence[str]) -> int:
    """Grow the rule, print its loss and extent, and write films and point files."""
    options = common.parse_options(RolloutOptions, "rollout", arguments)
    import torch

    from npa_envs.render.world_film import SCREEN, WorldFilm, film_world, write_3d_world
    from npa_envs.rule.files import load_rule, rule_name
    from npa_envs.training.run_folder import stop_flag
    from npa_envs.training.task_of_rule import task_for_film, task_of_rule

    common.check_has_rule(options.rule)
    damages = checked_damages(options)
    device = options.checked_device()
    rule = load_rule(options.rule, device=device).float()
    trained = task_of_rule(options.rule, rule, device, **options.world)
    # The film has the size and style of the options; metrics are those of the trained task.
    film_task = task_for_film(
        trained.task, options.rule, rule, device, least=SCREEN, resolution=options.resolution,
        points=options.style == "points", **options.world,
    )  # fmt: skip
    folder = common.writable_folder(options.out or Path("runs/rollout", rule_name(options.rule)))
    generator = torch.Generator(device).manual_seed(options.seed)
    seed_world = trained.task.seed(1, generator=generator, device=device)
    with stop_flag() as stop, common.progress_bar(options.steps, show=options.progress) as advance:
        grown, film = film_world(
            rule, film_task, seed_world, options.steps, generator=generator, damages=damages,
            every=options.every, film=WorldFilm(background=options.background), progress=advance,
            stop=stop.is_set,
        )  # fmt: skip
    print_measures(options, trained, grown, max(film.steps.values()), seed_world.goal)
    paths = film.write(folder, "growth", fps=options.fps)
    if trained.task.has_views:
        paths += write_3d_world(
            trained.task.with_goal(seed_world.goal), grown, folder, drawn_by=film_task,
            resolution=options.resolution or SCREEN, background=options.background,
        )  # fmt: skip
    print("\n".join(f"wrote {path}" for path in paths))
    return 0


def checked_damages(options: RolloutOptions) -> list[DamageEvent]:
    """Return the events of `--damage`; raise NPAError for an option with a wrong value."""
    from npa_envs.render.colours import background_colour
    from npa_envs.render.picture_files import GIF_HIGHEST_RATE, check_rate
    from npa_envs.tasks.damage import parse_damage

    common.check_numbers(options, steps=1, every=1)
    if not 0 <= options.seed < 2**63:
        raise NPAError(f"seed must be in [0, 2^63), got {options.seed}: try 0")
    check_rate(options.fps, highest=GIF_HIGHEST_RATE)
    background_colour(options.background)
    damages = [parse_damage(text) for texts in options.damage for text in texts]
    for damage in damages:
        if damage.step >= options.steps:
            raise NPAError(
                f"damage must come before the last of {options.steps} steps, got step "
                f"{damage.step}: raise --steps above {damage.step}"
            )
    return damages


def print_measures(
    options: RolloutOptions, trained: TrainedTask, grown: Particles, step: int, goal: Tensor | None
) -> None:
    """Print loss and extent of a world after `step` steps, and the class that its particles say.

    `goal` is the right class, shape [1]; None: the task has no classes.
    """
    from npa_envs.measure.quality import measure
    from npa_envs.tasks.point_classification import PointClassification, majority

    task = trained.task.with_goal(goal)
    if step < options.steps:
        print(f"stopped at step {step} of {options.steps}; the film goes that far")
    if trained.why_not_measurable is not None:
        option = "--data" if task.classifies else "--target"
        print(f"no metrics for {options.rule}: {trained.why_not_measurable}; give {option}")
    else:
        row = measure(task, grown.x, grown.s, step)
        print(f"step {step}: {row.summary}, extent {row.extent:.3f}")
    if task.classifies and goal is not None:
        vote = int(majority(cast(PointClassification, task).outputs(grown.s)))
        print(f"most particles say {vote}; the cloud is a {int(goal)}")
