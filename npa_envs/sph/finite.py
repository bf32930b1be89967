"""Whether all numbers of a tensor are finite, in one pass that nothing waits for."""

from __future__ import annotations

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.kernels.finite import VALUES_PER_THREAD, finite_kernels
from npa_envs.sph.bridge import launch, scalar_type
from npa_envs.sph.cells import LARGEST_INDEX
from npa_envs.sph.checks import DTYPES


def mark_finite(values: Tensor, finite: Tensor) -> None:
    """Set a flag to 1 where all values are finite and to 0 otherwise.

    Args:
        values: Any shape, contiguous, float32 or float64.
        finite: The flag, uint8, shape [1], on the same device; changed.

    Raises:
        NPAError: A shape, dtype or device does not fit, or there are too many values.
    """
    if values.dtype not in DTYPES or not values.is_contiguous() or values.numel() >= LARGEST_INDEX:
        raise NPAError(
            f"values must be contiguous, float32 or float64 and fewer than {LARGEST_INDEX}, got "
            f"{values.dtype} of shape {tuple(values.shape)} and strides {values.stride()}"
        )
    fits = finite.dtype == torch.uint8 and tuple(finite.shape) == (1,)
    if not fits or finite.device != values.device:
        raise NPAError(
            f"finite must be torch.uint8 of shape (1,) on {values.device}, got {finite.dtype} of "
            f"shape {tuple(finite.shape)} on {finite.device}"
        )
    finite.fill_(1)
    thread_count = -(-values.numel() // VALUES_PER_THREAD)
    if thread_count:
        launch(
            finite_kernels(scalar_type(values.dtype)).find_not_finite,
            thread_count,
            values.device,
            thread_count,
            int(values.data_ptr() % 16 == 0),
            values.detach().view(-1),
            finite,
        )
