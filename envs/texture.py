"""`npa/Texture-v0`: particles all over a periodic box arrange themselves to a texture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from npa_envs.envs.core.config import EnvConfig
from npa_envs.envs.core.single import NPAEnv
from npa_envs.envs.core.task import TargetEnvTask
from npa_envs.envs.core.vector import vector_class
from npa_envs.tasks.texture import Texture, TextureConfig
from npa_envs.world.environment_steps import Boundary


@dataclass(frozen=True, kw_only=True)
class TextureEnvConfig(EnvConfig):
    """`EnvConfig` with target and loss of `TextureConfig`, which documents the fields."""

    task_config_type = TextureConfig
    fixed = EnvConfig.fixed | {"boundary": "for textures"}

    boundary: Boundary = "periodic"
    """A texture has no edge: only "periodic", a box into which positions are wrapped."""

    eps: float = TextureConfig.eps
    eps0: float = TextureConfig.eps
    target: str = "dots"
    target_tiles: bool = TextureConfig.target_tiles
    loss: str = TextureConfig.loss
    vgg_weights: str = TextureConfig.vgg_weights
    resolution: int = 64
    sigma: float = TextureConfig.sigma
    colour_weight: float = TextureConfig.colour_weight
    density_weight: float = TextureConfig.density_weight


class TextureTask(TargetEnvTask[TextureEnvConfig]):
    """The task of forming a texture, by a loss of `npa_envs.tasks.losses.texture`."""

    config_type = TextureEnvConfig
    training_task = Texture
    pixel_bytes = 4000

    def losses(self, x: Tensor, s: Tensor) -> Mapping[str, Tensor]:
        """Return the weighted losses of the colour and density images, by name, [B] each."""
        colour, density = self.task.texture_losses(x, s)
        colour_weight, density_weight = self.task.weights
        return {"colour": colour_weight * colour, "density": density_weight * density}


class TextureEnv(NPAEnv):
    """Arrange particles all over a periodic box to a texture.

    ## Description

    A world has N particles in a periodic box: a particle that leaves it on one side enters on the
    other. Each has a position and a state of C numbers. The last three numbers, plus 0.5, are
    its colour. An episode begins with grey particles scattered over the box. At its end they should
    look like the target. It does not matter where the parts of the pattern lie. For dots, bubbles
    and meshes particles gather and leave places empty; cells and stripes are made only of colours.

    Particles perceive and policies act as in `npa/Morphogenesis2D-v0`. Rules trained by gradient
    with `npa-envs train texture` are policies (`RulePolicy`).

    ## Reward

    The particles' picture, which has no seam, is compared with the target on `resolution` ×
    `resolution` pixels. The texture loss ignores positions. It compares the distributions of
    patches of several sizes (`"patch_swd"`) or of features of VGG16 (`"vgg_ot"`). The loss L is
    `colour_weight` times the loss of the colour image plus `density_weight` times the loss of the
    density image. 0 is the same texture. Joint losses such as `"patch_ot"` see both images at once.
    Their density term is 0. Formulas: [textures](../mathematics.md#textures).

    A particle's own loss is what its part of the picture adds to the texture loss, to first order.

    On a CPU four fifths of a step's time go into the loss, which sorts projections of all patches,
    world by world, so batches gain little. With `resolution=32` it takes a quarter.

    ## Starting state

    Particles are uniform in the box, all states are zero.

    ## Episode end

    `success_loss` is None by default. No particle can leave a periodic box.

    ## Vectorized environment

    With `reward="particle"` and `loss="vgg_ot"` or a joint loss other than `"joint_swd"`,
    particles' rewards may depend in their last bits on the number of worlds. Nothing else does.
    """

    task_type = TextureTask


TextureVectorEnv = vector_class(TextureEnv)
