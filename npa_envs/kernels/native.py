"""C++ beside Warp's Python: the `.cuh` files of this folder, and what the CPU's threads share.

A kernel module that comes from `module` begins with the text of those files. `@native.func_native`
then makes a Warp function of a C++ function: plain Warp has no loads of 16 bytes, no votes of a
warp, no memory shared by a few threads, and no tensor cores.
"""

import inspect
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import warp as wp

from npa_envs.once import made_once

BOTH_DEVICES = ("access.cuh", "mathematics.cuh")
"""Files that the CPU's compiler reads, too."""

CUDA_ONLY = (
    "cuda/sort.cuh",
    "cuda/splat.cuh",
    "cuda/neighbour_list.cuh",
    "cuda/tiles.cuh",
    "cuda/perceive.cuh",
    "cuda/adjoint.cuh",
    "cuda/network.cuh",
    "cuda/equivariance.cuh",
    "pictures/blending.cuh",
    "pictures/errors.cuh",
)
"""The other files; what a file uses of another one stands before it."""


@made_once()
def build_options() -> wp.ModuleBuildOptions:
    """Return what puts the C++ functions into a module: their text, which its hash includes."""
    folder = Path(__file__).parent
    for_cpu = "".join((folder / name).read_text(encoding="utf-8") for name in BOTH_DEVICES)
    for_cuda = for_cpu + "".join((folder / name).read_text(encoding="utf-8") for name in CUDA_ONLY)
    return wp.ModuleBuildOptions(extra_cpu_preamble=for_cpu, extra_cuda_preamble=for_cuda)


def module(name: str) -> wp.Module:
    """Return the Warp module of a name, whose kernels may call native functions."""
    result = wp.get_module(name)
    wp.set_module_options({"extra_build_options": build_options()}, result)
    return result


def func_native(*parameters: Any) -> Callable[[Any], Any]:
    """Return a decorator that makes a Warp function of the C++ function `npa::` of the same name.

    What it decorates is a stub with the types of the arguments and of the result. Warp knows such a
    stub by a decorator of this very name, an attribute of a module. The template parameters are
    those that do not follow from the arguments: numbers, truth values, `npa`'s constants, types.
    """
    template = f"<{', '.join(map(_in_cpp, parameters))}>" if parameters else ""

    def make(stub: Any) -> Any:
        signature = inspect.signature(stub)
        call = f"npa::{stub.__name__}{template}({', '.join(signature.parameters)});"
        returns = signature.return_annotation is not inspect.Signature.empty
        return wp.func_native(f"    {'return ' * returns}{call}\n")(stub)

    return make


def named(*functions: Any, **others: Any) -> SimpleNamespace:
    """Return kernels and Warp functions by their own names, and other values."""
    return SimpleNamespace(**{function.func.__name__: function for function in functions}, **others)


def _in_cpp(parameter: Any) -> str:
    """Return a template parameter as C++ writes it."""
    if isinstance(parameter, str):
        return f"npa::{parameter}"
    if isinstance(parameter, int):  # truth values too
        return str(int(parameter))
    scalar = getattr(parameter, "_wp_scalar_type_", parameter)
    name = {wp.int32: "int", wp.float32: "float", wp.float64: "double"}[scalar]
    shape = getattr(parameter, "_shape_", ())
    if not shape:
        return name
    return f"wp::{'vec_t' if len(shape) == 1 else 'mat_t'}<{', '.join(map(str, shape))}, {name}>"


# On a CPU, launches are cut into ranges for its threads. The first argument of a kernel that may be
# cut, `range_start`, is where its range begins along the launch's first dimension: 0 where it runs
# whole, as on CUDA. No range may read what another writes, or count in it: Warp's atomics on the
# CPU are for one thread.

SMALLEST_RANGES: dict[Any, int] = {}
"""For each such kernel, how many indices of the first dimension are worth a thread of their own."""

PAIRS = 512
"""Smallest range of a kernel whose threads each go through a neighbourhood."""

WORLDS = 2
"""Smallest range of a kernel whose threads each go through a whole world."""

CAMERAS = 1
"""Smallest range of a kernel whose threads each draw all that a camera sees."""

TILES = 4
"""Smallest range of a kernel whose threads each go through a tile of a picture."""

PARTICLES = 4096
"""Smallest range of a kernel whose threads each move a particle with its state."""

ELEMENTS = 16384
"""Smallest range of a kernel whose threads each change a few numbers."""


def in_ranges(smallest: int) -> Callable[[Any], Any]:
    """Return a decorator for a Warp kernel that takes `range_start`.

    So many indices of the first dimension take about 0.15 ms: a cut costs half of that.
    """

    def mark(kernel: Any) -> Any:
        assert kernel.adj.args[0].label == "range_start"
        SMALLEST_RANGES[kernel] = smallest
        return kernel

    return mark
