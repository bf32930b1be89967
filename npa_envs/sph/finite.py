"""Copying numbers while noting whether all of them are finite; nothing waits for the answer."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from npa_envs.errors import NPAError
from npa_envs.kernels.finite import QUAD, finite_kernels
from npa_envs.sph.bridge import Repeated, scalar_type
from npa_envs.sph.cells import LARGEST_INDEX
from npa_envs.sph.checks import DTYPES


class CheckedCopy:
    """Copies values into one place, and notes whether all are finite; nothing waits.

    Args:
        into: Where to copy, contiguous, float32 or float64, not empty.
        finite: Set to 0 where a value is not finite and left as it is otherwise, uint8, shape [1],
            on the same device.

    Raises:
        NPAError: A shape, dtype or device does not fit, or there are too many values.
    """

    def __init__(self, into: Tensor, finite: Tensor) -> None:
        fits = into.dtype in DTYPES and into.is_contiguous()
        if not fits or not 0 < into.numel() < LARGEST_INDEX:
            raise NPAError(
                f"into must be contiguous, float32 or float64 and of 1 to {LARGEST_INDEX - 1} "
                f"numbers, got {into.dtype} of shape {tuple(into.shape)} and strides "
                f"{into.stride()}"
            )
        fits = finite.dtype == torch.uint8 and tuple(finite.shape) == (1,)
        if not fits or finite.device != into.device:
            raise NPAError(
                f"finite must be torch.uint8 of shape (1,) on {into.device}, got {finite.dtype} of "
                f"shape {tuple(finite.shape)} on {finite.device}"
            )
        self._into = into
        self._finite = finite
        self._repeated: Repeated | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the recorded launch, which cannot be pickled."""
        return self.__dict__ | {"_repeated": None}

    def __call__(self, values: Tensor) -> None:
        """Copy.

        Args:
            values: Of the shape of `into`, of any dtype, on any device.

        Raises:
            NPAError: They have another shape.
        """
        into = self._into
        if values.shape != into.shape:
            raise NPAError(f"values must have shape {tuple(into.shape)}, got {tuple(values.shape)}")
        fits = values.dtype == into.dtype and values.device == into.device
        if not fits or not values.is_contiguous() or values.data_ptr() % 16:
            into.copy_(values)
            values = into
        flat = values.detach().view(-1)
        if self._repeated is None:
            self._repeated = Repeated(
                finite_kernels(scalar_type(into.dtype)).copy_finding_not_finite,
                -(-into.numel() // QUAD),
                into.device,
                flat,
                into.view(-1),
                self._finite,
                changing=flat,
            )
        self._repeated(flat)
