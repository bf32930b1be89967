"""Where commands write."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType

from tqdm import tqdm

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


# The progress bar of the commands.


class StepBar:
    """A progress bar that counts steps; a context manager.

    Args:
        total: Steps to come; None where that is not known.
        show: Whether to show it at all.
        unit: What is counted.
    """

    def __init__(self, total: int | None, *, show: bool, unit: str = "step") -> None:
        self.done = 0
        """Steps done so far."""
        self._bar = tqdm(total=total, disable=not show, unit=unit)

    def advance(self, steps: int) -> None:
        """Count steps that are done.

        Args:
            steps: How many since the last call.
        """
        self.done += steps
        self._bar.update(steps)

    def __enter__(self) -> StepBar:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._bar.close()
