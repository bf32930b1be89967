"""Writers of 3D worlds for other programs: point clouds (PLY), Gaussian splats (PLY, .splat)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from npa_envs.atomic_files import write_bytes
from npa_envs.errors import NPAError
from npa_envs.tasks.gaussian_outputs import HARMONIC_0, Gaussians

MIN_OPACITY = 1e-6
"""Opacities are clipped to [MIN_OPACITY, 1 - MIN_OPACITY], so that their logits are finite."""


def write_points(path: str | Path, x: Tensor, gaussians: Gaussians) -> None:
    """Write one world, x [1, N, 3], as a binary PLY file: x, y, z and red, green, blue."""
    positions = _checked(x)
    rows = np.zeros(len(positions), np.dtype([("position", "<f4", 3), ("colour", "u1", 3)]))
    rows["position"], rows["colour"] = positions, (255.0 * _colours(gaussians)).round()
    header = _ply_header(len(rows), float=("x", "y", "z"), uchar=("red", "green", "blue"))
    write_bytes(path, header + rows.tobytes())


def write_gaussians(path: str | Path, x: Tensor, gaussians: Gaussians) -> None:
    """Write one world, x [1, N, 3], as a PLY file of 3D Gaussian splatting (Kerbl et al. 2023).

    Scales are logarithms, opacities logits, colours spherical harmonics of degree 0 and 1.
    """
    positions = _checked(x)
    harmonics = _numpy(gaussians.colours)
    opacity = _numpy(gaussians.opacities).clip(MIN_OPACITY, 1.0 - MIN_OPACITY)
    columns = {
        ("x", "y", "z"): positions,
        ("nx", "ny", "nz"): np.zeros_like(positions),
        tuple(f"f_dc_{k}" for k in range(3)): harmonics[:, 0],
        tuple(f"f_rest_{k}" for k in range(9)): harmonics[:, 1:].transpose(0, 2, 1).reshape(-1, 9),
        ("opacity",): np.log(opacity / (1.0 - opacity))[:, None],
        tuple(f"scale_{k}" for k in range(3)): np.log(_numpy(gaussians.scales)),
        tuple(f"rot_{k}" for k in range(4)): _rotations(gaussians),
    }
    table = np.concatenate(list(columns.values()), axis=1).astype("<f4")
    header = _ply_header(len(table), float=[name for names in columns for name in names])
    write_bytes(path, header + table.tobytes())


def write_splat(path: str | Path, x: Tensor, gaussians: Gaussians) -> None:
    """Write one world, x [1, N, 3], as a `.splat` file for viewers in browsers.

    A particle takes 32 bytes: position and scale as float32; red, green, blue and opacity as bytes;
    the rotation (w, x, y, z) as bytes around 128. The largest and most opaque come first. Colours
    are averages over viewing directions.
    """
    positions = _checked(x)
    scales, opacities = _numpy(gaussians.scales), _numpy(gaussians.opacities)
    layout = np.dtype(
        [("position", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)]
    )
    rows = np.zeros(len(positions), layout)
    rows["position"], rows["scale"] = positions, scales
    rgba = np.concatenate((_colours(gaussians), opacities[:, None]), axis=1)
    rows["rgba"] = (255.0 * rgba).round()
    rows["rotation"] = (128.0 * _rotations(gaussians) + 128.0).round().clip(0, 255)
    order = np.argsort(-scales.prod(axis=1) * opacities, kind="stable")
    write_bytes(path, rows[order].tobytes())


def _ply_header(count: int, **properties: Sequence[str]) -> bytes:
    """Return the header of a binary PLY file of `count` rows; `properties`: columns by type."""
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    lines += [f"property {kind} {name}" for kind, names in properties.items() for name in names]
    return "\n".join((*lines, "end_header\n")).encode()


def _checked(x: Tensor) -> NDArray[np.float32]:
    if x.ndim != 3 or x.shape[0] != 1 or x.shape[2] != 3:
        raise NPAError(
            f"x must be the positions of one 3D world, [1, N, 3], got {tuple(x.shape)}: "
            "write one world at a time, x[:1]"
        )
    return _numpy(x)


def _numpy(values: Tensor) -> NDArray[np.float32]:
    """Return the values of the first world of a tensor [B, ...], float32, shape [...]."""
    array: NDArray[np.float32] = values.detach()[0].float().cpu().numpy()
    return array


def _colours(gaussians: Gaussians) -> NDArray[np.float32]:
    """Return red, green and blue in [0, 1], averaged over viewing directions, [N, 3]."""
    return (HARMONIC_0 * _numpy(gaussians.colours)[:, 0] + 0.5).clip(0.0, 1.0)


def _rotations(gaussians: Gaussians) -> NDArray[np.float32]:
    """Return unit quaternions (w, x, y, z), [N, 4]; zero quaternions become (1, 0, 0, 0)."""
    rotations = _numpy(gaussians.quaternions).copy()
    rotations[~rotations.any(axis=1), 0] = 1.0
    unit: NDArray[np.float32] = rotations / np.linalg.norm(rotations, axis=1, keepdims=True)
    return unit
