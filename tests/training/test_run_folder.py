"""A run's folder: killed while it is made, used by two, with damaged files in it."""

import json
import math
import os
import signal
import subprocess
import sys

import pytest
import torch
from support.circle_task import circle_config
from support.refusals import refused
from support.training_runs import Killed, KilledTask, kill, log_of, train, trainer_of

from npa_envs.atomic_files import write_text
from npa_envs.errors import NPAError
from npa_envs.training import JsonlLog, RunFolder, load_config, override
from npa_envs.training.checkpoint import load_checkpoint, save_checkpoint


def test_a_run_killed_at_its_first_checkpoint_is_resumed_with_its_configuration(
    tmp_path, monkeypatch
):
    config = circle_config(tmp_path)

    def killed_after(path, content):
        save_checkpoint(path, content)
        kill()

    monkeypatch.setattr("npa_envs.training.run_folder.save_checkpoint", killed_after)
    with pytest.raises(Killed):
        trainer_of(config)
    monkeypatch.undo()
    assert load_config(tmp_path / "config.json", circle_config("x")) == config
    assert train(config, resume=True).finished


@pytest.mark.parametrize("removals", range(6))
def test_an_overwriting_start_killed_while_it_clears_leaves_a_run_or_none(tmp_path, removals):
    config = circle_config(tmp_path)
    train(config)
    folder, left = RunFolder(tmp_path), removals

    def killing_unlink(path, missing_ok=False):
        nonlocal left
        if left == 0:
            kill()
        left -= 1
        os.unlink(path) if path.exists() else None

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pathlib.Path.unlink", killing_unlink)
        if removals < 5:
            with pytest.raises(Killed):
                folder.clear()
        else:
            folder.clear()
    # What begins next does not take up an earlier run's log.
    assert folder.checkpoint.exists() or not folder.log.exists()
    assert not folder.checkpoint.exists() or folder.config.exists()
    train(config, resume=folder.checkpoint.exists())


HOLDER = """
import fcntl, os, sys
with open(sys.argv[1] + "/.lock", "w") as lock:
    fcntl.flock(lock, fcntl.LOCK_EX)
    print("process", os.getpid(), "on a host", file=lock, flush=True)
    print("locked", flush=True)
    sys.stdin.read()
"""


def test_a_folder_that_another_process_trains_in_is_refused_until_that_is_killed(tmp_path):
    pytest.importorskip("fcntl")
    config = circle_config(tmp_path)
    trainer_of(config)
    command = [sys.executable, "-c", HOLDER, str(tmp_path)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(command, text=True, **pipes) as holder:
        assert holder.stdout.readline() == "locked\n"
        message = rf"no other run writes to, but process {holder.pid} on .* is training in"
        for options in ({"resume": True}, {"overwrite": True}, {}):
            refused(message, trainer_of, config, **options)
        holder.send_signal(signal.SIGKILL)
    # The file of the lock is still there, and of no effect.
    assert f"process {holder.pid}" in (tmp_path / ".lock").read_text(encoding="utf-8")
    assert train(config, resume=True).finished


def test_two_trainers_in_one_folder_do_not_both_run(tmp_path):
    config = circle_config(tmp_path)
    first = trainer_of(config)
    attempts = []

    def resume_meanwhile():
        refused("no other run writes to, but process", trainer_of, config, resume=True)
        attempts.append(True)

    second = trainer_of(config, KilledTask(2, end=resume_meanwhile), resume=True)
    assert second.run(progress=False).finished
    assert attempts == [True]
    refused(r"another one has written .* meanwhile: resume it", first.run, progress=False)
    assert [record["iteration"] for record in log_of(tmp_path)] == list(range(1, 7))
    # One trainer may go on with what it wrote itself.
    assert second.run(progress=False).finished


def test_what_killed_writes_left_behind_is_removed_by_the_next_start_and_nothing_else(tmp_path):
    config = circle_config(tmp_path)
    trainer_of(config)
    names = ("checkpoint.pt", "rule.safetensors", "rule-1.safetensors", "config.json", "log.jsonl")
    ours = [tmp_path / name for name in (*names, "diverged.pt", "pictures/000003.png")]
    foreign = [tmp_path / name for name in ("film.mp4", "pictures/mine.png")]
    for path in (*ours, *foreign):
        with pytest.MonkeyPatch.context() as patch:
            # A kill between writing and renaming, which no cleaning up follows.
            patch.setattr("pathlib.Path.unlink", lambda *_, **__: None)
            patch.setattr("os.replace", lambda *_: kill())
            with pytest.raises(Killed):
                write_text(path, "half")
    assert len(list(tmp_path.rglob(".*.tmp.*"))) == 9
    trainer_of(config, resume=True)
    left = sorted(path.name.split(".")[1] for path in tmp_path.rglob(".*.tmp.*"))
    assert left == ["film", "mine"]


BAD_STATE = torch.full((5056,), 255, dtype=torch.uint8)
DAMAGES = {
    "iteration": [-5, True, 1.0, None],
    "seconds": [math.nan, -1.0, True, "1", None],
    "task_name": [None],
    "rule_hyper_parameters": [None],
    "config": [None, {}, {"task": {"target": torch.zeros(2)}}],
    "rule": [None, {}, {"bias": 3}],
    "optimiser": [None, {}, {"state": 3}],
    "pool/x": [3, torch.zeros(8, 12, 3)],
    "pool": [None, {}],
    "statistics": [None],
    "random_states/schedule": [BAD_STATE, BAD_STATE[:10], BAD_STATE.float(), b"x"],
    "random_states": [None, {}],
}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("finished")
    train(circle_config(folder))
    return folder


@pytest.fixture
def resumed(finished, monkeypatch):
    """A function that resumes the finished run from another content of its checkpoint."""

    def resume(content, message):
        monkeypatch.setattr("npa_envs.training.run_folder.load_checkpoint", lambda _: content)
        before = {path: path.read_bytes() for path in finished.iterdir() if path.is_file()}
        refused(message, trainer_of, circle_config(finished, log_interval=2), resume=True)
        del before[finished / ".lock"]
        assert all(path.read_bytes() == data for path, data in before.items())

    return resume


@pytest.mark.parametrize("place", DAMAGES)
def test_a_checkpoint_with_something_wrong_in_it_is_refused(finished, resumed, place):
    for value in DAMAGES[place]:
        content = load_checkpoint(finished / "checkpoint.pt")
        *outer, last = place.split("/")
        inner = content[outer[0]] if outer else content
        inner[last] = value
        resumed(content, r"checkpoint\.pt' must hold all that a run needs, but .*: start a")
        del inner[last]
        resumed(content, r"checkpoint\.pt' must hold all that a run needs, but .*: start a")


@pytest.mark.parametrize(
    "line",
    [
        '{"iteration": 2, "lo',
        "x" * 1000,
        "[" * 100_000,
        '{"iteration": ' + "9" * 5000 + "}",
        '{"iteration": "2", "loss": 1.0}',
        '{"iteration": true}',
        '{"iteration": 2, "loss": NaN}',
        '{"iteration": 2, "loss": [1]}',
        '{"iteration": 1, "loss": 1.0}',
        '{"loss": 1.0}',
        "",
    ],
)
def test_a_damaged_line_of_the_log_is_named_and_the_log_left_alone(tmp_path, line):
    config = circle_config(tmp_path)
    train(config)
    log = tmp_path / "log.jsonl"
    lines = log.read_text(encoding="utf-8").splitlines()
    log.write_text("\n".join([lines[0], line, *lines[2:]]) + "\n", encoding="utf-8")
    before = log.read_text(encoding="utf-8")
    message = r"log\.jsonl' must hold .* but line 2 is .*move the file"
    with pytest.raises(NPAError, match=message) as e:
        trainer_of(config, resume=True)
    assert len(str(e.value)) < 500 + len(str(tmp_path))
    assert log.read_text(encoding="utf-8") == before
    log.unlink()
    assert train(override(config, repeats=2), resume=True).finished
    assert [record["iteration"] for record in log_of(tmp_path)] == list(range(7, 13))


def test_the_last_line_of_a_log_may_be_cut_short_or_lack_its_end(tmp_path):
    whole = [json.dumps({"iteration": k, "loss": 0.5}) for k in (1, 2)]
    for text, count in (("\n".join(whole), 2), (whole[0] + "\n" + whole[1][:-3], 1), ("", 0)):
        log = JsonlLog(tmp_path / "log.jsonl")
        log.path.write_text(text, encoding="utf-8")
        before = log.records()
        assert len(before) == count
        log.append({"iteration": 3})
        assert log.records() == [*before, {"iteration": 3}]
