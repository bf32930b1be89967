"""The suite of `npa-envs stress`: every check, how checks are run, and their record."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from npa_envs.errors import NPAError, suggest
from npa_envs.measure.accuracy.checks import (
    GROUPS,
    Check,
    CheckResult,
    CheckSession,
    Skipped,
    Verdict,
    group_of,
)
from npa_envs.measure.accuracy.endurance import endurance_checks
from npa_envs.measure.accuracy.hard_cases import geometry_checks, values_checks
from npa_envs.measure.accuracy.numerics import gradients_checks, precision_checks
from npa_envs.measure.plots import draw_matrix, new_figure, png
from npa_envs.measure.record import Record, time_limit
from npa_envs.measure.tables import as_objects, table_text
from npa_envs.rule.files import load_rule, rule_digest

MEASURED = ("pass", "range")
"""Verdicts of checks that a resumed run does not repeat."""

FAR = 1e3
"""Colours of heat maps end at this many times a limit, and at its inverse."""


def all_checks(
    *, quick: bool = False, seed: int = 0, rules: Mapping[str, str] | None = None
) -> list[Check]:
    """Return every check in its order; of `rules`, name -> source, the checks of a rule alone.

    When quick only some shipped rules are checked. Random places are drawn from the seed.
    """
    return [
        *(() if rules else (*geometry_checks(seed), *values_checks())),
        *endurance_checks(rules),
        *gradients_checks(quick=quick, rules=rules),
        *precision_checks(quick=quick, rules=rules),
    ]


def chosen_checks(checks: Sequence[Check], names: Sequence[str]) -> list[Check]:
    """Return the checks that names stand for: groups, checks, beginnings of names up to a slash."""

    def stands_for(name: str, check: Check) -> bool:
        return f"{check.name}/".startswith(f"{name.rstrip('/')}/")

    for name in names:
        if not any(stands_for(name, check) for check in checks):
            known = [*GROUPS, *(check.name for check in checks)]
            raise NPAError(f"unknown check {name!r}: {suggest(name, known)}")
    return [c for c in checks if not names or any(stands_for(name, c) for name in names)]


@dataclass(frozen=True)
class CheckEntry:
    """A check, its figures and limits by name, and what came of it."""

    name: str
    expected: str
    verdict: Verdict
    figures: Mapping[str, float] = field(default_factory=dict)
    limits: Mapping[str, float] = field(default_factory=dict)
    holds: str = ""
    """For a range: where it holds."""
    note: str = ""
    """The reason to skip it, the message of its error, or what else there is to know."""
    seconds: float = 0.0
    """How long it took [s]."""
    weights: str = ""
    """The `rule_digest` of a check's rule."""

    @classmethod
    def of(cls, check: Check, found: CheckResult, seconds: float) -> CheckEntry:
        """Return the entry of a check that ran to its end."""
        return cls(check.name, check.expected, found.verdict, **vars(found), seconds=seconds)

    @property
    def done(self) -> bool:
        """Whether a resumed run does not repeat it."""
        return self.verdict in MEASURED

    def share(self, name: str) -> float:
        """Return a figure over its limit: above 1, or not a number, it is exceeded.

        A limit of 0 allows nothing but 0.
        """
        value, limit = self.figures.get(name, math.nan), self.limits[name]
        if limit == 0.0:
            return value if value == 0.0 or math.isnan(value) else math.inf
        return value / limit

    def worst(self) -> str:
        """Return the figure that is nearest to its limit, or furthest above it, in words."""
        if not self.limits:
            return ""
        shares = {name: self.share(name) for name in self.limits}
        name = max(shares, key=lambda name: (math.isnan(shares[name]), shares[name]))
        value = self.figures.get(name, math.nan)
        return f"{name} {value:.2g} (at most {self.limits[name]:.2g})"


@dataclass(frozen=True)
class CheckRow:
    """A line of the printed tables."""

    check: str
    verdict: str
    seconds: float
    found: str


class StressRecord(Record[CheckEntry]):
    """All that a run found, in the order of names."""

    def __init__(
        self, facts: Mapping[str, Any], path: Path | None = None, names: Iterable[str] = ()
    ) -> None:
        super().__init__(facts, path=path, content=self._content)
        self._order = {name: place for place, name in enumerate(names)}

    def _content(self, rows: list[CheckEntry]) -> dict[str, Any]:
        # JSON has no numbers that are not finite: they become words.
        return {"counts": self.counts(), "checks": _with_words(as_objects(rows))}

    def read(self) -> StressRecord:
        """Take over the entries of a run that was stopped, and return this record."""

        def entry(fields: dict[str, Any]) -> CheckEntry:
            for name in ("figures", "limits"):
                fields[name] = {key: float(value) for key, value in fields[name].items()}
            return CheckEntry(**fields)

        self.resume(lambda held: [entry(fields) for fields in held["checks"]], command="stress")
        return self

    def entry(self, name: str) -> CheckEntry | None:
        """Return the entry of a check, None where it has not been run."""
        return next((entry for entry in self.rows if entry.name == name), None)

    def put(self, entry: CheckEntry) -> None:
        """Add an entry, in the place of one of the same name, and write the file."""
        self.rows = [row for row in self.rows if row.name != entry.name] + [entry]
        self.rows.sort(key=lambda row: self._order.get(row.name, len(self._order)))
        self.write()

    def drop_other_rules(self, weights: Mapping[str, str]) -> None:
        """Drop checks whose rule has other weights now: `rule_digest` by the checks' names."""
        self.rows = [row for row in self.rows if weights.get(row.name, row.weights) == row.weights]

    def counts(self) -> dict[str, int]:
        """Return how many checks came to each verdict."""
        found = [entry.verdict for entry in self.rows]
        return {verdict: found.count(verdict) for verdict in ("pass", "range", "fail", "skipped")}

    def failed(self) -> list[CheckEntry]:
        """Return the entries of the checks that failed."""
        return [entry for entry in self.rows if entry.verdict == "fail"]

    def by_group(self) -> dict[str, list[CheckEntry]]:
        """Return the entries of each group."""
        groups: dict[str, list[CheckEntry]] = {}
        for entry in self.rows:
            groups.setdefault(group_of(entry.name), []).append(entry)
        return groups

    def text(self) -> str:
        """Return a table of each group, and the expectations of the checks that failed."""
        parts = [_group_text(entries) for entries in self.by_group().values()]
        parts += [
            f"{entry.name} failed: {entry.worst() or entry.note}\n  expected: {entry.expected}"
            + (f"\n  {entry.note}" if entry.note and entry.worst() else "")
            for entry in self.failed()
        ]
        counts = ", ".join(f"{count} {verdict}" for verdict, count in self.counts().items())
        return "\n\n".join([*parts, counts])


def _group_text(entries: Sequence[CheckEntry]) -> str:
    found = [entry.holds or entry.worst() or entry.note for entry in entries]
    width = max(map(len, found))
    rows = [
        CheckRow(entry.name, entry.verdict, round(entry.seconds, 2), words.ljust(width))
        for entry, words in zip(entries, found, strict=True)
    ]
    return "\n".join(line.rstrip() for line in table_text(rows).splitlines())


def _with_words(value: Any) -> Any:
    """Return a tree of values in which numbers that are not finite are words."""
    if isinstance(value, Mapping):
        return {key: _with_words(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_with_words(inner) for inner in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def run_checks(
    checks: Sequence[Check],
    session: CheckSession,
    record: StressRecord,
    *,
    max_seconds: float | None = None,
    weights: Mapping[str, str] | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> None:
    """Run checks that are not done, and put what came of them into the record.

    No check begins after `max_seconds`; those that are left are skipped, unless an earlier run has
    an entry. `weights` are those of `rule_weights`. After each check `progress` is called with 1.
    """
    time_is_up = time_limit(max_seconds)
    for check in checks:
        entry = record.entry(check.name)
        if entry is None or not entry.done:
            if not time_is_up():
                entry = run_check(check, session)
                entry = replace(entry, weights=(weights or {}).get(check.name, ""))
            elif entry is None:
                note = "no time was left for it"
                entry = CheckEntry(check.name, check.expected, "skipped", note=note)
            record.put(entry)
        progress(1)


def rule_weights(checks: Iterable[Check]) -> dict[str, str]:
    """Return the `rule_digest` of the rules of checks of one, by the checks' names."""
    some = [check for check in checks if check.rule]
    known = {rule: rule_digest(load_rule(rule)) for rule in {check.rule for check in some}}
    return {check.name: known[check.rule] for check in some}


def run_check(check: Check, session: CheckSession) -> CheckEntry:
    """Return what comes of a check: raising is a failure, lack of memory a reason to skip."""
    begin = time.perf_counter()
    verdict: Verdict
    try:
        return CheckEntry.of(check, check.run(session), time.perf_counter() - begin)
    except Skipped as reason:
        verdict, note = "skipped", str(reason)
    except torch.OutOfMemoryError:
        verdict, note = "skipped", "not enough memory"
    except Exception as error:
        # Whatever breaks is what the command looks for.
        verdict, note = "fail", f"{type(error).__name__}: {' '.join(str(error).split())}"
    seconds = time.perf_counter() - begin
    return CheckEntry(check.name, check.expected, verdict, note=note, seconds=seconds)


def heat_maps(record: StressRecord) -> dict[str, bytes]:
    """Return PNG files by group: every figure over its limit, where there are such."""
    drawn = {}
    for group, entries in record.by_group().items():
        limited = [entry for entry in entries if entry.figures and entry.limits]
        if limited:
            drawn[group] = _heat_map(group, limited)
    return drawn


def _heat_map(group: str, entries: Sequence[CheckEntry]) -> bytes:
    from matplotlib.colors import LogNorm

    columns = list(dict.fromkeys(name for entry in entries for name in entry.limits))
    shares = [
        [entry.share(name) if name in entry.limits else None for name in columns]
        for entry in entries
    ]
    rows = [entry.name.partition("/")[2] for entry in entries]
    figure, ((panel,),) = new_figure(1, 1, (3.0 + 0.6 * len(columns), 1.6 + 0.26 * len(rows)))
    draw_matrix(panel, rows, columns, shares, colours="RdYlGn_r", norm=LogNorm(1.0 / FAR, FAR))
    panel.set_title(f"{group}: figures over their limits")
    return png(figure, 110)
