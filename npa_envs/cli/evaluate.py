"""`npa-envs evaluate RULE`: measures how good a rule is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias, cast

import tyro

from npa_envs.cli import common
from npa_envs.errors import NPAError, shown

if TYPE_CHECKING:
    from npa_envs.rule.rule import NPARule
    from npa_envs.tasks.point_classification import PointClassification

Result: TypeAlias = tuple[dict[str, Any], str, str]
"""Tables by name, the name of the metric, and a heading."""


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
    """Also damage grown worlds by cuts and wipes, and measure how they heal: pictures and objects
    near wounds spread over the body, textures as a whole. Point clouds are always damaged."""
    judge: bool = False
    """Textures only: also measure the texture metric: three distances from the target that no loss
    uses, as ratios: 1 is the distance of a quarter of the target from all of it."""
    json_path: Annotated[Path | None, tyro.conf.arg(name="json")] = None
    """Also write the tables to this JSON file."""


def main(arguments: Sequence[str]) -> int:
    """Measure a rule's quality; print and write its tables."""
    options = common.parse_options(EvaluateOptions, "evaluate", arguments)
    from npa_envs.atomic_files import write_text
    from npa_envs.measure import quality
    from npa_envs.measure.benchmark_records import UNMEASURED, table_text, tables_json
    from npa_envs.rule.files import load_rule
    from npa_envs.training.task_of_rule import trained_task_name

    quality.check_steps("checkpoints", options.checkpoints or quality.CHECKPOINTS)
    common.check_numbers(options, seed_count=1)
    if options.judge and (task := trained_task_name(options.rule)) != "texture":
        raise NPAError(
            f"judge compares textures, got {shown(options.rule)} of the task {task}: leave out "
            "--judge, or give a rule of the task texture"
        )
    device = options.checked_device()
    rule = load_rule(options.rule, device=device).float()
    seeds = range(quality.FIRST_SEED, quality.FIRST_SEED + options.seed_count)
    of_all_pictures = rule.codes is not None and options.target is None
    measure = _measure_pictures if of_all_pictures else _measure_task
    tables, metric, heading = measure(options, rule, seeds=seeds, device=device)
    print(f"{options.rule}: {heading}")
    for name, table in tables.items():
        print(table_text(table, missing=UNMEASURED if name == "growth" else "never"))
    for row in tables.get("healing", ()):
        print(row.summary)
    if options.json_path is not None:
        write_text(options.json_path, tables_json(tables, metric=metric))
        print(f"wrote {options.json_path}")
    return 0


def _measure_pictures(options: EvaluateOptions, rule: NPARule, **worlds: Any) -> Result:
    from npa_envs.measure import quality
    from npa_envs.training.task_of_rule import tasks_of_codes

    assert rule.codes is not None
    if options.healing:
        raise NPAError(
            "healing is measured of one picture at a time, of the rule's "
            f"{len(rule.codes)}: give --target {shown(rule.codes.names[0])}"
        )
    tasks = tasks_of_codes(options.rule, rule, worlds["device"], **options.world)
    steps = options.checkpoints or quality.PICTURE_CHECKPOINTS
    total = quality.picture_step_count(len(tasks), steps, seed_count=options.seed_count)
    with common.progress_bar(total, show=options.progress) as advance:
        rows = quality.picture_rows(rule, tasks, checkpoints=steps, progress=advance, **worlds)
    metric = tasks[0].metric_name
    heading = f"{len(tasks)} pictures, {options.seed_count} worlds each, loss: {metric}"
    return {"pictures": rows}, metric, f"{heading}, shuffled: with the code of the next picture"


def _measure_task(options: EvaluateOptions, rule: NPARule, **worlds: Any) -> Result:
    from npa_envs.measure import quality
    from npa_envs.training.task_of_rule import task_of_rule

    world = options.world | {"data_folder": options.data_folder}
    trained = task_of_rule(options.rule, rule, worlds["device"], **world)
    task = trained.task
    if trained.why_not_measurable is not None:
        raise NPAError(
            f"cannot measure {options.rule!r}: {trained.why_not_measurable}: give "
            + ("--data" if task.classifies else "--target, a built-in name or a picture")
        )
    changed = task.classifies or options.healing
    total = quality.step_count(task, checkpoints=options.checkpoints, changed=changed)
    with common.progress_bar(total, show=options.progress) as advance:
        tables = quality.tables_of(
            rule, task, checkpoints=options.checkpoints, changed=changed,
            texture_metric=options.judge, progress=advance, **worlds,
        )  # fmt: skip
    what = f"{options.seed_count} worlds"
    if task.classifies:
        clouds = cast("PointClassification", task)
        what = f"{len(clouds.clouds.label)} {clouds.split} clouds"
    return tables, task.metric_name, f"{what}, loss: {task.metric_name}"
