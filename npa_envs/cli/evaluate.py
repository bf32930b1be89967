"""`npa-envs evaluate RULE`: measures how good a rule is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import tyro

from npa_envs.cli import common
from npa_envs.errors import NPAError, shown

if TYPE_CHECKING:
    from npa_envs.tasks.point_classification import PointClassification


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions(common.RuleOptions):
    """Measure loss, PSNR, overflow and extent of a rule over thousands of steps.

    For a rule that classifies point clouds: the accuracy on clouds that it was not trained on, also
    after they are cut or replaced. For a rule of many pictures, unless `--target` names one of
    them: loss and PSNR of each picture, and the loss with the code of another.

    Examples:
      npa-envs evaluate gecko --healing
      npa-envs evaluate runs/heart --seed-count 2
    """

    data_folder: str | None = None
    """Point clouds only: where torchvision keeps "mnist"; default: as trained."""
    checkpoints: tuple[int, ...] | None = None
    """Steps from the seed to measure at, increasing; default: 64, 128, ... 4096, for point clouds
    8, 16, 24, 32, 64, 128."""
    seed_count: int = 8
    """Worlds to measure, each from a different seed; for point clouds all test clouds."""
    healing: bool = False
    """Also damage the grown worlds by a cut and a wipe, and measure how they heal. Point clouds are
    always damaged."""
    judge: bool = False
    """Textures only: also measure the texture metric: three distances from the target that no loss
    uses, as ratios: 1 is the distance of the target drawn by particles."""
    json_path: Annotated[Path | None, tyro.conf.arg(name="json")] = None
    """Also write the tables to this JSON file."""


def main(arguments: Sequence[str]) -> int:
    """Measure a rule's quality; print and write its tables."""
    options = common.parse_options(EvaluateOptions, "evaluate", arguments)
    from npa_envs.atomic_files import write_text
    from npa_envs.measure import quality
    from npa_envs.measure.benchmark_records import UNMEASURED, table_text, tables_json
    from npa_envs.rule.files import load_rule
    from npa_envs.training.task_of_rule import task_of_rule, tasks_of_codes

    checkpoints = options.checkpoints or quality.CHECKPOINTS
    quality.check_steps("checkpoints", checkpoints)
    common.check_numbers(options, seed_count=1)
    device = options.checked_device()
    rule = load_rule(options.rule, device=device).float()
    seeds = range(quality.FIRST_SEED, quality.FIRST_SEED + options.seed_count)
    kwargs: dict[str, Any] = {"seeds": seeds, "device": device}
    if rule.codes is not None and options.target is None:
        if options.healing or options.judge:
            raise NPAError(
                "healing and judge are measured of one picture at a time, of the rule's "
                f"{len(rule.codes)}: give --target {shown(rule.codes.names[0])}"
            )
        tasks = tasks_of_codes(options.rule, rule, device, **options.world)
        kwargs["checkpoints"] = options.checkpoints or quality.PICTURE_CHECKPOINTS
        with common.progress_bar(None, show=options.progress) as advance:
            rows = quality.picture_rows(rule, tasks, progress=advance, **kwargs)
        tables: dict[str, Sequence[Any]] = {"pictures": rows}
        metric = tasks[0].metric_name
        what = f"{len(tasks)} pictures, {options.seed_count} worlds each"
        note = ", shuffled: with the code of the next picture"
    else:
        world = options.world | {"data_folder": options.data_folder}
        trained = task_of_rule(options.rule, rule, device, **world)
        task = trained.task
        if trained.why_not_measurable is not None:
            raise NPAError(
                f"cannot measure {options.rule!r}: {trained.why_not_measurable}: "
                "give --target, a built-in name or a picture"
            )
        kwargs["checkpoints"] = options.checkpoints
        kwargs["texture_metric"] = options.judge
        kwargs["changed"] = task.classifies or options.healing
        total = None if kwargs["changed"] else max(checkpoints)
        with common.progress_bar(total, show=options.progress) as advance:
            tables = quality.tables_of(rule, task, progress=advance, **kwargs)
        what, metric, note = f"{options.seed_count} worlds", task.metric_name, ""
        if task.classifies:
            clouds = cast("PointClassification", task)
            what = f"{len(clouds.clouds.label)} {clouds.split} clouds"
    print(f"{options.rule}: {what}, loss: {metric}{note}")
    for name, table in tables.items():
        print(table_text(table, missing=UNMEASURED if name == "growth" else "never"))
    if options.json_path is not None:
        write_text(options.json_path, tables_json(tables, metric=metric))
        print(f"wrote {options.json_path}")
    return 0
