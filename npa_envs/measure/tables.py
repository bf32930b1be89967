"""Tables of measurements: plain text, Markdown, comma-separated values, JSON."""

from __future__ import annotations

import csv
import dataclasses
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from npa_envs.files import json_text

UNMEASURED = "-"
"""What tables show where nothing was measured."""

NONE = "–"
"""What Markdown shows where nothing was measured."""


def table_text(rows: Sequence[Any], *, missing: str = "never") -> str:
    """Return rows, instances of one dataclass, as a plain text table under a line of headings.

    A None is shown as `missing`; if that is `UNMEASURED`, columns of it alone are left out.
    """
    if not rows:
        return ""
    return "\n".join(aligned(_cells(rows, missing)))


def aligned(lines: Sequence[Sequence[str]]) -> list[str]:
    """Return lines of cells in columns, which end below each other."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return [
        "  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True))
        for line in lines
    ]


def table_markdown(rows: Sequence[Any], *, missing: str = "never") -> str:
    """Return rows as a table in Markdown, with the headings and cells of `table_text`."""
    heads, *lines = _cells(rows, missing)
    return markdown_table(heads, lines)


def _cells(rows: Sequence[Any], missing: str) -> list[list[str]]:
    """Return headings, and the cells of each row."""
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
    """Return tables and facts as a JSON object; a number that is not finite becomes null."""
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
    """Return a number with three digits, a word as it is."""
    return value if isinstance(value, str) else f"{value:.3g}"


def mean_with_error(mean: float, error: float, digits: int = 3) -> str:
    """Return a mean with its standard error; either may be NaN, for not known."""
    if math.isnan(mean):
        return NONE
    return f"{mean:.{digits}f}" + ("" if math.isnan(error) else f" ± {error:.{digits}f}")
