"""Shared code of environments with trained rules, which grow start worlds or step worlds."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, TypeVar, get_args

import torch
from torch import Tensor

from npa_envs.checks import check_field, check_positive
from npa_envs.envs.core.config import EnvConfig
from npa_envs.envs.core.task import Start
from npa_envs.envs.core.worlds import BatchedWorlds
from npa_envs.envs.morphogenesis2d import Morphogenesis2DEnvConfig, PictureConfig, PictureEnvTask
from npa_envs.errors import NPAError, shown
from npa_envs.rule.files import load_rule, shipped_rules
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.targets.digit_clouds import Split
from npa_envs.world.cuda_graph import GraphedCallable, makes_plain_tensors
from npa_envs.world.environment_steps import flag_unless_finite, hold_in_bounds, load_async
from npa_envs.world.particles import Particles, combined
from npa_envs.world.randomness import StreamId, WorldRandom
from npa_envs.world.rollout import rollout_particles

logger = logging.getLogger(__name__)

FIRST_RULES = {
    "heart": "heart-first",
    **{name: f"{name}-v0" for name in ("butterfly", "flower", "gecko", "letter-a", "octopus")},
}
"""Default rules by target; other targets are grown by the shipped rule of their name. Newer shipped
rules do not replace these, so that environments stay the same."""

FIRST_TEST_SEED = 1_000_000
"""Seed of the first world of the "test" pool, and the largest size of a pool."""

LONG_GROWTH = 2**21
"""Particles times steps from which growth is logged: seconds on a CPU."""

STEPPED_TOGETHER = 4096
"""Maximum number of particles that a CPU steps together, if they are of several worlds."""

OF_PARTICLES = {
    "tell_updated": "where actions do not belong to particles",
    "control": "where a rule steps the particles",
}
"""Fields of `WorldConfig.fixed` for worlds that a rule steps."""


@dataclass(frozen=True, kw_only=True)
class GrownConfig(Morphogenesis2DEnvConfig):
    """`Morphogenesis2DEnvConfig` with the rule that grows start worlds, and with their pool."""

    choices = EnvConfig.choices | {"split": get_args(Split)}

    without_rule: ClassVar[str] = ""
    """End of the error message where no rule is known: what may be given instead."""

    seed_pool: int = 4

    rule: str | None = None
    """Name or file of the rule that grows the worlds; None: `heart-first` for the target "heart",
    `gecko-v0` for "gecko", and the shipped rule of its name for another target."""

    split: Split = "train"
    """Which grown worlds are in the pool: "train", or "test" for others, to evaluate. "test" needs
    a `seed_pool`, as without one worlds differ by the seeds of `reset`."""

    grow_steps: int = 256
    """Steps of the rule from the seed to the grown world, of time step 1 and without noise."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self, int, "grow_steps")
        check_positive(self, int, "seed_pool", at_least=0, at_most=FIRST_TEST_SEED)
        has_split = self.split == "train" or self.seed_pool > 0
        rule = "be 'train' where seed_pool=0 grows a new world for each episode"
        hint = "evaluate with other seeds of reset, or give seed_pool=4"
        check_field(self, "split", has_split, rule, hint)


Config = TypeVar("Config", bound=GrownConfig)
AnyPicture = TypeVar("AnyPicture", bound=PictureConfig)


class GrownTask(PictureEnvTask[Config]):
    """A task whose episodes start from pictures that a rule has grown."""

    config_type: ClassVar[type[GrownConfig]] = GrownConfig
    grows = True

    @cached_property
    def rule(self) -> NPARule:
        """The trained rule that grows the start worlds."""
        config, known = self.config, shipped_rules("morphogenesis2d")
        if config.rule is None and config.target not in known:
            raise NPAError(
                "rule must say what grows the worlds, as no shipped rule grows "
                f"{shown(config.target)} ({', '.join(known)}): give rule='PATH'"
                f"{config.without_rule}"
            )
        rule = load_rule(growing_rule(config), device=self.device)
        same = {"space_dim": 2, "state_dim": config.state_dim}
        for name, value in (same | {"static": False, "divides": False, "code_dim": 0}).items():
            if getattr(rule, name) != value:
                raise NPAError(
                    f"rule must have {name}={value} like the world, got {getattr(rule, name)}: "
                    "choose another rule, or the same state_dim"
                )
        return rule

    @property
    def first_pool_seed(self) -> int:
        """Seed of world 0 of the pool: 0 for split="train", `FIRST_TEST_SEED` for "test"."""
        return 0 if self.config.split == "train" else FIRST_TEST_SEED

    def fresh(self, random: WorldRandom) -> Start:
        """Return new worlds, which `rule` has grown from the training task's initial worlds."""
        x, s, *_ = super().fresh(random)
        if x.shape[0] * x.shape[1] * self.config.grow_steps >= LONG_GROWTH:
            logger.warning(
                "growing %d start worlds of %d particles in %d steps of a rule",
                *x.shape[:2], self.config.grow_steps,
            )  # fmt: skip
        grown = grow(self.rule, self.config, Particles(x, s), random, dt=1.0, position_noise=0.0)
        return Start(grown.x, grown.s)


def run_rule(
    rule: NPARule,
    config: EnvConfig,
    particles: Particles,
    steps: int,
    random: WorldRandom,
    **changes: Any,
) -> Particles:
    """Return worlds after `steps` of a rule, with options from `config` except for `changes`."""
    names = ("eps", "box", "boundary", "update_prob", "dt", "position_noise")
    constants = {name: getattr(config, name) for name in names} | changes
    # A world is the same in every batch; on CUDA it is anyway.
    alone = particles.x.device.type == "cpu" and not torch.is_grad_enabled()
    constants |= {"generator": random, "world_by_world": alone}
    return rollout_particles(rule, particles, steps, **constants)


def grow(
    rule: NPARule, config: Any, seeds: Particles, random: WorldRandom, **changes: Any
) -> Particles:
    """Return worlds that `run_rule` has grown from `seeds` in `config.grow_steps` steps."""
    # One by one: matrix products depend in the last bit on the number of worlds.
    worlds = []
    for one in torch.split(torch.arange(len(seeds.x), device=seeds.x.device), 1):
        stream = random.take(one).substream(StreamId.GROWTH)
        worlds.append(run_rule(rule, config, seeds.take(one), config.grow_steps, stream, **changes))
    return combined(torch.cat, worlds)


def check_matches_rule(rule: NPARule, config: EnvConfig, *names: str) -> None:
    """Check that the fields `names` of `config` are equal to the rule's."""
    for name in names:
        value = getattr(rule, name)
        is_same, hint = getattr(config, name) == value, f"give {name}={value!r}, or another rule"
        check_field(config, name, is_same, f"be the rule's, {value!r}", hint)


def load_readout_rule(field: str, name: str, state_dim: int, device: torch.device) -> NPARule:
    """Return the rule with a read-out of this name or file; `field`: its keyword, for errors."""
    rule = load_rule(name, device=device).float().requires_grad_(False)
    if rule.readout is None or rule.state_dim != state_dim:
        raise NPAError(
            f"{field} must be a rule with a read-out of state_dim = {state_dim} channels, but "
            f"{shown(name)} has {rule.state_dim} channels and {rule.readout_dim} outputs: choose "
            "another rule, or set state_dim"
        )
    return rule


def growing_rule(config: GrownConfig) -> str:
    """Return the name or file of the rule that grows the start worlds."""
    return config.rule or FIRST_RULES.get(config.target, config.target)


class RuleDrivenWorlds(BatchedWorlds):
    """Worlds whose particles a rule steps; their `RuleDrivenTask` defines actions and rewards.

    On a CPU up to `STEPPED_TOGETHER` particles are stepped together: so few that their launches
    are recorded and replayed, and that arrays stay in the processor's cache.
    """

    task: RuleDrivenTask[Any]

    context: Any = None
    """Context of all worlds' episodes, see `RuleDrivenTask`; None before the first start."""

    _graph: GraphedCallable | None = None

    @torch.no_grad()
    @makes_plain_tensors
    def queue(self, action: Tensor, out: Tensor | None = None) -> Tensor:
        """Step the worlds without synchronising; return observations, in `out` if it is given."""
        if self._graph is None:
            self._action = torch.zeros(action.shape, device=self.device)
            self._graph = GraphedCallable(self._step_and_observe, self.device)
            self.random_steps = self.task.config.rule_steps
        load_async(action, self._action)
        flag_unless_finite(self._action, self.enabled)
        self._graph()
        if self.side_stream is not None:
            self.side_stream.mark()
        return self._observed.clone() if out is None else out.copy_(self._observed)

    def _step_and_observe(self) -> None:
        """Make the step of the loaded actions, if these are finite."""
        is_made = self.enabled.bool()
        stepped = self._stepped(torch.where(is_made, self._action, 0.0))
        for value, new in zip(self.particles[:2], stepped, strict=True):
            torch.where(is_made, new, value, out=value)
        hold_in_bounds(self.x, self.s, self.physics, self.diverged)
        self.evaluate()
        self._observed = self.task.observe(self.particles, self.loss, self.context)

    def _stepped(self, action: Tensor) -> tuple[Tensor, Tensor]:
        x, s = self.x, self.s
        count = max(STEPPED_TOGETHER // x.shape[1], 1)
        if x.is_cuda or len(x) <= count:
            return self.task.step(x, s, action, self.random)
        parts = [slice(k, k + count) for k in range(0, len(x), count)]
        streams = [self.random.take(part) for part in parts]
        worlds = [
            self.task.step(x[part], s[part], action[part], random)
            for part, random in zip(parts, streams, strict=True)
        ]
        # All streams have advanced by as many random numbers.
        self.random.sync_with(streams[-1], self.random_steps)
        x, s = (torch.cat(part) for part in zip(*worlds, strict=True))
        return x, s

    @torch.no_grad()
    @makes_plain_tensors
    def perceive(self, out: Tensor | None = None) -> Tensor:
        """Return all worlds' current observations, shape [B, O], in `out` if it is given."""
        self._measure()
        observed = self.task.observe(self.particles, self.loss, self.context)
        return observed if out is None else out.copy_(observed)

    def begin(self, world_indices: Tensor, start: Start, *, check: bool) -> None:
        """Begin episodes as the base class does, and store their `context`."""
        super().begin(world_indices, start, check=check)
        random = self.random.take(world_indices).substream(StreamId.GOAL)
        context = self.task.episode_context(start, self.loss[world_indices], random)
        if self.context is None:
            shapes = ((self.world_count, *value.shape[1:]) for value in context)
            self.context = type(context)(*map(Tensor.new_zeros, context, shapes))
        for stored, value in zip(self.context, context, strict=True):
            stored[world_indices] = value

    def write_rewards(self, terms: Tensor) -> None:
        """Write endings for new losses, [terms, B], the task's rewards, and the next goals."""
        self.episodes.update(terms)
        self._measure()
        # Replaces the decrease of the loss, which the update gives as the reward.
        rewards = self.task.reward(self.particles, self.loss, self.context)
        report = self.episodes.report
        if self.task.rewards_last_step_only:
            terminated, truncated, *_ = report.end_flags
            rewards = torch.where(terminated | truncated, rewards, 0.0)
        report.named.reward.copy_(rewards)
        self.task.next_goals(self.episodes.elapsed, self.context, self.goal)

    def _measure(self) -> None:
        """Write what the task measures of the current particles into `context`."""
        measured = self.task.measured(self.particles, self.context)
        for stored, value in zip(self.context, measured, strict=True):
            if value is not stored:
                stored.copy_(value)

    def extra_info(self) -> dict[str, Tensor]:
        """Return the task's own entries of infos (`context_info`): values [B, ...] by name."""
        return self.task.context_info(self.particles, self.context)


class RuleDrivenTask(PictureEnvTask[AnyPicture]):
    """Base class of tasks whose worlds a rule steps while an agent acts on them.

    A `context` is what `episode_context` returned when the current episodes started: a named tuple
    of tensors, [B, ...], that observations and rewards need besides the particles.
    """

    worlds_type: ClassVar[type[BatchedWorlds] | None] = RuleDrivenWorlds

    def step(
        self, x: Tensor, s: Tensor, action: Tensor, random: WorldRandom
    ) -> tuple[Tensor, Tensor]:
        """Return x and s after an action, [B, rows, columns], and steps of the rule."""
        raise NotImplementedError

    def observe(self, particles: Particles, loss: Tensor, context: Any) -> Tensor:
        """Return observations, [B, O]; `loss`, [B], is the current loss."""
        raise NotImplementedError

    def episode_context(self, start: Start, loss: Tensor, random: WorldRandom) -> Any:
        """Return the `context` of B episodes that start; `loss`, [B], is the loss of `start`."""
        raise NotImplementedError

    def measured(self, particles: Particles, context: Any) -> Any:
        """Return the context with what is measured of `particles`, once for all that reads it."""
        return context

    def reward(self, particles: Particles, loss: Tensor, context: Any) -> Tensor:
        """Return the rewards of a step, [B]; `particles` and `loss`, [B], are after it."""
        raise NotImplementedError

    def next_goals(self, elapsed: Tensor, context: Any, goal: Tensor) -> None:
        """Write goals after `elapsed` steps of episodes, [B], into `goal`, [B]; by default none."""

    def context_info(self, particles: Particles, context: Any) -> dict[str, Tensor]:
        """Return values that the task adds to infos, by name, [B, ...] each; by default none."""
        return {}
