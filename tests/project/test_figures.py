"""The measured numbers of the README are those of the files that they come from, rounded."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from npa_envs.measure.quality import scores
from npa_envs.rule.files import shipped_rules

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "benchmarks" / "results"

# Where a measurement is repeated, name its new file here.
ROLLOUTS = RESULTS / "paper_h200.json"
ENVIRONMENTS = RESULTS / "environments_h200.json"
TRAINING = RESULTS / "training_h200.txt"
ROLLOUTS_CPU = ROOT / "docs" / "performance.md"
"""The lower of two runs' medians: only the table is kept."""


def content(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def rollout_times() -> list[float]:
    """Of two workloads in one call, and of one in a graph, inference and training: µs, ms, ms."""
    tables = content(ROLLOUTS)["tables"]
    shown = (
        ("public", "2D (8, 4096, 64)", 1.0),
        ("public", "2D (8, 65536, 8)", 1e-3),
        ("throughput", "2D (1, 1048576, 8)", 1e-3),
    )
    found = []
    for table, workload, unit in shown:
        row = next(row for row in tables[table] if row["workload"] == workload)
        found += [row[kind]["median"] * unit for kind in ("infer_us", "train_us")]
    return found


def environment_times() -> list[float]:
    """Of 1024 grown worlds, then of seeds: ms a step, billions of particle-steps a second."""
    rows = [
        row
        for row in content(ENVIRONMENTS)["rows"]
        if row["world_count"] == row["particle_count"] == 1024 and row["resets"] == "together"
    ]
    found = {
        row["start"]: [row["step_us"] * 1e-3, row["particle_steps_per_s"] * 1e-9] for row in rows
    }
    return found["grown"] + found["seed"]


def cpu_times() -> list[float]:
    """Inference and training on one thread and on two: ms a step."""
    text = ROLLOUTS_CPU.read_text(encoding="utf-8")
    pattern = r"\| 2D \(1, 4096, 16\) \| 1 \| (\S+) \| (\S+) \|.*\n\| \| 2 \| (\S+) \| (\S+) \|"
    (found,) = re.findall(pattern, text)
    return [float(number) for number in found]


def training_time() -> list[float]:
    """The paper's iterations: seconds."""
    (seconds,) = re.findall(r"^total +(\S+) s \(10000 ", TRAINING.read_text("utf-8"), re.MULTILINE)
    return [float(seconds)]


def held(name: str, column: str, step: int) -> float:
    rows = scores(name)
    (row,) = [row for row in rows.get("growth", rows.get("accuracy")) if row["step"] == step]
    return float(row[column])


def picture_losses() -> list[float]:
    """Least and greatest loss of the shipped pictures at two steps."""
    found = []
    for step in (512, 4096):
        losses = [held(name, "loss", step) for name in shipped_rules("morphogenesis2d")]
        found += [min(losses), max(losses)]
    return found


def view_ratios() -> list[float]:
    """PSNR of the shipped things at two steps [dB]."""
    names = shipped_rules("morphogenesis3d")
    return [held(name, "psnr", step) for step in (128, 512) for name in names]


def classifier_shares() -> list[float]:
    """Unseen digits, and their particles, that are right [%]."""
    return [100.0 * held("digits", column, 32) for column in ("majority", "particle")]


NUMBER = r"\d+(?:\.\d+)?"

FIGURES: dict[str, tuple[str, Callable[[], list[float]]]] = {
    "speed, H200": (rf"({NUMBER})(?= [µm]s)", rollout_times),
    "environments, H200": (rf"({NUMBER})(?= ms| billion)", environment_times),
    "speed, CPU": (rf"({NUMBER})(?= ms| and| on two)", cpu_times),
    "training": (rf"({NUMBER})(?= s )", training_time),
    "six shipped pictures": (r"(0\.\d+)", picture_losses),
    "three shipped things in 3D": (r"(\d\d\.\d)", view_ratios),
    "the shipped classifier": (r"(\d\d\.\d)(?= %)", classifier_shares),
}
"""Rows of the table "What is measured": which of its numbers are measured, and what they are."""


def differences(text: str, pattern: str, values: list[float]) -> list[str]:
    """Return the numbers of a text that are not these values, rounded to as many digits."""
    told = re.findall(pattern, text)
    expected = [
        f"{value:.{len(number.partition('.')[2])}f}"
        for number, value in zip(told, values, strict=False)
    ]
    if len(told) != len(values):
        return [f"{len(told)} numbers, {len(values)} expected"]
    return [f"{a}, not {b}" for a, b in zip(told, expected, strict=True) if a != b]


@pytest.mark.parametrize("row", FIGURES)
def test_a_row_of_the_readme_has_the_numbers_of_its_file(row: str) -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (text,) = re.findall(rf"^\| {re.escape(row)} \| (.*) \|$", readme, re.MULTILINE)
    pattern, values = FIGURES[row]
    assert differences(text, pattern, values()) == []


def test_a_number_that_disagrees_is_told() -> None:
    assert differences("148 µs and 1.07 ms", rf"({NUMBER})(?= [µm]s)", [147.4, 1.0759]) == [
        "148, not 147",
        "1.07, not 1.08",
    ]


def test_the_page_on_species_has_the_numbers_of_its_file() -> None:
    rows = content(RESULTS / "species_cpu.json")["tables"]["one_species"]
    (row,) = [r for r in rows if r["workload"] == "2D (1, 4096, 4)" and r["what"] == "inference"]
    text = (ROOT / "docs" / "species.md").read_text(encoding="utf-8")
    pattern = rf"`rollout` takes ({NUMBER}) ms"
    assert differences(text, pattern, [row["rollout_us"]["median"] * 1e-3]) == []
