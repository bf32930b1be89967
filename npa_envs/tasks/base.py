"""Base classes of tasks and of their configurations.

The trainer calls the methods of `ParticleTask`. `GrowthTask` is for tasks in which a ball of
particles with zero states grows into a target.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Generic, NamedTuple, Self, TypeVar

import torch
from torch import Tensor

from npa_envs.checks import check_flag, check_fraction, check_non_negative, check_positive
from npa_envs.errors import NPAError, shown
from npa_envs.ops import world_mean
from npa_envs.rule.rule import COLOUR_OFFSET, NPARule
from npa_envs.tasks.damage import DAMAGE_CHANCE, far_points, random_particle, tear_off
from npa_envs.tasks.seeds import uniform_ball
from npa_envs.tasks.train_config import Common, Unlisted
from npa_envs.world.brushes import clump, cut, wipe_state
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import Randomness, uniform_draws


class Frame(NamedTuple):
    """The square or cube of space that viewers show."""

    centre: tuple[float, ...]
    """Its centre [length units]."""
    half_width: float
    """Half of its side [length units]."""


@dataclass(frozen=True, kw_only=True)
class TaskConfig:
    """Settings that all tasks share: sizes of world, rule and picture. Subclasses add their own."""

    particle_count: Common[int] = 4096
    """Particles in a world, N."""

    state_dim: int = 16
    """State channels of a particle, C; the last three are its colour (less 0.5)."""

    hidden_dim: Common[int] = 128
    """Width of the rule's hidden layer."""

    eps: Common[float] = 0.1
    """Perception radius ε [length units]; the rule is trained at it, so it is also its ε0."""

    update_prob: float = 0.5
    """Probability p that a particle is updated in a step (dimensionless)."""

    resolution: Common[int] = 128
    """Pixels on each side of a world's picture, R."""

    overflow_weight: float = 100.0
    """Weight of the penalty of states beyond [-1, 1], mean |s − clip(s, −1, 1)|
    (dimensionless)."""

    def __post_init__(self) -> None:
        check_positive(self, int, "particle_count", "state_dim", "hidden_dim")
        check_positive(self, int, "resolution", at_least=2)
        check_positive(self, float, "eps")
        check_fraction(self, "update_prob")
        check_non_negative(self, "overflow_weight")

    @property
    def goal_text(self) -> str:
        """The name of the target, or of the task if it has none, for reports."""
        return str(getattr(self, "target", type(self).__name__.removesuffix("Config")))

    def with_particle_count(self, particle_count: int) -> Self:
        """Return the same task with another number of particles."""
        return replace(self, particle_count=particle_count)


ConfigT = TypeVar("ConfigT", bound=TaskConfig)


class ParticleTask(Generic[ConfigT]):
    """A task: its initial worlds, untrained rule, loss, metric and pictures.

    A subclass defines `rule_shape`, `places`, `compare`, `metric` and `picture`; all else has
    defaults. In all methods x are positions [length units], shape [B, N, D], and s states
    (dimensionless), shape [B, N, C].

    No method may synchronise with the device (no `.item()`, no branch on a tensor's value): the
    trainer captures `seed`, `damage` and `loss` in CUDA graphs. So these must launch the same work
    in every iteration, and take random numbers from their generator only.
    """

    config: ConfigT
    """Sizes of worlds, of the rule and of pictures, and weights of the loss."""

    space_dim: int = 2
    """Space dimension D."""

    metric_name: str = "loss"
    """Name of what `metric` measures, for tables."""

    aligned: bool = False
    """Whether worlds are compared with `target_picture` pixel by pixel, so a PSNR makes sense."""

    grows_picture: bool = False
    """Whether worlds grow one picture or object, so that healing is measured near wounds: the task
    has `pixel_errors`, `pixels_near` and `spread_places`, as `Morphogenesis2D` explains them."""

    has_views: bool = False
    """Whether the task is a `Morphogenesis3D`, whose worlds are drawn from any camera."""

    has_texture_metric: bool = False
    """Whether the task is a `Texture`: `npa_envs.measure.texture_metric` compares its pictures."""

    classifies: bool = False
    """Whether the task is a `PointClassification`, whose particles do not move."""

    goal_count: int = 0
    """Number of targets or classes that a world's goal chooses from; 0: worlds have no goals."""

    species_counts: tuple[int, ...] = ()
    """Number of particles of each species, where each has its own rule; (): one rule for all."""

    _resized_with: tuple[str, ...] = ()
    """Names of the attributes that `resized` passes to the constructor as keywords."""

    _mean_of_processes: Callable[[Tensor], Tensor] | None = None
    _goal: Tensor | None = None
    _wounds: tuple[Tensor, float] | None = None
    _target_picture: Tensor | None = None
    _pixel_size: float | None = None

    @property
    def eps(self) -> float:
        """Perception radius [length units]."""
        return self.config.eps

    @property
    def box(self) -> tuple[float, ...] | None:
        """Sides of the periodic box [length units]; None: open space."""
        return None

    @property
    def update_prob(self) -> float:
        """Probability of a particle's update in a step (dimensionless)."""
        return self.config.update_prob

    @property
    def rollout_options(self) -> dict[str, Any]:
        """Keyword arguments of `npa_envs.rollout` for worlds of the task."""
        return {"eps": self.eps, "box": self.box, "update_prob": self.update_prob}

    @property
    def frame(self) -> Frame:
        """The region that viewers show: the box, or in open space a square or cube around 0."""
        open_space = 1.1 if self.space_dim == 2 else 0.95
        half_width = open_space if self.box is None else 0.5 * min(self.box)
        return Frame((0.0,) * self.space_dim, half_width)

    @property
    def pixel_size(self) -> float:
        """Distance between neighbouring particles of a grown world, about [length units]."""
        return self._pixel_size or (0.1 / self.config.particle_count) ** (1.0 / 3.0)

    @property
    def target_picture(self) -> Tensor:
        """The picture to match, dimensionless, shape [R, R, 4]; AttributeError if there is none.

        Channels are red, green and blue, each summed over the particles' splats (the Gaussian spots
        that draw them), and the density, the sum of the splats.
        """
        if self._target_picture is None:
            raise AttributeError(f"{type(self).__name__} has no picture to match")
        return self._target_picture

    @property
    def rule_shape(self) -> dict[str, Any]:
        """Arguments of `NPARule` in addition to state_dim, hidden_dim and eps0."""
        raise NotImplementedError

    def make_rule(self, generator: torch.Generator) -> NPARule:
        """Return an untrained rule on the CPU, with random weights from `generator`."""
        config = self.config
        sizes = {"state_dim": config.state_dim, "hidden_dim": config.hidden_dim}
        return untrained_rule(generator, **(sizes | {"eps0": config.eps} | self.rule_shape))

    def make_rules(self, generator: torch.Generator) -> list[NPARule]:
        """Return an untrained rule for each species, or one for all, on the CPU."""
        return [self.make_rule(generator)]

    def places(self, world_count: int, generator: Randomness, device: torch.device) -> Tensor:
        """Return the positions in B = `world_count` initial worlds [length units], [B, N, D]."""
        raise NotImplementedError

    def seed(
        self, world_count: int, *, generator: Randomness, device: str | torch.device = "cpu"
    ) -> Particles:
        """Return initial worlds: positions by `places`, states 0, no goals."""
        x = self.places(world_count, generator, torch.device(device))
        return Particles(x, x.new_zeros(*x.shape[:2], self.config.state_dim))

    def damage(self, worlds: Particles, generator: Randomness) -> Particles:
        """Return worlds after the damage of training; goals may change. By default: `worlds`."""
        return worlds

    def begin(self, iteration: int) -> None:
        """Prepare `loss` for an iteration: choose what differs between them, such as views.

        The choice depends on the iteration's number only, so that a resumed run equals an
        uninterrupted one. It is written to the same tensors each time: CUDA graphs read these.
        """

    def for_rule(self, rule: NPARule) -> Self:
        """Return a copy of the task whose loss and pictures use a rule's codes or read-out.

        They read the rule's parameters at each call and are differentiable in them. A task that
        uses neither returns itself.
        """
        return self

    def with_goal(self, goal: Tensor | None) -> Self:
        """Return a copy of the task whose loss and metric compare worlds with these goals.

        `goal` has the index of each world's target or class: int64, shape [B]. Values are read at
        each call, and on CUDA their range is not checked. The task returns itself for None, or if
        `goal_count` is 0.
        """
        count = self.goal_count
        if goal is None or count == 0:
            return self
        if not isinstance(goal, Tensor) or goal.dtype != torch.int64 or goal.ndim != 1:
            is_tensor = isinstance(goal, Tensor)
            got = f"{goal.dtype} {tuple(goal.shape)}" if is_tensor else shown(goal)
            raise NPAError(
                f"goal must be an int64 tensor of shape [B], got {got}: for example "
                "torch.tensor([0])"
            )
        if goal.device.type == "cpu" and not bool(((goal >= 0) & (goal < count)).all()):
            raise NPAError(
                f"goal must have entries of at least 0 and below {count}, got "
                f"{shown(goal.tolist())}: for example torch.tensor([0])"
            )
        return self._copy_with(_goal=goal)

    @property
    def goal(self) -> Tensor:
        """Index of each world's target or class, int64, shape [B]."""
        if self._goal is None:
            raise NPAError("the worlds' goals must be given first: task.with_goal(goal), int64 [B]")
        return self._goal

    def process_mean(self, value: Tensor) -> Tensor:
        """Return the mean of a tensor over all training processes, or the tensor if there is one.

        Each process calls it with its own tensor of the same shape.
        """
        return value if self._mean_of_processes is None else self._mean_of_processes(value)

    def with_process_mean(self, mean: Callable[[Tensor], Tensor]) -> Self:
        """Return a copy of the task for one of several training processes.

        `mean` returns the mean of a tensor over all of them.
        """
        return self._copy_with(_mean_of_processes=mean)

    def with_target_code(self, s: Tensor) -> Tensor:
        """Return states [B, N, C] with the code of the world's target in their first channels.

        Damage may have erased it there. The result is differentiable in codes that are learned.
        Tasks without codes return `s`.
        """
        return s

    def wounds_between(self, before: Particles, after: Particles) -> Tensor | None:
        """Return which pixels of each world's picture a damage has changed, uint8, [B, R, R].

        None for tasks whose worlds do not grow an upright picture each.
        """
        return None

    def with_wounds(self, wounds: Tensor, weight: float) -> Self:
        """Return a copy of the task whose loss also has, by `weight`, the mean over these pixels.

        `wounds` are 0 or 1, uint8, shape [B, R, R], as of `wounds_between`, and read at each call.
        """
        return self._copy_with(_wounds=(wounds, weight))

    def held_out(self) -> Self:
        """Return the task with test data in place of training data; without data, itself."""
        return self

    def resized(self, particle_count: int) -> Self:
        """Return a new task with another number of particles; call `for_rule` on it again."""
        make: Any = type(self)
        options = {name: getattr(self, name) for name in self._resized_with}
        config = self.config.with_particle_count(particle_count)
        task: Self = make(config, device=self.target_picture.device, **options)
        return task

    def compare(self, worlds: Particles) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the weighted distance from the target and its unweighted terms by name, all []."""
        raise NotImplementedError

    def penalties(self, worlds: Particles) -> dict[str, tuple[float, Tensor]]:
        """Return the other terms of the loss: name -> (weight, term of shape []).

        By default it is "overflow", of states beyond [-1, 1].
        """
        outside = (worlds.s - worlds.s.clamp(-1.0, 1.0)).abs().mean()
        return {"overflow": (self.config.overflow_weight, outside)}

    def loss(self, worlds: Particles) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the training loss, `compare` plus `penalties`, [], and unweighted terms by name.

        The worlds are the end of a rollout: they have `path_length`.
        """
        path, expected = worlds.path_length, tuple(worlds.x.shape[:2])
        if path is None or path.shape != expected:
            got = "none" if path is None else str(tuple(path.shape))
            raise NPAError(f"path_length must have shape {expected}, got {got}")
        total, terms = self.compare(worlds)
        for name, (weight, term) in self.penalties(worlds).items():
            terms[name] = term
            total = total + weight * term
        return total, terms

    def picture(self, x: Tensor, s: Tensor) -> Tensor:
        """Return each world's picture, shape [B, R, R, 4]; channels are as in `target_picture`."""
        raise NotImplementedError

    def metric(self, x: Tensor, s: Tensor) -> Tensor:
        """Return each world's distance from the target, shape [B]; lower is better."""
        raise NotImplementedError

    @property
    def trial_name(self) -> str:
        """Name of what `trial_metric` measures, for tables."""
        return self.metric_name

    def trial_metric(self, worlds: Particles) -> Tensor:
        """Return the metric of each world in `npa-envs robustness`, [B]; by default `metric`."""
        return self.metric(worlds.x, worlds.s)

    def colours(self, s: Tensor) -> Tensor:
        """Return each particle's colour as pictures show it, shape [B, N, 3]."""
        return s[..., -3:] + COLOUR_OFFSET

    def _copy_with(self, **fields: object) -> Self:
        """Return a shallow copy whose attributes `fields` have new values."""
        # Not by copy.copy, which would leave out what `__getstate__` keeps from pickles.
        bound = object.__new__(type(self))
        vars(bound).update(vars(self) | fields)
        return bound


Task = ParticleTask[Any]
"""Any task."""

PictureTask = Task
"""Any task, where only its pictures are used."""


@dataclass(frozen=True, kw_only=True)
class GrowthConfig(TaskConfig):
    """Settings of growth from a ball: target, damage in training, penalties of the loss.

    Training damages worlds of its pool, from which batches continue.
    """

    damage_radius: float = 0.0
    """Radius of the ball whose state is wiped in worlds from the pool [length units]; 0: none."""

    clump_radius: float = 0.0
    """Radius of the ball whose particles are pulled to one point, in a quarter of the worlds from
    the pool [length units]; 0: none."""

    cut_gap: float = 0.0
    """Width of the slit through `cut_share` of the worlds from the pool [length units]; 0: none."""

    cut_share: float = DAMAGE_CHANCE
    """Probability that a world from the pool is cut (dimensionless)."""

    cut_anywhere: Unlisted[bool] = False
    """Cuts run through random particles. If False, they run through the centroid."""

    flake_radius: float = 0.0
    """Radius up to which a ball of particles is torn off and thrown out, in a quarter of the worlds
    from the pool [length units]; 0: none."""

    escape_share: float = 0.0
    """Probability that a particle is thrown out of a world from the pool (dimensionless)."""

    target: str
    """What to grow."""

    alpha: float = 0.5
    """Largest displacement in one step, as a fraction of ε (dimensionless)."""

    seed_radius: float = 0.2
    """Radius of the ball that the particles start in [length units]."""

    motion_weight: float = 0.01
    """Weight of the path length Σ|Δx| of a rollout (per length unit)."""

    bound_weight: float = 100.0
    """Weight of the penalty of positions outside, mean |x − clip(x, −1, 1)| (per length unit)."""

    escape_weight: float = 0.0
    """Weight of the mean path length of particles outside of [−1, 1] (per length unit)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_fraction(self, "cut_share")
        check_flag(self, "cut_anywhere")
        check_non_negative(self, "damage_radius", "clump_radius", "cut_gap", "flake_radius")
        check_positive(self, int, "state_dim", at_least=3)
        check_positive(self, int, "resolution", at_least=8)
        check_positive(self, float, "alpha", "seed_radius")
        check_non_negative(self, "motion_weight", "bound_weight", "escape_weight", "escape_share")


GrowthConfigT = TypeVar("GrowthConfigT", bound=GrowthConfig)


class GrowthTask(ParticleTask[GrowthConfigT]):
    """A task of growing a target in open space; a subclass compares worlds with the target."""

    aligned = True

    @property
    def rule_shape(self) -> dict[str, Any]:
        """Arguments of `NPARule` in addition to state_dim, hidden_dim and eps0."""
        return {"space_dim": self.space_dim, "alpha": self.config.alpha}

    def places(self, world_count: int, generator: Randomness, device: torch.device) -> Tensor:
        """Return positions uniform in a ball around the origin."""
        count, radius = self.config.particle_count, self.config.seed_radius
        return uniform_ball(
            world_count, count, self.space_dim, radius, generator=generator, device=device
        )

    def damage(self, worlds: Particles, generator: Randomness) -> Particles:
        """Return worlds after each kind of damage that the configuration sets, at random places."""
        config = self.config
        x, s, *_ = worlds

        def chosen_worlds(probability: float) -> Tensor:
            """Return a random 0 or 1 for each world, shape [B], 1 with this probability."""
            return (uniform_draws(generator, (len(x), 1), x)[:, 0] < probability).to(x.dtype)

        if config.damage_radius > 0.0:
            centre = random_particle(x, generator)
            s = wipe_state(x, s, centre=centre, radius=config.damage_radius)
        if config.clump_radius > 0.0:
            centre = random_particle(x, generator)
            radius = config.clump_radius * chosen_worlds(DAMAGE_CHANCE)
            x, s = clump(x, s, centre=centre, radius=radius, factor=1.0)
        if config.cut_gap > 0.0:
            # Directions need not be uniform; a zero vector cuts nothing.
            normal = 2.0 * uniform_draws(generator, (len(x), x.shape[2]), x) - 1.0
            hit = chosen_worlds(config.cut_share)
            centre = random_particle(x, generator) if config.cut_anywhere else world_mean(x)
            x, s = cut(x, s, centre=centre, normal=normal, gap=config.cut_gap * hit)
        if config.flake_radius > 0.0:
            x = tear_off(x, radius=config.flake_radius, generator=generator)
        if config.escape_share > 0.0:
            drawn = uniform_draws(generator, (*x.shape[:2], 1), x)
            far = far_points(x, x.shape[1], generator)
            x = torch.where(drawn < config.escape_share, far, x)
        return worlds._replace(x=x, s=s)

    def penalties(self, worlds: Particles) -> dict[str, tuple[float, Tensor]]:
        """Return the penalties "motion", "overflow" and "bound" and, if weighted, "stray".

        They are of path lengths, of states and positions beyond [-1, 1], of path lengths there.
        """
        config, bounded = self.config, self.bounded(worlds.x)
        terms = {"motion": (config.motion_weight, distances_moved(worlds).mean())}
        terms |= super().penalties(worlds)
        terms["bound"] = config.bound_weight, (bounded - bounded.clamp(-1.0, 1.0)).abs().mean()
        if config.escape_weight > 0.0:
            # As losses are averaged over processes, so is the number of particles.
            outside = (bounded.detach().abs().amax(dim=-1) > 1.0).to(bounded.dtype)
            count = self.process_mean(outside.sum())
            path_length = (outside * distances_moved(worlds)).sum()
            stray = path_length / torch.where(count > 0.0, count, 1.0)
            terms["stray"] = config.escape_weight, stray
        return terms

    def bounded(self, x: Tensor) -> Tensor:
        """Return the numbers that `penalties` keep in [-1, 1], shape [B, N, any]: by default x."""
        return x


def distances_moved(worlds: Particles) -> Tensor:
    """Return the path lengths of particles since the rollout's start [length units], [B, N]."""
    assert worlds.path_length is not None, "worlds are the end of a rollout"
    return worlds.path_length


def contributions_to_loss(loss: Tensor, effects: Tensor) -> Tensor:
    """Return N times each particle's contribution to its world's `loss` [B]; shape [B, N].

    It is loss + N (effect - mean effect of the world), so its mean over particles is the loss, up
    to rounding. An effect is the derivative of the loss with respect to a factor on the particle's
    splat or opacity; `effects` has shape [B, N].
    """
    excess = effects - world_mean(effects[..., None])
    return loss[:, None] + effects.shape[1] * excess


def untrained_rule(generator: torch.Generator, **hyper_parameters: Any) -> NPARule:
    """Return a rule on the CPU with random weights from `generator`; torch's own state is kept."""
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(int(torch.randint(2**31, (), generator=generator)))
        return NPARule(**hyper_parameters)
