"""Texture losses: distances between two textures that do not depend on positions."""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from npa_envs.atomic_files import check_torch_archive, home_path, open_regular
from npa_envs.errors import NPAError, shown, suggest
from npa_envs.ops import world_mean
from npa_envs.tasks.losses.image_distances import (
    LossOptions,
    PatchTransport,
    TextureDistance,
    level_count,
    orthogonal,
    patches,
    products,
    pyramid,
    quantiles,
    stride_of,
)

DEFAULT_LOSS = "patch_swd"
"""The loss that needs no weights and no options."""

DEFAULT_OPTIONS = LossOptions()
"""Options for a target that tiles, with seed 0."""

TextureLoss = Callable[[Tensor], Tensor]
"""The distance of images [B, K, R, R] from a target texture (dimensionless), shape [B].

It is differentiable. Calls draw no random numbers and do not synchronise. A world's loss is the
same, bit for bit, in every batch (of `vgg_ot`: without gradient)."""


@dataclass(frozen=True)
class LossEntry:
    """A texture loss of the table `TEXTURE_LOSSES`."""

    summary: str
    """One line for lists."""

    make: Callable[[Tensor, LossOptions], TextureLoss]
    """Returns the loss against a target, shape [K, R, R]."""

    joint: bool = False
    """Whether it compares colours and density together, K = 4, with `Texture.drawable`."""


def check_loss_name(name: str) -> None:
    """Raise NPAError unless `name` is a texture loss, or joint ones with "+" between them."""
    names = name.split("+") if isinstance(name, str) else [name]
    for one in names:
        if not isinstance(one, str) or one not in TEXTURE_LOSSES:
            hint = suggest(one, TEXTURE_LOSSES)
            raise NPAError(f"loss must be a texture loss that exists, got {shown(name)}: {hint}")
    if len(names) > 1 and not all(TEXTURE_LOSSES[one].joint for one in names):
        joint = ", ".join(key for key, entry in TEXTURE_LOSSES.items() if entry.joint)
        raise NPAError(f"losses that are summed must be joint ones, got {shown(name)}: {joint}")


def is_joint(name: str) -> bool:
    """Return whether a loss, or a sum of losses, compares colours and density together."""
    return TEXTURE_LOSSES[name.split("+")[0]].joint


def make_texture_loss(
    name: str, target: Tensor, options: LossOptions = DEFAULT_OPTIONS
) -> TextureLoss:
    """Return a function from images to their texture loss against a target [K, R, R].

    The target has colours (K = 3), a density (1) or both (4). Names of joint losses with "+"
    between them give their sum.
    """
    check_loss_name(name)
    if not isinstance(target, Tensor):
        raise NPAError(
            f"target must be a tensor of shape [K, R, R], got {type(target).__name__}: for example "
            "torch.as_tensor(target)"
        )
    if target.ndim != 3 or target.shape[1] != target.shape[2] or not target.is_floating_point():
        raise NPAError(
            f"target must be a floating tensor of shape [K, R, R], got {target.dtype} "
            f"{tuple(target.shape)}: channels come first"
        )
    losses = [TEXTURE_LOSSES[one].make(target.detach(), options) for one in name.split("+")]
    return losses[0] if len(losses) == 1 else partial(_summed, losses)


def _summed(losses: list[TextureLoss], images: Tensor) -> Tensor:
    return torch.stack([loss(images) for loss in losses]).sum(0)


# Sliced Wasserstein distances. A texture is described, at each image size, by many features at each
# position. The distributions of a feature over the positions are compared by sorting its values.

PATCH = 5
"""Side of a patch [pixels]."""

FILTERS = 24
"""Random filters of the first layer; each gives two features, its positive and negative part."""

SECOND_PATCH = 3
"""Side of a filter of the second layer [pixels]."""

FLOOR = 0.01
"""Added to the target's variance, so that a uniform target works too."""


class SlicedWasserstein(TextureDistance):
    """The sliced Wasserstein distance of images from a target.

    At each image size it is the mean over the features of the squared 1D 2-Wasserstein distance
    between their distributions, divided by the target's variance; sizes are summed.

    `describe` is the class of a descriptor: it maps images to F features at M positions, [B, M, F]
    for each size. With `wrap` opposite edges are connected, else positions near them are left out.
    With `thinned` there are at most `POSITIONS` along each side.
    """

    same_in_every_batch = True

    def __init__(
        self, describe: Callable[..., Any], target: Tensor, options: LossOptions = DEFAULT_OPTIONS
    ) -> None:
        super().__init__(target)
        self.descriptor = describe(target, seed=options.seed)
        """Describes images by features."""
        with torch.no_grad():
            # The target has as many quantiles as worlds have positions.
            thinned = self.descriptor(target[None], wrap=True, thinned=True)
            described = self.descriptor(target[None].double(), wrap=options.tiles, thinned=False)
            self._quantiles = [
                quantiles(features[0].T, compared.shape[1]).to(target)
                for features, compared in zip(described, thinned, strict=True)
            ]
            self._scales = [1.0 / (each[0].var(0).mean() + FLOOR) for each in described]

    def compare(self, images: Tensor) -> Tensor:
        """Return the distance of images [B, K, R, R] from the target, [B]."""
        described = self.descriptor(images, wrap=True, thinned=True)
        total = images.new_zeros(len(images))
        for features, expected, scale in zip(described, self._quantiles, self._scales, strict=True):
            ordered = features.transpose(1, 2).contiguous().sort(dim=-1).values
            squares = (ordered - expected.to(ordered)).square()
            distance = world_mean(squares.flatten(1)[..., None])[:, 0]
            total = total + scale.to(distance) * distance
        return total


class PatchDescriptor:
    """Features of images: patches of all channels, projected on a random orthonormal basis."""

    def __init__(self, like: Tensor, *, seed: int) -> None:
        generator = torch.Generator().manual_seed(seed)
        size = like.shape[0] * PATCH * PATCH
        self.directions = [
            orthogonal(size, size, generator).to(like) for _ in range(level_count(like.shape[-1]))
        ]
        """Directions for each image size, columns of [K PATCH², K PATCH²]."""

    def __call__(self, images: Tensor, *, wrap: bool, thinned: bool) -> list[Tensor]:
        """Return for each size of images, [B, K, R, R], M projected patches, [B, M, K PATCH²].

        `wrap`: also across opposite edges; `thinned`: at most `POSITIONS` patches along each side.
        """
        sizes = pyramid(images, len(self.directions))
        return [
            products(patches(level, PATCH, stride=stride_of(level, thinned), wrap=wrap), direction)
            for level, direction in zip(sizes, self.directions, strict=True)
        ]


class FilterDescriptor:
    """Features of images: two layers of random filters with rectifiers between them.

    Filters of the first layer sum to zero, but for one mean filter for each channel; those of the
    second layer are random projections of patches of the first layer's features.
    """

    def __init__(self, like: Tensor, *, seed: int) -> None:
        generator = torch.Generator().manual_seed(seed)
        channels, area = like.shape[0], PATCH * PATCH
        self.levels: list[tuple[Tensor, Tensor]] = []
        """Filters of both layers, in columns, for each size of the image."""
        for _ in range(level_count(like.shape[-1])):
            first = torch.randn(channels * area, FILTERS, generator=generator, dtype=torch.float64)
            first -= first.mean(0)
            first /= first.norm(dim=0)
            means = torch.eye(channels, dtype=torch.float64).repeat_interleave(area, 0) / PATCH
            first[:, :channels] = means
            second = orthogonal(2 * FILTERS * SECOND_PATCH**2, 2 * FILTERS, generator)
            self.levels.append((first.to(like), second.to(like)))

    def __call__(self, images: Tensor, *, wrap: bool, thinned: bool) -> list[Tensor]:
        """Return for each image size the features of each layer, two tensors [B, M, 2 FILTERS]."""
        result = []
        for level, (first, second) in zip(
            pyramid(images, len(self.levels)), self.levels, strict=True
        ):
            signed = products(patches(level, PATCH, stride=1, wrap=wrap), first)
            features = torch.cat((signed, -signed), dim=2).relu()
            side = level.shape[-1] - (0 if wrap else PATCH - 1)
            field = features.transpose(1, 2).reshape(len(images), -1, side, side)
            stride = stride_of(level, thinned)
            result.append(field[:, :, ::stride, ::stride].flatten(2).transpose(1, 2))
            around = patches(field, SECOND_PATCH, stride=stride, wrap=wrap)
            result.append(products(around, second))
        return result


# The paper's loss. Of VGG16 (Simonyan and Zisserman 2014) only the weights are needed, not
# torchvision: the layers are few. Average pooling replaces maximum pooling, and worlds are padded
# periodically.

VGG_POSITIONS = 1024
"""Largest number of positions of a layer that are compared."""

VGG_MIN_SIDE = 32
"""Least side of images with more than one position in the deepest layer [pixels]."""

WEIGHTS_FILE = "vgg16-397923af.pth"
"""Name of torchvision's file of weights trained on ImageNet."""

WEIGHTS_URL = f"https://download.pytorch.org/models/{WEIGHTS_FILE}"
"""Address of that file."""

VGG_LAYERS = {(0, 2): 64, (5, 7): 128, (10, 12, 14): 256, (17, 19, 21): 512, (24,): 512}
"""Convolutions in torchvision's counting -> their channels; a pooling layer follows each group.
Features are read after the first rectifier of a group."""

TINY_SQUARE = 1e-12
"""Added to the squared length of a feature vector before it is normalised."""

VGG_MEAN, VGG_DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Mean and standard deviation of ImageNet's red, green and blue."""


class VGGTransport(TextureDistance):
    """Relaxed optimal transport of VGG16's features and their moments, summed over five layers.

    For each layer it is the relaxed earth mover's distance under the cosine distance of features,
    plus the mean absolute differences of their means and of their covariances (Kolkin, Salavon and
    Shakhnarovich, "Style Transfer by Relaxed Optimal Transport and Self-Similarity", 2019). Images
    have 1 or 3 channels. A layer with more than 1024 positions is read at 1024 random ones, the
    same in all calls.
    """

    def __init__(self, target: Tensor, options: LossOptions) -> None:
        super().__init__(target)
        channels, side, _ = target.shape
        if channels not in (1, 3):
            raise NPAError(f"vgg_ot compares images of 1 or 3 channels, got {channels}")
        if side < VGG_MIN_SIDE:
            raise NPAError(
                f"resolution must be at least {VGG_MIN_SIDE} pixels for vgg_ot, got {side}: "
                "for example 128"
            )
        file = load_vgg_weights(options.vgg_weights)
        generator = torch.Generator().manual_seed(options.seed)
        self._groups: list[list[tuple[Tensor, Tensor]]] = []
        self._positions: list[Tensor | None] = []
        channels = 3
        for numbers, width in VGG_LAYERS.items():
            group = []
            for number in numbers:
                weight = _checked(file, f"features.{number}.weight", (width, channels, 3, 3))
                bias = _checked(file, f"features.{number}.bias", (width,))
                group.append((weight.to(target), bias.to(target)))
                channels = width
            self._groups.append(group)
            positions = None
            if side * side > VGG_POSITIONS:
                drawn = torch.randperm(side * side, generator=generator)[:VGG_POSITIONS]
                positions = drawn.sort().values.to(target.device)
            self._positions.append(positions)
            side //= 2
        self._mean = target.new_tensor(VGG_MEAN)[:, None, None]
        self._deviation = target.new_tensor(VGG_DEVIATION)[:, None, None]
        with torch.no_grad():
            self._expected = self.features(target[None], wrap=options.tiles)

    def features(self, images: Tensor, *, wrap: bool) -> list[Tensor]:
        """Return features [B, M, F] of each layer; pads periodically (`wrap`) or mirrored."""
        mode = "circular" if wrap else "reflect"
        # In the weights' precision.
        field = (images.to(self._mean) - self._mean) / self._deviation
        features: list[Tensor] = []
        for group, positions in zip(self._groups, self._positions, strict=True):
            if features:
                field = F.avg_pool2d(field, 2)
            for number, (weight, bias) in enumerate(group):
                field = F.conv2d(F.pad(field, (1, 1, 1, 1), mode=mode), weight, bias).relu()
                if number == 0:
                    rows = field.flatten(2)
                    rows = rows if positions is None else rows.index_select(2, positions)
                    features.append(rows.transpose(1, 2))
        return features

    def compare(self, images: Tensor) -> Tensor:
        """Return the distance of images [B, K, R, R] from the target, [B]."""
        total = images.new_zeros(len(images))
        for actual, target in zip(self.features(images, wrap=True), self._expected, strict=True):
            expected = target.to(actual)
            total = total + relaxed_transport(actual, expected) + moment_distance(actual, expected)
        return total


def relaxed_transport(first: Tensor, second: Tensor) -> Tensor:
    """Return the relaxed earth mover's distance of two sets of feature vectors, shape [B].

    Every vector (a row) moves to the one of the other set with the least cosine distance. The
    larger mean cost of both directions is returned; each is a lower bound of transport's cost.
    """
    costs = 1.0 - _directions(first) @ _directions(second).transpose(1, 2)
    there, back = costs.amin(dim=2).mean(dim=1), costs.amin(dim=1).mean(dim=1)
    return torch.maximum(there, back)


def moment_distance(first: Tensor, second: Tensor) -> Tensor:
    """Return the mean absolute difference of features' means, plus that of covariances, [B]."""
    (mean, covariance), (other_mean, other_covariance) = _moments(first), _moments(second)
    difference = (mean - other_mean).abs().mean(dim=(1, 2))
    return difference + (covariance - other_covariance).abs().mean(dim=(1, 2))


def _directions(rows: Tensor) -> Tensor:
    return rows * (rows.square().sum(dim=-1, keepdim=True) + TINY_SQUARE).rsqrt()


def _moments(rows: Tensor) -> tuple[Tensor, Tensor]:
    mean = rows.mean(dim=1, keepdim=True)
    centred = rows - mean
    return mean, centred.transpose(1, 2) @ centred / (rows.shape[1] - 1)


def load_vgg_weights(path: str | Path = "") -> dict[str, Any]:
    """Return the weights of VGG16 by name, on the CPU."""
    folder = Path(torch.hub.get_dir()) / "checkpoints"
    file = home_path(path) if str(path) else folder / WEIGHTS_FILE
    if not os.path.exists(file):
        raise NPAError(
            f"vgg_ot needs VGG16's weights, and there is no file {shown(str(file))}: download "
            f"{WEIGHTS_URL} (528 MiB) to {shown(str(folder / WEIGHTS_FILE))}, for example with "
            f"python -c \"import torch; torch.hub.load_state_dict_from_url('{WEIGHTS_URL}')\", or "
            "give the path of such a file as vgg_weights, or choose loss='patch_swd' or "
            "'filter_swd', which need no weights"
        )
    try:
        with open_regular(file, limit=2**30, what="the file") as opened:
            check_torch_archive(opened, checksums=False)
        content = torch.load(file, map_location="cpu", weights_only=True, mmap=True)
    except (OSError, RuntimeError, ValueError, EOFError, pickle.UnpicklingError) as error:
        raise NPAError(
            f"VGG16's weights {shown(str(file))} cannot be read, the file is damaged or no torch "
            f"file ({shown(error)}): download {WEIGHTS_URL} again"
        ) from error
    if not isinstance(content, dict):
        raise NPAError(
            f"VGG16's weights {shown(str(file))} must be a state dict, got "
            f"{type(content).__name__}: download {WEIGHTS_URL}"
        )
    return content


def _checked(weights: Mapping[str, Any], name: str, shape: tuple[int, ...]) -> Tensor:
    tensor = weights.get(name)
    if not isinstance(tensor, Tensor) or tuple(tensor.shape) != shape:
        got = tuple(tensor.shape) if isinstance(tensor, Tensor) else "nothing"
        raise NPAError(
            f"VGG16's weights must hold {name} of shape {shape}, got {got}: "
            f"give torchvision's file, {WEIGHTS_URL}"
        )
    return tensor.detach()


TEXTURE_LOSSES: Mapping[str, LossEntry] = {
    "vgg_ot": LossEntry(
        "the paper's: optimal transport of VGG16 features; needs weights",
        VGGTransport,
    ),
    "patch_swd": LossEntry(
        "sliced Wasserstein distance of raw patches at several sizes",
        partial(SlicedWasserstein, PatchDescriptor),
    ),
    "filter_swd": LossEntry(
        "sliced Wasserstein distance of two layers of random filters",
        partial(SlicedWasserstein, FilterDescriptor),
    ),
    "joint_swd": LossEntry(
        "`patch_swd` of colours and density at once",
        partial(SlicedWasserstein, PatchDescriptor),
        joint=True,
    ),
    "patch_ot": LossEntry(
        "relaxed optimal transport of raw patches at several sizes", PatchTransport, joint=True
    ),
}
"""Every texture loss by name."""
