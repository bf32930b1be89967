"""Self-classifying point clouds: particles that never move agree on what they form."""

from __future__ import annotations

import copy
import math
from functools import cached_property
from typing import Self

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.ops import splat, world_mean
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.clouds import PointClouds, drawn_indices, load_clouds, share_of_worlds, varied
from npa_envs.tasks.digits import Split
from npa_envs.tasks.point_classification_config import PointClassificationConfig
from npa_envs.tasks.rules import untrained_rule
from npa_envs.tasks.votes import class_colours
from npa_envs.world.randomness import Randomness

SIGMA = 0.7
"""Standard deviation of a particle's splat, in distances between particles (dimensionless)."""


class PointClassification:
    """The classification task of arXiv 2601.16096; satisfies `PictureTask` and `GoalTask`.

    The goal of a world is its cloud's class. A rule's read-out gives one number for each class;
    without a rule, or where it has no read-out, these are the last channels of the states.

    Args:
        config: Data, variation, world and rule size.
        device: Where the clouds are kept.
        split: Which clouds worlds are made of; those of "test" are not varied.
    """

    aligned = False
    """There is no picture to match."""

    metric_name = "mean squared error to the class"
    """What `metric` is."""

    def __init__(
        self,
        config: PointClassificationConfig | None = None,
        *,
        device: str | torch.device = "cpu",
        split: Split = "train",
    ) -> None:
        self.config = config = config or PointClassificationConfig()
        self.split: Split = split
        """Which clouds worlds are made of."""
        self._device = torch.device(device)
        self._rule: NPARule | None = None
        self._goal: Tensor | None = None

    @cached_property
    def clouds(self) -> PointClouds:
        """All clouds that worlds are made of, loaded when first asked for.

        Raises:
            NPAError: They cannot be loaded, or are of more classes than the configuration says.
        """
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
    def eps(self) -> float:
        """Perception radius [length units]."""
        return self.config.eps

    @property
    def box(self) -> None:
        """Clouds lie in open space."""
        return None

    @property
    def update_prob(self) -> float:
        """Probability of a particle's update in a step, dimensionless."""
        return self.config.update_prob

    @property
    def target_picture(self) -> Tensor:
        """Nothing: there is no picture to match; shape [R, R, 4]."""
        return torch.zeros(self.config.resolution, self.config.resolution, 4, device=self._device)

    @property
    def pixel_size(self) -> float:
        """Side of the square that a particle fills [length units]."""
        return math.sqrt(self.clouds.coverage / self.config.particle_count)

    def make_rule(self, generator: torch.Generator) -> NPARule:
        """Return an untrained rule on the CPU; its weights are drawn from `generator`."""
        return untrained_rule(
            generator,
            state_dim=self.config.state_dim,
            hidden_dim=self.config.hidden_dim,
            eps0=self.config.eps,
            alpha=1.0,
            static=True,
            readout_dim=self.config.class_count,
            readout_hidden_dim=self.config.readout_hidden_dim,
        )

    def for_rule(self, rule: NPARule) -> Self:
        """Return the task with losses and pictures that read states through `rule`."""
        return self._with(_rule=rule)

    def on(self, split: Split) -> Self:
        """Return the task with the clouds of "train" or "test"."""
        other = self._with(split=split)
        vars(other).pop("clouds", None)
        return other

    def toward(self, goal: Tensor) -> Self:
        """Return the task with loss and metric for worlds of these classes, shape [B]."""
        return self._with(_goal=goal)

    def seed(
        self, world_count: int, *, generator: Randomness, device: str | torch.device = "cpu"
    ) -> tuple[Tensor, Tensor]:
        """Return fresh worlds without their classes; as `seed_with_goals`."""
        return self.seed_with_goals(world_count, generator=generator, device=device)[:2]

    def seed_with_goals(
        self, world_count: int, *, generator: Randomness, device: str | torch.device = "cpu"
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return random clouds, varied as the configuration says, with all states zero.

        Args:
            world_count: Worlds B.
            generator: Source of randomness, on `device`.
            device: Where the worlds are made: that of the task, or they are copied there.

        Returns:
            Positions [length units], shape [B, N, 2]; states, dimensionless, shape [B, N, C]; and
            classes, int64, shape [B].
        """
        config, clouds = self.config, self.clouds
        chosen = drawn_indices(len(clouds.label), world_count, generator, torch.device(device))
        chosen = chosen.to(clouds.label.device)
        x, goal = clouds.x[chosen].to(device), clouds.label[chosen].to(device)
        if self.split == "train":
            x = varied(
                x,
                rotation=config.rotation,
                stretch=config.stretch,
                jitter=config.jitter,
                generator=generator,
            )
        return x, x.new_zeros(*x.shape[:2], config.state_dim), goal

    def damage(self, x: Tensor, s: Tensor, generator: Randomness) -> tuple[Tensor, Tensor]:
        """Return the worlds as they are: who forgets its class cannot be told it again."""
        return x, s

    def damage_with_goals(
        self, x: Tensor, s: Tensor, goal: Tensor, generator: Randomness
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return some worlds as other clouds, with their states as they were, and the classes."""
        share = self.config.mutated_share
        if share == 0.0:
            return x, s, goal
        other, _, other_goal = self.seed_with_goals(len(x), generator=generator, device=x.device)
        mutated = share_of_worlds(share, len(x), generator, x.device)
        x = torch.where(mutated[:, None, None], other.to(x.dtype), x)
        return x, s, torch.where(mutated, other_goal, goal)

    def outputs(self, s: Tensor) -> Tensor:
        """Return what each particle says of each class, dimensionless, shape [B, N, K].

        Args:
            s: States, dimensionless, shape [B, N, C].

        Raises:
            NPAError: There are fewer outputs than classes.
        """
        outputs = s if self._rule is None else self._rule.read_out(s)
        if outputs.shape[-1] < self.config.class_count:
            raise NPAError(
                f"a rule must have at least as many outputs as there are classes, "
                f"{self.config.class_count}, got {outputs.shape[-1]}: set readout_dim or state_dim"
            )
        return outputs[..., -self.config.class_count :]

    def errors(self, s: Tensor) -> Tensor:
        """Return each particle's mean squared error to the one-hot of its world's class, [B, N].

        Args:
            s: States, dimensionless, shape [B, N, C].

        Raises:
            NPAError: The classes have not been said by `toward`.
        """
        if self._goal is None:
            raise NPAError("the worlds' classes must be given first: task.toward(goal), int64 [B]")
        outputs = self.outputs(s)
        classes = torch.arange(self.config.class_count, device=s.device)
        wanted = (self._goal[:, None] == classes).to(outputs.dtype)
        return channel_mean((outputs - wanted[:, None]).square())

    def metric(self, x: Tensor, s: Tensor) -> Tensor:
        """Return each world's mean squared error, shape [B]; for `x` and `s` as in `loss`."""
        return world_mean(self.errors(s)[..., None])[:, 0]

    def overflows(self, s: Tensor) -> Tensor:
        """Return each particle's mean |s − clip(s, −1, 1)|, [B, N]; for `s` as in `errors`."""
        return channel_mean((s - s.clamp(-1.0, 1.0)).abs())

    def overflow(self, s: Tensor) -> Tensor:
        """Return each world's mean |s − clip(s, −1, 1)|, shape [B]; for `s` as in `errors`."""
        return world_mean(self.overflows(s)[..., None])[:, 0]

    def loss(self, x: Tensor, s: Tensor, path_length: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the training loss and its named parts, unweighted, and the share that is right.

        Args:
            x: Positions [length units], shape [B, N, 2].
            s: States, dimensionless, shape [B, N, C].
            path_length: How far each particle travelled, [B, N]: not at all.

        Raises:
            NPAError: The classes have not been said by `toward`.
        """
        parts = {
            "error": self.errors(s).mean(),
            "overflow": (s - s.clamp(-1.0, 1.0)).abs().mean(),
        }
        assert self._goal is not None, "asked for by errors()"
        right = self.outputs(s.detach()).argmax(-1) == self._goal[:, None]
        total = parts["error"] + self.config.overflow_weight * parts["overflow"]
        return total, {**parts, "accuracy": right.to(s.dtype).mean().detach()}

    def picture(self, x: Tensor, s: Tensor) -> Tensor:
        """Return the picture of each world, coloured by class: colour sums and density.

        Args:
            x: Positions [length units], shape [B, N, 2].
            s: States, dimensionless, shape [B, N, C].

        Returns:
            Shape [B, R, R, 4].
        """
        return splat(
            x,
            class_colours(self.outputs(s)),
            resolution=self.config.resolution,
            pixel_size=self.pixel_size,
            sigma=SIGMA,
            lo=0.0,
            hi=1.0,
        )

    def __getstate__(self) -> dict[str, object]:
        """Leave out the clouds, which are loaded again when they are asked for."""
        return {name: value for name, value in vars(self).items() if name != "clouds"}

    def _with(self, **fields: object) -> Self:
        bound = copy.copy(self)
        vars(bound).update({"clouds": self.clouds} if "clouds" in vars(self) else {})
        vars(bound).update(fields)
        return bound


def channel_mean(values: Tensor) -> Tensor:
    """Return the mean over the last dimension, rounded alike in every batch.

    Args:
        values: Shape [..., K].
    """
    # One by one: torch's mean may round otherwise in another batch.
    total, *rest = values.unbind(-1)
    for term in rest:
        total = total + term
    return total / values.shape[-1]
