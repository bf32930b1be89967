"""Live worlds of rules: a rule with whatever grafts and seeds bring in, and the rule of a run."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.checks import is_real, is_whole
from npa_envs.errors import NPAError, shown, suggest
from npa_envs.files import open_regular, parse_json
from npa_envs.rule.files import load_rule, rule_file, rule_metadata, shipped_rules
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import (
    Task,
)
from npa_envs.tasks.co_morphogenesis2d import CoMorphogenesis2DConfig
from npa_envs.tasks.damage import DAMAGE_SIZES, damage_worlds
from npa_envs.tasks.seeds import uniform_ball
from npa_envs.tasks.train_config import TrainConfig
from npa_envs.training.overrides import load_config
from npa_envs.training.presets import preset
from npa_envs.training.run_folder import LARGEST_LOG, RunFolder
from npa_envs.training.trained_tasks import TrainedTask, task_of_rule, trained_config
from npa_envs.web.colouring import Colouring, Seen, shows_of
from npa_envs.web.live import Live, Range, Touch, WorldView, brushed, checked_seed
from npa_envs.world.brushes import inside_ball, removed, wipe_state
from npa_envs.world.division import living
from npa_envs.world.rollout import at_rest, rollout
from npa_envs.world.species import AGREEMENTS, rollout_species

MOST_PARTICLES = {"cpu": 16384, "cuda": 131072}
"""Largest number of particles that the slider offers, on each kind of device."""

SEED_SHARE = 0.5
"""Particles that the brush `add` of strength 1 adds, as a share of those of a fresh world."""

SMALL_VIEWS = {"resolution": 64, "training_views": 1, "held_out_views": 6}
"""What the loss of a 3D world looks at: as trained, drawing the target alone takes many seconds."""

MOST_TASKS = 8
"""Tasks that are kept, with their targets: a slider of N asks for many."""

REST_LOOK = 64
"""Steps from one question whether the world is at rest to the next."""

POLL_SECONDS = 1.0
"""Time between two looks into the folder of a run [s]."""


class LiveRule(NamedTuple):
    """A rule by its name."""

    name: str
    """What the page calls it."""
    rule: NPARule
    """The rule, float32, on the world's device."""


class RuleWorld(Live):
    """A world of one rule, or of several that grafts and seeds have brought into it.

    Args:
        source: The rule: a shipped one or a file.
        device: Where the world lives.
        seed: The first world's number.
        particle_count: Particles N; None: as trained.
        choices: Other rules that may be chosen, by their names; None: the shipped ones.

    Raises:
        NPAError: The rule cannot be loaded, or a number is out of its range.
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

    # Which rule, and a fresh world of it.

    def _organism(self, name: Any) -> LiveRule:
        if not isinstance(name, str) or name not in self._choices:
            raise NPAError(f"unknown rule {shown(name)}: {suggest(name, self._choices)}")
        if name not in self._rules:
            rule = load_rule(self._choices[name], device=self._device).float()
            self._rules[name] = rule.requires_grad_(False)
        return LiveRule(name, self._rules[name])

    def _task_of(self, organism: LiveRule, particle_count: int | None) -> TrainedTask:
        key = (organism.name, particle_count)
        if key not in self._trained:
            if len(self._trained) >= MOST_TASKS:
                self._trained.clear()
            self._trained[key] = task_of_rule(
                self._choices[organism.name],
                organism.rule,
                self._device,
                particle_count=particle_count,
                **(SMALL_VIEWS if organism.rule.space_dim == 3 else {}),
            )
        return self._trained[key]

    def _plant(self, name: Any, particle_count: int | None = None) -> None:
        """Begin a fresh world of a rule, in the world that it was trained in."""
        organism = self._organism(name)
        self.trained = self._task_of(organism, particle_count)
        self.main = organism
        self.eps, self.update_prob, self.noise = self.task.eps, self.task.update_prob, 0.0
        self.speed = 1
        if self.show not in self._shows():
            self.show = "colours"
        self.reset(self.seed)

    @torch.no_grad()
    def reset(self, seed: int | None) -> None:
        """Begin a fresh world of the chosen rule alone."""
        self.seed = self.seed + 1 if seed is None else seed
        self._generator = torch.Generator(self._device).manual_seed(self.seed)
        self.x, self.s, self._goal = self.task.seed(
            1, generator=self._generator, device=self._device
        )
        self.full = self.x.shape[1]
        self.organisms, self.counts = [self.main], [self.full]
        self._divisors = [float(self.full)]
        self._colouring = Colouring()
        self._travelled: Tensor | None = None
        self._updated: Tensor | None = None
        self.step, self._milliseconds, self._loss_due = 0, 0.0, 0.0
        self._still: tuple[Any, ...] = ()
        """What was at rest, and under what."""
        self._looked = 0
        """When that was asked last [steps]."""

    @property
    def task(self) -> Task:
        """The task of the chosen rule."""
        return self.trained.task

    @property
    def dimension(self) -> int:
        """Space dimension D."""
        return self.main.rule.space_dim

    def describe(self) -> dict[str, Any]:
        """Return the event "world"."""
        task, box = self.task, self.task.box
        centre, half_width = list(task.frame.centre), task.frame.half_width
        alike = [name for name in self._choices if self._may_join(name)]
        tools = ["remove", "push", "clump", "cut", "inject", "graft", "add"]
        if self.main.rule.static:
            tools.remove("add")
        if self.main.rule.divides:
            # A rule that divides lives alone, and fills its world by itself. What the dead have in
            # their slots is no state to be carried anywhere.
            tools = [tool for tool in tools if tool not in ("inject", "graft", "add")]
        return {
            "type": "world",
            "title": self._title(),
            "note": self._note(),
            "dimension": self.dimension,
            "box": None if box is None else list(box),
            "half_width": half_width,
            "centre": centre,
            "spot": self._spot(),
            "rules": sorted(self._choices),
            "rule": self.main.name,
            "others": alike,
            "species": [organism.name for organism in self.organisms],
            "shows": self._shows(),
            "show": self.show,
            "tools": tools,
            "damages": list(DAMAGE_SIZES),
            "settings": self._settings(),
            "capabilities": ["step", "reset", "film", *self._loss_offered()],
            "playing": self.playing,
            "seed": self.seed,
        }

    def _title(self) -> str:
        return self.main.name

    def _note(self) -> str:
        return ""

    def _loss_offered(self) -> list[str]:
        return ["loss"] if self.trained.doubt is None else []

    def _may_join(self, name: str) -> bool:
        """Return whether particles of another rule can live in this world."""
        try:
            other = self._organism(name).rule
        except NPAError:
            return False
        if other.divides or self.main.rule.divides:
            return False
        return all(getattr(other, what) == getattr(self.main.rule, what) for what in AGREEMENTS)

    def _spot(self) -> float:
        """Return the standard deviation of a particle's spot [length units]."""
        target = getattr(self.task, "target", None)
        size = getattr(self.task, "pixel_size", None) or getattr(target, "pixel_size", None)
        spacing = (0.1 / self.full) ** (1.0 / 3.0) if size is None else float(size)
        return 0.7 * spacing

    # Settings.

    def _ranges(self) -> dict[str, Range]:
        eps0, box = self.main.rule.eps0, self.task.box
        # Cells of a periodic box are as wide as the radius, and two of them must fit.
        most = 2.5 * eps0 if box is None else min(2.5 * eps0, 0.499 * min(box))
        return {
            "eps": Range(0.4 * eps0, most, "log"),
            "update_prob": Range(0.05, 1.0),
            "noise": Range(0.0, 0.2 * eps0),
            "count": Range(64, MOST_PARTICLES[self._device.type], "log", whole=True),
        }

    def _settings(self) -> dict[str, Any]:
        ranges = self._ranges()
        values = {
            "eps": self.eps, "update_prob": self.update_prob, "noise": self.noise,
            "count": self.full,
        }  # fmt: skip
        if self.task.classifies:
            del values["count"]
        told = {name: ranges[name].to_dict(value) for name, value in values.items()}
        return super()._settings() | told

    def _shows(self) -> list[str]:
        return shows_of(self.main.rule.state_dim)

    def _set(self, name: str, value: Any) -> bool:
        if name == "rule":
            self._plant(value)
            return True
        if name not in self._settings() or name == "speed":
            return super()._set(name, value)
        number = self._ranges()[name].checked(name, value)
        if name == "count":
            if number != self.full:
                self.trained = self._task_of(self.main, int(number))
                self.reset(self.seed)
        else:
            setattr(self, name, number)
        return True

    # Time.

    @torch.no_grad()
    def _run(self, steps: int) -> None:
        self.step += steps
        if self.x.shape[1] == 0:
            return
        watched = self.show in ("mask", "speed")
        if not watched and self._rests():
            return
        told: dict[str, Any] = {
            "eps": self.eps, "box": self.task.box, "update_prob": self.update_prob,
            "position_noise": self.noise, "generator": self._generator,
        }  # fmt: skip
        if watched and steps > 1:
            # Shown is the last step alone.
            self._go(steps - 1, told)
        before = self.s
        travelled = self._go(1 if watched else steps, told, path=watched)
        if travelled is not None:
            reach = max(organism.rule.alpha for organism in self.organisms) * self.eps
            self._travelled, self._updated = travelled / reach, (self.s != before).any(dim=-1)
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)

    def _rests(self) -> bool:
        """Return whether the rule's own world is at rest, which is asked now and then."""
        rule = self.main.rule
        if not rule.dead_zone or rule.divides or self.noise > 0.0 or not self._is_as_planted():
            return False
        worlds = self.x, self.s
        now = (*map(id, worlds), *(value._version for value in worlds), rule, self.eps)
        if now == self._still[2:]:
            return True
        if self.step < self._looked + REST_LOOK:
            return False
        self._looked = self.step
        rests = bool(at_rest(rule, *worlds, eps=self.eps, box=self.task.box))
        if rests:
            # The worlds are kept, so that nothing else gets their ids.
            self._still = (*worlds, *now)
        return rests

    def _is_as_planted(self) -> bool:
        """Return whether the particles are those of a fresh world of one rule."""
        return self.counts == [self.full] and self._divisors == [float(self.full)]

    def _go(self, steps: int, told: Mapping[str, Any], *, path: bool = False) -> Tensor | None:
        rules = [organism.rule for organism in self.organisms]
        if self._is_as_planted():
            self.x, self.s, travelled = rollout(
                rules[0], self.x, self.s, steps, return_path_length=True, **told
            )
        else:
            # Densities are divided by the particles of a fresh world: what a hand takes away or
            # adds is then felt nearby, and nowhere else.
            self.x, self.s, travelled = rollout_species(
                rules, self.x, self.s, steps, counts=self.counts, return_path_length=True,
                density_counts=self._divisors, **told,
            )  # fmt: skip
        return travelled if path else None

    def frame(self) -> WorldView:
        """Return what is seen now."""
        x, s, travelled, updated = self.x, self.s, self._travelled, self._updated
        counts = self.counts
        if self.main.rule.divides:
            alive = living(s)[0]
            x, s, counts = x[:, alive], s[:, alive], [int(alive.sum())]
            travelled = None if travelled is None else travelled[:, alive]
            updated = None if updated is None else updated[:, alive]
        seen = Seen(
            x, s, self._own_colours, self.eps, self.task.box, counts, self.full, travelled, updated
        )
        with torch.no_grad():
            colours = self._colouring(self.show, seen)
        positions: NDArray[np.float32] = x[0].cpu().numpy()
        alone = len(self.organisms) == 1 and positions.size and self._loss_offered()
        loss = self._loss(self._metric) if alone else None
        return WorldView(self.step, positions, colours, self._milliseconds, loss)

    def _own_colours(self, s: Tensor) -> Tensor:
        if self.task.classifies:
            return self.task.colours(s)
        if self.main.rule.divides:
            return self.main.rule.colour(s)
        parts = zip(self.organisms, s.split_with_sizes(self.counts, dim=1), strict=True)
        return torch.cat([organism.rule.colour(part) for organism, part in parts], dim=1)

    @torch.no_grad()
    def _metric(self) -> float:
        return float(self.task.toward(self._goal).metric(self.x, self.s))

    # Hands.

    @torch.no_grad()
    def _damage(self, name: str) -> None:
        if self.x.shape[1]:
            self.x, s = damage_worlds(self.x, self.s, kind=name, generator=self._generator)
            self.s = self._all_coded(s)

    @torch.no_grad()
    def _brush(self, message: Mapping[str, Any]) -> bool:
        touch = Touch.read(message, self.x)
        before = [organism.name for organism in self.organisms]
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
        return before != [organism.name for organism in self.organisms]

    def _graft(self, touch: Touch, organism: LiveRule) -> None:
        inside = inside_ball(self.x, centre=touch.at, radius=touch.radius, box=self.task.box)
        # Among its hosts it sees densities as they do.
        number = self._number(organism, float(self.full))
        s = torch.where(inside[..., None], self._coded(organism, self.s), self.s)
        self._arrange(self.x, s, torch.where(inside[0], number, self._species()))

    def _add(self, touch: Touch, organism: LiveRule) -> None:
        count = max(16, round(touch.strength * SEED_SHARE * self.full))
        room = MOST_PARTICLES[self._device.type] - self.x.shape[1]
        if count > room:
            raise NPAError(f"the world has room for {max(room, 0)} particles more, got {count}")
        ball = uniform_ball(
            1, count, self.dimension, touch.radius, generator=self._generator,
            device=self._device, dtype=self.x.dtype,
        )  # fmt: skip
        # As if it grew alone: what is new divides densities by its own number.
        number = self._number(organism, float(count))
        x = torch.cat((self.x, ball + touch.at[:, None]), dim=1)
        fresh = self._coded(organism, self.s.new_zeros(1, count, self.s.shape[2]))
        s = torch.cat((self.s, fresh), dim=1)
        self._arrange(x, s, torch.nn.functional.pad(self._species(), (0, count), value=number))

    def _all_coded(self, s: Tensor) -> Tensor:
        """Return states of all particles, each with the code of its species."""
        parts = zip(self.organisms, s.split_with_sizes(self.counts, dim=1), strict=True)
        return torch.cat([self._coded(organism, part) for organism, part in parts], dim=1)

    def _coded(self, organism: LiveRule, s: Tensor) -> Tensor:
        """Return states of a species with the code that its rule gives them, where it has such."""
        if organism.rule.codes is None:
            return s
        own = organism.name == self.main.name
        return (self.task if own else self._task_of(organism, None).task).coded(s)

    def _joining(self, name: Any) -> LiveRule:
        organism = self._organism(name)
        if not self._may_join(organism.name):
            raise NPAError(
                f"{organism.name} cannot live in a world of {self.main.name}: rules of one world "
                f"must agree in {', '.join(AGREEMENTS)}, and not divide"
            )
        return organism

    def _number(self, organism: LiveRule, divisor: float) -> int:
        """Return the number of a species, after giving a rule that is new here the next one."""
        names = [own.name for own in self.organisms]
        if organism.name not in names:
            names.append(organism.name)
            self.organisms.append(organism)
            self.counts.append(0)
            self._divisors.append(divisor)
        return names.index(organism.name)

    def _species(self) -> Tensor:
        """Return the species of each particle, int64, shape [N]."""
        numbers = torch.arange(len(self.counts))
        return numbers.repeat_interleave(torch.tensor(self.counts)).to(self._device)

    def _arrange(self, x: Tensor, s: Tensor, species: Tensor) -> None:
        """Take particles in any order, and put them species after species."""
        order = species.argsort(stable=True)
        if not torch.equal(order, torch.arange(self.x.shape[1], device=order.device)):
            # The page's tracers follow particles by their place.
            self._news.append({"type": "reordered"})
        counts = torch.bincount(species, minlength=len(self.organisms)).tolist()
        living = [k for k, count in enumerate(counts) if count] or [0]
        self.x, self.s = x[:, order], s[:, order]
        self.organisms = [self.organisms[k] for k in living]
        self._divisors = [self._divisors[k] for k in living]
        self.counts = [counts[k] for k in living]


def name_of(source: str) -> str:
    """Return what the page calls a rule: its file's name, or that of the run it belongs to."""
    if "#" in source:
        return source.rpartition("#")[2]
    path = rule_file(source)
    return path.resolve().parent.name if path.name == "rule.safetensors" else path.stem


class FollowedLog:
    """The log of a run that goes on: each call reads what has been added since the last one.

    Args:
        path: The file that the run's `JsonlLog` writes.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._seen: tuple[int, ...] = ()
        self._end = 0
        self._last_line = b""
        self.iteration = -1
        """That of the last record; -1: there is none yet."""

    def news(self) -> tuple[list[dict[str, Any]], bool]:
        """Return the records that are new, and whether the log begins anew with them.

        Lines that are no records are left out: the run itself complains of them.

        Raises:
            NPAError: The file cannot be read.
        """
        try:
            now = self._path.stat()
        except FileNotFoundError:
            self._forget()
            return [], False
        if (seen := (now.st_ino, now.st_size, now.st_mtime_ns)) == self._seen:
            return [], False
        self._seen = seen
        with open_regular(self._path, limit=LARGEST_LOG, what="the log") as file:
            file.seek(self._end - len(self._last_line))
            if file.read(len(self._last_line)) != self._last_line:
                # A resumed run has gone back to its checkpoint, or another one has begun here.
                self._forget()
                file.seek(0)
            text = file.read(LARGEST_LOG)
        # What stands behind the last end of a line is being written.
        text = text[: text.rfind(b"\n") + 1]
        anew = self.iteration < 0
        records = []
        for line in text.splitlines(keepends=True):
            self._end += len(line)
            self._last_line = line
            with contextlib.suppress(NPAError):
                record = parse_json(line)
                if isinstance(record, dict) and is_whole(record.get("iteration")):
                    self.iteration = record["iteration"]
                    records.append(record)
        return records, anew

    def _forget(self) -> None:
        self._end, self._last_line, self.iteration = 0, b"", -1


class RunWorld(RuleWorld):
    """The rules of a training run, as of its last checkpoint, in a world that lives on.

    Args:
        folder: The run's folder.
        device: Where the world lives.
        seed: The first world's number.
        particle_count: Particles N; None: as trained.

    Raises:
        NPAError: The folder holds no run, or one that has not written a rule yet.
    """

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
            config = load_config(self._run_folder.config, joint_preset())
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
        """Begin a fresh world of all rules of the run."""
        super().reset(seed)
        if len(self._files) == 1:
            return
        self.organisms = [self._organism(name) for name in self._files]
        worlds = []
        for organism, centre in zip(self.organisms, self._centres, strict=True):
            task = self._task_of(organism, self._each).task
            x, s, _ = task.seed(1, generator=self._generator, device=self._device)
            x[..., 0] += centre
            worlds.append((x, s))
        self.x, self.s = (torch.cat(parts, dim=1) for parts in zip(*worlds, strict=True))
        self.counts = [x.shape[1] for x, _ in worlds]
        self.full = sum(self.counts)
        # As in training, each sees densities as it would alone.
        self._divisors = [float(count) for count in self.counts]

    def describe(self) -> dict[str, Any]:
        """Return the event "world"; which rules there are is the run's matter."""
        return super().describe() | {"rules": [], "rule": None}

    def _settings(self) -> dict[str, Any]:
        told = super()._settings()
        if len(self._files) > 1:
            del told["count"]
        return told

    def _title(self) -> str:
        return self._run_folder.path.resolve().name

    def _note(self) -> str:
        return f"a training run, iteration {self._iteration}"

    def news(self) -> list[dict[str, Any]]:
        """Return the run's new losses, and the world where its rule has changed."""
        if time.monotonic() >= self._due:
            self._due = time.monotonic() + POLL_SECONDS
            try:
                self._poll()
            except NPAError as error:
                # A file that is just being written is whole a moment later.
                self._news.append({"type": "error", "message": str(error)})
        return super().news()

    def _stamp(self) -> list[int]:
        """Return when the rules were written."""
        return [path.stat().st_mtime_ns if path.exists() else 0 for path in self._files.values()]

    def _poll(self) -> None:
        fresh, anew = self._log.news()
        if fresh:
            self._iteration = self._log.iteration
            points = [
                [record["iteration"], record["loss"]]
                for record in fresh
                if is_real(record.get("loss"))
            ]
            self._news.append(
                {
                    "type": "curve", "name": "Training loss", "points": points,
                    "append": not anew,
                }
            )  # fmt: skip
        written = self._stamp()
        fresher = written != self._written
        if fresher:
            # Also where it cannot be read: that is told once.
            self._written = written
            self._take_rules()
        if fresh or fresher:
            self._news.append(self.describe())

    def _take_rules(self) -> None:
        """Take the rules as they are now: the world goes on under them, if they fit."""
        self._still = ()
        fresh = {
            name: load_rule(path, device=self._device).float() for name, path in self._files.items()
        }
        own = {name: self._organism(name).rule for name in fresh}
        goals = self._goal_choices()
        # What follows from the rules as they were, such as the codes of their targets.
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
            # Another run has begun in this folder.
            self._rules.clear()
            self._plant(self.main.name, self._each)
            self._news.append({"type": "reordered"})
        self._goals = goals

    def _goal_choices(self) -> list[Any]:
        """Return what the rules' files say that they are trained on."""
        found: list[Any] = []
        for path in self._files.values():
            metadata = rule_metadata(path)
            held = trained_config(path, metadata).task if "config" in metadata else None
            found.append((metadata.get("task"), held))
        return found


def joint_preset() -> TrainConfig[CoMorphogenesis2DConfig]:
    """Return what the configuration of a run of several rules begins with."""
    config: TrainConfig[CoMorphogenesis2DConfig] = preset("fast", "co_morphogenesis2d")
    return config


def rules_of_run(folder: RunFolder) -> list[Path]:
    """Return the files of a run's rules: one, or those of the species that it trains together.

    Raises:
        NPAError: There are none; the message says what is missing.
    """
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
