"""Pictures of a batch: target and worlds side by side."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.files import write_bytes
from npa_envs.render.colours import to_uint8
from npa_envs.render.film import encode_frame

PICTURE_HEIGHT = 256
"""Least height of the pictures [pixels]; the pixels of smaller worlds are repeated."""

PICTURE_GAP = 8
"""Pixels between the worlds of a picture."""


def write_batch_picture(path: Path, picture: Tensor, board: Any, iteration: int) -> None:
    """Write target and worlds of a batch side by side as a PNG, and as a JPEG to TensorBoard.

    Args:
        path: The file to write, at least `PICTURE_HEIGHT` pixels high.
        board: TensorBoard's writer (`open_tensorboard`), or None.
    """
    repeats = math.ceil(PICTURE_HEIGHT / picture.shape[1])
    frames = to_uint8(picture).repeat(repeats, axis=1).repeat(repeats, axis=2)
    frames = np.pad(frames, ((0, 0), (0, 0), (0, PICTURE_GAP), (0, 0)), constant_values=255)
    frame = np.concatenate(list(frames), axis=1)[:, :-PICTURE_GAP]
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
