"""Options of learners as dataclasses: each with its default, its meaning and its checks once."""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, TypeVar

from torch import nn

from npa_envs.agents.learning.actor_critic import CriticKind
from npa_envs.agents.learning.problem import Problem
from npa_envs.agents.learning.rules import RuleSet
from npa_envs.errors import NPAError, suggest
from npa_envs.tasks.checks import check_fraction, check_non_negative, check_positive

Result = TypeVar("Result")


def takes_fields_of(
    settings_type: type[Any],
) -> Callable[[Callable[..., Result]], Callable[..., Result]]:
    """Return a decorator: keyword arguments named as a dataclass's fields arrive as `settings`.

    The function that comes out has them in its signature, where `method_options` finds them.

    Args:
        settings_type: The dataclass, all of whose fields have defaults.

    Raises:
        NPAError: When the function is called: a name is unknown, or a value wrong.
    """
    own = {field.name: field.default for field in fields(settings_type)}

    def decorate(function: Callable[..., Result]) -> Callable[..., Result]:
        before = inspect.signature(function)
        kept = [p for name, p in before.parameters.items() if name != "settings"]
        added = [
            inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default)
            for name, default in own.items()
        ]

        @functools.wraps(function)
        def called(*positional: Any, **keywords: Any) -> Result:
            chosen = {name: keywords.pop(name) for name in own if name in keywords}
            for name in keywords.keys() - {p.name for p in kept}:
                raise NPAError(f"unknown option {name!r}: {suggest(name, own)}")
            return function(*positional, settings=settings_type(**chosen), **keywords)

        called.__signature__ = before.replace(parameters=[*kept, *added])  # type: ignore[attr-defined]
        return called

    return decorate


# Options of PPO: those that all forms share, and those of the device's own.


FRESH = {
    "learning_rate": 1e-3,
    "initial_std": 0.2,
    "last_noise": 0.25,
    "critic_rounds": 0,
    "target_kl": 0.2,
}
"""What options are where they are None, with fresh rules."""

WARM = {
    "learning_rate": 1e-4,
    "initial_std": 0.05,
    "last_noise": 1.0,
    "critic_rounds": 4,
    "target_kl": 0.05,
}
"""The same with rules to begin with: noise, haste and a raw critic would undo what they can do."""

CHOICES = {
    "ratio": ("particle", "world"),
    "credit": ("world", "particle"),
    "critic": ("particle", "central"),
}
"""Options that take one of a few words."""


@dataclass(frozen=True, kw_only=True)
class CommonSettings:
    """Options that the device's own PPO and Stable-Baselines3's share."""

    steps: int = 16
    """Steps of all worlds in a round, T."""

    epochs: int = 4
    """Passes over a round; fewer where `target_kl` is passed."""

    learning_rate: float | None = None
    """Adam's step at the start, from which it falls to zero over the budget; None: 0.001, or 0.0001
    with a `start`."""

    gamma: float = 0.5
    """Discount of a reward one step later (dimensionless)."""

    gae_lambda: float = 0.9
    """Discount of what the critic did not foresee, besides `gamma` (dimensionless)."""

    entropy_weight: float = 0.0
    """Weight of the entropy of an action in what is maximised."""

    initial_std: float | None = None
    """Standard deviation of every action column at first; None: 0.2, or 0.05 with a `start`."""

    last_noise: float | None = None
    """What is left of the standard deviations at the end of the budget (dimensionless); None: 0.25,
    or 1 with a `start`."""

    noise_decay_share: float = 0.5
    """Share of the budget, its last, in which standard deviations fall to that; 1: from the
    start."""

    critic_rounds: int | None = None
    """Rounds in which the critic learns alone; None: 0, or 4 with a `start`."""

    critic: CriticKind = "particle"
    """A value follows from a particle's own perception, or from its whole world ("central")."""

    def __post_init__(self) -> None:
        """Check every field.

        Raises:
            NPAError: One lies outside its range.
        """
        check_positive(self, int, "steps", "epochs")
        check_non_negative(self, "entropy_weight")
        check_fraction(self, "gamma", "gae_lambda", "noise_decay_share")
        for name in ("learning_rate", "initial_std"):
            if getattr(self, name) is not None:
                check_positive(self, float, name)
        if self.last_noise is not None:
            check_fraction(self, "last_noise")
        if self.critic_rounds is not None:
            check_positive(self, int, "critic_rounds", at_least=0)
        check_words(self, "critic")


@dataclass(frozen=True, kw_only=True)
class Settings(CommonSettings):
    """Options of `train`."""

    worlds: int | None = None
    """Worlds B to act in; None: the problem's `num_envs`, and on CUDA, where that is more, as many
    as have 131 072 particles together, if memory has room for them and particle-steps are enough
    for 128 rounds."""

    minibatches: int = 4
    """Parts that the particles of a round are shuffled into in each pass; for the critic, and where
    a world has one ratio, its worlds are."""

    critic_learning_rate: float = 1e-3
    """The critic's step at the start, as `learning_rate` is the rules'."""

    clip: float | None = None
    """Ratios of likelihoods count up to 1 plus or minus this (dimensionless). None: 0.2, or 0.02
    for a world's, whose logarithms are means over many particles."""

    max_gradient_norm: float = 0.5
    """Gradients of the rules, and those of the critic, are shortened to this norm."""

    target_kl: float | None = None
    """The rules stay as they are for the rest of a round once particles' actions are farther than
    this from those that were played [nats]; None: 0.2, or 0.05 with a `start`."""

    ratio: Literal["particle", "world"] = "particle"
    """Each particle has a ratio of its own, or a world has one, of mean log-probabilities."""

    credit: Literal["world", "particle"] = "world"
    """Each particle is paid what its world is, or its own share."""

    critic_width: int = 64
    """Units in a hidden layer of the critic."""

    def __post_init__(self) -> None:
        """Check every field.

        Raises:
            NPAError: One lies outside its range.
        """
        super().__post_init__()
        check_positive(self, int, "minibatches", "critic_width")
        check_positive(self, float, "max_gradient_norm")
        check_non_negative(self, "critic_learning_rate")
        for name in ("clip", "target_kl"):
            if getattr(self, name) is not None:
                check_positive(self, float, name)
        if self.worlds is not None:
            check_positive(self, int, "worlds")
        check_words(self, "ratio", "credit")
        if self.ratio == "world" and self.credit == "particle":
            raise NPAError(
                "credit='particle' needs ratio='particle': one ratio a world has one advantage"
            )

    @property
    def largest_change(self) -> float:
        """How far ratios count from 1."""
        if self.clip is not None:
            return self.clip
        return 0.2 if self.ratio == "particle" else 0.02


def check_words(settings: object, *names: str) -> None:
    """Check that options are among the words that they can be.

    Args:
        settings: What has them.
        names: Names from `CHOICES`.

    Raises:
        NPAError: One is not.
    """
    for name in names:
        word, words = getattr(settings, name), CHOICES[name]
        if word not in words:
            raise NPAError(f"{name} must be a known word, got {word!r}: {suggest(word, words)}")


def filled(settings: Any, start: RuleSet | None) -> Any:
    """Return options with those of `FRESH` or `WARM` where they are None.

    Args:
        settings: A dataclass with these options.
        start: Rules to begin with; None: fresh ones.
    """
    defaults = FRESH if start is None else WARM
    missing = {k: value for k, value in defaults.items() if getattr(settings, k) is None}
    return replace(settings, **missing)


def noise_left(share_left: float, last_noise: float, decay_share: float) -> float:
    """Return what is left of the first noise: all of it at first, then it falls by equal factors.

    What is learned is what is best with noise, and what counts is what it does without: towards the
    end the two are to be the same.

    Args:
        share_left: Share of the budget that is left.
        last_noise: What is left of the noise when nothing is.
        decay_share: Share of the budget, its last, in which it falls.
    """
    return math.pow(last_noise, max(0.0, 1.0 - share_left / decay_share))


def beginning(problem: Problem, seed: int, start: RuleSet | None) -> RuleSet:
    """Return the rules that PPO begins with: those given, or fresh ones that do nothing.

    Fresh rules have random output layers, and what they do in each step adds up: in
    `npa/Regeneration2D-v0` they take apart what is whole. Layers of zeros leave it alone, and learn
    just as well, as what is hidden is random still.

    Args:
        problem: What is to be learned.
        seed: Of the other weights.
        start: Rules to begin with; None: fresh ones.
    """
    if start is not None:
        return start
    rules = problem.new_rules(seed)
    for rule in rules:
        nn.init.zeros_(rule.output.weight)
    return rules
