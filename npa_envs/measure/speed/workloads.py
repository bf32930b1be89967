"""Worlds to measure on, with as many neighbours everywhere."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from npa_envs.rule.rule import NPARule
from npa_envs.world.rollout import rollout

SQUARE_HALF_WIDTH = 0.7
"""Half the side of a square of 4096 particles [length units]; larger worlds are as dense."""

CUBE_HALF_WIDTH = 0.8
"""Half the side of a cube of 16 384 particles [length units]; other cubes are as dense."""


@dataclass(frozen=True)
class Workload:
    """Worlds of uniformly scattered particles and a fresh rule; about 66 neighbours in 2D."""

    space_dim: int
    """Space dimension D."""
    world_count: int
    """Worlds B."""
    particle_count: int
    """Particles in each world N."""
    steps: int
    """Steps of a rollout T."""
    hidden_dim: int = 128
    """Width of the rule's hidden layer."""
    state_dim: int = 16
    """State channels C."""
    eps: float = 0.1
    """Perception radius [length units]."""
    update_prob: float = 0.5
    """Probability of each particle's update in a step (dimensionless)."""

    @property
    def name(self) -> str:
        """Short name: dimension and (B, N, T)."""
        return f"{self.space_dim}D ({self.world_count}, {self.particle_count}, {self.steps})"

    @property
    def half_width(self) -> float:
        """Half the side of the square or cube that the particles fill [length units]."""
        if self.space_dim == 2:
            return SQUARE_HALF_WIDTH * math.sqrt(self.particle_count / 4096)
        return CUBE_HALF_WIDTH * math.cbrt(self.particle_count / 16384)

    @property
    def neighbour_count(self) -> float:
        """Mean number of particles within eps of one, itself included, far from the edges."""
        ball = math.pi * self.eps**2 if self.space_dim == 2 else 4 / 3 * math.pi * self.eps**3
        volume = math.prod((2.0 * self.half_width,) * self.space_dim)
        return 1.0 + self.particle_count * ball / volume

    def worlds(self, device: torch.device) -> tuple[Tensor, Tensor]:
        """Return float32 positions [length units], [B, N, D], and states, [B, N, C]."""
        generator = torch.Generator(device).manual_seed(0)
        shape = (self.world_count, self.particle_count)
        x = torch.rand(*shape, self.space_dim, generator=generator, device=device)
        s = torch.randn(*shape, self.state_dim, generator=generator, device=device)
        return x.mul_(2.0).sub_(1.0).mul_(self.half_width), s.mul_(0.1)

    def rule(self, device: torch.device, **options: Any) -> NPARule:
        """Return a rule with the same fresh weights at every call, and options of `NPARule`."""
        # Weights are drawn from torch's global generators, which must be left as they were.
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            dims = (self.space_dim, self.state_dim, self.hidden_dim)
            rule = NPARule(*dims, eps0=self.eps, **options)
        return rule.to(device)


def rollout_call(
    workload: Workload,
    x: Tensor,
    s: Tensor,
    *,
    train: bool = False,
    gradients: bool = False,
    rule: Mapping[str, bool] | None = None,
    roll: Callable[..., Any] = rollout,
    **options: Any,
) -> tuple[Callable[[], None], torch.Generator]:
    """Return a call that rolls worlds out, and the source of its masks.

    `train` takes the gradient of a random linear functional by the rule's weights, `gradients`
    only lets autograd store its inputs. `rule` are options of the rule, `options` those of `roll`.
    """
    network = workload.rule(x.device, **(rule or {}))
    generator = torch.Generator(x.device).manual_seed(1)
    given = {"eps": workload.eps, "update_prob": workload.update_prob, **options}
    draws = torch.Generator(x.device).manual_seed(2)
    weights = [
        torch.randn(worlds.shape, generator=draws, device=x.device)
        for worlds in ((x, s) if train else ())
    ]

    def run() -> None:
        with torch.set_grad_enabled(train or gradients):
            worlds = roll(network, x, s, workload.steps, generator=generator, **given)
            if train:
                terms = [(a * b).sum() for a, b in zip(worlds, weights, strict=True)]
                torch.autograd.grad(terms[0] + terms[1], list(network.parameters()))

    return run, generator
