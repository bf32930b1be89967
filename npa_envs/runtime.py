"""Warp's runtime: its start, its devices and its kernel cache."""

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

from npa_envs.compile_lock import cached_under_lock
from npa_envs.errors import NPAError, shown

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

_NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"
"""Message of Warp's native code on computers without an NVIDIA GPU (`npa-envs doctor` has it)."""

_BROKEN_CACHE = ("Failed to load CPU", "Failed to load CUDA")
"""First words of Warp's errors about object files that it cannot load."""


@contextlib.contextmanager
def quiet_warp() -> Iterator[None]:
    """Suppress Warp's banner and its messages on loading modules; explain errors of its cache."""
    level = wp.config.log_level
    wp.config.log_level = max(level, wp.LOG_WARNING)
    try:
        yield
    except Exception as error:
        # Warp describes object files by JSON files.
        of_cache = isinstance(error, OSError | json.JSONDecodeError)
        if not of_cache and not str(error).startswith(_BROKEN_CACHE):
            raise
        # The error's own name, as a second try repeats the version in the configuration.
        folder = getattr(error, "filename", None) or wp.config.kernel_cache_dir
        folder = folder or os.environ.get("WARP_CACHE_PATH", "Warp's cache")
        raise NPAError(
            "Warp's cache of compiled kernels must be an intact folder that can be written to, "
            f"but {shown(str(folder))} cannot be used ({shown(error)}): remove it, and kernels are "
            "compiled again, or set WARP_CACHE_PATH to another folder"
        ) from error
    finally:
        wp.config.log_level = level


@contextlib.contextmanager
def without_line(unwanted: bytes) -> Iterator[None]:
    """Remove lines with `unwanted` from what native code writes to standard error in the block."""
    try:
        stderr = os.dup(2)
    except OSError:  # There is no standard error.
        yield
        return
    with tempfile.TemporaryFile() as written:
        os.dup2(written.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
            written.seek(0)
            for line in written:
                if unwanted not in line:
                    os.write(2, line)


@cached_under_lock()
def start_warp() -> None:
    """Start Warp without output; later calls do nothing."""
    with without_line(_NO_DRIVER), quiet_warp():
        wp.init()  # type: ignore[no-untyped-call]
    # Exit handlers run in reverse order: the one that warns must be registered first.
    weakref.finalize(wp, int).detach()
    atexit.register(_remove_header_folders)


@contextlib.contextmanager
def in_turn(module: str) -> Iterator[None]:
    """Let one process at a time compile or load a module of kernels, within the block.

    Of several processes, on one computer or on several that share a folder, the first compiles; the
    others wait and load the result. The system releases the lock when a process ends, in any way.
    Without such locks, or if the cache cannot be written to, every process compiles.
    """
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):
            lock = (kernel_cache_folder() / f"{module}.lock").open("a", encoding="utf-8")
            stack.enter_context(lock)
            if fcntl is not None:
                fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _remove_header_folders() -> None:
    """Remove Warp's folders of precompiled headers: Python would warn of them at its exit."""
    runtime = getattr(sys.modules.get("warp._src.context"), "runtime", None)
    for folder in getattr(runtime, "_pch_dirs", {}).values():
        folder.cleanup()


def warp_devices() -> list[str]:
    """Return one line for each of Warp's devices; starts Warp."""
    start_warp()
    return [f"{device.alias}: {device.name}" for device in wp.get_devices()]


def kernel_cache_folder() -> Path:
    """Return the folder of compiled kernels; starts Warp."""
    start_warp()
    folder = wp.config.kernel_cache_dir
    assert folder is not None, "Warp sets its cache folder when it starts"
    return Path(folder)
