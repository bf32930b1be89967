"""`npa-envs warmup`: compiles the kernels ahead of time."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from npa_envs.cli import common
from npa_envs.errors import NPAError


@dataclass(frozen=True, kw_only=True)
class WarmupOptions(common.DeviceOptions):
    """Compile the kernels ahead of time, into Warp's cache (`npa-envs doctor` prints where).

    Examples:
      npa-envs warmup
      npa-envs warmup --device cuda --space-dims 2 3
    """

    space_dims: tuple[int, ...] = (2,)
    """Space dimensions: 2, 3 or both."""
    dtypes: tuple[Literal["float32", "float64"], ...] = ("float32",)
    """Precisions."""


def main(arguments: Sequence[str]) -> int:
    """Compile the kernels; return 0."""
    options = common.parse_options(WarmupOptions, "warmup", arguments)
    import torch

    from npa_envs.ops import warmup
    from npa_envs.runtime import kernel_cache_folder

    if not options.space_dims or not options.dtypes or not set(options.space_dims) <= {2, 3}:
        raise NPAError(
            f"space_dims must be 2, 3 or both and dtypes not empty, got {options.space_dims} and "
            f"{options.dtypes}: for example --space-dims 2 3 --dtypes float32"
        )
    start = time.perf_counter()
    dtypes = [getattr(torch, name) for name in options.dtypes]
    warmup(options.checked_device(), space_dims=options.space_dims, dtypes=dtypes)
    seconds = time.perf_counter() - start
    print(f"kernels for {options.device} are ready ({seconds:.1f} s), in {kernel_cache_folder()}")
    return 0
