"""Parts of plots by matplotlib (extra `bench`): figures, bands, heat maps, axes, PNG files."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from npa_envs.atomic_files import write_bytes
from npa_envs.errors import MissingDependencyError, importing


def check_matplotlib() -> None:
    """Raise MissingDependencyError unless matplotlib is installed."""
    with importing("matplotlib", "a plot", "pip install 'npa-envs[bench]'"):
        import matplotlib  # noqa: F401


def write_plots(draw: Callable[[], Mapping[str, bytes]], path: Path, what: str) -> list[str]:
    """Write the PNG files that `draw` returns by name; return a line of text for each.

    A file's name replaces "*" in `path`. Without matplotlib the line says that there are no `what`.
    """
    try:
        check_matplotlib()
    except MissingDependencyError as error:
        return [f"no {what}: {error}"]
    done = []
    for name, picture in draw().items():
        place = path.with_name(path.name.replace("*", name))
        write_bytes(place, picture)
        done.append(f"wrote {place}")
    return done


def new_figure(rows: int, columns: int, size: tuple[float, float]) -> tuple[Any, Any]:
    """Return a figure of `size` [inches], and its panels (matplotlib's Axes), [rows, columns]."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def png(figure: Any, dpi: int = 90) -> bytes:
    """Return a figure as the bytes of a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()


def legend_of(figure: Any, panel: Any, place: str = "lower center", **options: Any) -> None:
    """Add the legend of one panel's curves to the figure, at `place` outside of its panels."""
    handles, labels = panel.get_legend_handles_labels()
    figure.legend(handles, labels, loc=f"outside {place}", **options)


def draw_band(
    panel: Any,
    across: Any,
    lines: tuple[Any, Any, Any],
    colour: str,
    label: str,
    **options: Any,
) -> None:
    """Plot a curve and a band over `across` (x): `lines` are lower end, curve and upper end (y)."""
    low, middle, high = lines
    panel.plot(across, middle, color=colour, label=label, **options)
    panel.fill_between(across, low, high, color=colour, alpha=0.2, lw=0)


Matrix = tuple[Sequence[str], Sequence[str], Sequence[Sequence[float | None]]]
"""Names of rows, names of columns, and positive numbers, row by row; None: an empty cell."""


def heat_map(matrices: Mapping[str, Matrix], *, colours: str, largest: float) -> bytes:
    """Return a PNG of matrices by title; logarithmic colours from 1 / `largest` to `largest`."""
    from matplotlib.colors import LogNorm

    size = max(len(columns) for _, columns, _ in matrices.values())
    heights = [1.6 + 0.3 * len(rows) for rows, _, _ in matrices.values()]
    figure, grid = new_figure(len(matrices), 1, (3.6 + 0.6 * size, sum(heights)))
    for (title, (rows, columns, values)), (panel,) in zip(matrices.items(), grid, strict=True):
        numbers = [[math.nan if value is None else value for value in line] for line in values]
        norm = LogNorm(1.0 / largest, largest)
        image = panel.imshow(numbers, cmap=colours, norm=norm, aspect="auto")
        for down, line in enumerate(values):
            for across, value in enumerate(line):
                if value is not None:
                    red, green, blue, _ = image.to_rgba(value)
                    ink = "white" if red + green + blue < 1.2 else "black"
                    style = {"color": ink, "ha": "center", "va": "center", "fontsize": 6}
                    panel.text(across, down, f"{value:.2g}", **style)
        panel.set_xticks(range(len(columns)), columns, rotation=45, ha="right", fontsize=7)
        panel.set_yticks(range(len(rows)), rows, fontsize=7)
        panel.set_title(title, fontsize=9)
        figure.colorbar(image, ax=panel)
    return png(figure)


def number_plainly(axis: Any, values: Sequence[float] | None = None) -> None:
    """Label a logarithmic axis with plain numbers at `values`, or at 1, 2 and 5 of each decade.

    Of two decades or more only decades are labelled. Labels have k for thousands, M for millions.
    """
    from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullLocator

    low, high = axis.get_view_interval()
    fine = (1, 2, 5) if high < 100.0 * low else (1,)
    axis.set_major_locator(
        LogLocator(subs=fine) if values is None else FixedLocator(values, nbins=9)
    )
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: _with_unit(value)))


def _with_unit(value: float) -> str:
    for unit, letter in ((1e6, "M"), (1e3, "k")):
        if value >= unit:
            return f"{value / unit:.3g}{letter}"
    return f"{value:.3g}"
