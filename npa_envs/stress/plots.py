"""Heat maps of a record: how near each figure is to its limit, and where rules work."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from typing import Any

from npa_envs.stress.ranges import AXES, WORKS, label
from npa_envs.stress.record import Entry, Record

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
        entries = [e for e in record.entries.values() if e.group == group and e.figures]
        if group == "ranges":
            if entries:
                drawn[group] = _draw_ranges(entries)
        elif any(entry.limits for entry in entries):
            drawn[group] = _draw_limits(group, [entry for entry in entries if entry.limits])
    return drawn


def _draw_limits(group: str, entries: Sequence[Entry]) -> bytes:
    """Draw every figure over its limit; below 1 it is kept."""
    columns = list(dict.fromkeys(name for entry in entries for name in entry.limits))
    shares = [
        [entry.share(name) if name in entry.limits else None for name in columns]
        for entry in entries
    ]
    rows = [entry.name.partition("/")[2] for entry in entries]
    figure, panel = _panels(1, len(columns), len(rows))
    _draw_matrix(panel[0], rows, columns, shares, "RdYlGn_r", 1.0 / FAR, FAR)
    panel[0].set_title(f"{group}: figures over their limits")
    return _png(figure)


def _draw_ranges(entries: Sequence[Entry]) -> bytes:
    """Draw the metric of each rule over the trained one, a panel for each axis."""
    axes = [axis for axis in AXES if any(e.name.split("/")[1] == axis.name for e in entries)]
    rules = list(dict.fromkeys(entry.name.split("/")[2] for entry in entries))
    widest = max(len(axis.values) for axis in axes)
    figure, panels = _panels(len(axes), widest, len(rules))
    for axis, panel in zip(axes, panels, strict=True):
        found = {e.name.split("/")[2]: e for e in entries if e.name.split("/")[1] == axis.name}
        columns = [
            label(value)
            for value in sorted({*axis.values, *axis.quick})
            if any(label(value) in entry.figures for entry in found.values())
        ]
        ratios = [
            [found[rule].figures.get(name) if rule in found else None for name in columns]
            for rule in rules
        ]
        _draw_matrix(panel, rules, columns, ratios, "RdYlGn_r", 1.0 / WORKS**2, WORKS**2)
        panel.set_title(f"metric over the trained one, by {axis.name}")
    return _png(figure)


def _panels(count: int, columns: int, rows: int) -> tuple[Any, list[Any]]:
    """Return a figure and its panels, one below the other."""
    from matplotlib.figure import Figure

    size = (3.0 + 0.6 * columns, count * (1.6 + 0.26 * rows))
    figure = Figure(figsize=size, layout="constrained")
    return figure, list(figure.subplots(count, 1, squeeze=False)[:, 0])


def _draw_matrix(
    panel: Any,
    rows: Sequence[str],
    columns: Sequence[str],
    values: Sequence[Sequence[float | None]],
    colours: str,
    low: float,
    high: float,
) -> None:
    """Draw numbers on a logarithmic scale and write each into its cell; None stays blank."""
    from matplotlib import colormaps
    from matplotlib.colors import LogNorm

    norm = LogNorm(low, high, clip=True)
    colour_of = colormaps[colours]
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


def _png(figure: Any) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()
