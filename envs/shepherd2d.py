"""`npa/Shepherd2D-v0`: move, turn or reshape a grown creature to a goal while it stays whole."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import torch
from gymnasium.spaces import Box, Dict
from numpy.typing import NDArray
from torch import Tensor

from npa_envs import world_mean
from npa_envs.checks import check_non_negative, check_positive
from npa_envs.envs.core.base import to_output
from npa_envs.envs.core.task import Start
from npa_envs.envs.core.vector import NPAVectorEnv
from npa_envs.envs.garden.brushes import OBSERVATION_LIMIT, BrushSpaces, GardenConfig, GardenReward
from npa_envs.envs.garden.task import GardenEnv, GardenTask, intact_context, lost_fraction
from npa_envs.errors import NPAError
from npa_envs.tasks.seeds import uniform_ball
from npa_envs.world.actions import Physics
from npa_envs.world.randomness import WorldRandom

Aim = Literal["move", "turn", "reshape"]


@dataclass(frozen=True, kw_only=True)
class Shepherd2DEnvConfig(GardenConfig):
    """What a creature is to come to."""

    words = GardenConfig.words | {"aim": get_args(Aim)}

    episode_steps: int = 32

    reward: GardenReward = "dense"
    """"dense": minus the distance to the goal; "sparse": 0 at the goal and -1 elsewhere."""

    place_count: int = 2

    place_reach: float = 0.4

    push_length: float = 0.1

    aim: Aim = "move"
    """What is asked for: to "move" the mean of all particles to a place, to "turn" the creature's
    longer axis, or to "reshape" it, wider or narrower and higher or lower."""

    goal_reach: float = 0.6
    """How far goals are from where a creature begins: at most this [length units, radians, or as a
    share of width and height]."""

    tolerance: float = 0.1
    """A goal is reached within this, in the same unit."""

    lost_limit: float = 0.5
    """A creature counts as whole as long as it has lost at most this share (dimensionless)."""

    reward_weight: float = 1.0
    """Weight of what is lost beyond `lost_limit`, where the reward is dense (dimensionless)."""

    def __post_init__(self) -> None:
        """Check every field."""
        super().__post_init__()
        check_positive(self, float, "goal_reach", "tolerance", "lost_limit")
        check_non_negative(self, "reward_weight")
        if self.aim != "move" and self.goal_reach > 0.9:
            raise NPAError(f"goal_reach must be at most 0.9 to {self.aim}, got {self.goal_reach}")


class GoalBrushes(BrushSpaces):
    """As `BrushSpaces`, with what is seen, achieved and desired as a dictionary."""

    def __init__(self, physics: Physics, config: Shepherd2DEnvConfig) -> None:
        super().__init__(physics, config)
        seen = self.observation_space
        assert seen.shape is not None, "a box has a shape"
        goal = Box(-OBSERVATION_LIMIT, OBSERVATION_LIMIT, (3,), np.float32)
        self._seen_count = seen.shape[0]
        self.observation_space = Dict(
            {"observation": seen, "achieved_goal": goal, "desired_goal": goal}
        )

    def returned(self, observation: Tensor) -> Any:
        """Return observations of worlds, or of one, as they are handed out."""
        count = self._seen_count
        parts = torch.split(observation, [count, 3, 3], dim=-1)
        names = ("observation", "achieved_goal", "desired_goal")
        return {
            name: to_output(part.contiguous(), self._output)
            for name, part in zip(names, parts, strict=True)
        }

    def returned_final(self, observation: Tensor, ended: NDArray[np.bool_]) -> Any:
        """Return the last observations as Gymnasium has them: an array of dictionaries, or None."""
        batched = self.returned(observation)
        if self._output == "torch":
            return batched
        last = np.full(len(ended), None, dtype=object)
        for k in np.flatnonzero(ended):
            last[k] = {name: value[k] for name, value in batched.items()}
        return last


class ShepherdTask(GardenTask[Shepherd2DEnvConfig]):
    """A creature that is to come to a place, an angle or a shape."""

    config_type = Shepherd2DEnvConfig
    form_type = GoalBrushes
    # What it is when whole, the goal, then how it lay at the start: mean and second moments.
    context_count = 2 + 2 + 5
    rewards_each_step = True

    def episode_context(self, start: Start, loss: Tensor, random: WorldRandom) -> Tensor:
        """Return what is whole, the goal, and how the creature lies at its start."""
        lies = lie_of(start.x)
        reach, width = self.config.goal_reach, 2
        places = uniform_ball(len(loss), 1, width, reach, generator=random, device=self.device)
        drawn = places[:, 0]
        if self.config.aim == "move":
            goal = lies[:, :2] + drawn
        elif self.config.aim == "turn":
            goal = direction(drawn[:, :1])
        else:
            goal = 1.0 + drawn
        return torch.cat((intact_context(self, start, loss), goal, lies), dim=1)

    def achieved(self, x: Tensor, s: Tensor, context: Tensor) -> Tensor:
        """Return what worlds have come to and what share of them is lost, shape [B, 3]."""
        first, now = context[:, 4:], lie_of(x)
        if self.config.aim == "move":
            got, undone = now[:, :2], x
        elif self.config.aim == "turn":
            got = axis_turn(first, now)
            undone = turned_back(x, now[:, :2], got)
        else:
            got = (now[:, (2, 4)] / first[:, (2, 4)]).sqrt()
            middle = now[:, None, :2]
            undone = middle + (x - middle) / got[:, None]
        loss = sum(self.losses(undone, s).values(), torch.zeros_like(got[:, 0]))
        return torch.cat((got, lost_fraction(loss, context)[:, None]), dim=1)

    def desired(self, context: Tensor) -> Tensor:
        """Return what worlds are to come to, and the share that may be lost, shape [B, 3]."""
        return torch.cat(
            (context[:, 2:4], torch.full_like(context[:, :1], self.config.lost_limit)), 1
        )

    def goal_reward(self, achieved: Tensor, desired: Tensor) -> Tensor:
        """Return rewards, shape [...], of what was achieved and desired, [..., 3]."""
        away = (achieved[..., :2] - desired[..., :2]).square().sum(dim=-1).sqrt()
        excess = achieved[..., 2] - desired[..., 2]
        if self.config.reward == "sparse":
            return ((away <= self.config.tolerance) & (excess <= 0.0)) * 1.0 - 1.0
        # No division: CUDA multiplies by the inverse instead, which is rounded otherwise.
        nearness = -away * (1.0 / self.config.goal_reach)
        return nearness - self.config.reward_weight * excess.clamp(min=0.0)

    def reward(self, x: Tensor, s: Tensor, loss: Tensor, context: Tensor) -> Tensor:
        """Return what worlds are worth, shape [B]."""
        return self.goal_reward(self.achieved(x, s, context), self.desired(context)).to(
            torch.float32
        )

    def context_info(self, x: Tensor, s: Tensor, context: Tensor) -> dict[str, Tensor]:
        """Return whether worlds are at their goals and whole, and what share is lost."""
        achieved, desired = self.achieved(x, s, context), self.desired(context)
        away = (achieved - desired)[:, :2].square().sum(dim=1).sqrt()
        there = (away <= self.config.tolerance) & (achieved[:, 2] <= desired[:, 2])
        return {"is_success": there, "distance": away, "lost": achieved[:, 2]}

    def observe(self, x: Tensor, s: Tensor, loss: Tensor, context: Tensor) -> Tensor:
        """Return what is seen, then what is achieved, then what is desired, [B, O + 6]."""
        seen = super().observe(x, s, loss, context)
        goals = torch.cat((self.achieved(x, s, context), self.desired(context)), dim=1)
        return torch.cat((seen, goals.clamp(-OBSERVATION_LIMIT, OBSERVATION_LIMIT)), dim=1)


def lie_of(x: Tensor) -> Tensor:
    """Return mean x, y and, about it, the means of x², x y, y², shape [B, 5]."""
    mean = world_mean(x)
    across, up = (x - mean[:, None]).unbind(dim=-1)
    seconds = torch.stack((across * across, across * up, up * up), dim=-1)
    return torch.cat((mean, world_mean(seconds)), dim=1)


def direction(angle: Tensor) -> Tensor:
    """Return cosine and sine of twice an angle [radians], [B, 1], by its tangent, [B, 2]."""
    # Without library functions, whose last bit changes with the number of worlds; the tangent of
    # an angle is near enough to it for the spread of goals.
    square = angle * angle
    return torch.cat((1.0 - square, 2.0 * angle), dim=1) / (1.0 + square)


def axis_turn(first: Tensor, now: Tensor) -> Tensor:
    """Return cosine and sine of twice the angle by which the longer axis has turned, [B, 2]."""

    def axis(lie: Tensor) -> tuple[Tensor, Tensor]:
        across, slant = lie[:, 2] - lie[:, 4], 2.0 * lie[:, 3]
        length = (across * across + slant * slant).sqrt().clamp_min(1e-12)
        return across / length, slant / length

    (a, b), (c, d) = axis(first), axis(now)
    return torch.stack((a * c + b * d, a * d - b * c), dim=1)


def turned_back(x: Tensor, middle: Tensor, turn: Tensor) -> Tensor:
    """Return positions turned back about a middle by half of the turn that is given, [B, N, 2]."""
    cosine = (0.5 * (1.0 + turn[:, 0])).clamp_min(0.0).sqrt()[:, None]
    sine = (0.5 * (1.0 - turn[:, 0])).clamp_min(0.0).sqrt()[:, None]
    sine = torch.where(turn[:, 1:] < 0.0, -sine, sine)
    across, up = (x - middle[:, None]).unbind(dim=-1)
    back = torch.stack((cosine * across + sine * up, cosine * up - sine * across), dim=-1)
    return middle[:, None] + back


class _GoalReward:
    """What Hindsight Experience Replay asks of an environment."""

    task: Any

    def compute_reward(
        self, achieved_goal: Any, desired_goal: Any, info: Mapping[str, Any] | Any
    ) -> NDArray[np.float64] | Any:
        """Return the rewards of goals, be they those of the episode or others.

        Args:
            achieved_goal: What was achieved, shape [3] or [..., 3].
            desired_goal: What was desired, in the same shape.
            info: Not read.
        """
        # By torch, as episodes are paid: NumPy's roots are rounded otherwise on some processors.
        achieved = torch.tensor(np.asarray(achieved_goal))
        desired = torch.tensor(np.asarray(desired_goal))
        paid: NDArray[Any] = self.task.goal_reward(achieved, desired).numpy()
        return paid


class Shepherd2DEnv(_GoalReward, GardenEnv):
    """Lead a grown creature to a goal while it stays whole.

    ## Description

    A trained rule has grown a picture, a creature, from N particles and goes on running them. The
    agent brings it to a goal by brushes on a grid that moves with the creature; they push, or do
    what other `tools` of a gardener do. Too hard a push tears it; the rule heals what it can.

    Observations are those of goal-conditioned environments, with `compute_reward` for other goals,
    so Hindsight Experience Replay works, for example Stable-Baselines3's `HerReplayBuffer`.

    ## Observation space

    `Dict` of three boxes of float32:

    | Key | Shape | Value |
    |---|---|---|
    | `observation` | [6 P²], or as `observe` says | what is seen of the world |
    | `achieved_goal` | [3] | what the creature has come to, and the share that it has lost |
    | `desired_goal` | [3] | what it is to come to, and `lost_limit` |

    | `aim` | First two numbers of goals | Unit |
    |---|---|---|
    | `"move"` | mean x and y of all particles | lengths |
    | `"turn"` | cosine and sine of 2φ; φ is how far the longer axis has turned | dimensionless |
    | `"reshape"` | width and height, as multiples of those at the start | dimensionless |

    The third number is (L − L₀) / (L₁ − L₀): 0 of a whole creature, 1 of one as bad as grey, as in
    `npa/Gardener2D-v0`. Before it is compared with the target the creature is moved, turned or
    stretched back. The longer axis and sizes are those of the second moments of positions.

    What is seen of the world:

    ## Reward

    d is the distance of the achieved goal's first two numbers from the desired ones, and the
    creature is whole while its third number is at most `lost_limit`.

    | `reward` | Reward of a step |
    |---|---|
    | `"dense"` | −d / `goal_reach` − `reward_weight` times what is lost beyond `lost_limit` |
    | `"sparse"` | 0 where d is at most `tolerance` and the creature is whole, else −1 |

    Both are paid in each step. `env.unwrapped.compute_reward(achieved_goal, desired_goal, info)`
    returns the same, for one goal or many.

    ## Starting state

    The rule has grown a world for `grow_steps` steps from a disk of blank particles; it is whole.
    With the default `seed_pool=16` there are sixteen grown worlds. The goal is drawn anew for each
    episode, uniform in a disk of radius `goal_reach` around where the creature is, or in what
    shape; tangents of angles are at most `goal_reach`.

    ## Episode end

    `success_loss` is None by default: a creature that has arrived is to stay there.

    ## Info

    | Key | In | Value |
    |---|---|---|
    | `is_success` | reset, step | whether the creature is at its goal and whole, bool |
    | `distance` | reset, step | d |
    | `lost` | reset, step | the share that is lost |

    All else is as in other living worlds:
    """

    task_type = ShepherdTask


class Shepherd2DVectorEnv(_GoalReward, NPAVectorEnv):
    """Worlds of `Shepherd2DEnv`, batched on one device; its docstring describes both."""

    task_type = ShepherdTask
