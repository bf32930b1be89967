"""Mesh files of Wavefront: OBJ, and the materials in MTL.

trimesh counts negative indices from the end of the file (case
obj_relative_indices_between_vertices), cuts polygons as if they were convex, and fails with texture
coordinates but no texture (case mesh_one_plain_material).
"""

from __future__ import annotations

import math
import re
from collections import Counter

import numpy as np

from npa_envs.errors import shown
from npa_envs.tasks.targets.mesh_parts import MeshFile, Part, unit_colours
from npa_envs.tasks.targets.meshes import FloatArray

_NOT_DRAWN = {"p": "element(s) of points", "l": "element(s) of lines", "curv": "free-form curve(s)"}
_NOT_DRAWN["surf"] = "free-form surface(s)"
_OPTIONS = re.compile(r"(-\S+\s+((on|off|[rgbmlz]|[-+]?[.\d]\S*)\s+)*)*", re.IGNORECASE)
"""The options before the file of a texture."""


class _Rows:
    """What the lines of an OBJ file hold."""

    def __init__(self) -> None:
        self.vertices: list[list[float]] = []
        self.colours: list[list[float]] = []
        """Red, green and blue of each vertex; NaN: none."""
        self.uv: list[list[float]] = []
        self.corners: list[int] = []
        """Vertex indices of the corners of all polygons."""
        self.places: list[int] = []
        """Index in `uv` of each of these corners, -1 for none."""
        self.counts: list[int] = []
        """Number of corners of each polygon."""
        self.materials: list[int] = []
        """Index in `names` of each polygon's material."""
        self.names: dict[str, int] = {"": 0}
        self.material = 0
        self.libraries: list[str] = []
        self.not_drawn: Counter[str] = Counter()

    def read_line(self, words: list[str]) -> None:
        """Add what one line holds."""
        word = words[0]
        if word == "v":
            row = [float(each) for each in words[1:]]
            # Four numbers are homogeneous coordinates, six or more have a colour.
            scale = row[3] if len(row) == 4 and row[3] else 1.0
            self.vertices.append([row[0] / scale, row[1] / scale, row[2] / scale])
            self.colours.append(row[3:6] if len(row) >= 6 else [math.nan] * 3)
        elif word == "vt":
            self.uv.append([float(words[1]), float(words[2]) if len(words) > 2 else 0.0])
        elif word in ("f", "fo"):
            for corner in words[1:]:
                vertex, uv, *_ = [*corner.split("/"), ""]
                self.corners.append(_index(vertex, len(self.vertices)))
                self.places.append(_index(uv, len(self.uv)) if uv else -1)
            self.counts.append(len(words) - 1)
            self.materials.append(self.material)
        elif word == "usemtl":
            self.material = self.names.setdefault(" ".join(words[1:]), len(self.names))
        elif word == "mtllib":
            self.libraries.append(" ".join(words[1:]))
        elif word in _NOT_DRAWN:
            self.not_drawn[word] += 1


def _index(text: str, count: int) -> int:
    """Return an index from 0; negative ones count back from the last row before the line."""
    index = int(text)
    if index == 0 or index < -count:
        raise ValueError(f"index {index} after {count} rows")
    return index - 1 if index > 0 else count + index


def _lines(content: bytes) -> list[list[str]]:
    """Return the words of the lines of a text, without comments; continued lines are joined."""
    code = "utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    text = re.sub(r"\r\n?", "\n", content.decode(code, errors="replace")).replace("\\\n", " ")
    lines = (re.sub(r"(^|\s)#.*", "", row) if "#" in row else row for row in text.split("\n"))
    return [line.split() for line in lines]


def read_obj(file: MeshFile, content: bytes) -> list[Part]:
    """Return the parts of an OBJ file, one for each material."""
    rows = _Rows()
    for number, words in enumerate(_lines(content), 1):
        try:
            if words:
                rows.read_line(words)
        except (ValueError, IndexError) as error:
            line = f"line {number}, {shown(' '.join(words))}"
            raise file.error(f"has an unreadable {line} ({error}): save it again") from error
    for word, things in _NOT_DRAWN.items():
        file.count_left_out(rows.not_drawn[word], *(things.replace("(s)", s) for s in ("", "s")))
    vertices, shades = (
        np.array(each, dtype=np.float64).reshape(-1, 3) for each in (rows.vertices, rows.colours)
    )
    corners, uv_indices, counts, of_polygons = (
        np.array(each, dtype=np.int64)
        for each in (rows.corners, rows.places, rows.counts, rows.materials)
    )
    if uv_indices.max(initial=-1) >= len(rows.uv):
        raise file.error(
            f"has more texture coordinates in faces than its {len(rows.uv)} rows of vt"
        )
    places, polygons = file.polygons(vertices, corners, counts)
    faces, of_faces, shades = corners[places], of_polygons[polygons], unit_colours(shades)
    uv = np.array([*rows.uv, [np.nan] * 2], dtype=np.float64)
    materials = _read_materials(file, rows.libraries)
    parts = []
    for name, index in rows.names.items():
        chosen = of_faces == index
        if chosen.any():
            part = Part(vertices, faces[chosen], shades[faces[chosen]])
            if name in materials:
                file.materials.add(name)
                _apply(file, materials[name], part, uv[uv_indices[places[chosen]]])
            elif name:
                file.left_out(f"the material {shown(name)}, which no .mtl file here has")
            parts.append(part)
    return parts


def _read_materials(file: MeshFile, libraries: list[str]) -> dict[str, dict[str, list[str]]]:
    """Return the words of each property of the materials in the MTL files of an OBJ file."""
    materials: dict[str, dict[str, list[str]]] = {}
    for library in dict.fromkeys(libraries):
        # A line may name one file with spaces, or several files.
        for name in [library] if file.neighbour(library) is not None else library.split():
            content, material = file.neighbour(name), {}
            if content is None:
                file.left_out(f"the materials of {shown(name)}, which is not there")
            for words in filter(None, _lines(content or b"")):
                if words[0] == "newmtl":
                    material = materials.setdefault(" ".join(words[1:]), {})
                else:
                    material[words[0].lower()] = words[1:]
    return materials


def _apply(file: MeshFile, material: dict[str, list[str]], part: Part, uv: FloatArray) -> None:
    """Give the colour and texture of its material to a part with these texture coordinates."""
    try:
        # One number stands for all three.
        colour, light = (
            [min(max(float(word), 0.0), 1.0) for word in (3 * material.get(key, []))[:3]]
            for key in ("kd", "ke")
        )
        alpha = [
            float(words[-1]) - k
            for k, words in ((1, material.get("d")), (0, material.get("tr")))
            if words
        ]
    except ValueError:
        file.left_out("colours that are no numbers")
        colour, light, alpha = [], [], []
    texture, line = None, " ".join(material.get("map_kd", []))
    name = _OPTIONS.sub("", line, count=1)
    if name:
        texture = file.texture(name, lambda: file.neighbour(name), ("repeat", "repeat"))
    if texture is not None:
        part.texture = texture.texture
        # In this format v goes up.
        part.uv = uv * (1.0, -1.0) + (0.0, 1.0)
        if name != line:
            file.left_out(f"options of the texture {shown(line)}")
        if np.isfinite(part.colours).any():
            file.left_out("colours of corners where there is a texture")
        if colour and not any(colour):
            file.left_out("black of a material with a texture, as it would hide that")
        part.colours = np.full(part.colours.shape, colour if any(colour) else 1.0)
    elif colour:
        if any(light) and not any(colour):
            file.left_out("light: what a black material emits is read as its colour")
            colour = light
        part.colours = np.where(np.isnan(part.colours), colour, part.colours)
    if any(alpha) or "map_d" in material or (texture is not None and texture.lowest_alpha < 1.0):
        file.left_out("transparency: all is opaque")
