"""Threads of the CPU: parallel calls, the first calls of several threads, forks."""

import multiprocessing
import os
import threading
import time

import pytest
import torch
from support.processes import run_alone

from npa_envs.compile_lock import kernel_lock
from npa_envs.ops import cpu_threads
from npa_envs.ops.cpu_threads import run_together

needs_fork = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")


@pytest.fixture
def set_threads():
    """Return a function that sets torch's number of threads until the end of the test."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def test_threads_of_torch_and_of_a_pool_are_both_used(set_threads, monkeypatch):
    set_threads(2)
    for team in (cpu_threads._team, lambda: None):
        monkeypatch.setattr(cpu_threads, "_team", team)
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


def threads_of_a_worker():
    """Return this process's default number of threads, then whether it can be set."""
    default = cpu_threads.thread_count()
    torch.set_num_threads(torch.get_num_threads() + 1)
    return default, cpu_threads.thread_count() == torch.get_num_threads()


def test_worker_processes_use_one_thread_unless_told_otherwise(set_threads, monkeypatch):
    set_threads(3)
    assert cpu_threads.thread_count() == 3
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.apply(threads_of_a_worker) == (1, True)


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
def rolled():
    torch.manual_seed(0)
    return npa_envs.rollout(rule, x, s, 3)[0].detach()
def perceived():
    # So small that torch's own operations start no thread: in a fork it would wait for them.
    return npa_envs.perceive(x[:1, :1500], s[:1, :1500, :4], 0.1)
def in_a_fork(_):
    same = torch.equal(rolled(), before[0])
    torch.set_num_threads(3)
    return [same, torch.equal(perceived(), before[1]), threading.active_count() > 1]
before = rolled(), perceived()
with multiprocessing.get_context("fork").Pool(2) as pool:
    print(pool.map(in_a_fork, range(2)))
"""


@needs_fork
def test_several_threads_make_the_same_kernels_first_and_a_forked_pool_starts_its_own_threads():
    """Its parent's threads do not run there: what they are given would never be done."""
    done = run_alone(ROLLOUT + FIRST_CALLS + FORKED_POOL, OMP_NUM_THREADS="2")
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [str([True] * 4), str([[True, True, True]] * 2)]


@needs_fork
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
