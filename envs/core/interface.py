"""The meaning of the columns of observations and actions."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Interface(NamedTuple):
    """Meaning of the columns of an environment's observations and actions."""

    space_dim: int
    """Space dimension D."""
    state_dim: int
    """State channels C."""
    moving: bool
    """Whether actions begin with a displacement, as particles move."""
    state_scale: float
    """State step of an action of 1, dimensionless."""
    species_count: int = 0
    """Species whose densities and density gradients are at the end of a perception; 0: none."""
    target_dim: int = 0
    """Columns of the world's target at the end of an observation; policies ignore them."""

    @property
    def shared_dim(self) -> int:
        """Length of a perception without each species' own density and density gradient."""
        return self.state_dim * (2 + self.space_dim) + self.space_dim

    @property
    def perception_dim(self) -> int:
        """Length P of a perception vector."""
        return self.shared_dim + self.species_count * (1 + self.space_dim)

    @property
    def action_dim(self) -> int:
        """Length A of an action."""
        return self.state_dim + (self.space_dim if self.moving else 0)

    def states(self, observation: Tensor) -> Tensor:
        """Return the particles' own states s, dimensionless, shape [..., C]."""
        return observation[..., : self.state_dim]

    def mean_states(self, observation: Tensor) -> Tensor:
        """Return the mean states s̄ of their neighbourhoods, dimensionless, shape [..., C]."""
        return observation[..., self.state_dim : 2 * self.state_dim]

    def density_gradient(self, observation: Tensor) -> Tensor:
        """Return the density gradient, (ε / ε0)^{1+D} ∇ρ / N, on a linear scale, shape [..., D]."""
        scaled = observation[..., self.shared_dim - self.space_dim : self.shared_dim]
        size = scaled.norm(dim=-1, keepdim=True)
        return scaled * torch.where(size > 0.0, torch.expm1(size) / size, 1.0)

    def action(self, displacement: Tensor, state_step: Tensor) -> Tensor:
        """Return the action of a displacement and a state step, within the action space.

        Displacements [..., D], fractions of α ε, are clipped to length 1 and left out if particles
        do not move; state steps [..., C] are clipped to ± `state_scale`.
        """
        parts = [(state_step / self.state_scale).clamp(-1.0, 1.0)]
        if self.moving:
            size = displacement.norm(dim=-1, keepdim=True)
            parts.insert(0, (displacement / size.clamp(min=1.0)).clamp(-1.0, 1.0))
        return torch.cat(parts, dim=-1)
