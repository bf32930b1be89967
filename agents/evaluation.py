"""Evaluation of policies: whole episodes from given seeds, batched."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from npa_envs.agents.policies import unwrapped
from npa_envs.errors import NPAError
from npa_envs.world.randomness import WorldRandom


class Episodes(NamedTuple):
    """Episodes of a policy, one entry a seed."""

    returns: NDArray[np.float64]
    """Sums of the rewards, shape [E]."""

    start_losses: NDArray[np.float64]
    """Losses before the first step, shape [E]."""

    final_losses: NDArray[np.float64]
    """Losses after the last step, shape [E]."""

    steps: NDArray[np.int64]
    """Lengths, shape [E]."""

    endings: tuple[str, ...]
    """Why each was over: "success", "diverged" or "time limit"; of several species why the first
    one ended by itself, and "left the world" where one diverged."""

    @property
    def mean_return(self) -> float:
        """Mean of the returns."""
        return float(self.returns.mean())

    @property
    def standard_error(self) -> float:
        """Standard error of the mean return; infinite for a single episode."""
        count = len(self.returns)
        return float(self.returns.std(ddof=1)) / math.sqrt(count) if count > 1 else math.inf


def evaluate_policy(env: Any, policy: Callable[[Any], Any], seeds: Iterable[int]) -> Episodes:
    """Run one episode from each seed, as many at a time as the environment has worlds.

    Each is the first episode after a reset with its seed, so short episodes count no more than
    long ones, and the environment's draws do not depend on the number of worlds.

    Args:
        env: A vector environment of `npa_envs`, wrapped or not, in the autoreset mode "same-step"
            and with `max_episode_steps`.
        policy: Maps observations, [B, N, P], to actions, [B, N, A].
        seeds: One for each episode, integers of at least 0.

    Raises:
        NPAError: There are no seeds or wrong ones, or the environment is another one.
    """
    worlds = unwrapped(env).worlds
    if env.metadata.get("autoreset_mode") is not AutoresetMode.SAME_STEP:
        raise NPAError(
            f"env must be a vector environment that resets in the same step, got "
            f"{type(env).__name__}: make it with gymnasium.make_vec(..., "
            "vectorization_mode='vector_entry_point', autoreset_mode='same-step')"
        )
    if worlds.episode_steps is None:
        raise NPAError("env must end its episodes: make it with max_episode_steps=256")
    if not isinstance(seeds, Iterable):
        raise NPAError(f"seeds must be one for each episode, got {seeds!r}: give seeds=range(8)")
    given = list(seeds)
    if not given:
        raise NPAError("seeds must hold at least one seed, got none: give seeds=range(8)")
    # Before the first episode, not in the midst of them.
    WorldRandom(given)
    count = env.num_envs
    batches = [given[k : k + count] for k in range(0, len(given), count)]
    ran = [_run(env, policy, [*batch, *batch[-1:] * (count - len(batch))]) for batch in batches]
    joined = [np.concatenate(column)[: len(given)] for column in zip(*ran, strict=True)]
    returns, start_losses, final_losses, steps, endings = joined
    return Episodes(returns, start_losses, final_losses, steps, tuple(endings.tolist()))


def _run(env: Any, policy: Callable[[Any], Any], seeds: list[int]) -> tuple[NDArray[Any], ...]:
    """Run the first episode of each world: returns, start and final losses, lengths, endings."""
    observation, infos = env.reset(seed=seeds)
    start_losses = _host(infos["loss"])
    returns, final_losses = np.zeros(len(seeds)), np.zeros(len(seeds))
    steps = np.zeros(len(seeds), dtype=np.int64)
    endings = np.full(len(seeds), None, dtype=object)
    running = np.ones(len(seeds), dtype=bool)
    while running.any():
        observation, reward, terminated, truncated, infos = env.step(policy(observation))
        returns[running] += _host(reward)[running]
        steps[running] += 1
        over = running & (_host(terminated) | _host(truncated)).astype(bool)
        if over.any():
            final = infos["final_info"]
            final_losses[over] = _host(final["loss"])[over]
            endings[over] = final["reason"][over]
            running &= ~over
    return returns, start_losses, final_losses, steps, endings


def _host(value: Any) -> NDArray[Any]:
    """Return numbers as an array, float64 unless they are truth values."""
    array = value.cpu().numpy() if isinstance(value, torch.Tensor) else np.asarray(value)
    return array if array.dtype == bool else array.astype(np.float64)
