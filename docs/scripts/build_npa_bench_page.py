"""Write the tables of NPA-Bench, `docs/npa_bench.md`, from the rows' files.

    python docs/scripts/build_npa_bench_page.py          write the tables and the curves' picture
    python docs/scripts/build_npa_bench_page.py --check  fail where the page is not current

Rows are the files of a suite's folder, such as `benchmarks/results/npa_bench_small_v0/`, each of
which is checked. Tables stand between marks in the page; all else in it is written by hand.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
from npa_bench_rows import BenchRow, Score, read_rows, score, scores_in
from page_parts import table, write_or_check

from npa_envs.agents.comparison.npa_bench import METHOD_DESCRIPTIONS, SUITES, Suite, task_name
from npa_envs.agents.comparison.plan import REFERENCE
from npa_envs.measure.benchmark_records import NONE
from npa_envs.measure.plots import draw_band, legend_of, new_figure, png

DOCS = Path(__file__).resolve().parents[1]
ROWS = DOCS.parent / "benchmarks" / "results"
PAGE = "npa_bench.md"
PANELS = 3
"""Panels side by side."""

SCORES_PICTURE = "npa_bench_scores.png"
SCORES_CAPTION = "Scores of all methods on all problems of both suites, as in the table below."

NO_ROWS = "No runs are stored yet."
"""What stands where a suite has no rows."""


def plain_name(suite: Suite) -> str:
    """Return a suite's name as files and folders have it."""
    return suite.name.replace("-", "_")


def problems(suite: Suite) -> str:
    """Return the table of the problems, Markdown."""
    lines = []
    for env_id, budget in suite.budgets.items():
        problem = suite.problem_of(task_name(env_id))
        steps = f"{budget:.1e}".replace("e+0", "e").replace(".0e", "e")
        sizes = (problem.particle_count, problem.episode_steps, problem.num_envs)
        line = (*sizes, problem.hidden_dim, steps)
        lines.append((f"`{env_id}`", *map(str, line)))
    heads = ("Id", "Particles", "Steps", "Worlds", "Hidden units", "Particle-steps of a run")
    return table(heads, lines)


def ranked(rows: dict[str, BenchRow]) -> list[str]:
    """Return the methods: the library's own in their order, then all others by name."""
    own = list(METHOD_DESCRIPTIONS)
    return sorted(rows, key=lambda name: (own.index(name) if name in own else len(own), name))


def measured(suite: Suite, rows: dict[str, BenchRow]) -> list[str]:
    """Return the ids of the problems that have runs."""
    ran = {run.env_id for row in rows.values() for run in row.runs}
    return [env_id for env_id in suite.budgets if env_id in ran]


Scores = dict[tuple[str, str], dict[str, Score]]
"""Scores of methods by suite and id, or "all GROUP" for all ids of a group of a suite."""


def scored(rows: dict[str, dict[str, BenchRow]]) -> Scores:
    """Return the scores of all methods on the problems that have runs, in the tables' order."""
    scores: Scores = {}
    for name, suite in SUITES.items():
        found = rows[name]
        for group, members in suite.groups.items():
            reference = found.get(REFERENCE)
            ids = [env_id for env_id in members if reference and len(reference.returns(env_id))]
            of = {method: scores_in(found, method, ids) for method in ranked(found)}
            for env_id in ids:
                scores[name, task_name(env_id)] = {
                    method: score([runs[env_id]]) for method, runs in of.items() if env_id in runs
                }
            if ids:
                scores[name, f"all {group}"] = {
                    method: score(list(runs.values()))
                    for method, runs in of.items()
                    if len(runs) == len(ids)
                }
    return scores


def described(rows: dict[str, dict[str, BenchRow]]) -> str:
    """Return what the files say of their methods, Markdown."""
    lines = []
    for method in ranked(joined(rows)):
        counts = [str(len(r[method].runs)) if method in r else NONE for r in rows.values()]
        lines.append((f"`{method}`", joined(rows)[method].about or NONE, *counts))
    return table(("Method", "What it is", *(f"Runs, `{name}`" for name in rows)), lines)


def joined(rows: dict[str, dict[str, BenchRow]]) -> dict[str, BenchRow]:
    """Return a row of each method that any suite has."""
    return {method: row for found in rows.values() for method, row in found.items()}


def results(rows: dict[str, dict[str, BenchRow]]) -> str:
    """Return the tables of methods and of scores, and their picture, Markdown."""
    methods, lines, last = ranked(joined(rows)), [], ""
    for (suite, row), found in scored(rows).items():
        cells = [str(found[method]) if method in found else NONE for method in methods]
        lines.append((f"`{suite}`" if suite != last else "", row, *cells))
        last = suite
    if not lines:
        return NO_ROWS
    scores = table(("Suite", "Id", *(f"`{method}`" for method in methods)), lines)
    return "\n\n".join((f"![{SCORES_CAPTION}](images/{SCORES_PICTURE})", described(rows), scores))


def heat_map(rows: dict[str, dict[str, BenchRow]]) -> bytes:
    """Return the scores of all methods on all problems as a PNG file."""
    scores, methods = scored(rows), ranked(joined(rows))
    values = np.array(
        [[found[m].middle if m in found else np.nan for m in methods] for found in scores.values()]
    )
    figure, grid = new_figure(1, 1, (9.0, 0.36 * len(values) + 1.0))
    panel = grid[0][0]
    panel.imshow(np.clip(values, 0.0, 1.0), cmap="YlGn", vmin=0.0, vmax=1.2, aspect="auto")
    for (k, j), value in np.ndenumerate(values):
        if np.isfinite(value):
            colour = "white" if value > 0.7 else "black"
            panel.text(j, k, f"{value:.2f}", ha="center", va="center", color=colour, fontsize=8)
    names = [name for name, _ in scores]
    for name in dict.fromkeys(names):
        first, count = names.index(name), names.count(name)
        panel.axhline(first - 0.5, color="black", lw=1.5)
        middle, right = first + 0.5 * (count - 1), len(methods) - 0.4
        panel.text(right, middle, name, rotation=270, va="center", fontsize=8)
    panel.xaxis.tick_top()
    panel.set_xticks(range(len(methods)), methods, fontsize=8)
    panel.set_yticks(range(len(names)), [row.removesuffix("-v0") for _, row in scores], fontsize=8)
    return png(figure)


def page(text: str, rows: dict[str, dict[str, BenchRow]]) -> str:
    """Return a page with its tables made anew, from the rows of each suite."""
    parts = {f"problems of {name}": problems(suite) for name, suite in SUITES.items()}
    parts["results"] = results(rows)
    for name, made in parts.items():
        mark = rf"(<!-- made: {name} -->\n).*?(<!-- end -->)"
        assert len(re.findall(mark, text, re.DOTALL)) == 1, f"{PAGE} has one mark {name}"
        text = re.sub(
            mark, lambda found, made=made: f"{found[1]}{made}\n{found[2]}", text, flags=re.S
        )
    return text


def curves(suite: Suite, rows: dict[str, BenchRow]) -> bytes:
    """Return the learning curves of all problems as a PNG file; bands are standard errors."""
    ids = measured(suite, rows)
    lines = -(-len(ids) // PANELS)
    figure, grid = new_figure(lines, PANELS, (11.0, 3.2 * lines))
    for panel, env_id in zip(grid.flat, ids, strict=False):
        for number, method in enumerate(ranked(rows)):
            draw_method(panel, rows[method], env_id, f"C{number}")
        panel.set_title(task_name(env_id), fontsize=9, loc="left")
        panel.set(xlabel="particle-steps", ylabel="return")
        panel.ticklabel_format(axis="x", scilimits=(0, 0))
        panel.grid(alpha=0.3)
    for panel in list(grid.flat)[len(ids) :]:
        panel.set_axis_off()
    legend_of(figure, grid[0][0], "right center", fontsize=8)
    return png(figure)


def draw_method(panel: object, row: BenchRow, env_id: str, colour: str) -> None:
    """Draw the mean curve of a method; a dashed line where it does not learn."""
    found = [run.curve for run in row.runs if run.env_id == env_id and run.curve]
    if not found:
        panel.plot([], [], color=colour, label=row.method)
        return
    if max(len(curve) for curve in found) == 1:
        panel.axhline(
            np.mean([c[0][1] for c in found]), color=colour, ls="--", lw=1.0, label=row.method
        )
        return
    across = np.linspace(0.0, min(curve[-1][0] for curve in found), 64)
    values = np.stack([np.interp(across, *zip(*curve, strict=True)) for curve in found])
    middle = values.mean(axis=0)
    error = values.std(axis=0, ddof=1) / len(values) ** 0.5
    draw_band(panel, across, (middle - error, middle, middle + error), colour, row.method, lw=1.3)


def main(arguments: list[str] | None = None, folder: Path = DOCS) -> int:
    """Write or check the page; return the exit status."""
    rows = {name: read_rows(suite, ROWS / plain_name(suite)) for name, suite in SUITES.items()}
    made = {PAGE: page((folder / PAGE).read_text(encoding="utf-8"), rows)}
    if "--check" not in (sys.argv[1:] if arguments is None else arguments):
        for name, suite in SUITES.items():
            if rows[name]:
                picture = DOCS / "images" / f"{plain_name(suite)}.png"
                picture.write_bytes(curves(suite, rows[name]))
        (DOCS / "images" / SCORES_PICTURE).write_bytes(heat_map(rows))
    return write_or_check(folder, made, [PAGE], __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
