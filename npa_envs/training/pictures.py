"""Pictures of a batch."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.files import write_bytes
from npa_envs.render.film import encode_frame
from npa_envs.render.picture import to_uint8


def write_batch_picture(path: Path, picture: Tensor, board: Any, iteration: int) -> None:
    """Write the worlds of a batch side by side as a PNG, and as a JPEG to TensorBoard.

    Args:
        path: The file to write.
        picture: rgb sums and density of each world, shape [B, R, R, 4].
        board: TensorBoard's writer (`open_tensorboard`), or None.
        iteration: Iterations done so far.

    Raises:
        NPAError: The file cannot be written.
    """
    frame = np.concatenate(list(to_uint8(picture)), axis=1)
    write_bytes(path, encode_frame(frame, "PNG"))
    if board is not None:
        _add_picture(board, frame, iteration)


def _add_picture(board: Any, frame: NDArray[np.uint8], iteration: int) -> None:
    # Imported late: only runs with TensorBoard need it.
    from tensorboard.compat.proto.summary_pb2 import Summary

    # The writer's own add_image makes a PNG, and TensorBoard takes a checksum of it in Python, byte
    # by byte, which holds up the interpreter for longer than all the rest takes.
    height, width, channels = frame.shape
    image = Summary.Image(
        height=height,
        width=width,
        colorspace=channels,
        encoded_image_string=encode_frame(frame, "JPEG"),
    )
    summary = Summary(value=[Summary.Value(tag="batch", image=image)])
    board.file_writer.add_summary(summary, iteration)
