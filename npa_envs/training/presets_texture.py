"""Presets of textures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from npa_envs.tasks.texture_config import TextureConfig
from npa_envs.training.config import TrainConfig

_OUT = Path("runs/texture")

_PAPER_TEXTURE: TrainConfig[TextureConfig] = TrainConfig(
    task=TextureConfig(loss="vgg_ot"),
    iterations=12_000,
    repeats=1,
    steps=(16, 32),
    learning_rate=1e-4,
    weight_decay=0.1,
    milestones=(3_000, 6_000, 9_000),
    out=_OUT,
)

TEXTURE_PRESETS: Mapping[str, TrainConfig[TextureConfig]] = {
    "paper": _PAPER_TEXTURE,
    # Dots of both colours after some three minutes on one core.
    "fast": TrainConfig(
        task=TextureConfig(
            target="dots", particle_count=1024, hidden_dim=64, resolution=64, damage_radius=0.2
        ),
        iterations=1200,
        repeats=1,
        world_count=2,
        pool_size=32,
        steps=(12, 24),
        learning_rate=2e-3,
        milestones=(800, 1050),
        seed_interval=4,
        out=_OUT,
        picture_interval=100,
        checkpoint_interval=200,
        tensorboard=False,
    ),
    "tiny": TrainConfig(
        task=TextureConfig(
            target="dots", particle_count=256, hidden_dim=32, eps=0.3, resolution=24
        ),
        iterations=60,
        repeats=1,
        world_count=2,
        pool_size=8,
        steps=(8, 16),
        learning_rate=5e-3,
        milestones=(45,),
        seed_interval=4,
        out=_OUT,
        log_interval=1,
        picture_interval=20,
        checkpoint_interval=20,
        tensorboard=False,
    ),
}
"""Textures: `paper` (arXiv 2601.16096, needs VGG16's weights), `fast` (on one core), `tiny`."""
