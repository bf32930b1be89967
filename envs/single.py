"""One world as a Gymnasium environment."""

from __future__ import annotations

import warnings
from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.envs.arrays import checked_action, to_output
from npa_envs.envs.spaces import action_space, observation_space
from npa_envs.envs.task import EnvTask, Start
from npa_envs.envs.worlds import DIVERGED, SUCCESS, Worlds, reason
from npa_envs.render import Window


class NPAEnv(gymnasium.Env[Any, Any]):
    """One world of a task; subclasses name the task, and their docstrings are its documentation.

    Args:
        keywords: Fields of the task's configuration.

    Raises:
        NPAError: A keyword is unknown or wrong, or the world does not fit into memory.
    """

    task_type: ClassVar[type[EnvTask[Any]]]
    """What the environment is about."""

    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]
        "render_modes": ["rgb_array", "human"],
        "render_fps": 25,
    }

    def __init__(self, **keywords: Any) -> None:
        self.config = self.task_type.config_type.from_keywords(keywords)
        self.render_mode = self.config.render_mode
        self.worlds = Worlds(self.task_type, self.config, 1)
        self.task = self.worlds.task
        self.observation_space = observation_space(self.worlds.physics, self.config.particle_count)
        self.action_space = action_space(self.worlds.physics, self.config.particle_count)
        self._world = torch.zeros(1, dtype=torch.int64, device=self.task.device)
        self._keyed_from: np.random.Generator | None = None
        self._unpaid_steps = 0
        self._window: Window | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Begin the sequence of episodes that belongs to this number; without it the
                sequence goes on.
            options: Not used.

        Returns:
            The observation, shape [N, P], and the loss with its parts.
        """
        super().reset(seed=seed)
        self._warn_of_unpaid_rewards()
        # A generator that is not the one of the last episode means a new sequence, be it by `seed`
        # or because the caller put another one into `np_random`.
        keys = None
        if seed is not None or self.np_random is not self._keyed_from:
            self._keyed_from = self.np_random
            keys = torch.from_numpy(
                self.np_random.integers(2**64, size=1, dtype=np.uint64).view(np.int64)
            )
        observation = self.worlds.start(self._world, keys)
        self._show()
        return to_output(observation[0], self.config.output), self._losses()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Apply an action and perceive.

        Args:
            action: Shape [N, A], in [-1, 1].

        Returns:
            Observation, reward, whether the episode ended by itself, False (the step limit is
            Gymnasium's own), and what the docstring of the environment lists.

        Raises:
            NPAError: The action has another shape or is not finite; the world is then as it was.
        """
        shape = (1, self.config.particle_count, self.worlds.physics.action_dim)
        ending = int(self.worlds.step(checked_action(action, shape, batched=False))[0])
        observation = self.worlds.observation()[0]
        ended = ending & (SUCCESS | DIVERGED) != 0
        info = self._losses()
        names, numbers = self.worlds.part_names, self.worlds.numbers[:, 0].tolist()
        info |= {f"reward_{name}": numbers[2 + len(names) + k] for k, name in enumerate(names)}
        info |= {"success": bool(ending & SUCCESS), "diverged": bool(ending & DIVERGED)}
        if ended:
            info["reason"] = reason(ending)
        if self.worlds.particle_reward is not None:
            own = self.worlds.particle_reward[0].clone()
            info["particle_reward"] = to_output(own, self.config.output)
        paid = ended or int(self.worlds.elapsed[0]) >= self.config.episode_steps
        self._unpaid_steps = 0 if paid else self._unpaid_steps + 1
        self._show()
        return to_output(observation, self.config.output), numbers[0], ended, False, info

    def render(self) -> NDArray[np.uint8] | None:
        """Return the world's picture, shape [R, R, 3], in the mode "rgb_array"."""
        if self.render_mode is None:
            gymnasium.logger.warn(
                "render() draws nothing without a render_mode: make the environment with "
                "render_mode='rgb_array' or 'human'"
            )
            return None
        if self.render_mode == "human":
            self._show()
            return None
        return self._picture()

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def particles(self) -> tuple[Tensor, Tensor]:
        """Return copies of positions [length units], [N, D], and states, [N, C], on the device."""
        return self.worlds.x[0].clone(), self.worlds.s[0].clone()

    def place_particles(self, x: Tensor, s: Tensor) -> Any:
        """Replace the particles, at no reward, and return the new observation, shape [N, P].

        Args:
            x: Positions [length units], shape [N, D].
            s: States, dimensionless, shape [N, C].
        """
        observation = self.worlds.place(self._world, Start(x[None], s[None]))
        return to_output(observation[0], self.config.output)

    def _losses(self) -> dict[str, Any]:
        loss, *rest = self.worlds.numbers[1:, 0].tolist()
        names = self.worlds.part_names
        return {"loss": loss} | {f"loss_{n}": v for n, v in zip(names, rest, strict=False)}

    def _picture(self) -> NDArray[np.uint8]:
        worlds = self.worlds
        picture: NDArray[np.uint8]
        (picture,) = self.task.draw(worlds.x, worlds.s, worlds.elapsed.cpu().numpy())
        return picture

    def _show(self) -> None:
        if self.render_mode != "human":
            return
        if self._window is None:
            title = self.spec.id if self.spec is not None else type(self).__name__
            self._window = Window(title, self.config.render_size, fps=self.metadata["render_fps"])
        self._window.show(self._picture())

    def _warn_of_unpaid_rewards(self) -> None:
        if self.config.reward == "sparse" and self._unpaid_steps > 0:
            warnings.warn(
                f"an episode of {self._unpaid_steps} steps was cut off before its sparse reward, "
                f"which comes at step {self.config.episode_steps}: make the environment with "
                f"episode_steps={self._unpaid_steps} as well as max_episode_steps",
                stacklevel=3,
            )
        self._unpaid_steps = 0
