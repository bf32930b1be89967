"""Behaviour cloning: rules learn the actions of other rules, or of a dataset."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from npa_envs.agents.learning.problem import world_seeds
from npa_envs.agents.learning.progress import Progress, annealed
from npa_envs.agents.learning.rule_set import RuleSet, Source
from npa_envs.checks import check_fraction, check_non_negative, check_positive
from npa_envs.errors import NPAError

STORED_STEPS = 64
"""Number of last steps of all worlds that are learned from, or `collect_steps` if larger."""

VARIANCE_FLOOR = 1e-8
"""Added to the variance of the teacher's actions before dividing by it, as it may be 0."""


@dataclass(frozen=True, kw_only=True)
class CloneOptions:
    """Options of behaviour cloning."""

    teacher: Source | Iterable[Source] | None = None
    """Rules to imitate, as of `RuleSet.of`. None: the rules imitate a dataset."""
    dataset: str | None = None
    """Id of a Minari dataset to imitate; each use of a step counts. None: there is a teacher."""
    student_share: float = 0.5
    """Fraction of the worlds in which the new rules act, in [0, 1]; 0: only the teacher acts."""
    collect_steps: int = 8
    """Steps of the worlds in an iteration."""
    updates: int = 16
    """Optimiser's steps in an iteration."""
    batch_worlds: int = 4
    """Worlds, with all of their particles, in an optimiser's step."""
    learning_rate: float = 3e-3
    """Adam's learning rate at first."""
    last_rate: float = 0.02
    """Learning rate at the end of the budget, as a fraction of the first (dimensionless)."""

    def __post_init__(self) -> None:
        check_non_negative(self, "student_share", at_most=1.0)
        check_positive(self, int, "collect_steps", "updates", "batch_worlds")
        check_positive(self, float, "learning_rate")
        check_fraction(self, "last_rate")


def train(progress: Progress, options: CloneOptions = CloneOptions()) -> RuleSet:
    """Return rules, the student, that imitate the actions of a teacher or of a dataset.

    The loss is `unexplained_variance`. In a fraction of the worlds the student acts, so that it
    learns the teacher's actions also where its own errors lead (DAgger, Ross et al. 2011).
    """
    device, rules = progress.device, progress.first_rules()
    generator = torch.Generator(device).manual_seed(progress.seed)
    optimiser = torch.optim.Adam(
        rules.parameters(), lr=options.learning_rate, fused=device.type == "cuda"
    )
    if options.dataset is None:
        collect, demonstrations = _from_teacher(progress, rules, options)
    else:
        collect, demonstrations = None, _from_dataset(progress, options)

    def iteration() -> int:
        steps = options.updates * options.batch_worlds if collect is None else collect()
        (weights,) = optimiser.param_groups
        weights["lr"] = annealed(options.learning_rate, options.last_rate, progress.spent_fraction)
        for _ in range(options.updates):
            loss = unexplained_variance(
                rules, *demonstrations.draw(options.batch_worlds, generator)
            )
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser.step()
        return steps * progress.problem.particle_count

    return progress.run(rules, iteration)


def _from_teacher(
    progress: Progress, rules: RuleSet, options: CloneOptions
) -> tuple[Callable[[], int], Demonstrations]:
    """Return a function that steps worlds into a buffer and counts their steps, and the buffer."""
    problem, device, source = progress.problem, progress.device, options.teacher
    if source is None:
        raise NPAError("teacher must be given to clone, or a dataset: for example teacher='heart'")
    teacher = RuleSet.of(problem, source).to(device).policy()
    student, envs = rules.policy(), problem.make_envs(device=device)
    observation, _ = envs.reset(seed=world_seeds(progress.seed, problem.num_envs))
    stored_steps = max(STORED_STEPS, options.collect_steps)
    capacity = stored_steps * problem.num_envs
    demonstrations = Demonstrations(capacity, observation, teacher(observation))
    teacher_worlds = problem.num_envs - round(options.student_share * problem.num_envs)

    def collect() -> int:
        nonlocal observation
        for _ in range(options.collect_steps):
            action = teacher(observation)
            demonstrations.add(observation, action)
            if teacher_worlds < problem.num_envs:
                action[teacher_worlds:] = student(observation[teacher_worlds:])
            observation, *_ = envs.step(action)
        return options.collect_steps * problem.num_envs

    return collect, demonstrations


def _from_dataset(progress: Progress, options: CloneOptions) -> Demonstrations:
    from npa_envs.wrappers.minari import read_pairs

    if options.teacher is not None:
        raise NPAError("teacher must be None with a dataset, which contains the actions")
    assert options.dataset is not None, "checked by the caller"
    observations, actions = read_pairs(options.dataset)
    interface, count = progress.problem.interface, progress.problem.particle_count
    wanted = (count, interface.perception_dim), (count, interface.action_dim)
    if (observations.shape[1:], actions.shape[1:]) != wanted:
        raise NPAError(
            f"dataset must have observations and actions of shapes {wanted}, got "
            f"{tuple(observations.shape[1:])} and {tuple(actions.shape[1:])}: record it in this "
            "problem"
        )
    observations, actions = observations.to(progress.device), actions.to(progress.device)
    demonstrations = Demonstrations(len(observations), observations, actions)
    demonstrations.add(observations, actions)
    return demonstrations


def unexplained_variance(rules: RuleSet, observation: Tensor, action: Tensor) -> Tensor:
    """Return 1 - R²: the squared error of the rules' actions over the variance of the teacher's.

    It is a mean over species and columns, for observations [B, N, P] and actions [B, N, A].
    """
    ratios, errors = [], (rules.mean(observation) - action).square()
    for span in rules.spans:
        error = errors[:, span]
        variance = action[:, span].flatten(0, 1).var(dim=0, correction=0)
        ratios.append((error.flatten(0, 1).mean(dim=0) / (variance + VARIANCE_FLOOR)).mean())
    return torch.stack(ratios).mean()


class Demonstrations:
    """Ring buffer of observations and actions of up to `capacity` worlds, [N, P] and [N, A] each.

    Shapes, types and device are those of `observation`, [B, N, P], and `action`, [B, N, A].
    """

    def __init__(self, capacity: int, observation: Tensor, action: Tensor) -> None:
        self.observations = observation.new_zeros(capacity, *observation.shape[1:])
        self.actions = action.new_zeros(capacity, *action.shape[1:])
        self.count = 0
        """Number of worlds added so far."""

    def add(self, observation: Tensor, action: Tensor) -> None:
        """Add B worlds, [B, N, P] and [B, N, A], in place of the oldest; B <= capacity."""
        capacity = len(self.observations)
        index = torch.arange(self.count, self.count + len(observation), device=observation.device)
        self.observations.index_copy_(0, index % capacity, observation)
        self.actions.index_copy_(0, index % capacity, action)
        self.count += len(observation)

    def draw(self, world_count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return observations [B, N, P] and actions [B, N, A] of worlds drawn with replacement."""
        stored, device = min(self.count, len(self.observations)), self.observations.device
        index = torch.randint(stored, (world_count,), generator=generator, device=device)
        return self.observations[index], self.actions[index]
