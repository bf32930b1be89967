"""Lets a process end soon after the one that started it; needs no torch."""

from __future__ import annotations

import os
import signal
import threading
import time

PARENT_PIPE = "NPA_ENVS_PARENT_PIPE"
"""The environment variable by which a parent says that it holds the other end of the input."""

PARENT_GRACE = 10.0
"""Time in which a process saves and ends after its parent has gone [s]."""

LOST_CODE = 2
"""Exit code of a process that has lost another one, that of errors on the command line."""


def end_with_parent() -> None:
    """Let this process end soon after its parent, where `PARENT_PIPE` is in the environment.

    Such a parent starts it with a pipe as standard input, and never writes. When it closes the
    pipe or ends, also by SIGKILL, this process gets SIGTERM, on which a run saves, and is ended
    after `PARENT_GRACE`. The processes of torch's launcher inherit pipe and variable.
    """
    if PARENT_PIPE not in os.environ:
        return

    def watch() -> None:
        while os.read(0, 1):
            pass
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(PARENT_GRACE)
        os._exit(LOST_CODE)

    threading.Thread(target=watch, name="npa-envs parent", daemon=True).start()
