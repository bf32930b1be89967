"""One step of several rules in one world: a common perception pass, then rule by rule."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from npa_envs.dynamics import StepOptions, draw_step, row_capacity, rule_terms
from npa_envs.randomness import Randomness, WorldRandom
from npa_envs.rule.rule import FoldedRule, NPARule
from npa_envs.sph.operators import perceive_rows
from npa_envs.sph.species import perceive_by_species
from npa_envs.sph.update import update_particles


class Species(NamedTuple):
    """One species of checked worlds."""

    rule: NPARule
    folded: FoldedRule | None
    """The rule's weights as they are run; None where it runs as the module that it is."""
    first: int
    """Its first particle in a world."""
    end: int
    """One past its last particle."""
    update_prob: float
    """Probability of each of its particles' updates."""
    reach_share: float
    """Its largest displacement as a share of the largest of all species."""
    count_ratio: float
    """Particles of a world over those by which this species divides densities."""


class Community(NamedTuple):
    """What stays the same over a rollout."""

    species: list[Species]
    counts: tuple[int, ...]
    options: StepOptions
    """With the largest update probability."""
    keep: Tensor | None
    """Share of the updates so drawn that each particle keeps, shape [N]; None: all keep all."""
    told_apart: bool
    """Rules perceive each species' density and density gradient."""


def make_community(
    rules: list[NPARule],
    counts: tuple[int, ...],
    options: list[StepOptions],
    density_counts: tuple[float, ...],
    x: Tensor,
    *,
    told_apart: bool,
) -> Community:
    """Return what stays the same over a rollout of checked worlds.

    Args:
        rules: One rule for each species; they agree.
        counts: Particles of each species.
        options: What each species' particles are told.
        density_counts: Particles by which each species divides densities.
        x: Positions [length units], shape [B, N, D].
        told_apart: Rules perceive each species' density and density gradient.
    """
    species = []
    first = 0
    longest = max(rule.alpha for rule in rules)
    for rule, count, own, divisor in zip(rules, counts, options, density_counts, strict=True):
        species.append(
            Species(
                rule=rule,
                folded=rule.folded() if rule.is_plain() else None,
                first=first,
                end=first + count,
                update_prob=own.update_prob,
                reach_share=rule.alpha / longest,
                count_ratio=x.shape[1] / divisor,
            )
        )
        first += count
    probabilities = [own.update_prob for own in options]
    highest = max(probabilities)
    keep = None
    if min(probabilities) < highest:
        keep = torch.cat(
            [
                torch.full((count,), chance / highest, device=x.device)
                for count, chance in zip(counts, probabilities, strict=True)
            ]
        )
    return Community(species, counts, options[0]._replace(update_prob=highest), keep, told_apart)


def draw(
    x: Tensor, community: Community, generator: Randomness | None
) -> tuple[Tensor | None, Tensor | None]:
    """Draw a step's update mask and position noise: as `rollout` does, then thinned by species."""
    mask, noise = draw_step(x, community.options, generator)
    if community.keep is None:
        return mask, noise
    if isinstance(generator, WorldRandom):
        drawn = generator.uniform(x.shape[1])
    else:
        drawn = torch.rand(x.shape[:2], device=x.device, generator=generator)
    kept = (drawn < community.keep).to(torch.uint8)
    return kept if mask is None else mask * kept, noise


def advance(
    community: Community,
    x: Tensor,
    s: Tensor,
    path_length: Tensor,
    mask: Tensor | None,
    noise: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Advance checked worlds by one step whose random draws are given."""
    species, options = community.species, community.options
    first = species[0].rule
    shared_dim = rule_terms(first).perception_dim(first.space_dim, first.state_dim)
    shared_width = shared_dim
    if not community.told_apart:
        # A folded rule's own row: a one follows the perception vector, then zeros.
        shared_width = max(own.folded.row_width if own.folded else shared_dim for own in species)
    perception, rows = perceive_rows(
        x.detach() if options.detach_positions else x,
        s,
        mask=mask,
        row_capacity=_row_total(community, x, mask),
        row_width=shared_width,
        eps=options.eps,
        eps0=first.eps0,
        box=options.box,
        terms=rule_terms(first),
    )
    appended = None
    if community.told_apart:
        appended = perceive_by_species(
            x, community.counts, eps=options.eps, eps0=first.eps0, box=options.box
        )
    row_count = len(perception)
    outputs, places = [], []
    for own in species:
        place, particle = _rows_of_species(rows.row_of.view(x.shape[:2]), own, row_count, mask)
        z = perception.index_select(0, place.clamp(max=row_count - 1))
        if own.count_ratio != 1.0 and first.density_gradient:
            begin, end = shared_dim - first.space_dim, shared_dim
            gradient = _recounted(z[:, begin:end], own.count_ratio)
            z = torch.cat((z[:, :begin], gradient, z[:, end:]), dim=1)
        if appended is not None:
            beside = appended[:, own.first : own.end].flatten(0, 1).index_select(0, particle)
            if own.count_ratio != 1.0:
                beside = _recounted_by_species(beside, len(species), own.count_ratio)
            z = torch.cat((z, beside), dim=1)
        outputs.append(_update_of(own, z))
        places.append(place)
    width = min(output.shape[1] for output in outputs)
    update = perception.new_zeros(row_count + 1, width).index_copy(
        0, torch.cat(places), torch.cat([output[:, :width] for output in outputs])
    )
    return update_particles(
        update[:row_count],
        x if noise is None else x + noise,
        s,
        path_length,
        rows=rows,
        reach=max(own.rule.alpha for own in species) * options.eps,
        dt=options.dt,
        moving=not first.static,
        box=options.box,
    )


def _row_total(community: Community, x: Tensor, mask: Tensor | None) -> int:
    """Return how many rows hold the active particles of all species."""
    total = x.shape[0] * x.shape[1]
    if mask is None:
        return total
    if not x.is_cuda:
        return max(int(mask.sum()), 1)
    return min(total, sum(_capacity(own, x.shape[0]) for own in community.species))


def _capacity(own: Species, world_count: int) -> int:
    return row_capacity(world_count * (own.end - own.first), own.update_prob)


def _rows_of_species(
    row_of: Tensor, own: Species, row_count: int, mask: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Return the rows of a species' active particles, and which of its particles they stand for.

    Both are int64, of one shape [R]; entries that stand for nobody have the row `row_count`. On
    CUDA R does not depend on the draw, so that nothing waits for the device.
    """
    row = row_of[:, own.first : own.end].reshape(-1).long()
    everyone = torch.arange(len(row), device=row.device)
    if mask is None:
        return row, everyone
    active = row >= 0
    if row.is_cuda:
        capacity = _capacity(own, row_of.shape[0])
        place = active.cumsum(0) - 1
        place = torch.where(active & (place < capacity), place, capacity)
        particle = everyone.new_zeros(capacity + 1).scatter(0, place, everyone)[:capacity]
        filled = torch.arange(capacity, device=row.device) < active.sum()
        return torch.where(filled, row[particle], row_count), particle
    particle = active.nonzero()[:, 0]
    if not len(particle):
        return row.new_full((1,), row_count), row.new_zeros(1)
    return row[particle], particle


def _recounted(scaled: Tensor, ratio: float) -> Tensor:
    """Return L(ratio v), given L(v) of vectors in the last dimension; differentiable."""
    length = torch.linalg.vector_norm(scaled, dim=-1, keepdim=True)
    somewhere = length > 0.0
    divisor = torch.where(somewhere, length, 1.0)
    factor = torch.log1p(ratio * torch.expm1(divisor)) / divisor
    return scaled * torch.where(somewhere, factor, ratio)


def _recounted_by_species(appended: Tensor, species_count: int, ratio: float) -> Tensor:
    """Return what is perceived of each species, [R, K (1 + D)], with densities times `ratio`."""
    density, gradient = appended[:, :species_count], appended[:, species_count:]
    gradient = _recounted(gradient.view(len(gradient), species_count, -1), ratio).flatten(1)
    return torch.cat((ratio * density, gradient), dim=1)


def _update_of(own: Species, z: Tensor) -> Tensor:
    """Return a species' raw updates, [R, A] or wider, for its rows of perception."""
    rule = own.rule
    if own.folded is None:
        update: Tensor = rule(z[:, : rule.perception_dim])
    else:
        if z.shape[1] < own.folded.row_width:
            one = z.new_ones(len(z), 1)
            rest = z.new_zeros(len(z), own.folded.row_width - rule.perception_dim - 1)
            z = torch.cat((z[:, : rule.perception_dim], one, rest), dim=1)
        update = own.folded(z)
    if rule.static or own.reach_share == 1.0:
        return update
    # The displacement r q δ / (1 + |δ|), with this share q of the common reach r, is that of
    # δ' = q δ / (1 + (1 - q) |δ|), which is pulled back by the same operator.
    delta = update[:, : rule.space_dim]
    length = torch.linalg.vector_norm(delta, dim=1, keepdim=True)
    delta = own.reach_share * delta / (1.0 + (1.0 - own.reach_share) * length)
    return torch.cat((delta, update[:, rule.space_dim :]), dim=1)
