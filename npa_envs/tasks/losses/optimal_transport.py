"""The paper's texture loss: relaxed optimal transport between features of VGG16, and their moments.

After Kolkin, Salavon and Shakhnarovich, "Style Transfer by Relaxed Optimal Transport and Self-
Similarity" (2019). Of VGG16 (Simonyan and Zisserman 2014) only the weights are needed, not
torchvision: the layers are few. Average pooling takes the place of maximum pooling, and worlds are
padded with what lies on their other side.
"""

from __future__ import annotations

import pickle
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.tasks.losses.sliced import check_images

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


# Features of VGG16.

WEIGHTS_FILE = "vgg16-397923af.pth"
"""Name of torchvision's file of weights trained on ImageNet."""

WEIGHTS_URL = f"https://download.pytorch.org/models/{WEIGHTS_FILE}"
"""Where it can be had."""

WIDTHS = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))
"""Channels of the convolutions; a pooling layer lies between two groups."""

MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of ImageNet's red, green and blue, by which images are normalised."""


class VGGFeatures:
    """Features of images at some layers.

    Args:
        weights: Weight and bias by name, as in torchvision's state dict: `features.0.weight`, ...
        layers: Numbers of the layers whose outputs are wanted, in torchvision's counting: each
            convolution, rectifier and pooling counts as one, from 0.
        like: A tensor of the dtype and on the device that the features are wanted in.

    Raises:
        NPAError: A weight is missing or has another shape.
    """

    def __init__(self, weights: Mapping[str, Any], layers: Sequence[int], like: Tensor) -> None:
        self._layers = frozenset(layers)
        self._steps: list[tuple[Tensor, Tensor] | None] = []
        index, channels = 0, 3
        for group in WIDTHS:
            for width in group:
                weight = _checked(weights, f"features.{index}.weight", (width, channels, 3, 3))
                bias = _checked(weights, f"features.{index}.bias", (width,))
                self._steps.append((weight.to(like), bias.to(like)))
                index, channels = index + 2, width
            self._steps.append(None)
            index += 1
        self._mean = like.new_tensor(MEAN)[:, None, None]
        self._deviation = like.new_tensor(DEVIATION)[:, None, None]

    def __call__(self, images: Tensor, *, wrap: bool) -> list[Tensor]:
        """Return the features at each layer, shape [B, F, R', R'] each, ever coarser.

        Args:
            images: Red, green and blue, or one channel that stands for all three (dimensionless),
                shape [B, 3, R, R] or [B, 1, R, R].
            wrap: Whether opposite edges meet; otherwise images are mirrored at their edges.
        """
        mode = "circular" if wrap else "reflect"
        # In the weights' precision, whatever the worlds' is.
        field = (images.to(self._mean) - self._mean) / self._deviation
        found = []
        index, last = 0, max(self._layers)
        for step in self._steps:
            if step is None:
                field = F.avg_pool2d(field, 2)
                index += 1
            else:
                field = F.conv2d(F.pad(field, (1, 1, 1, 1), mode=mode), *step).relu()
                # A convolution and its rectifier; layers are read behind the latter.
                index += 2
            if index - 1 in self._layers:
                found.append(field)
            if index > last:
                break
        return found


def load_vgg_weights(path: str | Path = "") -> dict[str, Any]:
    """Return the weights of VGG16 by name, on the CPU.

    Args:
        path: The file; empty: `vgg16-397923af.pth` in torch's folder of downloads. Nothing is
            downloaded.

    Raises:
        NPAError: There is no such file, or it is damaged or holds something else.
    """
    folder = Path(torch.hub.get_dir()) / "checkpoints"
    file = Path(path).expanduser() if str(path) else folder / WEIGHTS_FILE
    if not file.is_file():
        raise NPAError(
            f"vgg_ot needs VGG16's weights, and there is no file {str(file)!r}: "
            f"download {WEIGHTS_URL} (528 MiB) to {str(folder / WEIGHTS_FILE)!r}, for example with "
            f"python -c \"import torch; torch.hub.load_state_dict_from_url('{WEIGHTS_URL}')\", "
            "or give the path of such a file as vgg_weights, or choose loss='patch_swd' or "
            "'filter_swd', which need no weights"
        )
    try:
        content = torch.load(file, map_location="cpu", weights_only=True, mmap=True)
    except (OSError, RuntimeError, ValueError, EOFError, pickle.UnpicklingError) as error:
        raise NPAError(
            f"VGG16's weights {str(file)!r} cannot be read, the file is damaged or no torch file "
            f"({' '.join(str(error).split())[:120]}): download {WEIGHTS_URL} again"
        ) from error
    if not isinstance(content, dict):
        raise NPAError(
            f"VGG16's weights {str(file)!r} must be a state dict, got {type(content).__name__}: "
            f"download {WEIGHTS_URL}"
        )
    return content


def _checked(weights: Mapping[str, Any], name: str, shape: tuple[int, ...]) -> Tensor:
    tensor = weights.get(name)
    if not isinstance(tensor, Tensor) or tuple(tensor.shape) != shape:
        found = tuple(tensor.shape) if isinstance(tensor, Tensor) else "nothing"
        raise NPAError(
            f"VGG16's weights must hold {name} of shape {shape}, got {found}: "
            f"give torchvision's file, {WEIGHTS_URL}"
        )
    return tensor.detach()
