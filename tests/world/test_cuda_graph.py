"""Recorded CUDA work: when it is recorded, what that may not do, and that it is what it was."""

import contextlib
import copy
import gc
import pickle
import weakref
from types import SimpleNamespace

import pytest
import torch

from npa_envs.world import cuda_graph
from npa_envs.world.cuda_graph import GraphedCallable, capture, host_call, no_garbage_collection

CUDA = torch.device("cuda", 0)


class Boom(Exception):
    pass


@pytest.fixture
def events(monkeypatch):
    """Replace CUDA by a list of what is asked of it."""
    seen = []

    def stream(name):
        return SimpleNamespace(
            wait_stream=lambda other: seen.append(f"{name} waits for {other.name}"), name=name
        )

    class Graph:
        def register_generator_state(self, generator):
            seen.append(f"register {generator}")

        def capture_begin(self, pool, capture_error_mode):
            seen.append(f"begin {pool} {capture_error_mode}")

        def capture_end(self):
            seen.append("end")
            if "broken" in seen:
                raise RuntimeError("the capture is not valid")

        def pool(self):
            return "pool"

        def replay(self):
            seen.append("replay")

    @contextlib.contextmanager
    def within(where):
        seen.append(f"enter {where.name}")
        try:
            yield
        finally:
            seen.append(f"leave {where.name}")

    stand_ins = {
        "CUDAGraph": Graph,
        "stream": within,
        "device": lambda device: contextlib.nullcontext(),
        "current_device": lambda: 0,
        "current_stream": lambda: stream("current"),
        "synchronize": lambda *_args: seen.append("synchronize"),
        "empty_cache": lambda: seen.append("empty"),
        "get_allocator_backend": lambda: "native",
    }
    for name, stand_in in stand_ins.items():
        monkeypatch.setattr(torch.cuda, name, stand_in)
    monkeypatch.setattr(cuda_graph.GraphSequence, "abandoned", 0)
    monkeypatch.setattr(cuda_graph, "_capture_stream", lambda index: stream("side"))
    monkeypatch.setattr(cuda_graph, "_stand_in", lambda graph: contextlib.nullcontext())
    return seen


@pytest.mark.parametrize("broken", [True, False])
def test_a_failed_capture_is_ended_and_tells_its_own_reason(events, broken):
    def function():
        if broken:
            events.append("broken")
        raise Boom

    with pytest.raises(Boom):
        capture(function, CUDA)
    assert events.count("end") == 1
    assert events[-2:] == ["leave side", "current waits for side"]
    assert gc.isenabled()


def test_a_capture_without_enough_memory_is_tried_again_once_room_is_made(events):
    def function(attempts):
        events.append("run")
        if events.count("run") < attempts:
            raise torch.OutOfMemoryError

    assert capture(lambda: function(2), CUDA) is not None
    kept = [event for event in events if event.split()[0] in ("begin", "run", "end", "empty")]
    once = ["begin None thread_local", "run", "end"]
    assert kept == [*once, "empty", *once]
    events.clear()
    with pytest.raises(torch.OutOfMemoryError):
        capture(lambda: function(3), CUDA)
    assert events.count("run") == 2


def test_what_is_done_host_call_is_done_in_every_replay(events):
    def function():
        events.append("first")
        host_call(lambda: events.append("between"))
        events.append("second")

    function()
    assert events == ["first", "between", "second"]
    events.clear()
    captured = capture(function, CUDA)
    begun = ["begin None thread_local", "first", "end", "begin pool thread_local", "second", "end"]
    assert events[2:-2] == begun
    for _ in range(2):
        events.clear()
        captured.replay()
        assert events == ["replay", "between", "replay"]
    events.clear()
    host_call(lambda: events.append("at once"))
    assert events == ["at once"]


def test_a_replayed_function_runs_once_is_captured_once_and_then_replayed(events):
    replayed = GraphedCallable(lambda: events.append("run"), CUDA, "dice")
    counts = []
    for _ in range(4):
        replayed()
        counts.append((events.count("run"), events.count("register dice"), events.count("replay")))
    assert counts == [(1, 0, 0), (2, 1, 1), (2, 1, 2), (2, 1, 3)]


class Counter:
    """Counts its runs, through a method that is replayed."""

    def __init__(self, device=CUDA):
        self.count = 0
        self.run = GraphedCallable(self.add, device)

    def add(self):
        self.count += 1


def test_an_object_whose_method_is_replayed_is_freed_at_once(events):
    counter = Counter()
    for _ in range(3):
        counter.run()
    assert counter.count == 2
    assert events.count("replay") == 2
    run, held = counter.run, weakref.ref(counter)
    with no_garbage_collection():
        del counter
        assert held() is None
        # Its graph would read what is freed.
        with pytest.raises(ReferenceError, match="the object of this method is gone"):
            run()


def test_a_copied_object_replays_its_own_method():
    counter = Counter(torch.device("cpu"))
    counter.run()
    for other in (copy.deepcopy(counter), pickle.loads(pickle.dumps(counter))):
        other.run()
        assert (counter.count, other.count) == (1, 2)


@pytest.mark.gpu
def test_a_capture_in_between_leaves_the_numbers_of_busy_graphs_alone():
    drawn = []
    for busy in (True, False):
        generator = torch.Generator(CUDA).manual_seed(6)
        numbers = torch.zeros(4000, device=CUDA)
        work = torch.rand(2048, 2048, device=CUDA)

        def draw(numbers=numbers, generator=generator, work=work):
            for _ in range(20):
                torch.mm(work, work)
            numbers.copy_(torch.rand(4000, generator=generator, device=CUDA))

        draw()
        rows = []
        for _ in range(8):
            graph = capture(draw, CUDA, generator=generator)
            for _ in range(3):
                graph.replay()
                rows.append(numbers.clone())
            if not busy:
                torch.cuda.synchronize()
        drawn.append(torch.stack(rows))
    assert torch.equal(drawn[0], drawn[1])
    assert len(drawn[0].unique(dim=0)) == len(drawn[0])


@pytest.mark.gpu
def test_after_a_failed_capture_the_device_captures_and_replays_as_before():
    numbers = torch.zeros(10, device=CUDA)

    def broken():
        numbers.add_(1)
        raise Boom

    with pytest.raises(Boom):
        capture(broken, CUDA)
    graph = capture(lambda: numbers.add_(2), CUDA)
    assert numbers.tolist() == [0.0] * 10
    graph.replay()
    assert numbers.tolist() == [2.0] * 10


@pytest.mark.gpu
def test_captures_with_a_backward_pass_wait_for_nothing_and_halves_see_what_is_between():
    x = torch.arange(1.0, 11.0, device=CUDA, requires_grad=True)
    gradient, seen = torch.zeros(10, device=CUDA), torch.zeros(10, device=CUDA)

    def function():
        cubes = x**3
        count = cubes.detach().sum()
        divisor = torch.empty_like(count)
        host_call(lambda: divisor.copy_(count / 5.0))
        (found,) = torch.autograd.grad((cubes / divisor).sum(), x)
        gradient.copy_(found)
        seen.copy_(torch.rand(10, generator=generator, device=CUDA))

    generator = torch.Generator(CUDA).manual_seed(4)
    function()
    torch.cuda.set_sync_debug_mode("error")
    try:
        captured = capture(function, CUDA, generator=generator)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    draws = []
    for factor in (1.0, 2.0):
        with torch.no_grad():
            x.mul_(factor)
        captured.replay()
        cubes = x.detach() ** 3
        assert torch.allclose(gradient, 3.0 * x.detach() ** 2 * 5.0 / cubes.sum())
        draws.append(seen.clone())
    assert not torch.equal(*draws)
