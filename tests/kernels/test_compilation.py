"""Kernels compile for every GPU generation that is served, without a CUDA device."""

from pathlib import Path

import pytest
import warp as wp

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
from npa_envs.kernels.pictures.blending import block_kernels
from npa_envs.kernels.pictures.pixel_errors import gather_errors
from npa_envs.kernels.portable.rewards_and_ends import update_episodes
from npa_envs.ops import warmup
from npa_envs.ops.launch import loaded_modules

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
    "steering": lambda: steering_kernels(2, 8, True).steer,
    "steering 3D": lambda: steering_kernels(3, 8, False).steer,
    "pictures": lambda: block_kernels(wp.float32).pull_back_blocks,
    "errors of pictures": lambda: gather_errors(wp.float64),
    "errors in float32": lambda: gather_errors(wp.float32),
}


@pytest.mark.parametrize("name", VARIANTS)
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
