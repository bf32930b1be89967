"""Pictures of digits with their classes: scikit-learn's, MNIST, or any files in MNIST's format."""

from __future__ import annotations

import gzip
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from npa_envs.errors import MissingDependencyError, NPAError, suggest

Split = Literal["train", "test"]

BUILT_IN = ("digits", "mnist")
"""Data sets by name; everything else is a folder of IDX files."""

TEST_SHARE = 0.2
"""Share of scikit-learn's digits, class by class, that is never trained on."""

SPLIT_SEED = 0
"""What that share is drawn from."""

IDX_NAMES = {
    "train": ("train-images-idx3-ubyte", "train-labels-idx1-ubyte"),
    "test": ("t10k-images-idx3-ubyte", "t10k-labels-idx1-ubyte"),
}
"""Files of pictures and of their classes, as MNIST's are called; each may end in .gz."""

MNIST_DOWNLOAD = "import torchvision; torchvision.datasets.MNIST({folder!r}, download=True)"


@dataclass(frozen=True)
class DigitPictures:
    """Pictures and what they show."""

    ink: NDArray[np.float32]
    """How much ink there is, in [0, 1], shape [M, H, W]; the first row is the highest."""

    label: NDArray[np.int64]
    """The class of each picture, 0 or more, shape [M]."""


def load_pictures(data: str, split: Split = "train", *, folder: str = "data") -> DigitPictures:
    """Return the pictures of a data set.

    Args:
        data: "digits" (scikit-learn's 1797 pictures of 8 x 8 pixels), "mnist" (by torchvision), or
            the path of a folder with files in MNIST's IDX format.
        split: "train" or "test"; no picture is in both.
        folder: Where torchvision keeps "mnist".

    Raises:
        MissingDependencyError: scikit-learn or torchvision is needed and not installed.
        NPAError: There is no such data set or split, or a file is missing or damaged.
    """
    if split not in get_args(Split):
        raise NPAError(f"split must be 'train' or 'test', got {split!r}")
    if data == "digits":
        return _digits(split)
    if data == "mnist":
        return _mnist(split, folder)
    path = Path(data)
    if not path.is_dir():
        raise NPAError(
            f"data must be a known data set or a folder of IDX files, got {data!r}: "
            f"{suggest(data, BUILT_IN)}"
        )
    return _idx_folder(path, split)


def read_idx(path: Path) -> NDArray[np.uint8]:
    """Return the bytes of a file in MNIST's IDX format, gzipped or not, in their shape.

    Args:
        path: The file.

    Raises:
        NPAError: It cannot be read, or does not hold what its head says.
    """
    try:
        content = path.read_bytes()
        if content[:2] == b"\x1f\x8b":
            content = gzip.decompress(content)
    except (OSError, EOFError, zlib.error) as error:
        raise NPAError(f"cannot read the IDX file {str(path)!r}: {error}") from error
    # Two zeros, 8 for unsigned bytes, the number of dimensions, then each as four bytes.
    dimensions = content[3] if len(content) >= 4 else 0
    head = 4 + 4 * dimensions
    if content[:3] != b"\0\0\x08" or dimensions == 0 or len(content) < head:
        raise NPAError(
            f"{str(path)!r} must be an IDX file of unsigned bytes, but begins with "
            f"{content[:4].hex(' ') or 'nothing'}: 00 00 08 and the number of dimensions"
        )
    shape = tuple(int(size) for size in np.frombuffer(content, ">u4", dimensions, offset=4))
    values = np.frombuffer(content, np.uint8, offset=head)
    expected = 1
    for size in shape:
        expected *= size
    if values.size != expected:
        raise NPAError(
            f"the IDX file {str(path)!r} must hold {expected} bytes of data, as its head says "
            f"({' x '.join(map(str, shape))}), but holds {values.size}: get it anew"
        )
    return values.reshape(shape)


def _digits(split: Split) -> DigitPictures:
    try:
        from sklearn.datasets import load_digits
    except ImportError as error:
        raise MissingDependencyError(
            "data='digits' needs scikit-learn: pip install 'npa-envs[points]', or give the folder "
            "of MNIST's IDX files"
        ) from error
    bunch: Any = load_digits()
    label = np.asarray(bunch.target, np.int64)
    random = np.random.default_rng(SPLIT_SEED)
    is_test = np.zeros(len(label), bool)
    for number in range(10):
        own = random.permutation(np.flatnonzero(label == number))
        is_test[own[: round(TEST_SHARE * len(own))]] = True
    chosen = is_test if split == "test" else ~is_test
    return DigitPictures(np.asarray(bunch.images, np.float32)[chosen] / 16.0, label[chosen])


def _mnist(split: Split, folder: str) -> DigitPictures:
    try:
        from torchvision.datasets import MNIST
    except ImportError as error:
        raise MissingDependencyError(
            "data='mnist' needs torchvision: pip install torchvision, or give the folder of "
            "MNIST's IDX files"
        ) from error
    try:
        mnist: Any = MNIST(folder, train=split == "train", download=False)
    except RuntimeError as error:
        raise NPAError(
            f"MNIST is not in the folder {folder!r}, and nothing is downloaded unasked: "
            f'python -c "{MNIST_DOWNLOAD.format(folder=folder)}", or name its folder'
        ) from error
    ink = (mnist.data.numpy() / 255.0).astype(np.float32)
    return DigitPictures(ink, mnist.targets.numpy().astype(np.int64))


def _idx_folder(folder: Path, split: Split) -> DigitPictures:
    images, labels = (read_idx(_find(folder, name)) for name in IDX_NAMES[split])
    if images.ndim != 3 or labels.shape != images.shape[:1] or images.size == 0:
        raise NPAError(
            f"the {split} files of {str(folder)!r} must hold pictures [M, H, W] and classes [M], "
            f"got {list(images.shape)} and {list(labels.shape)}: get them anew"
        )
    return DigitPictures((images / 255.0).astype(np.float32), labels.astype(np.int64))


def _find(folder: Path, name: str) -> Path:
    for candidate in (folder / name, folder / f"{name}.gz"):
        if candidate.is_file():
            return candidate
    raise NPAError(
        f"the folder {str(folder)!r} must hold {name} or {name}.gz: MNIST's files are called so"
    )
