"""Accuracy of a rule that classifies clouds, and whether it changes its mind when they change."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.measure.quality.evaluation import Runner, check_steps
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.point_classification import PointClassification, majority, particle_classes

CLOUD_CHECKPOINTS = (8, 16, 24, 32, 64, 128)
"""Steps after which clouds are asked for their class, unless others are given."""

CUT_SHARE = 0.25
"""Share of its particles that a cut cloud loses."""

BATCH = 256
"""Clouds that are run at once."""


@dataclass(frozen=True)
class AccuracyRow:
    """All clouds after a number of steps."""

    step: int
    """Steps from blank states."""
    majority: float
    """Share of the clouds whose majority says the right class."""
    particle: float
    """Share of all particles that say the right class."""
    agreement: float
    """Share of all particles that say what their cloud's majority says."""
    loss: float
    """Mean squared error to the class (dimensionless)."""
    overflow: float
    """mean |s − clip(s, −1, 1)| (dimensionless)."""


@dataclass(frozen=True)
class ChangeRow:
    """All clouds, some steps after something was done to them."""

    change: str
    """What was done; the states of the particles were left as they were."""
    steps: int
    """Steps since."""
    majority: float
    """Share of the clouds whose majority says the class that they now show."""
    particle: float
    """Share of all particles that say so."""
    majority_before: float
    """Share of the clouds whose majority says the class that they showed before."""


@torch.no_grad()
def accuracies(
    rule: NPARule,
    task: PointClassification,
    *,
    checkpoints: Sequence[int] = CLOUD_CHECKPOINTS,
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
) -> list[AccuracyRow]:
    """Let a rule classify all clouds of a task, and count who is right along the way.

    Args:
        rule: The rule, on the device of the task.
        task: Gives the clouds: those of its split, as they are.
        checkpoints: Steps to ask at, positive and increasing.
        seed: Randomness of the updates.
        progress: Called with the number of steps done since its last call.

    Returns:
        One row for each of `checkpoints`.

    Raises:
        NPAError: `checkpoints` are empty or out of order.
    """
    check_steps("checkpoints", checkpoints)
    clouds = _Clouds(rule, task, seed, progress)
    sums = torch.zeros(len(checkpoints), 5, dtype=torch.float64)
    for index in clouds.batches():
        x, label, s = clouds.blank(index)
        aimed = clouds.task.toward(label)
        before = 0
        for row, step in enumerate(checkpoints):
            s = clouds.states(x, s, step - before)
            before = step
            outputs = clouds.task.outputs(s)
            says, most = particle_classes(outputs), majority(outputs)
            overflow = (s - s.clamp(-1.0, 1.0)).abs().mean((1, 2))
            figures = (
                (most == label).double(),
                (says == label[:, None]).double().mean(1),
                (says == most[:, None]).double().mean(1),
                aimed.metric(x, s).double(),
                overflow.double(),
            )
            sums[row] += torch.stack([figure.sum() for figure in figures]).cpu()
    means = (sums / clouds.cloud_count).tolist()
    return [AccuracyRow(step, *row) for step, row in zip(checkpoints, means, strict=True)]


@torch.no_grad()
def changes_of_mind(
    rule: NPARule,
    task: PointClassification,
    *,
    settle_steps: int = 32,
    steps: Sequence[int] = (0, 32, 64, 128),
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
) -> list[ChangeRow]:
    """Let clouds settle on a class, change them, and count what they say then.

    A cut cloud loses a quarter of its particles, on a random side. A mutated one becomes a cloud of
    another class, wholly or in its upper half: its particles move there and keep their states.

    Args:
        rule: The rule, on the device of the task.
        task: Gives the clouds, as for `accuracies`.
        settle_steps: Steps from blank states to the change.
        steps: Steps after the change to ask at, 0 or more and increasing.
        seed: Randomness of the updates and of the cuts.
        progress: Called with the number of steps done since its last call.

    Returns:
        One row for each change and each of `steps`.

    Raises:
        NPAError: A number of steps is out of range, or half of all clouds or more are of one class.
    """
    check_steps("settle_steps", [settle_steps])
    check_steps("steps", [1 + step for step in steps])
    clouds = _Clouds(rule, task, seed, progress)
    partner = _partners(clouds.label)
    names = (f"{CUT_SHARE:.0%} cut off", "upper half mutated", "all mutated")
    sums = torch.zeros(len(names), len(steps), 3, dtype=torch.float64)
    for index in clouds.batches():
        x, label, s = clouds.blank(index)
        other_x, other = clouds.x[partner[index]], clouds.label[partner[index]]
        s = clouds.states(x, s, settle_steps)
        changed = (
            (*_cut(x, s, clouds.generator), label),
            (*_chimera(x, s, other_x), other),
            (other_x, s, other),
        )
        for number, (new_x, new_s, goal) in enumerate(changed):
            before = 0
            for row, step in enumerate(steps):
                new_s = clouds.states(new_x, new_s, step - before)
                before = step
                outputs = clouds.task.outputs(new_s)
                most = majority(outputs)
                right = (particle_classes(outputs) == goal[:, None]).double().mean(1)
                figures = ((most == goal).double(), right, (most == label).double())
                sums[number, row] += torch.stack([figure.sum() for figure in figures]).cpu()
    means = (sums / clouds.cloud_count).tolist()
    return [
        ChangeRow(name, step, *row)
        for name, rows in zip(names, means, strict=True)
        for step, row in zip(steps, rows, strict=True)
    ]


def _cut(x: Tensor, s: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return clouds without the particles that lie farthest to one side, random for each."""
    normal = torch.randn(len(x), 2, generator=generator, device=x.device, dtype=x.dtype)
    order = (x * normal[:, None]).sum(-1).argsort(dim=1)
    kept = order[:, : max(1, round((1.0 - CUT_SHARE) * x.shape[1])), None]
    return x.gather(1, kept.expand(-1, -1, 2)), s.gather(1, kept.expand(-1, -1, s.shape[2]))


def _chimera(x: Tensor, s: Tensor, other_x: Tensor) -> tuple[Tensor, Tensor]:
    """Return clouds of the lower half of one and the upper half of the other, lowest first."""
    order = x[..., 1].argsort(dim=1)[..., None]
    other_order = other_x[..., 1].argsort(dim=1)[..., None]
    half = x.shape[1] // 2
    low = x.gather(1, order.expand_as(x))[:, :half]
    high = other_x.gather(1, other_order.expand_as(other_x))[:, half:]
    return torch.cat((low, high), dim=1), s.gather(1, order.expand_as(s))


def _partners(label: Tensor) -> Tensor:
    """Return for each cloud the index of one of another class, each cloud once; shape [M]."""
    largest = int(label.bincount().max())
    if 2 * largest > len(label):
        raise NPAError(
            f"no class may have more than half of the clouds, got {largest} of {len(label)}: "
            "mutated digits need others to become"
        )
    order = label.argsort(stable=True)
    partner = torch.empty_like(order)
    # Classes lie side by side in this order, none of them longer than this.
    partner[order] = order.roll(-largest)
    return partner


class _Clouds(Runner):
    """A rule on the clouds of a task, some at a time."""

    def __init__(
        self,
        rule: NPARule,
        task: PointClassification,
        seed: int,
        progress: Callable[[int], None] | None,
    ) -> None:
        super().__init__(rule, task, task.clouds.x.device, seed, progress)
        self.x, self.label = task.clouds.x.to(self.dtype), task.clouds.label
        self.cloud_count = len(self.label)

    def batches(self) -> Iterator[Tensor]:
        """Yield the indices of some clouds after the other."""
        indices = torch.arange(self.cloud_count, device=self.x.device)
        yield from torch.split(indices, BATCH)

    def blank(self, index: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return positions [B, N, 2], classes [B] and blank states [B, N, C] of some clouds."""
        x = self.x[index]
        return x, self.label[index], x.new_zeros(*x.shape[:2], self.task.config.state_dim)

    def states(self, x: Tensor, s: Tensor, steps: int) -> Tensor:
        """Return the states after some steps; positions stay as they are."""
        return self.run(x, s, steps)[1]
