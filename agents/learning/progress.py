"""Budget, learning curve and checkpoints of a run, for all methods."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from npa_envs.agents.evaluation import checked_seeds, evaluate_policy
from npa_envs.agents.learning.problem import Problem
from npa_envs.agents.learning.rule_set import RuleSet
from npa_envs.atomic_files import json_text, write_text
from npa_envs.checks import check_count, check_device, check_positive
from npa_envs.errors import DivergedError, NPAError, shown
from npa_envs.training.checkpoint import check_entries, unusable_checkpoint
from npa_envs.training.optimiser import load_moments
from npa_envs.training.process_group import ProcessGroup
from npa_envs.training.run_folder import Run, RunFolder
from npa_envs.world.randomness import Randomness, WorldRandom


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Limit of a run: seconds, particle-steps, or the one of both that is reached first."""

    seconds: float | None = None
    """Wall-clock time of learning [s]. Set-up and evaluations do not count, and may take longer:
    there are at most `curve_points` + 2 evaluations, by default 22 of 16 episodes."""
    particle_steps: int | None = None
    """Steps of all particles, in environments and rollouts, by which a method learns."""

    def __post_init__(self) -> None:
        if self.seconds is None and self.particle_steps is None:
            raise NPAError(
                "a budget must say something: Budget(seconds=60) or particle_steps=10**7"
            )
        if self.seconds is not None:
            check_positive(self, float, "seconds")
        if self.particle_steps is not None:
            check_positive(self, int, "particle_steps")


@dataclass(frozen=True)
class CurvePoint:
    """One evaluation: a point of a learning curve."""

    seconds: float
    """Learning time before the evaluation [s]."""
    particle_steps: int
    """Particle-steps before the evaluation."""
    mean_return: float
    """Mean return of the evaluation's episodes."""
    standard_error: float
    """Standard error of the mean return; infinite for a single episode."""
    final_loss: float
    """Mean loss at the episodes' ends, before the next ones start."""


class Learner(Protocol):
    """What a method must have so that its runs can be saved in checkpoints and resumed."""

    random: Randomness
    """Source of its random numbers."""

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        """Modules that it trains, by name."""

    @property
    def optimisers(self) -> Mapping[str, torch.optim.Optimizer]:
        """Optimisers of these modules, Adam or AdamW, by name."""

    def resume(self, iteration: int, resumption: int) -> None:
        """Begin new worlds after `iteration` iterations; `resumption`: number of resumes so far."""


class Progress:
    """Counts what a method spends, evaluates its rules at equal parts of the budget, saves them.

    A method makes its worlds, compiles what it needs, and calls `run`, which repeats an iteration
    until the budget is spent. A method whose loop a library runs calls the parts of `run`: `start`,
    and until the budget is `over`, `advance` and `look` after each iteration.

    Set-up before `start`, evaluations and checkpoints do not count as time. On CUDA only these
    synchronise, but `advance` keeps the CPU at most one iteration ahead of the device.

    With `out`, a checkpoint, the rules and the curve (`log.jsonl`) are written after each point of
    the curve, and when SIGTERM or Ctrl-C stops the run. A resumed run continues from the weights,
    optimisers and counts of the checkpoint, on any number of processes, with new episodes.

    Processes use the clock of rank 0 and evaluate the same episodes; rank 0 reports and writes.

    Args:
        initial: Rules to begin with, which are copied; None: new ones.
        run: Settings of the run, of JSON's types, which must be equal when it is resumed.
        others: As of `npa_envs.agents.learning.train`, whose `start` is `initial`.
    """

    def __init__(
        self,
        problem: Problem,
        budget: Budget,
        seed: int = 0,
        *,
        device: str | torch.device,
        evaluation_seeds: Iterable[int],
        curve_points: int = 20,
        on_point: Callable[[CurvePoint], None] = lambda _: None,
        initial: RuleSet | None = None,
        out: Path | None = None,
        run: Mapping[str, Any] | None = None,
        resume: bool = False,
        overwrite: bool = False,
        on_stop: Callable[[], None] = lambda: None,
    ) -> None:
        self.problem = problem
        self.budget = budget
        self.seed = seed
        self.device = check_device(device)
        self.initial = None
        """Copies of the rules to begin with, on the device; None: new ones."""
        if initial is not None:
            if not isinstance(initial, RuleSet):
                raise NPAError(
                    f"start must be a RuleSet, got {type(initial).__name__}: "
                    "RuleSet.of(problem, 'heart')"
                )
            self.initial = RuleSet.of(problem, initial).to(self.device)
        self.particle_steps = 0
        """Number of particle-steps spent so far."""
        self.log: list[CurvePoint] = []
        """Evaluations so far."""
        self.processes = ProcessGroup.current()
        self._evaluation_seeds = checked_seeds("evaluation_seeds", evaluation_seeds)
        check_count("curve_points", curve_points, ": try 20")
        self._curve_points = curve_points
        self._points_due = 0
        self._on_point, self._on_stop = on_point, on_stop
        self._envs: Any = None
        self._clock_start: float | None = None
        self._seconds = self._agreed_seconds = 0.0
        self._last_event: torch.cuda.Event | None = None
        self._resumptions = 0
        self._settings = dict(run or {})
        folder = None if out is None else RunFolder(out)
        self._run = Run(
            folder, self.processes, self._check_same_run, resume=resume, overwrite=overwrite
        )
        if folder is not None and self.processes.first:
            folder.prepare(0, pictures=False)

    def first_rules(self, *, zero_output: bool = False) -> RuleSet:
        """Return the rules that a method begins with and trains in place, on the device.

        zero_output: New rules do nothing: random ones destroy `npa/Regeneration2D-v0`'s pictures.
        """
        if self.initial is not None:
            return self.initial
        rules = RuleSet.new(self.problem, self.seed)
        for rule in rules if zero_output else ():
            nn.init.zeros_(rule.output.weight)
        return rules.to(self.device)

    def run(
        self, rules: RuleSet, iteration: Callable[[], int], learner: Learner | None = None
    ) -> RuleSet:
        """Learn until the budget is spent, and return the rules.

        Args:
            rules: The rules that `iteration` trains in place.
            iteration: One iteration of the method; it returns the particle-steps that it took.
            learner: The learner whose state checkpoints contain; needed with `out`.

        Raises:
            NPAError: A file of a run that is kept cannot be written or used, or another run writes
                there.
            DivergedError: A weight of the rules is not finite, or an action.
        """

        def begin() -> None:
            self.start(rules)
            self._save(rules, learner)

        def step() -> None:
            self.advance(iteration())
            self._run.iteration += 1
            if self.look(rules):
                self._save(rules, learner)

        def end(stopped: bool) -> None:
            if stopped:
                self._on_stop()
            # Save before the evaluation, as a stopped process may be killed soon.
            self._save(rules, learner)
            self.look(rules, force=True)
            self._save(rules, learner)

        with self._run.locked(begin=True):
            content = self._run.take_content()
            if content is not None:
                assert learner is not None, "methods whose runs are kept are learners"
                self._restore(learner, content)
            self._run.repeat(step, begin=begin, is_over=lambda: self.over, end=end)
        return rules

    def start(self, policy: RuleSet | Callable[[Any], Any]) -> None:
        """Evaluate the rules or the policy before any learning, unless resumed; start the clock."""
        if self._clock_start is not None:
            raise NPAError("progress must start once, got a second start: make one for each run")
        if not self.log:
            self._evaluate(policy)
        self._clock_start = time.perf_counter()
        self._agree_on_time()

    @property
    def spent_fraction(self) -> float:
        """Fraction of the budget that is spent, which the last iteration may take above 1."""
        seconds, particle_steps = self.budget.seconds, self.budget.particle_steps
        by_time = 0.0 if seconds is None else self._agreed_seconds / seconds
        return max(by_time, 0.0 if particle_steps is None else self.particle_steps / particle_steps)

    @property
    def over(self) -> bool:
        """Whether the budget is spent."""
        return self.spent_fraction >= 1.0

    def advance(self, particle_steps: int) -> None:
        """Count the particle-steps that an iteration took."""
        self._check_started("advance")
        self.particle_steps += particle_steps
        if self.device.type == "cuda":
            event = torch.cuda.Event()  # type: ignore[no-untyped-call]
            event.record(torch.cuda.current_stream(self.device))
            if self._last_event is not None:
                self._last_event.synchronize()
            self._last_event = event
        if self.budget.seconds is not None:
            self._agree_on_time()

    def look(self, policy: RuleSet | Callable[[Any], Any], force: bool = False) -> bool:
        """Evaluate if the curve's next point is due, or with `force`; return whether it was done.

        Nothing is done if no particle-steps were counted since the last evaluation. Raises a
        DivergedError if a weight of the rules, or an action, is not finite.
        """
        self._check_started("look")
        due = self.spent_fraction >= (self._points_due + 1) / self._curve_points
        if self.particle_steps == self.log[-1].particle_steps or not (force or due):
            return False
        with self._stopped_clock():
            self._points_due = int(self.spent_fraction * self._curve_points)
            self._evaluate(policy)
        return True

    @contextlib.contextmanager
    def _stopped_clock(self) -> Iterator[None]:
        """Stop the clock within a block, which all processes must enter."""
        self._synchronise()
        self._agree_on_time()
        self._seconds, self._clock_start = self._agreed_seconds, None
        yield
        self._clock_start = time.perf_counter()

    def _agree_on_time(self) -> None:
        assert self._clock_start is not None, "the clock runs"
        seconds = self._seconds + (time.perf_counter() - self._clock_start)
        self._agreed_seconds = self.processes.broadcast(seconds)

    def _check_started(self, caller: str) -> None:
        if self._clock_start is None:
            raise NPAError(f"{caller} needs a start: call progress.start(rules) after the set-up")

    def _evaluate(self, policy: RuleSet | Callable[[Any], Any]) -> None:
        if self._envs is None:
            count = min(len(self._evaluation_seeds), self.problem.num_envs)
            self._envs = self.problem.make_envs(count, device=self.device)
        if isinstance(policy, RuleSet):
            check_finite(policy, self.particle_steps)
            self.processes.check_same(list(policy.parameters()))
            policy = policy.policy()
        episodes = evaluate_policy(self._envs, policy, self._evaluation_seeds)
        point = CurvePoint(
            seconds=self._seconds,
            particle_steps=self.particle_steps,
            mean_return=episodes.mean_return,
            standard_error=episodes.standard_error,
            final_loss=float(episodes.final_losses.mean()),
        )
        self._synchronise()
        self.log.append(point)
        if self.processes.first:
            self._on_point(point)

    def _synchronise(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)

    def _save(self, rules: RuleSet, learner: Learner | None) -> None:
        """Write checkpoint, rules and curve, after a check that processes have equal weights."""
        folder = self._run.folder
        if folder is None:
            return
        assert learner is not None, "methods whose runs are kept are learners"
        with self._stopped_clock():
            state = learner_state(learner)
            values = [value for module in state["modules"].values() for value in module.values()]
            self.processes.check_same([value for value in values if isinstance(value, Tensor)])
            if not self.processes.first:
                return
            curve = [asdict(point) for point in self.log]
            state |= {"learner": self._settings, "curve": curve, "iteration": self._run.iteration}
            state |= {"resumptions": self._resumptions, "seconds": self._agreed_seconds}
            self._run.write_checkpoint(state | {"particle_steps": self.particle_steps})
            rules.save(folder.path)
            lines = [" ".join(json_text(line).split()) for line in curve]
            write_text(folder.log, "\n".join(lines) + "\n")

    def _check_same_run(self, content: dict[str, Any], path: Path) -> None:
        stored = content.get("learner")
        stored = stored if isinstance(stored, dict) else {}
        names = [name for name, value in self._settings.items() if stored.get(name) != value]
        if names:
            raise NPAError(
                f"the checkpoint {str(path)!r} must be of the same run, but "
                f"differs in {', '.join(names)}: learn what it is of, or choose another folder"
            )

    def _restore(self, learner: Learner, content: dict[str, Any]) -> None:
        assert self._run.folder is not None, "it contains the checkpoint"
        path = self._run.folder.checkpoint
        counts = {"iteration": int, "resumptions": int, "particle_steps": int, "seconds": float}
        check_entries(content, counts, path)
        try:
            self.log = [CurvePoint(**point) for point in content["curve"]]
            for name, module in learner.modules.items():
                module.load_state_dict(content["modules"][name])
            for name, optimiser in learner.optimisers.items():
                load_moments(optimiser, content["optimisers"][name])
            random, drawn = learner.random, content["random"]
            # Random sources of one process and of several differ in kind: this one then starts from
            # its seed.
            if drawn.shape == learner_state(learner)["random"].shape:
                if isinstance(random, WorldRandom):
                    random.episodes.fill_(int(drawn))
                else:
                    random.set_state(drawn)
        except (KeyError, TypeError, AttributeError, ValueError, RuntimeError) as error:
            raise unusable_checkpoint(path, f"it cannot be used ({shown(error)})") from error
        if not self.log:
            raise unusable_checkpoint(path, "curve must hold its points")
        self._run.iteration, self._resumptions = content["iteration"], content["resumptions"] + 1
        self.particle_steps = content["particle_steps"]
        self._seconds = self._agreed_seconds = content["seconds"]
        self._points_due = int(self.spent_fraction * self._curve_points)
        learner.resume(self._run.iteration, self._resumptions)


def annealed(rate: float, last_rate: float, fraction: float) -> float:
    """Return a rate along half a cosine: `rate` at fraction 0, `rate * last_rate` from 1 on."""
    wave = 0.5 * (1.0 + math.cos(math.pi * min(fraction, 1.0)))
    return rate * (last_rate + (1.0 - last_rate) * wave)


def check_finite(rules: RuleSet, particle_steps: int) -> None:
    """Raise a DivergedError if a weight of the rules is not finite; waits for the device."""
    for number, rule in enumerate(rules):
        for name, weight in rule.named_parameters():
            bad = int((~torch.isfinite(weight)).sum())
            if bad:
                raise DivergedError(
                    f"weights must stay finite, but {bad} of {weight.numel()} in {shown(name)} of "
                    f"rule {number} were not after {particle_steps} particle-steps: learn more "
                    "slowly"
                )


def learner_state(learner: Learner) -> dict[str, Any]:
    """Return a learner's modules, optimisers and random source as checkpoints contain them."""
    random = learner.random
    # The counter of random numbers is the same in all worlds.
    drawn = random.episodes[:1] if isinstance(random, WorldRandom) else random.get_state()
    optimisers = learner.optimisers.items()
    return {
        "modules": {name: module.state_dict() for name, module in learner.modules.items()},
        "optimisers": {name: optimiser.state_dict()["state"] for name, optimiser in optimisers},
        "random": drawn.cpu(),
    }
