"""What the trainer asks of a task: a seed, a loss, a picture. Any object with these will do."""

from __future__ import annotations

from typing import Protocol, TypeVar, cast, runtime_checkable

import torch
from torch import Tensor

from npa_envs.ops import Cameras
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
    """A task that compares what a rule reads out of the states, instead of the states themselves.

    It has all that `Task` has besides.
    """

    def for_rule(self, rule: NPARule) -> Task:
        """Return the task with losses, metric and pictures that read states through `rule`.

        Its parameters are read anew at each call, so that losses are differentiable in them and
        change with them. The task itself stays as it is.

        Args:
            rule: The rule, where the worlds are.
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


TaskT = TypeVar("TaskT", bound=Task)


def task_for_rule(task: TaskT, rule: NPARule) -> TaskT:
    """Return a task as it is for the worlds of one rule; most are the same for all rules.

    Args:
        task: Any task.
        rule: The rule that runs the worlds, where they are.
    """
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


def seed_worlds(
    task: Task, world_count: int, *, generator: Randomness, device: torch.device
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Return fresh worlds of any task: positions, states, and goals where it has such.

    Args:
        task: The task.
        world_count: Worlds B.
        generator: Randomness, on the device.
        device: Where the worlds are made.
    """
    if isinstance(task, GoalTask):
        return task.seed_with_goals(world_count, generator=generator, device=device)
    return *task.seed(world_count, generator=generator, device=device), None


@runtime_checkable
class ScheduledTask(Protocol):
    """A task whose loss changes from iteration to iteration: by a curriculum, or by draws.

    It has all that `Task` has besides.
    """

    def begin(self, iteration: int) -> None:
        """Prepare the loss of an iteration, without waiting for the device.

        Recorded graphs read what is written here: always into the same tensors. What is written
        must follow from the iteration alone, so that a resumed run goes on as it would have.

        Args:
            iteration: Iterations done so far in the run.
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


# Rules of tasks: untrained ones, and whether others have their shape.


def untrained_rule(
    generator: torch.Generator,
    *,
    state_dim: int,
    hidden_dim: int,
    eps0: float,
    alpha: float,
    space_dim: int = 2,
    static: bool = False,
    readout_dim: int = 0,
    readout_hidden_dim: int = 0,
) -> NPARule:
    """Return a rule on the CPU whose weights are drawn from `generator` alone.

    Args:
        generator: On the CPU; torch's own randomness is left as it is.
        state_dim: State channels C.
        hidden_dim: Width of the hidden layer.
        eps0: Perception radius that the rule is trained at [length units].
        alpha: Largest displacement in one step, as a fraction of ε (dimensionless).
        space_dim: Space dimension D.
        static: Particles never move.
        readout_dim: Outputs of the read-out network; 0 for none.
        readout_hidden_dim: Width of its hidden layer.
    """
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(int(torch.randint(2**31, (), generator=generator)))
        return NPARule(
            space_dim,
            state_dim,
            hidden_dim,
            eps0=eps0,
            alpha=alpha,
            static=static,
            readout_dim=readout_dim,
            readout_hidden_dim=readout_hidden_dim,
        )


def differing_fields(given: NPARule, wanted: NPARule) -> list[str]:
    """Return the names of the hyper-parameters in which a rule differs from one of a task.

    Args:
        given: The rule.
        wanted: A rule that the task has made.
    """
    own = wanted.hyper_parameters()
    return [name for name, value in given.hyper_parameters().items() if value != own.get(name)]
