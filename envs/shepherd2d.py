"""`npa/Shepherd2D-v0`: the agent moves, turns or reshapes one grown picture, with brushes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import torch
from gymnasium.spaces import Box, Dict
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.checks import check_field, check_non_negative, check_positive
from npa_envs.envs.core.base import to_output
from npa_envs.envs.core.task import Start
from npa_envs.envs.core.vector import vector_class
from npa_envs.envs.garden.base import GardenEnv, GardenTask, moments_of
from npa_envs.envs.garden.brush_actions import OBSERVATION_LIMIT, BrushSpaces, GardenConfig
from npa_envs.tasks.seeds import uniform_ball
from npa_envs.world.environment_steps import Physics
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import WorldRandom

Aim = Literal["move", "turn", "reshape"]


@dataclass(frozen=True, kw_only=True)
class Shepherd2DEnvConfig(GardenConfig):
    """`GardenConfig` with the goals of a grown picture, the creature."""

    choices = GardenConfig.choices | {"aim": get_args(Aim)}

    reward: str = "dense"
    """"dense": minus the distance to the goal; "sparse": 0 at the goal and -1 elsewhere."""

    place_count: int = 2
    place_reach: float = 0.4
    push_length: float = 0.1

    aim: Aim = "move"
    """Kind of goals: "move" the mean of all particles to a position, "turn" the creature's longer
    axis by an angle, or "reshape" its width and height."""

    goal_reach: float = 0.6
    """Maximum distance of goals from the creature's start: length units to "move", the tangent of
    an angle to "turn", a fraction of width and height to "reshape"."""

    tolerance: float = 0.1
    """Distance at which a goal is reached; to "turn", between (cos 2φ, sin 2φ) of both angles φ."""

    lost_limit: float = 0.5
    """Maximum lost fraction of a creature that counts as intact (dimensionless)."""

    reward_weight: float = 1.0
    """Weight in the dense reward of the fraction lost beyond `lost_limit` (dimensionless)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self, float, "goal_reach", "tolerance", "lost_limit")
        check_non_negative(self, "reward_weight")
        is_small = self.aim == "move" or self.goal_reach <= 0.9
        check_field(self, "goal_reach", is_small, f"be at most 0.9 to {self.aim}")


class GoalBrushes(BrushSpaces):
    """`BrushSpaces` whose observations are Gymnasium's dictionaries with goals."""

    def __init__(self, physics: Physics, config: Shepherd2DEnvConfig) -> None:
        super().__init__(physics, config)
        box = self.observation_space
        assert box.shape is not None, "a box has a shape"
        goal = Box(-OBSERVATION_LIMIT, OBSERVATION_LIMIT, (3,), np.float32)
        self._count = box.shape[0]
        self.observation_space = Dict(
            {"observation": box, "achieved_goal": goal, "desired_goal": goal}
        )

    def observation_output(self, observation: Tensor) -> Any:
        """Return observations, [..., O + 6], as a dictionary with both goals, [..., 3] each."""
        observed, achieved, desired = torch.split(observation, [self._count, 3, 3], dim=-1)
        # In the order of the space, which sorts its keys.
        parts = {"achieved_goal": achieved, "desired_goal": desired, "observation": observed}
        return {name: to_output(part.contiguous(), self._output) for name, part in parts.items()}


class ShepherdEpisode(NamedTuple):
    """The `context` of B episodes: `StartLosses`, the creature's goal, its moments at the start."""

    intact_loss: Tensor
    rise: Tensor
    goal: Tensor
    """First two values of the desired goal, shape [B, 2]."""
    moments: Tensor
    """The creature's `moments_of` at the start, shape [B, 5]."""
    achieved: Tensor
    """Goals that the current particles achieve, shape [B, 3]."""


class ShepherdTask(GardenTask[Shepherd2DEnvConfig]):
    """The task of bringing a grown picture, the creature, to a position, an angle or a shape."""

    config_type = Shepherd2DEnvConfig
    spaces_type = GoalBrushes
    # With "sparse" each step away from the goal is rewarded with -1.
    rewards_last_step_only = False

    def episode_context(self, start: Start, loss: Tensor, random: WorldRandom) -> ShepherdEpisode:
        """Return losses and moments of the creatures at `start`, and a random goal of each."""
        moments, reach = moments_of(start.x), self.config.goal_reach
        drawn = uniform_ball(len(loss), 1, 2, reach, generator=random, device=self.device)[:, 0]
        if self.config.aim == "move":
            goal = moments[:, :2] + drawn
        elif self.config.aim == "turn":
            goal = double_angle(drawn[:, :1])
        else:
            goal = 1.0 + drawn
        intact = super().episode_context(start, loss, random)
        achieved = goal.new_zeros(len(goal), 3)
        return ShepherdEpisode(intact.intact_loss, intact.rise, goal, moments, achieved)

    def measured(self, particles: Particles, context: ShepherdEpisode) -> ShepherdEpisode:
        """Return the context with the goals that `particles` achieve."""
        return context._replace(achieved=self.achieved(particles, context))

    def achieved(self, particles: Particles, context: ShepherdEpisode) -> Tensor:
        """Return achieved goals, [B, 3]: two values by `aim`, and lost fractions (0: intact)."""
        x, s, *_ = particles
        first, now = context.moments, moments_of(x)
        if self.config.aim == "move":
            values, aligned = now[:, :2], x
        elif self.config.aim == "turn":
            values = axis_turn(first, now)
            aligned = turned_back(x, now[:, :2], values)
        else:
            values = (now[:, 2::2] / first[:, 2::2]).sqrt()
            middle = now[:, None, :2]
            aligned = middle + (x - middle) / values[:, None]
        loss = sum(self.losses(aligned, s).values(), torch.zeros_like(values[:, 0]))
        return torch.cat((values, self.lost_fraction(loss, context)[:, None]), dim=1)

    def desired(self, context: ShepherdEpisode) -> Tensor:
        """Return the desired goals, [B, 3]: two values that `aim` names, and `lost_limit`."""
        limit = torch.full_like(context.goal[:, :1], self.config.lost_limit)
        return torch.cat((context.goal, limit), dim=1)

    def goal_reward(self, achieved: Tensor, desired: Tensor) -> Tensor:
        """Return the rewards, [...], for goals that were achieved and desired, [..., 3] each."""
        distance = (achieved[..., :2] - desired[..., :2]).square().sum(dim=-1).sqrt()
        excess = achieved[..., 2] - desired[..., 2]
        if self.config.reward == "sparse":
            return ((distance <= self.config.tolerance) & (excess <= 0.0)) * 1.0 - 1.0
        # No division: CUDA replaces it by a product with the inverse, which rounds differently.
        nearness = -distance * (1.0 / self.config.goal_reach)
        return nearness - self.config.reward_weight * excess.clamp(min=0.0)

    def reward(self, particles: Particles, loss: Tensor, context: ShepherdEpisode) -> Tensor:
        """Return the rewards of a step, [B], for the achieved goals of `context`."""
        return self.goal_reward(context.achieved, self.desired(context)).to(torch.float32)

    def context_info(self, particles: Particles, context: ShepherdEpisode) -> dict[str, Tensor]:
        """Return `is_success`, `distance` to the goal and `lost` fraction, [B] each."""
        achieved, desired = context.achieved, self.desired(context)
        distance = (achieved - desired)[:, :2].square().sum(dim=1).sqrt()
        success = (distance <= self.config.tolerance) & (achieved[:, 2] <= desired[:, 2])
        return {"is_success": success, "distance": distance, "lost": achieved[:, 2].clone()}

    def observe(self, particles: Particles, loss: Tensor, context: ShepherdEpisode) -> Tensor:
        """Return the observation, then the achieved and the desired goal, [B, O + 6]."""
        observed = super().observe(particles, loss, context)
        goals = torch.cat((context.achieved, self.desired(context)), dim=1)
        return torch.cat((observed, goals.clamp(-OBSERVATION_LIMIT, OBSERVATION_LIMIT)), dim=1)


def double_angle(tangent: Tensor) -> Tensor:
    """Return (cos 2φ, sin 2φ), [B, 2], of the angles φ with these tangents, [B, 1]."""
    # Without library functions, whose last bit changes with the number of worlds.
    square = tangent * tangent
    return torch.cat((1.0 - square, 2.0 * tangent), dim=1) / (1.0 + square)


def axis_turn(first: Tensor, now: Tensor) -> Tensor:
    """Return (cos 2φ, sin 2φ), [B, 2]; φ: angle of the longer axes of two `moments_of`."""

    def axis(moments: Tensor) -> tuple[Tensor, Tensor]:
        across, slant = moments[:, 2] - moments[:, 4], 2.0 * moments[:, 3]
        length = (across * across + slant * slant).sqrt().clamp_min(1e-12)
        return across / length, slant / length

    (a, b), (c, d) = axis(first), axis(now)
    return torch.stack((a * c + b * d, a * d - b * c), dim=1)


def turned_back(x: Tensor, middle: Tensor, turn: Tensor) -> Tensor:
    """Return positions rotated about `middle`, [B, 2], by −φ; `turn`: (cos 2φ, sin 2φ), [B, 2]."""
    cosine = (0.5 * (1.0 + turn[:, 0])).clamp_min(0.0).sqrt()[:, None]
    sine = (0.5 * (1.0 - turn[:, 0])).clamp_min(0.0).sqrt()[:, None]
    sine = torch.where(turn[:, 1:] < 0.0, -sine, sine)
    across, up = (x - middle[:, None]).unbind(dim=-1)
    back = torch.stack((cosine * across + sine * up, cosine * up - sine * across), dim=-1)
    return middle[:, None] + back


class _GoalReward:
    """Mixin with `compute_reward`, which Hindsight Experience Replay calls."""

    task: Any

    def compute_reward(
        self, achieved_goal: Any, desired_goal: Any, info: Mapping[str, Any] | Any
    ) -> NDArray[np.float64] | Any:
        """Return the rewards, [...], for any achieved and desired goals, [..., 3] each."""
        # By torch, as in steps: NumPy's square roots round differently on some processors.
        goals = (torch.tensor(np.asarray(goal)) for goal in (achieved_goal, desired_goal))
        rewards: NDArray[Any] = self.task.goal_reward(*goals).numpy()
        return rewards


class Shepherd2DEnv(_GoalReward, GardenEnv):
    """Bring a grown creature to a goal while it stays intact.

    ## Description

    A trained rule has grown a picture, the creature, from N particles and keeps stepping them. The
    agent brings it to a goal by brushes on a grid that moves with the creature; they push, or have
    the effects of other `tools`. Too hard a push tears it; the rule heals what it can. Observations
    are those of goal-conditioned environments, with `compute_reward` for other goals, so Hindsight
    Experience Replay works, for example Stable-Baselines3's `HerReplayBuffer`.

    ## Observation space

    `Dict` of three boxes of float32:

    | Key | Shape | Value |
    |---|---|---|
    | `observation` | [6 P²], or as `observe` says | the observation below |
    | `achieved_goal` | [3] | two values of the creature, and its lost fraction |
    | `desired_goal` | [3] | the same two values of the goal, and `lost_limit` |

    | `aim` | First two values of goals | Unit |
    |---|---|---|
    | `"move"` | mean x and y of all particles | lengths |
    | `"turn"` | cosine and sine of 2φ; φ is how far the longer axis has turned | dimensionless |
    | `"reshape"` | width and height, as multiples of those at the start | dimensionless |

    The third value, the lost fraction, is (L − L₀) / (L₁ − L₀): 0 for an intact creature, 1 for one
    as bad as grey, as in `npa/Gardener2D-v0`. Before it is compared with the target the creature is
    moved, turned or stretched back. The longer axis, width and height are those of the second
    moments of positions.

    Of the entry `observation`:

    ## Reward

    d is the distance of the achieved goal's first two values from the desired ones. The creature
    is intact while its lost fraction is at most `lost_limit`.

    | `reward` | Reward of a step |
    |---|---|
    | `"dense"` | −d / `goal_reach` − `reward_weight` times the fraction lost beyond `lost_limit` |
    | `"sparse"` | 0 where d is at most `tolerance` and the creature is intact, else −1 |

    Both reward each step. `env.unwrapped.compute_reward(achieved_goal, desired_goal, info)`
    returns the same, for one goal or many. `HerReplayBuffer` finds it in `gym.make(id)`;
    Stable-Baselines3's `check_env` needs `env.unwrapped`.

    ## Starting state

    The rule has grown an intact creature in `grow_steps` steps from a disk of grey particles. With
    the default `seed_pool=16` there are sixteen grown worlds. Each episode draws its goal uniformly
    in a disk of radius `goal_reach` around the creature's own position or shape; tangents of angles
    are at most `goal_reach`.

    ## Episode end

    `success_loss` is None by default: a creature at its goal has to stay there.

    ## Info

    | Key | In | Value |
    |---|---|---|
    | `is_success` | reset, step | whether the creature is at its goal and intact, bool |
    | `distance` | reset, step | d |
    | `lost` | reset, step | the lost fraction |

    All else is as in other environments with brushes:
    """

    task_type = ShepherdTask


Shepherd2DVectorEnv = vector_class(Shepherd2DEnv, _GoalReward)
