"""An environment's own task as the gradient's trainer wants it: seeds, rollouts, a loss."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, Self

import torch
from torch import Tensor

import npa_envs
from npa_envs.agents.learning.held import HeldRule
from npa_envs.agents.learning.problem import Problem
from npa_envs.agents.learning.rules import RuleSet
from npa_envs.envs.core.task import EnvTask
from npa_envs.envs.multi.config import SpeciesConfig
from npa_envs.envs.multi.task import Population, SpeciesTask
from npa_envs.errors import NPAError
from npa_envs.world.randomness import WorldRandom
from npa_envs.world.rollout import Memory

KEY_RANGE = -(2**63), 2**63 - 1
"""Keys of worlds' streams are drawn from here."""


class EpisodeTask:
    """Worlds as a problem's episodes start, and their loss; worlds move by the problem's physics.

    It is a `npa_envs.tasks.base.Task` as far as the training cycle asks for one.

    Args:
        problem: The environment.
        device: Where the worlds live.

    Raises:
        NPAError: No gradient leads from the environment's loss to its particles.
    """

    def __init__(self, problem: Problem, device: torch.device) -> None:
        self.problem = problem
        self.physics = problem.physics
        """The worlds' constants."""
        self._task = problem.make_task(device)
        counts = torch.tensor(problem.counts)
        self._species = torch.arange(len(counts)).repeat_interleave(counts).to(device)
        _check_rules_of_play(problem, self._task)

    @property
    def eps(self) -> float:
        """Perception radius ε [length units]."""
        return self.physics.eps

    @property
    def box(self) -> tuple[float, ...] | None:
        """Sides of the periodic box [length units], or None in open space."""
        return self.physics.box

    @property
    def update_prob(self) -> float:
        """Probability of a particle's update in a step, dimensionless."""
        return self.physics.update_prob

    @property
    def can_be_recorded(self) -> bool:
        """Whether starts take few operations, so that they are recorded on CUDA."""
        return isinstance(self._task, SpeciesTask) or self._task.start_is_short

    def seed(
        self, world_count: int, *, generator: torch.Generator, device: torch.device
    ) -> tuple[Tensor, Tensor]:
        """Return worlds at the beginning of their episodes.

        Args:
            world_count: Worlds B.
            generator: Randomness, on the device.
            device: Where the worlds are made.

        Returns:
            Positions [length units], shape [B, N, D]; states, dimensionless, shape [B, N, C].
        """
        x, s, *_ = self._start(world_count, generator, device)
        return x, s

    def loss(self, x: Tensor, s: Tensor, path_length: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the environment's loss, the mean over worlds and species, and its named parts.

        Args:
            x: Positions [length units], shape [B, N, D].
            s: States, dimensionless, shape [B, N, C].
            path_length: How far each particle travelled: nothing is paid for that.

        Raises:
            NPAError: No gradient leads from it to what requires one.
        """
        parts = {name: part.mean() for name, part in self._losses(x, s).items()}
        total = torch.stack(list(parts.values())).sum()
        if torch.is_grad_enabled() and (x.requires_grad or s.requires_grad):
            self._check_gradient(total)
        return total, parts

    def rollout(
        self,
        rules: Any,
        x: Tensor,
        s: Tensor,
        steps: int,
        /,
        *,
        eps: float,
        box: tuple[float, ...] | None,
        update_prob: float,
        memory: Memory,
        generator: torch.Generator,
        return_path_length: Literal[True],
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Run a set of rules as the environment would, differentiably; as `npa_envs.rollout`."""
        assert isinstance(rules, RuleSet), "the learner trains sets of rules"
        physics, config = self.physics, self.problem.config
        held = [HeldRule(rule, physics.state_scale) for rule in rules]
        common: dict[str, Any] = {
            "eps": eps,
            "box": box,
            "update_prob": update_prob,
            "dt": physics.dt,
            "position_noise": physics.position_noise,
            "memory": memory,
            "generator": generator,
            "return_path_length": return_path_length,
        }
        if not isinstance(config, SpeciesConfig):
            return npa_envs.rollout(held[0], x, s, steps, **common)
        common |= {"counts": config.counts, "perception": config.perception}
        return npa_envs.rollout_species(held, x, s, steps, **common)

    def _start(
        self, world_count: int, generator: torch.Generator, device: torch.device
    ) -> tuple[Any, ...]:
        keys = torch.randint(*KEY_RANGE, (world_count,), generator=generator, device=device)
        start: tuple[Any, ...] = self._task.start(WorldRandom.from_keys(keys))
        return start

    def _losses(self, x: Tensor, s: Tensor) -> Mapping[str, Tensor]:
        """Return the parts of each world's loss, shape [B] or [B, K]."""
        if isinstance(self._task, SpeciesTask):
            return self._task.losses(Population(x, s, self.problem.counts, self._species))
        return self._task.losses(x, s)

    def _check_gradient(self, total: Tensor) -> None:
        if not total.requires_grad:
            raise NPAError(
                f"the losses of {type(self._task).__name__} must be differentiable for "
                "method='gradient', but no gradient leads from them to positions or states: "
                "compute them by torch's operations, or learn by 'ppo' or 'evolution'"
            )


class GoalEpisodeTask(EpisodeTask):
    """The same for a task whose worlds have goals of their own, such as the class of a cloud."""

    def seed_with_goals(
        self, world_count: int, *, generator: torch.Generator, device: torch.device
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return worlds at the beginning of their episodes, and their goals, int64, shape [B].

        Args:
            world_count: Worlds B.
            generator: Randomness, on the device.
            device: Where the worlds are made.
        """
        x, s, _, goal = self._start(world_count, generator, device)
        return x, s, goal

    def damage_with_goals(
        self, x: Tensor, s: Tensor, goal: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return worlds as they are: episodes are damaged where they start, or not at all."""
        return x, s, goal

    def toward(self, goal: Tensor) -> Self:
        """Return the task with the loss of worlds that have these goals, shape [B]."""
        aimed = type(self).__new__(type(self))
        vars(aimed).update(vars(self))
        assert isinstance(self._task, EnvTask), "species have no goals"
        aimed._task = self._task.toward(goal)
        return aimed


def episode_task(problem: Problem, device: torch.device) -> EpisodeTask:
    """Return a problem's task for the gradient's trainer.

    Args:
        problem: The environment.
        device: Where the worlds live.

    Raises:
        NPAError: The problem is a game or its species die, so that no gradient descends its loss.
    """
    made = EpisodeTask(problem, device)
    generator = torch.Generator(device).manual_seed(0)
    has_goals = not problem.is_species and made._start(1, generator, device)[3] is not None
    return GoalEpisodeTask(problem, device) if has_goals else made


def _check_rules_of_play(problem: Problem, task: EnvTask[Any] | SpeciesTask) -> None:
    """Check that all rules want the same, and that nobody leaves a world."""
    if not isinstance(task, SpeciesTask):
        return
    if type(task).settle is not SpeciesTask.settle:
        raise NPAError(
            f"method='gradient' must have one loss to descend, but in {problem.env_id} species are "
            "paid at each other's expense: learn by 'ppo' with what each particle is paid"
        )
    if problem.keywords.get("deaths"):
        raise NPAError(
            f"method='gradient' must keep all particles, got deaths={problem.keywords['deaths']!r}:"
            " leave deaths out, or learn by 'ppo' or 'evolution'"
        )
