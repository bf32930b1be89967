"""Policies that nothing was trained for: the yardsticks from below."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from npa_envs.agents.policy import Policy, interface_of, unwrapped
from npa_envs.errors import NPAError
from npa_envs.rule.rule import COLOUR_OFFSET
from npa_envs.tasks.checks import is_real, is_whole
from npa_envs.world.randomness import Purpose, WorldRandom


class ZeroPolicy(Policy):
    """Do nothing.

    Args:
        env: The environment that it is to act in.

    Raises:
        NPAError: It is no environment of `npa_envs`.
    """

    def __init__(self, env: Any) -> None:
        super().__init__(interface_of(env))

    def act(self, observation: Tensor) -> Tensor:
        """Return zeros."""
        return observation.new_zeros(*observation.shape[:2], self.interface.action_dim)


class RandomPolicy(Policy):
    """Act at random, uniformly over the action space.

    The k-th of several worlds is acted upon as a policy with `seed + k` acts upon one.

    Args:
        env: The environment that it is to act in.
        seed: Of the sequence of actions, at least 0.

    Raises:
        NPAError: `env` is no environment of `npa_envs`, or the seed is no such integer.
    """

    def __init__(self, env: Any, seed: int = 0) -> None:
        super().__init__(interface_of(env))
        given: Any = seed
        if not (is_whole(given) or isinstance(given, np.integer)) or given < 0:
            raise NPAError(f"a seed must be an integer of at least 0, got {given!r}")
        self._seed = int(given)
        self._random: WorldRandom | None = None

    def act(self, observation: Tensor) -> Tensor:
        """Return numbers from [-1, 1)."""
        world_count, particle_count, _ = observation.shape
        random = self._random
        if random is None or random.world_count != world_count:
            seeds = range(self._seed, self._seed + world_count)
            # Beside, as an environment with the same seed draws its masks from the very streams.
            random = WorldRandom(seeds, device=observation.device).beside(Purpose.POLICY)
        self._random = random
        random.advance()
        return 2.0 * random.uniform(particle_count, self.interface.action_dim) - 1.0


class SpreadPolicy(Policy):
    """Move down the density gradient: particles repel each other and the worlds spread out.

    Args:
        env: The environment that it is to act in.
        gain: Displacement, as a fraction of α ε, at a perceived c^{1+D} ∇ρ / N of 1.

    Raises:
        NPAError: `env` is no environment of `npa_envs`, or the gain no finite number.
    """

    def __init__(self, env: Any, gain: float = 0.03) -> None:
        super().__init__(interface_of(env))
        if not is_real(gain):
            raise NPAError(f"gain must be a finite number, got {gain!r}: try 0.03")
        self._gain = gain

    def act(self, observation: Tensor) -> Tensor:
        """Return displacements down the gradient and the subclass's state steps."""
        displacement = -self._gain * self.interface.density_gradient(observation)
        return self.interface.action(displacement, self.state_step(observation))

    def state_step(self, observation: Tensor) -> Tensor:
        """Return changes of the states, dimensionless, shape [B, N, C]: none.

        Args:
            observation: What is perceived, shape [B, N, P].
        """
        return torch.zeros_like(self.interface.states(observation))


class PaintPolicy(SpreadPolicy):
    """Spread out in one colour: the picture's extent and its mean colour, without any detail.

    Args:
        env: The environment that it is to act in.
        colour: Red, green and blue in [0, 1]; None: the mean colour of the environment's target.
        gain: That of `SpreadPolicy`.

    Raises:
        NPAError: `env` is no environment of `npa_envs` or has no target's colour to take, or the
            colour does not have three numbers.
    """

    def __init__(
        self, env: Any, colour: Sequence[float] | Tensor | None = None, gain: float = 0.03
    ) -> None:
        super().__init__(env, gain)
        if colour is None:
            goal = getattr(unwrapped(env).task, "goal", None)
            if goal is None:
                raise NPAError("colour must be given where env has no target: colour=(0, 0.5, 0)")
            colour = goal.target.mean_colour
        try:
            self._colour = torch.as_tensor(colour, dtype=torch.float32)
        except (TypeError, ValueError, RuntimeError, OverflowError) as error:
            raise NPAError(
                f"colour must have three numbers, got {colour!r}: for example colour=(0, 0.5, 0)"
            ) from error
        if self._colour.shape != (3,):
            raise NPAError(
                f"colour must have three numbers, got {tuple(self._colour.shape)}: "
                "for example colour=(0, 0.5, 0)"
            )

    def state_step(self, observation: Tensor) -> Tensor:
        """Return the way to the colour, which the last three channels hold."""
        step = torch.zeros_like(self.interface.states(observation))
        wanted = self._colour.to(step.device) - COLOUR_OFFSET
        step[..., -3:] = wanted - self.interface.states(observation)[..., -3:]
        return step


class MendPolicy(SpreadPolicy):
    """Heal without a memory: blank particles take on their neighbours' mean state, all spread out.

    Args:
        env: The environment that it is to act in.
        blank: A particle is blank where the norm of its state is below this, dimensionless.
        gain: That of `SpreadPolicy`, small so that what is whole stays nearly as it is.

    Raises:
        NPAError: `env` is no environment of `npa_envs`.
    """

    def __init__(self, env: Any, blank: float = 0.1, gain: float = 0.003) -> None:
        super().__init__(env, gain)
        self._blank = blank

    def state_step(self, observation: Tensor) -> Tensor:
        """Return the way to the neighbours' mean state where a particle is blank."""
        states = self.interface.states(observation)
        blank = states.norm(dim=-1, keepdim=True) < self._blank
        return torch.where(blank, self.interface.mean_states(observation) - states, 0.0)
