"""Kernels compile for every GPU generation that is served, without a CUDA device."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import warp as wp

from npa_envs.kernels import native
from npa_envs.kernels.cuda.adjoint import listed_adjoint
from npa_envs.kernels.cuda.density import listed_density, tiled_density
from npa_envs.kernels.cuda.equivariance import mixing_sum, row_kernels, steering_kernels
from npa_envs.kernels.cuda.network import (
    arrangement_kernels,
    two_layer_kernel,
    weight_gradient_kernels,
)
from npa_envs.kernels.cuda.perceive import listed_perception
from npa_envs.kernels.cuda.sort import BLOCKS, order_particles, sort_small_worlds
from npa_envs.kernels.cuda.splat import sort_small_splats
from npa_envs.kernels.pictures.blending import block_kernels
from npa_envs.kernels.pictures.errors import gather_errors
from npa_envs.kernels.portable.episodes import update_episodes
from npa_envs.ops import warmup
from npa_envs.ops.launch import launched

VARIANTS: dict[str, Callable[[], Any]] = {
    "sort": lambda: sort_small_worlds(3, 1024),
    "density": lambda: listed_density(2, 4, True, 128, True),
    "density in tiles": lambda: tiled_density(True, 256, True),
    "perceive": lambda: listed_perception(
        3, 16, 4, True, "smooth", False, True, 128, True, teams=2
    ),
    "adjoint": lambda: listed_adjoint(3, 16, True, True, True).gather_state_cotangents,
    "network": lambda: two_layer_kernel(4, 2, "note"),
    "network's gradients": lambda: weight_gradient_kernels(4, 8, 2, 4, 1, 4).add_shares,
    "vectors": lambda: row_kernels(2, 32, 17, 8, True).pull_back_rows,
    "sums of vectors": mixing_sum,
    "steering": lambda: steering_kernels(2, 8, True).steer,
    "pictures": lambda: block_kernels(wp.float32).pull_back_blocks,
    "errors of pictures": lambda: gather_errors(wp.float64),
}


@pytest.mark.parametrize("name", VARIANTS)
def test_cuda_kernels_compile(name: str, tmp_path: Path) -> None:
    wp.init()
    if not wp.get_cuda_supported_archs():
        pytest.skip("Warp has no CUDA compiler here")
    (ptx,) = wp.compile_aot_module(
        VARIANTS[name]().module, arch=80, module_dir=tmp_path, use_ptx=True
    )
    assert ".entry" in ptx.read_text(errors="replace", encoding="utf-8")


def test_every_source_file_is_read() -> None:
    folder = Path(native.__file__).parent
    found = {path.relative_to(folder).as_posix() for path in folder.rglob("*.cuh")}
    assert found == {*native.BOTH_DEVICES, *native.CUDA_ONLY}


TURING = 75
MODERN = (80, 86, 89, 90, 100, 120)
"""Compute capabilities, times ten, from which kernels/cuda/ is used."""


def compile_for(kernel, capability, folder):
    wp.compile_aot_module(kernel.module, arch=capability, module_dir=folder, use_ptx=False)


def cuda_engine():
    """A variant of each kernel of kernels/cuda/, in 2D and 3D."""
    for space_dim in (2, 3):
        yield listed_density(space_dim, 1, True, 128, False)
        yield listed_density(space_dim, 4, False, 128, True)
        yield listed_perception(
            space_dim, 16, 4, True, "threshold", False, False, 128, True, teams=2
        )
        yield listed_adjoint(space_dim, 16, True, False, False).unscale_cotangents
        yield order_particles(space_dim, 16)
        yield sort_small_worlds(space_dim, max(BLOCKS))
    yield sort_small_splats(max(BLOCKS))
    yield gather_errors(wp.float32)
    yield tiled_density(True, 256, False)
    yield listed_perception(
        2, 16, 4, True, "smooth", True, False, 256, False, teams=2, by_place=True, tiled=True
    )
    yield arrangement_kernels().arrange_hidden
    for mode in ("rectify", "note", "mask"):
        yield two_layer_kernel(5, 3, mode)
    yield weight_gradient_kernels(5, 9, 3, 4, 1, 4).sum_weight_gradients
    yield mixing_sum()
    for space_dim in (2, 3):
        yield row_kernels(space_dim, 32, 17, 8, space_dim == 2).read_rows
        yield steering_kernels(space_dim, 8, space_dim == 2).steer


@pytest.mark.parametrize("capability", [TURING, MODERN[-1]])
def test_a_kernel_compiles_with_all_native_code_for_the_oldest_and_the_newest(capability, tmp_path):
    compile_for(update_episodes, capability, tmp_path)
    assert list(tmp_path.glob(f"*.sm{capability}.cubin"))


@pytest.mark.slow
def test_portable_kernels_compile_for_turing(tmp_path):
    warmup("cpu", space_dims=(2, 3))
    modules = {kernel.module.name: kernel for kernel, _ in launched}
    assert len(modules) > 15
    for kernel in modules.values():
        compile_for(kernel, TURING, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("capability", MODERN)
def test_cuda_kernels_compile_from_ampere_on(capability, tmp_path):
    for kernel in cuda_engine():
        compile_for(kernel, capability, tmp_path)
