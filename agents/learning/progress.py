"""The account of a learner: its budget, what it has spent, and its learning curve."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import nn

from npa_envs.agents.evaluation import evaluate_policy
from npa_envs.agents.learning.problem import Problem
from npa_envs.agents.learning.rules import RuleSet
from npa_envs.checks import is_real, is_whole
from npa_envs.devices import check_device
from npa_envs.errors import DivergedError, NPAError, shown
from npa_envs.training.ranks import Ranks
from npa_envs.world.randomness import Randomness, WorldRandom


@dataclass(frozen=True, kw_only=True)
class Budget:
    """What a learner may spend: time, or particle-steps, or whichever is spent first.

    Raises:
        NPAError: Neither is given, or one is not positive.
    """

    seconds: float | None = None
    """Wall-clock time of learning [s]. Set-up and evaluations come on top, and may take longer:
    there are at most `entries` + 2 evaluations, of an episode for each of `evaluation_seeds`. By
    default these are 22 of 16 episodes; `entries=1` makes at most 3."""

    particle_steps: int | None = None
    """Steps of an environment or a rollout, times the particles that took them."""

    def __post_init__(self) -> None:
        """Check both; raises NPAError."""
        if self.seconds is None and self.particle_steps is None:
            raise NPAError(
                "a budget must say something: Budget(seconds=60) or particle_steps=10**7"
            )
        if self.seconds is not None and not (is_real(self.seconds) and self.seconds > 0.0):
            raise NPAError(
                f"seconds must be positive and finite, got {shown(self.seconds)}: try 60"
            )
        steps = self.particle_steps
        if steps is not None and not (is_whole(steps) and steps > 0):
            raise NPAError(
                f"particle_steps must be a positive integer, got {shown(steps)}: try 10**7"
            )

    def share(self, seconds: float, particle_steps: int) -> float:
        """Return the share of the budget that time [s] and particle-steps are; 1: it is spent."""
        by_time = 0.0 if self.seconds is None else seconds / self.seconds
        by_steps = 0.0
        if self.particle_steps is not None:
            by_steps = particle_steps / self.particle_steps
        return max(by_time, by_steps)


@dataclass(frozen=True, kw_only=True)
class CurvePoint:
    """One evaluation: a point of a learning curve."""

    seconds: float
    """Time spent by then [s]."""

    particle_steps: int
    """Particle-steps spent by then."""

    mean_return: float
    """Mean return of the evaluation's episodes."""

    standard_error: float
    """Its standard error; infinite for a single episode."""

    final_loss: float
    """Mean loss at the episodes' ends, before the next ones start."""


class Learner(Protocol):
    """A learner whose run can be stopped and go on: what is to be kept of it."""

    random: Randomness
    """What it draws from."""

    def modules(self) -> Mapping[str, nn.Module]:
        """Return what learns, by name."""

    def optimisers(self) -> Mapping[str, torch.optim.Optimizer]:
        """Return what makes it learn, by name: of Adam's kind."""

    def go_on(self, iteration: int, part: int) -> None:
        """Go on after so many iterations, for the part-th time, from 1 on, with other worlds."""


class Progress:
    """Keeps a learner's account, and evaluates what it has learned every now and then.

    A learner makes its worlds, compiles what it needs, and then leaves the loop to `run`, which is

    ```python
    progress.start(rules)
    while not progress.over:
        progress.advance(iteration())  # learns, and returns the particle-steps that it took
        progress.look(rules)
    progress.look(rules, force=True)
    ```

    Neither what happens before `start` nor evaluations count, nor what is written meanwhile. On
    CUDA the host waits for the device only there; besides, `advance` keeps it at most one iteration
    ahead, so that time is what the device took.

    Where torch has a default group of processes, each has an account, and all go by the clock of
    the first one. Each evaluates the same episodes, and the first one tells of them.

    Args:
        problem: What is learned.
        budget: What may be spent.
        device: Where evaluations run: the learner's device.
        evaluation_seeds: Of the episodes, which no learner sees: one each.
        entries: Evaluations besides the first, at equal shares of the budget.
        on_entry: Called with each entry.

    Raises:
        NPAError: There are no seeds or wrong ones, or the number of entries is not positive.
    """

    def __init__(
        self,
        problem: Problem,
        budget: Budget,
        *,
        device: str | torch.device,
        evaluation_seeds: Iterable[int],
        entries: int = 20,
        on_entry: Callable[[CurvePoint], None] | None = None,
    ) -> None:
        self.problem = problem
        """What is learned."""
        self.budget = budget
        """What may be spent."""
        self.particle_steps = 0
        """Particle-steps spent so far."""
        self.log: list[CurvePoint] = []
        """Evaluations so far."""
        self.ranks = Ranks.current()
        """The processes that share the run."""
        given: Any = evaluation_seeds
        if not isinstance(given, Iterable):
            raise NPAError(
                f"evaluation_seeds must be one for each episode, got {shown(given)}: "
                "range(1_000_000, 1_000_016)"
            )
        self._seeds = list(evaluation_seeds)
        if not self._seeds:
            raise NPAError(
                "evaluation_seeds must hold at least one seed, got none: range(100, 132)"
            )
        # Now, not in the first evaluation.
        WorldRandom(self._seeds)
        if not is_whole(entries) or entries < 1:
            raise NPAError(
                f"entries must be a whole number of at least 1, got {shown(entries)}: try 20"
            )
        self._entries = entries
        self._on_entry = on_entry
        self._device = check_device(device)
        self._envs: Any = None
        self._started = False
        self._since: float | None = None
        self._seconds = 0.0
        self._elapsed = 0.0
        self._looks = 0
        self._previous: torch.cuda.Event | None = None

    def run(
        self, rules: RuleSet, iteration: Callable[[], int], learner: Learner | None = None
    ) -> RuleSet:
        """Learn until the budget is spent, and return the rules.

        Args:
            rules: What is learned.
            iteration: Lets the rules learn a little, and returns the particle-steps that it took.
            learner: What checkpoints are made of, where the run is kept.

        Raises:
            NPAError: It has started before.
            DivergedError: A weight of the rules is not finite, or an action.
        """
        self.start(rules)
        while not self.over:
            self.advance(iteration())
            self.look(rules)
        self.look(rules, force=True)
        return rules

    def start(self, actor: RuleSet | Callable[[Any], Any]) -> None:
        """Evaluate the rules or the policy that the learner begins with, and begin to count.

        Of a run that goes on, this is known.

        Raises:
            NPAError: It has started before.
        """
        if self._started:
            raise NPAError("progress must start once, got a second start: make one for each run")
        self._started = True
        if not self.log:
            self._evaluate(actor)
        self._since = time.perf_counter()
        self._agree_on_time()

    @property
    def seconds(self) -> float:
        """Time spent so far, as the host sees it [s]."""
        return self._seconds + (0.0 if self._since is None else time.perf_counter() - self._since)

    @property
    def share(self) -> float:
        """Share of the budget that is spent; above 1 by the last iteration's excess."""
        seconds = self._elapsed if self.ranks.together else self.seconds
        return self.budget.share(seconds, self.particle_steps)

    @property
    def over(self) -> bool:
        """Whether the budget is spent."""
        return self.share >= 1.0

    def advance(self, particle_steps: int) -> None:
        """Take down the particle-steps that an iteration took.

        Raises:
            NPAError: Nothing has started yet.
        """
        self._check_started("advance")
        self.particle_steps += particle_steps
        if self._device.type == "cuda":
            event = torch.cuda.Event()  # type: ignore[no-untyped-call]
            event.record(torch.cuda.current_stream(self._device))
            if self._previous is not None:
                self._previous.synchronize()
            self._previous = event
        if self.budget.seconds is not None:
            self._agree_on_time()

    def look(self, actor: RuleSet | Callable[[Any], Any], force: bool = False) -> None:
        """Evaluate where the next share of the budget is spent.

        Args:
            actor: The rules, or a policy.
            force: Evaluate in any case, but where nothing was done since the last evaluation.

        Raises:
            NPAError: Nothing has started yet.
            DivergedError: A weight of the rules is not finite, or an action.
        """
        self._check_started("look")
        fresh = self.particle_steps > self.log[-1].particle_steps
        due = self.share >= (self._looks + 1) / self._entries
        if not fresh or not (force or due):
            return
        with self._stopped_clock():
            self._looks = int(self.share * self._entries)
            self._evaluate(actor)

    @contextlib.contextmanager
    def _stopped_clock(self) -> Iterator[None]:
        """Count no time while a block runs; all processes enter it."""
        self._wait()
        self._agree_on_time()
        self._seconds, self._since = self._elapsed, None
        yield
        self._since = time.perf_counter()

    def _agree_on_time(self) -> None:
        """Take down the time as the first process has it."""
        self._elapsed = self.ranks.broadcast(self.seconds)

    def _check_started(self, caller: str) -> None:
        if not self._started:
            raise NPAError(f"{caller} needs a start: call progress.start(rules) after the set-up")

    def _evaluate(self, actor: RuleSet | Callable[[Any], Any]) -> None:
        if self._envs is None:
            count = min(len(self._seeds), self.problem.num_envs)
            self._envs = self.problem.make_envs(count, device=self._device)
        policy = actor
        if isinstance(actor, RuleSet):
            policy = actor.policy()
            check_finite(actor, self.particle_steps)
            self.ranks.check_same(list(actor.parameters()))
        episodes = evaluate_policy(self._envs, policy, self._seeds)
        entry = CurvePoint(
            seconds=self._seconds,
            particle_steps=self.particle_steps,
            mean_return=episodes.mean_return,
            standard_error=episodes.standard_error,
            final_loss=float(episodes.final_losses.mean()),
        )
        self._wait()
        self.log.append(entry)
        if self._on_entry is not None and self.ranks.first:
            self._on_entry(entry)

    def _wait(self) -> None:
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)


def annealed(rate: float, last_rate: float, share: float) -> float:
    """Return a rate that falls along half a cosine, to `last_rate` of itself at share 1."""
    wave = 0.5 * (1.0 + math.cos(math.pi * min(share, 1.0)))
    return rate * (last_rate + (1.0 - last_rate) * wave)


def check_finite(rules: RuleSet, particle_steps: int) -> None:
    """Check that rules have not diverged; waits for the device.

    Raises:
        DivergedError: A weight is infinite or NaN.
    """
    for number, rule in enumerate(rules):
        for name, weight in rule.named_parameters():
            bad = int((~torch.isfinite(weight)).sum())
            if bad:
                raise DivergedError(
                    f"weights must stay finite, but {bad} of {weight.numel()} in {shown(name)} of "
                    "rule "
                    f"{number} were not after {particle_steps} particle-steps: learn more slowly"
                )
