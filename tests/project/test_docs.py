"""The documentation is true: pages are current, tables name what is there, code runs."""

import contextlib
import importlib
import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import gymnasium as gym
import numpy as np
import pytest
import torch
from crowds import TASKS, still
from crowds import small as small_crowd
from gymnasium.utils.env_checker import check_env
from small_envs import assert_batch_of_singles

import npa_envs
from npa_envs.agents.learning import Budget, train
from npa_envs.cli import COMMANDS, main
from npa_envs.envs import multispecies_v0, particles_v0
from npa_envs.envs.multi import TASKS as TABLE
from npa_envs.ops.backend import KernelRequest, describe
from npa_envs.registration import ENVIRONMENTS, GARDEN_IDS
from npa_envs.rule.files import shipped_rules
from npa_envs.tasks.morphogenesis2d import MORPHOGENESIS2D_PRESETS
from npa_envs.training import TASKS as TRAINED

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
OWN = DOCS / "own_environment.md"
PAGES = [DOCS / "environments" / f"{registration.name}.md" for registration in ENVIRONMENTS]
MAP = DOCS / "architecture.md"
TEXTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]
FOLDERS = "npa_envs|envs|wrappers|agents|tests|benchmarks|docs"
"""Folders by which a path in a text is known for one."""
SMALL = {"particle_count": 64, "eps": 0.3, "resolution": 16}
NO_PICTURE = ("PointClassification",)
BY_ID = {registration.id: registration for registration in ENVIRONMENTS}


def small(name):
    """Keywords that make an environment small, by its name."""
    # Pictures take a second each to draw.
    few = {"targets": ("heart", "gecko")} if name == "Pictures2D" else {}
    return few | {k: v for k, v in SMALL.items() if k != "resolution" or name not in NO_PICTURE}


def code_blocks(path: Path) -> list[str]:
    text = path.read_text(encoding="utf-8")
    return re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def script(name: str) -> ModuleType:
    """Import a script of docs/."""
    sys.path.insert(0, str(DOCS))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(str(DOCS))


def run_code(page: str, *changes: tuple[str, str], names=None, blocks=slice(None)) -> dict:
    """Run blocks of a page, with changes of texts that it has, and return its names."""
    code = "\n".join(code_blocks(DOCS / f"{page}.md")[blocks])
    for old, new in changes:
        assert old in code
        code = code.replace(old, new)
    names = {} if names is None else names
    exec(compile(code, f"{page}.md", "exec"), names)
    return names


def section(path: Path, heading: str) -> str:
    return path.read_text(encoding="utf-8").split(f"\n## {heading}\n")[1].split("\n## ")[0]


def first_cells(text: str) -> list[str]:
    """Return the names in code that the first cells of a section's tables hold."""
    cells = re.findall(r"^\| ([^|]+) \|", text, re.MULTILINE)
    return [name for cell in cells for name in re.findall(r"`([^`]+)`", cell)]


def anchors(path: Path) -> set[str]:
    titles = re.findall(r"^#+ (.+)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title).strip().lower().replace(" ", "-") for title in titles}


@pytest.fixture(scope="module")
def builder():
    """The script that makes the pages."""
    return script("build_environment_pages")


@pytest.fixture(scope="module")
def bench():
    """The script that makes the tables of NPA-Bench."""
    pytest.importorskip("jsonschema")
    pytest.importorskip("scipy")
    return script("build_npa_bench_page")


def test_the_tables_of_the_benchmark_are_what_its_files_say(bench, tmp_path, capsys):
    assert bench.main(["--check"]) == 0
    text = (DOCS / bench.PAGE).read_text(encoding="utf-8")
    (tmp_path / bench.PAGE).write_text(text.replace("| 1e8 |", "| 2e8 |"), encoding="utf-8")
    assert bench.main(["--check"], tmp_path) == 1
    assert "run python docs/build_npa_bench_page.py" in capsys.readouterr().err


def test_tables_and_curves_of_the_benchmark_show_all_rows(bench):
    from npa_envs.agents.comparison.npa_bench import SUITES, BenchRow, BenchRun

    suite = SUITES["npa-bench-v0"]
    first, second = list(suite.groups["gardens"])[:2]

    def row(method, *means):
        curve = ((0.0, 0.0), (9.0, means[-1])) if method == "other" else ((0.0, means[-1]),)
        runs = [BenchRun(first, seed, 9.0, mean, curve) for seed, mean in enumerate(means)]
        return BenchRow(suite, method, tuple(runs), f"it is {method}")

    rows = {name: row(name, *means) for name, means in {
        "other": (1.0, 2.0), "zero": (0.0, 0.0), "gradient": (4.0, 4.0), "sac": (3.0, 3.0),
    }.items()}  # fmt: skip
    text = bench.results(suite, rows)
    assert "| `other` | 0.38 [0.25, 0.50] | 0.38 [0.25, 0.50] |" in text
    assert text.index("| `sac` | it is sac | 2 |") < text.index("| `other` | it is other | 2 |")
    assert second not in text
    assert "](images/npa_bench_v0.png)" in text
    assert text in bench.page(
        (DOCS / bench.PAGE).read_text(encoding="utf-8"), dict.fromkeys(SUITES, rows)
    )
    assert bench.curves(suite, rows).startswith(b"\x89PNG")
    del rows["gradient"]
    assert "Scores need the rows" in bench.results(suite, rows)
    assert bench.results(suite, {}) == bench.NO_ROWS


@pytest.fixture(scope="module")
def gallery():
    """The script that makes the page of the rules."""
    return script("build_gallery_page")


@pytest.fixture(scope="module")
def ring(tmp_path_factory):
    """The module that the page about own environments shows."""
    path = tmp_path_factory.mktemp("own") / "ring.py"
    path.write_text(code_blocks(OWN)[0], encoding="utf-8")
    spec = importlib.util.spec_from_file_location("ring", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules["ring"] = module
    spec.loader.exec_module(module)
    yield module
    gym.registry.pop("my/Ring-v0")
    del sys.modules["ring"]


def test_pages_of_environments_are_current(builder, capsys):
    status = builder.main(["--check"])
    assert status == 0, capsys.readouterr().err


def test_the_gallery_is_current_and_shows_every_rule(gallery, capsys):
    status = gallery.main(["--check"])
    assert status == 0, capsys.readouterr().err
    text = (DOCS / "gallery.md").read_text(encoding="utf-8")
    assert sorted(re.findall(r"^### (.+)$", text, re.MULTILINE)) == sorted(shipped_rules())
    films = re.findall(r"\(images/(gallery/[\w-]+\.webp)\)", text)
    assert len(films) == len(shipped_rules())
    assert all((DOCS / "images" / film).stat().st_size < 300_000 for film in films)


def test_the_reference_of_commands_has_every_command_and_task():
    text = (DOCS / "commands.md").read_text(encoding="utf-8")
    asked = re.findall(r"^```\{command-help\} (.+)$", text, re.MULTILINE)
    assert asked == re.findall(r"^##+ (.+)$", text, re.MULTILINE)
    assert sorted(asked) == sorted([*COMMANDS, *(f"train {name}" for name in TRAINED)])


def commands_of_pages() -> dict[tuple[str, ...], set[str]]:
    """Return the options that blocks of shell give to each command, by command and task."""
    asked: dict[tuple[str, ...], set[str]] = {}
    for path in TEXTS:
        for block in re.findall(
            r"^ *```(?:sh|bash)\n(.*?)^ *```", path.read_text(encoding="utf-8"), re.M | re.S
        ):
            for line in re.sub(r"\\\n", " ", block).splitlines():
                # What follows `--` is told to the runs of a sweep.
                words = re.sub(r"#.*| > .*| -- .*", "", line).replace(".venv/bin/", "").split()
                if words[:1] != ["npa-envs"] or len(words) < 2 or words[1].startswith("-"):
                    continue
                command = tuple(words[1:3]) if words[1] == "train" else (words[1],)
                names = {word.partition("=")[0] for word in words if word.startswith("-")}
                asked.setdefault(command, set()).update(names)
    return asked


def test_commands_in_blocks_of_shell_have_the_options_that_they_are_given(capsys):
    asked = commands_of_pages()
    assert len(asked) > 12
    for command, options in asked.items():
        if "TASK" in command:
            continue
        with contextlib.suppress(SystemExit):
            main([*command, "--help-all" if len(command) > 1 else "--help"])
        told = set(re.findall(r"(?<![\w-])--?[\w-]+", capsys.readouterr().out))
        assert options <= told, command


UNLISTED = ("out", "tensorboard", "picture_interval", "checkpoint_interval")
"""Fields of presets that the tables of options leave out: they change no rule."""


def as_number(word: str) -> float | str:
    """Return a word of a command as a number, where it is one."""
    try:
        return float(word)
    except ValueError:
        return word


@pytest.mark.parametrize("preset", ["best", "fast"])
def test_the_tables_of_options_are_what_the_presets_choose(preset):
    text = section(DOCS / "recipes.md", f"What `{preset}` consists of")
    listed = {}
    for cell in re.findall(r"^\| `--([^`]+)`", text, re.MULTILINE):
        for option in cell.split(" --"):
            name, *values = option.split()
            listed[name.replace("-", "_")] = [as_number(value) for value in values]
    chosen, paper = (
        vars(MORPHOGENESIS2D_PRESETS[name].task) | vars(MORPHOGENESIS2D_PRESETS[name])
        for name in (preset, "paper")
    )
    changed = {name for name in paper if chosen[name] != paper[name]}
    assert set(listed) - {"hidden_dim"} == changed - {"task", *UNLISTED}
    for name, values in listed.items():
        value = chosen[name]
        assert values == list(value if isinstance(value, tuple) else (value,)), name


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
    text = (DOCS / "api" / f"{page}.md").read_text(encoding="utf-8")
    told = re.findall(rf"^\.\. auto\w+:: {re.escape(package)}\.(\w+)$", text, re.MULTILINE)
    assert sorted(told) == sorted(public)


def test_check_finds_pages_that_are_changed_missing_or_nobodys(builder, tmp_path, capsys):
    made = builder.pages()
    for name, text in made.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    assert builder.main(["--check"], tmp_path) == 0
    changed = tmp_path / "Morphogenesis2D.md"
    changed.write_text(
        changed.read_text(encoding="utf-8").replace("1024", "1023", 1), encoding="utf-8"
    )
    (tmp_path / "README.md").unlink()
    (tmp_path / "Forgotten.md").write_text("# An environment of the past\n", encoding="utf-8")
    assert builder.main(["--check"], tmp_path) == 1
    told = capsys.readouterr().err
    assert "not current: Forgotten.md, Morphogenesis2D.md, README.md: run python docs/" in told


def test_a_table_of_columns_must_name_each_column_once(builder):
    text = "| Columns | What |\n|---|---|\n| `0 : C` | state |\n| `C : 2C + 2` | rest |\n"
    letters = {"C": 16, "D": 2}
    numbered = builder.numbered_columns(text, letters, 34)
    assert "| `0 : C` | 0 to 15 | state |" in numbered
    assert "| `C : 2C + 2` | 16 to 33 | rest |" in numbered
    with pytest.raises(AssertionError, match="34 columns of 35"):
        builder.numbered_columns(text, letters, 35)
    with pytest.raises(AssertionError, match="do not follow on 16"):
        builder.numbered_columns(text.replace("`C :", "`17 :"), letters, 34)


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_a_page_has_every_section(page):
    headings = re.findall(r"^## (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    assert headings == [
        "Description",
        "Observation space",
        "Action space",
        "Reward",
        "Starting state",
        "Episode end",
        "Info",
        "Rendering",
        "Arguments",
        "Vectorized environment",
        "References",
        "Version history",
    ]
    assert not re.search(r"As in `\w+Env`", page.read_text(encoding="utf-8"))


def test_the_first_page_alone_explains_what_all_environments_share():
    meaning = "Standard deviation of the noise added to every position in a step"
    shared = ("Dense rewards telescope", "| `num_envs` |", meaning)
    first, *others = (page.read_text(encoding="utf-8") for page in PAGES)
    assert all(text in first for text in shared)
    for page in others:
        assert not any(text in page for text in shared)
        for heading in ("reward", "arguments", "vectorized-environment"):
            assert f"({PAGES[0].name}#{heading})" in page


def inline(text):
    """Return the arguments that a page lists by their defaults alone, `name=default`."""
    return dict(re.findall(r"`(\w+)=([^`]+)`[,.]", text.partition("same environment with")[0]))


def literal(value):
    return f'"{value}"' if isinstance(value, str) else str(value)


@pytest.mark.parametrize("registration", ENVIRONMENTS, ids=lambda row: row.name)
def test_a_page_lists_the_arguments_with_their_defaults(registration, builder):
    page = DOCS / "environments" / f"{registration.name}.md"
    config = builder.environment_class(registration).task_type.config_type()
    arguments = section(page, "Arguments")
    assert sorted([*first_cells(arguments), *inline(arguments)]) == sorted(vars(config))
    assert all(value == literal(getattr(config, n)) for n, value in inline(arguments).items())
    name = {"PointClassification": "data", "Pictures2D": "split"}.get(registration.name, "target")
    assert f'| `{name}` | str | `"{getattr(config, name)}"` |' in arguments
    first = section(PAGES[0], "Arguments")
    assert "| `success_loss` | float or None | `None` |" in first


@pytest.mark.parametrize("registration", ENVIRONMENTS, ids=lambda row: row.name)
def test_a_page_lists_the_keys_of_info(registration):
    keywords = {"reward": "particle", "success_loss": 1e6, "tell_updated": True}
    keywords |= small(registration.name)
    if registration.name == "Regeneration2D":
        keywords["rule"] = "picture"
    env = gym.make(registration.id, **keywords)
    _, at_reset = env.reset(seed=0)
    *_, terminated, _, at_step = env.step(np.zeros(env.action_space.shape, np.float32))
    assert terminated
    listed = section(DOCS / "environments" / f"{registration.name}.md", "Info")
    rows = [line for line in listed.splitlines() if line.startswith("| `")]
    in_reset = [name for row in rows if "| reset" in row for name in first_cells(row)]
    assert sorted(in_reset) == sorted(at_reset)
    assert sorted(first_cells(listed)) == sorted(at_step)


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_the_example_of_a_page_runs(page):
    (example,) = code_blocks(page)
    # Small worlds: what is tested is that the calls are right.
    fields = ", ".join(f"{name}={value}" for name, value in small(page.stem).items())
    names = {}
    exec(re.sub(r'(-v\d+")', rf"\1, {fields}", example), names)
    assert names["observation"].shape == (64, 83 if "3D" in page.stem else 66)
    assert names["envs"].num_envs == 8


def test_an_own_environment_takes_at_most_40_lines():
    assert len(code_blocks(OWN)[0].splitlines()) <= 40


def test_the_own_environment_passes_the_check_of_gymnasium(ring, monkeypatch, recwarn):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    check_env(gym.make("my/Ring-v0", particle_count=64).unwrapped)
    assert [str(warning.message) for warning in recwarn] == []


def test_a_batch_of_the_own_environment_equals_single_ones(ring):
    keywords = {"particle_count": 61, "position_noise": 0.01}
    envs = gym.make_vec("my/Ring-v0", num_envs=3, max_episode_steps=5, **keywords)
    singles = [gym.make("my/Ring-v0", max_episode_steps=5, **keywords) for _ in range(3)]
    actions = np.random.default_rng(0).uniform(-1, 1, (8, *envs.action_space.shape))
    reasons, _ = assert_batch_of_singles(envs, singles, actions.astype(np.float32))
    assert reasons == {None, "time limit"}


def test_the_own_environment_measures_the_distance_from_the_ring(ring):
    env = gym.make("my/Ring-v0", particle_count=60, ring_radius=0.25).unwrapped
    env.reset(seed=0)
    angle = torch.arange(60) * (2 * torch.pi / 60)
    circle = torch.stack((angle.cos(), angle.sin()), dim=1)
    env.place_particles(0.25 * circle + 0.5, torch.zeros(60, 16))
    assert env.worlds.loss.item() == pytest.approx(0.0, abs=1e-12)
    env.place_particles(0.35 * circle, torch.zeros(60, 16))
    assert env.worlds.loss.item() == pytest.approx(0.01, rel=1e-5)
    with pytest.raises(npa_envs.NPAError, match="did you mean 'ring_radius'"):
        gym.make("my/Ring-v0", ringradius=0.3)


def test_the_other_code_about_own_environments_runs_as_it_says(ring, monkeypatch, capsys):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    names = {"gym": gym}
    for block in code_blocks(OWN)[1:]:
        exec(block, names)
    first, last = map(float, capsys.readouterr().out.split(" -> "))
    told = re.search(r"from (0\.\d+)\s+to (0\.\d+)", OWN.read_text(encoding="utf-8"))
    assert first == pytest.approx(float(told[1]), abs=1e-3)
    assert last == pytest.approx(float(told[2]), abs=2e-3)


def test_the_code_about_datasets_runs(tmp_path, monkeypatch):
    pytest.importorskip("minari")
    pytest.importorskip("h5py")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    small = ["target=heart", "particle_count=32", "eps=0.3", "eps0=0.1", "resolution=16"]
    words = ["record", "npa/Morphogenesis2D-v0", "--policy", "heart", "--episodes", "2"]
    words += ["--dataset", "npa/heart/shipped-v0", "--no-progress", "--options", *small]
    assert main(words) == 0
    first, second = code_blocks(DOCS / "datasets.md")
    names = {}
    exec(first, names)
    observation, _ = names["env"].reset(seed=0)
    assert np.array_equal(observation, names["episode"].observations[0])
    told = ", ".join(word.replace("=", '": ', 1) for word in small).replace("heart", '"heart"')
    told = '{"' + told.replace(", ", ', "') + "}"
    second = second.replace('{"target": "heart"}', told).replace("8_000_000", "5_000")
    second = second.replace("episode_steps=256", "episode_steps=2")
    exec(second, names)
    assert names["clone"].rules is not None


@pytest.mark.parametrize(
    "page", ["training", "textures", "point_classification", "morphogenesis3d"]
)
def test_the_code_of_a_page_runs(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names = run_code(page)
    told = capsys.readouterr().out
    if page == "training":
        assert told.startswith("random: ")
    elif page == "textures":
        assert told.count("tensor([") == 2
    elif page == "point_classification":
        assert "AccuracyRow(step=8" in told
        assert names["points"].shape == (1, 128, 2)
    else:
        assert [frame.shape for frame in names["frames"]] == [(256, 256, 3)] * 4
        assert (tmp_path / "seed.ply").stat().st_size > 512 * 26 * 4


@pytest.mark.slow
def test_the_code_about_the_search_runs():
    pytest.importorskip("ribs", reason="the extra search is not installed")
    names = run_code("search")
    assert names["search"].evaluations == 40
    assert 0.0 < names["best"].found.quality <= 1.0
    assert names["rule"].weight_count == len(names["best"].solution)


def test_the_code_about_codes_runs():
    names = run_code("beyond", blocks=slice(1))
    codes, s, x = names["rule"].codes, names["s"], names["x"]
    right = x[0, :, 0] > 0
    assert 0 < int(right.sum()) < len(right)
    assert (s[0, right][:, : codes.table.shape[1]] == codes["gecko"]).all()
    assert (s[0, ~right][:, : codes.table.shape[1]] == names["half"]).all()


def test_the_code_about_own_losses_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    # Fewer iterations: tested is that it runs and goes down.
    names = run_code("own_loss", ("range(150)", "range(12)"))
    (first,) = re.findall(r"^0: (.+)$", capsys.readouterr().out, re.MULTILINE)
    told = re.search(
        r"fell from (0\.\d+) at the start", (DOCS / "own_loss.md").read_text(encoding="utf-8")
    )
    assert float(first) == pytest.approx(float(told[1]), abs=1e-3)
    assert names["loss"].item() < 0.8 * float(first)
    assert npa_envs.load_rule("ring.safetensors").state_dim == 16


def test_the_code_about_own_tasks_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = run_code("own_task", ("iterations=60", "iterations=6"))
    assert names["result"].finished
    assert (tmp_path / "runs" / "ring" / "rule.safetensors").exists()


def test_the_code_about_own_kernels_prints_what_the_page_says(capsys):
    run_code("own_kernel")
    printed = re.search(r"It prints `(.+)`", (DOCS / "own_kernel.md").read_text(encoding="utf-8"))
    assert capsys.readouterr().out.strip() == printed[1]


def test_the_code_of_the_first_minutes_and_about_graphics_cards_runs():
    names = run_code("first_minutes")
    assert names["x"].shape == (1, 1024, 2)
    changes = ("8, 4096", "2, 256"), ("steps=64", "steps=2"), ("num_envs=64", "num_envs=2")
    run_code("gpu", *changes, names=names, blocks=slice(2))
    assert names["x"].shape == (2, 256, 2)
    assert isinstance(names["observations"], torch.Tensor)


def test_the_code_about_several_species_runs():
    names = run_code("species")
    assert names["x"].shape == (1, 256, 2)
    assert [own.target for own in names["config"].task.species] == ["ring", "heart"]
    assert names["observations"]["species_0"].shape == (8, 32, 66)
    assert names["models"]["species_1"].num_timesteps == 2 * 16 * 8 * 16
    acted = names["policies"]["species_1"](names["rows"].vector_env.reset()[0]["species_1"])
    assert acted.shape == (8, 16, 6)


def test_the_code_about_learning_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    # Less learning: tested is that it runs, and what needs no learning.
    names = run_code("learning", ("00_000", "0_000"), blocks=slice(1))
    method = code_blocks(DOCS / "learning.md")[2]
    told = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in told] == [
        "zero", "random", "scripted", "gradient", "cold", "warm",
    ]  # fmt: skip
    page = (DOCS / "learning.md").read_text(encoding="utf-8")
    random, scripted = (float(line.split()[1]) for line in told[1:3])
    (printed,) = re.findall(r"^random: (\d\.\d+) ±", page, re.MULTILINE)
    assert random == pytest.approx(float(printed), abs=0.02)
    # Its search pays for episodes too, and ends early here.
    assert scripted > random
    assert (tmp_path / "grown" / "rule-0.safetensors").exists()
    (tmp_path / "mine.py").write_text(method, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    budget = Budget(particle_steps=2000)
    trained = train("mine:train", names["problem"], budget, 0, noise=0.2, entries=1)
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
    names = {}
    of_two = code_blocks(DOCS / "environments" / "Gardeners.md")
    for code in code_blocks(DOCS / "gardening.md") + of_two:
        few = "max_cycles=2, particle_count=61, grow_steps=4"
        code = re.sub(r"max_cycles=\d+(, particle_count=256)?", few, code)
        exec(compile(code, "gardening.md", "exec"), names)
    told = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in told[:2]] == ["StillGardener", "ScriptedGardener"]
    assert float(names["slope"].abs().max()) > 0.0
    assert names["rewards"]["keeper_0"] == -names["rewards"]["raider_0"] != 0.0


@pytest.mark.usefixtures("_quick_gardens")
def test_the_tutorial_of_gardeners_runs(capsys, tmp_path, monkeypatch):
    pytest.importorskip("stable_baselines3")
    monkeypatch.chdir(tmp_path)
    names = {}
    for code in code_blocks(DOCS / "tutorial_gardener.md"):
        code = re.sub(r"learn\([\d_]+\)", "learn(34)", code).replace("1_000", "33")
        code = code.replace("num_envs=256", "num_envs=2").replace("n_steps=32", "n_steps=8")
        code = code.replace("range(100, 116)", "range(100, 102)").replace(
            "num_envs=8", "num_envs=2"
        )
        code = code.replace("env, gamma=0.9, seed=0", "env, gamma=0.9, seed=0, **few")
        names["few"] = {"n_steps": 17} if "import PPO" in code else {}
        exec(compile(code, "tutorial_gardener.md", "exec"), names)
    told = capsys.readouterr().out.splitlines()
    policies = ["StillGardener", "RandomGardener", "ScriptedGardener", "learned"]
    assert [line.split()[0] for line in told[:4]] == policies
    assert told[4].startswith("arrived and whole: ")
    assert (tmp_path / "gardener.webp").stat().st_size > 1000
    assert names["model"].num_timesteps >= 34
    assert names["shepherd"].num_timesteps == 34


def test_the_code_about_ppo_runs(capsys):
    pytest.importorskip("stable_baselines3")
    run_code("learning", ("500_000", "1_000"), blocks=slice(1, 2))
    told = capsys.readouterr().out.splitlines()
    forms = ("ppo", "ppo_world")
    assert [line.split(":")[0] for line in told] == [form for form in forms for _ in range(3)]


def test_the_code_about_exported_pages_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_code("export_web")
    assert "<title>Two rules</title>" in (tmp_path / "page.html").read_text(encoding="utf-8")


def test_the_code_about_stability_runs(capsys):
    x = torch.rand(3, 64, 2, generator=torch.Generator().manual_seed(0))
    x[1, 5, 0] = torch.nan
    names = {"npa_envs": npa_envs, "gym": gym, "rule": npa_envs.load_rule("heart")}
    names |= {"x": x, "s": torch.zeros(3, 64, 16)}
    run_code("stability", ("512", "2"), names=names)
    assert names["x"].shape == (2, 64, 2)
    assert names["z"].shape == (2, 64, 66)


def test_the_code_about_the_viewer_runs(capsys):
    run_code("view")
    assert capsys.readouterr().out == "(256, 2)\n"


def test_the_code_of_the_readme_runs():
    environments, operators = code_blocks(ROOT / "README.md")
    names = {}
    exec(operators.replace("4096", "256").replace("steps=512", "steps=8"), names)
    assert names["colours"].shape == (1, 256, 3)
    assert names["z"].shape == (1, 256, 66)
    names = {}
    exec(environments, names)
    assert names["truncated"]
    assert names["info"]["loss"] < 0.3
    assert names["envs"].num_envs == 8


def test_every_page_with_code_is_run_by_a_test():
    """The names of pages in this folder's tests are the list of what is run."""
    tests = "".join(
        path.read_text(encoding="utf-8") for path in sorted(Path(__file__).parent.glob("test_*.py"))
    )
    pages = [path for path in sorted(DOCS.glob("*.md")) if code_blocks(path)]
    assert len(pages) > 10
    assert [path.stem for path in pages if path.stem not in tests] == []


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_links_lead_somewhere(path):
    for target in re.findall(r"\]\(([^)\s]+)\)", path.read_text(encoding="utf-8")):
        if target.startswith("http"):
            continue
        name, _, anchor = target.partition("#")
        there = (path.parent / name).resolve() if name else path
        assert there.exists(), f"{target} is not there"
        if anchor:
            assert anchor in anchors(there), f"{there.name} has no heading {anchor}"


def in_package(name: str) -> Path:
    """Return where a path lies that may leave out `npa_envs/`."""
    return ROOT / name if (ROOT / name).exists() else ROOT / "npa_envs" / name


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_paths_in_code_exist(path):
    text = path.read_text(encoding="utf-8")
    named = re.findall(rf"`((?:{FOLDERS})/[\w./]*|\w+/[\w/]*\.(?:py|cuh))`", text)
    gone = [name for name in named if "NAME" not in name and not in_package(name).exists()]
    assert gone == []


def test_the_map_names_what_is_there():
    """Of the drawings' lines, of the way of `eps`, and of "`name` in `file`"."""
    text = MAP.read_text(encoding="utf-8")
    trail = re.findall(r"((?:npa_envs|envs)/[\w/]+\.py): ([\w.]+)", text)
    assert len(trail) == 8
    drawn = re.findall(r"((?:world|ops|rule|envs/core)/\w+\.py) +([A-Za-z_]\w*(?:\.\w+)?) ", text)
    assert len(drawn) > 10
    told = [pair[::-1] for pair in re.findall(r"`([\w.]+)` (?:in|of) `([\w/]+\.py)`", text)]
    for file, names in re.findall(r"`([\w/]+\.py)` \((`[\w`, ]+)\)", text):
        told += [(file, name) for name in re.findall(r"\w+", names)]
    assert len(told) > 20
    for file, name in [*trail, *drawn, *told]:
        for part in name.split("."):
            defined = rf"^ *(?:def|class) {part}\b|^ *{part}\b(?:: .*)? = |^    {part}:"
            there = re.search(defined, in_package(file).read_text(encoding="utf-8"), re.MULTILINE)
            assert there, f"{file} has no {name}"


def test_the_page_on_what_is_measured_shows_the_backend_table():
    chosen = describe(KernelRequest(torch.device("cpu"), torch.float32))
    assert "\n".join(f"  {line}" for line in chosen) in (DOCS / "measured.md").read_text(
        encoding="utf-8"
    )


def test_the_index_leads_to_every_page():
    links = re.findall(r"\]\(([^)#]+)", (DOCS / "index.md").read_text(encoding="utf-8"))
    linked = {(DOCS / name).resolve() for name in links}
    pages = {*DOCS.glob("*.md"), DOCS / "environments" / "README.md"}
    assert pages - {DOCS / "index.md"} <= linked


# Pages of PettingZoo's environments.

MODULES = {"MultiSpecies": multispecies_v0, "Particles": particles_v0}
every_page = pytest.mark.parametrize("name", MODULES)


def page_of(name: str) -> Path:
    return DOCS / "environments" / f"{name}.md"


@every_page
def test_the_examples_of_a_page_run(name, capsys):
    names = {}
    for block in code_blocks(page_of(name)):
        # Small and short worlds: what is tested is that the calls are right.
        few = "particle_count=40, max_cycles=4)"
        small_block = re.sub(r"species_count=2\)", f"species_count=2, {few}", block)
        small_block = re.sub(r"max_cycles=200\)", few, small_block)
        assert small_block.count(few) == 1
        exec(small_block, names)
    assert names["env"].agents == []
    agent = names["env"].possible_agents[-1]
    assert names["infos"][agent]["reason"] == "time limit"
    if name == "MultiSpecies":
        assert re.fullmatch(
            r"\{'species_0': [\d.]+, 'species_1': [\d.]+\}\n", capsys.readouterr().out
        )


def test_the_page_lists_the_arguments_of_every_task_with_their_defaults():
    shared, *own = section(page_of("MultiSpecies"), "Arguments").split("\nOf `")
    tables = {part.split('"')[1]: part for part in own}
    for task, task_type in TABLE.items():
        listed = inline(shared)
        for line in (shared + tables.get(task, "")).splitlines():
            if line.startswith("| `"):
                listed[first_cells(line)[0]] = line.split(" | ")[2].strip("`")
        config = task_type.config_type()
        assert listed == {name: literal(value) for name, value in vars(config).items()}


@every_page
@pytest.mark.parametrize("task", TASKS)
def test_a_page_names_the_keys_of_info_and_the_parts_of_the_loss(name, task):
    env = MODULES[name].parallel_env(**small_crowd(task, particle_count=8, max_cycles=1))
    _, at_reset = env.reset(seed=0)
    *_, at_step = env.step(still(env))
    agent = env.possible_agents[0]
    (row,) = [
        line for line in section(page_of(name), "Reward").splitlines() if f"| {task} |" in line
    ]
    parts = re.findall(r"`(\w+)`", row.split(" | ")[-1])
    assert set(at_reset[agent]) == {"species", "loss", *(f"loss_{part}" for part in parts)}
    gained = {f"reward_{part}" for part in parts}
    assert set(at_step[agent]) == set(at_reset[agent]) | gained | {"reason"}
    assert {"species", "loss", "reason"} <= set(first_cells(section(page_of(name), "Info")))


@every_page
def test_a_page_tells_spaces_and_agents_as_they_are(name):
    env = MODULES[name].parallel_env()
    head = page_of(name).read_text(encoding="utf-8").split("```")[0]
    for shown in (
        f"`{env.possible_agents[0]}` to `{env.possible_agents[-1]}`",
        f"`{env.observation_space(env.possible_agents[0])}`",
        f"`{env.action_space(env.possible_agents[0])}`",
        f"shape {env.state_space.shape}",
        f"| {env.max_cycles} |",
    ):
        assert shown in head


@every_page
def test_the_page_lists_tasks_with_their_ids(name):
    rows = re.findall(
        r'^\| `"(\w+)"` \| `([^`]+)` \|', page_of(name).read_text(encoding="utf-8"), re.MULTILINE
    )
    assert {id_: task for task, id_ in rows} == MODULES[name].ENVIRONMENTS


def test_the_page_tells_how_episodes_end():
    listed = re.findall(
        r'`"([^`"]+)"` \|$', section(page_of("MultiSpecies"), "Episode end"), re.MULTILINE
    )
    reasons = set()
    for task, keywords in (("invasion", {"deaths": ((1, 1),)}), ("mixing", {"max_cycles": 1})):
        env = multispecies_v0.parallel_env(**small_crowd(task, **keywords))
        env.reset(seed=0)
        reasons |= {info["reason"] for info in env.step(still(env))[-1].values()}
    env = multispecies_v0.parallel_env(**small_crowd("mixing", particle_counts=(1, 1)))
    env.reset(seed=0)
    env.place_particles(np.full((2, 2), 4.0), np.zeros((2, 16)))
    reasons |= {info["reason"] for info in env.step(still(env))[-1].values()}
    assert set(listed) == reasons
