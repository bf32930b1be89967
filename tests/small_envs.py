"""Every registered environment, made small."""

from typing import Any

import gymnasium
import numpy as np
import torch

from npa_envs.registration import ENVIRONMENTS

IDS = [environment.id for environment in ENVIRONMENTS]

SMALL: dict[str, Any] = {"particle_count": 61, "eps": 0.3, "resolution": 16, "render_size": 24}
# None: the environment has no such field.
SPECIAL: dict[str, dict[str, Any]] = {
    "npa/Regeneration2D-v0": {"rule": "picture"},
    "npa/PointClassification-v0": {"resolution": None},
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


def assert_same(left: Any, right: Any, where: str = "") -> None:
    """Compare what steps and resets return, bit for bit: tuples and dicts of arrays or tensors."""
    if isinstance(left, dict):
        assert left.keys() == right.keys(), where
        for key, value in left.items():
            assert_same(value, right[key], f"{where}.{key}")
    elif isinstance(left, tuple | list):
        for k, (value, other) in enumerate(zip(left, right, strict=True)):
            assert_same(value, other, f"{where}[{k}]")
    else:
        arrays = [v.cpu().numpy() if isinstance(v, torch.Tensor) else v for v in (left, right)]
        assert np.array_equal(*arrays), where
