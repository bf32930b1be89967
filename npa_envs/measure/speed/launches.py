"""Which Warp kernels a call launches."""

from __future__ import annotations

import contextlib
import inspect
from collections.abc import Iterator
from typing import Any, NamedTuple

import warp as wp


class Launch(NamedTuple):
    """One launch of a Warp kernel."""

    kernel: str
    """The kernel's name."""
    module: str
    """The Warp module of its variant, without the package's name."""
    threads: str
    """Threads along each dimension."""
    purpose: str
    """First line of its docstring."""


@contextlib.contextmanager
def recorded_launches() -> Iterator[list[Launch]]:
    """Yield a list to which every launch in the block is added."""
    launches: list[Launch] = []
    launch = wp.launch

    def noted(kernel: Any, dim: Any, *arguments: Any, **options: Any) -> Any:
        launches.append(_described(kernel, dim))
        return launch(kernel, dim, *arguments, **options)

    wp.launch = noted
    try:
        yield launches
    finally:
        wp.launch = launch


def _described(kernel: Any, dim: Any) -> Launch:
    sizes = dim if isinstance(dim, tuple | list) else (dim,)
    purpose = (inspect.getdoc(kernel.func) or "").split("\n")[0]
    module = kernel.module.name.removeprefix("npa_envs.").removeprefix("kernels.")
    return Launch(kernel.func.__name__, module, " x ".join(str(size) for size in sizes), purpose)
