"""Interaction of two trained rules in one world (arXiv 2601.16096), in numbers.

The effect of a rule on another is measured by the task metric of the other's particles, compared
with the same seeds grown alone.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.measure.plots import draw_matrix, new_figure, png
from npa_envs.measure.record import Record
from npa_envs.ops import species_fields
from npa_envs.render import draw_worlds
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import Task
from npa_envs.world.randomness import StreamId, WorldRandom
from npa_envs.world.species import rollout_species

MARGIN = 0.2
"""A loss that changes by less than this fraction counts as undisturbed."""

MIXED = 0.25
"""Least mixing index of species that mix (dimensionless)."""


@dataclass(frozen=True, kw_only=True)
class InteractionSettings:
    """Settings of an interaction measurement."""

    particle_count: int
    """Particles of a world with two species, N."""
    distances: tuple[float, ...] = (0.0, 0.5, 1.0)
    """Distances between the centres of the two seeds [length units]."""
    ratios: tuple[float, ...] = (0.5,)
    """Fractions of the particles that belong to the measured species, in (0, 1)."""
    eps_factors: tuple[float, ...] = (1.0,)
    """Factors on the rules' perception radius (dimensionless)."""
    steps: int = 512
    """Steps from the seeds."""
    seeds: tuple[int, ...] = tuple(range(8))
    """Seeds of the worlds, one each; the same seeds give the same table."""
    update_prob: float | None = None
    """Probability of each particle's update in a step; None: as each species was trained."""
    margin: float = MARGIN
    """Least fraction by which a loss must change to count as changed, in (0, 1)."""

    def __post_init__(self) -> None:
        """Check every field; raises NPAError."""
        for name, count, least in (
            ("particle_count", self.particle_count, 2),
            ("steps", self.steps, 1),
            ("seed count", len(self.seeds), 1),
        ):
            if count < least:
                raise NPAError(f"{name} must be at least {least}, got {count}")
        if not self.distances or not all(0.0 <= d < math.inf for d in self.distances):
            raise NPAError(
                f"distances must be finite and not negative, got {self.distances}: try 0 0.5 1"
            )
        if not self.eps_factors or not all(0.0 < f < math.inf for f in self.eps_factors):
            raise NPAError(
                f"eps_factors must be finite and above 0, got {self.eps_factors}: try 0.7 1 1.4"
            )
        for name, shares in (("ratios", self.ratios), ("margin", (self.margin,))):
            if not shares or not all(0.0 < share < 1.0 for share in shares):
                raise NPAError(f"{name} must lie in (0, 1), got {shares}")
        if self.update_prob is not None and not 0.0 < self.update_prob <= 1.0:
            raise NPAError(f"update_prob must lie in (0, 1], got {self.update_prob}")

    def counts(self, ratio: float) -> tuple[int, int]:
        """Return the numbers of particles of the measured species and of the other one."""
        own = min(max(round(ratio * self.particle_count), 1), self.particle_count - 1)
        return own, self.particle_count - own


@dataclass(frozen=True)
class InteractionRow:
    """One rule A (`rule`), grown together with rule B (`beside`); figures are means of the worlds.

    `alone` and `together` are A's task metric of its own particles, `change` is together / alone,
    `mixing` the `mixing_index` at the end, `displacement` the distance of A's centroid from its
    position when grown alone [length units]. `distance` is between the centres of the seeds
    [length units], `ratio` A's fraction of the particles. `..._low` and `..._high` are the ends of
    95 % intervals.
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


def verdict(change: float, mixing: float, margin: float = MARGIN) -> str:
    """Return "cooperates" below 1 - margin, "disrupted" above 1 + margin or of NaN, "undisturbed".

    ", mixes" follows where the mixing index is at least `MIXED`.
    """
    word = "disrupted"
    if change < 1.0 - margin:
        word = "cooperates"
    elif change <= 1.0 + margin:
        word = "undisturbed"
    return f"{word}, mixes" if mixing >= MIXED else word


def ratio_interval(above: Tensor, below: Tensor) -> tuple[float, float]:
    """Return the 95 % bootstrap interval, over worlds, of mean(above) / mean(below).

    `above` [B] may be infinite, `below` [B] is finite and not negative; the ratio to 0 is infinite.
    """
    count = len(above)
    draws = np.random.default_rng(0).integers(count, size=(2000, count))
    tops, bases = (values.double().cpu().numpy()[draws].mean(axis=1) for values in (above, below))
    ratios = np.divide(tops, bases, out=np.full_like(tops, np.inf), where=bases > 0.0)
    # Without interpolation, which between two infinite numbers is NaN.
    low, high = np.quantile(ratios, (0.025, 0.975), method="nearest")
    return float(low), float(high)


def mixing_index(x: Tensor, counts: Sequence[int], *, eps: float) -> Tensor:
    """Return how much the K species of each world are mixed, in [0, 1], shape [B].

    It is the mean over particles of the entropy of the species' fractions of the density, over
    log K. 0: no particle perceives another species; 1: all species are perceived equally.
    """
    rho = species_fields(x, counts, eps=eps).rho
    if rho.shape[2] < 2:
        raise NPAError("counts must name at least two species that can mix, got one")
    fractions = rho / rho.sum(dim=2, keepdim=True)
    entropy: Tensor = torch.special.entr(fractions).sum(dim=2)
    return entropy.mean(dim=1) / math.log(rho.shape[2])


PROGRESS_STEPS = 32
"""Steps between two reports of progress."""

FRAME_SHARES = (0.0, 0.125, 0.25, 0.5, 1.0)
"""Times of pictures, as fractions of the run."""


@dataclass(frozen=True)
class RuleUnderTest:
    """A trained rule that grows in 2D; `task_of` makes its task for a number of particles."""

    name: str
    rule: NPARule
    task_of: Callable[[int], Task]
    update_prob: float
    """Probability of a particle's update in a step, as trained (dimensionless)."""
    particle_count: int = 0
    """Particles of a world, as trained."""


class Scenes(NamedTuple):
    """Pictures of the first worlds, uint8, [R, R, 3]: `len(FRAME_SHARES)` for each setting."""

    frames: list[NDArray[np.uint8]]
    captions: list[str]


class _Solo(NamedTuple):
    """A rule grown alone: its metric [B], infinite if blown up, and centroids [B, 2]."""

    losses: Tensor
    centroids: Tensor


class Encounters:
    """Grows rules alone and together from the same seeds; caches results of rules alone.

    `progress` is called with the steps done since its last call.
    """

    def __init__(
        self,
        settings: InteractionSettings,
        *,
        device: torch.device,
        progress: Callable[[int], None] = lambda _: None,
    ) -> None:
        self.settings = settings
        self._device = device
        self._progress = progress
        self._solos: dict[tuple[str, int, float], _Solo] = {}

    def check(self, organisms: Sequence[RuleUnderTest]) -> None:
        """Check that any two of the rules can share a world."""
        for other in organisms:
            weight = other.rule.hidden.weight
            x, s = weight.new_zeros(1, 2, 2), weight.new_zeros(1, 2, other.rule.state_dim)
            try:
                rollout_species([organisms[0].rule, other.rule], x, s, 0, counts=[1, 1])
            except NPAError as error:
                raise NPAError(
                    f"{organisms[0].name} and {other.name} cannot share a world: {error}"
                ) from error

    @torch.no_grad()
    def meet(
        self, first: RuleUnderTest, second: RuleUnderTest
    ) -> tuple[list[InteractionRow], Scenes]:
        """Grow and measure `first` together with `second`: return a row for each setting."""
        rows, scenes, given = [], Scenes([], []), self.settings
        for factor, ratio, distance in itertools.product(
            given.eps_factors, given.ratios, given.distances
        ):
            counts = given.counts(ratio)
            solo = self._solo(first, counts[0], factor)
            radius = "" if factor == 1.0 else f"eps x {factor:g}, "
            caption = f"{radius}d {distance:g}, r {ratio:g}, step"
            snapshots: list[tuple[Tensor, Tensor, int]] = []
            x, s, lost = self._grow([first, second], counts, distance, factor, snapshots)
            for then_x, then_s, step in snapshots:
                frame = draw_worlds(
                    then_x,
                    then_s,
                    resolution=160,
                    pixel_size=0.5 * math.sqrt(4.0 / given.particle_count),
                    half_width=1.2 + 0.5 * distance,
                )[0]
                scenes.frames.append(frame)
                scenes.captions.append(f"{caption} {step}")
            own = x[:, : counts[0]]
            losses = first.task_of(counts[0]).metric(own, s[:, : counts[0]])
            losses = losses.masked_fill(lost, math.inf)
            alone, together = solo.losses.mean().item(), losses.mean().item()
            change = together / alone if alone > 0.0 else math.inf
            mixings = mixing_index(x, counts, eps=factor * first.rule.eps0)
            mixing = mixings.mean().item()
            away = (own.mean(dim=1) - solo.centroids).norm(dim=-1).mean().item()
            word = verdict(change, mixing, given.margin)
            setting, figures = (distance, ratio), (alone, together, change, mixing, away)
            intervals = (
                *ratio_interval(losses, solo.losses),
                *ratio_interval(mixings, torch.ones_like(mixings)),
            )
            names = first.name, second.name
            rows.append(InteractionRow(*names, *setting, *figures, word, factor, *intervals))
        return rows, scenes

    def _solo(self, organism: RuleUnderTest, count: int, factor: float) -> _Solo:
        key = organism.name, count, factor
        if key not in self._solos:
            x, s, lost = self._grow([organism], (count,), 0.0, factor)
            losses = organism.task_of(count).metric(x, s).masked_fill(lost, math.inf)
            self._solos[key] = _Solo(losses, x.mean(dim=1))
        return self._solos[key]

    def _grow(
        self,
        organisms: Sequence[RuleUnderTest],
        counts: tuple[int, ...],
        distance: float,
        factor: float,
        snapshots: list[tuple[Tensor, Tensor, int]] | None = None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return one or two species grown from their seeds, and which worlds blew up.

        The first is seeded at the origin and has the same random stream as alone; the second is
        seeded at `distance` along the first axis. `snapshots` gets the first world at
        `FRAME_SHARES`.
        """
        settings = self.settings
        random = WorldRandom(settings.seeds, device=self._device)
        streams = (random, random.substream(StreamId.SPECIES))
        parts = [
            organism.task_of(count).seed(
                len(settings.seeds), generator=stream, device=self._device
            )[:2]
            for organism, count, stream in zip(organisms, counts, streams, strict=False)
        ]
        for number, (x, _) in enumerate(parts):
            x[..., 0] += number * distance
        like = organisms[0].rule.hidden.weight
        x, s = (torch.cat(of_all, dim=1).to(like) for of_all in zip(*parts, strict=True))
        lost = torch.zeros(len(x), dtype=torch.bool, device=x.device)
        frames = {round(share * settings.steps) for share in FRAME_SHARES}
        stops = sorted({*range(0, settings.steps, PROGRESS_STEPS), *frames})
        for now, then in zip([0, *stops], stops, strict=False):
            new_x, new_s = rollout_species(
                [organism.rule for organism in organisms],
                x,
                s,
                then - now,
                counts=counts,
                eps=factor * organisms[0].rule.eps0,
                update_prob=[settings.update_prob or own.update_prob for own in organisms],
                generator=random,
                density_counts=counts,
            )
            # Worlds that blew up stay as they were, so that the others can be measured.
            fine = new_x.isfinite().all(dim=(1, 2)) & new_s.isfinite().all(dim=(1, 2))
            x = torch.where(fine[:, None, None], new_x, x)
            s = torch.where(fine[:, None, None], new_s, s)
            lost |= ~fine
            self._progress(then - now)
            if then in frames and snapshots is not None:
                # Centre the picture between the two seeds.
                shift = x.new_zeros(x.shape[2])
                shift[0] = 0.5 * distance
                snapshots.append((x[:1] - shift, s[:1], then))
        return x, s, lost


MAX_CHANGE = 4.0
"""Range of the colour map of changes: this, and its inverse."""


class InteractionRecord(Record[InteractionRow]):
    """Rows, and their figures as matrices over the rules for each setting."""

    command, key = "interact", "settings"

    def content(self) -> dict[str, Any]:
        """Return rows and matrices."""
        kinds, names = ("change", "mixing", "displacement", "verdict"), list(self.facts["rules"])
        matrices = [
            {"ratio": ratio, "distance": distance, "eps_factor": factor}
            | {what: _matrix(some, names, what) for what in kinds}
            for (factor, ratio, distance), some in _by_setting(self.rows).items()
        ]
        return {**super().content(), "matrices": matrices}

    def parse(self, held: dict[str, Any]) -> list[InteractionRow]:
        """Return the rows; null stands for infinite numbers."""
        rows: list[dict[str, Any]] = [
            {k: math.inf if v is None else v for k, v in row.items()} for row in held["rows"]
        ]
        return [InteractionRow(**row) for row in rows]


def _by_setting(
    rows: Sequence[InteractionRow],
) -> dict[tuple[float, float, float], list[InteractionRow]]:
    """Return the rows by radius factor, ratio and distance."""
    found: dict[tuple[float, float, float], list[InteractionRow]] = {}
    for row in rows:
        found.setdefault((row.eps_factor, row.ratio, row.distance), []).append(row)
    return found


def _matrix(rows: Sequence[InteractionRow], names: Sequence[str], what: str) -> list[list[Any]]:
    """Return a field of each pair of rules as a matrix; None for missing pairs."""
    found = {(row.rule, row.beside): getattr(row, what) for row in rows}
    return [[found.get((down, across)) for across in names] for down in names]


def heat_map(rows: Sequence[InteractionRow]) -> bytes:
    """Return a PNG of two matrices for each setting: change of the loss, and mixing index.

    Rows are the measured rules, columns the other ones. Needs matplotlib.
    """
    names = list(dict.fromkeys([row.rule for row in rows] + [row.beside for row in rows]))
    settings = _by_setting(rows)
    side = 1.6 + 0.55 * len(names)
    figure, grid = new_figure(len(settings), 2, (2 * side + 2.0, side * len(settings)))
    for ((factor, ratio, distance), some), panels in zip(settings.items(), grid, strict=True):
        setting = f"distance {distance:g}, ratio {ratio:g}" + _radius(factor)
        for panel, (what, title, colours, norm, bar) in zip(panels, _shades(), strict=True):
            values = _matrix(some, names, what)
            scale = draw_matrix(panel, names, names, values, colours=colours, norm=norm)
            panel.set(xlabel="beside", title=f"{title}\n{setting}")
            figure.colorbar(scale, ax=panel, **bar).minorticks_off()
        panels[0].set_ylabel("rule")
    return png(figure)


def phase_diagram(rows: Sequence[InteractionRow]) -> bytes:
    """Return a PNG of one pair of rules over distance, ratio and radius. Needs matplotlib.

    The upper panels show the change of the loss, the lower ones the mixing index, with intervals.
    """
    factors, ratios, distances = (
        sorted(set(each)) for each in zip(*_by_setting(rows), strict=True)
    )
    found = {(row.eps_factor, row.ratio, row.distance): row for row in rows}
    size = 1.6 + 0.62 * len(distances), 1.4 + 0.4 * len(ratios)
    figure, grid = new_figure(2, len(factors), (size[0] * len(factors) + 1.0, 2 * size[1]))
    down, across = ([f"{value:g}" for value in values] for values in (ratios, distances))
    for panels, (what, title, colours, norm, bar) in zip(grid, _shades(), strict=True):
        for panel, factor in zip(panels, factors, strict=True):
            held = [[found.get((factor, r, d)) for d in distances] for r in ratios]
            values = [
                [None if row is None else getattr(row, what) for row in line] for line in held
            ]
            notes = [["" if row is None else _interval(row, what) for row in line] for line in held]
            scale = draw_matrix(
                panel, down, across, values, colours=colours, norm=norm, notes=notes
            )
            panel.set(xlabel="distance")
            panel.set_title(title + _radius(factor), fontsize=9)
        panels[0].set_ylabel(f"ratio of {rows[0].rule}")
        figure.colorbar(scale, ax=list(panels), **bar).minorticks_off()
    figure.suptitle(f"{rows[0].rule} beside {rows[0].beside}", fontsize=10)
    return png(figure)


def _interval(row: InteractionRow, what: str) -> str:
    ends = (getattr(row, f"{what}_{end}") for end in ("low", "high"))
    # A cell has room for one digit of small numbers.
    return " to ".join(f"{end:.2g}" if end >= 0.01 else f"{end:.1g}" for end in ends)


def _radius(factor: float) -> str:
    return "" if factor == 1.0 else f", ε × {factor:g}"


def _shades() -> tuple[tuple[str, str, str, Any, dict[str, Any]], ...]:
    """Return, for each drawn field, its name, title, colour map, norm and options of the bar."""
    from matplotlib.colors import LogNorm, Normalize

    ticks = {"ticks": [0.25, 0.5, 1.0, 2.0, 4.0], "format": "%g"}
    changes = LogNorm(1.0 / MAX_CHANGE, MAX_CHANGE)
    return (
        ("change", "loss together / alone", "RdBu_r", changes, ticks),
        ("mixing", "mixing index", "viridis", Normalize(0.0, 1.0), {}),
    )
