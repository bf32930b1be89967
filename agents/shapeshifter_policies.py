"""A scripted policy for `npa/Shapeshifter2D-v0`, whose agent chooses a rule's codes."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from npa_envs.agents.policies import unwrapped
from npa_envs.envs.shapeshifter2d import PictureGoals, ShapeshifterTask
from npa_envs.errors import NPAError
from npa_envs.world.particles import Particles


class RecognisingShapeshifter:
    """Choose the code whose picture is most like the goal's picture in the observation.

    `env`, `npa/Shapeshifter2D-v0` of any form, has the picture of each code.
    """

    def __init__(self, env: Any) -> None:
        inner = unwrapped(env)
        task = inner.worlds.task
        if not isinstance(task, ShapeshifterTask):
            raise NPAError(
                f"env must be one whose agent chooses codes, got {type(task).__name__}: make it "
                "with gymnasium.make('npa/Shapeshifter2D-v0')"
            )
        self._chosen = task.config.actions == "choice"
        self._actions = inner.spaces.actions_of_codes()
        goals = torch.arange(len(task.codes), device=task.device)
        x = torch.zeros(len(goals), 1, 2, device=task.device)
        s = x.new_zeros(len(goals), 1, task.config.state_dim)
        # The second half of an observation is the goal's picture.
        observation = task.observe(Particles(x, s), x[:, 0, 0], PictureGoals(goals, goals[:, None]))
        self._goals = observation.chunk(2, dim=1)[1].cpu()

    def __call__(self, observation: Any) -> Any:
        """Return the action for an observation [8 G²], with G² grid cells, or B for [B, 8 G²]."""
        array = torch.as_tensor(observation).cpu()
        goal = array.unflatten(-1, (2, -1))[..., 1, :]  # type: ignore[no-untyped-call]
        away = (goal[..., None, :] - self._goals).square().sum(dim=-1)
        number = away.argmin(dim=-1)
        action = number if self._chosen else self._actions[number]
        return action.to(observation.device) if isinstance(observation, Tensor) else action.numpy()
