"""`npa/Regeneration2D-v0`: a grown picture is damaged and has to heal."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from npa_envs.checks import check_flag, check_fraction, check_positive
from npa_envs.envs.core.single import NPAEnv
from npa_envs.envs.core.step_report import total
from npa_envs.envs.core.task import Start
from npa_envs.envs.core.vector import vector_class
from npa_envs.envs.morphogenesis2d import PictureEnvTask
from npa_envs.envs.trained_rules import GrownConfig, GrownTask
from npa_envs.errors import shown
from npa_envs.rule.rule import COLOUR_OFFSET
from npa_envs.tasks.damage import DAMAGE_SIZES, damage_worlds
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import StreamId, WorldRandom

RANDOM_DAMAGE = "random"
"""Value of `damage` for a random kind in each episode."""

RANDOM_KINDS = ("wipe", "cut", "clump")
"""Kinds of damage that "random" chooses among."""

DEFAULT_SIZES = DAMAGE_SIZES | {"wipe": 0.3}
"""Default sizes of damage [length units]. A wipe is larger than `DAMAGE_SIZES` has it, which rules
of the training preset "best" learn to heal."""

MIN_DAMAGE_RISE = 0.02
"""Minimum rise of the loss by damage, as a fraction, with which an episode can succeed."""

PICTURE_POINTS = "picture"
"""Value of `rule` for worlds that start as the target's own points."""


@dataclass(frozen=True, kw_only=True)
class Regeneration2DEnvConfig(GrownConfig):
    """`GrownConfig` with the damage, and when it counts as healed."""

    choices = GrownConfig.choices | {"damage": (*DEFAULT_SIZES, RANDOM_DAMAGE)}

    without_rule = f", or rule={shown(PICTURE_POINTS)} to start from the target's own points"

    damage: str = RANDOM_DAMAGE
    """Kind of damage: "wipe", "cut", "clump", "noise", or "random" for one of the first three."""

    damage_size: float | None = None
    """Radius of the wiped or clumped disk, width of the cut, or standard deviation of the noise
    [length units]; None: 0.3, 0.1, 0.2 and 0.05."""

    rule: str | None = None
    """What grows the worlds: a rule of the package or a rule's file; None: `heart-first` for the
    target "heart", `gecko-v0` for "gecko", and the shipped rule of its name for another one.
    "picture" starts from the target's own points instead, with hidden states of zero."""

    seed_pool: int = 256

    split_damage: bool = True
    """Whether split="test" draws other damage than "train", also with the same seeds of `reset`."""

    healed_share: float = 0.8
    """Fraction of the damage's addition to the loss that must be gone for success, unless
    `success_loss` is given (dimensionless, in (0, 1])."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_fraction(self, "healed_share")
        check_flag(self, "split_damage")
        if self.damage_size is not None:
            check_positive(self, float, "damage_size")


class RegenerationTask(GrownTask[Regeneration2DEnvConfig]):
    """The task of healing a grown picture that was damaged."""

    config_type = Regeneration2DEnvConfig

    def __init__(self, config: Regeneration2DEnvConfig, device: torch.device) -> None:
        super().__init__(config, device)
        self.grows = config.rule != PICTURE_POINTS
        if self.grows:
            _ = self.rule

    def fresh(self, random: WorldRandom) -> Start:
        """Return grown worlds without damage, or the target's points if `rule` is "picture"."""
        if self.grows:
            return super().fresh(random)
        start = PictureEnvTask.fresh(self, random)
        points, colours = self.task.target.points, self.task.target.colours
        # The numbers of points and particles differ a little: some points repeat or are skipped.
        chosen = torch.linspace(0, len(points) - 1, start.x.shape[1], device=self.device)
        chosen = chosen.round().long()
        start.s[..., -3:] = colours[chosen] - COLOUR_OFFSET
        return start._replace(x=points[chosen].expand_as(start.x).clone())

    def start(self, random: WorldRandom) -> Start:
        """Return damaged worlds with the losses at which they count as healed."""
        start = super().start(random)
        if self.config.split_damage and self.config.split == "test":
            random = random.substream(StreamId.TEST)
        kinds = RANDOM_KINDS if self.config.damage == RANDOM_DAMAGE else (self.config.damage,)
        chosen, box = random.integers(len(kinds), 1, 1), self.periodic_sides
        damaged, intact = start, Particles(start.x, start.s)
        for k, kind in enumerate(kinds):
            size = self.config.damage_size or DEFAULT_SIZES[kind]
            hurt = damage_worlds(intact, kind=kind, size=size, box=box, generator=random)
            damaged = damaged._replace(
                x=torch.where(chosen == k, hurt.x, damaged.x),
                s=torch.where(chosen == k, hurt.s, damaged.s),
            )
        if start.success_loss is not None:
            return damaged
        before, after = (self._loss(worlds) for worlds in (start, damaged))
        healed = before + (1.0 - self.config.healed_share) * (after - before)
        never = torch.full_like(before, -torch.inf)
        is_damaged = after - before >= MIN_DAMAGE_RISE * before
        return damaged._replace(success_loss=torch.where(is_damaged, healed, never))

    def _loss(self, worlds: Start) -> Tensor:
        return total(torch.stack(list(self.losses(worlds.x, worlds.s).values())))


class Regeneration2DEnv(NPAEnv):
    """Heal a picture that was damaged.

    ## Description

    A picture was grown from N particles and then damaged: the states in a disk were wiped, a line
    was cut through it, or a disk was drawn together. The policy moves each particle and changes its
    state, so that the picture becomes intact again. As in `npa/Morphogenesis2D-v0`, a particle
    perceives only its neighbourhood. Observations do not say that there was damage.

    Update rules that grow pictures can also heal them. The rule `gecko-v0` has grown these worlds,
    so their hidden states mean something to it:
    `npa_envs.agents.RulePolicy(npa_envs.load_rule("gecko-v0"), env)` shows what it can do.
    Another policy cannot read these hidden states. With `rule="picture"` episodes start from the
    target's own points instead, with hidden states of zero.
    Spaces, reward and `info` are those of `Morphogenesis2DEnv`.

    ## Starting state

    The rule grows a world for `grow_steps` steps from a disk of grey particles. Then one kind of
    damage is applied. The worlds are made once: with the default `seed_pool=256` there are 256. On
    a CPU each is grown when an episode first starts from it, which takes 0.4 s of CPU time with
    1024 particles; on CUDA the first reset grows all of them. Each episode draws its damage.

    `split="test"` has other grown worlds, as many, and other damage: learn with "train", evaluate
    with "test".

    | `damage` | What is done |
    |---|---|
    | `"wipe"` | the states in a disk around a random particle become zero: grey |
    | `"cut"` | particles near a line through the middle, at a random angle, move off it |
    | `"clump"` | the particles in a disk around a random one come ten times nearer to its centre |
    | `"noise"` | every position gets normal noise |
    | `"random"` | one of the first three, drawn for each episode |

    `damage_size` is the disk's radius, the width of the cut, or the noise's standard deviation
    [length units]; see [damage](../mathematics.md#damage).

    ## Episode end

    The damage adds to the loss. The episode ends in success once `healed_share` of this addition is
    gone. If you give `success_loss`, it ends once the loss is at most this instead. If damage
    raises the loss by less than 2 %, there is nothing to heal, and the episode runs to its limit.
    """

    task_type = RegenerationTask


Regeneration2DVectorEnv = vector_class(Regeneration2DEnv)
