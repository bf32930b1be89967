"""Evolution strategies over rules' weights: sep-CMA-ES, all candidates in one batch of worlds.

The library `cma` (pycma) proposes candidates, vectors of weights, with a diagonal covariance, as
rules have thousands of weights (Ros and Hansen, A Simple Modification in CMA-ES Achieving Linear
Time and Space Complexity, 2008). A candidate's fitness is the mean return of its worlds. All
candidates of a generation have worlds of the same seeds; each generation has new seeds.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from npa_envs.agents.learning.problem import FIRST_EVALUATION_SEED
from npa_envs.agents.learning.progress import Progress
from npa_envs.agents.learning.rule_set import RuleSet
from npa_envs.agents.policies import columns_read, split_update
from npa_envs.checks import check_positive
from npa_envs.errors import NPAError, importing
from npa_envs.rule.folded_network import without_small
from npa_envs.rule.rule import NPARule

MAX_HIDDEN = 2**27
"""Maximum number of hidden units' values in memory at a time: 512 MiB of float32."""


@dataclass(frozen=True, kw_only=True)
class EvolutionOptions:
    """Options of sep-CMA-ES, the evolution strategy that changes the weights of rules."""

    population: int = 32
    """Number of candidates of a generation, at least 4."""
    worlds_per_candidate: int = 1
    """Number of worlds in which each candidate is evaluated."""
    sigma: float = 0.1
    """First standard deviation of each weight, in units of `RuleWeights.scales`."""

    def __post_init__(self) -> None:
        check_positive(self, int, "population", at_least=4)
        check_positive(self, int, "worlds_per_candidate")
        check_positive(self, float, "sigma")


def train(progress: Progress, options: EvolutionOptions = EvolutionOptions()) -> RuleSet:
    """Evolve rules until the budget is spent, and return the mean of the last generation.

    Candidates are proposed on the CPU and evaluated on the device.
    """
    problem, device = progress.problem, progress.device
    rules = progress.first_rules()
    rule_weights = RuleWeights(rules)
    world_count = options.population * options.worlds_per_candidate
    envs = problem.make_envs(world_count, device=device, copy=False)
    random = np.random.default_rng(progress.seed)
    strategy = _strategy(rule_weights, options, random)

    def generation() -> int:
        proposed = strategy.ask()
        seeds = random.integers(FIRST_EVALUATION_SEED, size=options.worlds_per_candidate).tolist()
        weights = torch.as_tensor(np.stack(proposed), dtype=torch.float32).to(device)
        returns = fitness(envs, rules, weights, seeds, problem.episode_steps)
        strategy.tell(proposed, costs(returns.cpu().double().numpy()))
        rule_weights.set_vector(strategy.mean)
        return world_count * problem.particle_count * problem.episode_steps

    return progress.run(rules, generation)


class RuleWeights:
    """Reads and writes the weights of rules as one vector: W1, b1 and W2 of each rule in turn.

    Rules must have networks of these two layers; read-outs are left as they are.
    """

    def __init__(self, rules: Iterable[NPARule]) -> None:
        self._rules = list(rules)
        self._layers = [layer for rule in self._rules for layer in layers_of(rule)]
        for rule in self._rules:
            if not rule.is_plain():
                raise NPAError(
                    "rules must be NPARules whose networks are their two layers, got one that "
                    "overrides its network: evolve it by its own code"
                )

    def vector(self) -> NDArray[np.float64]:
        """Return the current weights of the rules, shape [W]."""
        with torch.no_grad():
            return nn.utils.parameters_to_vector(self._layers).double().cpu().numpy()

    def set_vector(self, vector: NDArray[np.float64]) -> None:
        """Set the weights of the rules, in place, to those of a vector, shape [W]."""
        first = self._layers[0]
        with torch.no_grad():
            nn.utils.vector_to_parameters(
                torch.as_tensor(vector, dtype=first.dtype, device=first.device), self._layers
            )

    def scales(self) -> NDArray[np.float64]:
        """Return the standard deviation of each weight by Xavier, gain 1, [W]; of b1 as of W1."""
        sizes = []
        for rule in self._rules:
            hidden, bias, output = layers_of(rule)
            first = math.sqrt(2.0 / sum(hidden.shape))
            sizes += [np.full(hidden.numel() + bias.numel(), first)]
            sizes += [np.full(output.numel(), math.sqrt(2.0 / sum(output.shape)))]
        return np.concatenate(sizes)


def layers_of(rule: NPARule) -> tuple[Tensor, Tensor, Tensor]:
    """Return a rule's weights: W1 [H, P], b1 [H] and W2 [A, H]."""
    return rule.hidden.weight, rule.hidden.bias, rule.output.weight


def updates_of(rule: NPARule, weights: Tensor, rows: Tensor) -> Tensor:
    """Return raw updates [G, K, A] of G candidates, weights [G, W], for perceptions [G, K, P]."""
    shapes = [tuple(layer.shape) for layer in layers_of(rule)]
    sizes = [math.prod(shape) for shape in shapes]
    first, bias, second = (
        layer.reshape(-1, *shape)
        for layer, shape in zip(torch.split(weights, sizes, dim=1), shapes, strict=True)
    )
    size = max(1, MAX_HIDDEN // (rows.shape[1] * rule.hidden_dim))
    updates = []
    for k in range(0, len(weights), size):
        chunk = slice(k, k + size)
        hidden = torch.baddbmm(bias[chunk, None], rows[chunk], first[chunk].mT).relu_()
        updates.append(torch.bmm(hidden, second[chunk].mT))
    return without_small(torch.cat(updates), rule.dead_zone)


@torch.no_grad()
def candidates_actions(rules: RuleSet, weights: Tensor, observation: Tensor) -> Tensor:
    """Return actions [G B, N, A] of G candidates, weights [G, W], each in B worlds.

    Observations, [G B, N, P], are ordered by candidate.
    """
    sizes = [sum(layer.numel() for layer in layers_of(rule)) for rule in rules]
    weights_of = dict(zip(rules, torch.split(weights, sizes, dim=1), strict=True))

    def action(rule: NPARule, observation: Tensor) -> Tensor:
        rows = columns_read(rule, observation)
        rows = rows.view(len(weights), -1, rows.shape[1])
        update = updates_of(rule, weights_of[rule], rows).flatten(0, 1)
        return rules.interface.action(*split_update(rule, update))

    return rules.actions(observation, action)


def fitness(
    envs: Any, rules: RuleSet, weights: Tensor, seeds: list[int], episode_steps: int
) -> Tensor:
    """Return the mean return of each candidate, shape [G], for weights [G, W].

    `envs` has G B worlds: for each candidate in turn B worlds, with the B `seeds`.
    """
    observation, _ = envs.reset(seed=seeds * len(weights))
    returns = torch.zeros(envs.num_envs, device=weights.device)
    running = torch.ones(envs.num_envs, dtype=torch.bool, device=weights.device)
    for _ in range(episode_steps):
        action = candidates_actions(rules, weights, observation)
        observation, reward, terminated, truncated, _ = envs.step(action)
        # The next episode of a world that restarted does not count.
        returns += torch.where(running, reward, 0.0)
        running &= ~(terminated | truncated)
    return returns.view(len(weights), -1).mean(dim=1)


def _strategy(
    rule_weights: RuleWeights, options: EvolutionOptions, random: np.random.Generator
) -> Any:
    """Return an evolution strategy of the library `cma` that begins at the rules' weights."""
    with importing("cma", "evolution", "pip install 'npa-envs[evolution]'"):
        import cma

    settings = {
        "popsize": options.population,
        "randn": lambda *shape: random.standard_normal(shape),
        # The library takes no seed with `randn`.
        "seed": math.nan,
        "verbose": -9,
        "CMA_diagonal": True,
        "CMA_stds": rule_weights.scales(),
    }
    return cma.CMAEvolutionStrategy(rule_weights.vector(), options.sigma, settings)


def costs(returns: NDArray[np.float64]) -> list[float]:
    """Return costs to minimise: minus the returns [G]; infinite and NaN ones cost the most."""
    finite = np.isfinite(returns)
    worst = returns[finite].min() - 1.0 if finite.any() else 0.0
    minimised: list[float] = (-np.where(finite, returns, worst)).tolist()
    return minimised
