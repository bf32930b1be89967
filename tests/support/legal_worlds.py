"""Property tests: Hypothesis strategies of random legal worlds, and bounds on rounding errors.

Coordinates, shifts and sides of boxes are multiples of `GRID`, so that moving a world rounds
nothing, while particles coincide, lie on borders of cells, on the seam of a box, and at ε exactly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import pytest
import torch
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from torch import Tensor

import npa_envs
from npa_envs import reference as oracle

QUICK, THOROUGH = 15, 500
"""Examples of a property in a quick run and in a thorough one."""

GRID = 2.0**-10
"""Unit of coordinates [length units]."""

UNIT = {torch.float32: 2.0**-24, torch.float64: 2.0**-53}
"""Rounding of one operation, relative."""

ROUNDINGS = 50
"""Roundings that a sum and what it is made of are allowed."""

PLACES = ("scattered", "lattice", "coincident", "clump", "seam")


@dataclass(frozen=True)
class World:
    """Worlds and how they are perceived."""

    x: Tensor
    s: Tensor
    eps: float
    eps0: float
    box: tuple[float, ...] | None
    seed: int
    """Of all that belongs to the worlds beside their positions and states."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """B, N and D."""
        return tuple(self.x.shape)

    def normal(self, *shape: int, seed: int = 0) -> Tensor:
        """Return normal numbers of the worlds' dtype and device, the same for the same seed."""
        generator = torch.Generator().manual_seed(self.seed + seed)
        return torch.randn(*shape, generator=generator, dtype=torch.float64).to(self.x)

    def permutation(self) -> Tensor:
        """Return another order of the particles, shape [N]."""
        generator = torch.Generator().manual_seed(self.seed)
        return torch.randperm(self.shape[1], generator=generator).to(self.x.device)

    def shift(self) -> Tensor:
        """Return a shift by which no coordinate is rounded, shape [D]."""
        return ((self.normal(self.shape[2]) / GRID).round() * GRID).clamp(-4.0, 4.0)

    @property
    def factor(self) -> float:
        """A power of two by which nothing over- or underflows."""
        return 2.0 ** (self.seed % 13 - 6)

    def split(self, count: int) -> list[int]:
        """Return how the particles fall into species."""
        total = self.shape[1]
        first = 1 + self.seed % max(1, total - 1)
        return [first, total - first] if count == 2 and total > first else [total]

    def scaled(self) -> World:
        """Return the worlds with all lengths times `factor`, except the radius of training."""
        box = None if self.box is None else tuple(side * self.factor for side in self.box)
        return replace(self, x=self.x * self.factor, eps=self.eps * self.factor, box=box)

    def ordered(self, order: Tensor) -> World:
        """Return the worlds with their particles in another order."""
        return replace(self, x=self.x[:, order], s=self.s[:, order])

    def moved(self) -> World:
        """Return the worlds with all positions moved by `shift`."""
        return replace(self, x=self.x + self.shift())

    def alone(self, k: int) -> World:
        """Return world k as a batch of one."""
        return replace(self, x=self.x[k : k + 1], s=self.s[k : k + 1])


@st.composite
def worlds(draw, device, *, dtypes=tuple(UNIT)):
    """Draw worlds: N from 1, states of sizes 0 to 1000, open or periodic down to sides of 2 ε."""
    dim, dtype = draw(st.sampled_from((2, 3))), draw(st.sampled_from(dtypes))
    world_count, particle_count = draw(st.integers(1, 3)), draw(st.integers(1, 24))
    eps_units = draw(st.sampled_from((1, 32, 96, 128, 200, 512)))
    eps = eps_units * GRID
    # A radius of a grid unit would put every particle of a wide world in a cell of its own.
    reach = draw(st.sampled_from((1, 4, 1000))) * eps_units
    box = None
    if draw(st.booleans()):
        factors = draw(st.tuples(*[st.integers(0, 3)] * dim))
        box = tuple((2 * eps_units + f * eps_units // 2 * 2) * GRID for f in factors)
    seed = draw(st.integers(0, 2**31))
    generator = torch.Generator().manual_seed(seed)

    def integers(low, high, *shape):
        return torch.randint(low, high + 1, shape, generator=generator)

    units = integers(-reach, reach, world_count, particle_count, dim)
    where = draw(st.sampled_from(PLACES))
    if where == "lattice":
        units = units // eps_units * eps_units
    elif where == "coincident":
        twin = integers(0, particle_count - 1, world_count, particle_count, 1)
        units = units.gather(1, twin.expand_as(units))
    elif where == "clump":
        units = units[:, :1] + integers(-2, 2, world_count, particle_count, dim)
    elif where == "seam" and box is not None:
        half = torch.tensor([round(side / GRID) // 2 for side in box])
        units = units.sign() * half - integers(-1, 1, *units.shape)
    size = draw(st.sampled_from((0.0, 1e-3, 1.0, 1e3)))
    shape = (world_count, particle_count, draw(st.integers(1, 6)))
    s = size * torch.randn(shape, generator=generator, dtype=torch.float64)
    eps0 = eps * draw(st.sampled_from((0.5, 1.0, 3.0)))
    return World((units * GRID).to(device, dtype), s.to(device, dtype), eps, eps0, box, seed)


def clear_of_threshold(world: World) -> None:
    """Give up an example whose moment matrices rounding takes across the threshold."""
    moment = npa_envs.perception_fields(world.x.double(), world.s.double(), world.eps, world.box)[3]
    size = torch.linalg.matrix_norm(moment) ** world.shape[2]
    slack = 10 * ROUNDINGS * UNIT[world.x.dtype] * (size + 1.0)
    assume(bool(((torch.linalg.det(moment).abs() - oracle.MOMENT_THRESHOLD).abs() > slack).all()))


def allowances(world: World) -> npa_envs.PerceptionFields:
    """Return how far rounding may move each field, by the sums of sizes behind it.

    Densities are sums of positive numbers; gradients cancel, so that the sums of their terms'
    sizes count; where a moment matrix is inverted its own error is carried along.
    """
    x, s = world.x.double(), world.s.double()
    fields = npa_envs.perception_fields(x, s, world.eps, world.box)
    r = oracle.differences(x, world.box)
    kernel = oracle.spiky_gradient(r, world.eps).norm(dim=-1)
    # (ε - r)² cancels next to its edge: a rounding of r moves it by so much of ε (ε - r).
    dims = world.shape[2]
    peak = (30.0, 45.0)[dims - 2] / math.pi / world.eps ** (1 + dims)
    kernel = (kernel * peak).sqrt()
    unit = ROUNDINGS * UNIT[world.x.dtype]
    weighted = kernel / fields.rho[:, None]
    largest = s.abs().amax(dim=(1, 2))[:, None] + 1e-30
    slope = unit * 2.0 * largest * weighted.sum(2)
    moment = unit * (weighted * r.norm(dim=-1)).sum(2) + unit
    determinant = torch.linalg.det(fields.moment).abs()
    inverted = determinant >= 0.5 * oracle.MOMENT_THRESHOLD
    norm = torch.linalg.matrix_norm(fields.moment)
    gain = torch.where(inverted, norm ** (dims - 1) / determinant.clamp(min=1e-4), 1.0)
    steepest = fields.grad0.norm(dim=-1).amax(dim=-1)
    corrected = slope + gain * (slope + steepest * moment * gain)
    return npa_envs.PerceptionFields(
        rho=unit * fields.rho,
        blur=(unit * largest)[..., None].expand_as(fields.blur),
        grad0=slope[..., None, None].expand_as(fields.grad0),
        moment=moment[..., None, None].expand_as(fields.moment),
        grad1=corrected[..., None, None].expand_as(fields.grad1),
        drho=(unit * kernel.sum(2))[..., None].expand_as(fields.drho),
    )


def perception_allowance(world: World) -> Tensor:
    """Return how far rounding may move a perception vector, [B, N, P]: L stretches nothing."""
    fields, ratio = allowances(world), world.eps / world.eps0
    unit = ROUNDINGS * UNIT[world.x.dtype]
    density = ratio ** (1 + world.shape[2]) / world.shape[1] * fields.drho
    parts = (torch.zeros_like(fields.blur), fields.blur, ratio * fields.grad1.flatten(2), density)
    # L's values grow like a logarithm: 100 is beyond them all.
    return torch.cat(parts, dim=2) + 100.0 * unit


def within(value: Tensor, expected: Tensor, allowed: Tensor | float) -> None:
    """Assert that numbers are as expected up to what is allowed of each."""
    assert value.isfinite().all()
    error = (value.double() - expected.double()).abs()
    assert (error <= allowed).all(), (
        f"off by up to {float((error / allowed).nan_to_num(0).max()):.3g} times what is allowed"
    )


def every(strategy):
    """Make a test of a function of what is drawn for it: a quick one and a thorough one.

    Args:
        strategy: Function of the device that returns a strategy.
    """

    def decorate(function):
        @pytest.mark.parametrize(
            "examples", [QUICK, pytest.param(THOROUGH, marks=pytest.mark.slow)]
        )
        def run(examples, device):
            # The quick run is the same each time; no example has to meet a deadline.
            chosen = settings(
                max_examples=examples,
                derandomize=examples == QUICK,
                deadline=None,
                print_blob=True,
                database=None,
                suppress_health_check=[HealthCheck.too_slow],
            )
            chosen(given(strategy(device))(function))()

        run.__name__, run.__doc__ = function.__name__, function.__doc__
        return run

    return decorate
