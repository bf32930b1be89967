"""Parsing and checking of device names."""

from __future__ import annotations

import torch

from npa_envs.errors import NPAError, shown


def parse_device(name: str) -> torch.device:
    """Return the torch.device called `name`, such as "cuda:1"; it need not exist."""
    hint = "use 'cpu', 'cuda' or 'cuda:1'"
    if not isinstance(name, str):
        raise NPAError(f"device must be text, got {shown(name)}: {hint}")
    try:
        device = torch.device(name)
    except (RuntimeError, TypeError) as error:
        raise NPAError(f"device must name a device, got {shown(name)}: {hint}") from error
    rule = ""
    if device.type not in ("cpu", "cuda"):
        rule = "be 'cpu' or 'cuda'"
    elif device.type == "cpu" and name not in ("cpu", "cpu:0"):
        rule = "be 'cpu' without a number"
    elif str(device) != name:
        # Torch stores the number in eight bits: "cuda:256" would be the first device.
        rule = "have a number that torch can represent"
    if rule:
        raise NPAError(f"device must {rule}, got {shown(name)}: {hint}")
    return device


def check_device(name: str | torch.device) -> torch.device:
    """Return the torch.device called `name`, a CUDA one with its number; it must exist."""
    device = parse_device(str(name) if isinstance(name, torch.device) else name)
    if device.type != "cuda":
        return device
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    index = 0 if device.index is None else device.index
    if index >= count:
        raise NPAError(
            f"device must be one that torch sees, got {shown(str(name))}, but it sees {count} CUDA "
            "devices: use device='cpu', or see `npa-envs doctor`"
        )
    return torch.device("cuda", index)
