"""Queues of processes: how they are stopped."""

import os
import signal
import threading

import pytest

from npa_envs.measure.process_queue import Child, Slots, run_children

SIGNALS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]


class Noted(Child):
    """A child that is over when it is looked at, and notes what is done with it."""

    def __init__(self, name, notes, at=None):
        self.name, self.notes, self.at = name, notes, at or {}

    def note(self, what):
        self.notes.append(f"{what} {self.name}")
        self.at.get(what, lambda: None)()

    def begin_work(self, device):
        self.note("go")

    @property
    def has_ended(self):
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


def run(*children, jobs=2, starts_early=False):
    waiting, finished = list(children), []
    run_children(
        lambda _: waiting.pop(0) if waiting else None,
        lambda one: finished.append(one.name),
        Slots(("cpu",), jobs),
        starts_early=starts_early,
    )
    return finished


def once(send):
    """Return a function that sends the signal when it is first called."""
    calls = [send]
    return lambda: calls.pop()() if calls else None


def break_down():
    raise ValueError("out of luck")


@pytest.mark.parametrize(
    ("at", "options", "after"),
    [
        # All are asked to end before one is waited for; what ended with the signal is no result.
        (
            lambda send: {name: {"over": send} for name in "abcd"},
            {"starts_early": True},
            "go a, go b, over a, stop a, stop b, stop c, stop d, end a, end b, end c, end d",
        ),
        # A second signal ends all at once.
        (
            lambda send: {"a": {"over": send, "end": once(send)}, "b": {}},
            {},
            "go a, go b, over a, stop a, stop b, end a, kill a, kill b, end a, end b",
        ),
        # A child that a signal finds starting is ended as well.
        (lambda send: {"a": {"go": send}, "b": {}}, {}, "go a, stop a, end a"),
        # An error ends the others, and a signal meanwhile ends them at once.
        (
            lambda send: {"a": {"over": break_down}, "b": {"stop": send}},
            {},
            "go a, go b, over a, stop a, stop b, kill a, kill b, end a, end b",
        ),
    ],
)
def test_a_signal_ends_all(send, at, options, after):
    notes = []
    children = [Noted(name, notes, actions) for name, actions in at(send).items()]
    with pytest.raises(KeyboardInterrupt):
        run(*children, **options)
    assert ", ".join(notes) == after


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
