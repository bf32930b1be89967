"""Texture losses: distances between images by statistics of their parts, wherever these are."""

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
from npa_envs.ops.world_mean import scalar_world_mean

DEFAULT_LOSS = "patch_swd"
"""Name of the default loss, which needs no download."""


@dataclass(frozen=True)
class LossOptions:
    """Options of a texture loss."""

    tiles: bool = True
    """Whether the target's opposite edges fit together, so that patches may cross them."""
    seed: int = 0
    """Seed of the random directions and positions that the loss uses."""
    vgg_weights: str = ""
    """File of VGG16's weights, for `vgg_ot`; empty: torch's usual folder of downloads."""


DEFAULT_OPTIONS = LossOptions()
"""Options for a target whose opposite edges fit together, with seed 0."""

TextureLoss = Callable[[Tensor], Tensor]
"""A function from images [B, K, R, R] to distances from a target texture (dimensionless), [B].

It is differentiable. Calls use no random numbers and do not synchronise. The distance of an image
is the same, bit for bit, in every batch (by `vgg_ot`: without gradient)."""


@dataclass(frozen=True)
class LossEntry:
    """A row of the table `TEXTURE_LOSSES`."""

    summary: str
    """What the loss is, in one line."""
    make: Callable[[Tensor, LossOptions], TextureLoss]
    """Returns the loss for a target of shape [K, R, R] and options."""
    joint: bool = False
    """Whether it compares colours and density at once: K = 4; the target is `Texture.drawable`."""


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
    """Return whether a loss, or a sum of losses with "+", compares colours and density at once."""
    return TEXTURE_LOSSES[name.split("+")[0]].joint


def make_texture_loss(
    name: str, target: Tensor, options: LossOptions = DEFAULT_OPTIONS
) -> TextureLoss:
    """Return the loss `name` of `TEXTURE_LOSSES` for a target [K, R, R].

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


# What the losses share: images at several sizes, their patches, quantiles.

MAX_LEVELS = 4
"""Maximum number of image sizes that are compared, each half of the one before."""

MIN_IMAGE_SIDE = 12
"""Minimum side of the smallest of these [pixels]."""

MAX_POSITIONS = 64
"""Maximum number of positions along each side that sliced distances compare if `thinned`."""

ALIGNMENT = 64
"""Addresses of matrices that are multiplied are multiples of this [bytes]."""


class TextureDistance:
    """Base class of texture losses: distances of images from a target of shape [K, R, R]."""

    same_in_every_batch: bool = False
    """Whether `compare` gives an image the same distance, bit for bit, in every batch."""

    def __init__(self, target: Tensor) -> None:
        if target.shape[-1] < MIN_IMAGE_SIDE:
            raise NPAError(
                f"resolution must be at least {MIN_IMAGE_SIDE} pixels, got {target.shape[-1]}: for "
                "example 64"
            )
        self._shape = tuple(target.shape)

    def __call__(self, images: Tensor) -> Tensor:
        """Return the distance of images [B, K, R, R] from the target (dimensionless), [B].

        It is differentiable. Without gradient it is the same, bit for bit, in every batch.
        """
        if images.ndim != 4 or tuple(images.shape[1:]) != self._shape:
            raise NPAError(
                f"images must have shape [B, K, R, R] with (K, R, R) = {self._shape} as the "
                f"target, got {tuple(images.shape)}: draw them at the target's resolution"
            )
        with_gradient = torch.is_grad_enabled() and images.requires_grad
        if len(images) == 1 or with_gradient or self.same_in_every_batch:
            return self.compare(images)
        return torch.cat([self.compare(image[None]) for image in images])

    def compare(self, images: Tensor) -> Tensor:
        """Return the distance of images [B, K, R, R] from the target, [B]."""
        raise NotImplementedError


def level_count(resolution: int) -> int:
    """Return the number of sizes at which images of a resolution [pixels] are compared."""
    count = 1
    while count < MAX_LEVELS and resolution % 2 == 0 and resolution // 2 >= MIN_IMAGE_SIDE:
        resolution //= 2
        count += 1
    return count


def pyramid(images: Tensor, count: int) -> list[Tensor]:
    """Return images [B, K, R, R] at `count` sizes; each averages 2 x 2 pixels of the one before."""
    levels = [images]
    while len(levels) < count:
        fine = levels[-1]
        # Written out: the order of additions is fixed, whatever the size of the batch.
        rows = fine[:, :, ::2] + fine[:, :, 1::2]
        levels.append(0.25 * (rows[..., ::2] + rows[..., 1::2]))
    return levels


def patches(images: Tensor, size: int, *, stride: int, wrap: bool) -> Tensor:
    """Return square patches of images [B, K, R, R], one every `stride` pixels, [B, M, K size²].

    With `wrap` some lie across opposite edges.
    """
    if wrap:
        half = size // 2
        images = torch.cat((images[:, :, -half:], images, images[:, :, :half]), dim=2)
        images = torch.cat((images[..., -half:], images, images[..., :half]), dim=3)
    windows = images.unfold(2, size, stride).unfold(3, size, stride)
    return windows.permute(0, 2, 3, 1, 4, 5).flatten(3).flatten(1, 2)


def products(rows: Tensor, weights: Tensor) -> Tensor:
    """Return the matrix products of rows [B, M, E], contiguous, and weights [E, F], [B, M, F].

    They are computed image by image from aligned memory, or rounding may depend on the batch.
    """
    weights = weights.to(rows)
    tables = [one if one.data_ptr() % ALIGNMENT == 0 else one.clone() for one in rows]
    return torch.stack([table @ weights for table in tables])


def in_order(values: Tensor) -> Tensor:
    """Return values [..., M] rising along M."""
    if values.is_cuda or values.requires_grad:
        return values.contiguous().sort(dim=-1).values
    # NumPy finds no indices, which only gradients need: many times faster.
    ordered = values.clone(memory_format=torch.contiguous_format)
    ordered.numpy().sort(axis=-1)
    return ordered


def quantiles(values: Tensor, count: int) -> Tensor:
    """Return evenly spaced quantiles of each row of values [F, M], rising, shape [F, count]."""
    ordered = in_order(values)
    total = ordered.shape[1]
    if total == count:
        return ordered
    position = (torch.arange(count, dtype=values.dtype, device=values.device) + 0.5) / count
    position = (position * total - 0.5).clamp(0.0, total - 1.0)
    low = position.floor().long()
    part = position - low
    return ordered[:, low] * (1.0 - part) + ordered[:, (low + 1).clamp(max=total - 1)] * part


# Sliced Wasserstein distances. A texture is described, at each image size, by its patches in a
# random basis. Distributions of a coordinate over the positions are compared by sorting its values.

PATCH_SIDE = 5
"""Side of a patch of sliced distances [pixels]."""

VARIANCE_FLOOR = 0.01
"""Added to the target's variance before division by it, so that a uniform target works too."""


class SlicedWasserstein(TextureDistance):
    """The sliced Wasserstein distance of patches of all channels from those of a target.

    At each image size it is the mean over a random orthonormal basis of the squared 1D
    2-Wasserstein distance between the patches' coordinates, divided by the target's variance; sizes
    are summed.
    """

    same_in_every_batch = True

    def __init__(self, target: Tensor, options: LossOptions = DEFAULT_OPTIONS) -> None:
        super().__init__(target)
        generator = torch.Generator().manual_seed(options.seed)
        size = target.shape[0] * PATCH_SIDE * PATCH_SIDE
        self.bases: list[Tensor] = []
        """Basis of each image size: columns of [K PATCH_SIDE², K PATCH_SIDE²]."""
        for _ in range(level_count(target.shape[-1])):
            normal = torch.randn(size, size, generator=generator, dtype=torch.float64)
            self.bases.append(torch.linalg.qr(normal).Q.to(target))
        with torch.no_grad():
            # The target has as many quantiles as worlds have positions.
            thinned = self.coordinates(target[None], wrap=True, thinned=True)
            every = self.coordinates(target[None].double(), wrap=options.tiles, thinned=False)
            self._quantiles = [
                quantiles(rows[0].T, compared.shape[1]).to(target)
                for rows, compared in zip(every, thinned, strict=True)
            ]
            self._scales = [1.0 / (rows[0].var(0).mean() + VARIANCE_FLOOR) for rows in every]

    def coordinates(self, images: Tensor, *, wrap: bool, thinned: bool) -> list[Tensor]:
        """Return M patches of images [B, K, R, R] by size, in its basis: [B, M, K PATCH_SIDE²].

        With `wrap` opposite edges are connected, else positions near them are left out. With
        `thinned` there are at most `MAX_POSITIONS` along each side.
        """
        result = []
        for level, basis in zip(pyramid(images, len(self.bases)), self.bases, strict=True):
            stride = max(1, level.shape[-1] // MAX_POSITIONS) if thinned else 1
            result.append(products(patches(level, PATCH_SIDE, stride=stride, wrap=wrap), basis))
        return result

    def compare(self, images: Tensor) -> Tensor:
        """Return the distance of images [B, K, R, R] from the target, [B]."""
        levels = self.coordinates(images, wrap=True, thinned=True)
        total = images.new_zeros(len(images))
        for rows, expected, scale in zip(levels, self._quantiles, self._scales, strict=True):
            ordered = in_order(rows.transpose(1, 2))
            squares = (ordered - expected.to(ordered)).square()
            distance = scalar_world_mean(squares)
            total = total + scale.to(distance) * distance
        return total


# Optimal transport of raw patches.

MATCHED_PATCH = 7
"""Side of a patch of `PatchTransport` [pixels]; at the smallest of four sizes it spans 56."""

WORLD_POSITIONS = 32
"""Maximum number of patches of a world along each side, for each size."""

TARGET_POSITIONS = 64
"""Maximum number of patches of the target along each side, for each size."""


class PatchTransport(TextureDistance):
    """Relaxed optimal transport of raw patches at several sizes.

    At each size every patch of a world is compared with the nearest patch of the target, and every
    patch of the target with the nearest of the world. The larger of both mean squared distances,
    divided by the target's variance, is averaged over the sizes: it penalises both additional and
    missing parts. After the relaxed transport of Kolkin, Salavon and Shakhnarovich (2019), with
    patches in place of a network's features.
    """

    def __init__(self, target: Tensor, options: LossOptions) -> None:
        super().__init__(target)
        self._expected = []
        self._scales = []
        for level in pyramid(target[None], level_count(target.shape[-1])):
            stride = -(-level.shape[-1] // TARGET_POSITIONS)
            rows = patches(level, MATCHED_PATCH, stride=stride, wrap=options.tiles)[0].contiguous()
            spread = (rows.double() - rows.double().mean(0)).square().mean()
            self._expected.append(rows)
            self._scales.append(1.0 / (spread + VARIANCE_FLOOR))

    def compare(self, images: Tensor) -> Tensor:
        """Return the distance of images [B, K, R, R] from the target, [B]."""
        total = images.new_zeros(len(images))
        levels = pyramid(images, len(self._expected))
        for level, expected, scale in zip(levels, self._expected, self._scales, strict=True):
            stride = -(-level.shape[-1] // WORLD_POSITIONS)
            rows = patches(level, MATCHED_PATCH, stride=stride, wrap=True)
            total = total + scale.to(total) * _matched(rows, expected.to(rows))
        return total / len(self._expected)


def _matched(rows: Tensor, expected: Tensor) -> Tensor:
    """Return the mean squared distance to the nearest patch, the larger of both directions, [B].

    `rows` [B, M, E] are the worlds' patches, `expected` [M', E] the target's.
    """
    with torch.no_grad():
        squares = rows.square().sum(2)[:, :, None] + expected.square().sum(1)
        costs = squares - 2.0 * (rows @ expected.T)
        there, back = costs.argmin(2), costs.argmin(1)
        # The target patches to which each patch of a world is nearest: their number and sum.
        index = torch.arange(rows.shape[1], device=rows.device)[:, None]
        chosen = (back[:, None] == index).to(rows)
        times, sums = chosen.sum(2, keepdim=True), chosen @ expected
        mean_square = expected.square().mean()
    forward = (rows - expected[there]).square()
    # Σ (p − t)² over the target's patches, gathered by the world's: its gradient has a fixed order.
    ratio = rows.shape[1] / expected.shape[0]
    backward = ratio * (times * rows.square() - 2.0 * rows * sums)
    return torch.maximum(scalar_world_mean(forward), scalar_world_mean(backward) + mean_square)


# The paper's loss. Of VGG16 (Simonyan and Zisserman 2014) only the weights are needed, not
# torchvision: the layers are few. Average pooling replaces maximum pooling, and worlds are padded
# periodically.

VGG_POSITIONS = 1024
"""Maximum number of positions of a layer of VGG16 that are compared."""

VGG_MIN_SIDE = 32
"""Minimum side of images for VGG16 [pixels]: the deepest layer has four positions there."""

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
                weight = _weight(file, f"features.{number}.weight", (width, channels, 3, 3))
                bias = _weight(file, f"features.{number}.bias", (width,))
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
        """Return the features [B, M, F] of images in each of the five layers.

        With `wrap` images are padded periodically, else by their mirror images.
        """
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
    """Return the relaxed earth mover's distance of feature vectors [B, M, F] and [B, M', F], [B].

    Every vector moves to that of the other set with the least cosine distance, its cost. Returned
    is the mean cost of the dearer direction. Both are lower bounds of the earth mover's distance.
    """
    costs = 1.0 - _directions(first) @ _directions(second).transpose(1, 2)
    there, back = costs.amin(dim=2).mean(dim=1), costs.amin(dim=1).mean(dim=1)
    return torch.maximum(there, back)


def moment_distance(first: Tensor, second: Tensor) -> Tensor:
    """Return mean |difference| of two sets' means plus that of their covariances, shape [B].

    The sets are feature vectors [B, M, F] and [B, M', F].
    """
    (mean, covariance), (other_mean, other_covariance) = _moments(first), _moments(second)
    difference = (mean - other_mean).abs().mean(dim=(1, 2))
    return difference + (covariance - other_covariance).abs().mean(dim=(1, 2))


def _directions(rows: Tensor) -> Tensor:
    """Return vectors of length 1, in the last dimension."""
    return rows * (rows.square().sum(dim=-1, keepdim=True) + TINY_SQUARE).rsqrt()


def _moments(rows: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mean [B, 1, F] and the covariance [B, F, F] of vectors [B, M, F]."""
    mean = rows.mean(dim=1, keepdim=True)
    centred = rows - mean
    return mean, centred.transpose(1, 2) @ centred / (rows.shape[1] - 1)


def load_vgg_weights(path: str | Path = "") -> dict[str, Any]:
    """Return the weights of VGG16 by name, from a file or from torch's folder of downloads ("")."""
    folder = Path(torch.hub.get_dir()) / "checkpoints"
    file = home_path(path) if str(path) else folder / WEIGHTS_FILE
    if not os.path.exists(file):
        raise NPAError(
            f"vgg_ot needs VGG16's weights, and there is no file {shown(str(file))}: download "
            f"{WEIGHTS_URL} (528 MiB) to {shown(str(folder / WEIGHTS_FILE))}, for example with "
            f"python -c \"import torch; torch.hub.load_state_dict_from_url('{WEIGHTS_URL}')\", or "
            "give the path of such a file as vgg_weights, or choose loss='patch_swd', which "
            "needs no weights"
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


def _weight(weights: Mapping[str, Any], name: str, shape: tuple[int, ...]) -> Tensor:
    """Return the tensor `name`; raise NPAError unless it is there and has this shape."""
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
        "the paper's: optimal transport of VGG16 features; needs weights", VGGTransport
    ),
    "patch_swd": LossEntry(
        "sliced Wasserstein distance of raw patches at several sizes", SlicedWasserstein
    ),
    "joint_swd": LossEntry(
        "`patch_swd` of colours and density at once", SlicedWasserstein, joint=True
    ),
    "patch_ot": LossEntry(
        "relaxed optimal transport of raw patches at several sizes", PatchTransport, joint=True
    ),
}
"""All texture losses by name."""
