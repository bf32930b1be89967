"""Several rules in one world: each species follows its own rule, and all perceive each other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, get_args

from torch import Tensor

from npa_envs.checks import Box, as_list, check_world, checked_choice, checked_positive
from npa_envs.errors import NPAError, shown
from npa_envs.ops.physics import Boundary
from npa_envs.ops.species_density import checked_counts
from npa_envs.rule.rule import NPARule
from npa_envs.world.capture_cache import CudaGraph
from npa_envs.world.divergence import OnDivergence
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import Randomness
from npa_envs.world.rollout import checked_physics, returned_fields, run_rules, take_physics
from npa_envs.world.rollout_execution import Memory
from npa_envs.world.steps import SpeciesSpec

SpeciesPerception = Literal["shared", "per_species"]
"""Whether rules perceive each species' density and density gradient, or only those of all."""

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
"""Attributes in which rules must agree to share a perception pass."""


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
    boundary: Boundary | None = None,
    dt: float = 1.0,
    position_noise: float = 0.0,
    generator: Randomness | None = None,
    detach_positions: bool = True,
    perception: SpeciesPerception = "shared",
    density_counts: float | Sequence[float] | None = None,
    memory: Memory = "store",
    on_divergence: OnDivergence = "ignore",
    keep_every: int | None = None,
    cuda_graph: CudaGraph = "auto",
    return_path_length: bool = False,
) -> tuple[Tensor, ...]:
    """Run several rules in one world; differentiable, and particle i stays particle i.

    Each step is that of `rollout`: one perception pass for the particles of all species, then each
    species' rule updates its own particles. As in the paper (arXiv 2601.16096), a rule reads the
    states of all neighbours, whatever their species. With one species this is `rollout`. With
    several species of the same rule it is `rollout` of all particles, up to rounding.

    Perceived densities are divided by the number of particles in the world. So for a rule that was
    trained without others, their particles lower the density that it perceives, at any distance.
    With `density_counts=counts` each species divides by its own number, as in training.

    All other arguments are those of `rollout`.

    Args:
        rules: One rule for each species; dtype and device of x. They agree in space dimension,
            channels, eps0, groups of perception, and in whether particles move; hidden units, alpha
            and readout may differ.
        x: Particle positions [length units], shape [B, N, D], species after species.
        counts: Particles of each species, which sum to N: species k owns `counts[k]` consecutive
            ones.
        update_prob: Probability of each particle's update in a step, in (0, 1], for all species or
            one for each.
        generator: As for `rollout`; with one `update_prob` it draws the same numbers.
        perception: "shared", or "per_species" for rules made with `species_count`: they also
            perceive the density and the density gradient of each species, as `perceive_species`
            gives them.
        density_counts: Number that each species divides densities and their gradients by, positive,
            for all species or one for each; default: N, the particles of the world, for all.

    Returns:
        As `rollout`.

    Raises:
        NPAError: Rules do not agree, counts do not fit, or as for `rollout`.
        DivergedError: As for `rollout`.
    """
    after = species_particles(
        rules,
        Particles(x, s),
        steps,
        counts=counts,
        eps=eps,
        update_prob=update_prob,
        box=box,
        boundary=boundary,
        dt=dt,
        position_noise=position_noise,
        generator=generator,
        detach_positions=detach_positions,
        perception=perception,
        density_counts=density_counts,
        memory=memory,
        on_divergence=on_divergence,
        keep_every=keep_every,
        cuda_graph=cuda_graph,
        return_path_length=return_path_length,
    )
    return returned_fields(after)


def species_particles(
    rules: Sequence[NPARule],
    worlds: Particles,
    steps: int,
    *,
    counts: Sequence[int],
    update_prob: float | Sequence[float] = 0.5,
    perception: SpeciesPerception = "shared",
    density_counts: float | Sequence[float] | None = None,
    **options: Any,
) -> Particles:
    """Run rules as `rollout_species` does, with its options; return worlds with all fields."""
    check_world(worlds.x, worlds.s)
    particle_count = worlds.x.shape[1]
    sizes = checked_counts(counts, particle_count)
    species_rules = _checked_rules(rules, len(sizes), perception)
    probabilities = _for_each_species("update_prob", update_prob, len(sizes))
    divisors = _for_each_species(
        "density_counts", particle_count if density_counts is None else density_counts, len(sizes)
    )
    divisors = [checked_positive("an entry of density_counts", count) for count in divisors]
    physics = take_physics(options)
    constants = [
        checked_physics(rule, worlds, update_prob=probability, **physics)
        for rule, probability in zip(species_rules, probabilities, strict=True)
    ]
    common = constants[0]._replace(
        update_prob=max(each.update_prob for each in constants),
        max_displacement=max(each.max_displacement for each in constants),
    )
    species = [
        SpeciesSpec(size, each.update_prob, divisor)
        for size, each, divisor in zip(sizes, constants, divisors, strict=True)
    ]
    per_species = perception == "per_species"
    if not per_species and divisors == [particle_count]:
        # With one species this is `rollout`.
        species = []
    return run_rules(
        species_rules, worlds, steps, common, species, per_species=per_species, **options
    )


def _checked_rules(rules: Any, species_count: int, perception: str) -> list[NPARule]:
    """Check that rules fit each other, the species' number and `perception`; return their list."""
    checked_choice("perception", perception, get_args(SpeciesPerception))
    checked = None if isinstance(rules, NPARule) else as_list(rules)
    if checked is None or not all(isinstance(rule, NPARule) for rule in checked):
        types = [type(entry).__name__ for entry in ([rules] if checked is None else checked)]
        raise NPAError(
            f"rules must have one NPARule for each species, got {', '.join(types)}: give (rule,) "
            "for one species, and load rules with npa_envs.load_rule"
        )
    if len(checked) != species_count:
        raise NPAError(
            f"rules and counts must be one for each species, got {len(checked)} rules and "
            f"{species_count} counts"
        )
    expected = 0 if perception == "shared" else species_count
    for number, rule in enumerate(checked):
        if rule.divides:
            raise NPAError(
                f"rules of several species must not divide, got divides=True for rule {number}: "
                "run it alone with npa_envs.rollout"
            )
        for name in AGREEMENTS:
            first, other = getattr(checked[0], name), getattr(rule, name)
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
    return checked


def _for_each_species(name: str, numbers: Any, species_count: int) -> list[Any]:
    """Return a list of one number for each species, from such a list or one number for all."""
    each = as_list(numbers)
    if each is None:
        return [numbers] * species_count
    if len(each) != species_count:
        raise NPAError(
            f"{name} must be one number, or one for each of {species_count} species, "
            f"got {len(each)}"
        )
    return each
