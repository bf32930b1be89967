"""Evolution strategies over rules' weights: sep-CMA-ES, all candidates in one batch of worlds.

The library `cma` (pycma) proposes candidates and learns from their fitness; it is asked for a
diagonal covariance, as rules have thousands of weights (Ros and Hansen, A Simple Modification in
CMA-ES Achieving Linear Time and Space Complexity, 2008). A candidate's fitness is the mean return
of its worlds, which start from the same seeds for all candidates of a generation, and from new ones
in the next: differences between candidates are theirs and not their luck's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.agents.learning.population import Population
from npa_envs.agents.learning.problem import Problem
from npa_envs.agents.learning.progress import Progress
from npa_envs.agents.learning.rules import RuleSet, starting_rules
from npa_envs.agents.learning.seeds import FIRST_EVALUATION_SEED
from npa_envs.errors import MissingDependencyError
from npa_envs.tasks.checks import check_positive


@dataclass(frozen=True, kw_only=True)
class _Options:
    population: int
    worlds_per_candidate: int
    sigma: float

    def __post_init__(self) -> None:
        check_positive(self, int, "population", at_least=4)
        check_positive(self, int, "worlds_per_candidate")
        check_positive(self, float, "sigma")


def train(
    problem: Problem,
    progress: Progress,
    seed: int,
    *,
    device: torch.device,
    start: RuleSet | None = None,
    population: int = 32,
    worlds_per_candidate: int = 1,
    sigma: float = 0.1,
) -> RuleSet:
    """Evolve rules until the budget is spent, and return the mean of the last generation.

    Args:
        problem: What is to be learned.
        progress: The budget, and who looks on.
        seed: Of the first weights, of candidates and of worlds.
        device: Where worlds live and candidates are evaluated; candidates are drawn on the host.
        start: The mean to begin with; None: a new rule.
        population: Candidates of a generation, at least 4.
        worlds_per_candidate: Worlds that each is tried in.
        sigma: Step size to begin with, as a fraction of the size that a layer's weights are drawn
            with (Xavier, gain 1; dimensionless).

    Returns:
        The rules, on the device.

    Raises:
        MissingDependencyError: cma is not installed.
        NPAError: An option is out of its range.
    """
    options = _Options(
        population=population, worlds_per_candidate=worlds_per_candidate, sigma=sigma
    )
    rules = starting_rules(problem, seed, device, start)
    candidates = Population(rules)
    envs = problem.make_envs(population * worlds_per_candidate, device=device, copy=False)
    draws = np.random.default_rng(seed)
    search = _search(candidates, options, draws)
    steps = population * worlds_per_candidate * problem.particle_count * problem.episode_steps
    progress.start(rules)
    while not progress.over:
        proposed = search.ask()
        seeds = draws.integers(FIRST_EVALUATION_SEED, size=worlds_per_candidate).tolist()
        weights = torch.as_tensor(np.stack(proposed), dtype=torch.float32).to(device)
        found = fitness(envs, candidates, weights, seeds, problem.episode_steps)
        search.tell(proposed, _costs(found.cpu().double().numpy()))
        candidates.put(search.mean)
        progress.advance(steps)
        progress.look(rules)
    progress.look(rules, force=True)
    return rules


def fitness(
    envs: Any, candidates: Population, weights: Tensor, seeds: list[int], episode_steps: int
) -> Tensor:
    """Return the mean return of each candidate over worlds that start from the same seeds.

    Args:
        envs: K * M worlds of `Problem.make_envs`, in which candidate k owns the M from k * M on.
        candidates: Their architecture.
        weights: Of K candidates, shape [K, W].
        seeds: Of each candidate's worlds, M of them.
        episode_steps: Length of an episode.

    Returns:
        On the worlds' device, shape [K].
    """
    observation, _ = envs.reset(seed=seeds * len(weights))
    returns = torch.zeros(envs.num_envs, device=weights.device)
    running = torch.ones(envs.num_envs, dtype=torch.bool, device=weights.device)
    for _ in range(episode_steps):
        action = candidates.actions(weights, observation)
        observation, reward, terminated, truncated, _ = envs.step(action)
        # A world that is over has begun another episode, which is not asked for.
        returns += torch.where(running, reward, 0.0)
        running &= ~(terminated | truncated)
    return returns.view(len(weights), -1).mean(dim=1)


def _search(candidates: Population, options: _Options, draws: np.random.Generator) -> Any:
    """Return the strategy: it proposes by `ask`, learns by `tell`, and its mean is `mean`."""
    try:
        import cma
    except ImportError as error:
        raise MissingDependencyError(
            "evolution strategies need cma, which is not installed: "
            "pip install 'npa-envs[evolution]'"
        ) from error

    def normal(*shape: int) -> NDArray[np.float64]:
        return draws.standard_normal(shape)

    words = {
        "popsize": options.population,
        "CMA_diagonal": True,
        "CMA_stds": candidates.scales(),
        "randn": normal,
        # With draws of one's own the library wants none.
        "seed": math.nan,
        "verbose": -9,
    }
    return cma.CMAEvolutionStrategy(candidates.vector(), options.sigma, words)


def _costs(found: NDArray[np.float64]) -> list[float]:
    """Return what is to be minimised; candidates without a finite return are the worst of all."""
    finite = np.isfinite(found)
    worst = found[finite].min() - 1.0 if finite.any() else 0.0
    costs: list[float] = (-np.where(finite, found, worst)).tolist()
    return costs
