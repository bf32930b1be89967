"""Several rules in one world: each species follows its own rule, and all see each other."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, Literal, NamedTuple, Unpack, overload

import torch
from torch import Tensor

from npa_envs.checks import (
    Box,
    check_world,
    checked_count,
    checked_flag,
    checked_number,
    constant,
    entries,
)
from npa_envs.errors import NPAError, shown
from npa_envs.ops.perceive import perceive_rows
from npa_envs.ops.physics import Physics
from npa_envs.ops.species import checked_counts, perceive_by_species
from npa_envs.ops.static import StaticRows
from npa_envs.ops.update import update_particles
from npa_envs.rule.network import Network
from npa_envs.rule.rule import NPARule
from npa_envs.world.divergence import DivergenceWatch, OnDivergence, make_watch
from npa_envs.world.division import Births
from npa_envs.world.randomness import Randomness, WorldRandom, check_generator
from npa_envs.world.recorded import CudaGraph, Particles, check_cuda_graph, run_call
from npa_envs.world.rollout import (
    Memory,
    RolloutOptions,
    check_memory,
    checked_keep_every,
    checked_physics,
    rollout,
    run_steps,
)
from npa_envs.world.steps import Draws, draw_step, row_capacity

SpeciesPerception = Literal["shared", "per_species"]

MODES: tuple[SpeciesPerception, ...] = ("shared", "per_species")
"""What rules see of species: nothing, or the density and the density gradient of each."""

AGREEMENTS = (
    "space_dim",
    "state_dim",
    "eps0",
    "static",
    "state_gradient",
    "moment_correction",
    "moment_inverse",
    "density_gradient",
)
"""What rules must have in common to read one perception pass."""


@overload
def rollout_species(
    rules: Sequence[NPARule],
    x: Tensor,
    s: Tensor,
    steps: int,
    *,
    counts: Sequence[int],
    update_prob: float | Sequence[float] = ...,
    perception: SpeciesPerception = ...,
    density_counts: Sequence[float] | None = ...,
    return_path_length: Literal[False] = ...,
    **options: Unpack[RolloutOptions],
) -> tuple[Tensor, Tensor]: ...


@overload
def rollout_species(
    rules: Sequence[NPARule],
    x: Tensor,
    s: Tensor,
    steps: int,
    *,
    counts: Sequence[int],
    update_prob: float | Sequence[float] = ...,
    perception: SpeciesPerception = ...,
    density_counts: Sequence[float] | None = ...,
    return_path_length: Literal[True],
    **options: Unpack[RolloutOptions],
) -> tuple[Tensor, Tensor, Tensor]: ...


def rollout_species(
    rules: Sequence[NPARule],
    x: Tensor,
    s: Tensor,
    steps: int,
    *,
    counts: Sequence[int],
    eps: float | None = None,
    update_prob: float | Sequence[float] = 0.5,
    box: Box = None,
    dt: float = 1.0,
    position_noise: float = 0.0,
    generator: Randomness | None = None,
    detach_positions: bool = True,
    perception: SpeciesPerception = "shared",
    density_counts: Sequence[float] | None = None,
    memory: Memory = "store",
    on_divergence: OnDivergence = "ignore",
    keep_every: int | None = None,
    cuda_graph: CudaGraph = "auto",
    return_path_length: bool = False,
) -> tuple[Tensor, Tensor] | tuple[Tensor, Tensor, Tensor]:
    """Run several rules in one world; differentiable, and particle i stays particle i.

    Each step is that of `rollout`: one perception pass for the particles of all species, then each
    species' rule updates its own particles. As in the paper (arXiv 2601.16096), a rule reads the
    states of all neighbours, whatever their species. With one species this is `rollout`. With
    several species of the same rule it is `rollout` of all particles, up to rounding.

    Perceived densities are divided by the number of particles in the whole world. So for a rule
    that was trained alone, foreign particles lower the density that it perceives, however far away
    they are. With `density_counts=counts` each species divides by its own number, as it does alone.

    Args:
        rules: One rule for each species; dtype and device of x. They agree in space dimension,
            channels, eps0, groups of perception, and in whether particles move; not necessarily in
            hidden units, alpha or read-out.
        x: Particle positions [length units], shape [B, N, D], species after species.
        s: Particle states, dimensionless, shape [B, N, C].
        steps: Number of steps T, 0 or more.
        counts: Particles of each species, which sum to N: species k owns `counts[k]` consecutive
            ones.
        eps: Perception radius [length units]; default: the rules' eps0.
        update_prob: Probability of each particle's update in a step, in (0, 1], for all species or
            one for each.
        box: Sides of a periodic box centred on the origin [length units], or None for open space.
        dt: Time step, dimensionless.
        position_noise: Standard deviation of the noise added to every position in each step
            [length units].
        generator: Source of the masks and the noise, on x's device; default: torch's global one.
            With one `update_prob` it draws the same numbers as in `rollout`.
        detach_positions: Perception does not back-propagate into positions (the paper's choice).
        perception: "shared", or "per_species" for rules made with `species_count`: they also
            perceive the density and the density gradient of each species, as `perceive_species`
            gives them.
        density_counts: Number that each species divides densities and their gradients by, positive;
            default: N, the particles of the world, for all.
        memory: What the backward pass reads is stored or recomputed, as in `rollout`.
        on_divergence: "ignore" worlds that diverge, or "raise" at the end, as in `rollout`.
        keep_every: Return the worlds after every so many steps, as in `rollout`.
        cuda_graph: Whether calls that repeat are replayed on CUDA, as in `rollout`.
        return_path_length: Also return how far each particle travelled.

    Returns:
        Positions [length units], shape [B, N, D]; states, dimensionless, shape [B, N, C]; and where
        asked the length of each particle's path [length units], shape [B, N].

    Raises:
        NPAError: Rules do not agree, counts do not fit, or as for `rollout`.
        DivergedError: As for `rollout`.
    """
    steps = checked_count("steps", steps)
    species_rules = _checked_rules(rules)
    check_world(x, s)
    sizes = checked_counts(counts, x.shape[1])
    _check_agreement(species_rules, len(sizes), perception)
    probabilities = _checked_probabilities(update_prob, len(sizes))
    divisors = _checked_divisors(density_counts, sizes)
    check_memory(memory)
    if perception == "shared" and divisors == (float(x.shape[1]),):
        *after, travelled = rollout(
            species_rules[0],
            x,
            s,
            steps,
            eps=eps,
            box=box,
            update_prob=probabilities[0],
            dt=dt,
            position_noise=position_noise,
            detach_positions=detach_positions,
            memory=memory,
            generator=generator,
            on_divergence=on_divergence,
            keep_every=keep_every,
            cuda_graph=cuda_graph,
            return_path_length=True,
        )
        return (after[0], after[1], travelled) if return_path_length else (after[0], after[1])
    kept = checked_keep_every(keep_every, steps)
    check_cuda_graph(cuda_graph)
    own = [
        checked_physics(
            rule, x, s, eps=eps, box=box, update_prob=chance, dt=dt, position_noise=position_noise
        )
        for rule, chance in zip(species_rules, probabilities, strict=True)
    ]
    common = own[0]._replace(
        update_prob=max(each.update_prob for each in own),
        max_displacement=max(each.max_displacement for each in own),
    )
    species = tuple(
        SpeciesSpec(size, each.update_prob, divisor)
        for size, each, divisor in zip(sizes, own, divisors, strict=True)
    )
    check_generator(generator, x.device, x.shape[0])
    worlds = run_call(
        SpeciesCall(
            steps,
            common,
            checked_flag("detach_positions", detach_positions),
            memory,
            kept,
            species,
            perception == "per_species",
        ),
        species_rules,
        x,
        s,
        generator,
        cuda_graph=cuda_graph,
        watch=make_watch(on_divergence, x, s),
    )
    if return_path_length:
        return worlds.x, worlds.s, worlds.path_length
    return worlds.x, worlds.s


class SpeciesSpec(NamedTuple):
    """What may differ between species, besides their rules."""

    count: int
    """Its particles in a world."""
    update_prob: float
    """Probability of each of its particles' updates."""
    density_count: float
    """Particles by which it divides densities."""


class SpeciesCall(NamedTuple):
    """What a checked call of `rollout_species` asks for besides its tensors."""

    steps: int
    physics: Physics
    detach_positions: bool
    memory: Memory
    keep_every: int | None
    species: tuple[SpeciesSpec, ...]
    by_species: bool

    def run(
        self,
        rules: Sequence[NPARule],
        worlds: Particles,
        generator: Randomness | None,
        watch: DivergenceWatch | None = None,
    ) -> Particles:
        """Launch the rollout."""
        return run_steps(
            make_species_step(self, rules, worlds.x),
            rules,
            worlds,
            self.steps,
            generator=generator,
            memory=self.memory,
            keep_every=self.keep_every,
            watch=watch,
            with_modules=not all(rule.has_network() for rule in rules),
        )


def _checked_rules(rules: Any) -> list[NPARule]:
    given = None if isinstance(rules, NPARule) else entries(rules)
    if given is None:
        raise NPAError(
            f"rules must hold one rule for each species, got {type(rules).__name__}: "
            f"give (rule,) for one species"
        )
    for number, rule in enumerate(given):
        if not isinstance(rule, NPARule):
            raise NPAError(
                f"rules must be NPARule each, got {type(rule).__name__} as rule {number}: "
                f"load it with npa_envs.load_rule"
            )
    return given


def _check_agreement(rules: list[NPARule], species_count: int, perception: str) -> None:
    """Check that rules fit each other, the number of species and the mode of perception."""
    if not isinstance(perception, str) or perception not in MODES:
        raise NPAError(f"perception must be 'shared' or 'per_species', got {shown(perception)}")
    if len(rules) != species_count:
        raise NPAError(
            f"rules and counts must be one for each species, got {len(rules)} rules and "
            f"{species_count} counts"
        )
    expected = 0 if perception == "shared" else species_count
    for number, rule in enumerate(rules):
        if rule.divides:
            raise NPAError(
                f"rules of several species must not divide, got divides=True for rule {number}: "
                "run it alone with npa_envs.rollout"
            )
        for name in AGREEMENTS:
            first, other = getattr(rules[0], name), getattr(rule, name)
            if first != other:
                raise NPAError(
                    f"rules must agree in {name}, got {first} for rule 0 and {other} for rule "
                    f"{number}: train them alike"
                )
        if rule.species_count != expected:
            raise NPAError(
                f"perception {shown(perception)} of {species_count} species needs rules with "
                f"species_count={expected}, got {rule.species_count} for rule {number}"
            )


def _checked_probabilities(update_prob: Any, species_count: int) -> list[Any]:
    """Return one probability for each species; their values are checked with the rules."""
    given = entries(update_prob)
    if given is None:
        return [update_prob] * species_count
    if len(given) != species_count:
        raise NPAError(
            f"update_prob must be one number, or one for each of {species_count} species, "
            f"got {len(given)}"
        )
    return given


def _checked_divisors(density_counts: Any, counts: tuple[int, ...]) -> tuple[float, ...]:
    """Return what each species divides densities by."""
    if density_counts is None:
        return (float(sum(counts)),) * len(counts)
    given = entries(density_counts)
    if given is None:
        given = [density_counts]
    checked = tuple(checked_number("an entry of density_counts", number) for number in given)
    if len(checked) != len(counts) or not all(0.0 < number < math.inf for number in checked):
        raise NPAError(
            f"density_counts must hold one positive number for each of {len(counts)} species, "
            f"got {shown(density_counts)}: for example density_counts={counts}"
        )
    return checked


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

    def draws(self, x: Tensor, steps: int, generator: Randomness | None) -> Iterator[Draws]:
        """Draw each step's update mask and position noise: as for one rule, thinned by species."""
        for _ in range(steps):
            yield self._draw(x, generator)

    def _draw(self, x: Tensor, generator: Randomness | None) -> Draws:
        mask, noise, *_ = draw_step(x, self.physics, generator)
        if self.update_share is None:
            return Draws(mask, noise)
        if isinstance(generator, WorldRandom):
            drawn = generator.uniform(x.shape[1])
        else:
            drawn = torch.rand(x.shape[:2], device=x.device, generator=generator)
        kept = (drawn < self.update_share).to(torch.uint8)
        return Draws(kept if mask is None else mask * kept, noise)

    def advance(
        self,
        x: Tensor,
        s: Tensor,
        path_length: Tensor,
        mask: Tensor | None,
        noise: Tensor | None,
        rows: StaticRows | None,
        births: Births | None,
    ) -> Particles:
        """Advance checked worlds by one step whose random draws are given."""
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
        return Particles(
            *update_particles(
                update[:row_count],
                x if noise is None else x + noise,
                s,
                path_length,
                active,
                physics,
            )
        )

    def ordered(self, worlds: Particles) -> Particles:
        """Return the worlds: they are in the caller's order."""
        return worlds


def make_species_step(call: SpeciesCall, rules: Sequence[NPARule], x: Tensor) -> SpeciesStep:
    """Return the step of a rollout from positions [B, N, D]; one rule for each species."""
    species = []
    first = 0
    longest = max(rule.alpha for rule in rules)
    for rule, own in zip(rules, call.species, strict=True):
        species.append(
            Species(
                rule=rule,
                network=rule.network(),
                first=first,
                end=first + own.count,
                update_prob=constant(own.update_prob),
                reach_share=rule.alpha / longest,
                count_ratio=x.shape[1] / own.density_count,
            )
        )
        first += own.count
    physics = call.physics.constants()
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
    return SpeciesStep(species, physics, call.detach_positions, update_share, call.by_species)


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
