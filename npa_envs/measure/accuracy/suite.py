"""Checks of `npa-envs stress`: what each finds and may find, how they run, and their record."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch

from npa_envs.errors import NPAError, suggest
from npa_envs.measure.plots import draw_matrix, new_figure, png
from npa_envs.measure.record import Record, aligned, as_objects, time_limit
from npa_envs.rule.files import load_rule, rule_digest

Verdict = Literal["pass", "fail", "range", "skipped"]

GROUPS = {
    "geometry": "where particles lie: forwards and backwards, against a float64 reference",
    "values": "what states hold: tiny, huge, infinite, no number",
    "time": "every shipped rule for 100 000 steps",
    "gradients": "how gradients grow with the steps; finite differences; float32's errors",
    "precision": "order, batches, repetitions, devices, recorded graphs",
}
"""Every group of checks with its summary."""

FAR = 1e3
"""Colours of heat maps end at this many times a limit, and at its inverse."""


class Skipped(Exception):
    """A check has nothing to measure; the message is the reason."""


@dataclass(frozen=True)
class CheckResult:
    """Figures of a check by name, and limits of some of them."""

    figures: Mapping[str, float]
    limits: Mapping[str, float] = field(default_factory=dict)
    holds: str = ""
    """For a range: where it holds, in words."""
    note: str = ""

    @property
    def verdict(self) -> Verdict:
        """Whether it is as expected; a figure that is missing or NaN is above its limit."""
        nan = float("nan")
        # Comparisons with NaN are false.
        if not all(self.figures.get(name, nan) <= limit for name, limit in self.limits.items()):
            return "fail"
        return "range" if self.holds else "pass"


@dataclass
class CheckSession:
    """One run of the command; when quick, with small worlds and few steps."""

    device: torch.device
    quick: bool = False
    seed: int = 0
    kept: dict[Any, Any] = field(default_factory=dict)
    """Results that several checks share."""

    @property
    def cuda(self) -> bool:
        """Whether the device is a CUDA device."""
        return self.device.type == "cuda"

    def generator(self, number: int = 0) -> torch.Generator:
        """Return a source of randomness on the device; others for other numbers."""
        return torch.Generator(self.device).manual_seed(1000 * self.seed + number)


Run = Callable[..., CheckResult]
"""Measures something in a session; a rule or a space dimension may come before that."""


@dataclass(frozen=True)
class Check:
    """A hard case GROUP/CASE, its expectation in a sentence, and the function that measures it."""

    name: str
    expected: str
    run: Run
    rule: str = ""
    """What `load_rule` takes, of a check of a rule."""


def group_of(name: str) -> str:
    """Return the group of a check's name."""
    return name.partition("/")[0]


def check(checks: list[Check], name: str, *space_dims: int) -> Callable[[Run], Run]:
    """Return a decorator that adds a check to a list, or one NAME/2d for each space dimension.

    The docstring of what it decorates says what is expected.
    """

    def add(run: Run) -> Run:
        expected = " ".join((run.__doc__ or "").split()).removesuffix(".")
        if not expected.startswith("NaN"):
            expected = expected[:1].lower() + expected[1:]
        checks.extend(Check(f"{name}/{d}d", expected, partial(run, d)) for d in space_dims)
        if not space_dims:
            checks.append(Check(name, expected, run))
        return run

    return add


def by_dimension(checks: Iterable[Check]) -> list[Check]:
    """Return checks in 2D first, then those in 3D, then others."""
    return sorted(checks, key=lambda one: {"2d": 0, "3d": 1}.get(one.name.rpartition("/")[2], 2))


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
        return self.verdict in ("pass", "range")

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


class StressRecord(Record[CheckEntry]):
    """All that a run found, in the order of names."""

    command = "stress"

    def __init__(
        self, facts: Mapping[str, Any], path: Path | None = None, names: Iterable[str] = ()
    ) -> None:
        super().__init__(facts, path)
        self._order = {name: place for place, name in enumerate(names)}

    def content(self) -> dict[str, Any]:
        """Return the entries; numbers that are not finite, which JSON has not, become words."""
        return {"counts": self.counts(), "checks": _with_words(as_objects(self.rows))}

    def parse(self, held: dict[str, Any]) -> list[CheckEntry]:
        """Return the entries of a run that was stopped."""
        for fields in held["checks"]:
            for name in ("figures", "limits"):
                fields[name] = {key: float(value) for key, value in fields[name].items()}
        return [CheckEntry(**fields) for fields in held["checks"]]

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
        parts = []
        for entries in self.by_group().values():
            found = [entry.holds or entry.worst() or entry.note for entry in entries]
            width = max(map(len, found))
            lines = [["check", "verdict", "seconds", "found"]]
            for entry, words in zip(entries, found, strict=True):
                seconds = f"{round(entry.seconds, 2):.4g}"
                lines.append([entry.name, entry.verdict, seconds, words.ljust(width)])
            parts.append("\n".join(line.rstrip() for line in aligned(lines)))
        parts += [
            f"{entry.name} failed: {entry.worst() or entry.note}\n  expected: {entry.expected}"
            + (f"\n  {entry.note}" if entry.note and entry.worst() else "")
            for entry in self.failed()
        ]
        counts = ", ".join(f"{count} {verdict}" for verdict, count in self.counts().items())
        return "\n\n".join([*parts, counts])


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
        entry = next((row for row in record.rows if row.name == check.name), None)
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
