"""What adapters to training libraries share: demands on environments, rewards, spaces of rows."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode

from npa_envs.envs.core.vector import NPAVectorEnv
from npa_envs.errors import NPAError
from npa_envs.wrappers.statistics import as_tensor


def check_same_step(mode: AutoresetMode) -> None:
    """Check that worlds restart by themselves, as rows have to.

    Args:
        mode: How the environment restarts worlds.

    Raises:
        NPAError: Not in the step that ends their episodes.
    """
    if mode is not AutoresetMode.SAME_STEP:
        raise NPAError(
            f"env must restart worlds in the step that ends their episodes, got {mode}: "
            "make it with autoreset_mode='same-step'"
        )


def check_torch_output(env: NPAVectorEnv, adapter: str) -> None:
    """Check that a vector environment hands out tensors.

    Args:
        env: The environment itself, without wrappers.
        adapter: Name of the adapter, for the error.

    Raises:
        NPAError: It hands out arrays.
    """
    if env.config.output != "torch":
        raise NPAError(
            f"{adapter} needs torch tensors, got output={env.config.output!r}: "
            "make the environment with output='torch'"
        )


def check_copies(env: NPAVectorEnv, adapter: str) -> None:
    """Check that a vector environment leaves alone what it has handed out.

    Args:
        env: The environment itself, without wrappers.
        adapter: Name of the adapter, which keeps what it gets, for the error.

    Raises:
        NPAError: It overwrites what it has handed out.
    """
    if not env.copies:
        raise NPAError(
            f"{adapter} needs new tensors in each step, got copy=False: "
            "make the environment with copy=True, the default"
        )


def own_rewards(infos: dict[str, Any]) -> Any:
    """Return each particle's reward of the last step, shape [B, N], or None where there is none.

    Args:
        infos: Of the step; with same-step autoreset worlds that restarted say in their final infos
            what their last step was worth.
    """
    own = infos.get("particle_reward")
    last = infos.get("final_info", {}).get("particle_reward")
    if own is None or last is None:
        return own
    which = as_tensor(infos["_final_info"])[:, None]
    return torch.where(which, as_tensor(last), as_tensor(own))


def row_space(space: Any) -> Box:
    """Return the space of one particle of a world's.

    Args:
        space: A box of shape [N, ...].
    """
    assert isinstance(space, Box), "environments of this package have boxes"
    return Box(space.low[0], space.high[0], dtype=np.float32)
