"""`npa/Pictures2D-v0`: each episode has one of several target pictures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, get_args

import torch
import torch.nn.functional as F
from torch import Tensor

from npa_envs.checks import check_flag, check_positive
from npa_envs.envs.core.config import EnvConfig, check_picture_size
from npa_envs.envs.core.single import NPAEnv
from npa_envs.envs.core.vector import vector_class
from npa_envs.envs.core.world_state import OBSERVATION_COPIES
from npa_envs.envs.morphogenesis2d import PictureConfig, PictureEnvTask
from npa_envs.errors import NPAError, shown
from npa_envs.tasks.many_pictures import ManyPictures, named_targets
from npa_envs.tasks.morphogenesis2d import Morphogenesis2DConfig
from npa_envs.tasks.targets.digit_clouds import Split

CHANNELS = 4
"""Channels of a pixel: red, green, blue and density."""


@dataclass(frozen=True, kw_only=True)
class Pictures2DEnvConfig(PictureConfig):
    """`PictureConfig` with several targets, and whether observations show them."""

    fixed = PictureConfig.fixed | {"control": "where targets differ"}
    choices = EnvConfig.choices | {"split": get_args(Split)}

    targets: tuple[str, ...] = ("butterfly", "flower", "gecko", "heart", "octopus")
    """Pictures of the split "train": built-in names, emoji, picture files, or folders of such."""

    test_targets: tuple[str, ...] = ("letter-a", "ring")
    """Pictures of the split "test", not among `targets`."""

    split: Split = "train"
    """Which pictures are targets: "train", or "test" to evaluate with others."""

    observe_target: bool = False
    """Whether each row of the observation ends with a small picture of the target."""

    picture_size: int = 4
    """Pixels on each side of the observed picture; a divisor of `resolution`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_flag(self, "observe_target")
        check_positive(self, int, "picture_size")
        check_picture_size(self)
        if not self.targets or not self.test_targets:
            raise NPAError(
                "targets and test_targets must name a picture each, got "
                f"{shown(self.targets)} and {shown(self.test_targets)}: for example ('heart',)"
            )
        # Checks the names of both splits.
        _ = self._config_of(self.targets), self._config_of(self.test_targets)
        both = named_targets(self.targets).keys() & named_targets(self.test_targets).keys()
        if both:
            raise NPAError(
                f"test_targets must not be among targets, got {shown(min(both))} in both: leave it "
                "out of one"
            )

    @property
    def task_config(self) -> Morphogenesis2DConfig:
        """Configuration of the training task, with the targets of the split."""
        return self._config_of(self.targets if self.split == "train" else self.test_targets)

    @property
    def target_dim(self) -> int:
        """Number T of target columns at the end of an observation's row."""
        return CHANNELS * self.picture_size**2 if self.observe_target else 0

    def _config_of(self, targets: tuple[str, ...]) -> Morphogenesis2DConfig:
        count = self.particle_count
        return self.as_config(Morphogenesis2DConfig, targets=targets, target_point_count=count)


class PicturesTask(PictureEnvTask[Pictures2DEnvConfig]):
    """The task of growing pictures; each world has one of several targets."""

    config_type = Pictures2DEnvConfig
    task: ManyPictures
    training_task = ManyPictures

    def __init__(self, config: Pictures2DEnvConfig, device: torch.device) -> None:
        super().__init__(config, device)
        self.names = self.task.names
        """Names of the pictures of the split, by their indices."""
        everyone = torch.arange(len(self.names), device=device)
        pictures = self.task.with_goal(everyone).target_picture.permute(0, 3, 1, 2)
        small = F.avg_pool2d(pictures, config.resolution // config.picture_size)
        limit = config.observation_limit
        if config.observe_target:
            self.target_rows = small.flatten(1).clamp(-limit, limit)

    @classmethod
    def bytes_per_world(cls, config: Any) -> int:
        """Return about how much memory the loss and target columns of one world take [bytes]."""
        numbers = OBSERVATION_COPIES * config.particle_count * config.target_dim
        return super().bytes_per_world(config) + 4 * int(numbers)

    @property
    def pixel_size(self) -> float:
        """Size of a particle in pictures: the spacing of the first target's points."""
        return self.task.target.pixel_size

    def extra_info(self, s: Tensor) -> dict[str, Tensor]:
        """Return as `target` the index of each world's target, int64, shape [B]."""
        return {"target": self.task.goal.clone()}


class Pictures2DEnv(NPAEnv):
    """Grow the episode's target picture from a disk of grey particles.

    ## Description

    As in `npa/Morphogenesis2D-v0` a disk of grey particles has to become a picture, but each
    episode draws its target. With `observe_target=True` each row of the observation ends with a
    small picture of the target. Without it the observation does not depend on the target;
    `info["target"]` has its index.

    Learn with the pictures of the split "train", and evaluate with the other pictures of
    `split="test"`. A policy that observes targets can be tried on new ones; any other policy can
    only find a compromise between them.

    Particles of all pictures are drawn equally large, and pictures are scaled so that each one's
    density is about 1. Action space and reward are those of `Morphogenesis2DEnv`.

    ## Observation space

    With `observe_target=True` there are T = 4 G² more columns, the target's small picture, equal in
    all rows: means over squares of pixels, G × G of red, then of green, of blue, and of density,
    rows from the bottom up (dimensionless); G is `picture_size`. Rules do not use these columns:
    policies of `npa_envs.agents` drop them, and `npa_envs.agents.learning.Problem` refuses
    `observe_target`. Learners that use whole observations use them, such as Stable-Baselines3's
    through [`ParticleVecEnv`](../integrations.md).

    ## Starting state

    Particles are uniform in a disk of radius `seed_radius` around the origin, all states are zero.
    The picture is drawn uniformly from those of the split. After `place_particles` a world keeps
    its picture.

    ## Info

    | Key | In | Value |
    |---|---|---|
    | `loss_density`, `loss_colour` | reset, step | the terms of the loss |
    | `reward_density`, `reward_colour` | step | decrease of each term in this step |
    | `target` | reset, step | index of the picture; `env.unwrapped.task.names` has its name |
    """

    task_type = PicturesTask


Pictures2DVectorEnv = vector_class(Pictures2DEnv)
