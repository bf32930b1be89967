"""Warp's runtime: its quiet start, its devices, its kernel cache and what it launches."""

from __future__ import annotations

import contextlib
import functools
import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import warp as wp


@contextlib.contextmanager
def quiet_warp() -> Iterator[None]:
    """Keep Warp's banner and its notes on loading modules out of the caller's output."""
    level = wp.config.log_level
    wp.config.log_level = max(level, wp.LOG_WARNING)
    try:
        yield
    finally:
        wp.config.log_level = level


@functools.cache
def start_warp() -> None:
    """Start Warp, quietly; does nothing from the second call on."""
    with quiet_warp():
        wp.init()  # type: ignore[no-untyped-call]


def warp_devices() -> list[str]:
    """Return one line for each device that Warp sees; starts Warp, quietly."""
    start_warp()
    return [f"{device.alias}: {device.name}" for device in wp.get_devices()]


def kernel_cache_folder() -> Path:
    """Return the folder that compiled kernels are kept in; starts Warp, quietly."""
    start_warp()
    folder = wp.config.kernel_cache_dir
    assert folder is not None, "Warp sets its cache folder when it starts"
    return Path(folder)


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
