"""Records and tables of measurements: JSON files with rows, and the facts of the run.

Facts are what the rows depend on: device, machine, commit, versions, settings. A record is written
after every entry, so that a stopped run can continue. Records with other facts are rejected.
"""

from __future__ import annotations

import csv
import dataclasses
import importlib.metadata
import io
import math
import os
import platform
import shlex
import subprocess
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Generic, Self, TypeVar

import torch

from npa_envs.atomic_files import json_text, plain_numbers, read_json, write_text
from npa_envs.errors import NPAError, shown

LIBRARIES = ("npa-envs", "torch", "warp-lang", "numpy", "scipy", "warpSPHCore")
"""Distributions whose versions are recorded."""

Content = TypeVar("Content")
Row = TypeVar("Row")


class Record(Generic[Row]):
    """The results of a measurement (rows) and the facts of its run, kept in a JSON file, if any."""

    command: str
    """The command that writes such records, for errors."""
    key = "facts"
    """Key of the facts in the file."""

    def __init__(
        self, facts: Mapping[str, Any], path: Path | None = None, rows: Iterable[Row] = ()
    ) -> None:
        self.facts, self.path, self.rows = facts, path, list(rows)

    def content(self) -> Mapping[str, Any]:
        """Return the fields of the file except the facts of the run."""
        return {"rows": as_objects(self.rows)}

    def parse(self, content: dict[str, Any]) -> list[Row]:
        """Return the rows from the JSON object of a file."""
        raise NotImplementedError

    def read(self) -> Self:
        """Read the rows of the file, if it exists, and return this record."""
        if self.path is not None:
            parse, command = self.parse, self.command
            rows = read_record(self.path, self.facts, parse, command=command, key=self.key)
            self.rows += rows or []
        return self

    def add(self, *rows: Row) -> None:
        """Add rows and write the file."""
        self.rows += rows
        self.write()

    def write(self) -> None:
        """Write the file, if the record has a path."""
        if self.path is not None:
            write_record(self.path, {self.key: self.facts, **self.content()})


def write_record(path: Path, content: Any) -> None:
    """Write JSON atomically; numbers that are not finite become null."""
    write_text(path, json_text(content))


def read_record(
    path: Path,
    facts: Mapping[str, Any],
    parse: Callable[[dict[str, Any]], Content],
    *,
    command: str,
    key: str = "facts",
) -> Content | None:
    """Return `parse` of the JSON object in a file; None if the file does not exist.

    Raises an NPAError, which names `command`, if the file's facts under `key` differ from `facts`.
    """
    if not os.path.exists(path):
        return None
    hint = "remove it, or choose another folder with --out"
    try:
        content = read_json(path, limit=64 * 2**20)
        before = dict(content[key])
        record = parse(content)
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise NPAError(
            f"{str(path)!r} must be a record of npa-envs {command}, but cannot be read "
            f"({shown(error)}): {hint}"
        ) from error
    for name, value in plain_numbers(facts).items():
        if before.get(name) != value:
            raise NPAError(
                f"{str(path)!r} has results of other settings: {name} was "
                f"{shown(before.get(name))}, now {shown(value)}: {hint}"
            )
    return record


def number(value: float | None) -> float:
    """Return a number read from a JSON record; NaN for null."""
    return math.nan if value is None else float(value)


def time_limit(max_seconds: float | None) -> Callable[[], bool]:
    """Return a function that returns whether `max_seconds` have passed since now; None: never."""
    end = math.inf if max_seconds is None else time.monotonic() + max_seconds
    return lambda: time.monotonic() >= end


# Facts


def measured_facts(device: torch.device, commit: str | None, **settings: Any) -> dict[str, Any]:
    """Return a record's facts: device, settings, commit (default: the checkout's) and versions."""
    return {
        "device": device.type,
        "machine": machine(device),
        **settings,
        "commit": commit or current_commit(),
        "versions": versions(),
    }


def command_text(name: str, arguments: Sequence[str], *options: str) -> str:
    """Return a command line as text, in which values of `options` are replaced: "--out OUT".

    Records do not name folders of the machine that they were written on.
    """
    words = ["npa-envs", name]
    for argument in arguments:
        option, mark, _ = argument.partition("=")
        if words[-1] in options:
            argument = words[-1].lstrip("-").upper()
        elif mark and option in options:
            argument = f"{option}={option.lstrip('-').upper()}"
        words.append(argument)
    return shlex.join(words)


def machine(device: torch.device) -> str:
    """Return the name of a device's hardware."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"CPU ({names[0] if names else platform.processor() or platform.machine()})"


def installed_version(name: str) -> str | None:
    """Return the version of a distribution, None if it is not installed."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def versions() -> dict[str, str | None]:
    """Return versions of Python and of `LIBRARIES`; None: not installed."""
    libraries = {name: installed_version(name) for name in LIBRARIES}
    return {"python": platform.python_version(), **libraries}


def current_commit() -> str:
    """Return the short hash of this file's git checkout, "unknown" without one."""
    command = ["git", "describe", "--always", "--dirty", "--exclude=*"]
    try:
        done = subprocess.run(
            command, cwd=Path(__file__).parent, capture_output=True, encoding="utf-8", check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return done.stdout.strip()


# Tables: plain text, Markdown, comma-separated values, JSON

UNMEASURED = "-"
"""Cell of a plain text table without a value."""

NONE = "–"
"""Cell of a Markdown table without a value."""


def table_text(rows: Sequence[Any], *, missing: str = "never") -> str:
    """Return instances of one dataclass as a plain text table with headings.

    None is shown as `missing`; if that is `UNMEASURED`, columns without values are left out.
    """
    if not rows:
        return ""
    return "\n".join(aligned(_cells(rows, missing)))


def aligned(lines: Sequence[Sequence[str]], *, left: bool = False) -> list[str]:
    """Return a table's lines of cells as text, with columns aligned right or left."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    align = str.ljust if left else str.rjust
    return ["  ".join(map(align, line, widths)).rstrip() for line in lines]


def table_markdown(rows: Sequence[Any], *, missing: str = "never") -> str:
    """Return rows as a table in Markdown, with the headings and cells of `table_text`."""
    heads, *lines = _cells(rows, missing)
    return markdown_table(heads, lines)


def _cells(rows: Sequence[Any], missing: str) -> list[list[str]]:
    names = [field.name for field in dataclasses.fields(rows[0])]
    if missing == UNMEASURED:
        names = [name for name in names if any(getattr(row, name) is not None for row in rows)]
    heads = [name.replace("_", " ") for name in names]
    return [heads, *([_cell(getattr(row, name), missing) for name in names] for row in rows)]


def _cell(value: object, missing: str) -> str:
    if value is None:
        return missing
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def tables_json(tables: Mapping[str, Sequence[Any]], **facts: str) -> str:
    """Return tables and facts as a JSON object; numbers that are not finite become null."""
    return json_text({**facts, **{name: as_objects(rows) for name, rows in tables.items()}})


def as_objects(rows: Iterable[Any]) -> list[dict[str, Any]]:
    """Return instances of dataclasses as JSON objects."""
    return [dataclasses.asdict(row) for row in rows]


def markdown_table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def csv_text(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return comma-separated values; floats have 12 digits."""
    written = io.StringIO()
    writer = csv.writer(written, lineterminator="\n")
    writer.writerow(heads)
    for row in rows:
        writer.writerow([f"{v:.12g}" if isinstance(v, float) else v for v in row])
    return written.getvalue()


def short(value: float | str) -> str:
    """Return a number with three digits; text stays as it is."""
    return value if isinstance(value, str) else f"{value:.3g}"


def mean_with_error(mean: float, error: float, digits: int = 3) -> str:
    """Return a mean ± its standard error as text; NaN: not known."""
    if math.isnan(mean):
        return NONE
    return f"{mean:.{digits}f}" + ("" if math.isnan(error) else f" ± {error:.{digits}f}")
