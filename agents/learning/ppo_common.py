"""Parts of both forms of PPO, and of SHAC: options, rules that explore, the critic, minibatches."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor, nn

from npa_envs.agents.learning.problem import Problem
from npa_envs.agents.learning.rules import RuleSet, species_of
from npa_envs.checks import check_fraction, check_non_negative, check_positive
from npa_envs.errors import NPAError, shown, suggest
from npa_envs.training.ranks import ALONE, Ranks, restart, world_streams
from npa_envs.world.randomness import Randomness, WorldRandom, normal_draws


class Pace(NamedTuple):
    """Those of `CommonOptions` whose defaults depend on whether a run begins with fresh rules."""

    learning_rate: float
    initial_std: float
    last_noise: float
    critic_rounds: int
    target_kl: float


FRESH = Pace(1e-3, 0.2, 0.25, 0, 0.2)

WARM = Pace(1e-4, 0.05, 1.0, 4, 0.05)
"""For rules to begin with: noise, haste and a raw critic would undo what they can do."""

CriticKind = Literal["particle", "central"]
"""Input of a value: a "particle" alone, or its whole world besides ("central")."""


@dataclass(frozen=True, kw_only=True)
class CommonOptions:
    """Options that the device's own PPO and Stable-Baselines3's share."""

    steps: int = 16
    """Steps of all worlds in a round, T."""
    epochs: int = 4
    """Passes over a round; fewer where `target_kl` is passed."""
    learning_rate: float | None = None
    """Adam's step at the start, from which it falls to zero over the budget; None: 0.001, or 0.0001
    with a `start`."""
    minibatches: int = 4
    """Parts that a round is shuffled into in each pass."""
    gamma: float = 0.5
    """Discount of a reward one step later (dimensionless)."""
    gae_lambda: float = 0.9
    """Discount of what the critic did not foresee, besides `gamma` (dimensionless)."""
    entropy_weight: float = 0.0
    """Weight of the entropy of an action in what is maximised."""
    max_gradient_norm: float = 0.5
    """Gradients are shortened to this norm: those of rules and of the critic by themselves on the
    device, taken together in Stable-Baselines3."""
    target_kl: float | None = None
    """The rules stay as they are for the rest of a round once particles' actions are farther than
    this from those that were played [nats]; None: 0.2, or 0.05 with a `start`."""
    initial_std: float | None = None
    """Standard deviation of every action column at first; None: 0.2, or 0.05 with a `start`."""
    last_noise: float | None = None
    """What is left of the standard deviations at the end of the budget (dimensionless); None: 0.25,
    or 1 with a `start`."""
    noise_decay_share: float = 0.5
    """Share of the budget, its last, in which standard deviations fall to that; 1: from the
    start."""
    critic_rounds: int | None = None
    """Rounds in which the critic learns alone; None: 0, or 4 with a `start`."""
    critic: CriticKind = "particle"
    """A value follows from a particle's own perception, or from its whole world ("central")."""

    def __post_init__(self) -> None:
        """Check every field; raises NPAError."""
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
        check_word("critic", self.critic, get_args(CriticKind))

    def pace(self, start: RuleSet | None) -> Pace:
        """Return the options that depend on a start: those of `FRESH` or `WARM` where None."""
        given = {name: getattr(self, name) for name in Pace._fields}
        given = {name: value for name, value in given.items() if value is not None}
        return (FRESH if start is None else WARM)._replace(**given)


def noise_left(share_left: float, last_noise: float, decay_share: float) -> float:
    """Return the share of the first noise that is left: 1 at first, then it falls exponentially.

    Rules learn what is best with noise, and are evaluated without. In the last `decay_share` of the
    budget the two become the same.
    """
    return math.pow(last_noise, max(0.0, 1.0 - share_left / decay_share))


def check_word(name: str, word: object, words: Sequence[str]) -> None:
    """Check that an option is one of a few words."""
    if word not in words:
        raise NPAError(f"{name} must be a known word, got {shown(word)}: {suggest(word, words)}")


def find_gradients(optimizer: torch.optim.Optimizer, loss: Tensor) -> None:
    """Write the gradients of a loss into those of an optimiser's parameters."""
    # A read-out does not act, and layers may be frozen.
    parameters = [p for p in optimizer.param_groups[0]["params"] if p.requires_grad]
    # Not backward(): its accumulation nodes remember the stream they were first used on, which a
    # capture on another stream must not touch.
    gradients = torch.autograd.grad(loss, parameters, allow_unused=True)
    for parameter, gradient in zip(parameters, gradients, strict=True):
        if gradient is not None:
            if parameter.grad is None:
                # Laid out like the parameter, as fused optimisers expect.
                parameter.grad = torch.empty_like(parameter)
            parameter.grad.copy_(gradient)


def gradients_of(optimizer: torch.optim.Optimizer) -> list[Tensor]:
    """Return the gradients of those of an optimiser's parameters that have one."""
    return [p.grad for p in optimizer.param_groups[0]["params"] if p.grad is not None]


def zero_output_rules(problem: Problem, seed: int, start: RuleSet | None) -> RuleSet:
    """Return the rules that actor-critics begin with: those given, or fresh ones that do nothing.

    The steps of random output layers add up: in `npa/Regeneration2D-v0` they take apart whole
    pictures. Output layers of zeros leave these alone, and learn just as well.
    """
    if start is not None:
        return start
    rules = problem.new_rules(seed)
    for rule in rules:
        nn.init.zeros_(rule.output.weight)
    return rules


HALF_LOG_TAU = 0.5 * math.log(2.0 * math.pi)


def gaussian_log_prob(mean: Tensor, log_std: Tensor, action: Tensor) -> Tensor:
    """Return the log-probability of each row of actions [..., A], shape [...]."""
    noise = (action - mean) * torch.exp(-log_std)
    return -(0.5 * noise.square() + log_std + HALF_LOG_TAU).sum(dim=-1)


class GaussianRules(nn.Module):
    """Rules as the mean of Gaussian actions, whose standard deviations do not depend on the state.

    Each particle has a likelihood of its own, summed over its action's columns. That of a world is
    the mean over its particles, never the sum: with N A columns the ratio of two sums is far from
    one after the smallest update. The rules given are copied.
    """

    row_species: Tensor

    def __init__(self, rules: RuleSet, initial_std: float) -> None:
        super().__init__()
        self.rules = copy.deepcopy(rules)
        widths = [rule.update_dim for rule in self.rules]
        start = torch.full((len(widths), widths[0]), math.log(initial_std))
        self.noise_left = 1.0
        """Share of the first standard deviations that is left (dimensionless)."""
        self.log_std = nn.Parameter(start)
        """Logarithms of the standard deviations, a row for each species, shape [K, A]."""
        self.register_buffer("row_species", species_of(rules.counts), persistent=False)
        # A tuple, so that modules are registered once.
        self._each = tuple(RuleSet([rule], [1], self.rules.interface) for rule in self.rules)

    def get_extra_state(self) -> float:
        """Return the share of the noise that is left, for `state_dict`."""
        return self.noise_left

    def set_extra_state(self, state: float) -> None:
        """Set the share of the noise that is left."""
        self.noise_left = state

    def row_log_std(self) -> Tensor:
        """Return the logarithms of the standard deviations of every particle, shape [N, A]."""
        return self.log_std[self.row_species]

    @torch.no_grad()
    def leave_noise(self, left: float) -> None:
        """Scale standard deviations to a share of the first, on top of what was learned."""
        self.log_std.add_(math.log(left / self.noise_left))
        self.noise_left = left

    def sample(
        self, observation: Tensor, generator: Randomness | None = None
    ) -> tuple[Tensor, Tensor]:
        """Draw actions for observations [M, N, P], not clipped, with log-probabilities [M, N]."""
        mean, log_std = self.rules.mean(observation), self.row_log_std()
        noise = normal_draws(generator, mean.shape, mean)
        action = mean + log_std.exp() * noise
        return action, gaussian_log_prob(mean, log_std, action)

    def log_prob(self, observation: Tensor, action: Tensor) -> Tensor:
        """Return the log-probability of each particle's action, shape [M, N]."""
        return gaussian_log_prob(self.rules.mean(observation), self.row_log_std(), action)

    def row_log_prob(self, species: int, rows: Tensor, action: Tensor) -> Tensor:
        """Return log-probabilities [K] of actions [K, A] of one species that perceives [K, P]."""
        mean = self._each[species].mean(rows[:, None])[:, 0]
        return gaussian_log_prob(mean, self.log_std[species], action)

    def entropy(self) -> Tensor:
        """Return the mean entropy of a particle's action [nats]."""
        return (self.row_log_std() + HALF_LOG_TAU + 0.5).sum(dim=-1).mean()


SLOWEST = 0.01
"""Share of the newest batch in the running moments, once they are no longer plain means."""

FARTHEST = 8.0
"""Standardised inputs are clipped to plus and minus this."""


class Critic(nn.Module):
    """Values of particles, whose inputs and outputs are standardised by running moments.

    A value of the kind "particle" is a function of the particle's own perception, "central" of that
    and of features of all particles of its world, averaged.
    """

    mean: Tensor
    square: Tensor
    scale: Tensor
    updates: Tensor
    row_species: Tensor

    def __init__(
        self,
        perception_dim: int,
        counts: Sequence[int],
        kind: CriticKind = "particle",
        width: int = 64,
    ) -> None:
        super().__init__()
        self.features = nn.Linear(perception_dim, width)
        self.own = nn.Linear(width, width)
        self.pooled = nn.Linear(width, width, bias=False) if kind == "central" else None
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
        """Return values of particles that observe [M, N, P], in units of the rewards, [M, N]."""
        spread = (self.square - self.mean.square()).clamp(min=1e-6).sqrt()
        seen = ((observation - self.mean) / spread).clamp(-FARTHEST, FARTHEST)
        features = torch.tanh(self.features(seen))
        mixed = self.own(features) + self.species(self.row_species)
        if self.pooled is not None:
            mixed = mixed + self.pooled(features.mean(dim=-2, keepdim=True))
        values: Tensor = self.value(torch.tanh(mixed)).squeeze(-1)
        return self.scale * values

    @torch.no_grad()
    def observe(self, observation: Tensor, ranks: Ranks = ALONE) -> None:
        """Take observations [..., P] of all processes into the moments of inputs."""
        rate = self._rate(0)
        rows = observation.flatten(0, -2)
        mean, square = rows.mean(dim=0), rows.square().mean(dim=0)
        ranks.reduce([mean, square])
        self.mean.lerp_(mean, rate)
        self.square.lerp_(square, rate)

    @torch.no_grad()
    def rescale(self, targets: Tensor, ranks: Ranks = ALONE) -> None:
        """Take targets into the scale of values; values stay the same."""
        before = self.scale.clone()
        square = targets.square().mean()
        ranks.reduce([square])
        size = square.sqrt().clamp(min=1e-8)
        self.scale.lerp_(size, self._rate(1))
        for parameter in (self.value.weight, self.value.bias):
            parameter.mul_(before / self.scale)

    def _rate(self, moment: int) -> Tensor:
        """Return the share of the newest batch, on the device."""
        self.updates[moment] += 1.0
        return (1.0 / self.updates[moment]).clamp(min=SLOWEST)


def seeded_critic(problem: Problem, input_dim: int, options: Any, seed: int) -> Critic:
    """Return the critic of a problem's particles; torch's own randomness is left as it is."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return Critic(input_dim, problem.counts, options.critic, options.critic_width)


def learner_random(
    seed: int, total: int, places: Tensor, device: torch.device, ranks: Ranks
) -> Randomness:
    """Return the source of a learner's draws: a stream a world where processes share them."""
    if ranks.together:
        return world_streams((seed,), total, places, device)
    return torch.Generator(device).manual_seed(seed)


class Minibatches:
    """Parts that the rows of a round are shuffled into, anew for each pass.

    A process alone shuffles all rows. Where several share a run, the rows of each world are
    shuffled by its own stream, and a part has as many of each world: so it is the same part of the
    whole round for any number of processes.

    Groups are shuffled by themselves; those of n `rows` a world and step stand as [T, B, n]. There
    are `count` parts, or fewer where there are not as many rows.
    """

    def __init__(
        self, steps: int, worlds: int, rows: Sequence[int], count: int, random: Randomness
    ) -> None:
        self._shape = steps, worlds
        self._rows = rows
        self._random = random
        shared = worlds if isinstance(random, WorldRandom) else 1
        self.count = min(count, steps * worlds * min(rows) // shared)
        """Parts of a pass."""
        # Recorded work reads them in place.
        self._orders = [
            torch.zeros(steps * worlds * n, dtype=torch.int64, device=random.device) for n in rows
        ]
        self.parts: list[tuple[Tensor, ...]] = []
        """Rows of each part, int64, by group: views, which `shuffle` writes anew."""
        for order in self._orders:
            # As even as `tensor_split` makes them.
            sizes = [shared * ((len(order) // shared + k) // self.count) for k in range(self.count)]
            self.parts.append(torch.split(order, sizes[::-1]))

    def shuffle(self) -> None:
        """Draw the orders of the next pass."""
        restart(self._random)
        for order, rows in zip(self._orders, self._rows, strict=True):
            if isinstance(self._random, WorldRandom):
                order.copy_(self._by_world(self._random, rows))
            else:
                torch.randperm(len(order), generator=self._random, out=order)

    def _by_world(self, random: WorldRandom, rows: int) -> Tensor:
        """Return all rows of a group, part by part, shape [T B n]."""
        steps, worlds = self._shape
        places = random.uniform(steps * rows).argsort(dim=1, stable=True)
        world = torch.arange(worlds, device=places.device)[:, None]
        index = (places // rows * worlds + world) * rows + places % rows
        return torch.cat([part.flatten() for part in index.tensor_split(self.count, dim=1)])
