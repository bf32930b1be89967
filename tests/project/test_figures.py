"""The measured numbers of the pages are those of the files that they come from, rounded."""

import json
import math
import re
import statistics
from collections.abc import Callable, Collection
from pathlib import Path
from statistics import mean, stdev
from typing import Any

import pytest

from npa_envs.measure.quality import scores
from npa_envs.rule.files import shipped_rules
from npa_envs.tasks.morphogenesis2d import MORPHOGENESIS2D_PRESETS

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "benchmarks" / "results"

# Where a measurement is repeated, name its new file here.
ROLLOUTS = RESULTS / "paper_h200.json"
ENVIRONMENTS = RESULTS / "environments_1024_h200.json"
TRAINING = RESULTS / "training_h200.txt"
ROLLOUTS_CPU = RESULTS / "throughput_cpu.json"
PERCEPTIONS = (RESULTS / "accuracy_cpu.json", RESULTS / "accuracy_h200.json")
HARD_SCENES = RESULTS / "stress_d519fdd_h200.json"


def content(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def section_of(title: str, name: str = "recipes_history") -> str:
    """Return what stands under a title of a page, up to the next one of any level."""
    page = (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")
    return re.split(r"\n##+ ", page.split(f"\n{title}")[1])[0]


def mean_loss(row: dict[str, Any]) -> float:
    """Mean loss of the worlds of a row of benchmarks/division.py."""
    return statistics.mean(row["loss"])


def losses_of(run: dict[str, Any]) -> dict[int, float]:
    """Losses of a run's worlds, by step."""
    return {row["step"]: row["loss"] for row in run["growth"]}


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
    """Inference and training on one thread: ms a step."""
    rows = content(ROLLOUTS_CPU)["rows"]
    (row,) = (r for r in rows if (r["workload"], r["memory"]) == ("2D (1, 4096, 16)", "store"))
    return [row["infer_us"] * 1e-3, row["train_us"] * 1e-3]


def errors() -> list[float]:
    """Of random worlds; of hard scenes, how many, and in both precisions; of weights' gradients."""
    fields = (
        "density",
        "smoothed",
        "state_gradient",
        "density_gradient",
        "perception",
        "cotangent",
    )
    rows = [row for path in PERCEPTIONS for row in content(path)["tables"]["perception"]]
    own = [r for r in rows if (r["strategy"], r["precision"]) == ("library", "float32")]
    checks = {check["name"]: check["figures"] for check in content(HARD_SCENES)["checks"]}
    scenes = [figures for figures in checks.values() if "positions_float64" in figures]
    return [
        max(row[field] for row in own for field in fields),
        len(scenes),
        *(
            max(
                scene[f"{part}_{dtype}"]
                for scene in scenes
                for part in ("z", "states", "positions")
            )
            for dtype in ("float32", "float64")
        ),
        max(
            f["by_weights_1"] for name, f in checks.items() if name.startswith("gradients/float32")
        ),
    ]


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


def texture_ratios() -> list[float]:
    """Least and greatest of the judge's ratios of the shipped textures at two steps."""
    found = []
    for step in (512, 4096):
        rows = [row for name in shipped_rules("texture") for row in scores(name)["judge"]]
        ratios = [row["ratio"] for row in rows if row["step"] == step]
        found += [min(ratios), max(ratios)]
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
    "accuracy": (r"(\de-\d+|\d+(?= hard))", errors),
    "speed, H200": (rf"({NUMBER})(?= [µm]s)", rollout_times),
    "environments, H200": (rf"({NUMBER})(?= ms| billion)", environment_times),
    "speed, CPU": (rf"({NUMBER})(?= ms)", cpu_times),
    "training": (rf"({NUMBER})(?= s )", training_time),
    "six shipped pictures": (r"(0\.\d+)", picture_losses),
    "eight shipped textures": (r"(\d\.\d+)", texture_ratios),
    "three shipped things in 3D": (r"(\d\d\.\d)", view_ratios),
    "the shipped classifier": (r"(\d\d\.\d)(?= %)", classifier_shares),
}
"""Rows of the table "What is measured": which of its numbers are measured, and what they are."""


def rounded(value: float, like: str) -> str:
    """Return a number as another one is written, be it 0.25 or 3e-7."""
    if "e" in like:
        mantissa, exponent = f"{value:.0e}".split("e")
        return f"{mantissa}e{int(exponent)}"
    return f"{value:.{len(like.partition('.')[2])}f}"


def differences(text: str, pattern: str, values: list[float]) -> list[str]:
    """Return the numbers of a text that are not these values, rounded to as many digits."""
    told = re.findall(pattern, text)
    expected = [rounded(value, number) for number, value in zip(told, values, strict=False)]
    if len(told) != len(values):
        return [f"{len(told)} numbers, {len(values)} expected"]
    return [f"{a}, not {b}" for a, b in zip(told, expected, strict=True) if a != b]


@pytest.mark.parametrize("row", FIGURES)
def test_a_row_of_what_is_measured_has_the_numbers_of_its_file(row: str) -> None:
    page = (ROOT / "docs" / "measured.md").read_text(encoding="utf-8")
    (text,) = re.findall(rf"^\| {re.escape(row)} \| (.*) \|$", page, re.MULTILINE)
    pattern, values = FIGURES[row]
    assert differences(text, pattern, values()) == []


def test_a_number_that_disagrees_is_told() -> None:
    assert differences("148 µs and 1.07 ms", rf"({NUMBER})(?= [µm]s)", [147.4, 1.0759]) == [
        "148, not 147",
        "1.07, not 1.08",
    ]
    pattern, _ = FIGURES["accuracy"]
    assert differences("in 40 hard scenes 3e-7", pattern, [40, 3.6e-7]) == ["3e-7, not 4e-7"]


def test_the_page_on_species_has_the_numbers_of_its_file() -> None:
    rows = content(RESULTS / "species_cpu.json")["tables"]["one_species"]
    (row,) = [r for r in rows if r["workload"] == "2D (1, 4096, 4)" and r["what"] == "inference"]
    text = (ROOT / "docs" / "species.md").read_text(encoding="utf-8")
    pattern = rf"`rollout` takes ({NUMBER}) ms"
    assert differences(text, pattern, [row["rollout_us"]["median"] * 1e-3]) == []


def test_the_page_on_learners_has_what_shac_grew_in_a_small_world() -> None:
    rows = {row["method"]: row for row in content(RESULTS / "shac_small_cpu.json")["rows"]}
    text = (ROOT / "docs" / "learners_compared.md").read_text(encoding="utf-8")
    pattern = (
        rf"SHAC has ({NUMBER}) of what .* returns ({NUMBER}) and the gradient ({NUMBER}), .*"
        rf"`ppo` returns ({NUMBER}) and the best scripted policy ({NUMBER})"
    )
    methods = ("shac", "gradient", "ppo", "scripted")
    returns = [rows[method]["final_return"]["mean"] for method in methods]
    found = [rows["shac"]["fraction"]["mean"], *returns]
    told = re.search(pattern, " ".join(text.split()))
    assert told is not None
    assert differences(" ".join(told.groups()), NUMBER, found) == []


def test_the_table_of_small_environments_has_the_speeds_of_its_file() -> None:
    page = (ROOT / "docs" / "benchmarks.md").read_text(encoding="utf-8")
    told = dict(re.findall(r"^\| `(npa/[\w-]+)` \| (.*) \|$", page, re.MULTILINE))
    measured: dict[str, list[str]] = {}
    for row in content(RESULTS / "small_speed_cpu.json")["rows"]:
        measured.setdefault(row["id"], []).append(f"{row['steps_per_s']:.0f}")
    assert {env_id: line.split(" | ") for env_id, line in told.items()} == measured


def search_figures(run: dict[str, Any]) -> list[float]:
    """What a search came to, in the order of the table."""
    _, qd_score, coverage, best = run["growth"][-1]
    good = sum(quality >= 0.05 for quality in run["qualities"]) / 400
    return [qd_score, coverage, good, best, *run["fresh_worlds"][1:3]]


def test_the_table_of_searches_has_the_numbers_of_its_file() -> None:
    text = (ROOT / "docs" / "search.md").read_text(encoding="utf-8")
    runs = content(RESULTS / "search_cpu.json")["runs"]
    assert {len(done) for done in runs.values()} == {5}
    for method, done in runs.items():
        (row,) = re.findall(rf"^\| `{method}` \| (\d.*) \|$", text, re.MULTILINE)
        columns = zip(*map(search_figures, done), strict=True)
        assert differences(row, rf"({NUMBER}) \(", [mean(column) for column in columns]) == []


def standard_error(values: Collection[float]) -> float:
    """Standard error of the mean of some values."""
    return stdev(values) / len(values) ** 0.5


def bench_returns(path: Path, task: str) -> list[float]:
    """Mean returns of the runs of a row of NPA-Bench, by the name of an id without its end."""
    runs = [run for run in content(path)["runs"] if run["id"] == f"npa/{task}Small-v0"]
    return [mean(run["returns"]) for run in runs]


def test_what_shac_brought_in_npa_bench_and_the_gradient_in_gardens_is_told() -> None:
    page = (ROOT / "docs" / "npa_bench.md").read_text(encoding="utf-8")
    rows = RESULTS / "npa_bench_v0"
    (told,) = re.findall(r"^\| SHAC \| (.*) \|$", page, re.MULTILINE)
    made = page[page.index("Scores, particles") :]
    (row,) = re.findall(
        r"^\| `shac` \| (.*) \|$", made.partition("Scores, gardens")[0], re.MULTILINE
    )
    assert told.split(" | ") == row.split(" | ")[:5]
    gardens = " ".join((ROOT / "docs" / "gardening.md").read_text(encoding="utf-8").split())

    def a_step(method: str, task: str) -> str:
        returns = bench_returns(rows / f"{method}.json", task)
        return f"{mean(returns) / 32:.2f}".replace("-", "−")

    gardener, shepherd = "Gardener2D", "Shepherd2D"
    a, b, c, d = (
        a_step(method, task) for task in (gardener, shepherd) for method in ("gradient", "scripted")
    )
    assert f"gradient earns {a} a step" in gardens
    assert f"script earns {b}, and {c} in" in gardens
    assert f"it earns {d}, in the 32" in gardens
    learned = [
        a_step(method, task) for method in ("ppo_world", "sac") for task in (gardener, shepherd)
    ]
    assert f"PPO earns {learned[0]} a step in the garden (script {b})" in gardens
    assert f"and {learned[1]} with shepherds (script {d}), SAC {learned[2]} and" in gardens
    assert f"SAC {learned[2]} and {learned[3]}. SAC's" in gardens


def test_the_speeds_of_gardens_are_the_fastest_of_their_file() -> None:
    page = (ROOT / "docs" / "gardening.md").read_text(encoding="utf-8")
    best: dict[str, dict[int, float]] = {}
    for row in (row for run in content(RESULTS / "gardens_speed_cpu.json")["runs"] for row in run):
        speeds = best.setdefault(row["id"], {})
        speeds[row["worlds"]] = max(speeds.get(row["worlds"], 0.0), row["steps_a_second"])
    for env_id, speeds in best.items():
        assert f"| `{env_id}` | {' | '.join(f'{n:.0f}' for n in speeds.values())} |" in page


def test_rows_of_npa_bench_on_two_machines_are_told_and_agree() -> None:
    page = (ROOT / "docs" / "npa_bench.md").read_text(encoding="utf-8")
    rows = content(RESULTS / "npa_bench_small_two_machines.json")
    for first, second in (rows[:2], rows[2:4]):
        both = [list(row["returns"].values()) for row in (first, second)]
        errors = [standard_error(values) for values in both]
        cells = [
            f"{mean(values):.4f} ± {error:.4f}, {len(values)} seeds"
            for values, error in zip(both, errors, strict=True)
        ]
        assert f"| `{first['method']}`, `{first['id']}` | {' | '.join(cells)} |" in page
        assert abs(mean(both[0]) - mean(both[1])) < 2.0 * math.hypot(*errors)
    apart = {}
    for first, second in zip(rows[4::2], rows[5::2], strict=True):
        assert (first["id"], first["method"]) == (second["id"], second["method"])
        both = [list(row["returns"].values()) for row in (first, second)]
        error = math.hypot(*map(standard_error, both))
        distance = abs(mean(both[0]) - mean(both[1]))
        apart[distance / error if error else 0.0] = [f"{mean(values):.4f}" for values in both]
    count = len(rows[4::2])
    most, next_most = sorted(apart, reverse=True)[:2]
    told = " ".join(page.split())
    assert f"these {count} the means of {count - 1} differ by at most {next_most:.1f} " in told
    assert f"Growth by the script differs by {most:.1f}: its seeds" in told
    assert "returned {} on one machine and {} on the other".format(*apart[most]) in told


def test_two_rows_of_npa_bench_from_a_cpu_and_a_gpu_are_told() -> None:
    page = (ROOT / "docs" / "npa_bench.md").read_text(encoding="utf-8")
    rows = content(RESULTS / "npa_bench_two_machines.json")
    apart = []
    for first, second in zip(rows[:24:2], rows[1:24:2], strict=True):
        assert (first["id"], first["method"]) == (second["id"], second["method"])
        held = content(RESULTS / "npa_bench_v0" / f"{second['method']}.json")
        assert (second["machine"], second["commit"]) == (held["machine"], held["commit"])
        runs = {run["seed"]: run["returns"] for run in held["runs"] if run["id"] == first["id"]}
        assert second["returns"] == {str(seed): round(mean(runs[seed]), 5) for seed in range(5)}
        for row in (first, second):
            values = list(row["returns"].values())
            assert len(values) == 5
            assert row["mean"] == pytest.approx(mean(values), abs=1e-5)
            assert row["standard_error"] == pytest.approx(standard_error(values), abs=1e-5)
        if "Gardener" in first["id"] or "Shepherd" in first["id"]:
            cells = [f"{row['mean']:.3f} ± {row['standard_error']:.3f}" for row in (first, second)]
            assert f"| `{first['method']}`, `{first['id']}` | {' | '.join(cells)} |" in page
            error = math.hypot(first["standard_error"], second["standard_error"])
            apart.append(f"{abs(first['mean'] - second['mean']) / error:.1f}")
        else:
            assert second["returns"] == pytest.approx(first["returns"], abs=1.5e-5)
    told = " ".join(page.split())
    assert f"means differ by {' and '.join(apart)} standard errors of their difference" in told
    for again in rows[24:]:
        (first,) = (row for row in rows[:14:2] if row["id"] == again["id"])
        assert all(again[key] == first[key] for key in ("method", "machine"))
        assert again["returns"] == pytest.approx(first["returns"], abs=5e-5)


def test_learners_of_npa_bench_from_cpus_and_a_gpu_are_told() -> None:
    page = (ROOT / "docs" / "npa_bench.md").read_text(encoding="utf-8")
    rows = content(RESULTS / "npa_bench_learners_two_machines.json")
    for first, second in zip(rows[::2], rows[1::2], strict=True):
        assert (first["id"], first["method"]) == (second["id"], second["method"])
        held = content(RESULTS / "npa_bench_v0" / f"{second['method']}.json")
        runs = {run["seed"]: run["returns"] for run in held["runs"] if run["id"] == first["id"]}
        kept = {seed: round(mean(runs[int(seed)]), 5) for seed in second["returns"]}
        assert second["returns"] == kept
        assert first["returns"].keys() == kept.keys()
        cells, both = [], (first, second)
        for row in both:
            values = list(row["returns"].values())
            assert row["mean"] == pytest.approx(mean(values), abs=1e-5)
            assert row["standard_error"] == pytest.approx(standard_error(values), abs=1e-5)
            cells.append(f"{row['mean']:.4f} ± {row['standard_error']:.4f}")
        error = math.hypot(*(row["standard_error"] for row in both))
        apart = abs(first["mean"] - second["mean"]) / error
        line = f"| `{first['method']}`, `{first['id']}` | {len(kept)} | {' | '.join(cells)} |"
        if len(kept) > 2:
            assert f"{line} {apart:.1f} |" in page
            assert apart < 2.0
    first, _, second = content(RESULTS / "npa_bench_growth_again_cpu.json")
    told = " ".join(page.split())
    for row in (first, second):
        values = list(row["returns"].values())
        assert len(values) == 5
        assert row["standard_error"] == pytest.approx(standard_error(values), abs=1e-5)
        assert f"returned {mean(values):.2f} ± {row['standard_error']:.2f} on an" in told
    error = math.hypot(first["standard_error"], second["standard_error"])
    assert f"{(first['mean'] - second['mean']) / error:.1f} standard errors less" in told


def test_what_is_said_of_the_small_suite_is_in_its_table() -> None:
    page = (ROOT / "docs" / "npa_bench.md").read_text(encoding="utf-8")
    page = page[page.index("### On a laptop") : page.index("### On a GPU")]
    told = " ".join(page.partition("<!-- made")[0].split())
    scores = dict(re.findall(r"^\| `(\w+)` \|.* (\S+ \[\S+ \S+\]) \|$", page, re.MULTILINE))
    assert f"SHAC brings {scores['shac']} of the gradient" in told
    assert f"PPO brings {scores['ppo_world']} and the library's own {scores['ppo']}." in told
    returned = page[page.index("Returns, mean") :]
    digits = {
        method: line.split(" | ")[3]
        for method, line in re.findall(r"^\| `(\w+)` \| (.*) \|$", returned, re.MULTILINE)
    }
    assert f"the gradient returns {digits['gradient']}, SHAC {digits['shac']}, and" in told


def earned(rows: list[dict[str, Any] | None]) -> str:
    """Return what seeds of a learner earn in gardens, as a table's cell has it."""
    told = [row for row in rows if row is not None]
    if len(told) < len(rows):
        return ""
    values = [row["reward"] for row in told]
    error = standard_error(values)
    share = f" ({100 * mean(r['success'] for r in told):.0f} %)" if "success" in told[0] else ""
    return f"{mean(values):.3f} ± {error:.3f}{share}".replace("-", "−")


def test_the_table_of_learners_in_gardens_has_the_numbers_of_its_file() -> None:
    page = (ROOT / "docs" / "gardening.md").read_text(encoding="utf-8")
    for run in content(RESULTS / "garden_learning_cpu.json")["runs"]:
        seeds = run["seeds"].values()
        at = [[next((r for r in s if r["steps"] == k), None) for s in seeds] for k in TENS]
        cells = [*map(earned, at), earned([rows[-1] for rows in seeds])]
        line = f"| `{run['id']}`, {run['method'].upper()} | {' | '.join(cells)} |"
        assert (line in page) == (run["method"] != "her"), line


def test_what_many_worlds_brought_in_gardens_is_told() -> None:
    page = (ROOT / "docs" / "gardening.md").read_text(encoding="utf-8")
    for run in content(RESULTS / "garden_learning_h200.json")["runs"]:
        script = run["last"]["scripted"]
        names = {"scripted": (script, "")}
        for seed, rows in run["seeds"].items():
            steps = f"{rows[-1]['steps']:,}".replace(",", " ")
            names[f"PPO, seed {seed}"] = (run["last"][f"seed {seed}"], steps)
        for name, (row, steps) in names.items():
            share = f"{100 * row['success']:.0f} %" if "success" in row else ""
            more = f"{row['more']:.3f} ± {row['more_error']:.3f}" if "more" in row else ""
            cells = [steps, f"{row['reward']:.3f} ± {row['error']:.3f}", share, more]
            line = " | ".join((f"| `{run['id']}`, {name}", *cells)) + " |"
            assert re.sub(" +", " ", line).replace("-0", "−0") in page, line


def test_what_hindsight_brought_is_told() -> None:
    page = (ROOT / "docs" / "gardening.md").read_text(encoding="utf-8")
    held = content(RESULTS / "garden_hindsight_cpu.json")
    names = {"scripted": "scripted", "random": "random", "nobody": "zero"}
    for seed, rows in held["seeds"].items():
        steps = f"{rows[-1]['steps']:,}".replace(",", " ")
        names[f"hindsight, seed {seed}, {steps} steps"] = f"seed {seed}"
    for name, key in names.items():
        row = held["last"][key]
        earns = f"{row['reward']:.2f} ± {row['error']:.2f}".replace("-", "−")
        assert f"| {name} | {100 * row['success']:.0f} % | {earns} |" in page
    learned = [row for key, row in held["last"].items() if key.startswith("seed")]
    assert all(row["more"] > 10.0 * row["more_error"] for row in learned)


TENS = (10_000, 20_000, 30_000)

SMALL_WORLDS = content(RESULTS / "small_sizes_cpu.json")["rows"]


def returns(env_id: str, method: str) -> list[float]:
    """Returns of a small world, a run each."""
    runs = [row for row in SMALL_WORLDS if (row["id"], row["method"]) == (env_id, method)]
    return [row["return"] for row in runs if "return" in row]


def other_ppo(env_id: str) -> str:
    """Form of Stable-Baselines3's PPO that is told of a small world."""
    return "ppo_particles" if "PointClassification" in env_id else "ppo_world"


def estimates(env_id: str) -> list[tuple[float, float] | None]:
    """Means and standard errors of a small world's returns, as the table has them; None: not run.

    They are of random and scripted policies, the library's PPO, and Stable-Baselines3's.
    """
    found: list[tuple[float, float] | None] = []
    for method in ("random", "scripted", "ppo", other_ppo(env_id)):
        values = returns(env_id, method)
        error = standard_error(values) if len(values) > 1 else 0.0
        found.append((mean(values), error) if values else None)
    return found


def test_the_table_of_small_worlds_has_the_numbers_of_its_file() -> None:
    page = (ROOT / "docs" / "learning.md").read_text(encoding="utf-8")
    told = dict(re.findall(r"^\| `(npa/[\w-]+)` \| (.*) \|$", page, re.MULTILINE))
    assert set(told) == {row["id"] for row in SMALL_WORLDS}
    for env_id, line in told.items():
        cells = []
        for found in estimates(env_id):
            cell = "" if found is None else f"{found[0]:.3f}".replace("-", "−")
            cells.append(cell + (f" ± {found[1]:.3f}" if found and found[1] > 5e-4 else ""))
        assert line.split(" | ") == cells, env_id


@pytest.mark.parametrize("env_id", sorted({row["id"] for row in SMALL_WORLDS}))
def test_ppo_is_above_what_learns_nothing_in_small_worlds_by_three_standard_errors(
    env_id: str,
) -> None:
    assert len(returns(env_id, "ppo")) == len(returns(env_id, other_ppo(env_id))) == 3
    random, scripted, *both = estimates(env_id)
    floors = [(0.0, 0.0), *filter(None, (random, scripted))]
    for ppo in both:
        assert ppo is not None
        for floor in floors:
            assert ppo[0] - floor[0] > 3.0 * math.hypot(ppo[1], floor[1])


def test_the_table_of_the_test_of_best_has_the_numbers_of_its_file() -> None:
    page = (ROOT / "docs" / "recipes_history.md").read_text(encoding="utf-8")
    section = page.split("## The test of `best` with AdamW")[1].split("![")[0]
    told = dict(re.findall(r"^\| ([a-z -]+) \| (.*) \|$", section, re.MULTILINE))
    record = content(RESULTS / "recipes_best_test_h200.json")
    aged = {row["picture"]: row for row in record["long"]}
    steps = (64, 128, 512, 1024, 4096, 20_000)
    assert len(record["runs"]) == len(aged) == 12
    for run in record["runs"]:
        losses = losses_of(run)
        late = aged[run["picture"]]
        cells = [f"{losses[step]:.3f}" for step in steps] + [f"{late['loss']['100000']:.3f}"]
        cells += [f"{row['worlds_healed']} of {row['world_count']}" for row in run["healing"]]
        cells.append(f"{late['worlds_within']} of 8")
        assert told[run["picture"].replace("-", " ")].split(" | ") == cells


BIRTHS = (
    ("division128b plain-s1", "a = 2", "inherit, and only they move"),
    ("sym", "a = 2", "apart"),
    ("sym1", "a = 2", "apart, twice as far"),
    ("sym25", "a = 2", "apart, half as far"),
    ("blank", "a = 2", "blank"),
    ("blanksym", "a = 2", "blank, apart"),
    ("blanksym25", "a = 2", "blank, apart, half as far"),
    ("thin", "a = 2", "blank, apart, thinned"),
    ("fastplain", "a = 5", "inherit, and only they move"),
    ("fastsym", "a = 5", "apart"),
    ("fastsymthin", "a = 5", "apart, thinned"),
    ("fastblank", "a = 5", "blank"),
    ("fast fast-s1", "a = 5", "blank, apart"),
    ("fast25", "a = 5", "blank, apart, half as far"),
    ("fastthin", "a = 5", "blank, apart, thinned"),
    ("fastthin2000", "a = 5", "blank, apart, thinned, 2000 iterations"),
    ("fastallthin", "**a = 5**", "**blank, apart, all thinned**"),
    ("fastside", "a = 5", "blank, apart, half thinned, half one side"),
    ("fastallside", "a = 5", "blank, apart, all one side"),
    ("fasthalf", "a = 5", "half inherited, apart, thinned"),
)
"""Rows of the table of births: rules of its record, how fates begin, what children do."""


def test_the_tables_of_births_have_the_numbers_of_their_files() -> None:
    page = (ROOT / "docs" / "beyond.md").read_text(encoding="utf-8")

    rules = content(RESULTS / "division_births_cpu.json")["rules"]
    disk = content(RESULTS / "division_muon_cpu.json")["rules"]["big-disk128"]
    section = page.split("### How children are born")[1].split("\n### ")[0]
    lines = [line for line in section.splitlines() if re.match(r"\| \*{0,2}a = ", line)]
    ratios = {}
    for line, (names, fates, children) in zip(lines, BIRTHS, strict=True):
        found = [rules.pop(name) for name in names.split()]
        cells = []
        for when in ("64", "128", "512", "each second", "one side"):
            rows = [rule[when]["256"] if " " in when else rule["grown"][when] for rule in found]
            cells.append(", ".join(f"{mean_loss(row):.3f}" for row in rows))
        assert line == f"| {fates} | {children} | {' | '.join(cells)} |"
        grown = statistics.mean(mean_loss(rule["grown"]["512"]) for rule in found)
        ratios[names] = f"{grown / mean_loss(disk['grown']['512']):.2f} times"
    assert not rules
    record = content(RESULTS / "division_births_cpu.json")
    room = record["where_there_is_room"]
    healed = " and ".join(
        f"{mean_loss(room[half]['256']):.3f}" for half in ("each second", "one side")
    )
    assert f"{mean_loss(room['grown']['512']):.3f} at step 512, and {healed} after" in section
    blank, inheriting = (record[f"of_256_particles{kind}"] for kind in ("_born_blank", ""))
    alone = content(RESULTS / "division_muon_cpu.json")["rules"]["disk128"]
    grown = mean_loss(blank["grown"]["512"])
    times = grown / mean_loss(alone["grown"]["512"])
    assert f"bring {grown:.3f} at step 512, {times:.2f} times" in section
    for half in ("each second", "one side"):
        losses = [f"{mean_loss(rule[half]['256']):.3f}" for rule in (blank, inheriting)]
        told = " instead of ".join(losses)
        assert told in section
    for name in ("fastsym", "fast fast-s1", "fastthin", "fastthin2000", "fastallthin"):
        assert ratios[name] in section


def test_the_tables_of_division_at_full_size_have_the_numbers_of_their_files() -> None:
    page = (ROOT / "docs" / "beyond.md").read_text(encoding="utf-8")
    section = page.split("**From one particle to 4096**")[1].split("\n### ")[0]

    def cells(rows: dict[str, Any]) -> str:
        return " | ".join(f"{mean_loss(row):.3f}" for row in rows.values())

    for name in ("division_blank_h200", "division_thinned_h200"):
        rules = content(RESULTS / f"{name}.json")["rules"]
        for rule in rules.values():
            assert f" | {cells(rule['grown'])} |" in section
        disk = mean_loss(rules["heart-disk"]["grown"]["512"])
        for kind, rule in rules.items():
            if kind in ("heart-division", "heart-division-inheriting"):
                assert f"{mean_loss(rule['grown']['512']) / disk:.2f} times" in section
    inheriting = rules["heart-division-inheriting"]
    for rule in (rules["heart-division"], inheriting):
        for half, told in (("each second", "each second one"), ("one side", "one side")):
            assert f"| {told} | {cells(rule[half])} |" in section
    healed = rules["heart-division"]["each second"]["128"]
    grown = rules["heart-division"]["grown"]["512"]
    assert (
        f"{mean_loss(healed):.3f} after 128 steps, {mean_loss(healed) / mean_loss(grown):.2f} times"
        in section
    )
    blank = content(RESULTS / "division_blank_h200.json")["rules"]["heart-division"]
    for half in ("each second", "one side"):
        assert f"{mean_loss(blank[half]['256']):.3f} instead of" in section


def span(numbers: Collection[float], places: int) -> str:
    ends = sorted({f"{min(numbers):.{places}f}", f"{max(numbers):.{places}f}"}, key=float)
    return "–".join(ends)


def test_the_times_of_rules_that_know_no_direction_are_those_of_their_files() -> None:
    page = (ROOT / "docs" / "beyond.md").read_text(encoding="utf-8")
    section = page.split("\n## Rules that know no direction")[1].split("\n## ")[0]
    readings: dict[str, list[dict[str, Any]]] = {}
    for run in content(RESULTS / "directions_time_warps.json")["runs"]:
        readings.setdefault(run["commit"], []).append(run["steps"])
    for commit, name in (("9deb1db", "h200"), ("a5297d3", "h100")):
        readings[commit] = [content(RESULTS / f"directions_time_{name}.json")["steps"]]

    def times(commit: str, told: str, way: str) -> tuple[list[float], list[float]]:
        found = [steps for steps in readings[commit] if f"8 x 4096, {told}" in steps]
        own = [steps[f"8 x 4096, {told}"][way] for steps in found]
        plain = [steps["8 x 4096, plain"][way] for steps in found]
        return own, [time / other for time, other in zip(own, plain, strict=True)]

    ways = ("inference", "training")
    for title, told in (
        ("plain", "plain"),
        ("not chiral", "mirrored"),
        ("chiral", "chiral"),
        ("chiral, in plain torch", "chiral, in torch"),
    ):
        cells = []
        for way in ways:
            own, ratios = times("250067c", told, way)
            cells.append(span(own, 0) + ("" if told == "plain" else f" ({span(ratios, 2)})"))
            if told in ("mirrored", "chiral"):
                assert max(ratios) <= 1.5  # "met by all rules, in every reading"
        assert f"| {title} | {' | '.join(cells)} |" in section
    history = [
        line for line in section.splitlines() if re.search(r"; [0-9a-f]{7}, H[12]00 \|", line)
    ]
    counts = []
    for line, commit in zip(
        history, ("9deb1db", "a5297d3", "b4f51e9", "b48e29b", "250067c"), strict=True
    ):
        cells = [
            span(times(commit, told, way)[1], 2) for told in ("mirrored", "chiral") for way in ways
        ]
        assert f"; {commit}, " in line
        assert line.endswith(f" | {' | '.join(cells)} |")
        counts.append(len(readings[commit]))
    assert counts == [1, 1, 3, 2, 5]


def test_the_tables_of_more_cuts_have_the_numbers_of_their_file() -> None:
    page = (ROOT / "docs" / "recipes_history.md").read_text(encoding="utf-8")
    section = page.split("\n## More cuts and later rest\n")[1].split("\n## ")[0]
    record = content(RESULTS / "recipes_cuts_h200.json")
    told = [line.split(" | ") for line in section.splitlines() if line.startswith("| ")]
    arms: dict[str, list[dict[str, Any]]] = {}
    for row in record["development"]:
        arms.setdefault(row["arm"], []).append(row)
    cells = []
    for rows in arms.values():
        losses = [
            statistics.mean(row["loss_of_32"][step] for row in rows) for step in ("512", "4096")
        ]
        counts = [
            sum(row[name] for row in rows)
            for name in ("cuts_healed", "disks_healed", "within_4096_steps")
        ]
        most = max(row["most_energies"][0] for row in rows)
        row = [f"{loss:.3f}" for loss in losses] + [f"{count} of 128" for count in counts]
        cells.append([*row, f"{most:.1f} |"])
    assert sorted(cells) == sorted(row[1:] for row in told if len(row) == 7 and "of" in row[3])
    grown = [losses_of(run) for run in record["test"]]
    steps = (64, 128, 512, 1024, 4096, 20_000)
    means = [statistics.mean(own[step] for own in grown) for step in steps]
    means.append(statistics.mean(row["loss"]["100000"] for row in record["long"]))
    worst = max(own[step] for own in grown for step in own if step >= 128)
    healed = sum(row["worlds_healed"] for own in record["healing_of_32"] for row in own["healing"])
    within = sum(row["worlds_within"] for row in record["long"])
    row = [f"{loss:.3f}" for loss in (*means, worst)]
    assert [*row, f"{healed} of 768", f"{within} of 96 |"] in [cells[1:] for cells in told]


REST_ARMS = {
    "p2": "`--rest-power 2`",
    "p4": "`--rest-power 4`",
    "p2a1024": "`--rest-power 2 --rest-age 1024`",
    "p4a1024": "**`--rest-power 4 --rest-age 1024`**",
    "p2a2048": "`--rest-power 2 --rest-age 2048`",
    "p4a2048": "`--rest-power 4 --rest-age 2048`",
    "cuts8a2048": "`--rest-weight 8 --rest-age 2048`",
}
"""Rows of the table of rest, by the arms of its record that were looked at in full."""


def test_the_table_of_rest_has_the_numbers_of_its_file() -> None:
    section = section_of("## Rest of the fastest particles\n")
    rows = content(RESULTS / "recipes_rest_h200.json")["development"]
    looked = [row for row in rows if "worlds_within" in row]
    for arm, changed in REST_ARMS.items():
        own = [row for row in looked if row["arm"] == arm]
        assert len(own) == 4
        cells = []
        for step in ("512", "5146", "100000"):
            cells.append(f"{mean(row['loss_of_32'][step] for row in own):.3f}")
        for name in ("cuts_healed", "disks_healed", "worlds_within"):
            cells.append(f"{sum(row[name] for row in own)} of 128")
        cells.append(f"{max(row['most_energies'][0] for row in own):.1f}")
        assert f"| {changed} | {' | '.join(cells)} |" in section
    stopped = [row for row in looked if row["arm"] not in REST_ARMS]
    assert [row["arm"] for row in stopped] == ["p2w8a2048", "p2w8a2048", "p4w8a2048"]
    assert f"({sum(row['worlds_within'] for row in stopped)} of these 96 worlds" in section
    late = []
    for arm in ("p2w8a2048", "p4w8a2048", "p4w8a1024", "p4a1024"):
        late.append(mean(row["growth"]["512"] for row in rows if row["arm"] == arm))
    told = re.findall(r"0\.\d{3}", section.split("of 8 seeds they have")[1])
    assert told[:4] == [f"{loss:.3f}" for loss in late]


TESTS = {
    ("recipes_history", "### The test with rest of the fastest particles\n"): {
        "mean of 12, or sum": "rest_h200",
        "(more cuts, `--rest-age 2048`)": "cuts_h200",
        "(`best` as it was)": "decay_h200",
    },
    ("recipes", "## The test of `best`\n"): {
        "mean of 12, or sum": "dead_zone_h100",
        "(without a dead zone)": "rest_h200",
    },
}
"""Records of rows of the tables of the test, by page and title; the first one's pictures have
rows, too."""

STEPS = (64, 128, 512, 1024, 4096, 20_000)
"""Steps of the tables of the test, before that of 100 000."""


@pytest.mark.parametrize(("name", "title"), TESTS)
def test_the_tables_of_the_test_have_the_numbers_of_their_files(name: str, title: str) -> None:
    section = section_of(title, name)
    told = dict(re.findall(r"^\| (\S.*?) \| (.*) \|$", section, re.MULTILINE))
    restless = []
    for row_title, measured in TESTS[name, title].items():
        record = content(RESULTS / f"recipes_{measured}.json")
        aged = {row["picture"]: row for row in record["long"]}
        healed = {row["picture"]: row["healing"] for row in record["healing_of_32"]}
        grown = {run["picture"]: losses_of(run) for run in record["test"]}
        assert len(record["test"]) == len(grown) == len(aged) == len(healed) == 12
        pictures: list[list[float]] = []
        counts: list[list[int]] = []
        for picture, losses in grown.items():
            late = aged[picture]
            pictures.append([losses[step] for step in STEPS] + [late["loss"]["100000"]])
            counts.append([row["worlds_healed"] for row in healed[picture]])
            counts[-1].append(late["worlds_within"])
            if not restless:
                cells = [f"{loss:.3f}" for loss in pictures[-1]]
                pairs = zip(counts[-1], (32, 32, 8), strict=True)
                cells += [f"{count} of {every}" for count, every in pairs]
                assert told[picture.replace("-", " ")].split(" | ") == cells
        cells = [f"{mean(column):.3f}" for column in zip(*pictures, strict=True)]
        sums = [sum(column) for column in zip(*counts, strict=True)]
        cells += [f"{count} of {every}" for count, every in zip(sums, (384, 384, 96), strict=True)]
        assert told[row_title].split(" | ") == cells
        if not restless:
            assert (
                f"{100 * (sums[0] + sums[1]) / 768:.1f} % ({sums[0] + sums[1]} of 768)" in section
            )
        worlds = [world for row in record["long"] for world in row["worlds"]]
        restless.append(sum(world["energy"] > 1.01 for world in worlds))
    assert f"{restless[0]} of 96" in section
    assert f"{restless[-1]} had" in section


def test_what_best_reaches_is_what_its_test_measured() -> None:
    page = (ROOT / "docs" / "recipes.md").read_text(encoding="utf-8")
    reached = page.split("## What it reaches")[1].split("\n## ")[0]
    record = content(RESULTS / "recipes_dead_zone_h100.json")
    grown = [losses_of(run) for run in record["test"]]
    cells = dict(re.findall(r"^\| (.*?) \|[^|]*\| (.*?) \|", reached, re.MULTILINE))
    titles = ("step 64", "128", "512", "1024", "4096", "20 000")
    for title, step in zip(titles, STEPS, strict=True):
        assert cells[title] == f"{mean(own[step] for own in grown):.3f}"
    worst = max(own[step] for own in grown for step in own if step >= 128)
    assert cells["worst picture from 128 on"] == f"{worst:.3f}"
    damages = [row for own in record["healing_of_32"] for row in own["healing"]]
    healed = sum(row["worlds_healed"] for row in damages)
    assert cells["damaged worlds healed in 500 steps"] == f"{100 * healed / 768:.1f} %"
    within = sum(row["worlds_within"] for row in record["long"])
    bounds = "worlds within the bounds of `npa-envs stress` for 100 000 steps"
    assert cells[bounds] == f"{within} of 96"
    seconds = record["one_command"]["command_seconds"]
    assert cells["one command, from start to end"] == f"[{seconds} s](#the-one-command), an H100"


UNTOLD = ("out", "tensorboard", "picture_interval", "checkpoint_interval")
"""Fields of presets that the tables of choices leave out: they change no rule."""


@pytest.mark.parametrize("preset", ["best", "fast"])
def test_the_tables_of_choices_tell_the_presets(preset: str) -> None:
    page = (ROOT / "docs" / "recipes.md").read_text(encoding="utf-8")
    section = page.split(f"\n## What `{preset}` consists of\n")[1].split("\n## ")[0]
    told = {}
    for cell in re.findall(r"^\| `--([^`]+)`", section, re.MULTILINE):
        for option in cell.split(" --"):
            name, *values = option.split()
            told[name.replace("-", "_")] = [as_number(value) for value in values]
    chosen, paper = (MORPHOGENESIS2D_PRESETS[name] for name in (preset, "paper"))
    fields = dict(vars(chosen.task)) | vars(chosen)
    assert set(told) - {"hidden_dim"} == {
        name
        for name, value in (dict(vars(paper.task)) | vars(paper)).items()
        if fields[name] != value and name not in ("task", *UNTOLD)
    }
    for name, values in told.items():
        value = fields[name]
        assert values == list(value if isinstance(value, tuple) else (value,)), name


def as_number(word: str) -> float | str:
    """A word of a command as a number, where it is one."""
    try:
        return float(word)
    except ValueError:
        return word


def test_the_table_of_shipped_pictures_has_the_numbers_of_their_files() -> None:
    page = (ROOT / "docs" / "recipes.md").read_text(encoding="utf-8")
    section = page.split("\n## The library\n")[1]
    rows = re.findall(r"^\| \[`([^`]+)`\]\(\S+\) \| [^|]+ \| (.*) \|$", section, re.MULTILINE)
    assert sorted(name for name, _ in rows) == sorted(shipped_rules("morphogenesis2d"))
    for name, cells in rows:
        measured = scores(name)
        losses = losses_of(measured)
        told = [f"{losses[step]:.3f}" for step in (64, 128, 512, 1024, 2048, 4096)]
        told += [f"{row['worlds_healed']} of {row['world_count']}" for row in measured["healing"]]
        assert cells.split(" | ") == told


ZONE_ARMS = {
    "p4": "nothing (printed)",
    "p4w4": "`--rest-weight 4` (printed)",
    "p8": "`--rest-power 8` (printed)",
    "p8w4": "`--rest-power 8 --rest-weight 4` (printed)",
    "z1": "**`--dead-zone 1e-3`**",
    "z3": "`--dead-zone 3e-3`",
    "z1s": "`--dead-zone 1e-3`, squashed",
    "z3s": "`--dead-zone 3e-3`, squashed, three pictures",
}
"""Rows of the table of dead zones, by the arms of its record that were looked at."""


def test_the_table_of_dead_zones_has_the_numbers_of_its_file() -> None:
    section = section_of("## A dead zone\n")
    record = content(RESULTS / "recipes_dead_zone_h100.json")
    rows = record["printed_only"]["looks"] + record["development"]
    looked = [row for row in rows if "worlds_within" in row]
    kept = []
    for arm, changed in ZONE_ARMS.items():
        own = [row for row in looked if row["arm"] == arm]
        cells = [
            f"{mean(row['loss_of_128'][step] for row in own):.3f}" for step in ("512", "30000")
        ]
        for name in ("cuts_healed", "disks_healed"):
            cells.append(f"{sum(row[name] for row in own)} of {16 * len(own)}")
        within = sum(row["worlds_within"] for row in own)
        cells.append(f"{within} of {128 * len(own)}")
        cells.append(f"{max(row['most_energies'][0] for row in own):.1f}")
        still = [row["moving"]["8192"]["at_rest"] for row in own if "moving" in row]
        cells.append(f"{sum(still)} of {128 * len(own)}" if still else "–")
        assert f"| {changed} | {' | '.join(cells)} |" in section
        if len(own) == 4:
            kept.append(within)
    assert f"of 512 worlds {min(kept)} to {max(kept)} are within" in section
    over = [then for row in looked for then in row.get("over", {}).values()]
    assert all(then.startswith("energy at step ") for then in over)
    steps = [int(then.split()[-1]) for then in over]
    assert f"between steps {min(steps)} and {max(steps)}." in section
    # The claim of 128 of 128 worlds, by 32 seeds, says how many more seeds tell.
    before = section_of("## Rest of the fastest particles\n")
    assert f"of 512 worlds the same four rules keep [{kept[0]}](#a-dead-zone)" in before
    unlooked = [row for row in rows if row["arm"] == "z1w1"]
    for arm in (unlooked, [row for row in rows if row["arm"] == "z1"]):
        assert f"{mean(row['growth']['20000'] for row in arm):.3f}" in section


def test_the_library_with_a_dead_zone_has_the_numbers_of_its_files() -> None:
    section = section_of("### The library with a dead zone\n")
    runs = {
        run["target"]: (losses_of(run["after"]), losses_of(run["before"]))
        for run in content(RESULTS / "library_dead_zone_h100.json")["runs"]
    }
    gecko = losses_of(content(RESULTS / "recipes_dead_zone_h100.json")["one_command"])
    (shipped,) = (
        losses_of(run["before"])
        for run in content(RESULTS / "library_rest_h200.json")["runs"]
        if run["target"] == "gecko"
    )
    runs["gecko"] = gecko, shipped
    steps = (64, 128, 512, 4096)
    rows = re.findall(r"^\| `(\S+)` \| (.*) \|$", section, re.MULTILINE)
    assert {name for name, _ in rows} == runs.keys()
    for name, row in rows:
        assert row.split(" | ") == [f"{of[step]:.3f}" for of in runs[name] for step in steps]
    more = [
        100 * (now[step] / then[step] - 1) for now, then in runs.values() for step in (512, 4096)
    ]
    assert f"worse, by {min(more):.0f} to {max(more):.0f} %" in section


def test_the_table_of_the_library_has_the_numbers_of_its_file() -> None:
    section = section_of("### The library with rest of the fastest particles\n")
    runs = content(RESULTS / "library_rest_h200.json")["runs"]
    lines = [line for line in section.splitlines() if re.match(r"\| (`|shipped)", line)]
    assert len(runs) == 6
    for run, new, old in zip(runs, lines[::2], lines[1::2], strict=True):
        for line, measured in ((new, run), (old, run["before"])):
            losses = losses_of(measured)
            cells = [f"{losses[step]:.3f}" for step in (64, 128, 512, 1024, 2048, 4096)]
            cells += [f"{row['worlds_healed']} of 8" for row in measured["healing"]]
            cells.append(str(run["command_seconds"]) if line is new else "")
            name = f"`{run['target']}`, the one command" if line is new else "shipped before"
            assert line == f"| {name} | {' | '.join(cells)} |"
        card = run["target"] in ("butterfly", "flower", "octopus")
        kept = run if card else run["before"]
        shipped = {row["step"]: row["loss"] for row in scores(run["target"])["growth"]}
        assert shipped == pytest.approx(losses_of(kept), rel=2e-3)


def test_the_tables_of_shipped_things_have_the_numbers_of_their_files() -> None:
    page = (ROOT / "docs" / "morphogenesis3d.md").read_text(encoding="utf-8")
    first = page.split("Three rules are shipped")[1].split("\n## ")[0]
    for name in shipped_rules("morphogenesis3d"):
        psnr = {row["step"]: f"{row['psnr']:.1f} dB" for row in scores(name)["growth"]}
        cells = (psnr.get(step, "") for step in (64, 128, 256, 512, 1024, 4096))
        told = re.findall(rf"^\| `{name}` \|(.*)\|$", first, re.MULTILINE)
        assert [[cell.strip() for cell in row.split("|")] for row in told] == [[*cells]]
    section = page.split("#### The library with the one command\n")[1].split("\n### ")[0]
    runs = content(RESULTS / "library_3d_h200.json")["runs"]
    lines = [line for line in section.splitlines() if re.match(r"\| (`|shipped)", line)]
    assert [run["target"] for run in runs] == ["duck", "mushroom"]
    for run, new, old in zip(runs, lines[::2], lines[1::2], strict=True):
        for line, measured in ((new, run), (old, run["before"])):
            psnr = {row["step"]: f"{row['psnr']:.1f} dB" for row in measured["growth"]}
            row = [psnr.get(step, "") for step in (64, 128, 256, 512, 1024, 2048, 4096)]
            row.append(f"{losses_of(measured)[128]:.4f}")
            healed = [f"{row['worlds_healed']} of 8" for row in measured.get("healing", [])]
            row += [*(healed or ["", ""]), str(measured.get("command_seconds", ""))]
            name = f"`{run['target']}`, the one command" if line is new else "shipped before"
            assert [cell.strip() for cell in line.split("|")[1:-1]] == [name, *row]
        kept = run if run["target"] == "duck" else run["before"]
        shipped = {row["step"]: row["loss"] for row in scores(run["target"])["growth"]}
        assert shipped == pytest.approx(losses_of(kept), rel=2e-3)
    duck, mushroom = runs
    first_psnr, middle, last = (
        row["psnr"] for row in duck["growth"] if row["step"] in (128, 2048, 4096)
    )
    assert f"it loses {first_psnr - last:.1f} dB, and {first_psnr - middle:.1f} of them" in section
    whole = losses_of(duck["before"])[512]
    assert f"cut its loss is {duck['healing'][0]['end']:.4f}, less than the {whole:.4f}" in section
    cut = mushroom["healing"][0]
    assert f"is {cut['end']:.4f} after 1000 steps instead of {cut['before']:.4f}" in section
    seconds = [str(run["training_seconds"]) for run in runs]
    assert f"{' and '.join(seconds)} s of these were training" in section


MUON_ARM = "eighth, muon, from 16"
"""The preset `best` of 2D before it had a weight decay."""


def test_the_tables_of_muon_have_the_numbers_of_their_files() -> None:
    page = (ROOT / "docs" / "recipes_history.md").read_text(encoding="utf-8")
    first, table, section = (
        page.split(title)[1].split("\n### ")[0]
        for title in ("\n## Muon\n", "\n## Weight decay\n", "\n### The test with weight decay\n")
    )
    pattern = re.compile(r"^\| ([a-z0-9., -]+?)(?: \(.*\))? \| (.*) \|$", re.MULTILINE)
    small, told = (dict(pattern.findall(part)) for part in (first, section))
    record = content(RESULTS / "recipes_muon_h100.json")
    steps = ("64", "128", "512", "1024", "4096", "20000")
    decayed = content(RESULTS / "recipes_decay_h200.json")
    aged = {row["picture"]: row for row in decayed["long"]}
    healed = {row["picture"]: row["healing"] for row in decayed["healing_of_32"]}
    grown = {run["picture"]: losses_of(run) for run in decayed["test"]}
    assert len(decayed["test"]) == len(grown) == len(aged) == len(healed) == 12
    for picture, losses in grown.items():
        late = aged[picture]
        cells = [f"{losses[int(step)]:.3f}" for step in steps] + [f"{late['loss']['100000']:.3f}"]
        cells += [f"{row['worlds_healed']} of 32" for row in healed[picture]]
        cells.append(f"{late['worlds_within']} of 8")
        assert told[picture.replace("-", " ")].split(" | ") == cells
    means = [statistics.mean(own[int(step)] for own in grown.values()) for step in steps]
    cells = [f"{mean:.3f}" for mean in means]
    assert told["mean of 12, or sum"].split(" | ")[: len(steps)] == cells
    plain = record["test"]
    means = [statistics.mean(run["losses"][step] for run in plain) for step in steps]
    means.append(statistics.mean(row["loss"]["100000"] for row in record["long"]))
    cells = [f"{mean:.3f}" for mean in means]
    for kind in zip(*(run["healing_of_32"] for run in plain), strict=True):
        cells.append(f"{sum(row['worlds_healed'] for row in kind)} of 384")
    cells.append(f"{sum(row['worlds_within'] for row in record['long'])} of 96")
    assert f"| (without weight decay) | {' | '.join(cells)} |" in section
    arms: dict[str, dict[str, str]] = {}
    known = content(RESULTS / "library_muon_h200.json")["arms"]
    plain = [run | {"arm": MUON_ARM} for run in known if run["begins_with"] == "heart-v0"]
    for run in decayed["first"] + decayed["second"] + plain:
        own = losses_of(run)
        cell = " / ".join(f"{own[step]:.3f}" for step in (128, 512, 20_000))
        arms.setdefault(run["picture"].removesuffix("-knife"), {})[run["arm"]] = cell
    endings = ("", ", decay 0.1", ", halfway 1", ", halfway 1, decay 0.03")
    for picture, found in arms.items():
        absent = "fell apart" if picture == "gecko" else "–"
        cells = [found.get(MUON_ARM + ending, absent) for ending in endings]
        assert f"| {picture.replace('-', ' ')} | {' | '.join(cells)} |" in table
    for arm in {run["arm"] for run in record["small"]} - {"eighth, muon, rate 1e-2"}:
        losses = [run["losses"] for run in record["small"] if run["arm"] == arm]
        means = [statistics.mean(own[step] for own in losses) for step in steps]
        # The runs printed three digits.
        assert [float(cell) for cell in small[arm].split(" | ")] == pytest.approx(means, abs=6e-4)


def test_the_table_of_fast_has_the_numbers_of_its_file() -> None:
    page = (ROOT / "docs" / "recipes.md").read_text(encoding="utf-8")
    section = page.split("\n## The test of `fast`\n")[1].split("\n## ")[0]
    runs = content(RESULTS / "recipes_fast_wide_cpu.json")["test"]
    losses = [losses_of(run) for run in runs]
    assert len(runs) == 12
    for run, own in zip(runs, losses, strict=True):
        cells = " | ".join(f"{own[step]:.3f}" for step in (128, 512, 1024, 4096))
        assert f"| {run['picture'].replace('-', ' ')} | {cells} |" in section
    means = (statistics.mean(own[step] for own in losses) for step in (128, 512, 1024, 4096))
    told = " | ".join(f"{mean:.3f}" for mean in means)
    assert f"| mean of 12 (aim 0.12 at 128, 0.15 at 1024) | {told} |" in section


@pytest.mark.parametrize(
    ("title", "name"),
    [
        ("## More second lives", "second_lives"),
        ("### Long lives and more cuts", "from_16"),
    ],
)
def test_the_tables_of_second_lives_have_the_numbers_of_their_files(title: str, name: str) -> None:
    section = section_of(title)
    told = dict(
        re.findall(r"^\| ([a-z0-9, -]+?)(?: \(`best`\))? \| (.*) \|$", section, re.MULTILINE)
    )
    record = content(RESULTS / f"recipes_{name}_h100.json")
    aged = {row["picture"]: row for row in record["long"]}
    steps = (64, 128, 512, 1024, 4096, 20_000)
    arms: dict[str, list[Any]] = {}
    for run in record["runs"]:
        losses = losses_of(run)
        if run["pictures"] == "development":
            arms.setdefault(run["arm"], []).append((losses, run["healing_of_32"]))
            continue
        late = aged.pop(run["picture"])
        cells = [f"{losses[step]:.3f}" for step in steps] + [f"{late['loss']['100000']:.3f}"]
        cells += [f"{row['worlds_healed']} of 32" for row in run["healing_of_32"]]
        cells.append(f"{late['worlds_within']} of 8")
        assert told[run["picture"].replace("-", " ")].split(" | ") == cells
    assert not aged
    assert len(arms) == 3
    for arm, runs in arms.items():
        assert len(runs) == 4
        cells = [f"{mean(losses[step] for losses, _ in runs):.3f}" for step in steps]
        for damage in (0, 1):
            healed = sum(healing[damage]["worlds_healed"] for _, healing in runs)
            cells.append(f"{healed} of 128")
        back = [healing[0]["end"] / healing[0]["before"] for _, healing in runs]
        cells.append(f"{mean(back):.2f}")
        assert told[arm].split(" | ") == cells


def test_the_table_of_training_on_two_gpus_has_the_numbers_of_its_file() -> None:
    page = (ROOT / "docs" / "scale.md").read_text(encoding="utf-8")
    lines = (RESULTS / "scale_two_h100.jsonl").read_text(encoding="utf-8").splitlines()
    rows = [row for row in map(json.loads, lines) if "loss" in row]
    assert len(rows) == 3
    for row in rows:
        count = 1 if row["processes"] == "alone" else row["processes"]
        waits = [f"{row['reduce_ms']:.3f}", f"{row['waited_ms']:.2f}"] if count > 1 else ["", ""]
        cells = [str(count), str(row["worlds"]), f"{row['ms']:.2f}", *waits]
        assert f"| {' | '.join(cells)} |".replace("  ", " ") in page
    alone, twice, shared = (row["ms"] for row in rows)
    assert f"take {100 * (twice / alone - 1):.0f} % longer" in page
    assert f"weak scaling {100 * alone / twice:.0f} %" in page
    assert f"{alone / shared:.2f} times as\nfast" in page


def test_the_table_of_worlds_at_rest_has_the_numbers_of_its_file() -> None:
    page = (ROOT / "docs" / "skipping.md").read_text(encoding="utf-8")
    section = page[page.index("## Worlds at rest") :]
    told = [
        [cell.strip() for cell in line.split("|")[2:6]]
        for line in section.splitlines()
        if re.match(r"\|[^|]*\| \d", line)
    ]
    gecko, paperclip = content(RESULTS / "resting_cpu.json")["resting"]
    expected = []
    for world, ages, places in ((gecko, (0, 1024, 2048, 4096), 2), (paperclip, (0, 512, 2048), 3)):
        for row in world["ages"]:
            if row["age"] in ages:
                rests, called = row["at_rest"], row["as_called_s"]
                short = f"{called:.3f}" if rests else f"{called:.{places}f}"
                every = f"{row['every_step_s']:.{places}f}"
                expected.append([str(row["age"]), "yes" if rests else "no", every, short])
    assert told == expected
