"""What users are told about the file of a target that was not used whole."""

from __future__ import annotations

import functools
import logging

logger = logging.getLogger("npa_envs.targets")


@functools.lru_cache(1024)
def left_out(name: str, text: str) -> None:
    """Warn, once in a process, of what was not used of a file.

    `name` is the file's name or path. `text` says what was left out, as in "its normals".
    """
    logger.warning("%s: left out: %s", name, text)
