"""Steps of worlds whose particles never move: their rows, drawn some steps ahead, and one step."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from torch import Tensor

from npa_envs.sph.settled import SettledWorlds
from npa_envs.sph.settled_perception import perceive_settled
from npa_envs.sph.settled_states import SettledRows, all_rows, settled_rows, update_settled

DRAWN_AHEAD = 16
"""Steps whose masks are drawn together, at most: they are given rows in few launches."""

DRAWN_PARTICLES = 2**24
"""Particles of masks that are drawn together, if there are several."""


def drawn_rows(
    worlds: SettledWorlds, draw: Callable[[], Tensor | None], steps: int, row_capacity: int
) -> Iterator[tuple[SettledRows]]:
    """Return an iterator over the rows of steps, each alone in a tuple.

    Args:
        worlds: The worlds.
        draw: Draws a step's update mask, uint8 of ones and zeros, shape [B, N]; or None for all in
            every step.
        steps: Number of steps.
        row_capacity: Rows K of each step on CUDA; on the CPU each has as many as it needs.
    """
    ahead = max(min(DRAWN_AHEAD, DRAWN_PARTICLES // worlds.total), 1)
    for first in range(0, steps, ahead):
        drawn = [draw() for _ in range(min(ahead, steps - first))]
        masks = [mask for mask in drawn if mask is not None]
        if masks:
            yield from zip(settled_rows(worlds, masks, row_capacity))
        else:
            yield from [(all_rows(worlds),)] * len(drawn)


def advance_settled(
    network: Callable[[Tensor], Tensor],
    row_width: int,
    dt: float,
    worlds: SettledWorlds,
    states: Tensor,
    rows: SettledRows,
) -> tuple[Tensor]:
    """Advance states by one step; alone in a tuple.

    Args:
        network: Maps rows of perception, [K, row_width], to updates Δs, [K, C] or wider.
        row_width: Columns of its rows.
        dt: Time step, dimensionless.
        worlds: The worlds.
        states: States as `settled_states` returns them, shape [B N, C'].
        rows: Which particles are active.
    """
    perception = perceive_settled(worlds, states, rows, row_width=row_width)
    return (update_settled(worlds, states, network(perception), rows, dt),)
