"""Signs of life between processes: who is missed, and who is not."""

import threading
import time

import pytest
import torch.distributed as dist

from npa_envs.training import ranks
from npa_envs.training.ranks import LOST_CODE, Heartbeat


@pytest.fixture
def codes(monkeypatch):
    """Exit codes with which a process would have ended; its pauses are short."""
    ended = []
    monkeypatch.setattr(ranks, "BEAT_SECONDS", 0.05)
    monkeypatch.setattr(ranks.os, "_exit", ended.append)
    return ended


def waited(codes, seconds=60.0):
    end = time.monotonic() + seconds
    while not codes and time.monotonic() < end:
        time.sleep(0.01)
    return codes


def test_nobody_is_missed_who_lives_or_has_left(codes, monkeypatch):
    # No load gives a thread sixty pauses and another one none.
    monkeypatch.setattr(ranks, "BEAT_SECONDS", 0.02)
    monkeypatch.setattr(ranks, "SILENT_BEATS", 60)
    store = dist.HashStore()
    first, second = (Heartbeat(store, rank, 2) for rank in (0, 1))
    time.sleep(2.0)
    second.end(left=True)
    time.sleep(2.0)
    first.end(left=True)
    assert codes == []


def test_a_process_that_falls_silent_is_missed(codes, capfd):
    store = dist.HashStore()
    first, second, third = (Heartbeat(store, rank, 3) for rank in (0, 1, 2))
    second.end(left=True)
    third.end(left=False)
    assert set(waited(codes)) == {LOST_CODE}
    first.end(left=True)
    assert "process 0 of 3 has heard nothing from process 2 for" in capfd.readouterr().err


def test_a_store_that_is_gone_is_named(codes, capfd):
    class Gone:
        def add(self, _, __):
            raise RuntimeError("connection reset")

    watching = Heartbeat(Gone(), 0, 2)
    assert set(waited(codes)) == {LOST_CODE}
    watching.end(left=True)
    assert "s, as the store that processes meet in is gone" in capfd.readouterr().err


def test_a_store_that_does_not_answer_is_as_silent(codes, capfd):
    class Frozen:
        def __init__(self):
            self.thawed = threading.Event()

        def add(self, _, __):
            self.thawed.wait()
            return 1

    store = Frozen()
    watching = Heartbeat(store, 0, 2)
    assert set(waited(codes)) == {LOST_CODE}
    store.thawed.set()
    watching.end(left=True)
    assert "has heard nothing from process 1" in capfd.readouterr().err
