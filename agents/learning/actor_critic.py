"""Parts that PPO (`ppo.py`, `sb3.py`) and SHAC share: options, noisy rules, critic, minibatches."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor, nn

from npa_envs.agents.learning.progress import Progress
from npa_envs.agents.learning.rule_set import RuleSet, species_of
from npa_envs.checks import check_fraction, check_non_negative, check_positive, check_word
from npa_envs.training.process_group import ALONE, ProcessGroup, begin_episodes, world_streams
from npa_envs.world.randomness import Randomness, WorldRandom, normal_draws


class Schedule(NamedTuple):
    """The `CommonOptions` whose defaults depend on whether a run begins with rules, `start`."""

    learning_rate: float
    initial_std: float
    last_noise: float
    critic_rounds: int
    target_kl: float


SCHEDULES = {
    # Option: default for new rules, default with a `start`.
    "learning_rate": (1e-3, 1e-4),
    "initial_std": (0.2, 0.05),
    "last_noise": (0.25, 1.0),
    "critic_rounds": (0, 4),
    "target_kl": (0.2, 0.05),
}
"""The two defaults: much noise, large steps and an untrained critic would spoil a `start`."""

CRITIC_RATE = 1e-3
"""Adam's learning rate for the critic."""

CRITIC_WIDTH = 64
"""Units in a hidden layer of the critic."""

CriticInput = Literal["particle", "central"]
"""What a value depends on: one "particle" only, or also the mean over its world ("central")."""


@dataclass(frozen=True, kw_only=True)
class CommonOptions:
    """Options of both PPOs: `ppo.py` and Stable-Baselines3's. `SCHEDULES` says what None is."""

    steps: int = 16
    """Steps of all worlds in a round, T."""
    epochs: int = 4
    """Passes over a round; fewer where `target_kl` is exceeded."""
    learning_rate: float | None = None
    """Adam's learning rate at first; it falls to zero over the budget."""
    minibatches: int = 4
    """Minibatches of a pass, which is shuffled."""
    gamma: float = 0.5
    """Discount of a reward one step later (dimensionless); raise it if rewards come late."""
    gae_lambda: float = 0.9
    """λ of generalised advantage estimation (dimensionless)."""
    entropy_weight: float = 0.0
    """Weight of an action's entropy in the objective (dimensionless)."""
    max_gradient_norm: float = 0.5
    """Gradients are clipped to this norm, in `ppo.py` separately for rules and for the critic."""
    target_kl: float | None = None
    """Largest KL divergence [nats] from the rules that played a round; then rules stop learning."""
    initial_std: float | None = None
    """Standard deviation of all columns of actions at first."""
    last_noise: float | None = None
    """Factor on the standard deviations at the end of the budget (dimensionless)."""
    noise_decay_share: float = 0.5
    """Last fraction of the budget, in which standard deviations fall by the factor `last_noise`."""
    critic_rounds: int | None = None
    """Number of first rounds, in which only the critic learns."""
    critic: CriticInput = "particle"
    """Input of the critic: a particle's own perception, or also its whole world ("central")."""

    def __post_init__(self) -> None:
        check_positive(self, int, "steps", "epochs", "minibatches")
        check_positive(self, float, "max_gradient_norm")
        check_non_negative(self, "entropy_weight")
        check_fraction(self, "gamma", "gae_lambda", "noise_decay_share")
        for name in ("learning_rate", "initial_std", "target_kl"):
            if getattr(self, name) is not None:
                check_positive(self, float, name)
        if self.last_noise is not None:
            check_fraction(self, "last_noise")
        if self.critic_rounds is not None:
            check_positive(self, int, "critic_rounds", at_least=0)
        check_word(self, "critic", get_args(CriticInput))

    def schedule(self, start: RuleSet | None) -> Schedule:
        """Return the options that depend on `start`, the rules to begin with, without None."""
        given = {name: getattr(self, name) for name in SCHEDULES}
        defaults: dict[str, Any] = {
            name: pair[start is not None] for name, pair in SCHEDULES.items()
        }
        return Schedule(**defaults | {name: n for name, n in given.items() if n is not None})

    def noise_factor(self, remaining_budget: float, last_noise: float) -> float:
        """Return the factor on the first standard deviations, for the budget's remaining fraction.

        It is 1 until the last `noise_decay_share` of the budget, and there falls exponentially to
        `last_noise`: rules learn with noise, but are evaluated without.
        """
        return math.pow(last_noise, max(0.0, 1.0 - remaining_budget / self.noise_decay_share))


def set_gradients(optimiser: torch.optim.Optimizer, loss: Tensor) -> None:
    """Write the gradients of a loss into `grad` of an optimiser's parameters."""
    # Read-outs and frozen layers have no gradients.
    parameters = [p for p in optimiser.param_groups[0]["params"] if p.requires_grad]
    # Not backward(): its accumulation nodes keep the stream of their first use, which a capture
    # on another stream must not touch.
    gradients = torch.autograd.grad(loss, parameters, allow_unused=True)
    for parameter, gradient in zip(parameters, gradients, strict=True):
        if gradient is not None:
            if parameter.grad is None:
                # Laid out like the parameter, as fused optimisers expect.
                parameter.grad = torch.empty_like(parameter)
            parameter.grad.copy_(gradient)


def gradients_of(optimiser: torch.optim.Optimizer) -> list[Tensor]:
    """Return the tensors `grad` of an optimiser's parameters, without None."""
    return [p.grad for p in optimiser.param_groups[0]["params"] if p.grad is not None]


HALF_LOG_TAU = 0.5 * math.log(2.0 * math.pi)


def gaussian_log_prob(mean: Tensor, log_std: Tensor, action: Tensor) -> Tensor:
    """Return Gaussian log-probabilities [nats], [...], of actions [..., A]: sums over columns."""
    noise = (action - mean) * torch.exp(-log_std)
    return -(0.5 * noise.square() + log_std + HALF_LOG_TAU).sum(dim=-1)


class GaussianRules(nn.Module):
    """A policy of Gaussian actions, whose means are the actions of copies of the rules.

    Standard deviations are learned, one for each species and column of actions. A particle's
    log-probability is the sum over columns. A world's is the mean over its particles: with their
    sum a likelihood ratio would be far from 1 after the smallest update.
    """

    row_species: Tensor

    def __init__(self, rules: RuleSet, initial_std: float) -> None:
        super().__init__()
        self.rules = copy.deepcopy(rules)
        widths = [rule.update_dim for rule in self.rules]
        start = torch.full((len(widths), widths[0]), math.log(initial_std))
        self.noise_factor = 1.0
        """Factor on the first standard deviations, set by `set_noise` (dimensionless)."""
        self.log_std = nn.Parameter(start)
        """Logarithms of the standard deviations, a row for each species, shape [species, A]."""
        self.register_buffer("row_species", species_of(rules.counts), persistent=False)

    def get_extra_state(self) -> float:
        """Return `noise_factor`, for `state_dict`."""
        return self.noise_factor

    def set_extra_state(self, state: float) -> None:
        """Set `noise_factor`."""
        self.noise_factor = state

    def row_log_std(self) -> Tensor:
        """Return logarithms of the standard deviations of each particle's actions, shape [N, A]."""
        return self.log_std[self.row_species]

    @torch.no_grad()
    def set_noise(self, factor: float) -> None:
        """Rescale the standard deviations so that `noise_factor` becomes `factor`."""
        self.log_std.add_(math.log(factor / self.noise_factor))
        self.noise_factor = factor

    def sample(
        self, observation: Tensor, generator: Randomness | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return random unclipped actions, [B, N, A], and their log-probabilities, [B, N]."""
        mean, log_std = self.rules.mean(observation), self.row_log_std()
        noise = normal_draws(generator, mean.shape, mean)
        action = mean + log_std.exp() * noise
        return action, gaussian_log_prob(mean, log_std, action)

    def log_prob(self, observation: Tensor, action: Tensor) -> Tensor:
        """Return log-probabilities [B, N] of actions [B, N, A] at observations [B, N, P]."""
        return gaussian_log_prob(self.rules.mean(observation), self.row_log_std(), action)

    def row_log_prob(self, species: int, rows: Tensor, action: Tensor) -> Tensor:
        """Return log-probabilities [K] of one species' actions [K, A] at observations [K, P]."""
        mean = self.rules.mean_by_rule(list(self.rules)[species], rows)
        return gaussian_log_prob(mean, self.log_std[species], action)

    def entropy(self) -> Tensor:
        """Return the entropy of a particle's action, averaged over particles [nats], shape []."""
        return (self.row_log_std() + HALF_LOG_TAU + 0.5).sum(dim=-1).mean()


MIN_RATE = 0.01
"""Minimum weight of a new batch in a running moment; the first 100 batches weigh the same."""

INPUT_LIMIT = 8.0
"""Standardised inputs are clipped to ± this."""


class Critic(nn.Module):
    """Network that estimates each particle's value, the discounted sum of its later rewards.

    Its input is a particle's perception, and with "central" also the mean of its world's hidden
    features. Running moments standardise inputs (`observe`) and scale outputs (`rescale`).
    """

    mean: Tensor
    square: Tensor
    scale: Tensor
    updates: Tensor
    row_species: Tensor

    def __init__(
        self, perception_dim: int, counts: Sequence[int], inputs: CriticInput = "particle"
    ) -> None:
        super().__init__()
        width = CRITIC_WIDTH
        self.features = nn.Linear(perception_dim, width)
        self.hidden = nn.Linear(width, width)
        self.pooled = nn.Linear(width, width, bias=False) if inputs == "central" else None
        self.species = nn.Embedding(len(counts), width)
        self.value = nn.Linear(width, 1)
        nn.init.zeros_(self.species.weight)
        nn.init.zeros_(self.value.weight)
        nn.init.zeros_(self.value.bias)
        self.register_buffer("row_species", species_of(counts), persistent=False)
        self.register_buffer("mean", torch.zeros(perception_dim))
        self.register_buffer("square", torch.ones(perception_dim))
        self.register_buffer("scale", torch.ones(()))
        self.register_buffer("updates", torch.zeros(2))

    def forward(self, observation: Tensor) -> Tensor:
        """Return values [B, N] for observations [B, N, P], in units of the rewards."""
        spread = (self.square - self.mean.square()).clamp(min=1e-6).sqrt()
        inputs = ((observation - self.mean) / spread).clamp(-INPUT_LIMIT, INPUT_LIMIT)
        features = torch.tanh(self.features(inputs))
        mixed = self.hidden(features) + self.species(self.row_species)
        if self.pooled is not None:
            mixed = mixed + self.pooled(features.mean(dim=-2, keepdim=True))
        values: Tensor = self.value(torch.tanh(mixed)).squeeze(-1)
        return self.scale * values

    @torch.no_grad()
    def observe(self, observation: Tensor, processes: ProcessGroup = ALONE) -> None:
        """Update the running moments of inputs by observations [..., P] of all processes."""
        rate = self._rate(0)
        rows = observation.flatten(0, -2)
        mean, square = rows.mean(dim=0), rows.square().mean(dim=0)
        processes.reduce([mean, square])
        self.mean.lerp_(mean, rate)
        self.square.lerp_(square, rate)

    @torch.no_grad()
    def rescale(self, targets: Tensor, processes: ProcessGroup = ALONE) -> None:
        """Update the scale of outputs, the running RMS of targets; values do not change."""
        before = self.scale.clone()
        square = targets.square().mean()
        processes.reduce([square])
        size = square.sqrt().clamp(min=1e-8)
        self.scale.lerp_(size, self._rate(1))
        for parameter in (self.value.weight, self.value.bias):
            parameter.mul_(before / self.scale)

    def _rate(self, moment: int) -> Tensor:
        """Count a batch of inputs (0) or targets (1); return its weight in the running moment."""
        self.updates[moment] += 1.0
        return (1.0 / self.updates[moment]).clamp(min=MIN_RATE)


def seeded_critic(progress: Progress, input_dim: int, inputs: CriticInput) -> Critic:
    """Return a new critic for inputs of `input_dim` columns, with weights by the run's seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(progress.seed)
        return Critic(input_dim, progress.problem.counts, inputs).to(progress.device)


def worlds_of_process(progress: Progress, total: int) -> tuple[list[int], Randomness]:
    """Return the indices of this process's worlds out of `total`, and a source of random numbers.

    That is one torch generator, or with several processes a stream for each world.
    """
    progress.processes.check_even("num_envs", total)
    indices = progress.processes.indices(total)
    if progress.processes.distributed:
        random: Randomness = world_streams((progress.seed,), total, indices, progress.device)
    else:
        random = torch.Generator(progress.device).manual_seed(progress.seed)
    return indices.tolist(), random


class Minibatches:
    """Indices of a round's samples, shuffled for each pass and split into `count` minibatches.

    There are several groups of samples, which are shuffled separately: one with n in `group_sizes`
    has n samples per world and step, in the order [T, B, n]. Few samples make fewer minibatches.
    A single process shuffles all samples together. Each of several processes shuffles the samples
    of each world separately, by the world's random stream, and a minibatch has equally many of each
    world: so minibatches do not depend on the number of processes.
    """

    def __init__(
        self,
        steps: int,
        world_count: int,
        group_sizes: Sequence[int],
        count: int,
        random: Randomness,
    ) -> None:
        self._steps, self._world_count = steps, world_count
        self._group_sizes = group_sizes
        self._random = random
        unit = world_count if isinstance(random, WorldRandom) else 1
        self.count = min(count, steps * world_count * min(group_sizes) // unit)
        """Number of minibatches of a pass."""
        # CUDA graphs read them in place.
        self._orders = [
            torch.zeros(steps * world_count * n, dtype=torch.int64, device=random.device)
            for n in group_sizes
        ]
        self.indices: list[tuple[Tensor, ...]] = []
        """For each group the indices of each minibatch, int64: views that `shuffle` overwrites."""
        for order in self._orders:
            # Sizes as of `tensor_split`.
            sizes = [unit * ((len(order) // unit + k) // self.count) for k in range(self.count)]
            self.indices.append(torch.split(order, sizes[::-1]))

    def shuffle(self) -> None:
        """Shuffle the samples for the next pass."""
        begin_episodes(self._random)
        for order, group_size in zip(self._orders, self._group_sizes, strict=True):
            if not isinstance(self._random, WorldRandom):
                torch.randperm(len(order), generator=self._random, out=order)
                continue
            drawn = self._random.uniform(self._steps * group_size).argsort(dim=1, stable=True)
            world = torch.arange(self._world_count, device=order.device)[:, None]
            step, row = drawn // group_size, drawn % group_size
            index = (step * self._world_count + world) * group_size + row
            # One minibatch after the other.
            minibatches = index.tensor_split(self.count, dim=1)
            order.copy_(torch.cat([indices.flatten() for indices in minibatches]))
