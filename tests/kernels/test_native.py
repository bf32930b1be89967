"""CUDA C++ of the kernels: it compiles on machines without a CUDA device, too."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import warp as wp

from npa_envs.kernels import native
from npa_envs.kernels.cuda.adjoint import listed_adjoint
from npa_envs.kernels.cuda.density import listed_density
from npa_envs.kernels.cuda.network import two_layer_kernel, weight_gradient_kernels
from npa_envs.kernels.cuda.perceive import listed_perception
from npa_envs.kernels.cuda.sort import sort_small_worlds
from npa_envs.kernels.pictures.blending import block_kernels

VARIANTS: dict[str, Callable[[], Any]] = {
    "sort": lambda: sort_small_worlds(3, 1024),
    "density": lambda: listed_density(2, 4, True, 128, True),
    "perceive": lambda: listed_perception(
        3, 16, 4, True, "smooth", False, True, 128, True, teams=2
    ),
    "adjoint": lambda: listed_adjoint(3, 16, True, True, True).gather_state_cotangents,
    "network": lambda: two_layer_kernel(4, 2, "note"),
    "network's gradients": lambda: weight_gradient_kernels(4, 8, 2, 4, 1, 4).add_shares,
    "pictures": lambda: block_kernels(wp.float32).pull_back_blocks,
}


@pytest.mark.parametrize("name", VARIANTS)
def test_cuda_kernels_compile(name: str, tmp_path: Path) -> None:
    wp.init()
    if not wp.get_cuda_supported_archs():
        pytest.skip("Warp has no CUDA compiler here")
    (ptx,) = wp.compile_aot_module(
        VARIANTS[name]().module, arch=80, module_dir=tmp_path, use_ptx=True
    )
    assert ".entry" in ptx.read_text(errors="replace")


def test_every_source_file_is_read() -> None:
    folder = Path(native.__file__).parent
    found = {path.relative_to(folder).as_posix() for path in folder.rglob("*.cuh")}
    assert found == {*native.BOTH_DEVICES, *native.CUDA_ONLY}
