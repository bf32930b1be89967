"""Worlds that a trained rule has grown, from which other environments start."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, TypeVar, get_args

import torch
from torch import Tensor

from npa_envs.checks import check_positive
from npa_envs.envs.core.config import EnvConfig
from npa_envs.envs.core.task import Start
from npa_envs.envs.morphogenesis2d import Morphogenesis2DEnvConfig, PictureEnvTask
from npa_envs.errors import NPAError, shown
from npa_envs.rule.files import load_rule, shipped_rules
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.targets.clouds import Split
from npa_envs.world.randomness import StreamId, WorldRandom
from npa_envs.world.rollout import rollout

FIRST_RULES = {"gecko": "gecko-v0", "heart": "heart-first"}
"""Default rules for these targets; other targets are grown by the shipped rule of their name.
Newer shipped rules do not replace these, so that environments stay the same."""

FIRST_TEST_SEED = 1_000_000
"""Seed of the first world of the "test" pool, and the largest size of a pool."""


@dataclass(frozen=True, kw_only=True)
class GrownConfig(Morphogenesis2DEnvConfig):
    """Adds the rule that grows the worlds, and the pool of grown worlds."""

    without_rule: ClassVar[str] = ""
    """Alternative to a rule, as the end of an error's message."""

    seed_pool: int = 4
    """Number of grown worlds, each made once, that episodes start from; 0: each start grows a new
    one in `grow_steps` steps of the rule."""

    rule: str | None = None
    """Name or file of the rule that grows the worlds; None: `heart-first` for the target "heart",
    `gecko-v0` for "gecko", and the shipped rule of its name for another target."""

    split: Split = "train"
    """Which grown worlds are in the pool: "train", or "test" for others, to evaluate. "test" needs
    a `seed_pool`, as without one worlds differ by the seeds of `reset`."""

    grow_steps: int = 256
    """Steps of the rule from the seed to the grown world, of time step 1 and without noise."""

    def __post_init__(self) -> None:
        """Check every field."""
        super().__post_init__()
        check_positive(self, int, "grow_steps")
        if self.split not in get_args(Split):
            raise NPAError(f"split must be 'train' or 'test', got {shown(self.split)}")
        check_positive(self, int, "seed_pool", at_least=0, at_most=FIRST_TEST_SEED)
        if self.split == "test" and self.seed_pool == 0:
            raise NPAError(
                "split must be 'train' where seed_pool=0 grows a new world for each episode: "
                "evaluate with other seeds of reset, or give seed_pool=4"
            )


Config = TypeVar("Config", bound=GrownConfig)


class GrownTask(PictureEnvTask[Config]):
    """Pictures that a rule has grown."""

    config_type: ClassVar[type[GrownConfig]] = GrownConfig

    def __init__(self, config: Config, device: torch.device) -> None:
        super().__init__(config, device)
        self._grown: dict[int, Start] = {}

    @cached_property
    def rule(self) -> NPARule:
        """The rule that grows them."""
        return _load_rule(self.config, self.device)

    @property
    def first_pool_seed(self) -> int:
        """Seed of the first world of the pool, far from the other split's."""
        return 0 if self.config.split == "train" else FIRST_TEST_SEED

    @property
    def start_is_short(self) -> bool:
        """Whether a start takes few operations: not if it grows a world."""
        return self.config.seed_pool > 0

    def pooled(self, indices: Tensor) -> Start:
        """Return worlds of the pool; on a CPU each is grown when an episode first starts from it.

        On CUDA this would synchronise.
        """
        if self.device.type != "cpu":
            return super().pooled(indices)
        wanted = indices.tolist()
        for index in set(wanted) - self._grown.keys():
            self._grown[index] = self.made_for_pool([index])
        worlds = [self._grown[index] for index in wanted]
        return Start(torch.cat([world.x for world in worlds]), torch.cat([w.s for w in worlds]))

    def seed(self, random: WorldRandom) -> tuple[Tensor, Tensor]:
        """Return grown worlds."""
        x, s = super().seed(random)
        return grow(self.rule, self.config, x, s, random, dt=1.0, position_noise=0.0)


def run_rule(
    rule: NPARule,
    config: EnvConfig,
    x: Tensor,
    s: Tensor,
    steps: int,
    random: WorldRandom,
    **changes: Any,
) -> tuple[Tensor, Tensor]:
    """Return worlds after steps of a rule with an environment's constants.

    `changes` replace arguments of `rollout`.
    """
    names = ("eps", "box", "boundary", "update_prob", "dt", "position_noise")
    constants = {name: getattr(config, name) for name in names} | changes
    stepped: tuple[Tensor, Tensor] = rollout(rule, x, s, steps, generator=random, **constants)
    return stepped


def grow(
    rule: NPARule, config: Any, x: Tensor, s: Tensor, random: WorldRandom, **changes: Any
) -> tuple[Tensor, Tensor]:
    """Return worlds after `grow_steps` steps of a rule; arguments are those of `run_rule`.

    One after the other: a rule's matrix products depend in the last bit on the number of worlds.
    """
    worlds = []
    for k in range(len(x)):
        one = slice(k, k + 1)
        stream = random.take(one).substream(StreamId.GROWTH)
        worlds.append(run_rule(rule, config, x[one], s[one], config.grow_steps, stream, **changes))
    grown_x, grown_s = (torch.cat(part) for part in zip(*worlds, strict=True))
    return grown_x, grown_s


def check_rule_driven(config: Any) -> None:
    """Check the fields that configurations of rule-driven worlds share."""
    if config.resolution % config.picture_size:
        raise NPAError(
            f"picture_size must divide resolution = {config.resolution}, got "
            f"{config.picture_size}: try {config.resolution // 2}"
        )
    if config.tell_updated:
        raise NPAError("tell_updated must be False, as actions do not belong to particles")


def check_runs(rule: NPARule, **wanted: Any) -> None:
    """Check that the worlds' constants are those of the rule that steps them."""
    for name, given in wanted.items():
        value = getattr(rule, name)
        if value != given:
            raise NPAError(
                f"{name} must be the rule's, {value!r}, got {given!r}: give {name}={value!r}, or "
                "another rule"
            )


def load_read_out(field: str, name: str, state_dim: int, device: torch.device) -> NPARule:
    """Return the rule with a read-out that a field of a configuration names, checked."""
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


def _load_rule(config: GrownConfig, device: torch.device) -> NPARule:
    if config.rule is None and config.target not in (known := shipped_rules("morphogenesis2d")):
        raise NPAError(
            "rule must say what grows the worlds, as no shipped rule grows "
            f"{shown(config.target)} ({', '.join(known)}): give rule='PATH'{config.without_rule}"
        )
    rule = load_rule(growing_rule(config), device=device)
    wanted = {
        "space_dim": 2,
        "state_dim": config.state_dim,
        "static": False,
        "divides": False,
        "code_dim": 0,
    }
    for name, value in wanted.items():
        if getattr(rule, name) != value:
            raise NPAError(
                f"rule must have {name}={value} like the world, got {getattr(rule, name)}: "
                "choose another rule, or the same state_dim"
            )
    return rule
