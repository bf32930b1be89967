"""A search that can be stopped: its record, its growth, and the elites that it leaves."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from npa_envs.agents.search.methods import METHODS, as_told, make_archive
from npa_envs.agents.search.worlds import Axis, Candidates, Found, SearchWorld
from npa_envs.checks import is_whole
from npa_envs.errors import NPAError, shown, suggest
from npa_envs.measure.record import installed_version, read_record, write_record

RESULTS = "search.json"
"""The file that a stopped search goes on from."""

LIBRARIES = ("numpy", "ribs", "cma")
"""What proposals follow from besides the settings; other versions may propose others."""


class Growth(NamedTuple):
    """What an archive holds after some candidates."""

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
    """Which cell of each axis, from 0."""
    found: Found
    """Its quality and descriptors."""
    solution: NDArray[np.float64]
    """Its weights in units of `Candidates.scales`, shape [W]."""

    @property
    def name(self) -> str:
        """What its files are called, such as "3-4-1"."""
        return "-".join(map(str, self.cell))


@dataclass
class CandidateBatch:
    """Candidates that were tried together."""

    fingerprint: int
    """CRC-32 of their weights."""
    found: list[Found | None]
    """What each came to; None: nothing alive."""

    @classmethod
    def of(cls, told: Mapping[str, Any]) -> CandidateBatch:
        """Return the batch that a record tells of."""
        found = [None if one is None else Found(one[0], tuple(one[1:])) for one in told["found"]]
        return cls(int(told["fingerprint"]), found)

    def to_dict(self) -> dict[str, Any]:
        """Return the batch as a record tells it: quality and descriptors of each candidate."""
        found = [None if one is None else [one.quality, *one.measures] for one in self.found]
        return {"fingerprint": self.fingerprint, "found": found}


class Search:
    """A search for rules that differ, in worlds of one kind.

    The same settings give the same elites. A record holds what all candidates came to, but not
    their weights: to go on, the same candidates are proposed once more and not tried again.

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
        """What tries candidates."""
        self.growth: list[Growth] = []
        """What the archive held after each batch."""
        self.facts: dict[str, Any] = {
            **asdict(world),
            "method": method,
            "seed": seed,
            "batch_size": batch_size,
            "device": device.type,
            "axes": [list(axis) for axis in self.axes],
            "versions": {name: installed_version(name) for name in LIBRARIES},
        }
        """What the elites follow from."""
        self._batches: list[CandidateBatch] = []
        self._path = path
        self.archive = make_archive(self.candidates.weight_count, self.axes, seed)
        """The elites, a `ribs.archives.GridArchive`."""
        self._proposals = METHODS[method](self.archive, batch_size, seed)
        if path is not None:
            self._replay(path)

    @property
    def evaluations(self) -> int:
        """Candidates that have been tried."""
        return sum(len(batch.found) for batch in self._batches)

    @property
    def particle_steps(self) -> int:
        """What they have cost: B N T each."""
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
            self._tell(CandidateBatch(_fingerprint(solutions), found))
            progress(len(found) * self.world.particle_steps)
            if self._path is not None:
                self._write(self._path)

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

    def _tell(self, batch: CandidateBatch) -> None:
        self._proposals.tell(*as_told(batch.found, self.axes))
        self._batches.append(batch)
        self.growth.append(growth_of(self.archive, self.evaluations))

    def _write(self, path: Path) -> None:
        write_record(
            path,
            {
                "facts": self.facts,
                "growth": [list(step) for step in self.growth],
                "batches": [batch.to_dict() for batch in self._batches],
            },
        )

    def _replay(self, path: Path) -> None:
        """Propose again what was tried before, and tell what it came to."""

        def read(held: dict[str, Any]) -> list[CandidateBatch]:
            return [CandidateBatch.of(told) for told in held["batches"]]

        for batch in read_record(path, self.facts, read, command="search") or []:
            solutions = self._proposals.ask()
            if _fingerprint(solutions) != batch.fingerprint or len(solutions) != len(batch.found):
                raise NPAError(
                    f"{str(path)!r} must tell of the candidates that are proposed here, but batch "
                    f"{len(self._batches)} is of others (another machine?): remove it, or choose "
                    "another folder with --out"
                )
            self._tell(batch)


def growth_of(archive: Any, evaluations: int) -> Growth:
    """Return what an archive holds."""
    stats = archive.stats
    best = 0.0 if stats.obj_max is None else float(stats.obj_max)
    return Growth(evaluations, float(stats.qd_score), float(stats.coverage), best)


def tried_again(search: Search, seeds: Sequence[int], *, steps: int | None = None) -> Growth:
    """Return what the archive would hold if its elites had met other worlds instead.

    Each elite is tried once more, in worlds of other seeds, and put where it then belongs.

    Args:
        search: Whose elites.
        seeds: The worlds' numbers, of which each elite meets all.
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
        archive.add(solutions, *as_told(candidates.try_all(solutions).found, search.axes))
    return growth_of(archive, len(elites))


def _fingerprint(solutions: NDArray[np.float64]) -> int:
    return zlib.crc32(np.ascontiguousarray(solutions, dtype=np.float64).tobytes())
