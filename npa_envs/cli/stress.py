"""`npa-envs stress`: hard cases, what is expected of each, and where things break."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from npa_envs.errors import NPAError

if TYPE_CHECKING:
    import torch

    from npa_envs.measure.accuracy.checks import Check
    from npa_envs.measure.accuracy.record import Record

FAILED = 1


@dataclass(frozen=True, kw_only=True)
class StressOptions:
    """Check hard geometry, hard values, long runs of rules, gradients, precision.

    Every check has an expectation, figures and a verdict: pass, fail, a range (where something
    holds), or skipped. With --output a JSON file is written after each check, and a run that was
    stopped goes on where it was: what passed is not repeated.
    """

    quick: bool = False
    """Small worlds, few steps, some rules: about a minute on two CPU cores."""

    device: str = "cpu"
    """Where to run: cpu, cuda, cuda:1."""

    only: tuple[str, ...] = ()
    """Groups (geometry, values, time, gradients, precision), checks (time/gecko), or the first
    words of checks (geometry/clump); default: all."""

    max_seconds: float | None = None
    """Begin no check after so long [s]; what is left is skipped, and run by the next call."""

    threads: int = 1
    """CPU threads of torch and of the kernels; the figures are the same."""

    seed: int = 0
    """What random worlds are drawn from."""

    output: Path | None = None
    """Folder for stress_DEVICE.json and heat maps (extra `bench`); default: nothing is written."""

    commit: str | None = None
    """Commit that is measured; default: that of the checkout."""

    list: bool = False
    """Run nothing: say which checks there are and what each expects."""

    progress: bool = True
    """Show a progress bar."""


def main(arguments: Sequence[str]) -> int:
    """Run the command.

    Args:
        arguments: The words after `npa-envs stress`.

    Returns:
        0, or 1 where a check failed.

    Raises:
        NPAError: There is no such check or device, or the folder cannot be written to or holds
            figures of other settings.
    """
    return run(tyro.cli(StressOptions, prog="npa-envs stress", args=arguments))


def run(options: StressOptions) -> int:
    """Check, print and write.

    Args:
        options: What the command line said.

    Raises:
        NPAError: As for `main`.
    """
    from npa_envs.cli.bench import torch_threads
    from npa_envs.cli.output import StepBar
    from npa_envs.devices import check_device
    from npa_envs.measure.accuracy.checks import Session
    from npa_envs.measure.accuracy.record import Record, in_order, read_record
    from npa_envs.measure.accuracy.suite import all_checks, chosen_checks, run_checks

    if options.max_seconds is not None and not options.max_seconds > 0.0:
        raise NPAError(
            f"max_seconds must be positive, got {options.max_seconds}: leave it out for no limit"
        )
    for name, least in (("seed", 0), ("threads", 1)):
        if getattr(options, name) < least:
            raise NPAError(f"{name} must be at least {least}, got {getattr(options, name)}")
    checks = all_checks(quick=options.quick, seed=options.seed)
    chosen = chosen_checks(checks, options.only)
    if options.list:
        print(_listing(chosen))
        return 0
    device = check_device(options.device)
    facts = _facts(options, device)
    path = _path(options, device)
    record = Record(facts) if path is None else read_record(path, facts)
    before = sum(record.done(check.name) for check in chosen)
    if before:
        print(f"{before} of {len(chosen)} checks were done before")

    def written(record: Record) -> None:
        if path is not None:
            in_order(record, [check.name for check in checks]).write(path)

    with (
        StepBar(len(chosen), show=options.progress, unit="check") as bar,
        torch_threads(options.threads),
    ):
        run_checks(
            chosen,
            Session(device, quick=options.quick, seed=options.seed),
            record,
            max_seconds=float("inf") if options.max_seconds is None else options.max_seconds,
            written=written,
            progress=bar.advance,
        )
    record = in_order(record, [check.name for check in checks])
    print(record.text())
    if path is not None:
        print(f"wrote {path}")
        _draw(path, record)
    return FAILED if record.failed() else 0


def _listing(checks: Sequence[Check]) -> str:
    from npa_envs.measure.accuracy.checks import GROUPS

    lines = []
    for group, summary in GROUPS.items():
        some = [check for check in checks if check.group == group]
        if some:
            lines += [f"{group}: {summary}", *(f"  {c.name}: {c.expected}" for c in some)]
    return "\n".join(lines)


def _facts(options: StressOptions, device: torch.device) -> dict[str, Any]:
    """Return what figures follow from."""
    from npa_envs.measure.speed.report import current_commit, machine, versions

    return {
        "device": device.type,
        "machine": machine(device),
        "quick": options.quick,
        "seed": options.seed,
        "commit": options.commit or current_commit(),
        "versions": versions(),
    }


def _path(options: StressOptions, device: torch.device) -> Path | None:
    """Return the file to write, None where none is asked for."""
    from npa_envs.cli.output import make_folder
    from npa_envs.cli.rollout import check_writable

    if options.output is None:
        return None
    check_writable(make_folder(options.output))
    return options.output / f"stress_{device.type}{'_quick' * options.quick}.json"


def _draw(path: Path, record: Record) -> None:
    """Draw heat maps beside the record, where matplotlib is installed."""
    from npa_envs.measure.accuracy.plots import heat_maps
    from npa_envs.measure.speed.plots import write_plots

    maps = path.with_name(f"{path.stem}_*.png")
    for line in write_plots(lambda: heat_maps(record), maps, "heat maps"):
        print(line)
