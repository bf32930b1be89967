"""Minari datasets of episodes: recording any policy, and reading steps as tensors.

Minari stores datasets below the folder in the environment variable `MINARI_DATASETS_PATH`, by
default `~/.minari/datasets`.
"""

from __future__ import annotations

import os
import re
import secrets
import shutil
import warnings
from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any
from unittest import mock

import gymnasium
import numpy as np
import torch
from gymnasium.envs.registration import EnvSpec
from torch import Tensor

from npa_envs.errors import NPAError, importing, shown
from npa_envs.wrappers.base import as_tensor, autoreset_mode, check_autoreset, vector_env

with importing("Minari", "a dataset of episodes", "pip install 'npa-envs[minari]'"):
    import h5py  # noqa: F401
    import minari
    from minari.data_collector import EpisodeBuffer
    from minari.namespace import create_namespace, list_local_namespaces
    from minari.storage import get_dataset_path

ROOT = "MINARI_DATASETS_PATH"
"""Environment variable with the folder of all datasets."""

_DATASET_ID = re.compile(r"([-\w][-\w/]*[-\w]/)?[-\w]+-v\d+")
"""Minari's ids with a version, which it needs to write a dataset."""


def record_episodes(
    env: Any, policy: Callable[[Any], Any], seeds: Sequence[int]
) -> Iterator[EpisodeBuffer]:
    """Run one episode from each seed, and yield each as a Minari buffer.

    An episode is the first one after a reset with its seed. It has T + 1 observations, T actions,
    rewards, terminations and truncations, and the info `loss`, of T + 1 numbers.

    `env` is a vector environment of this package with same-step autoreset and a step limit. The
    policy maps observations, [B, ...], to actions, [B, ...].
    """
    vector_env(env, "record_episodes")
    check_autoreset(autoreset_mode(env), "same-step")
    if not len(seeds):
        raise NPAError("seeds must have at least one seed, got none: give seeds=range(8)")
    for first in range(0, len(seeds), env.num_envs):
        batch = list(seeds[first : first + env.num_envs])
        # Worlds beyond the last seed repeat it, and are dropped.
        padding = batch[-1:] * (env.num_envs - len(batch))
        yield from _recorded(env, policy, batch + padding)[: len(batch)]


def _recorded(env: Any, policy: Callable[[Any], Any], seeds: list[int]) -> list[EpisodeBuffer]:
    """Reset each world with its seed, and return the first episode of each."""
    observation, infos = env.reset(seed=seeds)
    observations, losses = [_host(observation)], [_host(infos["loss"])]
    steps: list[tuple[Any, ...]] = []
    lengths = np.zeros(len(seeds), np.int64)
    last: list[Any] = [None] * len(seeds)
    while not lengths.all():
        action = policy(observation)
        if isinstance(env.single_action_space, gymnasium.spaces.Box):
            # As environments do, which may also take another shape.
            action = action.clip(-1.0, 1.0).reshape(len(seeds), *env.single_action_space.shape)
        observation, *outcome, infos = env.step(action)
        steps.append(tuple(map(_host, (action, *outcome))))
        ended = (steps[-1][2] | steps[-1][3]) & (lengths == 0)
        loss = _host(infos["loss"])
        if ended.any():
            final = _host(infos["final_obs"])
            loss = np.where(ended, _host(infos["final_info"]["loss"]), loss)
            for k in np.flatnonzero(ended).tolist():
                last[k], lengths[k] = _of_world(final, k), len(steps)
        observations.append(_host(observation))
        losses.append(loss)

    names = ("actions", "rewards", "terminations", "truncations")
    episodes = []
    for k, length in enumerate(lengths.tolist()):
        episode: dict[str, Any] = {
            name: np.stack([step[number][k] for step in steps[:length]])
            for number, name in enumerate(names)
        }
        world = [*(_of_world(one, k) for one in observations[:length]), last[k]]
        episode["observations"] = _mapped(lambda *arrays: np.stack(arrays), *world)
        world_losses = [loss[k] for loss in losses[: length + 1]]
        episode["infos"] = {"loss": np.array(world_losses, np.float64)}
        episodes.append(EpisodeBuffer(seed=seeds[k], **episode))
    return episodes


def _mapped(function: Callable[..., Any], *values: Any) -> Any:
    """Return `function(*values)`; if values are dictionaries, a dictionary of it for each key."""
    if isinstance(values[0], dict):
        return {name: _mapped(function, *(v[name] for v in values)) for name in values[0]}
    return function(*values)


def _host(values: Any) -> Any:
    """Copy a tensor or array, or a dictionary of them, to new arrays on the CPU."""
    return _mapped(
        lambda v: v.cpu().numpy().copy() if isinstance(v, Tensor) else np.array(v), values
    )


def _of_world(observation: Any, k: int) -> Any:
    return _mapped(lambda array: array[k], observation)


def write_dataset(
    dataset_id: str,
    spec: EnvSpec,
    episodes: Iterator[EpisodeBuffer],
    *,
    algorithm: str,
    description: str,
) -> Path:
    """Write episodes as a dataset, whole or not at all, and return its folder.

    `dataset.recover_environment()` makes an environment by `spec`; `algorithm` names the policy's.
    """
    if not _DATASET_ID.fullmatch(dataset_id):
        raise NPAError(
            f"dataset must be an id with a version, got {shown(dataset_id)}: for example "
            "npa/heart/expert-v0"
        )
    target: Path = get_dataset_path(dataset_id)
    if target.exists():
        raise NPAError(
            f"dataset {shown(dataset_id)} exists already, in {shown(str(target))}: give another "
            "version, -v1, or delete it"
        )
    root = get_dataset_path()
    part = root / f".{secrets.token_hex(6)}"
    try:
        part.mkdir()
        with mock.patch.dict(os.environ, {ROOT: str(part)}), warnings.catch_warnings():
            # Minari warns about missing authors, addresses and links to code.
            warnings.simplefilter("ignore", UserWarning)
            dataset = minari.create_dataset_from_buffers(
                dataset_id, [next(episodes)], env=spec, algorithm_name=algorithm,
                description=description,
            )  # fmt: skip
            for episode in episodes:
                dataset.update_dataset_from_buffer([episode])
        namespace = dataset_id.rpartition("/")[0]
        if namespace and namespace not in list_local_namespaces():
            create_namespace(namespace)
        os.replace(part / dataset_id, target)
    except (OSError, ValueError) as error:
        if isinstance(error, NPAError):
            # Errors of `episodes` need no other message.
            raise
        raise NPAError(
            f"dataset {shown(dataset_id)} could not be written ({shown(error)}): give an id such "
            "as npa/heart/expert-v0, and a folder with room for it"
        ) from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return target


def spec_of(env_id: str, keywords: dict[str, Any], episode_steps: int) -> EnvSpec:
    """Return the Gymnasium spec of a single environment with keywords and a step limit."""
    spec = deepcopy(gymnasium.spec(env_id))
    spec.kwargs = {**spec.kwargs, **keywords, "episode_steps": episode_steps}
    spec.max_episode_steps = episode_steps
    spec.vector_entry_point = None
    return spec


def read_pairs(dataset_id: str) -> tuple[Tensor, Tensor]:
    """Return the observations and actions of all steps of a dataset, float32, [steps, ...] each."""
    try:
        dataset = minari.load_dataset(dataset_id)
    except (FileNotFoundError, ValueError) as error:
        raise NPAError(
            f"there is no dataset {shown(dataset_id)} in {shown(str(get_dataset_path()))}: record "
            "one with npa-envs record-dataset, or set MINARI_DATASETS_PATH"
        ) from error
    observations, actions = [], []
    for episode in dataset.iterate_episodes():
        if not isinstance(episode.observations, np.ndarray):
            raise NPAError(
                f"dataset {shown(dataset_id)} must have arrays, got observations of "
                f"{type(episode.observations).__name__}"
            )
        # The last observation of an episode has no action.
        observations.append(as_tensor(episode.observations[:-1]))
        actions.append(as_tensor(episode.actions))
    return torch.cat(observations).float(), torch.cat(actions).float()
