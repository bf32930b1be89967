"""The record of a run: JSON that is written after each check, and tables for the eye."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from npa_envs.errors import NPAError
from npa_envs.files import write_text
from npa_envs.measure.accuracy.checks import Check, Finding, Verdict
from npa_envs.measure.tables import table_text

MEASURED = ("pass", "range")
"""Verdicts of checks that a resumed run does not repeat."""


@dataclass(frozen=True)
class Entry:
    """A check and what came of it."""

    name: str
    """Its name."""
    expected: str
    """What was expected."""
    verdict: Verdict
    """What came of it."""
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

    @classmethod
    def of(cls, check: Check, finding: Finding, seconds: float) -> Entry:
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
        return self.name.partition("/")[0]

    def share(self, name: str) -> float:
        """Return a figure over its limit: above 1, or not a number, it is exceeded.

        Args:
            name: A figure that has a limit. A limit of 0 allows nothing but 0.
        """
        value, limit = self.figures.get(name, math.nan), self.limits[name]
        if limit == 0.0:
            return value if value == 0.0 or math.isnan(value) else math.inf
        return value / limit

    def worst(self) -> str:
        """Return the figure that is nearest to its limit, or furthest above it, in words."""
        if not self.limits:
            return ""

        def size(name: str) -> float:
            share = self.share(name)
            return math.inf if math.isnan(share) else share

        name = max(self.limits, key=size)
        value = self.figures.get(name, math.nan)
        return f"{name} {value:.2g} (at most {self.limits[name]:.2g})"


@dataclass(frozen=True)
class Row:
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
    entries: dict[str, Entry] = field(default_factory=dict)
    """What came of each check, by its name."""

    def done(self, name: str) -> bool:
        """Return whether a check need not be run again."""
        return name in self.entries and self.entries[name].verdict in MEASURED

    def counts(self) -> dict[str, int]:
        """Return how many checks came to each verdict."""
        found = [entry.verdict for entry in self.entries.values()]
        return {verdict: found.count(verdict) for verdict in ("pass", "range", "fail", "skipped")}

    def failed(self) -> list[Entry]:
        """Return the entries of the checks that failed."""
        return [entry for entry in self.entries.values() if entry.verdict == "fail"]

    def text(self) -> str:
        """Return a table of each group, and what is to be known of those that failed."""
        parts = []
        for group in dict.fromkeys(entry.group for entry in self.entries.values()):
            rows = [_row(entry) for entry in self.entries.values() if entry.group == group]
            width = max(len(row.found) for row in rows)
            rows = [Row(r.check, r.verdict, r.seconds, r.found.ljust(width)) for r in rows]
            parts.append("\n".join(line.rstrip() for line in table_text(rows).splitlines()))
        parts += [
            f"{entry.name} failed: {entry.worst() or entry.note}\n  expected: {entry.expected}"
            + (f"\n  {entry.note}" if entry.note and entry.worst() else "")
            for entry in self.failed()
        ]
        told = ", ".join(f"{count} {verdict}" for verdict, count in self.counts().items())
        return "\n\n".join([*parts, told])

    def write(self, path: Path) -> None:
        """Write everything as JSON, whole or not at all.

        Args:
            path: The file. Numbers that are not finite become "nan", "inf" and "-inf".

        Raises:
            NPAError: It cannot be written.
        """
        entries = [asdict(entry) for entry in self.entries.values()]
        content = _plain({"facts": self.facts, "counts": self.counts(), "checks": entries})
        write_text(path, json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False) + "\n")


def _row(entry: Entry) -> Row:
    found = entry.holds or entry.worst() or entry.note
    return Row(entry.name, entry.verdict, round(entry.seconds, 2), found)


def _plain(value: Any) -> Any:
    """Return a tree of values in which numbers that are not finite are words."""
    if isinstance(value, Mapping):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_plain(inner) for inner in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def read_record(path: Path, facts: Mapping[str, Any]) -> Record:
    """Return the record that a run left, an empty one where there is none.

    Args:
        path: The file that it wrote.
        facts: What figures follow from now.

    Raises:
        NPAError: The file is no record, or its figures follow from something else.
    """
    if not path.exists():
        return Record(dict(facts))
    try:
        held = json.loads(path.read_text("utf-8"))
        before = held["facts"]
        entries = [_entry(fields) for fields in held["checks"]]
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise NPAError(
            f"{str(path)!r} must hold a record of npa-envs stress, but cannot be read ({error}): "
            "remove it, or choose another folder with --output"
        ) from error
    for name, value in _plain(dict(facts)).items():
        if before.get(name) != value:
            raise NPAError(
                f"{str(path)!r} holds figures of other settings: {name} was {before.get(name)!r}, "
                f"now {value!r}: remove it, or choose another folder with --output"
            )
    return Record(dict(facts), {entry.name: entry for entry in entries})


def _entry(fields: dict[str, Any]) -> Entry:
    for name in ("figures", "limits"):
        fields[name] = {key: float(value) for key, value in fields[name].items()}
    return Entry(**fields)


def in_order(record: Record, names: Iterable[str]) -> Record:
    """Return a record whose entries come in the order of these names, others last."""
    order = {name: place for place, name in enumerate(names)}
    entries = sorted(record.entries.items(), key=lambda item: order.get(item[0], len(order)))
    return Record(record.facts, dict(entries))
