"""Signals that ask a run to stop: what counts as one request, and what comes after it."""

import signal

import pytest
from clock import Clock

from npa_envs.training.run import ONE_REQUEST, stop_flag


def test_the_first_signal_sets_the_flag_and_one_much_later_acts_as_usual(monkeypatch, capfd):
    clock = Clock()
    monkeypatch.setattr("npa_envs.training.run.time", clock)
    usual = signal.getsignal(signal.SIGINT)
    with stop_flag() as stop:
        assert not stop.is_set()
        signal.raise_signal(signal.SIGTERM)
        assert stop.is_set()
        # A launcher passes on what its scheduler has sent to all processes.
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGINT)
        clock.sleep(2 * ONE_REQUEST)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is usual
    assert capfd.readouterr().err.count("once more to stop at once") == 1


def test_the_patient_are_asked_as_often_as_one_likes(monkeypatch):
    clock = Clock()
    monkeypatch.setattr("npa_envs.training.run.time", clock)
    with stop_flag(patient=True) as stop:
        for _ in range(3):
            signal.raise_signal(signal.SIGTERM)
            clock.sleep(2 * ONE_REQUEST)
    assert stop.is_set()
