"""Opaque torch operators: kernels that `torch.compile` calls and does not look into.

Their derivatives are kernels as well, of which there are no derivatives: gradients are computed
backwards, one at a time. Whatever else torch can derive is refused.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterator
from types import NoneType
from typing import Any, Generic, ParamSpec, TypeVar

import torch
from torch import Tensor, nn
from torch.autograd import forward_ad
from torch.utils._python_dispatch import is_in_torch_dispatch_mode

from npa_envs.errors import NPAError
from npa_envs.ops.physics import Physics

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


_transforms_active = torch._C._are_functorch_transforms_active

PLAIN_TYPES = {Tensor, nn.Parameter, Physics, torch.dtype, bool, int, float, str, list, NoneType}
"""Types of arguments that kernels read as they are; other tensors may wrap some."""

CURE = "or take small worlds with the slow operators of npa_envs.reference, which are plain torch"


def check_derivatives(**given: Any) -> None:
    """Check that torch derives nothing but backward passes from what kernels compute.

    Forward-mode derivatives would vanish without a word where nothing requires a gradient.

    Raises:
        NPAError: A tensor carries a tangent of forward-mode derivatives, or a function of
            `torch.func` makes the call.
    """
    # Asked in this order: a compiler cannot trace the other question.
    if not torch.compiler.is_compiling() and _transforms_active():
        raise NPAError(
            f"{', '.join(given)} must not be given within a function of torch.func (grad, vjp, "
            "jvp, jacrev, jacfwd, vmap, ...), which cannot look into kernels, got a call within "
            "one: take torch.autograd.grad for derivatives and a batch of worlds [B, N, D] for "
            f"vmap, {CURE}"
        )
    if forward_ad._current_level >= 0:
        _check_tangents(given)


def _check_tangents(given: dict[str, Any]) -> None:
    """Check within a `dual_level` that no tensor carries a tangent."""
    if torch.compiler.is_compiling():
        # Only calls that a compiler does not trace show tangents.
        torch.compiler.disable(_check_tangents)(given)  # type: ignore[no-untyped-call]
        return
    for name, value in given.items():
        for tensor in _tensors(value):
            _, tangent = forward_ad.unpack_dual(tensor)  # type: ignore[no-untyped-call]
            if tangent is not None:
                raise NPAError(
                    f"{name} must carry no tangent of forward-mode derivatives "
                    "(torch.autograd.forward_ad, strategy='forward-mode'), got one: kernels have "
                    "backward passes alone; take backward(), torch.autograd.grad or "
                    f"strategy='reverse-mode', {CURE}"
                )


def _tensors(value: Any) -> Iterator[Tensor]:
    """Yield the tensors that something is or holds; a module's weights may be plain attributes."""
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, nn.Module):
        for module in value.modules():
            yield from _tensors([*vars(module).values()])
            yield from module.parameters(recurse=False)
            yield from module.buffers(recurse=False)
    elif isinstance(value, list | tuple):
        for entry in value:
            if isinstance(entry, Tensor | list | tuple):
                yield from _tensors(entry)


class CustomOp(Generic[Arguments, Result]):
    """A function as a torch operator; run as it is where nobody wants to see an operator.

    A call of an operator takes the host as long as several launches do. Results share no memory
    with each other or with arguments, which are given by place. The operator takes a `Physics` as
    a list of its numbers.
    """

    def __init__(self, name: str, function: Callable[Arguments, Result]) -> None:
        self._function = function
        self._signature = inspect.signature(function, eval_str=True)
        self._operator = torch.library.custom_op(name, self._of_numbers(function), mutates_args=())

    def register_fake(self, fake: Callable[..., Any]) -> Callable[..., Any]:
        """Say what the operator returns of tensors without numbers, by a function like itself."""
        self._operator.register_fake(self._of_numbers(fake))
        return fake

    def _of_numbers(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function of what the operator takes."""
        parameters = self._signature.parameters.values()
        packed = [parameter.annotation is Physics for parameter in parameters]

        def unpacked(*args: Any) -> Any:
            pairs = zip(args, packed, strict=True)
            return function(*[Physics.of(value) if flag else value for value, flag in pairs])

        taken = [
            parameter.replace(annotation=list[float]) if flag else parameter
            for parameter, flag in zip(parameters, packed, strict=True)
        ]
        unpacked.__signature__ = self._signature.replace(parameters=taken)  # type: ignore[attr-defined]
        return unpacked

    def __call__(self, *args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        """Run the function on plain tensors, and the operator on all others."""
        assert not kwargs, "given by place"
        if forward_ad._current_level >= 0:
            _check_tangents(dict(zip(self._signature.parameters, args, strict=False)))
        # Asked in this order: a compiler cannot trace the other questions.
        if (
            torch.compiler.is_compiling()
            or not PLAIN_TYPES.issuperset(map(type, args))
            or is_in_torch_dispatch_mode()
        ):
            flat = [value.numbers() if isinstance(value, Physics) else value for value in args]
            result: Result = self._operator(*flat)
            return result
        return self._function(*args, **kwargs)


def custom_op(name: str) -> Callable[[Callable[Arguments, Result]], CustomOp[Arguments, Result]]:
    """Return a decorator that makes a function of tensors the opaque operator "npa::..."."""
    return lambda function: CustomOp(name, function)


def without_autocast(backward: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Return the backward pass of an autograd function, in its tensors' own dtypes.

    Forward passes are run without autocast; a backward pass may be asked for within it.
    """

    @functools.wraps(backward)
    def guarded(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        for device in ("cuda", "cpu"):
            if torch.is_autocast_enabled(device):
                with torch.autocast(device, enabled=False):
                    return guarded(*args, **kwargs)
        return backward(*args, **kwargs)

    return guarded


def once_differentiable(backward: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Return the backward pass of an autograd function, made to refuse what it cannot derive.

    Torch's own `once_differentiable` says nothing where the cotangent needs no gradient, as that of
    a sum: second derivatives are then zero. Functions that `torch.compile` has taken refuse them by
    themselves, but for its backend "eager", which is there to look for faults.

    Raises:
        NPAError: When called with `create_graph=True`, or with several cotangents at once.
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
        try:
            return backward(*args, **kwargs)
        except RuntimeError as error:
            # A batch of cotangents has no memory that a kernel could read.
            if any(map(torch._C._functorch.is_legacy_batchedtensor, _tensors(args))):
                raise NPAError(
                    "is_grads_batched must be False where particles are perceived, moved or drawn, "
                    "and vectorize too, got several cotangents at once: run one backward pass for "
                    f"each, {CURE}"
                ) from error
            raise

    return guarded
