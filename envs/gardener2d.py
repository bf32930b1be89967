"""`npa/Gardener2D-v0`: a gardener keeps a living picture whole in bad weather."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from npa_envs.checks import check_fraction, check_non_negative, check_positive
from npa_envs.envs.core.task import Start
from npa_envs.envs.core.vector import batched
from npa_envs.envs.garden.brushes import GardenConfig
from npa_envs.envs.garden.task import GardenEnv, GardenTask, lost_share, marks_of_whole
from npa_envs.tasks.damage import random_particle
from npa_envs.world.brushes import push, wipe_state
from npa_envs.world.randomness import StreamId, WorldRandom


@dataclass(frozen=True, kw_only=True)
class Gardener2DEnvConfig(GardenConfig):
    """What befalls the picture."""

    episode_steps: int = 32

    position_noise: float = 0.002
    """Standard deviation of the noise added to every position in a step of the rule
    [length units]."""

    gust_chance: float = 1.0
    """Probability of a gust in a step: particles around a random one are carried along in a random
    direction (dimensionless)."""

    gust_radius: float = 0.4
    """Radius within which a gust carries particles along, softly [length units]."""

    gust_length: float = 0.4
    """How far it carries those in its middle [length units]."""

    blight_chance: float = 0.5
    """Probability that states around a random particle are wiped in a step (dimensionless)."""

    blight_radius: float = 0.3
    """Radius within which they are wiped [length units]."""

    def __post_init__(self) -> None:
        """Check every field."""
        super().__post_init__()
        for name in ("gust_chance", "blight_chance"):
            if getattr(self, name) != 0.0:
                check_fraction(self, name)
        check_positive(self, float, "gust_radius", "blight_radius")
        check_non_negative(self, "gust_length")


class GardenerTask(GardenTask[Gardener2DEnvConfig]):
    """A picture in bad weather."""

    config_type = Gardener2DEnvConfig
    context_count = 2

    def disturb(self, x: Tensor, s: Tensor, random: WorldRandom) -> tuple[Tensor, Tensor]:
        """Return worlds after a gust and a blight, by draws apart from the rule's."""
        config, draws = self.config, random.substream(StreamId.DAMAGE)
        chance, angle = draws.uniform(2), 2.0 * math.pi * draws.uniform(1)
        centre = random_particle(x, draws)
        happens = (chance[:, :1] < config.gust_chance).to(x.dtype)
        move = config.gust_length * happens * torch.cat((angle.cos(), angle.sin()), dim=1)
        box = None if config.periodic_box is None else (config.periodic_box,) * 2
        x = push(x, centre=centre, move=move, radius=config.gust_radius, box=box)
        # A ball outside of the world wipes nothing.
        centre = random_particle(x, draws)
        happens = chance[:, 1] < config.blight_chance
        radius = torch.where(happens, config.blight_radius, -1.0)
        return x, wipe_state(x, s, centre=centre, radius=radius, box=box)

    def episode_context(self, start: Start, loss: Tensor, random: WorldRandom) -> Tensor:
        """Return the loss of the whole picture, and how much it rises if all of it turns grey."""
        return marks_of_whole(self, start, loss)

    def reward(self, x: Tensor, s: Tensor, loss: Tensor, context: Tensor) -> Tensor:
        """Return how good worlds are: 1 as at their start, 0 as bad as grey, shape [B]."""
        return (1.0 - lost_share(loss, context)).clamp_min(-1.0)


class Gardener2DEnv(GardenEnv):
    """Keep a living picture whole in bad weather.

    ## Description

    A trained rule has grown a picture from N particles and goes on running them. Again and again a
    gust carries some of them away, a blight wipes the states of others, and noise shakes them all.
    The rule heals a part of it, too slowly. The agent helps from outside, as a gardener does: it
    has brushes on a grid, which push particles; with other `tools` they wipe or change states or
    let particles live slower or faster. It sees what lacks at each place of the grid.

    `npa_envs.agents.gardening` has gardeners to compare with: `StillGardener` does nothing,
    `ScriptedGardener` pushes particles to where the picture lacks some, linearly in what it sees,
    and `GradientGardener` plans by the gradient of the reward through brushes, rule and picture.

    ## Reward

    Worlds are compared with the target as in `npa/Morphogenesis2D-v0`, by a loss L. The reward is
    1 − (L − L₀) / (L₁ − L₀), and at least -1. L₀ is the loss at the episode's start, of the picture
    that the rule has grown. L₁ is what it would be if all states were wiped, grey, and at least
    1.1 L₀. So 1 is a picture as good as the rule's, 0 one as bad as a grey one; a picture nearer to
    the target than the rule's is worth more than 1.

    ## Starting state

    The rule has grown a world for `grow_steps` steps from a disk of blank particles; it is whole.
    With the default `seed_pool=16` there are sixteen grown worlds, made at the first reset, which
    takes some seconds on a CPU. The weather is drawn anew for each episode.

    ## Episode end

    `success_loss` is None by default: a gardener's work has no end.
    """

    task_type = GardenerTask


Gardener2DVectorEnv = batched(Gardener2DEnv)
