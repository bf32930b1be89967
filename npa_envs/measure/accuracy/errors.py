"""How far perception and its adjoints may be from the float64 reference, and how far they are."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from npa_envs import reference
from npa_envs.measure.accuracy.scenes import EPS, SIDE
from npa_envs.ops import perceive

LIMITS = {
    "z_float32": 2e-6,
    "states_float32": 5e-6,
    "positions_float32": 2e-5,
    "z_float64": 5e-15,
    "states_float64": 1e-14,
    "positions_float64": 2e-14,
}
"""Relative errors allowed: of z, and of a random functional's gradients by states and positions.

Where a scene's own condition is worse than that, so is what may be asked of it: see `error_limits`.
"""

ROUNDINGS = 4.0
"""Roundings of each number given that an answer may be off by, where that is more than `LIMITS`."""

PRECISIONS = {"float32": torch.float32, "float64": torch.float64}
"""Dtypes by their names."""


class Perceived(NamedTuple):
    """A perception and its adjoint."""

    z: Tensor
    """Perception vectors, shape [B, N, P]."""
    states: Tensor
    """Gradient of a random functional of z by the states, shape [B, N, C]."""
    positions: Tensor
    """And by the positions [1 / length unit], shape [B, N, D]."""


def relative_error(value: Tensor, expected: Tensor) -> float:
    """Return the largest relative error of a world, in the Euclidean norm, taken in float64.

    Args:
        value: Shape [B, ...].
        expected: Shape [B, ...]; where a world's is 0 its error is taken as it is.
    """
    exact = expected.detach().cpu().double().flatten(1)
    away = (value.detach().cpu().double().flatten(1) - exact).norm(dim=1)
    size = exact.norm(dim=1)
    errors = away / torch.where(size > 0.0, size, 1.0)
    # max() of a list may skip NaN; that of a tensor does not.
    return float(errors.max())


def functional_weights(x: Tensor, s: Tensor) -> Tensor:
    """Return weights of a random linear functional of the perception of worlds, [B, N, P]."""
    width = s.shape[2] * (2 + x.shape[2]) + x.shape[2]
    draws = torch.Generator().manual_seed(3)
    return torch.randn(*x.shape[:2], width, generator=draws).to(x)


def perceived(
    x: Tensor,
    s: Tensor,
    box: tuple[float, ...] | None,
    *,
    by_reference: bool = False,
    weights: Tensor | None = None,
    given: Callable[[Tensor], Tensor] = torch.clone,
) -> Perceived:
    """Return z and the gradients of a random functional of it.

    Args:
        x: Positions [length units], shape [B, N, D].
        s: States, shape [B, N, C].
        box: Sides of the periodic box [length units], or None.
        by_reference: Ask the reference instead of the library.
        weights: Those of the functional, shape [B, N, P]; default: `functional_weights`.
        given: What to make of positions, states and the functional's weights first.
    """
    x, s = given(x.detach()).requires_grad_(), given(s.detach()).requires_grad_()
    if by_reference:
        z = reference.perceive(x, s, EPS, EPS, box, detach_positions=False)
    else:
        z = perceive(x, s, EPS, EPS, box, detach_positions=False)
    weights = given(functional_weights(x, s) if weights is None else weights)
    states, positions = torch.autograd.grad((z * weights).sum(), (s, x))
    return Perceived(z.detach(), states, positions)


def error_limits(
    x: Tensor, s: Tensor, box: tuple[float, ...] | None, expected: Perceived
) -> dict[str, float]:
    """Return the relative errors that worlds allow, by the names of `LIMITS`.

    Where sums cancel, or answers grow with 1 / distance, the last bit of what is given shows in
    many digits of the answer. So an error may be what some roundings of every number given change.
    Particles in one place stay together, and far away in open space the differences of coordinates
    are rounded, not they themselves.

    Args:
        x: Positions [length units], float64, shape [B, N, D].
        s: States, float64, shape [B, N, C].
        box: Sides of the periodic box [length units], or None.
        expected: What the reference perceives there.
    """
    generator = torch.Generator().manual_seed(4)
    change = 1e-11

    def changed(values: Tensor) -> Tensor:
        rows = values.flatten(0, 1)
        which = torch.unique(rows, dim=0, return_inverse=True)[1]
        draws = torch.rand(rows.shape, generator=generator, dtype=rows.dtype)[which]
        size = rows if box is not None else rows.clamp(-SIDE, SIDE)
        return (rows + change * (2.0 * draws - 1.0) * size).view_as(values)

    limits = dict(LIMITS)
    for _ in range(4):
        others = perceived(x, s, box, by_reference=True, given=changed)
        for what, exact, other in zip(Perceived._fields, expected, others, strict=True):
            condition = relative_error(other, exact) / change
            for name, dtype in PRECISIONS.items():
                rounding = 0.5 * torch.finfo(dtype).eps
                key = f"{what}_{name}"
                limits[key] = max(limits[key], ROUNDINGS * rounding * condition)
    return limits
