"""Trained rules in worlds of their task, and checks of 100 000 steps."""

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
"""Tasks whose rules can be checked."""

QUICK_PARTICLES, QUICK_CLOUD = 1024, 128
"""Most particles of a world, and of a cloud, in a quick run."""

MIN_VIEWS: dict[str, Any] = {"resolution": 16, "training_views": 1, "held_out_views": 1}
"""Fields of 3D tasks whose target is not used, as large views take long to make."""

LOSS_PARTICLES = 1 << 17
"""Most particles of a batch of worlds for a loss, as views of Gaussians take much memory."""

CHUNK = 50
"""Steps that are recorded in one CUDA graph."""


@dataclass(frozen=True)
class TrialWorlds:
    """A float32 rule, its task, and worlds of it with their goals, if any."""

    rule: NPARule
    task: Task
    x: Tensor
    s: Tensor
    goal: Tensor | None = None

    def options(self, **changed: Any) -> dict[str, Any]:
        """Return the options of `rollout` of training, except those in `changed`."""
        task = self.task
        return {"eps": task.eps, "box": task.box, "update_prob": task.update_prob} | changed

    def at_trained_size(self, x: Tensor, eps: float) -> Tensor:
        """Return positions at the scale of training, from a run with radius `eps`.

        In open space the dynamics do not change if positions and ε are scaled by one factor.
        Positions in boxes and of static particles are not scaled.
        """
        free = self.task.box is None and not self.rule.static
        return x * (self.task.eps / eps) if free and eps != self.task.eps else x

    def with_worlds(self, x: Tensor, s: Tensor) -> TrialWorlds:
        """Return a copy with the particles of K copies of all worlds, [K B, N, ...]."""
        goal = None if self.goal is None else self.goal.repeat(len(x) // len(self.goal))
        return replace(self, x=x, s=s, goal=goal)

    @torch.no_grad()
    def losses(self, x: Tensor, s: Tensor) -> Tensor:
        """Return the task's metric, [B]; of clouds the fraction of wrong particles."""
        size = max(1, LOSS_PARTICLES // x.shape[1])
        found = []
        for start in range(0, len(x), size):
            worlds = slice(start, start + size)
            goal = None if self.goal is None else self.goal[worlds]
            found.append(self.task.toward(goal).trial_metric(x[worlds], s[worlds]))
        return torch.cat(found)


def rule_names() -> list[str]:
    """Return the names of the shipped rules."""
    return list(shipped_rules())


def task_name(rule: str) -> str:
    """Return the name of the task that a rule was trained on, from its file."""
    metadata = rule_metadata(rule_file(rule))
    if metadata.get("task") not in TASKS:
        raise NPAError(
            f"the rule's file must name the task of its training, {rule!r} names "
            f"{metadata.get('task')!r}: give a rule that npa-envs train has saved"
        )
    return metadata["task"]


def habitat(
    session: CheckSession, name: str, *, world_count: int = 1, particles: float = 1.0
) -> TrialWorlds:
    """Return a rule, shipped or of a file, with fresh worlds of its task.

    `particles` is a factor on the trained number, in a quick run on at most `QUICK_PARTICLES`.
    """
    if (name, particles) not in session.kept:
        rule = load_rule(name, device=session.device).float().requires_grad_(False)
        fields = {} if rule.space_dim == 2 else MIN_VIEWS
        path = rule_file(name)
        count = int(trained_config(path, rule_metadata(path)).task.particle_count)
        # Farthest point sampling of clouds is slow.
        most = QUICK_CLOUD if task_name(name) == "point_classification" else QUICK_PARTICLES
        count = max(1, round(particles * (min(count, most) if session.quick else count)))
        found = task_of_rule(name, rule, session.device, particle_count=count, **fields)
        session.kept[name, particles] = rule, found.task
    rule, task = session.kept[name, particles]
    x, s, _, goal = task.seed(world_count, generator=session.generator(), device=session.device)
    return TrialWorlds(rule, task.toward(goal), x.float(), s.float(), goal)


class LongRun:
    """Long rollouts without gradients; `options` are those of `rollout`.

    On CUDA a chunk of steps is recorded as a graph, as launches would take most of the time.
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
        """Run `steps` more steps."""
        own = self._random if isinstance(self._random, torch.Generator) else None
        chunk = partial(self._run, self._steps)
        while self.x.is_cuda and steps >= self._steps:
            if self._graph is None:
                # The warm-up counts as a chunk.
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
        """Yield step, positions and states at each of increasing steps."""
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
"""Bounds of figures, which are maxima over the steps after the world has settled.

`extent`: longest side of the bounding box, over that of the settled world. `overflow`: mean
|s − clip(s, −1, 1)|. `largest_state`: the largest |s|. `energy`: mean over particles of |Δx|²/ε² +
mean Δs² of a step, over that of the settled world, both averaged over `ENERGY_STEPS`. `drift`:
distance of the centroid from the settled one, in extents of the settled world; only for moving
particles in open space.
"""

ENDURANCE: list[Check] = []
"""The check of the group `time`, of a rule."""


def measured(
    home: TrialWorlds, x: Tensor, s: Tensor, generator: torch.Generator
) -> dict[str, float]:
    """Return the absolute figures of worlds; the energy runs `ENERGY_STEPS` more steps."""
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
                    # In a world at rest the rest is rounding.
                    found[key] /= max(first[unit], 1e-12)
        for key, value in found.items():
            figures[key] = max(value, figures.get(key, 0.0))
        over = [key for key, limit in limits.items() if not found.get(key, 0.0) <= limit]
        if over and not note:
            note = f"{', '.join(over)} above the bound at step {step}"
        if found["not_finite"]:
            break
    return CheckResult(figures, limits, note=note)
