"""Evaluation of policies: whole episodes from given seeds, batched."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from numpy.typing import NDArray

from npa_envs.agents.policies import unwrapped
from npa_envs.errors import NPAError, shown
from npa_envs.world.randomness import WorldRandom

TIME_LIMIT = "time limit"
"""End reason of an episode that was truncated."""

_REASONS = {"reason", "diverged", "success"}


class Episodes(NamedTuple):
    """Results of a policy's episodes: arrays of shape [E], one entry for each of E seeds."""

    returns: NDArray[np.float64]
    """Sum of the rewards of each episode."""
    start_losses: NDArray[np.float64]
    """The world's loss before the first step."""
    final_losses: NDArray[np.float64]
    """The world's loss after the last step."""
    steps: NDArray[np.int64]
    """Number of steps."""
    endings: tuple[str, ...]
    """End reasons: "success", "diverged" or "time limit"; with several species the reason of the
    first one that terminated, or "left the world" if one diverged."""

    @property
    def mean_return(self) -> float:
        """Mean of the episodes' returns."""
        return float(self.returns.mean())

    @property
    def standard_error(self) -> float:
        """Standard error of the mean return; infinite for a single episode."""
        count = len(self.returns)
        return float(self.returns.std(ddof=1)) / math.sqrt(count) if count > 1 else math.inf


def evaluate_policy(env: Any, policy: Callable[[Any], Any], seeds: Iterable[int]) -> Episodes:
    """Run one episode from each seed, as many at a time as the environment has worlds.

    Each is the first one after a reset with its seed. Results do not depend on other episodes.

    Args:
        env: A single or a vector environment of `npa_envs`, or Gymnasium's `SyncVectorEnv` or
            `AsyncVectorEnv` of single ones, with or without wrappers, in any autoreset mode, with
            `max_episode_steps`.
        policy: Maps observations, [B, N, P], to actions, [B, N, A]; B is 1 where `env` is single,
            which also takes actions [N, A].
            A policy that reads the worlds instead has `made_for(env)`, which returns the policy
            for an environment.
        seeds: Seed of each episode, integers of at least 0.

    Raises:
        NPAError: Seeds are missing or wrong, or the environment is not of this library, or has
            several agents.
    """
    # The worlds of several species that learners step as one agent have `episode_steps`.
    if hasattr(env, "possible_agents") and not hasattr(env, "episode_steps"):
        raise NPAError(
            f"env must have one agent, got {type(env).__name__} with {len(env.possible_agents)}: "
            "for returns by agent, reset(seed=...) and add up rewards[agent] until terminations"
            "[agent] | truncations[agent]; for the mean of all species, give "
            "Problem(env_id='npa/MixingSmall-v0', episode_steps=32).make_envs() of "
            "npa_envs.agents.learning"
        )
    # `_run_many` checks environments in other processes by their infos.
    in_processes = isinstance(getattr(env, "unwrapped", None), AsyncVectorEnv)
    worlds = None if in_processes else unwrapped(env).worlds
    limits = [getattr(holder, "episode_steps", None) for holder in (worlds, env)]
    if limits == [None, None] and _step_limit(env) is None:
        raise NPAError("env must end its episodes: make it with max_episode_steps=256")
    seeds = checked_seeds("seeds", seeds)
    policy = bound_to(env, policy)
    single = isinstance(env, gymnasium.Env)
    run, count = (_run_single, 1) if single else (_run_many, env.num_envs)
    batches = [seeds[k : k + count] for k in range(0, len(seeds), count)]
    results = [run(env, policy, [*batch, *batch[-1:] * (count - len(batch))]) for batch in batches]
    returns, start_losses, final_losses, steps, end_reasons = (
        np.concatenate(column)[: len(seeds)] for column in zip(*results, strict=True)
    )
    return Episodes(returns, start_losses, final_losses, steps, tuple(end_reasons.tolist()))


def checked_seeds(name: str, seeds: Iterable[int]) -> list[int]:
    """Return seeds as a list, if they are at least one and valid; errors call them `name`."""
    if not isinstance(seeds, Iterable):
        raise NPAError(
            f"{name} must be one for each episode, got {shown(seeds)}: give {name}=range(8)"
        )
    listed = list(seeds)
    if not listed:
        raise NPAError(f"{name} must have at least one seed, got none: give {name}=range(8)")
    # Raises on wrong seeds.
    WorldRandom(listed)
    return listed


def bound_to(env: Any, policy: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return `policy.made_for(env)`, which policies that read worlds have; else `policy` itself."""
    make = getattr(policy, "made_for", None)
    if make is None and not callable(policy):
        raise NPAError(
            f"policy must be a function of observations, got {type(policy).__name__}: of a model "
            "of Stable-Baselines3 give lambda seen: model.predict(seen, deterministic=True)[0]"
        )
    return policy if make is None else make(env)


def _run_many(env: Any, policy: Callable[[Any], Any], seeds: list[int]) -> tuple[NDArray[Any], ...]:
    """Return the fields of `Episodes` for each world's first episode after a reset with `seeds`."""
    observation, infos = env.reset(seed=seeds)
    if "loss" not in infos:
        raise NPAError(
            f"env must contain environments of npa_envs, got others in {type(env).__name__}: make "
            "it with gymnasium.make_vec('npa/Morphogenesis2D-v0', num_envs=8)"
        )
    start_losses = _as_numpy(infos["loss"])
    returns, final_losses = np.zeros(len(seeds)), np.zeros(len(seeds))
    steps = np.zeros(len(seeds), dtype=np.int64)
    end_reasons = np.full(len(seeds), None, dtype=object)
    running = np.ones(len(seeds), dtype=bool)
    resets_itself = env.metadata.get("autoreset_mode") is not AutoresetMode.DISABLED
    while running.any():
        observation, reward, terminated, truncated, infos = env.step(policy(observation))
        returns[running] += _as_numpy(reward)[running]
        steps[running] += 1
        ended = (_as_numpy(terminated) | _as_numpy(truncated)).astype(bool)
        over = running & ended
        if over.any():
            final = infos.get("final_info", infos)
            final_losses[over] = _as_numpy(final["loss"])[over]
            for k in np.flatnonzero(over):
                info = {name: final[name][k] for name in _REASONS & final.keys()}
                end_reasons[k] = _end_reason(info, bool(terminated[k]))
            running &= ~over
        if not resets_itself and ended.any() and running.any():
            observation, _ = env.reset(options={"reset_mask": ended})
    return returns, start_losses, final_losses, steps, end_reasons


def _run_single(
    env: Any, policy: Callable[[Any], Any], seeds: list[int]
) -> tuple[NDArray[Any], ...]:
    """Return the fields of `Episodes`, of length 1, for the episode of a single environment."""
    observation, info = env.reset(seed=seeds[0])
    start_loss, total, steps, over = info["loss"], 0.0, 0, False
    while not over:
        batch: Any = (
            {name: value[None] for name, value in observation.items()}
            if isinstance(observation, Mapping)
            else observation[None]
        )
        action = policy(batch)
        if np.ndim(action) > len(env.action_space.shape or ()):
            action = action[0]
        observation, reward, terminated, truncated, info = env.step(action)
        total, steps, over = total + float(reward), steps + 1, terminated or truncated
    end_reason = np.array([_end_reason(info, terminated)], dtype=object)
    return *(np.array([n]) for n in (total, start_loss, info["loss"], steps)), end_reason


def _end_reason(info: Mapping[str, Any], terminated: bool) -> str:
    flags = [name for name in ("diverged", "success") if terminated and info.get(name)]
    return str(info.get("reason") or next(iter(flags), TIME_LIMIT))


def _step_limit(env: Any) -> int | None:
    inner, spec = env.unwrapped, None
    if isinstance(inner, SyncVectorEnv | AsyncVectorEnv):
        spec = inner.get_attr("spec")[0]
    elif isinstance(env, gymnasium.Env):
        spec = env.spec
    limit = getattr(spec, "max_episode_steps", None)
    return limit if limit is not None and limit > 0 else None


def _as_numpy(value: Any) -> NDArray[Any]:
    """Return a tensor or an array as a NumPy array, float64 unless bool."""
    array = value.cpu().numpy() if isinstance(value, torch.Tensor) else np.asarray(value)
    return array if array.dtype == bool else array.astype(np.float64)
