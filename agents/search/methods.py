"""Ways to propose candidates, all with the same archive; most are those of pyribs.

The archive is the grid of MAP-Elites (Mouret and Clune, arXiv 1504.04909): a cell keeps the best
candidate whose descriptors lie in it. Methods differ in what they propose next.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np

from npa_envs.agents.search.worlds import Axis, Found, Numbers
from npa_envs.errors import MissingDependencyError

SMALLEST, LARGEST = 0.05, 0.8
"""Sizes of weights that random candidates have, over those of Xavier."""

MUTATION = 0.1
"""Standard deviation of what a mutation adds to a weight, over its size by Xavier."""

FIRST_STEP = 0.2
"""Standard deviation that CMA-ES begins with, likewise."""


class Proposals(Protocol):
    """Proposes candidates and learns from their results, as pyribs' schedulers do."""

    def ask(self) -> Numbers:
        """Return candidates, shape [K, W]."""

    def tell(self, objective: Numbers, measures: Numbers) -> Any:
        """Take qualities, shape [K], and descriptors, [K, M]; they go into the archive as well."""


def import_ribs() -> Any:
    """Return the library with its parts imported."""
    try:
        import cma  # noqa: F401
        import ribs.archives
        import ribs.emitters  # noqa: F401
        import ribs.schedulers  # noqa: F401
    except ImportError as error:
        raise MissingDependencyError(
            "the search needs pyribs and cma, which are not both installed: "
            "pip install 'npa-envs[search]'"
        ) from error
    return ribs


def make_archive(weight_count: int, axes: tuple[Axis, ...], seed: int = 0) -> Any:
    """Return an empty `ribs.archives.GridArchive` of candidates with so many weights.

    Only qualities above 0 are kept: all others are dead, or blew up. The seed is that of the elites
    that are drawn from it.
    """
    return import_ribs().archives.GridArchive(
        solution_dim=weight_count,
        dims=[axis.cells for axis in axes],
        ranges=[(axis.lowest, axis.highest) for axis in axes],
        # With these two a cell's threshold is 0 at first, and then its best.
        learning_rate=1.0,
        threshold_min=0.0,
        seed=seed,
    )


class RandomProposals:
    """Random candidates, each with weights of a size of its own, spread evenly in the logarithm."""

    def __init__(self, archive: Any, batch_size: int, seed: int) -> None:
        self._archive = archive
        self._batch_size = batch_size
        self._draws = np.random.default_rng(seed)
        self._asked: Numbers = np.empty((0, archive.solution_dim))

    def ask(self) -> Numbers:
        """Return candidates, shape [K, W]."""
        self._asked = drawn(self._draws, self._batch_size, self._archive.solution_dim)
        return self._asked

    def tell(self, objective: Numbers, measures: Numbers) -> None:
        """Put the candidates into the archive."""
        self._archive.add(self._asked, objective, measures)


def drawn(draws: np.random.Generator, count: int, weight_count: int) -> Numbers:
    """Return random candidates, shape [count, W], weights of sizes from `SMALLEST` to `LARGEST`."""
    sizes = np.exp(draws.uniform(np.log(SMALLEST), np.log(LARGEST), (count, 1)))
    return sizes * draws.standard_normal((count, weight_count))


def _map_elites(archive: Any, batch_size: int, seed: int) -> Proposals:
    emitter = import_ribs().emitters.GaussianEmitter(
        archive,
        sigma=MUTATION,
        initial_solutions=drawn(np.random.default_rng(seed), batch_size, archive.solution_dim),
        batch_size=batch_size,
        seed=seed,
    )
    return _scheduler(archive, emitter)


def _evolution(ranker: str, restart_rule: str) -> Callable[[Any, int, int], Proposals]:
    def make(archive: Any, batch_size: int, seed: int) -> Proposals:
        ribs = import_ribs()
        from cma.sigma_adaptation import CMAAdaptSigmaCSA

        # From 300 weights on cma would go by the order of candidates, and pyribs sorts them.
        options = {"CMA_diagonal": True, "AdaptSigma": CMAAdaptSigmaCSA}
        emitter = ribs.emitters.EvolutionStrategyEmitter(
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
        return _scheduler(archive, emitter)

    return make


def _scheduler(archive: Any, emitter: Any) -> Proposals:
    scheduler: Proposals = import_ribs().schedulers.Scheduler(archive, [emitter])
    return scheduler


METHODS: Mapping[str, Callable[[Any, int, int], Proposals]] = {
    "map-elites": _map_elites,
    "cma-me": _evolution("2imp", "no_improvement"),
    "cma-es": _evolution("obj", "basic"),
    "random": RandomProposals,
}
"""Makes proposals from an archive, the batch size and a seed.

`map-elites` mutates elites drawn at random. `cma-me` (arXiv 1912.02400) is CMA-ES that is rewarded
for new cells first and for better elites second. `cma-es` is rewarded for quality alone. Both adapt
a diagonal covariance. `random` draws anew.
"""


def qualities_and_measures(
    found: list[Found | None], axes: tuple[Axis, ...]
) -> tuple[Numbers, Numbers]:
    """Return qualities, shape [K], and descriptors, [K, M]; all are 0 where nothing was found."""
    nothing = Found(0.0, (0.0,) * len(axes))
    whole = [nothing if one is None else one for one in found]
    return np.array([one.quality for one in whole]), np.array([one.measures for one in whole])
