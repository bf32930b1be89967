"""One run of a comparison as a process: `python -m npa_envs.agents.comparison FOLDER`.

It gets ready, waits for a byte on its input, then does what is asked for; it ends when its input
does.
"""

from __future__ import annotations

import os
import sys
import threading
from pathlib import Path


def main(folder: Path) -> None:
    """Do what is asked for in a folder once it is told to, unless the comparison ends before.

    Args:
        folder: The run's folder.
    """
    told = threading.Event()
    threading.Thread(target=_listen, args=(told,), daemon=True).start()
    # Not before, as it takes seconds.
    from npa_envs.agents.comparison.run import prepare, run

    prepare(folder)
    told.wait()
    run(folder)


def _listen(told: threading.Event) -> None:
    """Set the event at the first byte; end the process once the pipe has no other end."""
    while os.read(sys.stdin.fileno(), 1):
        told.set()
    os._exit(1)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
