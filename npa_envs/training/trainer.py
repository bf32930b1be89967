"""The trainer: one iteration after another, and everything that a run leaves behind."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from npa_envs.devices import check_device
from npa_envs.errors import NPAError
from npa_envs.files import write_text
from npa_envs.rule.files import save_rule
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import Task
from npa_envs.tasks.train_config import TrainConfig
from npa_envs.training.checkpoint import check_same_run, load_checkpoint, save_checkpoint
from npa_envs.training.cycle import TrainingCycle
from npa_envs.training.divergence import divergence_error
from npa_envs.training.folder import JsonlLog, RunFolder, open_tensorboard
from npa_envs.training.graphs import Rollout
from npa_envs.training.initial import initial_rule
from npa_envs.training.interrupt import stop_flag
from npa_envs.training.overrides import config_to_dict
from npa_envs.training.pictures import write_batch_picture


@dataclass(frozen=True)
class TrainResult:
    """What a run came to."""

    rule: NPARule
    """The rule as it stands."""

    iteration: int
    """Iterations done."""

    finished: bool
    """Whether these were all of them; if not, the run was stopped and can be resumed."""

    interrupted: bool
    """Whether Ctrl-C or SIGTERM stopped it."""

    record: dict[str, Any]
    """The last line of the log: loss terms (means over the interval), learning rate, seconds."""

    folder: Path
    """Where log, pictures, checkpoint and rule lie."""


class Trainer:
    """Trains a rule on a task.

    Args:
        task: What to learn.
        config: How.
        task_name: The task's name, which checkpoints hold.
        resume: Go on from the checkpoint in `config.out`.
        overwrite: Start anew although `config.out` holds a run; its files are removed.
        rollout: The rollout to train through; None is the engine's for one rule.

    Raises:
        NPAError: There is no such device; the folder cannot be written to, holds a run already
            (without `resume` or `overwrite`), or holds one of another task or configuration.
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
    ) -> None:
        self.task = task
        self.config = config
        self.task_name = task_name
        self.iteration = 0
        """Iterations done."""
        self.folder = RunFolder(config.out)
        self._log = JsonlLog(self.folder.log)
        self._record: dict[str, Any] = {}
        self._record_begun: dict[str, Any] | None = None
        self._board: Any = None
        self._seconds_before = 0.0
        self._started: float | None = None
        content = self._open_folder(resume=resume, overwrite=overwrite)

        device = check_device(config.device)
        # While the host waits for the numbers, a GPU would have nothing to do; a CPU has done all.
        self._log_late = device.type == "cuda"
        schedule = torch.Generator().manual_seed(config.seed)
        self.rule = self._make_rule(schedule).to(device, config.torch_dtype)
        self._cycle = TrainingCycle(task, self.rule, config, device, schedule, rollout)
        self.pool = self._cycle.pool
        rule_bytes = sum(p.nbytes for p in self.rule.parameters())
        self.folder.prepare(self.pool.x.nbytes + self.pool.s.nbytes + 16 * rule_bytes)
        if content is not None:
            self._restore(content)
        else:
            if overwrite:
                self.folder.clear()
            # From the start, so that a run killed early can be resumed, and a disk that is too
            # full is noticed now.
            self.save()
        write_text(self.folder.config, json.dumps(config_to_dict(config), indent=2) + "\n")

    def run(self, *, progress: bool = True, max_seconds: float | None = None) -> TrainResult:
        """Train until the end, or until Ctrl-C, SIGTERM or `max_seconds`; then save.

        Args:
            progress: Show a progress bar.
            max_seconds: Stop after this time [s]; the run can be resumed.

        Raises:
            DivergedError: The loss is not finite.
            NPAError: A file cannot be written; the last checkpoint is intact.
        """
        config = self.config
        start = self._started = time.perf_counter()
        self._record = next(iter(self._log.records()[-1:]), {})
        if config.tensorboard:
            self._board = open_tensorboard(self.folder, self.iteration)
        total = config.total_iterations
        bar = tqdm(total=total, initial=self.iteration, disable=not progress, unit="it")
        try:
            with stop_flag() as flag:
                while self.iteration < total:
                    if flag.requested:
                        break
                    if max_seconds is not None and time.perf_counter() - start >= max_seconds:
                        break
                    self._iterate()
                    # Of the iteration before: meanwhile the device has this one to do.
                    self._finish_record()
                    if self._due(config.log_interval) or self.iteration == total:
                        self._begin_record()
                    if self._due(config.picture_interval):
                        self._write_picture()
                    if self._due(config.checkpoint_interval) and self.iteration < total:
                        self.save()
                    bar.update()
                    if self._record:
                        bar.set_postfix(loss=f"{self._record['loss']:.4g}", refresh=False)
                self.save()
        finally:
            bar.close()
            if self._board is not None:
                self._board.close()
                self._board = None
        return TrainResult(
            self.rule,
            self.iteration,
            self.iteration >= total,
            flag.requested,
            self._record,
            self.folder.path,
        )

    def save(self) -> None:
        """Write the checkpoint and the rule.

        Raises:
            DivergedError: The loss was not finite in an iteration before; nothing is written.
            NPAError: A file cannot be written; the last checkpoint is intact.
        """
        self._finish_record()
        self._stop_if_diverged()
        save_checkpoint(
            self.folder.checkpoint,
            {
                "task_name": self.task_name,
                "config": config_to_dict(self.config),
                "iteration": self.iteration,
                "seconds": self._seconds(),
                "rule": self.rule.state_dict(),
                "rule_hyper_parameters": dict(self.rule.hyper_parameters()),
                **self._cycle.state_dict(),
            },
        )
        # A rule is passed on: where and on what it was trained is nobody's business.
        told = config_to_dict(self.config)
        told = {name: told[name] for name in told if name not in ("out", "device", "initial_rule")}
        self._save_rule(told)

    def _save_rule(self, told: dict[str, Any]) -> None:
        metadata = {"task": self.task_name, "config": json.dumps(told)}
        metadata["iteration"] = str(self.iteration)
        save_rule(self.rule, self.folder.rule, metadata=metadata)

    def _iterate(self) -> None:
        self._cycle.run(self.iteration)
        self.iteration += 1

    def _make_rule(self, generator: torch.Generator) -> NPARule:
        return initial_rule(self.config, self.task.make_rule(generator))

    def _due(self, interval: int) -> bool:
        return interval > 0 and self.iteration % interval == 0

    def _seconds(self) -> float:
        running = 0.0 if self._started is None else time.perf_counter() - self._started
        return self._seconds_before + running

    def _begin_record(self) -> None:
        """Ask the device for what the log is to say of the interval that ends here."""
        self._cycle.meter.send()
        self._record_begun = {
            "iteration": self.iteration,
            "learning_rate": self.config.learning_rate_at(self.iteration - 1),
        }
        if not self._log_late:
            self._finish_record()

    def _finish_record(self) -> None:
        """Write the record that was begun, if there is one.

        Raises:
            DivergedError: The loss was not finite in the interval.
            NPAError: The log cannot be written.
        """
        begun, self._record_begun = self._record_begun, None
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
        self._log.append(self._record)
        if self._board is not None:
            for name, value in self._record.items():
                if name != "iteration":
                    self._board.add_scalar(name, value, begun["iteration"])

    def _write_picture(self) -> None:
        self._finish_record()
        with torch.no_grad():
            picture = self._cycle.task.picture(self._cycle.batch.x, self._cycle.batch.s)
        path = self.folder.picture(self.iteration)
        write_batch_picture(path, picture, self._board, self.iteration)

    def _stop_if_diverged(self) -> None:
        meter = self._cycle.meter
        if meter.bad_iteration() is None:
            return
        snapshot = meter.snapshot()
        diagnosis = self.folder.diagnosis
        hyper_parameters = dict(self.rule.hyper_parameters())
        save_checkpoint(
            diagnosis,
            {
                "task_name": self.task_name,
                "config": config_to_dict(self.config),
                "rule_hyper_parameters": hyper_parameters,
                **snapshot,
            },
        )
        raise divergence_error(self.task, self.rule, snapshot, diagnosis)

    def _open_folder(self, *, resume: bool, overwrite: bool) -> dict[str, Any] | None:
        path = self.folder.checkpoint
        if resume:
            content = load_checkpoint(path)
            check_same_run(content, self.task_name, self.config, path)
            return content
        if path.exists() and not overwrite:
            raise NPAError(
                f"out must be a folder without a run, but {str(self.folder.path)!r} holds one: "
                "resume it, choose another folder, or overwrite it"
            )
        return None

    def _restore(self, content: dict[str, Any]) -> None:
        self.iteration = content["iteration"]
        self._seconds_before = content["seconds"]
        self.rule.load_state_dict(content["rule"])
        self._cycle.load_state_dict(content)
        self._log.truncate(self.iteration)
