"""Live worlds of environments, which a policy runs episode by episode."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import torch
from torch import Tensor

from npa_envs.agents.network_policies import load_policy
from npa_envs.checks import is_whole
from npa_envs.envs.garden.brush_actions import apply_brushes
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


def outline_of(target: PointTarget) -> Any:
    """Return lines [x, y, dx, dy] around a target's points [length units]."""
    size, at = target.pixel_size, np.linspace(-1.0, 1.0, 64)
    picture = splat(target.points[None], target.colours[None], resolution=64, pixel_size=size)
    # The density is about 1 inside.
    height = picture[0, ..., 3].cpu().numpy() - 0.5
    fields = np.stack((*np.meshgrid(at, at), height), axis=-1)
    # Triangles between three pixels; the outline crosses two sides of a triangle, or none.
    a, b, c, d = fields[:-1, :-1], fields[:-1, 1:], fields[1:, :-1], fields[1:, 1:]
    first = np.concatenate((np.stack((a, b, c), 2), np.stack((d, c, b), 2))).reshape(-1, 3, 3)
    last = np.roll(first, 1, axis=1)
    crossed = (first[..., 2] > 0.0) != (last[..., 2] > 0.0)
    first, last = first[crossed], last[crossed]
    share = first[:, 2:] / (first[:, 2:] - last[:, 2:])
    ends = (first + share * (last - first)).reshape(-1, 2, 3)[..., :2]
    return np.concatenate((ends[:, 0], ends[:, 1] - ends[:, 0]), axis=1).round(3).tolist()


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
        task = getattr(self._inner.task, "task", None)
        target = getattr(task, "target", None) if getattr(task, "goal_count", 1) == 0 else None
        self._outline = outline_of(target) if isinstance(target, PointTarget) else []
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
        coloured = not getattr(self._inner.task.config, "class_count", 0)
        return shows_of(self._physics.state_dim, species=False, coloured=coloured)

    def _run(self, steps: int) -> None:
        for _ in range(steps):
            before = self.particles.x if self.show == "speed" else None
            action = self._policy(self._observation)
            acted = self._marks(action)
            self._observation, reward, ended, truncated, self._info = self._env.step(action)
            self.step += 1
            self._return += float(reward)
            acted |= {"reward": float(reward), "total": self._return}
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
        x, task, worlds = self.particles.x, self._inner.task, self._inner.worlds
        moves = getattr(task.config, "aim", "") == "move"
        middle, pushes = (worlds.context.goal if moves else world_mean(x))[0], x.new_zeros(0)
        if task.controls == "brushes":
            # The grid's places as particles: brushes lie there, or move them in other forms.
            origin, rows = task.middle(x), self._inner.spaces.action(action, None)
            places = origin[:, None] + task.deficit.places
            at = Particles(places, x.new_zeros(*places.shape[:2], self._physics.state_dim))
            moved, _ = apply_brushes(at, rows, origin, task.config)
            pushes = torch.cat((places, moved.x - places), dim=-1)[0]
        return {"type": "acted", "middle": middle.tolist(), "pushes": pushes.tolist()}

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
