"""What a rule with a network of its own depends on, as far as that can be read off its modules."""

from __future__ import annotations

import inspect
import weakref
from collections.abc import Hashable
from typing import Any

import torch
from torch import Tensor, nn

NUMBERS = (int, float, complex, bool, str, bytes, type(None), torch.dtype, torch.device)
"""Types of attributes that are compared by value."""

HOOKS = ("_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks")
"""Where modules keep their hooks, by numbers that are given once."""

OF_EVERY_MODULE = frozenset(vars(nn.Module()))
"""Attributes that torch gives every module, which are looked at by themselves."""


def rule_tensors(rule: nn.Module, device: torch.device) -> list[Tensor]:
    """Return a rule's parameters, buffers and plain attributes that lie on a device, each once."""
    found: dict[int, Tensor] = {}
    for module in rule.modules():
        for values in (module._parameters, module._buffers, vars(module)):
            for value in values.values():
                if isinstance(value, Tensor) and value.device == device:
                    found.setdefault(id(value), value)
    return list(found.values())


def rule_settings(rule: nn.Module, device: torch.device) -> dict[str, Hashable]:
    """Return what a rule's network depends on besides the numbers of its tensors on a device.

    That is: its modules, their hooks and modes, and their attributes: numbers and words by value,
    others by what they are, those within lists, tuples and dictionaries alike. What else Python
    code reads, such as global variables, is not seen.
    """
    settings: dict[str, Hashable] = {}
    for path, module in rule.named_modules():
        hooks = tuple(tuple(getattr(module, name)) for name in HOOKS)
        settings[path] = (type(module), module.training, hooks)
        for values in (module._parameters, module._buffers, vars(module)):
            for name, value in values.items():
                if name not in OF_EVERY_MODULE:
                    settings[f"{path}.{name}"] = _setting(value, device)
    return settings


def _setting(value: Any, device: torch.device) -> Hashable:
    if isinstance(value, NUMBERS):
        return type(value), value
    if isinstance(value, Tensor):
        form = (value.shape, value.dtype, value.device)
        # The numbers of those on the device are read anew in each call.
        return form if value.device == device else (form, id(value), value._version)
    if isinstance(value, list | tuple):
        return type(value), tuple(_held(entry, device) for entry in value)
    if isinstance(value, dict):
        return tuple((_held(key, device), _held(entry, device)) for key, entry in value.items())
    if inspect.ismethod(value):
        return id(value.__self__), value.__func__
    try:
        reference = weakref.ref(value)
        hash(reference)
    except TypeError:
        return id(value)
    return reference


def _held(value: Any, device: torch.device) -> Hashable:
    """Return the setting of what a list or a dictionary holds, whose tensors are not read anew."""
    setting = _setting(value, device)
    return (setting, id(value), value._version) if isinstance(value, Tensor) else setting
