"""Suites of `npa-envs bench`: the tables that each makes, their report, ratios that are held."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Any

import torch

from npa_envs.errors import NPAError
from npa_envs.files import json_text
from npa_envs.measure.record import machine, versions
from npa_envs.measure.speed.errors import (
    composed_step,
    drawn_mask,
    drift_rows,
    perception_rows,
    rollout_rows,
)
from npa_envs.measure.speed.explain import kernel_rows
from npa_envs.measure.speed.peers import peer_rows
from npa_envs.measure.speed.strategies import STRATEGIES
from npa_envs.measure.speed.throughput import (
    CPU,
    ONE_WORLD,
    PAPER,
    PROFILED,
    SMALL,
    aim_rows,
    one_species_rows,
    scaling_rows,
    skip_rows,
    slope_rows,
    throughput_rows,
)
from npa_envs.measure.speed.timing import LeftOut, Session, Tables
from npa_envs.measure.speed.workloads import Workload
from npa_envs.measure.tables import as_objects, table_text
from npa_envs.world.rollout import step


def accuracy(session: Session) -> Tables:
    """Return run time against error: of perception, of rollouts, of other libraries."""
    geckos = [1024] if session.small else [1024, 4096]
    flat = Workload(2, 1, 1024, 1)
    compared = [flat, Workload(3, 1, 512 if session.small else 1024, 1)]
    worlds = compared
    if not session.small:
        larger = [(2, 1, 4096), (2, 1, 65536 if session.cuda else 16384), (2, 8, 4096)]
        worlds = [flat, *(Workload(*sizes, 1) for sizes in larger), compared[1]]
        worlds.append(Workload(3, 1, 16384, 1))
    return {
        "perception": [row for world in worlds for row in perception_rows(session, world)],
        "rollouts": [row for count in geckos for row in rollout_rows(session, count)],
        "peers": [row for world in compared for row in peer_rows(session, world)],
    }


def paper(session: Session) -> Tables:
    """Return the paper's table: inference, training and memory; and float32's errors there."""
    workloads = SMALL if session.small else PAPER if session.cuda else CPU
    drifting = SMALL if session.small else PROFILED if session.cuda else (ONE_WORLD,)
    rows = throughput_rows(session, workloads)
    tables: Tables = {"throughput": rows, "drift": drift_rows(session, drifting)}
    if session.cuda and not session.small:
        tables["aims"] = aim_rows(rows)
    return tables


def scaling(session: Session) -> Tables:
    """Return time and memory against N, neighbours, B and C."""
    rows = scaling_rows(session)
    return {"scaling": rows, "slopes": slope_rows(rows)}


def quick(session: Session) -> Tables:
    """Return the small tables of the suites `accuracy` and `paper`."""
    session.small = True
    return {**accuracy(session), **paper(session)}


SUITES: dict[str, Callable[[Session], Tables]] = {
    "quick": quick,
    "paper": paper,
    "accuracy": accuracy,
    "scaling": scaling,
    "skips": lambda session: {"skips": skip_rows(session)},
    "species": lambda session: {"one_species": one_species_rows(session)},
    "kernels": lambda here: {"kernels": kernel_rows(here, SMALL if here.small else PROFILED)},
}
"""What makes the tables of each suite."""


# The report


@dataclass(frozen=True)
class Report:
    """One run of one suite."""

    suite: str
    command: str
    commit: str
    """Commit that was measured."""
    device: torch.device
    threads: int
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
        by_reason: dict[str, list[str]] = {}
        for entry in self.left_out:
            by_reason.setdefault(entry.why, []).append(entry.what)
        if by_reason:
            lines = [f"  {why}: {'; '.join(names)}" for why, names in by_reason.items()]
            parts.append("\n".join(["left out:", *lines]))
        return "\n\n".join(parts)

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
            "tables": {name: as_objects(rows) for name, rows in self.tables.items()},
            "ratios": dict(self.ratios),
            "left_out": as_objects(self.left_out),
        }
        return json_text(content)


# Ratios of times within one run, which hold on any machine of a kind, and their check.

WORKLOAD = Workload(2, 1, 1024, 1)
"""Small enough for dense torch."""

TOLERANCE = 3.0
"""A ratio passes if it is at least the stored one divided by this: other machines, other loads."""


def ratios(session: Session) -> dict[str, float]:
    """Return how many times faster the library is than each thing it is compared with."""
    x, s = WORKLOAD.worlds(session.device)
    rule = WORKLOAD.rule(session.device)
    generator = torch.Generator(session.device).manual_seed(1)

    def time_of(run: Any, graph: bool) -> float:
        session.progress(1)
        return session.cost(run, graph=graph, generator=generator).time.median

    def perceive(name: str) -> float:
        strategy = STRATEGIES[name]
        return time_of(lambda: strategy.perceive(x, s, WORKLOAD.eps), strategy.capturable)

    def pull_back(name: str) -> float:
        strategy, states = STRATEGIES[name], s.clone().requires_grad_()
        return time_of(
            lambda: torch.autograd.grad(strategy.perceive(x, states, WORKLOAD.eps).sum(), states),
            strategy.capturable,
        )

    @torch.no_grad()
    def composed() -> None:
        mask = drawn_mask(x, WORKLOAD.update_prob, generator)
        composed_step(STRATEGIES["library"], rule, x, s, mask)

    @torch.no_grad()
    def fused() -> None:
        step(rule, x, s, update_prob=WORKLOAD.update_prob, generator=generator)

    own = perceive("library")
    return {
        "perceive: dense torch over library": perceive("dense") / own,
        "perceive: hash grid over library": perceive("hash_grid") / own,
        "gradient: dense torch over library": pull_back("dense") / pull_back("library"),
        "step: composed in torch over fused": time_of(composed, True) / time_of(fused, True),
    }


def stored_ratios(path: Path, device: torch.device) -> dict[str, float]:
    """Return the ratios that are to be held, of JSON {"cpu": {name: ratio}, "cuda": {...}}.

    Raises:
        NPAError: The file cannot be read or holds nothing for this kind of device.
    """
    cure = "take `ratios` from the JSON of `npa-envs bench --quick --output DIR`"
    try:
        loaded = json.loads(path.read_text(encoding="utf-8"))
        return {str(name): float(value) for name, value in loaded[device.type].items()}
    except OSError as error:
        raise NPAError(f"cannot read {str(path)!r} ({error.strerror}): {cure}") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise NPAError(
            f"{str(path)!r} must hold ratios under {device.type!r}, got {error!r}: {cure}"
        ) from error


def missed_ratios(measured: Mapping[str, float], stored: Mapping[str, float]) -> list[str]:
    """Return a line for each stored ratio that is missed; none where all are held."""
    return [
        f"{name}: {measured.get(name, math.nan):.3g}, stored {value:.3g}, "
        f"at least {value / TOLERANCE:.3g} wanted"
        for name, value in stored.items()
        if not measured.get(name, math.nan) >= value / TOLERANCE
    ]
