"""Configurations of training runs: `TrainConfig`, of several rules in one world, of small runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Generic, Literal, TypeVar, get_args

import torch

from npa_envs.checks import (
    MomentInverse,
    are_texts,
    check_field,
    check_flag,
    check_non_negative,
    check_positive,
    check_seed,
    check_word,
    is_real,
    is_whole,
    parse_device,
)
from npa_envs.errors import NPAError, shown
from npa_envs.world.rollout import Memory

TaskConfigT = TypeVar("TaskConfigT")
FieldT = TypeVar("FieldT")

COMMON = "shown by --help"
Common = Annotated[FieldT, COMMON]
"""Type of a field that `npa-envs train TASK --help` shows; `--help-all` shows all fields
that are not `Unlisted`."""

UNLISTED = "shown by no help"
Unlisted = Annotated[FieldT, UNLISTED]
"""Type of a field whose option `npa-envs train` takes but does not show; pages name it."""

Schedule = Literal["milestones", "cosine"]
"""Learning-rate schedules."""

OptimiserName = Literal["adamw", "muon"]
"""Names of optimisers."""

RISE = 0.01
"""Fraction of a repeat in which the schedule "cosine" raises the learning rate from 0."""

LOWEST = 0.01
"""Final learning rate of the schedule "cosine", as a fraction of the largest."""

DECAY = 0.3
"""Factor on the learning rate at each milestone."""

MAX_POWER = 8.0
"""Largest `stillness_power`: float32 would round higher powers of small changes to 0."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig(Generic[TaskConfigT]):
    """A training run: the schedule, the pool, the optimiser, the machine, what is written.

    The pool stores worlds between batches. In each iteration a batch of them is rolled out further,
    the rule learns from the loss at the end, and the worlds go back into the pool. The defaults are
    the paper's for 2D morphogenesis (arXiv 2601.16096). `npa_envs.training.override` and
    configuration files take names of these fields and of those of `task`.
    """

    task: TaskConfigT
    """The task's own configuration."""

    initial_rule: Common[str] = ""
    """Rule to start from: a name, a file or a run's folder; '': random weights. The preset `best`
    of morphogenesis2d starts from a heart (`heart-first`), that of morphogenesis3d from
    `rocket-8192`."""

    vary_eps: tuple[float, float] = (1.0, 1.0)
    """Range of random factors on ε, log-uniform, one for each initial world in open space. Instead
    of ε, the start positions are divided by the factor, which is equivalent."""

    moment_inverse: MomentInverse = "threshold"
    """How the rule's state gradients are corrected: "threshold", the paper's, or "smooth"."""

    dead_zone: float = 0.0
    """Entries y of an update with |y| <= `dead_zone` are set to 0 (dimensionless), so that worlds
    that hardly change come to rest. It replaces that of `initial_rule`, even if it is 0; rules that
    are given for several species keep theirs. Ignored for equivariant rules, which have none."""

    iterations: Common[int] = 10_000
    """Optimiser steps in one repeat."""

    repeats: Common[int] = 3
    """How often the schedule of `iterations` runs: rule and pool continue, the optimiser is
    reset."""

    world_count: Common[int] = 8
    """Number of worlds in a batch, B."""

    pool_size: Common[int] = 512
    """Number of worlds that are stored between batches."""

    steps: Common[tuple[int, int]] = (32, 96)
    """Range [lo, hi) that the number of steps of a rollout is drawn from, uniformly."""

    optimiser: OptimiserName = "adamw"
    """"adamw" as in the paper, or "muon": orthogonal steps of the layers' matrices (Jordan et al.
    2024), and AdamW for all else, such as biases."""

    learning_rate: Common[float] = 5e-4
    """The optimiser's learning rate at the start of each repeat."""

    schedule: Schedule = "milestones"
    """How the learning rate falls in a repeat: at `milestones`, or by "cosine", along half a cosine
    to a hundredth, whatever the length of the repeat."""

    milestones: tuple[int, ...] = (2_000, 4_000, 6_000, 8_000)
    """Iterations of a repeat after which the learning rate falls to 0.3 of itself."""

    weight_decay: float = 0.0
    """The optimiser's weight decay."""

    seed_interval: int = 16
    """One batch in this many contains initial worlds; 1: every batch."""

    fresh_share: float = 0.0
    """Fraction of initial worlds in such a batch (`seed_interval`); at least one world. No effect
    with `max_age_range`."""

    max_age_range: tuple[int, int] = (0, 0)
    """Range of the lifetimes [steps] after which a world of the pool is replaced by an initial one,
    or damaged and kept (`damage_and_keep_share`): shortest at the pool's first index, longest at
    its last, geometrically spaced between. A batch has one world from each of B equal sections of
    the pool, so it has young and old worlds. (0, 0): `seed_interval` instead."""

    damage_and_keep_share: float = 0.0
    """Fraction in [0, 1) of the worlds at the end of their lifetime that are damaged and kept for
    another lifetime instead of being replaced (dimensionless), so that a rule learns the long-term
    effects of damage. Needs `max_age_range`."""

    stillness_weight: float = 0.0
    """Weight of the change of grown worlds in a rollout: their particles' mean path length in
    perception radii, plus the mean |Δs| from its start to its end (dimensionless). Births and
    deaths do not count. Grown are worlds of at least `stillness_min_age` outside of `damage_share`.
    It stops the slow flow by which worlds lose their shape. Needs `max_age_range`."""

    stillness_power: float = 1.0
    """Power of the means over particles and states in `stillness_weight`:
    (mean |a|^power)^(1/power), at least 1 and at most 8. A larger power gives more weight to the
    particles that move most."""

    stillness_min_age: int = 512
    """Age [steps], also since the damage before another lifetime, from which a world is grown."""

    wound_chance: Unlisted[float] = 0.0
    """Probability that a world of at least `wound_min_age` is damaged when a batch has it, and
    keeps its age (dimensionless); every second world of the pool is left out. Needs
    `max_age_range`."""

    wound_min_age: Unlisted[int] = 256
    """Age [steps] from which `wound_chance` damages a world."""

    wound_weight: Unlisted[float] = 0.0
    """Weight of each world's mean loss over the pixels that its last damage changed, relative to
    the whole picture's loss (dimensionless). The pool stores these pixels until the world is
    replaced. For upright pictures, without effect elsewhere; needs `max_age_range`."""

    damage_share: float = 1.0
    """Fraction in [0, 1] of the pool whose worlds are damaged in every batch, so that a rule learns
    to heal: the first indices, which with `max_age_range` have the shortest lifetimes. All others
    are damaged by `damage_and_keep_share` only."""

    seed: Common[int] = 0
    """Seed of every random number of the run, in [0, 2**63)."""

    device: Common[str] = "cpu"
    """Device to train on: "cpu", "cuda", "cuda:1", ..."""

    dtype: Literal["float32", "float64"] = "float32"
    """Precision of the worlds and of the rule."""

    memory: Memory = "store"
    """Intermediate values for the backward pass: "store" keeps those of all steps, "recompute"
    computes two steps in three again, "minimal" all but the last."""

    cuda_graph: bool = True
    """On CUDA, replay rollout and gradients as one CUDA graph for each number of steps."""

    out: Common[Path] = Path("runs/morphogenesis2d")
    """Folder that log, pictures, checkpoint and rule are written to; created where missing."""

    log_interval: int = 10
    """Iterations between two lines of the log."""

    picture_interval: int = 250
    """Iterations between two pictures of the batch; 0: none."""

    checkpoint_interval: int = 1000
    """Iterations between two checkpoints."""

    tensorboard: bool = True
    """Write TensorBoard events as well as the JSONL log."""

    def __post_init__(self) -> None:
        check_positive(self, int, "iterations", "repeats", "world_count", "pool_size")
        check_positive(self, int, "seed_interval", "log_interval", "checkpoint_interval")
        check_positive(self, int, "stillness_min_age", "wound_min_age")
        check_positive(self, int, "picture_interval", at_least=0)
        check_positive(self, float, "learning_rate", "stillness_power")
        check_non_negative(self, "weight_decay", "stillness_weight", "dead_zone")
        check_non_negative(self, "damage_and_keep_share", "wound_weight")
        check_non_negative(self, "fresh_share", "damage_share", "wound_chance", at_most=1.0)
        check_seed(self, "seed")
        check_flag(self, "cuda_graph", "tensorboard")
        parse_device(self.device)
        choices = {"optimiser": OptimiserName, "schedule": Schedule, "memory": Memory}
        choices |= {"moment_inverse": MomentInverse, "dtype": Literal["float32", "float64"]}
        for name, literal in choices.items():
            check_word(self, name, get_args(literal))
        self._check_schedule_and_pool()
        factors, check = self.vary_eps, partial(check_field, self)
        fits = _is_pair(factors, is_real) and 0.0 < factors[0] <= factors[1]
        hint = "for example vary_eps=(0.5, 2.0)"
        check("vary_eps", fits, "be two factors (lo, hi) with 0 < lo <= hi", hint)
        is_path = isinstance(self.out, Path)
        check("out", is_path, "be a pathlib.Path", f"Path({shown(self.out)})")
        aged = ("stillness_weight", "damage_and_keep_share", "wound_chance", "wound_weight")
        for name in aged:
            if getattr(self, name) > 0 and not self.ages:
                raise NPAError(
                    f"{name} needs max_age_range, got {getattr(self, name)} without: "
                    "set max_age_range, for example to (256, 32768)"
                )

    def _check_schedule_and_pool(self) -> None:
        check, milestones, ages = partial(check_field, self), self.milestones, self.max_age_range
        fits = 1.0 <= self.stillness_power <= MAX_POWER
        rule = f"be at least 1 and at most {MAX_POWER:g}"
        check("stillness_power", fits, rule, "1 for arithmetic means")
        fits = self.damage_and_keep_share < 1.0
        check("damage_and_keep_share", fits, "be below 1", "1 leaves no initial worlds")
        rule = "be the name of a rule or of a file, or '' for none"
        check("initial_rule", isinstance(self.initial_rule, str), rule)
        fits = _is_pair(self.steps, is_whole) and 1 <= self.steps[0] < self.steps[1]
        rule = "be two whole numbers (lo, hi) with 1 <= lo < hi"
        check("steps", fits, rule, "hi is exclusive, so exactly 32 steps are steps=(32, 33)")
        fits = isinstance(milestones, tuple) and all(map(is_whole, milestones))
        fits = fits and list(milestones) == sorted({m for m in milestones if m >= 1})
        rule = "be positive and increasing whole numbers in a tuple"
        check("milestones", fits, rule, "for example milestones=(2000, 4000)")
        fits, hint = self.world_count <= self.pool_size, f"set pool_size={self.world_count} or more"
        rule = f"be at most pool_size={self.pool_size} (batches are drawn without replacement)"
        check("world_count", fits, rule, hint)
        fits = _is_pair(ages, is_whole) and (1 <= ages[0] <= ages[1] or ages == (0, 0))
        rule = "be two whole numbers (lo, hi) with 1 <= lo <= hi, or (0, 0)"
        check("max_age_range", fits, rule, "for example max_age_range=(64, 16384)")
        sections = self.pool_size // self.world_count * self.world_count
        fits = not self.ages or self.pool_size == sections
        rule = "be a multiple of world_count where max_age_range is set"
        hint = f"with world_count={self.world_count} set pool_size={sections}"
        check("pool_size", fits, rule, hint)

    @property
    def ages(self) -> bool:
        """Whether worlds of the pool have lifetimes (`max_age_range`)."""
        return self.max_age_range[1] > 0

    @property
    def damages(self) -> bool:
        """Whether any world of the pool is ever damaged."""
        return max(self.damage_share, self.damage_and_keep_share, self.wound_chance) > 0.0

    @property
    def fresh_count(self) -> int:
        """Initial worlds in a batch that has any: `fresh_share` of its worlds, and at least one."""
        return max(1, round(self.fresh_share * self.world_count))

    @property
    def total_iterations(self) -> int:
        """Optimiser steps of the whole run: iterations times repeats."""
        return self.iterations * self.repeats

    @property
    def torch_dtype(self) -> torch.dtype:
        """The torch.dtype of the name `dtype`."""
        return torch.float64 if self.dtype == "float64" else torch.float32

    def learning_rate_at(self, iteration: int, fraction: float = 0.0) -> float:
        """Return the learning rate of an iteration, counted from 0 over all repeats.

        It falls in steps at the milestones, or after a short linear rise along a cosine (Loshchilov
        and Hutter, arXiv 1608.03983), and starts again in each repeat. The cosine is followed at
        least to `fraction`, from 0 to 1, even if the iteration has not come so far.
        """
        within = iteration % self.iterations
        if self.schedule == "milestones":
            passed = sum(milestone <= within for milestone in self.milestones)
            return float(self.learning_rate * float(DECAY**passed))
        fraction = min(1.0, max(fraction, within / self.iterations))
        fall = 0.5 + 0.5 * math.cos(math.pi * fraction)
        rate = self.learning_rate * (LOWEST + (1.0 - LOWEST) * fall)
        return rate * min(1.0, (within + 1) / (RISE * self.iterations))


@dataclass(frozen=True, kw_only=True)
class JointTrainConfig(TrainConfig[TaskConfigT]):
    """A training run of several rules in one world; `initial_rule` must be empty."""

    initial_rules: Common[tuple[str, ...]] = ()
    """Rules to start from, one for each species: names or files; (): random weights."""

    frozen: Common[tuple[int, ...]] = ()
    """Indices of the species, from 0, whose initial rules stay as they are."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.initial_rule:
            raise NPAError(
                f"initial_rule is for one rule, got {shown(self.initial_rule)}: give "
                "initial_rules, one for each species"
            )
        hint = "for example initial_rules=('gecko', 'heart')"
        rule = "be a tuple of names or files"
        check_field(self, "initial_rules", are_texts(self.initial_rules), rule, hint)
        frozen = self.frozen
        numbers = isinstance(frozen, tuple) and all(is_whole(n) and n >= 0 for n in frozen)
        check_field(self, "frozen", numbers, "be a tuple of species' numbers from 0")


def _is_pair(value: object, kind: Callable[[object], bool]) -> bool:
    """Return whether a value is a tuple of two numbers for which `kind` is true."""
    return isinstance(value, tuple) and len(value) == 2 and all(map(kind, value))


SMALL_RUN: Mapping[str, Any] = {"repeats": 1, "world_count": 2, "tensorboard": False}

fast_run = partial(TrainConfig, **SMALL_RUN, learning_rate=2e-3, checkpoint_interval=200)
"""A function that returns a `TrainConfig` of minutes on one core, from `task` and other fields."""

tiny_run = partial(
    TrainConfig,
    **SMALL_RUN, iterations=60, pool_size=8, learning_rate=5e-3, milestones=(45,), log_interval=1,
    picture_interval=20, checkpoint_interval=20,
)  # fmt: skip
"""A function that returns a `TrainConfig` of seconds, for tests, from `task` and other fields."""


def presets_of(
    task_name: str, **runs: TrainConfig[TaskConfigT]
) -> Mapping[str, TrainConfig[TaskConfigT]]:
    """Return the `runs` by name, with runs/<task_name> as the folder that each writes to."""
    return {name: replace(run, out=Path("runs") / task_name) for name, run in runs.items()}
