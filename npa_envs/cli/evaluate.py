"""`npa-envs evaluate RULE`: how good a rule is, in numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from npa_envs.cli import common
from npa_envs.errors import NPAError, shown

if TYPE_CHECKING:
    import torch

    from npa_envs.rule.rule import NPARule


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions(common.RuleOptions):
    """Measure loss, PSNR, overflow and extent of a rule over thousands of steps.

    Of a rule that classifies point clouds: the accuracy on clouds it was not trained on, and what
    they say when they are cut or become others. Of a rule of many pictures, unless `--target` names
    one of them: loss and PSNR of each, and the loss with the code of another.
    """

    data_folder: str | None = None
    """Point clouds only: where torchvision keeps "mnist"; default: as trained."""
    checkpoints: tuple[int, ...] | None = None
    """Steps from the seed to measure at, increasing; default: 64, 128, ... 4096, or 8, 16, 24, 32,
    64, 128 of point clouds."""
    seed_count: int = 8
    """Worlds to measure, each from a seed of its own; of point clouds all test clouds are taken."""
    first_seed: int = 1_000_000
    """The first world's number; training uses others."""
    healing: bool = False
    """Also cut the grown worlds and wipe a part, and measure how they heal. Point clouds are
    always cut and changed."""
    judge: bool = False
    """Textures only: also judge worlds by three distances from the target that no loss compares, as
    ratios: at 1 they differ from it as drawings of it by particles do."""
    json: Path | None = None
    """Also write the table to this JSON file."""


def main(arguments: Sequence[str]) -> int:
    """Measure and print."""
    options = common.parse_options(EvaluateOptions, "evaluate", arguments)
    from npa_envs.measure.judge import TextureJudge
    from npa_envs.measure.quality import CHECKPOINTS, check_steps, tables_of
    from npa_envs.rule.files import load_rule
    from npa_envs.tasks.point_classification import PointClassification
    from npa_envs.training.trained_tasks import task_of_rule

    checkpoints = options.checkpoints or CHECKPOINTS
    check_steps("checkpoints", checkpoints)
    common.check_numbers(options, seed_count=1)
    device = options.place()
    rule = load_rule(options.rule, device=device).float()
    world = options.world | {"data_folder": options.data_folder}
    if rule.codes is not None and options.target is None:
        return _pictures(options, rule, device)
    trained = task_of_rule(options.rule, rule, device, **world)
    if trained.doubt is not None:
        raise NPAError(
            f"cannot measure {options.rule!r}: {trained.doubt}: "
            "give --target, a built-in name or a picture"
        )
    judge = TextureJudge(trained.task) if options.judge else None
    clouds = trained.task.classifies
    known = not (clouds or options.healing)
    with common.StepBar(max(checkpoints) if known else None, show=options.progress) as bar:
        tables = tables_of(
            rule,
            trained.task,
            checkpoints=options.checkpoints,
            seeds=range(options.first_seed, options.first_seed + options.seed_count),
            changed=clouds or options.healing,
            device=device,
            progress=bar.advance,
            judge=judge,
        )
    what = f"{options.seed_count} worlds"
    if clouds:
        task = cast(PointClassification, trained.task)
        what = f"{len(task.clouds.label)} {task.split} clouds"
    print(f"{options.rule}: {what}, loss: {trained.task.metric_name}")
    return _finish(options, tables, trained.task.metric_name)


def _pictures(options: EvaluateOptions, rule: NPARule, device: torch.device) -> int:
    """Measure and print the pictures of a rule of many, each by its code."""
    from npa_envs.measure.quality import PICTURE_CHECKPOINTS, picture_rows
    from npa_envs.training.trained_tasks import tasks_of_codes

    assert rule.codes is not None, "asked before"
    if options.healing or options.judge:
        raise NPAError(
            "healing and judge are measured of one picture at a time, of the rule's "
            f"{len(rule.codes)}: give --target {shown(rule.codes.names[0])}"
        )
    tasks = tasks_of_codes(options.rule, rule, device, **options.world)
    with common.StepBar(None, show=options.progress) as bar:
        rows = picture_rows(
            rule,
            tasks,
            checkpoints=options.checkpoints or PICTURE_CHECKPOINTS,
            seeds=range(options.first_seed, options.first_seed + options.seed_count),
            device=device,
            progress=bar.advance,
        )
    metric = tasks[0].metric_name
    print(
        f"{options.rule}: {len(tasks)} pictures, {options.seed_count} worlds each, loss: {metric}, "
        "shuffled: with the code of the next picture"
    )
    return _finish(options, {"pictures": rows}, metric)


def _finish(options: EvaluateOptions, tables: Mapping[str, Sequence[Any]], metric: str) -> int:
    """Print tables and, if asked for, write them."""
    from npa_envs.files import write_text
    from npa_envs.measure.record import UNMEASURED, table_text, tables_json

    for name, rows in tables.items():
        print(table_text(rows, missing=UNMEASURED if name == "growth" else "never"))
    if options.json is not None:
        write_text(options.json, tables_json(tables, metric=metric))
        print(f"wrote {options.json}")
    return 0
