"""The search: methods that propose candidates, the archive of the best, the record of all.

The archive is the grid of MAP-Elites (Mouret and Clune, arXiv 1504.04909): each cell keeps the best
candidate with descriptors in it. Methods differ in the candidates that they propose next.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from npa_envs.agents.search.candidate_evaluation import (
    Axis,
    Candidates,
    Found,
    Numbers,
    SearchWorld,
)
from npa_envs.checks import is_whole
from npa_envs.errors import NPAError, check_known, importing, shown
from npa_envs.measure.benchmark_records import installed_version, read_record, write_record

RESULTS = "search.json"
"""The file of a search's record, from which a stopped search continues."""

LIBRARIES = ("numpy", "ribs", "cma")
"""Libraries whose versions affect the proposed candidates."""

MIN_STD, MAX_STD = 0.05, 0.8
"""Range of the standard deviation of a random candidate's weights, in units of Xavier's."""

MUTATION = 0.1
"""Standard deviation of mutations, in units of Xavier's standard deviation of each weight."""

FIRST_STEP = 0.2
"""First standard deviation of CMA-ES, in units of Xavier's standard deviation of each weight."""


def import_ribs() -> Any:
    """Return the library `ribs` with its modules imported."""
    with importing("pyribs and cma", "the search", "pip install 'npa-envs[search]'"):
        import cma  # noqa: F401
        import ribs.archives
        import ribs.emitters  # noqa: F401
        import ribs.schedulers  # noqa: F401
    return ribs


def make_archive(weight_count: int, axes: tuple[Axis, ...], seed: int = 0) -> Any:
    """Return an empty `ribs.archives.GridArchive` of candidates with `weight_count` weights.

    It keeps qualities above 0 (other worlds came to rest or diverged), and draws elites by `seed`.
    """
    return import_ribs().archives.GridArchive(
        solution_dim=weight_count,
        dims=[axis.cells for axis in axes],
        ranges=[(axis.lowest, axis.highest) for axis in axes],
        # With these two the threshold of a cell is 0 at first, then its best quality.
        learning_rate=1.0,
        threshold_min=0.0,
        seed=seed,
    )


class RandomEmitter:
    """An emitter of pyribs that proposes `random_weights`, whatever the archive contains."""

    def __init__(self, archive: Any, batch_size: int, seed: int) -> None:
        self.solution_dim: int = archive.solution_dim
        self._batch_size = batch_size
        self._random = np.random.default_rng(seed)

    def ask(self) -> Numbers:
        """Return the weights of new candidates, shape [G, W]."""
        return random_weights(self._random, self._batch_size, self.solution_dim)

    def tell(self, *_: Any, **results: Any) -> None:
        """Ignore the results."""


def random_weights(random: np.random.Generator, count: int, weight_count: int) -> Numbers:
    """Return Gaussian weights [count, W]; each candidate's deviation is drawn log-uniformly."""
    deviations = np.exp(random.uniform(np.log(MIN_STD), np.log(MAX_STD), (count, 1)))
    return deviations * random.standard_normal((count, weight_count))


def _map_elites(archive: Any, batch_size: int, seed: int) -> Any:
    random = np.random.default_rng(seed)
    return import_ribs().emitters.GaussianEmitter(
        archive,
        sigma=MUTATION,
        initial_solutions=random_weights(random, batch_size, archive.solution_dim),
        batch_size=batch_size,
        seed=seed,
    )


def _evolution(ranker: str, restart_rule: str, archive: Any, batch_size: int, seed: int) -> Any:
    ribs = import_ribs()
    from cma.sigma_adaptation import CMAAdaptSigmaCSA

    # For more than 300 weights cma's default depends on the order of candidates, which pyribs
    # changes.
    options = {"CMA_diagonal": True, "AdaptSigma": CMAAdaptSigmaCSA}
    return ribs.emitters.EvolutionStrategyEmitter(
        archive,
        x0=np.zeros(archive.solution_dim),
        sigma0=FIRST_STEP,
        ranker=ranker,
        restart_rule=restart_rule,
        es="pycma_es",
        es_kwargs={"opts": options},
        batch_size=batch_size,
        seed=seed,
    )


EMITTERS: Mapping[str, Callable[[Any, int, int], Any]] = {
    "map-elites": _map_elites,
    "cma-me": partial(_evolution, "2imp", "no_improvement"),
    "cma-es": partial(_evolution, "obj", "basic"),
    "random": RandomEmitter,
}
"""Methods of a search: functions of an archive, a batch size and a seed that return an emitter of
pyribs, whose `ask` proposes candidates, [G, W].

`map-elites` mutates random elites. `cma-me` (arXiv 1912.02400) is CMA-ES that ranks new cells
before better elites, `cma-es` by quality. Both adapt a diagonal covariance. `random` draws anew.
"""


def qualities_and_measures(
    found: Sequence[Found | None], axes: Sequence[Axis]
) -> tuple[Numbers, Numbers]:
    """Return the qualities [G] and descriptors [G, axes] of candidates, 0 where one is None."""
    nothing = Found(0.0, (0.0,) * len(axes))
    qualities, measures = zip(*(one or nothing for one in found), strict=True)
    return np.array(qualities), np.array(measures)


# The search.


class Growth(NamedTuple):
    """Statistics of an archive after a number of evaluations."""

    evaluations: int
    """Candidates tried so far."""
    qd_score: float
    """Sum of the elites' qualities."""
    coverage: float
    """Fraction of the cells that have an elite."""
    best: float
    """Quality of the best elite; 0 without elites."""


class Elite(NamedTuple):
    """The best candidate in a cell of the archive."""

    cell: tuple[int, ...]
    """Index of the cell on each axis."""
    found: Found
    """Its quality and descriptors."""
    solution: Numbers
    """Its weights in units of `Candidates.scales`, shape [W]."""

    @property
    def name(self) -> str:
        """Name of its rule's file, the indices of its cell, such as "3-4-1"."""
        return "-".join(map(str, self.cell))


Batch = dict[str, Any]
"""A batch of candidates in the record: "fingerprint", the CRC-32 of their weights, and "found", a
list of quality and descriptors of each, or None where its worlds stopped changing or diverged."""


class Search:
    """A quality-diversity search for rules, with a record from which it can be resumed.

    The same settings give the same elites. The record has the results of all candidates, not their
    weights: a resumed search proposes the same candidates again, and takes their results from it.

    Args:
        world: Sizes of rules and worlds.
        method: A name of `EMITTERS`.
        seed: Seed of the proposals, at least 0. All candidates have the same worlds.
        batch_size: Candidates that are proposed at a time, at least 2.
        device: Device of the worlds.
        path: File of the record, written after each batch and read at first; None: no record.
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
        check_known("unknown method", method, EMITTERS)
        for name, value, least in (("seed", seed, 0), ("batch_size", batch_size, 2)):
            if not is_whole(value) or value < least:
                raise NPAError(
                    f"{name} must be a whole number of at least {least}, got {shown(value)}"
                )
        self.world = world
        self.axes: tuple[Axis, ...] = world.axes()
        self.candidates = Candidates(world, device=device)
        self.facts: dict[str, Any] = {
            **asdict(world),
            "method": method,
            "seed": seed,
            "batch_size": batch_size,
            "device": device.type,
            "axes": [list(axis) for axis in self.axes],
            "versions": {name: installed_version(name) for name in LIBRARIES},
        }
        self.growth: list[Growth] = []
        """Statistics of the archive after each batch."""
        self._path = path
        self._batches: list[Batch] = []
        self.archive = make_archive(self.candidates.weight_count, self.axes, seed)
        """The elites, a `ribs.archives.GridArchive`."""
        emitter = EMITTERS[method](self.archive, batch_size, seed)
        self._proposals = import_ribs().schedulers.Scheduler(self.archive, [emitter])
        self._replay()

    @property
    def evaluations(self) -> int:
        """Number of candidates evaluated so far."""
        return sum(len(batch["found"]) for batch in self._batches)

    @property
    def particle_steps(self) -> int:
        """Particle-steps spent so far: B N T for each candidate."""
        return self.evaluations * self.world.particle_steps

    def run(
        self,
        budget: int,
        *,
        enough: Callable[[], bool] = lambda: False,
        progress: Callable[[int], None] = lambda _: None,
    ) -> None:
        """Propose and evaluate batches of candidates while the search is within its budget.

        Args:
            budget: Particle-steps of the whole search, including those before it was resumed.
            enough: Called after each batch; True stops the search.
            progress: Called with the particle-steps of each batch.
        """
        batch_cost = int(self.facts["batch_size"]) * self.world.particle_steps
        while self.particle_steps + batch_cost <= budget and not enough():
            solutions = self._proposals.ask()
            found = self.candidates.try_all(solutions).found
            results = [one and [one.quality, *one.measures] for one in found]
            self._tell({"fingerprint": _fingerprint(solutions), "found": results})
            progress(len(found) * self.world.particle_steps)
            if self._path is not None:
                content = {"facts": self.facts, "growth": self.growth, "batches": self._batches}
                write_record(self._path, content)

    def elites(self) -> list[Elite]:
        """Return the elites, sorted by cell."""
        stored = self.archive.data(["index", "objective", "measures", "solution"])
        index, *columns = stored.values()
        cells = self.archive.int_to_grid_index(index)
        elites = [
            Elite(tuple(cell.tolist()), Found(float(quality), tuple(measures.tolist())), solution)
            for cell, quality, measures, solution in zip(cells, *columns, strict=True)
        ]
        return sorted(elites, key=lambda elite: elite.cell)

    def _tell(self, batch: Batch) -> None:
        found = [one and Found(one[0], tuple(one[1:])) for one in batch["found"]]
        self._proposals.tell(*qualities_and_measures(found, self.axes))
        self._batches.append(batch)
        self.growth.append(growth_of(self.archive, self.evaluations))

    def _replay(self) -> None:
        """Propose the candidates of the record again, and take their results, if there is one."""

        def batches_of(content: Mapping[str, Any]) -> list[Batch]:
            return [
                {
                    "fingerprint": int(batch["fingerprint"]),
                    "found": [one and list(map(float, one)) for one in batch["found"]],
                }
                for batch in content["batches"]
            ]

        if self._path is None:
            return
        stored = read_record(self._path, self.facts, batches_of, command="search")
        for number, batch in enumerate(stored or []):
            solutions = self._proposals.ask()
            same = _fingerprint(solutions) == batch["fingerprint"]
            if not same or len(solutions) != len(batch["found"]):
                raise NPAError(
                    f"{str(self._path)!r} must have the candidates that this search proposes, but "
                    f"batch {number} differs (another machine?): remove it, or choose another "
                    "folder with --out"
                )
            self._tell(batch)


def growth_of(archive: Any, evaluations: int) -> Growth:
    """Return the statistics of an archive after a number of evaluations."""
    stats = archive.stats
    best = 0.0 if stats.obj_max is None else float(stats.obj_max)
    return Growth(evaluations, float(stats.qd_score), float(stats.coverage), best)


def tried_again(search: Search, seeds: Sequence[int]) -> Growth:
    """Evaluate a search's elites again in worlds of other seeds; return their statistics."""
    candidates = Candidates(search.world, device=search.candidates.device, seeds=seeds)
    archive = make_archive(candidates.weight_count, search.axes)
    elites = search.elites()
    if elites:
        solutions = np.stack([elite.solution for elite in elites])
        archive.add(
            solutions, *qualities_and_measures(candidates.try_all(solutions).found, search.axes)
        )
    return growth_of(archive, len(elites))


def _fingerprint(solutions: Numbers) -> int:
    return zlib.crc32(np.ascontiguousarray(solutions, dtype=np.float64).tobytes())
