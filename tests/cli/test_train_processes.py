"""`npa-envs train` with `--gpus` and `--resume auto`: what is decided before anything starts."""

import pytest
import torch
from circle_task import circle_config
from training_runs import trainer_of

from npa_envs.cli import main
from npa_envs.cli.train import settled
from npa_envs.errors import NPAError

TASK = "morphogenesis2d"


def test_resume_auto_begins_and_later_goes_on(tmp_path):
    for words in (["--resume", "auto"], ["--resume=auto"]):
        assert settled(TASK, [*words, "--out", str(tmp_path)]) == ["--out", str(tmp_path)]
    trainer_of(circle_config(tmp_path))
    for words in (["--resume", "auto"], ["--resume=auto"]):
        chosen = settled(TASK, ["--target", "ring", *words, "--out", str(tmp_path)])
        assert chosen == ["--target", "ring", "--out", str(tmp_path), "--resume"]
    # What is plain stays as it is.
    assert settled(TASK, ["--resume", "--out", "x"]) == ["--resume", "--out", "x"]
    with pytest.raises(NPAError, match="resume"):
        settled(TASK, ["--resume", "never"])


def test_gpus_are_cuda_devices_unless_told_otherwise():
    assert settled(TASK, ["--gpus", "2"]) == ["--gpus", "2", "--device", "cuda"]
    words = ["--gpus", "2", "--device", "cpu"]
    assert settled(TASK, words) == words
    assert settled(TASK, ["--gpus", "1"]) == ["--gpus", "1"]


def test_more_gpus_than_there_are_is_refused_before_anything_starts(tmp_path, capsys):
    count = torch.cuda.device_count() + 2
    words = [
        "train",
        TASK,
        "--preset",
        "tiny",
        "--gpus",
        str(count),
        "--out",
        str(tmp_path / "run"),
    ]
    assert main(words) == 2
    said = capsys.readouterr().err
    assert f"gpus must be at most the {count - 2} CUDA devices that torch sees, got {count}" in said
    assert not (tmp_path / "run").exists()
