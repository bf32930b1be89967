"""The settings and tensors of a rule that a captured rollout depends on.

A custom network's settings are its modules' attributes, hooks and modes. A capture is replayed only
as long as all settings are the same.
"""

from __future__ import annotations

import inspect
import operator
import weakref
from collections.abc import Callable, Hashable
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.modules.module import _has_any_global_hook

from npa_envs.rule.rule import HYPER_PARAMETERS, NPARule

NUMBERS = (int, float, complex, bool, str, bytes, type(None), torch.dtype, torch.device)
"""Types of attributes that are compared by value."""

HOOKS = ("_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks")
"""Names of the attributes of modules that map unique numbers to hooks."""

OF_EVERY_MODULE = frozenset(vars(nn.Module()))
"""Names of the attributes that torch gives every module, which are compared separately."""


def is_observed(rule: nn.Module) -> bool:
    """Return whether hooks or other Python code run with a rule besides its classes' `forward`."""
    return bool(_has_any_global_hook()) or any(  # type: ignore[no-untyped-call]
        "forward" in vars(module)
        or "_orig_mod" in module._modules
        or any(getattr(module, name) for name in HOOKS)
        for module in rule.modules()
    )


def rule_tensors(rule: nn.Module, device: torch.device) -> list[Tensor]:
    """Return all tensors of a rule on a device, once each: parameters, buffers and attributes."""
    tensors = {
        id(value): value
        for module in rule.modules()
        for values in (module._parameters, module._buffers, vars(module))
        for value in values.values()
        if isinstance(value, Tensor) and value.device == device
    }
    return list(tensors.values())


def rule_settings(rule: nn.Module, device: torch.device) -> dict[str, Hashable]:
    """Return all settings of a rule by name, except the values of its tensors on a device.

    These are its modules with their hooks and modes, and their attributes: numbers and strings by
    value, other objects by identity, also within lists, tuples and dictionaries. Other inputs of
    Python code, such as global variables, are not included.
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


def _setting(value: Any, device: torch.device, *, in_container: bool = False) -> Hashable:
    """Return a hashable key of the value of an attribute, or of an entry of a container."""
    if isinstance(value, NUMBERS):
        return type(value), value
    if isinstance(value, Tensor):
        form = (value.shape, value.dtype, value.device)
        # Values of attributes on the device are read again in each call.
        read_again = value.device == device and not in_container
        return form if read_again else (form, id(value), value._version)
    if isinstance(value, nn.Module):
        # It is not a part of the rule, so that its tensors are not read again.
        tensors = (*value.parameters(), *value.buffers())
        keys = (_setting(each, device, in_container=True) for each in tensors)
        return id(value), value.training, *keys
    if isinstance(value, list | tuple):
        return type(value), tuple(_setting(entry, device, in_container=True) for entry in value)
    if isinstance(value, dict):
        entries = (entry for item in value.items() for entry in item)
        return tuple(_setting(entry, device, in_container=True) for entry in entries)
    if inspect.ismethod(value):
        return id(value.__self__), value.__func__
    try:
        reference = weakref.ref(value)
        hash(reference)
    except TypeError:
        return id(value)
    return reference


rule_form: Callable[[NPARule], Hashable] = operator.attrgetter(
    *HYPER_PARAMETERS.keys() - {"readout_dim", "readout_hidden_dim", "code_names", "encoder"}
)
"""Returns all settings of a plain rule that its steps depend on, except weights."""


def settings_and_weights(rule: NPARule, plain: bool) -> tuple[Hashable, list[Tensor]]:
    """Return a rule's settings and its tensors; `plain`: it runs with the weights of `NPARule`."""
    if plain:
        weights = rule.network_weights()
        return (rule_form(rule), *map(tensor_form, weights)), weights
    device = rule.hidden.weight.device
    settings = tuple(rule_settings(rule, device).items())
    deterministic = torch.are_deterministic_algorithms_enabled()
    return (weakref.ref(rule), settings, deterministic), rule_tensors(rule, device)


def tensor_form(tensor: Tensor) -> Hashable:
    """Return shape, dtype and device of a tensor."""
    return tensor.shape, tensor.dtype, tensor.device
