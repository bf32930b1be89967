"""Scenes that are hard to perceive, their perception, and its errors against the reference."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from npa_envs import reference
from npa_envs.ops import perceive

EPS = 0.125
"""Perception radius of the scenes [length units], a power of two, so that borders are exact."""

SIDE = 1.0
"""Side of the periodic scenes' boxes [length units]."""

STATE_DIM = 5
"""Number of state channels C of the scenes."""

Box = tuple[float, ...] | None
"""Sides of a periodic box [length units], one for each dimension; None: open space."""


@dataclass(frozen=True)
class Scene:
    """Worlds that are hard to perceive."""

    name: str
    summary: str
    """Where the particles are, in words."""
    x: Tensor
    """Positions [length units], [B, N, D], float64 numbers that float32 represents exactly."""
    box: Box

    @property
    def s(self) -> Tensor:
        """States of the particles, [B, N, C], random and always the same (`states_at`)."""
        return states_at(self.x)


def states_at(x: Tensor) -> Tensor:
    """Return random states [B, N, C] for positions x, the same each time; exact in float32 too."""
    shape = (*x.shape[:2], STATE_DIM)
    return torch.randn(shape, generator=torch.Generator().manual_seed(5)).double()


def scenes(space_dim: int, *, periodic: bool) -> list[Scene]:
    """Return all scenes in open space, or all in a periodic box, of 2 or 3 dimensions."""
    selected: list[Scene] = []
    for name, (summary, make_positions) in POSITIONS.items():
        generator = torch.Generator().manual_seed(len(selected))
        only_periodic = name in ("seam", "tight_box")
        if (only_periodic and not periodic) or (name == "far" and periodic):
            continue
        if name == "coplanar" and space_dim != 3:
            continue
        # Rounded to float32 first, so that both precisions have the same particles.
        x = make_positions(space_dim, generator).float().double()
        side = 2.0 * EPS if name == "tight_box" else SIDE
        selected.append(Scene(name, summary, x, (side,) * space_dim if periodic else None))
    return selected


def _uniform(space_dim: int, generator: torch.Generator, count: int, side: float = 0.5) -> Tensor:
    return (torch.rand(1, count, space_dim, generator=generator) - 0.5) * side


def _direction(space_dim: int) -> Tensor:
    """Return a unit vector that is along no axis, [D]."""
    slanted = torch.tensor([0.48, 0.64, 0.6] if space_dim == 3 else [0.6, 0.8])
    return slanted.double()


def _touching(space_dim: int, generator: torch.Generator) -> Tensor:
    distances = torch.tensor([1e-12, 1e-9, 1e-6, 1e-3, 0.5], dtype=torch.float64)
    distances[3:] *= EPS
    apart = distances[:, None] * _direction(space_dim)
    return torch.stack((torch.zeros_like(apart), apart), dim=1)


def _at_eps(space_dim: int, generator: torch.Generator) -> Tensor:
    step = 2.0**-20
    first = torch.full((4, space_dim), -0.375, dtype=torch.float64)
    first[:, 1] += torch.arange(4) * 2.0 * EPS
    second = first.clone()
    second[:, 0] += EPS * torch.tensor([0.5, 1.0 - step, 1.0, 1.0 + step], dtype=torch.float64)
    return torch.cat((first, second))[None]


def _collinear(space_dim: int, generator: torch.Generator) -> Tensor:
    along = (torch.arange(16) - 8) * (EPS / 4.0)
    straight = torch.zeros(16, space_dim, dtype=torch.float64)
    straight[:, 0] = along
    slanted = along[:, None] * _direction(space_dim)
    return torch.stack((straight, slanted))


def _coplanar(space_dim: int, generator: torch.Generator) -> Tensor:
    flat = _uniform(space_dim, generator, 60)
    flat[..., 2] = 0.1
    return flat


def _seam(space_dim: int, generator: torch.Generator) -> Tensor:
    x = _uniform(space_dim, generator, 60, 0.3)
    edges = torch.tensor([-0.5, 0.5, 0.5 - 2.0**-24, -0.5 + 2.0**-24, 0.5 + 2.0**-10])
    x[..., 0] = edges[torch.randint(5, (1, 60), generator=generator)]
    return x


def _tight_box(space_dim: int, generator: torch.Generator) -> Tensor:
    x = _uniform(space_dim, generator, 40, 2.0 * EPS)
    # A pair at exactly ε on both sides, through the box and across its seam.
    x[0, 0], x[0, 1] = 0.0, 0.0
    x[0, 1, 0] = EPS
    return x


def _far(space_dim: int, generator: torch.Generator) -> Tensor:
    x = _uniform(space_dim, generator, 80)
    # Squares of the last two are too large for float32.
    for k, offset in enumerate((1e3, 1e6, -1e30, 3e38)):
        x[:, 20 * k : 20 * k + 10, 0] += offset
    return x


POSITIONS: dict[str, tuple[str, Callable[[int, torch.Generator], Tensor]]] = {
    "one": ("a single particle", lambda d, g: _uniform(d, g, 1)),
    "coincident": ("48 particles in one place", lambda d, g: _uniform(d, g, 1).expand(1, 48, d)),
    "touching": ("pairs from 1e-12 length units to ε/2 apart", _touching),
    "at_eps": ("pairs at ε, and at ε (1 ± 2⁻²⁰)", _at_eps),
    "collinear": ("particles on a line, straight and slanted", _collinear),
    "coplanar": ("particles on a plane", _coplanar),
    "lattice": (
        "a lattice of ε/2: neighbours at ε exactly",
        lambda d, g: torch.cartesian_prod(*((torch.arange(5) - 2) * (EPS / 2.0),) * d)[None],
    ),
    "cell_borders": (
        "particles on the borders of cells",
        lambda d, g: torch.randint(-4, 4, (1, 60, d), generator=g) * (EPS / 2.0),
    ),
    "clump": ("100 particles in one cell", lambda d, g: 0.03 + _uniform(d, g, 100, EPS / 4.0)),
    "far": ("crowds at 0, 1e3, 1e6, -1e30 and 3e38", _far),
    "seam": ("particles on both sides of the box's seam and on it", _seam),
    "tight_box": ("particles in a box of exactly 2 ε", _tight_box),
}
"""Summary of each scene by name, and the function of D and a generator that makes its positions."""


def threshold_scenes(space_dim: int, threshold: float) -> tuple[Tensor, Tensor]:
    """Return worlds in which a moment matrix has a determinant near a threshold.

    It is the matrix of particle 0. One further particle lies on each axis but the last, and the
    height of one more sets the determinant. Returns positions [B, 1 + D, D], and the relative
    distance of each world's determinant from the threshold, [B].
    """
    offsets = torch.tensor([1e-1, 1e-3, 1e-5, 1e-7, 0.0, -1e-7, -1e-5, -1e-3, -1e-1]).double()
    worlds = torch.zeros(len(offsets), 1 + space_dim, space_dim, dtype=torch.float64)
    worlds[:, 1:] = 0.4 * EPS * torch.eye(space_dim).double()
    worlds[:, -1, 0] = 0.5 * EPS
    s = torch.zeros(*worlds.shape[:2], 1, dtype=torch.float64)
    targets = threshold * (1.0 + offsets)
    # Bisection, as the determinant grows with the height.
    low, high = torch.zeros_like(offsets), torch.full_like(offsets, 0.4 * EPS)
    for _ in range(50):
        worlds[:, -1, -1] = 0.5 * (low + high)
        determinants = torch.linalg.det(reference.fields(worlds, s, EPS).moment[:, 0])
        low = torch.where(determinants < targets, worlds[:, -1, -1], low)
        high = torch.where(determinants < targets, high, worlds[:, -1, -1])
    torch.testing.assert_close(determinants, targets, rtol=1e-9, atol=0.0)
    return worlds.float().double(), offsets


# Errors against the reference, and their limits

LIMITS = {
    "z_float32": 2e-6,
    "states_float32": 5e-6,
    "positions_float32": 2e-5,
    "z_float64": 5e-15,
    "states_float64": 1e-14,
    "positions_float64": 2e-14,
}
"""Maximum relative errors of a perception, WHAT_DTYPE, of well-conditioned scenes.

WHAT is a field of `PerceptionOutcome`. For other scenes `error_limits` has larger ones.
"""

PRECISIONS = {"float32": torch.float32, "float64": torch.float64}
"""Dtypes that are checked, by name."""


class PerceptionOutcome(NamedTuple):
    """A perception z, [B, N, P], and gradients of a functional of it, of states and positions."""

    z: Tensor
    states: Tensor
    positions: Tensor


def relative_error(value: Tensor, expected: Tensor) -> float:
    """Return the largest |value - expected| / |expected| of worlds, [B, ...]; a norm of 0 is 1."""
    exact = expected.detach().cpu().double().flatten(1)
    away = (value.detach().cpu().double().flatten(1) - exact).norm(dim=1)
    size = exact.norm(dim=1)
    errors = away / torch.where(size > 0.0, size, 1.0)
    # Unlike that of a list, max() of a tensor never ignores NaN.
    return float(errors.max())


def perception_errors(
    outcome: PerceptionOutcome, expected: PerceptionOutcome, precision: str = "float32"
) -> dict[str, float]:
    """Return relative errors of a perception and its gradients, by keys of `LIMITS`."""
    pairs = zip(PerceptionOutcome._fields, outcome, expected, strict=True)
    return {f"{what}_{precision}": relative_error(a, b) for what, a, b in pairs}


def against_reference(
    x: Tensor, s: Tensor, box: Box, device: torch.device
) -> tuple[PerceptionOutcome, PerceptionOutcome]:
    """Return perception and gradients of the library (float32, on `device`), and the reference."""
    outcome = perceived(x.to(device, torch.float32), s.to(device, torch.float32), box)
    return outcome, perceived(x.cpu().double(), s.cpu().double(), box, by_reference=True)


def not_finite(tensors: Iterable[Tensor]) -> float:
    """Return the number of elements of tensors that are infinite or NaN."""
    return float(sum(int((~tensor.isfinite()).sum()) for tensor in tensors))


def differing(value: Tensor, expected: Tensor) -> float:
    """Return the number of elements in which two tensors differ; NaN equals NaN."""
    same = (value == expected) | (value.isnan() & expected.isnan())
    return float((~same).sum())


def functional_weights(x: Tensor, s: Tensor) -> Tensor:
    """Return random weights [B, N, P], always the same, of a linear functional of perceptions."""
    width = s.shape[2] * (2 + x.shape[2]) + x.shape[2]
    generator = torch.Generator().manual_seed(3)
    return torch.randn(*x.shape[:2], width, generator=generator).to(x)


def perceived(
    x: Tensor,
    s: Tensor,
    box: Box,
    *,
    by_reference: bool = False,
    weights: Tensor | None = None,
    changed: Callable[[Tensor], Tensor] = torch.clone,
) -> PerceptionOutcome:
    """Return the perception z of worlds and its gradients, by the library or the reference.

    Gradients are of Σ z `weights`; None: of `functional_weights`. `changed` maps all inputs first.
    """
    x, s = changed(x.detach()).requires_grad_(), changed(s.detach()).requires_grad_()
    operator = reference.perceive if by_reference else perceive
    z = operator(x, s, EPS, EPS, box, detach_positions=False)
    weights = changed(functional_weights(x, s) if weights is None else weights)
    states, positions = torch.autograd.grad((z * weights).sum(), (s, x))
    return PerceptionOutcome(z.detach(), states, positions)


def error_limits(x: Tensor, s: Tensor, box: Box, expected: PerceptionOutcome) -> dict[str, float]:
    """Return the maximum relative errors of worlds, by the keys of `LIMITS`.

    An error may be four times the effect of rounding all inputs, which is large where sums cancel
    or results grow with 1 / distance. `expected` is the reference's outcome without rounding.
    Coincident particles stay together; in open space coordinates are rounded as if within `SIDE`.
    """
    generator = torch.Generator().manual_seed(4)
    change = 1e-11

    def rounded(values: Tensor) -> Tensor:
        rows = values.flatten(0, 1)
        which = torch.unique(rows, dim=0, return_inverse=True)[1]
        random = torch.rand(rows.shape, generator=generator, dtype=rows.dtype)[which]
        size = rows if box is not None else rows.clamp(-SIDE, SIDE)
        return (rows + change * (2.0 * random - 1.0) * size).view_as(values)

    limits = dict(LIMITS)
    for _ in range(4):
        perturbed = perceived(x, s, box, by_reference=True, changed=rounded)
        for name, dtype in PRECISIONS.items():
            rounding = 0.5 * torch.finfo(dtype).eps
            for key, error in perception_errors(perturbed, expected, name).items():
                limits[key] = max(limits[key], 4.0 * rounding * (error / change))
    return limits
