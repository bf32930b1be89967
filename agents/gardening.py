"""Gardeners: policies that use brushes on living worlds, scripted and by the world's gradient."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from npa_envs.agents.policies import PolicyDraws, unwrapped
from npa_envs.checks import checked_positive
from npa_envs.envs.garden.brushes import BrushLayout, grid_places
from npa_envs.envs.garden.task import GardenTask, TargetDeficit
from npa_envs.envs.shepherd2d import ShepherdTask
from npa_envs.errors import NPAError
from npa_envs.world.randomness import StreamId, WorldRandom

FREE_PLACES = 8
"""Places on each side of the grid from which scripts choose where free brushes go."""


class BrushPolicy:
    """A policy of a garden, single or vector, whose actions are numbers: "grid" or "free"."""

    def __init__(self, env: Any) -> None:
        inner = unwrapped(env)
        self.worlds = inner.worlds
        self.task = self.worlds.task
        if not isinstance(self.task, GardenTask) or self.task.config.actions == "discrete":
            raise NPAError(
                f"env must be a garden with actions='grid' or 'free', got "
                f"{type(self.task).__name__}: make it with gymnasium.make('npa/Gardener2D-v0')"
            )
        self._seen = inner.form.seen_dim
        self.config = self.task.config
        self.columns = BrushLayout.of(self.config)
        self.shape = inner.form.rows_shape
        """Shape of a world's actions, (K, W)."""

    def __call__(self, observation: Any) -> Any:
        """Return the brushes' actions, [K, W], or [B, K, W] for observations of B worlds.

        Policies look at the worlds of their environment, not at the observation.
        """
        seen = observation["observation"] if isinstance(observation, dict) else observation
        action = self.act(self.worlds.world_count)
        action = action if seen.ndim > self._seen else action[0]
        return action if isinstance(seen, Tensor) else action.cpu().numpy()

    def act(self, world_count: int) -> Tensor:
        """Return the brushes' actions in the environment's worlds, float32, shape [B, K, W]."""
        raise NotImplementedError

    def still(self, world_count: int) -> Tensor:
        """Return actions that do nothing."""
        return torch.zeros(world_count, *self.shape, device=self.task.device)


class StillGardener(BrushPolicy):
    """Leave the worlds to their rule."""

    def act(self, world_count: int) -> Tensor:
        """Return zeros."""
        return self.still(world_count)


class RandomGardener(BrushPolicy):
    """Act at random, uniformly over the action space; each further world has one seed more."""

    def __init__(self, env: Any, seed: int = 0) -> None:
        super().__init__(env)
        self._draws = PolicyDraws(seed)

    def act(self, world_count: int) -> Tensor:
        """Return numbers from [-1, 1)."""
        return 2.0 * self._draws.next(world_count, self.task.device).uniform(*self.shape) - 1.0


class ScriptedGardener(BrushPolicy):
    """Push particles towards places with too few of them.

    On a grid actions are linear in observations. Free brushes go where the longest push is due and
    no brush before them is.

    Args:
        gain: Push for the deficit at a place (dimensionless).
        share: Push towards neighbouring places for the deficit there (dimensionless).
        width: Standard deviation of the distance of neighbours [length units].
    """

    def __init__(self, env: Any, gain: float = 0.5, share: float = 0.6, width: float = 0.4) -> None:
        super().__init__(env)
        if "push" not in self.config.tools:
            raise NPAError(f"env must have brushes that push, got tools={self.config.tools}")
        self._gain = checked_positive("gain", gain)
        self._lacking = self.task.lacking
        if self.config.actions == "free":
            fine = replace(self.config, place_count=FREE_PLACES)
            places = grid_places(fine, self.task.device)
            self._lacking = TargetDeficit(places, self.task.task.target, fine)
        places = self._lacking.places
        away = places[None] - places[:, None]
        near = (-0.5 * away.square().sum(dim=-1) / checked_positive("width", width) ** 2).exp()
        # In double precision: libraries add up one world in another order than several.
        self._ways = (checked_positive("share", share) * near[..., None] * away).double()

    def act(self, world_count: int) -> Tensor:
        """Return the pushes for the deficits of the worlds."""
        worlds, action = self.worlds, self.still(world_count)
        lack = self._lacking(worlds.x, worlds.s, self.task.middle(worlds.x))
        ways = torch.einsum("bq,pqd->bpd", lack[..., 0].double(), self._ways).to(lack.dtype)
        move = (self._gain * lack[..., 1:3] + ways).clamp(-1.0, 1.0)
        if self.config.actions == "grid":
            action[..., self.columns.push] = move
            return action
        places, worth = self._lacking.places, move.norm(dim=-1)
        everyone = torch.arange(world_count, device=lack.device)
        for brush in range(len(action[0])):
            place = worth.argmax(dim=1)
            action[:, brush, self.columns.place] = places[place]
            action[:, brush, self.columns.push] = move[everyone, place]
            apart = (places - places[place][:, None]).norm(dim=-1) >= self.config.brush_radius
            worth = worth * apart
        return action


class ScriptedShepherd(BrushPolicy):
    """Push everywhere in the direction of the goal: to a place, around, or outwards.

    Args:
        gain: Share of the way to the goal in a step (dimensionless).
        ring: Distance from the middle of the picture at which brushes stand that can go anywhere
            [length units].
    """

    def __init__(self, env: Any, gain: float = 1.0, ring: float = 0.4) -> None:
        super().__init__(env)
        if not isinstance(self.task, ShepherdTask) or "push" not in self.config.tools:
            raise NPAError(
                f"env must be npa/Shepherd2D-v0 with brushes that push, got "
                f"{type(self.task).__name__} with tools={self.config.tools}"
            )
        self._gain = checked_positive("gain", gain)
        self._places = self.task.lacking.places
        ring = checked_positive("ring", ring)
        if self.config.actions == "free":
            count = self.config.brush_count
            angle = 2.0 * torch.pi * (torch.arange(count, device=self.task.device) + 0.5) / count
            self._places = ring * torch.stack((angle.cos(), angle.sin()), dim=1)

    def act(self, world_count: int) -> Tensor:
        """Return pushes towards the goals of the worlds."""
        worlds, action = self.worlds, self.still(world_count)
        achieved = self.task.achieved(worlds.x, worlds.s, worlds.context)
        missing = (self.task.desired(worlds.context) - achieved)[:, None, :2]
        if self.config.aim == "move":
            way = missing.expand(-1, len(self._places), -1)
        elif self.config.aim == "reshape":
            way = missing * self._places
        else:
            around = torch.stack((-self._places[:, 1], self._places[:, 0]), dim=1)
            way = missing[..., 1:] * around
        if self.config.actions == "free":
            action[..., self.columns.place] = self._places
        push = self._gain * way / self.config.push_length
        action[..., self.columns.push] = push.clamp(-1.0, 1.0)
        return action


class GradientGardener(BrushPolicy):
    """Plan by the gradient of rewards through brushes, rule and picture.

    In each step it copies the worlds and improves a plan for the next `horizon` steps by Adam,
    with draws of its own: it knows the state of the world, the rule and the target, and nothing of
    the damage to come. It begins with the action of `ScriptedGardener` or `ScriptedShepherd`, and
    takes the first step of the best plan found.

    Args:
        env: A garden whose brushes push, with dense rewards.
        horizon: Steps of a plan.
        iterations: Gradient steps on each plan.
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
        self._draws = PolicyDraws(seed)

    def act(self, world_count: int) -> Tensor:
        """Return the first step of the best plan."""
        draws = self._draws.next(world_count, self.task.device)
        first = self._scripted.act(world_count)
        plan = torch.stack([first] + [self.still(world_count)] * (self._horizon - 1))
        plan[1:, ..., self.columns.place] = first[..., self.columns.place]
        plan = plan.requires_grad_()
        optimizer = torch.optim.Adam([plan], lr=self._learning_rate)
        best = plan.detach().clone()
        highest = torch.full((world_count,), -torch.inf, device=self.task.device)
        for _ in range(self._iterations):
            worth = self.worth(plan, draws)
            with torch.no_grad():
                better = worth > highest
                highest = torch.where(better, worth, highest)
                best = torch.where(better[:, None, None], plan, best)
            (plan.grad,) = torch.autograd.grad(-worth.sum(), plan)
            optimizer.step()
            with torch.no_grad():
                plan.clamp_(-1.0, 1.0)
        return best[0].detach()

    @torch.enable_grad()
    def worth(self, plan: Tensor, draws: WorldRandom) -> Tensor:
        """Return the worlds' rewards in the steps of a plan, [T, B, K, W], summed, [B]."""
        worlds, task = self.worlds, self.task
        x, s = worlds.x.detach(), worlds.s.detach()
        random = draws.substream(StreamId.POLICY)
        earned = torch.zeros(x.shape[0], device=x.device)
        for action in plan:
            x, s = task.brush_and_roll(x, s, action, random)
            loss = sum(task.losses(x, s).values())
            earned = earned + task.reward(x, s, loss, worlds.context)
        return earned
