"""The device that a name stands for, from `npa_envs.devices`."""

from __future__ import annotations

from npa_envs.devices import check_device

__all__ = ["check_device"]
