"""`npa/Pictures2D-v0`: each episode asks for one of several pictures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self, get_args

import torch
import torch.nn.functional as F
from torch import Tensor

from npa_envs.checks import check_flag, check_positive
from npa_envs.envs.core.config import EnvConfig
from npa_envs.envs.core.single import NPAEnv
from npa_envs.envs.core.state import OBSERVATION_COPIES
from npa_envs.envs.core.task import Start
from npa_envs.envs.core.vector import batched
from npa_envs.envs.morphogenesis2d import PictureConfig, PictureEnvTask
from npa_envs.errors import NPAError, shown
from npa_envs.tasks.many_pictures import ManyPictures, named_targets
from npa_envs.tasks.morphogenesis2d import Morphogenesis2DConfig
from npa_envs.tasks.targets.clouds import Split
from npa_envs.world.randomness import WorldRandom

CHANNELS = 4
"""Red, green and blue of a pixel, and how many particles lie there."""


@dataclass(frozen=True, kw_only=True)
class Pictures2DEnvConfig(PictureConfig):
    """Adds the pictures, and whether observations show them."""

    words = EnvConfig.words | {"split": get_args(Split)}

    targets: tuple[str, ...] = ("butterfly", "flower", "gecko", "heart", "octopus")
    """Pictures of the split "train": built-in names, emoji, picture files, or folders of such."""

    test_targets: tuple[str, ...] = ("letter-a", "ring")
    """Pictures of the split "test", not among `targets`."""

    split: Split = "train"
    """Which pictures episodes ask for: "train", or "test" to evaluate with others."""

    observe_target: bool = False
    """Each row of the observation ends with a small picture of the target."""

    picture_size: int = 4
    """Pixels on each side of the picture that is seen; it divides `resolution`."""

    def __post_init__(self) -> None:
        """Check every field."""
        super().__post_init__()
        check_flag(self, "observe_target")
        check_positive(self, int, "picture_size")
        if self.resolution % self.picture_size:
            raise NPAError(
                f"picture_size must divide resolution = {self.resolution}, got "
                f"{self.picture_size}: try {self.resolution}"
            )
        if not self.targets or not self.test_targets:
            raise NPAError(
                "targets and test_targets must name a picture each, got "
                f"{shown(self.targets)} and {shown(self.test_targets)}: for example ('heart',)"
            )
        # Checks names, also of the split that is not asked for.
        _ = self._config_of(self.targets), self._config_of(self.test_targets)
        both = named_targets(self.targets).keys() & named_targets(self.test_targets).keys()
        if both:
            raise NPAError(
                f"test_targets must not be among targets, got {shown(min(both))} in both: leave it "
                "out of one"
            )

    @property
    def task_config(self) -> Morphogenesis2DConfig:
        """Configuration of the task itself."""
        return self._config_of(self.targets if self.split == "train" else self.test_targets)

    @property
    def target_dim(self) -> int:
        """Numbers that a row tells of the target, T; 0: none."""
        return CHANNELS * self.picture_size**2 if self.observe_target else 0

    def _config_of(self, targets: tuple[str, ...]) -> Morphogenesis2DConfig:
        count = self.particle_count
        return self.as_config(Morphogenesis2DConfig, targets=targets, target_point_count=count)


class PicturesTask(PictureEnvTask[Pictures2DEnvConfig]):
    """Several pictures to grow, one asked for in each world."""

    config_type = Pictures2DEnvConfig
    task: ManyPictures
    task_type = ManyPictures

    def __init__(self, config: Pictures2DEnvConfig, device: torch.device) -> None:
        super().__init__(config, device)
        self.names = self.task.names
        """Names of the pictures of the split, by their numbers."""
        everyone = torch.arange(len(self.names), device=device)
        pictures = self.task.toward(everyone).target_picture.permute(0, 3, 1, 2)
        small = F.avg_pool2d(pictures, config.resolution // config.picture_size)
        limit = config.observation_limit
        if config.observe_target:
            self.target_rows = small.flatten(1).clamp(-limit, limit)
        self._number = everyone[:1]

    @classmethod
    def extra_bytes(cls, config: Any, world_count: int) -> int:
        """Return about how much memory pool, pictures and what rows tell of them need [bytes]."""
        numbers = OBSERVATION_COPIES * world_count * config.particle_count * config.target_dim
        return super().extra_bytes(config, world_count) + int(4 * numbers)

    def fresh(self, random: WorldRandom) -> Start:
        """Return worlds as training begins with them, and the numbers of their pictures."""
        x, s, _, number = self.task.seed(random.world_count, generator=random, device=self.device)
        # No rule of codes acts on these worlds.
        return Start(x, s[..., -self.config.state_dim :].contiguous(), goal=number)

    def toward(self, goal: Tensor) -> Self:
        """Return the task with losses for worlds of these pictures."""
        aimed = super().toward(goal)
        aimed._number = goal
        return aimed

    def extra_info(self, s: Tensor) -> dict[str, Tensor]:
        """Return the number of each world's picture, int64, shape [B]."""
        return {"target": self._number.clone()}


class Pictures2DEnv(NPAEnv):
    """Grow the picture that is asked for from a disk of blank particles.

    ## Description

    As in `npa/Morphogenesis2D-v0` a disk of grey particles is to become a picture, but each episode
    draws which one. With `observe_target=True` every particle is told: its row of the observation
    ends with a small picture of the target. Without, nothing in the observation tells the pictures
    apart; `info["target"]` does.

    Learn with the pictures of the split "train", and evaluate with those of `split="test"`, which
    are others. A policy that observes targets can try new ones; another can only find what serves
    all of them.

    Particles of all pictures are drawn equally large, and pictures are scaled so that each one's
    density is about 1. Action space and reward are those of `Morphogenesis2DEnv`.

    ## Observation space

    With `observe_target=True` T = 4 G² columns more tell of the target, the same in all rows: means
    over squares of pixels, G × G of red, then of green, of blue, and of density, rows from the
    bottom up (dimensionless); G is `picture_size`. Policies of `npa_envs.agents` leave them out,
    and `npa_envs.agents.learning.Problem` refuses `observe_target`, as rules read no target: so
    none of its methods takes these columns. Learners that read whole observations do, such as
    Stable-Baselines3's through [`ParticleVecEnv`](../integrations.md).

    ## Starting state

    Particles are uniform in a disk of radius `seed_radius` around the origin, all states are zero.
    The picture is drawn uniformly from those of the split. After `place_particles` a world keeps
    its picture.

    ## Episode end

    `success_loss` is None by default: growth has no natural end, and the picture should last.

    ## Info

    | Key | In | Value |
    |---|---|---|
    | `loss_density`, `loss_colour` | reset, step | the parts of the loss |
    | `reward_density`, `reward_colour` | step | how much each part improved in this step |
    | `target` | reset, step | number of the picture; `env.unwrapped.task.names` has its name |
    """

    task_type = PicturesTask


Pictures2DVectorEnv = batched(Pictures2DEnv)
