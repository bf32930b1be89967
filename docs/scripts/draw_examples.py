"""Join the curves that examples wrote into a record, and draw `docs/images/examples.png`.

    python docs/scripts/draw_examples.py sb3_ppo.json mappo_particles.json ...

Curves in the record that are not given stay as they are; without any it only draws.
"""

from __future__ import annotations

import json
import math
import sys
from datetime import date
from pathlib import Path

import torch

from npa_envs.atomic_files import write_bytes
from npa_envs.measure.benchmark_records import current_commit, machine, write_record
from npa_envs.measure.plots import draw_band, legend_of, new_figure, png

ROOT = Path(__file__).resolve().parents[2]
RECORD = ROOT / "benchmarks" / "results" / "examples_cpu.json"
IMAGE = ROOT / "docs" / "images" / "examples.png"
EXAMPLES = {
    "ppo_one_file": "ppo_one_file.py",
    "sb3_ppo": "sb3_ppo.py",
    "sb3_sac_her": "sb3_sac_her.py",
    "torchrl_ppo": "torchrl_ppo.py",
    "mappo_particles": "mappo.py particles",
    "mappo_gardeners": "mappo.py gardeners",
    "evolution": "evolution.py",
    "gradient": "gradient.py",
}
"""Commands in `examples/` by the names of the curves that they write."""
COLOURS = {"zero": "C7", "random": "C1", "scripted": "C2"}
COLUMNS = 4


def join(paths: list[Path]) -> None:
    """Write curves of files into the record, with the commit and the machine of now."""
    runs = {run["name"]: run for run in read()["runs"]} if RECORD.exists() else {}
    for path in paths:
        command = f"python examples/{EXAMPLES[path.stem]}"
        curve = json.loads(path.read_text(encoding="utf-8"))
        runs[path.stem] = {"name": path.stem, "command": command, **curve}
    facts = {
        "command": "python examples/NAME",
        "commit": current_commit(),
        "date": date.today().isoformat(),
        "machine": f"{machine(torch.device('cpu'))}, one thread beside other work",
        "threads": 1,
        "torch": torch.__version__,
    }
    write_record(RECORD, {**facts, "runs": [runs[name] for name in EXAMPLES if name in runs]})


def read() -> dict:
    """Return the record."""
    return json.loads(RECORD.read_text(encoding="utf-8"))


def draw() -> bytes:
    """Return the figure as PNG: a panel for each curve, with policies that did not learn."""
    runs = read()["runs"]
    lines = math.ceil(len(runs) / COLUMNS)
    figure, panels = new_figure(lines, COLUMNS, (10.0, 2.4 * lines))
    for panel in panels.flat[len(runs) :]:
        panel.axis("off")
    for panel, run in zip(panels.flat, runs, strict=False):
        steps, means, errors = zip(*run["curve"], strict=True)
        ends = ([m + sign * e for m, e in zip(means, errors, strict=True)] for sign in (-1, 1))
        low, high = ends
        thousands = [count / 1000 for count in steps]
        draw_band(panel, thousands, (low, means, high), "C0", "learned")
        for name, colour in COLOURS.items():
            if name in run:
                panel.axhline(run[name][0], color=colour, ls="--", lw=1.0, label=name)
        panel.set_title(run["command"].removeprefix("python examples/"), fontsize=9)
        panel.set_xlabel("thousand steps of worlds", fontsize=8)
        panel.tick_params(labelsize=7)
    # Some panels have a scripted policy as well.
    most = max(panels.flat, key=lambda panel: len(panel.get_lines()))
    legend_of(figure, most, ncols=4, fontsize=8)
    return png(figure)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        join([Path(name) for name in sys.argv[1:]])
    write_bytes(IMAGE, draw())
