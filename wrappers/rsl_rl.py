"""Adapter to RSL-RL: particles as rows of its `VecEnv`, without copies to the CPU."""

from __future__ import annotations

from typing import Any, NoReturn

import torch
from torch import Tensor

from npa_envs.errors import NPAError, importing
from npa_envs.wrappers.base import AnyVectorEnv, ParticleRowsBase, torch_env

with importing("RSL-RL", "RslRlParticleEnv", "pip install 'npa-envs[rslrl]'"):
    from rsl_rl.env import VecEnv
    from tensordict import TensorDict


class RslRlParticleEnv(ParticleRowsBase, VecEnv):  # type: ignore[misc]
    """The particles of a vector environment as the rows of RSL-RL's `VecEnv`.

    Row w N + i is particle i of world w. It observes that particle's perception, shape [P], in the
    observation group "policy", gives its action, shape [A], and gets its own reward where the
    environment was made with `reward="particle"`, else its world's. So all particles share one
    policy. Observations, rewards and flags stay on the environment's device.

    At the ends of episodes the means of the last losses and of success are logged, as
    `Episode/loss` and `Episode/success`.

    Args:
        env: A vector environment of this package, wrapped or not, made with `output="torch"`, with
            same-step autoreset and `copy=True` (the default), as RSL-RL stores the tensors.
        seed: World w begins with the episode of seed + w; None: a random one.
    """

    def __init__(self, env: AnyVectorEnv, *, seed: int | None = None) -> None:
        base = torch_env(env, type(self).__name__)
        self.set_env(env, base, "same-step")
        self.num_actions = base.worlds.physics.action_dim
        self.max_episode_length = base.worlds.episode_steps or 2**31 - 1
        self.device = base.worlds.x.device
        self.cfg = vars(base.config) | {"num_envs": base.num_envs}
        self._elapsed = torch.zeros(self.num_envs, dtype=torch.int64, device=self.device)
        self._observations, _ = env.reset(seed=seed)

    @property
    def episode_length_buf(self) -> Tensor:
        """Steps since the start of each row's episode, int64, shape [B N]."""
        return self._elapsed

    @episode_length_buf.setter
    def episode_length_buf(self, _: Tensor) -> NoReturn:
        raise NPAError(
            "episode_length_buf cannot be set, the worlds count their own steps: "
            "call learn with init_at_random_ep_len=False"
        )

    def get_observations(self) -> TensorDict:
        """Return the current observations, shape [B N, P], as the entry "policy"."""
        rows = self._observations.reshape(self.num_envs, -1)
        return TensorDict({"policy": rows}, batch_size=[self.num_envs], device=self.device)

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """Step all worlds by actions [B N, A], with the errors of `ParticleRows.step`.

        Returns observations, rewards [B N], done flags, int64, [B N], and extras: `time_outs`
        [B N], and `log` where episodes ended.
        """
        # RSL-RL collects in inference mode, whose tensors later steps could not write to.
        with torch.inference_mode(False), torch.no_grad():
            self._observations, rewards, ended, cut, infos = self.step_worlds(actions.clone())
            over = ended | cut
            self._elapsed = torch.where(over, 0, self._elapsed + 1)
            extras: dict[str, Any] = {"time_outs": cut & ~ended}
            if "final_info" in infos:
                final, which = infos["final_info"], infos["_final_info"]
                extras["log"] = {
                    f"Episode/{name}": torch.where(which, final[name].float(), 0.0).sum()
                    / which.sum()
                    for name in ("loss", "success")
                }
            return self.get_observations(), rewards, over.long(), extras
