"""Clouds of points from pictures of digits: scikit-learn's, MNIST, or files in MNIST's format."""

from __future__ import annotations

import functools
import gzip
import math
import os
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.atomic_files import home_path, open_regular
from npa_envs.errors import MissingDependencyError, NPAError, shown, suggest
from npa_envs.tasks.targets.notes import tell
from npa_envs.world.randomness import Randomness, normal_draws, uniform_draws

Split = Literal["train", "test"]

COORDINATE_COUNT = 2048
"""While points are chosen, coordinates are integers below this, so that squared distances are exact
in float32 and every device chooses the same points."""

INK = 0.5
"""A position has ink if the picture is there at least this fraction as dark as at its darkest."""

CANDIDATE_FACTORS = (2, 3)
"""Minimum and maximum number of candidates for each chosen point."""

FINEST_GRID = 1024
"""Number of cells along each side of the finest grid of candidates."""

BATCH_SIZES = {"cpu": 256, "cuda": 1024}
"""Maximum number of pictures that are sampled in one batch, by device; a CPU's fit into caches."""

CELLS_PER_BATCH = 1 << 24
"""Maximum number of grid cells in one batch."""

MAX_IDX = 600_000_000
"""Maximum size of the data in an IDX file [bytes]; the largest of EMNIST has 547 million."""

CACHED_DATA_SETS = 4
"""Maximum number of results of `load_clouds` that stay in memory."""


@dataclass(frozen=True)
class PointClouds:
    """Point clouds with their classes."""

    x: Tensor
    """Positions in [0, 1]² [length units], shape [M, N, 2]; y is up."""
    label: Tensor
    """Classes, int64, shape [M]."""
    coverage: float
    """Fraction of the unit square that has ink, averaged over the clouds."""
    summary: str = ""
    """What was read, in one line; empty for a built-in target."""


@functools.lru_cache(CACHED_DATA_SETS)
def load_clouds(
    data: str,
    split: Split,
    particle_count: int,
    *,
    folder: str = "data",
    sample_seed: int = 0,
    device: torch.device,
) -> PointClouds:
    """Return a cloud of `particle_count` points for each picture of a data set.

    `load_pictures` explains `data`, `split`, `folder`; `sample_ink` the points. Results are cached.
    """
    ink, label = load_pictures(data, split, folder=folder)
    x, area = sample_ink(ink, particle_count, sample_seed=sample_seed, device=device)
    height, width = ink.shape[1:]
    coverage = area * (height * width / max(height, width) ** 2)
    summary = ""
    if data != "digits":
        summary = f"{shown(data)[1:-1]}: {len(ink)} pictures of {width} x {height} to {split}, "
        summary += f"{len(np.unique(label))} classes"
        tell(summary)
    return PointClouds(x, torch.from_numpy(label).to(device), coverage, summary)


def sample_ink(
    ink: NDArray[np.float32],
    particle_count: int,
    *,
    sample_seed: int = 0,
    device: str | torch.device = "cpu",
) -> tuple[Tensor, float]:
    """Return N = `particle_count` points with ink in each of M pictures, and their share of ink.

    The points [M, N, 2] lie in [0, 1]² [length units], where a picture's longer side is 1. They are
    farthest-point samples of candidates: one random position in each cell of a grid, where the
    picture, enlarged bilinearly, has ink. The grid is refined until there are enough. Points are
    the same on every device. The second result is the fraction of the area that has ink, averaged
    over the pictures. `ink` has shape [M, H, W].
    """
    darkest = ink.max((1, 2))
    if (darkest <= 0).any():
        raise NPAError(
            f"every picture must have ink, got an empty one at {int(np.argmin(darkest))}: remove it"
        )
    least, most = (factor * particle_count for factor in CANDIDATE_FACTORS)
    relative = torch.from_numpy(ink / darkest[:, None, None])
    x = torch.empty(len(ink), particle_count, 2, device=device)
    areas = torch.empty(len(ink))
    random = torch.Generator().manual_seed(sample_seed)
    chunk = BATCH_SIZES[torch.device(device).type]
    waiting = torch.arange(len(ink))
    side = 1 << math.ceil(math.log2(2.0 * math.sqrt(least)))
    while len(waiting) > 0:
        cells, points = _grid_points(side, relative.shape[1:], random)
        finer = []
        for part in torch.split(waiting, max(1, min(chunk, CELLS_PER_BATCH // side**2))):
            has_ink = _has_ink(relative[part], side)[:, cells]
            counts = has_ink.sum(1)
            enough = (counts >= least) | (side >= FINEST_GRID)
            finer.append(part[~enough])
            part, has_ink, counts = part[enough], has_ink[enough], counts[enough]
            if len(part) == 0:
                continue
            areas[part] = counts / len(cells)
            x[part.to(device)] = _farthest_points(
                points[_first_true(has_ink, most)].to(device), counts.to(device), particle_count
            )
        waiting = torch.cat(finer)
        side *= 2
    return (x + 0.5) / COORDINATE_COUNT, float(areas.mean())


def _has_ink(relative: Tensor, side: int) -> Tensor:
    """Return whether pictures [M, H, W], enlarged to side x side, have `INK`, [M, side²]."""
    enlarged = torch.nn.functional.interpolate(
        relative[:, None], size=(side, side), mode="bilinear", align_corners=False
    )
    return enlarged.flatten(1) >= INK


def _grid_points(
    side: int, shape: tuple[int, ...], random: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Return the indices of a grid's side² cells in random order, and a random point in each.

    Points have integer coordinates below `COORDINATE_COUNT`, for pictures of `shape` [H, W].
    """
    height, width = shape
    longer = max(height, width)
    order = torch.randperm(side * side, generator=random)
    corner = torch.stack((order % side, side - 1 - order // side), dim=1)
    within = torch.rand(len(order), 2, generator=random)
    points = (corner + within) * (COORDINATE_COUNT / side)
    points *= torch.tensor((width / longer, height / longer))
    return order, points.floor().clamp(max=COORDINATE_COUNT - 1)


def _first_true(has_ink: Tensor, most: int) -> Tensor:
    """Return the indices of the first `most` True values of rows, padded with 0, [M, most]."""
    # Entries are in random order, so the first ones are a fair choice.
    slot = (has_ink.cumsum(1) - 1).where(has_ink, most).clamp(max=most)
    index = torch.arange(has_ink.shape[1]).expand_as(slot)
    return slot.new_zeros(len(slot), most + 1).scatter_(1, slot, index)[:, :most]


def _farthest_points(candidates: Tensor, counts: Tensor, particle_count: int) -> Tensor:
    """Return N of the candidates [M, E, 2], each the farthest from all before it, [M, N, 2].

    Of cloud m the first `counts[m]` candidates are valid.
    """
    across, up = candidates.unbind(-1)
    valid = torch.arange(across.shape[1], device=across.device) < counts[:, None]
    # Invalid candidates are never the farthest, even after all valid ones are chosen.
    distance = torch.where(valid, 1e9, -1.0)
    latest = torch.zeros(len(across), 1, dtype=torch.int64, device=across.device)
    chosen = [latest]
    for _ in range(particle_count - 1):
        away_x = across - across.gather(1, latest)
        away_y = up - up.gather(1, latest)
        distance = torch.minimum(distance, away_x.square_().addcmul_(away_y, away_y))
        latest = distance.argmax(1, keepdim=True)
        chosen.append(latest)
    index = torch.cat(chosen, dim=1)[..., None].expand(-1, -1, 2)
    return candidates.gather(1, index)


def augmented(
    x: Tensor, rotation: float, stretch: float, jitter: float, generator: Randomness
) -> Tensor:
    """Return clouds [B, N, 2] after random rotation, stretch, shear around (0.5, 0.5), noise.

    Their sizes are the fields of `PointClassificationConfig` with these names.
    """
    world_count, particle_count = x.shape[:2]
    if rotation > 0.0 or stretch > 0.0:
        random_numbers = 2.0 * uniform_draws(generator, (world_count, 4), x) - 1.0
        angle = math.radians(rotation) * random_numbers[:, 0]
        cos, sin = angle.cos(), angle.sin()
        wide, high = 1.0 + stretch * random_numbers[:, 1], 1.0 + stretch * random_numbers[:, 2]
        shear = stretch * random_numbers[:, 3]
        across, up = (x - 0.5).unbind(-1)
        across = wide[:, None] * across + shear[:, None] * up
        up = high[:, None] * up
        turned_x = cos[:, None] * across - sin[:, None] * up
        turned_y = sin[:, None] * across + cos[:, None] * up
        x = torch.stack((turned_x, turned_y), dim=-1) + 0.5
    if jitter > 0.0:
        x = x + jitter * normal_draws(generator, (world_count, particle_count, 2), x)
    return x


# Pictures of digits with their classes.

BUILT_IN = ("digits", "mnist")
"""Data sets by name; everything else is a folder of IDX files."""

TEST_FRACTION = 0.2
"""Fraction of each class of scikit-learn's digits that is in the test split."""

SPLIT_SEED = 0
"""Seed of the random choice of these digits."""

IDX_NAMES = {
    "train": ("train-images-idx3-ubyte", "train-labels-idx1-ubyte"),
    "test": ("t10k-images-idx3-ubyte", "t10k-labels-idx1-ubyte"),
}
"""Names of MNIST's files of pictures and of classes, by split; each may also end in .gz."""

MNIST_DOWNLOAD = "import torchvision; torchvision.datasets.MNIST({folder!r}, download=True)"


def load_pictures(
    data: str, split: Split = "train", *, folder: str = "data"
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return the ink of M pictures, in [0, 1], [M, H, W], top row first, and their classes, [M].

    `data` is "digits", "mnist", which is read from `folder`, or a folder of IDX files.
    """
    if data == "digits":
        return _digits(split)
    path = data_path(data, folder)
    images, labels = (read_idx(_idx_file(path, name)) for name in IDX_NAMES[split])
    if images.ndim != 3 or labels.shape != images.shape[:1] or images.size == 0:
        raise NPAError(
            f"the {split} files of {shown(str(path))} must hold pictures [M, H, W] and classes "
            f"[M], got {list(images.shape)} and {list(labels.shape)}: download them again"
        )
    # By a table: the quotients themselves would take eight bytes per pixel.
    ink = (np.arange(256) / 255.0).astype(np.float32)
    return ink[images], labels.astype(np.int64)


def data_path(data: str, folder: str = "data") -> Path:
    """Return the folder of a data set's IDX files; raise NPAError if there is none."""
    path = home_path(folder) / "MNIST" / "raw" if data == "mnist" else home_path(data)
    if data == "mnist" and not os.path.isdir(path):
        raise NPAError(
            f"MNIST is not in the folder {shown(folder)}, and nothing is downloaded unasked: "
            f'python -c "{MNIST_DOWNLOAD.format(folder=folder)}", or name its folder'
        )
    if not os.path.isdir(path):
        raise NPAError(
            f"data must be a known data set or a folder of IDX files, got {shown(data)}: "
            f"{suggest(data, BUILT_IN)}"
        )
    return path


def read_idx(path: Path) -> NDArray[np.uint8]:
    """Return the array in a file of MNIST's IDX format, gzipped or not."""
    name = f"the IDX file {shown(str(path))}"
    with open_regular(path, limit=MAX_IDX, what="the IDX file") as file:
        try:
            is_gzip = file.read(2) == b"\x1f\x8b"
            file.seek(0)
            unpacked = gzip.GzipFile(fileobj=file) if is_gzip else file
            # Two zeros, 8 for unsigned bytes, the number of dimensions, then four bytes per size.
            head = unpacked.read(4)
            dimensions = head[3] if len(head) == 4 else 0
            sizes = unpacked.read(4 * dimensions)
            if head[:3] != b"\0\0\x08" or not 1 <= dimensions <= 4 or len(sizes) < 4 * dimensions:
                raise NPAError(
                    f"{shown(str(path))} must be an IDX file of unsigned bytes, but begins with "
                    f"{head.hex(' ') or 'nothing'}: 00 00 08 and the number of dimensions, 1 to 4"
                )
            shape = tuple(int(size) for size in np.frombuffer(sizes, ">u4"))
            expected = math.prod(shape)
            if expected > MAX_IDX:
                raise NPAError(
                    f"{name} must have at most {MAX_IDX} bytes of data, but its head says "
                    f"{' x '.join(map(str, shape))}: take a part of it"
                )
            values = np.frombuffer(unpacked.read(expected + 1), np.uint8)
        except (OSError, EOFError, zlib.error) as error:
            raise NPAError(f"cannot read {name}: {shown(error)}") from error
    if values.size != expected:
        raise NPAError(
            f"{name} must hold {expected} bytes of data, as its head says "
            f"({' x '.join(map(str, shape))}), but holds {min(values.size, expected)}"
            f"{' and more' if values.size > expected else ''}: download it again"
        )
    return values.reshape(shape)


def _digits(split: Split) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return ink and classes of scikit-learn's digits, as `load_pictures`."""
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
        indices = random.permutation(np.flatnonzero(label == number))
        is_test[indices[: round(TEST_FRACTION * len(indices))]] = True
    chosen = is_test if split == "test" else ~is_test
    return np.asarray(bunch.images, np.float32)[chosen] / 16.0, label[chosen]


def _idx_file(folder: Path, name: str) -> Path:
    """Return the file of this name, gzipped or not, in a folder; raise NPAError without one."""
    for file in (folder / name, folder / f"{name}.gz"):
        if os.path.isfile(file):
            return file
    raise NPAError(f"the folder {shown(str(folder))} must hold MNIST's file {name} or {name}.gz")
