"""Mesh files of Wavefront: OBJ, and the materials in MTL.

trimesh counts negative indices from the end of the whole file (case
obj_relative_indices_between_vertices), cuts polygons as if they were convex, and fails with texture
coordinates but no texture (case mesh_one_plain_material).
"""

from __future__ import annotations

import math
import re
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from npa_envs.errors import shown
from npa_envs.tasks.targets.mesh_parts import MeshFile, Part, unit_colours
from npa_envs.tasks.targets.meshes import FloatArray, Wrap

_NOT_DRAWN = {
    "p": ("element of points", "elements of points"),
    "l": ("element of lines", "elements of lines"),
    "curv": ("free-form curve", "free-form curves"),
    "surf": ("free-form surface", "free-form surfaces"),
}


@dataclass
class Material:
    """What an MTL file says of the colour of a material."""

    colour: list[float] = field(default_factory=list)
    """Red, green and blue of `Kd`, sRGB in [0, 1]; empty if it is not given."""
    emitted: list[float] = field(default_factory=list)
    """Those of `Ke`."""
    picture: str = ""
    """The file of `map_Kd`; empty if there is none."""
    wrap: Wrap = "repeat"
    scale: tuple[float, float] = (1.0, 1.0)
    """Texture coordinates are multiplied by this first."""
    offset: tuple[float, float] = (0.0, 0.0)
    """Then this is added to them."""
    transparent: bool = False


@dataclass
class Rows:
    """What the lines of an OBJ file hold."""

    vertices: list[list[float]] = field(default_factory=list)
    colours: list[list[float]] = field(default_factory=list)
    """Red, green and blue of each vertex; NaN: none."""
    uv: list[list[float]] = field(default_factory=list)
    corners: list[int] = field(default_factory=list)
    """Vertex indices of the corners of all polygons."""
    places: list[int] = field(default_factory=list)
    """Index in `uv` of each of these corners, -1 for none."""
    counts: list[int] = field(default_factory=list)
    """Number of corners of each polygon."""
    materials: list[int] = field(default_factory=list)
    """Index in `names` of each polygon's material."""
    names: dict[str, int] = field(default_factory=lambda: {"": 0})
    material: int = 0
    """The index of the polygons that follow."""
    libraries: list[str] = field(default_factory=list)
    not_drawn: Counter[str] = field(default_factory=Counter)


def read_obj(file: MeshFile, content: bytes) -> list[Part]:
    """Return the parts of an OBJ file, one for each material."""
    rows = Rows()
    for number, words in enumerate(_lines(content), 1):
        try:
            _read_line(rows, words)
        except (ValueError, IndexError) as error:
            raise file.error(
                f"has a line that cannot be read, {number}: {shown(' '.join(words))} ({error}): "
                "save it again"
            ) from error
    for word, (one, more) in _NOT_DRAWN.items():
        file.count_left_out(rows.not_drawn[word], one, more)
    vertices = np.array(rows.vertices, dtype=np.float64).reshape(-1, 3)
    corners, uv_indices, counts, of_polygons = (
        np.array(each, dtype=np.int64)
        for each in (rows.corners, rows.places, rows.counts, rows.materials)
    )
    if uv_indices.size and not -1 <= uv_indices.min() <= uv_indices.max() < len(rows.uv):
        raise file.error(
            f"must have indices of texture coordinates from 1 to {len(rows.uv)}, got others: save "
            "it again"
        )
    places, polygons = file.polygons(vertices, corners, counts)
    faces, of_faces = corners[places], of_polygons[polygons]
    shades = unit_colours(np.array(rows.colours, dtype=np.float64).reshape(-1, 3))
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


def _lines(content: bytes) -> list[list[str]]:
    """Return the words of each line of a text, without comments; long lines are joined."""
    code = "utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    text = content.decode(code, errors="replace").replace("\r\n", "\n").replace("\r", "\n")
    lines = text.replace("\\\n", " ").split("\n")
    return [(re.sub(r"(^|\s)#.*", "", row) if "#" in row else row).split() for row in lines]


def _read_line(rows: Rows, words: list[str]) -> None:
    """Add what one line holds."""
    word = words[0] if words else ""
    if word == "v":
        row = [float(each) for each in words[1:]]
        # Four numbers are homogeneous coordinates, six or more have a colour.
        scale = row[3] if len(row) == 4 and row[3] else 1.0
        rows.vertices.append([row[0] / scale, row[1] / scale, row[2] / scale])
        rows.colours.append(row[3:6] if len(row) >= 6 else [math.nan] * 3)
    elif word == "vt":
        rows.uv.append([float(words[1]), float(words[2]) if len(words) > 2 else 0.0])
    elif word in ("f", "fo"):
        for corner in words[1:]:
            vertex, uv, *_ = [*corner.split("/"), ""]
            rows.corners.append(_index(vertex, len(rows.vertices)))
            rows.places.append(_index(uv, len(rows.uv)) if uv else -1)
        rows.counts.append(len(words) - 1)
        rows.materials.append(rows.material)
    elif word == "usemtl":
        rows.material = rows.names.setdefault(" ".join(words[1:]), len(rows.names))
    elif word == "mtllib":
        rows.libraries.append(" ".join(words[1:]))
    elif word in _NOT_DRAWN:
        rows.not_drawn[word] += 1


def _index(text: str, count: int) -> int:
    """Return an index from 0; negative ones are counted back from the last row before the line."""
    index = int(text)
    if index == 0 or index < -count:
        raise ValueError(f"index {index} of {count} rows")
    return index - 1 if index > 0 else count + index


def _apply(file: MeshFile, material: Material, part: Part, uv: FloatArray) -> None:
    """Give the colour and texture of its material to a part with these texture coordinates."""
    colour, texture = material.colour, None
    if material.picture:
        name, wrap = material.picture, material.wrap
        texture = file.texture(name, lambda: file.neighbour(name), (wrap, wrap))
    transparent = material.transparent
    if not any(colour) and any(material.emitted):
        file.left_out("light: what a black material emits is read as its colour")
        colour = material.emitted
    if texture is not None:
        transparent |= texture.lowest_alpha < 1.0
        part.texture = texture.texture
        # In this format v goes up.
        part.uv = (uv * material.scale + material.offset) * (1.0, -1.0) + (0.0, 1.0)
        if np.isfinite(part.colours).any():
            file.left_out("colours of corners where there is a texture")
        if colour and not any(colour):
            file.left_out("black of a material with a texture, as it would hide that")
        part.colours = np.full(part.colours.shape, colour if any(colour) else 1.0)
    elif colour:
        part.colours = np.where(np.isnan(part.colours), colour, part.colours)
    if transparent:
        file.left_out("transparency: all is opaque")


def _read_materials(file: MeshFile, libraries: list[str]) -> dict[str, Material]:
    """Return the materials in the MTL files that an OBJ file names."""
    materials: dict[str, Material] = {}
    for library in dict.fromkeys(libraries):
        # A line may name one file with spaces, or several files.
        for name in [library] if file.neighbour(library) is not None else library.split():
            content = file.neighbour(name)
            if content is None:
                file.left_out(f"the materials of {shown(name)}, which is not there")
                continue
            material = Material()
            for words in _lines(content):
                if words[:1] == ["newmtl"]:
                    material = materials.setdefault(" ".join(words[1:]), Material())
                elif words:
                    try:
                        _read_property(material, words[0].lower(), words[1:])
                    except (ValueError, IndexError):
                        file.left_out(f"{shown(' '.join(words))} of {shown(name)}")
    return materials


def _read_property(material: Material, word: str, words: list[str]) -> None:
    """Read a line of an MTL file."""
    if word in ("kd", "ke"):
        row = [min(max(float(each), 0.0), 1.0) for each in words[:3]]
        row = row * 3 if len(row) == 1 else row
        material.colour, material.emitted = (
            (row, material.emitted) if word == "kd" else (material.colour, row)
        )
    elif word in ("d", "tr"):
        material.transparent |= float(words[-1]) != (1.0 if word == "d" else 0.0)
    elif word == "map_d":
        material.transparent = True
    elif word == "map_kd":
        while words[0].startswith("-"):
            option, words, numbers = words[0].lower(), words[1:], []
            # The last numbers of an option may be left out.
            while words and len(numbers) < {"-s": 3, "-o": 3, "-t": 3, "-mm": 2}.get(option, 0):
                if not re.fullmatch(r"[-+]?[\d.]+(e[-+]?\d+)?", words[0], re.IGNORECASE):
                    break
                numbers.append(float(words.pop(0)))
            if option == "-s":
                material.scale = ([*numbers, 1.0][0], [*numbers, 1.0, 1.0][1])
            elif option == "-o":
                material.offset = ([*numbers, 0.0][0], [*numbers, 0.0, 0.0][1])
            elif option not in ("-t", "-mm"):
                value = words.pop(0).lower()
                if option == "-clamp":
                    material.wrap = "clamp" if value == "on" else "repeat"
        material.picture = " ".join(words)
