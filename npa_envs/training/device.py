"""The device that a name stands for."""

from __future__ import annotations

import torch

from npa_envs.errors import NPAError


def check_device(name: str) -> torch.device:
    """Return the device of that name, with its number where it is a CUDA device.

    Args:
        name: "cpu", "cuda" or "cuda:1".

    Raises:
        NPAError: This machine has no such device.
    """
    device = torch.device(name)
    if device.type != "cuda":
        return device
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    index = 0 if device.index is None else device.index
    if index >= count:
        raise NPAError(
            f"device must be one that torch sees, got {name!r}, but it sees {count} CUDA devices: "
            "use device='cpu', or see `npa-envs doctor`"
        )
    return torch.device("cuda", index)
