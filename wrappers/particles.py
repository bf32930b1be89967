"""Each particle as one environment of Stable-Baselines3: many small agents that share a policy."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NoReturn

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorWrapper
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.errors import MissingDependencyError, NPAError
from npa_envs.wrappers.base import AnyVectorEnv, autoreset_mode, vector_env
from npa_envs.wrappers.moments import as_tensor

try:
    from stable_baselines3.common.vec_env import VecEnv
except ImportError as error:
    raise MissingDependencyError(
        "ParticleVecEnv needs Stable-Baselines3: pip install 'npa-envs[sb3]'"
    ) from error


class SharedInfo(dict[str, Any]):
    """The empty info that all rows in the midst of their episodes share, so it stays empty."""

    def _refuse(self, *_: Any, **__: Any) -> NoReturn:
        raise NPAError(
            "info of a row in the midst of its episode is shared by all such rows: "
            "put a copy into the list, infos[row] = dict(infos[row])"
        )

    __setitem__ = __ior__ = setdefault = update = _refuse


class ParticleVecEnv(VecEnv):
    """The particles of a vector environment as the rows of a Stable-Baselines3 `VecEnv`.

    Row w N + i is particle i of world w: it observes that particle's perception, shape [P], gives
    its action, shape [A], and gets its own reward where the environment was made with
    `reward="particle"`; with any other reward each row gets its world's. So a policy of any
    algorithm is shared by all particles, and sees what a rule sees. A step stays one batched step,
    and costs one copy of the observations to the host (on CUDA make the environment with
    `output="torch"`: the copy is then pinned).

    Rows of a finished world have an info of their own, with `terminal_observation`,
    `TimeLimit.truncated` and `is_success`; the others share an empty one, which cannot be written
    to. Attributes and methods belong to the whole environment: each row gives the same.

    Stable-Baselines3 counts rows: 8 worlds of 1024 particles are 8192 steps at once. Its defaults
    are made for a few rows; with PPO set for example `n_steps=32, batch_size=4096`.

    Args:
        env: A vector environment of this package, wrapped or not, with same-step autoreset.
        bootstrap: Whether rows cut off by the step limit say so, from which Stable-Baselines3
            estimates what they would still have got. On-policy algorithms do that row by row, which
            for many thousand rows takes seconds; False: such an end counts as any other.

    Raises:
        NPAError: The environment is none of this package, or has another autoreset mode.
        MissingDependencyError: Stable-Baselines3 is not installed (on import).
    """

    def __init__(self, env: AnyVectorEnv, *, bootstrap: bool = True) -> None:
        base = vector_env(env, type(self).__name__)
        if autoreset_mode(env) is not AutoresetMode.SAME_STEP:
            raise NPAError(
                f"env must restart worlds in the step that ends their episodes, got "
                f"{autoreset_mode(env)}: make it with autoreset_mode='same-step'"
            )
        self.vector_env = env
        """The environment whose particles these are."""
        self.bootstrap = bootstrap
        """Whether rows cut off by the step limit say so."""
        self.world_count = base.num_envs
        """Worlds B."""
        self.particle_count = base.config.particle_count
        """Particles N of a world."""
        self.spec = env.spec
        """What Gymnasium knows of the environment."""
        self._seed: int | None = None
        self._actions: NDArray[np.float32] | None = None
        self._nothing = SharedInfo()
        super().__init__(
            self.world_count * self.particle_count,
            _row_space(env.single_observation_space),
            _row_space(env.single_action_space),
        )

    def reset(self) -> NDArray[np.float32]:
        """Start episodes in all worlds and return the rows' observations, shape [B N, P]."""
        options = self._options[0] or None
        observations, _ = self.vector_env.reset(seed=self._seed, options=options)
        self._seed = None
        self._reset_seeds()
        self._reset_options()
        return _on_host(observations)[0].reshape(self.num_envs, -1)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Keep the actions for `step_wait`.

        Args:
            actions: Of each row, shape [B N, A].
        """
        self._actions = actions.reshape(self.world_count, self.particle_count, -1)

    def step_wait(
        self,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Step all worlds.

        Returns:
            Of each row: observation [B N, P], reward [B N], whether its episode is over [B N], and
            infos.

        Raises:
            NPAError: An action is not finite; the worlds are then as they were.
        """
        if self._actions is None:
            raise NPAError("step_wait needs actions: call step_async, or step")
        observations, rewards, terminations, truncations, infos = self.vector_env.step(
            self._actions
        )
        self._actions = None
        own = _own_rewards(infos)
        shown, paid, ended, cut = _on_host(
            observations, rewards if own is None else own, terminations, truncations
        )
        if own is None:
            paid = np.repeat(paid, self.particle_count)
        rows: list[dict[str, Any]] = [self._nothing] * self.num_envs
        done = ended | cut
        if done.any():
            self._write_infos(rows, infos, np.flatnonzero(done), cut & ~ended)
        return (
            shown.reshape(self.num_envs, -1),
            paid.reshape(self.num_envs).astype(np.float32, copy=False),
            np.repeat(done, self.particle_count),
            rows,
        )

    def _write_infos(
        self,
        rows: list[dict[str, Any]],
        infos: dict[str, Any],
        worlds: NDArray[np.int64],
        cut: NDArray[np.bool_],
    ) -> None:
        """Give each row of some worlds an info about its episode's end."""
        count = self.particle_count
        success = _on_host(infos["final_info"]["success"])[0]
        final = as_tensor(infos["final_obs"])
        chosen = torch.from_numpy(worlds).to(final.device)
        last = _on_host(final[chosen])[0] if self.bootstrap else None
        for k, world in enumerate(worlds.tolist()):
            common = {"is_success": bool(success[world])}
            first = world * count
            if last is None:
                rows[first : first + count] = [dict(common) for _ in range(count)]
                continue
            common["TimeLimit.truncated"] = bool(cut[world])
            rows[first : first + count] = [
                {**common, "terminal_observation": observation} for observation in last[k]
            ]

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
        worlds = np.arange(self.world_count).repeat(self.particle_count)
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
            holder = self.vector_env.unwrapped
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

    def _layers(self) -> Iterator[AnyVectorEnv]:
        layer: Any = self.vector_env
        while isinstance(layer, VectorWrapper):
            yield layer
            layer = layer.env
        yield layer

    def _holder(self, name: str) -> AnyVectorEnv:
        for layer in self._layers():
            if hasattr(layer, name):
                return layer
        raise AttributeError(f"{self.vector_env} has no attribute {name!r}")


def _own_rewards(infos: dict[str, Any]) -> Any:
    """Return each particle's reward of the last step, shape [B, N], or None where there is none."""
    own = infos.get("particle_reward")
    if own is None or "final_info" not in infos:
        return own
    # Worlds that restarted say in their final info what their last step was worth.
    which = as_tensor(infos["_final_info"])[:, None]
    return torch.where(which, as_tensor(infos["final_info"]["particle_reward"]), as_tensor(own))


def _on_host(*given: Any) -> list[NDArray[Any]]:
    """Return new arrays with what arrays or tensors hold, after one wait for the device."""
    copies = []
    for values in given:
        tensor = as_tensor(values)
        # Pinned memory comes from torch's cache and goes back to it with the array.
        copy = torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=tensor.is_cuda)
        copies.append(copy.copy_(tensor, non_blocking=tensor.is_cuda))
    for device in {v.device for v in given if isinstance(v, Tensor) and v.is_cuda}:
        torch.cuda.current_stream(device).synchronize()
    return [copy.numpy() for copy in copies]


def _row_space(space: Any) -> Box:
    """Return the space of one particle of a world's."""
    assert isinstance(space, Box), "environments of this package have boxes"
    return Box(space.low[0], space.high[0], dtype=np.float32)
