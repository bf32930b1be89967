"""Runs of training that were killed, kept as files."""

import shutil
from pathlib import Path

CHECKPOINT_INTERVAL = 6

ITERATIONS = 12

OPTIONS = (
    "--preset",
    "tiny",
    "--iterations",
    str(ITERATIONS),
    "--checkpoint-interval",
    str(CHECKPOINT_INTERVAL),
    "--picture-interval",
    str(CHECKPOINT_INTERVAL),
    "--no-progress",
)
"""What the runs were started with."""

FOLDERS = {
    "morphogenesis2d": "unfinished_run",
    "co_morphogenesis2d": "unfinished_joint_run",
}
"""Folders by task."""


def keep(run: Path, folder: Path) -> None:
    """Replace a kept run by another.

    Args:
        run: The run's folder.
        folder: Where it is kept.
    """
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(run, folder)
