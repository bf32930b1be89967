"""The paper's texture loss: relaxed optimal transport between features of VGG16, and their moments.

After Kolkin, Salavon and Shakhnarovich, "Style Transfer by Relaxed Optimal Transport and
Self-Similarity" (2019).
"""

from __future__ import annotations

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.tasks.sliced import check_images
from npa_envs.tasks.vgg import VGGFeatures, load_vgg_weights

LAYERS = (1, 6, 11, 18, 25)
"""Layers of VGG16 that are compared, in torchvision's counting."""

PLACES = 1024
"""Places of a layer that are compared at most."""

SMALLEST = 32
"""Pixels along each side that leave the deepest layer more than one place."""

TINY = 1e-12
"""Squared length of a feature vector below which it counts as no direction."""


class VGGTransport:
    """The distance of images from a target; satisfies `TextureLoss`.

    For each layer it is the relaxed earth mover's distance under the cosine distance of features,
    plus the mean absolute differences of their means and of their covariances; the layers' are
    added. A layer with more than 1024 places is compared at 1024 of them, drawn once.

    Args:
        target: The texture (dimensionless), shape [3, R, R], or [1, R, R] for a density.
        weights: File of VGG16's weights; empty: torch's folder of downloads.
        tiles: Whether the target's opposite edges meet.
        seed: What the places are drawn from.

    Raises:
        NPAError: There are no such weights, the file is damaged, or the target is too small or has
            another number of channels.
    """

    def __init__(self, target: Tensor, *, weights: str = "", tiles: bool, seed: int) -> None:
        channels, height, _ = target.shape
        if channels not in (1, 3):
            raise NPAError(f"vgg_ot compares images of 1 or 3 channels, got {channels}")
        if height < SMALLEST:
            raise NPAError(
                f"resolution must be at least {SMALLEST} pixels for vgg_ot, got {height}: "
                "for example 128"
            )
        self._shape = tuple(target.shape)
        self._features = VGGFeatures(load_vgg_weights(weights), LAYERS, target)
        generator = torch.Generator().manual_seed(seed)
        self._places: list[Tensor | None] = []
        self._expected = []
        with torch.no_grad():
            for field in self._features(target[None], wrap=tiles):
                count = field.shape[2] * field.shape[3]
                chosen = None
                if count > PLACES:
                    drawn = torch.randperm(count, generator=generator)[:PLACES]
                    chosen = drawn.sort().values.to(target.device)
                self._places.append(chosen)
                self._expected.append(_rows(field, chosen))

    def __call__(self, images: Tensor) -> Tensor:
        """Return the distance of each image (dimensionless), shape [B]; differentiable.

        Without gradient images are compared one by one, so that no image depends on the others.

        Args:
            images: Pictures that tile (dimensionless), shape [B, K, R, R].

        Raises:
            NPAError: They have another shape than the target.
        """
        check_images(images, self._shape)
        if torch.is_grad_enabled() and images.requires_grad:
            return self._compare(images)
        return torch.cat([self._compare(image[None]) for image in images])

    def _compare(self, images: Tensor) -> Tensor:
        total = images.new_zeros(len(images))
        layers = zip(self._features(images, wrap=True), self._places, self._expected, strict=True)
        for field, places, expected in layers:
            found = _rows(field, places)
            total = total + relaxed_transport(found, expected) + moment_distance(found, expected)
        return total


def relaxed_transport(first: Tensor, second: Tensor) -> Tensor:
    """Return the relaxed earth mover's distance of rows under the cosine distance, shape [B].

    Either side may send all to the nearest of the other; the larger of both costs is taken, each
    a lower bound of the cost of transport.

    Args:
        first: Rows, shape [B, M, F].
        second: Rows, shape [1, L, F] or [B, L, F].
    """
    costs = 1.0 - _directions(first) @ _directions(second).transpose(1, 2)
    there, back = costs.amin(dim=2).mean(dim=1), costs.amin(dim=1).mean(dim=1)
    return torch.maximum(there, back)


def moment_distance(first: Tensor, second: Tensor) -> Tensor:
    """Return the mean absolute differences of means and of covariances, added, shape [B].

    Args:
        first: Rows, shape [B, M, F].
        second: Rows, shape [1, L, F] or [B, L, F].
    """
    (mean, covariance), (other_mean, other_covariance) = _moments(first), _moments(second)
    difference = (mean - other_mean).abs().mean(dim=(1, 2))
    return difference + (covariance - other_covariance).abs().mean(dim=(1, 2))


def _rows(field: Tensor, places: Tensor | None) -> Tensor:
    rows = field.flatten(2)
    return (rows if places is None else rows.index_select(2, places)).transpose(1, 2)


def _directions(rows: Tensor) -> Tensor:
    return rows * (rows.square().sum(dim=-1, keepdim=True) + TINY).rsqrt()


def _moments(rows: Tensor) -> tuple[Tensor, Tensor]:
    mean = rows.mean(dim=1, keepdim=True)
    centred = rows - mean
    return mean, centred.transpose(1, 2) @ centred / (rows.shape[1] - 1)
