"""Records of measurements (JSON files), the metadata of their runs, and tables as text.

Run metadata is what results depend on: device, machine, commit, versions, settings. A record is
written after every result, so that a stopped run can resume; with other metadata it raises.
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
"""Python packages whose versions are recorded."""

Content = TypeVar("Content")
Row = TypeVar("Row")


class Record(Generic[Row]):
    """Results of a measurement (rows), the run metadata (`facts`), and their JSON file, if any."""

    command: str
    """The command of `npa-envs` that writes such records, for messages of errors."""
    key = "facts"
    """Key of the run metadata in the file."""

    def __init__(
        self, facts: Mapping[str, Any], path: Path | None = None, rows: Iterable[Row] = ()
    ) -> None:
        self.facts, self.path, self.rows = facts, path, list(rows)

    def content(self) -> Mapping[str, Any]:
        """Return the fields of the file except the run metadata, for JSON."""
        return {"rows": as_objects(self.rows)}

    def parse(self, content: dict[str, Any]) -> list[Row]:
        """Return the rows in the JSON object of a file."""
        raise NotImplementedError

    def read(self) -> Self:
        """Add the rows of the file, if it exists, to this record, and return this record."""
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
    """Write `content` as JSON, whole or not at all; infinite numbers and NaN become null."""
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

    If it is not a record, or its run metadata (under `key`) differs from `facts`, an NPAError is
    raised, which names the `command` of `npa-envs`.
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
    """Return a number of a JSON record as a float; None (null) is NaN."""
    return math.nan if value is None else float(value)


def time_limit(max_seconds: float | None) -> Callable[[], bool]:
    """Return a function that returns whether `max_seconds` have passed since now; None: never."""
    end = math.inf if max_seconds is None else time.monotonic() + max_seconds
    return lambda: time.monotonic() >= end


# Run metadata


def measured_facts(device: torch.device, commit: str | None, **settings: Any) -> dict[str, Any]:
    """Return run metadata: device, settings, commit (None: the checkout's), versions, ..."""
    return {
        "device": device.type,
        "machine": machine(device),
        **settings,
        "commit": commit or current_commit(),
        "versions": versions(),
    }


def command_text(name: str, arguments: Sequence[str], *options: str) -> str:
    """Return the command line `npa-envs NAME ARGUMENTS` as text, for records.

    Values of `options`, which are paths of this machine, are replaced: "--out OUT".
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
    """Return the name of a device's hardware, such as "NVIDIA H100" or "CPU (model)"."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"CPU ({names[0] if names else platform.processor() or platform.machine()})"


def installed_version(name: str) -> str | None:
    """Return the version of a Python package; None: not installed."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def versions() -> dict[str, str | None]:
    """Return the versions of Python and of `LIBRARIES` by name; None: not installed."""
    libraries = {name: installed_version(name) for name in LIBRARIES}
    return {"python": platform.python_version(), **libraries}


def current_commit() -> str:
    """Return the short hash of the git checkout that this file is in; "unknown" if in none."""
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
"""Text of a cell without a value, in tables of plain text."""

NONE = "–"
"""Text of a cell without a value, in tables of Markdown."""


def table_text(rows: Sequence[Any], *, missing: str = "never") -> str:
    """Return rows, instances of one dataclass, as a table in plain text with the fields' names.

    None is shown as the rows' `missing` if they have one, else as this one; if this one is
    `UNMEASURED`, columns without values are left out.
    """
    if not rows:
        return ""
    return "\n".join(aligned(_cells(rows, missing)))


def aligned(lines: Sequence[Sequence[str]], *, left: bool = False) -> list[str]:
    """Return lines of text from lines of cells, with columns aligned right, or `left`."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    align = str.ljust if left else str.rjust
    return ["  ".join(map(align, line, widths)).rstrip() for line in lines]


def table_markdown(rows: Sequence[Any], *, missing: str = "never") -> str:
    """Return rows as a table in Markdown, with headings and cells as in `table_text`."""
    heads, *lines = _cells(rows, missing)
    return markdown_table(heads, lines)


def _cells(rows: Sequence[Any], missing: str) -> list[list[str]]:
    names = [field.name for field in dataclasses.fields(rows[0])]
    if missing == UNMEASURED:
        names = [name for name in names if any(getattr(row, name) is not None for row in rows)]
    heads = [name.replace("_", " ") for name in names]
    missing = getattr(rows[0], "missing", missing)
    return [heads, *([_cell(getattr(row, name), missing) for name in names] for row in rows)]


def _cell(value: object, missing: str) -> str:
    if value is None:
        return missing
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def tables_json(tables: Mapping[str, Sequence[Any]], **facts: str) -> str:
    """Return tables of rows by name and run metadata as JSON; infinite numbers and NaN are null."""
    return json_text({**facts, **{name: as_objects(rows) for name, rows in tables.items()}})


def as_objects(rows: Iterable[Any]) -> list[dict[str, Any]]:
    """Return instances of dataclasses as dicts, for JSON."""
    return [dataclasses.asdict(row) for row in rows]


def markdown_table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return headings and rows of cells as a table in Markdown."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def csv_text(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return headings and rows as comma-separated values; floats have 12 digits."""
    written = io.StringIO()
    writer = csv.writer(written, lineterminator="\n")
    writer.writerow(heads)
    for row in rows:
        writer.writerow([f"{v:.12g}" if isinstance(v, float) else v for v in row])
    return written.getvalue()


def short(value: float | str) -> str:
    """Return a number as text with three significant digits; text is returned as it is."""
    return value if isinstance(value, str) else f"{value:.3g}"


def mean_with_error(mean: float, error: float, digits: int = 3) -> str:
    """Return "mean ± standard error" with `digits` decimals; `NONE` if the mean is NaN."""
    if math.isnan(mean):
        return NONE
    return f"{mean:.{digits}f}" + ("" if math.isnan(error) else f" ± {error:.{digits}f}")
