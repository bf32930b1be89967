"""The files that show a whole comparison, written anew whenever a run is over."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from npa_envs.agents.comparison.pictures import write_strips
from npa_envs.agents.comparison.plan import Plan
from npa_envs.agents.comparison.plots import pictures
from npa_envs.agents.comparison.record import RunRecord
from npa_envs.agents.comparison.tables import as_json, curves, rows, text
from npa_envs.files import write_text
from npa_envs.measure.speed.plots import write_plots

TABLE, FIGURES, CURVES = "comparison.md", "comparison.json", "comparison.csv"
"""Names of the files of the table, and of the curves."""


def write_table(plan: Plan, records: Sequence[RunRecord], folder: Path, command: str) -> str:
    """Write the table, in Markdown and as JSON, and all curves; return the table in Markdown.

    Args:
        plan: What was compared.
        records: Those of the runs that are over.
        folder: The comparison's folder.
        command: The command line.

    Raises:
        NPAError: A file cannot be written.
    """
    table = rows(records)
    told = text(table) + _sharing(plan)
    write_text(folder / TABLE, f"`{command}`\n\n{told}")
    write_text(folder / FIGURES, as_json(table, _facts(plan, command)))
    write_text(folder / CURVES, curves(records))
    return told


def _sharing(plan: Plan) -> str:
    """Return what is to be said where runs of equal wall time were not alone; else nothing."""
    at_once = plan.settings.get("runs_at_once", 1)
    if "seconds" not in plan.budgets or at_once == 1:
        return ""
    return (
        f"\nUp to {at_once} runs at once shared a device: what each had of it in its wall time is "
        "not controlled.\n"
    )


def _facts(plan: Plan, command: str) -> dict[str, Any]:
    """Return what a table follows from, as JSON has it."""
    fields = asdict(plan) | {"left_out": sorted(map(list, plan.left_out))}
    return {"command": command, **fields}


def write_pictures(records: Sequence[RunRecord], folder: Path) -> list[str]:
    """Write what was grown and, where matplotlib is installed, the curves; return what was done.

    Args:
        records: Those of the runs that are over.
        folder: The comparison's folder.

    Raises:
        NPAError: A file cannot be written.
    """
    strips = [f"wrote {path}" for path in write_strips(records, folder)]
    return [*strips, *write_plots(lambda: pictures(records), folder / "curves_*.png", "curves")]
