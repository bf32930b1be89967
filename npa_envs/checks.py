"""Checks of arguments, device names and configuration fields; each error says how to correct it.

`check_...` raises NPAError if the check fails, `checked_...` also returns the checked value. `name`
is what the error calls the value.
"""

from __future__ import annotations

import contextlib
import functools
import math
import operator
import sys
from collections.abc import Callable, Sequence
from types import NoneType
from typing import Any, Literal, ParamSpec, TypeGuard, TypeVar, cast

import torch
from torch import Tensor, nn

from npa_envs.errors import NPAError, shown, suggest

Choice = TypeVar("Choice")
Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

DTYPES = (torch.float32, torch.float64)

LENGTH_RANGE = {
    (2, torch.float32): (1e-8, 1e8),
    (3, torch.float32): (1e-6, 1e6),
    (2, torch.float64): (1e-60, 1e60),
    (3, torch.float64): (1e-50, 1e50),
}
"""Allowed perception radii [length units] by D and dtype, whose powers in the kernels are
finite."""

MAX_SIDE = 16384
"""Largest side of a picture [pixels]."""

MomentInverse = Literal["threshold", "smooth"]
"""Correction of state gradients: "threshold" is the paper's, M^-1 where |det M| >= 1e-3, else I;
"smooth" is a smooth function of M that tends to M^-1, and to I as det M tends to 0."""

Box = float | Sequence[float] | None
"""Sides of a periodic box centred on the origin [length units], one number for all; None: open."""


IMMUTABLE: set[type] = {float, int, bool, str, NoneType, torch.dtype}
"""Types of arguments whose values `checked_once` compares."""

MAX_CHECKED = 1024
"""Maximum number of calls whose results a check keeps."""


def checked_once(check: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Return a check that is made once for tensors of the same forms and equal other arguments.

    It must not read tensors' numbers. It is made each time if an argument is mutable, or while
    torch compiles.
    """
    results: dict[Any, Result] = {}

    @functools.wraps(check)
    def checked(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        if torch.compiler.is_compiling():
            return check(*args, **kwargs)
        forms: list[Any] = [*args, *kwargs.values()]
        # With the types: True is 1, and 1 is 1.0.
        kinds = tuple(map(type, forms))
        tensors = _tensor_places(kinds)
        if tensors is None:
            return check(*args, **kwargs)
        for k in tensors:
            value = forms[k]
            forms[k] = value.is_nested or value.shape, value.dtype, value.device, value.layout
        key = kinds, tuple(kwargs), tuple(forms)
        # `results` where there is no result, as that may be None.
        result: Any = results.get(key, results)
        if result is results:
            result = check(*args, **kwargs)
            if len(results) >= MAX_CHECKED:
                results.clear()
            results[key] = result
        return cast("Result", result)

    return checked


@functools.lru_cache(MAX_CHECKED)
def _tensor_places(kinds: tuple[type, ...]) -> list[int] | None:
    """Return which of these types are tensors; None: a type is neither that nor immutable."""
    places = [k for k, kind in enumerate(kinds) if kind in (Tensor, nn.Parameter)]
    return places if IMMUTABLE.issuperset({*kinds} - {Tensor, nn.Parameter}) else None


def check_dense(name: str, tensor: Tensor) -> None:
    """Check that a tensor is strided, not nested, and on a CPU or a CUDA device."""
    if tensor.is_nested:
        raise NPAError(f"{name} must be one dense tensor, got a nested one: run each by itself")
    if tensor.layout != torch.strided or tensor.device.type not in ("cpu", "cuda"):
        raise NPAError(
            f"{name} must be a dense tensor on 'cpu' or 'cuda', got {tensor.layout} on "
            f"{tensor.device}: convert it with .to_dense() or .to(device)"
        )


def check_floating(name: str, tensor: Any, shape: str = "") -> None:
    """Check that a tensor is dense, float32 or float64; errors name the `shape` that it needs."""
    if not isinstance(tensor, Tensor):
        wanted = f" of shape {shape}" if shape else ""
        raise NPAError(
            f"{name} must be a torch tensor{wanted}, got {type(tensor).__name__}: "
            f"convert it with torch.as_tensor"
        )
    if tensor.dtype not in DTYPES:
        raise NPAError(
            f"{name} must be float32 or float64, got {tensor.dtype}: convert it with .float()"
        )
    check_dense(name, tensor)


def check_alike(name: str, tensor: Tensor, other_name: str, other: Tensor) -> None:
    """Check that two tensors have the same dtype and device."""
    if tensor.dtype != other.dtype or tensor.device != other.device:
        raise NPAError(
            f"{name} and {other_name} must share dtype and device, got {tensor.dtype} on "
            f"{tensor.device} and {other.dtype} on {other.device}: convert one with .to(other)"
        )


@checked_once
def check_world(x: Tensor, s: Tensor) -> None:
    """Check shapes, dtypes and devices of positions and states."""
    for name, tensor, last in (("x", x, "D"), ("s", s, "C")):
        check_floating(name, tensor)
        if tensor.ndim != 3:
            hint = f"add a world dimension with {name}[None]" if tensor.ndim == 2 else "reshape it"
            raise NPAError(
                f"{name} must have shape [B, N, {last}], got {tuple(tensor.shape)}: {hint}"
            )
    if x.shape[2] not in (2, 3):
        raise NPAError(
            f"x must have 2 or 3 coordinates, got shape {tuple(x.shape)}: give positions first, "
            "then states"
        )
    if x.shape[:2] != s.shape[:2]:
        raise NPAError(
            f"x and s must agree in worlds and particles, got {tuple(x.shape)} and "
            f"{tuple(s.shape)}: for example s = torch.zeros(*x.shape[:2], channels)"
        )
    if 0 in x.shape or 0 in s.shape:
        raise NPAError(
            f"a world needs at least one particle and one state channel, "
            f"got {tuple(x.shape)} and {tuple(s.shape)}"
        )
    check_alike("x", x, "s", s)


def check_finite_positions(x: Tensor) -> None:
    """Check that every position is finite, except while torch compiles or captures a CUDA graph."""
    # In this order: torch.compile cannot trace the second call.
    if torch.compiler.is_compiling():
        return
    if x.is_cuda and torch.cuda.is_current_stream_capturing():
        return
    FiniteCheck(x).wait()


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
    """Return a torch.device, for "cuda" cuda:0; raise NPAError if torch has no such device."""
    device = parse_device(str(name) if isinstance(name, torch.device) else name)
    if device.type != "cuda":
        return device
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    index = 0 if device.index is None else device.index
    if index >= count:
        raise NPAError(
            f"device must be one that torch sees, got {shown(str(name))}, but it sees {count} CUDA "
            "devices: use 'cpu', or see `npa-envs doctor`"
        )
    return torch.device("cuda", index)


class FiniteCheck:
    """A check that all positions, not states, are finite: it starts when made, and `wait` raises.

    x must not change until `wait` returns.
    """

    def __init__(self, x: Tensor) -> None:
        self._x = x.detach()
        self._copied: torch.cuda.Event | None = None
        # The largest absolute value, NaN if there is any NaN, takes one kernel.
        self._size: Tensor
        if not x.is_cuda:
            self._size = torch.linalg.vector_norm(self._x, math.inf)
            return
        stream = torch.cuda.current_stream(x.device)
        # `torch.cuda.stream(stream)` would take half of the time of a call of few steps.
        with stream:
            on_host = torch.empty((), dtype=x.dtype, device="cpu", pin_memory=True)
            size = torch.linalg.vector_norm(self._x, math.inf)
            self._size = on_host.copy_(size, non_blocking=True)
            self._copied = torch.cuda.Event()  # type: ignore[no-untyped-call]
            self._copied.record(stream)

    def wait(self) -> None:
        """Wait for the check, not for work after it; raise NPAError if a position is not finite."""
        if self._copied is not None:
            self._copied.synchronize()
        if math.isfinite(self._size):
            return
        finite = torch.isfinite(self._x).all(dim=-1)
        world, particle = (int(k) for k in (~finite).nonzero()[0])
        raise NPAError(
            f"x must be finite, got {self._x[world, particle].tolist()} at world {world}, particle "
            f"{particle} ({int((~finite).sum())} such particles): reset those worlds"
        )


def constant(number: float) -> float:
    """Return `number`, or its value if it is a symbol of `torch.compile(dynamic=True)`.

    Custom operators take Python numbers, not the compiler's symbols.
    """
    if not torch.compiler.is_compiling():
        return number
    # The compiler evaluates these two; most other functions return another symbol.
    return math.ldexp(*math.frexp(number))


def checked_flag(name: str, value: Any) -> bool:
    """Return `value` as a bool; raise NPAError if it has no truth value."""
    if isinstance(value, bool):
        return value
    with contextlib.suppress(TypeError, ValueError, RuntimeError):
        return bool(value)
    raise NPAError(f"{name} must be True or False, got {shown(value)}")


def checked_choice(name: str, value: Any, choices: Sequence[Choice]) -> Choice:
    """Return the one of two or more `choices` that equals `value` and has its type."""
    for choice in choices:
        if isinstance(value, type(choice)) and value == choice:
            return choice
    *others, last = map(repr, choices)
    text = " ".join(one for one in choices if isinstance(one, str))
    nearest = suggest(value, text.split()).partition("known: ")[0] if text else ""
    hint = f": {nearest.strip()}" if nearest else ""
    raise NPAError(f"{name} must be {', '.join(others)} or {last}, got {shown(value)}{hint}")


def checked_number(name: str, value: Any) -> float:
    """Return a number as a float; 0-dimensional tensors and NumPy scalars are allowed."""
    if not isinstance(value, str | bytes | bool):
        with contextlib.suppress(TypeError, ValueError, RuntimeError, OverflowError):
            return constant(float(value))
    raise NPAError(f"{name} must be a number, got {shown(value)}: try 0.5")


def checked_count(name: str, value: Any) -> int:
    """Return an integer of at least 0 as an int; NumPy's integers are allowed."""
    if not isinstance(value, bool):
        with contextlib.suppress(TypeError):
            count = operator.index(value)
            if count >= 0:
                return count
    raise NPAError(f"{name} must be an integer of at least 0, got {shown(value)}: try 8")


def checked_positive(name: str, value: Any, unit: str = "") -> float:
    """Return a positive, finite number as a float; errors name its `unit`."""
    number = checked_number(name, value)
    if not (math.isfinite(number) and number > 0.0):
        raise NPAError(f"{name} must be positive and finite{unit}, got {number:g}: try 0.1")
    return number


def checked_finite(name: str, value: Any, unit: str = "") -> float:
    """Return a finite number as a float; errors name its `unit`."""
    number = checked_number(name, value)
    if not math.isfinite(number):
        raise NPAError(f"{name} must be finite{unit}, got {number:g}: try 0.1")
    return number


def checked_side(name: str, value: Any) -> int:
    """Return the side of a picture [pixels] as an int in [1, `MAX_SIDE`]."""
    side = checked_count(name, value)
    if not 1 <= side <= MAX_SIDE:
        raise NPAError(f"{name} must lie in [1, {MAX_SIDE}] pixels, got {shown(side)}")
    return side


def as_list(value: Any) -> list[Any] | None:
    """Return a sequence, array or tensor as a list; None for text and for single numbers."""
    if isinstance(value, str | bytes) or getattr(value, "ndim", 1) == 0:
        return None
    with contextlib.suppress(TypeError, ValueError, RuntimeError):
        return list(value)
    return None


def number_tensor(name: str, value: Any) -> Tensor:
    """Return an array, a list or a tensor of real numbers as a dense tensor."""
    try:
        numbers = torch.as_tensor(value)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise NPAError(f"{name} must be numbers, got {shown(value)}") from error
    if numbers.dtype.is_complex:
        raise NPAError(f"{name} must be real numbers, got {shown(value)}")
    check_dense(name, numbers)
    return numbers


def checked_tensor(
    task: Any,
    method: str,
    field: str,
    value: Any,
    shape: tuple[int, ...],
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Return `value`, which `method` returned as `field`, if it has this shape and type."""
    device = task.device
    if not isinstance(value, Tensor):
        actual = f"a {type(value).__name__}"
    elif tuple(value.shape) != shape or value.dtype != dtype or value.device.type != device.type:
        actual = f"{value.dtype} of shape {tuple(value.shape)} on {value.device}"
    else:
        return value
    raise NPAError(
        f"{field} of {type(task).__name__}.{method} must be a {dtype} tensor of shape {shape} on "
        f"{device}, got {actual}: reshape or convert it there"
    )


def checked_eps(name: str, eps: float, space_dim: int, dtype: torch.dtype) -> float:
    """Return a perception radius as a float [length units] within its `LENGTH_RANGE`."""
    value = checked_positive(name, eps, " [length units]")
    low, high = LENGTH_RANGE[space_dim, dtype]
    if not low <= value <= high:
        raise NPAError(
            f"{name} must lie in [{low:g}, {high:g}] length units for {dtype} in {space_dim}D, got "
            f"{shown(eps)}: choose another unit of length"
        )
    return value


def check_scale(eps: float, eps0: float, space_dim: int, dtype: torch.dtype) -> None:
    """Check that (eps / eps0)^(1+D), a factor of density gradients, is in the dtype's range."""
    limits = torch.finfo(dtype)
    # By logarithms, as the power may overflow.
    scale = (1 + space_dim) * (math.log(eps) - math.log(eps0))
    if not math.log(1e6 * limits.tiny) < scale < math.log(1e-6 * limits.max):
        raise NPAError(
            f"eps / eps0 must be a moderate ratio, got {eps:g} / {eps0:g}: perceive at a radius "
            f"nearer to the one that the rule was trained with"
        )


def checked_box(
    box: Box, space_dim: int, eps: float | None, dtype: torch.dtype
) -> tuple[float, ...] | None:
    """Return the sides of a box as D floats, or None for open space.

    Sides must be at least 2 `eps`, as in a periodic box; `eps` None: any positive sides.
    """
    if box is None:
        return None
    several = as_list(box)
    if several is None:
        sides = (checked_number("box", box),) * space_dim
    else:
        sides = tuple(checked_number("a side of box", side) for side in several)
    if len(sides) != space_dim:
        raise NPAError(f"box must have {space_dim} sides, got {len(sides)}: {shown(sides)}")
    # With a tolerance: a box of exactly 2 eps passes however both were rounded.
    least = math.ulp(0.0) if eps is None else 2.0 * eps * (1.0 - 1e-10)
    if not all(math.isfinite(side) and side >= least for side in sides):
        rule, hint = "positive", ""
        if eps is not None:
            rule = f"at least 2 eps = {2.0 * eps:g}"
            hint = ": enlarge the box or perceive at a smaller eps"
        raise NPAError(f"box sides must be finite and {rule}, got {shown(sides)}{hint}")
    largest = 1e-6 * torch.finfo(dtype).max
    if max(sides) > largest:
        raise NPAError(
            f"box sides must be at most {largest:g} length units for {dtype}, got {shown(sides)}: "
            "use open space, box=None"
        )
    return sides


# Fields of configurations: each error names the field, the rule, the value and a correction.


def check_field(
    config: object, name: str, ok: bool, requirement: str, hint: str = "", *, example: object = None
) -> None:
    """Raise NPAError unless `ok`; it says that the configuration's field must `requirement`.

    The error ends with `hint`; without one, with the field's default, or `example` if it has none.
    """
    if not ok:
        hint = hint or f"for example {name}={getattr(type(config), name, example)!r}"
        raise NPAError(f"{name} must {requirement}, got {shown(getattr(config, name))}: {hint}")


def _check_fields(
    config: object, names: Sequence[str], ok: Callable[[Any], bool], rule: str, example: object
) -> None:
    for name in names:
        check_field(config, name, ok(getattr(config, name)), rule, example=example)


def check_positive(
    config: object, cls: type, *names: str, at_least: int = 1, at_most: int = sys.maxsize
) -> None:
    """Check that fields are ints within the bounds or, if `cls` is float, finite and above 0."""
    if cls is float:
        rule = "be a finite number greater than 0"
        _check_fields(config, names, lambda v: is_real(v) and v > 0, rule, 1.0)
        return
    rule = f"be a whole number of at least {at_least}"
    _check_fields(config, names, lambda v: is_whole(v) and v >= at_least, rule, at_least)
    _check_fields(config, names, lambda v: v <= at_most, f"be at most {at_most}", at_least)


def check_non_negative(config: object, *names: str, at_most: float = math.inf) -> None:
    """Check that fields are finite numbers of at least 0, and at most `at_most`."""
    rule = "be a finite number of at least 0"
    _check_fields(config, names, lambda v: is_real(v) and v >= 0, rule, 0.0)
    _check_fields(config, names, lambda v: v <= at_most, f"be at most {at_most:g}", at_most)


def check_fraction(config: object, *names: str) -> None:
    """Check that fields are numbers in (0, 1]."""
    _check_fields(config, names, lambda v: is_real(v) and 0 < v <= 1, "lie in (0, 1]", 0.5)


def check_word(config: object, name: str, choices: Sequence[str | None]) -> None:
    """Check that a field is one of `choices`, which may include None."""
    checked_choice(name, getattr(config, name), choices)


def check_flag(config: object, *names: str) -> None:
    """Check that fields are True or False."""
    _check_fields(config, names, lambda v: isinstance(v, bool), "be True or False", False)


def check_text(config: object, name: str, what: str) -> None:
    """Check that a field is a non-empty string; the error says that it must be `what`."""
    _check_fields(config, (name,), lambda v: isinstance(v, str) and v != "", f"be {what}", "name")


def check_seed(config: object, name: str, *, bits: int = 63) -> None:
    """Check that a field is the seed of a random generator: an int in [0, 2**bits)."""
    rule = f"be a whole number of at least 0 and below 2**{bits}"
    _check_fields(config, (name,), lambda v: is_whole(v) and 0 <= v < 2**bits, rule, 0)


def is_whole(value: Any) -> TypeGuard[int]:
    """Return whether `value` is an int (a bool is not)."""
    return isinstance(value, int) and not isinstance(value, bool)


def is_real(value: Any) -> bool:
    """Return whether `value` is a finite int or float (a bool is not)."""
    # Compared, not converted, as an int may be too large for a float.
    real = isinstance(value, int | float) and not isinstance(value, bool)
    return real and -sys.float_info.max <= value <= sys.float_info.max


def are_texts(value: Any) -> bool:
    """Return whether `value` is a tuple of non-empty strings."""
    return isinstance(value, tuple) and all(isinstance(part, str) and part for part in value)


def check_count(name: str, value: object, hint: str = "", *, at_most: int = sys.maxsize) -> None:
    """Check that an argument is a whole number of at least 1, and at most `at_most`."""
    if not is_whole(value) or value < 1:
        raise NPAError(f"{name} must be an integer of at least 1, got {shown(value)}{hint}")
    if value > at_most:
        raise NPAError(f"{name} must be at most {at_most}, got {shown(value)}{hint}")
