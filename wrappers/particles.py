"""Each particle as one environment of Stable-Baselines3: many small agents that share a policy."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from npa_envs.wrappers.adapters import check_same_step, own_rewards, row_space
from npa_envs.wrappers.base import AnyVectorEnv, autoreset_mode, vector_env
from npa_envs.wrappers.moments import as_tensor
from npa_envs.wrappers.rows import RowVecEnv, on_host


class ParticleVecEnv(RowVecEnv):
    """The particles of a vector environment as the rows of a Stable-Baselines3 `VecEnv`.

    Row w N + i is particle i of world w: it observes that particle's perception, shape [P], gives
    its action, shape [A], and gets its own reward where the environment was made with
    `reward="particle"`; with any other reward each row gets its world's. So a policy of any
    algorithm is shared by all particles, and sees what a rule sees. A step stays one batched step,
    and costs one copy of the observations to the host (on CUDA make the environment with
    `output="torch"`: the copy is then pinned).

    Rows of a finished world have an info of their own, with `terminal_observation`,
    `TimeLimit.truncated` and `is_success`; the others share an empty one, which cannot be written
    to. Attributes and methods belong to the whole environment: each row gives the same.

    Stable-Baselines3 counts rows: 8 worlds of 1024 particles are 8192 steps at once. Its defaults
    are made for a few rows; with PPO set for example `n_steps=32, batch_size=4096`.

    Args:
        env: A vector environment of this package, wrapped or not, with same-step autoreset.
        bootstrap: Whether rows cut off by the step limit say so, from which Stable-Baselines3
            estimates what they would still have got. On-policy algorithms do that row by row, which
            for many thousand rows takes seconds; False: such an end counts as any other.

    Raises:
        NPAError: The environment is none of this package, or has another autoreset mode.
        MissingDependencyError: Stable-Baselines3 is not installed (on import).
    """

    def __init__(self, env: AnyVectorEnv, *, bootstrap: bool = True) -> None:
        base = vector_env(env, type(self).__name__)
        check_same_step(autoreset_mode(env))
        self.bootstrap = bootstrap
        """Whether rows cut off by the step limit say so."""
        self.particle_count = base.config.particle_count
        """Particles N of a world."""
        super().__init__(
            env,
            base.num_envs,
            self.particle_count,
            row_space(env.single_observation_space),
            row_space(env.single_action_space),
        )

    def reset(self) -> NDArray[np.float32]:
        """Start episodes in all worlds and return the rows' observations, shape [B N, P]."""
        observations, _ = self.begin()
        return on_host(observations)[0].reshape(self.num_envs, -1)

    def step_wait(
        self,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Step all worlds.

        Returns:
            Of each row: observation [B N, P], reward [B N], whether its episode is over [B N], and
            infos.

        Raises:
            DivergedError: An action is not finite; the worlds are then as they were.
        """
        observations, rewards, terminations, truncations, infos = self.vector_env.step(
            self.taken_actions()
        )
        own = own_rewards(infos)
        shown, paid, ended, cut = on_host(
            observations, rewards if own is None else own, terminations, truncations
        )
        if own is None:
            paid = np.repeat(paid, self.particle_count)
        rows: list[dict[str, Any]] = [self.nothing] * self.num_envs
        done = ended | cut
        if done.any():
            self._write_infos(rows, infos, np.flatnonzero(done), cut & ~ended)
        return (
            shown.reshape(self.num_envs, -1),
            paid.reshape(self.num_envs).astype(np.float32, copy=False),
            np.repeat(done, self.particle_count),
            rows,
        )

    def _write_infos(
        self,
        rows: list[dict[str, Any]],
        infos: dict[str, Any],
        worlds: NDArray[np.int64],
        cut: NDArray[np.bool_],
    ) -> None:
        """Give each row of some worlds an info about its episode's end."""
        count = self.particle_count
        success = on_host(infos["final_info"]["success"])[0]
        final = as_tensor(infos["final_obs"])
        chosen = torch.from_numpy(worlds).to(final.device)
        last = on_host(final[chosen])[0] if self.bootstrap else None
        for k, world in enumerate(worlds.tolist()):
            common = {"is_success": bool(success[world])}
            first = world * count
            if last is None:
                rows[first : first + count] = [dict(common) for _ in range(count)]
                continue
            common["TimeLimit.truncated"] = bool(cut[world])
            rows[first : first + count] = [
                {**common, "terminal_observation": observation} for observation in last[k]
            ]
