"""`npa/PointClassification-v0`: particles that do not move agree on the digit that they form."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs import world_mean
from npa_envs.checks import check_field, check_positive
from npa_envs.envs.core.config import EnvConfig
from npa_envs.envs.core.single import NPAEnv
from npa_envs.envs.core.task import TargetEnvTask
from npa_envs.envs.core.vector import vector_class
from npa_envs.envs.trained_rules import load_readout_rule
from npa_envs.rule.rule import COLOUR_OFFSET, NPARule
from npa_envs.tasks.point_classification import (
    PICTURE_MARGIN,
    PointClassification,
    PointClassificationConfig,
    class_colours,
)
from npa_envs.tasks.targets.digit_clouds import Split
from npa_envs.world.particles import Particles

Score = Literal["error", "cross_entropy", "accuracy"]


@dataclass(frozen=True, kw_only=True)
class PointClassificationEnvConfig(EnvConfig):
    """`EnvConfig` with fields of `PointClassificationConfig`, which documents them."""

    task_config_type = PointClassificationConfig
    fixed = EnvConfig.fixed | {"boundary": "for point clouds"}
    choices = EnvConfig.choices | {"score": get_args(Score), "split": get_args(Split)}

    particle_count: int = PointClassificationConfig.particle_count
    data: str = PointClassificationConfig.data
    data_folder: str = PointClassificationConfig.data_folder
    class_count: int = PointClassificationConfig.class_count
    rotation: float = PointClassificationConfig.rotation
    stretch: float = PointClassificationConfig.stretch
    jitter: float = PointClassificationConfig.jitter
    overflow_weight: float = PointClassificationConfig.overflow_weight
    place_reach: float = 0.5

    split: Split = "train"
    """Split of the data: "train", or "test", whose clouds are not augmented."""

    score: Score = "error"
    """First term of the loss: "error", the mean squared error of particles' outputs;
    "cross_entropy" of softmax(`sharpness` × outputs); or "accuracy", the fraction of particles
    whose largest output is of another class."""

    sharpness: float = 4.0
    """Factor of outputs in the softmax of "cross_entropy" (dimensionless)."""

    rule: str = ""
    """File of the rule whose read-out maps states to outputs; empty: the last channels are the
    outputs."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_field(self, "rule", isinstance(self.rule, str), "be the path of a rule as a string")
        check_positive(self, float, "sharpness")
        check_positive(self, int, "state_dim", at_least=3 if self.rule else self.class_count)


class _WorldByWorld(NPARule):
    """A rule whose read-out of a world is the same, bit for bit, in every batch."""

    def read_out(self, states: Tensor) -> Tensor:
        return torch.stack([super(_WorldByWorld, self).read_out(world) for world in states])


class PointClassificationTask(TargetEnvTask[PointClassificationEnvConfig]):
    """The task of naming the digit that particles form; the loss is their outputs' error."""

    config_type = PointClassificationEnvConfig
    task: PointClassification
    static = True
    place_middle = 0.5

    def _make_task(self) -> PointClassification:
        config, device = self.config, self.device
        task = PointClassification(config.task_config, device=device, split=config.split)
        _ = task.clouds  # Reads the data now: errors come from gym.make.
        if not config.rule:
            return task
        loaded = load_readout_rule("rule", config.rule, config.state_dim, device)
        rule = _WorldByWorld(**loaded.hyper_parameters()).to(device)
        rule.load_state_dict(loaded.state_dict())
        return task.for_rule(rule.requires_grad_(False))

    def losses(self, x: Tensor, s: Tensor) -> Mapping[str, Tensor]:
        """Return each world's means of the terms of `particle_losses`, by name, [B] each."""
        overflow = self.config.overflow_weight * world_mean(self.task.overflows(s)[..., None])[:, 0]
        score = world_mean(self._scores(s)[..., None])[:, 0]
        return {self.config.score: score, "overflow": overflow}

    def particle_losses(self, x: Tensor, s: Tensor) -> Tensor:
        """Return each particle's score plus weighted |s - clip(s, -1, 1)|, shape [B, N]."""
        return self._scores(s) + self.config.overflow_weight * self.task.overflows(s)

    def particle_gains(self, before: tuple[Tensor, Tensor], after: tuple[Tensor, Tensor]) -> Tensor:
        """Return the decrease of each particle's loss, which depends on its own action only."""
        return self.particle_losses(*before) - self.particle_losses(*after)

    def extra_info(self, s: Tensor) -> dict[str, Tensor]:
        """Return each world's class, int64, and its fraction of correct particles, [B] each."""
        wrong = world_mean(self.task.mistakes(s)[..., None])[:, 0]
        return {"label": self.task.goal.clone(), "accuracy": 1.0 - wrong}

    def _scores(self, s: Tensor) -> Tensor:
        """Return each particle's loss of the kind that `config.score` names, shape [B, N]."""
        if self.config.score == "cross_entropy":
            return self.task.cross_entropies(s, self.config.sharpness)
        return self.task.mistakes(s) if self.config.score == "accuracy" else self.task.errors(s)

    def draw(self, particles: Particles, steps: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Return pictures of the unit square with a margin, coloured by predicted class."""
        x, s, *_ = particles
        s = torch.cat((s[..., :-3], class_colours(self.task.outputs(s)) - COLOUR_OFFSET), dim=-1)
        return super().draw(particles._replace(x=MAGNIFICATION * (x - 0.5), s=s), steps)

    @property
    def pixel_size(self) -> float:
        """Size of a particle in pictures, in which the unit square is magnified [length units]."""
        return MAGNIFICATION * super().pixel_size


MAGNIFICATION = 2.0 / (1.0 + 2.0 * PICTURE_MARGIN)
"""Factor of lengths in pictures, which span two length units."""


class PointClassificationEnv(NPAEnv):
    """Let particles that never move agree on which digit they form.

    ## Description

    A world has N particles, spread evenly over the ink of a digit, which never move. Each has a
    state of C numbers, zero at first. The particles have to find out which digit they form, and
    each of them has to output it. The last `class_count` channels of a state are the particle's
    outputs for class 0, 1, ...: they should be 1 for the digit's own class and 0 for all others.

    The digit is ten times as large as the radius ε of perception, so information has to travel. As
    in `npa/Morphogenesis2D-v0` the usual policy is one small network that is applied to every row
    of the observation. Rules are trained by gradient with `npa-envs train point_classification`.
    Their outputs come from a read-out network, so give a rule's file to the environment as well, to
    run it as a policy: `gym.make(id, rule="rule.safetensors")` with
    `npa_envs.agents.RulePolicy(npa_envs.load_rule("rule.safetensors"), env)`.

    `data="digits"` needs `pip install 'npa-envs[envs]'`; see [point
    clouds](../point_classification.md) for MNIST and data of your own.

    ## Action space

    `Box(-1, 1, (N, A), float32)` with A = C: one row for each particle, which never moves.

    | Columns | Action a | An action of 1 is | Effect on an updated particle |
    |---|---|---|---|
    | `0 : C` | change of the state | `state_scale`, no unit | s ← s + dt `state_scale` a |

    The rest is as in `npa/Morphogenesis2D-v0`. The square of central control is [0, 1] × [0, 1].

    ## Reward

    The loss L is the mean squared difference of all particles' outputs and the right ones, plus
    `overflow_weight` times the mean of |s − clip(s, −1, 1)|. Zero states have
    L = 1 / `class_count`. With `score="cross_entropy"` or `"accuracy"` the first term is the mean
    cross-entropy of softmax(`sharpness` × outputs), or the fraction of particles whose largest
    output is of another class; ties go to the first class. A particle's reward is the decrease of
    its own loss.

    ## Starting state

    A random cloud of the `split`, rotated, stretched and jittered by `rotation`, `stretch` and
    `jitter`. All states are zero. After `place_particles` a world keeps its class.

    ## Episode end

    `success_loss` is None by default. No particle moves, so none leaves the world.

    ## Info

    | Key | In | Value |
    |---|---|---|
    | `loss_error`, `loss_overflow` | reset, step | the terms of the loss |
    | `reward_error`, `reward_overflow` | step | decrease of each term in this step |
    | `label` | reset, step | the digit's class, a whole number |
    | `accuracy` | reset, step | fraction of particles whose largest output is of this class |

    With another `score` than "error" the first term has its name.

    ## Rendering

    A particle has the colour of its predicted class, greyer for less certain outputs. The picture
    shows [0, 1] × [0, 1] with a margin, instead of the square named below.
    """

    task_type = PointClassificationTask


PointClassificationVectorEnv = vector_class(PointClassificationEnv)
