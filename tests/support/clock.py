"""A fake clock for tests of time budgets, and waiting by the real one."""

import time


class Clock:
    """Stands in for `time` in a module, so that what a test sees is the same on a busy machine.

    Time passes only where `sleep` is called, and by `tick` [s] with each reading.
    """

    def __init__(self, tick=0.0):
        self.now, self.tick = 0.0, tick

    def perf_counter(self):
        self.now += self.tick
        return self.now

    monotonic = perf_counter

    def sleep(self, seconds):
        self.now += seconds


def wait_until(condition, seconds=300.0, run=None):
    """Return a condition's value once it is true; a process `run` must live until then."""
    end = time.monotonic() + seconds
    while not (value := condition()):
        assert run is None or run.poll() is None, run.stdout.read()
        assert time.monotonic() < end, "never true"
        time.sleep(0.05)
    return value
