"""A fake clock for tests of time budgets."""


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
