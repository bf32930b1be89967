"""What came of a run, as JSON that is written whole once the run is over."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from npa_envs.agents.comparison.plan import Job
from npa_envs.errors import NPAError
from npa_envs.files import json_text, plain_numbers, write_text

Status = Literal["done", "diverged", "failed"]

RECORD, REQUEST, OUTPUT = "run.json", "request.json", "output.txt"
"""Files in the folder of a run: its record, what its process was asked for, what that said."""

MEASURED = ("done", "diverged")
"""What a resumed comparison does not run again."""


@dataclass(frozen=True)
class Point:
    """A place on a learning curve."""

    seconds: float
    """Wall time of training so far [s]."""
    particle_steps: float
    """Particles times steps so far."""
    mean_return: float
    """Mean return of held-out episodes."""
    standard_error: float
    """Its standard error."""
    final_loss: float
    """Mean loss at the episodes' ends."""


@dataclass(frozen=True, kw_only=True)
class RunRecord:
    """What came of one run."""

    job: Job
    """Which run."""
    facts: Mapping[str, Any]
    """What its figures follow from."""
    status: Status
    """"done"; "diverged": numbers became infinite or NaN; "failed": an error of another kind."""
    error: str = ""
    """What was raised, where it is not done."""
    curve: Sequence[Point] = ()
    """What held-out episodes gave while it learned."""
    returns: Sequence[float] = ()
    """Returns of the held-out episodes at the end."""
    final_losses: Sequence[float] = ()
    """Losses at the ends of the same episodes."""
    endings: Mapping[str, int] | None = None
    """How many of the same episodes ended for each reason."""
    seconds: float = 0.0
    """How long it took with set-up and evaluation [s]."""
    command: str = ""
    """The command line."""
    date: str = ""
    """The day, as YYYY-MM-DD."""

    @property
    def mean_return(self) -> float:
        """Mean return of the held-out episodes; NaN where there are none."""
        return _mean(self.returns)

    @property
    def mean_loss(self) -> float:
        """Mean loss at the ends of the held-out episodes; NaN where there are none."""
        return _mean(self.final_losses)

    def write(self, folder: Path) -> None:
        """Write everything as JSON, whole or not at all; what is not finite becomes null.

        Args:
            folder: The run's folder.

        Raises:
            NPAError: It cannot be written.
        """
        write_text(folder / RECORD, json_text(asdict(self)))


def read_record(folder: Path, facts: Mapping[str, Any]) -> RunRecord | None:
    """Return the record that a run left, None where there is none.

    Args:
        folder: The run's folder.
        facts: What figures follow from now.

    Raises:
        NPAError: The file is no record, or its figures follow from something else.
    """
    path = folder / RECORD
    if not path.exists():
        return None
    try:
        record = _record(json.loads(path.read_text("utf-8")))
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise NPAError(
            f"{str(path)!r} must hold a record of npa-envs compare, but cannot be read "
            f"({error}): remove its folder, or choose another one with --output"
        ) from error
    for name, value in plain_numbers(facts).items():
        if record.facts.get(name) != value:
            raise NPAError(
                f"{str(path)!r} holds figures of other settings: {name} was "
                f"{record.facts.get(name)!r}, now {value!r}: remove its folder, or choose another "
                "one with --output"
            )
    return record


def _record(held: dict[str, Any]) -> RunRecord:
    return RunRecord(
        **held
        | {
            "job": Job(**held["job"]),
            "facts": dict(held["facts"]),
            "curve": tuple(
                Point(**{k: _number(v) for k, v in row.items()}) for row in held["curve"]
            ),
            "returns": tuple(map(_number, held["returns"])),
            "final_losses": tuple(map(_number, held["final_losses"])),
        }
    )


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else math.nan


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)
