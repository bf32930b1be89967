"""The cache of compiled kernels, shared by processes that start together."""

import multiprocessing
import os

import pytest
import torch
import warp as wp

from npa_envs.ops.launch import launch
from npa_envs.runtime import start_warp


@wp.kernel(module="unique")
def double(values: wp.array(dtype=wp.float32)):
    values[wp.tid()] *= 2.0


def load_and_launch(barrier, pipe):
    compiled = 0
    compile_module = wp.Module._compile

    def counted(*arguments, **options):
        nonlocal compiled
        fresh = compile_module(*arguments, **options)
        compiled += bool(fresh)
        return fresh

    wp.Module._compile = counted
    values = torch.ones(3)
    barrier.wait()
    launch(double, 3, torch.device("cpu"), values)
    pipe.send((compiled, values.tolist()))
    os._exit(0)


@pytest.mark.skipif(os.name != "posix", reason="needs locks of files and fork")
def test_of_four_processes_that_start_together_one_compiles(tmp_path, monkeypatch):
    start_warp()
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    context = multiprocessing.get_context("fork")
    barrier = context.Barrier(4)
    pipes = [context.Pipe(duplex=False) for _ in range(4)]
    made = [context.Process(target=load_and_launch, args=(barrier, w)) for _, w in pipes]
    for process in made:
        process.start()
    results = [reader.recv() for reader, _ in pipes]
    for process in made:
        process.join()
    assert sorted(compiled for compiled, _ in results) == [0, 0, 0, 1]
    assert [values for _, values in results] == [[2.0, 2.0, 2.0]] * 4
    assert len(list(tmp_path.glob("*.lock"))) == 1


def test_a_cache_without_room_for_locks_is_used_all_the_same(tmp_path, monkeypatch):
    start_warp()
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path / "nowhere" / "yet"))

    @wp.kernel(module="unique")
    def triple(values: wp.array(dtype=wp.float32)):
        values[wp.tid()] *= 3.0

    values = torch.ones(2)
    launch(triple, 2, torch.device("cpu"), values)
    assert values.tolist() == [3.0, 3.0]
