"""Evaluation of candidate rules that a search proposes: rollouts, quality and descriptors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs import NPARule, WorldRandom, perception_fields
from npa_envs.agents.learning.evolution import RuleWeights, updates_of
from npa_envs.checks import check_positive
from npa_envs.errors import NPAError
from npa_envs.tasks.seeds import uniform_ball
from npa_envs.world.particles import Particles, combined
from npa_envs.world.rollout import rollout_particles

SNAPSHOTS = 16
"""Number of times at which a rollout is stored, evenly spread; the second half is evaluated."""

UPDATE_PROB = 0.5
"""Probability of a particle's update in a step (dimensionless)."""

SEED_RADIUS = 0.2
"""Radius of the disk in which particles start [length units]."""

MIN_VARIANCE = 1e-12
"""Colours with a variance of at most this count as a single colour (dimensionless)."""

Numbers = NDArray[np.float64]


class Axis(NamedTuple):
    """A descriptor of worlds: its name and range, and the archive's number of cells along it."""

    name: str
    lowest: float
    highest: float
    cells: int


@dataclass(frozen=True, kw_only=True)
class SearchWorld:
    """Sizes of the candidate rules and of the worlds in which they are evaluated."""

    particle_count: int = 128
    """Particles N."""
    steps: int = 128
    """Steps of a rollout T, a multiple of 16; the second half of them is evaluated."""
    world_count: int = 1
    """Worlds of each candidate, B, over which quality and descriptors are averaged."""
    state_dim: int = 4
    """State channels C, at least 3; the last three are the colour (less 0.5)."""
    hidden_dim: int = 8
    """Hidden units of a rule."""
    eps: float = 0.1
    """Perception radius ε [length units]."""

    def __post_init__(self) -> None:
        check_positive(self, int, "particle_count", at_least=4)
        check_positive(self, int, "steps", "world_count", "hidden_dim")
        check_positive(self, int, "state_dim", at_least=3)
        check_positive(self, float, "eps")
        if self.steps % SNAPSHOTS:
            raise NPAError(
                f"steps must be a multiple of {SNAPSHOTS}, got {self.steps}: "
                f"take {-(-self.steps // SNAPSHOTS) * SNAPSHOTS}"
            )

    @property
    def particle_steps(self) -> int:
        """Cost of one candidate in particle-steps: B N T."""
        return self.world_count * self.particle_count * self.steps

    def make_rule(self) -> NPARule:
        """Return a rule of these sizes with random weights, on the CPU."""
        with torch.random.fork_rng(devices=()):
            return NPARule(2, self.state_dim, self.hidden_dim, eps0=self.eps).requires_grad_(False)

    def axes(self) -> tuple[Axis, ...]:
        """Return the descriptors by which the archive distinguishes worlds, all dimensionless.

        `speed` is the mean path length of a step over ε, at most α times the probability of an
        update. `crowding` is log(ρ / ρ₁) / log N for the mean density ρ at particles and the
        density ρ₁ of a single particle: 0 if none has neighbours, 1 if all coincide. `mixing` is
        1 − r for the correlation r between the colours of particles and the smoothed colours around
        them: 0 if neighbours look alike, 1 if their colours are independent.
        """
        fastest = self.make_rule().alpha * UPDATE_PROB
        return (
            Axis("speed", 0.0, fastest, 10),
            Axis("crowding", 0.0, 1.0, 10),
            Axis("mixing", 0.0, 1.0, 4),
        )


class Found(NamedTuple):
    """Quality and descriptors of a candidate."""

    quality: float
    """Value of `quality_of`, in (0, 1]."""
    measures: tuple[float, ...]
    """Values of the descriptors, in the order of `SearchWorld.axes`."""


class Evaluations(NamedTuple):
    """Results of G candidates, and the worlds in which they were evaluated."""

    found: list[Found | None]
    """Quality and descriptors of each; None where its worlds diverged or stopped changing."""
    worlds: Particles
    """The B worlds of each candidate at the end, positions [G, B, N, D] and so on."""


class RuleStack(NPARule):
    """G rules of one architecture as one rule of a batch of worlds: each updates some of them.

    The rules must have equally many worlds, with the same update masks, so that each gets the same
    number of perceptions. Weights have shape [G, W], in the order of `RuleWeights`.
    """

    def __init__(self, rule: NPARule, weights: Tensor) -> None:
        with torch.random.fork_rng(devices=()):
            super().__init__(**rule.hyper_parameters())
        self.weights = weights
        self.to(weights.device)

    def forward(self, perception: Tensor) -> Tensor:
        """Map perceptions [G K, P], K for each rule in turn, to raw updates [G K, A]."""
        count = len(self.weights)
        if len(perception) % count:
            # If no particle is updated there is one row, which is not used.
            return perception.new_zeros(len(perception), self.update_dim)
        rows = perception.reshape(count, len(perception) // count, self.perception_dim)
        return updates_of(self, self.weights, rows).flatten(0, 1)


class Candidates:
    """Evaluates candidates, each in B worlds with the same seeds, by default 0 to B - 1.

    On a CPU candidates share a batch. On CUDA, with perceptions of unknown number, each runs alone.
    """

    def __init__(
        self, world: SearchWorld, *, device: torch.device, seeds: Sequence[int] | None = None
    ) -> None:
        self.world = world
        self.device = device
        self._seeds = tuple(range(world.world_count) if seeds is None else seeds)
        self._rule = world.make_rule()
        self.scales = RuleWeights([self._rule]).scales()
        """Standard deviation of each weight by Xavier, shape [W]: the unit of `solutions`."""
        alone = torch.zeros(1, 1, 2), torch.zeros(1, 1, 1)
        self._alone = float(perception_fields(*alone, eps=world.eps).rho)

    @property
    def weight_count(self) -> int:
        """Number of weights of a candidate, W."""
        return len(self.scales)

    def rule_of(self, solution: Numbers) -> NPARule:
        """Return the rule with the weights `solution`, [W] in units of `scales`, on the CPU."""
        rule = self.world.make_rule()
        RuleWeights([rule]).set_vector(solution * self.scales)
        return rule

    @torch.no_grad()
    def try_all(self, solutions: Numbers) -> Evaluations:
        """Run candidates with weights `solutions`, [G, W] in units of `scales`; return results."""
        weights = torch.as_tensor(solutions * self.scales, dtype=torch.float32).to(self.device)
        batch_size = len(weights) if self.device.type == "cpu" else 1
        batches = [self._evaluate_batch(batch) for batch in torch.split(weights, batch_size)]
        found = [result for batch in batches for result in batch.found]
        return Evaluations(found, combined(torch.cat, [batch.worlds for batch in batches]))

    def _evaluate_batch(self, weights: Tensor) -> Evaluations:
        """Run candidates with weights [G, W] in one batch; return their results and last worlds."""
        snapshots, speeds = self._run(weights)
        found: list[Found | None] = []
        for k, speed in enumerate(speeds.tolist()):
            own = Particles(snapshots.x[:, k], snapshots.s[:, k])
            quality = float(quality_of(own))
            # It is 0 if worlds came to rest, NaN if they diverged.
            if quality > 0.0:
                flat = own.map(lambda values: values.flatten(0, 1))
                found.append(Found(quality, (speed, *self.crowding_and_mixing(flat))))
            else:
                found.append(None)
        return Evaluations(found, snapshots.map(lambda values: values[-1]))

    def _run(self, weights: Tensor) -> tuple[Particles, Tensor]:
        """Return worlds at T late times, [T, G, B, N, ...], and the `speed` of candidates, [G]."""
        world, count = self.world, len(weights)
        random = WorldRandom(self._seeds * count, device=self.device)
        shape = random.world_count, world.particle_count, 2
        x = uniform_ball(*shape, SEED_RADIUS, generator=random, device=self.device)
        s = x.new_zeros(*x.shape[:2], world.state_dim)
        every, late = world.steps // SNAPSHOTS, SNAPSHOTS // 2
        options: dict[str, Any] = {"generator": random, "keep_every": every}
        options |= {"update_prob": UPDATE_PROB, "return_path_length": True}
        rule = RuleStack(self._rule, weights)
        after = rollout_particles(rule, Particles(x, s), world.steps, **options)
        path = after.path_length
        assert path is not None, "it is asked for"
        travelled = (path[-1] - path[late - 1]).mean(dim=1) / ((SNAPSHOTS - late) * every)
        speeds = travelled.view(count, -1).mean(dim=1) / world.eps
        snapshots = after.map(
            lambda values: values[late:].view(SNAPSHOTS - late, count, -1, *values.shape[2:])
        )
        return snapshots, speeds

    def crowding_and_mixing(self, worlds: Particles) -> tuple[float, float]:
        """Return `crowding` (of the mean density) and mean `mixing`; see `SearchWorld.axes`."""
        colours = _colours(worlds)
        fields = perception_fields(worlds.x, colours, eps=self.world.eps)
        excess = math.log(float(fields.rho.mean()) / self._alone)
        mixing = 1.0 - correlation(colours, fields.blur)
        return excess / math.log(self.world.particle_count), float(mixing.mean().clamp(0.0, 1.0))


def _colours(worlds: Particles) -> Tensor:
    """Return particles' colours minus 0.5, clipped to ± 0.5, shape [..., 3]."""
    return worlds.s[..., -3:].clamp(-0.5, 0.5)


def quality_of(worlds: Particles) -> Tensor:
    """Return the quality of B worlds at T times, [T, B, N, ...]: a number in [0, 1], shape [].

    It is alive / (1 + mean |s − clip(s, −1, 1)| + mean |x − clip(x, −1, 1)|). `alive` is twice the
    mean standard deviation of a particle's colour channels over time: 1 if all flicker from 0 to 1.
    """
    excess = [(values - values.clamp(-1.0, 1.0)).abs().mean() for values in worlds.tensors()]
    alive = 2.0 * _colours(worlds).std(dim=0, correction=0).mean()
    return alive / (1.0 + excess[0] + excess[1])


def correlation(first: Tensor, second: Tensor) -> Tensor:
    """Return the correlation of two fields [B, N, C] over particles and channels, shape [B].

    The mean of each channel is subtracted. The correlation is 1 if the first field is constant.
    """
    a, b = (field - field.mean(dim=1, keepdim=True) for field in (first, second))
    together = (a * b).sum(dim=(1, 2))
    sizes = a.square().sum(dim=(1, 2)) * b.square().sum(dim=(1, 2))
    one_colour = a.square().mean(dim=(1, 2)) <= MIN_VARIANCE
    return torch.where(one_colour, 1.0, together / sizes.clamp_min(1e-30).sqrt())
