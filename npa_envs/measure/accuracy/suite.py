"""Every check of `npa-envs stress`, in the order that it runs them in."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import torch

from npa_envs.errors import NPAError, suggest
from npa_envs.measure.accuracy.checks import GROUPS, Check, Session, Skipped, Verdict
from npa_envs.measure.accuracy.endurance import endurance_checks
from npa_envs.measure.accuracy.geometry import geometry_checks
from npa_envs.measure.accuracy.gradients import gradients_checks
from npa_envs.measure.accuracy.precision import precision_checks
from npa_envs.measure.accuracy.record import Entry, Record
from npa_envs.measure.accuracy.values import values_checks


def all_checks(*, quick: bool = False, seed: int = 0) -> list[Check]:
    """Return every check, by group.

    Args:
        quick: Only of some of the rules, where there is a check for each rule.
        seed: What random places are drawn from.
    """
    return [
        *geometry_checks(seed),
        *values_checks(),
        *endurance_checks(),
        *gradients_checks(quick=quick),
        *precision_checks(quick=quick),
    ]


# Runs checks one after the other: one that raises has failed, and the others go on.


def chosen_checks(checks: Sequence[Check], names: Sequence[str]) -> list[Check]:
    """Return the checks that names stand for, all where there are none.

    Args:
        checks: Every check.
        names: Groups, checks, or what checks' names begin with, up to a slash.

    Raises:
        NPAError: A name stands for none.
    """
    for name in names:
        if not any(_stands_for(name, check) for check in checks):
            known = [*GROUPS, *(check.name for check in checks)]
            raise NPAError(f"unknown check {name!r}: {suggest(name, known)}")
    return [
        check for check in checks if not names or any(_stands_for(name, check) for name in names)
    ]


def _stands_for(name: str, check: Check) -> bool:
    return f"{check.name}/".startswith(f"{name.rstrip('/')}/")


def run_checks(
    checks: Sequence[Check],
    session: Session,
    record: Record,
    *,
    max_seconds: float = float("inf"),
    written: Callable[[Record], None] = lambda record: None,
    progress: Callable[[int], None] = lambda done: None,
) -> None:
    """Run checks that the record does not have yet, and put what came of them there.

    Args:
        checks: What to run, in this order.
        session: Where and how.
        record: Takes the entries.
        max_seconds: No check begins after so long [s]; those that are left out are skipped, but
            for what an earlier run found of them.
        written: Called with the record after each check.
        progress: Called with 1 after each check.
    """
    begin = time.monotonic()
    for check in checks:
        if not record.done(check.name):
            if time.monotonic() - begin < max_seconds:
                record.entries[check.name] = run_check(check, session)
            else:
                record.entries.setdefault(check.name, _left_out(check))
            written(record)
        progress(1)


def _left_out(check: Check) -> Entry:
    return Entry(check.name, check.expected, "skipped", note="no time was left for it")


def run_check(check: Check, session: Session) -> Entry:
    """Return what comes of a check; an error of its own is a failure, and memory a reason to skip.

    Args:
        check: What to run.
        session: Where and how.
    """
    begin = time.perf_counter()
    verdict: Verdict
    try:
        finding = check.run(session)
        return Entry.of(check, finding, time.perf_counter() - begin)
    except Skipped as reason:
        verdict, note = "skipped", str(reason)
    except torch.OutOfMemoryError:
        verdict, note = "skipped", "not enough memory"
    except Exception as error:
        # Whatever breaks here is what the command is looking for.
        verdict, note = "fail", f"{type(error).__name__}: {' '.join(str(error).split())}"
    seconds = time.perf_counter() - begin
    return Entry(check.name, check.expected, verdict, note=note, seconds=seconds)
