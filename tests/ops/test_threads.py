"""Threads: launches on the CPU in ranges, the first calls of several threads, forks."""

import contextlib
import functools
import multiprocessing
import os
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from worlds import assert_same, random_mask, random_world, rows_of, with_gradients

import npa_envs
from npa_envs.kernel_lock import cached_under_lock, kernel_lock
from npa_envs.ops import launch as threads
from npa_envs.ops import orbit, render_gaussians
from npa_envs.ops.launch import even_ranges, run_together
from npa_envs.ops.perceive import build_neighbours
from npa_envs.ops.physics import Limits, Physics, Terms
from npa_envs.ops.pictures.losses import picture_losses
from npa_envs.ops.pictures.splat import splat
from npa_envs.ops.update import ActedWorlds, PreparedActions, update_particles

STATE_DIM = 5
SMALL_RANGE = 7


@pytest.fixture
def set_threads():
    """Sets torch's threads; they are put back after the test."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.fixture
def cuts(monkeypatch):
    """Cuts small launches, too; lists the number of ranges of each one that was cut."""
    counts = []

    def counted(calls):
        counts.append(len(calls))
        run_together(calls)

    monkeypatch.setattr(threads, "even_ranges", lambda count, _: even_ranges(count, SMALL_RANGE))
    monkeypatch.setattr(threads, "run_together", counted)
    return counts


def physics_of(x):
    limits = Limits(perception=1.0, position=0.6, state=10.0)
    return Physics(x.shape[2], STATE_DIM, 0.3, 0.3, max_displacement=0.1, limits=limits)


def stepped(x, s):
    """Return perception of half of the particles, their update, and the cotangents of both."""
    mask = random_mask(x)

    def moved(x, s):
        width = Terms().perception_dim(x.shape[2], STATE_DIM) + 1
        perception, rows = rows_of(x, s, mask, width=width)
        # No product: torch's own may depend on its number of threads.
        update = perception[:, : x.shape[2] + STATE_DIM]
        path = x.new_zeros(x.shape[:2])
        return perception, *update_particles(update, x, s, path, rows, physics_of(x))

    return with_gradients(moved, x, s)


def states_only(x, s):
    """Return perception of every particle and the cotangent of states alone; its fields."""
    found = with_gradients(lambda s: npa_envs.perceive(x, s, 0.3), s)
    return [*found, *npa_envs.perception_fields(x, s, 0.3)]


def acted(x, s):
    """Return worlds after two actions, and what they observe then."""
    x, s = x.clone(), s.clone()
    diverged = torch.zeros(x.shape[0], dtype=torch.uint8)
    enabled = torch.ones(1, dtype=torch.uint8)
    worlds = ActedWorlds(x, s, None, None, enabled, diverged)
    actions = PreparedActions(worlds, physics_of(x))
    generator = torch.Generator().manual_seed(2)
    for _ in range(2):
        shape = (*x.shape[:2], x.shape[2] + STATE_DIM)
        actions(torch.randn(shape, generator=generator, dtype=x.dtype))
    neighbours = build_neighbours(x, s, physics_of(x))
    first = neighbours.perceive()
    return [x, s, diverged, first, neighbours.perceive(torch.empty_like(first))]


def drawn(x, s):
    """Return pictures, their cotangents, and losses."""
    x = x[..., :2].contiguous()
    picture = functools.partial(splat, resolution=24, pixel_size=0.05)
    found = with_gradients(picture, x, s[..., -3:])
    losses = picture_losses(x, s, found[0][0], goal=x.new_zeros(2), shift=0.5, pixel_size=0.05)
    return [*found, *losses]


def rendered(x, s):
    """Return what cameras see of Gaussians, and all cotangents."""
    means = torch.nn.functional.pad(x, (0, 3 - x.shape[2]))
    scales = 0.1 + 0.1 * s[..., :3].sigmoid()
    gaussians = [means, scales, s[..., :4], s[..., 4].sigmoid(), s[..., 1:4]]
    cameras = orbit(3, width=50, height=40)
    return with_gradients(lambda *inputs: render_gaussians(*inputs, cameras)[:2], *gaussians)


@pytest.mark.parametrize("run", [stepped, states_only, acted, drawn, rendered])
@pytest.mark.parametrize(("world_count", "particle_count"), [(1, 101), (3, 57)])
def test_results_are_the_same_bits_for_every_number_of_threads(
    run, world_count, particle_count, space_dim, set_threads, cuts
):
    sizes = (world_count, particle_count, space_dim, STATE_DIM)
    x, s = random_world(*sizes, dtype=torch.float32, device="cpu")
    set_threads(1)
    expected = run(x, s)
    assert not cuts
    for thread_count in (2, 3):
        cuts.clear()
        set_threads(thread_count)
        assert_same(run(x, s), expected)
        assert max(cuts) == thread_count * threads.RANGES_PER_THREAD


@pytest.mark.parametrize(("particle_count", "ranges"), [(2000, [3, 3]), (1000, [])])
def test_launches_over_large_worlds_alone_are_cut(
    particle_count, ranges, set_threads, cuts, monkeypatch
):
    monkeypatch.setattr(threads, "even_ranges", even_ranges)
    x, s = random_world(1, particle_count, 2, STATE_DIM, dtype=torch.float32, device="cpu")
    set_threads(2)
    npa_envs.perceive(x, s, 0.1)
    if not ranges:
        stepped(x, s)
    assert cuts == ranges


@pytest.mark.parametrize("count", [0, 1, 20, 21, 1000])
def test_ranges_cover_every_index_once_and_none_is_too_small(count, set_threads):
    for thread_count in (1, 2, 3):
        set_threads(thread_count)
        ranges = even_ranges(count, 10)
        assert [index for part in ranges for index in part] == list(range(count))
        assert len(ranges) == 1 or min(len(part) for part in ranges) >= 10
        assert thread_count > 1 or len(ranges) == 1


def test_threads_of_torch_and_of_a_pool_are_both_used(set_threads, monkeypatch):
    set_threads(2)
    for team in (threads._team, lambda: None):
        monkeypatch.setattr(threads, "_team", team)
        meeting = threading.Barrier(2, timeout=60.0)
        run_together([meeting.wait, meeting.wait])


def test_an_error_in_another_thread_is_raised_after_every_call(set_threads):
    set_threads(2)
    started, done = threading.Event(), []

    def fail():
        started.set()
        raise ValueError("broken")

    def wait_for_it():
        assert started.wait(60.0)
        done.append(True)

    with pytest.raises(ValueError, match="broken"):
        run_together([wait_for_it, fail])
    assert done == [True]


@pytest.fixture(scope="module")
def worker():
    """Calls a function of this module in a process that multiprocessing has started."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("OMP_NUM_THREADS", raising=False)
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            yield lambda function: pool.apply_async(function).get(timeout=300)


@contextlib.contextmanager
def one_more_thread():
    """Ask for another number of threads than torch's own, which a worker does not take."""
    default = torch.get_num_threads()
    torch.set_num_threads(default + 1)
    yield default + 1
    torch.set_num_threads(default)


def threads_of_a_worker():
    own = threads.thread_count()
    with one_more_thread() as asked:
        return own, threads.thread_count() == asked


def test_worker_processes_use_one_thread_unless_told_otherwise(set_threads, worker):
    set_threads(3)
    assert threads.thread_count() == 3
    assert worker(threads_of_a_worker) == (1, True)


def perceive_after_a_fork():
    """Return whether a forked process perceives the same, with threads."""
    x = torch.rand(1, 1500, 2, generator=torch.Generator().manual_seed(0))
    s = x.repeat(1, 1, 2)
    with one_more_thread() as asked:
        expected = npa_envs.perceive(x, s, 0.1)
        child = os.fork()
        if child == 0:
            torch.set_num_threads(asked)
            same = torch.equal(npa_envs.perceive(x, s, 0.1), expected)
            os._exit(0 if same and threading.active_count() > 1 else 1)
        return os.waitpid(child, 0)[1] == 0


def test_a_forked_process_starts_threads_of_its_own(worker):
    """Its parent's are gone: what is handed to them would never run."""
    assert worker(perceive_after_a_fork)


ROLLOUT = """
import threading
import torch, npa_envs
rule = npa_envs.NPARule(2, 8, 32, eps0=0.3)
x, s = torch.rand(2, 3000, 2), torch.rand(2, 3000, 8)
"""

FIRST_CALLS = """
import sys
sys.setswitchinterval(1e-5)
barrier, finite = threading.Barrier(4), []
def first():
    barrier.wait()
    finite.append(npa_envs.rollout(rule, x[:, :60], s[:, :60], 3)[0].isfinite().all().item())
members = [threading.Thread(target=first) for _ in range(4)]
for member in members:
    member.start()
for member in members:
    member.join()
print(finite)
"""

FORKED_POOL = """
import multiprocessing
def rolled(seed):
    torch.manual_seed(seed)
    x, s = torch.rand(2, 3000, 2), torch.rand(2, 3000, 8)
    return npa_envs.rollout(rule, x, s, 3)[0].detach().numpy().tobytes()
before = rolled(0)
with multiprocessing.get_context("fork").Pool(2) as pool:
    print([after == before for after in pool.map(rolled, [0, 0])])
"""


def printed(program, threads):
    """Return the lines that a program prints in a process of its own."""
    command, env = [sys.executable, "-c", ROLLOUT + program], {"OMP_NUM_THREADS": str(threads)}
    options = {"capture_output": True, "encoding": "utf-8", "timeout": 60, "check": False}
    done = subprocess.run(command, env={**os.environ, **env}, **options)
    assert done.returncode == 0, done.stderr
    return done.stdout.split("\n")[:-1]


def test_several_threads_may_make_and_load_the_same_kernels_first():
    assert printed(FIRST_CALLS, 1) == ["[True, True, True, True]"]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_forked_pool_rolls_out_where_environments_were_never_imported():
    assert printed(FORKED_POOL, 2) == ["[True, True]"]


def test_what_several_threads_make_at_once_is_made_once():
    barrier, made = threading.Barrier(4), []

    @cached_under_lock()
    def make(name):
        made.append(name)
        time.sleep(0.02)
        return object()

    def call(_):
        barrier.wait(10.0)
        return make("kernel")

    with ThreadPoolExecutor(4) as pool:
        assert len(set(pool.map(call, range(4)))) == 1
    assert made == ["kernel"]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_fork_waits_until_no_thread_is_making_kernels():
    begun = threading.Event()

    def hold():
        with kernel_lock:
            begun.set()
            time.sleep(0.2)

    holder = threading.Thread(target=hold)
    holder.start()
    assert begun.wait(10.0)
    child = os.fork()
    if child == 0:
        os._exit(0 if kernel_lock.acquire(timeout=5.0) else 1)
    holder.join()
    assert os.waitpid(child, 0)[1] == 0
