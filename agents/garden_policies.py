"""Gardeners and shepherds: policies that use brushes; random, scripted, or planned by gradients.

`act` returns rows of brushes, [B, J, W]: J brushes, W columns each. A policy returns them in the
shape of the environment's action space.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from npa_envs.agents.policies import PolicyRandom, unwrapped
from npa_envs.checks import checked_positive
from npa_envs.envs.garden.base import GardenTask, TargetDeficit
from npa_envs.envs.garden.brush_actions import BrushLayout, grid_places
from npa_envs.envs.shepherd2d import ShepherdTask
from npa_envs.errors import NPAError
from npa_envs.world.randomness import StreamId, WorldRandom

FREE_PLACES = 8
"""Points on each side of the grid of places at which `ScriptedGardener` puts free brushes."""


class BrushPolicy:
    """Policy of the brushes of a garden `env`, single or vector, whose worlds it reads."""

    def __init__(self, env: Any) -> None:
        inner = unwrapped(env)
        self.worlds = inner.worlds
        self.task = self.worlds.task
        if not isinstance(self.task, GardenTask) or self.task.config.actions == "discrete":
            raise NPAError(
                f"env must be a garden with actions='grid' or 'free', got "
                f"{type(self.task).__name__}: make it with gymnasium.make('npa/Gardener2D-v0')"
            )
        self.config = self.task.config
        self.columns = BrushLayout.for_config(self.config)
        self.shape = inner.spaces.rows_shape
        """Shape of a world's rows of brushes, (J, W)."""
        self._action_shape = inner.spaces.action_shape

    def __call__(self, observation: Any) -> Any:
        """Return actions of the environment's shape, of B worlds for observations [B, O].

        For one world's observation, [O], they are its own, without a dimension of worlds. Of the
        observation only the form counts: worlds are read.
        """
        array = observation["observation"] if isinstance(observation, dict) else observation
        actions = self.act().reshape(-1, *self._action_shape)
        actions = actions[0] if array.ndim == 1 else actions
        return actions if isinstance(array, Tensor) else actions.cpu().numpy()

    def act(self) -> Tensor:
        """Return actions, float32, [B, J, W]: W columns of `BrushLayout` for each of J brushes.

        By default they are zeros, which do nothing.
        """
        return torch.zeros(self.worlds.world_count, *self.shape, device=self.task.device)


class StillGardener(BrushPolicy):
    """Do nothing, so that only the rule acts."""


class RandomGardener(BrushPolicy):
    """Act at random, uniformly over the action space; world k acts by the seed `seed + k`."""

    def __init__(self, env: Any, seed: int = 0) -> None:
        super().__init__(env)
        self._random = PolicyRandom(seed)

    def act(self) -> Tensor:
        """Return a number from [-1, 1) for each of J brushes and W columns, [B, J, W]."""
        random = self._random.next_step(self.worlds.world_count, self.task.device)
        return 2.0 * random.uniform(*self.shape) - 1.0


class ScriptedGardener(BrushPolicy):
    """Push particles to places with a deficit, where their density is less than the target's.

    Brushes on a grid all push. Each free brush goes to the free place that needs the longest push.

    Args:
        gain: Factor on a push's first part, along the deficit's gradient (dimensionless).
        share: Factor on its other part, to all places by deficit and nearness [1 / length units].
        width: Standard deviation of nearness, a Gaussian of distance [length units].
    """

    def __init__(self, env: Any, gain: float = 0.5, share: float = 0.6, width: float = 0.4) -> None:
        super().__init__(env)
        if "push" not in self.config.tools:
            raise NPAError(f"env must have brushes that push, got tools={self.config.tools}")
        self._gain = checked_positive("gain", gain)
        self._deficit = self.task.deficit
        if self.config.actions == "free":
            fine = replace(self.config, place_count=FREE_PLACES)
            places = grid_places(fine, self.task.device)
            self._deficit = TargetDeficit(places, self.task.task.target, fine)
        places = self._deficit.places
        away = places[None] - places[:, None]
        weight = (-0.5 * away.square().sum(dim=-1) / checked_positive("width", width) ** 2).exp()
        # In float64, as libraries sum one world in another order than several.
        self._pulls = (checked_positive("share", share) * weight[..., None] * away).double()

    def act(self) -> Tensor:
        """Return actions that push particles to places with a deficit, shape [B, J, W]."""
        worlds, action = self.worlds, super().act()
        deficit = self._deficit(worlds.particles, self.task.middle(worlds.x))
        pull = torch.einsum("bq,pqd->bpd", deficit[..., 0].double(), self._pulls).to(deficit.dtype)
        move = (self._gain * deficit[..., 1:3] + pull).clamp(-1.0, 1.0)
        if self.config.actions == "grid":
            action[..., self.columns.push] = move
            return action
        places, length = self._deficit.places, move.norm(dim=-1)
        every_world = torch.arange(len(action), device=deficit.device)
        for brush in range(len(action[0])):
            longest = length.argmax(dim=1)
            action[:, brush, self.columns.place] = places[longest]
            action[:, brush, self.columns.push] = move[every_world, longest]
            apart = (places - places[longest][:, None]).norm(dim=-1) >= self.config.brush_radius
            length = length * apart
        return action


class ScriptedShepherd(BrushPolicy):
    """Push all particles towards the world's goal, whatever the `aim` of the environment.

    Args:
        gain: Fraction of the distance to the goal that a push covers (dimensionless).
        ring: Radius of the circle on which free brushes are placed [length units].
    """

    def __init__(self, env: Any, gain: float = 1.0, ring: float = 0.4) -> None:
        super().__init__(env)
        if not isinstance(self.task, ShepherdTask) or "push" not in self.config.tools:
            raise NPAError(
                f"env must be npa/Shepherd2D-v0 with brushes that push, got "
                f"{type(self.task).__name__} with tools={self.config.tools}"
            )
        self._gain = checked_positive("gain", gain)
        self._places = self.task.deficit.places
        ring = checked_positive("ring", ring)
        if self.config.actions == "free":
            count = self.config.brush_count
            angle = 2.0 * torch.pi * (torch.arange(count, device=self.task.device) + 0.5) / count
            self._places = ring * torch.stack((angle.cos(), angle.sin()), dim=1)

    def act(self) -> Tensor:
        """Return actions that push particles towards each world's goal, shape [B, J, W]."""
        worlds, action = self.worlds, super().act()
        missing = (self.task.desired(worlds.context) - worlds.context.achieved)[:, None, :2]
        if self.config.aim == "move":
            direction = missing.expand(-1, len(self._places), -1)
        elif self.config.aim == "reshape":
            direction = missing * self._places
        else:
            around = torch.stack((-self._places[:, 1], self._places[:, 0]), dim=1)
            direction = missing[..., 1:] * around
        if self.config.actions == "free":
            action[..., self.columns.place] = self._places
        push = self._gain * direction / self.config.push_length
        action[..., self.columns.push] = push.clamp(-1.0, 1.0)
        return action


class GradientGardener(BrushPolicy):
    """Plan by the gradient of rewards, differentiated through brushes, rule and picture.

    In each step of a garden `env`, whose brushes push and whose rewards are dense, it simulates the
    worlds for `horizon` steps, without damage and with update masks of its own. Adam improves the
    actions of these steps `iterations` times, from those of `ScriptedGardener` or
    `ScriptedShepherd`. It takes the first step of the best plan.
    """

    def __init__(
        self,
        env: Any,
        horizon: int = 2,
        iterations: int = 12,
        learning_rate: float = 0.1,
        seed: int = 0,
    ) -> None:
        super().__init__(env)
        shepherd = isinstance(self.task, ShepherdTask)
        self._scripted = ScriptedShepherd(env) if shepherd else ScriptedGardener(env)
        self._horizon, self._iterations = horizon, iterations
        self._learning_rate = learning_rate
        self._random = PolicyRandom(seed)

    def act(self) -> Tensor:
        """Return the actions of the first step of the best plan found, shape [B, J, W]."""
        random = self._random.next_step(self.worlds.world_count, self.task.device)
        first = self._scripted.act()
        plan = torch.stack([first] + [super().act()] * (self._horizon - 1))
        plan[1:, ..., self.columns.place] = first[..., self.columns.place]
        plan = plan.requires_grad_()
        optimiser = torch.optim.Adam([plan], lr=self._learning_rate)
        best = plan.detach().clone()
        highest = torch.full_like(first[:, 0, 0], -torch.inf)
        for _ in range(self._iterations):
            rewards = self.planned_rewards(plan, random)
            with torch.no_grad():
                better = rewards > highest
                highest = torch.where(better, rewards, highest)
                best = torch.where(better[:, None, None], plan, best)
            (plan.grad,) = torch.autograd.grad(-rewards.sum(), plan)
            optimiser.step()
            with torch.no_grad():
                plan.clamp_(-1.0, 1.0)
        return best[0].detach()

    @torch.enable_grad()
    def planned_rewards(self, plan: Tensor, random: WorldRandom) -> Tensor:
        """Return the sum [B] of each world's rewards in the T steps of a plan [T, B, J, W]."""
        worlds, task = self.worlds, self.task
        particles = worlds.particles
        random = random.substream(StreamId.POLICY)
        total = torch.zeros(worlds.world_count, device=worlds.device)
        for action in plan:
            particles = task.brush_and_roll(particles, action, random)
            loss = sum(task.losses(particles.x, particles.s).values())
            context = task.measured(particles, worlds.context)
            total = total + task.reward(particles, loss, context)
        return total
