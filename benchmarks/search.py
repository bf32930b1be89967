"""Searches for rules compared: MAP-Elites, CMA-ME, CMA-ES and chance, for equal particle-steps.

`run` does all methods with all seeds, each in a folder of its own, so that it can be stopped and
goes on; afterwards each archive's elites are tried in worlds that the search did not see. `draw`
draws the growth of the archives: means over seeds, and their 95 % intervals (Student's t).

    python benchmarks/search.py run --out runs/searches --output benchmarks/results/search_cpu.json
    python benchmarks/search.py draw --output benchmarks/results/search_cpu.json
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import t as student
from scripts import script_facts, script_parser

from npa_envs.agents.search.candidate_evaluation import SearchWorld
from npa_envs.agents.search.quality_diversity import EMITTERS, RESULTS, Growth, Search, tried_again
from npa_envs.atomic_files import read_json, write_bytes
from npa_envs.checks import check_device
from npa_envs.measure.benchmark_records import markdown_table, write_record
from npa_envs.measure.plots import draw_band, legend_of, new_figure, png

IMAGE = Path("runs/search_growth.png")

FRESH_SEEDS = (1_000_000, 1_000_001)
"""Worlds that no search saw."""

GOOD = 0.05
"""Elites of at least this quality are also counted separately."""

CURVES = {"qd_score": "QD score", "coverage": "coverage", "best": "best quality"}

COLOURS = {"map-elites": "C0", "cma-me": "C1", "cma-es": "C2", "random": "C7"}


def run(arguments: Any) -> None:
    """Run all searches, one seed after the other, and write the results after each."""
    world = SearchWorld(particle_count=arguments.particles)
    facts = {
        **script_facts(arguments),
        "world": asdict(world),
        "budget": arguments.budget,
        "fresh_seeds": list(FRESH_SEEDS),
    }
    runs: dict[str, list[dict[str, Any]]] = {method: [] for method in arguments.methods}
    for seed in range(arguments.seeds):
        for method in arguments.methods:
            folder = arguments.out / f"rule-{method}-{seed}"
            folder.mkdir(parents=True, exist_ok=True)
            search = Search(
                world,
                method=method,
                seed=seed,
                device=check_device(arguments.device),
                path=folder / RESULTS,
            )
            search.run(int(arguments.budget))
            again = tried_again(search, FRESH_SEEDS)
            runs[method].append(
                {
                    "seed": seed,
                    "growth": [list(step) for step in search.growth],
                    "qualities": [elite.found.quality for elite in search.elites()],
                    "fresh_worlds": list(again),
                }
            )
            write_record(arguments.output, {**facts, "runs": runs})
            print(method, seed, search.growth[-1], "fresh", again, flush=True)


def interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Return the lower end of the 95 % interval of a mean, the mean, and the upper end."""
    middle, count = fmean(values), len(values)
    if count < 2:
        return math.nan, middle, math.nan
    half = float(student.ppf(0.975, count - 1)) * float(np.std(values, ddof=1)) / math.sqrt(count)
    return middle - half, middle, middle + half


def draw(arguments: Any) -> None:
    """Draw how archives grew, and print the figures at the end."""
    runs = read_json(arguments.output, limit=2**26)["runs"]
    figure, panels = new_figure(1, len(CURVES), (10.0, 3.4))
    for panel, (name, label) in zip(panels[0], CURVES.items(), strict=True):
        column = Growth._fields.index(name)
        for method, done in runs.items():
            curves: NDArray[np.float64] = np.array([one["growth"] for one in done])
            bands = [interval(values) for values in curves[:, :, column].T.tolist()]
            lines = tuple(zip(*bands, strict=True))
            draw_band(panel, curves[0, :, 0], lines, COLOURS[method], method)  # type: ignore[arg-type]
        panel.set(xlabel="candidates", ylabel=label, ylim=(0.0, None))
    legend_of(figure, panels[0][0], ncols=len(runs))
    write_bytes(IMAGE, png(figure))
    rows = []
    for method, done in runs.items():
        figures = [figures_of(one) for one in done]
        cells = []
        for name in figures[0]:
            low, middle, high = interval([own[name] for own in figures])
            cells.append(f"{middle:.3g} ({low:.3g} to {high:.3g})")
        rows.append([f"`{method}`", *cells])
    print(markdown_table(["method", *figures[0]], rows))


def figures_of(run: dict[str, Any]) -> dict[str, float]:
    """Return the results of a search by the table's headings."""
    grown, fresh = Growth(*run["growth"][-1]), Growth(*run["fresh_worlds"])
    good = sum(quality >= GOOD for quality in run["qualities"])
    return {
        "QD score": grown.qd_score,
        "coverage": grown.coverage,
        f"coverage, quality at least {GOOD}": grown.coverage * good / len(run["qualities"]),
        "best quality": grown.best,
        "QD score, fresh worlds": fresh.qd_score,
        "coverage, fresh worlds": fresh.coverage,
    }


def main() -> None:
    """Run the command line."""
    parser = script_parser(__doc__)
    parser.add_argument("command", choices=("run", "draw"))
    parser.add_argument("--out", type=Path, default=Path("runs/searches"))
    parser.add_argument("--methods", nargs="+", choices=list(EMITTERS), default=list(EMITTERS))
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--particles", type=int, default=128)
    parser.add_argument("--budget", type=float, default=2e7, help="particle-steps of each search")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    {"run": run, "draw": draw}[arguments.command](arguments)


if __name__ == "__main__":
    main()
