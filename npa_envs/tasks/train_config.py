"""Configurations of training runs: of one rule, of several rules in one world; small runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar, get_args

import torch

from npa_envs.checks import (
    MomentInverse,
    are_texts,
    check_field,
    check_flag,
    check_non_negative,
    check_positive,
    check_seed,
    is_real,
    is_whole,
)
from npa_envs.devices import parse_device
from npa_envs.errors import NPAError, shown
from npa_envs.world.rollout import Memory

TaskConfigT = TypeVar("TaskConfigT")

Schedule = Literal["milestones", "cosine"]
"""How a learning rate falls."""

OptimiserName = Literal["adamw", "muon"]
"""What takes the steps along gradients."""

RISE = 0.01
"""Share of a repeat in which the learning rate of the schedule "cosine" rises."""

LOWEST = 0.01
"""What is left of the learning rate at the end of the schedule "cosine"."""

DECAY = 0.3
"""Factor on the learning rate at each milestone."""

LARGEST_POWER = 8.0
"""Largest power of the mean of what grown worlds change: float32 rounds higher ones to 0."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig(Generic[TaskConfigT]):
    """A training run: the schedule, the pool, the optimiser, the machine, what is written.

    The defaults are the paper's for 2D morphogenesis (arXiv 2601.16096). Fields of the task lie
    in `task`; `npa_envs.training.override` and configuration files take both kinds by plain name.
    """

    task: TaskConfigT
    """The task's own configuration."""

    initial_rule: str = ""
    """Start from this rule, a name, a file or a run's folder, instead of random weights; '': from
    these. The preset `best` of morphogenesis2d starts from a heart (`heart-first`), that of
    morphogenesis3d from `rocket-8192`."""

    vary_eps: tuple[float, float] = (1.0, 1.0)
    """Range of factors on ε, in open space: one is drawn for each fresh world, evenly in the
    logarithm. A world at a larger ε is one at the task's ε that begins as a smaller disk."""

    moment_inverse: MomentInverse = "threshold"
    """How the rule's state gradients are corrected: "threshold", the paper's, or "smooth"."""

    dead_zone: float = 0.0
    """Each number y of an update with |y| <= `dead_zone` counts as 0 (dimensionless): worlds that
    hardly change then come to rest. It replaces that of `initial_rule`, also where it is 0; of
    several rules that learn together, those that are given keep theirs. Equivariant rules have
    none, whatever is said here."""

    iterations: int = 10_000
    """Optimiser steps in one repeat."""

    repeats: int = 3
    """How often the schedule runs. Rule and pool go on; the optimiser starts afresh."""

    world_count: int = 8
    """Worlds in a batch, B."""

    pool_size: int = 512
    """Worlds that live on between batches."""

    steps: tuple[int, int] = (32, 96)
    """Range [lo, hi) that the number of steps of a rollout is drawn from, uniformly."""

    optimiser: OptimiserName = "adamw"
    """What takes the steps: "adamw" as in the paper, or "muon", which makes the steps of layers'
    matrices orthogonal (Jordan et al. 2024) and gives all else, such as biases, to AdamW."""

    learning_rate: float = 5e-4
    """The optimiser's learning rate at the start of each repeat."""

    schedule: Schedule = "milestones"
    """How the learning rate falls in a repeat: at `milestones`, or by "cosine", along half a cosine
    to a hundredth, whatever the length of the repeat."""

    milestones: tuple[int, ...] = (2_000, 4_000, 6_000, 8_000)
    """Iterations of a repeat after which the learning rate falls to 0.3 of itself."""

    weight_decay: float = 0.0
    """The optimiser's weight decay."""

    seed_interval: int = 16
    """Every so many batches, the first world of the batch is a fresh seed. 1: in every batch."""

    fresh_share: float = 0.0
    """Share of fresh seeds in a batch that has any by `seed_interval`; at least one world. Without
    effect where worlds have `max_age_range`, at the end of which seeds come."""

    max_age_range: tuple[int, int] = (0, 0)
    """Steps that a world of the pool lives until a fresh seed takes its place, or it is damaged and
    is kept (`damage_and_keep_share`): the least, in the pool's first place, and the most, in its
    last; evenly in the logarithm between them. A batch has one world from each of B equal
    sections of the pool, so it holds young and old worlds. (0, 0): fresh seeds come by
    `seed_interval` instead."""

    damage_and_keep_share: float = 0.0
    """Share in [0, 1) of the worlds whose time is over that are damaged at that moment and live as
    long again; a fresh seed takes the place of the others (dimensionless). So a rule learns what
    comes of a damage long after it. Needs `max_age_range`."""

    stillness_weight: float = 0.0
    """Weight of what a rollout changes in grown worlds: the mean path length of their particles in
    perception radii, and the mean |Δs| from its start to its end; of all others it is 0
    (dimensionless). Births and deaths do not count. Grown are worlds of `stillness_min_age` whose
    place in the pool is not damaged in every batch. It ends the slow flow by which worlds
    lose their shape. Needs `max_age_range`."""

    stillness_power: float = 1.0
    """Power of the means over particles and states in `stillness_weight`:
    (mean |a|^power)^(1/power), at least 1 and at most 8. The larger it is, the more the few
    particles weigh that move most."""

    stillness_min_age: int = 512
    """Steps from the seed, or from the damage before another life, after which a world is grown."""

    damage_share: float = 1.0
    """Share in [0, 1] of the pool's places whose worlds are damaged in every batch, so that a rule
    learns to heal: the first places, which with `max_age_range` are those of the shortest lives.
    All others are damaged by `damage_and_keep_share` alone."""

    seed: int = 0
    """Seed of every random number of the run, in [0, 2**63)."""

    device: str = "cpu"
    """Where to train: "cpu", "cuda", "cuda:1", ..."""

    dtype: Literal["float32", "float64"] = "float32"
    """Precision of the worlds and of the rule."""

    memory: Memory = "store"
    """What the backward pass reads: "store" keeps all steps, "recompute" computes two steps in
    three again, "minimal" all but the last."""

    cuda_graph: bool = True
    """On CUDA, capture an iteration: rollout and gradients as one graph per number of steps."""

    out: Path = Path("runs/morphogenesis2d")
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
        """Check every field; raise NPAError where one has a wrong type or lies out of its range."""
        check_positive(self, int, "iterations", "repeats", "world_count", "pool_size")
        check_positive(self, int, "seed_interval", "log_interval", "checkpoint_interval")
        check_positive(self, int, "stillness_min_age")
        check_positive(self, int, "picture_interval", at_least=0)
        check_positive(self, float, "learning_rate", "stillness_power")
        check_non_negative(self, "weight_decay", "stillness_weight", "dead_zone")
        check_non_negative(self, "damage_and_keep_share")
        check_non_negative(self, "fresh_share", "damage_share", at_most=1.0)
        check_seed(self, "seed")
        check_flag(self, "cuda_graph", "tensorboard")
        choices = {"optimiser": OptimiserName, "schedule": Schedule, "memory": Memory}
        choices |= {"moment_inverse": MomentInverse, "dtype": Literal["float32", "float64"]}
        for name, kind in choices.items():
            value, allowed = getattr(self, name), get_args(kind)
            known = isinstance(value, str) and value in allowed
            check_field(self, name, known, f"be one of {', '.join(allowed)}")
        parse_device(self.device)
        milestones, ages = self.milestones, self.max_age_range
        are_ages = _is_pair(ages, is_whole)
        are_whole = isinstance(milestones, tuple) and all(map(is_whole, milestones))
        for name, fits, rule, cure in (
            (
                "stillness_power",
                1.0 <= self.stillness_power <= LARGEST_POWER,
                f"be at least 1 and at most {LARGEST_POWER:g}",
                "1 for plain means",
            ),
            (
                "damage_and_keep_share",
                self.damage_and_keep_share < 1.0,
                "be below 1",
                "with 1 there are no seeds",
            ),
            (
                "initial_rule",
                isinstance(self.initial_rule, str),
                "be the name of a rule or of a file, or '' for none",
                "",
            ),
            (
                "steps",
                _is_pair(self.steps, is_whole) and 1 <= self.steps[0] < self.steps[1],
                "be two whole numbers (lo, hi) with 1 <= lo < hi",
                "hi is exclusive, so exactly 32 steps are steps=(32, 33)",
            ),
            ("milestones", are_whole, "be a tuple of whole numbers", ""),
            (
                "milestones",
                are_whole and list(milestones) == sorted({m for m in milestones if m >= 1}),
                "be positive and increasing",
                "for example milestones=(2000, 4000)",
            ),
            (
                "world_count",
                self.world_count <= self.pool_size,
                f"be at most pool_size={self.pool_size} (batches are drawn without replacement)",
                f"set pool_size={self.world_count} or more",
            ),
            (
                "max_age_range",
                are_ages and (1 <= ages[0] <= ages[1] or ages == (0, 0)),
                "be two whole numbers (lo, hi) with 1 <= lo <= hi, or (0, 0)",
                "for example max_age_range=(64, 16384)",
            ),
            (
                "pool_size",
                not are_ages or not self.ages or self.pool_size % self.world_count == 0,
                "be a multiple of world_count where max_age_range is set",
                f"with world_count={self.world_count} set "
                f"pool_size={self.pool_size // self.world_count * self.world_count}",
            ),
            (
                "vary_eps",
                _is_pair(self.vary_eps, is_real) and 0.0 < self.vary_eps[0] <= self.vary_eps[1],
                "be two factors (lo, hi) with 0 < lo <= hi",
                "for example vary_eps=(0.5, 2.0)",
            ),
            ("out", isinstance(self.out, Path), "be a pathlib.Path", f"Path({shown(self.out)})"),
        ):
            check_field(self, name, fits, rule, cure)
        for name in ("stillness_weight", "damage_and_keep_share"):
            if getattr(self, name) > 0 and not self.ages:
                raise NPAError(
                    f"{name} needs max_age_range, got {getattr(self, name)} without: "
                    "set max_age_range, for example to (256, 32768)"
                )

    @property
    def ages(self) -> bool:
        """Whether worlds of the pool have max_age_range."""
        return self.max_age_range[1] > 0

    @property
    def damages(self) -> bool:
        """Whether any world of the pool is ever damaged."""
        return self.damage_share > 0.0 or self.damage_and_keep_share > 0.0

    @property
    def fresh_count(self) -> int:
        """Fresh seeds in a batch that has such."""
        return max(1, round(self.fresh_share * self.world_count))

    @property
    def total_iterations(self) -> int:
        """Optimiser steps of the whole run: iterations times repeats."""
        return self.iterations * self.repeats

    @property
    def torch_dtype(self) -> torch.dtype:
        """`dtype` as torch's own."""
        return torch.float64 if self.dtype == "float64" else torch.float32

    def learning_rate_at(self, iteration: int, share: float = 0.0) -> float:
        """Return the learning rate of an iteration, counted from 0 over all repeats.

        It is a function of the iteration alone, restarted with each repeat, so that a resumed run
        needs no scheduler state: MultiStepLR, or a cosine with a short linear rise before it
        (Loshchilov and Hutter, arXiv 1608.03983).
        """
        within = iteration % self.iterations
        if self.schedule == "milestones":
            passed = sum(milestone <= within for milestone in self.milestones)
            return float(self.learning_rate * float(DECAY**passed))
        over = min(1.0, max(share, within / self.iterations))
        fall = 0.5 + 0.5 * math.cos(math.pi * over)
        rate = self.learning_rate * (LOWEST + (1.0 - LOWEST) * fall)
        return rate * min(1.0, (within + 1) / (RISE * self.iterations))


@dataclass(frozen=True, kw_only=True)
class JointTrainConfig(TrainConfig[TaskConfigT]):
    """A training run of several rules in one world: what they start from, and which ones learn.

    `initial_rule` of a run of one rule stays empty.
    """

    initial_rules: tuple[str, ...] = ()
    """Start from these rules, shipped ones' names or files, one for each species."""

    frozen: tuple[int, ...] = ()
    """Numbers of the species, from 0, whose initial rules stay as they are."""

    def __post_init__(self) -> None:
        """Check every field; how many species there are is the task's to know."""
        super().__post_init__()
        if self.initial_rule:
            raise NPAError(
                f"initial_rule is for one rule, got {shown(self.initial_rule)}: give "
                "initial_rules, one for each species"
            )
        cure = "for example initial_rules=('gecko', 'heart')"
        rule = "be a tuple of names or files"
        check_field(self, "initial_rules", are_texts(self.initial_rules), rule, cure)
        frozen = self.frozen
        numbers = isinstance(frozen, tuple) and all(is_whole(n) and n >= 0 for n in frozen)
        check_field(self, "frozen", numbers, "be a tuple of species' numbers from 0")


def _is_pair(value: object, kind: Callable[[object], bool]) -> bool:
    return isinstance(value, tuple) and len(value) == 2 and all(map(kind, value))


SMALL: Mapping[str, Any] = {"repeats": 1, "world_count": 2, "tensorboard": False}
FAST = {**SMALL, "learning_rate": 2e-3, "checkpoint_interval": 200}
TINY = {
    **SMALL,
    "iterations": 60,
    "pool_size": 8,
    "learning_rate": 5e-3,
    "milestones": (45,),
    "log_interval": 1,
    "picture_interval": 20,
    "checkpoint_interval": 20,
}


def fast_run(task: TaskConfigT, **fields: Any) -> TrainConfig[TaskConfigT]:
    """Return a run of minutes on one core that learns something to look at."""
    return TrainConfig(task=task, **{**FAST, **fields})


def tiny_run(task: TaskConfigT, **fields: Any) -> TrainConfig[TaskConfigT]:
    """Return a run of seconds, for tests."""
    return TrainConfig(task=task, **{**TINY, **fields})


def presets_of(
    task_name: str, **runs: TrainConfig[TaskConfigT]
) -> Mapping[str, TrainConfig[TaskConfigT]]:
    """Return the presets of a task, each with the task's folder of runs."""
    return {name: replace(run, out=Path("runs") / task_name) for name, run in runs.items()}
