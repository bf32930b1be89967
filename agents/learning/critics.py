"""What states are worth: a small network on each particle's perception, alone or in its world."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from npa_envs.errors import NPAError, suggest

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
