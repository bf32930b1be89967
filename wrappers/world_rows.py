"""Each world as one environment of Stable-Baselines3: a policy that acts for all its particles."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from npa_envs.errors import NPAError
from npa_envs.wrappers.adapters import check_same_step
from npa_envs.wrappers.base import autoreset_mode
from npa_envs.wrappers.rows import RowVecEnv, on_host


class WorldVecEnv(RowVecEnv):
    """The worlds of a vector environment as the rows of a Stable-Baselines3 `VecEnv`.

    A row observes what all particles of its world perceive, shape [N, P], and gives all their
    actions, [N, A]. Stable-Baselines3's own policies draw those from one Gaussian of N A columns,
    which cannot learn: after the smallest update the ratio of two likelihoods is near zero or
    beyond all bounds. Take a policy that means over particles instead of summing, such as
    `npa_envs.agents.learning.sb3_world.WorldRulePolicy`.

    Rows of a finished world have an info of their own, with `terminal_observation`,
    `TimeLimit.truncated` and, where there is one, `is_success`; the others share an empty one.

    Args:
        env: A vector environment whose worlds are particles, [B, N, P] and [B, N, A], wrapped or
            not, with same-step autoreset.

    Raises:
        NPAError: The environment has other spaces, or another autoreset mode.
        MissingDependencyError: Stable-Baselines3 is not installed (on import).
    """

    def __init__(self, env: Any) -> None:
        spaces = [
            _flat_float(getattr(env, name, None), name)
            for name in ("single_observation_space", "single_action_space")
        ]
        check_same_step(autoreset_mode(env))
        super().__init__(env, env.num_envs, 1, *spaces)

    def reset(self) -> NDArray[np.float32]:
        """Start episodes in all worlds and return their observations, shape [B, N, P]."""
        observations, _ = self.begin()
        return on_host(observations)[0]

    def step_wait(
        self,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Step all worlds.

        Returns:
            Of each world: observation [B, N, P], reward [B], whether its episode is over [B], and
            infos.

        Raises:
            DivergedError: An action is not finite; the worlds are then as they were.
        """
        actions = self.taken_actions().reshape(self.world_count, *(self.action_space.shape or ()))
        observations, rewards, terminations, truncations, infos = self.vector_env.step(actions)
        shown, paid, ended, cut = on_host(observations, rewards, terminations, truncations)
        done = ended | cut
        rows: list[dict[str, Any]] = [self.nothing] * self.num_envs
        if done.any():
            (last,) = on_host(infos["final_obs"])
            success = infos["final_info"].get("success")
            told = None if success is None else on_host(success)[0]
            for row in np.flatnonzero(done).tolist():
                rows[row] = {
                    "TimeLimit.truncated": bool(cut[row] and not ended[row]),
                    "terminal_observation": last[row],
                }
                if told is not None:
                    rows[row]["is_success"] = bool(told[row])
        return shown, paid.astype(np.float32, copy=False), done, rows


def _flat_float(space: Any, name: str) -> Box:
    """Return the space of a world's particles, a row of numbers for each."""
    if not (isinstance(space, Box) and len(space.shape) == 2):
        raise NPAError(
            f"{name} of env must be a box with a row for each particle, got {space}: make the "
            "environment with gym.make_vec(..., vectorization_mode='vector_entry_point')"
        )
    return Box(space.low, space.high, dtype=np.float32)
