"""`npa-envs train --processes`, killed: the checkpoint can always be read, and nothing is left."""

import json
import os
import random
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from support.clock import wait_until

from npa_envs.training.checkpoint import load_checkpoint

INTERVAL = 5
"""Iterations between two checkpoints."""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs Linux's /proc"),
]


def popen(*words, **variables):
    """A run that would go on for hours, if need be from its checkpoint."""
    task = ["train", "morphogenesis2d", "--preset", "tiny", "--resume", "auto", "--no-progress"]
    task += ["--iterations", "1000000", "--checkpoint-interval", str(INTERVAL)]
    launcher, options = words[: words.index("npa_envs") + 1], words[words.index("npa_envs") + 1 :]
    return subprocess.Popen(
        [sys.executable, "-m", *launcher, *task, *options], env=os.environ | variables,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, encoding="utf-8",
    )  # fmt: skip


def started(out, *options):
    return popen("npa_envs", "--processes", "2", "--out", str(out), *options)


def started_node(number, port, out):
    """A machine of two that share a run, each with one process."""
    words = ["torch.distributed.run", "--nnodes=2", "--nproc-per-node=1", f"--node-rank={number}"]
    words += ["--master-addr=127.0.0.1", f"--master-port={port}", "-m", "npa_envs"]
    return popen(*words, "--out", str(out), GLOO_SOCKET_IFNAME="lo", OMP_NUM_THREADS="1")


def children(pid):
    listing = Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="utf-8")
    return [int(child) for child in listing.split()]


def alive(pid):
    try:
        status = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8")
        return status.rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def last_iteration(out):
    log = out / "log.jsonl"
    lines = log.read_text(encoding="utf-8").splitlines() if log.exists() else []
    return json.loads(lines[-1])["iteration"] if lines else 0


def grown(run, out, start):
    """Wait until a run has gone some way beyond an iteration; return its processes."""
    wait_until(lambda: last_iteration(out) > start + INTERVAL, 60, run)
    return children(run.pid)


def check_left(out, workers, before):
    """Nothing of a run that has ended is left but a checkpoint of late."""
    wait_until(lambda: not any(map(alive, workers)), 60)
    saved = load_checkpoint(out / "checkpoint.pt")["iteration"]
    assert saved >= last_iteration(out) - INTERVAL > before - INTERVAL
    return saved


def test_a_killed_process_ends_the_run_which_goes_on_from_its_checkpoint(tmp_path):
    out, chance, saved = tmp_path / "run", random.Random(0), 0
    for _ in range(10):
        run = started(out)
        workers = grown(run, out, saved)
        time.sleep(chance.random())
        os.kill(chance.choice(workers), signal.SIGKILL)
        begun = time.monotonic()
        output, _ = run.communicate(timeout=60)
        assert time.monotonic() - begun < 60
        assert run.returncode == 2
        assert "of 2 was ended by SIGKILL" in output
        assert "continue from it with --resume" in output
        saved = check_left(out, workers, saved)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_machine_notices_within_a_minute_that_another_one_is_lost(tmp_path, number):
    out = tmp_path / "run"
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    here, there = (started_node(node, port, out) for node in (0, 1))
    try:
        mine = grown(here, out, 0)
        (lost,) = others = children(there.pid)
        os.kill(lost, number)
        begun = time.monotonic()
        output, _ = here.communicate(timeout=60)
        assert time.monotonic() - begun < 60
        assert here.returncode == 1
        if number == signal.SIGSTOP:
            assert "process 0 of 2 has heard nothing from process 1 for 40 s" in output
            # It is there until it may go on, and then ends by itself.
            os.kill(lost, signal.SIGCONT)
        assert "the last checkpoint is intact" in output
        there.communicate(timeout=60)
        check_left(out, [*mine, *others], 0)
    finally:
        here.kill()
        there.kill()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGKILL])
def test_a_signal_to_the_launcher_saves_what_was_learned(tmp_path, number):
    run = started(tmp_path / "run")
    workers = grown(run, tmp_path / "run", 0)
    run.send_signal(number)
    output, _ = run.communicate(timeout=60)
    if number != signal.SIGKILL:
        assert run.returncode == 130
        assert "stopped at iteration" in output
        assert "--resume --processes 2" in output
    saved = check_left(tmp_path / "run", workers, 0)
    assert saved == last_iteration(tmp_path / "run")


def test_a_mistake_is_printed_once_and_ends_all(tmp_path):
    run = started(tmp_path / "run", "--world-count", "3")
    output, _ = run.communicate(timeout=60)
    assert run.returncode == 2
    assert output.count("world_count must be a multiple of the number of processes, got 3") == 1
    assert "Traceback" not in output


FAILING = """
import os

if os.environ.get("RANK") == "1":
    from npa_envs.errors import NPAError
    from npa_envs.training.cycle import TrainingCycle

    def run(cycle, iteration, share):
        raise NPAError("memory is full: take less")

    TrainingCycle.run = run
"""


def test_the_error_of_any_process_is_printed(tmp_path, monkeypatch):
    # Python runs this in each process as it starts.
    (tmp_path / "sitecustomize.py").write_text(FAILING, encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    run = started(tmp_path / "run")
    output, _ = run.communicate(timeout=60)
    assert run.returncode == 2
    assert output.count("npa-envs: error: memory is full: take less") == 1
    assert load_checkpoint(tmp_path / "run" / "checkpoint.pt")["iteration"] == 0
