"""C++ functions for Warp kernels, from the `.cuh` files of this folder, and ranges of CPU threads.

A kernel module made by `module` begins with the text of those files. `function` makes a Warp
function of a C++ function. Plain Warp has no loads of 16 bytes, no votes of a warp, no memory
shared by a few threads, and no tensor cores.
"""

import inspect
import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import warp as wp

from npa_envs.compile_lock import cached_under_lock

BOTH_DEVICES = ("lanes_and_memory.cuh", "mathematics.cuh")
"""Files for CPU and CUDA."""

CUDA_ONLY = (
    "cuda/sort.cuh",
    "cuda/neighbour_list.cuh",
    "cuda/density.cuh",
    "cuda/perceive.cuh",
    "cuda/adjoint.cuh",
    "cuda/network.cuh",
    "cuda/equivariance.cuh",
    "cuda/whole_rollout.cuh",
    "pictures/warp_sums.cuh",
    "pictures/tiles_by_work.cuh",
)
"""Files for CUDA, in an order in which each uses only earlier ones."""


@cached_under_lock()
def build_options() -> wp.ModuleBuildOptions:
    """Return Warp's module options that put the C++ files' text into the code and its hash."""
    for_cpu = "".join(map(_text_of, BOTH_DEVICES))
    for_cuda = for_cpu + "".join(map(_text_of, CUDA_ONLY))
    return wp.ModuleBuildOptions(extra_cpu_preamble=for_cpu, extra_cuda_preamble=for_cuda)


def _text_of(file: str) -> str:
    return (Path(__file__).parent / file).read_text(encoding="utf-8")


def constants(file: str, *names: str) -> list[int]:
    """Return integer constants that a C++ file defines as `name = value`."""
    text = _text_of(file)
    return [int(re.findall(rf"\b{name} = (\d+)", text)[0]) for name in names]


def module(name: str) -> wp.Module:
    """Return the Warp module `name`: its kernels may call native functions, and have no adjoint."""
    result = wp.get_module(name)
    options = {"enable_backward": False, "extra_build_options": build_options()}
    wp.set_module_options(options, result)
    return result


def function(
    name: str, /, *parameters: Any, untyped: str = "", returns: Any = None, **arguments: Any
) -> Any:
    """Return a Warp function that calls `npa::name`, a C++ function of the `.cuh` files.

    `parameters` are the template parameters that C++ cannot deduce: numbers, booleans, types, names
    of constants in `npa`. `arguments` are types by name. `untyped` has the names, separated by
    spaces, of arguments of any type; a function with a result, of type `returns`, has none.
    """
    arguments = dict.fromkeys(untyped.split(), Any) | arguments
    template = f"<{', '.join(map(_in_cpp, parameters))}>" if parameters else ""
    call = f"npa::{name}{template}({', '.join(arguments)});"
    types = arguments if returns is None else arguments | {"return": returns}
    return _from_stub(name, types, f"    {'return ' * (returns is not None)}{call}\n")


def _from_stub(name: str, types: dict[str, Any], snippet: str) -> Any:
    """Return a C++ snippet as a Warp function; `types` are those of arguments and "return"."""

    # Warp reads names and types from a Python stub. It allows a stub to return something only if
    # its source has one decorator, `func_native` of some object: here of `native`.
    def declare(stub: Any) -> Any:
        names = [inspect.Parameter(key, 1) for key in types if key != "return"]
        stub.__qualname__, stub.__annotations__ = name, types
        stub.__signature__ = inspect.Signature(names)
        return wp.func_native(snippet)(stub)

    native = SimpleNamespace(func_native=lambda: declare)

    @native.func_native()
    def stub() -> Any: ...

    return stub


def namespace(scope: dict[str, Any], **others: Any) -> SimpleNamespace:
    """Return a namespace of a factory's kernels and Warp functions, from its `locals()`."""
    functions = {
        k: value for k, value in scope.items() if isinstance(value, wp.Function | wp.Kernel)
    }
    return SimpleNamespace(**functions, **others)


def _in_cpp(parameter: Any) -> str:
    """Return the C++ text of a template parameter."""
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


# On a CPU, launches are split into ranges for its threads. The first argument of such a kernel,
# `range_start`, is the beginning of its range along the launch's first dimension: 0 without a
# split, as on CUDA. Ranges must not read each other's outputs or use atomics: those of Warp on a
# CPU work for one thread only.

MIN_RANGES: dict[Any, int] = {}
"""Minimum number of indices in a range, by kernel."""

PAIRS, WORLDS, CAMERAS, TILES, PARTICLES, ELEMENTS = 512, 2, 1, 4, 4096, 16384
"""Minimum numbers of indices in a range, for kernels in which each index sums over a neighbourhood,
runs through a world, draws the picture of a camera, draws a tile of a picture, moves a particle
with its state, or changes a few numbers."""


def in_ranges(smallest: int) -> Callable[[Any], Any]:
    """Return a decorator for Warp kernels whose launches are split into ranges for CPU threads.

    A range has at least `smallest` indices of the first dimension, which take about 0.15 ms; a
    split costs half of that.
    """

    def mark(kernel: Any) -> Any:
        assert kernel.adj.args[0].label == "range_start"
        MIN_RANGES[kernel] = smallest
        return kernel

    return mark
