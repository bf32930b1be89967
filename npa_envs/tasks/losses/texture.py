"""Texture losses: distances between two textures that do not depend on positions."""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from npa_envs.errors import NPAError, shown, suggest
from npa_envs.files import check_torch_archive, home_path, open_regular
from npa_envs.ops import world_mean
from npa_envs.tasks.losses.pieces import (
    FeatureTransport,
    PatchTransport,
    RandomFilters,
    TextureDistance,
    check_images,
    check_size,
    level_count,
    moment_distance,
    orthogonal,
    patches,
    products,
    pyramid,
    quantiles,
    relaxed_transport,
    stride_of,
)

DEFAULT_LOSS = "patch_swd"
"""The loss that needs no weights and no options."""


class TextureLoss(Protocol):
    """The distance of images from a target texture.

    Calls draw no random numbers and do not synchronise. A world's loss is the same, bit for bit, in
    every batch (of `vgg_ot`: without gradient).
    """

    def __call__(self, images: Tensor) -> Tensor:
        """Return the distance of images [B, K, R, R] (dimensionless), shape [B]; differentiable."""


@dataclass(frozen=True)
class LossOptions:
    """Options of a texture loss."""

    tiles: bool = True
    """Whether the target's opposite edges fit together, so that patches may cross them."""

    seed: int = 0
    """Seed of the loss's directions, filters and positions."""

    vgg_weights: str = ""
    """File of VGG16's weights, for `vgg_ot`; empty: torch's usual folder of downloads."""


DEFAULT_OPTIONS = LossOptions()
"""Options for a target that tiles, with seed 0."""


@dataclass(frozen=True)
class LossEntry:
    """A row of `TEXTURE_LOSSES`."""

    summary: str
    """One line for lists."""

    make: Callable[[Tensor, LossOptions], TextureLoss]
    """Returns the loss against a target, shape [K, R, R]."""

    joint: bool = False
    """Whether it compares colours and density together, K = 4, with `Texture.drawable`."""


TEXTURE_LOSSES: Mapping[str, LossEntry] = {
    "vgg_ot": LossEntry(
        "the paper's: optimal transport of VGG16 features; needs weights",
        lambda target, options: VGGTransport(
            target, weights=options.vgg_weights, tiles=options.tiles, seed=options.seed
        ),
    ),
    "patch_swd": LossEntry(
        "sliced Wasserstein distance of raw patches at several sizes",
        lambda target, options: _sliced(PatchDescriptor, target, options),
    ),
    "filter_swd": LossEntry(
        "sliced Wasserstein distance of two layers of random filters",
        lambda target, options: _sliced(FilterDescriptor, target, options),
    ),
    "joint_swd": LossEntry(
        "`patch_swd` of colours and density at once",
        lambda target, options: _sliced(PatchDescriptor, target, options),
        joint=True,
    ),
    "patch_ot": LossEntry(
        "relaxed optimal transport of raw patches at several sizes",
        lambda target, options: PatchTransport(target, tiles=options.tiles),
        joint=True,
    ),
    "filter_ot": LossEntry(
        "relaxed optimal transport of one layer of random filters of many sizes",
        lambda target, options: FeatureTransport(
            target, RandomFilters(target, seed=options.seed), tiles=options.tiles
        ),
        joint=True,
    ),
}
"""Every texture loss by name."""


def check_loss_name(name: str) -> None:
    """Check that a name, or every name joined by "+", is of a texture loss."""
    parts = name.split("+") if isinstance(name, str) else []
    for part in parts or [name]:
        if not isinstance(part, str) or part not in TEXTURE_LOSSES:
            hint = suggest(part, TEXTURE_LOSSES)
            raise NPAError(f"loss must be a texture loss that exists, got {shown(name)}: {hint}")
    if len(parts) > 1 and not all(TEXTURE_LOSSES[part].joint for part in parts):
        joint = ", ".join(key for key, entry in TEXTURE_LOSSES.items() if entry.joint)
        raise NPAError(f"losses that are summed must be joint ones, got {shown(name)}: {joint}")


def is_joint(name: str) -> bool:
    """Return whether a loss, or a sum of losses, compares colours and density together."""
    return TEXTURE_LOSSES[name.split("+")[0]].joint


class LossSum:
    """The sum of several losses; satisfies `TextureLoss`."""

    def __init__(self, losses: Sequence[TextureLoss]) -> None:
        self._losses = losses

    def __call__(self, images: Tensor) -> Tensor:
        """Return the sum of each image's losses (dimensionless), shape [B]; differentiable."""
        return torch.stack([loss(images) for loss in self._losses]).sum(0)


def make_texture_loss(
    name: str, target: Tensor, options: LossOptions = DEFAULT_OPTIONS
) -> TextureLoss:
    """Return the loss against a target [K, R, R]: colours (K = 3), density (1) or both (4).

    Names of joint losses that are joined by "+" give their sum.
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
    made = [TEXTURE_LOSSES[part].make(target.detach(), options) for part in name.split("+")]
    return made[0] if len(made) == 1 else LossSum(made)


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


Descriptor = Callable[..., list[Tensor]]
"""Returns the features at each position of images, [B, M, F] for each size. With `wrap` opposite
edges meet, else positions near them are left out; `thinned`: at most `PLACES` along each side."""


class SlicedWasserstein:
    """The sliced Wasserstein distance of images from a target; satisfies `TextureLoss`.

    At each image size it is the mean over the features of the squared 1D 2-Wasserstein distance
    between their distributions, divided by the target's variance; sizes are summed.
    """

    def __init__(self, target: Tensor, descriptor: Descriptor, *, tiles: bool) -> None:
        check_size(target)
        self._descriptor = descriptor
        self._shape = tuple(target.shape)
        with torch.no_grad():
            # The target has as many quantiles as worlds have positions.
            thinned = descriptor(target[None], wrap=True, thinned=True)
            described = descriptor(target[None].double(), wrap=tiles, thinned=False)
            self._quantiles = [
                quantiles(features[0].T, found.shape[1]).to(target)
                for features, found in zip(described, thinned, strict=True)
            ]
            self._scales = [1.0 / (each[0].var(0).mean() + FLOOR) for each in described]

    def __call__(self, images: Tensor) -> Tensor:
        """Return the distance of each image (dimensionless), shape [B]; differentiable."""
        check_images(images, self._shape)
        described = self._descriptor(images, wrap=True, thinned=True)
        total = images.new_zeros(len(images))
        for features, expected, scale in zip(described, self._quantiles, self._scales, strict=True):
            ordered = features.transpose(1, 2).contiguous().sort(dim=-1).values
            squares = (ordered - expected.to(ordered)).square()
            distance = world_mean(squares.flatten(1)[..., None])[:, 0]
            total = total + scale.to(distance) * distance
        return total


def _sliced(
    make: Callable[..., Descriptor], target: Tensor, options: LossOptions
) -> SlicedWasserstein:
    descriptor = make(target, seed=options.seed)
    return SlicedWasserstein(target, descriptor, tiles=options.tiles)


class PatchDescriptor:
    """Square patches of all channels, projected on random directions.

    The directions are an orthonormal basis of the space of patches.
    """

    def __init__(self, like: Tensor, *, seed: int) -> None:
        generator = torch.Generator().manual_seed(seed)
        size = like.shape[0] * PATCH * PATCH
        self.directions = [
            orthogonal(size, size, generator).to(like) for _ in range(level_count(like.shape[-1]))
        ]
        """Directions for each image size, columns of [K PATCH², K PATCH²]."""

    def __call__(self, images: Tensor, *, wrap: bool, thinned: bool) -> list[Tensor]:
        """Return the projections of patches, [B, M, K PATCH²] for each size."""
        sizes = pyramid(images, len(self.directions))
        return [
            products(patches(level, PATCH, stride=stride_of(level, thinned), wrap=wrap), direction)
            for level, direction in zip(sizes, self.directions, strict=True)
        ]


class FilterDescriptor:
    """Two layers of random filters with rectifiers between them.

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
        """Return the features of both layers, [B, M, 2 FILTERS] for each size and layer."""
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


# The paper's loss: relaxed optimal transport between features of VGG16, and their moments, after
# Kolkin, Salavon and Shakhnarovich, "Style Transfer by Relaxed Optimal Transport and Self-
# Similarity" (2019). Of VGG16 (Simonyan and Zisserman 2014) only the weights are needed, not
# torchvision: the layers are few. Average pooling replaces maximum pooling, and worlds are padded
# periodically.

VGG_LAYERS = (1, 6, 11, 18, 25)
"""Layers of VGG16 that are compared, in torchvision's counting."""

VGG_PLACES = 1024
"""Largest number of positions of a layer that are compared."""

VGG_SMALLEST = 32
"""Least side of images with more than one position in the deepest layer [pixels]."""


class VGGTransport(TextureDistance):
    """The distance of VGG16 features of images from a target's; satisfies `TextureLoss`.

    For each layer it is the relaxed earth mover's distance under the cosine distance of features,
    plus the mean absolute differences of their means and of their covariances; layers are summed. A
    layer with more than 1024 positions is compared at 1024 random ones, the same in all calls.
    """

    def __init__(self, target: Tensor, *, weights: str = "", tiles: bool, seed: int) -> None:
        channels, height, _ = target.shape
        if channels not in (1, 3):
            raise NPAError(f"vgg_ot compares images of 1 or 3 channels, got {channels}")
        if height < VGG_SMALLEST:
            raise NPAError(
                f"resolution must be at least {VGG_SMALLEST} pixels for vgg_ot, got {height}: "
                "for example 128"
            )
        super().__init__(target)
        self._features = VGGFeatures(load_vgg_weights(weights), VGG_LAYERS, target)
        generator = torch.Generator().manual_seed(seed)
        self._places: list[Tensor | None] = []
        self._expected = []
        with torch.no_grad():
            for field in self._features(target[None], wrap=tiles):
                count = field.shape[2] * field.shape[3]
                chosen = None
                if count > VGG_PLACES:
                    drawn = torch.randperm(count, generator=generator)[:VGG_PLACES]
                    chosen = drawn.sort().values.to(target.device)
                self._places.append(chosen)
                self._expected.append(_rows(field, chosen))

    def compare(self, images: Tensor) -> Tensor:
        """Return the distance of each of some checked images, [B]."""
        total = images.new_zeros(len(images))
        layers = zip(self._features(images, wrap=True), self._places, self._expected, strict=True)
        for field, places, expected in layers:
            found = _rows(field, places)
            total = total + relaxed_transport(found, expected) + moment_distance(found, expected)
        return total


def _rows(field: Tensor, places: Tensor | None) -> Tensor:
    rows = field.flatten(2)
    return (rows if places is None else rows.index_select(2, places)).transpose(1, 2)


WEIGHTS_FILE = "vgg16-397923af.pth"
"""Name of torchvision's file of weights trained on ImageNet."""

WEIGHTS_URL = f"https://download.pytorch.org/models/{WEIGHTS_FILE}"
"""Address of that file."""

VGG_WIDTHS = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))
"""Channels of the convolutions, with a pooling layer after each group."""

VGG_MEAN, VGG_DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Mean and standard deviation of ImageNet's red, green and blue."""


class VGGFeatures:
    """VGG16's features of images at some layers."""

    def __init__(self, weights: Mapping[str, Any], layers: Sequence[int], like: Tensor) -> None:
        self._layers = frozenset(layers)
        self._steps: list[tuple[Tensor, Tensor] | None] = []
        index, channels = 0, 3
        for group in VGG_WIDTHS:
            for width in group:
                weight = _checked(weights, f"features.{index}.weight", (width, channels, 3, 3))
                bias = _checked(weights, f"features.{index}.bias", (width,))
                self._steps.append((weight.to(like), bias.to(like)))
                index, channels = index + 2, width
            self._steps.append(None)
            index += 1
        self._mean = like.new_tensor(VGG_MEAN)[:, None, None]
        self._deviation = like.new_tensor(VGG_DEVIATION)[:, None, None]

    def __call__(self, images: Tensor, *, wrap: bool) -> list[Tensor]:
        """Return features [B, F, R', R'] of each layer; pads periodically (`wrap`) or mirrored."""
        mode = "circular" if wrap else "reflect"
        # In the weights' precision.
        field = (images.to(self._mean) - self._mean) / self._deviation
        found = []
        index, last = 0, max(self._layers)
        for step in self._steps:
            if step is None:
                field = F.avg_pool2d(field, 2)
                index += 1
            else:
                field = F.conv2d(F.pad(field, (1, 1, 1, 1), mode=mode), *step).relu()
                # A convolution and its rectifier, after which features are read.
                index += 2
            if index - 1 in self._layers:
                found.append(field)
            if index > last:
                break
        return found


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
        found = tuple(tensor.shape) if isinstance(tensor, Tensor) else "nothing"
        raise NPAError(
            f"VGG16's weights must hold {name} of shape {shape}, got {found}: "
            f"give torchvision's file, {WEIGHTS_URL}"
        )
    return tensor.detach()
