"""`npa/Morphogenesis2D-v0`: a disk of grey particles grows into a picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, TypeVar

from torch import Tensor

from npa_envs.checks import check_positive
from npa_envs.envs.core.config import EnvConfig
from npa_envs.envs.core.single import NPAEnv
from npa_envs.envs.core.task import TargetEnvTask
from npa_envs.envs.core.vector import vector_class
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D, Morphogenesis2DConfig
from npa_envs.tasks.targets.images import MAX_POINT_COUNT


@dataclass(frozen=True, kw_only=True)
class PictureConfig(EnvConfig):
    """`EnvConfig` with fields of start and loss, which `Morphogenesis2DConfig` documents."""

    task_config_type = Morphogenesis2DConfig

    resolution: int = 64
    sigma: float = Morphogenesis2DConfig.sigma
    colour_weight: float = Morphogenesis2DConfig.colour_weight
    seed_radius: float = Morphogenesis2DConfig.seed_radius

    def __post_init__(self) -> None:
        # The target has as many points as particles.
        check_positive(self, int, "particle_count", at_most=MAX_POINT_COUNT)
        super().__post_init__()
        self.check_seed_radius(self.seed_radius)

    @property
    def task_config(self) -> Morphogenesis2DConfig:
        """Configuration of the training task, whose target has as many points as particles."""
        return self.as_config(Morphogenesis2DConfig, target_point_count=self.particle_count)


@dataclass(frozen=True, kw_only=True)
class Morphogenesis2DEnvConfig(PictureConfig):
    """`PictureConfig` with the target picture."""

    target: str = Morphogenesis2DConfig.target


Config = TypeVar("Config", bound=PictureConfig)


class PictureEnvTask(TargetEnvTask[Config]):
    """The task of growing a picture, by the splat loss of `npa_envs.tasks.morphogenesis2d`."""

    config_type: ClassVar[type[PictureConfig]] = Morphogenesis2DEnvConfig
    task: Morphogenesis2D
    training_task: ClassVar[type[Morphogenesis2D]] = Morphogenesis2D
    pixel_bytes = 16

    def losses(self, x: Tensor, s: Tensor) -> Mapping[str, Tensor]:
        """Return density error and weighted colour error of each world, by name, [B] each."""
        density, colour = self.task.splat_losses(x, s)
        return {"density": density, "colour": self.config.colour_weight * colour}


class Morphogenesis2DEnv(NPAEnv):
    """Grow a picture from a disk of grey particles.

    ## Description

    A world has N particles in the plane. Each has a position and a state of C numbers. The last
    three numbers, plus 0.5, are its colour: red, green and blue. In every step the policy moves
    each particle and changes its state. An episode begins with a small disk of grey particles. At
    its end they should look like the target picture.

    A row of the observation is what one particle perceives within the radius ε around it, as
    averages that smoothed particle hydrodynamics (SPH) defines. It does not depend on where the
    particle is, which one it is, or how many steps have passed. So a policy is usually one small
    network that is applied to every row. Update rules trained by gradient solve the task, and some
    are shipped: `npa_envs.agents.RulePolicy(npa_envs.load_rule("gecko"), env)` makes a policy of
    one. The task is 2D morphogenesis, section 4.1 of the paper below.

    ## Observation space

    `Box(-64, 64, (N, P), float32)` with P = 4C + 2: one row for each particle, always in the same
    order. Numbers beyond ±`observation_limit` are clipped.

    | Columns | Perceived | Unit |
    |---|---|---|
    | `0 : C` | the particle's own state s | dimensionless |
    | `C : 2C` | mean state of the neighbourhood, itself included | dimensionless |
    | `2C : 4C` | gradient of the state: x, y of channel 0, then of channel 1, ... | 1 / length |
    | `4C : 4C + 2` | gradient of the density over N, x and y: where it gets denser | 1 / length³ |

    Gradients are on a logarithmic scale: a vector v becomes log(1 + |v|) v / |v|. They are first
    scaled by powers of ε / ε0, so that a policy can be used at another ε than it was trained at.
    Formulas: [perception](../mathematics.md#perception); the same numbers come from
    `npa_envs.perceive`.

    ## Action space

    `Box(-1, 1, (N, A), float32)` with A = 2 + C: one row for each particle.

    | Columns | Action a | An action of 1 is | Effect on an updated particle |
    |---|---|---|---|
    | `0 : 2` | displacement along x and y | α ε, a length | x ← x + dt α ε a |
    | `2 : 2 + C` | change of the state | `state_scale`, no unit | s ← s + dt `state_scale` a |

    In every step each particle is updated with probability `update_prob`, independently of the
    others; the rows of the others are ignored. A displacement longer than 1 is shortened to length
    1, and state entries are clipped to [-1, 1]. An action that is not finite raises `NPAError` and
    does not change the world. An update rule's output [δ; Δs] is the action
    [δ / (1 + |δ|); Δs / `state_scale`]; see [one step](../mathematics.md#one-step). A policy that
    explores does better with `state_scale=0.1`: see [training](../training.md).

    ## Reward

    The particles' picture is compared with the target's on `resolution` × `resolution` pixels. The
    loss L is the sum of a density error (are there particles where there should be?) and
    `colour_weight` times a colour error; 0 is a perfect picture. The picture's middle is moved onto
    the target's first, so its position does not count. Formula:
    [pictures](../mathematics.md#pictures). A particle's own loss comes from the errors of the
    pixels that it covers.

    ## Starting state

    Particles are uniform in a disk of radius `seed_radius` around the origin, all states are zero.

    ## Episode end

    `success_loss` is None by default: growth has no natural end, and the picture should last.

    ## Info

    | Key | In | Value |
    |---|---|---|
    | `loss_density`, `loss_colour` | reset, step | the terms of the loss |
    | `reward_density`, `reward_colour` | step | decrease of each term in this step |
    """

    task_type = PictureEnvTask


Morphogenesis2DVectorEnv = vector_class(Morphogenesis2DEnv)
