"""One run of a comparison as a process: `python -m npa_envs.agents.comparison FOLDER`."""

from __future__ import annotations

import os
import sys
import threading
from pathlib import Path


def main(folder: Path) -> None:
    """Do what is asked for in a folder, unless the comparison ends before.

    Args:
        folder: The run's folder.
    """
    threading.Thread(target=_end_with_the_comparison, daemon=True).start()
    # Not before, as it takes seconds.
    from npa_envs.agents.comparison.run import run

    run(folder)


def _end_with_the_comparison() -> None:
    # Nothing is ever written there: the pipe ends when the process that holds it does.
    os.read(sys.stdin.fileno(), 1)
    os._exit(1)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
