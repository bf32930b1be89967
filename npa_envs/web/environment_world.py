"""Live worlds of environments, which a policy runs episode by episode."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from torch import Tensor

from npa_envs.agents.network_policies import load_policy
from npa_envs.checks import is_whole
from npa_envs.errors import NPAError, shown, suggest
from npa_envs.ops import splat, world_mean
from npa_envs.registration import ALL
from npa_envs.rule.rule import COLOUR_OFFSET
from npa_envs.tasks.base import Task
from npa_envs.tasks.damage import DAMAGE_SIZES
from npa_envs.tasks.targets.picture_points import PointTarget
from npa_envs.web.live_world import ColouredWorld, LiveWorld, shows_of
from npa_envs.web.messages import WorldEvent
from npa_envs.world.brushes import nearest_image
from npa_envs.world.particles import Particles


def make_environment(
    id: str, policy: str = "zero", *, device: str = "cpu", **keywords: Any
) -> tuple[Any, Callable[[Any], Any]]:
    """Return a Gymnasium environment, and the policy: a function from observations to actions.

    `id` is one of this package or, as MODULE:ID, of a module that registers it. `policy` is as for
    `load_policy`. `keywords` are those of `gymnasium.make`; None counts as not given.
    """
    keywords = {name: value for name, value in keywords.items() if value is not None}
    limit = keywords.get("max_episode_steps", 1)
    if not is_whole(limit) or limit < 1:
        # Checked here because Gymnasium's message does not say how to fix it.
        raise NPAError(
            f"max_episode_steps must be a whole number of at least 1, got {shown(limit)}: try 512"
        )
    options: dict[str, Any] = {"disable_env_checker": True, "device": device, "output": "torch"}
    try:
        env = gymnasium.make(id, **options, **keywords)
    except (gymnasium.error.Error, ModuleNotFoundError) as error:
        hint = suggest(id, [row.id for row in ALL])
        raise NPAError(f"unknown environment {shown(id)}: {hint}") from error
    except TypeError as error:
        if isinstance(error, NPAError):
            raise
        what = f"env must be an environment of npa_envs, got {shown(id)}"
        raise NPAError(f"{what}: {error}") from error
    return env, load_policy(policy, env)


def outline_of(target: PointTarget, *, side: int = 64) -> list[float]:
    """Return line segments [x, y, x, y, ...] around a target's points [length units]."""
    spots: Any = {"resolution": side, "pixel_size": target.pixel_size}
    # The density is about 1 inside.
    height = splat(target.points[None], target.colours[None], **spots)[0, ..., 3].cpu().numpy() - 0.5
    at = np.linspace(-1.0, 1.0, side)
    fields = np.stack((*np.meshgrid(at, at), height), axis=-1)
    # Both triangles of each square of pixels; the outline crosses two sides of a triangle, or none.
    a, b, c, d = fields[:-1, :-1], fields[:-1, 1:], fields[1:, :-1], fields[1:, 1:]
    corners = np.concatenate((np.stack((a, b, c), 2), np.stack((d, c, b), 2))).reshape(-1, 3, 3)
    inside = (corners[..., 2] > 0.0).sum(axis=1)
    corners, inside = corners[inside % 3 > 0], inside[inside % 3 > 0]
    # The corner that is alone inside or outside is on both sides that are crossed.
    order = np.argsort(np.where(inside == 1, -1.0, 1.0)[:, None] * corners[..., 2], axis=1)
    alone, *others = np.moveaxis(np.take_along_axis(corners, order[..., None], axis=1), 1, 0)
    share = [alone[:, 2:] / (alone[:, 2:] - one[:, 2:]) for one in others]
    ends = [alone + part * (one - alone) for part, one in zip(share, others, strict=True)]
    lines: list[float] = np.concatenate([end[:, :2] for end in ends], 1).round(3).ravel().tolist()
    return lines


class EnvironmentWorld(LiveWorld):
    """The world of an environment whose actions a policy chooses; `make_environment` makes both."""

    def __init__(
        self, env: Any, policy: Callable[[Any], Any], *, seed: int = 0, policy_name: str = ""
    ) -> None:
        super().__init__(seed)
        self._acting = f"policy {policy_name}, " if policy_name else ""
        self._env, self._inner, self._policy = env, env.unwrapped, policy
        if not hasattr(self._inner, "place_particles"):
            raise NPAError(
                f"env must be an environment of npa_envs, got {type(env).__name__}: make it with "
                "gymnasium.make('npa/Texture-v0')"
            )
        self._physics = self._inner.worlds.physics
        self._episode, self._ended = 0, ""
        target = getattr(getattr(self._inner.task, "task", None), "target", None)
        # Worlds of several targets have no outline.
        one = isinstance(target, PointTarget) and self._inner.task.task.goal_count == 0
        self._outline = outline_of(target) if one else []
        self.reset(self.seed)

    def _begin(self, seed: int | None) -> None:
        super()._begin(seed)
        self._observation, info = self._env.reset(seed=seed)
        self._episode += 1
        self._info: dict[str, Any] = info
        self._return = 0.0

    @property
    def box(self) -> tuple[float, ...] | None:
        """Sides of the periodic box [length units]; None: open space."""
        box: tuple[float, ...] | None = self._physics.periodic_box
        return box

    def describe(self) -> WorldEvent:
        """Return the event "world"; the note: policy, number of the episode, end of the last."""
        task = self._inner.task
        # Brushes and gusts carry particles out of the picture.
        margin = 1.25 if task.controls == "brushes" else 1.0
        event: WorldEvent = super().describe() | {
            "title": self._env.spec.id if self._env.spec is not None else type(self._env).__name__,
            "note": f"{self._acting}episode {self._episode}{self._ended}",
            "dimension": self._physics.space_dim,
            "outline": self._outline,
            "half_width": margin * task.half_width if self.box is None else 0.5 * min(self.box),
            "spot": 0.7 * float(task.pixel_size),
            "class_count": int(getattr(task.config, "class_count", 0)),
            "damages": list(DAMAGE_SIZES) if self._physics.moving else ["wipe"],
            "capabilities": ["film", "loss"],
        }
        if event["class_count"]:
            # Clouds fill [0, 1]², and the environment's sizes are those of its magnified pictures.
            frame, spot = task.task.frame, 0.7 * task.task.pixel_size
            event |= {"centre": [*frame.centre], "half_width": frame.half_width, "spot": spot}
        return event

    def _allowed(self) -> set[str]:
        return {"positions", "states"} if self._physics.moving else {"states"}

    def _shows(self) -> list[str]:
        return shows_of(self._physics.state_dim, species=False)

    def _run(self, steps: int) -> None:
        for _ in range(steps):
            before = self.particles.x if self.show == "speed" else None
            action = self._policy(self._observation)
            acted = self._marks(action)
            self._observation, reward, ended, truncated, self._info = self._env.step(action)
            self.step += 1
            self._return += float(reward)
            acted |= {"type": "acted", "reward": float(reward), "total": self._return}
            self._events = [*(one for one in self._events if one["type"] != "acted"), acted]
            if before is not None:
                moved = nearest_image(self.particles.x - before, self.box)
                self._travelled = moved.norm(dim=-1) / max(self._physics.max_displacement, 1e-12)
            if ended or truncated:
                self._ended = (
                    f"; the last one ended after {self.step} steps: "
                    f"{self._info.get('reason', 'time limit')}, return {self._return:.3g}"
                )
                point = [self._episode, self._return]
                curve = {"type": "curve", "name": "Return", "points": [point]}
                self._events.append(curve | {"append": self._episode > 1})
                self._begin(None)
                self._events.append(self.describe())
                return

    def _marks(self, action: Any) -> dict[str, Any]:
        """Return `middle` and `pushes` of the event "acted"."""
        x, task = self.particles.x, self._inner.task
        if task.controls != "brushes":
            return {"middle": world_mean(x)[0].tolist(), "pushes": []}
        pushes = task.pushes(x, self._inner.spaces.action(action, None))
        middle = task.goal_middle(x, self._inner.worlds.context)
        return {"middle": middle[0].tolist(), "pushes": pushes[0].tolist()}

    @property
    def particles(self) -> Particles:
        """The environment's particles, as a batch of one world; settable."""
        x, s = self._inner.particles()
        return Particles(x[None], s[None])

    @particles.setter
    def particles(self, particles: Particles) -> None:
        self._observation = self._inner.place_particles(particles.x[0], particles.s[0])

    def _coloured(self) -> ColouredWorld:
        x, s, *_ = self.particles
        eps, count = self._physics.eps, x.shape[1]
        return ColouredWorld(
            x, s, self._rule_colours, eps, self.box, [count], count, self._travelled, None
        )

    def _rule_colours(self, s: Tensor) -> Tensor:
        task: Task | None = getattr(self._inner.task, "task", None)
        return s[..., -3:] + COLOUR_OFFSET if task is None else task.colours(s)

    def _loss(self) -> float | None:
        loss = self._info.get("loss")
        return None if loss is None else float(loss)

    def close(self) -> None:
        """Close the environment."""
        self._env.close()
