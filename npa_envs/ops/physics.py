"""The constants of worlds, checked once: radius, box, perception groups, time step, limits."""

from __future__ import annotations

import math
from typing import Any, Literal, NamedTuple, get_args

import torch

from npa_envs.checks import (
    IMMUTABLE,
    Box,
    check_scale,
    checked_box,
    checked_choice,
    checked_eps,
    checked_number,
    checked_once,
    checked_positive,
    constant,
)
from npa_envs.errors import NPAError, shown

Boundary = Literal["open", "periodic", "reflecting"]
"""No box; a periodic box; or a box whose walls reflect particles."""


class Terms(NamedTuple):
    """Which gradients a perception vector has besides states and smoothed states."""

    state_gradient: bool = True
    moment_inverse: str | None = "threshold"
    """How the moment matrix is inverted to correct state gradients; None: no correction."""
    density_gradient: bool = True

    @property
    def correction(self) -> str | None:
        """`moment_inverse`, "threshold" or "smooth", if there is a state gradient; else None."""
        return self.moment_inverse if self.state_gradient else None

    def perception_dim(self, space_dim: int, state_dim: int) -> int:
        """Length P of a perception vector, for D space dimensions and C channels."""
        gradients = state_dim * space_dim * self.state_gradient
        return 2 * state_dim + gradients + space_dim * self.density_gradient


ALL_TERMS = Terms()

BOUNDARIES: tuple[Boundary, ...] = get_args(Boundary)

INVERSES = (None, "threshold", "smooth")
"""Values of `Terms.moment_inverse`; torch operators take the index, and that of `BOUNDARIES`."""


class Limits(NamedTuple):
    """Scale of actions and largest values in environments; rollouts have no limits."""

    state_scale: float = 1.0
    """State step of an action of 1, dimensionless."""
    perception: float = math.inf
    """Entries of perception are clipped to plus and minus this, dimensionless."""
    position: float = math.inf
    """A coordinate beyond this is out of bounds [length units]."""
    state: float = math.inf
    """A state beyond this is out of bounds, dimensionless."""


NO_LIMITS = Limits()


class Physics(NamedTuple):
    """Constants of worlds, such as radius, box and time step; `make_physics` makes them."""

    space_dim: int
    """Space dimension D."""
    state_dim: int
    """State channels C."""
    eps: float
    """Perception radius ε [length units]."""
    eps0: float
    """Radius ε0 at which the rule was trained [length units]."""
    boundary: Boundary = "open"
    """Whether there is a box, and what its sides do; neighbours are those of open space unless it
    is periodic."""
    box: tuple[float, ...] | None = None
    """Sides of the box [length units], None in open space."""
    terms: Terms = ALL_TERMS
    """Groups of the perception vector."""
    moving: bool = True
    """Whether updates begin with a displacement; otherwise particles do not move."""
    max_displacement: float = 0.0
    """Largest displacement α ε per unit of time [length units], over all species."""
    update_prob: float = 1.0
    """Probability p of a particle's update in a step; the highest of all species."""
    dt: float = 1.0
    """Time step, dimensionless."""
    position_noise: float = 0.0
    """Standard deviation of the noise on every position in a step [length units]."""
    limits: Limits = NO_LIMITS
    """Bounds of environments."""

    @property
    def periodic_box(self) -> tuple[float, ...] | None:
        """Sides of the box [length units] if it is periodic, else None."""
        return self.box if self.boundary == "periodic" else None

    @property
    def perception_dim(self) -> int:
        """Length P of a perception vector."""
        return self.terms.perception_dim(self.space_dim, self.state_dim)

    @property
    def action_dim(self) -> int:
        """Length A of an action: D + C, or C where particles are static."""
        return self.state_dim + (self.space_dim if self.moving else 0)

    @classmethod
    def from_list(cls, numbers: list[float]) -> Physics:
        """Return the constants in a list by `numbers`; D and C are 0, and there are no limits."""
        count = len(NUMBER_FIELDS)
        inverse, boundary, state_gradient, density_gradient, moving, *sides = numbers[count:]
        return cls(
            space_dim=0,
            state_dim=0,
            boundary=BOUNDARIES[int(boundary)],
            box=tuple(sides) or None,
            terms=Terms(bool(state_gradient), INVERSES[int(inverse)], bool(density_gradient)),
            moving=bool(moving),
            limits=NO_LIMITS,
            **dict(zip(NUMBER_FIELDS, numbers[:count], strict=True)),
        )

    def numbers(self) -> list[float]:
        """Return all but limits, D and C as a list of numbers, which torch operators can take."""
        state_gradient, inverse, density_gradient = self.terms
        choices = INVERSES.index(inverse), BOUNDARIES.index(self.boundary)
        flags = map(float, (*choices, state_gradient, density_gradient, self.moving))
        scalars = [getattr(self, name) for name in NUMBER_FIELDS]
        return [constant(number) for number in (*scalars, *flags, *(self.box or ()))]

    def scale(self) -> float:
        """Return c = eps / eps0, the factor on perceived gradients."""
        return self.eps / self.eps0

    def constants(self) -> Physics:
        """Return the constants, in a form that torch.compile takes for constant while it traces."""
        if not torch.compiler.is_compiling():
            return self
        # Compilers lose fields that `_replace` or a default would fill in.
        return Physics(*[_constants(value) for value in self])


NUMBER_FIELDS = ("eps", "eps0", "max_displacement", "update_prob", "dt", "position_noise")
"""Fields of `Physics` that are one number."""


def _constants(value: Any) -> Any:
    """Return a field's value; its floats are marked so that torch.compile keeps them constant."""
    if type(value) is tuple:
        return tuple([constant(side) for side in value])
    return constant(value) if type(value) is float else value


IMMUTABLE.update((Terms, Physics))


@checked_once
def make_physics(
    space_dim: int,
    state_dim: int,
    dtype: torch.dtype,
    *,
    eps: float | None,
    eps0: float | None = None,
    box: Box = None,
    boundary: Boundary | None = None,
    terms: Terms = ALL_TERMS,
    moving: bool = True,
    alpha: float = 0.0,
    update_prob: float = 1.0,
    dt: float = 1.0,
    position_noise: float = 0.0,
) -> Physics:
    """Return the constants of worlds as a `Physics`, after checking them.

    `eps0` is not checked; default: `eps`. `boundary` None is "periodic" if there is a box, else
    "open". The largest displacement in a unit of time is `alpha` times `eps`.
    """
    if boundary is None:
        boundary = "open" if box is None else "periodic"
    checked_choice("boundary", boundary, BOUNDARIES)
    if boundary == "open" and box is not None:
        raise NPAError(f"box must be None where boundary is 'open', got {shown(box)}: leave it out")
    if boundary != "open" and box is None:
        raise NPAError(
            f"box must be given where boundary is {boundary!r}, got None: give its sides"
        )
    unchecked: Any = eps0 if eps is None else eps
    radius = checked_eps("eps", unchecked, space_dim, dtype)
    radius0 = radius if eps0 is None else constant(eps0)
    check_scale(radius, radius0, space_dim, dtype)
    update_prob = checked_number("update_prob", update_prob)
    dt = checked_positive("dt", dt)
    position_noise = checked_number("position_noise", position_noise)
    if not 0.0 < update_prob <= 1.0:
        raise NPAError(f"update_prob must lie in (0, 1], got {update_prob}: try 0.5")
    if not (math.isfinite(position_noise) and position_noise >= 0.0):
        raise NPAError(
            f"position_noise must be finite and not negative, got {position_noise}: try 0.0"
        )
    sides = checked_box(box, space_dim, radius if boundary == "periodic" else None, dtype)
    return Physics(
        space_dim=space_dim,
        state_dim=state_dim,
        eps=radius,
        eps0=radius0,
        boundary=boundary,
        box=sides,
        terms=terms,
        moving=moving,
        max_displacement=constant(alpha) * radius,
        update_prob=update_prob,
        dt=dt,
        position_noise=position_noise,
        limits=NO_LIMITS,
    )
