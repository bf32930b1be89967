"""A toy task for the trainer's tests: particles learn to walk to a circle, without any kernels."""

import torch
from torch import Tensor

from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import ParticleTask
from npa_envs.tasks.morphogenesis2d import Morphogenesis2DConfig
from npa_envs.training import TrainConfig, override
from npa_envs.world.particles import Particles

PARTICLE_COUNT = 12
STATE_DIM = 3
RESOLUTION = 8


class CircleTask(ParticleTask):
    """Mean squared distance from the circle of radius 0.5, and a small pull on the states."""

    eps = 0.2
    box: tuple[float, ...] | None = None
    update_prob = 0.5
    aligned = True
    metric_name = "distance from the circle"

    def __init__(self) -> None:
        self.loss_calls = 0

    def make_rule(self, generator: torch.Generator) -> NPARule:
        rule = NPARule(2, STATE_DIM, 16, eps0=self.eps)
        with torch.no_grad():
            for parameter in rule.parameters():
                parameter.uniform_(-0.1, 0.1, generator=generator)
        return rule

    def seed(
        self, world_count: int, *, generator: torch.Generator, device: torch.device
    ) -> Particles:
        x = torch.rand(world_count, PARTICLE_COUNT, 2, generator=generator, device=device)
        s = torch.zeros(world_count, PARTICLE_COUNT, STATE_DIM, device=device)
        return Particles(0.4 * x - 0.2, s)

    def damage(self, worlds: Particles, generator: torch.Generator) -> Particles:
        s = worlds.s
        blank = torch.rand(s.shape[:2], generator=generator, device=s.device) < 0.2
        return worlds._replace(s=s.masked_fill(blank[..., None], 0.0))

    def loss(self, worlds: Particles) -> tuple[Tensor, dict[str, Tensor]]:
        self.loss_calls += 1
        distance = self.metric(worlds.x, worlds.s).mean()
        state = worlds.s.square().mean()
        assert worlds.path_length is not None
        motion = worlds.path_length.mean()
        total = distance + 0.01 * state + 0.001 * motion
        return total, {"distance": distance, "state": state, "motion": motion}

    def metric(self, x: Tensor, s: Tensor) -> Tensor:
        radius = x.square().sum(-1).add(1e-9).sqrt()
        return (radius - 0.5).square().mean(1)

    @property
    def target_picture(self) -> Tensor:
        return torch.zeros(RESOLUTION, RESOLUTION, 4)

    def picture(self, x: Tensor, s: Tensor) -> Tensor:
        axis = torch.linspace(-1.0, 1.0, RESOLUTION, dtype=x.dtype, device=x.device)
        near = torch.exp(-((x[..., None] - axis) ** 2) * 8.0)
        density = torch.einsum("bnc,bnr->brc", near[:, :, 0], near[:, :, 1])
        return torch.stack([0.2 * density, 0.5 * density, 0.8 * density, density], -1)


def plain_rollout(
    rule: NPARule,
    worlds: Particles,
    steps: int,
    *,
    eps: float,
    update_prob: float,
    generator: torch.Generator,
    **options: object,
) -> Particles:
    """Particles that see nothing but their own position and state."""
    x, s, _, goal = worlds
    path_length = torch.zeros_like(x[..., 0])
    blind = s.new_zeros(*s.shape[:2], rule.perception_dim - rule.state_dim - 2)
    for _ in range(steps):
        awake = torch.rand(s.shape[:2], generator=generator, device=s.device) < update_prob
        update = rule(torch.cat([s, blind, x], -1)) * awake[..., None]
        delta = update[..., :2]
        step = rule.alpha * eps * delta / (1.0 + delta.norm(dim=-1, keepdim=True).clamp(min=1e-9))
        x, s = x + step, s + update[..., 2:]
        path_length = path_length + step.square().sum(-1).add(1e-12).sqrt()
    return Particles(x, s, path_length, goal)


def circle_config(out: object, **fields: object) -> TrainConfig[Morphogenesis2DConfig]:
    """A run of a second or less; `fields` as for `override`."""
    base = TrainConfig(
        task=Morphogenesis2DConfig(),
        iterations=6,
        repeats=1,
        world_count=3,
        pool_size=8,
        steps=(4, 9),
        learning_rate=1e-2,
        milestones=(4,),
        seed_interval=4,
        log_interval=1,
        picture_interval=0,
        checkpoint_interval=3,
        tensorboard=False,
    )
    return override(base, out=str(out), **fields)
