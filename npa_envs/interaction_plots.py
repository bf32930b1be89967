"""Heat maps of what rules do to each other."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from typing import Any

from npa_envs.interaction import InteractionRow

LARGEST_CHANGE = 4.0
"""Colours end at this many times the loss alone, and at its inverse."""


def heat_map(rows: Sequence[InteractionRow]) -> bytes:
    """Return a PNG: how each rule's loss changes beside each other one, and how much they mix.

    One pair of panels for each distance and ratio; rows are the measured rules. Needs matplotlib.

    Args:
        rows: What was measured; pairs that are missing stay blank.
    """
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

    names = list(dict.fromkeys([row.rule for row in rows] + [row.beside for row in rows]))
    settings = list(dict.fromkeys((row.ratio, row.distance) for row in rows))
    side = 1.6 + 0.55 * len(names)
    figure = Figure(figsize=(2 * side + 2.0, side * len(settings)), layout="constrained")
    panels = figure.subplots(len(settings), 2, squeeze=False)
    norm = LogNorm(1.0 / LARGEST_CHANGE, LARGEST_CHANGE)
    for (ratio, distance), (left, right) in zip(settings, panels, strict=True):
        some = [row for row in rows if (row.ratio, row.distance) == (ratio, distance)]
        where = f"distance {distance:g}, ratio {ratio:g}"
        change = _draw_matrix(left, names, some, "change", cmap="RdBu_r", norm=norm)
        left.set(title=f"loss together / alone\n{where}", ylabel="rule", xlabel="beside")
        mixing = _draw_matrix(right, names, some, "mixing", cmap="viridis", vmin=0.0, vmax=1.0)
        right.set(title=f"mixing index\n{where}", xlabel="beside")
        ticks = [0.25, 0.5, 1.0, 2.0, 4.0]
        figure.colorbar(change, ax=left, ticks=ticks, format="%g").minorticks_off()
        figure.colorbar(mixing, ax=right)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=90)
    return buffer.getvalue()


def _draw_matrix(
    panel: Any, names: list[str], rows: Sequence[InteractionRow], what: str, **colours: Any
) -> Any:
    """Draw one number of each pair, and write it into its cell."""
    values = [[math.nan] * len(names) for _ in names]
    for row in rows:
        value = getattr(row, what)
        down, across = names.index(row.rule), names.index(row.beside)
        # Infinities have no colour of their own.
        values[down][across] = min(value, 1e6)
        label = panel.text(across, down, f"{value:.2g}", ha="center", va="center", fontsize=7)
        label.set_bbox({"facecolor": "white", "alpha": 0.6, "linewidth": 0.0, "pad": 1.5})
    image = panel.imshow(values, **colours)
    places = range(len(names))
    panel.set_xticks(places, names, rotation=45, ha="right", fontsize=8)
    panel.set_yticks(places, names, fontsize=8)
    return image
