"""The shipped gecko in motion: what a step costs, and how far errors have grown after many.

Worlds are chaotic: two that differ in the last bit drift apart, and after enough steps distances
say how long they have run, not how well each was computed. The picture grown says that.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from npa_envs.measure.quality.evaluation import psnr
from npa_envs.measure.speed.perception import functional_weights
from npa_envs.measure.speed.precisions import PRECISIONS, Precision
from npa_envs.measure.speed.session import Session, relative_error
from npa_envs.measure.speed.strategies import STRATEGIES, Strategy
from npa_envs.measure.speed.timing import Cost, Timing
from npa_envs.measure.speed.workloads import Gecko, gecko
from npa_envs.rule.rule import NPARule
from npa_envs.world.rollout import rollout

MARKS = (1, 8, 64)
"""Steps after which worlds are compared."""

TIMED_STEPS = 8
"""Steps of a timed rollout."""

GROWN_STEPS = 64
"""Age of the worlds that are compared: a gecko in the making."""

TASK_STEPS = 512
"""Age at which the gecko's picture is judged."""

SLOW = ("dense", "neighbour_cap")
"""Strategies whose rollouts small sessions leave out."""

LARGEST_SLOW = 1024
"""Particles of the largest gecko that they grow to its end."""


@dataclass(frozen=True)
class RolloutRow:
    """The gecko's next steps; positions err in perception radii, states relatively."""

    strategy: str
    precision: str
    particles: int
    step_us: Timing
    """Time of a step of inference [µs]."""
    training_us: Timing | None
    """Time of a step forward and back [µs]."""
    peak_mib: float | None
    """Peak memory of a rollout of `TIMED_STEPS` steps, forward and back where it can [MiB]."""
    x_1: float
    """Largest distance of a particle from where it should be after one step, over eps."""
    s_1: float
    """Relative error of the states after one step."""
    x_8: float
    """Error of positions after 8 steps."""
    s_8: float
    """Error of states after 8 steps."""
    x_64: float
    """Error of positions after 64 steps."""
    s_64: float
    """Error of states after 64 steps."""
    weights: float | None
    """Relative error of a functional's gradient by the rule's weights over `TIMED_STEPS` steps."""
    psnr_512: float | None
    """PSNR of the picture grown from the seed in 512 steps against the target [dB]."""


class Runner:
    """Worlds of the gecko's rule, advanced by one strategy in one precision.

    Args:
        strategy: How to perceive.
        precision: How to keep and multiply numbers.
        start: Rule, task and worlds to start from.
    """

    def __init__(self, strategy: Strategy, precision: Precision, start: Gecko) -> None:
        self.strategy = strategy
        self.precision = precision
        self.rule = precision.rule(start.rule)
        self.task = start.task
        self.x = start.x.to(precision.dtype)
        self.s = precision.kept(start.s.to(precision.dtype))
        # Drawn here: a graph of the functional holds no draws of its own.
        self._x_weights = functional_weights(self.x)
        self._s_weights = functional_weights(self.s)

    def advanced(
        self, x: Tensor, s: Tensor, steps: int, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Return worlds some steps later; differentiable in the rule where the strategy is.

        Args:
            x: Positions [length units], shape [B, N, 2].
            s: States, dimensionless, shape [B, N, C].
            steps: How many steps.
            generator: Source of the update masks: the same draws for every strategy.
        """
        own = self.strategy.name == "library"
        at_once = steps if own and not self.precision.short_states else 1
        with self.precision.active():
            for _ in range(steps // at_once):
                if own:
                    x, s = self._library_steps(x, s, at_once, generator)
                else:
                    mask = drawn_mask(x, self.task.update_prob, generator)
                    x, s = composed_step(self.strategy, self.rule, x, s, mask)
                s = self.precision.kept(s)
        return x, s

    def _library_steps(
        self, x: Tensor, s: Tensor, steps: int, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        return rollout(
            self.rule, x, s, steps, update_prob=self.task.update_prob, generator=generator
        )

    @torch.no_grad()
    def marks(self, marks: tuple[int, ...]) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield the worlds after each number of steps, increasing."""
        generator = mask_source(self.x)
        x, s = self.x, self.s
        for before, mark in zip((0, *marks), marks, strict=False):
            x, s = self.advanced(x, s, mark - before, generator)
            yield x, s

    def weight_gradient(self, generator: torch.Generator) -> Tensor:
        """Return the gradient of a functional of the worlds `TIMED_STEPS` later by the weights."""
        x, s = self.advanced(self.x, self.s, TIMED_STEPS, generator)
        loss = (x * self._x_weights).sum() + (s * self._s_weights).sum()
        gradients = torch.autograd.grad(loss, list(self.rule.parameters()))
        return torch.cat([gradient.flatten() for gradient in gradients])

    def costs(self, session: Session) -> list[Cost]:
        """Return what a timed rollout costs: inference, then training where it can be trained."""
        generator = mask_source(self.x)

        @torch.no_grad()
        def infer() -> None:
            self.advanced(self.x, self.s, TIMED_STEPS, generator)

        calls: list[Callable[[], object]] = [infer]
        if self.strategy.differentiable:
            calls.append(lambda: self.weight_gradient(generator))
        graph = self.strategy.capturable
        return [session.cost(call, graph=graph, generator=generator) for call in calls]

    def psnr(self) -> float:
        """Return the PSNR of the pictures against the target `TASK_STEPS` later [dB], mean."""
        (worlds,) = self.marks((TASK_STEPS,))
        picture = self.task.picture(*(tensor.float() for tensor in worlds))
        return float(psnr(picture, self.task.target_picture).mean())


def composed_step(
    strategy: Strategy,
    rule: NPARule,
    x: Tensor,
    s: Tensor,
    mask: Tensor,
) -> tuple[Tensor, Tensor]:
    """Return worlds one step later, composed in torch: every particle perceives, some update.

    Args:
        strategy: How to perceive, at the rule's own radius.
        rule: The rule.
        x: Positions [length units], shape [B, N, D].
        s: States, dimensionless, shape [B, N, C].
        mask: Which particles are updated, uint8, shape [B, N].
    """
    active = mask[..., None].to(x.dtype)
    update = rule(strategy.perceive(x.detach(), s, rule.eps0))
    delta = update[..., : rule.space_dim]
    length = torch.linalg.vector_norm(delta, dim=-1, keepdim=True)
    x = x + active * (rule.alpha * rule.eps0) * delta / (1.0 + length)
    return x, s + active * update[..., rule.space_dim :]


def rollout_rows(session: Session, particle_count: int) -> list[RolloutRow]:
    """Return a row for each strategy and precision: the gecko's next steps, and its picture."""
    seed = gecko(1, particle_count, session.device)
    grown = seed.grown(GROWN_STEPS)
    exact = Runner(STRATEGIES["library"], PRECISIONS["float64"], grown)
    expected = list(exact.marks(MARKS)), exact.weight_gradient(mask_source(grown.x))
    rows: list[RolloutRow] = []
    for precision in session.usable_precisions():
        for strategy in session.usable_strategies(grown.x.to(precision.dtype)):
            if session.small and strategy.name in SLOW:
                session.leave_out(f"rollouts of {strategy.name}", "64 steps of it take too long")
                continue
            runner = Runner(strategy, precision, grown)
            task = _task_runner(session, strategy, precision, seed)
            rows += session.attempt(
                f"rollouts of {strategy.name} in {precision.name}, {particle_count} particles",
                partial(_row, session, runner, expected, task),
            )
    return rows


def drawn_mask(x: Tensor, update_prob: float, generator: torch.Generator) -> Tensor:
    """Return a step's update mask, drawn as `npa_envs.rollout` draws it, uint8, shape [B, N].

    Args:
        x: Positions [length units], shape [B, N, D].
        update_prob: Probability of each particle's update (dimensionless).
        generator: Source of the mask, on the device of `x`.
    """
    mask = torch.empty(x.shape[:2], dtype=torch.uint8, device=x.device)
    return mask.bernoulli_(update_prob, generator=generator)


def mask_source(like: Tensor) -> torch.Generator:
    """Return the generator of the update masks, on the device of a tensor, at its start."""
    return torch.Generator(like.device).manual_seed(3)


def _task_runner(
    session: Session, strategy: Strategy, precision: Precision, seed: Gecko
) -> Runner | None:
    """Return what grows the picture; a run of 512 steps is left out where it takes too long."""
    particle_count = seed.x.shape[1]
    slow = strategy.name in SLOW and particle_count > LARGEST_SLOW
    if slow or (strategy.name != "library" and (session.small or not session.cuda)):
        why = f"{TASK_STEPS} steps of {particle_count} particles take too long"
        session.leave_out(f"PSNR of {strategy.name}", why)
        return None
    return Runner(strategy, precision, seed)


def _row(
    session: Session,
    runner: Runner,
    expected: tuple[list[tuple[Tensor, Tensor]], Tensor],
    task: Runner | None,
) -> RolloutRow:
    costs = runner.costs(session)
    peaks = [cost.peak_mib for cost in costs if cost.peak_mib is not None]
    worlds, weight_gradient = expected
    errors = [
        (_largest_distance(x, right_x) / runner.task.eps, relative_error(s, right_s))
        for (x, s), (right_x, right_s) in zip(runner.marks(MARKS), worlds, strict=True)
    ]
    (x_1, s_1), (x_8, s_8), (x_64, s_64) = errors
    weights = None
    if runner.strategy.differentiable:
        found = runner.weight_gradient(mask_source(runner.x))
        weights = relative_error(found, weight_gradient)
    return RolloutRow(
        strategy=runner.strategy.name,
        precision=runner.precision.name,
        particles=runner.x.shape[1],
        step_us=costs[0].time.divided(TIMED_STEPS),
        training_us=costs[1].time.divided(TIMED_STEPS) if len(costs) > 1 else None,
        peak_mib=max(peaks, default=None),
        x_1=x_1,
        s_1=s_1,
        x_8=x_8,
        s_8=s_8,
        x_64=x_64,
        s_64=s_64,
        weights=weights,
        psnr_512=None if task is None else task.psnr(),
    )


def _largest_distance(x: Tensor, expected: Tensor) -> float:
    """Return the largest distance between two worlds' particles [length units]."""
    return float((x.double() - expected.double()).norm(dim=-1).max())
