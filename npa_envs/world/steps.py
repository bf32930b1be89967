"""The kinds of steps of a rollout: of one rule or several, of static or dividing particles."""

from __future__ import annotations

import dataclasses
import math
import threading
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from npa_envs.checks import constant
from npa_envs.ops.perceive import Rows, perceive_rows, updates_in_parts
from npa_envs.ops.physics import Physics
from npa_envs.ops.random_numbers import mask_increment, torch_masks
from npa_envs.ops.species_density import perceive_by_species
from npa_envs.ops.static_worlds import StaticRows, prepare_static, static_rows
from npa_envs.ops.update import bounded, update_particles
from npa_envs.rule.folded_network import Network
from npa_envs.rule.rule import LIFE, NPARule
from npa_envs.world.cuda_graph import SideStream
from npa_envs.world.division import Births, divided, living, parked
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import (
    Randomness,
    WorldRandom,
    normal_draws,
    reserve_draws,
    torch_generator,
    uniform_draws,
)

MAX_STORED_ROWS = 2**24
"""Maximum number of rows of perception, or of assigned rows of static worlds, stored at once."""

MAX_AHEAD = 4
"""Maximum number of steps whose random numbers a CUDA graph draws ahead; they take memory."""

OVERFLOW_LOG_PROBABILITY = 34.5
"""`row_capacity` is exceeded in a step with probability exp(-34.5), about 1e-15."""


def row_capacity(particle_total: int, update_prob: float) -> int:
    """Return how many particles a step updates at most, by Bernstein's inequality.

    On CUDA the number of rows must not depend on the mask: reading it would wait for the device. On
    a CPU the exact number is used instead.
    """
    mean = particle_total * update_prob
    variance = mean * (1.0 - update_prob)
    slack = OVERFLOW_LOG_PROBABILITY / 3.0
    margin = slack + math.sqrt(slack * slack + 2.0 * OVERFLOW_LOG_PROBABILITY * variance)
    return min(particle_total, math.ceil(mean + margin))


def row_count(mask: Tensor | None, x: Tensor, update_prob: float) -> int:
    """Return how many rows of perception to allocate for an update mask; None: all particles."""
    total = x.shape[0] * x.shape[1]
    if mask is None:
        return total
    # Counting is free on a CPU; on CUDA it would wait for the device.
    return row_capacity(total, update_prob) if mask.is_cuda else max(int(mask.sum()), 1)


def active_counts(mask: Tensor | None, shape: Sequence[int]) -> list[int]:
    """Return the numbers of active particles of worlds of `shape`, [B, N, ...], on a CPU."""
    return [shape[1]] * shape[0] if mask is None else mask.sum(dim=1).tolist()


class Draws(NamedTuple):
    """The random numbers of a step, and for static particles the rows that they select."""

    mask: Tensor | None
    """Update mask, uint8, shape [B, N]; None: all particles are updated."""
    noise: Tensor | None
    """Position noise [length units], shape [B, N, D], or None."""
    rows: StaticRows | None = None
    """Rows of perception of active static particles, in place of a mask; None: all are active."""
    births: Births | None = None
    """Random numbers of divisions, for particles that divide."""


def draw_step(x: Tensor, physics: Physics, generator: Randomness | None) -> Draws:
    """Return a step's update mask and position noise, drawn in this order."""
    mask = noise = None
    if isinstance(generator, WorldRandom):
        generator.advance()
    if physics.update_prob < 1.0:
        if isinstance(generator, WorldRandom):
            mask = generator.bernoulli(physics.update_prob, x.shape[1])
        else:
            mask = torch.empty(x.shape[:2], dtype=torch.uint8, device=x.device)
            mask.bernoulli_(physics.update_prob, generator=generator)
    if physics.position_noise > 0.0:
        noise = normal_draws(generator, x.shape, x)
        noise *= physics.position_noise
    return Draws(mask, noise)


def draw_ahead(
    x: Tensor, physics: Physics, steps: int, generator: Randomness | None
) -> list[Tensor | None]:
    """Return the masks [T, B, N] and the noise [T, B, N, D] of `steps` calls of `draw_step`.

    A `WorldRandom` is `take_steps` of the caller's, and draws all steps at once.
    """
    world_count, particle_count, _ = x.shape
    if isinstance(generator, WorldRandom):
        # Only the shape is read.
        drawn = [draw_step(x[:1].expand(steps * world_count, -1, -1), physics, generator)]
    else:
        masked = physics.update_prob < 1.0 and physics.position_noise == 0.0
        if masked and not torch.cuda.is_current_stream_capturing():
            increment = mask_increment(x.device, world_count * particle_count)
            if increment is not None:
                source = torch_generator(generator, x.device)
                begin = reserve_draws(source, steps * increment)
                masks = torch.empty(steps, *x.shape[:2], dtype=torch.uint8, device=x.device)
                seed = source.initial_seed()
                torch_masks(masks.view(steps, -1), physics.update_prob, seed, begin)
                return [masks, None]
        drawn = [draw_step(x, physics, generator) for _ in range(steps)]
    fields = [[value for value in each if value is not None] for each in zip(*drawn, strict=True)]
    return [
        torch.cat(values).view(steps, world_count, *values[0].shape[1:]) if values else None
        for values in fields[:2]
    ]


def skip_draws(x: Tensor, physics: Physics, steps: int, generator: Randomness | None) -> None:
    """Advance a generator as far as `steps` steps of worlds with positions x would."""
    if steps == 0:
        return
    if isinstance(generator, WorldRandom):
        generator.advance(steps - 1)
        draw_step(x, physics, generator)
    elif x.is_cuda:
        # On CUDA torch counts draws in an offset, and equal draws add the same.
        counter = torch.Generator(x.device)
        draw_step(x, physics, counter)
        reserve_draws(torch_generator(generator, x.device), steps * counter.get_offset())
    else:
        for _ in range(steps):
            draw_step(x, physics, generator)


class Step:
    """A kind of step: `draw` returns the random numbers of steps, and `advance` does one step."""

    physics: Physics

    def to_step_order(self, particles: Particles) -> Particles:
        """Return the worlds with particles in the order of `advance`; here it is the caller's."""
        return particles

    def draw_step(self, like: Tensor, generator: Randomness | None) -> Draws:
        """Return the next step's random numbers, for positions of `like`'s shape and dtype."""
        return draw_step(like, self.physics, generator)

    def draw(self, like: Tensor, steps: int, generator: Randomness | None) -> Iterator[Draws]:
        """Yield each step's random numbers, drawn in the same order on every device.

        In a CUDA graph they are drawn ahead, in parallel with the steps before.
        """
        # In this order: a compiler cannot trace queries of streams.
        may_capture = not torch.compiler.is_compiling() and like.is_cuda
        if not (may_capture and torch.cuda.is_current_stream_capturing()):
            for _ in range(steps):
                yield self.draw_step(like, generator)
            return
        side_stream = SideStream.of_thread(like.device, threading.get_ident())
        ready, remaining = [self.draw_step(like, generator)], steps - 1
        while remaining > 0:
            # Draws reuse the memory of earlier steps, so the two streams wait for each other.
            count = min(3 * len(ready), MAX_AHEAD, remaining)
            with side_stream.overlap():
                coming = [self.draw_step(like, generator) for _ in range(count)]
            yield from ready
            side_stream.join()
            ready, remaining = coming, remaining - count
        yield from ready

    def advance(self, particles: Particles, draws: Draws) -> Particles:
        """Return the worlds after one step with these random numbers."""
        raise NotImplementedError

    def to_caller_order(self, particles: Particles) -> Particles:
        """Return the worlds with particles in the caller's order; undoes `to_step_order`."""
        return particles


def _updated(
    particles: Particles, update: Tensor, active: Rows, draws: Draws, physics: Physics
) -> Particles:
    """Return the worlds after updates [K, A] of active particles, and position noise of all."""
    x, s, paths, *_ = particles.per_particle()
    x = x if draws.noise is None else x + draws.noise
    return particles.moved(*update_particles(update, x, s, paths, active, physics))


@dataclasses.dataclass
class RuleStep(Step):
    """The step of one rule: perceive the active particles, run the network, update."""

    rule: NPARule
    network: Network | None
    """The rule's weights in the form that kernels run; None: the rule runs as its module."""
    physics: Physics
    detach_positions: bool = True
    world_by_world: bool = False
    """Whether the network runs for one world after the other, see `updates_of`."""

    def updates_of(self, perception: Tensor, counts: Sequence[int]) -> Tensor:
        """Return the network's updates of all rows, [K, A']; world k has `counts[k]` of them.

        Torch's products on a CPU may depend in the last bit on their number of rows: with
        `world_by_world` a world has the same updates in every batch.
        """
        network = self.network or self.rule
        filled = [count for count in counts if count > 0]
        if not self.world_by_world or len(filled) < 2:
            return network(perception)
        return torch.cat([network(rows) for rows in torch.split(perception, filled)])

    def advance(self, particles: Particles, draws: Draws) -> Particles:
        """Return the worlds after one step with these random numbers."""
        x, s, *_ = particles
        mask, physics = draws.mask, self.physics
        width = self.network.row_width if self.network else self.rule.perception_dim
        total = row_count(mask, x, physics.update_prob)
        too_many = total > MAX_STORED_ROWS and not torch.is_grad_enabled()
        if too_many and not torch.compiler.is_compiling():
            network = self.network or self.rule
            update, active = updates_in_parts(x, s, physics, mask, network.__call__, total, width)
        else:
            seen_x = x.detach() if self.detach_positions else x
            perception, active = perceive_rows(
                seen_x, s, physics, mask=mask, row_capacity=total, row_width=width
            )
            counts = active_counts(mask, x.shape) if self.world_by_world else ()
            update = self.updates_of(perception, counts)
        return _updated(particles, update, active, draws, physics)


class StaticStep(Step):
    """The step of a rule with static particles, whose neighbours are searched only once."""

    def __init__(self, rule: NPARule, physics: Physics, x: Tensor) -> None:
        # Later parts of a rollout begin inside the box, so the first must as well.
        self.x = bounded(x, physics)
        # Before all else: the compiler's trace breaks at it.
        self.sorted = prepare_static(self.x, physics)
        self.rule, self.network, self.physics = rule, rule.network(), physics

    def to_step_order(self, particles: Particles) -> Particles:
        """Return the worlds with particles in sorted order."""
        return particles._replace(x=self.x).gather(self.sorted.original_index)

    def draw(self, like: Tensor, steps: int, generator: Randomness | None) -> Iterator[Draws]:
        """Yield each step's active particles (`Draws.rows`), listed for up to 16 steps at once."""
        total, physics = like.shape[0] * like.shape[1], self.physics
        together = max(min(16, MAX_STORED_ROWS // total), 1)
        for first in range(0, steps, together):
            count = min(together, steps - first)
            drawn = [draw_step(like, physics, generator) for _ in range(count)]
            masks = [draws.mask for draws in drawn if draws.mask is not None]
            if masks:
                capacity = row_capacity(total, physics.update_prob)
                rows = static_rows(self.sorted, like.detach(), masks, capacity)
                drawn = [Draws(None, None, of_step) for of_step in rows]
            yield from drawn

    def advance(self, particles: Particles, draws: Draws) -> Particles:
        """Return the worlds after one step of the particles that have a row."""
        x, s, *_ = particles
        rows = draws.rows
        perception, active = perceive_rows(
            x.detach(),
            s,
            self.physics,
            mask=None,
            row_capacity=x.shape[0] * x.shape[1] if rows is None else len(rows.row_particle),
            row_width=self.network.row_width if self.network else self.rule.perception_dim,
            static=self.sorted,
            static_rows=rows,
        )
        network = self.network or self.rule
        return _updated(particles, network(perception), active, draws, self.physics)

    def to_caller_order(self, particles: Particles) -> Particles:
        """Return the worlds with particles in the caller's order."""
        return particles.gather(self.sorted.sorted_index)


class DivisionStep(RuleStep):
    """The step of a rule whose particles divide: an update of the living, then births, deaths."""

    def to_step_order(self, particles: Particles) -> Particles:
        """Return the worlds with states of zero in dead slots; the order does not change."""
        # Dead slots must not enter gradients either: 0 times NaN is NaN.
        s = particles.s
        return particles._replace(s=torch.where(living(s)[..., None], s, 0.0))

    def draw_step(self, like: Tensor, generator: Randomness | None) -> Draws:
        """Return update mask, position noise and random numbers of divisions."""
        drawn = super().draw_step(like, generator)
        chance = uniform_draws(generator, like.shape[:2], like)
        return drawn._replace(births=Births(chance, normal_draws(generator, like.shape, like)))

    def advance(self, particles: Particles, draws: Draws) -> Particles:
        """Return the worlds after an update of the living, then births and deaths."""
        assert draws.births is not None, "drawn above"
        x, s, *_ = particles
        eps = self.physics.eps
        alive = living(s)
        updated = alive if draws.mask is None else alive & draws.mask.bool()
        life, rest = s[..., : LIFE + 1], s[..., LIFE + 1 :]
        # Perception is not weighted by life, and so gives it no gradient.
        perceived = torch.cat((life.detach(), rest), dim=-1)
        after = super().advance(
            particles._replace(x=parked(x, alive, eps), s=perceived),
            draws._replace(mask=updated.byte()),
        )
        # A rule does not update life.
        new_s = torch.cat((life, after.s[..., LIFE + 1 :]), dim=-1)
        return divided(
            after._replace(s=new_s),
            division_probabilities=self.rule.division_probabilities(new_s),
            updated=updated,
            births=draws.births,
            eps=eps,
        )


class SpeciesSpec(NamedTuple):
    """The constants of one species of a rollout."""

    size: int
    """Number of its particles in a world."""
    update_prob: float
    """Probability that a step updates a particle."""
    density_count: float
    """Number by which its rule's densities are divided."""


class Species(NamedTuple):
    """One species of a rollout: its rule, its particles and its constants."""

    rule: NPARule
    network: Network | None
    """The rule's weights in the form that kernels run; None: the rule runs as its module."""
    particles: slice
    """Indices of its particles in a world."""
    spec: SpeciesSpec
    displacement_fraction: float
    """Its rule's alpha divided by the largest alpha of all species."""
    count_ratio: float
    """N divided by `spec.density_count`."""

    def capacity(self, world_count: int) -> int:
        """Return the number of rows to allocate for its active particles in B worlds."""
        return row_capacity(world_count * self.spec.size, self.spec.update_prob)


class SpeciesStep(Step):
    """The step of several rules in one world: a common perception pass, then rule by rule.

    `per_species`: rules perceive each species' density and density gradient.
    """

    def __init__(
        self,
        rules: Sequence[NPARule],
        specs: Sequence[SpeciesSpec],
        physics: Physics,
        x: Tensor,
        per_species: bool,
        detach_positions: bool,
    ) -> None:
        self.physics = physics
        self.per_species = per_species
        self.detach_positions = detach_positions
        self.species: list[Species] = []
        longest = max(rule.alpha for rule in rules)
        first = 0
        for rule, spec in zip(rules, specs, strict=True):
            # Not by `_replace`: torch.compile cannot trace it.
            spec = SpeciesSpec(spec.size, constant(spec.update_prob), spec.density_count)
            particles = slice(first, first + spec.size)
            fraction, ratio = rule.alpha / longest, x.shape[1] / spec.density_count
            self.species.append(Species(rule, rule.network(), particles, spec, fraction, ratio))
            first = particles.stop
        self.update_fraction: Tensor | None = None
        """p / max p of each particle, by which the mask is thinned, shape [N]; None: all are 1."""
        specs = [species.spec for species in self.species]
        if min(spec.update_prob for spec in specs) < physics.update_prob:
            fractions = [
                torch.full((spec.size,), spec.update_prob / physics.update_prob, device=x.device)
                for spec in specs
            ]
            self.update_fraction = torch.cat(fractions)

    def draw_step(self, like: Tensor, generator: Randomness | None) -> Draws:
        """Return a step's mask, by each species' update probability, and its position noise."""
        drawn = super().draw_step(like, generator)
        if self.update_fraction is None:
            return drawn
        # Of the fractions' dtype.
        chance = uniform_draws(generator, like.shape[:2], self.update_fraction)
        mask, kept = drawn.mask, (chance < self.update_fraction).to(torch.uint8)
        return drawn._replace(mask=kept if mask is None else mask * kept)

    def advance(self, particles: Particles, draws: Draws) -> Particles:
        """Return the worlds after one step with these random numbers."""
        x, s, *_ = particles
        mask, physics = draws.mask, self.physics
        row_width = physics.perception_dim
        if not self.per_species:
            # Rows of a rule's kernels: the perception vector, a one, then zeros.
            networks = [species.network for species in self.species]
            row_width = max(network.row_width if network else row_width for network in networks)
        total = row_count(mask, x, physics.update_prob)
        if mask is not None and mask.is_cuda:
            total = min(mask.numel(), sum(own.capacity(x.shape[0]) for own in self.species))
        perception, active = perceive_rows(
            x.detach() if self.detach_positions else x,
            s,
            physics,
            mask=mask,
            row_capacity=total,
            row_width=row_width,
        )
        fields = None
        if self.per_species:
            fields = perceive_by_species(x, tuple(own.spec.size for own in self.species), physics)
        row_total = len(perception)
        outputs, rows = [], []
        for species in self.species:
            row_of = active.row_of.view(x.shape[:2])
            row, particle = _rows_of_species(row_of, species, row_total, mask)
            z = perception.index_select(0, row.clamp(max=row_total - 1))
            outputs.append(_update_of(species, self._perceived(species, z, fields, particle)))
            rows.append(row)
        width = min(output.shape[1] for output in outputs)
        update = perception.new_zeros(row_total + 1, width).index_copy(
            0, torch.cat(rows), torch.cat([output[:, :width] for output in outputs])
        )
        return _updated(particles, update[:row_total], active, draws, physics)

    def _perceived(
        self, species: Species, z: Tensor, fields: Tensor | None, particle: Tensor
    ) -> Tensor:
        """Return what a species' rule perceives, from its K rows of perception z [K, P].

        Densities are divided by the species' own number. `fields` has all species' densities and
        gradients, which are appended, or is None. `particle` [K] has each row's particle.
        """
        ratio, space_dim = species.count_ratio, self.physics.space_dim
        if ratio != 1.0 and self.physics.terms.density_gradient:
            end = self.physics.perception_dim
            begin = end - space_dim
            gradient = _recounted(z[:, begin:end], ratio)
            z = torch.cat((z[:, :begin], gradient, z[:, end:]), dim=1)
        if fields is None:
            return z
        appended = fields[:, species.particles].flatten(0, 1).index_select(0, particle)
        if ratio != 1.0:
            density, gradients = appended.tensor_split([len(self.species)], dim=1)
            gradients = _recounted(gradients.view(len(z), -1, space_dim), ratio).flatten(1)
            appended = torch.cat((ratio * density, gradients), dim=1)
        return torch.cat((z, appended), dim=1)


def _rows_of_species(
    row_of: Tensor, species: Species, row_count: int, mask: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Return the rows of perception of a species' active particles, and these particles' indices.

    Both are int64, shape [K]. On CUDA K does not depend on the mask, so that nothing waits for the
    device; unused entries have the row `row_count`.
    """
    row = row_of[:, species.particles].reshape(-1).long()
    everyone = torch.arange(len(row), device=row.device)
    if mask is None:
        return row, everyone
    active = row >= 0
    if row.is_cuda:
        capacity = species.capacity(row_of.shape[0])
        rank = active.cumsum(0) - 1
        rank = torch.where(active & (rank < capacity), rank, capacity)
        particle = everyone.new_zeros(capacity + 1).scatter(0, rank, everyone)[:capacity]
        filled = torch.arange(capacity, device=row.device) < active.sum()
        return torch.where(filled, row[particle], row_count), particle
    particle = active.nonzero()[:, 0]
    if not len(particle):
        return row.new_full((1,), row_count), row.new_zeros(1)
    return row[particle], particle


def _recounted(scaled: Tensor, ratio: float) -> Tensor:
    """Return L(ratio v) from L(v) = log(1 + |v|) v / |v|, along the last dimension."""
    length = torch.linalg.vector_norm(scaled, dim=-1, keepdim=True)
    nonzero = length > 0.0
    divisor = torch.where(nonzero, length, 1.0)
    factor = torch.log1p(ratio * torch.expm1(divisor)) / divisor
    return scaled * torch.where(nonzero, factor, ratio)


def _update_of(species: Species, z: Tensor) -> Tensor:
    """Return a species' updates [displacement | state changes | zeros] for perceptions z [K, P]."""
    rule = species.rule
    if species.network is None:
        update: Tensor = rule(z[:, : rule.perception_dim])
    else:
        if z.shape[1] < species.network.row_width:
            one = z.new_ones(len(z), 1)
            rest = z.new_zeros(len(z), species.network.row_width - rule.perception_dim - 1)
            z = torch.cat((z[:, : rule.perception_dim], one, rest), dim=1)
        update = species.network(z)
    fraction = species.displacement_fraction
    if rule.static or fraction == 1.0:
        return update
    # The displacement r q δ / (1 + |δ|), a fraction q of the common largest one r, is that of
    # δ' = q δ / (1 + (1 - q) |δ|), which is pulled back by the same operator.
    delta = update[:, : rule.space_dim]
    length = torch.linalg.vector_norm(delta, dim=1, keepdim=True)
    delta = fraction * delta / (1.0 + (1.0 - fraction) * length)
    return torch.cat((delta, update[:, rule.space_dim :]), dim=1)
