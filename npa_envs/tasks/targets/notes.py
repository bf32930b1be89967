"""What users are told about the file of a target: what was read of it, and what was not."""

from __future__ import annotations

import functools
import logging

from npa_envs.errors import shown

logger = logging.getLogger("npa_envs.targets")


def tell(line: str) -> None:
    """Log a line about what was read as a target, unless it is empty; `npa-envs` prints it."""
    if line:
        logger.info("%s", line)


@functools.lru_cache(1024)
def left_out(name: str, text: str, *, what: str = "left out") -> None:
    """Warn, once in a process, of what was not used of a file.

    `name` is the file's name or path. `text` says what was left out, as in "its normals"; `what` is
    the word before it.
    """
    # As in Python's own text, without letters that no terminal prints.
    logger.warning("%s: %s: %s", shown(name)[1:-1], what, text)
