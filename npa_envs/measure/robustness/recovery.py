"""Damage and recovery: losses of damaged worlds and of undamaged twins with the same masks.

Damage is batched, around a random place of each world, across the seam of a box.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median

import torch
from torch import Tensor

from npa_envs.measure.robustness.trials import RuleTrial, TaskTrial, loss_curves
from npa_envs.ops import world_mean
from npa_envs.tasks.damage import DAMAGE_SIZES, random_particle
from npa_envs.world.brushes import clump, cut, nearest_image, offsets_from, wipe_state
from npa_envs.world.randomness import StreamId, WorldRandom

STATE_NOISE = 0.3
"""Standard deviation of the noise of states (dimensionless)."""

Box = tuple[float, ...] | None
Change = Callable[[Tensor, Tensor, WorldRandom, Box], tuple[Tensor, Tensor]]
"""Makes damaged worlds of positions, states, randomness and sides of the box."""


@dataclass(frozen=True)
class Damage:
    """Damage of worlds.

    `static` worlds can have it, whose particles do not move; it `halves` the number of particles;
    it is `beyond` what rules are asked to heal.
    """

    name: str
    apply: Change
    static: bool
    halves: bool = False
    beyond: bool = False


def wipe(x: Tensor, s: Tensor, random: WorldRandom, box: Box) -> tuple[Tensor, Tensor]:
    """Set all states in a disk around a random particle to zero, a ball in 3D."""
    away = offsets_from(x, random_particle(x, random), box)
    centre = torch.zeros_like(x[:, 0])
    return x, wipe_state(away, s, centre=centre, radius=DAMAGE_SIZES["wipe"])


def slit(x: Tensor, s: Tensor, random: WorldRandom, box: Box) -> tuple[Tensor, Tensor]:
    """Open a slit at a random angle: through the middle, in a box through a random particle."""
    centre = world_mean(x) if box is None else random_particle(x, random)
    normal = random.normal(x.shape[2], dtype=x.dtype)
    away = offsets_from(x, centre, box)
    origin = torch.zeros_like(centre)
    away, s = cut(away, s, centre=origin, normal=normal, gap=DAMAGE_SIZES["cut"])
    return nearest_image(away + centre[:, None], box), s


def pull_together(x: Tensor, s: Tensor, random: WorldRandom, box: Box) -> tuple[Tensor, Tensor]:
    """Pull all particles in a disk around a random one to its place."""
    centre = random_particle(x, random)
    away = offsets_from(x, centre, box)
    origin = torch.zeros_like(centre)
    away, s = clump(away, s, centre=origin, radius=DAMAGE_SIZES["clump"], factor=1.0)
    return nearest_image(away + centre[:, None], box), s


def add_state_noise(x: Tensor, s: Tensor, random: WorldRandom, box: Box) -> tuple[Tensor, Tensor]:
    """Add normal noise to all states."""
    return x, s + STATE_NOISE * random.normal(*s.shape[1:], dtype=s.dtype)


def remove_half(x: Tensor, s: Tensor, random: WorldRandom, box: Box) -> tuple[Tensor, Tensor]:
    """Leave N // 2 particles, chosen at random."""
    return _lowest_half(x, s, random.uniform(x.shape[1]))


def remove_side(x: Tensor, s: Tensor, random: WorldRandom, box: Box) -> tuple[Tensor, Tensor]:
    """Leave the N // 2 particles on one side of a line at a random angle, a plane in 3D.

    In a box the line runs through its middle, up to rounding.
    """
    normal = random.normal(x.shape[2], dtype=x.dtype)
    return _lowest_half(x, s, (x * normal[:, None]).sum(-1))


def _lowest_half(x: Tensor, s: Tensor, key: Tensor) -> tuple[Tensor, Tensor]:
    """Leave the particles with the lower keys [B, N], in the order that they have."""
    kept = key.argsort(dim=1)[:, : x.shape[1] // 2].sort(dim=1).values[..., None]
    return x.take_along_dim(kept, dim=1), s.take_along_dim(kept, dim=1)


DAMAGES = {
    damage.name: damage
    for damage in (
        Damage("wipe", wipe, static=True),
        Damage("cut", slit, static=False),
        Damage("clump", pull_together, static=False),
        Damage("noise", add_state_noise, static=True, beyond=True),
        Damage("half", remove_half, static=True, halves=True),
        Damage("side", remove_side, static=True, halves=True, beyond=True),
    )
}
"""Every damage by its name."""


# Recovery


RECOVERED = 1.1
"""A world has recovered once its loss is at most this many times its twin's at the same step."""

CONTROL = "nothing"
"""Name of worlds that only draw other masks than their twins."""

AFTERWARDS, OTHERWISE = 1001, 1002
"""Streams of the masks after the damage, and of those of the control."""


@dataclass(frozen=True)
class LossCurve:
    """Losses of all seeds, and of their twins without the damage, at steps after one damage.

    A loss is NaN where a world is not finite.
    """

    damage: str
    steps: tuple[int, ...]
    losses: tuple[tuple[float, ...], ...]
    twins: tuple[tuple[float, ...], ...]

    def recovery_steps(self) -> list[int | None]:
        """Return for each seed the first of `steps` at which it has recovered; None: at none."""
        pairs = zip(self.losses, self.twins, strict=True)
        return [recovery_step(self.steps, loss, twin) for loss, twin in pairs]

    def recovered(self) -> int:
        """Return how many seeds have recovered."""
        return sum(step is not None for step in self.recovery_steps())

    def median_step(self) -> float | None:
        """Return the median recovery time of those that recovered [steps]; None: none did."""
        found = [step for step in self.recovery_steps() if step is not None]
        return median(found) if found else None

    def ratios(self, place: int) -> list[float]:
        """Return for each seed the loss over its twin's at a place of `steps`: -1 is the end."""
        pairs = zip(self.losses, self.twins, strict=True)
        return [ratio(loss[place], twin[place]) for loss, twin in pairs]

    def within_at_end(self) -> int:
        """Return how many seeds are within `RECOVERED` at the last of `steps`."""
        return sum(value <= RECOVERED for value in self.ratios(-1))


def ratio(loss: float, twin: float) -> float:
    """Return a loss over a twin's; of two zeros it is 1."""
    if twin == 0.0:
        return 1.0 if loss == 0.0 else math.nan if math.isnan(loss) else math.inf
    return loss / twin


def recovery_step(
    steps: Sequence[int], losses: Sequence[float], twins: Sequence[float]
) -> int | None:
    """Return the first step at which a loss is at most `RECOVERED` times the twin's."""
    # Comparisons with NaN are false.
    rows = zip(steps, losses, twins, strict=True)
    return next((step for step, loss, twin in rows if loss <= RECOVERED * twin), None)


@torch.no_grad()
def healing(ground: RuleTrial, home: TaskTrial) -> list[LossCurve]:
    """Damage grown worlds in every way: a curve for the control and for each damage.

    Where half of the particles are removed, twins are worlds that were grown from as many.
    """
    chosen = [d for d in DAMAGES.values() if d.static or not ground.rule.static]
    found = _with_twins(ground, home, home, [d for d in chosen if not d.halves], control=True)
    smaller = ground.home(share=0.5)
    grown = ground.run(smaller, ground.random(StreamId.GROWTH))
    grown.advance(ground.plan.grow_steps)
    twins = smaller.with_worlds(grown.x, grown.s)
    return found + _with_twins(ground, home, twins, [d for d in chosen if d.halves], control=False)


def _with_twins(
    ground: RuleTrial,
    home: TaskTrial,
    twins: TaskTrial,
    damages: Sequence[Damage],
    *,
    control: bool,
) -> list[LossCurve]:
    """Run twins and damaged worlds as one batch."""
    steps = ground.plan.heal_steps
    copies = [(twins.x, twins.s)]
    keys = [ground.random(AFTERWARDS).keys]
    names = [damage.name for damage in damages]
    for damage in damages:
        random = ground.random(StreamId.DAMAGE)
        x, s = damage.apply(home.x, home.s, random, home.task.box)
        copies.append((x, home.task.coded(s)))
        keys.append(keys[0])
    if control:
        copies.append(copies[0])
        keys.append(ground.random(OTHERWISE).keys)
        names.append(CONTROL)
    x, s = (torch.cat(parts) for parts in zip(*copies, strict=True))
    batch = twins.with_worlds(x, s)
    run = ground.run(batch, WorldRandom.from_keys(torch.cat(keys)))
    losses = loss_curves(batch, run, steps).view(len(steps), len(copies), -1)
    # One row for each copy and seed.
    twin, *others = ground.by_seed(losses).permute(1, 2, 0).tolist()
    rows = [
        LossCurve(name, steps, tuple(map(tuple, other)), tuple(map(tuple, twin)))
        for name, other in zip(names, others, strict=True)
    ]
    return rows[-1:] + rows[:-1] if control else rows
