"""`npa-envs robustness`: rules under changed conditions and after damage, over many seeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from npa_envs.cli import common


@dataclass(frozen=True, kw_only=True)
class RobustnessOptions(common.MeasureOptions):
    """Measure how rules grow under changed conditions, and how they recover from damage.

    The result is a table of losses over seeds, without a verdict (`npa-envs stress` has those).
    With --out each rule's JSON file is saved after each measurement, and a stopped run continues.

    Examples:
      npa-envs robustness heart --quick
      npa-envs robustness --device cuda --out results
    """

    rules: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RULES")] = ()
    """Shipped rules (`npa-envs list`), initial rules of presets (`seven-pictures`), files of rules,
    or folders of runs; default: the shipped ones whose data are there, when quick one of a task."""
    seed_count: int | None = None
    """Worlds of each condition, each from its own seed; default: 8, or 2 when quick."""
    quick: bool = False
    """Small worlds, few steps and values: a test that it runs, at most a minute on two cores."""
    out: Path | None = None
    """Folder for robustness_RULE.json, robustness.md, and curves (extra `bench`); default: nothing
    is written."""


def main(arguments: Sequence[str]) -> int:
    """Measure the rules that have no result yet; print and write all tables."""
    options = common.parse_options(RobustnessOptions, "robustness", arguments)
    from npa_envs.atomic_files import write_text
    from npa_envs.measure.accuracy.trained_rule_checks import task_name
    from npa_envs.measure.benchmark_records import command_text, measured_facts, time_limit
    from npa_envs.measure.plots import write_plots
    from npa_envs.measure.quality import FIRST_SEED
    from npa_envs.measure.robustness import report
    from npa_envs.measure.robustness.trials import PLANS, RuleTrial, quick_plan
    from npa_envs.rule.files import load_rule, rule_digest, shipped_rules
    from npa_envs.training.task_of_rule import has_data

    common.check_numbers(options, seed_count=1, threads=1)
    enough = time_limit(options.max_seconds)
    sources = common.named_rules(options.rules or filter(has_data, shipped_rules()))
    names = list(sources)
    if options.quick and not options.rules:
        # One of each task.
        names = list({task_name(name): name for name in reversed(names)}.values())[::-1]
    device = options.checked_device()
    count = options.seed_count or (2 if options.quick else 8)
    seeds = range(FIRST_SEED, FIRST_SEED + count)
    facts = measured_facts(device, options.commit, quick=options.quick, seeds=list(seeds))
    folder = None if options.out is None else common.writable_folder(options.out)
    records = {}
    # Read before any measurement, so that a file of other settings is rejected at once.
    for name in names:
        # A rule that is trained again keeps its name, but not its weights.
        records[name] = report.RuleRecord(
            facts | {"weights": rule_digest(load_rule(sources[name]))},
            folder and folder / f"robustness_{name}.json", rule=name, done=False,
            command=command_text("robustness", arguments, "--out"),
        ).read()  # fmt: skip
    with common.measuring(options, len(names), "rule") as advance:
        for name, record in records.items():
            if not record.done and not enough():
                task = task_name(sources[name])
                plan = quick_plan(task) if options.quick else PLANS[task]
                small = 256 if options.quick else None
                trial = RuleTrial(sources[name], device, plan, seeds, small)
                report.measure_rule(record, trial, enough=enough)
            advance(1)
    done = [record for record in records.values() if record.done]
    lines = []
    if done:
        lines.append(report.tables(done))
    if done and folder is not None:
        # Written before printing, which fails if the reader of a pipe has ended.
        write_text(folder / "robustness.md", lines[0])
        lines.append(f"wrote {folder}: robustness.md and a record for each rule")
        plots = folder / "robustness_*.png"
        lines += write_plots(lambda: report.pictures(done), plots, "curves")
    if remaining := len(names) - len(done):
        lines.append(f"{remaining} rules are left: call again with the same options")
    print("\n".join(lines))
    return 0
