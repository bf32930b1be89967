"""What a policy is: a function from observations to actions, for arrays and tensors alike."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.errors import NPAError

Array = TypeVar("Array", NDArray[Any], Tensor)


class Interface(NamedTuple):
    """What observations and actions of an environment mean, column by column."""

    space_dim: int
    """Space dimension D."""

    state_dim: int
    """State channels C."""

    moving: bool
    """Whether actions begin with a displacement."""

    state_scale: float
    """State step of an action of 1, dimensionless."""

    species_count: int = 0
    """Species whose densities and density gradients follow in an observation; 0: none."""

    @property
    def shared_dim(self) -> int:
        """Columns of an observation that tell of all species together."""
        return self.state_dim * (2 + self.space_dim) + self.space_dim

    @property
    def perception_dim(self) -> int:
        """Length P of an observed perception vector."""
        return self.shared_dim + self.species_count * (1 + self.space_dim)

    @property
    def action_dim(self) -> int:
        """Length A of an action."""
        return self.state_dim + (self.space_dim if self.moving else 0)

    def states(self, observation: Tensor) -> Tensor:
        """Return the particles' own states s, dimensionless, shape [..., C]."""
        return observation[..., : self.state_dim]

    def mean_states(self, observation: Tensor) -> Tensor:
        """Return the mean states s̄ of their neighbourhoods, dimensionless, shape [..., C]."""
        return observation[..., self.state_dim : 2 * self.state_dim]

    def density_gradient(self, observation: Tensor) -> Tensor:
        """Return c^{1+D} ∇ρ / N, its logarithmic scale undone, shape [..., D]."""
        scaled = observation[..., self.shared_dim - self.space_dim : self.shared_dim]
        size = scaled.norm(dim=-1, keepdim=True)
        return scaled * torch.where(size > 0.0, torch.expm1(size) / size, 1.0)

    def action(self, displacement: Tensor, state_step: Tensor) -> Tensor:
        """Return the action of a displacement and a state step, within the action space.

        Args:
            displacement: As a fraction of α ε, shape [..., D]; longer ones are shortened to 1, and
                where particles do not move it counts for nothing.
            state_step: Change of the states, dimensionless, shape [..., C]; clipped to plus and
                minus `state_scale`.
        """
        parts = [(state_step / self.state_scale).clamp(-1.0, 1.0)]
        if self.moving:
            size = displacement.norm(dim=-1, keepdim=True)
            parts.insert(0, (displacement / size.clamp(min=1.0)).clamp(-1.0, 1.0))
        return torch.cat(parts, dim=-1)


def unwrapped(env: Any) -> Any:
    """Return the NPA environment within wrappers.

    Args:
        env: A single or a vector environment of `npa_envs`, wrapped or not.

    Raises:
        NPAError: It is none.
    """
    inner = getattr(env, "unwrapped", None)
    if not hasattr(inner, "worlds"):
        cure = "gymnasium.make('npa/Morphogenesis2D-v0')"
        if isinstance(env, VectorEnv):
            cure = (
                "gymnasium.make_vec('npa/Morphogenesis2D-v0', num_envs=8, "
                "vectorization_mode='vector_entry_point')"
            )
        raise NPAError(
            f"env must be an environment of npa_envs, got {type(env).__name__}: make it with {cure}"
        )
    return inner


def interface_of(env: Any) -> Interface:
    """Return what observations and actions of an environment mean.

    Args:
        env: A single or a vector environment of `npa_envs`, wrapped or not.

    Raises:
        NPAError: It is none.
    """
    worlds = unwrapped(env).worlds
    physics = worlds.physics
    # Worlds of species that are told apart perceive more than their physics says.
    appended = getattr(worlds, "perception_dim", physics.perception_dim) - physics.perception_dim
    return Interface(
        physics.space_dim,
        physics.state_dim,
        physics.moving,
        physics.state_scale,
        appended // (1 + physics.space_dim),
    )


class Policy:
    """A function from observations to actions; subclasses say what `act` does.

    Called with observations of one world, [N, P], or of several, [B, N, P], it returns actions
    [N, A] or [B, N, A], float32, within the action space: a NumPy array for an array, and a tensor
    on the same device for a tensor. No gradient is recorded.

    Args:
        interface: What observations and actions mean: `interface_of(env)`.

    Raises:
        NPAError: When called: the observation has another shape.
    """

    def __init__(self, interface: Interface) -> None:
        self.interface = interface

    def act(self, observation: Tensor) -> Tensor:
        """Return actions, float32, shape [B, N, A], on any device.

        Args:
            observation: What is perceived, float32, shape [B, N, P], on any device.
        """
        raise NotImplementedError

    @torch.no_grad()
    def __call__(self, observation: Array) -> Array:
        """Return the actions for observations.

        Args:
            observation: Shape [N, P] or [B, N, P].

        Raises:
            NPAError: It has another shape.
        """
        if isinstance(observation, Tensor):
            return self._act_on(observation).to(observation.device)
        # Torch refuses to share memory that may not be written to.
        writable = np.require(observation, np.float32, ("C", "W"))
        return self._act_on(torch.from_numpy(writable)).cpu().numpy()

    def _act_on(self, observation: Tensor) -> Tensor:
        shape, columns = tuple(observation.shape), self.interface.perception_dim
        if len(shape) not in (2, 3) or shape[-1] != columns:
            raise NPAError(
                f"observation must have shape [N, P] or [B, N, P] with P = {columns}, got {shape}: "
                "use the policy with the environment that it was made for"
            )
        action = self.act(observation.float().reshape(-1, *shape[-2:]))
        return action.view(*shape[:-1], self.interface.action_dim)
