"""Kernels compile for every GPU generation that is served, wait where they must, and are cached."""

import ast
import os
import re
from pathlib import Path

import pytest
import torch
import warp as wp
from support.processes import on_ranks
from support.slow import slow

import npa_envs
from npa_envs.kernels import native_functions as native
from npa_envs.kernels.cuda.adjoint import listed_adjoint
from npa_envs.kernels.cuda.density import listed_density, tiled_density
from npa_envs.kernels.cuda.equivariance import mixing_sum, row_kernels, steering_kernels
from npa_envs.kernels.cuda.network import (
    arrangement_kernels,
    two_layer_kernel,
    weight_gradient_kernels,
)
from npa_envs.kernels.cuda.perceive import PerceptionVariant, listed_perception
from npa_envs.kernels.cuda.sort import (
    BLOCKS,
    order_particles,
    sort_small_splats,
    sort_small_worlds,
)
from npa_envs.kernels.cuda.whole_rollout import WorldVariant, whole_rollout
from npa_envs.kernels.pictures.blending import block_kernels
from npa_envs.kernels.pictures.pixel_errors import gather_errors
from npa_envs.kernels.portable.brush_sums import brush_kernel
from npa_envs.kernels.portable.random_numbers import mix_keys
from npa_envs.kernels.portable.rewards_and_ends import update_episodes
from npa_envs.kernels.portable.update import report_finite
from npa_envs.ops import warmup
from npa_envs.ops.launch import launch, loaded_modules
from npa_envs.runtime import start_warp

VARIANTS = {
    "sort": lambda: sort_small_worlds(3, 1024),
    "sort 2D": lambda: sort_small_worlds(2, max(BLOCKS)),
    "order": lambda: order_particles(2, 16),
    "splats": lambda: sort_small_splats(max(BLOCKS)),
    "density": lambda: listed_density(2, 4, True, 128, True),
    "density 3D": lambda: listed_density(3, 1, False, 128, False),
    "density in tiles": lambda: tiled_density(True, 256, True),
    "perceive": lambda: listed_perception(
        PerceptionVariant(3, 16, True, "smooth", False, True, 128, True, 2)
    ),
    "perceive tiles": lambda: listed_perception(
        PerceptionVariant(2, 16, True, "threshold", True, False, 256, False, 2, True, True)
    ),
    "adjoint": lambda: listed_adjoint(3, 16, True, True, True).gather_state_cotangents,
    "adjoint 2D": lambda: listed_adjoint(2, 16, True, False, False).unscale_cotangents,
    "network": lambda: two_layer_kernel(4, 2, "relu_store_mask"),
    "network's masks": lambda: two_layer_kernel(5, 3, "apply_mask"),
    "network without masks": lambda: two_layer_kernel(5, 3, "relu"),
    "network's gradients": lambda: weight_gradient_kernels(4, 8, 2, 4, 1, 4).add_parts,
    "arrangement": lambda: arrangement_kernels().arrange_hidden,
    "vectors": lambda: row_kernels(2, 32, 17, 8, True).pull_back_rows,
    "vectors 3D": lambda: row_kernels(3, 32, 17, 8, False).read_rows,
    "sums of vectors": mixing_sum,
    "sums under brushes": lambda: brush_kernel(wp.float32, 3, True),
    "reports": lambda: report_finite(wp.float32),
    "keys": lambda: mix_keys,
    "steering": lambda: steering_kernels(2, 8, True).steer,
    "steering 3D": lambda: steering_kernels(3, 8, False).steer,
    "whole rollouts": lambda: whole_rollout(WorldVariant(128, 4, 1, 4, 1)),
    "pictures": lambda: block_kernels(wp.float32).pull_back_blocks,
    "errors of pictures": lambda: gather_errors(wp.float64),
    "errors in float32": lambda: gather_errors(wp.float32),
}


SECOND = ("sort 2D", "density 3D", "perceive", "adjoint 2D", "vectors", "steering 3D")
SECOND += ("network without masks", "errors in float32", "whole rollouts")
"""Other forms of kernels of which one is compiled all the same."""


@pytest.mark.parametrize("name", [slow(n) if n in SECOND else n for n in VARIANTS])
def test_cuda_kernels_compile(name, tmp_path):
    wp.init()
    if not wp.get_cuda_supported_archs():
        pytest.skip("Warp has no CUDA compiler here")
    (ptx,) = wp.compile_aot_module(
        VARIANTS[name]().module, arch=80, module_dir=tmp_path, use_ptx=True
    )
    assert ".entry" in ptx.read_text(errors="replace", encoding="utf-8")


def test_every_source_file_is_read():
    folder = Path(native.__file__).parent
    files = {path.relative_to(folder).as_posix() for path in folder.rglob("*.cuh")}
    assert files == {*native.BOTH_DEVICES, *native.CUDA_ONLY}


TURING = 75
MODERN = (80, 86, 89, 90, 100, 120)
"""Compute capabilities, times ten, from which kernels/cuda/ is used."""


def compile_for(module, capability, folder):
    wp.compile_aot_module(module, arch=capability, module_dir=folder, use_ptx=False)


@pytest.mark.parametrize("capability", [TURING, MODERN[-1]])
def test_a_kernel_compiles_with_all_native_code_for_the_oldest_and_the_newest(capability, tmp_path):
    compile_for(update_episodes.module, capability, tmp_path)
    assert list(tmp_path.glob(f"*.sm{capability}.cubin"))


def test_worlds_of_two_blocks_compile_where_there_are_clusters(tmp_path):
    compile_for(whole_rollout(WorldVariant(512, 8, 2, 1, 2)).module, 90, tmp_path)
    assert list(tmp_path.glob("*.sm90.cubin"))


@pytest.mark.slow
def test_portable_kernels_compile_for_turing(tmp_path):
    warmup("cpu", space_dims=(2, 3))
    assert len(loaded_modules) > 15
    for module, _ in loaded_modules:
        compile_for(module, TURING, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("capability", MODERN)
def test_cuda_kernels_compile_from_ampere_on(capability, tmp_path):
    for kernel in VARIANTS.values():
        compile_for(kernel().module, capability, tmp_path)


# The cache, shared by processes that start together.


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


def test_a_cache_without_room_for_locks_is_used_all_the_same(tmp_path, monkeypatch):
    start_warp()
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path / "nowhere" / "yet"))

    @wp.kernel(module="unique")
    def triple(values: wp.array(dtype=wp.float32)):
        values[wp.tid()] *= 3.0

    values = torch.ones(2)
    launch(triple, 2, torch.device("cpu"), values)
    assert values.tolist() == [3.0, 3.0]


# Its forks have what the test above has made: Warp's header in compiled form takes seconds.
@pytest.mark.skipif(os.name != "posix", reason="needs locks of files and fork")
def test_of_four_processes_that_start_together_one_compiles(tmp_path, monkeypatch):
    start_warp()
    cache = tmp_path / "cache"
    cache.mkdir()
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(cache))
    results = on_ranks(4, compile_and_launch, tmp_path)
    assert sorted(results) == [(count, [2.0, 2.0, 2.0]) for count in (0, 0, 0, 1)]
    assert len(list(cache.glob("*.lock"))) == 1


# Kernels that are launched early wait for those before them; nothing is run, no GPU is needed.


WAIT = "wait_for_previous_kernel()"

KERNELS = Path(npa_envs.__file__).parent / "kernels"

GLOBAL_ACCESS = re.compile(r"\b(?:ld|st|atom|red|cp|prefetch)\.(?!param|shared|local)\S+")
"""An instruction of PTX that may touch the device's memory."""


def kernel_bodies():
    """Yield each kernel's name and its statements after the docstring."""
    for path in sorted(KERNELS.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            marks = [ast.unparse(mark) for mark in getattr(node, "decorator_list", ())]
            if isinstance(node, ast.FunctionDef) and any("wp.kernel" in mark for mark in marks):
                yield f"{path.stem}.{node.name}", node.body[1:]


def test_kernels_that_wait_do_so_first():
    for name, body in kernel_bodies():
        first, *others = map(ast.unparse, body)
        assert WAIT not in "".join(others), name
        assert WAIT not in first or first == WAIT, name


def test_no_load_may_be_moved_ahead_of_the_wait():
    for path in KERNELS.rglob("*.cuh"):
        code = re.sub(r"//.*", "", path.read_text(encoding="utf-8"))
        # Both promise that nobody writes what is read while the kernel is there.
        assert not re.search(r"__ldg|ld\.global\.nc|__restrict__", code), path.name


@pytest.mark.parametrize(("capability", "waits"), [(80, False), (90, True)])
def test_memory_is_touched_after_the_wait(capability, waits, tmp_path):
    module = two_layer_kernel(1, 1, "relu_store_mask").module
    wp.compile_aot_module(module, arch=capability, module_dir=tmp_path, use_ptx=True)
    (file,) = tmp_path.glob("*.ptx")
    assert "ld.global.nc" not in file.read_text(encoding="utf-8")
    entries = re.findall(r"\.entry \w+\(.*?\n\}\n", file.read_text(encoding="utf-8"), re.DOTALL)
    assert entries
    for entry in entries:
        # Blocks of instructions, of which the first is entered first.
        first, *blocks = re.split(r"\n\$L\w+:\n", entry)
        waiting = [block for block in (first, *blocks) if "griddepcontrol.wait;" in block]
        assert len(waiting) == waits
        assert any(map(GLOBAL_ACCESS.search, blocks))
        for block in {first, *waiting}:
            assert not (waits and GLOBAL_ACCESS.search(block.partition("griddepcontrol.wait;")[0]))
