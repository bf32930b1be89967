"""What a page and its engine send each other: messages of the page, events of the engine, brushes.

An engine runs the world of a page. That of the viewer is server.py over live_world.py, which the
page reaches by server_connection.js; that of an exported page is rule_world.js in a worker, which
it reaches by worker_connection.js. Messages are JSON objects with a `type` and these fields:

    play    on                run the world (true) or pause it
    step                      one step, while the world is paused
    reset   seed?             a new world from a seed; without it, from the next seed
    set     name, value       name: "speed" or another key of `settings`, "rule", "show", or "loss"
                              (true while its plot is open; otherwise no loss is computed)
    brush   tool, at, move, radius, strength, source?, rule?, view?    one use: see `BrushUse`
    damage  name              one of the world's `damages`, at a random position
    drawn                     the page has drawn a frame; at most two frames are sent and not drawn,
                              so the engine waits for a slow or hidden page
    film    action            "start" or "stop", if `capabilities` has "film"; in between the page
                              sends pictures, JPEG files as Blob objects
    training  action          "stop" the training, "show" its world in this page, or "leave" it for
                              the world that the page began with; what it is to learn is uploaded
                              by HTTP, see `upload` in server.py

Events are objects with a `type` and these fields:

    world                     at first, and after changes: `WorldEvent` has the fields
    frame                     the world at one step: `FrameEvent` has the fields
    reordered                 the particles have new indices
    curve   name, points, append?    points [[x, y], ...] of the plot of a training run; they
                              replace those before unless `append` is true
    film    action            "stop": the film has its greatest length
    file    name, url         a file of a film is ready
    training                  the server's training of a dropped file, at first and after changes:
                              `TrainingEvent` has the fields; engines without one never send it
    acted   middle, pushes, reward, total    a step of an environment: the outline's middle, pushes
                              [x, y, dx, dy], the reward and the sum of rewards
    psnr    value             PSNR of the training's world in this page [dB], see `LearningWorld`
    error   message           a sentence for the user
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple, Required, TypedDict

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.checks import is_real, is_whole
from npa_envs.errors import NPAError, shown, suggest


class WorldEvent(TypedDict, total=False):
    """The event "world"; the page takes missing fields from `BLANK` of page.js."""

    type: Required[Literal["world"]]
    title: str
    note: str  # A sentence for the user, or "".
    dimension: int
    box: list[float] | None  # Sides of the periodic box [length units]; None: open space.
    centre: list[float]  # Centre of the first view [length units].
    half_width: float  # Half the width of the first view [length units].
    outline: list[list[float]]  # Lines [x, y, dx, dy] around the target, from its mean.
    spot: float  # Standard deviation of a particle's spot [length units].
    rules: list[str]  # Values of the setting "rule".
    rule: str | None  # The rule of a newly seeded world.
    others: list[str]  # Rules that the brushes graft and add can put into the world.
    species: list[str]  # Rules of the world's particles.
    shows: list[str]  # Values of the setting "show".
    show: str  # What colours show: a name of `shows_of` of live_world.py.
    class_count: int  # Classes of which the particles' own colours name one; 0: these are others.
    tools: list[dict[str, Any]]  # The world's brushes: `name`, and the fields of `Brush`.
    damages: list[str]  # Kinds of damage, as the page's buttons name them.
    settings: dict[str, dict[str, Any]]  # By name: `value`, `trained`, the fields of `Range`.
    capabilities: list[str]  # Some of "film", "loss".
    playing: bool
    seed: int


class TrainingEvent(TypedDict, total=False):
    """The event "training"; fields that are not known yet are missing."""

    type: Required[Literal["training"]]
    state: Required[Literal["none", "reading", "starting", "learning", "done", "stopped", "failed"]]
    limit: Required[int]  # Maximum size of an uploaded file [bytes].
    id: str  # Name of the run's folder.
    name: str  # Name of the file for the user, or the emoji.
    folder: str  # Path of the run's folder.
    note: str  # What was read, or "".
    preset: str  # Name of the run's preset.
    picture: str  # Name of the picture that is learned, a file to download.
    message: str  # Why it has failed, or has learned nothing.
    refused: str  # Name of a later file of which `message` and `cure` are: it left no rule.
    cure: Literal["whole"]  # Upload again with this keyword, which keeps the background.
    has_rule: bool  # Whether there is a rule to show and download.
    iteration: int
    total: int  # Iterations of the whole run.
    seconds: float  # Time of the training so far [s].
    expected: float | None  # Estimate of the whole run on an idle CPU [s]; None: on CUDA.
    seconds_left: float  # As measured so far [s].
    loss: float  # Training loss.


class FrameEvent(NamedTuple):
    """The event "frame": what a page shows of a world at a step; arrays are flat in JavaScript."""

    step: int  # Steps from the seed.
    positions: NDArray[np.float32]  # Positions [length units], shape [N, D].
    colours: NDArray[np.uint8]  # Red, green and blue, shape [N, 3].
    milliseconds: float  # Moving average of the time of a step [ms].
    loss: float | None  # Metric of the world's task; None: not computed for this frame.


class Range(NamedTuple):
    """The allowed values of a setting, and the scale of its slider."""

    low: float
    high: float
    scale: str | None = None  # "log", or None for a linear slider.
    whole: bool = False  # Whether only whole numbers are allowed.

    def checked(self, name: str, value: Any) -> float:
        """Return `value` if it lies in the range; raise NPAError, which calls it `name`, if not."""
        valid = is_whole(value) if self.whole else is_real(value)
        if not valid or not self.low <= value <= self.high:
            what = "a whole number" if self.whole else "a number"
            raise NPAError(
                f"{name} must be {what} in [{self.low:g}, {self.high:g}], got {shown(value)}"
            )
        return int(value) if self.whole else float(value)


SEEDS = Range(0, 2**53, whole=True)
"""The seeds of worlds; whole numbers in JavaScript are exact up to the last one."""


class Brush(NamedTuple):
    """A brush of the viewer: its button, and when it sends messages."""

    changes: str  # What a world must let it change, see `LiveWorld._allowed`.
    label: str  # The word below its button, and after a colon what it does.
    sends: str
    """When a stroke, from press to release of the pointer, sends messages: "frame", in each frame;
    "motion", in frames in which the pointer moves; "position", at each new position; "once", at its
    start; "line", at its end."""
    takes: str | None = None  # A further field of its messages: "source" or "rule".
    amounts: tuple[float, float] = (0.0, 1.0)
    """The amount of its effect at strength 0, and what strength 1 adds to it; 1 at most."""


BRUSHES = {
    "wipe": Brush("states", "Wipe: sets states to zero; see what grows back", "frame"),
    "cut": Brush("positions", "Cut: opens a slit along the line that you draw", "line"),
    "push": Brush(
        "positions",
        "Pull: carries particles along with the pointer",
        "motion",
        amounts=(0.5, 1.0),
    ),
    "clump": Brush("positions", "Clump: draws particles together", "frame", amounts=(0.0, 0.25)),
    "noise": Brush("positions", "Noise: scatters particles", "frame", amounts=(0.0, 0.6)),
    "inject": Brush(
        "states",
        "Inject: spreads the state of where you press",
        "frame",
        takes="source",
        amounts=(0.0, 0.5),
    ),
    "graft": Brush("species", "Graft: gives particles another rule", "position", takes="rule"),
    "add": Brush("growth", "Add: puts in a seed", "once", takes="rule", amounts=(0.0, 0.5)),
    "remove": Brush("removal", "Remove: takes particles away, for good", "frame"),
}
"""All brushes, in the order of their buttons and keys; a page begins with the first of its world.
`LiveWorld._use_brush` applies those that change positions or states, `RuleWorld._use_brush` the
others, and `BRUSHES` of rule_world.js all. Icons are in page.js."""

MAKES_ROOM = "Remove: takes particles away, which makes room for new ones"
"""The label of `remove` where particles divide."""


class BrushUse(NamedTuple):
    """One use of a brush; it is read from a message "brush"."""

    brush: str  # Name of the brush; `tool` in the message.
    at: Tensor  # Position [length units], shape [1, D].
    move: Tensor  # Movement from there [length units], shape [1, D]; by default zeros.
    radius: float  # Radius of the brush, or width of the gap of `cut` [length units].
    amount: float  # Amount by `Brush.amounts`, in [0, 1], of `strength` in the message, in [0, 1].
    source: Tensor  # Position whose state `inject` spreads [length units], [1, D]; by default `at`.
    view: Tensor  # Unit vector towards the viewer, shape [1, 3]; by default along z.
    rule: Any  # Name of the rule of `graft` or `add`, unchecked.

    @classmethod
    def read(cls, message: Mapping[str, Any], brushes: Mapping[str, Brush], x: Tensor) -> BrushUse:
        """Return the use in a message; tensors have dimension, device and dtype of x [1, N, D].

        `brushes` are those of the world. Raises NPAError for a wrong field.
        """
        name, at, space_dim = message.get("tool"), message.get("at"), x.shape[2]
        if not isinstance(name, str) or name not in brushes:
            raise NPAError(f"unknown brush {shown(name)}: {suggest(name, brushes)}")
        strength = Range(0.0, 1.0).checked("strength", message.get("strength", 1.0))
        least, added = brushes[name].amounts
        return cls(
            name,
            _checked_vector("at", at, space_dim, x),
            _checked_vector("move", message.get("move", [0.0] * space_dim), space_dim, x),
            Range(1e-4, 10.0).checked("radius", message.get("radius")),
            min(1.0, least + added * strength),
            _checked_vector("source", message.get("source", at), space_dim, x),
            _checked_vector("view", message.get("view", [0.0, 0.0, 1.0]), 3, x),
            message.get("rule"),
        )


def _checked_vector(name: str, value: Any, length: int, like: Tensor) -> Tensor:
    fits = isinstance(value, list) and len(value) == length and all(map(is_real, value))
    if not fits or max(map(abs, value)) > 1e4:
        raise NPAError(f"{name} must be {length} finite numbers, got {shown(value)}")
    return like.new_tensor([value])
