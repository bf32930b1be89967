"""Particles as rows of a Stable-Baselines3 `VecEnv`: what all such environments share."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NoReturn

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import VectorWrapper
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.errors import MissingDependencyError, NPAError
from npa_envs.wrappers.moments import as_tensor

try:
    from stable_baselines3.common.vec_env import VecEnv
except ImportError as error:
    raise MissingDependencyError(
        "particles as rows need Stable-Baselines3: pip install 'npa-envs[sb3]'"
    ) from error


class SharedInfo(dict[str, Any]):
    """The empty info that all rows in the midst of their episodes share, so it stays empty."""

    def _refuse(self, *_: Any, **__: Any) -> NoReturn:
        raise NPAError(
            "info of a row in the midst of its episode is shared by all such rows: "
            "put a copy into the list, infos[row] = dict(infos[row])"
        )

    __setitem__ = __ior__ = setdefault = update = _refuse


class RowVecEnv(VecEnv):
    """Rows of a batch of worlds, as many of each; subclasses say what a row sees, does and gets.

    Args:
        env: The environment of many worlds.
        world_count: Worlds B.
        row_count: Rows of a world, R.
        observation_space: Space of a row's observations.
        action_space: Space of its actions.
    """

    def __init__(
        self,
        env: Any,
        world_count: int,
        row_count: int,
        observation_space: Box,
        action_space: Box,
    ) -> None:
        self.vector_env = env
        """The environment whose particles these are."""
        self.world_count = world_count
        """Worlds B."""
        self.row_count = row_count
        """Rows of a world, R."""
        self.spec = getattr(env, "spec", None)
        """What Gymnasium knows of the environment."""
        self.nothing = SharedInfo()
        """The info of all rows in the midst of their episodes."""
        self._seed: int | None = None
        self._actions: NDArray[np.float32] | None = None
        super().__init__(world_count * row_count, observation_space, action_space)

    def begin(self) -> tuple[Any, Any]:
        """Reset the environment with what `seed` and `set_options` left for it."""
        outcome: tuple[Any, Any] = self.vector_env.reset(
            seed=self._seed, options=self._options[0] or None
        )
        self._seed = None
        self._reset_seeds()
        self._reset_options()
        return outcome

    def step_async(self, actions: NDArray[Any]) -> None:
        """Keep the actions for `step_wait`.

        Args:
            actions: Of each row, shape [B R, A].

        Raises:
            NPAError: They have another shape, which could be read as that of other rows.
        """
        wanted = (self.num_envs, *(self.action_space.shape or ()))
        if np.shape(actions) != wanted:
            raise NPAError(
                f"actions must have shape [B R, A] = {wanted}, got {np.shape(actions)}: "
                "one for each row"
            )
        self._actions = actions.reshape(self.world_count, self.row_count, -1)

    def taken_actions(self) -> NDArray[np.float32]:
        """Return the actions that were kept, shape [B, R, A]; they are taken once.

        Raises:
            NPAError: There are none.
        """
        if self._actions is None:
            raise NPAError("step_wait needs actions: call step_async, or step")
        actions, self._actions = self._actions, None
        return actions

    def close(self) -> None:
        """Close the environment."""
        self.vector_env.close()

    def seed(self, seed: int | None = None) -> list[int | None]:
        """Let the next reset begin the sequences of episodes of seed, seed + 1, ..., one a world.

        Args:
            seed: None: any.

        Returns:
            The seed of each row's world.
        """
        if seed is None:
            seed = int(np.random.default_rng().integers(2**32))
        self._seed = int(seed)
        worlds = np.arange(self.world_count).repeat(self.row_count)
        return [self._seed + world for world in worlds.tolist()]

    def get_images(self) -> list[NDArray[np.uint8] | None]:
        """Return a picture of each world, shape [R, R, 3], or nothing without a render mode."""
        pictures: Any = self.vector_env.render()
        return list(pictures or ())

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the environment, once for each row.

        Args:
            attr_name: Its name; wrappers are asked first.
            indices: Which rows; None: all of them.

        Raises:
            AttributeError: There is none of that name.
        """
        return [getattr(self._holder(attr_name), attr_name)] * len(self._chosen(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the environment.

        Args:
            attr_name: Its name; set where it is found, else in the innermost environment.
            value: The value.
            indices: None, or all rows: they share the environment.

        Raises:
            NPAError: Only some rows are chosen.
        """
        if len(set(self._chosen(indices))) != self.num_envs:
            raise NPAError("indices must be all rows, which share one environment: give None")
        try:
            holder = self._holder(attr_name)
        except AttributeError:
            holder = getattr(self.vector_env, "unwrapped", self.vector_env)
        setattr(holder, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the environment once, and return its result for each row.

        Args:
            method_name: Its name; wrappers are asked first.
            method_args: Its arguments.
            indices: Which rows; None: all of them.
            method_kwargs: Its keyword arguments.

        Raises:
            AttributeError: There is none of that name.
        """
        result = getattr(self._holder(method_name), method_name)(*method_args, **method_kwargs)
        return [result] * len(self._chosen(indices))

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """Return for each row whether the environment is wrapped with a class.

        Args:
            wrapper_class: The class.
            indices: Which rows; None: all of them.
        """
        wrapped = any(isinstance(layer, wrapper_class) for layer in self._layers())
        return [wrapped] * len(self._chosen(indices))

    def _chosen(self, indices: Any) -> list[int]:
        return list(self._get_indices(indices))

    def _layers(self) -> Iterator[Any]:
        layer: Any = self.vector_env
        while isinstance(layer, VectorWrapper):
            yield layer
            layer = layer.env
        yield layer

    def _holder(self, name: str) -> Any:
        for layer in self._layers():
            if hasattr(layer, name):
                return layer
        raise AttributeError(f"{self.vector_env} has no attribute {name!r}")


def on_host(*given: Any) -> list[NDArray[Any]]:
    """Return new arrays with what arrays or tensors hold, after one wait for the device.

    Args:
        given: Arrays or tensors.
    """
    copies = []
    for values in given:
        tensor = as_tensor(values)
        # Pinned memory comes from torch's cache and goes back to it with the array.
        copy = torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=tensor.is_cuda)
        copies.append(copy.copy_(tensor, non_blocking=tensor.is_cuda))
    for device in {v.device for v in given if isinstance(v, Tensor) and v.is_cuda}:
        torch.cuda.current_stream(device).synchronize()
    return [copy.numpy() for copy in copies]
