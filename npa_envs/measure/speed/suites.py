"""Suites of `npa-envs bench`: the tables that each makes, their report, plots and held ratios."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

import torch

from npa_envs.errors import NPAError, shown
from npa_envs.files import json_text, read_json
from npa_envs.measure.plots import new_figure, number_plainly, png
from npa_envs.measure.record import machine, versions
from npa_envs.measure.speed.errors import (
    composed_step,
    drawn_mask,
    drift_rows,
    peer_rows,
    perception_rows,
    rollout_rows,
)
from npa_envs.measure.speed.explain import kernel_rows
from npa_envs.measure.speed.strategies import PRECISIONS, STRATEGIES
from npa_envs.measure.speed.throughput import (
    AXES,
    CPU,
    ONE_WORLD,
    PAPER,
    PROFILED,
    PUBLIC,
    SMALL,
    ScalingRow,
    aim_rows,
    one_species_rows,
    public_rows,
    scaling_rows,
    skip_rows,
    slope_rows,
    throughput_rows,
)
from npa_envs.measure.speed.timing import LeftOut, Session, Tables
from npa_envs.measure.speed.workloads import Workload
from npa_envs.measure.tables import UNMEASURED, as_objects, table_text
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
    """Return the paper's table, what the public call costs there, and float32's errors."""
    workloads = SMALL if session.small else PAPER if session.cuda else CPU
    drifting = SMALL if session.small else PROFILED if session.cuda else (ONE_WORLD,)
    rows = throughput_rows(session, workloads)
    tables: Tables = {"throughput": rows, "drift": drift_rows(session, drifting)}
    if session.cuda:
        # On a CPU the throughput is that of the public call.
        tables["public"] = public_rows(session, SMALL if session.small else PUBLIC)
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
            parts.append(f"{name}:\n{table_text(rows, missing=UNMEASURED)}")
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


# Plots: fronts of run time against error, and how times grow.

FLOOR = 1e-16
"""Errors below this, as that of the float64 reference itself, are drawn here."""

COLOURS = dict(zip(STRATEGIES, ("C0", "C4", "C1", "C2", "C3"), strict=True))
"""Colour of each strategy."""

MARKERS = dict(zip(PRECISIONS, ("s", "o", "^", "D", "v"), strict=True))
"""Shape of each precision."""

AXIS_LABELS = {
    "particles": "particles N, same density",
    "neighbours": "neighbours of a particle",
    "worlds": "worlds B",
    "channels": "state channels C",
}
"""What the axes of the suite `scaling` are called."""


class Point(NamedTuple):
    """One way to compute something: its error (dimensionless) and its time [µs]."""

    error: float
    time: float
    strategy: str
    precision: str


def pictures(tables: Tables) -> dict[str, bytes]:
    """Return PNG files by their names, of tables that are there and whole. Needs matplotlib."""
    drawn = {}
    if tables.get("perception") and tables.get("rollouts"):
        drawn["pareto"] = png(_draw_fronts(tables["perception"], tables["rollouts"]))
    rows = tables.get("scaling", [])
    if {row.axis for row in rows} == set(AXES):
        drawn["scaling"] = png(_draw_scaling(rows, "time"))
        if any(row.infer_mib is not None for row in rows):
            drawn["memory"] = png(_draw_scaling(rows, "memory"))
    return drawn


def front(points: Iterable[Point]) -> list[Point]:
    """Return the points that no other one beats in both time and error, by increasing error."""
    best: list[Point] = []
    for point in sorted(points, key=lambda point: (point.error, point.time)):
        if not best or point.time < best[-1].time:
            best.append(point)
    return best


def _draw_fronts(perceptions: Sequence[Any], rollouts: Sequence[Any]) -> Any:
    largest = _largest_common(perceptions)
    perception = [
        Point(row.perception, row.forward_us.median, row.strategy, row.precision)
        for row in perceptions
        if (row.space_dim, row.worlds, row.particles) == (2, 1, largest)
    ]
    most = max(row.particles for row in rollouts)
    steps = [
        Point(row.s_8, row.step_us.median, row.strategy, row.precision)
        for row in rollouts
        if row.particles == most
    ]
    figure, (axes,) = new_figure(1, 2, (9.2, 3.8))
    _draw_front(axes[0], perception, "relative error of perception z", "time [µs]")
    axes[0].set_title(f"one perception, N {largest}")
    _draw_front(axes[1], steps, "relative error of states after 8 steps", "time of a step [µs]")
    axes[1].set_title(f"gecko, p 0.5, N {most}")
    _add_legend(figure, [*perception, *steps])
    return figure


def _largest_common(rows: Sequence[Any]) -> int:
    """Return the most particles of a 2D world that every strategy was measured on."""
    counts: set[int] = {row.particles for row in rows if (row.space_dim, row.worlds) == (2, 1)}
    names: dict[int, set[str]] = {count: set() for count in counts}
    for row in rows:
        if row.particles in counts:
            names[row.particles].add(row.strategy)
    return max(counts, key=lambda count: (len(names[count]), count))


def _draw_front(axis: Any, points: Sequence[Point], across: str, up: str) -> None:
    """Draw points, coloured by strategy and shaped by precision, over the front of the best."""
    drawn = [point._replace(error=max(point.error, FLOOR)) for point in points]
    best = front(drawn)
    line = [point.error for point in best], [point.time for point in best]
    axis.step(*line, where="post", color="0.8", zorder=1)
    for point in drawn:
        axis.scatter(
            point.error,
            point.time,
            color=COLOURS[point.strategy],
            marker=MARKERS[point.precision],
            s=36,
            zorder=2,
        )
    axis.set(xscale="log", yscale="log", xlabel=across, ylabel=up)
    axis.margins(0.08)
    number_plainly(axis.yaxis)
    axis.grid(alpha=0.3)


def _add_legend(figure: Any, points: Sequence[Point]) -> None:
    """Say which colours and shapes stand for what."""
    from matplotlib.lines import Line2D

    strategies = dict.fromkeys(point.strategy for point in points)
    precisions = dict.fromkeys(point.precision for point in points)
    marks = [
        *(
            Line2D([], [], ls="", marker="o", color=COLOURS[name], label=name)
            for name in strategies
        ),
        *(
            Line2D([], [], ls="", marker=MARKERS[name], color="0.4", label=name)
            for name in precisions
        ),
        Line2D([], [], color="0.8", label="front"),
    ]
    figure.legend(handles=marks, loc="outside lower center", ncols=5, fontsize=8)


def _draw_scaling(table: Sequence[ScalingRow], what: str) -> Any:
    figure, grid = new_figure(2, 2, (9.2, 7.6))
    panels = grid.ravel()
    for name, panel in zip(AXES, panels, strict=True):
        rows = [row for row in table if row.axis == name]
        for label, values in _curves(rows, what).items():
            panel.plot([row.value for row in rows], values, marker="o", ms=4, label=label)
        panel.set(xscale="log", yscale="log", xlabel=AXIS_LABELS[name])
        panel.set_ylabel("time of a step [µs]" if what == "time" else "peak memory [MiB]")
        number_plainly(panel.xaxis, [row.value for row in rows])
        number_plainly(panel.yaxis)
        panel.tick_params(axis="x", labelsize=8)
        panel.grid(alpha=0.3)
    panels[0].legend(fontsize=8)
    return figure


def _curves(rows: Sequence[ScalingRow], what: str) -> dict[str, list[float | None]]:
    """Return the values of each curve; what was not measured is a gap."""
    if what == "memory":
        return {
            "inference": [row.infer_mib for row in rows],
            "training": [row.train_mib for row in rows],
        }
    return {
        "inference": [row.infer_us.median for row in rows],
        "training": [row.train_us.median if row.train_us else None for row in rows],
    }


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
    cure = "take `ratios` from the JSON of `npa-envs bench --quick --out DIR`"
    try:
        loaded = read_json(path)
        return {str(name): float(value) for name, value in loaded[device.type].items()}
    except (NPAError, ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise NPAError(
            f"{str(path)!r} must hold ratios under {device.type!r}, got {shown(error)}: {cure}"
        ) from error


def missed_ratios(measured: Mapping[str, float], stored: Mapping[str, float]) -> list[str]:
    """Return a line for each stored ratio that is missed; none where all are held."""
    return [
        f"{name}: {measured.get(name, math.nan):.3g}, stored {value:.3g}, "
        f"at least {value / TOLERANCE:.3g} wanted"
        for name, value in stored.items()
        if not measured.get(name, math.nan) >= value / TOLERANCE
    ]
