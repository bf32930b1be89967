"""Perception of every particle, in the caller's order and clipped; without gradients."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from npa_envs.sph.bridge import Repeated
from npa_envs.sph.cells import make_plan, sort_worlds
from npa_envs.sph.passes import Terms, batch_listing, compute_densities, perception_launch


class SurveyedWorlds:
    """Worlds made ready for perception: sorted, their densities known; `survey` makes it.

    Args:
        launch_of: Returns what to give to a launch that writes rows into a tensor, [B N, P].
        shape: Shape of what is perceived, [B, N, P].
        like: A tensor of its dtype and on its device.
    """

    def __init__(
        self, launch_of: Callable[[Tensor], tuple[Any, ...]], shape: tuple[int, ...], like: Tensor
    ) -> None:
        self._launch_of = launch_of
        self._shape = shape
        self._like = like
        self._repeated: Repeated | None = None

    def perceive(self, out: Tensor | None = None) -> Tensor:
        """Return what every particle perceives, clipped, in the caller's order, shape [B, N, P].

        Later calls, after the tensors read have got other numbers, take less of the host's time.

        Args:
            out: Where to write it, contiguous; a new tensor otherwise. Where the worlds have places
                in a larger batch it must be given, of that batch's shape.
        """
        if out is None:
            out = self._like.new_empty(self._shape)
        rows = out.view(-1, self._shape[-1])
        if self._repeated is None:
            self._repeated = Repeated(*self._launch_of(rows), changing=rows)
        self._repeated(rows)
        return out


def survey(
    x: Tensor,
    s: Tensor,
    *,
    eps: float,
    eps0: float,
    box: tuple[float, ...] | None,
    terms: Terms,
    limit: float,
    places: Tensor | None = None,
) -> SurveyedWorlds:
    """Sort checked worlds and compute their densities.

    The result may read `s` where it is: it serves until the states change.

    Args:
        x: Positions [length units], shape [B, N, D].
        s: States, dimensionless, shape [B, N, C].
        eps: Perception radius [length units].
        eps0: Radius at which the rule was trained [length units].
        box: Sides of the periodic box [length units], or None in open space.
        terms: Groups of the perception vector.
        limit: Entries are clipped to plus and minus this, positive.
        places: Which worlds of a larger batch these are, in whose rows their perception is written,
            int64, shape [B]; default: a batch of their own.
    """
    x, s = x.contiguous(), s.contiguous()
    plan = make_plan(x, x.shape, s.shape[2], x.shape[0] * x.shape[1], False, eps, box)
    in_place = plan.listed and plan.state_dim % plan.width == 0 and s.data_ptr() % 16 == 0
    ordered = sort_worlds(plan, x, None if in_place else s, None, with_rows=not plan.listed)
    # World k of a batch perceives what it would alone, bit for bit: nothing here may follow from
    # the number of worlds.
    densities = compute_densities(
        plan,
        ordered,
        terms,
        batch_listing(plan),
        state_place=ordered.source if in_place else None,
        with_particles=False,
    )
    destination = ordered.source
    if places is not None:
        shift = (places - torch.arange(len(places), device=x.device)) * plan.particle_count
        destination = (destination.view(plan.world_count, -1) + shift.int()[:, None]).view(-1)

    def launch_of(rows: Tensor) -> tuple[Any, ...]:
        return perception_launch(
            plan,
            ordered,
            densities,
            terms,
            eps / eps0,
            rows,
            states=s if in_place else None,
            destination=destination,
            limit=limit,
        )

    perception_dim = terms.perception_dim(plan.space_dim, plan.state_dim)
    return SurveyedWorlds(launch_of, (*x.shape[:2], perception_dim), x)
