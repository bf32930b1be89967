"""Pictures of a batch."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.render.film import write_png
from npa_envs.render.picture import to_uint8


def write_batch_picture(path: Path, picture: Tensor) -> NDArray[np.uint8]:
    """Write the worlds of a batch side by side as a PNG.

    Args:
        path: The file to write.
        picture: rgb sums and density of each world, shape [B, R, R, 4].

    Returns:
        The frame that was written, shape [R, B·R, 3].

    Raises:
        NPAError: The file cannot be written.
    """
    frames: NDArray[Any] = to_uint8(picture.detach().cpu())
    frame = np.concatenate(list(frames), axis=1)
    write_png(path, frame)
    return frame
