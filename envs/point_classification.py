"""`npa/PointClassification-v0`: particles that stay where they are agree on what they form."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs import world_mean
from npa_envs.checks import check_positive
from npa_envs.envs.core.config import EnvConfig
from npa_envs.envs.core.single import NPAEnv
from npa_envs.envs.core.task import Start, TargetEnvTask
from npa_envs.envs.core.vector import batched
from npa_envs.envs.grown import load_read_out
from npa_envs.errors import NPAError, shown
from npa_envs.rule.rule import COLOUR_OFFSET, NPARule
from npa_envs.tasks.point_classification import (
    PICTURE_MARGIN,
    PointClassification,
    PointClassificationConfig,
    class_colours,
)
from npa_envs.tasks.targets.clouds import Split
from npa_envs.world.randomness import WorldRandom

Score = Literal["error", "cross_entropy", "accuracy"]


@dataclass(frozen=True, kw_only=True)
class PointClassificationEnvConfig(EnvConfig):
    """Adds the clouds and the loss of `PointClassificationConfig`, which explains them."""

    task_config_type = PointClassificationConfig

    words = EnvConfig.words | {"score": get_args(Score)}

    particle_count: int = PointClassificationConfig.particle_count
    data: str = PointClassificationConfig.data
    data_folder: str = PointClassificationConfig.data_folder
    class_count: int = PointClassificationConfig.class_count
    rotation: float = PointClassificationConfig.rotation
    stretch: float = PointClassificationConfig.stretch
    jitter: float = PointClassificationConfig.jitter
    overflow_weight: float = PointClassificationConfig.overflow_weight

    split: Split = "train"
    """Which pictures: "train" or "test", which are never varied."""

    score: Score = "error"
    """What the loss is, overflow aside: "error", the mean squared error of what particles say;
    "cross_entropy" of the probabilities softmax(`sharpness` × what they say); or "accuracy", the
    share of particles that say another class most loudly."""

    sharpness: float = 4.0
    """How surely outputs are taken as probabilities, where score is "cross_entropy"."""

    rule: str = ""
    """File of the rule whose read-out tells classes from states; empty: the last channels are the
    classes."""

    def __post_init__(self) -> None:
        """Check every field."""
        super().__post_init__()
        if self.boundary != "open":
            raise NPAError(
                f"boundary must be 'open' for point clouds, got {shown(self.boundary)}: leave it "
                "out"
            )
        if self.split not in get_args(Split):
            raise NPAError(f"split must be 'train' or 'test', got {shown(self.split)}")
        if not isinstance(self.rule, str):
            raise NPAError(f"rule must be the path of a rule as a string, got {shown(self.rule)}")
        _ = self.task_config
        check_positive(self, float, "sharpness")
        check_positive(self, int, "state_dim", at_least=3 if self.rule else self.class_count)

    @property
    def task_config(self) -> PointClassificationConfig:
        """Configuration of the task itself."""
        return self.as_config(PointClassificationConfig)


class _WorldByWorld(NPARule):
    """A rule whose read-out rounds alike in every batch."""

    def read_out(self, states: Tensor) -> Tensor:
        return torch.stack([super(_WorldByWorld, self).read_out(world) for world in states])


class PointClassificationTask(TargetEnvTask[PointClassificationEnvConfig]):
    """Clouds of digits, and the error of what their particles say of them."""

    config_type = PointClassificationEnvConfig
    task: PointClassification
    static = True

    def __init__(self, config: PointClassificationEnvConfig, device: torch.device) -> None:
        super().__init__(config, device)
        self.task = PointClassification(config.task_config, device=device, split=config.split)
        if config.rule:
            given = load_read_out("rule", config.rule, config.state_dim, device)
            rule = _WorldByWorld(**given.hyper_parameters()).to(device)
            rule.load_state_dict(given.state_dict())
            self.task = self.task.for_rule(rule.requires_grad_(False))
        self._coverage = self.task.clouds.coverage

    def fresh(self, random: WorldRandom) -> Start:
        """Return random clouds with all states zero, and their classes."""
        x, s, _, label = self.task.seed(random.world_count, generator=random, device=self.device)
        return Start(x, s, goal=label)

    def losses(self, x: Tensor, s: Tensor) -> Mapping[str, Tensor]:
        """Return each world's loss of what it says of its class, and its weighted overflow."""
        score = self.config.score
        overflow = self.config.overflow_weight * self.task.overflow(s)
        if score == "error":
            return {"error": self.task.metric(x, s), "overflow": overflow}
        return {score: world_mean(self._scores(s)[..., None])[:, 0], "overflow": overflow}

    def particle_losses(self, x: Tensor, s: Tensor) -> Tensor:
        """Return each particle's own loss and overflow."""
        return self._scores(s) + self.config.overflow_weight * self.task.overflows(s)

    def particle_gains(self, before: tuple[Tensor, Tensor], after: tuple[Tensor, Tensor]) -> Tensor:
        """Return how much each particle's own loss fell: nobody else's action changes it."""
        return self.particle_losses(*before) - self.particle_losses(*after)

    def accuracy(self, s: Tensor) -> Tensor:
        """Return the share of each world's particles that say its class most loudly, [B]."""
        return 1.0 - world_mean(self.task.mistakes(s)[..., None])[:, 0]

    def extra_info(self, s: Tensor) -> dict[str, Tensor]:
        """Return each world's class, int64, and accuracy, shape [B] each."""
        return {"label": self.task.goal.clone(), "accuracy": self.accuracy(s)}

    def _scores(self, s: Tensor) -> Tensor:
        """Return the loss of what each particle says, [B, N]."""
        if self.config.score == "cross_entropy":
            return self.task.cross_entropies(s, self.config.sharpness)
        return self.task.mistakes(s) if self.config.score == "accuracy" else self.task.errors(s)

    def draw(self, x: Tensor, s: Tensor, steps: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Return pictures of the unit square, with a margin, in colours of what particles say."""
        colours = class_colours(self.task.outputs(s)) - COLOUR_OFFSET
        return super().draw(
            MAGNIFICATION * (x - 0.5), torch.cat((s[..., :-3], colours), dim=-1), steps
        )

    @property
    def pixel_size(self) -> float:
        """Size of a particle in pictures, which show the unit square magnified."""
        return MAGNIFICATION * self.task.pixel_size


MAGNIFICATION = 2.0 / (1.0 + 2.0 * PICTURE_MARGIN)
"""Of pictures, which span two length units."""


class PointClassificationEnv(NPAEnv):
    """Let particles that never move agree on which digit they form.

    ## Description

    A world holds N particles that lie evenly spread on the ink of a digit and stay where they are.
    Each has a state of C numbers, zero at first. Step by step the particles have to find out which
    digit they form, and each of them has to say it. The last `class_count` channels of a state are
    the particle's answer for class 0, 1, ...: they should be 1 for the digit's own class and 0 for
    all others.

    No particle sees more than its neighbourhood within the radius ε, and the digit is ten times as
    large. So news has to travel. As in `npa/Morphogenesis2D-v0` the usual policy is one small
    network that is applied to every row of the observation. Rules are trained by gradient with
    `npa-envs train point_classification`. They give their answers through a read-out network. So to
    run one as a policy, give its file to the environment as well: `gym.make(id,
    rule="rule.safetensors")` with
    `npa_envs.agents.RulePolicy(npa_envs.load_rule("rule.safetensors"), env)`. The task is that of
    Neural Particle Automata, "self-classifying point clouds".

    `data="digits"` needs `pip install 'npa-envs[points]'`; see [point
    clouds](../point_classification.md) for MNIST and data of your own. The observation space is
    that of `Morphogenesis2DEnv`.

    ## Action space

    `Box(-1, 1, (N, A), float32)` with A = C: one row for each particle, which never moves.

    | Columns | Action a | An action of 1 is | Effect on an updated particle |
    |---|---|---|---|
    | `0 : C` | change of the state | `state_scale`, no unit | s ← s + dt `state_scale` a |

    The rest is as in `npa/Morphogenesis2D-v0`: only particles that are updated act, and entries are
    clipped to [-1, 1].

    ## Reward

    The loss L is the mean squared difference of what all particles say and what they should say,
    plus `overflow_weight` times the mean of |s − clip(s, −1, 1)|. Blank states have
    L = 1 / `class_count`. With `score="cross_entropy"` or `"accuracy"` the first part is the mean
    cross-entropy of softmax(`sharpness` × what particles say), or the share of particles that say
    another class most loudly; ties go to the first class.

    A particle's own reward is how much its own loss fell.

    ## Starting state

    A random cloud of the `split`, which is turned, stretched and shaken as `rotation`, `stretch`
    and `jitter` say. All states are zero. After `place_particles` a world keeps its class.

    ## Episode end

    `success_loss` is None by default. No particle moves, so none leaves the world.

    ## Info

    | Key | In | Value |
    |---|---|---|
    | `loss_error`, `loss_overflow` | reset, step | the parts of the loss |
    | `reward_error`, `reward_overflow` | step | how much each part improved in this step |
    | `label` | reset, step | the digit's class, a whole number |
    | `accuracy` | reset, step | the share of particles that say it most loudly |

    With another `score` than "error" the first part is called so.

    ## Rendering

    A particle has the colour of the class that it says, and is greyer the less sure it is. The
    picture shows [0, 1] × [0, 1] with a little room around it, instead of the square named below.
    """

    task_type = PointClassificationTask


PointClassificationVectorEnv = batched(PointClassificationEnv)
