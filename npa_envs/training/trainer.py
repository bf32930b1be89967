"""The trainer: pool, rollout, loss, optimiser, and everything that a run leaves behind."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from npa_envs.devices import check_device
from npa_envs.errors import NPAError
from npa_envs.files import write_text
from npa_envs.rule import NPARule
from npa_envs.rule_io import load_rule, save_rule
from npa_envs.tasks.task import Task
from npa_envs.training.checkpoint import check_same_run, load_checkpoint, save_checkpoint
from npa_envs.training.config import TrainConfig
from npa_envs.training.divergence import divergence_error
from npa_envs.training.folder import JsonlLog, RunFolder, open_tensorboard
from npa_envs.training.graphs import EagerIteration, GraphedIteration, Rollout
from npa_envs.training.interrupt import stop_flag
from npa_envs.training.meter import LossMeter
from npa_envs.training.optimiser import RuleOptimiser
from npa_envs.training.overrides import config_to_dict
from npa_envs.training.pictures import write_batch_picture
from npa_envs.training.pool import WorldPool


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
        rollout: The rollout to train through; another one than the engine's only in tests.

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
        self._seconds_before = 0.0
        self._started: float | None = None
        content = self._open_folder(resume=resume, overwrite=overwrite)

        device = check_device(config.device)
        self._schedule_generator = torch.Generator().manual_seed(config.seed)
        self._world_generator = torch.Generator(device).manual_seed(config.seed + 1)
        self._mask_generator = torch.Generator(device).manual_seed(config.seed + 2)
        self.rule = self._make_rule().to(device, config.torch_dtype)
        x, s = self._seeds(config.pool_size)
        self.pool = WorldPool(x, s, runaway_limit=config.runaway_limit)
        graphed = device.type == "cuda" and config.cuda_graph
        self._batch: EagerIteration = (GraphedIteration if graphed else EagerIteration)(
            task,
            self.rule,
            config,
            x[: config.world_count],
            s[: config.world_count],
            self._mask_generator,
            rollout,
        )
        self._optimiser = RuleOptimiser(self._batch.parameters, config)
        self._meter = LossMeter(self._batch)
        pool_bytes = x.nbytes + s.nbytes
        self.folder.prepare(pool_bytes + 16 * sum(p.nbytes for p in self._batch.parameters))
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
        records = self._log.records()
        record = records[-1] if records else {}
        board = open_tensorboard(self.folder, self.iteration) if config.tensorboard else None
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
                    bar.update()
                    if self._due(config.log_interval) or self.iteration == total:
                        record = self._write_log(board)
                        bar.set_postfix(loss=f"{record['loss']:.4g}", refresh=False)
                    if self._due(config.picture_interval):
                        self._write_picture(board)
                    if self._due(config.checkpoint_interval) and self.iteration < total:
                        self.save()
                self.save()
        finally:
            bar.close()
            if board is not None:
                board.close()
        return TrainResult(
            self.rule,
            self.iteration,
            self.iteration >= total,
            flag.requested,
            record,
            self.folder.path,
        )

    def save(self) -> None:
        """Write the checkpoint and the rule.

        Raises:
            DivergedError: The loss was not finite in an iteration before; nothing is written.
            NPAError: A file cannot be written; the last checkpoint is intact.
        """
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
                "optimiser": self._optimiser.state_dict(),
                "pool": {"x": self.pool.x, "s": self.pool.s},
                "meter": self._meter.state_dict(),
                "random_states": {n: g.get_state() for n, g in self._generators().items()},
            },
        )
        # A rule is passed on: where and on what it was trained is nobody's business.
        told = config_to_dict(self.config)
        told = {name: told[name] for name in told if name not in ("out", "device", "initial_rule")}
        metadata = {
            "task": self.task_name,
            "config": json.dumps(told),
            "iteration": str(self.iteration),
        }
        save_rule(self.rule, self.folder.rule, metadata=metadata)

    def _iterate(self) -> None:
        config, batch = self.config, self._batch
        lo, hi = config.steps
        steps = int(torch.randint(lo, hi, (), generator=self._schedule_generator))
        index = self.pool.sample(config.world_count, self._world_generator)
        x0, s0 = self.pool.read(index)
        if config.damage:
            x0, s0 = self.task.damage(x0, s0, self._world_generator)
        fresh_x, fresh_s = self._seeds(config.world_count)
        if self.iteration % config.seed_interval == 0:
            x0[0], s0[0] = fresh_x[0], fresh_s[0]
        batch.x0.copy_(x0)
        batch.s0.copy_(s0)
        batch.run(steps)
        replaced = self.pool.write(index, batch.x, batch.s, fresh_x, fresh_s)
        self._meter.observe(self.iteration + 1, steps, replaced)
        self._optimiser.step(self.iteration)
        self.iteration += 1

    def _make_rule(self) -> NPARule:
        rule = self.task.make_rule(self._schedule_generator)
        if not self.config.initial_rule:
            return rule
        source = self.config.initial_rule
        initial = load_rule(source)
        wanted, given = rule.hyper_parameters(), initial.hyper_parameters()
        wrong = [name for name, value in given.items() if value != wanted.get(name)]
        if wrong:
            raise NPAError(
                f"initial_rule must be a rule of the task's shape, but {source!r} differs in "
                f"{', '.join(wrong)}: change those fields, or start from another rule"
            )
        return initial

    def _seeds(self, world_count: int) -> tuple[Tensor, Tensor]:
        device = self._world_generator.device
        x, s = self.task.seed(world_count, generator=self._world_generator, device=device)
        return x.to(self.config.torch_dtype), s.to(self.config.torch_dtype)

    def _due(self, interval: int) -> bool:
        return interval > 0 and self.iteration % interval == 0

    def _seconds(self) -> float:
        running = 0.0 if self._started is None else time.perf_counter() - self._started
        return self._seconds_before + running

    def _write_log(self, board: Any) -> dict[str, Any]:
        self._stop_if_diverged()
        record: dict[str, Any] = {
            "iteration": self.iteration,
            **self._meter.read(),
            "learning_rate": self.config.learning_rate_at(self.iteration - 1),
            "seconds": round(self._seconds(), 3),
        }
        self._meter.clear()
        self._log.append(record)
        if board is not None:
            for name, value in record.items():
                if name != "iteration":
                    board.add_scalar(name, value, self.iteration)
        return record

    def _write_picture(self, board: Any) -> None:
        with torch.no_grad():
            picture = self.task.picture(self._batch.x, self._batch.s)
        write_batch_picture(self.folder.picture(self.iteration), picture, board, self.iteration)

    def _stop_if_diverged(self) -> None:
        if self._meter.bad_iteration() is None:
            return
        snapshot = self._meter.snapshot()
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
        raise divergence_error(self.task, snapshot, diagnosis)

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
        self._optimiser.load_state_dict(content["optimiser"])
        self.pool.x.copy_(content["pool"]["x"])
        self.pool.s.copy_(content["pool"]["s"])
        self._meter.load_state_dict(content["meter"])
        for name, generator in self._generators().items():
            generator.set_state(content["random_states"][name])
        self._log.truncate(self.iteration)

    def _generators(self) -> dict[str, torch.Generator]:
        return {
            "schedule": self._schedule_generator,
            "worlds": self._world_generator,
            "masks": self._mask_generator,
        }
