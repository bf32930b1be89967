"""Live worlds of a rule, and of the newest rules of a training run."""

from __future__ import annotations

import functools
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from npa_envs.errors import NPAError, check_known, shown
from npa_envs.rule.files import load_rule, rule_metadata, rule_name, shipped_rules
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import Task
from npa_envs.tasks.co_morphogenesis2d import CoMorphogenesis2DConfig, together
from npa_envs.tasks.damage import DAMAGE_SIZES
from npa_envs.tasks.seeds import uniform_ball
from npa_envs.tasks.train_config import TrainConfig
from npa_envs.training.run_folder import JsonlLog, RunFolder, file_version
from npa_envs.training.task_of_rule import TrainedTask, task_of_rule, trained_config
from npa_envs.training.task_table import load_config, preset
from npa_envs.web.live_world import ColouredWorld, Colouring, LiveWorld, shows_of
from npa_envs.web.messages import MAKES_ROOM, Brush, BrushUse, Range, WorldEvent
from npa_envs.world.brushes import inside_ball, wipe_state
from npa_envs.world.division import living
from npa_envs.world.particles import Particles
from npa_envs.world.rollout import at_rest, rollout_particles
from npa_envs.world.species import AGREEMENTS, species_particles

MAX_PARTICLES = {"cpu": 16384, "cuda": 131072}
"""Maximum number of particles of a world, by device type."""

MIN_SEED = 16
"""Minimum number of particles that the brush `add` adds."""

REST_CHECK_STEPS = 64
"""Steps between two checks whether the world is at rest."""

LOSS_FRACTION = 0.1
"""Maximum fraction of the time that losses take while their plot is open."""


@dataclass
class LiveRule:
    """A rule that runs some of the world's particles."""

    name: str
    rule: NPARule
    """The rule in float32."""
    count: int = 0
    """Number of its particles."""
    density_count: float = 0.0
    """Number of particles by which its densities are divided."""


class RuleWorld(LiveWorld):
    """A world of one rule, and of other rules that the brushes graft and add put into it.

    Args:
        source: The rule, as for `load_rule`.
        device: Where the world runs.
        seed: Seed of the first world.
        particle_count: Particles of a newly seeded world; None: as trained.
        choices: Other rules that the page offers, by name, as for `load_rule`; None: shipped ones.
        alone: Whether an exported page shows it, which offers other rules by itself.
    """

    _generator: torch.Generator

    def __init__(
        self,
        source: str = "gecko",
        *,
        device: torch.device,
        seed: int = 0,
        particle_count: int | None = None,
        choices: Mapping[str, str] | None = None,
        alone: bool = False,
    ) -> None:
        super().__init__(seed)
        self._device, self._alone = device, alone
        self._rules: dict[str, NPARule] = {}
        # Tasks with their targets, of which the slider of N makes many.
        self._trained = functools.lru_cache(8)(self._load_task)
        shipped = {} if alone else {name: name for name in shipped_rules()}
        others = shipped if choices is None else dict(choices)
        named = {path: name for name, path in (choices or {}).items()}
        name = named.get(source) or rule_name(source)
        self._choices = others | {name: source}
        self._choose_rule(name, particle_count)

    def _live_rule(self, name: Any) -> LiveRule:
        check_known("unknown rule", name, self._choices)
        if name not in self._rules:
            rule = load_rule(self._choices[name], device=self._device).float()
            self._rules[name] = rule.requires_grad_(False)
        return LiveRule(name, self._rules[name])

    def _load_task(self, name: str, particle_count: int | None) -> TrainedTask:
        rule = self._live_rule(name).rule
        # For a fast start: 3D targets of full size take many seconds to draw.
        small_views = {"resolution": 64, "training_views": 1, "held_out_views": 6}
        options: dict[str, Any] = small_views if rule.space_dim == 3 else {}
        options |= {"particle_count": particle_count, "for_page": self._alone}
        return task_of_rule(self._choices[name], rule, self._device, **options)

    def _choose_rule(self, name: Any, particle_count: int | None = None) -> None:
        """Take the rule `name` with the task that it was trained on, and start a new world."""
        main = self._live_rule(name)
        self.trained = self._trained(main.name, particle_count)
        self.main = main
        self.eps, self.update_prob, self.noise = self.task.eps, self.task.update_prob, 0.0
        self.speed = 1
        if self.show not in self._shows():
            self.show = "colours"
        self.reset(self.seed)
        physics = ("eps", "update_prob", "noise", "count")
        self._trained_values = {name: getattr(self, name) for name in physics}

    @torch.no_grad()
    def _begin(self, seed: int | None) -> None:
        """Start a new world whose particles all follow the chosen rule."""
        super()._begin(seed)
        self._generator = torch.Generator(self._device).manual_seed(self.seed)
        seed_world = self.task.seed(1, generator=self._generator, device=self._device)
        # The goal is the world's: it is no field of particles that come and go.
        self.particles, self.goal = seed_world._replace(goal=None), seed_world.goal
        self.count = self.particles.x.shape[1]
        """Particles of a newly seeded world."""
        self.live_rules = [replace(self.main, count=self.count, density_count=float(self.count))]
        self._colouring = Colouring()
        self._loss_due = 0.0
        self._resting, self._next_rest_check = False, REST_CHECK_STEPS

    @property
    def task(self) -> Task:
        """The task of the chosen rule."""
        return self.trained.task

    @property
    def counts(self) -> list[int]:
        """Number of particles of each rule, in the order of `live_rules`."""
        return [live_rule.count for live_rule in self.live_rules]

    @property
    def box(self) -> tuple[float, ...] | None:
        """Sides of the periodic box [length units]; None: open space."""
        return self.task.box

    def describe(self) -> WorldEvent:
        """Return the event "world", all its fields."""
        frame, goal = self.task.frame, self.goal if self.task.classifies else None
        others = " of scikit-learn's digits" if self.trained.why_not_measurable else ""
        return super().describe() | {
            "title": self.main.name,
            "note": "" if goal is None else f"class {int(goal)}{others}",
            "dimension": self.main.rule.space_dim,
            "half_width": frame.half_width,
            "centre": list(frame.centre),
            "spot": 0.7 * self.task.pixel_size,
            "rules": sorted(self._choices),
            "rule": self.main.name,
            "others": [name for name in self._choices if self._may_join(name)],
            "species": [live_rule.name for live_rule in self.live_rules],
            "class_count": int(getattr(self.task.config, "class_count", 0)),
            "damages": list(DAMAGE_SIZES),
            "capabilities": ["film", *([] if self.trained.why_not_measurable else ["loss"])],
        }

    @property
    def brushes(self) -> dict[str, Brush]:
        """The brushes that the world offers, by name."""
        brushes = super().brushes
        if self.main.rule.divides:
            brushes["remove"] = brushes["remove"]._replace(label=MAKES_ROOM)
        return brushes

    def handle(self, message: Mapping[str, Any]) -> bool:
        """Apply a message of the page; return whether `describe` returns something else now."""
        self._resting = False
        return super().handle(message)

    def _allowed(self) -> set[str]:
        allowed = {"positions", "removal"}
        # Rules that divide allow no others in their worlds; their dead particles have no state.
        if not self.main.rule.divides:
            allowed |= {"states", "species"}
            allowed |= set() if self.main.rule.static else {"growth"}
        return allowed

    def _may_join(self, name: str) -> bool:
        """Return whether brushes can put particles of the rule `name` into the world."""
        main = self.main.rule
        try:
            other = self._live_rule(name).rule
        except NPAError:
            return False
        agree = all(getattr(other, field) == getattr(main, field) for field in AGREEMENTS)
        return agree and not (other.divides or main.divides)

    def _ranges(self) -> dict[str, Range]:
        eps0, box = self.main.rule.eps0, self.box
        # A periodic box must have at least two cells of width ε in each direction.
        most = 2.5 * eps0 if box is None else min(2.5 * eps0, 0.499 * min(box))
        ranges = super()._ranges() | {
            "eps": Range(0.4 * eps0, most, "log"),
            "update_prob": Range(0.05, 1.0),
            "noise": Range(0.0, 0.2 * eps0),
        }
        if not self.task.classifies:
            most_particles = max(MAX_PARTICLES[self._device.type], self.count)
            ranges["count"] = Range(64, most_particles, "log", whole=True)
        return ranges

    def _shows(self) -> list[str]:
        return shows_of(self.main.rule.state_dim, coloured=not self.main.rule.readout_dim)

    def _set(self, name: str, value: Any) -> bool:
        if name == "rule":
            self._choose_rule(value)
        elif name == "count" and name in self._ranges():
            count = int(self._ranges()[name].checked(name, value))
            if count != self.count:
                self.trained = self._trained(self.main.name, count)
                self.reset(self.seed)
        else:
            return super()._set(name, value)
        return True

    @torch.no_grad()
    def _run(self, steps: int) -> None:
        self.step += steps
        if self.particles.x.shape[1] == 0:
            return
        watched = self.show in ("mask", "speed")
        if not watched and self._rests():
            return
        options: dict[str, Any] = {
            "eps": self.eps, "box": self.box, "update_prob": self.update_prob,
            "position_noise": self.noise, "generator": self._generator,
        }  # fmt: skip
        if watched and steps > 1:
            # The last step runs by itself, as masks and speeds are those of one step.
            self._rollout(steps - 1, options)
        before = self.particles.s
        path_length = self._rollout(1 if watched else steps, options)
        if watched:
            longest = max(live_rule.rule.alpha for live_rule in self.live_rules) * self.eps
            self._travelled = path_length / longest
            self._updated = (self.particles.s != before).any(dim=-1)
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)

    def _rests(self) -> bool:
        """Return whether a world of one rule is at rest; checks every `REST_CHECK_STEPS` steps."""
        rule = self.main.rule
        can_rest = rule.dead_zone and not rule.divides and not self.noise and self._is_unchanged()
        if can_rest and not self._resting and self.step >= self._next_rest_check:
            self._next_rest_check = self.step + REST_CHECK_STEPS
            x, s, *_ = self.particles
            self._resting = bool(at_rest(rule, x, s, eps=self.eps, box=self.box))
        return self._resting

    def _is_unchanged(self) -> bool:
        """Return whether no brush has added or removed particles or rules."""
        species = [(live_rule.count, live_rule.density_count) for live_rule in self.live_rules]
        return species == [(self.count, self.count)]

    def _rollout(self, steps: int, options: Mapping[str, Any]) -> Tensor:
        """Run steps and return particles' path lengths [length units], shape [1, N]."""
        rules = [live_rule.rule for live_rule in self.live_rules]
        if self._is_unchanged():
            after = rollout_particles(
                rules[0], self.particles, steps, return_path_length=True, **options
            )
        else:
            # Divided by the particles of a newly seeded world: those that a brush adds or removes
            # change only the densities around them.
            density_counts = [live_rule.density_count for live_rule in self.live_rules]
            after = species_particles(
                rules, self.particles, steps, counts=self.counts,
                density_counts=density_counts, return_path_length=True, **options,
            )  # fmt: skip
        assert after.path_length is not None, "it is asked for"
        self.particles = after._replace(path_length=self.particles.path_length)
        return after.path_length

    def _coloured(self) -> ColouredWorld:
        x, s, *_ = self.particles
        travelled, updated = self._travelled, self._updated
        counts = self.counts
        if self.main.rule.divides:
            alive = living(s)[0]
            x, s, counts = x[:, alive], s[:, alive], [int(alive.sum())]
            travelled = None if travelled is None else travelled[:, alive]
            updated = None if updated is None else updated[:, alive]
        return ColouredWorld(
            x, s, functools.partial(self._rule_colours, counts), self.eps, self.box, counts,
            self.count, travelled, updated,
        )  # fmt: skip

    def _rule_colours(self, counts: Sequence[int], s: Tensor) -> Tensor:
        if self.task.classifies:
            return self.task.colours(s)
        groups = zip(self.live_rules, s.split_with_sizes(counts, dim=1), strict=True)
        return torch.cat([live_rule.rule.colour(states) for live_rule, states in groups], dim=1)

    def _loss(self) -> float | None:
        """Return the task's metric; None for several rules, without a target, or if not due yet."""
        start = time.perf_counter()
        comparable = self.trained.why_not_measurable is None and len(self.live_rules) == 1
        if not comparable or not self.counts[0] or start < self._loss_due:
            return None
        loss = float(self.task.with_goal(self.goal).metric(*self.particles[:2]))
        self._loss_due = start + (time.perf_counter() - start) / LOSS_FRACTION
        return loss

    @torch.no_grad()
    def _damage(self, name: str) -> None:
        if self.particles.x.shape[1]:
            super()._damage(name)
            self.particles = self.particles._replace(s=self._all_coded(self.particles.s))

    @torch.no_grad()
    def _use_brush(self, use: BrushUse) -> bool:
        before = [live_rule.name for live_rule in self.live_rules]
        x, s, *_ = self.particles
        ball: dict[str, Any] = {"centre": use.at, "radius": use.radius}
        match use.brush:
            case "remove" if self.main.rule.divides:
                self.particles = self.particles._replace(s=wipe_state(x, s, **ball))
            case "remove":
                outside = ~inside_ball(x, box=self.box, **ball)[0]
                kept = self.particles.map(lambda value: value[:, outside])
                self._arrange(kept, self._species()[outside])
            case "graft":
                self._graft(use)
            case "add":
                self._add(use)
            case _:
                super()._use_brush(use)
                self.particles = self.particles._replace(s=self._all_coded(self.particles.s))
        return before != [live_rule.name for live_rule in self.live_rules]

    def _graft(self, use: BrushUse) -> None:
        x, s, *_ = self.particles
        inside = inside_ball(x, centre=use.at, radius=use.radius, box=self.box)
        # Grafted particles divide densities by the same number as their neighbours.
        index = self._species_index(use.rule, float(self.count))
        s = torch.where(inside[..., None], self._coded(self.live_rules[index], s), s)
        species = torch.where(inside[0], index, self._species())
        self._arrange(self.particles._replace(s=s), species)

    def _add(self, use: BrushUse) -> None:
        count = max(MIN_SEED, round(use.amount * self.count))
        room = MAX_PARTICLES[self._device.type] - self.particles.x.shape[1]
        if count > room:
            raise NPAError(f"the world has room for {max(room, 0)} particles more, got {count}")
        # A new species divides densities by its own number of particles, as in a world of its own.
        index = self._species_index(use.rule, float(count))
        zeros = self.particles.map(lambda value: value.new_zeros(1, count, *value.shape[2:]))
        ball = uniform_ball(
            1, count, zeros.x.shape[2], use.radius, generator=self._generator,
            device=self._device, dtype=zeros.x.dtype,
        )  # fmt: skip
        s = self._coded(self.live_rules[index], zeros.s)
        added = zeros._replace(x=ball + use.at[:, None], s=s)
        species = torch.nn.functional.pad(self._species(), (0, count), value=index)
        self._arrange(together([self.particles, added]), species)

    def _all_coded(self, s: Tensor) -> Tensor:
        """Return states s [1, N, C] in which each particle has the target code of its rule."""
        groups = zip(self.live_rules, s.split_with_sizes(self.counts, dim=1), strict=True)
        return torch.cat([self._coded(live_rule, states) for live_rule, states in groups], dim=1)

    def _coded(self, live_rule: LiveRule, s: Tensor) -> Tensor:
        """Return states s of a rule's particles with its target code, if it has codes."""
        if live_rule.rule.codes is None:
            return s
        is_main = live_rule.name == self.main.name
        task = self.task if is_main else self._trained(live_rule.name, None).task
        return task.with_target_code(s)

    def _species_index(self, name: Any, density_count: float) -> int:
        """Return a rule's index in `live_rules`; append a new rule, which has `density_count`."""
        live_rule = self._live_rule(name)
        if not self._may_join(name):
            raise NPAError(
                f"{name} cannot live in a world of {self.main.name}: rules of one world must agree "
                f"in {', '.join(AGREEMENTS)}, and not divide"
            )
        names = [present.name for present in self.live_rules]
        if name not in names:
            names.append(name)
            self.live_rules.append(replace(live_rule, density_count=density_count))
        return names.index(name)

    def _species(self) -> Tensor:
        """Return the index of each particle's rule in `live_rules`, int64, shape [N]."""
        indices = torch.arange(len(self.counts))
        return indices.repeat_interleave(torch.tensor(self.counts)).to(self._device)

    def _arrange(self, particles: Particles, species: Tensor) -> None:
        """Replace the world's particles, sorted by the index of their rule."""
        order = species.argsort(stable=True)
        if not torch.equal(order, torch.arange(self.particles.x.shape[1], device=order.device)):
            # The page's tracers follow particles by their index.
            self._events.append({"type": "reordered"})
        self.particles = particles.map(lambda value: value[:, order])
        counts = torch.bincount(species, minlength=len(self.live_rules)).tolist()
        for live_rule, count in zip(self.live_rules, counts, strict=True):
            live_rule.count = count
        present = [live_rule for live_rule in self.live_rules if live_rule.count]
        self.live_rules = present or self.live_rules[:1]


class RunWorld(RuleWorld):
    """A world of the rules of a training run, which are replaced at each new checkpoint."""

    def __init__(
        self,
        folder: Path,
        *,
        device: torch.device,
        seed: int = 0,
        particle_count: int | None = None,
        name: str | None = None,
    ) -> None:
        self._run_folder = RunFolder(folder)
        self._points: list[list[float]] = []
        """Iterations and losses of the log."""
        self._log_version: Any = None
        files = rules_of_run(self._run_folder)
        self._files = {name or rule_name(str(path)): path for path in files}
        self._centres = [0.0]
        if len(files) > 1:
            # Seeds lie in a row, as in training.
            joint: TrainConfig[CoMorphogenesis2DConfig] = preset("fast", "co_morphogenesis2d")
            config = load_config(self._run_folder.config, joint)
            self._centres = list(config.task.centres)
        self._each = None if particle_count is None else max(1, particle_count // len(files))
        self._written = [file_version(path) for path in files]
        self._iteration = 0
        self._poll_due = 0.0
        choices = {name: str(path) for name, path in self._files.items()}
        super().__init__(
            str(files[0]), device=device, seed=seed, particle_count=self._each, choices=choices
        )
        rules = {name: self._live_rule(name).rule for name in self._files}
        self._run_identities = self._identities(rules)

    @torch.no_grad()
    def _begin(self, seed: int | None) -> None:
        super()._begin(seed)
        if len(self._files) == 1:
            return
        self.live_rules = [self._live_rule(name) for name in self._files]
        worlds = []
        for live_rule, centre in zip(self.live_rules, self._centres, strict=True):
            task = self._trained(live_rule.name, self._each).task
            world = task.seed(1, generator=self._generator, device=self._device)
            world.x[..., 0] += centre
            worlds.append(world._replace(goal=None))
            # As in training, each species divides densities by its own number of particles.
            live_rule.count = live_rule.density_count = world.x.shape[1]
        self.particles = together(worlds)
        self.count = sum(self.counts)

    def describe(self) -> WorldEvent:
        """Return the event "world" for the page; its list of rules to choose from is empty."""
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

    def take_events(self) -> list[Mapping[str, Any]]:
        """Return the events since the last call, once a second also of new losses and rules."""
        if time.monotonic() >= self._poll_due:
            self._poll_due = time.monotonic() + 1.0
            try:
                self._poll()
            except NPAError as error:
                # Usually a file that is being written; the next check reads it.
                self._events.append({"type": "error", "message": str(error)})
        return super().take_events()

    def _poll(self) -> None:
        logged = self._read_log()
        written = [file_version(path) for path in self._files.values()]
        if written != self._written:
            # Set before reading, so that an error is reported only once.
            self._written = written
            self._take_rules()
        elif not logged:
            return
        self._events.append(self.describe())

    def _read_log(self) -> bool:
        """Read the log if it has changed, and return whether it has new records."""
        path, shown_points = self._run_folder.log, self._points
        version = file_version(path)
        if version == self._log_version:
            return False
        self._log_version = version
        records = JsonlLog(path).records()
        self._points = [[r["iteration"], r["loss"]] for r in records if "loss" in r]
        continues = bool(shown_points) and self._points[: len(shown_points)] == shown_points
        points = self._points[len(shown_points) :] if continues else self._points
        if points:
            self._iteration = records[-1]["iteration"]
            curve = {"type": "curve", "name": "Training loss", "points": points}
            self._events.append(curve | {"append": continues})
        return bool(points)

    def _take_rules(self) -> None:
        """Load the newest rules; the world continues if they are of the same run."""
        self._resting = False
        new_rules = {
            name: load_rule(path, device=self._device).float() for name, path in self._files.items()
        }
        identities = self._identities(new_rules)
        # Cached tasks have the codes of the old rules.
        self._trained.cache_clear()
        if identities == self._run_identities:
            for name, rule in new_rules.items():
                self._live_rule(name).rule.load_state_dict(rule.state_dict())
            task = self.task.for_rule(self.main.rule)
            self.trained = replace(self.trained, task=task)
            with torch.no_grad():
                s = self._all_coded(self.particles.s)
            self.particles = self.particles._replace(s=s)
        else:
            # Another run was started in the folder.
            self._rules.clear()
            self._choose_rule(self.main.name, self._each)
            self._events.append({"type": "reordered"})
        self._run_identities = identities

    def _identities(self, rules: Mapping[str, NPARule]) -> list[Any]:
        """Return hyper-parameters and task of each of the run's rules; another run has others."""
        identities: list[Any] = []
        for name, rule in rules.items():
            path = self._files[name]
            metadata = rule_metadata(path)
            config = trained_config(path, metadata).task if "config" in metadata else None
            identities.append((rule.hyper_parameters(), metadata.get("task"), config))
        return identities


def rules_of_run(folder: RunFolder) -> list[Path]:
    """Return the files of all rules that a run trains."""
    path = str(folder.path)
    if not folder.path.is_dir():
        raise NPAError(f"a run must be a folder, got {shown(path)}: name the one given as --out")
    several = len(list(folder.path.glob("rule-[0-9]*.safetensors")))
    files = [folder.rule_of(k) for k in range(several)]
    if folder.rule.is_file():
        return [folder.rule]
    if files and all(path.is_file() for path in files):
        return files
    if folder.config.is_file() or folder.log.is_file():
        raise NPAError(
            f"the run in {shown(path)} has not written its rules yet: wait for its first checkpoint"
        )
    raise NPAError(
        f"the folder {shown(path)} must hold the {folder.rule.name} of a run, it does not: name "
        "another one"
    )
