"""The trainer of one rule, or of several in one world."""

from __future__ import annotations

import copy
import functools
import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn
from tqdm import tqdm

from npa_envs.atomic_files import write_text
from npa_envs.checks import check_device, is_real
from npa_envs.errors import DivergedError, NPAError, shown
from npa_envs.rule.files import load_rule, preset_rules, rule_like, save_rule
from npa_envs.rule.rule import NPARule, enlarged, with_division
from npa_envs.tasks.base import Task
from npa_envs.tasks.train_config import TrainConfig
from npa_envs.training.checkpoint import (
    check_same_run,
    has_per_world_streams,
    save_checkpoint,
    unusable_checkpoint,
)
from npa_envs.training.cycle import TrainingCycle
from npa_envs.training.iteration import Rollout
from npa_envs.training.loss_statistics import divergence_error
from npa_envs.training.process_group import ProcessGroup
from npa_envs.training.run_folder import Run, RunFolder, RunLog
from npa_envs.training.task_table import config_to_dict
from npa_envs.world.species import species_particles

JOINT_TASK_NAME = "co_morphogenesis2d"
"""Name, in checkpoints, of the task that trains several rules together."""

LEFT_OUT = ("out", "device", "initial_rule", "initial_rules", "frozen")
"""Fields of the configuration that rule files leave out: paths, and the device."""

FIRST_PICTURE = 10
"""Number of iterations before the first picture, if `picture_interval` is longer."""


@dataclass(frozen=True)
class TrainResult:
    """Result of `Trainer.run`."""

    rule: NPARule | JointRules
    """The rule after the last iteration."""
    iteration: int
    """Number of iterations done."""
    finished: bool
    """Whether all iterations are done; if not, the run was stopped and can be resumed."""
    interrupted: bool
    """Whether Ctrl-C or SIGTERM stopped it."""
    record: dict[str, Any]
    """The last line of the log: loss terms (means over the interval), learning rate, seconds."""
    folder: Path
    """Folder with log, pictures, checkpoint and rule."""


class Trainer:
    """Trains a rule on a task.

    The constructor creates the folder `config.out` and writes the configuration and a first
    checkpoint there, or with `resume` reads the checkpoint. The processes of torch's default group,
    if there is one, train together: each has some worlds of pool and batch, and rank 0 reads
    and writes the files.

    Args:
        task: The task; one of several species trains a rule for each, as a `JointRules`.
        config: The run's configuration.
        task_name: The task's name in checkpoints.
        resume: Continue from the checkpoint in `config.out`.
        overwrite: Remove the files of an earlier run in `config.out`.
        rollout: For one rule, a function to call in place of `rollout_particles`; None: that one.
        processes: The processes of the run; None: those of torch's default group.
        rules: Initial rules of several species, which are copied; None: those of the configuration.

    Raises:
        NPAError: There is no such device; the folder cannot be written to, has a run already
            (without `resume` or `overwrite`), one of another task or configuration or a damaged
            one, or another trainer writes to it. The batch is not divisible by the number of
            processes, or a process is lost.
    """

    def __init__(
        self,
        task: Task,
        config: TrainConfig[Any],
        *,
        task_name: str,
        resume: bool = False,
        overwrite: bool = False,
        rollout: Rollout | None = None,
        processes: ProcessGroup | None = None,
        rules: Sequence[NPARule] | None = None,
    ) -> None:
        self.task, self.config, self.task_name = task, config, task_name
        self.folder = RunFolder(config.out)
        self._log = RunLog(self.folder)
        self._last_record: dict[str, Any] = {}
        self._unwritten_record: dict[str, Any] | None = None
        """Number and learning rate of the iteration whose log record is not yet written."""
        self._least_progress = 0.0
        """`least_progress` of the last `iterate`: the log computes the learning rate with it."""
        self._seconds_before = 0.0
        """Time [s] of all `run`s before the present one, also of those before a resumption."""
        self._started: float | None = None
        device = check_device(config.device)
        # On CUDA a record is written an iteration later, so that the device does not idle.
        self._defer_records = device.type == "cuda"
        self._processes = ProcessGroup.current() if processes is None else processes
        check = functools.partial(check_same_run, task_name=task_name, config=config)
        self._run = Run(self.folder, self._processes, check, resume=resume, overwrite=overwrite)
        checkpoint = self._run.take_content()
        self.rule, self._cycle = self._build(device, checkpoint, rollout, rules)
        """The trained module: one rule, or the rules of all species."""
        self.pool = self._cycle.pool
        # Up to here files are only read.
        self._open_folder(checkpoint)

    def _build(
        self,
        device: torch.device,
        checkpoint: dict[str, Any] | None,
        rollout: Rollout | None,
        rules: Sequence[NPARule] | None,
    ) -> tuple[NPARule | JointRules, TrainingCycle]:
        """Return the module, with initial weights or of a checkpoint's shape, and its cycle."""
        task, config = self.task, self.config
        generator = torch.Generator().manual_seed(config.seed)
        saved = None if checkpoint is None else checkpoint["rule_hyper_parameters"]
        rule: NPARule | JointRules
        if counts := task.species_counts:
            rule = JointRules(_species_rules(config, task.make_rules(generator), saved, rules))
            rollout = functools.partial(species_particles, counts=counts, density_counts=counts)
        else:
            untrained = task.make_rule(generator)
            rule = initial_rule(config, untrained) if saved is None else rule_like(saved)
        return rule, TrainingCycle(
            task,
            rule.to(device, config.torch_dtype),
            config,
            device,
            generator,
            rollout,
            processes=self._processes,
            # A run of several processes keeps these streams when one process resumes it.
            per_world_streams=self._processes.distributed
            or has_per_world_streams(checkpoint or {}),
        )

    def _open_folder(self, checkpoint: dict[str, Any] | None) -> None:
        """Create the folder; then restore the checkpoint of a resumed run, or write a first one."""
        if self._processes.first:
            rule_bytes = sum(p.nbytes for p in self.rule.parameters())
            pool_bytes = sum(value.nbytes for value in self.pool.worlds.tensors())
            self.folder.prepare(self._processes.count * pool_bytes + 16 * rule_bytes)
        with self._run.locked(begin=True):
            if checkpoint is not None:
                self._restore(checkpoint)
            elif self._processes.first and self._log.records():
                raise NPAError(
                    f"out must be a folder without a run, but {shown(str(self.folder.path))} "
                    "holds a log without its checkpoint: choose another folder (--out), or "
                    "overwrite it (--overwrite)"
                )
            if self._processes.first:
                # Before the first checkpoint, whose resumption needs it.
                text = json.dumps(config_to_dict(self.config), indent=2)
                write_text(self.folder.config, text + "\n")
            if checkpoint is None:
                # Now, so that a run that is killed early can be resumed and a full disk is noticed.
                self.save()

    @property
    def iteration(self) -> int:
        """Number of iterations done."""
        return self._run.iteration

    def run(self, *, progress: bool = True, max_seconds: float | None = None) -> TrainResult:
        """Train until the end, or until Ctrl-C, SIGTERM or `max_seconds`; then save.

        Args:
            max_seconds: Stop after this time [s]; the run can be resumed. None: no limit.

        Raises:
            DivergedError: The loss is not finite.
            NPAError: A file cannot be written, or one of several processes is lost (the last
                checkpoint is intact), or another trainer writes to the folder, or has done so since
                this one was made.
        """
        check_seconds(max_seconds)
        config, total, first = self.config, self.config.total_iterations, self._processes.first
        start = time.perf_counter()

        def step() -> None:
            self.iterate()
            self._update_log()
            interval = config.picture_interval
            early, last = self.iteration == FIRST_PICTURE < interval, self.iteration == total
            if self._due(interval) or early or (last and interval):
                self._write_picture()
            if self._due(config.checkpoint_interval) and self.iteration < total:
                self.save()
            bar.update()
            if "loss" in self._last_record:
                bar.set_postfix(loss=f"{self._last_record['loss']:.4g}", refresh=False)

        with (
            self._run.locked(),
            self._log.opened(config.tensorboard and first, self.iteration),
            tqdm(
                total=total, initial=self.iteration, disable=not (progress and first), unit="it"
            ) as bar,
        ):
            self._started = start
            seconds = math.inf if max_seconds is None else max_seconds
            if first:
                self._last_record = next(iter(self._log.records()[-1:]), {})
            try:
                interrupted = self._run.repeat(
                    step,
                    is_over=lambda: self.iteration >= total,
                    time_is_up=lambda: time.perf_counter() - start >= seconds,
                    end=lambda _: self.save(),
                )
            finally:
                # Time until the next `run` does not count.
                self._seconds_before, self._started = self._seconds(), None
        return TrainResult(
            rule=self.saved_rule,
            iteration=self.iteration,
            finished=self.iteration >= total,
            interrupted=interrupted,
            record=self._last_record,
            folder=self.folder.path,
        )

    def iterate(self, least_progress: float = 0.0) -> None:
        """Train for one iteration, without waiting for the device and without writing files.

        Args:
            least_progress: Lower bound on the progress of the learning rate's schedule, in [0, 1];
                only the schedule "cosine" reads it. `elapsed / seconds` ties the learning rate to a
                time limit; such a run is not repeatable.
        """
        if not 0.0 <= least_progress <= 1.0:
            raise NPAError(
                f"least_progress must lie in [0, 1], got {shown(least_progress)}: "
                "min(1, elapsed / seconds)"
            )
        self._cycle.run(self.iteration, least_progress)
        self._least_progress = least_progress
        self._run.iteration += 1

    @property
    def saved_rule(self) -> NPARule | JointRules:
        """The rule as it is saved; if it has an encoder, a copy with a table of current codes."""
        rule = self.rule
        if isinstance(rule, NPARule) and rule.encoder:
            # The table has the codes of the last iteration, before the optimiser's step.
            rule = copy.deepcopy(rule)
            self.task.for_rule(rule)
        return rule

    def save(self) -> None:
        """Write the checkpoint and the rule.

        Raises:
            DivergedError: The loss of an earlier iteration was not finite; nothing is written.
            NPAError: A file cannot be written, or parameters differ between processes; the last
                checkpoint is intact.
        """
        self._write_record()
        self._stop_if_diverged()
        self._processes.check_same(list(self.rule.parameters()))
        progress = {"iteration": self.iteration, "seconds": self._seconds()}
        state = {"rule": self.rule.state_dict(), **self._cycle.state_dict()}
        if not self._processes.first:
            return
        self._run.write_checkpoint(self._origin() | progress | state)
        write_rules(self.saved_rule, self.folder, self.config, self.task_name, self.iteration)

    def _origin(self) -> dict[str, Any]:
        return {
            "task_name": self.task_name,
            "config": config_to_dict(self.config),
            "rule_hyper_parameters": dict(self.rule.hyper_parameters()),
        }

    def _due(self, interval: int) -> bool:
        return interval > 0 and self.iteration % interval == 0

    def _seconds(self) -> float:
        running = 0.0 if self._started is None else time.perf_counter() - self._started
        return self._seconds_before + running

    def _update_log(self) -> None:
        """Begin the log record of the interval that ends with this iteration, if one does.

        It is written at once, or with `_defer_records` after the next iteration was launched.
        """
        self._write_record()
        if self._due(self.config.log_interval) or self.iteration == self.config.total_iterations:
            self._cycle.statistics.send()
            rate = self.config.learning_rate_at(self.iteration - 1, self._least_progress)
            self._unwritten_record = {"iteration": self.iteration, "learning_rate": rate}
        if not self._defer_records:
            self._write_record()

    def _write_record(self) -> None:
        """Write the record that `_update_log` has begun, unless it is written already."""
        begun, self._unwritten_record = self._unwritten_record, None
        if begun is None:
            return
        statistics, all_finite = self._cycle.statistics.receive()
        if not all_finite:
            self._stop_if_diverged()
        self._last_record = {
            "iteration": begun["iteration"],
            **statistics,
            "learning_rate": begun["learning_rate"],
            "seconds": round(self._seconds(), 3),
        }
        if self._processes.first:
            self._log.append(self._last_record)

    def _write_picture(self) -> None:
        self._write_record()
        if not self._processes.first:
            return
        with torch.no_grad():
            end = self._cycle.batch.end
            picture = self._cycle.task.picture(end.x, end.s)
        # Worlds with different goals have no common target picture.
        target = getattr(self.task, "target_picture", None) if end.goal is None else None
        captions = [f"iteration {self.iteration}, world {k}" for k in range(1, len(picture) + 1)]
        if target is not None:
            picture = torch.cat((target[None].to(picture), picture))
            captions.insert(0, "target")
        self._log.add_picture(picture, captions, self.iteration)

    def _stop_if_diverged(self) -> None:
        statistics = self._cycle.statistics
        if statistics.all_finite():
            return
        snapshot = statistics.snapshot()
        for name in snapshot.keys() & {"x0", "s0", "x", "s", "goal"}:
            snapshot[name] = self._processes.gathered(snapshot[name], section=1)
        error = None
        if self._processes.first:
            error = divergence_error(self.task, self.rule, snapshot, self.folder.diagnosis)
            try:
                save_checkpoint(self.folder.diagnosis, self._origin() | snapshot)
            except NPAError as other:
                error = DivergedError(f"{error}; but these were not written: {other}")
        error = self._processes.broadcast(error)
        assert error is not None, "made by the first process"
        raise error

    def _restore(self, content: dict[str, Any]) -> None:
        self._run.iteration = content["iteration"]
        self._seconds_before = content["seconds"]
        try:
            self.rule.load_state_dict(content["rule"])
            self._cycle.load_state_dict(content, self.iteration)
        except (KeyError, TypeError, AttributeError, ValueError, RuntimeError) as error:
            reason = f"it cannot be used ({shown(error)})"
            raise unusable_checkpoint(self.folder.checkpoint, reason) from error
        if self._processes.first:
            self._log.truncate(self.iteration)


def check_seconds(max_seconds: object) -> None:
    """Raise NPAError unless a time limit is a number of at least 0 [s], or None for no limit."""
    if max_seconds is None or max_seconds == math.inf:
        return
    if not is_real(max_seconds) or max_seconds < 0:  # type: ignore[operator]
        raise NPAError(
            f"max_seconds must be a number of at least 0, or None for no limit, got "
            f"{shown(max_seconds)}: try 60"
        )


class JointRules(nn.Module):
    """A module of several rules in one world, one for each species, which are trained together."""

    def __init__(self, rules: Sequence[NPARule]) -> None:
        super().__init__()
        self.rules = nn.ModuleList(rules)

    def __iter__(self) -> Any:
        return iter(self.rules)

    def hyper_parameters(self) -> dict[str, Any]:
        """Return the hyper-parameters of all rules, as a list "rules", for checkpoints."""
        return {"rules": [dict(rule.hyper_parameters()) for rule in self]}


def write_rules(
    rule: NPARule | JointRules,
    folder: RunFolder,
    config: TrainConfig[Any],
    task_name: str,
    iteration: int,
) -> None:
    """Write a run's rule, or each of a `JointRules`, to its folder with task and configuration."""
    fields = {k: v for k, v in config_to_dict(config).items() if k not in LEFT_OUT}
    metadata = {"task": task_name, "config": json.dumps(fields), "iteration": str(iteration)}
    if isinstance(rule, NPARule):
        save_rule(rule, folder.rule, metadata=metadata)
        return
    for number, (one, species) in enumerate(zip(rule, fields["task"]["species"], strict=True)):
        metadata |= {"task": "morphogenesis2d", "config": json.dumps(fields | {"task": species})}
        save_rule(one, folder.rule_of(number), metadata=metadata | {"trained_in": JOINT_TASK_NAME})


def take_options(rule: NPARule, config: TrainConfig[Any]) -> None:
    """Set a rule's `moment_inverse` and `dead_zone` as configured, but 0 if it is equivariant."""
    rule.moment_inverse = config.moment_inverse
    rule.dead_zone = 0.0 if rule.equivariant else config.dead_zone


def initial_rule(config: TrainConfig[Any], untrained: NPARule) -> NPARule:
    """Return the rule that a run starts from, with the shapes of the task's untrained one.

    A rule without division or codes may initialise one with them, and one of `preset_rules` a rule
    with more hidden units, of any ε0. An equivariant rule has no dead zone, and starts from random
    weights where the configuration names one of `preset_rules`, which are not equivariant.
    """
    take_options(untrained, config)
    source = config.initial_rule
    if not source or (untrained.equivariant and source in preset_rules()):
        return untrained
    rule = load_rule(source)
    narrow = source in preset_rules() and untrained.hidden_dim > rule.hidden_dim
    if narrow or (untrained.code_dim and not rule.code_dim):
        rule = enlarged(rule, untrained)
    if untrained.divides and not rule.divides:
        rule = with_division(rule)
    rule.dead_zone = untrained.dead_zone
    differences = _differences(rule, untrained, config)
    if differences:
        raise NPAError(
            f"initial_rule must be a rule of the task's shape, but {shown(source)} differs in "
            f"{differences}: change those fields, start from another rule, or from random weights, "
            "with the initial rule ''"
        )
    return rule


def _differences(rule: NPARule, untrained: NPARule, config: TrainConfig[Any]) -> str:
    """Return in which hyper-parameters a rule differs from the task's, as text; "" if in none."""
    if rule.moment_inverse == "threshold":
        rule.moment_inverse = config.moment_inverse
    theirs, ours = rule.hyper_parameters(), untrained.hyper_parameters()
    return ", ".join(
        f"{'eps0, the eps it learned at' if name == 'eps0' else name} "
        f"({shown(theirs[name])}, here {shown(ours[name])})"
        for name in ours
        if theirs[name] != ours[name]
    )


def _species_rules(
    config: TrainConfig[Any],
    untrained: list[NPARule],
    saved: dict[str, Any] | None,
    rules: Sequence[NPARule] | None,
) -> list[NPARule]:
    """Return each species' rule: like a checkpoint's (`saved`), else a copy of `rules` or new."""
    if config.initial_rule:
        raise NPAError(
            f"initial_rule is for one rule, got {shown(config.initial_rule)}: give one for each "
            "species as rules"
        )
    sources: tuple[str, ...] = getattr(config, "initial_rules", ())
    frozen: tuple[int, ...] = getattr(config, "frozen", ())
    if saved is not None:
        rules = [rule_like(one) for one in saved.get("rules", ())]
    elif rules is None and sources:
        rules = [load_rule(source) for source in sources]
    for rule in untrained:
        take_options(rule, config)
    if rules is None:
        if frozen:
            raise NPAError(
                f"frozen must name rules that were trained before, got {frozen} without "
                "initial_rules: give one for each species"
            )
        return untrained
    rules = copy.deepcopy(list(rules))
    if len(rules) != len(untrained):
        raise NPAError(f"rules must be one for each of {len(untrained)} species, got {len(rules)}")
    for number, (rule, expected) in enumerate(zip(rules, untrained, strict=True)):
        expected.dead_zone = rule.dead_zone
        differences = _differences(rule, expected, config)
        if differences:
            raise NPAError(
                f"rules must have the shape of their species, but rule {number} differs in "
                f"{differences}: change those fields of species {number}"
            )
    if frozen and max(frozen) >= len(rules):
        raise NPAError(
            f"frozen must name species from 0 to {len(rules) - 1}, got {shown(max(frozen))}"
        )
    for number in frozen:
        rules[number].requires_grad_(False)
    if not any(p.requires_grad for rule in rules for p in rule.parameters()):
        raise NPAError("frozen must leave a rule that learns, got all of them: leave one out")
    return rules
