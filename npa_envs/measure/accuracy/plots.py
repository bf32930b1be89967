"""Heat maps of a record: how near each figure is to its limit."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from typing import Any

from npa_envs.measure.accuracy.record import Entry, Record

FAR = 1e3
"""Colours end at this many times a limit, and at its inverse."""

WRONG = "black"
"""Colour of what is not a number."""


def heat_maps(record: Record) -> dict[str, bytes]:
    """Return PNG files by their names. Needs matplotlib.

    Args:
        record: What was measured; groups without figures that have limits get none.
    """
    drawn = {}
    for group in dict.fromkeys(entry.group for entry in record.entries.values()):
        entries = [
            e for e in record.entries.values() if e.group == group and e.figures and e.limits
        ]
        if entries:
            drawn[group] = _draw_limits(group, entries)
    return drawn


def _draw_limits(group: str, entries: Sequence[Entry]) -> bytes:
    """Draw every figure over its limit; below 1 it is kept."""
    from matplotlib.figure import Figure

    columns = list(dict.fromkeys(name for entry in entries for name in entry.limits))
    shares = [
        [entry.share(name) if name in entry.limits else None for name in columns]
        for entry in entries
    ]
    rows = [entry.name.partition("/")[2] for entry in entries]
    size = (3.0 + 0.6 * len(columns), 1.6 + 0.26 * len(rows))
    figure = Figure(figsize=size, layout="constrained")
    panel = figure.subplots()
    _draw_matrix(panel, rows, columns, shares)
    panel.set_title(f"{group}: figures over their limits")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()


def _draw_matrix(
    panel: Any,
    rows: Sequence[str],
    columns: Sequence[str],
    values: Sequence[Sequence[float | None]],
) -> None:
    """Draw shares on a logarithmic scale and write each into its cell; None stays blank."""
    from matplotlib import colormaps
    from matplotlib.colors import LogNorm

    low, high = 1.0 / FAR, FAR
    norm = LogNorm(low, high, clip=True)
    colour_of = colormaps["RdYlGn_r"]
    panel.set(xlim=(-0.5, len(columns) - 0.5), ylim=(len(rows) - 0.5, -0.5), aspect="auto")
    for down, line in enumerate(values):
        for across, value in enumerate(line):
            if value is None:
                continue
            wrong = math.isnan(value)
            colour = WRONG if wrong else colour_of(float(norm(min(max(value, low), high))))
            panel.add_patch(_square(across, down, colour))
            text = "nan" if wrong else f"{value:.2g}"
            ink = "white" if wrong else "black"
            panel.text(across, down, text, ha="center", va="center", fontsize=6, color=ink)
    panel.set_xticks(range(len(columns)), columns, rotation=45, ha="right", fontsize=7)
    panel.set_yticks(range(len(rows)), rows, fontsize=7)


def _square(across: int, down: int, colour: Any) -> Any:
    from matplotlib.patches import Rectangle

    return Rectangle((across - 0.5, down - 0.5), 1.0, 1.0, facecolor=colour, edgecolor="white")
