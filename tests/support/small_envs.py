"""Every registered Gymnasium environment at a small size, and comparisons of their results."""

from typing import Any

import gymnasium
import numpy as np
import torch

from npa_envs.envs.core.base import per_world
from npa_envs.envs.core.vector import own_entries
from npa_envs.registration import ENVIRONMENTS

IDS = [environment.id for environment in ENVIRONMENTS]

LIVING = {"eps": 0.2, "picture_size": 8, "seed_pool": 3, "grow_steps": 4, "rule_steps": 2}
SMALL: dict[str, Any] = {"particle_count": 61, "eps": 0.3, "resolution": 16, "render_size": 24}
# None: the environment has no such field.
SPECIAL: dict[str, dict[str, Any]] = {
    "npa/Pictures2D-v0": {"targets": ("heart", "ring"), "test_targets": ("letter-a",)},
    "npa/Regeneration2D-v0": {"rule": "picture"},
    "npa/PointClassification-v0": {"resolution": None},
    "npa/Gardener2D-v0": LIVING,
    "npa/Shepherd2D-v0": LIVING,
    "npa/Shapeshifter2D-v0": LIVING | {"eps": 0.3, "picture_size": 4, "hold_steps": 2},
    "npa/Morphogenesis3D-v0": {"seed_radius": 0.2, "view_count": 2, "target": "doughnut"},
}


def small(name: str, **keywords: Any) -> dict[str, Any]:
    fields = SMALL | SPECIAL.get(name, {})
    return {key: value for key, value in fields.items() if value is not None} | keywords


def make(name: str, **keywords: Any) -> gymnasium.Env:
    return gymnasium.make(name, **small(name, **keywords))


def make_vec(name: str, world_count: int, **keywords: Any) -> gymnasium.vector.VectorEnv:
    return gymnasium.make_vec(
        name,
        num_envs=world_count,
        vectorization_mode="vector_entry_point",
        **small(name, **keywords),
    )


def begun(*envs: Any, seed: int = 0) -> Any:
    """Reset environments alike; return them, or the only one."""
    for env in envs:
        env.reset(seed=seed)
    return envs if len(envs) > 1 else envs[0]


def assert_same(left: Any, right: Any) -> None:
    """Compare what steps and resets return, bit for bit: tuples and dicts of arrays or tensors."""
    if isinstance(left, dict):
        assert left.keys() == right.keys()
        left, right = list(left.values()), [right[key] for key in left]
    if isinstance(left, tuple | list) or (isinstance(left, np.ndarray) and left.dtype == "O"):
        for pair in zip(left, right, strict=True):
            assert_same(*pair)
    else:
        arrays = [v.cpu().numpy() if isinstance(v, torch.Tensor) else v for v in (left, right)]
        assert np.array_equal(*arrays)


def on_host(values: Any) -> Any:
    """Return a tensor, or all of a dictionary, as NumPy arrays; what is none stays."""
    if isinstance(values, dict):
        return {name: on_host(value) for name, value in values.items()}
    return values.cpu().numpy() if isinstance(values, torch.Tensor) else values


def as_arrays(infos: dict[str, Any]) -> dict[str, Any]:
    """Return the infos of a step with output="torch" as those of one with output="numpy"."""
    arrays = on_host(infos)
    if "final_obs" in arrays:
        arrays["final_obs"] = per_world(arrays["final_obs"], arrays["_final_obs"])
    return own_entries(arrays)


def world_of(batched: Any, k: int) -> Any:
    """Return what is world k's of an array, or of each array of a dictionary."""
    if isinstance(batched, dict):
        return {name: value[k] for name, value in batched.items()}
    return batched[k]


def assert_info_equal(infos, k, info):
    for name, value in info.items():
        assert np.array_equal(infos[name][k], value), name
        assert infos[f"_{name}"][k], name
    told = {name for name in infos if f"_{name}" in infos and infos[f"_{name}"][k]}
    assert told - {"final_obs", "final_info"} == info.keys()


def assert_batch_of_singles(
    envs: Any, singles: Any, actions: Any, mode: str = "same-step"
) -> tuple[set[str | None], int]:
    """Compare each world of a batch with its single environment, whatever the others do.

    Returns why episodes ended, None among it, and how many steps diverged.
    """
    observations, infos = envs.reset(seed=40)
    for k, env in enumerate(singles):
        observation, info = env.reset(seed=40 + k)
        assert_same(world_of(observations, k), observation)
        assert_info_equal(infos, k, info)
    reasons, diverged, over = set(), 0, [False] * len(singles)
    for action in actions:
        observations, rewards, terminations, truncations, infos = envs.step(action)
        for k, env in enumerate(singles):
            if over[k] and mode == "next-step":
                assert_same(world_of(observations, k), env.reset()[0])
                assert (rewards[k], terminations[k], truncations[k]) == (0.0, False, False)
                over[k] = False
                continue
            observation, reward_k, terminated, truncated, info = env.step(action[k])
            assert rewards[k] == reward_k
            assert (terminations[k], truncations[k]) == (terminated, truncated)
            over[k] = terminated or truncated
            diverged += info["diverged"]
            reasons.add(info.get("reason"))
            if over[k] and mode == "same-step":
                assert infos["_final_obs"][k]
                assert_same(world_of(infos["final_obs"], k), observation)
                assert_info_equal(infos["final_info"], k, info)
                observation, info = env.reset()
                assert "success" not in infos or not infos["_success"][k]
            elif "_final_obs" in infos:
                assert not infos["_final_obs"][k]
            assert_same(world_of(observations, k), observation)
            assert_info_equal(infos, k, info)
    return reasons, diverged
