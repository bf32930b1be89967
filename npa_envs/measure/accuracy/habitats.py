"""Shipped rules in the worlds that they were trained for, and what runs them for very long."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from npa_envs.measure.accuracy.checks import Session
from npa_envs.rule.files import load_rule, rule_metadata, shipped_rules
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import Task, seed_worlds, task_toward
from npa_envs.training.trained_tasks import task_of_rule, trained_config
from npa_envs.world.cuda_graph import capture
from npa_envs.world.randomness import Randomness
from npa_envs.world.rollout import rollout

HORIZONS = {
    "morphogenesis2d": 512,
    "morphogenesis3d": 128,
    "texture": 512,
    "point_classification": 32,
}
"""Steps after which rules of a task are judged."""

WORKS = 2.0
"""A rule works where its loss is at most this many times that as trained, and all is finite."""

QUICK_HORIZON = 64
"""The most of them in a quick run."""

QUICK_PARTICLES = 1024
"""The most particles in a quick run."""

QUICK_CLOUD = 128
"""The most particles of a cloud in a quick run."""

SMALLEST_VIEWS: dict[str, Any] = {"resolution": 16, "training_views": 1, "held_out_views": 1}
"""Fields of 3D tasks whose target nobody looks at."""

CHUNK = 50
"""Steps that are recorded in one CUDA graph."""


@dataclass(frozen=True)
class Habitat:
    """A float32 rule, its seeds x [B, N, D], s [B, N, C], and its horizon in steps."""

    rule: NPARule
    task: Task
    """What its worlds are for: radius, box, probability of updates, loss and metric."""
    x: Tensor
    s: Tensor
    horizon: int

    def options(self, **changed: Any) -> dict[str, Any]:
        """Return what `rollout` is given: as trained, but for what is changed."""
        task = self.task
        return {"eps": task.eps, "box": task.box, "update_prob": task.update_prob} | changed

    def at_trained_size(self, x: Tensor, eps: float) -> Tensor:
        """Return positions [B, N, D] as large as they would be at the radius of training.

        Scaling positions and ε alike is a symmetry of the dynamics, so what grows in open space at
        another ε is as much larger. Boxes and particles that do not move keep their size.
        """
        free = self.task.box is None and not self.rule.static
        return x * (self.task.eps / eps) if free and eps != self.task.eps else x

    def metric(self, x: Tensor, s: Tensor) -> float:
        """Return how far worlds are from the goal, mean; lower is better."""
        with torch.no_grad():
            return float(self.task.metric(x, s).mean())


def rule_names() -> list[str]:
    """Return the names of the shipped rules."""
    return list(shipped_rules())


def task_name(rule: str) -> str:
    """Return the name of the task that a shipped rule was trained on."""
    return rule_metadata(shipped_rules()[rule])["task"]


def habitat(
    session: Session,
    name: str,
    *,
    world_count: int = 1,
    particles: float = 1.0,
    looks: bool = True,
) -> Habitat:
    """Return a shipped rule with seeds of its task.

    Args:
        session: Where, and whether worlds are to be small.
        name: The rule's name.
        world_count: Worlds B.
        particles: Particles over those it was trained with or, in a quick run, over the most there.
        looks: Whether loss or metric will be asked for; a 3D target takes long to make.
    """
    key = ("task", name, particles, looks)
    rule, task = session.once(key, lambda: _task(session, name, particles, looks))
    x, s, goal = seed_worlds(
        task, world_count, generator=session.generator(), device=session.device
    )
    horizon = HORIZONS[task_name(name)]
    return Habitat(
        rule,
        task_toward(task, goal),
        x.float(),
        s.float(),
        min(horizon, QUICK_HORIZON) if session.quick else horizon,
    )


def _task(session: Session, name: str, particles: float, looks: bool) -> tuple[NPARule, Task]:
    """Load a rule and make its task."""
    rule = load_rule(name, device=session.device).float().requires_grad_(False)
    fields = {} if looks or rule.space_dim == 2 else SMALLEST_VIEWS
    count = trained_particles(session, name)
    task = task_of_rule(
        name, rule, session.device, particle_count=max(1, round(particles * count)), **fields
    ).task
    return rule, task


def trained_particles(session: Session, name: str) -> int:
    """Return how many particles a world of a rule has where their number is not what is varied."""
    path = shipped_rules()[name]
    count = int(trained_config(path, rule_metadata(path)).task.particle_count)
    # Clouds are sampled farthest point by farthest point, all of them.
    most = QUICK_CLOUD if task_name(name) == "point_classification" else QUICK_PARTICLES
    return min(count, most) if session.quick else count


class LongRun:
    """Worlds that are run for very long, without gradients; `options` are those of `rollout`.

    On CUDA, a chunk of steps is recorded as a graph, which is replayed: their launches would take
    most of the time.
    """

    def __init__(
        self, home: Habitat, generator: Randomness, options: dict[str, Any], *, chunk: int = CHUNK
    ) -> None:
        self.x, self.s = home.x.clone(), home.s.clone()
        self._rule, self._generator, self._options = home.rule, generator, options
        self.eps: float = options["eps"]
        """Perception radius [length units]."""
        self._steps = chunk
        self._graph: torch.cuda.CUDAGraph | None = None

    def advance(self, steps: int) -> None:
        """Run some steps more."""
        if self.x.is_cuda:
            own = self._generator if isinstance(self._generator, torch.Generator) else None
            while steps >= self._steps:
                if self._graph is None:
                    # The warm-up is a chunk of the run.
                    self._graph = capture(
                        self._chunk, self.x.device, generator=own, warm_up=self._chunk
                    )
                else:
                    self._graph.replay()
                steps -= self._steps
        if steps:
            self._run(steps)

    def _chunk(self) -> None:
        self._run(self._steps)

    @torch.no_grad()
    def _run(self, steps: int) -> None:
        x, s = rollout(
            self._rule, self.x, self.s, steps, generator=self._generator, **self._options
        )
        self.x.copy_(x)
        self.s.copy_(s)

    def marks(self, marks: list[int]) -> Iterator[tuple[int, Tensor, Tensor]]:
        """Yield steps, positions and states after each of some numbers of steps, increasing."""
        done = 0
        for mark in marks:
            self.advance(mark - done)
            done = mark
            yield mark, self.x, self.s
