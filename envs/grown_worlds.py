"""Worlds that a trained rule has grown, from which other environments start."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, TypeVar, get_args

import torch

from npa_envs.checks import check_field, check_positive
from npa_envs.envs.core.config import EnvConfig, check_picture_size
from npa_envs.envs.core.task import Start
from npa_envs.envs.morphogenesis2d import Morphogenesis2DEnvConfig, PictureEnvTask
from npa_envs.errors import NPAError, shown
from npa_envs.rule.files import load_rule, shipped_rules
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.targets.digit_clouds import Split
from npa_envs.world.particles import Particles, combined
from npa_envs.world.randomness import StreamId, WorldRandom
from npa_envs.world.rollout import rollout_particles

FIRST_RULES = {"gecko": "gecko-v0", "heart": "heart-first"}
"""Default rules for these targets; other targets are grown by the shipped rule of their name.
Newer shipped rules do not replace these, so that environments stay the same."""

FIRST_TEST_SEED = 1_000_000
"""Seed of the first world of the "test" pool, and the largest size of a pool."""


@dataclass(frozen=True, kw_only=True)
class GrownConfig(Morphogenesis2DEnvConfig):
    """`Morphogenesis2DEnvConfig` with the rule that grows worlds, and the pool of worlds."""

    choices = EnvConfig.choices | {"split": get_args(Split)}

    without_rule: ClassVar[str] = ""
    """Alternative to a rule, as the end of an error's message."""

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


class GrownTask(PictureEnvTask[Config]):
    """A task whose worlds begin with pictures that a rule has grown."""

    config_type: ClassVar[type[GrownConfig]] = GrownConfig
    grows = True

    @cached_property
    def rule(self) -> NPARule:
        """The trained rule that grows the worlds."""
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
        """Return worlds that `rule` has grown from the training task's initial worlds."""
        x, s, *_ = super().fresh(random)
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
    """Return worlds after steps of a rule with an environment's constants, or with `changes`."""
    names = ("eps", "box", "boundary", "update_prob", "dt", "position_noise")
    constants = {name: getattr(config, name) for name in names} | changes
    return rollout_particles(rule, particles, steps, generator=random, **constants)


def grow(
    rule: NPARule, config: Any, seeds: Particles, random: WorldRandom, **changes: Any
) -> Particles:
    """Return worlds that a rule has grown from `seeds` in `grow_steps` steps, as by `run_rule`."""
    # One by one: matrix products depend in the last bit on the number of worlds.
    worlds = []
    for one in torch.split(torch.arange(len(seeds.x), device=seeds.x.device), 1):
        stream = random.take(one).substream(StreamId.GROWTH)
        worlds.append(run_rule(rule, config, seeds.take(one), config.grow_steps, stream, **changes))
    return combined(torch.cat, worlds)


def check_rule_driven(config: Any) -> None:
    """Check `picture_size` and `tell_updated` of worlds that a rule steps."""
    check_picture_size(config)
    if config.tell_updated:
        raise NPAError("tell_updated must be False, as actions do not belong to particles")


def check_matches_rule(rule: NPARule, config: EnvConfig, *names: str) -> None:
    """Check that fields of these names have the values of the rule that steps the worlds."""
    for name in names:
        value = getattr(rule, name)
        is_same, hint = getattr(config, name) == value, f"give {name}={value!r}, or another rule"
        check_field(config, name, is_same, f"be the rule's, {value!r}", hint)


def load_readout_rule(field: str, name: str, state_dim: int, device: torch.device) -> NPARule:
    """Return the rule of this name or file, which must have a read-out; `field`: its keyword."""
    rule = load_rule(name, device=device).float().requires_grad_(False)
    if rule.readout is None or rule.state_dim != state_dim:
        raise NPAError(
            f"{field} must be a rule with a read-out of state_dim = {state_dim} channels, but "
            f"{shown(name)} has {rule.state_dim} channels and {rule.readout_dim} outputs: choose "
            "another rule, or set state_dim"
        )
    return rule


def growing_rule(config: GrownConfig) -> str:
    """Return the name or file of the rule that grows a configuration's worlds."""
    return config.rule or FIRST_RULES.get(config.target, config.target)
