"""Rules in the worlds that they were trained for, and for 100 000 steps in them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.measure.accuracy.suite import Check, CheckResult, CheckSession, check
from npa_envs.rule.files import load_rule, rule_file, rule_metadata, shipped_rules
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import Task
from npa_envs.training.task_of_rule import task_of_rule, trained_config
from npa_envs.world.brushes import nearest_image
from npa_envs.world.cuda_graph import GraphSequence, capture
from npa_envs.world.randomness import Randomness
from npa_envs.world.rollout import rollout

TASKS = ("morphogenesis2d", "morphogenesis3d", "texture", "point_classification")
"""Tasks whose rules are measured."""

QUICK_PARTICLES, QUICK_CLOUD = 1024, 128
"""The most particles, and particles of a cloud, in a quick run."""

SMALLEST_VIEWS: dict[str, Any] = {"resolution": 16, "training_views": 1, "held_out_views": 1}
"""Fields of 3D tasks whose target is not looked at: it takes long to make."""

SEEN_AT_ONCE = 1 << 17
"""Particles of the worlds whose loss is taken at once; views of Gaussians take much memory."""

CHUNK = 50
"""Steps that are recorded in one CUDA graph."""


@dataclass(frozen=True)
class TrialWorlds:
    """A float32 rule in worlds of its task, with their goals, where the task has such."""

    rule: NPARule
    task: Task
    x: Tensor
    s: Tensor
    goal: Tensor | None = None

    def options(self, **changed: Any) -> dict[str, Any]:
        """Return options of `rollout` as in training, but for what is changed."""
        task = self.task
        return {"eps": task.eps, "box": task.box, "update_prob": task.update_prob} | changed

    def at_trained_size(self, x: Tensor, eps: float) -> Tensor:
        """Return positions scaled to the radius of training.

        Scaling positions and ε alike is a symmetry of the dynamics in open space. Boxes and static
        particles keep their size.
        """
        free = self.task.box is None and not self.rule.static
        return x * (self.task.eps / eps) if free and eps != self.task.eps else x

    def with_worlds(self, x: Tensor, s: Tensor) -> TrialWorlds:
        """Return the same with other particles of K copies of all worlds, [K B, N, ...]."""
        goal = None if self.goal is None else self.goal.repeat(len(x) // len(self.goal))
        return replace(self, x=x, s=s, goal=goal)

    @torch.no_grad()
    def losses(self, x: Tensor, s: Tensor) -> Tensor:
        """Return the task's metric, [B]; of clouds, the share of particles that are wrong."""
        some = max(1, SEEN_AT_ONCE // x.shape[1])
        found = []
        for start in range(0, len(x), some):
            worlds = slice(start, start + some)
            goal = None if self.goal is None else self.goal[worlds]
            found.append(self.task.toward(goal).trial_metric(x[worlds], s[worlds]))
        return torch.cat(found)


def rule_names() -> list[str]:
    """Return the names of the shipped rules."""
    return list(shipped_rules())


def task_name(rule: str) -> str:
    """Return the name of the task that a rule was trained on, as its file says."""
    metadata = rule_metadata(rule_file(rule))
    if metadata.get("task") not in TASKS:
        raise NPAError(
            f"the rule's file must say on which task it was trained, {rule!r} says "
            f"{metadata.get('task')!r}: give a rule that npa-envs train has saved"
        )
    return metadata["task"]


def habitat(
    session: CheckSession, name: str, *, world_count: int = 1, particles: float = 1.0
) -> TrialWorlds:
    """Return a rule, shipped or of a file, with seeds of its task, whose target is not looked at.

    `particles` is over those it was trained with or, in a quick run, over the most there.
    """
    if (name, particles) not in session.kept:
        rule = load_rule(name, device=session.device).float().requires_grad_(False)
        fields = {} if rule.space_dim == 2 else SMALLEST_VIEWS
        path = rule_file(name)
        count = int(trained_config(path, rule_metadata(path)).task.particle_count)
        # Clouds are sampled farthest point by farthest point, which is slow.
        most = QUICK_CLOUD if task_name(name) == "point_classification" else QUICK_PARTICLES
        count = max(1, round(particles * (min(count, most) if session.quick else count)))
        found = task_of_rule(name, rule, session.device, particle_count=count, **fields)
        session.kept[name, particles] = rule, found.task
    rule, task = session.kept[name, particles]
    x, s, _, goal = task.seed(world_count, generator=session.generator(), device=session.device)
    return TrialWorlds(rule, task.toward(goal), x.float(), s.float(), goal)


class LongRun:
    """Long rollouts without gradients; `options` are those of `rollout`.

    On CUDA a chunk of steps is recorded as a graph: launches would take most of the time.
    """

    def __init__(
        self, home: TrialWorlds, random: Randomness, options: dict[str, Any], chunk: int = CHUNK
    ) -> None:
        self.x, self.s = home.x.clone(), home.s.clone()
        self._rule, self._random, self._options = home.rule, random, options
        self.eps: float = options["eps"]
        """Perception radius [length units]."""
        self._steps = chunk
        self._graph: GraphSequence | None = None

    def advance(self, steps: int) -> None:
        """Run some steps more."""
        own = self._random if isinstance(self._random, torch.Generator) else None
        chunk = partial(self._run, self._steps)
        while self.x.is_cuda and steps >= self._steps:
            if self._graph is None:
                # The warm-up is a chunk of the run.
                self._graph = capture(chunk, self.x.device, generator=own, warm_up=chunk)
            else:
                self._graph.replay()
            steps -= self._steps
        if steps:
            self._run(steps)

    @torch.no_grad()
    def _run(self, steps: int) -> None:
        x, s = rollout(self._rule, self.x, self.s, steps, generator=self._random, **self._options)
        self.x.copy_(x)
        self.s.copy_(s)

    def marks(self, marks: Sequence[int]) -> Iterator[tuple[int, Tensor, Tensor]]:
        """Yield steps, positions and states after each of increasing numbers of steps."""
        for mark, before in zip(marks, (0, *marks), strict=False):
            self.advance(mark - before)
            yield mark, self.x, self.s


# The group `time`: every shipped rule for 100 000 steps.

STEPS, QUICK_STEPS = 100_000, 200

SETTLED = 512
"""Step whose worlds later ones are compared with; half of the run where that is sooner."""

MARKS = 16
"""Measurements of worlds after that."""

ENERGY_STEPS = 16
"""Steps whose mean is the energy: of a world at rest single steps differ by a hundred times."""

BOUNDS = {
    "not_finite": 0.0,
    "extent": 2.0,
    "overflow": 0.1,
    "largest_state": 8.0,
    "energy": 4.0,
    "drift": 1.0,
}
"""Bounds of figures, which are the largest after the world has settled.

`extent`: longest side of the bounding box, over that of the settled world. `overflow`: mean
|s − clip(s, −1, 1)|. `largest_state`: the largest |s|. `energy`: mean over particles of |Δx|²/ε² +
mean Δs² of a step, over that of the settled world, each the mean of `ENERGY_STEPS`. `drift`: how
far the centroid is from where it was, in extents of the settled world; where a rule moves its
particles in open space.
"""

ENDURANCE: list[Check] = []
"""The check of the group `time`, of a rule."""


def measured(
    home: TrialWorlds, x: Tensor, s: Tensor, generator: torch.Generator
) -> dict[str, float]:
    """Return the figures of worlds by themselves; the energy takes some more steps."""
    with torch.no_grad():
        not_finite = (~x.isfinite()).sum() + (~s.isfinite()).sum()
        if int(not_finite):
            return {"not_finite": float(not_finite)}
        energy = torch.zeros((), device=x.device)
        before = x, s
        for _ in range(ENERGY_STEPS):
            after = rollout(home.rule, *before, 1, generator=generator, **home.options())
            moved = nearest_image(after[0] - before[0], home.task.box)
            energy += (moved / home.task.eps).square().sum(-1).mean()
            energy += (after[1] - before[1]).square().mean()
            before = after
        return {
            "not_finite": 0.0,
            "extent": float((x.amax(1) - x.amin(1)).amax()),
            "overflow": float((s - s.clamp(-1.0, 1.0)).abs().mean()),
            "largest_state": float(s.abs().max()),
            "energy": float(energy / ENERGY_STEPS),
        }


@check(ENDURANCE, "time")
def _run(name: str, session: CheckSession) -> CheckResult:
    """No number becomes infinite or NaN; the extent at most doubles, updates have at most four
    times the energy of the settled world's, states stay within 8 and on average within 1.1, the
    centroid moves by an extent at most."""
    home = habitat(session, name)
    steps = QUICK_STEPS if session.quick else STEPS
    settled = min(SETTLED, steps // 2)
    # Evenly spread on a logarithmic scale.
    marks = [round(settled * (steps / settled) ** (k / MARKS)) for k in range(MARKS + 1)]
    run = LongRun(home, session.generator(1), home.options())
    own_steps = session.generator(2)
    open_space = home.task.box is None and not home.rule.static
    figures: dict[str, float] = {"steps": float(steps), "particles": float(home.x.shape[1])}
    limits = {key: limit for key, limit in BOUNDS.items() if key != "drift" or open_space}
    first: dict[str, float] = {}
    centroid = home.x.mean(1)
    note = ""
    for step, x, s in run.marks(marks):
        found = measured(home, x, s, own_steps)
        if not first and not found["not_finite"]:
            first, centroid = dict(found), x.mean(1)
        if not found["not_finite"]:
            if open_space:
                found["drift"] = float((x.mean(1) - centroid).norm(dim=-1).max())
            for key, unit in (("extent", "extent"), ("energy", "energy"), ("drift", "extent")):
                if key in found:
                    # A world that has come to rest: what it does then is rounding.
                    found[key] /= max(first[unit], 1e-12)
        for key, value in found.items():
            figures[key] = max(value, figures.get(key, 0.0))
        over = [key for key, limit in limits.items() if not found.get(key, 0.0) <= limit]
        if over and not note:
            note = f"{', '.join(over)} above the bound at step {step}"
        if found["not_finite"]:
            break
    return CheckResult(figures, limits, note=note)
