"""Clouds of points from pictures of digits: scikit-learn's, MNIST, or files in MNIST's format."""

from __future__ import annotations

import functools
import gzip
import importlib.util
import math
import os
import zlib
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.atomic_files import home_path, open_regular
from npa_envs.errors import MissingDependencyError, NPAError, shown, suggest
from npa_envs.tasks.targets.notes import tell
from npa_envs.world.cuda_graph import makes_plain_tensors
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


class PointClouds:
    """Points with ink in each of M pictures, and the pictures' classes.

    Points are farthest-point samples of candidates: one random position in each cell of a grid,
    where the picture, enlarged bilinearly, has ink. The grid is refined until there are enough.
    Points are the same on every device. On a CPU those of a picture are chosen when they are first
    asked for. `ink` has shape [M, H, W], `label` [M].
    """

    def __init__(
        self,
        ink: NDArray[np.float32],
        label: NDArray[np.int64],
        particle_count: int,
        *,
        sample_seed: int = 0,
        device: str | torch.device = "cpu",
    ) -> None:
        darkest = ink.max((1, 2))
        if (darkest <= 0).any():
            number = int(np.argmin(darkest))
            raise NPAError(f"every picture must have ink, got an empty one at {number}: remove it")
        self.label = torch.from_numpy(label).to(device)
        """Classes, int64, shape [M]."""
        least, self._most = (factor * particle_count for factor in CANDIDATE_FACTORS)
        self._relative = torch.from_numpy(ink / darkest[:, None, None])
        self._x = torch.empty(len(ink), particle_count, 2, device=device)
        self._is_missing = torch.ones(len(ink), dtype=torch.bool)
        self._side = torch.zeros(len(ink), dtype=torch.int64)
        self._grids: dict[int, tuple[Tensor, Tensor]] = {}
        areas = torch.empty(len(ink))
        random = torch.Generator().manual_seed(sample_seed)
        waiting = torch.arange(len(ink))
        side = 1 << math.ceil(math.log2(2.0 * math.sqrt(least)))
        while len(waiting) > 0:
            self._grids[side] = _grid_points(side, ink.shape[1:], random)
            counts = torch.cat([self._has_ink(p, side).sum(1) for p in self._parts(waiting, side)])
            enough = (counts >= least) | (side >= FINEST_GRID)
            areas[waiting[enough]] = counts[enough] / side**2
            self._side[waiting[enough]] = side
            waiting = waiting[~enough]
            side *= 2
        height, width = ink.shape[1:]
        self.coverage = float(areas.mean()) * (height * width / max(height, width) ** 2)
        """Fraction of the unit square that has ink, averaged over the clouds."""
        if self._x.is_cuda:
            # The host does not know which ones are asked for, and all of them take a moment.
            self._choose(torch.arange(len(ink)))

    @property
    def x(self) -> Tensor:
        """Positions in [0, 1]² [length units], shape [M, N, 2]; y is up.

        A picture's longer side is 1.
        """
        return self.points(torch.arange(len(self.label), device=self.label.device))

    @makes_plain_tensors
    def points(self, index: Tensor) -> Tensor:
        """Return `x` of the pictures `index`, int64 [B], shape [B, N, 2]."""
        if not self._x.is_cuda:
            wanted = torch.zeros_like(self._is_missing).index_fill_(0, index, True)
            self._choose((wanted & self._is_missing).nonzero()[:, 0])
        return self._x[index]

    def _choose(self, index: Tensor) -> None:
        """Choose the points of the pictures `index`, int64 [B]."""
        device = self._x.device
        for side, (cells, points) in self._grids.items():
            for part in self._parts(index[self._side[index] == side], side):
                has_ink = self._has_ink(part, side)[:, cells]
                candidates = points[_first_true(has_ink, self._most)].to(device)
                counts = has_ink.sum(1).to(device)
                choose = _farthest_points if self._x.is_cuda else _farthest_one_by_one
                chosen = choose(candidates, counts, self._x.shape[1])
                self._x[part.to(device)] = (chosen + 0.5) / COORDINATE_COUNT
        self._is_missing[index] = False

    def _parts(self, index: Tensor, side: int) -> tuple[Tensor, ...]:
        """Return indices in batches with grids of side² cells that memory and caches hold."""
        most = min(BATCH_SIZES[self._x.device.type], CELLS_PER_BATCH // side**2)
        return torch.split(index, max(1, most)) if len(index) else ()

    def _has_ink(self, index: Tensor, side: int) -> Tensor:
        """Return whether pictures, enlarged to side x side, have `INK`, [B, side²]."""
        enlarged = torch.nn.functional.interpolate(
            self._relative[index, None], size=(side, side), mode="bilinear", align_corners=False
        )
        return enlarged.flatten(1) >= INK


@functools.lru_cache(CACHED_DATA_SETS)
@makes_plain_tensors
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

    `load_pictures` explains `data`, `split`, `folder`. Results are cached.
    """
    ink, label = load_pictures(data, split, folder=folder)
    if data != "digits":
        height, width = ink.shape[1:]
        tell(
            f"{shown(data)[1:-1]}: {len(ink)} pictures of {width} x {height} to {split}, "
            f"{len(np.unique(label))} classes"
        )
    return PointClouds(ink, label, particle_count, sample_seed=sample_seed, device=device)


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


def _farthest_one_by_one(candidates: Tensor, counts: Tensor, particle_count: int) -> Tensor:
    """Return the same as `_farthest_points`, in less time on a CPU."""
    clouds = []
    for cloud, count in zip(candidates.numpy(), counts.tolist(), strict=True):
        points = cloud[:count]
        square = np.square(points).sum(1)
        # |p|² + |q|² - 2 pq as a product: all of its sums are integers below 2²⁴, so exact.
        rows = np.column_stack((points, np.ones_like(square), square))
        columns = np.stack((*(-2.0 * points.T), square, np.ones_like(square)))
        distance, chosen = np.full_like(square, np.inf), [0]
        for _ in range(particle_count - 1):
            np.minimum(distance, rows[chosen[-1]] @ columns, out=distance)
            chosen.append(int(distance.argmax()))
        clouds.append(torch.from_numpy(points[chosen]))
    return torch.stack(clouds)


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
    spec = importlib.util.find_spec("sklearn")
    try:
        # The file by itself, as the import of scikit-learn takes seconds.
        file = Path((spec and spec.origin) or "").parent / "datasets" / "data" / "digits.csv.gz"
        table = np.loadtxt(file, np.float32, delimiter=",")
    except OSError as error:
        raise MissingDependencyError(
            "data='digits' needs scikit-learn: pip install 'npa-envs[points]', or give the folder "
            "of MNIST's IDX files"
        ) from error
    label = table[:, 64].astype(np.int64)
    random = np.random.default_rng(SPLIT_SEED)
    is_test = np.zeros(len(label), bool)
    for number in range(10):
        indices = random.permutation(np.flatnonzero(label == number))
        is_test[indices[: round(TEST_FRACTION * len(indices))]] = True
    chosen = is_test if split == "test" else ~is_test
    return table[chosen, :64].reshape(-1, 8, 8) / 16.0, label[chosen]


def _idx_file(folder: Path, name: str) -> Path:
    """Return the file of this name, gzipped or not, in a folder; raise NPAError without one."""
    for file in (folder / name, folder / f"{name}.gz"):
        if os.path.isfile(file):
            return file
    raise NPAError(f"the folder {shown(str(folder))} must hold MNIST's file {name} or {name}.gz")
