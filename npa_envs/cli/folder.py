"""Where commands write."""

from __future__ import annotations

from pathlib import Path

from npa_envs.errors import NPAError


def make_folder(path: Path) -> Path:
    """Create a folder, and those above it, where missing.

    Args:
        path: The folder.

    Raises:
        NPAError: It cannot be created.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise NPAError(
            f"out must be a folder that can be created, got {str(path)!r} "
            f"({error.strerror or error}): choose another one"
        ) from error
    return path
