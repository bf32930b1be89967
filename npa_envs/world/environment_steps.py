"""Steps by actions, in place of a rule, and all else that environments import of the layers below.

Nothing waits for the device.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from npa_envs.ops.launch import is_aligned, launch
from npa_envs.ops.perceive import NeighbourState as NeighbourState
from npa_envs.ops.physics import Boundary as Boundary
from npa_envs.ops.physics import Limits as Limits
from npa_envs.ops.physics import Physics as Physics
from npa_envs.ops.physics import Terms as Terms
from npa_envs.ops.rewards_and_ends import DIVERGED as DIVERGED
from npa_envs.ops.rewards_and_ends import NOT_FINITE as NOT_FINITE
from npa_envs.ops.rewards_and_ends import SUCCESS as SUCCESS
from npa_envs.ops.rewards_and_ends import TIME_LIMIT as TIME_LIMIT
from npa_envs.ops.rewards_and_ends import EpisodeRules as EpisodeRules
from npa_envs.ops.rewards_and_ends import EpisodeUpdate as EpisodeUpdate
from npa_envs.ops.species_density import perceive_by_species
from npa_envs.ops.update import ActedWorlds, PreparedActions
from npa_envs.ops.update import flag_unless_finite as flag_unless_finite
from npa_envs.ops.update import load_async as load_async
from npa_envs.ops.update import wrapped as wrapped
from npa_envs.ops.world_mean import world_mean as world_mean
from npa_envs.world.randomness import WorldRandom
from npa_envs.world.steps import draw_step


def perceive_each_species(x: Tensor, counts: Sequence[int], physics: Physics) -> Tensor:
    """Return each species' density, then the gradients, at each particle, [B, N, S (1 + D)].

    All are clipped to the limits of perception. Species k has `counts[k]` consecutive particles.
    """
    limit = physics.limits.perception
    return perceive_by_species(x, tuple(counts), physics).clamp(-limit, limit)


def hold_in_bounds(x: Tensor, s: Tensor, physics: Physics, diverged: Tensor) -> None:
    """Clip worlds to `Physics.limits` in place, NaN to 0; `diverged`, uint8 [B]: 1 for changed."""
    diverged.zero_()
    limits = (x, physics.limits.position), (s, physics.limits.state)
    # On a CPU a look costs less than the launch. NaN is not within any limit.
    extremes = [] if x.is_cuda else [(*value.aminmax(), limit) for value, limit in limits]
    if extremes and all(max(-float(low), float(high)) <= limit for low, high, limit in extremes):
        return
    still = physics._replace(moving=False, boundary="open", box=None)
    nobody = torch.zeros(x.shape[:2], dtype=torch.uint8, device=x.device)
    worlds = ActedWorlds(x, s, nobody, None, None, diverged)
    # Without an active particle any tensor of the states' shape serves as the action.
    launch(*worlds.launch_of(s, still, is_aligned(s)))


class Actions(PreparedActions):
    """Applies actions to worlds in place, with the update masks and the noise of `rollout`.

    An action has D displacements, as fractions of α ε (their norm is clipped to 1), and C state
    steps, as fractions of `state_scale` (each clipped to [-1, 1]). If an action is not finite, no
    world changes and `enabled` (uint8, [1]) is set to 0; the caller sets it to 1 again. `diverged`
    (uint8, [B]) is set to 1 for worlds with a value beyond its bounds or not finite, to 0 for
    others; such values are clipped to the bounds, and NaN becomes 0.
    """

    def __init__(
        self,
        x: Tensor,
        s: Tensor,
        physics: Physics,
        random: WorldRandom,
        *,
        enabled: Tensor,
        diverged: Tensor,
    ) -> None:
        self._random = random
        self._everyone = torch.ones((), dtype=torch.bool, device=x.device).expand(x.shape[:2])
        masked, noisy = physics.update_prob < 1.0, physics.position_noise > 0.0
        mask = torch.zeros(x.shape[:2], dtype=torch.uint8, device=x.device) if masked else None
        noise = torch.zeros_like(x) if noisy else None
        super().__init__(ActedWorlds(x, s, mask, noise, enabled, diverged), physics)

    apply = PreparedActions.__call__

    @torch.no_grad()
    def draw(self) -> None:
        """Draw the next step's update masks and noise; may be captured in a CUDA graph."""
        x, _, mask, noise, _, diverged = self._worlds
        diverged.zero_()
        drawn = draw_step(x, self._physics, self._random)
        for buffer, values in ((mask, drawn.mask), (noise, drawn.noise)):
            if buffer is not None and values is not None:
                buffer.copy_(values)

    def updated(self) -> Tensor:
        """Return which particles the last `draw` selected for an update, bool, shape [B, N]."""
        mask = self._worlds.mask
        return self._everyone if mask is None else mask.bool()
