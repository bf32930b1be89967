"""`npa-envs train` with `--processes` and `--resume auto`: what is decided before a start."""

import json

import pytest
import torch
from support.circle_task import circle_config
from support.training_runs import trainer_of

from npa_envs.cli import main
from npa_envs.cli.common import first_options, resolve_run, torch_threads
from npa_envs.cli.train import TrainOptions, parse_run, process_count, thread_count
from npa_envs.errors import NPAError
from npa_envs.training import RunFolder, config_to_dict, preset
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
