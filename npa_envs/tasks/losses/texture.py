"""Losses of textures by name: how unlike two of them are, whatever lies where."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from npa_envs.errors import NPAError, suggest
from npa_envs.tasks.losses.optimal_transport import VGGTransport
from npa_envs.tasks.losses.sliced import FilterDescriptor, PatchDescriptor, SlicedWasserstein

DEFAULT_LOSS = "patch_swd"
"""The loss that needs nothing but what is here."""


class TextureLoss(Protocol):
    """A texture that others are compared with.

    Nothing random is left once it is made, and no call waits for the device. A world's loss is the
    same, bit for bit, in every batch (for `vgg_ot`: where no gradient is asked for).
    """

    def __call__(self, images: Tensor) -> Tensor:
        """Return how unlike the target each image is (dimensionless), shape [B]; differentiable.

        Args:
            images: Pictures that tile without a seam (dimensionless), shape [B, K, R, R] with the
                target's K channels.
        """


@dataclass(frozen=True)
class LossOptions:
    """What a loss is told besides its target."""

    tiles: bool = True
    """Whether the target's opposite edges fit together; where not, nothing is read across them."""

    seed: int = 0
    """What directions, filters and positions are drawn from, once."""

    vgg_weights: str = ""
    """File of VGG16's weights, for `vgg_ot`; empty: torch's usual folder of downloads."""


DEFAULT_OPTIONS = LossOptions()
"""A target that tiles, drawn from seed 0."""


@dataclass(frozen=True)
class LossEntry:
    """A loss that textures can be trained with."""

    summary: str
    """One line for lists."""

    make: Callable[[Tensor, LossOptions], TextureLoss]
    """Prepares a target, shape [K, R, R]."""


TEXTURE_LOSSES: Mapping[str, LossEntry] = {
    "vgg_ot": LossEntry(
        "the paper's: optimal transport of VGG16 features; needs weights",
        lambda target, options: VGGTransport(
            target, weights=options.vgg_weights, tiles=options.tiles, seed=options.seed
        ),
    ),
    "patch_swd": LossEntry(
        "sliced Wasserstein distance of raw patches at several sizes",
        lambda target, options: SlicedWasserstein(
            target, PatchDescriptor(target, seed=options.seed), tiles=options.tiles
        ),
    ),
    "filter_swd": LossEntry(
        "sliced Wasserstein distance of two layers of random filters",
        lambda target, options: SlicedWasserstein(
            target, FilterDescriptor(target, seed=options.seed), tiles=options.tiles
        ),
    ),
}
"""Every texture loss by name."""


def check_loss_name(name: str) -> None:
    """Check that there is a loss of a name.

    Raises:
        NPAError: There is none.
    """
    if name not in TEXTURE_LOSSES:
        hint = suggest(str(name), TEXTURE_LOSSES)
        raise NPAError(f"loss must be a texture loss that exists, got {name!r}: {hint}")


def make_texture_loss(
    name: str, target: Tensor, options: LossOptions = DEFAULT_OPTIONS
) -> TextureLoss:
    """Prepare a texture to be compared with.

    Args:
        name: One of `TEXTURE_LOSSES`.
        target: The texture (dimensionless), shape [K, R, R]; K is 3 for colours, 1 for a density.
        options: What else the loss is told.

    Raises:
        NPAError: There is no such loss, the target's shape does not fit, or weights that the loss
            needs are missing or damaged.
    """
    check_loss_name(name)
    if target.ndim != 3 or target.shape[1] != target.shape[2] or not target.is_floating_point():
        raise NPAError(
            f"target must be a floating tensor of shape [K, R, R], got {target.dtype} "
            f"{tuple(target.shape)}: channels come first"
        )
    return TEXTURE_LOSSES[name].make(target.detach(), options)
