"""Runs of learners that are kept in a folder: they can be stopped, and go on from a checkpoint."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor

from npa_envs.agents.learning.progress import CurvePoint, Learner, Progress
from npa_envs.agents.learning.rules import RuleSet
from npa_envs.checks import is_real
from npa_envs.errors import NPAError, shown
from npa_envs.files import json_text, write_text
from npa_envs.training.checkpoint import (
    check_content,
    load_checkpoint,
    save_checkpoint,
    unusable_checkpoint,
)
from npa_envs.training.run_folder import RunFolder, check_choice
from npa_envs.training.stopping import stop_flag
from npa_envs.world.randomness import WorldRandom


class KeptProgress(Progress):
    """The account of a run that is kept in a folder.

    With each entry of the curve, and where SIGTERM or Ctrl-C asks the run to stop, the first
    process writes a checkpoint, the rules, and the curve as `log.jsonl`. What goes on has the
    weights, the optimisers and the account of the checkpoint, on any number of processes, and
    begins new episodes.

    Args:
        folder: Where the run is kept.
        broadcast: What the run is of, as JSON has it: one that goes on must be of the same.
        resume: Go on from the checkpoint in the folder.
        overwrite: Begin anew although the folder holds a run; its files are removed.
        on_stop: Called where the run is asked to stop before its budget is spent.
        given: Arguments of `Progress`.

    Raises:
        NPAError: The folder holds a run, without `resume` or `overwrite`; or none, or another one,
            with `resume`. Or as for `Progress`.
    """

    def __init__(
        self,
        folder: RunFolder,
        told: Mapping[str, Any],
        *,
        resume: bool,
        overwrite: bool,
        on_stop: Callable[[], None] = lambda: None,
        **given: Any,
    ) -> None:
        super().__init__(**given)
        self._on_stop = on_stop
        self.folder = folder
        """Where the run is kept."""
        self._told = json.loads(json.dumps(told))
        self._overwrite = overwrite
        self._iteration = 0
        self._part = 0
        content = None
        if self.ranks.first:
            content = self._opened(resume)
        self._content: dict[str, Any] | None = self.ranks.broadcast(content)

    def run(
        self, rules: RuleSet, iteration: Callable[[], int], learner: Learner | None = None
    ) -> RuleSet:
        """Learn until the budget is spent, or until SIGTERM or Ctrl-C; as `Progress.run`.

        Raises:
            NPAError: The learner says nothing of itself; a file cannot be written; what lies in the
                folder cannot be used; or another run writes there.
        """
        assert learner is not None, "the methods whose runs are kept say what is to be kept"
        with self.folder.locked() if self.ranks.first else nullcontext():
            if self.ranks.first:
                self.folder.tidy()
            if self._content is not None:
                self._go_on(learner, self._content)
            elif self.ranks.first and self._overwrite:
                self.folder.clear()
            self._run(rules, iteration, learner)
        return rules

    def _run(self, rules: RuleSet, iteration: Callable[[], int], learner: Learner) -> None:
        with stop_flag(patient=self.ranks.together) as stop:
            self.start(rules)
            self._save(rules, learner)
            entries = len(self.log)
            while not self.over:
                if self.ranks.agree_to_stop(stop.is_set(), self._iteration):
                    self._on_stop()
                    break
                self.advance(iteration())
                self._iteration += 1
                self.look(rules)
                if len(self.log) > entries:
                    entries = len(self.log)
                    self._save(rules, learner)
            # What evaluates takes its time, and who asked to stop may not wait.
            self._save(rules, learner)
            self.look(rules, force=True)
            self._save(rules, learner)

    def _opened(self, resume: bool) -> dict[str, Any] | None:
        """Return the checkpoint to go on from, or None, once the folder is fit to be written to."""
        check_choice(resume=resume, overwrite=self._overwrite)
        folder, content = self.folder, None
        folder.note_checkpoint()
        if resume:
            content = load_checkpoint(folder.checkpoint)
            held = content.get("learner")
            if held != self._told:
                here = held if isinstance(held, dict) else {}
                names = [name for name in self._told if here.get(name) != self._told[name]]
                raise NPAError(
                    f"the checkpoint {str(folder.checkpoint)!r} must be of the same run, but "
                    f"differs in {', '.join(names)}: learn what it is of, or choose another folder"
                )
        elif folder.checkpoint.exists() and not self._overwrite:
            raise NPAError(
                f"out must be a folder without a run, but {shown(str(folder.path))} holds one: "
                "resume it, choose another folder, or overwrite it"
            )
        folder.prepare(0, pictures=False)
        return content

    def _save(self, rules: RuleSet, learner: Learner) -> None:
        """Write checkpoint, rules and curve, once all processes agree on what has learned.

        No time counts meanwhile.
        """
        with self._stopped_clock():
            self._write(rules, learner)

    def _write(self, rules: RuleSet, learner: Learner) -> None:
        state = learner_state(learner)
        learned = [value for held in state["modules"].values() for value in held.values()]
        self.ranks.check_same([value for value in learned if isinstance(value, Tensor)])
        if not self.ranks.first:
            return
        content = {"learner": self._told, "iteration": self._iteration, "part": self._part}
        content |= {"particle_steps": self.particle_steps, "seconds": self._elapsed}
        curve = [asdict(entry) for entry in self.log]
        save_checkpoint(self.folder.checkpoint, content | {"curve": curve} | state)
        self.folder.note_checkpoint()
        rules.save(self.folder.path)
        lines = [" ".join(json_text(line).split()) for line in curve]
        write_text(self.folder.log, "\n".join(lines) + "\n")

    def _go_on(self, learner: Learner, content: dict[str, Any]) -> None:
        """Take over what a checkpoint holds."""
        path, like = self.folder.checkpoint, learner_state(learner)
        like |= {"iteration": 0, "part": 0, "particle_steps": 0, "seconds": 0.0}
        like["optimisers"] = moments_like(learner, content.get("optimisers"))
        random = content.get("random")
        if not isinstance(random, Tensor) or random.shape != like["random"].shape:
            # Processes that share a run draw otherwise than one alone, and begin that anew.
            content["random"] = like["random"]
        check_content(content, like, path)
        curve = content.get("curve")
        try:
            self.log = [CurvePoint(**entry) for entry in curve or ()]
            numbers = [value for entry in self.log for value in asdict(entry).values()]
            load_learner_state(learner, content)
        except (TypeError, RuntimeError) as error:
            raise unusable_checkpoint(path, f"it cannot be used ({shown(error)})") from error
        # The error of a single episode is infinite.
        if not self.log or not all(is_real(value) or value == math.inf for value in numbers):
            raise unusable_checkpoint(path, "curve must hold the numbers of its entries")
        self._iteration, self._part = content["iteration"], content["part"] + 1
        self.particle_steps = content["particle_steps"]
        self._seconds = self._elapsed = content["seconds"]
        self._looks = int(self.share * self._entries)
        learner.go_on(self._iteration, self._part)


def learner_state(learner: Learner) -> dict[str, Any]:
    """Return what a learner is, but for its worlds."""
    random = learner.random
    drawn = random.episodes[:1] if isinstance(random, WorldRandom) else random.get_state()
    return {
        "modules": {name: module.state_dict() for name, module in learner.modules().items()},
        "optimisers": {
            name: optimiser.state_dict()["state"]
            for name, optimiser in learner.optimisers().items()
        },
        # All worlds have drawn equally often.
        "random": drawn.cpu(),
    }


def load_learner_state(learner: Learner, state: Mapping[str, Any]) -> None:
    """Let a learner be what `learner_state` returned."""
    for name, module in learner.modules().items():
        module.load_state_dict(state["modules"][name])
    for name, optimiser in learner.optimisers().items():
        # The groups are the options', and not read.
        groups = optimiser.state_dict()["param_groups"]
        optimiser.load_state_dict({"state": state["optimisers"][name], "param_groups": groups})
    random = learner.random
    if isinstance(random, WorldRandom):
        random.episodes.fill_(int(state["random"]))
    else:
        random.set_state(state["random"])


def moments_like(learner: Learner, held: Any) -> dict[str, Any]:
    """Return what Adam keeps of those parameters that a checkpoint has something of."""
    like: dict[str, Any] = {}
    for name, optimiser in learner.optimisers().items():
        own = held.get(name) if isinstance(held, dict) else None
        keys = own.keys() if isinstance(own, dict) else ()
        parameters = optimiser.param_groups[0]["params"]
        like[name] = {
            number: {"step": torch.zeros(()), "exp_avg": value, "exp_avg_sq": value}
            for number, value in enumerate(parameters)
            if number in keys
        }
    return like
