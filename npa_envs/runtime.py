"""Warp's runtime: its quiet start, its devices and its kernel cache."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator
from pathlib import Path

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
