"""What trained rules do to each other, in numbers: what is measured, and what it is called.

Independently trained rules can share a world (arXiv 2601.16096). Whether one disrupts another is
measured by the other's own task, on its own particles, against the same seeds grown alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.ops import species_fields

MARGIN = 0.2
"""A loss that changes by less than this share of itself counts as undisturbed."""

MIXED = 0.25
"""Mixing index from which on two species mix (dimensionless)."""


@dataclass(frozen=True, kw_only=True)
class InteractionSettings:
    """How rules are brought together."""

    particle_count: int
    """Particles of a world with two species, N."""

    distances: tuple[float, ...] = (0.0, 0.5, 1.0)
    """Distances between the centres of the two seeds [length units]."""

    ratios: tuple[float, ...] = (0.5,)
    """Shares of the particles that are of the measured species, in (0, 1)."""

    steps: int = 512
    """Steps from the seeds."""

    seeds: tuple[int, ...] = tuple(range(8))
    """One number for each world; the same numbers give the same table."""

    update_prob: float | None = None
    """Probability of each particle's update in a step; None: of each species as trained."""

    margin: float = MARGIN
    """Share by which a loss must change to count as changed, in (0, 1)."""

    def __post_init__(self) -> None:
        """Check every field.

        Raises:
            NPAError: A field lies outside its range.
        """
        for name, count, least in (
            ("particle_count", self.particle_count, 2),
            ("steps", self.steps, 1),
            ("seed count", len(self.seeds), 1),
        ):
            if count < least:
                raise NPAError(f"{name} must be at least {least}, got {count}")
        if not self.distances or not all(0.0 <= d < math.inf for d in self.distances):
            raise NPAError(
                f"distances must be finite and not negative, got {self.distances}: try 0 0.5 1"
            )
        for name, shares in (("ratios", self.ratios), ("margin", (self.margin,))):
            if not shares or not all(0.0 < share < 1.0 for share in shares):
                raise NPAError(f"{name} must lie in (0, 1), got {shares}")
        if self.update_prob is not None and not 0.0 < self.update_prob <= 1.0:
            raise NPAError(f"update_prob must lie in (0, 1], got {self.update_prob}")

    def counts(self, ratio: float) -> tuple[int, int]:
        """Return the particles of the measured species and of the one beside it."""
        own = min(max(round(ratio * self.particle_count), 1), self.particle_count - 1)
        return own, self.particle_count - own


@dataclass(frozen=True)
class InteractionRow:
    """One rule, grown beside another."""

    rule: str
    """The rule that is measured, A."""

    beside: str
    """The rule beside it, B."""

    distance: float
    """Distance between the centres of their seeds [length units]."""

    ratio: float
    """A's share of the particles (dimensionless)."""

    alone: float
    """A's task metric where it grows alone, mean of the worlds."""

    together: float
    """A's task metric of its own particles where it grows beside B, mean of the worlds."""

    change: float
    """together / alone (dimensionless)."""

    mixing: float
    """`mixing_index` at the end, mean of the worlds (dimensionless)."""

    displacement: float
    """How far A's centroid ends from where it ends alone, mean of the worlds [length units]."""

    verdict: str
    """`verdict` of `change` and `mixing`."""


def verdict(change: float, mixing: float, margin: float = MARGIN) -> str:
    """Return what a neighbour does to a rule, in a word or two.

    "cooperates" where the loss falls below 1 - margin of what it is alone, "disrupted" where it
    rises above 1 + margin or is no number, else "undisturbed"; and ", mixes" where the mixing index
    is at least `MIXED`.

    Args:
        change: Loss together over loss alone (dimensionless).
        mixing: The mixing index (dimensionless).
        margin: Share by which the loss must change.
    """
    word = "disrupted"
    if change < 1.0 - margin:
        word = "cooperates"
    elif change <= 1.0 + margin:
        word = "undisturbed"
    return f"{word}, mixes" if mixing >= MIXED else word


def mixing_index(x: Tensor, counts: Sequence[int], *, eps: float) -> Tensor:
    """Return how much the species of each world are mixed, in [0, 1], shape [B].

    The mean over the particles of the entropy of the species around each, in units of log K: the
    shares are those of each species in the density at the particle, itself included. 0: nobody
    sees another species; 1: everybody sees all alike.

    Args:
        x: Positions [length units], shape [B, N, D], species after species.
        counts: Particles of each of K species, K at least 2.
        eps: Perception radius [length units].

    Raises:
        NPAError: Positions or counts do not fit, or there is one species only.
    """
    rho = species_fields(x, counts, eps=eps).rho
    if rho.shape[2] < 2:
        raise NPAError("counts must name at least two species that can mix, got one")
    shares = rho / rho.sum(dim=2, keepdim=True)
    entropy: Tensor = torch.special.entr(shares).sum(dim=2)
    return entropy.mean(dim=1) / math.log(rho.shape[2])
