"""Custom torch operators around kernels, which `torch.compile` calls without tracing them.

Backward passes are kernels as well and have no derivatives of their own. Second derivatives,
forward-mode derivatives and functions of `torch.func` are rejected with an error.
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
from npa_envs.ops.launch import repeated, tracing
from npa_envs.ops.physics import Physics

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

_transforms_active = torch._C._are_functorch_transforms_active

DIRECT_TYPES = {Tensor, nn.Parameter, Physics, torch.dtype, bool, int, float, str, list, NoneType}
"""Types of arguments that kernels can read; a tensor subclass may wrap other tensors."""

HINT = "or take small worlds with the slow operators of npa_envs.reference, which are plain torch"


def check_derivatives(**arguments: Any) -> None:
    """Raise NPAError within a function of `torch.func`, or if an argument has a tangent.

    A tangent is a derivative of forward mode. It would be lost silently where no tensor requires a
    gradient. Keywords are the names of the arguments.
    """
    # In this order: a compiler cannot trace the second condition.
    if not torch.compiler.is_compiling() and _transforms_active():
        raise NPAError(
            f"{', '.join(arguments)} must not be given within a function of torch.func (grad, vjp, "
            "jvp, jacrev, jacfwd, vmap, ...), which cannot look into kernels, got a call within "
            "one: take torch.autograd.grad for derivatives and a batch of worlds [B, N, D] for "
            f"vmap, {HINT}"
        )
    if forward_ad._current_level >= 0:
        _check_tangents(arguments)


def _check_tangents(arguments: dict[str, Any]) -> None:
    """Raise NPAError if a tensor in the arguments, by name, has a tangent of forward mode."""
    if torch.compiler.is_compiling():
        # Tangents are visible only to calls that a compiler does not trace.
        torch.compiler.disable(_check_tangents)(arguments)  # type: ignore[no-untyped-call]
        return
    for name, value in arguments.items():
        for tensor in _tensors(value):
            _, tangent = forward_ad.unpack_dual(tensor)  # type: ignore[no-untyped-call]
            if tangent is not None:
                raise NPAError(
                    f"{name} must carry no tangent of forward-mode derivatives "
                    "(torch.autograd.forward_ad, strategy='forward-mode'), got one: kernels have "
                    "only backward passes; take backward(), torch.autograd.grad or "
                    f"strategy='reverse-mode', {HINT}"
                )


def _tensors(value: Any) -> Iterator[Tensor]:
    """Yield the tensors in a tensor, list, tuple or module, also in a module's attributes."""
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
    """A function of tensors that is called directly, or as a torch operator where torch needs one.

    It needs one under torch.compile, in dispatch modes and for tensor subclasses. Elsewhere an
    operator's call would cost as much CPU time as several launches, and later calls repeat the
    launches of earlier ones (`npa_envs.ops.launch.repeated`). On a CPU only operators `of_all`
    particles do so: numbers of active ones change in each step. Arguments are positional.
    Results share no memory with each other or with arguments. The operator takes a `Physics` as the
    list `Physics.numbers`. With torch's fake tensors, which have no memory, nothing is launched.
    """

    def __init__(self, name: str, function: Callable[Arguments, Result], of_all: bool) -> None:
        self._function, self._of_all = function, of_all
        self._signature = inspect.signature(function, eval_str=True)
        self._operator = torch.library.custom_op(
            name, self._taking_lists(function), mutates_args=()
        )
        self._operator.register_fake(self._taking_lists(tracing()(function)))

    def _taking_lists(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return the function with a list of numbers as argument in place of each `Physics`."""
        parameters = self._signature.parameters.values()
        packed = [parameter.annotation is Physics for parameter in parameters]

        def unpacked(*args: Any) -> Any:
            pairs = zip(args, packed, strict=True)
            return function(*[Physics.from_list(value) if flag else value for value, flag in pairs])

        taken = [
            parameter.replace(annotation=list[float]) if flag else parameter
            for parameter, flag in zip(parameters, packed, strict=True)
        ]
        unpacked.__signature__ = self._signature.replace(parameters=taken)  # type: ignore[attr-defined]
        return unpacked

    def __call__(self, *args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        """Call the function, or the torch operator in the cases that the class names."""
        assert not kwargs, "arguments are positional"
        if forward_ad._current_level >= 0:
            _check_tangents(dict(zip(self._signature.parameters, args, strict=False)))
        # In this order: a compiler cannot trace the other conditions.
        if (
            torch.compiler.is_compiling()
            or not DIRECT_TYPES.issuperset(map(type, args))
            or is_in_torch_dispatch_mode()
        ):
            flat = [value.numbers() if isinstance(value, Physics) else value for value in args]
            result: Result = self._operator(*flat)
            return result
        if not (self._of_all or getattr(args[0], "is_cuda", False)):
            return self._function(*args, **kwargs)
        made: Result = repeated(self._function, args)
        return made


def custom_op(
    name: str, *, of_all: bool = False
) -> Callable[[Callable[Arguments, Result]], CustomOp[Arguments, Result]]:
    """Return a decorator that makes a function of tensors the operator `name`, "npa::..."."""
    return lambda function: CustomOp(name, function, of_all)


def without_autocast(backward: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Return the backward pass of an autograd function, made to run without autocast.

    Forward passes run without autocast, but `backward()` may be called within it.
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
    """Return a backward pass that rejects second derivatives and several cotangents at once.

    Torch's own `once_differentiable` raises no error where the incoming gradient requires none, as
    that of a sum: second derivatives are then silently zero. Compiled functions reject them
    themselves, except under torch.compile's debugging backend "eager".
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
                    f"each, {HINT}"
                ) from error
            raise

    return guarded
