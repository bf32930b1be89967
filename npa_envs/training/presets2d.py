"""Presets of 2D morphogenesis."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from npa_envs.tasks.morphogenesis2d_config import Morphogenesis2DConfig
from npa_envs.training.config import Morphogenesis2DTrainConfig, TrainConfig

_OUT = Path("runs/morphogenesis2d")

MORPHOGENESIS2D_PRESETS: Mapping[str, Morphogenesis2DTrainConfig] = {
    "paper": TrainConfig(task=Morphogenesis2DConfig(), out=_OUT),
    # A few particles that see far, in worlds that start from seeds often: a recognisable gecko
    # after about four minutes on one core (means of 4 worlds: splat loss 0.16 and PSNR 25 dB at
    # step 64, 0.22 and 23 dB at step 1024; with a seed in every sixth batch 0.21 and 0.43).
    "fast": TrainConfig(
        task=Morphogenesis2DConfig(
            target_point_count=512,
            particle_count=512,
            hidden_dim=64,
            eps=0.2,
            seed_radius=0.4,
            resolution=64,
        ),
        iterations=2400,
        repeats=1,
        world_count=2,
        pool_size=32,
        steps=(16, 32),
        learning_rate=2e-3,
        milestones=(1500, 2100),
        seed_interval=2,
        out=_OUT,
        picture_interval=200,
        checkpoint_interval=200,
        tensorboard=False,
    ),
    "tiny": TrainConfig(
        task=Morphogenesis2DConfig(
            target="ring",
            target_point_count=128,
            particle_count=128,
            hidden_dim=32,
            eps=0.3,
            resolution=32,
        ),
        iterations=40,
        repeats=1,
        world_count=2,
        pool_size=8,
        steps=(8, 16),
        learning_rate=5e-3,
        milestones=(30,),
        out=_OUT,
        log_interval=1,
        picture_interval=20,
        checkpoint_interval=20,
        tensorboard=False,
    ),
}
"""2D morphogenesis: `paper` (arXiv 2601.16096), `fast` (minutes on one core), `tiny` (tests)."""
