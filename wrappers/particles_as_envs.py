"""Particles as environments of their own, the rows of a vector environment, as RLlib needs them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from npa_envs.envs.core.vector import BatchedSpaces
from npa_envs.wrappers.base import (
    AnyVectorEnv,
    ParticleRowsBase,
    VectorStep,
    row_space,
    to_host,
    vector_env,
)


class ParticleRows(ParticleRowsBase, BatchedSpaces):
    """The particles of a vector environment as the rows of another one, with NumPy arrays.

    Row w N + i is particle i of world w: it observes that particle's perception, shape [P], gives
    its action, shape [A], and gets its own reward where the environment was made with
    `reward="particle"`, else its world's. The particles of a world begin and end their episodes
    together, and a new one begins in the step after (next-step autoreset).

    For libraries that train one policy on the rows of any Gymnasium vector environment. Infos are
    empty.

    Args:
        env: A vector environment of this package, wrapped or not, with next-step autoreset.
    """

    # Gymnasium closes deleted objects, also if the constructor failed and nothing is open.
    closed = True

    def __init__(self, env: AnyVectorEnv) -> None:
        self.set_env(env, vector_env(env, type(self).__name__), "next-step")
        self.metadata = env.metadata
        self.render_mode = env.render_mode
        self.single_observation_space = row_space(env.single_observation_space)
        self.single_action_space = row_space(env.single_action_space)
        self.closed = False

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start episodes in all worlds; return the rows' observations, [B N, P], and no infos.

        World w begins the sequence of `seed` + w; None: each world's next episode. `options` are
        not used, as rows cannot restart without the others of their world.
        """
        observations, _ = self.vector_env.reset(seed=seed)
        return to_host(observations).reshape(self.num_envs, -1), {}

    def step(self, actions: Any) -> VectorStep:
        """Step all worlds by actions [B N, A]; return the rows' results and no infos.

        Raises NPAError for actions of a wrong shape, and DivergedError for actions that are not
        finite; the worlds then stay as they are.
        """
        rows, rewards, ended, cut, _ = self.step_worlds(actions)
        return to_host(rows), to_host(rewards).astype(np.float64), to_host(ended), to_host(cut), {}

    def render(self) -> Any:
        """Return the environment's pictures of the worlds."""
        return self.vector_env.render()

    def close_extras(self, **kwargs: Any) -> None:
        """Close the environment."""
        self.vector_env.close(**kwargs)
