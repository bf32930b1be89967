"""The command line does what it says, says what it did, and refuses mistakes in one line."""

import errno
import json
import os
import re
import sys
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from support.processes import run_alone

import npa_envs
from npa_envs import registration
from npa_envs.cli import COMMANDS, common, demo, doctor, main
from npa_envs.cli.train import announcement, parse_run, starting_configuration
from npa_envs.errors import NPAError
from npa_envs.render.world_film import WorldFilm
from npa_envs.rule.files import load_rule, save_rule, shipped_rules
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.targets.notes import left_out
from npa_envs.training import TASKS, preset
from npa_envs.world.particles import Particles

TINY = ["morphogenesis2d", "--preset", "tiny", "--no-report", "--iterations", "6", "--no-progress"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """The folder of a run of six iterations."""
    folder = tmp_path_factory.mktemp("runs") / "ring"
    assert main(["train", *TINY, "--milestones", "--out", str(folder)]) == 0
    return folder


def code_of(words):
    """Return the exit code of a command, also if the parser of its options ends it."""
    try:
        return main(words)
    except SystemExit as end:
        return end.code


def error_of(capsys, words):
    """Run a command that must be refused, and return its message of one line."""
    assert code_of(words) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert error.startswith("npa-envs: error: ")
    return error


def raising(error):
    def fail(*_, **__):
        raise error

    return fail


@pytest.fixture
def rule(trained):
    return str(trained / "rule.safetensors")


def help_of(capsys, *words):
    """Ask for help, and return it without colours."""
    assert code_of(words) == 0
    return re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out)


@pytest.mark.parametrize("name", [*COMMANDS, *(f"train {task}" for task in TASKS)])
def test_every_command_explains_itself_and_shows_examples_of_its_options(name, capsys):
    assert f"\n  {name.split()[0]} " in help_of(capsys, "--help")
    text = help_of(capsys, *name.split(), "--help")
    assert f"usage: npa-envs {name}" in text
    assert "{None}" not in text
    examples = re.findall(rf"^  npa-envs {name}(.*)$", text, re.MULTILINE)
    assert examples or name in ("train", "doctor")
    for option in re.findall("--[a-z-]+", "".join(examples)):
        # Once more, among the options.
        assert re.search(rf"{option}[ ,\n]", text.partition(f"{examples[-1]}\n")[2])


def test_help_of_train_shows_the_most_used_options_and_help_all_all_of_them(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    counts = []
    for word in ("--help", "--help-all"):
        text = help_of(capsys, "train", "morphogenesis2d", word)
        # Their explanations stand further to the right.
        counts.append(len(set(re.findall(r"^[ │|]{1,3}(--[a-z][a-z-]+)", text, re.MULTILINE))))
        assert ("--splat-weight" in text) == (word == "--help-all")
    assert "--help-all" not in text.partition("Examples")[0]
    assert counts == [25, 76]
    assert "--wound-weight" not in text
    first = common.first_options(["--wound-weight", "0.5", "--max-age-range", "16", "64"])
    assert parse_run("morphogenesis2d", first)[1].wound_weight == 0.5
    text = help_of(capsys, "train", "texture", "--help")
    for option in ("preset", "target", "iterations", "device", "out", "config", "resume"):
        assert len(re.findall(rf"^[ │|]{{1,3}}--{option}[ ,]", text, re.MULTILINE)) == 1
    assert "default: dots" in text


def test_no_command_is_a_usage_error_and_the_version_is_that_of_the_package(capsys):
    assert main([]) == 2
    assert "usage: npa-envs COMMAND" in capsys.readouterr().out
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"npa-envs {npa_envs.__version__}\n"


@pytest.mark.parametrize(
    ("words", "message"),
    {
        "rollout gecko --steps abc": "--steps must be a whole number, got 'abc'",
        "rollout gecko --particle-count 1.5": "--particle-count must be a whole number, got '1.5'",
        "rollout gecko --eps abc": "--eps must be a number, got 'abc'",
        "train morphogenesis2d --steps a b": "--steps cannot be 'a', 'b'",
        "train texture --target": "--target needs a value",
        "train texture --optimiser foo": "--optimiser must be one of 'adamw', 'muon', got 'foo'",
        "rollout gecko heart": "Unrecognized options: heart",
        "rollout": "RULE is missing",
    }.items(),
)  # fmt: skip
def test_values_that_cannot_be_read_are_refused_in_a_line(words, message, capsys):
    assert f"error: {message}: see npa-envs {words.split()[0]}" in error_of(capsys, words.split())


def test_list_names_tasks_presets_targets_and_losses(capsys):
    assert main(["list"]) == 0
    text = capsys.readouterr().out
    words = ["morphogenesis2d", "paper", "fast", "tiny", "gecko", "butterfly", "texture:"]
    words += ["vgg_ot", "joint_swd", "npa/Regeneration2D-v0", "npa/Mixing-v0"]
    words += ["npa/InvasionLarge-v0", "morphogenesis3d: doughnut, duck, mushroom, rocket"]
    words += ["bubbles, cells, dots, droplets, grid, hearts, maze, stars"]
    assert [word for word in words if word not in text] == []
    assert max(map(len, text.splitlines())) <= 130
    parts = {}
    for part in ("rules", "targets", "ids", "presets"):
        assert main(["list", part]) == 0
        parts[part] = capsys.readouterr().out
    hint = "one part: npa-envs list rules|targets|ids|presets\n"
    assert "\n".join([hint, *parts.values(), hint]) == text
    ids = re.findall(r"^  (npa/\S+) +\d+  \S", parts["ids"], re.MULTILINE)
    named = [entry.id for entry in (*registration.ALL, *registration.SPECIES_SIZES)]
    assert sorted(ids) == sorted([*named, *registration.SPECIES])
    for name in shipped_rules():
        assert len(re.findall(rf"^    {name} +\d+ weights  \d", parts["rules"], re.MULTILINE)) == 1
    assert "seven-pictures" in parts["rules"]


def test_doctor_reports_what_there_is_and_goes_on_where_a_check_breaks(capsys, monkeypatch):
    code = main(["doctor"])
    text = capsys.readouterr().out
    assert code == (1 if re.search("^!", text, re.MULTILINE) else 0)
    assert re.search(rf"^  torch +{re.escape(metadata.version('torch'))}$", text, re.MULTILINE)
    for subject in ("kernel cache", "ffmpeg", "warp devices"):
        assert re.search(rf"^  {subject} +\S", text, re.MULTILINE)
    monkeypatch.setattr("npa_envs.runtime.warp_devices", raising(OSError("no driver")))
    assert main(["doctor"]) == 1
    text = capsys.readouterr().out
    assert re.search(r"^! warp devices +OSError: no driver$", text, re.MULTILINE)
    assert "ffmpeg" in text
    done = run_alone(WITHOUT_EXTRAS)
    assert done.returncode == 1, done.stderr
    assert re.search(rf"^  tyro +{re.escape(metadata.version('tyro'))}$", done.stdout, re.MULTILINE)
    assert re.search(r"^! ffmpeg +not found", done.stdout, re.MULTILINE)


WITHOUT_EXTRAS = """
import sys
for name in ("tyro", "tqdm", "torch", "warp", "imageio_ffmpeg", "PIL"):
    sys.modules[name] = None
from npa_envs.cli import main
sys.exit(main(["doctor"]))
"""


def test_the_command_line_works_without_utf8():
    program = "from npa_envs.cli import main\nmain(['list', 'presets'])\n"
    program += "main(['train', 'texture', '--help'])"
    done = run_alone(program, PYTHONUTF8="0", LC_ALL="C")
    assert done.returncode == 0, done.stderr
    assert "Perception radius ? [length units]" in done.stdout
    assert "iterations ? worlds" in done.stdout


def test_doctor_finds_packages_that_are_missing_or_old(monkeypatch):
    lines = ["torch>=999", "numpy>=1.26", "nosuchpackage>=1.0"]
    lines += ['pettingzoo>=1.25; extra == "envs"', 'npa-envs[envs,view]; extra == "all"']
    lines += ['nosuchpackage[server]>=1.0; extra == "view"']
    monkeypatch.setattr(doctor.importlib.metadata, "requires", lambda _: lines)
    found = {row.subject: row for row in doctor._packages()}
    marks = {"npa-envs": " ", "torch": "!", "numpy": " ", "nosuchpackage": "!", "[view]": "-"}
    assert {name: row.mark for name, row in found.items() if name != "[envs]"} == marks
    assert found["torch"].text.endswith("is older than 999")
    assert found["nosuchpackage"].fix == "pip install -U 'nosuchpackage>=1.0'"
    assert found["[view]"].fix == "pip install 'npa-envs[view]', in a clone '.[view]'"


@pytest.mark.parametrize(
    ("built", "cards", "hidden", "mark", "cure"),
    [
        (None, "", None, "-", "presets fast and tiny"),
        (None, "A100, 580.65.06", None, "!", "its CUDA build"),
        ("12.8", "A100, 550.54.15", "", "!", "unset CUDA_VISIBLE_DEVICES"),
        ("13.0", "A100, 580.65.06", None, "!", "newer driver"),
    ],
)
def test_doctor_says_why_no_card_is_used(built, cards, hidden, mark, cure, monkeypatch, tmp_path):
    program = tmp_path / "nvidia-smi"
    says = f"echo '{cards}'" if cards else "exit 9"
    program.write_text(f"#!/bin/sh\n{says}\n", encoding="utf-8")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    if hidden is not None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", hidden)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.version, "cuda", built)
    *_, finding = doctor._torch_devices()
    assert finding.mark == mark
    assert cure in finding.fix
    assert ("A100 is idle" in finding.text) == bool(cards)


def test_doctor_names_old_cards_idle_cores_cold_caches_and_what_is_not_there(monkeypatch, tmp_path):
    card = SimpleNamespace(name="GTX 1080", total_memory=8 * 2**30, major=6, minor=1)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda _: card)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    monkeypatch.setattr(os, "cpu_count", lambda: 16)
    monkeypatch.setattr("npa_envs.runtime.kernel_cache_folder", lambda: tmp_path)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert next(doctor._torch_devices()).text == "threads: 1, cores: 16"
    lines = [*doctor._torch_devices(), *doctor._kernel_cache(), *doctor._films_and_screen()]
    fixes = ["OMP_NUM_THREADS", "8.0", "npa-envs warmup", "pip install -U 'imageio", "ssh -L"]
    for line, mark, fix in zip(lines, "---!-", fixes, strict=True):
        assert (line.mark, fix in line.fix) == (mark, True)
    (tmp_path / "wp_npa_envs.kernels.cpu").mkdir()
    assert [row.mark for row in doctor._kernel_cache()] == [" "]


def test_train_says_what_it_learns_and_writes_a_rule_that_loads(tmp_path, capsys):
    folder = tmp_path / "run"
    words = ["train", *TINY[:-3], "--iterations", "10", "--milestones", "3", "5", "--no-progress"]
    assert main([*words, "--target", "heart", "--out", str(folder)]) == 0
    text = capsys.readouterr().out
    learns, size, where = text.splitlines()[:3]
    assert learns == "morphogenesis2d: learns heart (preset tiny)"
    assert size.startswith("10 iterations, each of 2 worlds of 128 particles, on cpu: about 1 s")
    assert where.startswith(f"writing to {folder}/")
    assert "finished: 10 iterations" in text
    for name in ("rule.safetensors", "log.jsonl", "pictures"):
        assert str(folder / name) in text
        assert (folder / name).exists()
    config = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    assert (config["iterations"], config["milestones"]) == (10, [3, 5])
    assert config["task"]["target"] == "heart"
    assert load_rule(folder / "rule.safetensors").hidden_dim == config["task"]["hidden_dim"]
    # The tiny preset has its first picture after 20 iterations.
    with Image.open(folder / "pictures" / "000010.png") as picture:
        target = np.asarray(picture)[8:264, 8:264].astype(int)
    assert (target[..., 0] > target[..., 2] + 50).mean() > 0.1


@pytest.mark.parametrize(
    ("words", "name"),
    [
        ("morphogenesis2d", "fast"),
        ("morphogenesis2d --device cuda", "best"),
        ("texture --device cuda", "best"),
        ("co_morphogenesis2d --device cuda:1", "best"),
        ("morphogenesis3d --device cuda:1", "best"),
        ("point_classification --device cuda", "fast"),
        ("morphogenesis2d --device cuda --preset fast", "fast"),
    ],
)
def test_runs_that_name_no_preset_take_the_best_one_on_cuda_and_the_fast_one_elsewhere(words, name):
    task, *rest = words.split()
    first = common.first_options(rest)
    assert starting_configuration(task, first) == preset(name, task)
    options, config = parse_run(task, first)
    line = announcement(task, options, config, words.split())[0]
    assert line.endswith(f"(preset {name})")
    assert ("no --target" in line) is (task != "point_classification")
    assert "no --target" not in announcement(task, options, config, ["--targets=a"])[0]


def test_a_configuration_file_goes_over_the_preset_and_options_over_the_file(tmp_path, capsys):
    path = tmp_path / "run.yaml"
    path.write_text("preset: tiny\nlearning_rate: 0.125\nparticle_count: 77\nseed: 5\n", "utf-8")
    words = ["--config", str(path)]
    first = common.first_options([*words, "--seed", "6", "--eps", "0.25"])
    config = parse_run("morphogenesis2d", first)[1]
    assert (config.iterations, config.learning_rate, config.seed) == (40, 0.125, 6)
    assert (config.task.particle_count, config.task.eps) == (77, 0.25)
    first = common.first_options([*words, "--preset", "fast"])
    config = starting_configuration("morphogenesis2d", first)
    assert (config.iterations, config.seed) == (preset("fast").iterations, 5)
    path.write_text("preset: tinny\n", encoding="utf-8")
    assert "did you mean 'tiny'" in error_of(capsys, ["train", "morphogenesis2d", *words])


def test_train_refuses_before_it_says_where_it_writes(trained, tmp_path, capsys):
    before = (trained / "rule.safetensors").read_bytes()
    words = ["train", *TINY, "--milestones", "--out"]
    for given, message in (
        ([*words, str(trained)], r"holds one: resume it \(--resume\), .*it \(--overwrite\)"),
        ([*words, str(trained), "--resume", "--overwrite"], "resume and overwrite exclude"),
        ([*words, str(tmp_path / "out"), "--target", "/nowhere.png"], r"nowhere\.png"),
        (["train", "texture", "--resume", "--out", str(trained)], "'morphogenesis2d', not of 'tex"),
    ):
        assert main(given) == 2
        said = capsys.readouterr()
        assert said.out == ""
        assert re.search(message, said.err)
    assert (trained / "rule.safetensors").read_bytes() == before


@pytest.mark.parametrize("command", ["rollout", "evaluate"])
def test_the_folder_of_a_run_stands_for_its_rule(command, trained, tmp_path):
    words = [command, str(trained), "--no-progress"]
    own = {"rollout": ["--steps", "1", "--out", str(tmp_path)], "evaluate": ["--checkpoints", "1"]}
    assert main([*words, *own[command]]) == 0


MISTAKES = [
    ("demoo", "unknown command 'demoo': did you mean 'demo'?"),
    ("warmup --space-dims 4", "2, 3 or both"),
    ("warmup --device cuda:99", "device must"),
    ("train", "needs a task first"),
    ("train gecko", "npa-envs train morphogenesis2d --target gecko"),
    ("train duck", "npa-envs train morphogenesis3d --target duck"),
    ("learn npa/Texture-v0", "npa-envs learn ppo npa/Texture-v0"),
    ("list rule", "unknown part 'rule': did you mean 'rules'?"),
    ("demo --target hart --out OUT", "did you mean 'heart'?"),
    ("rollout gecko --damage cut:300", "for example 300:cut"),
    ("train --preset tiny", "needs a task first"),
    ("train morphogenesis", "unknown task 'morphogenesis': did you mean 'morphogenesis2d'"),
    ("train morphogenesis2d --preset papr", "unknown preset 'papr'"),
    ("train morphogenesis2d --preset", "expected one argument"),
    ("train morphogenesis2d --resume --out /nowhere", "no checkpoint to resume from"),
    ("train morphogenesis2d --config /nowhere.yaml", "cannot read the configuration file"),
    ("train TINY --out OUT --max-seconds -1", "--max-seconds must be positive"),
    ("rollout nosuchrule --out OUT", "unknown rule 'nosuchrule'"),
    ("rollout grid --out OUT", "grid is a target, and no rule for it is shipped: train one"),
    ("rollout RULE --out OUT --damage 5", "STEP:KIND"),
    ("rollout RULE --out OUT --steps 20 --damage 20:cut", "before the last of 20 steps"),
    ("rollout RULE --out OUT --target nosuchtarget", "nosuchtarget"),
    ("rollout RULE --out OUT --eps -1", "eps must be"),
    ("rollout RULE --out FILE/inside", "out must be a folder"),
    ("rollout 3D --out OUT", "got space_dim=3"),
    ("evaluate UNTOLD --no-progress", "give --target"),
    ("robustness hart", "unknown rule 'hart': did you mean 'heart'"),
    ("robustness --seed-count 0", "--seed-count must be at least 1, got 0: try 1"),
    ("robustness --max-seconds 0", "--max-seconds must be positive, got 0"),
    ("stress --only tim", "unknown check 'tim'"),
    ("stress --threads 0", "threads must be at least 1, got 0"),
    ("train JOINT --targets ring", "targets must be two or more, got 1"),
    ("rollout digits --style points", "for clouds that never move"),
    ("train TINY --iterations 0", "--iterations must be a whole number of at least 1, got 0: for"),
    ("train TINY --alpha=-2", "--alpha must be a finite number greater than 0, got -2.0: for"),
    ("evaluate gecko --steps 9", "unknown option '--steps': did you mean '--checkpoints'?"),
    ("train TINY --iters 3", "unknown option '--iters': did you mean '--iterations'?"),
    ("train TINY --particles=3", "unknown option '--particles=3': did you mean '--particle-count'"),
    ("rollout gecko --fps 51", "fps must be in [0.1, 50], got 51"),
    ("rollout gecko --background mauvish", "background must be"),
    ("rollout gecko --seed -1", "seed must be in [0, 2^63), got -1"),
    ("rollout gecko --seed 9223372036854775808", "seed must be in"),
]


def test_cures_name_what_the_shell_and_python_have_in_common(trained, capsys, monkeypatch):
    words = ["train", *TINY, "--milestones", "--resume", "--out", str(trained)]
    cure = f"a new run in another folder, with the initial rule '{trained}'"
    assert cure in error_of(capsys, [*words, "--iterations", "9"])
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    message = error_of(capsys, ["evaluate", "gecko", "--device", "cuda"])
    assert "sees 0 CUDA devices: use 'cpu', or see" in message


@pytest.mark.parametrize(("words", "message"), MISTAKES)
def test_a_mistake_is_refused_and_nothing_is_written(
    words, message, rule, tmp_path, capsys, monkeypatch
):
    names = {"OUT": tmp_path / "out", "FILE/inside": tmp_path / "file/a", "RULE": rule}
    names |= {"3D": tmp_path / "3d.safetensors", "UNTOLD": tmp_path / "untold.safetensors"}
    monkeypatch.chdir(tmp_path)
    # A task is one also where a file has its name.
    for name in ("file", "morphogenesis2d"):
        (tmp_path / name).touch()
    save_rule(NPARule(3, 8, 16), names["3D"])
    save_rule(NPARule(2, 8, 16, eps0=0.2), names["UNTOLD"])
    options = " ".join([*TINY[1:], "--milestones"])
    words = words.replace("TINY", f"{TINY[0]} {options}")
    words = words.replace("JOINT", f"co_morphogenesis2d {options}")
    given = [str(names.get(word, word)) for word in words.split()]
    assert message in error_of(capsys, given)
    assert not list(tmp_path.rglob("growth.gif"))


def test_rollout_writes_films_that_open(tmp_path, rule, capsys):
    out = tmp_path / "a" / "film"
    words = ["rollout", rule, "--steps", "20", "--every", "5", "--damage", "0:cut", "8:cut"]
    words += ["--damage", "10:wipe:0.3", "10:clump", "--out", str(out), "--no-progress"]
    assert main(words) == 0
    text = capsys.readouterr().out
    assert re.search(r"step 20: loss \d+\.\d+, PSNR +\d+\.\d+ dB", text)
    with Image.open(out / "growth.gif") as film:
        # The rule was trained at 32 pixels.
        assert film.size == (256, 256)
        # 0, cut, 5, 8, cut, 10, wipe, clump, 15, 20
        assert getattr(film, "n_frames", 1) == 10
    assert (out / "growth.mp4").stat().st_size > 500
    with Image.open(out / "growth-filmstrip.png") as strip:
        assert strip.width == 7 * (256 + 8) + 8
    for name in ("growth.gif", "growth.mp4", "growth-filmstrip.png"):
        assert f"wrote {out / name}" in text


def test_commands_say_once_what_was_read_of_a_target_and_what_was_not(tmp_path, rule, capsys):
    left_out.cache_clear()
    frames = [Image.new("RGBA", (40, 40)) for _ in range(2)]
    for frame in frames:
        frame.paste((200, 30, 30, 255), (10, 10, 30, 30))
    frames[1].putpixel((0, 0), (0, 0, 0, 255))
    path = tmp_path / "red.png"
    frames[0].save(path, save_all=True, append_images=frames[1:])
    for words in (["rollout", rule, "--steps", "2", "--out", str(tmp_path)], ["evaluate", rule]):
        options = ["--seed-count", "1", "--checkpoints", "2"] if words[0] == "evaluate" else []
        assert main([*words, *options, "--target", str(path), "--no-progress"]) == 0
        said = capsys.readouterr()
        assert said.out.startswith("red.png: 40 x 40, cut out by alpha, 25 % of its pixels\n")
        assert said.out.count("red.png") == 1
        told = f"{path}: left out: all its frames, pages or pictures but the first\n"
        # The second command runs in the same process.
        assert said.err == (told if words[0] == "rollout" else "")


def test_rollout_repeats_itself_and_makes_about_150_frames(tmp_path, rule):
    words = ["rollout", rule, "--resolution", "16", "--no-progress", "--damage", "6:wipe"]
    films = []
    for steps, seed in ((12, 0), (12, 0), (12, 1), (299, 0)):
        given = [*words, "--steps", str(steps), "--seed", str(seed)]
        assert main([*given, "--out", str(tmp_path)]) == 0
        films.append((tmp_path / "growth.gif").read_bytes())
    assert films[0] == films[1] != films[2]
    with Image.open(tmp_path / "growth.gif") as film:
        # One every second step, the last one, and one after the damage.
        assert (film.size, film.n_frames) == ((16, 16), 152)


def test_films_of_another_rule_go_to_another_folder_by_default(tmp_path, rule, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for source in (rule, "gecko"):
        assert main(["rollout", source, "--steps", "2", "--resolution", "16", "--no-progress"]) == 0
    films = {path.parent.name for path in tmp_path.glob("runs/rollout/*/growth.gif")}
    assert films == {"ring", "gecko"}


def test_a_film_has_the_style_and_the_background_that_were_asked_for(tmp_path, rule, capsys):
    words = ["rollout", rule, "--steps", "8", "--every", "4", "--no-progress"]
    large = ["--resolution", "96", "--background", "#102030"]
    figures, bare = {}, {}
    for style in ("splats", "points"):
        out = tmp_path / style
        assert main([*words, *large, "--style", style, "--out", str(out)]) == 0
        figures[style] = capsys.readouterr().out.splitlines()[0]
        with Image.open(out / "growth.gif") as film:
            film.seek(film.n_frames - 1)
            pixels = np.asarray(film.convert("RGB")).astype(int)
        assert pixels.shape == (96, 96, 3)
        bare[style] = np.abs(pixels - (16, 32, 48)).max(axis=-1) < 12
    # Figures are those of the trained resolution.
    assert main([*words, "--out", str(tmp_path)]) == 0
    assert {capsys.readouterr().out.splitlines()[0]} == set(figures.values())
    assert bare["splats"][0, 0]
    assert (~bare["points"]).mean() < 0.7 * (~bare["splats"]).mean()
    with Image.open(tmp_path / "points" / "growth-filmstrip.png") as strip:
        assert strip.getpixel((0, 0)) == (16, 32, 48)


@pytest.mark.parametrize(
    ("steps", "every", "damages", "shown"),
    [
        (400, 2, {200, 300}, ["0", "16", "32", "64", "128", "200!", "250", "300!", "350", "400"]),
        (512, 4, set(), ["0", "16", "32", "64", "128", "176", "224", "320", "416", "512"]),
        (130, 50, {60}, ["0", "50", "60", "60!", "100", "130"]),
        (70, 10, set(), ["0", "10", "20", "30", "40", "50", "60", "70"]),
    ],
)
def test_filmstrip_shows_growth_damage_and_the_end(steps, every, damages, shown):
    film = WorldFilm()
    task = SimpleNamespace(picture=lambda *_: torch.zeros(1, 4, 4, 4))
    worlds = Particles(torch.zeros(1, 1, 2), torch.zeros(1, 1, 2))
    for step in sorted({*range(0, steps, every), *damages, steps}):
        film.add(task, worlds, step)
        if step in damages:
            film.add(task, worlds, step, "!")
    frames, captions = film.filmstrip()
    assert captions == [f"step {caption.replace('!', ': !')}" for caption in shown]
    assert len(frames) == len(shown)


@pytest.mark.parametrize("config", ["{", "null", "[]", '{"colour": 3}', '{"state_dim": "many"}'])
def test_a_rule_with_damaged_metadata_is_refused(config, tmp_path, capsys):
    path = tmp_path / "damaged.safetensors"
    save_rule(NPARule(), path, metadata={"task": "morphogenesis2d", "config": config})
    assert main(["evaluate", str(path), "--checkpoints", "1", "--no-progress"]) == 2
    assert f"the metadata of '{path}'" in capsys.readouterr().err


def test_a_rule_without_a_target_grows_without_figures(tmp_path, capsys):
    picture = tmp_path / "square.png"
    pixels = np.zeros((16, 16, 4), dtype=np.uint8)
    pixels[4:12, 4:12] = (200, 30, 30, 255)
    Image.fromarray(pixels).save(picture)
    words = ["train", *TINY, "--milestones", "--target", str(picture), "--out"]
    assert main([*words, str(tmp_path / "run")]) == 0
    picture.unlink()
    rule, plain = str(tmp_path / "run" / "rule.safetensors"), str(tmp_path / "plain.safetensors")
    save_rule(NPARule(2, 8, 16, eps0=0.2), plain)
    words = ["--steps", "2", "--particle-count", "100", "--no-progress", "--out", str(tmp_path)]
    for source, doubt in ((rule, "target cannot be loaded"), (plain, "not say what it grows")):
        assert main(["rollout", source, *words]) == 0
        text = capsys.readouterr().out
        assert doubt in text
        assert "PSNR" not in text
        with Image.open(tmp_path / "growth.gif") as film:
            assert np.asarray(film.convert("RGB")).min() < 250
    assert "square.png" in error_of(capsys, ["evaluate", rule, "--no-progress"])
    assert main(["rollout", rule, *words, "--target", "ring"]) == 0
    assert "PSNR" in capsys.readouterr().out


def test_a_message_becomes_one_line_and_an_interruption_has_no_traceback(monkeypatch, capsys):
    monkeypatch.setattr("npa_envs.cli.list.main", raising(NPAError("x must be\n  positive")))
    assert error_of(capsys, ["list"]) == "npa-envs: error: x must be positive\n"
    for number, hint in ((errno.ENOSPC, "free some space"), (errno.EACCES, "another folder")):
        monkeypatch.setattr("npa_envs.cli.list.main", raising(OSError(number, "no", "a.txt")))
        message = error_of(capsys, ["list"])
        assert message.startswith("npa-envs: error: no 'a.txt': ")
        assert hint in message
    monkeypatch.setattr("npa_envs.cli.list.main", raising(KeyboardInterrupt))
    assert main(["list"]) == 130
    assert capsys.readouterr().err == "npa-envs: interrupted\n"


def test_demo_shows_growth_healing_and_training(tmp_path, monkeypatch, capsys):
    # A world that has hardly begun to grow: a frame for the seed, each step and each wound.
    monkeypatch.setattr(demo, "GROWING", ((4, 1),))
    monkeypatch.setattr(demo, "HEALING", ((4, 2),))
    monkeypatch.setattr(demo, "SIDE", 256)
    words = ["demo", "--out", str(tmp_path), "--train-seconds", "1", "--no-progress"]
    assert main(words) == 0
    text = capsys.readouterr().out
    assert len(re.findall(r"PSNR +\d+\.\d+ dB", text)) == 2
    times = r"rises to \d+\.\d times that before, then falls to \d+\.\d times"
    for wound in ("cut through the spots", "wipe of an eye"):
        verdict = r"(heals|heals but for a scar|does not heal) in 4 steps"
        assert re.search(rf"a {wound} {verdict}: .*{times}", text)
    with Image.open(tmp_path / "gecko.gif") as film:
        assert film.size == (256, 256)
        # There is no eye yet, so its wipe changes nothing, and equal frames become one.
        assert film.n_frames == 5 + (1 + 2) + 2
    assert (tmp_path / "report.txt").read_text(encoding="utf-8") in text
    written = {Path(name) for name in re.findall(r"wrote (\S+)", text)}
    assert {path.suffix for path in written} == {".gif", ".mp4", ".png", ".txt", ".safetensors"}
    assert all(path.is_file() for path in written)
