"""Mesh files of glTF 2.0, as text (.gltf) and as bytes (.glb).

Not read by trimesh: it neither multiplies factors with textures and colours nor knows a second set
of texture coordinates (case glb_factor_and_texture), makes all grey where parts are coloured in
different ways (glb_parts_coloured_in_different_ways), and reads Draco parts as zeros and ignores
instances and fans (glb_extensions_that_are_required).
"""

from __future__ import annotations

import base64
import struct
from collections.abc import Iterable
from typing import Any
from urllib.parse import unquote, unquote_to_bytes

import numpy as np
from numpy.typing import NDArray

from npa_envs.atomic_files import parse_json
from npa_envs.errors import shown
from npa_envs.tasks.targets.mesh_parts import (
    MAX_TRIANGLES,
    FileTexture,
    IntArray,
    MeshFile,
    Part,
    strip,
)
from npa_envs.tasks.targets.meshes import FloatArray, Wrap, srgb_values

_READ = (
    "EXT_mesh_gpu_instancing",
    "EXT_texture_webp",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_variants",
    "KHR_mesh_quantization",
    "KHR_node_visibility",
    "KHR_texture_transform",
    "KHR_xmp_json_ld",
)
"""Extensions that are read, or change nothing of what is read."""

_APPEARANCE = ("KHR_materials_", "KHR_lights_", "KHR_animation_", "EXT_lights_")
"""How the names of extensions begin without which shape and colour are still right."""

_DRACO, _MESHOPT = "KHR_draco_mesh_compression", "EXT_meshopt_compression"
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_KINDS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WRAPS: dict[Any, Wrap] = {33648: "mirror", 33071: "clamp"}
_MAX_VALUES = 2**27


def read_gltf(file: MeshFile, content: bytes) -> list[Part]:
    """Return the parts of a glTF file's scene, one for each of its primitives."""
    return _Gltf(file, content).parts()


class _Gltf:
    """A glTF file that is read."""

    def __init__(self, file: MeshFile, content: bytes) -> None:
        self.file = file
        file.plain = 1.0
        self.inner: bytes | None = None
        text = content
        if content[:4] == b"glTF":
            self._check_version(struct.unpack_from("<I", content, 4)[0])
            text, position = b"", 12
            while position < len(content):
                length, kind = struct.unpack_from("<I4s", content, position)
                chunk = content[position + 8 : position + 8 + length]
                if len(chunk) < length:
                    raise file.error("ends too early: fetch or save it again")
                if kind == b"JSON" and not text:
                    text = chunk
                elif kind == b"BIN\0" and self.inner is None:
                    self.inner = chunk
                position += 8 + length
        self.root: dict[str, Any] = parse_json(text)
        self._check_version(self.root["asset"]["version"])
        self._refuse(
            name
            for name in self.root.get("extensionsRequired", [])
            if name not in _READ and not str(name).startswith(_APPEARANCE)
        )
        self.buffers: dict[int, bytes] = {}
        self.world: dict[int, FloatArray] = {}
        self.count = 0

    def _check_version(self, version: Any) -> None:
        if not str(version).startswith("2"):
            raise self.file.error(
                f"must be of glTF 2.0, got {shown(version)}: convert it, for example with Blender"
            )

    def _refuse(self, names: Iterable[Any]) -> None:
        """Raise NPAError if there are names of extensions that cannot be read."""
        if needed := list(names):
            raise self.file.error(
                f"needs {shown(', '.join(map(str, needed)))}, which cannot be read here: save it "
                "without compression or extensions"
            )

    # Data.

    def _item(self, kind: str, index: Any) -> dict[str, Any]:
        items = self.root.get(kind)
        known = isinstance(items, list) and isinstance(index, int) and 0 <= index < len(items)
        if not known or not isinstance(items[index], dict):
            raise self.file.error(
                f"names {kind} {shown(index)}, which it does not have: save it again"
            )
        item: dict[str, Any] = items[index]
        return item

    def _resource(self, uri: str) -> bytes | None:
        """Return what a URI stands for; None if it is not there."""
        if not uri.startswith("data:"):
            return self.file.neighbour(unquote(uri))
        head, _, body = uri.partition(",")
        try:
            return (
                base64.b64decode(body + "==")
                if head.endswith(";base64")
                else unquote_to_bytes(body)
            )
        except ValueError as error:
            raise self.file.error(
                f"has data in a URI that is damaged ({error}): save it again"
            ) from error

    def _buffer(self, index: Any) -> bytes:
        buffer = self._item("buffers", index)
        if index not in self.buffers:
            uri = buffer.get("uri")
            data = self._resource(uri) if uri is not None else self.inner if index == 0 else None
            if data is None and _MESHOPT in self.root.get("extensionsUsed", []):
                self._refuse([_MESHOPT])
            if data is None:
                name = "its data" if uri is None else shown(uri)
                raise self.file.error(f"needs {name}, which is not there: put it beside the file")
            if len(data) < buffer["byteLength"]:
                raise self.file.error(
                    f"must have {buffer['byteLength']} bytes of data, got {len(data)}: fetch or "
                    "save it again"
                )
            self.buffers[index] = data
        return self.buffers[index]

    def _view(self, index: Any) -> memoryview:
        """Return the bytes of a buffer view."""
        view = self._item("bufferViews", index)
        start, length = view.get("byteOffset", 0), view["byteLength"]
        found = memoryview(self._buffer(view["buffer"]))[start : start + length]
        if start < 0 or length < 0 or len(found) < length:
            raise self.file.error(f"must have all of bufferViews {index}: save it again")
        return found

    def _stored(
        self, view: Any, offset: Any, count: int, kind: str, components: int
    ) -> NDArray[Any]:
        """Return `count` rows of numbers of a buffer view."""
        item = np.dtype(kind).itemsize
        stride = self._item("bufferViews", view).get("byteStride") or item * components
        return np.ndarray((count, components), kind, self._view(view), offset, (stride, item))

    def _raw(self, index: Any) -> NDArray[Any]:
        """Return the numbers of an accessor as they are stored, [count, components]."""
        accessor = self._item("accessors", index)
        components, count = _COMPONENTS[accessor["type"]], accessor["count"]
        kind = _KINDS[accessor["componentType"]]
        if not 0 <= count * components <= _MAX_VALUES:
            raise self.file.error(
                f"must have at most {_MAX_VALUES} numbers in accessors, got {shown(count)} rows: "
                "simplify it"
            )
        if "bufferView" in accessor:
            offset = accessor.get("byteOffset", 0)
            values = self._stored(accessor["bufferView"], offset, count, kind, components)
        else:
            values = np.zeros((count, components), kind)
        if "sparse" in accessor:
            sparse = accessor["sparse"]
            where, what = sparse["indices"], sparse["values"]
            rows = self._stored(
                where["bufferView"],
                where.get("byteOffset", 0),
                sparse["count"],
                _KINDS[where["componentType"]],
                1,
            )
            values = values.copy()
            values[rows[:, 0]] = self._stored(
                what["bufferView"], what.get("byteOffset", 0), sparse["count"], kind, components
            )
        return values

    def _values(self, index: Any, rows: Any = slice(None)) -> FloatArray:
        """Return rows of an accessor, normalised if it says so, [any, components]."""
        raw = self._raw(index)[rows]
        values = raw.astype(np.float64)
        if self._item("accessors", index).get("normalized") and raw.dtype.kind in "iu":
            values = np.maximum(values / np.iinfo(raw.dtype).max, -1.0)
        return values

    # The scene.

    def parts(self) -> list[Part]:
        """Return all parts of the scene."""
        nodes, scenes = self.root.get("nodes", []), self.root.get("scenes", [])
        below = {child for node in nodes for child in node.get("children", [])}
        roots = [k for k in range(len(nodes)) if k not in below]
        drawn_roots = (
            self._item("scenes", self.root.get("scene", 0)).get("nodes", []) if scenes else roots
        )
        self.file.count_left_out(len(scenes) - 1, "scene", "scenes")
        stack = [(k, np.eye(4), True) for k in reversed(drawn_roots)]
        # Joints may lie outside of the scene.
        stack = [(k, np.eye(4), False) for k in roots if k not in drawn_roots] + stack
        drawn = []
        while stack:
            index, outer, visible = stack.pop()
            node = self._item("nodes", index)
            if index in self.world:
                raise self.file.error(
                    f"must have nodes that form a tree, node {index} is met twice"
                )
            self.world[index] = outer @ _local(node)
            hidden = (
                node.get("extensions", {}).get("KHR_node_visibility", {}).get("visible") is False
            )
            if visible and not hidden and "mesh" in node:
                drawn.append(index)
            inner = [
                (k, self.world[index], visible and not hidden) for k in node.get("children", [])
            ]
            stack += reversed(inner)
        self.file.count_left_out(len(self.root.get("animations", [])), "animation", "animations")
        unread = [
            n for n in self.root.get("extensionsUsed", []) if n not in (*_READ, _DRACO, _MESHOPT)
        ]
        if unread:
            self.file.left_out(f"what {shown(', '.join(map(str, unread)))} would change")
        parts = [part for index in drawn for part in self._parts_of_node(index)]
        if not nodes:
            for mesh in range(len(self.root.get("meshes", []))):
                parts += self._parts_of_mesh({"mesh": mesh}, np.eye(4)[None])
        return parts

    def _parts_of_node(self, index: int) -> list[Part]:
        node, places = self._item("nodes", index), self.world[index][None]
        instancing = node.get("extensions", {}).get("EXT_mesh_gpu_instancing")
        if instancing is not None:
            each = instancing["attributes"]
            t, r, s = (
                self._values(each[key]) if key in each else None
                for key in ("TRANSLATION", "ROTATION", "SCALE")
            )
            places = self.world[index] @ _placed(t, r, s)
        if "skin" in node:
            # The joints say where the vertices are.
            places = np.eye(4)[None]
        return self._parts_of_mesh(node, places)

    def _parts_of_mesh(self, node: dict[str, Any], places: FloatArray) -> list[Part]:
        """Return the parts of a node's mesh at places [I, 4, 4]."""
        mesh, parts = self._item("meshes", node["mesh"]), []
        weights = node.get("weights", mesh.get("weights", []))
        not_drawn = 0
        for primitive in mesh["primitives"]:
            mode = primitive.get("mode", 4)
            not_drawn += mode in (0, 1, 2, 3)
            part = None if mode in (0, 1, 2, 3) else self._part(primitive, mode, node, weights)
            if part is None or not len(part.faces):
                continue
            self.count += len(part.faces) * len(places)
            if self.count > MAX_TRIANGLES:
                raise self.file.error(f"must have at most {MAX_TRIANGLES} triangles: simplify it")
            # A mirrored part is turned inside out.
            mirrored = (np.linalg.det(places[:, :3, :3]) < 0)[:, None, None]
            where = (
                np.where(mirrored, (2, 1, 0), (0, 1, 2)) + np.arange(len(part.faces))[:, None] * 3
            )
            starts = np.arange(len(places))[:, None, None] * len(part.vertices)
            points = part.vertices @ places[:, :3, :3].mT + places[:, None, :3, 3]
            parts.append(
                Part(
                    points.reshape(-1, 3),
                    (part.faces.reshape(-1)[where] + starts).reshape(-1, 3),
                    part.colours.reshape(-1, 3)[where].reshape(-1, 3, 3),
                    None if part.uv is None else part.uv.reshape(-1, 2)[where].reshape(-1, 3, 2),
                    part.texture,
                )
            )
        self.file.count_left_out(not_drawn, "part of points or lines", "parts of points or lines")
        return parts

    def _part(
        self, primitive: dict[str, Any], mode: int, node: dict[str, Any], weights: list[float]
    ) -> Part | None:
        """Return the triangles of a primitive, None if it has no surface or is invisible."""
        attributes = primitive["attributes"]
        if "POSITION" not in attributes:
            self.file.left_out("a part without positions")
            return None
        position = attributes["POSITION"]
        stored = self._item("accessors", position)
        if _DRACO in primitive.get("extensions", {}) and "bufferView" not in stored:
            self._refuse([_DRACO])
        raw = self._raw(position)
        indices = np.arange(len(raw))
        if "indices" in primitive:
            indices = self._raw(primitive["indices"])[:, 0].astype(np.int64)
        if mode == 4:
            self.file.count_left_out(len(indices) % 3, "corner too many", "corners too many")
            triangles = indices[: len(indices) // 3 * 3].reshape(-1, 3)
        elif mode == 5:
            triangles = strip(indices)
        elif mode == 6:
            hub = np.repeat(indices[:1], max(0, len(indices) - 2))
            triangles = np.stack((hub, indices[1:-1], indices[2:]), axis=1)
        else:
            raise self.file.error(f"must have primitives of modes 0 to 6, got {shown(mode)}")
        self.file.check_corners(raw, triangles)
        used, faces = np.unique(triangles, return_inverse=True)
        faces = faces.reshape(-1, 3)
        points = self._values(position, used)
        for weight, target in zip(weights, primitive.get("targets", []), strict=False):
            if weight and "POSITION" in target:
                points = points + weight * self._values(target["POSITION"], used)
        if primitive.get("targets"):
            self.file.left_out("morph targets but with the weights that it gives them")
        if "skin" in node and "JOINTS_0" in attributes:
            points = self._skinned(points, used, attributes, self._item("skins", node["skin"]))
        return self._coloured(points, faces, used, primitive)

    def _skinned(
        self, points: FloatArray, used: IntArray, attributes: dict[str, Any], skin: dict[str, Any]
    ) -> FloatArray:
        """Return vertices where the joints of a skin at rest hold them."""
        motions = np.stack([self.world[joint] for joint in skin["joints"]])
        if "inverseBindMatrices" in skin:
            bound = self._values(skin["inverseBindMatrices"]).reshape(-1, 4, 4).mT
            motions = motions @ bound[: len(motions)]
        moved, total, group = np.zeros_like(points), np.zeros((len(points), 1)), 0
        while f"JOINTS_{group}" in attributes:
            joints = self._raw(attributes[f"JOINTS_{group}"])[used].astype(np.int64)
            weights = self._values(attributes[f"WEIGHTS_{group}"], used)
            for k in range(4):
                motion = motions[joints[:, k]]
                place = (motion[:, :3, :3] @ points[..., None])[..., 0] + motion[:, :3, 3]
                moved += weights[:, k, None] * place
                total += weights[:, k, None]
            group += 1
        return np.where(total > 0, moved / np.where(total > 0, total, 1.0), points)

    # Materials.

    def _coloured(
        self, points: FloatArray, faces: IntArray, used: IntArray, primitive: dict[str, Any]
    ) -> Part | None:
        """Return a part with the colours and the texture of its material; None if invisible."""
        attributes, index = primitive["attributes"], primitive.get("material")
        material = {} if index is None else self._item("materials", index)
        self.file.materials |= set() if index is None else {index}
        surface = material.get("pbrMetallicRoughness", {})
        factor, info = surface.get("baseColorFactor"), surface.get("baseColorTexture")
        gloss = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness")
        if gloss is not None:
            factor, info = gloss.get("diffuseFactor"), gloss.get("diffuseTexture")
        factor = np.array(factor or (1.0, 1.0, 1.0, 1.0), dtype=np.float64)
        light = material.get("emissiveFactor", (0.0, 0.0, 0.0))
        if any(light) and not factor[:3].any():
            self.file.left_out("light: what a black material emits is read as its colour")
            factor[:3], info = light, material.get("emissiveTexture")
        elif any(light):
            self.file.left_out("light that materials emit")
        texture, uv = self._texture(info, attributes, used) if info is not None else (None, None)
        mode = material.get("alphaMode", "OPAQUE")
        if mode != "OPAQUE":
            lowest, highest = (
                (texture.lowest_alpha, texture.highest_alpha) if texture is not None else (1.0, 1.0)
            )
            least = material.get("alphaCutoff", 0.5) if mode == "MASK" else 1 / 255
            if factor[3] * highest < least:
                self.file.left_out(
                    f"invisible triangles of the material {shown(material.get('name', index))}"
                )
                return None
            if factor[3] * lowest < 1.0:
                self.file.left_out("transparency: all is opaque")
        # Factors and colours of vertices are linear.
        linear = np.broadcast_to(factor[:3], (len(points), 3))
        if "COLOR_0" in attributes:
            raw = self._raw(attributes["COLOR_0"])[used, :3]
            top = 1.0 if raw.dtype.kind == "f" else np.iinfo(raw.dtype).max
            linear = linear * (raw / top)
        elif index is None:
            # White, as glTF says, but not without a word.
            linear = np.full_like(linear, np.nan)
        colours = srgb_values(linear.clip(0.0, 1.0))
        part = Part(points, faces, colours[faces])
        if texture is not None and uv is not None:
            part.uv, part.texture = uv[faces], texture.texture
        return part

    def _texture(
        self, info: dict[str, Any], attributes: dict[str, Any], used: IntArray
    ) -> tuple[FileTexture | None, FloatArray | None]:
        """Return the texture of a material, and its coordinates at vertices."""
        texture = self._item("textures", info["index"])
        webp = texture.get("extensions", {}).get("EXT_texture_webp", {})
        source = webp.get("source", texture.get("source"))
        if source is None:
            self.file.left_out(
                "a texture of a kind that is not read, such as KTX2 (KHR_texture_basisu)"
            )
            return None, None
        image, sampler = self._item("images", source), {}
        if "sampler" in texture:
            sampler = self._item("samplers", texture["sampler"])
        wrap = (
            _WRAPS.get(sampler.get("wrapS"), "repeat"),
            _WRAPS.get(sampler.get("wrapT"), "repeat"),
        )
        name = f"image {source}" if image.get("uri", "data:").startswith("data:") else image["uri"]

        def read() -> bytes | None:
            if "bufferView" in image:
                return bytes(self._view(image["bufferView"]))
            return self._resource(image["uri"])

        change = info.get("extensions", {}).get("KHR_texture_transform", {})
        key = f"TEXCOORD_{change.get('texCoord', info.get('texCoord', 0))}"
        found = self.file.texture(name, read, wrap)
        if found is None or key not in attributes:
            if found is not None:
                self.file.left_out(f"a texture of triangles without its coordinates, {key}")
            return None, None
        uv = self._values(attributes[key], used)
        turn, (u, v) = change.get("rotation", 0.0), (uv * change.get("scale", (1.0, 1.0))).T
        uv = np.stack(
            (np.cos(turn) * u + np.sin(turn) * v, np.cos(turn) * v - np.sin(turn) * u), axis=1
        )
        return found, uv + change.get("offset", (0.0, 0.0))


def _local(node: dict[str, Any]) -> FloatArray:
    """Return the motion of a node in the one above it, [4, 4]."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    t, r, s = (
        np.array(node[key], dtype=np.float64)[None] if key in node else None
        for key in ("translation", "rotation", "scale")
    )
    placed: FloatArray = _placed(t, r, s)[0]
    return placed


def _placed(
    translations: FloatArray | None, rotations: FloatArray | None, scales: FloatArray | None
) -> FloatArray:
    """Return motions [I, 4, 4] that scale [I, 3], rotate by quaternions x y z w, and translate."""
    count = max(
        len(each)
        for each in (translations, rotations, scales, np.zeros((1, 3)))
        if each is not None
    )
    motions = np.tile(np.eye(4), (count, 1, 1))
    if rotations is not None:
        x, y, z, w = (rotations / np.linalg.norm(rotations, axis=1, keepdims=True)).T
        motions[:, :3, :3] = np.stack(
            (
                (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
                (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
                (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
            )
        ).transpose(2, 0, 1)
    if scales is not None:
        motions[:, :3, :3] *= scales[:, None, :]
    if translations is not None:
        motions[:, :3, 3] = translations
    return motions
