"""Base class of worlds that a page shows and changes while they run; colours of particles."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.errors import NPAError, check_known, shown, suggest
from npa_envs.ops import species_fields
from npa_envs.render.colours import GOLDEN_ANGLE, STATE_CHROMA, STATE_GAIN, ramp, srgb
from npa_envs.tasks.damage import check_damage, damage_worlds
from npa_envs.web.messages import BRUSHES, SEEDS, Brush, BrushUse, FrameEvent, Range, WorldEvent
from npa_envs.world.brushes import clump, cut, inject, push, softness, state_around, wipe_state
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import normal_draws


class LiveWorld(ABC):
    """A world that a page shows and changes while it runs."""

    particles: Particles
    """The world, as a batch of one."""

    _generator: torch.Generator | None = None
    """Random numbers of damage and brushes; None: torch's own."""

    _trained_values: Mapping[str, float] = {}
    """Settings as the rule was trained, by name."""

    def __init__(self, seed: int) -> None:
        self.seed = int(SEEDS.checked("seed", seed))
        self.playing = True
        """Whether it runs; else it makes steps only by the message "step"."""
        self.speed = 1
        """Steps from one frame to the next."""
        self.show = "colours"
        self._loss_wanted = False
        self._colouring = Colouring()
        self._events: list[Mapping[str, Any]] = []

    def describe(self) -> WorldEvent:
        """Return the event "world"; subclasses add the fields of their worlds."""
        ranges = self._ranges()
        values = {name: getattr(self, name) for name in ranges}
        trained = {**values, **self._trained_values}
        return {
            "type": "world",
            "tools": [{"name": name} | brush._asdict() for name, brush in self.brushes.items()],
            "shows": self._shows(),
            "show": self.show,
            "settings": {
                name: {"value": values[name], "trained": trained[name]} | limits._asdict()
                for name, limits in ranges.items()
            },
            "playing": self.playing,
            "seed": self.seed,
            "box": None if self.box is None else list(self.box),
        }

    @property
    def brushes(self) -> dict[str, Brush]:
        """The brushes that the world offers, by name."""
        allowed = self._allowed()
        return {name: brush for name, brush in BRUSHES.items() if brush.changes in allowed}

    def handle(self, message: Mapping[str, Any]) -> bool:
        """Apply a message of the page; return whether `describe` returns something else now."""
        action = message.get("type") if isinstance(message, Mapping) else None
        match action:
            case "play":
                self.playing = bool(message.get("on"))
            case "step":
                self.playing = False
                self._run_timed(1)
            case "reset":
                seed = message.get("seed")
                self.reset(None if seed is None else int(SEEDS.checked("seed", seed)))
                return True
            case "set":
                return self._set(str(message.get("name")), message.get("value"))
            case "brush":
                return self._use_brush(BrushUse.read(message, self.brushes, self.particles.x))
            case "damage":
                check_damage(name := message.get("name"))
                self._damage(str(name))
            case _:
                known = ("play", "step", "reset", "set", "brush", "damage")
                raise NPAError(f"unknown message {shown(action)}: {suggest(action, known)}")
        return False

    def advance(self) -> None:
        """Run to the next frame."""
        self._run_timed(self.speed)

    @torch.no_grad()
    def frame(self) -> FrameEvent:
        """Return what the page shows now."""
        world = self._coloured()
        colours = self._colouring(self.show, world)
        loss = self._loss() if self._loss_wanted else None
        positions: NDArray[np.float32] = world.x[0].cpu().numpy()
        return FrameEvent(self.step, positions, colours, self._milliseconds, loss)

    def take_events(self) -> list[Mapping[str, Any]]:
        """Return the events of the world since the last call, to send to the page."""
        events, self._events = self._events, []
        return events

    def close(self) -> None:  # noqa: B027
        """Close what the world has opened; by default nothing."""

    def reset(self, seed: int | None) -> None:
        """Start a new world from a seed; None: from the next one."""
        self.seed = self.seed + 1 if seed is None else seed
        self._begin(self.seed)

    def _begin(self, seed: int | None) -> None:
        """Start a new world from a seed; None: the next episode of an environment."""
        self.step, self._milliseconds = 0, 0.0
        self._travelled: Tensor | None = None
        self._updated: Tensor | None = None

    @property
    @abstractmethod
    def box(self) -> tuple[float, ...] | None:
        """Sides of the periodic box [length units]; None: open space."""

    @abstractmethod
    def _run(self, steps: int) -> None: ...

    @abstractmethod
    def _coloured(self) -> ColouredWorld: ...

    @abstractmethod
    def _loss(self) -> float | None: ...

    @abstractmethod
    def _allowed(self) -> set[str]:
        """Return what brushes may change: some of the values of `Brush.changes`."""

    @abstractmethod
    def _shows(self) -> list[str]: ...

    def _damage(self, name: str) -> None:
        options: Any = {"box": self.box, "generator": self._generator}
        self.particles = damage_worlds(self.particles, kind=name, **options)

    def _use_brush(self, use: BrushUse) -> bool:
        """Apply a brush; return whether `describe` returns something else now."""
        x, s, *_ = self.particles
        disk: dict[str, Any] = {"radius": use.radius, "box": self.box}
        match use.brush:
            case "wipe":
                s = wipe_state(x, s, centre=use.at, **disk)
            case "noise":
                deviation = use.amount * use.radius * softness(x, centre=use.at, **disk)
                x = x + deviation * normal_draws(self._generator, x.shape, x)
            case "push":
                x = push(x, centre=use.at, move=use.move, strength=use.amount, **disk)
            case "clump":
                x, s = clump(x, s, centre=use.at, factor=use.amount, **disk)
            case "cut":
                space_dim, half = x.shape[2], 0.5 * use.move
                move = torch.nn.functional.pad(use.move, (0, 3 - space_dim))
                normal = torch.linalg.cross(use.view, move)[:, :space_dim]
                line: dict[str, Any] = {"centre": use.at + half, "normal": normal, "along": half}
                x, s = cut(x, s, gap=use.radius, box=self.box, **line)
            case "inject":
                state, exists = state_around(x, s, centre=use.source, **disk)
                weight = use.amount * exists.to(x.dtype)
                s = inject(x, s, centre=use.at, state=state, strength=weight, **disk)
        self.particles = self.particles._replace(x=x, s=s)
        return False

    def _set(self, name: str, value: Any) -> bool:
        ranges = self._ranges()
        match name:
            case "show":
                check_known("unknown show", value, self._shows())
                self.show = str(value)
            case "loss":
                self._loss_wanted = bool(value)
            case _ if name in ranges:
                setattr(self, name, ranges[name].checked(name, value))
            case _:
                raise NPAError(f"unknown setting {shown(name)}: {suggest(name, ranges)}")
        return bool(name != "loss")

    def _ranges(self) -> dict[str, Range]:
        """Return the allowed values of the settings, by name; attributes have the same names."""
        return {"speed": Range(1, 64, "log", whole=True)}

    def _run_timed(self, steps: int) -> None:
        start = time.perf_counter()
        self._run(steps)
        each = 1000.0 * (time.perf_counter() - start) / steps
        # A moving average, as single steps may compile kernels or be interrupted.
        self._milliseconds += (0.2 if self._milliseconds else 1.0) * (each - self._milliseconds)


# Colours of a live world's particles by state, density, species, speed or update mask.

BALANCE = 0.9
"""Weight of earlier frames in the moving average of the covariance behind "components"."""

MASK_COLOURS = ((0.29, 0.33, 0.42), (0.98, 0.78, 0.36))
"""Colours of particles that the last step has not updated, and of those that it has."""


class ColouredWorld(NamedTuple):
    """The values of a world from which `Colouring` computes colours."""

    x: Tensor
    s: Tensor
    colours: Callable[[Tensor], Tensor]
    """Maps states [1, N, C] to the rule's colours [1, N, 3], which may exceed [0, 1]."""
    eps: float
    box: tuple[float, ...] | None
    counts: Sequence[int]
    """Particles of each species, species after species."""
    usual_count: int
    """Particles of a newly seeded world."""
    travelled: Tensor | None
    """Distance of each particle in the last step over the largest possible one, [1, N]."""
    updated: Tensor | None
    """Which particles the last step updated, bool, shape [1, N]."""


class Colouring:
    """Computes the colours of one world's particles, frame by frame."""

    def __init__(self) -> None:
        self._average: Tensor | None = None
        """Moving average of the states' covariance."""
        self._basis: Tensor | None = None

    def __call__(self, show: str, world: ColouredWorld) -> NDArray[np.uint8]:
        """Return particles' colours, uint8, shape [N, 3]; `show` is a name of `shows_of`."""
        if world.x.shape[1] == 0:
            return np.zeros((0, 3), dtype=np.uint8)
        match show.split():
            case ["colours"]:
                return _bytes(world.colours(world.s)[0])
            case ["density"]:
                # 1 if the particles fill [-1, 1]^D, or the box, evenly.
                rho = species_fields(world.x, [world.x.shape[1]], eps=world.eps, box=world.box).rho
                volume = float(np.prod(world.box or (2.0,) * world.x.shape[2]))
                crowding = rho[0].sum(dim=-1) * (volume / world.usual_count)
                # Particles in open space are denser, as they fill only a part of [-1, 1]^D.
                return _ramp(1.0 - torch.exp2(-crowding / (1.0 if world.box else 4.0)))
            case ["components"]:
                return _bytes(self._components(world.s[0]))
            case ["species"]:
                return species_colours(len(world.counts)).repeat(world.counts, axis=0)
            case ["speed"]:
                speed = _or_zeros(world.travelled, world)
                fast = speed.kthvalue(math.ceil(0.99 * len(speed))).values.clamp_min(0.01)
                return _ramp((speed / fast).clamp(0.0, 1.0).sqrt())
            case ["mask"]:
                tints = world.x.new_tensor(MASK_COLOURS, dtype=torch.float32)
                return _bytes(tints[_or_zeros(world.updated, world).long()])
            case _:
                channel = int(show.split()[1])
                return _bytes(signed_colours(world.s[0, :, channel]))

    def _components(self, s: Tensor) -> Tensor:
        """Return the first three principal components as colours, in a slowly changing basis."""
        # A NaN would stay in the moving average.
        known = s[s.isfinite().all(dim=-1)].double()
        mean = known.mean(dim=0)
        covariance = (known - mean).T @ (known - mean) / max(len(known), 1)
        if self._average is None or self._average.shape != covariance.shape:
            self._average, self._basis = covariance, None
        self._average = BALANCE * self._average + (1.0 - BALANCE) * covariance
        values, vectors = torch.linalg.eigh(self._average.cpu())
        count = min(3, len(values))
        basis = vectors[:, -count:].flip(-1).to(s.device)
        if self._basis is not None:
            # An eigenvector's sign is arbitrary: colours must not flip between frames.
            sign = (basis * self._basis).sum(dim=0, keepdim=True).sign()
            basis = basis * torch.where(sign == 0, 1.0, sign)
        self._basis = basis
        width = values[-count:].flip(0).clamp_min(1e-12).sqrt().to(s.device)
        colours = 0.5 + 0.22 * ((s.double() - mean) @ basis) / width
        return torch.nn.functional.pad(colours, (0, 3 - count), value=0.5)


def shows_of(state_dim: int, *, species: bool = True, coloured: bool = False) -> list[str]:
    """Return what colours can show of particles with `state_dim` state channels.

    "components" are the first three principal components of the states, "mask" is which particles
    the last step updated. Without `species` there is one species, and masks are unknown. With
    `coloured`, the last three states are colours, which their names say.
    """
    last = ("species", "speed", "mask") if species else ("speed",)
    tints = dict(enumerate((" (red)", " (green)", " (blue)"), state_dim - 3)) if coloured else {}
    states = (f"state {k}{tints.get(k, '')}" for k in range(state_dim))
    return ["colours", "density", "components", *last, *states]


def signed_colours(values: Tensor) -> Tensor:
    """Return colours [..., 3] of numbers [...]: blue below 0, grey at 0, orange above."""
    pull = torch.tanh(0.5 * STATE_GAIN * values)
    lab = (0.62 + 0.18 * pull.abs(), 0.5 * STATE_CHROMA * pull, STATE_CHROMA * pull)
    return srgb(torch.stack(lab, dim=-1))


def species_colours(count: int) -> NDArray[np.uint8]:
    """Return different colours for `count` species, uint8, shape [count, 3]."""
    hue = 0.9 + GOLDEN_ANGLE * torch.arange(count, dtype=torch.float64)
    lab = (torch.full_like(hue, 0.72), 0.13 * hue.cos(), 0.13 * hue.sin())
    return _bytes(srgb(torch.stack(lab, dim=-1)))


def _or_zeros(values: Tensor | None, world: ColouredWorld) -> Tensor:
    """Return a value of each particle from the last step [N]; zeros if there are none."""
    if values is None or values.shape[1] != world.x.shape[1]:
        return torch.zeros(world.x.shape[1], device=world.x.device)
    return values[0]


def colour_tables(species_count: int) -> dict[str, NDArray[np.uint8]]:
    """Return the colours that colours.js reads, by name, each uint8, shape [K, 3].

    "ramp" is `colour_ramp`, "mask" are `MASK_COLOURS`, and "species" has a colour for each species.
    "state" has those of `signed_colours` at equal steps of 1 / (1 + exp(-STATE_GAIN value)).
    """
    values = torch.logit(torch.linspace(0.0, 1.0, 1025)) / STATE_GAIN
    state = _bytes(signed_colours(values))
    species, mask = species_colours(species_count), _bytes(torch.tensor(MASK_COLOURS))
    return {"ramp": colour_ramp(), "state": state, "species": species, "mask": mask}


def colour_ramp() -> NDArray[np.uint8]:
    """Return the colours of densities and speeds from low to high, uint8, shape [K, 3]."""
    table = ramp((0.05, 0.06, 0.09))
    # The darkest colours are invisible on a dark background.
    return table[len(table) // 6 :]


def _ramp(values: Tensor) -> NDArray[np.uint8]:
    table = colour_ramp()
    entry = (values.nan_to_num(0.0) * (len(table) - 1)).round()
    colours: NDArray[np.uint8] = table[entry.to(torch.int32).cpu().numpy()]
    return colours


def _bytes(colours: Tensor) -> NDArray[np.uint8]:
    scaled = (colours.detach().nan_to_num(0.0).clamp(0.0, 1.0) * 255.0).round()
    pixels: NDArray[np.uint8] = scaled.to(torch.uint8).cpu().numpy()
    return pixels
