"""Results as tables: rows of one dataclass as plain text or as JSON."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from typing import Any


def table_text(rows: Sequence[Any], *, missing: str = "never") -> str:
    """Return rows as a plain text table, one line each under a line of headings.

    Args:
        rows: Instances of one dataclass, for example those that `evaluate` returns.
        missing: What a None is shown as.
    """
    if not rows:
        return ""
    names = [field.name for field in dataclasses.fields(rows[0])]
    cells = [[name.replace("_", " ") for name in names]]
    cells += [[_cell(getattr(row, name), missing) for name in names] for row in rows]
    widths = [max(len(line[column]) for line in cells) for column in range(len(names))]
    return "\n".join(
        "  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True))
        for line in cells
    )


def tables_json(tables: Mapping[str, Sequence[Any]], **facts: str) -> str:
    """Return tables as a JSON object of lists; a number that is not finite becomes null.

    Args:
        tables: Rows, instances of dataclasses, by the table's name.
        facts: What else the object says, by name.
    """

    def plain(value: Any) -> Any:
        return None if isinstance(value, float) and not math.isfinite(value) else value

    objects: dict[str, Any] = {
        name: [{k: plain(v) for k, v in dataclasses.asdict(row).items()} for row in rows]
        for name, rows in tables.items()
    }
    return json.dumps({**facts, **objects}, indent=2, allow_nan=False) + "\n"


def _cell(value: object, missing: str) -> str:
    if value is None:
        return missing
    return f"{value:.4g}" if isinstance(value, float) else str(value)
