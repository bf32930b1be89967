"""What a run of the benchmark leaves: a text for the eye, JSON for the record."""

from __future__ import annotations

import platform
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import date
from pathlib import Path

import torch

from npa_envs.diagnostics import installed_version
from npa_envs.files import json_text
from npa_envs.measure.speed.session import LeftOut, Tables
from npa_envs.measure.tables import table_text

LIBRARIES = ("npa-envs", "torch", "warp-lang", "numpy", "scipy", "warpSPHCore")
"""Distributions whose versions are recorded."""


@dataclass(frozen=True)
class Report:
    """One run of one suite."""

    suite: str
    """Its name."""
    command: str
    """The command line."""
    commit: str
    """Commit that was measured."""
    device: torch.device
    """Where."""
    threads: int
    """CPU threads of torch."""
    tables: Tables
    """Rows by the table's name."""
    left_out: Sequence[LeftOut]
    """What was not measured."""
    ratios: Mapping[str, float] = field(default_factory=dict)
    """How many times faster the library is than what it is compared with."""

    def text(self) -> str:
        """Return the tables as plain text."""
        parts = [f"{self.suite} on {machine(self.device)}, commit {self.commit}"]
        for name, rows in self.tables.items():
            parts.append(f"{name}:\n{table_text(rows, missing='-')}")
        if self.ratios:
            lines = [f"  {name}: {value:.3g}" for name, value in self.ratios.items()]
            parts.append("\n".join(["times faster:", *lines]))
        if self.left_out:
            parts.append("\n".join(["left out:", *self._reasons()]))
        return "\n\n".join(parts)

    def _reasons(self) -> list[str]:
        """Return a line for each reason to leave something out."""
        by_reason: dict[str, list[str]] = {}
        for entry in self.left_out:
            by_reason.setdefault(entry.why, []).append(entry.what)
        return [f"  {why}: {'; '.join(names)}" for why, names in by_reason.items()]

    def json(self) -> str:
        """Return everything as JSON; a number that is not finite becomes null."""
        content = {
            "suite": self.suite,
            "command": self.command,
            "commit": self.commit,
            "date": date.today().isoformat(),
            "device": self.device.type,
            "machine": machine(self.device),
            "threads": self.threads,
            "versions": versions(),
            "tables": {name: [asdict(row) for row in rows] for name, rows in self.tables.items()},
            "ratios": dict(self.ratios),
            "left_out": [asdict(entry) for entry in self.left_out],
        }
        return json_text(content)


def machine(device: torch.device) -> str:
    """Return the name of a device's hardware."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"CPU ({_processor()})"


def script_facts(commit: str, device: torch.device) -> dict[str, str]:
    """Return what the record of a script in `benchmarks/` begins with.

    Args:
        commit: Commit that is measured.
        device: Where.
    """
    return {
        "command": " ".join(["python", *sys.argv]),
        "commit": commit,
        "date": date.today().isoformat(),
        "machine": machine(device),
        "torch": torch.__version__,
    }


def _processor() -> str:
    """Return the processor's name as Linux tells it, or what Python knows."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def versions() -> dict[str, str | None]:
    """Return versions of Python and of the libraries that matter; None: not installed."""
    found: dict[str, str | None] = {name: installed_version(name) for name in LIBRARIES}
    return {"python": platform.python_version(), **found}


def current_commit() -> str:
    """Return the short hash of the checkout that this file lies in, "unknown" without one."""
    command = ["git", "describe", "--always", "--dirty", "--exclude=*"]
    try:
        done = subprocess.run(
            command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return done.stdout.strip()
