"""Base classes of tasks.

The trainer calls the methods of `ParticleTask`, which has defaults for most of them. `GrowthTask`
adds those of tasks in which a ball of particles with zero states grows into a target.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Generic, NamedTuple, Self, TypeVar

import torch
from torch import Tensor

from npa_envs.checks import check_fraction, check_non_negative, check_positive
from npa_envs.errors import NPAError, shown
from npa_envs.ops import world_mean
from npa_envs.rule.rule import COLOUR_OFFSET, NPARule
from npa_envs.tasks.damage import CHANCE, far_points, random_particle, tear_off
from npa_envs.tasks.seeds import uniform_ball
from npa_envs.tasks.train_config import Common
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
    """Weight of mean |s − clip(s, −1, 1)| (dimensionless)."""

    def __post_init__(self) -> None:
        check_positive(self, int, "particle_count", "state_dim", "hidden_dim")
        check_positive(self, int, "resolution", at_least=2)
        check_positive(self, float, "eps")
        check_fraction(self, "update_prob")
        check_non_negative(self, "overflow_weight")

    @property
    def goal_text(self) -> str:
        """What rules are trained for, in a few words: the target, or else the task's name."""
        return str(getattr(self, "target", type(self).__name__.removesuffix("Config")))

    def with_particle_count(self, particle_count: int) -> Self:
        """Return the same task with another number of particles."""
        return replace(self, particle_count=particle_count)


ConfigT = TypeVar("ConfigT", bound=TaskConfig)


class ParticleTask(Generic[ConfigT]):
    """A task: its worlds, untrained rule, loss, metric and pictures.

    A subclass defines where particles start (`places`), the loss (`compare`), a metric and a
    picture; all else has defaults. `seed` returns initial worlds. In all methods x are positions
    [length units], shape [B, N, D], and s states (dimensionless), shape [B, N, C].

    No method may synchronise with the device (no `.item()`, no branch on a tensor's value): the
    trainer captures `seed`, `damage` and `loss` in CUDA graphs and never reads a number back
    between two log lines. So these must launch the same work in every iteration, and draw from
    their generator alone.
    """

    config: ConfigT
    """World, rule and loss."""

    space_dim: int = 2
    """Space dimension D."""

    metric_name: str = "loss"
    """Name of `metric` in tables."""

    aligned: bool = False
    """Whether worlds are compared with `target_picture` pixel by pixel, so a PSNR makes sense."""

    has_views: bool = False
    """Whether the task is a `Morphogenesis3D`, whose worlds are drawn from any camera."""

    has_texture_metric: bool = False
    """Whether `npa_envs.measure.texture_metric` compares pictures of the task."""

    classifies: bool = False
    """Whether static particles output class scores of their point cloud."""

    goal_count: int = 0
    """Number of different goals of worlds; 0: worlds have no goals."""

    species_counts: tuple[int, ...] = ()
    """Particles of each species, where each has its own rule (`make_rules`); (): one rule."""

    _resized_with: tuple[str, ...] = ()
    """Attributes that `resized` passes to the constructor."""

    _mean_of_processes: Callable[[Tensor], Tensor] | None = None
    _goal: Tensor | None = None
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
        """Options of `npa_envs.rollout` for worlds of the task."""
        return {"eps": self.eps, "box": self.box, "update_prob": self.update_prob}

    @property
    def frame(self) -> Frame:
        """The region that viewers show: the box, or a square or cube around the origin."""
        open_space = 1.1 if self.space_dim == 2 else 0.95
        half_width = open_space if self.box is None else 0.5 * min(self.box)
        return Frame((0.0,) * self.space_dim, half_width)

    @property
    def pixel_size(self) -> float:
        """Usual distance between particles [length units]."""
        return self._pixel_size or (0.1 / self.config.particle_count) ** (1.0 / 3.0)

    @property
    def target_picture(self) -> Tensor:
        """The picture to match, dimensionless, shape [R, R, 4]; AttributeError if there is none.

        Channels are red, green and blue, each summed over splats, and the density.
        """
        if self._target_picture is None:
            raise AttributeError(f"{type(self).__name__} has no picture to match")
        return self._target_picture

    @property
    def rule_shape(self) -> dict[str, Any]:
        """Arguments of `NPARule` in addition to state_dim, hidden_dim and eps0."""
        raise NotImplementedError

    def make_rule(self, generator: torch.Generator) -> NPARule:
        """Return an untrained rule on the CPU; its weights are drawn from `generator`."""
        config = self.config
        sizes = {"state_dim": config.state_dim, "hidden_dim": config.hidden_dim}
        return untrained_rule(generator, **(sizes | {"eps0": config.eps} | self.rule_shape))

    def make_rules(self, generator: torch.Generator) -> list[NPARule]:
        """Return an untrained rule for each species, on the CPU."""
        return [self.make_rule(generator)]

    def places(self, world_count: int, generator: Randomness, device: torch.device) -> Tensor:
        """Return the positions of particles in initial worlds [length units], shape [B, N, D]."""
        raise NotImplementedError

    def seed(
        self, world_count: int, *, generator: Randomness, device: str | torch.device = "cpu"
    ) -> Particles:
        """Return initial worlds, with all states zero and without goals."""
        x = self.places(world_count, generator, torch.device(device))
        return Particles(x, x.new_zeros(*x.shape[:2], self.config.state_dim))

    def damage(self, worlds: Particles, generator: Randomness) -> Particles:
        """Return worlds of the training pool after random damage; their goals may change."""
        return worlds

    def begin(self, iteration: int) -> None:
        """Set what the loss uses in an iteration only, such as camera views.

        It depends on the iteration alone, so that a resumed run equals an uninterrupted one. It is
        written to the same tensors in each iteration, because CUDA graphs read these.
        """

    def for_rule(self, rule: NPARule) -> Self:
        """Return the task whose loss and pictures use a rule's codes or read-out, or itself.

        They read the rule's parameters at each call and are differentiable in them. The original
        task is not changed.
        """
        return self

    def with_goal(self, goal: Tensor | None) -> Self:
        """Return a copy of the task whose loss and metric compare worlds with these goals.

        A goal is the index of a world's target or class: int64, shape [B], read at each call. It is
        the task itself for None, or without goals. On CUDA the range is not checked: that would
        synchronise.
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
        return self._with(_goal=goal)

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
        return self._with(_mean_of_processes=mean)

    def with_target_code(self, s: Tensor) -> Tensor:
        """Return states [B, N, C] whose first channels hold the code of the world's target again.

        Damage may have erased it. They are differentiable in codes that are learned; states of
        tasks without codes are unchanged.
        """
        return s

    def held_out(self) -> Self:
        """Return the task with test data, where data are split; else the task itself."""
        return self

    def resized(self, particle_count: int) -> Self:
        """Return the task with another number of particles; for a rule call `for_rule` again."""
        make: Any = type(self)
        options = {name: getattr(self, name) for name in self._resized_with}
        config = self.config.with_particle_count(particle_count)
        task: Self = make(config, device=self.target_picture.device, **options)
        return task

    def compare(self, worlds: Particles) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the batch's weighted distance from the target, [], and its unweighted terms."""
        raise NotImplementedError

    def penalties(self, worlds: Particles) -> dict[str, tuple[float, Tensor]]:
        """Return what the loss adds to `compare`, name -> (weight, term []); here, "overflow"."""
        outside = (worlds.s - worlds.s.clamp(-1.0, 1.0)).abs().mean()
        return {"overflow": (self.config.overflow_weight, outside)}

    def loss(self, worlds: Particles) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the training loss of worlds that have path lengths, [], and unweighted terms."""
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
        """Return each world's picture, as `target_picture` but of shape [B, R, R, 4]."""
        raise NotImplementedError

    def metric(self, x: Tensor, s: Tensor) -> Tensor:
        """Return each world's distance from the target, shape [B]; lower is better."""
        raise NotImplementedError

    @property
    def trial_name(self) -> str:
        """Name of `trial_metric`."""
        return self.metric_name

    def trial_metric(self, worlds: Particles) -> Tensor:
        """Return the metric that robustness trials measure, shape [B]; by default `metric`."""
        return self.metric(worlds.x, worlds.s)

    def colours(self, s: Tensor) -> Tensor:
        """Return each particle's colour as pictures show it, shape [B, N, 3]."""
        return s[..., -3:] + COLOUR_OFFSET

    def _with(self, **fields: object) -> Self:
        """Return a shallow copy with some attributes replaced."""
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
    """Configuration of growth from a ball: target, damage in training, penalties of the loss."""

    damage_radius: float = 0.0
    """Radius of the ball whose state is wiped in worlds from the pool [length units]; 0: none."""

    clump_radius: float = 0.0
    """Radius of the ball whose particles are pulled to one point, in a quarter of the worlds from
    the pool [length units]; 0: none."""

    cut_gap: float = 0.0
    """Width of the slit through `cut_share` of the worlds from the pool [length units]; 0: none."""

    cut_share: float = CHANCE
    """Probability of a world from the pool to be cut (dimensionless)."""

    flake_radius: float = 0.0
    """Radius up to which a ball of particles is torn off and thrown out, in a quarter of the worlds
    from the pool [length units]; 0: none."""

    escape_share: float = 0.0
    """Probability of each particle to be thrown out of worlds from the pool (dimensionless)."""

    target: str
    """What to grow."""

    alpha: float = 0.5
    """Largest displacement in one step, as a fraction of ε (dimensionless)."""

    seed_radius: float = 0.2
    """Radius of the ball that the particles start in [length units]."""

    motion_weight: float = 0.01
    """Weight of the path length Σ|Δx| of a rollout (per length unit)."""

    bound_weight: float = 100.0
    """Weight of mean |x − clip(x, −1, 1)| (per length unit)."""

    escape_weight: float = 0.0
    """Weight of the mean path length of particles outside of [−1, 1] (per length unit)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_fraction(self, "cut_share")
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
            """Return a random 0 or 1 for each of the B worlds, 1 with this probability, [B]."""
            return (uniform_draws(generator, (len(x), 1), x)[:, 0] < probability).to(x.dtype)

        if config.damage_radius > 0.0:
            centre = random_particle(x, generator)
            s = wipe_state(x, s, centre=centre, radius=config.damage_radius)
        if config.clump_radius > 0.0:
            centre = random_particle(x, generator)
            radius = config.clump_radius * chosen_worlds(CHANCE)
            x, s = clump(x, s, centre=centre, radius=radius, factor=1.0)
        if config.cut_gap > 0.0:
            # Directions need not be uniform; a zero vector cuts nothing.
            normal = 2.0 * uniform_draws(generator, (len(x), x.shape[2]), x) - 1.0
            hit = chosen_worlds(config.cut_share)
            x, s = cut(x, s, centre=world_mean(x), normal=normal, gap=config.cut_gap * hit)
        if config.flake_radius > 0.0:
            x = tear_off(x, radius=config.flake_radius, generator=generator)
        if config.escape_share > 0.0:
            drawn = uniform_draws(generator, (*x.shape[:2], 1), x)
            far = far_points(x, x.shape[1], generator)
            x = torch.where(drawn < config.escape_share, far, x)
        return worlds._replace(x=x, s=s)

    def penalties(self, worlds: Particles) -> dict[str, tuple[float, Tensor]]:
        """Return penalties of motion, and of states, positions and motion outside of [-1, 1]."""
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
        """Return the coordinates that the loss keeps in [-1, 1]: by default x itself."""
        return x


def distances_moved(worlds: Particles) -> Tensor:
    """Return the particles' path lengths [length units], shape [B, N]; worlds must have them."""
    assert worlds.path_length is not None, "worlds are the end of a rollout"
    return worlds.path_length


def contributions_to_loss(loss: Tensor, effects: Tensor) -> Tensor:
    """Return each particle's contribution to its world's loss, times N; shape [B, N].

    It is loss + N (effect - mean effect of the world), so that its mean over particles is the loss
    [B], up to rounding. `effects` [B, N] are the derivatives of the loss by a factor on each
    particle's splat or opacity.
    """
    excess = effects - world_mean(effects[..., None])
    return loss[:, None] + effects.shape[1] * excess


def untrained_rule(generator: torch.Generator, **hyper_parameters: Any) -> NPARule:
    """Return a rule on the CPU whose weights are drawn from `generator` alone."""
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(int(torch.randint(2**31, (), generator=generator)))
        return NPARule(**hyper_parameters)
