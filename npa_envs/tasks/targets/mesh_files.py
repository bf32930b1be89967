"""Mesh files as meshes with colours and textures; in this file PLY, OBJ, OFF and STL."""

from __future__ import annotations

import io
import math
import re
import warnings
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from npa_envs.atomic_files import read_bytes
from npa_envs.errors import importing, shown
from npa_envs.tasks.targets.gltf_files import read_gltf
from npa_envs.tasks.targets.mesh_parts import (
    MAX_TRIANGLES,
    IntArray,
    MeshFile,
    Part,
    unit_colours,
)
from npa_envs.tasks.targets.meshes import MAX_FILE, FloatArray, Mesh

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
    with file.reading("a mesh"):
        return _joined(file, _READERS[path.suffix.lower()](file, content))


def _joined(file: MeshFile, parts: list[Part]) -> Mesh:
    """Return the mesh of a file's parts."""
    sizes = [len(part.faces) for part in parts]
    total = sum(sizes)
    if not 0 < total <= MAX_TRIANGLES:
        raise file.error(
            f"must hold triangles, at most {MAX_TRIANGLES}, got {total}: give a surface, not a "
            "point cloud"
        )
    shared = {id(part.vertices): part.vertices for part in parts}
    vertices = np.concatenate(list(shared.values()))
    ends = np.cumsum([len(each) for each in shared.values()])
    starts = dict(zip(shared, [0, *ends.tolist()], strict=False))
    faces = np.concatenate([part.faces + starts[id(part.vertices)] for part in parts])
    file.check_corners(vertices, faces)
    _check_size(file, vertices, faces)
    textures = [part.texture for part in parts if part.texture is not None and len(part.faces)]
    number = {texture: k for k, texture in enumerate(dict.fromkeys(textures))}
    texture_of_face = np.repeat(
        [-1 if p.texture is None else number.get(p.texture, -1) for p in parts], sizes
    )
    colours, uv = (np.concatenate([getattr(p, key) for p in parts]) for key in ("colours", "uv"))
    lost = (texture_of_face >= 0) & ~np.isfinite(uv).all(axis=(1, 2))
    file.count_left_out(int(lost.sum()), "texture of triangle(s), without coordinates in it")
    texture_of_face[lost] = -1
    colours[(texture_of_face >= 0)[:, None, None] & np.isnan(colours)] = 1.0
    plain = ~np.isfinite(colours).all(axis=(1, 2))
    colours[plain] = file.plain
    if plain.any():
        which = "the file has none" if plain.all() else f"{plain.sum()} triangles have none"
        shade = "white" if file.plain == 1.0 else "grey"
        file.left_out(f"colours, as {which}: {'all is' if plain.all() else 'they are'} {shade}")
    looks = [f"{total} triangle" + "s" * (total > 1)]
    if number:
        size = "texture {1} x {0}".format(*textures[0].pixels.shape)
        looks.append(size if len(number) == 1 else f"{len(number)} textures")
    if file.materials:
        looks.append(f"{len(file.materials)} material" + "s" * (len(file.materials) > 1))
    elif not number:
        looks.append("no colours" if plain.all() else "colours of corners or faces")
    summary = f"{shown(file.path.name)[1:-1]}: {', '.join(looks)}"
    mesh = Mesh(vertices, faces, colours.clip(0.0, 1.0), summary=summary)
    if number:
        uv = np.nan_to_num(uv).clip(-_MAX_UV, _MAX_UV)
        mesh = replace(mesh, uv=uv, texture_of_face=texture_of_face, textures=tuple(number))
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

    keys, kinds = [key for key, _, _ in properties], [stored(kind) for _, _, kind in properties]
    counters = [stored(counted) if counted else None for _, counted, _ in properties]
    if not any(counters):
        fields = list(zip(keys, kinds, strict=True))
        rows = np.frombuffer(data, fields, count, start) if count else np.empty(0, fields)
        columns, end = [rows[key] for key in keys], start + rows.nbytes
        counts = [np.ones(count, dtype=np.int64) for _ in keys]
    else:
        pieces: list[list[bytes]] = [[] for _ in keys]
        lengths: list[list[int]] = [[] for _ in keys]
        plan, end = list(zip(counters, kinds, pieces, lengths, strict=True)), start
        for _ in range(count):
            for counter, kind, found, sizes in plan:
                length = 1
                if counter is not None:
                    length = int(np.frombuffer(data, counter, 1, end)[0])
                    end += counter.itemsize
                start, end = end, end + length * kind.itemsize
                if not start <= end <= len(data):
                    raise ValueError("it ends too early")
                sizes.append(length)
                found.append(data[start:end])
        columns = [np.frombuffer(b"".join(p), kind) for p, kind in zip(pieces, kinds, strict=True)]
        counts = [np.array(each, dtype=np.int64) for each in lengths]
    return {
        key: PlyProperty(values.astype(_PLY_TYPES[kind]), each)
        for (key, _, kind), values, each in zip(properties, columns, counts, strict=True)
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
    if "tristrips" in elements:
        raise file.error("has strips of triangles (tristrips), which are not read: save faces")
    vertex, face = elements.get("vertex", {}), elements.get("face", {})
    vertices = np.stack([vertex[key].values.astype(np.float64) for key in "xyz"], axis=1)
    nothing = PlyProperty(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64))
    indices = face.get("vertex_indices", face.get("vertex_index", nothing))
    flat = indices.values.astype(np.int64)
    corners, owners = file.polygons(vertices, flat, indices.counts)
    faces, colours, uv, parts = flat[corners], None, None, []
    at_corners, of_rows = ply_colours(file, vertex), ply_colours(file, face)
    if at_corners is not None and (of_rows is None or np.ptp(at_corners, axis=0).any()):
        colours = at_corners[faces]
        if of_rows is not None:
            file.left_out("colours of polygons, as their corners have some as well")
    elif of_rows is not None:
        colours = np.repeat(of_rows[owners][:, None], 3, axis=1)
    if "texcoord" in face and np.array_equal(face["texcoord"].counts, 2 * indices.counts):
        uv = face["texcoord"].values.reshape(-1, 2)[corners]
    for u, v in (("s", "t"), ("u", "v"), ("texture_u", "texture_v")):
        if uv is None and u in vertex and v in vertex:
            uv = np.stack((vertex[u].values, vertex[v].values), axis=1)[faces]
    names = [text[12:].strip() for text in comments if text.lower().startswith("texturefile ")]
    numbers = face["texnumber"].values[owners] if "texnumber" in face else np.zeros(len(faces))
    for number in np.unique(numbers):
        chosen, texture = numbers == number, None
        if uv is not None and 0 <= number < len(names):
            texture = file.texture(names[int(number)])
        if texture is None or uv is None:
            part = Part(vertices, faces[chosen], None if colours is None else colours[chosen])
        else:
            if colours is not None:
                file.left_out("colours where there is a texture")
            # In this format v goes up.
            flipped = uv[chosen] * (1.0, -1.0) + (0.0, 1.0)
            part = Part(vertices, faces[chosen], None, flipped, texture.texture)
        parts.append(part)
    return parts


# OBJ and its materials in MTL. trimesh counts negative indices from the end of the file (case
# obj_relative_indices_between_vertices), cuts polygons as if they were convex, and fails with
# texture coordinates but no texture (case mesh_one_plain_material).

_NOT_DRAWN = {"p": "element(s) of points", "l": "element(s) of lines", "curv": "free-form curve(s)"}
_NOT_DRAWN["surf"] = "free-form surface(s)"
_OPTIONS = re.compile(r"(-\S+\s+((on|off|[rgbmlz]|[-+]?[.\d]\S*)\s+)*)*", re.IGNORECASE)
"""The options before the file of a texture."""


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


def _read_obj(file: MeshFile, content: bytes) -> list[Part]:
    """Return the parts of an OBJ file, one for each material."""
    rows: list[list[float]] = []
    uv: list[list[float]] = []
    of_corners: list[tuple[int, int]] = []
    of_polygons: list[tuple[int, int]] = []
    names, material, libraries, not_drawn = {"": 0}, 0, [], Counter[str]()
    for number, words in enumerate(_lines(content), 1):
        try:
            match words:
                case ["v", *rest]:
                    x, y, z, *more = map(float, rest)
                    # Four numbers are homogeneous coordinates, six or more have a colour.
                    scale = more[0] if len(more) == 1 and more[0] else 1.0
                    shade = more[:3] if len(more) > 2 else [math.nan] * 3
                    rows.append([x / scale, y / scale, z / scale, *shade])
                case ["vt", *rest]:
                    uv.append([float(rest[0]), float(rest[1]) if len(rest) > 1 else 0.0])
                case ["f" | "fo", *rest]:
                    for corner in rest:
                        vertex, place, *_ = [*corner.split("/"), ""]
                        index = _index(place, len(uv)) if place else -1
                        of_corners.append((_index(vertex, len(rows)), index))
                    of_polygons.append((len(rest), material))
                case ["usemtl", *rest]:
                    material = names.setdefault(" ".join(rest), len(names))
                case ["mtllib", *rest]:
                    libraries.append(" ".join(rest))
                case [word, *_] if word in _NOT_DRAWN:
                    not_drawn[word] += 1
        except (ValueError, IndexError) as error:
            line = f"line {number}, {shown(' '.join(words))}"
            raise file.error(f"has an unreadable {line} ({error}): save it again") from error
    for word, things in _NOT_DRAWN.items():
        file.count_left_out(not_drawn[word], things)
    vertices, shades = np.split(np.array(rows, dtype=np.float64).reshape(-1, 6), 2, axis=1)
    corners, uv_indices = np.array(of_corners, dtype=np.int64).reshape(-1, 2).T
    counts, materials_of = np.array(of_polygons, dtype=np.int64).reshape(-1, 2).T
    if uv_indices.max(initial=-1) >= len(uv):
        raise file.error(f"has more texture coordinates in faces than its {len(uv)} rows of vt")
    places, polygons = file.polygons(vertices, corners, counts)
    faces, of_faces, shades = corners[places], materials_of[polygons], unit_colours(shades)
    places_in_textures = np.array([*uv, [np.nan] * 2])[uv_indices[places]]
    materials = _read_materials(file, libraries)
    parts = []
    for name, index in names.items():
        chosen = of_faces == index
        if chosen.any():
            part = Part(vertices, faces[chosen], shades[faces[chosen]])
            if name in materials:
                file.materials.add(name)
                _apply(file, materials[name], part, places_in_textures[chosen])
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
    line = " ".join(material.get("map_kd", []))
    name = _OPTIONS.sub("", line, count=1)
    texture = file.texture(name) if name else None
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
        if min(colour) < 1.0 and np.isfinite(part.colours).any():
            file.left_out("colours of materials where corners have some")
        part.colours = np.where(np.isnan(part.colours), colour, part.colours)
    if any(alpha) or "map_d" in material or (texture is not None and texture.lowest_alpha < 1.0):
        file.left_out("transparency: all is opaque")


# OFF. trimesh reads no colours, and cuts polygons as if they were convex.


def _read_off(file: MeshFile, content: bytes) -> list[Part]:
    """Return the part of an OFF file, with colours of corners or polygons."""
    lines = (line.split("#")[0].split() for line in content.decode("latin-1").splitlines())
    rows = [line for line in lines if line]
    head = re.fullmatch(r"(ST)?C?(N?)(4?n?)OFF", rows[0][0])
    if head is not None:
        rows = ([rows[0][1:]] if rows[0][1:] else []) + rows[1:]
    if (head is not None and head[3]) or rows[0][0] == "BINARY":
        raise file.error("must be an OFF file of text in three dimensions: save it as PLY")
    first, last = (int(word) for word in rows[0][:2])
    corners, faces = rows[1 : 1 + first], rows[1 + first : 1 + first + last]
    if (len(corners), len(faces)) != (first, last) or any(len(f) <= int(f[0]) for f in faces):
        raise file.error(f"must have {first} corners and {last} whole polygons: save it again")
    vertices = np.array([row[:3] for row in corners], dtype=np.float64).reshape(-1, 3)
    counts = np.array([int(row[0]) for row in faces], dtype=np.int64)
    flat = np.array(
        [int(word) for row in faces for word in row[1 : int(row[0]) + 1]], dtype=np.int64
    )
    places, owners = file.polygons(vertices, flat, counts)
    # Files that call themselves OFF have colours after x, y, z and a normal, too.
    start = 6 if head is not None and head[2] else 3
    least = start + (5 if head is not None and head[1] else 3)
    rows, of_corners = [row[int(row[0]) + 1 :] for row in faces], False
    if corners and all(len(row) >= least for row in corners):
        rows, of_corners = [row[start:] for row in corners], True
    shades = np.array([(row + ["nan"] * 4)[:4] for row in rows], dtype=np.float64).reshape(-1, 4)
    # Negative ones are normals.
    shades = unit_colours(np.where((shades < 0).any(), np.nan, shades))
    if (shades[:, 3] < 1.0).any():
        file.left_out("transparency: all is opaque")
    shades = shades[:, :3]
    colours = shades[flat[places]] if of_corners else np.repeat(shades[owners][:, None], 3, axis=1)
    return [Part(vertices, flat[places], colours)]


# STL. trimesh reads its triangles right, and hands over the two bytes in which colours are.


def _read_stl(file: MeshFile, content: bytes) -> list[Part]:
    """Return the parts of an STL file, one for each solid, with colours of triangles."""
    cure = "pip install 'npa-envs[meshes]', or save it as PLY or GLB"
    with importing("trimesh", f"reading the mesh {shown(str(file.path))}", cure):
        import trimesh
    # trimesh takes what is followed by more bytes for text.
    size = 84 + 50 * int.from_bytes(content[80:84], "little")
    if 84 < size < len(content):
        file.count_left_out(len(content) - size, "byte(s) after the end")
        content = content[:size]
    with warnings.catch_warnings():
        # Numbers after text that is none would be left out.
        warnings.simplefilter("error", DeprecationWarning)
        read = trimesh.exchange.stl.load_stl(io.BytesIO(content))
    parts = []
    for solid in read["geometry"].values() if "geometry" in read else [read]:
        vertices = np.asarray(solid["vertices"], dtype=np.float64)
        colours = None
        if "face_attributes" in solid:
            colours = _stl_colours(np.asarray(solid["face_attributes"]["stl"]), content[:80])
        parts.append(Part(vertices, np.asarray(solid["faces"], dtype=np.int64), colours))
    if not parts:
        raise file.error("has no triangles, or ends too early for an STL file: save it again")
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
    ".obj": _read_obj,
    ".off": _read_off,
    ".ply": _read_ply_parts,
    ".stl": _read_stl,
}
"""What reads the files of each suffix."""
