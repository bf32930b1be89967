"""Live worlds of a rule, and of the newest rules of a training run."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.checks import is_real, is_whole
from npa_envs.errors import NPAError, shown, suggest
from npa_envs.files import open_regular, parse_json
from npa_envs.rule.files import load_rule, rule_file, rule_metadata, shipped_rules
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import Task
from npa_envs.tasks.co_morphogenesis2d import CoMorphogenesis2DConfig
from npa_envs.tasks.damage import DAMAGE_SIZES, damage_worlds
from npa_envs.tasks.seeds import uniform_ball
from npa_envs.tasks.train_config import TrainConfig
from npa_envs.training.presets import load_config, preset
from npa_envs.training.run import MAX_LOG, RunFolder
from npa_envs.training.task_of_rule import TrainedTask, task_of_rule, trained_config
from npa_envs.web.live import (
    ColouredWorld,
    Colouring,
    LiveWorld,
    Range,
    Touch,
    WorldView,
    brushed,
    checked_seed,
    shows_of,
)
from npa_envs.world.brushes import inside_ball, removed, wipe_state
from npa_envs.world.division import living
from npa_envs.world.rollout import at_rest, rollout
from npa_envs.world.species import AGREEMENTS, rollout_species

MAX_PARTICLES = {"cpu": 16384, "cuda": 131072}
"""Most particles of a world, by device type."""

SEED_FRACTION, MIN_SEED = 0.5, 16
"""Particles that the brush `add` of strength 1 adds, as a fraction of a fresh world's; the least
number of them."""

SMALL_VIEWS = {"resolution": 64, "training_views": 1, "held_out_views": 6}
"""Options of 3D tasks for a fast start: targets of full size take many seconds to draw."""

MAX_TASKS = 8
"""Cached tasks with their targets; the slider of N makes many."""

REST_CHECK_STEPS = 64
"""Steps between two checks whether the world is at rest."""

POLL_SECONDS = 1.0
"""Time between two checks of the files of a run [s]."""


@dataclass
class LiveRule:
    """A float32 rule in the world, with the number of its particles."""

    name: str
    rule: NPARule
    count: int = 0
    divisor: float = 0.0
    """Number by which its densities are divided."""


class RuleWorld(LiveWorld):
    """A world of one rule, and of other rules that the brushes graft and add put into it.

    `choices` has the sources of the other rules by name; None: the shipped ones.
    """

    def __init__(
        self,
        source: str = "gecko",
        *,
        device: torch.device,
        seed: int = 0,
        particle_count: int | None = None,
        choices: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__()
        self._device = device
        self._rules: dict[str, NPARule] = {}
        self._trained: dict[tuple[str, int | None], TrainedTask] = {}
        self.seed = checked_seed(seed)
        others = {name: name for name in shipped_rules()} if choices is None else dict(choices)
        name = name_of(source)
        self._choices = others | {name: source}
        self._plant(name, particle_count)

    def _live_rule(self, name: Any) -> LiveRule:
        if not isinstance(name, str) or name not in self._choices:
            raise NPAError(f"unknown rule {shown(name)}: {suggest(name, self._choices)}")
        if name not in self._rules:
            rule = load_rule(self._choices[name], device=self._device).float()
            self._rules[name] = rule.requires_grad_(False)
        return LiveRule(name, self._rules[name])

    def _task_of(self, live_rule: LiveRule, particle_count: int | None) -> TrainedTask:
        key = (live_rule.name, particle_count)
        if key not in self._trained:
            if len(self._trained) >= MAX_TASKS:
                self._trained.clear()
            self._trained[key] = task_of_rule(
                self._choices[live_rule.name],
                live_rule.rule,
                self._device,
                particle_count=particle_count,
                **(SMALL_VIEWS if live_rule.rule.space_dim == 3 else {}),
            )
        return self._trained[key]

    def _plant(self, name: Any, particle_count: int | None = None) -> None:
        """Start a fresh world of a rule with the task that it was trained on."""
        live_rule = self._live_rule(name)
        self.trained = self._task_of(live_rule, particle_count)
        self.main = live_rule
        self.eps, self.update_prob, self.noise = self.task.eps, self.task.update_prob, 0.0
        self.speed = 1
        if self.show not in self._shows():
            self.show = "colours"
        self.reset(self.seed)

    @torch.no_grad()
    def reset(self, seed: int | None) -> None:
        """Start a fresh world of the chosen rule alone."""
        self.seed = self.seed + 1 if seed is None else seed
        self._generator = torch.Generator(self._device).manual_seed(self.seed)
        seeds = self.task.seed(1, generator=self._generator, device=self._device)
        self.x, self.s, self._goal = seeds.x, seeds.s, seeds.goal
        self.full = self.x.shape[1]
        self.live_rules = [replace(self.main, count=self.full, divisor=float(self.full))]
        self._colouring = Colouring()
        self._travelled: Tensor | None = None
        self._updated: Tensor | None = None
        self.step, self._milliseconds, self._loss_due = 0, 0.0, 0.0
        self._still: tuple[Any, ...] = ()
        """Tensors, their ids and versions, rule and ε of a world that is at rest, or empty."""
        self._checked_step = 0
        """Step of the last check for rest."""

    @property
    def task(self) -> Task:
        """The task of the chosen rule."""
        return self.trained.task

    @property
    def counts(self) -> list[int]:
        """Particles of each rule, rule after rule."""
        return [own.count for own in self.live_rules]

    @property
    def count(self) -> int:
        """Particles of a fresh world."""
        return self.full

    def describe(self) -> dict[str, Any]:
        """Return the event "world"."""
        task, box = self.task, self.task.box
        centre, half_width = list(task.frame.centre), task.frame.half_width
        capabilities = ["step", "reset", "film"]
        return super().describe() | {
            "title": self.main.name,
            "note": "",
            "dimension": self.main.rule.space_dim,
            "box": None if box is None else list(box),
            "half_width": half_width,
            "centre": centre,
            "spot": 0.7 * self.task.pixel_size,
            "rules": sorted(self._choices),
            "rule": self.main.name,
            "others": [name for name in self._choices if self._may_join(name)],
            "species": [live_rule.name for live_rule in self.live_rules],
            "damages": list(DAMAGE_SIZES),
            "capabilities": [*capabilities, "loss"] if self._has_loss() else capabilities,
        }

    def _allowed(self) -> set[str]:
        allowed = {"moves", "removal"}
        # Rules that divide allow no others in their worlds; their dead particles have no state.
        if not self.main.rule.divides:
            allowed |= {"states", "species"}
            allowed |= set() if self.main.rule.static else {"growth"}
        return allowed

    def _has_loss(self) -> bool:
        return self.trained.doubt is None

    def _may_join(self, name: str) -> bool:
        """Return whether particles of another rule can be put into this world."""
        own = self.main.rule
        try:
            other = self._live_rule(name).rule
        except NPAError:
            return False
        alike = all(getattr(other, field) == getattr(own, field) for field in AGREEMENTS)
        return alike and not (other.divides or own.divides)

    def _ranges(self) -> dict[str, Range]:
        eps0, box = self.main.rule.eps0, self.task.box
        # A periodic box must have at least two cells of width ε in each direction.
        most = 2.5 * eps0 if box is None else min(2.5 * eps0, 0.499 * min(box))
        ranges = super()._ranges() | {
            "eps": Range(0.4 * eps0, most, "log"),
            "update_prob": Range(0.05, 1.0),
            "noise": Range(0.0, 0.2 * eps0),
        }
        if not self.task.classifies:
            ranges["count"] = Range(64, MAX_PARTICLES[self._device.type], "log", whole=True)
        return ranges

    def _shows(self) -> list[str]:
        return shows_of(self.main.rule.state_dim)

    def _set(self, name: str, value: Any) -> bool:
        if name == "rule":
            self._plant(value)
        elif name == "count" and name in self._ranges():
            number = self._ranges()[name].checked(name, value)
            if number != self.full:
                self.trained = self._task_of(self.main, int(number))
                self.reset(self.seed)
        else:
            return super()._set(name, value)
        return True

    @torch.no_grad()
    def _run(self, steps: int) -> None:
        self.step += steps
        if self.x.shape[1] == 0:
            return
        watched = self.show in ("mask", "speed")
        if not watched and self._rests():
            return
        options: dict[str, Any] = {
            "eps": self.eps, "box": self.task.box, "update_prob": self.update_prob,
            "position_noise": self.noise, "generator": self._generator,
        }  # fmt: skip
        if watched and steps > 1:
            # The last step runs by itself, as masks and speeds are those of one step.
            self._rollout(steps - 1, options)
        before = self.s
        path_length = self._rollout(1 if watched else steps, options)
        if watched:
            longest = max(live_rule.rule.alpha for live_rule in self.live_rules) * self.eps
            self._travelled = path_length / longest
            self._updated = (self.s != before).any(dim=-1)
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)

    def _rests(self) -> bool:
        """Return whether a world of one rule is at rest; checks every `REST_CHECK_STEPS` steps."""
        rule = self.main.rule
        if not rule.dead_zone or rule.divides or self.noise > 0.0 or not self._is_unchanged():
            return False
        worlds = self.x, self.s
        now = (*map(id, worlds), *(value._version for value in worlds), rule, self.eps)
        if now == self._still[2:]:
            return True
        if self.step < self._checked_step + REST_CHECK_STEPS:
            return False
        self._checked_step = self.step
        rests = bool(at_rest(rule, *worlds, eps=self.eps, box=self.task.box))
        if rests:
            # Keeping the tensors makes sure that no other tensors get their ids.
            self._still = (*worlds, *now)
        return rests

    def _is_unchanged(self) -> bool:
        """Return whether no brush has added or removed particles or rules."""
        return [(own.count, own.divisor) for own in self.live_rules] == [(self.full, self.full)]

    def _rollout(self, steps: int, options: Mapping[str, Any]) -> Tensor:
        """Run steps and return the path length of each particle."""
        rules = [own.rule for own in self.live_rules]
        if self._is_unchanged():
            self.x, self.s, path_length = rollout(
                rules[0], self.x, self.s, steps, return_path_length=True, **options
            )
        else:
            # Divided by the particles of a fresh world: particles that a brush adds or removes
            # change only the densities around them.
            divisors = [own.divisor for own in self.live_rules]
            self.x, self.s, path_length = rollout_species(
                rules, self.x, self.s, steps, counts=self.counts, density_counts=divisors,
                return_path_length=True, **options,
            )  # fmt: skip
        return path_length

    def frame(self) -> WorldView:
        """Return the present frame."""
        x, s, travelled, updated = self.x, self.s, self._travelled, self._updated
        counts = self.counts
        if self.main.rule.divides:
            alive = living(s)[0]
            x, s, counts = x[:, alive], s[:, alive], [int(alive.sum())]
            travelled = None if travelled is None else travelled[:, alive]
            updated = None if updated is None else updated[:, alive]
        coloured = ColouredWorld(
            x, s, self._own_colours, self.eps, self.task.box, counts, self.full, travelled, updated
        )
        with torch.no_grad():
            colours = self._colouring(self.show, coloured)
        positions: NDArray[np.float32] = x[0].cpu().numpy()
        alone = len(self.live_rules) == 1 and positions.size and self._has_loss()
        loss = self._loss(self._metric) if alone else None
        return WorldView(self.step, positions, colours, self._milliseconds, loss)

    def _own_colours(self, s: Tensor) -> Tensor:
        if self.task.classifies:
            return self.task.colours(s)
        if self.main.rule.divides:
            return self.main.rule.colour(s)
        parts = zip(self.live_rules, s.split_with_sizes(self.counts, dim=1), strict=True)
        return torch.cat([live_rule.rule.colour(part) for live_rule, part in parts], dim=1)

    @torch.no_grad()
    def _metric(self) -> float:
        return float(self.task.toward(self._goal).metric(self.x, self.s))

    @torch.no_grad()
    def _damage(self, name: str) -> None:
        if self.x.shape[1]:
            self.x, s = damage_worlds(self.x, self.s, kind=name, generator=self._generator)
            self.s = self._all_coded(s)

    @torch.no_grad()
    def _brush(self, message: Mapping[str, Any]) -> bool:
        touch = Touch.read(message, self.x)
        before = [own.name for own in self.live_rules]
        match touch.tool:
            case "remove" if self.main.rule.divides:
                self.s = wipe_state(self.x, self.s, centre=touch.at, radius=touch.radius)
            case "remove":
                gone = inside_ball(self.x, centre=touch.at, radius=touch.radius, box=self.task.box)
                self._arrange(*removed(self.x, self.s, gone=gone), self._species()[~gone[0]])
            case "graft":
                self._graft(touch, self._joining(message.get("rule")))
            case "add" if not self.main.rule.static:
                self._add(touch, self._joining(message.get("rule")))
            case _:
                self.x, self.s = brushed(self.x, self.s, touch, self.task.box)
        return before != [own.name for own in self.live_rules]

    def _graft(self, touch: Touch, live_rule: LiveRule) -> None:
        inside = inside_ball(self.x, centre=touch.at, radius=touch.radius, box=self.task.box)
        # Grafted particles divide densities by the same number as their neighbours.
        number = self._number(live_rule, float(self.full))
        s = torch.where(inside[..., None], self._coded(live_rule, self.s), self.s)
        self._arrange(self.x, s, torch.where(inside[0], number, self._species()))

    def _add(self, touch: Touch, live_rule: LiveRule) -> None:
        count = max(MIN_SEED, round(touch.strength * SEED_FRACTION * self.full))
        room = MAX_PARTICLES[self._device.type] - self.x.shape[1]
        if count > room:
            raise NPAError(f"the world has room for {max(room, 0)} particles more, got {count}")
        ball = uniform_ball(
            1, count, self.x.shape[2], touch.radius, generator=self._generator,
            device=self._device, dtype=self.x.dtype,
        )  # fmt: skip
        # A new species divides densities by its own number of particles, as in a world alone.
        number = self._number(live_rule, float(count))
        x = torch.cat((self.x, ball + touch.at[:, None]), dim=1)
        fresh = self._coded(live_rule, self.s.new_zeros(1, count, self.s.shape[2]))
        s = torch.cat((self.s, fresh), dim=1)
        self._arrange(x, s, torch.nn.functional.pad(self._species(), (0, count), value=number))

    def _all_coded(self, s: Tensor) -> Tensor:
        """Return states of all particles, each with the code of its species."""
        parts = zip(self.live_rules, s.split_with_sizes(self.counts, dim=1), strict=True)
        return torch.cat([self._coded(live_rule, part) for live_rule, part in parts], dim=1)

    def _coded(self, live_rule: LiveRule, s: Tensor) -> Tensor:
        """Return states of a species with its rule's code, if it has one."""
        if live_rule.rule.codes is None:
            return s
        own = live_rule.name == self.main.name
        return (self.task if own else self._task_of(live_rule, None).task).coded(s)

    def _joining(self, name: Any) -> LiveRule:
        live_rule = self._live_rule(name)
        if not self._may_join(live_rule.name):
            raise NPAError(
                f"{live_rule.name} cannot live in a world of {self.main.name}: rules of one world "
                f"must agree in {', '.join(AGREEMENTS)}, and not divide"
            )
        return live_rule

    def _number(self, live_rule: LiveRule, divisor: float) -> int:
        """Return the index of a rule's species; a rule that is new in the world is appended."""
        names = [own.name for own in self.live_rules]
        if live_rule.name not in names:
            names.append(live_rule.name)
            self.live_rules.append(replace(live_rule, divisor=divisor))
        return names.index(live_rule.name)

    def _species(self) -> Tensor:
        """Return the species index of each particle, int64, shape [N]."""
        numbers = torch.arange(len(self.counts))
        return numbers.repeat_interleave(torch.tensor(self.counts)).to(self._device)

    def _arrange(self, x: Tensor, s: Tensor, species: Tensor) -> None:
        """Set the world's particles, sorted by species."""
        order = species.argsort(stable=True)
        if not torch.equal(order, torch.arange(self.x.shape[1], device=order.device)):
            # The page's tracers follow particles by their index.
            self._news.append({"type": "reordered"})
        self.x, self.s = x[:, order], s[:, order]
        counts = torch.bincount(species, minlength=len(self.live_rules)).tolist()
        for own, count in zip(self.live_rules, counts, strict=True):
            own.count = count
        self.live_rules = [own for own in self.live_rules if own.count] or self.live_rules[:1]


def name_of(source: str) -> str:
    """Return the name of a rule: that of its file, or of the run's folder for rule.safetensors."""
    if "#" in source:
        return source.rpartition("#")[2]
    path = rule_file(source)
    return path.resolve().parent.name if path.name == "rule.safetensors" else path.stem


class FollowedLog:
    """Reads new records of the log of a run in progress."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._seen: tuple[int, ...] = ()
        self._forget()

    def _forget(self) -> None:
        self._end, self._last_line = 0, b""
        self.iteration = -1
        """Iteration of the last record, or -1."""

    def news(self) -> tuple[list[dict[str, Any]], bool]:
        """Return records since the last call, and whether they start a log; skip broken lines."""
        try:
            now = self._path.stat()
        except FileNotFoundError:
            self._forget()
            return [], False
        if (seen := (now.st_ino, now.st_size, now.st_mtime_ns)) == self._seen:
            return [], False
        self._seen = seen
        with open_regular(self._path, limit=MAX_LOG, what="the log") as file:
            file.seek(self._end - len(self._last_line))
            if file.read(len(self._last_line)) != self._last_line:
                # The run was resumed from a checkpoint, or another one was started in its folder.
                self._forget()
                file.seek(0)
            text = file.read(MAX_LOG)
        # A last line without newline is not complete yet.
        text = text[: text.rfind(b"\n") + 1]
        first = self.iteration < 0
        records = []
        for line in text.splitlines(keepends=True):
            self._end += len(line)
            self._last_line = line
            with contextlib.suppress(NPAError):
                record = parse_json(line)
                if isinstance(record, dict) and is_whole(record.get("iteration")):
                    self.iteration = record["iteration"]
                    records.append(record)
        return records, first


class RunWorld(RuleWorld):
    """A world of the rules of a run, which are replaced by those of each new checkpoint."""

    def __init__(
        self,
        folder: Path,
        *,
        device: torch.device,
        seed: int = 0,
        particle_count: int | None = None,
    ) -> None:
        self._run_folder = RunFolder(folder)
        self._log = FollowedLog(self._run_folder.log)
        files = rules_of_run(self._run_folder)
        self._files = {name_of(str(path)): path for path in files}
        self._centres = [0.0]
        if len(files) > 1:
            # Seeds lie in a row, as in training.
            joint: TrainConfig[CoMorphogenesis2DConfig] = preset("fast", "co_morphogenesis2d")
            config = load_config(self._run_folder.config, joint)
            self._centres = list(config.task.centres)
        self._each = None if particle_count is None else max(1, particle_count // len(files))
        self._written = self._stamp()
        self._iteration = 0
        self._due = 0.0
        choices = {name: str(path) for name, path in self._files.items()}
        super().__init__(
            str(files[0]), device=device, seed=seed, particle_count=self._each, choices=choices
        )
        self._goals = self._goal_choices()

    @torch.no_grad()
    def reset(self, seed: int | None) -> None:
        """Start a fresh world of all rules of the run."""
        super().reset(seed)
        if len(self._files) == 1:
            return
        self.live_rules = [self._live_rule(name) for name in self._files]
        worlds = []
        for own, centre in zip(self.live_rules, self._centres, strict=True):
            task = self._task_of(own, self._each).task
            x, s, *_ = task.seed(1, generator=self._generator, device=self._device)
            x[..., 0] += centre
            worlds.append((x, s))
            # As in training, each species divides densities by its own number of particles.
            own.count, own.divisor = x.shape[1], float(x.shape[1])
        self.x, self.s = (torch.cat(parts, dim=1) for parts in zip(*worlds, strict=True))
        self.full = sum(self.counts)

    def describe(self) -> dict[str, Any]:
        """Return the event "world", without a choice of rules."""
        return super().describe() | {
            "title": self._run_folder.path.resolve().name,
            "note": f"a training run, iteration {self._iteration}",
            "rules": [],
            "rule": None,
        }

    def _ranges(self) -> dict[str, Range]:
        ranges = super()._ranges()
        if len(self._files) > 1:
            del ranges["count"]
        return ranges

    def news(self) -> list[dict[str, Any]]:
        """Return the other events since the last call, also the run's new losses and rules."""
        if time.monotonic() >= self._due:
            self._due = time.monotonic() + POLL_SECONDS
            try:
                self._poll()
            except NPAError as error:
                # Usually a file that is being written; the next check reads it.
                self._news.append({"type": "error", "message": str(error)})
        return super().news()

    def _stamp(self) -> list[int]:
        """Return the modification times of the rules' files."""
        return [path.stat().st_mtime_ns if path.exists() else 0 for path in self._files.values()]

    def _poll(self) -> None:
        fresh, restarted = self._log.news()
        if fresh:
            self._iteration = self._log.iteration
            points = [[r["iteration"], r["loss"]] for r in fresh if is_real(r.get("loss"))]
            curve = {"type": "curve", "name": "Training loss", "points": points}
            self._news.append(curve | {"append": not restarted})
        written = self._stamp()
        fresher = written != self._written
        if fresher:
            # Set before reading, so that an error is reported only once.
            self._written = written
            self._take_rules()
        if fresh or fresher:
            self._news.append(self.describe())

    def _take_rules(self) -> None:
        """Load the newest rules; the world continues if they have the same hyper-parameters."""
        self._still = ()
        fresh = {
            name: load_rule(path, device=self._device).float() for name, path in self._files.items()
        }
        own = {name: self._live_rule(name).rule for name in fresh}
        goals = self._goal_choices()
        # Cached tasks have the codes of the old rules.
        self._trained.clear()
        if goals == self._goals and all(
            fresh[k].hyper_parameters() == own[k].hyper_parameters() for k in own
        ):
            for name, rule in own.items():
                rule.load_state_dict(fresh[name].state_dict())
            task = self.task.for_rule(self.main.rule)
            self.trained = replace(self.trained, task=task)
            with torch.no_grad():
                self.s = self._all_coded(self.s)
        else:
            # Another run was started in the folder.
            self._rules.clear()
            self._plant(self.main.name, self._each)
            self._news.append({"type": "reordered"})
        self._goals = goals

    def _goal_choices(self) -> list[Any]:
        """Return each file's task name and configuration, to notice that a run's task changed."""
        found: list[Any] = []
        for path in self._files.values():
            metadata = rule_metadata(path)
            config = trained_config(path, metadata).task if "config" in metadata else None
            found.append((metadata.get("task"), config))
        return found


def rules_of_run(folder: RunFolder) -> list[Path]:
    """Return the file of a run's rule, or the files of all rules that it trains together."""
    path = str(folder.path)
    if not folder.path.is_dir():
        raise NPAError(f"a run must be a folder, got {shown(path)}: name the one given as --out")
    if folder.rule.is_file():
        return [folder.rule]
    found = sorted(folder.path.glob("rule-[0-9]*.safetensors"))
    several = [folder.rule_of(number) for number in range(len(found))]
    if found and all(path.is_file() for path in several):
        return several
    if folder.config.is_file() or folder.log.is_file():
        raise NPAError(
            f"the run in {shown(path)} has not written its rules yet: wait for its first checkpoint"
        )
    raise NPAError(
        f"the folder {shown(path)} must hold the {folder.rule.name} of a run, it does not: name "
        "another one"
    )
