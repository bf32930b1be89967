"""Rules that explore: Gaussian actions around what the rules would do."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from npa_envs.agents.learning.rules import RuleSet
from npa_envs.errors import NPAError, suggest

HALF_LOG_TAU = 0.5 * math.log(2.0 * math.pi)
"""Constant of the logarithm of a Gaussian's density."""


def gaussian_log_prob(mean: Tensor, log_std: Tensor, action: Tensor) -> Tensor:
    """Return the log-probability of each row of actions, shape [...].

    Args:
        mean: Shape [..., A].
        log_std: Logarithms of the standard deviations, likewise, or broadcast to it.
        action: What was done, like the mean.
    """
    noise = (action - mean) * torch.exp(-log_std)
    return -(0.5 * noise.square() + log_std + HALF_LOG_TAU).sum(dim=-1)


class GaussianRules(nn.Module):
    """Rules as the mean of Gaussian actions, whose standard deviations do not depend on the state.

    Each particle has a likelihood of its own, summed over its action's columns. That of a world is
    the mean over its particles, never the sum: with N A columns the ratio of two sums is far from
    one after the smallest update.

    Args:
        rules: Means; copied, so the caller's stay as they are.
        initial_std: Standard deviation of every action column at first (dimensionless).
    """

    row_species: Tensor

    def __init__(self, rules: RuleSet, initial_std: float) -> None:
        super().__init__()
        self.rules = copy.deepcopy(rules)
        """What acts without exploration."""
        widths = [rule.update_dim for rule in self.rules]
        start = torch.full((len(widths), widths[0]), math.log(initial_std))
        self._left = 1.0
        self.log_std = nn.Parameter(start)
        """Logarithms of the standard deviations, a row for each species, shape [K, A]."""
        counts = [span.stop - span.start for span in self.rules.spans]
        kinds = torch.arange(len(widths)).repeat_interleave(torch.tensor(counts))
        self.register_buffer("row_species", kinds, persistent=False)
        # The same rules one by one, not registered a second time.
        self._each = tuple(RuleSet([rule], [1], self.rules.interface) for rule in self.rules)

    def row_log_std(self) -> Tensor:
        """Return the logarithms of the standard deviations of every particle, shape [N, A]."""
        return self.log_std[self.row_species]

    @torch.no_grad()
    def leave_noise(self, left: float) -> None:
        """Scale all standard deviations, what was learned of them stays.

        Args:
            left: What is to be left of those at first, above 0 (dimensionless).
        """
        self.log_std.add_(math.log(left / self._left))
        self._left = left

    def sample(
        self, observation: Tensor, generator: torch.Generator | None = None
    ) -> tuple[Tensor, Tensor]:
        """Draw actions, and return them with their log-probabilities.

        Args:
            observation: Shape [M, N, P].
            generator: Where the noise comes from, on the observation's device; None: torch's own.

        Returns:
            Actions [M, N, A], not clipped, and log-probabilities [M, N].
        """
        mean, log_std = self.rules.mean(observation), self.row_log_std()
        noise = torch.randn(mean.shape, generator=generator, device=mean.device)
        action = mean + log_std.exp() * noise
        return action, gaussian_log_prob(mean, log_std, action)

    def log_prob(self, observation: Tensor, action: Tensor) -> Tensor:
        """Return the log-probability of each particle's action, shape [M, N].

        Args:
            observation: Shape [M, N, P].
            action: Shape [M, N, A].
        """
        return gaussian_log_prob(self.rules.mean(observation), self.row_log_std(), action)

    def row_mean(self, species: int, rows: Tensor) -> Tensor:
        """Return what particles of one species would do without exploration, shape [K, A].

        Args:
            species: Its number.
            rows: What they perceive, shape [K, P].
        """
        return self._each[species].mean(rows[:, None])[:, 0]

    def row_log_prob(self, species: int, rows: Tensor, action: Tensor) -> Tensor:
        """Return the log-probability of the actions of particles of one species, shape [K].

        Args:
            species: Its number.
            rows: What they perceive, shape [K, P].
            action: What they did, shape [K, A].
        """
        return gaussian_log_prob(self.row_mean(species, rows), self.log_std[species], action)

    def entropy(self) -> Tensor:
        """Return the mean entropy of a particle's action [nats]."""
        return (self.row_log_std() + HALF_LOG_TAU + 0.5).sum(dim=-1).mean()


# What states are worth: a small network on each particle's perception, alone or in its world.


CriticKind = Literal["particle", "central"]
"""What a value is told of: a "particle" alone, or its whole world besides ("central")."""

SLOWEST = 0.01
"""Share of the newest batch in the running moments, once they are no longer plain means."""

FARTHEST = 8.0
"""Standardised inputs are clipped to plus and minus this."""


class Critic(nn.Module):
    """Values of particles, which standardises what it sees and predicts by running moments.

    A critic is not exported, so that it may see more, and otherwise, than a rule does.

    Args:
        perception_dim: Columns P of an observation.
        counts: Particles of each species.
        kind: "particle": a value follows from the particle's own perception; "central": from that
            and from features of all particles of its world, averaged.
        width: Units of a hidden layer.

    Raises:
        NPAError: There is no such kind.
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
        if kind not in ("particle", "central"):
            raise NPAError(
                f"critic must be a known kind, got {kind!r}: "
                f"{suggest(str(kind), ['particle', 'central'])}"
            )
        self.features = nn.Linear(perception_dim, width)
        self.own = nn.Linear(width, width)
        self.pooled = nn.Linear(width, width, bias=False) if kind == "central" else None
        self.species = nn.Embedding(len(counts), width)
        self.value = nn.Linear(width, 1)
        nn.init.zeros_(self.species.weight)
        nn.init.zeros_(self.value.weight)
        nn.init.zeros_(self.value.bias)
        kinds = torch.arange(len(counts)).repeat_interleave(torch.tensor(tuple(counts)))
        self.register_buffer("row_species", kinds, persistent=False)
        self.register_buffer("mean", torch.zeros(perception_dim))
        self.register_buffer("square", torch.ones(perception_dim))
        self.register_buffer("scale", torch.ones(()))
        self.register_buffer("updates", torch.zeros(2))

    def forward(self, observation: Tensor) -> Tensor:
        """Return the value of every particle, in units of the rewards, shape [M, N].

        Args:
            observation: Shape [M, N, P].
        """
        spread = (self.square - self.mean.square()).clamp(min=1e-6).sqrt()
        seen = ((observation - self.mean) / spread).clamp(-FARTHEST, FARTHEST)
        features = torch.tanh(self.features(seen))
        mixed = self.own(features) + self.species(self.row_species)
        if self.pooled is not None:
            mixed = mixed + self.pooled(features.mean(dim=-2, keepdim=True))
        values: Tensor = self.value(torch.tanh(mixed)).squeeze(-1)
        return self.scale * values

    @torch.no_grad()
    def observe(self, observation: Tensor) -> None:
        """Take observations into the moments that inputs are standardised by.

        Args:
            observation: Shape [..., P].
        """
        rate = self._rate(0)
        rows = observation.flatten(0, -2)
        self.mean.lerp_(rows.mean(dim=0), rate)
        self.square.lerp_(rows.square().mean(dim=0), rate)

    @torch.no_grad()
    def rescale(self, targets: Tensor) -> None:
        """Take targets into the scale of values; what the critic says now keeps its meaning.

        Args:
            targets: Values to be predicted, of any shape.
        """
        before = self.scale.clone()
        size = targets.square().mean().sqrt().clamp(min=1e-8)
        self.scale.lerp_(size, self._rate(1))
        for parameter in (self.value.weight, self.value.bias):
            parameter.mul_(before / self.scale)

    def _rate(self, moment: int) -> Tensor:
        """Return the share of the newest batch, on the device."""
        self.updates[moment] += 1.0
        return (1.0 / self.updates[moment]).clamp(min=SLOWEST)
