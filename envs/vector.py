"""Many worlds as one Gymnasium vector environment, batched on the device."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch
from gymnasium import Space
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.envs.arrays import checked_action, to_output
from npa_envs.envs.spaces import action_space, observation_space
from npa_envs.envs.task import EnvTask, Start
from npa_envs.envs.vector_options import autoreset_mode as checked_mode
from npa_envs.envs.vector_options import check_count, world_keys, worlds_to_reset
from npa_envs.envs.worlds import FLAGS, Worlds, reason
from npa_envs.errors import NPAError
from npa_envs.render import Window

SHOWN_ACROSS = 4
"""A window shows at most so many worlds side by side."""


class NPAVectorEnv(VectorEnv[Any, Any, Any]):
    """B worlds of a task, stepped together; subclasses name the task.

    World k, reset with `seed`, is the single environment reset with `seed + k`, bit for bit.

    Args:
        num_envs: Worlds B.
        max_episode_steps: Steps after which an episode is truncated, or None for never.
        autoreset_mode: "same-step": the step that ends an episode returns the next one's first
            observation, the last one is in `infos["final_obs"]`; "next-step": the next step does,
            whatever its action; "disabled": `reset(options={"reset_mask": ...})` does.
        copy: Hand out new arrays; False: the same ones in each step, overwritten by the next.
        keywords: Fields of the task's configuration.

    Raises:
        NPAError: A keyword is unknown or wrong, or the worlds do not fit into memory.
    """

    task_type: ClassVar[type[EnvTask[Any]]]
    """What the environment is about."""

    metadata: dict[str, Any] = {  # noqa: RUF012 (each instance gets a dictionary of its own)
        "render_modes": ["rgb_array", "human"],
        "render_fps": 25,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        *,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = "same-step",
        copy: bool = True,
        **keywords: Any,
    ) -> None:
        check_count("num_envs", num_envs)
        if max_episode_steps is not None:
            check_count("max_episode_steps", max_episode_steps)
        self.autoreset_mode = checked_mode(autoreset_mode)
        self.metadata = {**type(self).metadata, "autoreset_mode": self.autoreset_mode}
        self.config = self.task_type.config_type.from_keywords(keywords)
        self.render_mode = self.config.render_mode
        self.num_envs = num_envs
        self.worlds = Worlds(self.task_type, self.config, num_envs, max_episode_steps)
        self.task = self.worlds.task
        physics, count = self.worlds.physics, self.config.particle_count
        self.single_observation_space = observation_space(physics, count)
        self.single_action_space = action_space(physics, count)
        self._copy = copy
        self._observation: Tensor | None = None
        self._ended = np.zeros(num_envs, dtype=bool)
        self._window: Window | None = None
        self._everyone = self._mask(np.ones(num_envs, dtype=bool))

    @cached_property
    def observation_space(self) -> Space[Any]:  # type: ignore[override]
        """Observations of all worlds, shape [B, N, P]; made when asked for, as it is large."""
        return batch_space(self.single_observation_space, self.num_envs)

    @cached_property
    def action_space(self) -> Space[Any]:  # type: ignore[override]
        """Actions of all worlds, shape [B, N, A]; made when asked for, as it is large."""
        return batch_space(self.single_action_space, self.num_envs)

    def reset(
        self,
        *,
        seed: int | Sequence[int] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Start episodes.

        Args:
            seed: Begin the sequences of episodes of seed, seed + 1, ..., or of the seeds in a list;
                without it the sequences go on.
            options: `{"reset_mask": mask}` resets only the worlds where the mask, bool, shape [B],
                is True; the others are left as they are, bit for bit.

        Returns:
            Observations of all worlds, shape [B, N, P], and the losses with their parts.

        Raises:
            NPAError: The mask or the seeds have a wrong shape.
        """
        super().reset(seed=seed if isinstance(seed, int) else None)
        chosen = worlds_to_reset(options, self.num_envs)
        worlds = torch.from_numpy(chosen).to(self.task.device)
        keys = None
        if seed is not None or self._observation is None:
            keys = world_keys(seed, self.num_envs, self.np_random)[chosen]
        if self._observation is None and len(chosen) < self.num_envs:
            raise NPAError("reset_mask needs worlds to leave alone: reset all of them first")
        started = self.worlds.start(worlds, keys)
        self._observation = self._with(worlds, started)
        self._ended[chosen] = False
        self._show()
        return self._out(self._observation), self._losses(self.worlds.numbers.clone())

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Apply an action to each world and perceive.

        Args:
            actions: Shape [B, N, A], in [-1, 1].

        Returns:
            Observations [B, N, P], rewards [B], terminations [B], truncations [B], and infos.

        Raises:
            NPAError: The actions have another shape or are not finite; the worlds are then as they
                were.
        """
        if self._observation is None:
            raise NPAError("step needs worlds: call reset first")
        shape = (self.num_envs, self.config.particle_count, self.worlds.physics.action_dim)
        endings = self.worlds.step(checked_action(actions, shape, batched=True))
        observation = self.worlds.observation(None if self._copy else self._observation)
        stepped = None
        if self.autoreset_mode is AutoresetMode.NEXT_STEP and self._ended.any():
            stepped = ~self._ended
            endings[self._ended] = 0
            self._restart(self._ended, observation)
        ended = endings != 0
        restarting = self.autoreset_mode is AutoresetMode.SAME_STEP and bool(ended.any())
        # What a restart overwrites is copied first, whatever the caller wants of the rest.
        numbers, flags, infos = self._report(stepped, copy=self._copy or restarting)
        if restarting:
            which, final_observation = self._mask(ended), observation.clone()
            final_infos = self._ending_infos(infos, endings, which)
            self._restart(ended, observation)
            _, _, infos = self._report(~ended, copy=self._copy)
            infos |= {"final_obs": self._out(final_observation), "_final_obs": which}
            infos |= {"final_info": final_infos, "_final_info": which}
        self._ended, self._observation = ended, observation
        self._show()
        terminations, truncations = self._out(flags[0]), self._out(flags[1])
        return self._out(observation), self._out(numbers[0]), terminations, truncations, infos

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return a picture of each world, shape [R, R, 3], in the mode "rgb_array"."""
        if self.render_mode is None:
            gymnasium.logger.warn(
                "render() draws nothing without a render_mode: make the environment with "
                "render_mode='rgb_array' or 'human'"
            )
            return None
        if self.render_mode == "human":
            self._show()
            return None
        return tuple(self._pictures(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def particles(self) -> tuple[Tensor, Tensor]:
        """Return copies of positions [length units], [B, N, D], and states, [B, N, C]."""
        return self.worlds.x.clone(), self.worlds.s.clone()

    def place_particles(self, x: Tensor, s: Tensor, worlds: Tensor | None = None) -> Any:
        """Replace particles, at no reward, and return the new observations of all worlds.

        Args:
            x: Positions [length units], shape [M, N, D].
            s: States, dimensionless, shape [M, N, C].
            worlds: Which worlds, int64, shape [M]; None: all of them.
        """
        if self._observation is None:
            raise NPAError("particles need worlds: call reset first")
        if worlds is None:
            worlds = torch.arange(self.num_envs, device=self.task.device)
        self._observation = self._with(worlds, self.worlds.place(worlds, Start(x, s)))
        return self._out(self._observation)

    def _with(self, worlds: Tensor, observation: Tensor) -> Tensor:
        """Return the observations of all worlds with those of some of them replaced."""
        if self._observation is None or (self._copy and len(worlds) == self.num_envs):
            return observation
        last = self._observation.clone() if self._copy else self._observation
        return last.index_copy_(0, worlds, observation)

    def _restart(self, ended: NDArray[np.bool_], observation: Tensor) -> None:
        worlds = torch.from_numpy(np.flatnonzero(ended)).to(self.task.device)
        observation[worlds] = self.worlds.start(worlds)

    def _report(
        self, stepped: NDArray[np.bool_] | None, *, copy: bool
    ) -> tuple[Tensor, Tensor, dict[str, Any]]:
        """Return numbers, flags and infos as they are.

        Args:
            stepped: Worlds that have a step behind them; None: all of them.
            copy: Make new tensors, which later steps and restarts leave alone.
        """
        worlds = self.worlds
        numbers, flags = worlds.numbers, worlds.flags
        if copy:
            numbers, flags = numbers.clone(), flags.clone()
        infos = self._losses(numbers)
        mask = self._everyone if stepped is None else self._mask(stepped)
        first = 2 + len(worlds.part_names)
        own = dict(zip((f"reward_{n}" for n in worlds.part_names), numbers[first:], strict=True))
        own |= dict(zip(FLAGS, flags[2:], strict=True))
        if worlds.particle_reward is not None:
            shares = worlds.particle_reward
            own["particle_reward"] = shares.clone() if copy else shares
        for name, value in own.items():
            infos[name], infos[f"_{name}"] = self._out(value), mask
        return numbers, flags, infos

    def _losses(self, numbers: Tensor) -> dict[str, Any]:
        infos = {"loss": self._out(numbers[1]), "_loss": self._everyone}
        for k, name in enumerate(self.worlds.part_names):
            infos[f"loss_{name}"] = self._out(numbers[2 + k])
            infos[f"_loss_{name}"] = self._everyone
        return infos

    def _ending_infos(
        self, infos: dict[str, Any], endings: NDArray[np.uint8], which: Any
    ) -> dict[str, Any]:
        """Return the last infos of the worlds whose episodes are over, with the reasons."""
        final = {name: which if name.startswith("_") else value for name, value in infos.items()}
        reasons = np.array([reason(int(ending)) for ending in endings], dtype=object)
        return final | {"reason": reasons, "_reason": which}

    def _out(self, tensor: Tensor) -> Any:
        return to_output(tensor, self.config.output)

    def _mask(self, mask: NDArray[np.bool_]) -> Any:
        if self.config.output == "numpy":
            return mask
        return torch.from_numpy(mask).to(self.task.device)

    def _pictures(self, count: int) -> NDArray[np.uint8]:
        worlds = self.worlds
        steps = worlds.elapsed[:count].cpu().numpy()
        return self.task.draw(worlds.x[:count], worlds.s[:count], steps)

    def _show(self) -> None:
        """Show the first worlds side by side."""
        if self.render_mode != "human":
            return
        across = min(math.ceil(math.sqrt(self.num_envs)), SHOWN_ACROSS)
        shown = min(self.num_envs, across * across)
        size = self.config.render_size
        frame = np.full((across * across, size, size, 3), 255, np.uint8)
        frame[:shown] = self._pictures(shown)
        frame = frame.reshape(across, across, size, size, 3).swapaxes(1, 2)
        if self._window is None:
            title = self.spec.id if self.spec is not None else type(self).__name__
            self._window = Window(title, across * size, fps=self.metadata["render_fps"])
        self._window.show(frame.reshape(across * size, across * size, 3))
