"""Tasks: what the trainer asks of one, and what most of them have in common.

Any object with the methods of `Task` can be trained on; `ParticleTask` has those that are alike.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Generic, Protocol, Self, TypeVar, cast, runtime_checkable

import torch
from torch import Tensor

from npa_envs.checks import check_fraction, check_non_negative, check_positive
from npa_envs.errors import NPAError, shown
from npa_envs.ops import Cameras, world_mean
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.appearance import Gaussians
from npa_envs.world.randomness import Randomness


class Task(Protocol):
    """A thing to learn. Shapes: B worlds, N particles, D space, C channels, R pixels.

    No method may wait for the device (no `.item()`, no branch on a tensor's value): the trainer
    captures `seed`, `damage` and `loss` in CUDA graphs and never reads a number back between two
    log lines. So these must do the same in every iteration, and draw from their generator alone.
    """

    @property
    def eps(self) -> float:
        """Perception radius ε [length units]."""

    @property
    def box(self) -> tuple[float, ...] | None:
        """Sides of the periodic box [length units], or None where the domain is open."""

    @property
    def update_prob(self) -> float:
        """Probability p that a particle is updated in a step (dimensionless)."""

    def make_rule(self, generator: torch.Generator) -> NPARule:
        """Return an untrained rule on the CPU; its weights are drawn from `generator`."""

    def seed(
        self, world_count: int, *, generator: Randomness, device: torch.device
    ) -> tuple[Tensor, Tensor]:
        """Return fresh worlds: positions x [B, N, D] [length units] and states s [B, N, C]."""

    def damage(self, x: Tensor, s: Tensor, generator: Randomness) -> tuple[Tensor, Tensor]:
        """Return the worlds damaged, as the pool's are before a rollout, so that they heal."""

    def loss(self, x: Tensor, s: Tensor, path_length: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the scalar to minimise and its named parts, scalars too.

        Args:
            x: Positions [length units], shape [B, N, D].
            s: States, shape [B, N, C].
            path_length: Σ|Δx| of every particle over the rollout [length units], shape [B, N].
        """

    def picture(self, x: Tensor, s: Tensor) -> Tensor:
        """Return the picture of each world: rgb sums and density, shape [B, R, R, 4]."""

    def metric(self, x: Tensor, s: Tensor) -> Tensor:
        """Return how far each world is from the goal, shape [B]; lower is better."""


class PictureTask(Task, Protocol):
    """A task that is learned from a picture: what films and the evaluation need besides."""

    @property
    def target_picture(self) -> Tensor:
        """The picture to match: rgb sums and density, shape [R, R, 4]."""

    @property
    def aligned(self) -> bool:
        """Whether worlds are to match it pixel by pixel, so that a PSNR means something."""

    @property
    def metric_name(self) -> str:
        """What `metric` is, in a word or two."""


@runtime_checkable
class ReadOutTask(Protocol):
    """A task that needs its rule: it compares what the rule reads out of the states, or its fresh
    worlds carry a code of the rule.

    It has all that `Task` has besides.
    """

    def for_rule(self, rule: NPARule) -> Task:
        """Return the task with worlds, losses, metric and pictures as they are for `rule`.

        Its parameters are read anew at each call, so that losses are differentiable in them and
        change with them. The task itself stays as it is.
        """


@runtime_checkable
class GoalTask(Protocol):
    """A task in which every world has a goal of its own, such as the class of what it shows.

    It has all that `Task` has besides; goals are int64, shape [B], and stay with their worlds.
    """

    def seed_with_goals(
        self, world_count: int, *, generator: Randomness, device: torch.device
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return fresh worlds as `seed` does, and their goals."""

    def damage_with_goals(
        self, x: Tensor, s: Tensor, goal: Tensor, generator: Randomness
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the worlds damaged as `damage` does, and what their goals are then."""

    def toward(self, goal: Tensor) -> Task:
        """Return the task with loss and metric for worlds of these goals.

        The tensor is read anew at each call. The task itself stays as it is.
        """


@runtime_checkable
class CodedTask(Protocol):
    """A task whose worlds may carry a code of their rule, which says what to grow.

    It has all that `Task` has besides.
    """

    def coded(self, s: Tensor) -> Tensor:
        """Return states [B, N, C] with the code of each world as it is now, or as they are.

        Where it is learned, they are differentiable in it.
        """


@runtime_checkable
class ScheduledTask(Protocol):
    """A task whose loss changes from iteration to iteration: by a curriculum, or by draws.

    It has all that `Task` has besides.
    """

    def begin(self, iteration: int) -> None:
        """Prepare the loss of an iteration, without waiting for the device.

        Recorded graphs read what is written here: always into the same tensors. What is written
        must follow from the iteration alone, so that a resumed run goes on as it would have.
        """


@runtime_checkable
class ViewTask(Protocol):
    """A task of 3D worlds that cameras see as Gaussians, from several sides.

    It has all that `PictureTask` has besides.
    """

    def view_psnr(self, x: Tensor, s: Tensor) -> Tensor:
        """Return each world's mean PSNR over the views that it is measured by [dB], shape [B]."""

    def views(self, x: Tensor, s: Tensor, cameras: Cameras) -> Tensor:
        """Return what cameras see: colours times alpha, and alpha, shape [B, V, H, W, 4]."""

    def gaussians(self, s: Tensor) -> Gaussians:
        """Return how particles of states s [B, N, C] look."""


@dataclass(frozen=True, kw_only=True)
class TaskConfig:
    """World and rule of a task; the configurations of tasks add what they are told besides."""

    particle_count: int = 4096
    """Particles in a world, N."""

    state_dim: int = 16
    """State channels of a particle, C; the last three are its colour (less 0.5)."""

    hidden_dim: int = 128
    """Width of the rule's hidden layer."""

    eps: float = 0.1
    """Perception radius ε [length units]; the rule is trained at it, so it is also its ε0."""

    update_prob: float = 0.5
    """Probability p that a particle is updated in a step (dimensionless)."""

    resolution: int = 128
    """Pixels on each side of a world's picture, R."""

    overflow_weight: float = 100.0
    """Weight of mean |s − clip(s, −1, 1)| (dimensionless)."""

    def __post_init__(self) -> None:
        """Check every field; raise NPAError where one has a wrong type or lies out of its range."""
        check_positive(self, int, "particle_count", "state_dim", "hidden_dim")
        check_positive(self, int, "resolution", at_least=2)
        check_positive(self, float, "eps")
        check_fraction(self, "update_prob")
        check_non_negative(self, "overflow_weight")

    def with_particle_count(self, particle_count: int) -> Self:
        """Return the same task with another number of particles."""
        return replace(self, particle_count=particle_count)


ConfigT = TypeVar("ConfigT", bound=TaskConfig)


class ParticleTask(Generic[ConfigT]):
    """A task of one rule: world, untrained rule, fresh worlds, and the penalties of the loss.

    A task says where particles begin (`places`) and what is compared (`compare`), and has a
    picture and a metric besides. In all methods x are positions [length units], shape [B, N, D],
    s states (dimensionless), shape [B, N, C], and path_length is how far each particle travelled
    in the rollout [length units], shape [B, N].
    """

    config: ConfigT
    """What the task was told."""

    @property
    def eps(self) -> float:
        """Perception radius [length units]."""
        return self.config.eps

    @property
    def box(self) -> tuple[float, ...] | None:
        """Sides of the periodic box [length units]; None: open space."""
        return None

    @property
    def update_prob(self) -> float:
        """Probability of a particle's update in a step (dimensionless)."""
        return self.config.update_prob

    @property
    def rule_shape(self) -> dict[str, Any]:
        """What `NPARule` takes besides the channels, the hidden width and ε0."""
        raise NotImplementedError

    def make_rule(self, generator: torch.Generator) -> NPARule:
        """Return an untrained rule on the CPU; its weights are drawn from `generator`."""
        return untrained_rule(
            generator,
            state_dim=self.config.state_dim,
            hidden_dim=self.config.hidden_dim,
            eps0=self.config.eps,
            **self.rule_shape,
        )

    def places(self, world_count: int, generator: Randomness, device: torch.device) -> Tensor:
        """Return the positions of fresh worlds."""
        raise NotImplementedError

    def seed(
        self, world_count: int, *, generator: Randomness, device: str | torch.device = "cpu"
    ) -> tuple[Tensor, Tensor]:
        """Return fresh worlds: positions of `places`, all states zero.

        Args:
            world_count: Worlds B.
            generator: Source of the positions, on `device`.
            device: Where the worlds are made.
        """
        x = self.places(world_count, generator, torch.device(device))
        return x, x.new_zeros(*x.shape[:2], self.config.state_dim)

    def compare(self, x: Tensor, s: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Return how far worlds are from the goal, weighted, and its named parts, unweighted."""
        raise NotImplementedError

    def penalties(
        self, x: Tensor, s: Tensor, path_length: Tensor
    ) -> dict[str, tuple[float, Tensor]]:
        """Return what the loss adds to `compare`: weight and term by name."""
        overflow = (s - s.clamp(-1.0, 1.0)).abs().mean()
        return {"overflow": (self.config.overflow_weight, overflow)}

    def loss(self, x: Tensor, s: Tensor, path_length: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the training loss and its named parts, unweighted.

        Raises:
            NPAError: The shapes do not fit each other.
        """
        if path_length.shape != x.shape[:2]:
            raise NPAError(
                f"path_length must have shape {tuple(x.shape[:2])}, got {tuple(path_length.shape)}"
            )
        total, parts = self.compare(x, s)
        for name, (weight, term) in self.penalties(x, s, path_length).items():
            parts[name] = term
            total = total + weight * term
        return total, parts


TaskT = TypeVar("TaskT", bound=Task)


def task_for_rule(task: TaskT, rule: NPARule) -> TaskT:
    """Return a task as it is for the worlds of one rule; most are the same for all rules."""
    return cast(TaskT, task.for_rule(rule)) if isinstance(task, ReadOutTask) else task


def task_toward(task: TaskT, goal: Tensor | None) -> TaskT:
    """Return a task as it is for worlds of some goals; most tasks have none.

    Args:
        task: Any task.
        goal: The worlds' goals, int64, shape [B], or None.
    """
    return (
        task if goal is None or not isinstance(task, GoalTask) else cast(TaskT, task.toward(goal))
    )


def check_goal(goal: Tensor, count: int) -> None:
    """Check the goals of worlds; their range only on a CPU, as no task may wait for a CUDA device.

    Args:
        goal: What is to be the worlds' goals, int64, shape [B].
        count: How many goals there are to choose from.

    Raises:
        NPAError: It is no such tensor, or there is no such goal.
    """
    if not isinstance(goal, Tensor) or goal.dtype != torch.int64 or goal.ndim != 1:
        came = f"{goal.dtype} {tuple(goal.shape)}" if isinstance(goal, Tensor) else shown(goal)
        raise NPAError(
            f"goal must be an int64 tensor of shape [B], got {came}: for example torch.tensor([0])"
        )
    if goal.device.type == "cpu" and not bool(((goal >= 0) & (goal < count)).all()):
        raise NPAError(
            f"goal must hold numbers of at least 0 and below {count}, got {shown(goal.tolist())}: "
            "for example torch.tensor([0])"
        )


def coded_states(task: Task, s: Tensor) -> Tensor:
    """Return states that carry the code of their task again, where it has one.

    Damage to states takes it away, and no rule writes it.

    Args:
        task: Any task, toward the worlds' goals.
        s: States (dimensionless), shape [B, N, C].
    """
    return task.coded(s) if isinstance(task, CodedTask) else s


def seed_worlds(
    task: Task, world_count: int, *, generator: Randomness, device: torch.device
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Return fresh worlds of any task: positions, states, and goals where it has such."""
    if isinstance(task, GoalTask):
        return task.seed_with_goals(world_count, generator=generator, device=device)
    return *task.seed(world_count, generator=generator, device=device), None


def shares_of_loss(loss: Tensor, amounts: Tensor) -> Tensor:
    """Return each particle's share of its world's loss, times N; shape [B, N].

    To first order, the loss changes by some amount with what a particle adds to the world. Its
    share is the loss plus N times what its amount exceeds the mean by; so the mean of the shares is
    the loss, up to rounding.

    Args:
        loss: Each world's loss, shape [B].
        amounts: The change that each particle brings, shape [B, N].
    """
    worse = amounts - world_mean(amounts[..., None])
    return loss[:, None] + amounts.shape[1] * worse


def untrained_rule(generator: torch.Generator, **hyper_parameters: Any) -> NPARule:
    """Return a rule on the CPU whose weights are drawn from `generator` alone.

    Args:
        generator: On the CPU; torch's own randomness is left as it is.
        hyper_parameters: What `NPARule` takes.
    """
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(int(torch.randint(2**31, (), generator=generator)))
        return NPARule(**hyper_parameters)


def differing_fields(given: NPARule, wanted: NPARule) -> list[str]:
    """Return the names of the hyper-parameters in which a rule differs from one of a task."""
    own, other = wanted.hyper_parameters(), given.hyper_parameters()
    return [name for name in own | other if own.get(name) != other.get(name)]
