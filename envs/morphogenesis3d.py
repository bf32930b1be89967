"""`npa/Morphogenesis3D-v0`: a ball of grey particles grows into a 3D object."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.checks import check_field, check_positive
from npa_envs.envs.core.config import EnvConfig
from npa_envs.envs.core.single import NPAEnv
from npa_envs.envs.core.task import EnvTask, TargetEnvTask
from npa_envs.envs.core.vector import vector_class
from npa_envs.envs.trained_rules import load_readout_rule
from npa_envs.render import turntable_frames
from npa_envs.tasks.morphogenesis3d import Morphogenesis3D, Morphogenesis3DConfig
from npa_envs.world.particles import Particles

PIXEL_BYTES = 200
"""About how much memory comparing one pixel of a view takes [bytes]."""

PARTICLE_BYTES = 700
"""About how much memory drawing one particle in one view takes [bytes]."""


@dataclass(frozen=True, kw_only=True)
class Morphogenesis3DEnvConfig(EnvConfig):
    """`EnvConfig` with fields of `Morphogenesis3DConfig`, which documents most of them."""

    task_config_type = Morphogenesis3DConfig
    fixed = EnvConfig.fixed | {"control": "in 3D"}

    eps: float = 0.3
    eps0: float = 0.3
    alpha: float = 0.3
    target: str = Morphogenesis3DConfig.target
    resolution: int = 48
    sigma: float = 0.06
    seed_radius: float = 0.6

    readout: str = ""
    """Name or file of the rule whose read-out gives the particles' shapes and colours; empty: the
    last three channels are the colour, and particles are round."""

    view_count: int = 6
    """Maximum number of views from all sides that the loss compares."""

    opacity: float = 0.5
    """Opacity of a particle, in (0, 1); with a read-out, its opacity where the read-out is 0."""

    def __post_init__(self) -> None:
        check_positive(self, int, "view_count")
        super().__post_init__()
        is_text, hint = isinstance(self.readout, str), "for example readout='mushroom'"
        check_field(self, "readout", is_text, "be a name or a path", hint)
        self.check_seed_radius(self.seed_radius)

    @property
    def task_config(self) -> Morphogenesis3DConfig:
        """Configuration of the training task, whose held-out views the loss compares."""
        return self.as_config(
            Morphogenesis3DConfig, training_views=1, held_out_views=self.view_count, ssim_weight=0.0
        )


class SolidTask(TargetEnvTask[Morphogenesis3DEnvConfig]):
    """The task of growing a 3D object, by the loss of `npa_envs.tasks.morphogenesis3d`."""

    config_type = Morphogenesis3DEnvConfig
    training_task = Morphogenesis3D
    space_dim = 3
    pixel_size = EnvTask.pixel_size

    def _make_task(self) -> Morphogenesis3D:
        task: Morphogenesis3D = super()._make_task()
        if not self.config.readout:
            return task
        state_dim = self.config.state_dim
        return task.for_rule(
            load_readout_rule("readout", self.config.readout, state_dim, self.device)
        )

    @classmethod
    def bytes_per_world(cls, config: Any) -> int:
        """Return about how much memory the views of one world take [bytes]."""
        view = PIXEL_BYTES * config.resolution**2 + PARTICLE_BYTES * config.particle_count
        return int(view * config.view_count * (2 if config.per_particle_reward else 1))

    def losses(self, x: Tensor, s: Tensor) -> Mapping[str, Tensor]:
        """Return each world's mean absolute difference from the target's views, [B], by name."""
        return {"views": self.task.metric(x, s)}

    def draw_particles(
        self, particles: Particles, style: str, azimuth: float = 0.0
    ) -> NDArray[np.uint8]:
        """Return pictures, uint8, [B, R, R, 3]; with a read-out, of the particles' Gaussians."""
        if not self.config.readout or style != "particles":
            return super().draw_particles(particles, style, azimuth)
        frames = turntable_frames(
            partial(self.task.views, particles.x, particles.s),
            frame_count=1,
            resolution=self.config.render_size,
            azimuth=azimuth,
            device=self.device,
        )
        return np.stack(frames)


class Morphogenesis3DEnv(NPAEnv):
    """Grow a 3D object from a ball of grey particles.

    ## Description

    A world has N particles in open 3D space. Each has a position and a state of C numbers. The
    last three numbers, plus 0.5, are its colour. An episode begins with grey particles all over a
    ball. At its end they should look like the target: a mushroom, a duck, a rocket, a doughnut, any
    mesh, or a scene given by pictures. Particles are drawn as 3D Gaussians.

    Particles perceive and policies act as in `npa/Morphogenesis2D-v0`. Rules trained by gradient
    with `npa-envs train morphogenesis3d` are policies (`RulePolicy`). Such a rule has a network
    that maps states to the particles' shapes and colours, so give it as `readout` too. Shipped
    rules need the worlds that they were trained in: `particle_count=16384`, `state_dim=24`, `eps`
    and `eps0` 0.1, `alpha=1.0`, `seed_radius` 0.7 (the mushroom's 0.5), `sigma=0.02`,
    `opacity=0.15`. The duck, other than the older rule `duck-v0`, needs `particle_count=8192`,
    `eps` and `eps0` 0.126, `sigma=0.014`, `opacity=0.6`, and views of `resolution=192`.

    ## Observation space

    `Box(-64, 64, (N, P), float32)` with P = 5C + 3: one row for each particle, always in the same
    order. Numbers beyond ±`observation_limit` are clipped.

    | Columns | Perceived | Unit |
    |---|---|---|
    | `0 : C` | the particle's own state s | dimensionless |
    | `C : 2C` | mean state of the neighbourhood, itself included | dimensionless |
    | `2C : 5C` | gradient of the state: x, y, z of channel 0, then of channel 1, ... | 1 / length |
    | `5C : 5C + 3` | gradient of the density over N: where it gets denser | 1 / length⁴ |

    Gradients are on a logarithmic scale and scaled by powers of ε / ε0, as in
    `npa/Morphogenesis2D-v0`: [perception](../mathematics.md#perception).

    ## Action space

    `Box(-1, 1, (N, A), float32)` with A = 3 + C: one row for each particle.

    | Columns | Action a | An action of 1 is | Effect on an updated particle |
    |---|---|---|---|
    | `0 : 3` | displacement along x, y and z | α ε, a length | x ← x + dt α ε a |
    | `3 : 3 + C` | change of the state | `state_scale`, no unit | s ← s + dt `state_scale` a |

    The rest is as in `npa/Morphogenesis2D-v0`.

    ## Reward

    The particles are rendered in front of grey by `view_count` cameras, spread over a sphere. The
    loss L is the mean absolute difference from the target's views, over red, green, blue and alpha.
    0 is the target. A particle's own loss is what its opacity adds to the difference of the views,
    to first order. Formulas: [3D morphogenesis](../mathematics.md#3d-morphogenesis).

    ## Starting state

    Particles are uniform in a ball of radius `seed_radius`, all states are zero.

    ## Info

    | Key | In | Value |
    |---|---|---|
    | `loss_views` | reset, step | equal to L, its only term |
    | `reward_views` | step | its decrease in this step |

    ## Rendering

    The camera turns around the world by two degrees a step. With a `readout` the style
    `"particles"` draws its Gaussians.

    ## References

    Gaussians: Kerbl et al. 2023, "3D Gaussian Splatting for Real-Time Radiance Field Rendering".
    """

    task_type = SolidTask


Morphogenesis3DVectorEnv = vector_class(Morphogenesis3DEnv)
