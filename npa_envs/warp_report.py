"""What Warp says about itself, for `npa-envs doctor`."""

from __future__ import annotations

from pathlib import Path

import warp as wp


def warp_devices() -> list[str]:
    """Return one line for each device that Warp sees; starts Warp, quietly."""
    _start()
    return [f"{device.alias}: {device.name}" for device in wp.get_devices()]


def kernel_cache_folder() -> Path:
    """Return the folder that compiled kernels are kept in; starts Warp, quietly."""
    _start()
    folder = wp.config.kernel_cache_dir
    assert folder is not None, "Warp sets its cache folder when it starts"
    return Path(folder)


def _start() -> None:
    before = wp.config.log_level
    wp.config.log_level = max(before, wp.LOG_WARNING)
    try:
        wp.init()  # type: ignore[no-untyped-call]
    finally:
        wp.config.log_level = before
