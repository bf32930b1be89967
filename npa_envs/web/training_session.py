"""The training that a page starts from a dropped file: its processes, its progress, its world."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import secrets
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from npa_envs.atomic_files import made_folder, read_json, write_bytes
from npa_envs.errors import NPAError
from npa_envs.measure.process_queue import PARENT_GRACE, PARENT_PIPE
from npa_envs.measure.quality import psnr_on_white
from npa_envs.rule.files import rule_metadata
from npa_envs.training.run_folder import JsonlLog, RunFolder
from npa_envs.training.task_of_rule import trained_config
from npa_envs.training.task_table import task_entry
from npa_envs.web.dropped_file import EMOJI, MAX_BYTES, PICTURE, READ_SECONDS, stored_name
from npa_envs.web.export import page_rule, page_text
from npa_envs.web.messages import TrainingEvent, WorldEvent
from npa_envs.web.rule_world import RunWorld

CHECKPOINTS = {False: 25, True: 200}
"""Iterations between two checkpoints without and with CUDA: a few seconds."""


class Training:
    """What a server trains from dropped files: one run at a time, in a process of its own.

    All pages of the server share it. Each run has a new folder, whose name is made of time and
    chance. Its processes end with the server, also if that is killed (see `end_with_parent`).

    Args:
        folder: Folder in which runs get their folders.
        device: Device to train on.
        preset: Preset of the run; None: `best` on CUDA where the task has it, else `fast`.
    """

    def __init__(self, folder: Path, *, device: str = "cpu", preset: str | None = None) -> None:
        self._folder, self._device, self._preset = folder, device, preset
        self._lock = threading.Lock()
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self.report: TrainingEvent = {"type": "training", "state": "none", "limit": MAX_BYTES}
        """The event for pages; a new object after each change."""
        self._learned: Any = None  # The report of the last run that left a rule.

    @property
    def active(self) -> bool:
        """Whether a file is being read or learned."""
        return self.report["state"] in ("reading", "starting", "learning")

    @property
    def slows_worlds(self) -> bool:
        """Whether worlds should leave the processor to the training."""
        return self.active and self._device == "cpu"

    def begin(self, name: str, content: bytes, *, emoji: bool = False, whole: bool = False) -> str:
        """Begin to read and learn a file, and return the run's id.

        The name is shown, and its suffix tells meshes from pictures. The content is the file's, or
        with `emoji` an emoji in UTF-8. With `whole` a picture keeps its background. NPAError if
        another training runs, or the file is empty, too large or cannot be stored.
        """
        shown_name = "".join(c for c in name if c.isprintable())[:80].strip() or "picture"
        with self._lock:
            if self.active:
                raise NPAError(
                    f"one file is learned at a time, and {self.report['name']} still is: stop it "
                    "first, or wait for its end"
                )
            if not 0 < len(content) <= MAX_BYTES:
                raise NPAError(
                    f"a dropped file must have 1 byte to {MAX_BYTES >> 20} MiB, got "
                    f"{len(content)} bytes: give another one"
                )
            # Random, as several servers may share the folder.
            run = self._folder / f"{time.strftime('learned-%Y%m%d-%H%M%S')}-{secrets.token_hex(3)}"
            stored = run / (EMOJI if emoji else stored_name(name))
            with made_folder(run):
                write_bytes(stored, content)
            self._stopping.clear()
            self.report = {
                "type": "training", "state": "reading", "limit": MAX_BYTES, "id": run.name,
                "name": shown_name, "folder": str(run), "note": "", "has_rule": False,
            }  # fmt: skip
            self._thread = threading.Thread(
                target=self._run, args=(stored, whole), name="npa-envs training", daemon=True
            )
            self._thread.start()
        return run.name

    def stop(self) -> None:
        """Let the present training save what it has learned, and end."""
        self._stopping.set()

    def close(self) -> None:
        """Stop the present training, and wait until its processes have ended."""
        self.stop()
        if self._thread is not None:
            self._thread.join(2.0 * PARENT_GRACE)

    def file(self, run_id: str, name: str) -> Path | None:
        """Return a file of the latest run: the picture it learns, its rule, or its page, made now.

        None: there is no such run, or it has no such file yet. Raises NPAError if the rule cannot
        run in a page.
        """
        report = self.report
        if run_id != report.get("id"):
            return None
        if name == report.get("picture"):
            return Path(report["folder"], name)
        if not report.get("has_rule"):
            return None
        rule = RunFolder(Path(report["folder"])).rule
        if name != "page.html":
            return rule if name == rule.name else None
        shown_rule = page_rule(str(rule))
        title = report["name"]
        shown_rule |= {"name": title, "world": shown_rule["world"] | {"title": title, "note": ""}}
        path = rule.with_name(name)
        write_bytes(path, page_text([shown_rule], title=title).encode())
        return path

    def _set(self, **fields: Any) -> None:
        report: Any = self.report | fields
        if report != self.report:
            self.report = report

    def _end(self, state: str, **fields: Any) -> None:
        """Report the end of a run; one that leaves no rule gives way to the last one that did."""
        if state == "stopped" and not self.report["has_rule"]:
            fields["message"] = "Stopped before anything was learned."
        report: Any = self.report | {"state": state} | fields
        if report["has_rule"]:
            self._learned = report
        elif self._learned:
            report = self._learned | {"refused": report["name"]} | fields
        self.report = report

    def _run(self, stored: Path, whole: bool) -> None:
        try:
            self._read_and_learn(stored, whole)
        except Exception as error:
            message = str(error).replace(str(stored), self.report["name"])
            cured = "keep_background" in message and not whole
            self._end("failed", message=message, **({"cure": "whole"} if cured else {}))
        # Not by the report, which may already be that of the next run.
        if not RunFolder(stored.parent).rule.exists():
            shutil.rmtree(stored.parent, ignore_errors=True)

    def _read_and_learn(self, stored: Path, whole: bool) -> None:
        folder = stored.parent
        words = ["npa_envs.web.dropped_file", str(stored), *(["whole"] if whole else [])]
        output = self._call(words, folder, "reading the file", seconds=READ_SECONDS)
        if self._stopping.is_set():
            return self._end("stopped")
        flat = (folder / PICTURE).exists()
        note = output.removeprefix(f"{stored.name}: ").strip()
        task = "morphogenesis2d" if flat else "morphogenesis3d"
        target = folder / PICTURE if flat else stored
        text = stored.read_text("utf-8") if stored.name == EMOJI else target
        entry = task_entry(task)
        cuda = self._device != "cpu"
        best = cuda and "best" in entry.presets
        preset = self._preset or ("best" if best else "fast")
        found = {"picture": PICTURE} if flat else {}
        config = dataclasses.replace(entry.presets[preset], device=self._device)
        expected = entry.expected_seconds(config)
        self._set(state="starting", note=note, preset=preset, expected=expected, **found)
        self._call(
            [
                "npa_envs", "train", task, f"--target={text}", f"--out={folder}",
                f"--preset={preset}",
                f"--device={self._device}", f"--checkpoint-interval={CHECKPOINTS[cuda]}",
                "--picture-interval=0", "--no-tensorboard", "--no-progress", "--no-report",
                *(["--keep-background"] if whole and flat else []),
            ],
            folder,
            "the training",
        )  # fmt: skip
        self._look(folder)
        self._end("stopped" if self._stopping.is_set() else "done", seconds_left=0.0)

    def _call(
        self, words: list[str], folder: Path, what: str, *, seconds: float | None = None
    ) -> str:
        """Run a module of the package until its end, or until it is stopped; return its output.

        Raises NPAError, which calls it `what`, if it fails or takes longer than `seconds`.
        """
        path = folder / "output.txt"
        options: dict[str, Any] = {
            "stdin": subprocess.PIPE, "stderr": subprocess.STDOUT,
            "env": os.environ | {PARENT_PIPE: "1", "PYTHONIOENCODING": "utf-8"},
            # Ctrl-C is for the server, which then stops the training.
            "start_new_session": True,
        }  # fmt: skip
        command = [sys.executable, "-m", *words]
        begun = time.monotonic()
        with path.open("wb") as file, subprocess.Popen(command, stdout=file, **options) as process:
            try:
                while process.poll() is None and not self._stopping.wait(0.05 if seconds else 0.25):
                    if seconds is not None and time.monotonic() > begun + seconds:
                        raise NPAError(f"{what} must take at most {seconds} s: give a smaller file")
                    self._look(folder)
            finally:
                # It may save; after some time it is killed.
                assert process.stdin is not None, "it was opened as a pipe"
                process.stdin.close()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(PARENT_GRACE + 2.0)
                process.kill()
        output = path.read_text("utf-8", errors="replace")
        if process.returncode and not self._stopping.is_set():
            _, found, error = output.rpartition("npa-envs: error: ")
            what += f" ended with code {process.returncode} (-9 is often a lack of memory)"
            last = output.strip().rpartition("\n")[2] or "try a smaller file"
            raise NPAError(error.strip() if found else f"{what}: {last}")
        return output

    def _look(self, folder: Path) -> None:
        """Read the run's progress from its files."""
        run = RunFolder(folder)
        if not run.rule.exists():
            return
        if not self.report["has_rule"]:
            config = read_json(run.config)
            total = config["iterations"] * config["repeats"]
            self._set(state="learning", has_rule=True, iteration=0, total=total)
        with contextlib.suppress(NPAError):  # A line that is being written.
            # The last ones say how long the rest takes.
            records = JsonlLog(run.log).records()[-20:]
            if records:
                first, last = records[0], records[-1]
                self._set(**{name: last[name] for name in ("iteration", "loss", "seconds")})
            if len(records) > 1:
                done, seconds = (last[name] - first[name] for name in ("iteration", "seconds"))
                left = self.report["total"] - last["iteration"]
                self._set(seconds_left=round(seconds / done * left, 1))


# The world of a training.

GROWN, OLD = 3, 4
"""Ages, in longest rollouts of the training, from which a world is compared with its picture, and
begins again: early rules lead worlds to where later ones never are."""

OUTSIDE = 0.03
"""Fraction of particles outside of the view from which a world begins again."""


class LearningWorld(RunWorld):
    """The world of the latest run of a training; it begins again and again while that learns."""

    def __init__(self, training: Training, *, device: torch.device) -> None:
        self._training = training
        self._title, self._run_id = training.report["name"], training.report["id"]
        self._psnr: float | None = None
        self._end_awaited = True
        self._touched = 0
        super().__init__(Path(training.report["folder"]), device=device, name=self._title)
        config = trained_config(rule := self._run_folder.rule, rule_metadata(rule))
        self._rollout_steps, self._longest_life = config.steps[1], config.max_age_range[1]
        self.speed = 2

    @property
    def learns(self) -> bool:
        """Whether its rule is still being trained."""
        return self._training.active and self._training.report["id"] == self._run_id

    def describe(self) -> WorldEvent:
        """Return the event "world" for the page, with the dropped file's name as title."""
        described = super().describe() | {"title": self._title, "note": ""}
        # The plot of the training's loss says more than that of a world that begins again.
        return described | ({"capabilities": ["film"]} if self.learns else {})

    def handle(self, message: Mapping[str, Any]) -> bool:
        """Apply a message of the page; what a hand has done is seen for another life."""
        if message.get("type") in ("brush", "damage"):
            self._touched = self.step
        return super().handle(message)

    def _begin(self, seed: int | None) -> None:
        super()._begin(seed)
        self._touched = 0
        # The page's tracers follow particles by their index.
        self._events.append({"type": "reordered"})

    def _run(self, steps: int) -> None:
        super()._run(steps)
        if not self.learns:
            return
        report, frame, x = self._training.report, self.task.frame, self.particles.x[0]
        # The better the rule, the longer it is watched.
        share = report.get("iteration", 0) / report.get("total", 1)
        life = max(OLD * self._rollout_steps, share * self._longest_life)
        strays = ((x - x.new_tensor(frame.centre)).abs() > frame.half_width).any(dim=-1)
        if self.step - self._touched >= life or float(strays.float().mean()) > OUTSIDE:
            self.reset(self.seed)

    def _poll(self) -> None:
        # Asked first: after the end no rule comes.
        ended = self._end_awaited and not self.learns
        super()._poll()
        if ended:
            self._end_awaited = False
            self.reset(self.seed)
            self._events.append(self.describe())
        if self.step < GROWN * self._rollout_steps or not self._is_unchanged():
            return
        value = round(float(psnr_on_white(self.task, *self.particles[:2]).mean()), 1)
        if value != self._psnr:
            self._psnr = value
            self._events.append({"type": "psnr", "value": value})
