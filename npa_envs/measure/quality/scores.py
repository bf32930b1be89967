"""What was measured of the shipped rules: the tables of `npa-envs evaluate`, beside each rule."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from npa_envs.errors import NPAError, suggest
from npa_envs.rule.files import shipped_rules

STEPS = (128, 256, 512, 1024, 4096)
"""Steps from the seed that a line of scores names, where they were measured."""

CLOUD_STEP = 32
"""Step at which clouds are asked what they are."""


def scores(name: str) -> dict[str, Any]:
    """Return what was measured of a shipped rule.

    Args:
        name: A name from `npa_envs.rule.files.shipped_rules`.

    Returns:
        `command`, `commit`, `date`, `machine`, `metric` (what the loss is), and tables, lists of
        rows by column: `growth` with `step`, `loss`, `psnr` [dB] and others, and for some rules
        `healing`; of a rule that classifies `accuracy` and `changes`.

    Raises:
        NPAError: There is no such rule.
    """
    rules = shipped_rules()
    if not isinstance(name, str) or name not in rules:
        raise NPAError(f"unknown rule {name!r}: {suggest(str(name), rules)}")
    found: dict[str, Any] = json.loads(rules[name].with_suffix(".json").read_text("utf-8"))
    return found


def score_line(measured: Mapping[str, Any]) -> str:
    """Return scores in a line.

    Args:
        measured: What `scores` returns.
    """
    if "accuracy" in measured:
        (row,) = (row for row in measured["accuracy"] if row["step"] == CLOUD_STEP)
        shares = f"{row['majority']:.1%} of clouds by majority, {row['particle']:.1%} of particles"
        return f"{shares} at step {CLOUD_STEP}"
    rows = [row for row in measured["growth"] if row["step"] in STEPS]
    if measured["metric"] == "view loss":
        return f"PSNR of held-out views {_at_steps(rows, 'psnr', '.1f', ' dB')}"
    return f"{measured['metric']} {_at_steps(rows, 'loss', '.3g', '')}"


def _at_steps(rows: Sequence[Mapping[str, Any]], column: str, form: str, unit: str) -> str:
    return ", ".join(f"{format(row[column], form)}{unit} at {row['step']}" for row in rows)
