"""A data set in MNIST's format that any rule can learn: a disk, a bar and a ring."""

import gzip
import struct
from pathlib import Path

import numpy as np

SIDE = 12
COUNTS = {"train": 36, "t10k": 18}


def pictures(count, seed):
    """Return pictures, uint8, [count, SIDE, SIDE], and their classes 0, 1, 2, 0, ..."""
    random = np.random.default_rng(seed)
    row, column = np.mgrid[:SIDE, :SIDE]
    label = np.arange(count) % 3
    images = np.zeros((count, SIDE, SIDE), np.uint8)
    for k in range(count):
        middle = SIDE / 2 - 0.5 + random.uniform(-0.7, 0.7, 2)
        away = np.hypot(row - middle[0], column - middle[1])
        shapes = (away < 2.5, np.abs(column - middle[1]) < 1.0, np.abs(away - 4.2) < 0.9)
        images[k] = np.where(shapes[label[k]], random.integers(200, 256), 0)
    return images, label.astype(np.uint8)


def idx(values):
    """Return the bytes of an IDX file."""
    head = struct.pack(f">BBBB{values.ndim}I", 0, 0, 8, values.ndim, *values.shape)
    return head + values.tobytes()


def write_idx(folder: Path) -> Path:
    """Write the data set; the files for testing are gzipped."""
    folder.mkdir(parents=True, exist_ok=True)
    for seed, (part, count) in enumerate(COUNTS.items()):
        images, label = pictures(count, seed)
        for name, values in (("images-idx3", images), ("labels-idx1", label)):
            path = folder / f"{part}-{name}-ubyte"
            if part == "train":
                path.write_bytes(idx(values))
            else:
                path.with_name(path.name + ".gz").write_bytes(gzip.compress(idx(values)))
    return folder
