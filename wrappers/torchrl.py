"""Adapter to TorchRL: batches of worlds as one environment, without copies to the CPU."""

from __future__ import annotations

from typing import Any

import torch
from gymnasium.spaces import Box, Dict
from torch import Tensor

from npa_envs.errors import NPAError, importing, shown
from npa_envs.wrappers.base import (
    AnyVectorEnv,
    autoreset_mode,
    check_autoreset,
    row_space,
    torch_env,
)

with importing("TorchRL", "NPATorchRLEnv", "pip install 'npa-envs[torchrl]'"):
    from tensordict import TensorDict, TensorDictBase
    from torchrl.data import Bounded, Categorical, Composite, Unbounded
    from torchrl.envs import EnvBase


class NPATorchRLEnv(EnvBase):  # type: ignore[misc]
    """B worlds as one TorchRL environment of batch size [B], or of [B, N] with `rows=True`.

    Entries are `observation` [B, N, P], `action` [B, N, A], and `reward`, `done`, `terminated` and
    `truncated`, [B, 1] each. Where observations are dictionaries, as in `npa/Shepherd2D-v0`, their
    entries stand in the place of `observation`. TorchRL restarts worlds itself, each when its own
    episode is over. World k, seeded with s, has the episodes of the single environment seeded with
    s + k.

    With `rows=True` every particle is an element of the batch, so TorchRL's losses for one agent
    train one small policy that all particles share. `observation` and `action` keep their shapes,
    the others become [B, N, 1]; a particle gets its own reward where the environment was made with
    `reward="particle"`, else its world's. Frames are then counted in rows. The particles of a world
    begin and end their episodes together.

    Observations, rewards and flags are the environment's own tensors, on its device.

    Args:
        env: A vector environment of this package, wrapped or not, made with `output="torch"`,
            `autoreset_mode="disabled"`, and `copy=True` (the default), as TorchRL stores tensors.
        rows: Whether particles are elements of the batch.
    """

    def __init__(self, env: AnyVectorEnv, *, rows: bool = False) -> None:
        base = torch_env(env, type(self).__name__)
        check_autoreset(autoreset_mode(env), "disabled")
        worlds, count = base.num_envs, base.config.particle_count
        batch = (worlds, count) if rows else (worlds,)
        super().__init__(device=base.worlds.x.device, batch_size=torch.Size(batch))
        self.vector_env = env
        self.rows = rows
        self.particle_count = count
        self._first_seed: int | None = None
        space = env.single_observation_space
        if rows:
            row_space(space)
        named = space.spaces if isinstance(space, Dict) else {"observation": space}
        observed = {name: _bounded(part, worlds, self.device) for name, part in named.items()}
        self.observation_spec = Composite(observed, shape=batch, device=self.device)
        self.action_spec = _bounded(env.single_action_space, worlds, self.device)
        self.reward_spec = Unbounded(shape=(*batch, 1), device=self.device)
        flag = Categorical(2, shape=(*batch, 1), dtype=torch.bool, device=self.device)
        names = ("done", "terminated", "truncated")
        flags = {name: flag.clone() for name in names}
        self.done_spec = Composite(flags, shape=batch, device=self.device)

    def _reset(self, tensordict: TensorDictBase | None, **_: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        chosen = torch.ones(self.batch_size[0], dtype=torch.bool)
        if mask is not None:
            by_world = mask.reshape(self.batch_size[0], -1).cpu()
            chosen = by_world.any(dim=1)
            if not torch.equal(chosen, by_world.all(dim=1)):
                raise NPAError(
                    "_reset must choose all particles of a world or none, got some of them: "
                    "they begin their episodes together"
                )
        if chosen.all():
            observation, _ = self.vector_env.reset(seed=self._first_seed)
            self._first_seed = None
        else:
            observation, _ = self.vector_env.reset(options={"reset_mask": chosen})
        off = torch.zeros((*self.batch_size, 1), dtype=torch.bool, device=self.device)
        return self._entries(observation, done=off, terminated=off.clone(), truncated=off.clone())

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        outcome = self.vector_env.step(tensordict["action"])
        observation, reward, terminated, truncated, infos = outcome
        if self.rows and "particle_reward" in infos:
            reward = infos["particle_reward"][..., None]
        else:
            reward = self._spread(reward)
        return self._entries(
            observation, reward=reward, done=self._spread(terminated | truncated),
            terminated=self._spread(terminated), truncated=self._spread(truncated),
        )  # fmt: skip

    def _set_seed(self, seed: int | None) -> None:
        self._first_seed = seed

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close the environment; `raise_if_closed` refuses a second call."""
        super().close(raise_if_closed=raise_if_closed)
        self.vector_env.close()

    def _spread(self, values: Tensor) -> Tensor:
        """Reshape worlds' values [B] to [B, 1], or with `rows=True` repeat them, to [B, N, 1]."""
        if not self.rows:
            return values[:, None]
        return values[:, None, None].expand(-1, self.particle_count, -1).clone()

    def _entries(self, observation: Any, **entries: Tensor) -> TensorDictBase:
        """Return a TensorDict of an observation and other results of a reset or a step."""
        entries |= observation if isinstance(observation, dict) else {"observation": observation}
        result: TensorDictBase = TensorDict(entries, self.batch_size, device=self.device)
        return result


def _bounded(space: Any, world_count: int, device: torch.device | None) -> Bounded:
    """Return the space of one world as TorchRL's spec of `world_count` worlds."""
    if not isinstance(space, Box):
        raise NPAError(
            f"env must have actions that are numbers, got {shown(space)}: leave out "
            "actions='discrete' or 'choice'"
        )
    low, high = (
        torch.as_tensor(limit, device=device).expand(world_count, *space.shape).clone()
        for limit in (space.low, space.high)
    )
    return Bounded(low, high, (world_count, *space.shape), device=device, dtype=torch.float32)
