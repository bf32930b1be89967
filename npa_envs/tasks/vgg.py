"""The convolutional part of VGG16 (Simonyan and Zisserman 2014), as textures are compared by it.

Only its weights are needed, not torchvision: the layers are few. Average pooling takes the place of
maximum pooling, and worlds are padded with what lies on their other side.
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
