"""Signals that ask a run to stop: what counts as one request, and what comes after it."""

import signal
import time

import pytest

from npa_envs.training.stopping import stop_flag


def test_the_first_signal_sets_the_flag_and_one_much_later_acts_as_usual(monkeypatch, capfd):
    monkeypatch.setattr("npa_envs.training.stopping.ONE_REQUEST", 0.1)
    usual = signal.getsignal(signal.SIGINT)
    with stop_flag() as stop:
        assert not stop.is_set()
        signal.raise_signal(signal.SIGTERM)
        assert stop.is_set()
        # A launcher passes on what its scheduler has sent to all processes.
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGINT)
        time.sleep(0.2)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is usual
    assert capfd.readouterr().err.count("once more to stop at once") == 1


def test_the_patient_are_asked_as_often_as_one_likes(monkeypatch):
    monkeypatch.setattr("npa_envs.training.stopping.ONE_REQUEST", 0.0)
    with stop_flag(patient=True) as stop:
        for _ in range(3):
            signal.raise_signal(signal.SIGTERM)
            time.sleep(0.01)
    assert stop.is_set()
