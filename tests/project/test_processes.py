"""Queues of processes: how they are stopped."""

import os
import signal
import threading

import pytest

from npa_envs.processes import Child, Places, run_children

SIGNALS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]


class Noted(Child):
    """A child that is over when it is looked at, and notes what is done with it."""

    def __init__(self, name, notes, at=None):
        self.name, self.notes, self.at = name, notes, at or {}

    def note(self, what):
        self.notes.append(f"{what} {self.name}")
        self.at.get(what, lambda: None)()

    def go(self, device):
        self.note("go")

    @property
    def over(self):
        self.note("over")
        return True

    def stop(self, *, at_once):
        self.note("kill" if at_once else "stop")

    def end(self):
        self.note("end")


@pytest.fixture(params=SIGNALS)
def send(request):
    """Send this process a signal, which does nothing unless it is caught."""
    before = signal.signal(request.param, nothing)
    yield lambda: os.kill(os.getpid(), request.param)
    assert signal.getsignal(request.param) is nothing
    signal.signal(request.param, before)


def nothing(number, frame):
    """Do nothing."""


def run(*children, jobs=2, ahead=False):
    waiting, finished = list(children), []
    run_children(
        lambda _: waiting.pop(0) if waiting else None,
        lambda one: finished.append(one.name),
        Places(("cpu",), jobs),
        ahead=ahead,
    )
    return finished


def test_a_signal_asks_all_to_end_before_one_is_waited_for(send):
    notes = []
    children = [Noted(name, notes, {"over": send}) for name in "abcd"]
    with pytest.raises(KeyboardInterrupt):
        run(*children, ahead=True)
    asked = [f"{what} {name}" for what in ("stop", "end") for name in "abcd"]
    # What ended with the signal is no result.
    assert notes == ["go a", "go b", "over a", *asked]


def test_a_second_signal_ends_all_at_once(send):
    notes, once = [], [True]

    def again():
        if once:
            once.pop()
            send()

    children = [Noted(name, notes, {"over": send, "end": again}) for name in "ab"]
    with pytest.raises(KeyboardInterrupt):
        run(*children)
    assert notes[3:] == ["stop a", "stop b", "end a", "kill a", "kill b", "end a", "end b"]


def test_a_child_that_a_signal_finds_starting_is_ended_as_well(send):
    notes = []
    with pytest.raises(KeyboardInterrupt):
        run(Noted("a", notes, {"go": send}), Noted("b", notes))
    assert notes == ["go a", "stop a", "end a"]


def test_an_error_ends_the_others_and_a_signal_meanwhile_ends_them_at_once(send):
    notes = []

    def break_down():
        raise ValueError("out of luck")

    children = [Noted("a", notes, {"over": break_down}), Noted("b", notes, {"stop": send})]
    with pytest.raises(KeyboardInterrupt):
        run(*children)
    assert notes[3:] == ["stop a", "stop b", "kill a", "kill b", "end a", "end b"]


@pytest.mark.parametrize("number", SIGNALS)
def test_an_ignored_signal_stays_ignored(number):
    before = signal.signal(number, signal.SIG_IGN)
    try:
        stop = {"over": lambda: os.kill(os.getpid(), number)}
        assert run(Noted("a", [], stop), Noted("b", [])) == ["a", "b"]
    finally:
        signal.signal(number, before)


def test_queues_run_in_any_thread():
    finished = []
    thread = threading.Thread(target=lambda: finished.extend(run(Noted("a", []))))
    thread.start()
    thread.join()
    assert finished == ["a"]
