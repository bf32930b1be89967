"""`npa/Shapeshifter2D-v0`: the agent chooses the code of a rule of many pictures.

The code decides which picture the rule grows; the goal picture changes from time to time.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete, Space
from torch import Tensor

from npa_envs.checks import check_positive
from npa_envs.envs.core.base import ParticleSpaces, batch_tensor
from npa_envs.envs.core.config import EnvConfig, check_picture_size
from npa_envs.envs.core.single import NPAEnv
from npa_envs.envs.core.task import Start
from npa_envs.envs.core.vector import vector_class
from npa_envs.envs.garden.base import coarse
from npa_envs.envs.garden.brush_actions import GARDEN_REWARDS, OBSERVATION_LIMIT
from npa_envs.envs.morphogenesis2d import PictureConfig
from npa_envs.envs.trained_rules import (
    OF_PARTICLES,
    RuleDrivenTask,
    check_matches_rule,
    grow,
    run_rule,
)
from npa_envs.errors import NPAError
from npa_envs.rule.files import load_rule
from npa_envs.rule.picture_codes import Codes
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.many_pictures import ManyPictures
from npa_envs.tasks.morphogenesis2d import Morphogenesis2DConfig
from npa_envs.training.task_of_rule import targets_of_codes
from npa_envs.world.environment_steps import Physics
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import WorldRandom

GOAL_COUNT = 8
"""Number of goals of an episode; the first one follows the last."""

CodeActions = Literal["code", "choice"]


@dataclass(frozen=True, kw_only=True)
class Shapeshifter2DEnvConfig(PictureConfig):
    """`PictureConfig` with the rule of many pictures, and how goals change."""

    fixed = PictureConfig.fixed | OF_PARTICLES
    choices = EnvConfig.choices | {"reward": GARDEN_REWARDS, "actions": get_args(CodeActions)}

    reward: str = "dense"
    """"dense": the closeness to the goal in each step; "sparse": that of the last step only."""

    particle_count: int = 256
    state_dim: int = 24
    eps: float = 0.2
    eps0: float = 0.2

    rule: str = "seven-pictures"
    """A rule of many pictures, by name or file; its pictures are the goals."""

    actions: CodeActions = "code"
    """Form of actions: "code", the vector of a code; "choice", the index of one of the rule's."""

    rule_steps: int = 8
    """Steps of the rule in one step of the environment."""

    hold_steps: int = 16
    """Steps of the environment after which the goal becomes another picture."""

    grow_steps: int = 64
    """Steps of the rule from the seed to the start of an episode."""

    picture_size: int = 8
    """Pixels on each side of the observed pictures, G; a divisor of `resolution`."""

    seed_pool: int = 16
    resolution: int = 32
    seed_radius: float = 0.4

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self, int, "rule_steps", "hold_steps", "grow_steps", "picture_size")
        check_picture_size(self)


def load_coded_rule(config: Shapeshifter2DEnvConfig, device: torch.device) -> tuple[NPARule, Codes]:
    """Return the rule of many pictures that `config.rule` names, and its codes."""
    rule = load_rule(config.rule, device=device).float().requires_grad_(False)
    if rule.codes is None or len(rule.codes) < 2:
        raise NPAError(
            f"rule must be one of two pictures or more, got {config.rule!r}: train one with "
            "npa-envs train morphogenesis2d --targets gecko heart"
        )
    check_matches_rule(rule, config, "state_dim", "alpha", "eps0", "moment_inverse")
    return rule, rule.codes


class CodeSpaces(ParticleSpaces):
    """Spaces with coarse pictures of world and goal as observations, and codes as actions."""

    def __init__(self, physics: Physics, config: Shapeshifter2DEnvConfig) -> None:
        _, codes = load_coded_rule(config, torch.device("cpu"))
        self._table = codes.table
        self._limit = max(1.0, float(self._table.abs().max()))
        self._chosen = config.actions == "choice"
        self._output = config.output
        count, dim = self._table.shape
        limit, shape = OBSERVATION_LIMIT, (8 * config.picture_size**2,)
        self.observation_space: Space[Any] = Box(-limit, limit, shape, np.float32)
        self.action_space: Space[Any] = (
            Discrete(count) if self._chosen else Box(-1.0, 1.0, (dim,), np.float32)
        )

    def action(self, action: Any, world_count: int | None) -> Tensor:
        """Return checked actions as codes, float32, shape [B, 1, code_dim]."""
        count, dim = self._table.shape
        if not self._chosen:
            code = batch_tensor(action, world_count, (dim,), "code_dim")
            return self._limit * code[:, None].clamp(-1.0, 1.0)
        chosen = batch_tensor(action, world_count, (), "", discrete=True)
        if not bool(((chosen >= 0) & (chosen < count)).all()):
            raise NPAError(f"action must be the number of one of {count} codes, from 0 on")
        return self._table.to(chosen.device)[chosen[:, None]]

    def actions_of_codes(self) -> Tensor:
        """Return the action that stands for each of the rule's codes, [T, code_dim]."""
        return self._table / self._limit


class PictureGoals(NamedTuple):
    """Which of the rule's pictures are the goals of B episodes: indices, int64."""

    goal: Tensor
    """The current goal, shape [B]."""
    in_turn: Tensor
    """All goals of each episode in their order, shape [B, `GOAL_COUNT`]."""


class ShapeshifterTask(RuleDrivenTask[Shapeshifter2DEnvConfig]):
    """The task of choosing codes that make a grown picture become one goal after another."""

    config_type = Shapeshifter2DEnvConfig
    spaces_type = CodeSpaces
    controls = "codes"
    grows = True
    pixel_bytes = 48
    task: ManyPictures

    def _make_task(self) -> ManyPictures:
        config = self.config
        self.rule, self.codes = load_coded_rule(config, self.device)
        sources = targets_of_codes(config.rule, self.codes)
        task_config = config.as_config(
            Morphogenesis2DConfig,
            target_point_count=config.particle_count,
            targets=tuple(sources.values()),
            state_dim=config.state_dim - self.rule.code_dim,
            code_dim=self.rule.code_dim,
        )
        return ManyPictures(task_config, device=self.device)

    @cached_property
    def empty_losses(self) -> Tensor:
        """Loss of a world without particles for each goal, shape [T]."""
        goals = torch.arange(len(self.codes), device=self.device)
        x = torch.full((len(goals), 1, 2), 1e3, device=self.device)
        s = x.new_zeros(len(goals), 1, self.config.state_dim)
        # Without particles in the picture colours do not count, and nothing is centred.
        goal_task = self.task.with_goal(goals)
        difference = goal_task.picture(x, s, centred=False) - goal_task.target_picture
        return (difference[..., 3].square() + difference[..., 3].abs()).flatten(1).mean(dim=1)

    def fresh(self, random: WorldRandom) -> Start:
        """Return grown worlds of random pictures, with other pictures as their goals."""
        x, s, *_, picture = self.task.seed(random.world_count, generator=random, device=self.device)
        assert picture is not None, "worlds of many pictures have goals"
        seeds = Particles(x, self.rule.with_code(s, self.codes.table[picture][:, None]))
        x, s, *_ = grow(self.rule, self.config, seeds, random)
        return Start(x, s, goal=self._another(picture, random))

    def _another(self, goal: Tensor, random: WorldRandom) -> Tensor:
        """Return random goals, each other than `goal`, int64, shape [B]."""
        return (goal + 1 + random.integers(len(self.codes) - 1, 1)[:, 0]) % len(self.codes)

    def episode_context(self, start: Start, loss: Tensor, random: WorldRandom) -> PictureGoals:
        """Return the first goal of each episode, and all its random goals in order."""
        assert start.goal is not None, "made with goals"
        goals = [start.goal]
        while len(goals) < GOAL_COUNT:
            goals.append(self._another(goals[-1], random))
        # The last one is followed by the first.
        goals[-1] = torch.where(goals[-1] == goals[0], self._another(goals[0], random), goals[-1])
        return PictureGoals(start.goal, torch.stack(goals, dim=1))

    def step(
        self, x: Tensor, s: Tensor, action: Tensor, random: WorldRandom
    ) -> tuple[Tensor, Tensor]:
        """Return x and s after steps of the rule with codes `action`, shape [B, 1, code_dim]."""
        coded = Particles(x, self.rule.with_code(s, action))
        steps = self.config.rule_steps
        x, s, *_ = run_rule(self.rule, self.config, coded, steps, random, cuda_graph="whole")
        return x, s

    def reward(self, particles: Particles, loss: Tensor, context: PictureGoals) -> Tensor:
        """Return rewards, [B]: 1 for a loss of 0, 0 for the loss without particles."""
        return (1.0 - loss / self.empty_losses.index_select(0, context.goal)).clamp_min(-1.0)

    def next_goals(self, elapsed: Tensor, context: PictureGoals, goal: Tensor) -> None:
        """Write each world's goal into `goal`, [B]; it changes every `hold_steps` steps."""
        turn = (elapsed.long() // self.config.hold_steps) % GOAL_COUNT
        context.goal.copy_(context.in_turn.gather(1, turn[:, None])[:, 0])
        goal.copy_(context.goal)

    def context_info(self, particles: Particles, context: PictureGoals) -> dict[str, Tensor]:
        """Return as `goal` the index of each world's goal, int64, shape [B]."""
        return {"goal": context.goal.clone()}

    def observe(self, particles: Particles, loss: Tensor, context: PictureGoals) -> Tensor:
        """Return coarse pictures of worlds and then of their goals, shape [B, 8 G²]."""
        goal_task = self.task.with_goal(context.goal)
        picture = goal_task.picture(particles.x, particles.s)
        both = torch.cat((picture, goal_task.target_picture), dim=-1)
        return coarse(both, self.config.picture_size)


class Shapeshifter2DEnv(NPAEnv):
    """Change a grown picture into others, by the code that its particles have.

    ## Description

    A rule of many pictures steps N particles. A code of `code_dim` numbers, part of each particle's
    state, determines the picture that they grow ([one rule, many pictures](../beyond.md)). The
    agent chooses the code. It observes the current picture and the goal's, both coarse, and after
    `hold_steps` steps the goal becomes another picture. Observations do not say which code grows
    which picture, and particles need time to rearrange.

    With `actions="choice"` the agent chooses among the rule's trained codes: it has to recognise
    the goal. With `actions="code"` it gives the vector itself, which need not be a trained one.

    The default rule, `seven-pictures`, recolours a grown picture at once, but hardly changes its
    shape. `npa_envs.agents.shapeshifter_policies.RecognisingShapeshifter` gives the goal's code;
    with "choice" it gets −0.01 per step, Stable-Baselines3's PPO −0.10 after 20 000 steps, random
    actions −0.31 (16 episodes, one training seed; "code" not measured). Rules of `npa-envs train
    morphogenesis2d --targets ...` need their own `state_dim`, `eps`, `eps0` and `particle_count`.

    ## Observation space

    `Box(-8, 8, (8 G²,), float32)` with G = `picture_size`: red, green, blue and density of the
    world's picture, then of the goal's, each row by row from the bottom up. Colours are sums over
    particles, as is the density, which is about 1 inside a goal. The world's picture is centred on
    its particles' mean.

    ## Action space

    With `actions="code"`, `Box(-1, 1, (code_dim,), float32)`: the code, in units of the largest
    absolute value in the rule's codes, or of 1 if that is larger. With `actions="choice"`,
    `Discrete(T)`: the index of one of the rule's T codes. All particles get this code, and the rule
    makes `rule_steps` steps. An action that is not finite raises `NPAError` and does not change the
    world.

    ## Reward

    Worlds are compared with the goal as in `npa/Morphogenesis2D-v0`, by a loss L. The reward is
    1 − L / L₁, and at least -1; L₁ is the loss of an empty picture. So 1 is the goal itself. It is
    for the goal that was observed before the step.

    ## Starting state

    The rule has grown one of its pictures, drawn at random, for `grow_steps` steps from a disk of
    grey particles. The first goal is another one. With the default `seed_pool=16` there are
    sixteen such worlds, made at the first reset.

    ## Info

    | Key | In | Value |
    |---|---|---|
    | `goal` | reset, step | index of the goal's code |
    | `loss` | reset, step | current loss L; of a step, for the goal observed before it |
    | `loss_density`, `loss_colour` | reset, step | the terms of the loss |
    | `reward_density`, `reward_colour` | step | decrease of each term, whatever the goals were |
    | `success`, `diverged` | step | whether the world succeeded or diverged in it, bool |
    | `reason` | last step | why the episode ended, see above; None for other worlds |
    """

    task_type = ShapeshifterTask


Shapeshifter2DVectorEnv = vector_class(Shapeshifter2DEnv)
