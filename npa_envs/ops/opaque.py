"""Opaque torch operators: kernels that `torch.compile` calls and does not look into.

Their derivatives are kernels as well, of which there are no derivatives.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, Generic, ParamSpec, TypeVar

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import is_in_torch_dispatch_mode

from npa_envs.errors import NPAError

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


class Opaque(Generic[Arguments, Result]):
    """A function as a torch operator; run as it is where nobody wants to see an operator.

    A call of an operator takes the host as long as several launches do.

    Args:
        name: The operator's name, "npa::...".
        function: What it does; results share no memory with each other or with arguments.
    """

    def __init__(self, name: str, function: Callable[Arguments, Result]) -> None:
        self._function = function
        self._operator = torch.library.custom_op(name, function, mutates_args=())
        self.register_fake = self._operator.register_fake

    def __call__(self, *args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        """Run the function on plain tensors, and the operator on all others."""
        # Asked in this order: a compiler cannot trace the other questions.
        if torch.compiler.is_compiling() or not _is_plain(args[0]) or is_in_torch_dispatch_mode():
            result: Result = self._operator(*args, **kwargs)
            return result
        return self._function(*args, **kwargs)


def _is_plain(value: Any) -> bool:
    return type(value) is Tensor or type(value) is nn.Parameter


def opaque(name: str) -> Callable[[Callable[Arguments, Result]], Opaque[Arguments, Result]]:
    """Return a decorator that makes a function an opaque operator; its first argument is a tensor.

    Args:
        name: The operator's name, "npa::...".
    """
    return lambda function: Opaque(name, function)


def without_autocast(
    backward: Callable[Arguments, Result],
) -> Callable[Arguments, Result]:
    """Return the backward pass of an autograd function, in its tensors' own dtypes.

    Forward passes are run without autocast; a backward pass may be asked for within it.

    Args:
        backward: The backward pass, of a context and cotangents.
    """

    @functools.wraps(backward)
    def guarded(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        for device in ("cuda", "cpu"):
            if torch.is_autocast_enabled(device):
                with torch.autocast(device, enabled=False):
                    return guarded(*args, **kwargs)
        return backward(*args, **kwargs)

    return guarded


def once_differentiable(
    backward: Callable[Arguments, Result],
) -> Callable[Arguments, Result]:
    """Return the backward pass of an autograd function, made to refuse second derivatives.

    Torch's own `once_differentiable` says nothing where the cotangent needs no gradient, as that of
    a sum: second derivatives are then zero. Functions that `torch.compile` has taken refuse them by
    themselves, but for its backend "eager", which is there to look for faults.

    Args:
        backward: The backward pass, of a context and cotangents.

    Raises:
        NPAError: When called with `create_graph=True`.
    """
    backward = without_autocast(backward)

    @functools.wraps(backward)
    def guarded(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        if torch.is_grad_enabled():
            raise NPAError(
                "create_graph must be False where particles are perceived, moved or drawn, got "
                "True: these have no second derivatives; leave it out, or take small worlds with "
                "the slow operators of npa_envs.reference, which have"
            )
        return backward(*args, **kwargs)

    return guarded
