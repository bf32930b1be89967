"""MS-SSIM: how alike the structure of pictures is at several sizes (Wang et al. 2003)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from npa_envs.errors import MissingDependencyError, NPAError

WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
"""Powers of the sizes, from fine to coarse (Wang et al. 2003)."""

WINDOW = 11
"""Pixels along each side of the window, at most."""

SPREAD = 1.5
"""Standard deviation of a window of 11 pixels [pixels]; smaller ones keep the proportion."""

FLOOR = 1e-4
"""Least similarity of a size: below it, where the power is steep, nothing is learned from it."""


def _halved(pictures: Tensor) -> Tensor:
    """Return pictures of half the size, an odd side rounded up, means of 2 x 2 pixels.

    Zeros are put before the first row or column of an odd side; with the padding of `avg_pool2d`
    itself gradients are wrong on CUDA where channels lie innermost (torch 2.11).
    """
    odd_rows, odd_columns = (side % 2 for side in pictures.shape[2:])
    return avg_pool2d(pad(pictures, (odd_columns, 0, odd_rows, 0)), kernel_size=2)


class MultiScaleSimilarity:
    """MS-SSIM of pictures in [0, 1]; windows and sums are pytorch-msssim's.

    The library's own MS-SSIM multiplies the sizes by `torch.prod`, whose derivative waits for the
    device and so cannot be captured, and its derivative is not finite where a size's similarity
    is 0; here their logarithms are added.

    Args:
        resolution: Pixels along each side of the pictures, at least 16.
        channels: Channels of the pictures.
        device: Where they are.

    Raises:
        MissingDependencyError: pytorch-msssim is not installed.
        NPAError: The pictures are too small.
    """

    def __init__(
        self, resolution: int, channels: int, *, device: str | torch.device = "cpu"
    ) -> None:
        try:
            from pytorch_msssim.ssim import _ssim
        except ImportError as error:
            raise MissingDependencyError(
                "comparing views by MS-SSIM needs pytorch-msssim, which is not installed: "
                "pip install 'npa-envs[views]', or set ssim_weight to 0"
            ) from error
        self._compare: Any = _ssim
        if resolution < 2 ** len(WEIGHTS[1:]):
            raise NPAError(
                f"resolution must be at least {2 ** len(WEIGHTS[1:])} pixels for MS-SSIM, got "
                f"{resolution}: raise it, or set ssim_weight to 0"
            )
        self._windows = []
        size = resolution
        for _ in WEIGHTS:
            width = min(WINDOW, size - 1 + size % 2)
            place = torch.arange(width, dtype=torch.float64, device=device) - width // 2
            window = torch.exp(-0.5 * (place * (WINDOW / (SPREAD * width))) ** 2)
            window /= window.sum()
            self._windows.append(window.float().expand(channels, 1, 1, width).contiguous())
            size = (size + 1) // 2

    def __call__(self, found: Tensor, wanted: Tensor) -> Tensor:
        """Return the similarity of each picture, at most 1, the mean of its channels, shape [B].

        Args:
            found: Pictures, shape [B, K, R, R].
            wanted: What they are to be, likewise.
        """
        total = found.new_zeros(found.shape[:2])
        last = len(WEIGHTS) - 1
        for size, (weight, window) in enumerate(zip(WEIGHTS, self._windows, strict=True)):
            whole, contrast = self._compare(
                found, wanted, data_range=1.0, win=window.to(found.dtype), size_average=False
            )
            share = whole if size == last else contrast
            total = total + weight * share.clamp_min(FLOOR).log()
            if size < last:
                found, wanted = _halved(found), _halved(wanted)
        return total.exp().mean(dim=1)
