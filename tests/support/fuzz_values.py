"""Wrong and extreme arguments, for tests that call at random."""

import math
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

ORDINARY: tuple[Any, ...] = (
    None, True, False, "", "a", "0.1", "nan", b"x", "cuda", "npa/Texture-v0", 0, -1, 1, 2, 3, 2.0,
    0.5, -0.0, 1.0, np.float32(0.1), np.int64(-1), np.int32(2), np.bool_(True), np.array(0.1),
    np.array([0.1, 0.2]), np.array("a"), np.array([]), [], [0.1], [1, 2], ["a"], (), (1,),
    (0.5, 0.5), {}, {"a": 1}, set(), object(), 1j, int, range(3), Path("no.safetensors"),
    torch.tensor(0.1), torch.tensor([1.0, 2.0]), torch.tensor(1 + 2j), torch.float16,
)  # fmt: skip
"""Values of many types that a caller may pass by mistake."""

EXTREME: tuple[Any, ...] = (
    math.nan, math.inf, -math.inf, 5e-324, 1e-38, 1e-12, 1e12, 1e30, 1e38, 1e300, -1e300, 2**31 - 1,
    2**31, 2**63 - 1, 2**64, 10**400, -(10**400), np.nan, np.array(math.inf), [math.nan, 1.0],
    (math.inf, 1e300), torch.tensor(math.nan), torch.tensor([math.inf, 1.0]), [10**400], "1e400",
    10**5000, 10_000 * "x",
)  # fmt: skip
"""Numbers that are not finite, or at the end of a range."""

ENDLESS = ("steps", "frame_count", "max_cycles", "frames")
"""Arguments whose large values are legal, and take long."""


def wrong(draw: random.Random, name: str, legal: Any) -> Any:
    """Return a replacement of a legal argument."""
    if isinstance(legal, Tensor) and draw.random() < 0.8:
        return wrong_tensor(draw, legal)
    if name not in ENDLESS and draw.random() < 0.4:
        return draw.choice(EXTREME)
    return draw.choice(ORDINARY)


def wrong_tensor(draw: random.Random, legal: Tensor) -> Any:
    """Return a tensor of another shape, dtype, device or content."""

    def filled(value: float) -> Tensor:
        made = legal.clone()
        if made.numel() and made.is_floating_point():
            made.view(-1)[draw.randrange(made.numel())] = value
        return made

    makers: tuple[Callable[[], Any], ...] = (
        lambda: legal[0] if len(legal) else legal[None],
        lambda: legal[None],
        lambda: legal[..., :1],
        lambda: legal[:0],
        lambda: legal[:, :0] if legal.ndim > 1 else legal[:0],
        lambda: legal[..., :0],
        lambda: legal.repeat(2, *[1] * (legal.ndim - 1)),
        lambda: legal.flatten(),
        lambda: legal.mT if legal.ndim > 1 else legal,
        lambda: legal[:1].expand_as(legal),
        lambda: legal.double(),
        lambda: legal.half(),
        lambda: legal.bfloat16(),
        lambda: legal.long(),
        lambda: legal.bool(),
        lambda: legal.to(torch.complex64),
        lambda: legal.to("meta"),
        lambda: legal.to_sparse(),
        lambda: legal.numpy(),
        lambda: legal.tolist(),
        lambda: legal.clone().requires_grad_() if legal.is_floating_point() else legal,
        lambda: filled(math.nan),
        lambda: filled(math.inf),
        lambda: filled(-1e38),
        lambda: filled(1e12),
        lambda: filled(1e-40),
        lambda: torch.zeros_like(legal),
        lambda: -legal,
        lambda: 1e20 * legal,
    )
    return draw.choice(makers)()
