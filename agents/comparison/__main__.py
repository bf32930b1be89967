"""One run of a comparison as a process: `python -m npa_envs.agents.comparison FOLDER`.

It gets ready, waits for a line on its input that names a device, and does there what is asked for;
it ends when its input does.
"""

from __future__ import annotations

import os
import sys
import threading
from pathlib import Path
from queue import SimpleQueue


def main(folder: Path) -> None:
    """Do what is asked for in a folder once a device is named, unless the comparison ends before.

    Args:
        folder: The run's folder.
    """
    lines: SimpleQueue[str] = SimpleQueue()
    threading.Thread(target=_listen, args=(lines,), daemon=True).start()
    # Not before, as it takes seconds.
    from npa_envs.agents.comparison.run import prepare, run

    prepare(folder)
    run(folder, lines.get())


def _listen(lines: SimpleQueue[str]) -> None:
    """Pass lines on, and end the process once the pipe has no other end."""
    for line in sys.stdin:
        lines.put(line.strip())
    os._exit(1)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
