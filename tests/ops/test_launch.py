"""Launches: tensors of any strides and sizes, one after the other, are described as they are."""

import collections
import contextlib
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from support.refusals import refused
from support.worlds import assert_same, random_world

import npa_envs
from npa_envs.ops import launch, position_check
from npa_envs.ops.perceive import _perceive
from npa_envs.ops.pictures.splat import _picture_losses, picture_losses
from npa_envs.ops.random_numbers import draw

WORLDS = 12
SELECTIONS = (
    slice(0, 4),
    slice(None, None, 3),
    slice(0, 5),
    slice(None, None, 2),
    slice(2, 8),
    slice(1, None, 5),
    slice(0, 1),
)


def test_tensors_with_and_without_strides_take_turns(device):
    keys = torch.arange(7, 7 + WORLDS, device=device)
    episodes = torch.arange(WORLDS, dtype=torch.int32, device=device)

    def drawn(*arguments):
        return draw(*arguments, 0, "uniform", 5, torch.float32, 0)

    expected = drawn(keys, episodes, episodes)
    assert len(expected.unique()) == expected.numel()
    for chosen in SELECTIONS * 2:
        results = drawn(keys[chosen], episodes[chosen], episodes[chosen].contiguous())
        assert torch.equal(results, expected[chosen])


def calls_of(function):
    """Return this thread's calls of an operator, numbers or launches, one for each kind."""
    return [calls for key, calls in launch._thread.calls.items() if key[0] is function]


def perceived(x, s, **options):
    """Return perception, its gradients and all fields."""
    x, s = x.detach().requires_grad_(), s.detach().requires_grad_()
    z = npa_envs.perceive(x, s, 0.3, **options)
    bars = torch.autograd.grad(z.sin().sum(), [x, s], allow_unused=True, materialize_grads=True)
    with torch.no_grad():
        quiet = npa_envs.perceive(x, s, 0.3, **options)
    assert torch.equal(quiet, z)
    return [z.detach(), *bars, *npa_envs.perception_fields(x, s, 0.3)]


@pytest.fixture
def nothing_repeated():
    launch._thread.calls.clear()


@pytest.mark.usefixtures("nothing_repeated")
@pytest.mark.parametrize("options", [{}, {"detach_positions": False}, {"box": 2.0}], ids=str)
def test_repeated_launches_have_the_results_of_the_first(
    options, device, dtype, space_dim, monkeypatch
):
    """Sizes and places in memory take turns, and no result is written to again."""
    kept, repeats, run = [], set(), launch._Repeat.run
    monkeypatch.setattr(
        launch._Repeat, "run", lambda each, inputs: repeats.add(each) or run(each, inputs)
    )
    for call in range(7):
        for particles in (31, 40):
            x, s = random_world(2, particles, space_dim, 5, dtype=dtype, device=device, seed=call)
            if call == 4:
                # Begins anywhere in memory.
                s = torch.cat([s.new_zeros(1), s.flatten()])[1:].view_as(s)
            if call == 5:
                s = s.mT.contiguous().mT
            found = perceived(x, s, **options)
            launch._thread.calls, before = collections.OrderedDict(), launch._thread.calls
            first = perceived(x, s, **options)
            launch._thread.calls = before
            assert_same(found, first)
            kept.append((found, first))
    for found, first in kept:
        assert_same(found, first)
    # With and without gradients, backward and fields, of two sizes; threads have their own.
    # On CUDA float64 is sorted with the help of torch's sums, so only backward passes are repeated.
    assert len(repeats) >= (2 if dtype == torch.float64 and device.type == "cuda" else 8)


@pytest.mark.usefixtures("nothing_repeated")
def test_losses_of_pictures_are_repeated_with_the_same_results(device):
    target, kept = torch.rand(8, 8, 4, device=device), []
    options = {"goal": target[0, 0, :2].clone(), "shift": 0.5, "pixel_size": 0.2}
    for call in range(6):
        x, s = random_world(3, 31, 2, 5, dtype=torch.float32, device=device, seed=call)
        found = picture_losses(x, s, target, **options)
        (calls,) = calls_of(_picture_losses._function)
        assert isinstance(calls, int) == (call < 2)
        with_others = x.flip(0).contiguous(), s.flip(0).contiguous()
        # One of other sizes does not repeat, but is launched.
        alone = picture_losses(with_others[0][:1], with_others[1][:1], target, **options)
        kept.append((torch.stack(found)[:, -1], torch.stack(alone)[:, 0]))
        launch._thread.calls.popitem()
    for found, alone in kept:
        assert torch.equal(found, alone)
    assert len({float(found[0]) for found, _ in kept}) == 6


@pytest.mark.usefixtures("nothing_repeated")
def test_calls_with_other_operators_of_torch_are_never_repeated(device):
    """Large worlds are sorted with the help of torch's sums."""
    x, s = random_world(1, 4200, 2, 5, dtype=torch.float32, device=device)
    results = [npa_envs.perceive(x, s, 0.1) for _ in range(5)]
    assert all(torch.equal(result, results[0]) for result in results)
    assert calls_of(_perceive._function) == [5]


@pytest.mark.usefixtures("nothing_repeated")
def test_arguments_that_share_memory_are_told_apart_later(device):
    whole = torch.zeros(4, dtype=torch.int64, device=device)

    def drawn(first, second):
        return draw(first, second, second, 0, "uniform", 5, torch.float32, 0)

    steps = torch.arange(4, dtype=torch.int32, device=device)
    for _ in range(4):
        drawn(whole, steps)
    other = steps + 1
    expected = draw(whole, steps, other.clone(), 0, "uniform", 5, torch.float32, 0)
    assert not torch.equal(drawn(whole, steps), expected)
    assert torch.equal(draw(whole, steps, other, 0, "uniform", 5, torch.float32, 0), expected)


@pytest.mark.usefixtures("nothing_repeated")
def test_threads_and_modes_repeat_on_their_own(device):
    x, s = random_world(2, 31, 3, 5, dtype=torch.float32, device=device)
    expected = perceived(x, s)

    def work():
        for mode in (torch.no_grad, torch.inference_mode, torch.enable_grad):
            for _ in range(4):
                with mode():
                    found = npa_envs.perceive(x, s, 0.3)
                assert torch.equal(found, expected[0])

    with ThreadPoolExecutor(3) as pool:
        for done in [pool.submit(work) for _ in range(3)]:
            done.result()
    with torch.autograd.set_multithreading_enabled(False):
        for _ in range(4):
            assert_same(perceived(x, s), expected)


def test_a_check_of_positions_waits_for_late_reports(monkeypatch):
    late, report = [], position_check.launch

    def launch_later(*arguments):
        threading.Timer(0.05, lambda: late.append(1) or report(*arguments)).start()

    monkeypatch.setattr(position_check, "is_slow", lambda x: False)
    monkeypatch.setattr(position_check, "launch", launch_later)
    with position_check.checked_positions(torch.zeros(1, 4, 2)):
        assert not late
    assert late


def test_a_check_ignores_late_reports_of_one_that_nobody_waited_for(monkeypatch):
    report, x = position_check.launch, torch.zeros(1, 4, 2)
    late = lambda *arguments: threading.Timer(0.05, report, arguments).start()  # noqa: E731
    monkeypatch.setattr(position_check, "is_slow", lambda x: False)
    for first, second in [(x, x / 0.0), (x / 0.0, x)]:
        monkeypatch.setattr(position_check, "launch", late)
        position_check.PositionCheck(first)
        monkeypatch.setattr(position_check, "launch", report)
        expected = pytest.raises(npa_envs.NPAError) if first is x else contextlib.nullcontext()
        with expected:
            position_check.PositionCheck(second).wait()


@pytest.mark.parametrize("fast", [False, True])
@pytest.mark.parametrize("size", [7, 60, 4000, 140_000])
def test_positions_that_are_not_finite_are_refused_by_all_checks(size, fast, device, monkeypatch):
    if fast:
        # On a CPU as well, threads report.
        monkeypatch.setattr(position_check, "is_slow", lambda x: False)
    x, s = random_world(1, size, 2, 1, dtype=torch.float32, device=device)
    # Beside a multiple of what a thread reads at once.
    for k in {0, size // 3, size - 1}:
        for _ in range(4):
            npa_envs.perception_fields(x, s, 1e-3)
        broken = x.clone()
        broken[0, k, 1] = torch.inf
        refused(
            rf"x must be finite, got .* world 0, particle {k} \(1 ",
            npa_envs.perceive,
            broken,
            s,
            1e-3,
        )
        refused("x must be finite", npa_envs.perception_fields, broken[:, k : k + 1], s[:, :1], 1)
