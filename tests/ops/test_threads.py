"""Launches on the CPU in ranges: the same bits for every number of threads, also after a fork."""

import os
import subprocess
import sys
import threading

import pytest
import torch
from worlds import random_world

import npa_envs
from npa_envs.ops import launch as bridge
from npa_envs.ops import orbit, render_gaussians, threads
from npa_envs.ops.perceive import Terms, perceive_rows, survey
from npa_envs.ops.pictures.losses import picture_losses
from npa_envs.ops.pictures.splat import splat
from npa_envs.ops.threads import even_ranges, run_together
from npa_envs.ops.update import ActionRules, PreparedActions, update_particles

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

    monkeypatch.setattr(bridge, "even_ranges", lambda count, _: even_ranges(count, SMALL_RANGE))
    monkeypatch.setattr(bridge, "run_together", counted)
    return counts


def stepped(x, s):
    """Return perception of half of the particles, their update, and the cotangents of both."""
    x, s = x.clone().requires_grad_(), s.clone().requires_grad_()
    generator = torch.Generator().manual_seed(1)
    mask = (torch.rand(x.shape[:2], generator=generator) < 0.5).to(torch.uint8)
    width = Terms().perception_dim(x.shape[2], STATE_DIM) + 1
    perception, rows = perceive_rows(
        x,
        s,
        mask=mask,
        row_capacity=int(mask.sum()),
        row_width=width,
        eps=0.3,
        eps0=0.3,
        box=None,
        terms=Terms(),
    )
    # No product: torch's own may depend on its number of threads.
    update = perception[:, : x.shape[2] + STATE_DIM]
    moved = update_particles(
        update,
        x,
        s,
        x.new_zeros(x.shape[:2]),
        rows=rows,
        reach=0.1,
        dt=1.0,
        moving=True,
        box=None,
    )
    bars = [torch.randn(m.shape, generator=generator, dtype=m.dtype) for m in moved]
    return [perception, *moved, *torch.autograd.grad(moved, (x, s), bars)]


def states_only(x, s):
    """Return perception of every particle and the cotangent of states alone; its fields."""
    s = s.clone().requires_grad_()
    perception = npa_envs.perceive(x, s, 0.3)
    (s_bar,) = torch.autograd.grad(perception.sin().sum(), s)
    fields = npa_envs.perception_fields(x, s.detach(), 0.3)
    return [perception, s_bar, *fields]


def acted(x, s):
    """Return worlds after two actions, and what they observe then."""
    x, s = x.clone(), s.clone()
    diverged = torch.zeros(x.shape[0], dtype=torch.uint8)
    actions = PreparedActions(
        x,
        s,
        ActionRules(0.1, 1.0, 1.0, True, None, position_limit=0.6, state_limit=10.0),
        mask=None,
        noise=None,
        enabled=torch.ones(1, dtype=torch.uint8),
        diverged=diverged,
    )
    generator = torch.Generator().manual_seed(2)
    for _ in range(2):
        shape = (*x.shape[:2], x.shape[2] + STATE_DIM)
        actions(torch.randn(shape, generator=generator, dtype=x.dtype))
    surveyed = survey(x, s, eps=0.3, eps0=0.3, box=None, terms=Terms(), limit=1.0)
    first = surveyed.perceive()
    return [x, s, diverged, first, surveyed.perceive(torch.empty_like(first))]


def drawn(x, s):
    """Return pictures, their cotangents, and losses."""
    x, colour = x[..., :2].clone().requires_grad_(), s[..., -3:].clone().requires_grad_()
    picture = splat(x, colour, resolution=24, pixel_size=0.05)
    bars = torch.autograd.grad(picture.square().sum(), (x, colour))
    losses = picture_losses(
        x.detach(), s, picture.detach()[0], goal=x.new_zeros(2), shift=0.5, pixel_size=0.05
    )
    return [picture, *bars, *losses]


def rendered(x, s):
    """Return what cameras see of Gaussians, and all cotangents."""
    means = torch.nn.functional.pad(x, (0, 3 - x.shape[2]))
    scales = 0.1 + 0.1 * s[..., :3].sigmoid()
    gaussians = [means, scales, s[..., :4], s[..., 4].sigmoid(), s[..., 1:4]]
    gaussians = [t.detach().clone().requires_grad_() for t in gaussians]
    pictures = render_gaussians(*gaussians, orbit(3, width=50, height=40))[:2]
    bars = [torch.linspace(-1.0, 1.0, p.numel()).view_as(p) for p in pictures]
    return [*pictures, *torch.autograd.grad(pictures, gaussians, bars)]


@pytest.mark.parametrize("run", [stepped, states_only, acted, drawn, rendered])
@pytest.mark.parametrize(("world_count", "particle_count"), [(1, 101), (3, 57)])
@pytest.mark.parametrize("space_dim", [2, 3])
def test_results_are_the_same_bits_for_every_number_of_threads(
    run, world_count, particle_count, space_dim, set_threads, cuts
):
    x, s = random_world(
        world_count, particle_count, space_dim, STATE_DIM, dtype=torch.float32, device="cpu"
    )
    set_threads(1)
    expected = run(x, s)
    assert not cuts
    for thread_count in (2, 3):
        cuts.clear()
        set_threads(thread_count)
        for value, alone in zip(run(x, s), expected, strict=True):
            assert torch.equal(value, alone)
        assert max(cuts) == thread_count * threads.SHARES


def test_a_step_of_a_large_world_is_cut(set_threads, cuts, monkeypatch):
    monkeypatch.setattr(bridge, "even_ranges", even_ranges)
    x, s = random_world(1, 2000, 2, STATE_DIM, dtype=torch.float32, device="cpu")
    set_threads(2)
    npa_envs.perceive(x, s, 0.1)
    assert cuts == [3, 3]


def test_small_worlds_are_not_cut(set_threads, cuts, monkeypatch):
    monkeypatch.setattr(bridge, "even_ranges", even_ranges)
    x, s = random_world(1, 1000, 2, STATE_DIM, dtype=torch.float32, device="cpu")
    set_threads(2)
    stepped(x, s)
    assert not cuts


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
        meeting = threading.Barrier(2, timeout=10.0)
        run_together([meeting.wait, meeting.wait])


def test_an_error_in_another_thread_is_raised_after_every_call(set_threads):
    set_threads(2)
    started, done = threading.Event(), []

    def fail():
        started.set()
        raise ValueError("broken")

    def wait_for_it():
        assert started.wait(10.0)
        done.append(True)

    with pytest.raises(ValueError, match="broken"):
        run_together([wait_for_it, fail])
    assert done == [True]


def test_worker_processes_use_one_thread_unless_told_otherwise(tmp_path):
    script = tmp_path / "workers.py"
    script.write_text(
        "import multiprocessing\n"
        "import torch\n"
        "from npa_envs.ops.threads import thread_count\n"
        "def counts(_):\n"
        "    default = thread_count()\n"
        "    torch.set_num_threads(5)\n"
        "    return default, thread_count()\n"
        "if __name__ == '__main__':\n"
        "    torch.set_num_threads(3)\n"
        "    assert thread_count() == 3\n"
        "    with multiprocessing.get_context('spawn').Pool(1) as pool:\n"
        "        assert pool.map(counts, [0]) == [(1, 5)]\n"
    )
    environment = {k: v for k, v in os.environ.items() if k != "OMP_NUM_THREADS"}
    done = subprocess.run([sys.executable, str(script)], env=environment, capture_output=True)
    assert done.returncode == 0, done.stderr.decode()


def test_a_forked_process_starts_threads_of_its_own():
    """Its parent's are gone: what is handed to them would never run."""
    program = (
        "import os, threading, torch, npa_envs\n"
        "torch.set_num_threads(2)\n"
        "x = torch.rand(1, 1500, 2, generator=torch.Generator().manual_seed(0))\n"
        "s = x.repeat(1, 1, 2)\n"
        "expected = npa_envs.perceive(x, s, 0.1)\n"
        "child = os.fork()\n"
        "if child == 0:\n"
        "    torch.set_num_threads(2)\n"
        "    same = torch.equal(npa_envs.perceive(x, s, 0.1), expected)\n"
        "    os._exit(0 if same and threading.active_count() > 1 else 1)\n"
        "print(os.waitpid(child, 0)[1])\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=120
    )
    assert done.stdout == "0\n", done.stderr
