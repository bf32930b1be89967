"""Common parts of the commands: options, folders to write to, checks, progress bars."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any

import tyro
from tqdm import tqdm

from npa_envs.errors import NPAError, suggest


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Options of commands that run worlds."""

    device: str = "cpu"
    """Where to run: cpu, cuda, cuda:1."""

    progress: bool = True
    """Show a progress bar."""


@dataclass(frozen=True, kw_only=True)
class RuleOptions(RunOptions):
    """Options of commands that run one rule: which one, in which world, and where."""

    rule: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RULE")]
    """A shipped rule (`npa-envs list`), a file of ours or the authors' (.safetensors, .pth), or a
    rule of their web demo (models.json#name)."""

    target: str | None = None
    """The target to measure against; default: the one that the rule was trained on."""

    loss: str | None = None
    """Textures only: the loss to measure by (`npa-envs list`); default: as trained."""

    data: str | None = None
    """Point clouds only: "digits", "mnist" or a folder of IDX files; default: as trained."""

    particle_count: int | None = None
    """Particles N; default: as trained."""

    eps: float | None = None
    """Perception radius [length units]; default: as trained."""

    update_prob: float | None = None
    """Probability of each particle's update in a step; default: as trained."""

    def world(self) -> dict[str, Any]:
        """Return what was said of the rule's world, as `task_of_rule` takes it."""
        names = ("target", "loss", "data", "particle_count", "eps", "update_prob")
        return {name: getattr(self, name) for name in names}


def writable_folder(path: Path) -> Path:
    """Create a folder where missing, and check that files can be made in it, before work is done.

    Raises:
        NPAError: It cannot be created, or files in it cannot.
    """
    must = "created"
    try:
        path.mkdir(parents=True, exist_ok=True)
        must = "written to"
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise NPAError(
            f"out must be a folder that can be {must}, got {str(path)!r} "
            f"({error.strerror or error}): choose another one"
        ) from error
    return path


@dataclass(frozen=True, kw_only=True)
class MeasureOptions(RunOptions):
    """Options of the commands that measure and keep records."""

    threads: int = 1
    """CPU threads of torch and of the kernels, of each run; figures are the same, times are not."""

    commit: str | None = None
    """Commit that is measured; default: that of the checkout."""


def check_numbers(options: Any, **least: int) -> None:
    """Check that options of a command, where given, are at least so large, and its time limit.

    Raises:
        NPAError: One is smaller, or `max_seconds` is not positive.
    """
    for name, smallest in least.items():
        value = getattr(options, name)
        if value is not None and value < smallest:
            raise NPAError(f"{name} must be at least {smallest}, got {value}")
    seconds = getattr(options, "max_seconds", None)
    if seconds is not None and not seconds > 0.0:
        raise NPAError(f"max_seconds must be positive, got {seconds}: leave it out for no limit")


def chosen_names(kind: str, names: Sequence[str], known: Iterable[str]) -> list[str]:
    """Return those known names that were asked for, in their own order; all where none was.

    Raises:
        NPAError: A name is not known.
    """
    known = list(known)
    for name in names:
        if name not in known:
            raise NPAError(f"unknown {kind} {name!r}: {suggest(name, known)}")
    return [name for name in known if not names or name in names]


@contextlib.contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Let torch use so many CPU threads while a block runs."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class StepBar:
    """A progress bar that counts steps or another unit; a context manager.

    `total` is None where it is not known.
    """

    def __init__(self, total: int | None, *, show: bool, unit: str = "step") -> None:
        self.done = 0
        """Steps done so far."""
        self._bar = tqdm(total=total, disable=not show, unit=unit)

    def advance(self, steps: int) -> None:
        """Count steps that are done since the last call."""
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
