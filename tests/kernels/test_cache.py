"""The cache of compiled kernels, shared by processes that start together."""

import os

import pytest
import torch
import warp as wp
from support.processes import on_ranks

from npa_envs.ops.launch import launch
from npa_envs.runtime import start_warp


@wp.kernel(module="unique")
def double(values: wp.array(dtype=wp.float32)):
    values[wp.tid()] *= 2.0


def compile_and_launch():
    """Return how many modules this process compiles for a launch, and the launch's results."""
    compile_module, compiled = wp.Module._compile, []

    def counted(*arguments, **options):
        compiled.append(compile_module(*arguments, **options))
        return compiled[-1]

    wp.Module._compile = counted
    values = torch.ones(3)
    launch(double, 3, torch.device("cpu"), values)
    return sum(map(bool, compiled)), values.tolist()


@pytest.mark.skipif(os.name != "posix", reason="needs locks of files and fork")
def test_of_four_processes_that_start_together_one_compiles(tmp_path, monkeypatch):
    start_warp()
    cache = tmp_path / "cache"
    cache.mkdir()
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(cache))
    results = on_ranks(4, compile_and_launch, tmp_path)
    assert sorted(results) == [(count, [2.0, 2.0, 2.0]) for count in (0, 0, 0, 1)]
    assert len(list(cache.glob("*.lock"))) == 1


def test_a_cache_without_room_for_locks_is_used_all_the_same(tmp_path, monkeypatch):
    start_warp()
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path / "nowhere" / "yet"))

    @wp.kernel(module="unique")
    def triple(values: wp.array(dtype=wp.float32)):
        values[wp.tid()] *= 3.0

    values = torch.ones(2)
    launch(triple, 2, torch.device("cpu"), values)
    assert values.tolist() == [3.0, 3.0]
