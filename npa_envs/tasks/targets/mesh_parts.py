"""What the readers of mesh files share: the file, its parts, and polygons as triangles."""

from __future__ import annotations

import contextlib
import os
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from npa_envs.atomic_files import read_bytes
from npa_envs.errors import NPAError, shown
from npa_envs.tasks.targets.images import decode_image
from npa_envs.tasks.targets.meshes import MAX_FILE, FloatArray, MeshTexture, Wrap
from npa_envs.tasks.targets.notes import left_out

IntArray = NDArray[np.int64]

MAX_TRIANGLES = 2**23
"""Maximum number of triangles of a mesh."""

_MAX_TEXELS = 2**27
_MAX_WORK = 2**27
_MAX_TRIES = 8  # for each corner of a polygon


class FileTexture(NamedTuple):
    """A texture of a mesh file, and the alpha of its pixels in [0, 1], which meshes have not."""

    texture: MeshTexture
    lowest_alpha: float
    highest_alpha: float


class Part:
    """Triangles of a file, which share a texture or have none."""

    def __init__(
        self,
        vertices: FloatArray,
        faces: IntArray,
        colours: FloatArray | None = None,
        uv: FloatArray | None = None,
        texture: MeshTexture | None = None,
    ) -> None:
        """Take the values of `Mesh`; a corner without a colour or a place in the texture has NaN.

        Parts with the same array of vertices share them.
        """
        self.vertices, self.faces, self.texture = vertices, faces, texture
        shape = (len(faces), 3)
        self.colours = np.full((*shape, 3), np.nan) if colours is None else colours
        self.uv = np.full((*shape, 2), np.nan) if uv is None else uv


class MeshFile:
    """A mesh file that is read: its errors, what is left out of it, and the files it names."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.plain = 0.6
        """Red, green and blue of triangles without a colour."""
        self.profiles = True
        """Whether the colour profiles of textures are applied."""
        self.materials: set[object] = set()
        """The materials of triangles that were read."""
        self._textures: dict[tuple[str, tuple[Wrap, Wrap]], FileTexture | None] = {}
        self._texels = 0

    def error(self, text: str) -> NPAError:
        """Return an error about this file."""
        return NPAError(f"target {shown(str(self.path))} {text}")

    @contextlib.contextmanager
    def reading(self, what: str) -> Iterator[None]:
        """Within it, an exception becomes an error: this file cannot be read as `what`."""
        try:
            with np.errstate(all="ignore"):
                yield
        except NPAError:
            raise
        except Exception as error:
            # Damaged files raise exceptions of many kinds.
            cause = f"{type(error).__name__}: {shown(error)}"
            raise self.error(
                f"cannot be read as {what} ({cause}): save it again, for example as .ply"
            ) from error

    def left_out(self, text: str) -> None:
        """Warn of what was left out."""
        left_out(self.path.name, text)

    def count_left_out(self, count: int, things: str) -> None:
        """Warn of a number of things, such as "corner(s)", that were left out, if any were."""
        if count > 0:
            self.left_out(f"{count} {things.replace('(s)', 's' * (count > 1))}")

    def neighbour(self, name: str) -> bytes | None:
        """Return the bytes of a file that this one names, None if it is not there.

        It lies in this one's folder or below. Another path is often that of another computer: its
        last name is looked for in the folder. Small and capital letters may differ.
        """
        inside = os.path.normpath(name.strip().replace("\\", "/"))
        folder, tries = self.path.parent, [os.path.basename(inside)]
        if not os.path.isabs(inside) and inside.split(os.sep)[0] != os.pardir:
            tries.insert(0, inside)
        for path in (folder / each for each in tries):
            others = sorted(path.parent.iterdir()) if path.name and path.parent.is_dir() else []
            alike = [p for p in others if p.name.casefold() == path.name.casefold()]
            if alike:
                return read_bytes(path if path in alike else alike[0], limit=MAX_FILE)
        return None

    def texture(
        self,
        name: str,
        read: Callable[[], bytes | None] | None = None,
        wrap: tuple[Wrap, Wrap] = ("repeat", "repeat"),
    ) -> FileTexture | None:
        """Return a texture, None after a warning if it is missing or damaged.

        `name` identifies it in this file. `read` returns its bytes; None: it is the `neighbour` of
        this name.
        """
        if (name, wrap) in self._textures:
            return self._textures[name, wrap]
        label, found = os.path.basename(name.replace("\\", "/")) or name, None
        try:
            content = self.neighbour(name) if read is None else read()
            if content is None:
                raise NPAError(f"{shown(label)} is not there: put it beside the file")
            image = decode_image(content, label=label, profile=self.profiles)
            self._texels += image.width * image.height
            if self._texels > _MAX_TEXELS:
                raise NPAError(f"textures must have at most {_MAX_TEXELS} pixels: reduce them")
            pixels = np.array(image)
            lowest, highest = (float(f(pixels[..., 3])) / 255.0 for f in (np.min, np.max))
            found = FileTexture(MeshTexture(pixels[..., :3].copy(), wrap), lowest, highest)
        except NPAError as error:
            self.left_out(f"a texture: {error}")
        self._textures[name, wrap] = found
        return found

    def polygons(
        self, vertices: FloatArray, corners: IntArray, counts: IntArray
    ) -> tuple[IntArray, IntArray]:
        """Return polygons as triangles of places in `corners`, and the polygon of each.

        `corners` are the vertex indices of all polygons, `counts` their numbers of corners.
        """
        self.check_corners(vertices, corners)
        self.count_left_out(int((counts < 3).sum()), "face(s) with fewer than three corners")
        try:
            return triangulated(vertices[corners], counts)
        except NPAError as error:
            raise self.error(str(error)) from error

    def check_corners(self, vertices: NDArray[Any], corners: IntArray) -> None:
        """Raise NPAError unless indices are ones of vertices, and these are finite."""
        lowest, highest = corners.min(initial=0), corners.max(initial=-1)
        if lowest < 0 or highest >= len(vertices):
            raise NPAError(
                f"the triangles of target {shown(str(self.path))} must have corners from 0 to "
                f"{len(vertices) - 1}, got {corners.min()} to {highest}: save it again"
            )
        if not np.isfinite(vertices[corners]).all():
            raise self.error("must hold triangles with finite corners, got others: save it again")


def unit_colours(values: NDArray[np.generic]) -> FloatArray:
    """Return colours in [0, 1] from a file's numbers, [..., any].

    Whole numbers go to 255, or to 65535 where some are above that. So do others if some are above
    2, as float colours are written both ways (case colours_of_vertices_and_faces).
    """
    top = float(np.nan_to_num(values.astype(np.float64)).max(initial=0.0))
    whole = values.dtype.kind in "iu"
    scale = 65535.0 if top > 255.0 else 255.0 if whole or top > 2.0 else 1.0
    colours: FloatArray = (values.astype(np.float64) / scale).clip(0.0, 1.0)
    return colours


def triangulated(points: FloatArray, counts: IntArray) -> tuple[IntArray, IntArray]:
    """Return polygons as triangles: indices of their corners [F, 3], and each one's polygon [F].

    `counts` [P] has the number of corners of each polygon, and `points` [M, 3] all corners in this
    order. Polygons need be neither convex nor flat; ones of fewer than three corners give nothing.
    A polygon of n corners gives n - 2 triangles that turn as it does. One that is not convex is
    cut at its ears (Meisters 1975).
    """
    starts = np.cumsum(counts) - counts
    if int(np.maximum(counts - 2, 0).sum()) > MAX_TRIANGLES:
        raise NPAError(f"must have at most {MAX_TRIANGLES} triangles: simplify it")
    plain, quads = np.flatnonzero(counts == 3), np.flatnonzero(counts == 4)
    triangles, owners = [starts[plain][:, None] + np.arange(3)], [plain, quads, quads]
    corners = starts[quads][:, None] + np.arange(4)
    a, b, c, d = (points[corners[:, k]] for k in range(4))
    # The diagonal from the first corner lies outside where its two triangles turn differently.
    outside = (np.cross(b - a, c - a) * np.cross(c - a, d - a)).sum(axis=1, keepdims=True) < 0
    triangles.append(np.where(outside, corners[:, [0, 1, 3]], corners[:, [0, 1, 2]]))
    triangles.append(np.where(outside, corners[:, [1, 2, 3]], corners[:, [0, 2, 3]]))
    work = 0
    for polygon in np.flatnonzero(counts > 4):
        start, count = int(starts[polygon]), int(counts[polygon])
        flat = _flattened(points[start : start + count])
        if _is_convex(flat):
            fan = np.arange(1, count - 1)
            cut = np.stack((np.zeros_like(fan), fan, fan + 1), axis=1)
        else:
            work += count * (256 + count)
            if work > _MAX_WORK:
                raise NPAError(
                    "has too many polygons that are not convex, or too large ones: save triangles"
                )
            cut = _ears(flat)
        triangles.append(start + cut)
        owners.append(np.full(len(cut), polygon))
    order = np.argsort(np.concatenate(owners), kind="stable")
    return np.concatenate(triangles)[order], np.concatenate(owners)[order]


def _flattened(points: FloatArray) -> FloatArray:
    """Return a polygon [n, 3] in the plane of two axes, [n, 2], counterclockwise."""
    around = points - points[0]
    normal = np.cross(around, np.roll(around, -1, axis=0)).sum(axis=0)
    axis = int(np.abs(normal).argmax())
    flat: FloatArray = around[:, [(axis + 1) % 3, (axis + 2) % 3]]
    flat[:, 0] *= 1.0 if normal[axis] >= 0 else -1.0
    return flat


def _is_convex(flat: FloatArray) -> bool:
    """Return whether a polygon [n, 2] turns left everywhere, and once around."""
    edge = np.roll(flat, -1, axis=0) - flat
    edge = edge[(edge != 0).any(axis=1)]
    after = np.roll(edge, -1, axis=0)
    turn = np.arctan2(
        edge[:, 0] * after[:, 1] - edge[:, 1] * after[:, 0], (edge * after).sum(axis=1)
    )
    return bool((turn >= 0).all() and turn.sum() < 3.0 * np.pi)


def _ears(flat: FloatArray) -> IntArray:
    """Return the triangles [n - 2, 3] of a polygon [n, 2] that is not convex."""
    left, triangles = deque(range(len(flat))), []
    tries, missed = _MAX_TRIES * len(flat), 0
    while len(left) > 2:
        a, b, c = left[0], left[1], left[2]
        # Without an ear, the outline crosses itself or what is left of it is a line.
        if missed > len(left) or tries < 0 or _is_ear(flat[[a, b, c]], flat[left]):
            triangles.append((a, b, c))
            del left[1]
            left.rotate(1)
            missed = 0
        else:
            left.rotate(-1)
            missed, tries = missed + 1, tries - 1
    return np.array(triangles, dtype=np.int64)


def _is_ear(corners: FloatArray, outline: FloatArray) -> bool:
    """Return whether a triangle [3, 2] turns left, and no corner of the outline [n, 2] is in it."""
    along = np.roll(corners, -1, axis=0) - corners
    away = outline[:, None] - corners
    inside = (along[:, 0] * away[..., 1] - along[:, 1] * away[..., 0] >= 0).all(axis=1)
    # Corners at the place of the ear's own are where a hole is joined to the outline.
    inside &= (away != 0).any(axis=2).all(axis=1)
    (ux, uy), (vx, vy) = along[:2]
    return bool(ux * vy - uy * vx > 0 and not inside.any())
