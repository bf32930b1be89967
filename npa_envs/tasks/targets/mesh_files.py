"""Mesh files as meshes with colours and textures; in this file PLY, OFF and STL."""

from __future__ import annotations

import io
import re
import struct
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from npa_envs.atomic_files import read_bytes
from npa_envs.errors import NPAError, importing, shown
from npa_envs.tasks.targets.gltf_files import read_gltf
from npa_envs.tasks.targets.mesh_parts import (
    MAX_TRIANGLES,
    IntArray,
    MeshFile,
    Part,
    strip,
    unit_colours,
)
from npa_envs.tasks.targets.meshes import MAX_FILE, FloatArray, Mesh, Texture
from npa_envs.tasks.targets.obj_files import read_obj

_MAX_UV = 1e6
_SIZE_RANGE = 1e-30, 1e30
_MIN_AREA = 1e-12


def read_mesh(path: Path) -> Mesh:
    """Return the mesh in a file, as large as there; grey where the file has no colours.

    What is left out of it is told by `left_out`.
    """
    content = read_bytes(path, limit=MAX_FILE, what="target")
    file = MeshFile(path)
    if not content:
        raise file.error("is an empty file (0 bytes): save the mesh again")
    try:
        with np.errstate(all="ignore"):
            return _joined(file, _READERS[path.suffix.lower()](file, content))
    except NPAError:
        raise
    except Exception as error:
        # Damaged files raise exceptions of many kinds.
        raise file.error(
            f"cannot be read as a mesh ({type(error).__name__}: {shown(error)}): save it again, "
            "for example as .ply or .glb"
        ) from error


def _joined(file: MeshFile, parts: list[Part]) -> Mesh:
    """Return the mesh of a file's parts."""
    total = sum(len(part.faces) for part in parts)
    if not total:
        raise file.error("must hold triangles, got none: give a surface, not a point cloud")
    if total > MAX_TRIANGLES:
        raise file.error(f"must have at most {MAX_TRIANGLES} triangles, got {total}: simplify it")
    starts: dict[int, int] = {}
    vertices: list[FloatArray] = []
    textures: list[Texture] = []
    faces, colours, uv, texture_of_face = [], [], [], []
    for part in parts:
        file.check_corners(part.vertices, part.faces)
        if id(part.vertices) not in starts:
            starts[id(part.vertices)] = sum(map(len, vertices))
            vertices.append(part.vertices)
        index, place = -1, np.zeros((len(part.faces), 3, 2)) if part.uv is None else part.uv
        if part.texture is not None and len(part.faces):
            if not any(part.texture is other for other in textures):
                textures.append(part.texture)
            index = [part.texture is other for other in textures].index(True)
        placed = np.isfinite(place).all(axis=(1, 2))
        file.count_left_out(
            int((~placed).sum()) if index >= 0 else 0,
            "triangle's texture, as it has no texture coordinates",
            "triangles' texture, as they have no texture coordinates",
        )
        given = np.full((len(part.faces), 3, 3), np.nan) if part.colours is None else part.colours
        textured = placed & (index >= 0)
        colours.append(np.where(textured[:, None, None] & np.isnan(given), 1.0, given))
        faces.append(part.faces + starts[id(part.vertices)])
        uv.append(np.where(placed[:, None, None], place, 0.0).clip(-_MAX_UV, _MAX_UV))
        texture_of_face.append(np.where(textured, index, -1))
    colour = np.concatenate(colours)
    plain = ~np.isfinite(colour).all(axis=(1, 2))
    colour[plain] = file.plain
    if plain.any():
        which = "the file has none" if plain.all() else f"{plain.sum()} triangles have none"
        shade = "white" if file.plain == 1.0 else "grey"
        file.left_out(f"colours, as {which}: {'all is' if plain.all() else 'they are'} {shade}")
    looks = [f"{total} triangles"]
    if len(textures) == 1:
        looks.append("texture {1} x {0}".format(*textures[0].pixels.shape))
    elif textures:
        looks.append(f"{len(textures)} textures")
    if file.materials:
        looks.append(f"{len(file.materials)} material" + "s" * (len(file.materials) > 1))
    elif not textures:
        looks.append("no colours" if plain.all() else "colours of corners or faces")
    mesh = Mesh(
        np.concatenate(vertices),
        np.concatenate(faces),
        colour.clip(0.0, 1.0),
        np.concatenate(uv) if textures else None,
        np.concatenate(texture_of_face) if textures else None,
        tuple(textures),
        summary=f"{file.path.name}: {', '.join(looks)}",
    )
    _check_size(file, mesh.vertices, mesh.faces)
    return mesh


def _check_size(file: MeshFile, vertices: FloatArray, faces: IntArray) -> None:
    """Raise NPAError unless a file's triangles are of a usual size, and not all flat."""
    used = vertices[np.unique(faces)]
    size = float((used.max(axis=0) / 2 - used.min(axis=0) / 2).max()) * 2
    if not _SIZE_RANGE[0] <= size <= _SIZE_RANGE[1] or np.abs(used).max() > _SIZE_RANGE[1]:
        raise file.error(
            f"must lie within {_SIZE_RANGE[1]:g} of the origin and be of a size of at least "
            f"{_SIZE_RANGE[0]:g}, got a size of {size:.3g}: scale it"
        )
    a, b, c = ((vertices[faces[:, k]] - used.min(axis=0)) / size for k in range(3))
    if np.linalg.norm(np.cross(b - a, c - a), axis=1).max() < _MIN_AREA:
        raise file.error(
            "must have a surface, but the corners of every triangle lie on a line: give triangles "
            "with an area"
        )


# PLY. trimesh reads no lists of different lengths from bytes, cuts polygons as if they were convex,
# and knows neither other names of colours nor polygons' own (case colours_of_vertices_and_faces).

_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "int64": "i8", "uint64": "u8", "float16": "f2", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_PLY_UV = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))


class PlyProperty(NamedTuple):
    """The values of one property in all rows of a PLY element."""

    values: NDArray[Any]
    """The values of all rows, one after another, of the type that the file declares."""
    counts: IntArray
    """The number of values of each row; other numbers than 1 if the property is a list."""


def read_ply(content: bytes) -> tuple[dict[str, dict[str, PlyProperty]], list[str]]:
    """Return the properties of each element of a PLY file, by their names, and its comments."""
    end = re.search(rb"[\r\n]end_header[ \t]*(\r\n|\n|\r)", content)
    if not content.startswith(b"ply") or end is None:
        raise ValueError("it does not begin with ply and a whole header")
    order, comments, data, position = "", [], content[end.end() :], 0
    layout: list[tuple[str, int, list[tuple[str, str, str]]]] = []
    for line in content[: end.start()].decode("latin-1").splitlines()[1:]:
        word, *rest = line.split() or [""]
        if word == "format":
            order = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}[rest[0]]
        elif word == "comment":
            comments.append(" ".join(rest))
        elif word == "element":
            layout.append((rest[0], int(rest[1]), []))
        elif word == "property":
            counted, kind = rest[1:3] if rest[0] == "list" else ("", rest[0])
            layout[-1][2].append((rest[-1], counted, kind))
    if order == "=":
        with warnings.catch_warnings():
            # What is no number is a warning.
            warnings.simplefilter("error")
            data = np.fromstring(data.decode("latin-1"), dtype=np.float64, sep=" ").tobytes()
    elements = {}
    for name, count, properties in layout:
        elements[name], position = _read_rows(data, position, count, properties, order)
    return elements, comments


def _read_rows(
    data: bytes, start: int, count: int, properties: list[tuple[str, str, str]], order: str
) -> tuple[dict[str, PlyProperty], int]:
    """Return the rows of a PLY element, which begin at a byte, and the byte where they end.

    Properties have a name, the type of a list's count or "", and a type. In the order "=" all are
    stored as float64.
    """

    def stored(kind: str) -> np.dtype[Any]:
        return np.dtype(np.float64 if order == "=" else order + _PLY_TYPES[kind])

    values: dict[str, NDArray[Any]] = {key: np.empty(0) for key, _, _ in properties}
    counts = {key: np.empty(0, dtype=np.int64) for key in values}
    lengths: dict[str, int] = {}
    fields: list[Any] = []
    for key, counted, kind in properties if count else []:
        if counted:
            place = start + np.dtype(fields).itemsize
            lengths[key] = int(np.frombuffer(data, stored(counted), 1, place)[0])
            fields.append((f"{key}, count", stored(counted)))
        fields.append((key, stored(kind), (lengths.get(key, 1),)))
    row, end = np.dtype(fields), start
    if count and start + count * row.itemsize <= len(data):
        rows = np.frombuffer(data, row, count, start)
        end = start + rows.nbytes
        if any((rows[f"{key}, count"] != length).any() for key, length in lengths.items()):
            end = start
        values = {key: rows[key].reshape(-1) for key in values}
        counts = {key: np.full(count, lengths.get(key, 1)) for key in values}
    if count and end == start:
        # Lists of different lengths.
        plan = [
            (
                key,
                struct.Struct(order + stored(counted).char.replace("l", "q")) if counted else None,
                stored(kind),
            )
            for key, counted, kind in properties
        ]
        pieces: dict[str, list[bytes]] = {key: [] for key in values}
        sizes: dict[str, list[int]] = {key: [] for key in values}
        for _ in range(count):
            for key, counter, kind_stored in plan:
                length = 1
                if counter is not None:
                    length = int(counter.unpack_from(data, end)[0])
                    end += counter.size
                sizes[key].append(length)
                pieces[key].append(data[end : end + length * kind_stored.itemsize])
                end += length * kind_stored.itemsize
                if length < 0 or end > len(data):
                    raise ValueError("it ends too early")
        values = {key: np.frombuffer(b"".join(pieces[key]), kind) for key, _, kind in plan}
        counts = {key: np.array(sizes[key]) for key in values}
    return {
        key: PlyProperty(values[key].astype(_PLY_TYPES[kind]), counts[key])
        for key, _, kind in properties
    }, end


def ply_colours(file: MeshFile, element: dict[str, PlyProperty]) -> FloatArray | None:
    """Return the colours of the rows of an element, [n, 3], None if it has none."""
    for names in ("red green blue", "diffuse_red diffuse_green diffuse_blue", "r g b"):
        if all(name in element for name in names.split()):
            if "alpha" in element and (unit_colours(element["alpha"].values) < 1.0).any():
                file.left_out("transparency: all is opaque")
            return unit_colours(np.stack([element[name].values for name in names.split()], axis=1))
    return None


def _read_ply_parts(file: MeshFile, content: bytes) -> list[Part]:
    """Return the parts of a PLY file, one for each texture."""
    elements, comments = read_ply(content)
    vertex, face, strips = (elements.get(key, {}) for key in ("vertex", "face", "tristrips"))
    vertices = np.stack([vertex[key].values.astype(np.float64) for key in "xyz"], axis=1)
    key = next((key for key in ("vertex_indices", "vertex_index") if key in face), None)
    nothing = PlyProperty(np.empty(0), np.empty(0, dtype=np.int64))
    indices = face[key] if key else nothing
    flat = indices.values.astype(np.int64)
    corners, owners = file.polygons(vertices, flat, indices.counts)
    at_corners, of_rows = ply_colours(file, vertex), ply_colours(file, face)
    if "material_index" in face and "material" in elements:
        palette = ply_colours(file, elements["material"])
        of_rows = palette if palette is None else palette[face["material_index"].values]
    colours = None
    if at_corners is not None and (of_rows is None or np.ptp(at_corners, axis=0).any()):
        colours = at_corners[flat[corners]]
        if of_rows is not None:
            file.left_out("colours of polygons, as their corners have some as well")
    elif of_rows is not None:
        colours = np.repeat(of_rows[owners][:, None], 3, axis=1)
    uv = None
    if "texcoord" in face and np.array_equal(face["texcoord"].counts, 2 * indices.counts):
        uv = face["texcoord"].values.reshape(-1, 2).astype(np.float64)[corners]
    for u, v in _PLY_UV:
        if uv is None and u in vertex and v in vertex:
            uv = np.stack((vertex[u].values, vertex[v].values), axis=1).astype(np.float64)
            uv = uv[flat[corners]]
    if uv is not None:
        # In this format v goes up.
        uv = uv * (1.0, -1.0) + (0.0, 1.0)
    texture_numbers = np.zeros(len(indices.counts), dtype=np.int64)
    if "texnumber" in face:
        texture_numbers = face["texnumber"].values.astype(np.int64)
    parts = []
    names = [text[12:].strip() for text in comments if text.lower().startswith("texturefile ")]
    for number in np.unique(texture_numbers):
        chosen = texture_numbers[owners] == number
        texture = None
        if uv is not None and 0 <= number < len(names):
            name = names[number]
            texture = file.texture(
                name, lambda name=name: file.neighbour(name), ("repeat", "repeat")
            )
        part = Part(vertices, flat[corners][chosen], None if colours is None else colours[chosen])
        if texture is not None and uv is not None:
            part.uv, part.texture, part.colours = uv[chosen], texture.texture, None
        parts.append(part)
    if "vertex_indices" in strips:
        values = strips["vertex_indices"].values.astype(np.int64)
        ends = np.flatnonzero(values == -1)
        faces = np.concatenate([strip(run[run != -1]) for run in np.split(values, ends)])
        file.check_corners(vertices, faces)
        parts.append(Part(vertices, faces, None if at_corners is None else at_corners[faces]))
    return parts


# OFF. trimesh reads no colours, and cuts polygons as if they were convex.


def _read_off(file: MeshFile, content: bytes) -> list[Part]:
    """Return the part of an OFF file, with colours of corners or polygons."""
    rows = [line.split("#")[0].split() for line in content.decode("latin-1").splitlines()]
    rows = [row for row in rows if row]
    head = re.fullmatch(r"(ST)?(C?)(N?)(4?)(n?)OFF", rows[0][0])
    if head is not None:
        rows[0] = rows[0][1:]
        rows = rows if rows[0] else rows[1:]
    kind = head[0] if head is not None else "OFF"
    if "4" in kind or "n" in kind or rows[0][0] == "BINARY":
        raise file.error(f"must be an OFF file of text in three dimensions, got {kind}: save a PLY")
    vertex_count, face_count = (int(word) for word in rows[0][:2])
    if min(vertex_count, face_count) < 0 or len(rows) < 1 + vertex_count + face_count:
        raise file.error(
            f"must have {vertex_count} + {face_count} lines after the first, as that says, got "
            f"{len(rows) - 1}: save it again"
        )
    first = 6 if "N" in kind else 3
    corners = [[float(word) for word in row] for row in rows[1 : 1 + vertex_count]]
    vertices = np.array([row[:3] for row in corners], dtype=np.float64).reshape(-1, 3)
    faces = rows[1 + vertex_count : 1 + vertex_count + face_count]
    counts = np.array([int(row[0]) for row in faces], dtype=np.int64)
    if any(len(row) <= int(row[0]) for row in faces):
        raise file.error("has a polygon with fewer corners than it says: save it again")
    flat = np.array(
        [int(word) for row in faces for word in row[1 : int(row[0]) + 1]], dtype=np.int64
    )
    places, owners = file.polygons(vertices, flat, counts)
    # Files that call themselves OFF have colours after x, y and z, too.
    shades = [row[first : first + 3] for row in corners]
    end = 5 if "ST" in kind else 3
    if all(len(row) >= first + end for row in corners) and vertex_count:
        return [Part(vertices, flat[places], unit_colours(np.array(shades))[flat[places]])]
    shades = [[float(word) for word in row[int(row[0]) + 1 :][:3]] for row in faces]
    if all(len(row) < 3 for row in shades):
        return [Part(vertices, flat[places], None)]
    own = [row if len(row) == 3 else [np.nan] * 3 for row in shades]
    return [
        Part(
            vertices,
            flat[places],
            np.repeat(unit_colours(np.array(own))[owners][:, None], 3, axis=1),
        )
    ]


# STL. trimesh reads its triangles right, and hands over the two bytes in which colours are.


def _read_stl(file: MeshFile, content: bytes) -> list[Part]:
    """Return the parts of an STL file, one for each solid, with colours of triangles."""
    with importing(
        "trimesh",
        f"reading the mesh {shown(str(file.path))}",
        "pip install 'npa-envs[meshes]', or save it as PLY or GLB",
    ):
        from trimesh.exchange.stl import load_stl
    read = load_stl(io.BytesIO(content))
    parts = []
    for solid in read["geometry"].values() if "geometry" in read else [read]:
        vertices = np.asarray(solid["vertices"], dtype=np.float64)
        colours = None
        if "face_attributes" in solid:
            colours = _stl_colours(np.asarray(solid["face_attributes"]["stl"]), content[:80])
        parts.append(Part(vertices, np.asarray(solid["faces"], dtype=np.int64), colours))
    return parts


def _stl_colours(words: NDArray[np.uint16], head: bytes) -> FloatArray | None:
    """Return the colours [F, 3, 3] in the last two bytes of binary triangles; NaN: none.

    They are five bits each. VisCAM and SolidView set the highest bit of a triangle with a colour,
    and store red highest. Magics has a colour for all in the head, the highest bit of triangles
    that take it, and blue highest.
    """
    bits = np.stack([words >> shift & 31 for shift in (10, 5, 0)], axis=1) / 31.0
    marked = (words >> 15).astype(bool)[:, None]
    at = head.find(b"COLOR=")
    if 0 <= at <= 70:
        colours = np.where(marked, np.frombuffer(head, np.uint8, 3, at + 6) / 255.0, bits[:, ::-1])
    elif marked.any():
        colours = np.where(marked, bits, np.nan)
    else:
        return None
    return np.repeat(colours[:, None], 3, axis=1)


_READERS = {
    ".glb": read_gltf,
    ".gltf": read_gltf,
    ".obj": read_obj,
    ".off": _read_off,
    ".ply": _read_ply_parts,
    ".stl": _read_stl,
}
"""What reads the files of each suffix."""
