"""`npa/Texture-v0`: particles all over a periodic box arrange themselves to a texture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from npa_envs.envs.core.config import Boundary, EnvConfig
from npa_envs.envs.core.single import NPAEnv
from npa_envs.envs.core.task import EnvTask
from npa_envs.envs.core.vector import NPAVectorEnv
from npa_envs.errors import NPAError
from npa_envs.tasks.checks import check_non_negative, check_positive
from npa_envs.tasks.losses.texture import DEFAULT_LOSS, check_loss_name
from npa_envs.tasks.texture import Texture, TextureConfig
from npa_envs.world.randomness import WorldRandom

LOSS_BYTES = 4000
"""About what comparing one pixel of a picture needs [bytes]."""


@dataclass(frozen=True, kw_only=True)
class TextureEnvConfig(EnvConfig):
    """What the texture environment can be told besides."""

    eps: float = 0.2
    """Perception radius ε [length units]."""

    eps0: float = 0.2
    """Radius ε0 that perception is scaled to: that of the rules run here [length units]."""

    boundary: Boundary = "periodic"
    """A texture has no edge: only "periodic", a box into which positions are wrapped."""

    target: str = "dots"
    """The texture: a built-in name (`npa-envs list`), or the path of a picture."""

    target_tiles: bool = False
    """Whether the opposite edges of a picture file fit together; built-in textures tile."""

    loss: str = DEFAULT_LOSS
    """How textures are compared: "patch_swd", "filter_swd", or "vgg_ot", which needs weights."""

    vgg_weights: str = ""
    """File of VGG16's weights for "vgg_ot"; empty: torch's usual folder of downloads."""

    resolution: int = 64
    """Pixels on each side of the picture that the loss compares."""

    sigma: float = 0.7
    """Standard deviation of a particle's splat, in distances between particles (dimensionless)."""

    colour_weight: float = 1.0
    """Weight of the loss of the colour image (dimensionless)."""

    density_weight: float = 1.0
    """Weight of the loss of the density image (dimensionless)."""

    def __post_init__(self) -> None:
        """Check every field.

        Raises:
            NPAError: A field has the wrong type or lies outside its range.
        """
        super().__post_init__()
        if self.boundary != "periodic":
            raise NPAError(
                f"boundary must be 'periodic' for textures, got {self.boundary!r}: leave it out"
            )
        if not isinstance(self.target, str) or not self.target:
            raise NPAError(
                f"target must be a built-in texture or a path, got {self.target!r}: "
                "for example target='dots'"
            )
        check_loss_name(self.loss)
        check_positive(self, int, "state_dim", at_least=3)
        check_positive(self, int, "resolution", at_least=12)
        check_positive(self, float, "sigma")
        check_non_negative(self, "colour_weight", "density_weight")


class TextureTask(EnvTask[TextureEnvConfig]):
    """A texture, compared by a loss of `npa_envs.tasks.losses.texture`.

    Args:
        config: The environment's configuration.
        device: Where the worlds live.

    Raises:
        NPAError: The target cannot be loaded.
    """

    config_type = TextureEnvConfig

    def __init__(self, config: TextureEnvConfig, device: torch.device) -> None:
        super().__init__(config, device)
        self.goal = Texture(
            TextureConfig(
                target=config.target,
                target_tiles=config.target_tiles,
                loss=config.loss,
                vgg_weights=config.vgg_weights,
                particle_count=config.particle_count,
                state_dim=config.state_dim,
                eps=config.eps,
                alpha=config.alpha,
                box_size=config.box_size,
                resolution=config.resolution,
                sigma=config.sigma,
                colour_weight=config.colour_weight,
                density_weight=config.density_weight,
            ),
            device=device,
        )
        """The task with its target and its loss."""

    @classmethod
    def extra_bytes(cls, config: EnvConfig, world_count: int) -> int:
        """Return about how much memory pool and loss need [bytes]."""
        assert isinstance(config, TextureEnvConfig), "the task's own configuration"
        copies = 4 if config.reward == "particle" else 1
        pictures = LOSS_BYTES * copies * world_count * config.resolution**2
        return super().extra_bytes(config, world_count) + pictures

    def seed(self, random: WorldRandom) -> tuple[Tensor, Tensor]:
        """Return particles uniform in the box, all states zero."""
        return self.goal.seed(random.world_count, generator=random, device=self.device)

    def losses(self, x: Tensor, s: Tensor) -> Mapping[str, Tensor]:
        """Return the weighted losses of each world's colour image and of its density image."""
        colour, density = self.goal.texture_losses(x, s)
        return {
            "colour": self.config.colour_weight * colour,
            "density": self.config.density_weight * density,
        }

    def particle_losses(self, x: Tensor, s: Tensor) -> Tensor:
        """Return each particle's share of the texture loss."""
        return self.goal.particle_shares(x, s)

    @property
    def pixel_size(self) -> float:
        """Size of a particle in pictures: all together have the target's mean density."""
        return self.goal.pixel_size


class TextureEnv(NPAEnv):
    """Arrange particles all over a periodic box to a texture.

    ## Description

    A world holds N particles in a periodic box: what leaves it on one side comes in on the other.
    Each has a position and a state of C numbers, of which the last three, plus 0.5, are its colour.
    An episode begins with grey particles scattered over the box; at its end they should look like
    the target, wherever its parts lie: dots, bubbles or meshes where particles gather and leave
    places empty, cells or stripes in colours alone.

    No particle sees the whole, nor knows where it is. As in `npa/Morphogenesis2D-v0` it perceives
    its neighbourhood within the radius ε, and one small network, applied to every row of the
    observation alike, is the usual policy. Rules for textures are trained by gradient with
    `npa-envs train texture`; `npa_envs.agents.RulePolicy(npa_envs.load_rule("rule.safetensors"),
    env)` makes a policy of one.

    ## Observation space

    As in `Morphogenesis2DEnv`.

    ## Action space

    As in `Morphogenesis2DEnv`.

    ## Reward

    The particles' picture, which has no seam, is compared with the target on `resolution` ×
    `resolution` pixels by a texture loss, which does not ask what lies where: whether patches of
    all sizes (`"patch_swd"`), answers of random filters (`"filter_swd"`), or features of VGG16
    (`"vgg_ot"`) are distributed alike. The loss L is the sum of that of the colour image, times
    `colour_weight`, and that of the density image, times `density_weight`; 0 is the same texture.
    Formulas: [textures](../mathematics.md#textures).

    | `reward` | Reward of step t |
    |---|---|
    | `"dense"` | L before the step minus L after it |
    | `"sparse"` | 0, and minus L in the last step |
    | `"particle"` | as dense; besides, `info["particle_reward"]` has each particle's own |

    Dense rewards telescope: their sum over an episode is L at its start minus L at its end. `info`
    holds the reward's two parts, as `reward_colour` and `reward_density`. A particle's own reward
    comes from how much better or worse, to first order, the texture is for what the particle adds
    to the picture; the mean of all is the dense reward, up to rounding. In a step that diverges L
    counts as at least its value at the start, so that it never pays; the parts in `info` are as
    they are.

    ## Starting state

    Particles are uniform in the box, all states are zero. `reset(seed=k)` begins the sequence of
    episodes that belongs to k, and `reset()` goes on with the next one. With `seed_pool=K` there
    are only K different starts.

    ## Episode end

    | Cause | Returned as | `info["reason"]` |
    |---|---|---|
    | the loss is at most `success_loss` | terminated | `"success"` |
    | a particle's state has run away | terminated | `"diverged"` |
    | `max_episode_steps` steps are done, by default 128 | truncated | `"time limit"` |

    `success_loss` is None by default. No particle can leave a periodic box; a state has run away
    beyond ±`observation_limit`. The steps of a single environment are counted by Gymnasium, which
    truncates without a reason; with `reward="sparse"` such an environment has to be told the number
    of steps twice, as `max_episode_steps` and as `episode_steps`.

    ## Info

    As in `Morphogenesis2DEnv`.

    ## Rendering

    As in `Morphogenesis2DEnv`.

    ## Arguments

    As in `Morphogenesis2DEnv`.

    ## Vectorized environment

    As in `Morphogenesis2DEnv`. With `loss="vgg_ot"` and `reward="particle"` particles' own rewards
    may differ in their last bits from one number of worlds to another; nothing else does.

    ## References

    As in `Morphogenesis2DEnv`.

    ## Version history

    - v0: first version.
    """

    task_type = TextureTask


class TextureVectorEnv(NPAVectorEnv):
    """Worlds of `TextureEnv`, batched on one device; its docstring describes both."""

    task_type = TextureTask
