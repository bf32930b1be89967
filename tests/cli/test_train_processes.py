"""`npa-envs train` with processes, `--resume auto`, and several species."""

import json
import re
from dataclasses import replace

import pytest
import torch
from support.circle_task import circle_config
from support.training_runs import trainer_of

from npa_envs.cli import common, main
from npa_envs.cli.common import first_options, resolve_run, torch_threads
from npa_envs.cli.train import TrainOptions, parse_run, process_count, thread_count
from npa_envs.errors import NPAError
from npa_envs.rule.files import load_rule, rule_metadata
from npa_envs.tasks.co_morphogenesis2d import CoMorphogenesis2DConfig
from npa_envs.training import RunFolder, config_to_dict, load_config, preset, train
from npa_envs.training.checkpoint import load_checkpoint, save_checkpoint

TASK = "morphogenesis2d"
WITHOUT_AGES = {"world_count": 4, "pool_size": 30, "max_age_range": (0, 0), "stillness_weight": 0}


def resolved(words):
    return resolve_run(words, lambda first: parse_run(TASK, first)[1].out).words


def test_resume_auto_begins_and_later_goes_on(tmp_path):
    for words in (["--resume", "auto"], ["--resume=auto"]):
        assert resolved([*words, "--out", str(tmp_path)]) == ["--out", str(tmp_path)]
    trainer_of(circle_config(tmp_path))
    for words in (["--resume", "auto"], ["--resume=auto"]):
        chosen = resolved(["--target", "ring", *words, "--out", str(tmp_path)])
        assert chosen == ["--target", "ring", "--out", str(tmp_path), "--resume"]
    # What is plain stays as it is.
    assert resolved(["--resume", "--out", "x"]) == ["--resume", "--out", "x"]
    with pytest.raises(NPAError, match="resume"):
        resolved(["--resume", "never"])


@pytest.mark.parametrize(
    ("name", "fields", "threads", "expected"),
    [
        ("fast", {}, 2, 2),
        ("fast", {}, 8, 2),
        ("fast", {}, 1, 1),
        ("fast", {"device": "cuda"}, 2, 1),
        ("fast", {"world_count": 3, "pool_size": 30}, 2, 1),
        ("fast", WITHOUT_AGES, 2, 1),
        ("fast", {"iterations": 100}, 2, 1),
        ("paper", {}, 2, 1),
    ],
)
def test_two_processes_train_where_a_second_core_would_be_idle(name, fields, threads, expected):
    with torch_threads(threads):
        assert thread_count(preset(name)) == (threads if name == "paper" else 1)
        assert process_count(TASK, TrainOptions(), preset(name, **fields)) == expected
        for asked in (1, 3):
            options = TrainOptions(processes=asked)
            assert process_count(TASK, options, preset(name, **fields)) == asked


def test_a_run_that_was_begun_alone_goes_on_alone(tmp_path):
    trainer_of(circle_config(tmp_path))
    resumed = preset("fast", out=tmp_path)
    with torch_threads(2):
        assert process_count(TASK, TrainOptions(resume=True), resumed) == 1
        content = load_checkpoint(RunFolder(tmp_path).checkpoint)
        # What a run of several processes leaves: its worlds' draws follow from the iteration.
        content["random_states"] = {"schedule": content["random_states"]["schedule"]}
        save_checkpoint(RunFolder(tmp_path).checkpoint, content)
        assert process_count(TASK, TrainOptions(resume=True), resumed) == 2
        with pytest.raises(NPAError, match="no checkpoint"):
            process_count(TASK, TrainOptions(resume=True), preset("fast", out=tmp_path / "none"))


def test_a_run_goes_on_with_its_own_preset_only(tmp_path):
    words = ["--out", str(tmp_path), "--resume"]
    config = preset("fast", out=tmp_path, target="ring", iterations=9)
    (tmp_path / "checkpoint.pt").touch()
    (tmp_path / "config.json").write_text(json.dumps(config_to_dict(config)), "utf-8")

    def resumed(*more):
        return parse_run(TASK, first_options([*words, *more]))[1]

    assert resumed() == config == resumed("--preset=fast", "--iterations=9")
    with pytest.raises(NPAError, match=r"'fast' differs from it \(.*iterations: 9"):
        resumed("--preset", "fast", "--target", "iterations")
    for name in ("tiny", "best"):
        with pytest.raises(NPAError, match=f"preset must be the one .* but '{name}' differs"):
            resumed("--preset", name, "--iterations", "9")


def test_gpus_are_processes_that_have_a_gpu_each():
    cuda = preset("fast", device="cuda")
    assert process_count(TASK, TrainOptions(gpus=4), cuda) == 4
    assert resolved(["--gpus", "4"]) == ["--gpus", "4", "--device", "cuda"]
    given = ["--gpus=4", "--device", "cuda"]
    assert resolved(given) == given
    for options, config, message in (
        ({"gpus": 4}, preset("fast"), "gpus goes with device 'cuda', got 'cpu'"),
        ({"gpus": 0}, cuda, "gpus must be at least 1, got 0"),
        ({"gpus": 2, "processes": 2}, cuda, "give one of them"),
        ({"processes": 0}, preset("tiny"), "processes must be at least 1, got 0"),
    ):
        with pytest.raises(NPAError, match=message):
            process_count(TASK, TrainOptions(**options), config)


def test_more_processes_than_gpus_are_refused_before_anything_starts(tmp_path, capsys):
    count = torch.cuda.device_count() + 2
    words = ["train", TASK, "--preset", "tiny", "--device", "cuda", "--processes", str(count)]
    assert main([*words, "--out", str(tmp_path / "run")]) == 2
    rule = f"processes must be at most the {count - 2} CUDA devices that torch sees, got {count}"
    assert rule in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


# Several species: options, files, runs that stop and go on.


TINY = ["co_morphogenesis2d", "--preset", "tiny", "--no-report", "--no-progress"]
TINY += ["--iterations", "4"]


def parsed(*words):
    return parse_run("co_morphogenesis2d", common.first_options(words))[1]


def test_options_are_those_of_all_species():
    words = ("--targets", "ring", "flower", "gecko", "--distance", "0.5", "--eps", "0.25")
    config = parsed("--preset", "tiny", *words, "--seed", "3", "--particle-count", "64")
    base = preset("tiny").task
    assert config.task == CoMorphogenesis2DConfig(
        species=tuple(
            replace(base, target=target, eps=0.25, particle_count=64)
            for target in ("ring", "flower", "gecko")
        ),
        distance=0.5,
    )
    assert (config.seed, config.iterations) == (3, 40)
    assert (config.initial_rules, config.frozen) == ((), ())


def test_a_file_tells_species_apart_and_options_leave_what_they_do_not_name(tmp_path):
    path = tmp_path / "run.yaml"
    path.write_text(
        "species:\n- {particle_count: 77}\n- {alpha: 0.25, hidden_dim: 8}\n", encoding="utf-8"
    )
    # The value that the first species has must reach the second one, too.
    words = ("--preset", "tiny", "--config", str(path), "--hidden-dim", "32")
    first, second = parsed(*words).task.species
    assert (first.particle_count, first.alpha, first.hidden_dim) == (77, 0.5, 32)
    assert (second.particle_count, second.alpha, second.hidden_dim) == (128, 0.25, 32)
    assert (first.target, second.target) == ("ring", "heart")


def test_a_run_stopped_by_time_resumes_to_the_same_rules(tmp_path, capsys):
    words = ["train", *TINY, "--targets", "ring", "flower", "--milestones", "--out"]
    assert main([*words, str(tmp_path / "whole")]) == 0
    text = capsys.readouterr().out
    for name in ("rule-0.safetensors", "rule-1.safetensors"):
        assert f"rule        {tmp_path / 'whole' / name}" in text
    assert "--distances 0.8 --particle-count 256" in text
    assert main([*words, str(tmp_path / "parts"), "--max-seconds", "1e-9"]) == 0
    (command,) = re.findall(r"continue +npa-envs (train .*--resume)", capsys.readouterr().out)
    assert main([*command.split(), "--no-progress", "--no-report"]) == 0
    assert "finished: 4 iterations" in capsys.readouterr().out
    for number, target in enumerate(("ring", "flower")):
        whole, parts = (tmp_path / n / f"rule-{number}.safetensors" for n in ("whole", "parts"))
        expected, got = load_rule(whole).state_dict(), load_rule(parts).state_dict()
        assert all(torch.equal(got[name], expected[name]) for name in expected)
        assert json.loads(rule_metadata(whole)["config"])["task"]["target"] == target


def test_rules_are_gone_on_from_and_frozen_ones_stay(tmp_path):
    first, second = tmp_path / "first", tmp_path / "second"
    assert main(["train", *TINY, "--milestones", "--out", str(first)]) == 0
    paths = [str(first / f"rule-{number}.safetensors") for number in (1, 0)]
    words = ["train", *TINY, "--milestones", "--out", str(second)]
    assert main([*words, "--initial-rules", *paths, "--frozen", "0"]) == 0
    learned = [load_rule(second / f"rule-{number}.safetensors") for number in (0, 1)]
    given = [load_rule(path) for path in paths]
    assert torch.equal(learned[0].output.weight, given[0].output.weight)
    assert not torch.equal(learned[1].output.weight, given[1].output.weight)
    # What a rule passes on is the run of one rule.
    saved = json.loads(rule_metadata(second / "rule-0.safetensors")["config"])
    assert "initial_rules" not in saved
    assert preset("paper", **saved).task == preset("tiny").task
    config = load_config(second / "config.json", preset("tiny", "co_morphogenesis2d"))
    assert (config.initial_rules, config.frozen) == (tuple(paths), (0,))


def test_a_run_anew_leaves_no_rule_of_the_one_before(tmp_path):
    folder = RunFolder(tmp_path)
    kept = tmp_path / "rule-of-thumb.safetensors"
    for path in (folder.rule_of(0), folder.rule_of(2), kept):
        path.touch()
    folder.clear()
    assert list(tmp_path.iterdir()) == [kept]


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"frozen": [0]}, "frozen must name rules that were trained before"),
        ({"frozen": [2], "initial_rules": ["gecko"] * 2}, "from 0 to 1, got 2"),
        ({"frozen": [0, 1], "initial_rules": ["gecko"] * 2}, "must leave a rule that learns"),
        ({"initial_rules": ["gecko"]}, "one for each of 2 species, got 1"),
    ],
)
def test_what_cannot_be_started_from_is_refused(fields, message, tmp_path):
    config = preset("paper", "co_morphogenesis2d", **fields, out=tmp_path, pool_size=8)
    with pytest.raises(NPAError, match=message):
        train(config, "co_morphogenesis2d", progress=False)
