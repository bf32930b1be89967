"""The batch of worlds behind every environment: steps, losses, endings, restarts.

Gymnasium is not known here. A single environment is a batch of one; world k of a batch is, bit for
bit, that world alone.
"""

from __future__ import annotations

import contextlib
import os
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.control import Physics, act, observe, perceive_worlds, place_perception
from npa_envs.envs.config import EnvConfig
from npa_envs.envs.memory import check_memory
from npa_envs.envs.restarts import Restarts
from npa_envs.envs.task import EnvTask, Start
from npa_envs.errors import NPAError
from npa_envs.randomness import WorldRandom
from npa_envs.replay import Beside, Replayed

# Torch's pool of threads does not survive a fork: a forked worker, as Gymnasium's AsyncVectorEnv
# starts them, would wait for it for ever.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=lambda: torch.set_num_threads(1))

SUCCESS, DIVERGED, TIME_LIMIT = 1, 2, 4
"""Bits of an ending: why an episode is over; none is set while it runs."""

FLAGS = ("success", "diverged")
"""Names of the first two endings in `info`."""


def reason(ending: int) -> str | None:
    """Return why an episode ended, in words, or None where it has not."""
    words = {DIVERGED: "diverged", SUCCESS: "success", TIME_LIMIT: "time limit"}
    return next((word for bit, word in words.items() if ending & bit), None)


def make_physics(config: EnvConfig, task_type: type[EnvTask[Any]]) -> Physics:
    """Return the constants of the worlds that a configuration describes."""
    return Physics(
        space_dim=task_type.space_dim,
        state_dim=config.state_dim,
        eps=config.eps,
        eps0=config.eps0,
        reach=config.alpha * config.eps,
        state_scale=config.state_scale,
        update_prob=config.update_prob,
        dt=config.dt,
        position_noise=config.position_noise,
        box=None if config.box is None else (config.box,) * task_type.space_dim,
        moving=not task_type.static,
        perception_limit=config.observation_limit,
        position_limit=config.position_limit,
        state_limit=config.observation_limit,
    )


def total(parts: Tensor) -> Tensor:
    """Return the sum of the parts of a loss, [K, B], in their order, which torch's is not."""
    first, *rest = parts.unbind()
    for part in rest:
        first = first + part
    return first


class Worlds:
    """B worlds of one task, stepped together. All tensors stay where they are between steps.

    Args:
        task_type: Gives starts and losses.
        config: The environment's configuration.
        world_count: Worlds B.
        episode_steps: Steps after which an episode is cut off, or None for never.

    Raises:
        NPAError: The worlds do not fit into memory.
    """

    def __init__(
        self,
        task_type: type[EnvTask[Any]],
        config: EnvConfig,
        world_count: int,
        episode_steps: int | None = None,
    ) -> None:
        device = config.torch_device
        self.physics = physics = make_physics(config, task_type)
        # Before the task, which may make a target of as many points.
        extra = task_type.extra_bytes(config, world_count)
        check_memory(world_count, config.particle_count, physics, device, extra)
        self.task = task_type(config, device)
        self.world_count = world_count
        self.episode_steps = episode_steps

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.zeros(world_count, *shape, dtype=dtype, device=device)

        count = config.particle_count
        self.x = zeros(count, physics.space_dim)
        """Positions [length units], shape [B, N, D]."""
        self.s = zeros(count, physics.state_dim)
        """States, dimensionless, shape [B, N, C]."""
        self.random = WorldRandom.from_keys(zeros(dtype=torch.int64))
        """One stream of randomness for each world."""
        self.elapsed = zeros(dtype=torch.int32)
        """Steps since the start of each episode, shape [B]."""
        self.particle_loss = zeros(count) if config.reward == "particle" else None
        """Each particle's share of the loss, shape [B, N], where rewards are shared out."""
        self.particle_reward = zeros(count) if config.reward == "particle" else None
        """Each particle's own reward of the last step, shape [B, N], likewise."""
        self._start_loss = zeros()
        self._success_loss = zeros()
        self._action = zeros(count, physics.action_dim)
        self._diverged = zeros(dtype=torch.uint8)
        self._enabled = torch.ones(1, dtype=torch.uint8, device=device)
        # One buffer for all numbers of a step and one for its endings, so that a step hands out two
        # copies and not twenty.
        self.part_names: tuple[str, ...] = ()
        """Names of the parts of the loss."""
        self.numbers = zeros()[None]
        """Reward; loss; its parts; their improvements in the last step; shape [2 + 2 K, B]."""
        self.flags = torch.zeros(2 + len(FLAGS), world_count, dtype=torch.bool, device=device)
        """Terminated; truncated; success; diverged; shape [4, B]."""
        # Each world's ending, then whether the actions were finite: all that the host reads.
        self._host_endings = torch.zeros(
            world_count + 1, dtype=torch.uint8, pin_memory=device.type == "cuda"
        )
        self._act = Replayed(self._move, device)
        self._measure = Replayed(self._judge, device)
        self._survey = Replayed(self._sort, device)
        self.restart = Restarts(self.start, world_count, device, recorded=self.task.start_is_short)
        """Starts the next episodes of some worlds: restart(indices, observation)."""
        self._beside = Beside(device) if device.type == "cuda" else None

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what only the next step needs, and which cannot be pickled."""
        return self.__dict__ | {"_surveyed": None}

    @property
    def reward(self) -> Tensor:
        """Rewards of the last step, shape [B]."""
        return self.numbers[0]

    @property
    def loss(self) -> Tensor:
        """Losses as they are, shape [B]."""
        return self.numbers[1]

    @torch.no_grad()
    def start(self, worlds: Tensor, keys: Tensor | None = None) -> Tensor:
        """Start episodes in some worlds and return what is perceived there, [M, N, P].

        Args:
            worlds: Which, int64, shape [M].
            keys: Keys of new streams of randomness, int64, shape [M], which begin with their first
                episode; None: each world goes on to its next one.
        """
        if keys is not None:
            random = WorldRandom.from_keys(keys.to(self.task.device))
        else:
            random = self.random.take(worlds)
            random.restart()
        start = self.task.start(random)
        self.random.put(worlds, random)
        self.elapsed.index_fill_(0, worlds, 0)
        observation = self.place(worlds, start)
        self._start_loss[worlds] = self.loss[worlds]
        if start.success_loss is None:
            self._success_loss.index_fill_(0, worlds, -torch.inf)
        else:
            self._success_loss[worlds] = start.success_loss
        return observation

    @torch.no_grad()
    def place(self, worlds: Tensor, start: Start) -> Tensor:
        """Put particles into some worlds, at no reward, and return what is perceived, [M, N, P].

        Args:
            worlds: Which, int64, shape [M].
            start: Their particles.
        """
        x, s = start.x.contiguous(), start.s.contiguous()
        parts = self.task.losses(x, s)
        if not self.part_names:
            self.part_names = tuple(parts)
            self.numbers = self.numbers.new_zeros(2 + 2 * len(parts), self.world_count)
        self.x[worlds], self.s[worlds] = x, s
        self.numbers.index_fill_(1, worlds, 0.0)
        values = torch.stack(list(parts.values()))
        self.numbers[1, worlds] = total(values)
        self.numbers[2 : 2 + len(values), worlds] = values
        if self.particle_loss is not None and self.particle_reward is not None:
            self.particle_loss[worlds] = self.task.particle_losses(x, s)
            self.particle_reward.index_fill_(0, worlds, 0.0)
        self.flags.index_fill_(1, worlds, False)
        return observe(x, s, self.physics)

    def perceive(self) -> Tensor:
        """Return what is perceived in all worlds as they are, shape [B, N, P]."""
        return observe(self.x, self.s, self.physics)

    def here(self) -> contextlib.AbstractContextManager[Any]:
        """Return a context in which the worlds' device is the current one."""
        return (
            contextlib.nullcontext() if self._beside is None else torch.cuda.device(self.x.device)
        )

    @torch.no_grad()
    def step(self, action: Tensor, out: Tensor | None = None) -> tuple[NDArray[np.uint8], Tensor]:
        """Apply actions to all worlds; return their endings, [B], and what is perceived, [B, N, P].

        The endings are all that the host reads, one byte a world. On CUDA the worlds are judged
        and sorted side by side, and the device perceives while the host reads.

        Args:
            action: Float32, shape [B, N, A], on any device.
            out: Where to write what is perceived; a new tensor otherwise.

        Raises:
            NPAError: An action is not finite; the worlds are then as they were.
        """
        if self._beside is None and not bool(torch.isfinite(action).all()):
            raise self._not_finite(action)
        self._action.copy_(action)
        self._act()
        if self._beside is None:
            self._measure()
            self._survey()
        else:
            self._beside.run(self._measure)
            self._survey()
            # The long perception comes last: the host knows the endings while it still runs.
            self._beside.join()
        observation = place_perception(self._surveyed, self.physics, out)
        if self._beside is not None:
            self._beside.wait()
        if not self._host_endings[-1]:
            self.random.steps -= 1
            self.elapsed -= 1
            raise self._not_finite(action)
        return self._host_endings[:-1].numpy().copy(), observation

    def _move(self) -> None:
        """Apply the actions."""
        self._diverged.zero_()
        act(
            self.x,
            self.s,
            self._action,
            self.physics,
            self.random,
            enabled=self._enabled,
            diverged=self._diverged,
        )
        self.elapsed += 1

    def _judge(self) -> None:
        """Write rewards, losses and endings of the worlds as they now are."""
        config, task = self.task.config, self.task
        diverged = self._diverged.bool()
        parts = torch.stack(list(task.losses(self.x, self.s).values()))
        loss = total(parts)
        # Leaving the world must not pay, even where an empty picture is better than the start.
        loss = torch.where(diverged, torch.maximum(loss, self._start_loss), loss)
        success = (loss <= self._success_loss) & ~diverged
        late = torch.zeros_like(success)
        if self.episode_steps is not None:
            late = self.elapsed >= self.episode_steps
        self.flags.copy_(torch.stack((success | diverged, late, success, diverged)))
        improvement = self.loss - loss
        if self.particle_loss is not None and self.particle_reward is not None:
            shares = task.particle_losses(self.x, self.s)
            own = torch.where(diverged[:, None], improvement[:, None], self.particle_loss - shares)
            self.particle_reward.copy_(own)
            self.particle_loss.copy_(shares)
        reward = improvement
        if config.reward == "sparse":
            limit = self.episode_steps or config.episode_steps
            over = success | diverged | (self.elapsed == limit)
            reward = torch.where(over, -loss, torch.zeros_like(loss))
        before = self.numbers[2 : 2 + len(parts)]
        self.numbers.copy_(torch.cat((reward[None], loss[None], parts, before - parts)))
        ending = SUCCESS * success.byte() + DIVERGED * diverged.byte() + TIME_LIMIT * late.byte()
        self._host_endings.copy_(torch.cat((ending, self._enabled)), non_blocking=True)

    def _sort(self) -> None:
        self._surveyed = perceive_worlds(self.x, self.s, self.physics)

    def _not_finite(self, action: Tensor) -> NPAError:
        bad = ~torch.isfinite(action)
        world, particle, entry = (int(k) for k in bad.nonzero()[0])
        return NPAError(
            f"action must be finite, got {action[world, particle, entry].item()} at world {world}, "
            f"particle {particle}, entry {entry} ({int(bad.sum())} such numbers): check the policy"
        )
