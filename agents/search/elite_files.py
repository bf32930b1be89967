"""Output of a search: the elites' rules as files, and the atlas, a page of their pictures."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from npa_envs.agents.search.candidate_evaluation import SEED_RADIUS, UPDATE_PROB, Axis
from npa_envs.agents.search.quality_diversity import Elite, Search
from npa_envs.atomic_files import made_folder
from npa_envs.measure.plots import new_figure, png
from npa_envs.render import draw_worlds
from npa_envs.render.picture_files import encode_frame
from npa_envs.rule.files import save_rule

ELITES, PAGE = "elites", "atlas.html"
"""Folder of the elites' rules and the page, in the folder of a search."""

PICTURE_SIDE = 64
"""Pixels on each side of an elite's picture."""

HALF_WIDTH = 0.6
"""Half the side of a picture, whose centre is the particles' centroid [length units]."""

Pictures = Mapping[tuple[int, ...], NDArray[np.uint8]]
"""Pictures of elites by cell, uint8, [R, R, 3] each."""


def write_elites(search: Search, folder: Path) -> Pictures:
    """Write each elite's rule as `elites/CELL.safetensors`; return a picture of a world of each."""
    pictures: dict[tuple[int, ...], NDArray[np.uint8]] = {}
    count = search.world.particle_count
    for elite in search.elites():
        path = folder / ELITES / f"{elite.name}.safetensors"
        measures = zip(search.axes, elite.found.measures, strict=True)
        result = {"quality": elite.found.quality} | {axis.name: value for axis, value in measures}
        world = {"particle_count": count, "update_prob": UPDATE_PROB, "seed_radius": SEED_RADIUS}
        metadata = {"found": json.dumps(result), "world": json.dumps(world)}
        with made_folder(path.parent):
            save_rule(search.candidates.rule_of(elite.solution), path, metadata=metadata)
        worlds = search.candidates.try_all(elite.solution[None]).worlds
        x, s, *_ = worlds.map(lambda values: values[0, :1])
        (pictures[elite.cell],) = draw_worlds(
            x,
            s,
            resolution=PICTURE_SIDE,
            pixel_size=math.sqrt(math.pi / count) * SEED_RADIUS,
            centre=x.mean(dim=1),
            half_width=HALF_WIDTH,
        )
    return pictures


def atlas_html(search: Search, pictures: Pictures) -> str:
    """Return the atlas as one HTML page: a table of pictures for each cell of the last axis.

    The first axis goes from left to right, the second one upwards.
    """
    across, up, last = search.axes
    elites = {elite.cell: elite for elite in search.elites()}
    growth = search.growth[-1]
    facts = (
        f"{search.facts['method']}, seed {search.facts['seed']}: {growth.evaluations} candidates, "
        f"{search.particle_steps} particle-steps, {len(elites)} elites, coverage "
        f"{growth.coverage:.3f}, QD score {growth.qd_score:.3f}, best {growth.best:.3f}"
    )
    tables = []
    for layer in range(last.cells):
        rows = []
        for row in reversed(range(up.cells)):
            cells = [
                _cell(search, elites.get((column, row, layer)), pictures)
                for column in range(across.cells)
            ]
            rows.append(f"<tr><th>{_span(up, row)}</th>{''.join(cells)}</tr>")
        foot = "".join(f"<th>{_span(across, column)}</th>" for column in range(across.cells))
        tables.append(
            f"<h2>{last.name} {_span(last, layer)}</h2>\n"
            f"<table>\n{chr(10).join(rows)}\n<tr><th>{up.name} ↑ {across.name} →</th>{foot}</tr>"
            "\n</table>"
        )
    return "\n".join([_HEAD, f"<h1>Atlas</h1>\n<p>{facts}</p>", *tables, "</html>\n"])


_HEAD = f"""<!doctype html>
<html lang="en"><meta charset="utf-8"><title>Atlas</title>
<style>
body {{ font: 14px sans-serif; margin: 1em; }}
table {{ border-collapse: collapse; }}
th {{ font-weight: normal; font-size: 11px; padding: 2px 6px; }}
td {{ width: {PICTURE_SIDE}px; height: {PICTURE_SIDE}px; border: 1px solid #ddd; padding: 0; }}
img {{ display: block; width: {PICTURE_SIDE}px; height: {PICTURE_SIDE}px; }}
</style>"""


def _cell(search: Search, elite: Elite | None, pictures: Pictures) -> str:
    if elite is None:
        return "<td></td>"
    measures = zip(search.axes, elite.found.measures, strict=True)
    text = ", ".join(f"{axis.name} {value:.3f}" for axis, value in measures)
    file = f"{ELITES}/{elite.name}.safetensors"
    data = base64.b64encode(encode_frame(pictures[elite.cell], "JPEG")).decode()
    return (
        f'<td><a href="{file}"><img alt="{elite.name}" title="{elite.name}: quality '
        f'{elite.found.quality:.3f}, {text}" src="data:image/jpeg;base64,{data}"></a></td>'
    )


def _span(axis: Axis, cell: int) -> str:
    width = (axis.highest - axis.lowest) / axis.cells
    begin = axis.lowest + cell * width
    return f"{begin:.3g} to {begin + width:.3g}"


def atlas_png(axes: Sequence[Axis], pictures: Pictures) -> bytes:
    """Return the atlas as a PNG file: a panel for each cell of the last axis, in rows of two."""
    across, up, last = axes
    width, height = ((axis.highest - axis.lowest) / axis.cells for axis in (across, up))
    rows = -(-last.cells // 2)
    drawn, panels = new_figure(rows, 2, (9.0, 4.6 * rows))
    for layer, panel in enumerate(panels.flat):
        if layer >= last.cells:
            panel.axis("off")
            continue
        for (column, row, cell_layer), picture in pictures.items():
            if cell_layer == layer:
                left, low = across.lowest + column * width, up.lowest + row * height
                panel.imshow(picture, extent=(left, left + width, low, low + height), aspect="auto")
        panel.set(xlim=(across.lowest, across.highest), ylim=(up.lowest, up.highest))
        panel.set_facecolor("#eeeeee")
        panel.tick_params(labelsize=7)
        panel.set_title(f"{last.name} {_span(last, layer)}", fontsize=9)
        panel.set(xlabel=across.name, ylabel=up.name)
    return png(drawn, dpi=110)
