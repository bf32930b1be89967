"""What environments do about worlds that diverge, once the host knows of them."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.envs.core.report import DIVERGED
from npa_envs.envs.core.worlds import Worlds
from npa_envs.errors import DivergedError
from npa_envs.world.actions import Physics
from npa_envs.world.divergence import LARGEST_REPORT, term_name


@torch.no_grad()
def guarded(worlds: Worlds, endings: NDArray[np.uint8], observation: Tensor) -> NDArray[np.uint8]:
    """Do what `on_divergence` says about worlds that diverged; return what ends episodes.

    Nothing is read from the device, and nothing run, where none did.

    Args:
        worlds: After a step.
        endings: What `Worlds.step` returned, of the worlds that were to act, shape [B].
        observation: What is perceived, shape [B, N, P]; changed where worlds are reset.

    Returns:
        Endings, shape [B], without divergence where that ends no episode.

    Raises:
        DivergedError: A world diverged, and `on_divergence` is "raise".
    """
    way = worlds.task.config.on_divergence
    diverged = endings & DIVERGED != 0
    if way == "terminate" or not diverged.any():
        return endings
    if way == "raise":
        raise DivergedError(_report(worlds, np.flatnonzero(diverged)))
    if way == "reset":
        # Where the time is up, the next episode comes anyway.
        going_on = np.flatnonzero(endings == DIVERGED)
        if len(going_on):
            worlds.reseed(going_on, observation)
    return endings & ~np.uint8(DIVERGED)


def held_numbers(x: Tensor, s: Tensor, physics: Physics) -> Tensor:
    """Return which numbers of particles are held at their limits, bool, shape [..., D + C]."""
    outside = x.abs() >= physics.position_limit
    return torch.cat((outside, s.abs() >= physics.state_limit), dim=-1)


def _report(worlds: Worlds, diverged: NDArray[np.int64]) -> str:
    physics, told = worlds.physics, []
    for world in diverged[:LARGEST_REPORT].tolist():
        x, s = worlds.x[world], worlds.s[world]
        held = held_numbers(x, s, physics)
        line = f"world {world} in step {int(worlds.elapsed[world])}"
        if bool(held.any()):
            particle, entry = held.nonzero()[0].tolist()
            number = torch.cat((x[particle], s[particle]))[entry].item()
            line += (
                f": {term_name(entry, physics.space_dim)} of particle {particle} got to {number:g}"
            )
            line += f" ({int(held.any(dim=1).sum())} such particles)"
        told.append(line)
    if len(diverged) > LARGEST_REPORT:
        told.append(f"and {len(diverged) - LARGEST_REPORT} more worlds")
    return (
        f"numbers must stay within position_limit = {physics.position_limit:g} and "
        f"observation_limit = {physics.state_limit:g}, but left them in {'; '.join(told)}: take "
        "smaller actions, raise the limits, or choose on_divergence='terminate' or 'reset'"
    )
