"""`npa/Gardener2D-v0`: the agent keeps one grown picture intact, with brushes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from npa_envs.checks import check_fraction, check_non_negative, check_positive
from npa_envs.envs.core.vector import vector_class
from npa_envs.envs.garden.base import GardenEnv, GardenTask, StartLosses
from npa_envs.envs.garden.brush_actions import GardenConfig
from npa_envs.tasks.damage import random_particle
from npa_envs.world.brushes import blow, sums_under_brushes, wipe_state
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import StreamId, WorldRandom


@dataclass(frozen=True, kw_only=True)
class Gardener2DEnvConfig(GardenConfig):
    """`GardenConfig` with disturbances: gusts move particles, blights wipe states."""

    position_noise: float = 0.002
    """Standard deviation of the noise added to every position in a step of the rule
    [length units]."""

    gust_chance: float = 1.0
    """Probability of a gust in a step: particles around a random one are moved in a random
    direction (dimensionless)."""

    gust_radius: float = 0.4
    """Radius of a gust, whose effect falls to 0 at its edge [length units]."""

    gust_length: float = 0.4
    """Displacement at the centre of a gust [length units]."""

    blight_chance: float = 0.5
    """Probability of a blight in a step: states around a random particle become zero
    (dimensionless)."""

    blight_radius: float = 0.3
    """Radius of a blight [length units]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("gust_chance", "blight_chance"):
            if getattr(self, name) != 0.0:
                check_fraction(self, name)
        check_positive(self, float, "gust_radius", "blight_radius")
        check_non_negative(self, "gust_length")


class GardenerTask(GardenTask[Gardener2DEnvConfig]):
    """The task of keeping a grown picture intact while gusts push and blights wipe particles."""

    config_type = Gardener2DEnvConfig

    def disturb(self, particles: Particles, random: WorldRandom) -> Particles:
        """Return worlds after a random gust and a random blight, of the given chances."""
        x, s, *_ = particles
        config, random = self.config, random.substream(StreamId.DAMAGE)
        chance, angle = random.uniform(2), 2.0 * math.pi * random.uniform(1)
        happens = (chance[:, :1] < config.gust_chance).to(x.dtype)
        move = config.gust_length * happens * torch.cat((angle.cos(), angle.sin()), dim=1)
        # A negative radius wipes nothing.
        radius = torch.where(chance[:, 1] < config.blight_chance, config.blight_radius, -1.0).to(
            x.dtype
        )
        box = self.periodic_sides
        if not (torch.is_grad_enabled() and (x.requires_grad or s.requires_grad)):
            # The lines below by one launch.
            x, hit = blow(x, random, move, radius, gust_radius=config.gust_radius, box=box)
            return particles._replace(x=x, s=s.masked_fill(hit[..., None], 0.0))
        # As `push`, by one launch.
        gust = random_particle(x, random)[:, None], move[:, None]
        x = x + sums_under_brushes(x, *gust, radius=config.gust_radius, box=box)
        centre = random_particle(x, random)
        s = wipe_state(x, s, centre=centre, radius=radius, box=box)
        return particles._replace(x=x, s=s)

    def reward(self, particles: Particles, loss: Tensor, context: StartLosses) -> Tensor:
        """Return rewards, [B]: 1 for the loss at the start, 0 for that of a grey picture."""
        return (1.0 - self.lost_fraction(loss, context)).clamp_min(-1.0)


class Gardener2DEnv(GardenEnv):
    """Keep a picture that a rule has grown intact against disturbances.

    ## Description

    A trained rule has grown a picture from N particles and keeps stepping them. Gusts move some
    particles away, blights wipe the states of others, and noise moves all of them. The rule heals
    a part of this, too slowly. The agent helps from outside, as a gardener: it has brushes on a
    grid, which push particles; with other `tools` they wipe or change states, or slow down or speed
    up the rule. It observes the difference to the target at each place of the grid.

    `npa_envs.agents.garden_policies` has policies to compare with: `StillGardener` does nothing,
    `ScriptedGardener` pushes particles to where the picture has too few, linearly in what it
    observes, and `GradientGardener` plans by the gradient of the reward through brushes, rule and
    picture.

    ## Reward

    Worlds are compared with the target as in `npa/Morphogenesis2D-v0`, by a loss L. The reward is
    1 − (L − L₀) / (L₁ − L₀), and at least -1. L₀ is the loss at the episode's start, of the picture
    that the rule has grown. L₁ is the loss of the same picture with all states wiped, grey, and at
    least 1.1 L₀. So 1 is a picture as good as the rule's, and 0 one as bad as a grey one; a picture
    nearer to the target than the rule's has a reward above 1.

    ## Starting state

    The rule has grown an intact picture in `grow_steps` steps from a disk of grey particles. With
    the default `seed_pool=16` there are sixteen grown worlds, made at the first reset, which takes
    some seconds on a CPU. Disturbances differ between episodes.
    """

    task_type = GardenerTask


Gardener2DVectorEnv = vector_class(Gardener2DEnv)
