"""Behaviour cloning: rules that learn to do what other rules do."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from npa_envs.agents.learning.problem import Problem, world_seeds
from npa_envs.agents.learning.progress import Progress, annealed
from npa_envs.agents.learning.rules import RuleSet, Source
from npa_envs.checks import check_fraction, check_positive, is_real
from npa_envs.errors import NPAError, shown

VARIANCE_FLOOR = 1e-8
"""Added to the variance of the teacher's actions, which may be 0."""


@dataclass(frozen=True, kw_only=True)
class CloneOptions:
    """Options of `train`."""

    teacher: Source | Sequence[Source] | RuleSet | None = None
    """A rule, a shipped rule's name or a file, for all species or one for each, or a set of rules;
    it must be given, or a dataset."""
    dataset: str | None = None
    """A dataset of Minari, by its id, to learn from instead; the particle-steps that count are
    those learned from."""
    student_share: float = 0.5
    """Share of the worlds in which the student acts, in [0, 1]; 0: plain cloning."""
    collect_steps: int = 8
    """Steps of the worlds in an iteration."""
    kept_steps: int = 64
    """Steps of all worlds that are learned from, at least `collect_steps`."""
    updates: int = 16
    """Optimiser's steps in an iteration."""
    batch_worlds: int = 4
    """Worlds, with all of their particles, in each of them."""
    learning_rate: float = 3e-3
    """Adam's, at the beginning."""
    last_rate: float = 0.02
    """Learning rate at the end, as a share of the first."""

    def __post_init__(self) -> None:
        """Check every field but the teacher; raises NPAError."""
        if not (is_real(self.student_share) and 0.0 <= self.student_share <= 1.0):
            raise NPAError(
                f"student_share must lie in [0, 1], got {shown(self.student_share)}: try 0.5"
            )
        check_positive(self, int, "collect_steps", "kept_steps", "updates", "batch_worlds")
        check_positive(self, float, "learning_rate")
        check_fraction(self, "last_rate")
        if self.kept_steps < self.collect_steps:
            raise NPAError(
                f"kept_steps must be at least collect_steps = {self.collect_steps}, got "
                f"{self.kept_steps}: give {8 * self.collect_steps}"
            )


DEFAULTS = CloneOptions()


def train(progress: Progress, options: CloneOptions = DEFAULTS) -> RuleSet:
    """Learn a teacher's actions in the worlds that it comes to, and in those of the student.

    The loss is the squared error of actions over the variance of the teacher's, column by column.
    In some of the worlds the student acts, as its errors lead to worlds that the teacher's actions
    do not, and the teacher's actions there are learned (dataset aggregation, Ross et al. 2011).
    """
    problem, device, seed = progress.problem, progress.device, progress.seed
    rules = progress.first_rules()
    generator = torch.Generator(device).manual_seed(seed)
    optimiser = torch.optim.Adam(
        rules.parameters(), lr=options.learning_rate, fused=device.type == "cuda"
    )
    if options.dataset is None:
        collect, some = _taught(problem, rules, seed, device, options)
    else:
        collect, some = None, _recorded(problem, device, options)

    def iteration() -> int:
        steps = options.updates * options.batch_worlds if collect is None else collect()
        rate = annealed(options.learning_rate, options.last_rate, progress.share)
        for group in optimiser.param_groups:
            group["lr"] = rate
        for _ in range(options.updates):
            loss = unexplained(rules, *some.draw(options.batch_worlds, generator))
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser.step()
        return steps * problem.particle_count

    return progress.run(rules, iteration)


def _taught(
    problem: Problem, rules: RuleSet, seed: int, device: torch.device, options: CloneOptions
) -> tuple[Callable[[], int], Demonstrations]:
    """Return a function that steps worlds and counts their steps, and its demonstrations."""
    source = options.teacher
    if source is None:
        raise NPAError("teacher must be given to clone, or a dataset: for example teacher='heart'")
    given = list(source) if isinstance(source, RuleSet) else source
    teacher = RuleSet.of(problem, given).to(device).policy()
    student, envs = rules.policy(), problem.make_envs(device=device)
    observation, _ = envs.reset(seed=world_seeds(seed, problem.num_envs))
    some = Demonstrations(options.kept_steps * problem.num_envs, observation, teacher(observation))
    taught = problem.num_envs - round(options.student_share * problem.num_envs)

    def collect() -> int:
        nonlocal observation
        for _ in range(options.collect_steps):
            action = teacher(observation)
            some.add(observation, action)
            if taught < problem.num_envs:
                action[taught:] = student(observation[taught:])
            observation, *_ = envs.step(action)
        return options.collect_steps * problem.num_envs

    return collect, some


def _recorded(problem: Problem, device: torch.device, options: CloneOptions) -> Demonstrations:
    """Return the demonstrations of a dataset, on a device."""
    from npa_envs.wrappers.minari import read_pairs

    if options.teacher is not None:
        raise NPAError("teacher must be None where a dataset is given: it holds what was done")
    assert options.dataset is not None, "checked by the caller"
    seen, done = read_pairs(options.dataset)
    interface, count = problem.interface, problem.particle_count
    wanted = (count, interface.perception_dim), (count, interface.action_dim)
    if (seen.shape[1:], done.shape[1:]) != wanted:
        raise NPAError(
            f"dataset must hold observations and actions of shapes {wanted}, got "
            f"{tuple(seen.shape[1:])} and {tuple(done.shape[1:])}: record it in this problem"
        )
    some = Demonstrations(len(seen), seen.to(device), done.to(device))
    some.add(seen.to(device), done.to(device))
    return some


def unexplained(rules: RuleSet, observation: Tensor, action: Tensor) -> Tensor:
    """Return the squared error of rules over the variance of the actions, a scalar.

    Observations have shape [B, N, P], the teacher's actions [B, N, A].
    """
    parts, errors = [], (rules.mean(observation) - action).square()
    for span in rules.spans:
        error = errors[:, span]
        variance = action[:, span].flatten(0, 1).var(dim=0, correction=0)
        parts.append((error.flatten(0, 1).mean(dim=0) / (variance + VARIANCE_FLOOR)).mean())
    return torch.stack(parts).mean()


class Demonstrations:
    """The last W observations of worlds, and the teacher's actions, on the device.

    At most `capacity` worlds are kept, of the shape and device of an observation and an action.
    """

    def __init__(self, capacity: int, observation: Tensor, action: Tensor) -> None:
        self.observations = observation.new_zeros(capacity, *observation.shape[1:])
        self.actions = action.new_zeros(capacity, *action.shape[1:])
        self.count = 0
        """Worlds that were added so far; the oldest are overwritten."""

    def add(self, observation: Tensor, action: Tensor) -> None:
        """Add some worlds, at most as many as are kept, shapes [B, N, P] and [B, N, A]."""
        capacity = len(self.observations)
        place = torch.arange(self.count, self.count + len(observation), device=observation.device)
        self.observations.index_copy_(0, place % capacity, observation)
        self.actions.index_copy_(0, place % capacity, action)
        self.count += len(observation)

    def draw(self, world_count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return some worlds drawn with replacement: observations and the teacher's actions."""
        kept, device = min(self.count, len(self.observations)), self.observations.device
        chosen = torch.randint(kept, (world_count,), generator=generator, device=device)
        return self.observations[chosen], self.actions[chosen]
