"""The suite of `npa-envs stress`: every check, how checks are run, and their record."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
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
from npa_envs.measure.record import read_record, time_limit, write_record
from npa_envs.measure.tables import table_text
from npa_envs.rule.files import load_rule, rule_digest

MEASURED = ("pass", "range")
"""Verdicts of checks that a resumed run does not repeat."""

FAR = 1e3
"""Colours of heat maps end at this many times a limit, and at its inverse."""


def all_checks(
    *, quick: bool = False, seed: int = 0, rules: Mapping[str, str] | None = None
) -> list[Check]:
    """Return every check in the order that they are run in; when quick, only of some of the rules.

    Random places are drawn from the seed. Of `rules`, name -> what `load_rule` takes, it is every
    check of a rule, and nothing else.
    """
    return [
        *(() if rules else (*geometry_checks(seed), *values_checks())),
        *endurance_checks(rules),
        *gradients_checks(quick=quick, rules=rules),
        *precision_checks(quick=quick, rules=rules),
    ]


def chosen_checks(checks: Sequence[Check], names: Sequence[str]) -> list[Check]:
    """Return the checks that names stand for: groups, checks, beginnings of names up to a slash.

    Raises:
        NPAError: A name stands for none.
    """

    def stands_for(name: str, check: Check) -> bool:
        return f"{check.name}/".startswith(f"{name.rstrip('/')}/")

    for name in names:
        if not any(stands_for(name, check) for check in checks):
            known = [*GROUPS, *(check.name for check in checks)]
            raise NPAError(f"unknown check {name!r}: {suggest(name, known)}")
    return [
        check for check in checks if not names or any(stands_for(name, check) for name in names)
    ]


@dataclass(frozen=True)
class CheckEntry:
    """A check and what came of it."""

    name: str
    expected: str
    verdict: Verdict
    figures: Mapping[str, float] = field(default_factory=dict)
    """What was measured, by name."""
    limits: Mapping[str, float] = field(default_factory=dict)
    """Largest values allowed, by the figure's name."""
    holds: str = ""
    """For a range: where it holds."""
    note: str = ""
    """The reason to skip it, the message of its error, or what else there is to know."""
    seconds: float = 0.0
    """How long it took [s]."""
    weights: str = ""
    """Of a check of a rule: what `rule_digest` says of it; older records do not tell."""

    @classmethod
    def of(cls, check: Check, finding: CheckResult, seconds: float) -> CheckEntry:
        """Return the entry of a check that ran to its end."""
        return cls(
            check.name,
            check.expected,
            finding.verdict,
            dict(finding.figures),
            dict(finding.limits),
            finding.holds,
            finding.note,
            seconds,
        )

    @property
    def group(self) -> str:
        """The group that the check belongs to."""
        return group_of(self.name)

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


@dataclass
class Record:
    """All that a run found."""

    facts: dict[str, Any]
    """What its figures follow from: device, machine, size, seed, commit, versions."""
    entries: dict[str, CheckEntry] = field(default_factory=dict)
    """What came of each check, by its name."""

    @classmethod
    def read(cls, path: Path, facts: Mapping[str, Any]) -> Record:
        """Return the record that a run left, an empty one where there is none.

        Raises:
            NPAError: As for `read_record`.
        """

        def made(held: dict[str, Any]) -> dict[str, CheckEntry]:
            return {fields["name"]: _entry(fields) for fields in held["checks"]}

        return cls(dict(facts), read_record(path, facts, made, command="stress") or {})

    def write(self, path: Path) -> None:
        """Write everything as JSON; numbers that are not finite become "nan", "inf" and "-inf".

        Raises:
            NPAError: It cannot be written.
        """
        entries = [asdict(entry) for entry in self.entries.values()]
        content = {"facts": self.facts, "counts": self.counts(), "checks": entries}
        write_record(path, _with_words(content))

    def done(self, name: str) -> bool:
        """Return whether a check need not be run again."""
        return name in self.entries and self.entries[name].verdict in MEASURED

    def drop_other_rules(self, weights: Mapping[str, str]) -> None:
        """Drop what was found of rules that have been trained anew.

        Args:
            weights: What `rule_digest` says now of the rules of checks, by the checks' names.
        """
        for name, digest in weights.items():
            if name in self.entries and self.entries[name].weights != digest:
                del self.entries[name]

    def counts(self) -> dict[str, int]:
        """Return how many checks came to each verdict."""
        found = [entry.verdict for entry in self.entries.values()]
        return {verdict: found.count(verdict) for verdict in ("pass", "range", "fail", "skipped")}

    def failed(self) -> list[CheckEntry]:
        """Return the entries of the checks that failed."""
        return [entry for entry in self.entries.values() if entry.verdict == "fail"]

    def by_group(self) -> dict[str, list[CheckEntry]]:
        """Return the entries of each group."""
        groups: dict[str, list[CheckEntry]] = {}
        for entry in self.entries.values():
            groups.setdefault(entry.group, []).append(entry)
        return groups

    def in_order(self, names: Iterable[str]) -> Record:
        """Return the same with entries in the order of these names, others last."""
        order = {name: place for place, name in enumerate(names)}
        entries = sorted(self.entries.items(), key=lambda item: order.get(item[0], len(order)))
        return Record(self.facts, dict(entries))

    def text(self) -> str:
        """Return a table of each group, and what is to be known of those that failed."""
        parts = [_group_text(entries) for entries in self.by_group().values()]
        parts += [
            f"{entry.name} failed: {entry.worst() or entry.note}\n  expected: {entry.expected}"
            + (f"\n  {entry.note}" if entry.note and entry.worst() else "")
            for entry in self.failed()
        ]
        told = ", ".join(f"{count} {verdict}" for verdict, count in self.counts().items())
        return "\n\n".join([*parts, told])


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


def _entry(fields: dict[str, Any]) -> CheckEntry:
    for name in ("figures", "limits"):
        fields[name] = {key: float(value) for key, value in fields[name].items()}
    return CheckEntry(**fields)


def run_checks(
    checks: Sequence[Check],
    session: CheckSession,
    record: Record,
    *,
    max_seconds: float | None = None,
    weights: Mapping[str, str] | None = None,
    written: Callable[[Record], None] = lambda record: None,
    progress: Callable[[int], None] = lambda done: None,
) -> None:
    """Run checks that the record does not have yet, and put what came of them there.

    No check begins after `max_seconds`; those that are left out are skipped, but for what an
    earlier run found of them. `weights` are those of checks of rules, as `rule_weights` returns
    them. After each check `written` is called with the record, `progress` with 1.
    """
    time_is_up = time_limit(max_seconds)
    for check in checks:
        if not record.done(check.name):
            if time_is_up():
                left = CheckEntry(
                    check.name, check.expected, "skipped", note="no time was left for it"
                )
                record.entries.setdefault(check.name, left)
            else:
                found = run_check(check, session)
                told = (weights or {}).get(check.name, "")
                record.entries[check.name] = replace(found, weights=told)
            written(record)
        progress(1)


def rule_weights(checks: Iterable[Check]) -> dict[str, str]:
    """Return what `rule_digest` says of the rules of checks of one, by the checks' names.

    Raises:
        NPAError: A rule cannot be loaded.
    """
    some = [check for check in checks if check.rule]
    known = {rule: rule_digest(load_rule(rule)) for rule in {check.rule for check in some}}
    return {check.name: known[check.rule] for check in some}


def run_check(check: Check, session: CheckSession) -> CheckEntry:
    """Return what comes of a check: raising is a failure, lack of memory a reason to skip."""
    begin = time.perf_counter()
    verdict: Verdict
    try:
        finding = check.run(session)
        return CheckEntry.of(check, finding, time.perf_counter() - begin)
    except Skipped as reason:
        verdict, note = "skipped", str(reason)
    except torch.OutOfMemoryError:
        verdict, note = "skipped", "not enough memory"
    except Exception as error:
        # Whatever breaks here is what the command is looking for.
        verdict, note = "fail", f"{type(error).__name__}: {' '.join(str(error).split())}"
    seconds = time.perf_counter() - begin
    return CheckEntry(check.name, check.expected, verdict, note=note, seconds=seconds)


def heat_maps(record: Record) -> dict[str, bytes]:
    """Return PNG files by their groups: every figure over its limit; below 1 it is kept.

    Groups without figures that have limits get none.
    """
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
