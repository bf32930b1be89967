"""Warp's runtime: its quiet start, its devices and its kernel cache."""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import sys
import tempfile
import weakref
from collections.abc import Iterator
from pathlib import Path

import warp as wp

from npa_envs.errors import NPAError, shown
from npa_envs.once import made_once

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

_NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"
"""What Warp's native code says on every computer without such a card; `npa-envs doctor`, too."""

_BROKEN_CACHE = ("Failed to load CPU", "Failed to load CUDA")
"""How what Warp says about object files that it cannot load begins."""


@contextlib.contextmanager
def quiet_warp() -> Iterator[None]:
    """Keep Warp's banner and its notes on loading modules out of the caller's output."""
    level = wp.config.log_level
    wp.config.log_level = max(level, wp.LOG_WARNING)
    try:
        yield
    except Exception as error:
        # Its descriptions of object files are JSON.
        of_cache = isinstance(error, OSError | json.JSONDecodeError)
        if not of_cache and not str(error).startswith(_BROKEN_CACHE):
            raise
        # A second try names the version twice in the configuration.
        folder = getattr(error, "filename", None) or wp.config.kernel_cache_dir
        folder = folder or os.environ.get("WARP_CACHE_PATH", "Warp's cache")
        raise NPAError(
            "Warp's cache of compiled kernels must be a folder that can be written to, and whole, "
            f"but {shown(str(folder))} cannot be used ({shown(error)}): remove it, and kernels are "
            "compiled anew, or set WARP_CACHE_PATH to another folder"
        ) from error
    finally:
        wp.config.log_level = level


@contextlib.contextmanager
def without_line(unwanted: bytes) -> Iterator[None]:
    """Keep a line out of what native code writes to standard error in the block."""
    try:
        own = os.dup(2)
    except OSError:  # There is none.
        yield
        return
    with tempfile.TemporaryFile() as told:
        os.dup2(told.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(own, 2)
            os.close(own)
            told.seek(0)
            for line in told:
                if unwanted not in line:
                    os.write(2, line)


@made_once()
def start_warp() -> None:
    """Start Warp, quietly; does nothing from the second call on."""
    with without_line(_NO_DRIVER), quiet_warp():
        wp.init()  # type: ignore[no-untyped-call]
    # Handlers go in the reverse order: the one that warns has to be there before this one.
    weakref.finalize(wp, int).detach()
    atexit.register(_remove_header_folders)


@contextlib.contextmanager
def in_turn(module: str) -> Iterator[None]:
    """Let one process at a time compile or load a module of kernels, within the block.

    Of many that start together, on one computer or on several that share a folder, the first one
    compiles. The others wait, and load what it has left. The system frees the lock of a process
    that ends in whatever way. Where it has no such locks, or the cache cannot be written to, each
    process does all by itself.
    """
    with contextlib.ExitStack() as held:
        with contextlib.suppress(OSError):
            lock = (kernel_cache_folder() / f"{module}.lock").open("a", encoding="utf-8")
            held.enter_context(lock)
            if fcntl is not None:
                fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _remove_header_folders() -> None:
    """Remove Warp's folders of precompiled headers: left to the interpreter, that warns of them."""
    runtime = getattr(sys.modules.get("warp._src.context"), "runtime", None)
    for folder in getattr(runtime, "_pch_dirs", {}).values():
        folder.cleanup()


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
