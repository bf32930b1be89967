"""Configurations of environments: the keywords of `gym.make`, with their checks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar, Literal, NamedTuple, Self, TypeVar, get_args

import numpy as np
import torch
from torch import Tensor

from npa_envs.checks import (
    MomentInverse,
    check_device,
    check_field,
    check_flag,
    check_fraction,
    check_non_negative,
    check_positive,
    check_word,
    is_real,
)
from npa_envs.envs.core.step_report import PARTICLE_REWARDS, REWARDS
from npa_envs.errors import NPAError, UnknownKeywordError, shown, suggest
from npa_envs.render import STYLES
from npa_envs.world.environment_steps import Boundary, Limits, Physics, Terms

Output = Literal["numpy", "torch"]
OnDivergence = Literal["terminate", "reset", "raise", "ignore"]
Control = Literal["particles", "central"]

MAX_VALUE = 1e9
"""Maximum of a field; so products of fields are finite in float32."""

MAX_RATIO = 1e7
"""Maximum of eps / eps0 and of eps0 / eps; its fourth power is finite in float32."""

TaskConfig = TypeVar("TaskConfig")


class Interface(NamedTuple):
    """Meaning of the columns of an environment's observations and actions."""

    space_dim: int
    """Space dimension D."""
    state_dim: int
    """State channels C."""
    moving: bool
    """Whether actions begin with a displacement, as particles move."""
    state_scale: float
    """State step of an action of 1, dimensionless."""
    species_count: int = 0
    """Species whose densities and density gradients are at the end of a perception; 0: none."""
    target_dim: int = 0
    """Columns of the world's target at the end of an observation; policies ignore them."""

    @property
    def shared_dim(self) -> int:
        """Length of a perception without the densities and density gradients of single species."""
        return self.state_dim * (2 + self.space_dim) + self.space_dim

    @property
    def perception_dim(self) -> int:
        """Length P of a perception vector."""
        return self.shared_dim + self.species_count * (1 + self.space_dim)

    @property
    def action_dim(self) -> int:
        """Length A of an action."""
        return self.state_dim + (self.space_dim if self.moving else 0)

    def states(self, observation: Tensor) -> Tensor:
        """Return the particles' own states s, dimensionless, shape [..., C]."""
        return observation[..., : self.state_dim]

    def mean_states(self, observation: Tensor) -> Tensor:
        """Return the mean states s̄ of their neighbourhoods, dimensionless, shape [..., C]."""
        return observation[..., self.state_dim : 2 * self.state_dim]

    def density_gradient(self, observation: Tensor) -> Tensor:
        """Return the density gradient, (ε / ε0)^{1+D} ∇ρ / N, on a linear scale, shape [..., D]."""
        scaled = observation[..., self.shared_dim - self.space_dim : self.shared_dim]
        size = scaled.norm(dim=-1, keepdim=True)
        return scaled * torch.where(size > 0.0, torch.expm1(size) / size, 1.0)

    def action(self, displacement: Tensor, state_step: Tensor) -> Tensor:
        """Return the action of a displacement and a state step, within the action space.

        Displacements [..., D], fractions of α ε, are clipped to length 1 and left out if particles
        do not move; state steps [..., C] are clipped to ± `state_scale`.
        """
        parts = [(state_step / self.state_scale).clamp(-1.0, 1.0)]
        if self.moving:
            size = displacement.norm(dim=-1, keepdim=True)
            parts.insert(0, (displacement / size.clamp(min=1.0)).clamp(-1.0, 1.0))
        return torch.cat(parts, dim=-1)


@dataclass(frozen=True, kw_only=True)
class WorldConfig:
    """Configuration fields of all environments; pictures show [-1, 1] x [-1, 1] length units."""

    choices: ClassVar[dict[str, tuple[str | None, ...]]] = {
        "moment_inverse": get_args(MomentInverse),
        "boundary": get_args(Boundary),
        "output": get_args(Output),
        "render_mode": (None, "rgb_array", "human"),
    }
    """Values of the fields that take one of a few."""

    elsewhere: ClassVar[dict[str, str]] = {"seed": "give it to reset(seed=...)"}
    """Hints in the error message for keywords that are no fields."""

    fixed: ClassVar[dict[str, str]] = {}
    """Fields that keep their default; where and why, as the end of an error message."""

    taken_by_make: ClassVar[tuple[str, ...]] = ()
    """Keywords that Gymnasium itself takes, for suggestions in error messages."""

    task_config_type: ClassVar[type | None] = None
    """Class of the training task's configuration, which documents fields without a docstring."""

    particle_count: int = 1024
    """Particles in a world, N."""

    state_dim: int = 16
    """State channels of a particle, C; the last three plus 0.5 are its colour."""

    eps: float = 0.1
    """Perception radius ε [length units]."""

    eps0: float = 0.1
    """Radius ε0 that perception is scaled to: the one that rules are trained at [length units]."""

    alpha: float = 0.5
    """Maximum displacement in one step, as a fraction of ε (dimensionless)."""

    state_scale: float = 1.0
    """Change of a state channel by an action of 1 (dimensionless)."""

    update_prob: float = 0.5
    """Probability p that a particle is updated, so that its action counts (dimensionless)."""

    dt: float = 1.0
    """Time step (dimensionless)."""

    position_noise: float = 0.0
    """Standard deviation of the noise added to every position in a step [length units]."""

    moment_inverse: MomentInverse = "threshold"
    """Correction of observed state gradients: "threshold", the paper's, which jumps when neighbours
    become collinear; or "smooth", for rules that are trained with it."""

    boundary: Boundary = "open"
    """"open" space, a "periodic" box into which positions are wrapped, or one whose "reflecting"
    walls mirror them."""

    box_size: float = 2.0
    """Side of the box around the origin, unless space is open [length units]."""

    observation_limit: float = 64.0
    """Observations and states are clipped to ± this; a particle with a clipped state has diverged
    (dimensionless)."""

    position_limit: float = 4.0
    """Coordinates are clipped to ± this; a clipped particle has diverged [length units]."""

    device: str = "cpu"
    """Device of the worlds: "cpu", "cuda" or "cuda:1"."""

    output: Output = "numpy"
    """Type of the returned arrays: "numpy", or "torch" tensors on the device."""

    render_mode: str | None = None
    """None, "rgb_array" or "human" (a window, with pygame)."""

    render_style: str = "particles"
    """What pictures show: "particles" (colours), "density" or "states" (hidden channels)."""

    render_size: int = 256
    """Pixels on each side of a rendered picture."""

    def __post_init__(self) -> None:
        check_positive(self, int, "particle_count", "state_dim")
        check_positive(self, int, "render_size", at_least=8)
        check_positive(self, float, "eps", "eps0", "alpha", "state_scale", "dt", "box_size")
        check_positive(self, float, "observation_limit", "position_limit")
        check_fraction(self, "update_prob")
        check_non_negative(self, "position_noise")
        for name, choices in self.choices.items():
            check_word(self, name, choices)
        fits = self.boundary != "periodic" or self.box_size >= 2.0 * self.eps
        rule = f"be at least 2 eps = {2.0 * self.eps:g}"
        check_field(self, "box_size", fits, rule, "enlarge the box or perceive at a smaller eps")
        fits = self.boundary == "open" or self.position_limit >= 0.5 * self.box_size
        rule = f"be at least half of box_size = {self.box_size:g}"
        hint = "particles would be out of bounds inside the box"
        check_field(self, "position_limit", fits, rule, hint)
        for field in fields(self):
            value = getattr(self, field.name)
            if is_real(value) and value > MAX_VALUE:
                raise NPAError(f"{field.name} must be at most {MAX_VALUE:g}, got {shown(value)}")
        for name in ("eps", "eps0"):
            rule = f"be at least {1.0 / MAX_VALUE:g} length units"
            fits = getattr(self, name) >= 1.0 / MAX_VALUE
            check_field(self, name, fits, rule, "choose another unit of length")
        if not 1.0 / MAX_RATIO <= self.eps / self.eps0 <= MAX_RATIO:
            raise NPAError(
                f"eps / eps0 must lie in [{1.0 / MAX_RATIO:g}, {MAX_RATIO:g}], got "
                f"{self.eps:g} / {self.eps0:g}: perceive at a radius nearer to the rule's own"
            )
        check_device(self.device)
        for name, where in self.fixed.items():
            default = getattr(type(self), name)
            is_default, rule = getattr(self, name) == default, f"be {default!r} {where}"
            check_field(self, name, is_default, rule, "leave it out")

    @property
    def box(self) -> float | None:
        """Side of the box [length units], or None in open space."""
        return None if self.boundary == "open" else self.box_size

    @property
    def periodic_box(self) -> float | None:
        """Side of the box [length units] if it is periodic, else None."""
        return self.box_size if self.boundary == "periodic" else None

    def physics(self, space_dim: int, *, static: bool) -> Physics:
        """Return the constants of motion and perception; `static`: particles never move."""
        return Physics(
            space_dim=space_dim,
            state_dim=self.state_dim,
            eps=self.eps,
            eps0=self.eps0,
            boundary=self.boundary,
            box=None if self.box is None else (self.box,) * space_dim,
            terms=Terms(moment_inverse=self.moment_inverse),
            moving=not static,
            max_displacement=self.alpha * self.eps,
            update_prob=self.update_prob,
            dt=self.dt,
            position_noise=self.position_noise,
            limits=Limits(
                state_scale=self.state_scale,
                perception=self.observation_limit,
                position=self.position_limit,
                state=self.observation_limit,
            ),
        )

    def interface(self, physics: Physics) -> Interface:
        """Return what each column of observations and of actions means."""
        limits = physics.limits
        return Interface(physics.space_dim, self.state_dim, physics.moving, limits.state_scale)

    @classmethod
    def from_keywords(cls, keywords: dict[str, Any]) -> Self:
        """Return a configuration with `keywords` as fields; NumPy values become Python's."""
        known = [field.name for field in fields(cls)]
        for name in keywords:
            if name not in known:
                hint = cls.elsewhere.get(name) or suggest(name, [*known, *cls.taken_by_make])
                raise UnknownKeywordError(f"got an unexpected keyword argument {name!r}: {hint}")
        return cls(**{name: as_python(value) for name, value in keywords.items()})

    def as_config(self, config_type: type[TaskConfig], **changes: Any) -> TaskConfig:
        """Return a training task's configuration from the fields that both have, and `changes`."""
        names = [field.name for field in fields(config_type)]  # type: ignore[arg-type]
        shared = {name: getattr(self, name) for name in names if hasattr(self, name)}
        return config_type(**(shared | changes))

    def check_seed_radius(self, radius: float) -> None:
        """Check that `radius`, within which particles start, is below `position_limit`."""
        rule = f"be below position_limit = {self.position_limit:g}"
        hint = "worlds would begin out of bounds"
        check_field(self, "seed_radius", radius < self.position_limit, rule, hint)


@dataclass(frozen=True, kw_only=True)
class EnvConfig(WorldConfig):
    """Configuration fields of all environments of one species; each task adds its own."""

    choices = WorldConfig.choices | {
        "control": get_args(Control),
        "reward": tuple(REWARDS),
        "on_divergence": get_args(OnDivergence),
        "render_style": STYLES,
    }

    elsewhere = WorldConfig.elsewhere | {
        "num_envs": "many worlds at once are made by gymnasium.make_vec",
        "autoreset_mode": "it is for make_vec(..., vectorization_mode='vector_entry_point'); "
        "Gymnasium's own vector environments take it in vector_kwargs",
    }

    taken_by_make = ("max_episode_steps",)

    on_divergence: OnDivergence = "terminate"
    """What happens to a world that diverges: "terminate" ends its episode; "reset" restarts its
    particles within the episode; "raise" raises an error that names the particle; "ignore"
    continues with values clipped to the limits. `info["diverged"]` is True in each case."""

    reward: str = "dense"
    """What is rewarded, and when: a word of the table in the section Reward."""

    tell_updated: bool = False
    """Report in `info["updated"]` which particles the step updated. The others ignored their
    action, so learners can mask their likelihoods."""

    episode_steps: int | None = None
    """Steps after which the environment itself truncates an episode; None: never. The limit of the
    id stays: the first to be reached ends the episode. Needed where reward is "sparse", except by
    `make_vec`, which has `max_episode_steps`."""

    control: Control = "particles"
    """Who acts: "particles", by a row each; or "central", one controller of few numbers, see the
    section Central control."""

    place_count: int = 4
    """Places P on each side of the grid, where control is "central"; 1: one action for all
    particles."""

    place_reach: float = 1.0
    """Half of the side of the square that grid and observed picture span [length units]."""

    picture_size: int = 8
    """Pixels G on each side of the observed picture, where control is "central"."""

    success_loss: float | None = None
    """The episode ends in success once the loss is at most this; None: as the task decides."""

    seed_pool: int = 0
    """Number of worlds, made once, that episodes start from; 0: each episode starts from a new
    one."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.episode_steps is not None:
            check_positive(self, int, "episode_steps")
        check_flag(self, "tell_updated")
        check_positive(self, int, "seed_pool", at_least=0)
        check_positive(self, int, "place_count")
        check_positive(self, float, "place_reach")
        check_positive(self, int, "picture_size", at_least=2)
        # The observed picture has colours.
        check_positive(self, int, "state_dim", at_least=3 if self.control == "central" else 1)
        if self.success_loss is not None:
            check_non_negative(self, "success_loss")
        if self.task_config_type is not None:
            _ = self.task_config

    @property
    def task_config(self) -> Any:
        """Configuration of the training task, which checks its own fields."""
        assert self.task_config_type is not None, "a class with a training task sets it"
        return self.as_config(self.task_config_type)

    @property
    def target_dim(self) -> int:
        """Number T of target columns at the end of an observation's row; by default 0."""
        return 0

    def interface(self, physics: Physics) -> Interface:
        """Return what each column of observations and of actions means, target columns included."""
        return super().interface(physics)._replace(target_dim=self.target_dim)

    @property
    def per_particle_reward(self) -> bool:
        """Whether `info` has a reward for each particle."""
        return self.reward in PARTICLE_REWARDS


def check_picture_size(config: Any) -> None:
    """Check that `picture_size`, of the observed picture, divides `resolution`, of the loss."""
    rule, hint = f"divide resolution = {config.resolution}", f"try {config.resolution // 2}"
    check_field(config, "picture_size", config.resolution % config.picture_size == 0, rule, hint)


def as_python(value: Any) -> Any:
    """Return a keyword's value with NumPy numbers as Python's, lists and arrays as tuples."""
    if isinstance(value, np.generic | np.ndarray | Tensor):
        value = value.tolist()
    if isinstance(value, Sequence) and not isinstance(value, str):
        return tuple(as_python(entry) for entry in value)
    return value
