"""The step of several rules in one world: one perception pass, then each species' rule."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from npa_envs.checks import constant
from npa_envs.ops.perceive import perceive_rows
from npa_envs.ops.physics import Physics
from npa_envs.ops.species import perceive_by_species
from npa_envs.ops.update import update_particles
from npa_envs.rule.network import Network
from npa_envs.rule.rule import NPARule
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import Randomness, WorldRandom
from npa_envs.world.steps import Draws, draw_step, row_capacity


class SpeciesSpec(NamedTuple):
    """What may differ between species, besides their rules."""

    size: int
    """Its particles in a world."""
    update_prob: float
    """Probability of each of its particles' updates."""
    density_count: float
    """Particles by which it divides densities."""


class Species(NamedTuple):
    """One species of checked worlds."""

    rule: NPARule
    network: Network | None
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


class SpeciesStep(NamedTuple):
    """The step of several rules in one world: a common perception pass, then rule by rule."""

    species: list[Species]
    physics: Physics
    detach_positions: bool
    update_share: Tensor | None
    """Share of the updates so drawn that each particle keeps, shape [N]; None: all keep all."""
    by_species: bool
    """Rules perceive each species' density and density gradient."""

    def enter(self, particles: Particles) -> Particles:
        """Return the worlds."""
        return particles

    def draw(self, like: Tensor, steps: int, source: Randomness | None) -> Iterator[Draws]:
        """Yield each step's update mask and position noise: as for one rule, thinned by species."""
        for _ in range(steps):
            drawn = draw_step(like, self.physics, source)
            if self.update_share is not None:
                if isinstance(source, WorldRandom):
                    chance = source.uniform(like.shape[1])
                else:
                    chance = torch.rand(like.shape[:2], device=like.device, generator=source)
                mask, kept = drawn.mask, (chance < self.update_share).to(torch.uint8)
                drawn = drawn._replace(mask=kept if mask is None else mask * kept)
            yield drawn

    def advance(self, particles: Particles, draws: Draws) -> Particles:
        """Return the worlds after one step with these draws."""
        x, s, path_length, _ = particles
        mask, noise, *_ = draws
        assert path_length is not None, "rollouts measure paths"
        species, physics = self.species, self.physics
        shared_width = shared_dim = physics.perception_dim
        if not self.by_species:
            # A folded rule's own row: a one follows the perception vector, then zeros.
            shared_width = max(
                own.network.row_width if own.network else shared_dim for own in species
            )
        perception, active = perceive_rows(
            x.detach() if self.detach_positions else x,
            s,
            physics,
            mask=mask,
            row_capacity=_row_total(self, x, mask),
            row_width=shared_width,
        )
        appended = None
        if self.by_species:
            counts = tuple(own.end - own.first for own in species)
            appended = perceive_by_species(x, counts, physics)
        row_count = len(perception)
        outputs, places = [], []
        for own in species:
            place, particle = _rows_of_species(
                active.row_of.view(x.shape[:2]), own, row_count, mask
            )
            z = perception.index_select(0, place.clamp(max=row_count - 1))
            if own.count_ratio != 1.0 and physics.terms.density_gradient:
                begin, end = shared_dim - physics.space_dim, shared_dim
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
        moved = x if noise is None else x + noise
        return Particles(
            *update_particles(update[:row_count], moved, s, path_length, active, physics)
        )

    def leave(self, particles: Particles) -> Particles:
        """Return the worlds."""
        return particles


def make_species_step(
    rules: Sequence[NPARule],
    specs: Sequence[SpeciesSpec],
    physics: Physics,
    x: Tensor,
    *,
    by_species: bool,
    detach_positions: bool,
) -> SpeciesStep:
    """Return the step of species that follow one rule each, in worlds of positions x."""
    species = []
    first = 0
    longest = max(rule.alpha for rule in rules)
    for rule, own in zip(rules, specs, strict=True):
        species.append(
            Species(
                rule=rule,
                network=rule.network(),
                first=first,
                end=first + own.size,
                update_prob=constant(own.update_prob),
                reach_share=rule.alpha / longest,
                count_ratio=x.shape[1] / own.density_count,
            )
        )
        first += own.size
    update_share = None
    if min(own.update_prob for own in species) < physics.update_prob:
        update_share = torch.cat(
            [
                torch.full(
                    (own.end - own.first,), own.update_prob / physics.update_prob, device=x.device
                )
                for own in species
            ]
        )
    return SpeciesStep(species, physics, detach_positions, update_share, by_species)


def _row_total(community: SpeciesStep, x: Tensor, mask: Tensor | None) -> int:
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
    if own.network is None:
        update: Tensor = rule(z[:, : rule.perception_dim])
    else:
        if z.shape[1] < own.network.row_width:
            one = z.new_ones(len(z), 1)
            rest = z.new_zeros(len(z), own.network.row_width - rule.perception_dim - 1)
            z = torch.cat((z[:, : rule.perception_dim], one, rest), dim=1)
        update = own.network(z)
    if rule.static or own.reach_share == 1.0:
        return update
    # The displacement r q δ / (1 + |δ|), with this share q of the common reach r, is that of
    # δ' = q δ / (1 + (1 - q) |δ|), which is pulled back by the same operator.
    delta = update[:, : rule.space_dim]
    length = torch.linalg.vector_norm(delta, dim=1, keepdim=True)
    delta = own.reach_share * delta / (1.0 + (1.0 - own.reach_share) * length)
    return torch.cat((delta, update[:, rule.space_dim :]), dim=1)
