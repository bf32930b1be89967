"""Interaction of two trained rules in one world (arXiv 2601.16096), in numbers.

The effect of rule B on rule A is measured by the loss (task metric) of A's particles, compared with
worlds that have only A and start from the same random seeds.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.checks import check_field, check_positive
from npa_envs.errors import NPAError
from npa_envs.measure.benchmark_records import Record
from npa_envs.measure.plots import heat_map
from npa_envs.measure.quality import FIRST_SEED, PROGRESS_STEPS
from npa_envs.ops import species_fields
from npa_envs.render import draw_worlds
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import Task
from npa_envs.world.divergence import divergence
from npa_envs.world.particles import Particles, combined
from npa_envs.world.randomness import StreamId, WorldRandom
from npa_envs.world.species import rollout_species

MIXED = 0.25
"""Mixing index from which on two species are said to mix (dimensionless)."""


@dataclass(frozen=True, kw_only=True)
class InteractionSettings:
    """Settings of an interaction measurement, which runs for all combinations of tuples."""

    seed_count: int = 8
    """Number B of worlds of each pair of rules, from random seeds that training does not use."""
    distances: tuple[float, ...] = (0.0, 0.5, 1.0)
    """Distances between the centres of the two rules' particles at the start [length units]."""
    ratios: tuple[float, ...] = (0.5,)
    """Fractions of the particles that belong to the measured rule."""
    eps_factors: tuple[float, ...] = (1.0,)
    """Perception radii / the radius that the rules were trained with (dimensionless)."""
    steps: int = 512
    """Steps of each run."""
    particle_count: int | None = None
    """Particles of both rules together; None: the largest number that a rule was trained with."""
    margin: float = 0.2
    """Relative change of a loss up to which it counts as unchanged."""

    def __post_init__(self) -> None:
        check_positive(self, int, "steps", "seed_count")
        if self.particle_count is not None:
            check_positive(self, int, "particle_count", at_least=2)
        for name in ("distances", "eps_factors"):
            values = getattr(self, name)
            legal = len(values) > 0 and all(0.0 <= value < math.inf for value in values)
            check_field(self, name, legal, "be finite and not negative, one or more")
        fractions = *self.ratios, self.margin
        if not (self.ratios and all(0.0 < value < 1.0 for value in fractions)):
            raise NPAError(
                f"ratios and margin must lie in (0, 1), got {self.ratios} and {self.margin}"
            )


@dataclass(frozen=True)
class InteractionRow:
    """Rule A (`rule`) in worlds with rule B (`beside`), after all steps; numbers are means.

    At the start the centres are `distance` apart [length units]; `ratio` is A's fraction of the
    particles. `alone` and `together` are the losses of A's particles without and with B, `change`
    is together / alone, `displacement` the distance between A's centroids in both [length units],
    `mixing` the `mixing_index`. `..._low` and `..._high` are the ends of 95 % intervals.
    """

    rule: str
    beside: str
    distance: float
    ratio: float
    alone: float
    together: float
    change: float
    mixing: float
    displacement: float
    verdict: str
    eps_factor: float = 1.0
    change_low: float = math.nan
    change_high: float = math.nan
    mixing_low: float = math.nan
    mixing_high: float = math.nan


def verdict(change: float, mixing: float, margin: float) -> str:
    """Return "cooperates" for a change below 1 - margin, "undisturbed" for one up to 1 + margin.

    Otherwise it is "disrupted". ", mixes" follows if the mixing index is at least `MIXED`.
    """
    word = "disrupted"
    if change < 1.0 - margin:
        word = "cooperates"
    elif change <= 1.0 + margin:
        word = "undisturbed"
    return f"{word}, mixes" if mixing >= MIXED else word


def ratio_interval(numerators: Tensor, denominators: Tensor) -> tuple[float, float]:
    """Return both ends of the 95 % bootstrap interval of mean(numerators) / mean(denominators).

    Worlds are resampled. Numerators [B] may be infinite, denominators [B] are finite and >= 0.
    """
    count = len(numerators)
    chosen = np.random.default_rng(0).integers(count, size=(2000, count))
    above, below = (
        values.double().cpu().numpy()[chosen].mean(axis=1) for values in (numerators, denominators)
    )
    ratios = np.divide(above, below, out=np.full_like(above, np.inf), where=below > 0.0)
    # Without interpolation, which between two infinite numbers is NaN.
    low, high = np.quantile(ratios, (0.025, 0.975), method="nearest")
    return float(low), float(high)


def mixing_index(x: Tensor, counts: Sequence[int], *, eps: float) -> Tensor:
    """Return how much K >= 2 species are mixed in each world, from 0 to 1 (dimensionless), [B].

    It is the mean over particles of the entropy of each species' fraction of the particle's
    density, divided by log K. 0 means that no particle perceives another species, 1 that all
    perceive all species equally. `counts` are the particles of each species, in order.
    """
    rho = species_fields(x, counts, eps=eps).rho
    fractions = rho / rho.sum(dim=2, keepdim=True)
    entropy: Tensor = torch.special.entr(fractions).sum(dim=2)
    return entropy.mean(dim=1) / math.log(rho.shape[2])


FRAME_TIMES = (0.0, 0.125, 0.25, 0.5, 1.0)
"""Times of pictures / duration of the run."""


class RuleUnderTest(NamedTuple):
    """A trained rule that grows pictures, and its task."""

    name: str
    rule: NPARule
    task: Task

    def with_count(self, particle_count: int) -> Task:
        """Return the rule's task in worlds with `particle_count` particles."""
        return self.task.resized(particle_count).for_rule(self.rule)


class Encounters:
    """Grows pairs of rules together, and each one without the other, from the same random seeds.

    Rules that cannot share a world raise NPAError. `progress` gets the number of new steps.
    """

    def __init__(
        self,
        rules: Sequence[RuleUnderTest],
        settings: InteractionSettings,
        progress: Callable[[int], None] = lambda _: None,
    ) -> None:
        self.settings = settings
        self.particle_count = settings.particle_count or max(
            rule.task.config.particle_count for rule in rules
        )
        """Particles of both rules together."""
        self._progress = progress
        self._frame_steps = [round(time * settings.steps) for time in FRAME_TIMES]
        self._alone: dict[tuple[str, int, float], tuple[Tensor, Tensor]] = {}
        """Results of `_grown_alone` by rule, number of particles and factor on the radius."""
        for other in rules:
            weight = other.rule.hidden.weight
            x, s = weight.new_zeros(1, 2, 2), weight.new_zeros(1, 2, other.rule.state_dim)
            try:
                rollout_species([rules[0].rule, other.rule], x, s, 0, counts=[1, 1])
            except NPAError as error:
                raise NPAError(
                    f"{rules[0].name} and {other.name} cannot share a world: {error}"
                ) from error

    @torch.no_grad()
    def meet(
        self, first: RuleUnderTest, second: RuleUnderTest
    ) -> tuple[list[InteractionRow], dict[str, NDArray[np.uint8]]]:
        """Grow `first` together with `second`; return a row about `first` for each setting.

        Also returns pictures of the first worlds at `FRAME_TIMES`, uint8, [R, R, 3], by caption.
        """
        rows, frames, settings = [], {}, self.settings
        for factor, ratio, distance in itertools.product(
            settings.eps_factors, settings.ratios, settings.distances
        ):
            count = min(max(round(ratio * self.particle_count), 1), self.particle_count - 1)
            counts = count, self.particle_count - count
            losses_alone, centroids_alone = self._grown_alone(first, count, factor)
            radius = "" if factor == 1.0 else f"eps x {factor:g}, "
            together = self._grow([first, second], counts, distance, factor)
            for step, worlds, diverged in together:  # noqa: B007 - read after the loop
                if step in self._frame_steps:
                    caption = f"{radius}d {distance:g}, r {ratio:g}, step {step}"
                    # Of the first world, centred between the two start positions.
                    (frames[caption],) = draw_worlds(
                        worlds.x[:1],
                        worlds.s[:1],
                        centre=(0.5 * distance, 0.0),
                        resolution=160,
                        pixel_size=0.5 * math.sqrt(4.0 / self.particle_count),
                        half_width=1.2 + 0.5 * distance,
                    )
            losses, centroids = _loss_and_centroid(first, worlds.split(counts)[0], diverged)
            alone, beside = losses_alone.mean().item(), losses.mean().item()
            change = beside / alone if alone > 0.0 else math.inf
            mixings = mixing_index(worlds.x, counts, eps=factor * first.rule.eps0)
            mixing = mixings.mean().item()
            moved = (centroids - centroids_alone).norm(dim=-1)
            row = InteractionRow(
                first.name, second.name, distance, ratio,
                alone, beside, change, mixing, moved.mean().item(),
                verdict(change, mixing, settings.margin), factor,
                *ratio_interval(losses, losses_alone),
                *ratio_interval(mixings, torch.ones_like(mixings)),
            )  # fmt: skip
            rows.append(row)
        return rows, frames

    def _grown_alone(self, rule: RuleUnderTest, count: int, factor: float) -> tuple[Tensor, Tensor]:
        """Return losses [B] and centroids [B, 2] of worlds of one rule, with `count` particles."""
        key = rule.name, count, factor
        if key not in self._alone:
            *_, (_, worlds, diverged) = self._grow([rule], [count], 0.0, factor)
            self._alone[key] = _loss_and_centroid(rule, worlds, diverged)
        return self._alone[key]

    def _grow(
        self,
        rules: Sequence[RuleUnderTest],
        counts: Sequence[int],
        distance: float,
        factor: float,
    ) -> Iterator[tuple[int, Particles, Tensor]]:
        """Grow one or two species; yield steps, the worlds then, and whether each diverged, [B].

        The first species starts at the origin, by random numbers that do not depend on the second;
        the second starts at `distance` along the first axis. `factor` multiplies the perception
        radius. Worlds that diverge stay as they were before.
        """
        weight = rules[0].rule.hidden.weight
        seeds = range(FIRST_SEED, FIRST_SEED + self.settings.seed_count)
        random = WorldRandom(seeds, device=weight.device)
        species = []
        for k, (rule, count) in enumerate(zip(rules, counts, strict=True)):
            stream = random.substream(StreamId.SPECIES) if k else random
            seeded = rule.with_count(count).seed(len(seeds), generator=stream, device=weight.device)
            seeded.x[..., 0] += k * distance
            species.append(seeded)
        worlds = combined(partial(torch.cat, dim=1), species).map(lambda part: part.to(weight))
        diverged = torch.zeros(len(seeds), dtype=torch.bool, device=weight.device)
        stops = sorted({*range(0, self.settings.steps, PROGRESS_STEPS), *self._frame_steps})
        for before, step in zip([0, *stops], stops, strict=False):
            x, s = rollout_species(
                [rule.rule for rule in rules],
                worlds.x,
                worlds.s,
                step - before,
                counts=counts,
                eps=factor * rules[0].rule.eps0,
                update_prob=[rule.task.update_prob for rule in rules],
                generator=random,
                density_counts=counts,
            )
            broken = divergence(x, s).non_finite
            worlds = worlds.where(broken, worlds._replace(x=x, s=s))
            diverged = diverged | broken
            self._progress(step - before)
            yield step, worlds, diverged


def _loss_and_centroid(
    rule: RuleUnderTest, worlds: Particles, diverged: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the loss of worlds of one rule (inf if diverged), [B], and centroids, [B, 2]."""
    losses = rule.with_count(worlds.x.shape[1]).metric(worlds.x, worlds.s)
    return losses.masked_fill(diverged, math.inf), worlds.x.mean(dim=1)


class InteractionRecord(Record[InteractionRow]):
    """The rows of all pairs of rules and all settings, and their JSON file."""

    command, key = "rule-interaction", "settings"

    def parse(self, content: dict[str, Any]) -> list[InteractionRow]:
        """Return the rows in the JSON object of a file, where null stands for infinity."""
        rows: list[dict[str, Any]] = [
            {k: math.inf if v is None else v for k, v in row.items()} for row in content["rows"]
        ]
        return [InteractionRow(**row) for row in rows]


def interaction_map(rows: Sequence[InteractionRow]) -> bytes:
    """Return a PNG of a heat map for each setting: the loss of rule A (row) with B / without B."""
    names = list(dict.fromkeys([row.rule for row in rows] + [row.beside for row in rows]))
    cells: dict[str, dict[tuple[str, str], float]] = {}
    for row in rows:
        radius = "" if row.eps_factor == 1.0 else f", ε × {row.eps_factor:g}"
        title = f"loss together / alone, distance {row.distance:g}, ratio {row.ratio:g}{radius}"
        cells.setdefault(title, {})[row.rule, row.beside] = row.change
    matrices = {
        title: (names, names, [[changes.get((a, b)) for b in names] for a in names])
        for title, changes in cells.items()
    }
    return heat_map(matrices, colours="RdBu_r", largest=4.0)
