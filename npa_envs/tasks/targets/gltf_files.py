"""Mesh files of glTF 2.0, as text (.gltf) and as bytes (.glb).

trimesh neither multiplies factors with textures nor knows a second set of texture coordinates
(case glb_factor_and_texture), makes all grey where parts are coloured in different ways
(glb_parts_coloured_in_different_ways), and reads Draco parts as zeros, one of several instances and
no fans (glb_extensions_that_are_required).
"""

from __future__ import annotations

import base64
import struct
from typing import Any
from urllib.parse import unquote, unquote_to_bytes

import numpy as np
from numpy.typing import NDArray

from npa_envs.atomic_files import parse_json
from npa_envs.errors import NPAError, shown
from npa_envs.tasks.targets.mesh_parts import (
    MAX_TRIANGLES,
    FileTexture,
    IntArray,
    MeshFile,
    Part,
)
from npa_envs.tasks.targets.meshes import FloatArray, Wrap, srgb_values

_DRACO, _MESHOPT = "KHR_draco_mesh_compression", "EXT_meshopt_compression"
_INSTANCES, _WEBP = "EXT_mesh_gpu_instancing", "EXT_texture_webp"
_TRANSFORM, _GLOSS = "KHR_texture_transform", "KHR_materials_pbrSpecularGlossiness"
_READ = (_WEBP, _TRANSFORM, _GLOSS, "KHR_mesh_quantization")

_APPEARANCE = ("KHR_materials_", "KHR_lights_", "KHR_animation_", "KHR_xmp", "EXT_lights_")
"""How the names of extensions begin without which shape and colour are nearly right."""

_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_KINDS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_LINES = (0, 1, 2, 3)  # modes of points and lines
_WRAPS: dict[Any, Wrap] = {33648: "mirror", 33071: "clamp"}
_MAX_VALUES = 2**27
_MAX_PARTS = 2**16


def read_gltf(file: MeshFile, content: bytes) -> list[Part]:
    """Return the parts of a glTF file's scene, one for each primitive of each node."""
    return _Gltf(file, content).parts()


def _extension(item: dict[str, Any], name: str) -> dict[str, Any]:
    """Return the extension of an item; empty if it does not have it."""
    found: dict[str, Any] = item.get("extensions", {}).get(name, {})
    return found


class _Gltf:
    """A glTF file that is read."""

    def __init__(self, file: MeshFile, content: bytes) -> None:
        self.file = file
        # Without a material all is white, and colour profiles of textures are ignored, says glTF.
        file.plain, file.profiles = 1.0, False
        chunks = {b"JSON": content}
        if content[:4] == b"glTF":
            version, size = struct.unpack_from("<II", content, 4)
            self._check_version(version)
            chunks, position = {}, 12
            while position < min(size, len(content)):
                length, kind = struct.unpack_from("<I4s", content, position)
                position += 8 + length
                if position > len(content):
                    raise file.error("ends too early: fetch or save it again")
                chunks.setdefault(kind, content[position - length : position])
        self.inner = chunks.get(b"BIN\0")
        self.root: dict[str, Any] = parse_json(chunks[b"JSON"])
        self._check_version(self.root["asset"]["version"])
        for name in self.root.get("extensionsRequired", []):
            if name not in _READ and not name.startswith(_APPEARANCE):
                raise self._refused(name)
        self.buffers: dict[int, bytes] = {}
        self.world: dict[int, FloatArray] = {}
        self.known: dict[tuple[int, int], Part | None] = {}
        self.triangles = self.part_count = 0

    def _check_version(self, version: Any) -> None:
        if not str(version).startswith("2"):
            raise self.file.error(
                f"must be of glTF 2.0, got {shown(version)}: convert it, for example with Blender"
            )

    def _refused(self, name: str) -> NPAError:
        return self.file.error(
            f"needs the extension {shown(name)}, which is not read: save it without (uncompressed)"
        )

    def _too_large(self) -> NPAError:
        limits = f"{MAX_TRIANGLES} triangles, {_MAX_PARTS} nodes and {_MAX_PARTS} parts"
        return self.file.error(f"must have at most {limits}: simplify it")

    # Data.

    def _item(self, kind: str, index: Any) -> dict[str, Any]:
        items = self.root.get(kind, [])
        if not isinstance(index, int) or not 0 <= index < len(items):
            raise self.file.error(f"names {kind} {shown(index)}, which it has not: save it again")
        item: dict[str, Any] = items[index]
        return item

    def _resource(self, uri: str) -> bytes | None:
        """Return what a URI stands for; None if it is not there."""
        if not uri.startswith("data:"):
            return self.file.neighbour(unquote(uri))
        head, _, body = uri.partition(",")
        return base64.b64decode(body + "==") if head.endswith(";base64") else unquote_to_bytes(body)

    def _view(self, index: Any) -> memoryview:
        """Return the bytes of a buffer view."""
        view = self._item("bufferViews", index)
        number, start, length = view["buffer"], view.get("byteOffset", 0), view["byteLength"]
        uri = self._item("buffers", number).get("uri")
        if number not in self.buffers:
            data = self._resource(uri) if uri is not None else self.inner if number == 0 else None
            if data is None and _MESHOPT in self.root.get("extensionsUsed", []):
                raise self._refused(_MESHOPT)
            if data is None:
                name = "its data" if uri is None else shown(uri)
                raise self.file.error(f"needs {name}, which is not there: put it beside the file")
            self.buffers[number] = data
        found = memoryview(self.buffers[number])[start : start + length]
        if start < 0 or length < 0 or len(found) < length:
            raise self.file.error(f"must have all of bufferViews {index}: fetch or save it again")
        return found

    def _stored(
        self, place: dict[str, Any], kind: int, count: int, components: int
    ) -> NDArray[Any]:
        """Return the rows of numbers at a place in a buffer view."""
        dtype = np.dtype(_KINDS[kind])
        stride = self._item("bufferViews", place["bufferView"]).get("byteStride")
        strides = (stride or dtype.itemsize * components, dtype.itemsize)
        data, offset = self._view(place["bufferView"]), place.get("byteOffset", 0)
        return np.ndarray((count, components), dtype, data, offset, strides)

    def _raw(self, index: Any) -> NDArray[Any]:
        """Return the numbers of an accessor as they are stored, [count, components]."""
        accessor = self._item("accessors", index)
        components, count = _COMPONENTS[accessor["type"]], accessor["count"]
        kind = accessor["componentType"]
        if not 0 <= count * components <= _MAX_VALUES:
            raise self.file.error(
                f"must have at most {_MAX_VALUES} numbers in an accessor, got {shown(count)} rows"
            )
        if "bufferView" in accessor:
            values = self._stored(accessor, kind, count, components)
        else:
            values = np.zeros((count, components), _KINDS[kind])
        if "sparse" in accessor:
            sparse = accessor["sparse"]
            where, changed = sparse["indices"], sparse["count"]
            rows = self._stored(where, where["componentType"], changed, 1)[:, 0]
            values = values.copy()
            values[rows] = self._stored(sparse["values"], kind, changed, components)
        return values

    def _values(self, index: Any, rows: Any = slice(None)) -> FloatArray:
        """Return rows of an accessor, normalised if it says so, [any, components]."""
        raw = self._raw(index)[rows]
        values: FloatArray = raw.astype(np.float64)
        if self._item("accessors", index).get("normalized") and raw.dtype.kind in "iu":
            values = np.maximum(values / np.iinfo(raw.dtype).max, -1.0)
        return values

    # The scene.

    def parts(self) -> list[Part]:
        """Return all parts of the scene."""
        nodes, scenes = self.root.get("nodes", []), self.root.get("scenes", [])
        if len(nodes) > _MAX_PARTS:
            raise self._too_large()
        below = {child for node in nodes for child in node.get("children", [])}
        roots = [k for k in range(len(nodes)) if k not in below]
        scene = self._item("scenes", self.root.get("scene", 0)) if scenes else {"nodes": roots}
        self.file.count_left_out(len(scenes) - 1, "scene(s)")
        self.file.count_left_out(len(self.root.get("animations", [])), "animation(s)")
        read = (*_READ, _DRACO, _MESHOPT, _INSTANCES)
        used = [name for name in self.root.get("extensionsUsed", []) if name not in read]
        if used:
            self.file.left_out(f"what {shown(', '.join(used))} would change")
        # Joints may lie outside of the scene.
        hidden = sorted(set(roots).difference(scene.get("nodes", [])))
        stack = [(k, np.eye(4), False) for k in hidden]
        stack += [(k, np.eye(4), True) for k in reversed(scene.get("nodes", []))]
        drawn = []
        while stack:
            index, outer, visible = stack.pop()
            node = self._item("nodes", index)
            if index in self.world:
                raise self.file.error(
                    f"must have nodes that form a tree, node {index} is in a loop"
                )
            self.world[index] = outer @ _local(node)
            if visible and "mesh" in node:
                drawn.append(node | {"place": self.world[index]})
            stack += [(k, self.world[index], visible) for k in reversed(node.get("children", []))]
        return [part for node in drawn for part in self._parts_of(node)]

    def _parts_of(self, node: dict[str, Any]) -> list[Part]:
        """Return the parts of a node's mesh."""
        if _extension(node, _INSTANCES):
            raise self._refused(_INSTANCES)
        # The joints of a skin say where the vertices are.
        place = np.eye(4) if "skin" in node else node["place"]
        # What is mirrored must not be turned inside out.
        order = (2, 1, 0) if np.linalg.det(place[:3, :3]) < 0 else (0, 1, 2)
        mesh, parts = self._item("meshes", node["mesh"]), []
        modes = [primitive.get("mode", 4) for primitive in mesh["primitives"]]
        self.file.count_left_out(sum(k in _LINES for k in modes), "part(s) of points or lines")
        for k, primitive in enumerate(mesh["primitives"]):
            key = (node["mesh"], k)
            if key not in self.known or "skin" in node or "weights" in node:
                self.known[key] = self._part(primitive, modes[k], node, mesh)
            part = self.known[key]
            if part is None:
                continue
            self.triangles += len(part.faces)
            self.part_count += 1
            if self.triangles > MAX_TRIANGLES or self.part_count > _MAX_PARTS:
                raise self._too_large()
            points = part.vertices @ place[:3, :3].T + place[:3, 3]
            faces, colours, uv = part.faces[:, order], part.colours[:, order], part.uv[:, order]
            parts.append(Part(points, faces, colours, uv, part.texture))
        return parts

    def _part(
        self, primitive: dict[str, Any], mode: int, node: dict[str, Any], mesh: dict[str, Any]
    ) -> Part | None:
        """Return the triangles of a primitive, None if it has none or is invisible."""
        attributes = primitive["attributes"]
        if mode not in (4, 5, 6) or "POSITION" not in attributes:
            if mode not in _LINES:
                self.file.left_out(f"a part of mode {shown(mode)}, or without positions")
            return None
        position = attributes["POSITION"]
        compressed = _DRACO in primitive.get("extensions", {})
        if compressed and "bufferView" not in self._item("accessors", position):
            raise self._refused(_DRACO)
        raw = self._raw(position)
        corners = np.arange(len(raw))
        if "indices" in primitive:
            corners = self._raw(primitive["indices"])[:, 0].astype(np.int64)
        first, second, third = (corners[k : k - 2 or None] for k in range(3))
        if mode == 5:
            # Every other triangle of a strip turns the other way.
            odd = np.arange(len(first)) % 2 == 1
            first, second = np.where(odd, second, first), np.where(odd, first, second)
        elif mode == 6:
            first = np.repeat(corners[:1], len(second))
        else:
            more = len(corners) % 3
            self.file.count_left_out(more, "corner(s) too many")
            first, second, third = corners[: len(corners) - more].reshape(-1, 3).T
        triangles = np.stack((first, second, third), axis=1)
        self.file.check_corners(raw, triangles)
        used, faces = np.unique(triangles, return_inverse=True)
        points, targets = self._values(position, used), primitive.get("targets", [])
        if targets:
            self.file.left_out("morph targets but with the weights that it gives them")
        for weight, target in zip(
            node.get("weights", mesh.get("weights", [])), targets, strict=False
        ):
            if weight and "POSITION" in target:
                points = points + weight * self._values(target["POSITION"], used)
        if "skin" in node and "JOINTS_0" in attributes:
            points = self._skinned(points, used, attributes, self._item("skins", node["skin"]))
        return self._coloured(points, faces.reshape(-1, 3), used, primitive)

    def _skinned(
        self, points: FloatArray, used: IntArray, attributes: dict[str, Any], skin: dict[str, Any]
    ) -> FloatArray:
        """Return vertices where the joints of a skin at rest hold them."""
        motions = np.stack([self.world[joint] for joint in skin["joints"]])
        if "inverseBindMatrices" in skin:
            motions = motions @ self._values(skin["inverseBindMatrices"]).reshape(-1, 4, 4).mT
        moved, total, group = np.zeros_like(points), np.zeros((len(points), 1)), 0
        while f"JOINTS_{group}" in attributes:
            joints = self._raw(attributes[f"JOINTS_{group}"])[used]
            weights = self._values(attributes[f"WEIGHTS_{group}"], used)[:, :, None]
            for k in range(4):
                motion = motions[joints[:, k]]
                place = (motion[:, :3, :3] @ points[..., None])[..., 0] + motion[:, :3, 3]
                moved, total = moved + weights[:, k] * place, total + weights[:, k]
            group += 1
        return np.where(total > 0, moved / np.where(total > 0, total, 1.0), points)

    # Materials.

    def _coloured(
        self, points: FloatArray, faces: IntArray, used: IntArray, primitive: dict[str, Any]
    ) -> Part | None:
        """Return a part with the colours and the texture of its material; None if invisible."""
        attributes, index = primitive["attributes"], primitive.get("material")
        material: dict[str, Any] = {}
        if index is not None:
            material = self._item("materials", index)
            self.file.materials.add(index)
        surface, gloss = material.get("pbrMetallicRoughness", {}), _extension(material, _GLOSS)
        factor = gloss.get("diffuseFactor", surface.get("baseColorFactor", (1.0, 1.0, 1.0, 1.0)))
        info = gloss.get("diffuseTexture") if gloss else surface.get("baseColorTexture")
        light = material.get("emissiveFactor", (0.0, 0.0, 0.0))
        if any(light) and not any(factor[:3]):
            self.file.left_out("light: what a black material emits is read as its colour")
            factor, info = (*light, factor[3]), material.get("emissiveTexture")
        elif any(light):
            self.file.left_out("light that materials emit")
        texture, uv = self._texture(info, attributes, used) if info is not None else (None, None)
        lowest, highest = factor[3], factor[3]
        if texture is not None:
            lowest, highest = lowest * texture.lowest_alpha, highest * texture.highest_alpha
        # Factors and colours of vertices are linear.
        linear = np.full((len(points), 3), factor[:3] if index is not None else np.nan)
        if "COLOR_0" in attributes:
            raw = self._raw(attributes["COLOR_0"])[used]
            shades = raw / (1.0 if raw.dtype.kind == "f" else np.iinfo(raw.dtype).max)
            linear = np.multiply(factor[:3], shades[:, :3])
            alpha = shades[:, 3] if shades.shape[1] > 3 else np.ones(1)
            lowest, highest = lowest * alpha.min(initial=1.0), highest * alpha.max(initial=0.0)
        mode, cut = material.get("alphaMode", "OPAQUE"), material.get("alphaCutoff", 0.5)
        if mode != "OPAQUE" and highest < (cut if mode == "MASK" else 1 / 255):
            name = shown(material.get("name", index))
            self.file.left_out(f"the invisible triangles of material {name}")
            return None
        if mode != "OPAQUE" and lowest < 1.0:
            self.file.left_out("transparency: all is opaque")
        part = Part(points, faces, srgb_values(linear.clip(0.0, 1.0))[faces])
        if texture is not None and uv is not None:
            part.uv, part.texture = uv[faces], texture.texture
        return part

    def _texture(
        self, info: dict[str, Any], attributes: dict[str, Any], used: IntArray
    ) -> tuple[FileTexture | None, FloatArray | None]:
        """Return the texture of a material, and its coordinates at vertices."""
        texture, change = self._item("textures", info["index"]), _extension(info, _TRANSFORM)
        source = _extension(texture, _WEBP).get("source", texture.get("source"))
        key = f"TEXCOORD_{change.get('texCoord', info.get('texCoord', 0))}"
        if source is None or key not in attributes:
            lack = (
                "of a kind that is not read, such as KTX2" if source is None else f"without {key}"
            )
            self.file.left_out(f"a texture {lack}")
            return None, None
        image = self._item("images", source)
        sampler = self._item("samplers", texture["sampler"]) if "sampler" in texture else {}
        wrap = tuple(_WRAPS.get(sampler.get(side), "repeat") for side in ("wrapS", "wrapT"))

        def read() -> bytes | None:
            view = image.get("bufferView")
            return self._resource(image["uri"]) if view is None else bytes(self._view(view))

        name = image.get("uri", "data:")
        name = f"image {source}" if name.startswith("data:") else unquote(name)
        uv = self._values(attributes[key], used) * change.get("scale", (1.0, 1.0))
        c, s = np.cos(change.get("rotation", 0.0)), np.sin(change.get("rotation", 0.0))
        uv = uv @ np.array(((c, -s), (s, c))) + change.get("offset", (0.0, 0.0))
        return self.file.texture(name, read, (wrap[0], wrap[1])), uv


def _local(node: dict[str, Any]) -> FloatArray:
    """Return the motion of a node in the one above it, [4, 4]."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    turn = np.array(node.get("rotation", (0, 0, 0, 1)), dtype=np.float64)
    x, y, z, w = turn / np.linalg.norm(turn)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    motion: FloatArray = np.eye(4)
    motion[:3, :3] = np.array(rows) * np.array(node.get("scale", (1, 1, 1)), dtype=np.float64)
    motion[:3, 3] = node.get("translation", (0, 0, 0))
    return motion
