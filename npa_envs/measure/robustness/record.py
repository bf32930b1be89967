"""What was measured of each rule, as JSON that is written whole after every value."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from npa_envs.errors import NPAError
from npa_envs.files import json_text, plain_numbers, write_text
from npa_envs.measure.robustness.conditions import Response
from npa_envs.measure.robustness.recovery import Course


@dataclass(frozen=True)
class RuleRecord:
    """What was measured of one rule."""

    rule: str
    """Its name."""
    task: str
    """Its task."""
    metric: str
    """What losses are."""
    update_prob: float
    """Probability of an update as trained."""
    facts: Mapping[str, Any]
    """What the figures follow from: device, machine, size, seeds, commit, versions."""
    courses: tuple[Course, ...]
    """After each damage, the control first."""
    responses: tuple[Response, ...]
    """Under each condition."""
    done: bool = True
    """Whether that is all; else a run goes on with the next value."""
    seconds: float = 0.0
    """How long it took [s]."""
    command: str = ""
    """The command line."""
    date: str = ""
    """The day, as YYYY-MM-DD."""

    def trained(self) -> Response:
        """Return what comes of worlds as trained."""
        return next(r for r in self.responses if (r.condition, r.value) == ("eps", 1.0))

    def write(self, path: Path) -> None:
        """Write everything as JSON, whole or not at all; what is not finite becomes null.

        Args:
            path: The file.

        Raises:
            NPAError: It cannot be written.
        """
        content = asdict(self)
        for course, row in zip(self.courses, content["courses"], strict=True):
            row["recovery_steps"] = course.recovery_steps()
        write_text(path, json_text(content))


def read_record(path: Path, facts: Mapping[str, Any]) -> RuleRecord | None:
    """Return the record that a run left, None where there is none.

    Args:
        path: The file that it wrote.
        facts: What figures follow from now.

    Raises:
        NPAError: The file is no record, or its figures follow from something else.
    """
    if not path.exists():
        return None
    try:
        held = json.loads(path.read_text("utf-8"))
        before = held["facts"]
        held["courses"] = tuple(_course(row) for row in held["courses"])
        held["responses"] = tuple(
            Response(**row | {"losses": _numbers(row["losses"])}) for row in held["responses"]
        )
        record = RuleRecord(**held)
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise NPAError(
            f"{str(path)!r} must hold a record of npa-envs robustness, but cannot be read "
            f"({error}): remove it, or choose another folder with --output"
        ) from error
    for name, value in plain_numbers(facts).items():
        if before.get(name) != value:
            raise NPAError(
                f"{str(path)!r} holds figures of other settings: {name} was {before.get(name)!r}, "
                f"now {value!r}: remove it, or choose another folder with --output"
            )
    return record


def _course(row: dict[str, Any]) -> Course:
    return Course(
        row["damage"],
        tuple(row["steps"]),
        tuple(map(_numbers, row["losses"])),
        tuple(map(_numbers, row["twins"])),
    )


def _numbers(values: list[float | None]) -> tuple[float, ...]:
    return tuple(math.nan if value is None else float(value) for value in values)
