"""A search that can be stopped: its record, its growth, and the elites that it leaves."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from npa_envs.agents.search.methods import METHODS, make_archive, qualities_and_measures
from npa_envs.agents.search.worlds import Axis, Candidates, Found, SearchWorld
from npa_envs.checks import is_whole
from npa_envs.errors import NPAError, shown, suggest
from npa_envs.measure.record import installed_version, read_record, write_record

RESULTS = "search.json"
"""The file that a stopped search goes on from."""

LIBRARIES = ("numpy", "ribs", "cma")
"""Libraries whose other versions may propose other candidates."""


class Growth(NamedTuple):
    """An archive after some candidates."""

    evaluations: int
    """Candidates tried so far."""
    qd_score: float
    """Sum of the elites' qualities."""
    coverage: float
    """Share of the cells that hold an elite."""
    best: float
    """Quality of the best elite, 0 without any."""


class Elite(NamedTuple):
    """The best candidate of a cell."""

    cell: tuple[int, ...]
    """Place on each axis, from 0."""
    found: Found
    """Its quality and descriptors."""
    solution: NDArray[np.float64]
    """Its weights in units of `Candidates.scales`, shape [W]."""

    @property
    def name(self) -> str:
        """Name of its files, such as "3-4-1"."""
        return "-".join(map(str, self.cell))


Batch = dict[str, Any]
"""Candidates that were tried together, as in the record: "fingerprint", the CRC-32 of their
weights, and "found", quality and descriptors of each, or None where nothing is alive."""


class Search:
    """A search for rules that differ, in worlds of one kind.

    The same settings give the same elites. A record holds the results of all candidates, but not
    their weights: a resumed search proposes the same candidates once more and does not try them.

    Args:
        world: Where candidates live.
        method: What proposes them, a name of `METHODS`.
        seed: Of the proposals, at least 0. All candidates meet the same worlds.
        batch_size: Candidates that are proposed together, at least 2.
        device: Where worlds are computed.
        path: The record, which is written after each batch, or None. Where it exists, the search
            goes on from it.

    Raises:
        NPAError: A setting is wrong, or the record is of other settings.
        MissingDependencyError: pyribs or cma is not installed.
    """

    def __init__(
        self,
        world: SearchWorld,
        *,
        method: str = "map-elites",
        seed: int = 0,
        batch_size: int = 20,
        device: torch.device,
        path: Path | None = None,
    ) -> None:
        if method not in METHODS:
            raise NPAError(f"unknown method {shown(method)}: {suggest(method, METHODS)}")
        for name, value, least in (("seed", seed, 0), ("batch_size", batch_size, 2)):
            if not is_whole(value) or value < least:
                raise NPAError(
                    f"{name} must be a whole number of at least {least}, got {shown(value)}"
                )
        self.world = world
        self.axes: tuple[Axis, ...] = world.axes()
        """The descriptors."""
        self.candidates = Candidates(world, device=device)
        self.growth: list[Growth] = []
        """The archive after each batch."""
        self.facts: dict[str, Any] = {
            **asdict(world),
            "method": method,
            "seed": seed,
            "batch_size": batch_size,
            "device": device.type,
            "axes": [list(axis) for axis in self.axes],
            "versions": {name: installed_version(name) for name in LIBRARIES},
        }
        """Facts that the elites depend on."""
        self._batches: list[Batch] = []
        self._path = path
        self.archive = make_archive(self.candidates.weight_count, self.axes, seed)
        """The elites, a `ribs.archives.GridArchive`."""
        self._proposals = METHODS[method](self.archive, batch_size, seed)
        if path is not None:
            self._replay(path)

    @property
    def evaluations(self) -> int:
        """Candidates that have been tried."""
        return sum(len(batch["found"]) for batch in self._batches)

    @property
    def particle_steps(self) -> int:
        """Their cost: B N T each."""
        return self.evaluations * self.world.particle_steps

    def run(
        self,
        budget: int,
        *,
        enough: Callable[[], bool] = lambda: False,
        progress: Callable[[int], None] = lambda _: None,
    ) -> None:
        """Try candidates until the next batch would cost more than the budget in all.

        Args:
            budget: Particle-steps of the whole search, what was done before included.
            enough: Asked after each batch whether to stop early.
            progress: Called with the particle-steps of each batch.
        """
        batch_cost = int(self.facts["batch_size"]) * self.world.particle_steps
        while self.particle_steps + batch_cost <= budget and not enough():
            solutions = self._proposals.ask()
            found = self.candidates.try_all(solutions).found
            results = [None if one is None else [one.quality, *one.measures] for one in found]
            self._tell({"fingerprint": _fingerprint(solutions), "found": results})
            progress(len(found) * self.world.particle_steps)
            if self._path is not None:
                growth = [list(step) for step in self.growth]
                content = {"facts": self.facts, "growth": growth, "batches": self._batches}
                write_record(self._path, content)

    def elites(self) -> list[Elite]:
        """Return the best candidate of each cell that has one, cell by cell."""
        held = self.archive.data(["index", "solution", "objective", "measures"])
        cells = self.archive.int_to_grid_index(held["index"])
        elites = [
            Elite(
                tuple(int(number) for number in cell),
                Found(float(quality), tuple(float(value) for value in measures)),
                np.asarray(solution),
            )
            for cell, quality, measures, solution in zip(
                cells, held["objective"], held["measures"], held["solution"], strict=True
            )
        ]
        return sorted(elites, key=lambda elite: elite.cell)

    def _tell(self, batch: Batch) -> None:
        found = [None if one is None else Found(one[0], tuple(one[1:])) for one in batch["found"]]
        self._proposals.tell(*qualities_and_measures(found, self.axes))
        self._batches.append(batch)
        self.growth.append(growth_of(self.archive, self.evaluations))

    def _replay(self, path: Path) -> None:
        """Propose again the candidates of a record, and tell their results."""

        def read(held: dict[str, Any]) -> list[Batch]:
            return [
                {
                    "fingerprint": int(batch["fingerprint"]),
                    "found": [one and list(map(float, one)) for one in batch["found"]],
                }
                for batch in held["batches"]
            ]

        for batch in read_record(path, self.facts, read, command="search") or []:
            asked = self._proposals.ask()
            if _fingerprint(asked) != batch["fingerprint"] or len(asked) != len(batch["found"]):
                raise NPAError(
                    f"{str(path)!r} must tell of the candidates that are proposed here, but batch "
                    f"{len(self._batches)} is of others (another machine?): remove it, or choose "
                    "another folder with --out"
                )
            self._tell(batch)


def growth_of(archive: Any, evaluations: int) -> Growth:
    """Return the growth of an archive."""
    stats = archive.stats
    best = 0.0 if stats.obj_max is None else float(stats.obj_max)
    return Growth(evaluations, float(stats.qd_score), float(stats.coverage), best)


def tried_again(search: Search, seeds: Sequence[int], *, steps: int | None = None) -> Growth:
    """Return the growth of an archive of the same elites, tried once more in other worlds.

    Args:
        search: Of the elites.
        seeds: The worlds' numbers; each elite meets all.
        steps: Steps from the seed, of which the later half is judged; default: as searched.

    Raises:
        NPAError: The number of steps is no multiple of 16.
    """
    world = search.world if steps is None else replace(search.world, steps=steps)
    candidates = Candidates(world, device=search.candidates.device, seeds=seeds)
    archive = make_archive(candidates.weight_count, search.axes)
    elites = search.elites()
    if elites:
        solutions = np.stack([elite.solution for elite in elites])
        archive.add(
            solutions, *qualities_and_measures(candidates.try_all(solutions).found, search.axes)
        )
    return growth_of(archive, len(elites))


def _fingerprint(solutions: NDArray[np.float64]) -> int:
    return zlib.crc32(np.ascontiguousarray(solutions, dtype=np.float64).tobytes())
