"""The trainer of one rule, or of several in one world: checkpoints, log, pictures, rule files."""

from __future__ import annotations

import copy
import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Unpack, cast

import torch
from torch import Tensor, nn
from tqdm import tqdm

from npa_envs.atomic_files import write_text
from npa_envs.checks import is_real
from npa_envs.devices import check_device
from npa_envs.errors import DivergedError, NPAError, shown
from npa_envs.rule.files import load_rule, preset_rules, save_rule
from npa_envs.rule.rule import NPARule, dividing, with_codes
from npa_envs.tasks.base import Task, differing_fields, untrained_rule
from npa_envs.tasks.co_morphogenesis2d import CoMorphogenesis2D, CoMorphogenesis2DConfig
from npa_envs.tasks.train_config import TrainConfig
from npa_envs.training.checkpoint import (
    check_content,
    check_same_run,
    drawn_by_world,
    save_checkpoint,
    unusable_checkpoint,
)
from npa_envs.training.cycle import TrainingCycle
from npa_envs.training.iteration import Rollout, TrainingOptions, divergence_error
from npa_envs.training.ranks import Ranks
from npa_envs.training.run_folder import (
    JsonlLog,
    Run,
    RunFolder,
    open_tensorboard,
    write_batch_picture,
)
from npa_envs.training.task_table import config_to_dict
from npa_envs.world.species import rollout_species

FIRST_PICTURE = 10
"""Iteration after which the first picture is written, if the interval is longer."""


@dataclass(frozen=True)
class TrainResult:
    """Result of `Trainer.run`."""

    rule: NPARule
    """The rule after the last iteration."""
    iteration: int
    """Iterations done."""
    finished: bool
    """Whether all iterations are done; if not, the run was stopped and can be resumed."""
    interrupted: bool
    """Whether Ctrl-C or SIGTERM stopped it."""
    record: dict[str, Any]
    """The last line of the log: loss terms (means over the interval), learning rate, seconds."""
    folder: Path
    """Folder of log, pictures, checkpoint and rule."""


class Trainer:
    """Trains a rule on a task.

    The constructor creates the folder `config.out` and writes the configuration and a first
    checkpoint there, or with `resume` reads the checkpoint. The processes of torch's default group,
    if there is one, train together: each has a part of the pool and of the batch, and rank 0 reads
    and writes the files.

    Args:
        task: The task.
        config: The run's configuration.
        task_name: The task's name in checkpoints.
        resume: Continue from the checkpoint in `config.out`.
        overwrite: Remove the files of an earlier run in `config.out`.
        rollout: The rollout to train through; None: `npa_envs.rollout`.
        ranks: The processes of the run; None: those of torch's default group.

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
        ranks: Ranks | None = None,
    ) -> None:
        self.task = task
        self.config = config
        self.task_name = task_name
        self.folder = RunFolder(config.out)
        self._log = JsonlLog(self.folder.log)
        self._record: dict[str, Any] = {}
        self._begun_record: dict[str, Any] | None = None
        self._board: Any = None
        self._schedule_share = 0.0
        self._seconds_before = 0.0
        self._started: float | None = None
        # On CUDA a record is finished an iteration later, so that the device does not idle.
        device = check_device(config.device)
        self._defer_records = device.type == "cuda"
        self._ranks = Ranks.current() if ranks is None else ranks

        def check(content: dict[str, Any], path: Path) -> None:
            check_same_run(content, task_name, config, path)

        self._run = Run(self.folder, self._ranks, check, resume=resume, overwrite=overwrite)
        content, self._run.content = self._run.content, None
        self._make_cycle(content, device, rollout)
        if self._ranks.first:
            rule_bytes = sum(p.nbytes for p in self.rule.parameters())
            pool_bytes = sum(value.nbytes for value in self.pool.worlds.tensors())
            self.folder.prepare(self._ranks.count * pool_bytes + 16 * rule_bytes)
        with self._run.held(begin=True):
            if content is not None:
                self._restore(content)
            self._write_config(new=content is None)
            if content is None:
                # Now, so that a run that is killed early can be resumed and a full disk is noticed.
                self.save()

    def _make_cycle(
        self, content: dict[str, Any] | None, device: torch.device, rollout: Rollout | None
    ) -> None:
        """Make rule, pool and optimiser, as new, for the checkpoint of a resumed run if any."""
        config, ranks = self.config, self._ranks
        schedule = torch.Generator().manual_seed(config.seed)
        saved = None if content is None else content["rule_hyper_parameters"]
        self.rule = self._make_rule(schedule, saved).to(device, config.torch_dtype)
        # A run of several processes keeps its streams by world when one process resumes it.
        by_world = ranks.together or (content is not None and drawn_by_world(content))
        self._cycle = TrainingCycle(
            self.task, self.rule, config, device, schedule, rollout, ranks=ranks, by_world=by_world
        )
        self.pool = self._cycle.pool

    def _write_config(self, *, new: bool) -> None:
        """Write the configuration, before the first checkpoint, whose resumption needs it."""
        if not self._ranks.first:
            return
        if new and self._log.records():
            raise NPAError(
                f"out must be a folder without a run, but {shown(str(self.folder.path))} "
                "holds a log without its checkpoint: choose another folder (--out), or "
                "overwrite it (--overwrite)"
            )
        text = json.dumps(config_to_dict(self.config), indent=2)
        write_text(self.folder.config, text + "\n")

    @property
    def iteration(self) -> int:
        """Iterations done."""
        return self._run.iteration

    def run(self, *, progress: bool = True, max_seconds: float | None = None) -> TrainResult:
        """Train until the end, or until Ctrl-C, SIGTERM or `max_seconds`; then save.

        Args:
            max_seconds: Stop after this time [s]; the run can be resumed.

        Raises:
            DivergedError: The loss is not finite.
            NPAError: A file cannot be written, or a process of several is lost; the last checkpoint
                is intact. Or another trainer writes to the folder, or has done so since this one
                was made.
        """
        check_seconds(max_seconds)
        with self._run.held():
            return self._train(progress, max_seconds)

    def _train(self, progress: bool, max_seconds: float | None) -> TrainResult:
        config, total, ranks = self.config, self.config.total_iterations, self._ranks
        start = self._started = time.perf_counter()
        seconds = math.inf if max_seconds is None else max_seconds
        if ranks.first:
            self._record = next(iter(self._log.records()[-1:]), {})
            if config.tensorboard:
                self._board = open_tensorboard(self.folder, self.iteration)
        visible = progress and ranks.first
        bar = tqdm(total=total, initial=self.iteration, disable=not visible, unit="it")

        def step() -> None:
            self.iterate()
            # Of the iteration before: the device runs this one meanwhile.
            self._finish_record()
            if self._due(config.log_interval) or self.iteration == total:
                self._begin_record()
            interval = config.picture_interval
            if self._due(interval) or self.iteration == FIRST_PICTURE < interval:
                self._write_picture()
            if self._due(config.checkpoint_interval) and self.iteration < total:
                self.save()
            bar.update()
            if "loss" in self._record:
                bar.set_postfix(loss=f"{self._record['loss']:.4g}", refresh=False)

        try:
            interrupted = self._run.go(
                step,
                over=lambda: self.iteration >= total,
                late=lambda: time.perf_counter() - start >= seconds,
                end=lambda _: self.save(),
            )
        finally:
            # Time until the next `run` does not count.
            self._seconds_before, self._started = self._seconds(), None
            bar.close()
            if self._board is not None:
                self._board.close()
                self._board = None
        return TrainResult(
            rule=self.saved_rule,
            iteration=self.iteration,
            finished=self.iteration >= total,
            interrupted=interrupted,
            record=self._record,
            folder=self.folder.path,
        )

    def iterate(self, share: float = 0.0) -> None:
        """Train for one iteration, without synchronising and without writing files.

        Args:
            share: The least fraction of the schedule "cosine" that is over, in [0, 1].
                `elapsed / seconds` ties the learning rate to a time limit; such a run is not
                repeatable.

        Raises:
            NPAError: The share is not in [0, 1].
        """
        if not 0.0 <= share <= 1.0:
            raise NPAError(
                f"share must lie in [0, 1], got {shown(share)}: min(1, elapsed / seconds)"
            )
        self._cycle.run(self.iteration, share)
        self._schedule_share = share
        self._run.iteration += 1

    @property
    def saved_rule(self) -> NPARule:
        """The rule as it is saved: with the encoder's current codes in its table."""
        rule = self.rule
        codes = getattr(rule, "codes", None)
        if codes is not None and codes.encoder is not None:
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
        self._finish_record()
        self._stop_if_diverged()
        self._ranks.check_same(list(self.rule.parameters()))
        progress = {"iteration": self.iteration, "seconds": self._seconds()}
        state = {"rule": self.rule.state_dict(), **self._cycle.state_dict()}
        if not self._ranks.first:
            return
        self._run.keep(self._origin() | progress | state)
        # Rule files are shared with others: paths and device are left out.
        config = config_to_dict(self.config)
        for private in ("out", "device", "initial_rule"):
            del config[private]
        self._save_rule(self.saved_rule, config)

    def _save_rule(self, rule: NPARule, config: dict[str, Any]) -> None:
        metadata = {"task": self.task_name, "config": json.dumps(config)}
        metadata["iteration"] = str(self.iteration)
        save_rule(rule, self.folder.rule, metadata=metadata)

    def _origin(self) -> dict[str, Any]:
        return {
            "task_name": self.task_name,
            "config": config_to_dict(self.config),
            "rule_hyper_parameters": dict(self.rule.hyper_parameters()),
        }

    def _make_rule(self, generator: torch.Generator, saved: dict[str, Any] | None) -> NPARule:
        """Return the initial rule, or one with the hyper-parameters of a checkpoint."""
        untrained = self.task.make_rule(generator)
        return initial_rule(self.config, untrained) if saved is None else rule_like(saved)

    def _due(self, interval: int) -> bool:
        return interval > 0 and self.iteration % interval == 0

    def _seconds(self) -> float:
        running = 0.0 if self._started is None else time.perf_counter() - self._started
        return self._seconds_before + running

    def _begin_record(self) -> None:
        """Begin the log record of the interval that ends with this iteration."""
        self._cycle.meter.send()
        self._begun_record = {
            "iteration": self.iteration,
            "learning_rate": self.config.learning_rate_at(self.iteration - 1, self._schedule_share),
        }
        if not self._defer_records:
            self._finish_record()

    def _finish_record(self) -> None:
        begun, self._begun_record = self._begun_record, None
        if begun is None:
            return
        interval = self._cycle.meter.receive()
        if interval.bad_iteration is not None:
            self._stop_if_diverged()
        self._record = {
            "iteration": begun["iteration"],
            **interval.means,
            "learning_rate": begun["learning_rate"],
            "seconds": round(self._seconds(), 3),
        }
        if self._ranks.first:
            self._log.append(self._record)
        if self._board is not None:
            for name, value in self._record.items():
                if name != "iteration":
                    self._board.add_scalar(name, value, begun["iteration"])

    def _write_picture(self) -> None:
        self._finish_record()
        if not self._ranks.first:
            return
        with torch.no_grad():
            end = self._cycle.batch.end
            picture = self._cycle.task.picture(end.x, end.s)
        # Worlds with different goals have no common target picture.
        target = getattr(self.task, "target_picture", None) if end.goal is None else None
        if target is not None:
            picture = torch.cat((target[None].to(picture), picture))
        path = self.folder.picture(self.iteration)
        write_batch_picture(path, picture, self._board, self.iteration)

    def _stop_if_diverged(self) -> None:
        meter = self._cycle.meter
        if meter.bad_iteration() is None:
            return
        snapshot = meter.snapshot()
        for name in snapshot.keys() & {"x0", "s0", "x", "s", "goal"}:
            snapshot[name] = self._ranks.collected(snapshot[name], section=1)
        error = None
        if self._ranks.first:
            error = divergence_error(self.task, self.rule, snapshot, self.folder.diagnosis)
            try:
                save_checkpoint(self.folder.diagnosis, self._origin() | snapshot)
            except NPAError as other:
                error = DivergedError(f"{error}; but these were not written: {other}")
        error = self._ranks.broadcast(error)
        assert error is not None, "made by the first process"
        raise error

    def _restore(self, content: dict[str, Any]) -> None:
        path = self.folder.checkpoint
        self._run.iteration = content["iteration"]
        expected = {"rule": self.rule.state_dict(), **self._cycle.state_like(self.iteration)}
        read = dict(content)
        if self._ranks.together:
            # The generators of a run of one process are not read.
            states = content["random_states"]
            read["random_states"] = {name: states.get(name) for name in expected["random_states"]}
        check_content(read, expected, path)
        self._seconds_before = content["seconds"]
        self.rule.load_state_dict(content["rule"])
        try:
            self._cycle.load_state_dict(content, self.iteration)
        except RuntimeError as error:
            # Only a generator can check its state.
            raise unusable_checkpoint(path, f"random_states cannot be used ({error})") from error
        if self._ranks.first:
            self._log.truncate(self.iteration)


def check_seconds(max_seconds: object) -> None:
    """Check a time limit [s]; raises NPAError."""
    if max_seconds is None or max_seconds == math.inf:
        return
    if not is_real(max_seconds) or max_seconds < 0:  # type: ignore[operator]
        raise NPAError(
            f"max_seconds must be a number of at least 0, or None for no limit, got "
            f"{shown(max_seconds)}: try 60"
        )


def rule_like(saved: dict[str, Any]) -> NPARule:
    """Return a rule with a checkpoint's hyper-parameters, on the CPU, with random weights."""
    try:
        return untrained_rule(torch.Generator(), **saved)
    except (TypeError, RuntimeError, OverflowError) as error:
        raise NPAError(
            f"no rule has the hyper-parameters {shown(saved)} of the checkpoint: it is damaged, or "
            "of another version"
        ) from error


def take_options(rule: NPARule, config: TrainConfig[Any]) -> None:
    """Set an untrained rule's `moment_inverse` and `dead_zone` from the configuration."""
    rule.moment_inverse = config.moment_inverse
    rule.dead_zone = 0.0 if rule.equivariant else config.dead_zone


def initial_rule(config: TrainConfig[Any], untrained: NPARule) -> NPARule:
    """Return the rule that a run starts from, in the form of the task's untrained one.

    A rule without division or codes may initialise one with them. An equivariant rule has no dead
    zone, and starts from random weights where the configuration names one of `preset_rules`, which
    are not equivariant.
    """
    take_options(untrained, config)
    if not config.initial_rule or (untrained.equivariant and config.initial_rule in preset_rules()):
        return untrained
    source = config.initial_rule
    rule = load_rule(source)
    if untrained.code_dim and not rule.code_dim:
        rule = with_codes(rule, untrained)
    if rule.moment_inverse == "threshold":
        rule.moment_inverse = config.moment_inverse
    rule.dead_zone = untrained.dead_zone
    if untrained.divides and not rule.divides:
        rule = dividing(rule)
    wrong = differing_fields(rule, untrained)
    if rule.codes is not None and untrained.codes is not None:
        names, expected = rule.codes.names, untrained.codes.names
        if names != expected:
            raise NPAError(
                f"initial_rule must have codes of the run's targets, in their order, but "
                f"{shown(source)} has those of {shown(', '.join(names))}, not of "
                f"{shown(', '.join(expected))}: give these targets, or start from a rule without "
                "codes, or from random weights (initial_rule='')"
            )
    if wrong:
        theirs, ours = rule.hyper_parameters(), untrained.hyper_parameters()
        differences = [
            f"{'eps0, the eps it learned at' if name == 'eps0' else name} "
            f"({shown(theirs.get(name))}, here {shown(ours.get(name))})"
            for name in wrong
        ]
        raise NPAError(
            f"initial_rule must be a rule of the task's shape, but {shown(source)} differs in "
            f"{', '.join(differences)}: change those fields, start from another rule, or from "
            "random weights (initial_rule='')"
        )
    return rule


JOINT_TASK_NAME = "co_morphogenesis2d"
"""Name of the task of several rules in checkpoints."""


class JointRules(nn.Module):
    """The rules of one world, one for each species, as a module that the trainer trains."""

    def __init__(self, rules: Sequence[NPARule]) -> None:
        super().__init__()
        self.rules = nn.ModuleList(rules)

    def __iter__(self) -> Any:
        return iter(self.rules)

    def hyper_parameters(self) -> dict[str, Any]:
        """Return the hyper-parameters of all rules, for checkpoints."""
        return {"rules": [dict(rule.hyper_parameters()) for rule in self]}


class _JointTrainer(Trainer):
    """`Trainer` of several rules, each of which is saved in its own file."""

    def __init__(
        self,
        task: CoMorphogenesis2D,
        config: TrainConfig[CoMorphogenesis2DConfig],
        rules: Sequence[NPARule] | None,
        *,
        resume: bool,
        overwrite: bool,
    ) -> None:
        sources: tuple[str, ...] = getattr(config, "initial_rules", ())
        if rules is None and sources and not resume:
            rules = [load_rule(source) for source in sources]
        self._initial_rules, counts = rules, task.config.counts

        def rollout(
            rule: NPARule, x: Tensor, s: Tensor, steps: int, /, **options: Unpack[TrainingOptions]
        ) -> tuple[Tensor, ...]:
            each = list(cast(JointRules, rule))
            return rollout_species(
                each, x, s, steps, counts=counts, density_counts=counts, **options
            )

        super().__init__(
            task,
            config,
            task_name=JOINT_TASK_NAME,
            resume=resume,
            overwrite=overwrite,
            rollout=rollout,
        )

    def _make_rule(self, generator: torch.Generator, saved: dict[str, Any] | None) -> NPARule:
        # The trainer uses its rule only as a module with hyper-parameters.
        untrained = cast(CoMorphogenesis2D, self.task).make_rules(generator)
        for rule in untrained:
            take_options(rule, self.config)
        if saved is not None:
            self._initial_rules = [rule_like(own) for own in saved.get("rules", ())]
        frozen: tuple[int, ...] = getattr(self.config, "frozen", ())
        if self._initial_rules is None:
            if frozen:
                raise NPAError(
                    f"frozen must name rules that were trained before, got {frozen} without "
                    "initial_rules: give one for each species"
                )
            return cast(NPARule, JointRules(untrained))
        rules = copy.deepcopy(list(self._initial_rules))
        if len(rules) != len(untrained):
            raise NPAError(
                f"rules must be one for each of {len(untrained)} species, got {len(rules)}"
            )
        for number, (rule, own) in enumerate(zip(rules, untrained, strict=True)):
            if rule.moment_inverse == "threshold":
                rule.moment_inverse = self.config.moment_inverse
            own.dead_zone = rule.dead_zone
            wrong = differing_fields(rule, own)
            if wrong:
                raise NPAError(
                    f"rules must have the shape of their species, but rule {number} differs in "
                    f"{', '.join(wrong)}: change those fields of species {number}"
                )
        if frozen and max(frozen) >= len(rules):
            raise NPAError(
                f"frozen must name species from 0 to {len(rules) - 1}, got {shown(max(frozen))}"
            )
        for number in frozen:
            rules[number].requires_grad_(False)
        if not any(p.requires_grad for rule in rules for p in rule.parameters()):
            raise NPAError("frozen must leave a rule that learns, got all of them: leave one out")
        return cast(NPARule, JointRules(rules))

    def _save_rule(self, rule: NPARule, config: dict[str, Any]) -> None:
        for number, one in enumerate(cast(JointRules, rule)):
            own = {name: config[name] for name in config if name not in ("initial_rules", "frozen")}
            own["task"] = config["task"]["species"][number]
            metadata = {"task": "morphogenesis2d", "config": json.dumps(own)}
            metadata |= {"iteration": str(self.iteration), "trained_in": JOINT_TASK_NAME}
            save_rule(one, self.folder.rule_of(number), metadata=metadata)


def train_together(
    config: TrainConfig[CoMorphogenesis2DConfig],
    rules: Sequence[NPARule] | None = None,
    *,
    resume: bool = False,
    overwrite: bool = False,
    progress: bool = True,
    max_seconds: float | None = None,
    begun: Callable[[], None] = lambda: None,
) -> TrainResult:
    """Train one rule for each species of a common world.

    Each rule perceives densities divided by the number of its own particles, as it would alone. A
    rule whose parameters do not require gradients does not change.

    Args:
        config: The run's configuration, for example `preset("fast", "co_morphogenesis2d")` or
            `TrainConfig(task=CoMorphogenesis2DConfig())`.
        rules: Initial rules, one for each species; copied. None: the configuration's
            `initial_rules`, or untrained ones.
        resume: Continue from the checkpoint in `config.out`; give the same `rules` again.
        overwrite: As of `train`, like `progress`, `max_seconds` and `begun`.

    Returns:
        The result; its `rule` is a `JointRules`, in the order of the species. Their files
        are `rule-0.safetensors`, `rule-1.safetensors`, ... in `config.out`.

    Raises:
        NPAError: Rules do not fit the species, a target cannot be loaded, or as for `Trainer`.
        DivergedError: The loss is not finite.
    """
    if config.initial_rule:
        raise NPAError(
            f"initial_rule is for one rule, got {shown(config.initial_rule)}: give one for each "
            "species as rules"
        )
    task = CoMorphogenesis2D(config.task, device=check_device(config.device))
    trainer = _JointTrainer(task, config, rules, resume=resume, overwrite=overwrite)
    begun()
    return trainer.run(progress=progress, max_seconds=max_seconds)
