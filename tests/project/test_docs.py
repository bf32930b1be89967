"""The documentation is true: pages are current, tables name what is there, code runs."""

import contextlib
import functools
import importlib
import json
import math
import re
import runpy
import sys
import time
from pathlib import Path
from typing import NamedTuple

import draw_examples
import gymnasium as gym
import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from PIL import Image
from support.crowds import TASKS, still
from support.crowds import small as small_crowd
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import npa_envs
from npa_envs.agents.learning import Budget, train
from npa_envs.cli import COMMANDS, main
from npa_envs.envs import multispecies_v0, particles_v0
from npa_envs.measure.speed.suites import SUITES
from npa_envs.ops.backend import KernelRequest, describe
from npa_envs.registration import ENVIRONMENTS, GARDEN_IDS
from npa_envs.training import TASKS as TRAINED

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = draw_examples.EXAMPLES
DOCS = ROOT / "docs"
TEXTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Programs write to a folder of their own, and the threads that they set do not stay."""
    monkeypatch.chdir(tmp_path)
    threads = torch.get_num_threads()
    yield tmp_path
    torch.set_num_threads(threads)


def text_of(page: str) -> str:
    return (DOCS / f"{page}.md").read_text(encoding="utf-8")


def code_blocks(page: str) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", text_of(page), re.MULTILINE | re.DOTALL)


def run_code(page: str, *changes: tuple[str, str], names=None, blocks=slice(None)) -> dict:
    """Run blocks of a page, with changes by regular expressions, and return its names."""
    code = "\n".join(code_blocks(page)[blocks])
    for old, new in changes:
        code, count = re.subn(old, new, code)
        assert count, f"{page}.md has no {old}"
    names = {} if names is None else names
    exec(compile(code, f"{page}.md", "exec"), names)
    return names


def section(page: str, heading: str) -> str:
    return text_of(page).split(f"\n## {heading}\n")[1].split("\n## ")[0]


def first_cells(text: str) -> list[str]:
    """Return the names in code that the first cells of a section's tables hold."""
    cells = re.findall(r"^\| ([^|]+) \|", text, re.MULTILINE)
    return [name for cell in cells for name in re.findall(r"`([^`]+)`", cell)]


@functools.cache
def anchors(path: Path) -> set[str]:
    titles = re.findall(r"^#+ (.+)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title).strip().lower().replace(" ", "-") for title in titles}


# Pages that scripts make.


@pytest.mark.parametrize(
    "name", ["address", "environment_pages", "gallery_page", "npa_bench_page", "tables"]
)
def test_made_pages_are_current(name, capsys):
    if name == "npa_bench_page":
        pytest.importorskip("jsonschema")
        pytest.importorskip("scipy")
    status = importlib.import_module(f"build_{name}").main(["--check"])
    assert status == 0, capsys.readouterr().err


# Names that pages list.


def test_the_reference_of_commands_has_every_command_and_task():
    text = text_of("commands")
    helped = re.findall(r"^```\{command-help\} (.+)$", text, re.MULTILINE)
    assert helped == re.findall(r"^##+ (.+)$", text, re.MULTILINE)
    assert sorted(helped) == sorted([*COMMANDS, *(f"train {name}" for name in TRAINED)])


def test_commands_in_blocks_of_shell_have_the_options_that_they_are_given(capsys):
    texts = "\n".join(path.read_text(encoding="utf-8") for path in TEXTS)
    blocks = re.findall(r"^ *```(?:sh|bash)\n(.*?)^ *```", texts, re.M | re.S)
    blocks += re.findall(r"^Measured: .*`(npa-envs [^`]+)`", texts, re.M)
    assert set(re.findall(r"npa-envs bench .*?--suite (\w+)", texts)) <= set(SUITES)
    used: dict[tuple[str, ...], set[str]] = {}
    for line in re.sub(r"\\\n", " ", "\n".join(blocks)).replace(" && ", "\n").splitlines():
        words = re.sub(r"#.*| > .*", "", line).replace(".venv/bin/", "").split()
        if words[:1] == ["npa-envs"] and words[1:2] and words[1][0] != "-" and "TASK" not in words:
            command = tuple(words[1:3]) if words[1] == "train" else (words[1],)
            options = {word.partition("=")[0] for word in words if word.startswith("-")}
            used[command] = used.get(command, set()) | options
    assert len(used) > 12
    for command, options in used.items():
        with contextlib.suppress(SystemExit):
            main([*command, "--help-all" if len(command) > 1 else "--help"])
        listed = set(re.findall(r"(?<![\w-])--?[\w-]+", capsys.readouterr().out))
        assert options <= listed, command


@pytest.mark.parametrize(
    ("package", "page"),
    [
        ("npa_envs", "engine"),
        ("npa_envs.envs", "environments"),
        ("npa_envs.wrappers", "wrappers"),
        ("npa_envs.agents", "agents"),
        ("npa_envs.agents.learning", "agents"),
        ("npa_envs.agents.search", "agents"),
        ("npa_envs.render", "pictures"),
    ],
)
def test_the_reference_of_the_interface_has_every_public_name(package, page):
    module = importlib.import_module(package)
    public = {*module.__all__, *getattr(module, "ON_REQUEST", {})}
    described = rf"^\.\. auto\w+:: {re.escape(package)}\.(\w+)$"
    assert sorted(re.findall(described, text_of(f"api/{page}"), re.MULTILINE)) == sorted(public)


def test_the_page_on_what_is_measured_shows_the_backend_table():
    chosen = describe(KernelRequest(torch.device("cpu"), torch.float32))
    assert "\n".join(f"  {line}" for line in chosen) in text_of("measured")


def test_the_list_of_pages_leads_to_every_page_and_notebook():
    linked = {(DOCS / name).resolve() for name in re.findall(r"\]\(([^)#]+)", text_of("pages"))}
    pages = {*DOCS.glob("*.md"), *DOCS.glob("notebooks/*.ipynb"), DOCS / "environments/README.md"}
    assert pages - {DOCS / "index.md", DOCS / "pages.md"} <= linked


def test_the_home_page_has_four_doors_with_pictures():
    doors = section("index", "What do you want to do?").split("\n### ")[1:]
    assert len(doors) == 4
    for door in doors:
        (page,) = re.findall(r"^\[[^\]]+\]\(([^)]+)\)\n", door)
        assert re.search(rf"^\[!\[[^\]]+\]\(images/[^)]+\)\]\({page}\)$", door, re.MULTILINE)


def test_links_lead_somewhere():
    for path in TEXTS:
        for target in re.findall(r"\]\(([^)\s]+)\)", path.read_text(encoding="utf-8")):
            if target.startswith("http"):
                continue
            name, _, anchor = target.partition("#")
            there = (path.parent / name).resolve() if name else path
            assert there.exists(), f"{path.name}: {target} is not there"
            assert not anchor or anchor in anchors(there), f"{there.name} has no heading {anchor}"


# Pages of environments.

MODULES = {"MultiSpecies": multispecies_v0, "Particles": particles_v0}
every_module = pytest.mark.parametrize("name", MODULES)


@pytest.mark.parametrize("name", [row.name for row in ENVIRONMENTS])
def test_the_example_of_a_page_runs(name):
    # Small worlds: what is tested is that the calls are right. Pictures take a second each to draw.
    fields = "particle_count=64, eps=0.3"
    fields += "" if name == "PointClassification" else ", resolution=16"
    fields += ", targets=('heart', 'gecko')" if name == "Pictures2D" else ""
    names = run_code(f"environments/{name}", (r'(-v\d+")', rf"\1, {fields}"))
    assert names["observation"].shape == (64, 83 if "3D" in name else 66)
    assert names["envs"].num_envs == 8


@every_module
def test_the_examples_of_a_page_of_several_species_run(name, capsys):
    few = ", particle_count=40, max_cycles=4)\nobservations"
    names = run_code(f"environments/{name}", (r"(, max_cycles=200)?\)\nobservations", few))
    assert names["env"].agents == []
    assert names["infos"][names["env"].possible_agents[-1]]["reason"] == 4
    if name == "MultiSpecies":
        losses = r"\{'species_0': [\d.]+, 'species_1': [\d.]+\}\n"
        assert re.fullmatch(losses, capsys.readouterr().out)


@every_module
@pytest.mark.parametrize("task", TASKS)
def test_a_page_names_the_keys_of_info_and_the_parts_of_the_loss(name, task):
    page = f"environments/{name}"
    env = MODULES[name].parallel_env(**small_crowd(task, particle_count=8, max_cycles=1))
    _, at_reset = env.reset(seed=0)
    *_, at_step = env.step(still(env))
    agent = env.possible_agents[0]
    (row,) = [line for line in section(page, "Reward").splitlines() if f"| {task} |" in line]
    parts = re.findall(r"`(\w+)`", row.split(" | ")[-1])
    named = {f"{kind}_{part}" for kind in ("loss", "reward") for part in parts}
    assert set(at_reset[agent]) == set(at_step[agent]) == {"species", "loss", "reason", *named}
    assert {"species", "loss", "reason"} <= set(first_cells(section(page, "Info")))


@every_module
def test_the_page_lists_tasks_with_their_ids(name):
    rows = re.findall(
        r'^\| `"(\w+)"` \| `([^`]+)` \|', text_of(f"environments/{name}"), re.MULTILINE
    )
    assert {id_: task for task, id_ in rows} == MODULES[name].ENVIRONMENTS


# The page about an own environment.


def test_the_own_environment_passes_gymnasiums_check_and_learns(
    folder, monkeypatch, recwarn, capsys
):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.syspath_prepend(folder)
    blocks = code_blocks("own_environment")
    (folder / "ring.py").write_text(blocks[0], encoding="utf-8")
    importlib.import_module("ring")
    try:
        check_env(gym.make("my/Ring-v0", particle_count=64).unwrapped)
        assert [str(warning.message) for warning in recwarn] == []
        with pytest.raises(npa_envs.NPAError, match="did you mean 'ring_radius'"):
            gym.make("my/Ring-v0", ringradius=0.3)
        names = {"gym": gym}
        for k in range(1, len(blocks)):
            run_code("own_environment", names=names, blocks=slice(k, k + 1))
    finally:
        gym.registry.pop("my/Ring-v0")
        del sys.modules["ring"]
    first, last = map(float, capsys.readouterr().out.split(" -> "))
    assert last < 0.5 * first


# Code of the other pages.


class Program(NamedTuple):
    """What is changed in a page's code so that it takes little time, and what is true after it."""

    checks: tuple[str, ...]
    """Expressions of the code's names, and of `printed`, its `labels` and `folder`."""
    changes: tuple[tuple[str, str], ...] = ()
    blocks: slice = slice(None)
    library: str = "torch"
    """A library that it needs."""


PROGRAMS = {
    "first_minutes": Program(("x.shape == (1, 1024, 2)",)),
    "gpu": Program(
        ("x.shape == (2, 256, 2)", "isinstance(observations, torch.Tensor)"),
        (("8, 4096", "2, 256"), ("steps=64", "steps=2"), ("num_envs=64", "num_envs=2")),
        slice(2),
    ),
    "gpu: learning": Program(
        (
            "labels == ['zero', 'ppo', 'gradient', \"ppo, begun with the gradient's rule\"]",
            "(folder / 'runs' / 'ppo' / 'rule-0.safetensors').is_file()",
            "(folder / 'runs' / 'gradient' / 'rule-0.safetensors').is_file()",
        ),
        (
            *(("[13]0_000_000", "500"), ("episode_steps=48", "episode_steps=2")),
            *(("particle_count=512", "particle_count=16"), ("num_envs=32", "num_envs=2")),
        ),
        slice(2, None),
        "stable_baselines3",
    ),
    "training": Program(
        ("model.num_timesteps == 64", "model.action_space.shape == (32,)"),
        (("37_000", "8"), (r'v0"\)', r'v0"), n_steps=64')),
        library="stable_baselines3",
    ),
    "textures": Program(("printed.count('tensor([') == 2",)),
    "point_classification": Program(
        ("'AccuracyRow(step=8' in printed", "points.shape == (1, 128, 2)")
    ),
    "morphogenesis3d": Program(
        (
            "[frame.shape for frame in frames] == [(256, 256, 3)] * 4",
            "(folder / 'seed.ply').stat().st_size > 512 * 26 * 4",
        )
    ),
    "beyond": Program(
        (
            "(s[0][x[0, :, 0] > 0][:, : rule.codes.table.shape[1]] == rule.codes['gecko']).all()",
            "(s[0][x[0, :, 0] <= 0][:, : rule.codes.table.shape[1]] == half).all()",
            "0 < (x[0, :, 0] > 0).sum() < x.shape[1]",
        ),
        blocks=slice(1),
    ),
    "own_loss": Program(
        (
            "sum(history[-8:]) < 0.8 * sum(history[:8])",
            "npa_envs.load_rule('ring.safetensors').state_dim == 12",
        ),
        (("iterations = 400", "iterations = 40"), ("particle_count = 256", "particle_count = 96")),
    ),
    "own_task": Program(
        ("result.finished", "(folder / 'runs' / 'ring' / 'rule.safetensors').exists()"),
        (("iterations=60", "iterations=6"),),
    ),
    "own_kernel": Program(("f'It prints `{printed.strip()}`' in text_of('own_kernel')",)),
    "species": Program(
        (
            "x.shape == (1, 256, 2)",
            "[own.target for own in config.task.species] == ['ring', 'heart']",
            "observations['species_0'].shape == (8, 32, 66)",
            "models['species_1'].num_timesteps == 2 * 16 * 8 * 16",
            "policies['species_1'](rows.vector_env.reset()[0]['species_1']).shape == (8, 16, 6)",
        )
    ),
    "export_web": Program(
        ("'<title>Two rules</title>' in (folder / 'page.html').read_text(encoding='utf-8')",)
    ),
    "view": Program(("printed == '(256, 2)\\n'",)),
    "../README": Program(
        (
            "colours.shape == (1, 256, 3)",
            "z.shape == (1, 256, 66)",
            "truncated and info['loss'] < 0.3",
            "envs.num_envs == 8",
        ),
        (("4096", "256"), ("steps=64", "steps=8")),
    ),
}


@pytest.mark.parametrize("page", PROGRAMS)
def test_the_code_of_a_page_runs(page, folder, capsys):
    checks, changes, blocks, library = PROGRAMS[page]
    pytest.importorskip(library)
    names = run_code(page.partition(":")[0], *changes, blocks=blocks)
    printed = capsys.readouterr().out
    names |= {"printed": printed, "folder": folder, "text_of": text_of}
    names["labels"] = re.findall(r"^([\w, ']+): ", printed, re.MULTILINE)
    assert [check for check in checks if not eval(check, names)] == []


# The page about an own rule.


def test_the_code_about_an_own_rule_runs(folder, monkeypatch):
    pytest.importorskip("pygame", reason="the extra human is not installed")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    few = (r"range\(300\)", "range(4)"), ("while not window.closed", "for _ in range(2)")
    names = run_code("own_rule", *few)
    names["window"].close()
    # The rule reads its input and never changes it.
    follower = names["FollowerRule"](state_dim=8, hidden_dim=64)
    updates = follower(torch.ones(5, follower.perception_dim))
    assert (updates == 0).all(dim=0).tolist() == [k == 2 for k in range(2 + 8)]
    follower.load_state_dict(torch.load(folder / "follower.pt"))
    with np.load(folder / "trajectory.npz") as saved:
        assert saved["x"].shape == (8, 1, 1024, 2)
        assert np.array_equal(saved["s"], names["ss"])
    assert len(imageio.imread(folder / "trajectory.mp4")) == 8
    # Calls in a row equal one call.
    together, (x, s) = torch.Generator().manual_seed(0), (names["x"], names["s"])
    whole = npa_envs.rollout(names["rule"], x, s, 8, generator=together)
    generator = torch.Generator().manual_seed(0)
    for _ in range(4):
        x, s = npa_envs.rollout(names["rule"], x, s, 2, generator=generator)
    assert torch.equal(whole[0], x)
    assert torch.equal(whole[1], s)


@pytest.mark.slow
def test_particles_learn_to_follow_a_place():
    names = run_code("own_rule", blocks=slice(1))
    with torch.no_grad():
        x, s = names["seed"](1)
        for place in torch.tensor([[[0.6, 0.4]], [[-0.6, 0.4]], [[0.0, -0.6]]]):
            x, s = names["follow"](x, s, place, 64)
            assert float((x.mean(dim=1) - place).norm()) < 0.3


# The tutorials.


def printed_returns(text: str) -> dict[str, tuple[float, float]]:
    """Return mean returns and their standard errors, by policy, of what a program prints."""
    rows = re.findall(r"^(\w+): (-?[\d.]+) ± ([\d.]+)$", text, re.MULTILINE)
    return {name: (float(mean), float(error)) for name, mean, error in rows}


def test_the_tutorial_runs_and_gives_the_returns_that_need_no_training(folder, capsys):
    pytest.importorskip("stable_baselines3")
    run_code("tutorial", (r"model\.learn\(100 \* 16", "model.learn(16"), blocks=slice(-1, None))
    returns, on_page = map(printed_returns, (capsys.readouterr().out, text_of("tutorial")))
    assert returns.keys() == on_page.keys()
    for name in ("RandomPolicy", "ZeroPolicy", "RulePolicy"):
        assert returns[name][0] == pytest.approx(on_page[name][0], abs=0.02)
    with Image.open(folder / "ppo.png") as picture:
        assert picture.width >= 5 * 256


@pytest.mark.slow
def test_ppo_beats_random_actions_by_three_standard_errors_in_five_minutes(capsys):
    pytest.importorskip("stable_baselines3")
    start = time.process_time()
    run_code("tutorial", blocks=slice(-1, None))
    assert time.process_time() - start < 300.0
    returns = printed_returns(capsys.readouterr().out)
    (mean, error), (random_mean, random_error) = returns["RowPolicy"], returns["RandomPolicy"]
    assert mean - random_mean > 3.0 * math.hypot(error, random_error)
    # Not by doing nothing, either.
    assert mean > 3.0 * error
    assert mean == pytest.approx(printed_returns(text_of("tutorial"))["RowPolicy"][0], abs=0.2)


@pytest.mark.slow
def test_the_code_about_the_search_runs():
    pytest.importorskip("ribs", reason="the extra search is not installed")
    names = run_code("search")
    assert names["search"].evaluations == 40
    assert 0.0 < names["best"].found.quality <= 1.0
    assert names["rule"].weight_count == len(names["best"].solution)


def test_the_code_about_datasets_runs(folder, monkeypatch):
    pytest.importorskip("minari")
    pytest.importorskip("h5py")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder))
    small = ["target=heart", "particle_count=32", "eps=0.3", "eps0=0.1", "resolution=16"]
    words = ["record-dataset", "npa/Morphogenesis2D-v0", "--policy", "heart", "--episodes", "2"]
    words += ["--dataset", "npa/heart/shipped-v0", "--no-progress", "--keywords", *small]
    assert main(words) == 0
    names = run_code("datasets", blocks=slice(1))
    observation, _ = names["env"].reset(seed=0)
    assert np.array_equal(observation, names["episode"].observations[0])
    options = '{"target": "heart", "particle_count": 32, "eps": 0.3, "eps0": 0.1, "resolution": 16}'
    changes = ('{"target": "heart"}', options), ("8_000_000", "5_000")
    run_code(
        "datasets", *changes, ("episode_steps=256", "episode_steps=2"),
        names=names, blocks=slice(1, 2),
    )  # fmt: skip
    assert names["clone"].rules is not None


def test_the_code_about_learning_runs(folder, monkeypatch, capsys):
    # Less learning: tested is that it runs, and what needs no learning.
    names = run_code("learning", ("00_000", "0_000"), blocks=slice(1))
    printed = capsys.readouterr().out.splitlines()
    methods = ["zero", "random", "scripted", "gradient", "cold", "warm"]
    assert [line.split(":")[0] for line in printed] == methods
    random, scripted = (float(line.split()[1]) for line in printed[1:3])
    # Its search pays for episodes too, and ends early here.
    assert scripted > random
    assert (folder / "grown" / "rule-0.safetensors").exists()
    (folder / "mine.py").write_text(code_blocks("learning")[1], encoding="utf-8")
    monkeypatch.syspath_prepend(folder)
    budget = Budget(particle_steps=2000)
    trained = train("mine:train", names["problem"], budget, 0, noise=0.2, curve_points=1)
    assert [entry.particle_steps for entry in trained.log] == [0, 2000]


@pytest.fixture
def _quick_gardens(monkeypatch):
    """Living worlds that take little time: what is tested is that the calls are right."""
    for garden in GARDEN_IDS:
        spec = gym.spec(garden)
        for key, value in {"grow_steps": 4, "seed_pool": 1, "rule_steps": 1}.items():
            monkeypatch.setitem(spec.kwargs, key, value)


@pytest.mark.usefixtures("_quick_gardens")
def test_the_code_about_gardening_runs(capsys):
    few = r"max_cycles=\d+(, particle_count=256)?", "max_cycles=2, particle_count=61, grow_steps=4"
    names = run_code("gardening", few)
    run_code("environments/Gardeners", few, names=names)
    printed = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in printed[:2]] == ["StillGardener", "ScriptedGardener"]
    assert float(names["slope"].abs().max()) > 0.0
    assert names["rewards"]["keeper_0"] == -names["rewards"]["raider_0"] != 0.0


@pytest.mark.usefixtures("_quick_gardens")
def test_the_tutorial_of_gardeners_runs():
    stable_baselines3 = pytest.importorskip("stable_baselines3")
    # The programs that it includes have tests of their own.
    names = {"gym": gym, "name": "npa/Gardener2DSmall-v0", "PPO": stable_baselines3.PPO}
    names["env"] = gym.make(names["name"])
    few = (r"learn\([\d_]+\)", "learn(34)"), ("num_envs=256", "num_envs=2")
    run_code("tutorial_gardener", *few, ("n_steps=32", "n_steps=8"), names=names)
    assert names["model"].num_timesteps >= 34
    assert names["model"].n_envs == 2


# Other libraries: each program runs as it stands there, and learns.

RANDOM, RANDOM_ERROR = 0.143, 0.018
"""Return of random actions in the worlds of the tutorial, by its table."""

foreign = pytest.mark.filterwarnings(
    "ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning"
)


def run_integration(number: int, library: str, *changes: tuple[str, str]) -> None:
    """Run one program of docs/integrations.md, if there is the library."""
    pytest.importorskip(library)
    run_code("integrations", *changes, blocks=slice(number, number + 1))


@foreign
def test_callbacks_logs_and_films_of_stable_baselines3(folder):
    pytest.importorskip("moviepy")
    run_integration(0, "stable_baselines3")
    load = importlib.import_module("stable_baselines3").PPO.load
    assert load(folder / "runs/rl_model_16384_steps.zip").num_timesteps == 16384
    assert load(folder / "runs/best_model.zip").num_timesteps in (8192, 16384)
    log = EventAccumulator(str(folder / "runs/PPO_1")).Reload()
    assert [event.value for event in log.Scalars("eval/mean_ep_length")] == [16.0, 16.0]
    rewards = log.Scalars("rollout/ep_rew_mean")
    assert [event.step for event in rewards] == [4096, 8192, 12288, 16384]
    (film,) = (folder / "runs").glob("*.mp4")
    assert len(imageio.imread(film)) in (17, 18)


@foreign
def test_weights_and_biases_follows_the_logs(folder, monkeypatch):
    monkeypatch.setenv("WANDB_MODE", "offline")
    run_integration(1, "wandb")
    (record,) = (folder / "wandb").glob("offline-run-*/*.wandb")
    assert b"rollout/ep_rew_mean" in record.read_bytes()


@foreign
def test_films_of_gymnasium(folder):
    run_integration(2, "moviepy", ("24", "12"))
    for name, side in (("one", 256), ("four", 512)):
        film = imageio.imread(next((folder / "films" / name).glob("*.mp4")))
        # The first picture and 12 steps; moviepy 1.0.3 may show the last one twice.
        assert len(film) in (13, 14)
        assert film.shape[1:] == (side, side, 3)
        assert abs(film[-1].astype(float) - film[0]).mean() > 1.0


@foreign
@pytest.mark.parametrize("rounds", [1, pytest.param(60, marks=pytest.mark.slow)])
def test_particles_learn_to_act_for_their_world_by_rsl_rl(rounds, capsys):
    run_integration(3, "rsl_rl", ("(?m)^rounds(.*) = 60", rf"rounds\1 = {rounds}"))
    mean, error = printed_returns(capsys.readouterr().out.replace("RSL-RL", "RSL"))["RSL"]
    assert error < 0.05
    if rounds == 60:
        assert mean > RANDOM + 10.0 * (RANDOM_ERROR + error)
        on_page = printed_returns(text_of("integrations").replace("RSL-RL", "RSL"))
        assert mean == pytest.approx(on_page["RSL"][0], abs=0.3)


@foreign
@pytest.mark.slow
def test_rllib_learns(capsys):
    ray = pytest.importorskip("ray")
    ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    try:
        run_integration(4, "ray", ("rounds = 60", "rounds = 30"))
    finally:
        ray.shutdown()
    (mean,) = re.findall(r"^RLlib: (-?[\d.]+)$", capsys.readouterr().out, re.MULTILINE)
    assert float(mean) > 3.0 * RANDOM


# Programs of `examples/`.

LIBRARIES = {"sb3": "stable_baselines3", "torchrl": "torchrl", "evolution": "cma"}
"""What programs need, by the first words of their names."""


@foreign
@pytest.mark.parametrize(
    "name", [n if n == "gradient" else pytest.param(n, marks=pytest.mark.slow) for n in EXAMPLES]
)
def test_an_example_runs_and_writes_its_curve(name, folder, monkeypatch, capsys):
    pytest.importorskip(LIBRARIES.get(name.partition("_")[0], "torch"))
    program, *words = EXAMPLES[name].split()
    monkeypatch.setattr(sys, "argv", [program, *words, "--steps", "64"])
    runpy.run_path(str(ROOT / "examples" / program))
    written = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
    returns = (f"{policy}: {written[policy][0]:.2f} ±" for policy in ("learned", "zero", "random"))
    printed = capsys.readouterr().out
    assert [part for part in returns if part not in printed] == []
    assert written["curve"][-1][1:] == written["learned"]
    (committed,) = (run for run in draw_examples.read()["runs"] if run["name"] == name)
    mean, error = committed["zero"]
    assert written["zero"][0] == pytest.approx(mean, abs=0.01 + 3.0 * error)


def test_committed_curves_are_those_of_all_examples_and_beat_zero_and_random_actions():
    runs = draw_examples.read()["runs"]
    assert [run["command"] for run in runs] == [f"python examples/{c}" for c in EXAMPLES.values()]
    files = (ROOT / "examples").glob("*.py")
    programs = [path for path in files if "--curve" in path.read_text(encoding="utf-8")]
    assert {path.name for path in programs} == {c.split()[0] for c in EXAMPLES.values()}
    for run in runs:
        mean, error = run["learned"]
        for other, spread in (run["zero"], run["random"]):
            assert mean - other > 3.0 * math.hypot(error, spread), run["name"]
    for path in programs:
        assert len(path.read_text(encoding="utf-8").splitlines()) <= 150
        assert path.name in text_of("recipes_rl")


# Living worlds, and all pages.


def test_the_code_about_stability_runs():
    x = torch.rand(3, 64, 2, generator=torch.Generator().manual_seed(0))
    x[1, 5, 0] = torch.nan
    names = {"npa_envs": npa_envs, "gym": gym, "rule": npa_envs.load_rule("heart")}
    names |= {"x": x, "s": torch.zeros(3, 64, 16)}
    run_code("stability", ("512", "2"), names=names)
    assert names["x"].shape == (2, 64, 2)
    assert names["z"].shape == (2, 64, 66)


def test_every_page_with_code_is_run_by_a_test():
    """The names of pages in this folder's tests are the list of what is run."""
    files = sorted(Path(__file__).parent.glob("test_*.py"))
    tests = "".join(path.read_text(encoding="utf-8") for path in files)
    pages = [path.stem for path in sorted(DOCS.glob("*.md")) if code_blocks(path.stem)]
    assert len(pages) > 10
    assert [page for page in pages if page not in tests] == []
