"""The classification task: particles that do not move agree on the class of their point cloud."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import torch
from torch import Tensor

from npa_envs.checks import check_non_negative, check_positive, check_seed, check_text
from npa_envs.errors import NPAError
from npa_envs.ops import splat
from npa_envs.ops.world_mean import scalar_world_mean
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.base import Frame, ParticleTask, TaskConfig
from npa_envs.tasks.seeds import drawn_indices, drawn_worlds
from npa_envs.tasks.targets.digit_clouds import PointClouds, Split, augmented, load_clouds
from npa_envs.tasks.train_config import Common, TrainConfig, fast_run, presets_of, tiny_run
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import Randomness, normal_draws


@dataclass(frozen=True, kw_only=True)
class PointClassificationConfig(TaskConfig):
    """Particles that do not move agree on the class of their point cloud (arXiv 2601.16096).

    The defaults are the paper's, but for the data, which are small. Lengths are in length units;
    a cloud fills about [0, 1]².
    """

    data: Common[str] = "digits"
    """The pictures: "digits" (scikit-learn), "mnist" (torchvision), or a folder of IDX files."""

    data_folder: str = "data"
    """Folder of torchvision's "mnist"."""

    class_count: int = 10
    """Number of classes."""

    sample_seed: int = 0
    """Seed of the points that are chosen from the pictures."""

    rotation: float = 0.0
    """Largest random rotation of clouds to train with, in either direction [degrees]."""

    stretch: float = 0.0
    """Largest random stretch and shear of clouds to train with (dimensionless)."""

    jitter: float = 0.0
    """Standard deviation of the noise on coordinates of clouds to train with [length units]."""

    mutated_share: float = 0.0
    """Probability that a damaged world from the pool gets the positions and class of another cloud
    and keeps its states (dimensionless)."""

    cut_share: float = 0.0
    """Probability that a damaged world from the pool has the quarter of its particles on a random
    side moved out of sight of the others, and keeps its class (dimensionless)."""

    particle_count: Common[int] = 512
    """Particles in a world, N: points of a cloud."""

    hidden_dim: Common[int] = 256
    """Width of the rule's hidden layer."""

    readout_hidden_dim: int = 256
    """Width of the hidden layer of the read-out, which maps states to class scores."""

    overflow_weight: float = 1.0
    """Weight of mean |s − clip(s, −1, 1)| (dimensionless)."""

    @property
    def goal_text(self) -> str:
        """The data set whose clouds rules classify."""
        return f"the data {self.data}"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_text(self, "data", "a name or a path")
        check_text(self, "data_folder", "a path")
        check_seed(self, "sample_seed")
        check_positive(self, int, "readout_hidden_dim")
        check_positive(self, int, "class_count", at_least=2)
        check_non_negative(self, "rotation", "jitter")
        check_non_negative(self, "stretch", "mutated_share", "cut_share", at_most=1.0)


SIGMA = 0.7
"""Standard deviation of a particle's splat, in distances between particles (dimensionless)."""


class PointClassification(ParticleTask[PointClassificationConfig]):
    """The classification task of arXiv 2601.16096: each particle outputs a score for each class.

    Scores are the outputs of the rule's read-out; without a read-out, the last channels of the
    states. The goal of a world is its cloud's class. Clouds of the split "train" are randomly
    rotated, stretched and jittered, those of "test" are not.
    """

    metric_name = "mean squared error to the class"
    trial_name = "share of particles that are wrong"
    classifies = True
    _resized_with = ("split",)
    _rule: NPARule | None = None

    def __init__(
        self,
        config: PointClassificationConfig | None = None,
        *,
        device: str | torch.device = "cpu",
        split: Split = "train",
    ) -> None:
        self.config = config = config or PointClassificationConfig()
        self.split: Split = split
        """The clouds that worlds are made of, "train" or "test"."""
        self._device = torch.device(device)
        self.goal_count = config.class_count
        # There is no picture to match.
        side = config.resolution
        self._target_picture = torch.zeros(side, side, 4, device=self._device)

    @cached_property
    def clouds(self) -> PointClouds:
        """All clouds of the split, whose pictures are loaded at the first use."""
        config = self.config
        clouds = load_clouds(
            config.data,
            self.split,
            config.particle_count,
            folder=config.data_folder,
            sample_seed=config.sample_seed,
            device=self._device,
        )
        highest = int(clouds.label.max())
        if highest >= config.class_count:
            raise NPAError(
                f"class_count must be more than the highest class of the data, {highest}, got "
                f"{config.class_count}: set class_count={highest + 1}"
            )
        return clouds

    @property
    def frame(self) -> Frame:
        """The region that viewers show: [0, 1]² and a margin."""
        return Frame((0.5, 0.5), 0.6)

    @property
    def pixel_size(self) -> float:
        """Distance between neighbouring particles, about [length units]."""
        return math.sqrt(self.clouds.coverage / self.config.particle_count)

    @property
    def rule_shape(self) -> dict[str, Any]:
        """Arguments of `NPARule` in addition to state_dim, hidden_dim and eps0."""
        sizes = {"readout_dim": self.config.class_count}
        sizes["readout_hidden_dim"] = self.config.readout_hidden_dim
        return {"alpha": 1.0, "static": True, **sizes}

    def for_rule(self, rule: NPARule) -> Self:
        """Return a copy of the task whose losses and pictures use the rule's read-out."""
        return self._copy_with(_rule=rule)

    def held_out(self) -> Self:
        """Return a copy of the task with the clouds of "test"."""
        task = self._copy_with(split="test")
        vars(task).pop("clouds", None)
        return task

    def seed(
        self, world_count: int, *, generator: Randomness, device: str | torch.device = "cpu"
    ) -> Particles:
        """Return worlds of random clouds, with zero states and the clouds' classes as goals."""
        config, clouds = self.config, self.clouds
        chosen = drawn_indices(len(clouds.label), world_count, generator, torch.device(device))
        chosen = chosen.to(clouds.label.device)
        x, goal = clouds.points(chosen).to(device), clouds.label[chosen].to(device)
        if self.split == "train":
            x = augmented(x, config.rotation, config.stretch, config.jitter, generator)
        return Particles(x, x.new_zeros(*x.shape[:2], config.state_dim), goal=goal)

    def damage(self, worlds: Particles, generator: Randomness) -> Particles:
        """Return worlds; some get another cloud and its class, of some a quarter is cut off.

        The probabilities are `mutated_share` and `cut_share`.
        """
        x, mutated, cut = worlds.x, self.config.mutated_share, self.config.cut_share
        if worlds.goal is not None and mutated > 0.0:
            other = self.seed(len(x), generator=generator, device=x.device)
            other = worlds._replace(x=other.x.to(x.dtype), goal=other.goal)
            worlds = other.where(drawn_worlds(x, generator, mutated), worlds)
        if cut > 0.0:
            normal = torch.nn.functional.normalize(normal_draws(generator, (len(x), 2), x))[:, None]
            height = worlds.x[..., :1] * normal[..., :1] + worlds.x[..., 1:] * normal[..., 1:]
            bound = height.sort(dim=1).values[:, 3 * x.shape[1] // 4 :][:, :1]
            # As far from the rest as if they were gone.
            apart = worlds.x + 2.0 * self.eps * (height >= bound) * normal
            worlds = worlds._replace(x=apart).where(drawn_worlds(x, generator, cut), worlds)
        return worlds

    def outputs(self, s: Tensor) -> Tensor:
        """Return each particle's class scores, dimensionless, shape [B, N, K]."""
        outputs = s if self._rule is None else self._rule.read_out(s)
        if outputs.shape[-1] < self.config.class_count:
            raise NPAError(
                f"a rule must have at least as many outputs as there are classes, "
                f"{self.config.class_count}, got {outputs.shape[-1]}: set readout_dim or state_dim"
            )
        return outputs[..., -self.config.class_count :]

    def errors(self, s: Tensor) -> Tensor:
        """Return each particle's mean of (class scores - one-hot of the world's class)², [B, N]."""
        outputs = self.outputs(s)
        classes = torch.arange(self.config.class_count, device=s.device)
        one_hot = (self.goal[:, None] == classes).to(outputs.dtype)
        return channel_mean((outputs - one_hot[:, None]).square())

    def mistakes(self, s: Tensor) -> Tensor:
        """Return 1 for particles that score a wrong class highest, else 0, shape [B, N]."""
        return (self.outputs(s).argmax(dim=-1) != self.goal[:, None]).to(s.dtype)

    def cross_entropies(self, s: Tensor, sharpness: float) -> Tensor:
        """Return each particle's cross-entropy of class and softmax(sharpness × scores), [B, N]."""
        log_probabilities = torch.log_softmax(sharpness * self.outputs(s), dim=-1)
        label = self.goal[:, None, None].expand(*s.shape[:2], 1)
        return -log_probabilities.gather(-1, label).squeeze(-1)

    def metric(self, x: Tensor, s: Tensor) -> Tensor:
        """Return each world's mean of (class scores - one-hot of its class)², shape [B]."""
        return scalar_world_mean(self.errors(s))

    def trial_metric(self, worlds: Particles) -> Tensor:
        """Return the fraction of each world's particles with a wrong class, shape [B]."""
        return self.mistakes(worlds.s).mean(1)

    def colours(self, s: Tensor) -> Tensor:
        """Return the colour of each particle's best class, shape [B, N, 3]."""
        return class_colours(self.outputs(s))

    def overflows(self, s: Tensor) -> Tensor:
        """Return each particle's mean |s − clip(s, −1, 1)| over channels, shape [B, N]."""
        return channel_mean((s - s.clamp(-1.0, 1.0)).abs())

    def compare(self, worlds: Particles) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the batch's mean squared error, and terms "error" (the same) and "accuracy", [].

        Accuracy is the fraction of particles that score the right class highest.
        """
        error = self.errors(worlds.s).mean()
        accuracy = 1.0 - self.mistakes(worlds.s.detach()).mean()
        return error, {"error": error, "accuracy": accuracy}

    def picture(self, x: Tensor, s: Tensor) -> Tensor:
        """Return pictures of particles in colours of their best class, shape [B, R, R, 4].

        Channels are as in `target_picture`.
        """
        return splat(
            x,
            self.colours(s),
            resolution=self.config.resolution,
            pixel_size=self.pixel_size,
            sigma=SIGMA,
            lo=-PICTURE_MARGIN,
            hi=1.0 + PICTURE_MARGIN,
        )

    def __getstate__(self) -> dict[str, object]:
        """Return the attributes to pickle, without the clouds, which are loaded again."""
        return {name: value for name, value in vars(self).items() if name != "clouds"}


PICTURE_MARGIN = 0.0625
"""Width of the margin around [0, 1]² in pictures [length units]."""

PALETTE = (
    (0.90, 0.10, 0.29), (0.24, 0.71, 0.29), (1.00, 0.85, 0.10), (0.26, 0.39, 0.85),
    (0.96, 0.51, 0.19), (0.57, 0.12, 0.71), (0.27, 0.80, 0.85), (0.94, 0.20, 0.90),
    (0.50, 0.35, 0.14), (0.65, 0.55, 1.00),
)  # fmt: skip
"""Red, green and blue of class 0, 1, ..., repeated for more classes."""

UNDECIDED = (0.6, 0.6, 0.6)
"""Colour of a particle whose scores are 0."""


def majority(outputs: Tensor) -> Tensor:
    """Return the class that the largest number of particles score highest, int64, shape [B].

    `outputs` are the scores [B, N, K]. If classes have equally many particles, it is that with the
    largest sum of scores.
    """
    particle_count, class_count = outputs.shape[1:]
    classes = torch.arange(class_count, device=outputs.device)
    votes = (outputs.argmax(-1)[..., None] == classes).sum(1)
    sums = outputs.double().sum(1)
    # Less than one vote, whatever the outputs.
    tie_breaker = 0.5 * torch.softmax(sums / particle_count, dim=-1)
    return (votes + tie_breaker).argmax(-1)


def class_colours(outputs: Tensor) -> Tensor:
    """Return the colour of each particle's best class, greyer the lower its score; [B, N, 3]."""
    rows = [PALETTE[k % len(PALETTE)] for k in range(outputs.shape[-1])]
    sure, chosen = outputs.max(-1, keepdim=True)
    sure = sure.clamp(0.0, 1.0)
    colours = []
    for channel, grey in enumerate(UNDECIDED):
        # Scalar by scalar: a tensor of the palette would be copied to the device for each picture.
        colour = torch.zeros_like(sure)
        for number, row in enumerate(rows):
            colour = torch.where(chosen == number, row[channel], colour)
        colours.append(grey + sure * (colour - grey))
    return torch.cat(colours, dim=-1)


def channel_mean(values: Tensor) -> Tensor:
    """Return the mean over the last dimension, whose bits do not depend on the batch."""
    # One by one: the rounding of torch's mean may depend on the batch.
    total, *rest = values.unbind(-1)
    for term in rest:
        total = total + term
    return total / values.shape[-1]


POINT_CLASSIFICATION_PRESETS = presets_of(
    "point_classification",
    paper=TrainConfig(
        task=PointClassificationConfig(), iterations=50_000, repeats=1, world_count=64,
        pool_size=1024, steps=(12, 24), learning_rate=1e-3, weight_decay=0.1,
        milestones=(20_000, 40_000), seed_interval=1, fresh_share=0.5,
    ),
    # Of clouds never seen 91 % are classified rightly, after some four minutes on one core.
    fast=fast_run(
        task=PointClassificationConfig(
            stretch=0.1, mutated_share=0.25, particle_count=128, hidden_dim=128,
            readout_hidden_dim=64, eps=0.2, resolution=64,
        ),
        iterations=1500, world_count=32, pool_size=256, steps=(12, 20), milestones=(1100, 1400),
        seed_interval=1, fresh_share=0.5, picture_interval=500, checkpoint_interval=300,
    ),
    tiny=tiny_run(
        task=PointClassificationConfig(
            particle_count=64, hidden_dim=32, readout_hidden_dim=32, eps=0.25, resolution=32,
        ),
        world_count=8, pool_size=32, steps=(6, 10), seed_interval=1, fresh_share=0.5,
    ),
)  # fmt: skip
"""Classification of point clouds: `paper` (arXiv 2601.16096), `fast` (on one core), `tiny`."""
