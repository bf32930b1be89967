"""`npa-envs stress`: checks that results are right in hard cases; no tests of load."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from npa_envs.cli import common


@dataclass(frozen=True, kw_only=True)
class StressOptions(common.MeasureOptions):
    """Check hard geometry, hard values, long runs of rules, gradients, precision.

    Every check has an expectation, measured values and a verdict: pass, fail, the range in which a
    property is true, or skipped. With --out a JSON file is written after each check, and a stopped
    run continues: checks that passed are not repeated.

    Examples:
      npa-envs stress --quick
      npa-envs stress --only geometry --out results
    """

    rules: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RULES")] = ()
    """Run only the checks of rules, for these: shipped ones (`npa-envs list`), files of rules, or
    folders of runs; default: all checks, with the shipped rules."""
    quick: bool = False
    """Small worlds, few steps, some rules: about a minute on two CPU cores."""
    only: tuple[str, ...] = ()
    """Groups (geometry, values, time, gradients, precision), checks (time/gecko), or beginnings of
    names (geometry/clump); default: all."""
    out: Path | None = None
    """Folder for stress_DEVICE.json; default: nothing is written."""
    only_list: Annotated[bool, tyro.conf.arg(name="list")] = False
    """Run nothing: print the checks and what each expects."""


def main(arguments: Sequence[str]) -> int:
    """Run the checks, print and write their verdicts; return 1 if a check failed."""
    options = common.parse_options(StressOptions, "stress", arguments)
    from npa_envs.measure import accuracy
    from npa_envs.measure.accuracy import check_runner
    from npa_envs.measure.benchmark_records import measured_facts

    common.check_numbers(options, threads=1)
    rules = common.named_rules(options.rules)
    checks = accuracy.all_checks(quick=options.quick, rules=rules)
    chosen = check_runner.chosen_checks(checks, options.only)
    if options.only_list:
        for group, summary in check_runner.GROUPS.items():
            some = [check for check in chosen if check.group == group]
            if some:
                print(f"{group}: {summary}")
                print("\n".join(f"  {check.name}: {check.expected}" for check in some))
        return 0
    device = options.checked_device()
    path = None
    if options.out is not None:
        name = f"stress_{device.type}{'_quick' * options.quick}.json"
        path = common.writable_folder(options.out) / name
    facts = measured_facts(device, options.commit, quick=options.quick)
    record = check_runner.StressRecord(facts, path).read()
    done = sum(map(record.is_done, chosen))
    if done:
        print(f"{done} of {len(chosen)} checks were done before")
    with common.measuring(options, len(chosen), "check") as advance:
        check_runner.run_checks(
            chosen, check_runner.CheckSession(device, quick=options.quick), record,
            max_seconds=options.max_seconds, progress=advance,
        )  # fmt: skip
    print(record.text())
    if path is not None:
        print(f"wrote {path}")
    return 1 if record.counts()["fail"] else 0
