"""Mesh files of other people's programs: shapes, colours and textures, and what is left out."""

import io
import json
import math
import struct

import numpy as np
import pytest
from PIL import Image

from npa_envs.errors import NPAError
from npa_envs.tasks.targets.meshes import RADIUS, load_mesh
from npa_envs.tasks.targets.notes import left_out

CUBE = np.array([(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)], dtype=np.float32)
SIDES = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (1, 3, 7, 5), (0, 4, 6, 2)]
TRIANGLES = np.array([t for a, b, c, d in SIDES for t in ((a, b, c), (a, c, d))], dtype=np.uint16)
CUBE_AREA = 6 * (2 * RADIUS / math.sqrt(3)) ** 2
ORANGE = (200, 50, 20)
ORANGE_FACTOR = [0.57758044, 0.03189603, 0.00699541, 1.0]


@pytest.fixture(autouse=True)
def _told_again():
    left_out.cache_clear()


def area(mesh):
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2


def volume(mesh):
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return (a * np.cross(b, c)).sum() / 6


def shades(mesh):
    """Return the different colours of corners, 0 to 255."""
    return {tuple(map(int, row)) for row in (255 * mesh.colours).round().reshape(-1, 3)}


def cube(mesh, *colours):
    """Assert that a mesh is a cube of these colours."""
    assert (len(mesh.faces), area(mesh)) == (12, pytest.approx(CUBE_AREA))
    assert volume(mesh) == pytest.approx((CUBE_AREA / 6) ** 1.5)
    assert shades(mesh) == set(colours)


def png(pixels):
    file = io.BytesIO()
    Image.fromarray(np.asarray(pixels, dtype=np.uint8)).save(file, "PNG")
    return file.getvalue()


HALVES = np.repeat([[(255, 0, 0), (0, 0, 255)]], 2, axis=0)
"""Red on the left and blue on the right, 2 x 2."""


class Gltf:
    """A glTF file that is written."""

    def __init__(self, **root):
        self.data = b""
        self.root = {"asset": {"version": "2.0"}, "scenes": [{"nodes": []}], **root}

    def add(self, kind, **item):
        self.root.setdefault(kind, []).append(item)
        return len(self.root[kind]) - 1

    def view(self, data):
        self.data += b"\0" * (-len(self.data) % 4)
        start, self.data = len(self.data), self.data + data
        return self.add("bufferViews", buffer=0, byteOffset=start, byteLength=len(data))

    def values(self, array, **more):
        array = np.asarray(array)
        codes = dict(zip("bBhHIf", (5120, 5121, 5122, 5123, 5125, 5126), strict=True))
        names = {2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
        return self.add(
            "accessors",
            bufferView=self.view(array.tobytes()),
            componentType=codes[array.dtype.char],
            type="SCALAR" if array.ndim == 1 else names[array.shape[1]],
            count=len(array),
            **more,
        )

    def texture(self, pixels=HALVES, **more):
        image = self.add("images", bufferView=self.view(png(pixels)), mimeType="image/png")
        return self.add("textures", source=image, **more)

    def part(
        self, node=None, positions=CUBE, indices=TRIANGLES, material=None, more=(), **attributes
    ):
        """Add a node with a mesh of one primitive."""
        position = positions if isinstance(positions, int) else self.values(positions)
        primitive = {"attributes": {"POSITION": position, **attributes}, **dict(more)}
        if indices is not None:
            primitive["indices"] = self.values(np.asarray(indices, dtype=np.uint16).ravel())
        if material is not None:
            primitive["material"] = self.add("materials", **material)
        mesh = self.add("meshes", primitives=[primitive])
        self.root["scenes"][0]["nodes"].append(self.add("nodes", mesh=mesh, **(node or {})))
        return self

    def save(self, path):
        self.root["buffers"] = [{"byteLength": len(self.data)}]
        text = json.dumps(self.root).encode()
        text += b" " * (-len(text) % 4)
        data = self.data + b"\0" * (-len(self.data) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text
        chunks += struct.pack("<I4s", len(data), b"BIN\0") + data
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
        return path

    def read(self, folder):
        return load_mesh(self.save(folder / "mesh.glb"))


def base(colour=None, **texture):
    """Return a material with a factor or a texture."""
    surface = {"baseColorFactor": colour} if colour else {}
    return {"pbrMetallicRoughness": surface | ({"baseColorTexture": texture} if texture else {})}


UV = CUBE[:, :2].copy()


def test_a_material_without_a_texture_colours_its_triangles(tmp_path):
    cube(Gltf().part(material=base(ORANGE_FACTOR)).read(tmp_path), ORANGE)
    gltf = Gltf()
    mesh = gltf.part(material=base([1, 0, 0, 1]), TEXCOORD_0=gltf.values(UV)).read(tmp_path)
    cube(mesh, (255, 0, 0))
    assert mesh.textures == ()
    assert mesh.summary == "mesh.glb: 12 triangles, 1 material"


def test_colours_of_vertices_are_linear_and_multiply_the_factor(tmp_path):
    """Half of the light of one half is a quarter, in sRGB 137 of 255."""
    for values, more in (
        (np.tile(np.float32([0.5, 0.5, 0.0]), (8, 1)), {}),
        (np.tile(np.uint8([128, 128, 0, 255]), (8, 1)), {"normalized": True}),
        (np.tile(np.uint16([32768, 32768, 0, 65535]), (8, 1)), {"normalized": True}),
    ):
        gltf = Gltf()
        gltf.part(material=base([0.5, 1, 1, 1]), COLOR_0=gltf.values(values, **more))
        (colour,) = shades(gltf.read(tmp_path))
        assert colour == pytest.approx((137, 188, 0), abs=1)


def test_textures_are_multiplied_by_factors_and_take_their_own_coordinates(tmp_path):
    gltf = Gltf()
    other = 0.25 * UV
    info = {
        "index": gltf.texture(sampler=gltf.add("samplers", wrapS=33071, wrapT=33648)),
        "texCoord": 1,
    }
    uv = {"TEXCOORD_0": gltf.values(UV), "TEXCOORD_1": gltf.values(other)}
    mesh = gltf.part(material=base([1, 0, 0, 1], **info), **uv).read(tmp_path)
    cube(mesh, (255, 0, 0))
    assert np.array_equal(mesh.textures[0].pixels, HALVES)
    assert mesh.textures[0].wrap == ("clamp", "mirror")
    assert mesh.texture_of_face.tolist() == [0] * 12
    assert np.allclose(mesh.uv, other[TRIANGLES])
    assert mesh.summary == "mesh.glb: 12 triangles, texture 2 x 2, 1 material"


def test_coordinates_of_textures_are_quantised_and_transformed(tmp_path):
    """A quarter turn leads u to -v and v to u, where v goes down."""
    gltf = Gltf(extensionsRequired=["KHR_texture_transform", "KHR_mesh_quantization"])
    change = {"offset": [0.5, 0.25], "scale": [2.0, 3.0], "rotation": math.pi / 2}
    info = {"index": gltf.texture(), "extensions": {"KHR_texture_transform": change}}
    stored = gltf.values(
        (255 * UV).astype(np.uint8).repeat(2, axis=1)[:, ::2].copy(), normalized=True
    )
    shape = gltf.values((100 * CUBE).astype(np.int16))
    mesh = gltf.part(positions=shape, material=base(**info), TEXCOORD_0=stored).read(tmp_path)
    cube(mesh, (255, 255, 255))
    u, v = 2.0 * UV[TRIANGLES, 0], 3.0 * UV[TRIANGLES, 1]
    assert np.allclose(mesh.uv, np.stack((v + 0.5, -u + 0.25), axis=-1))


def test_parts_may_be_coloured_in_different_ways(tmp_path):
    gltf = Gltf()
    gltf.part(material=base(index=gltf.texture()), TEXCOORD_0=gltf.values(UV))
    gltf.part({"translation": [2, 0, 0]}, material=base([0, 1, 0, 1]))
    blue = gltf.values(np.tile(np.float32([0, 0, 1]), (8, 1)))
    mesh = gltf.part({"translation": [4, 0, 0]}, COLOR_0=blue).read(tmp_path)
    assert len(mesh.vertices) == 24
    assert mesh.texture_of_face.tolist() == [0] * 12 + [-1] * 24
    for k, colour in enumerate([(1, 1, 1), (0, 1, 0), (0, 0, 1)]):
        assert np.allclose(mesh.colours[12 * k : 12 * (k + 1)], colour)


@pytest.mark.parametrize(
    "name", ["KHR_draco_mesh_compression", "EXT_meshopt_compression", "XX_new"]
)
def test_required_extensions_are_read_or_refused_by_name(tmp_path, name):
    with pytest.raises(NPAError, match=name):
        Gltf(extensionsRequired=[name]).part().read(tmp_path)


def test_compressed_parts_without_their_numbers_are_refused(tmp_path):
    gltf = Gltf(extensionsUsed=["KHR_draco_mesh_compression"]).part()
    empty = gltf.add("accessors", componentType=5126, type="VEC3", count=8)
    gltf.part(positions=empty, more={"extensions": {"KHR_draco_mesh_compression": {}}})
    with pytest.raises(NPAError, match="KHR_draco_mesh_compression"):
        gltf.read(tmp_path)


def test_instances_are_drawn_each(tmp_path):
    gltf = Gltf(extensionsRequired=["EXT_mesh_gpu_instancing"])
    where = {
        "TRANSLATION": gltf.values(np.float32([(0, 0, 0), (3, 0, 0), (6, 0, 0)])),
        "SCALE": gltf.values(np.float32([(1, 1, 1), (2, 1, 1), (-1, 1, 1)])),
    }
    node = {"extensions": {"EXT_mesh_gpu_instancing": {"attributes": where}}}
    mesh = gltf.part(node, material=base(ORANGE_FACTOR)).read(tmp_path)
    assert (len(mesh.faces), len(mesh.vertices), shades(mesh)) == (36, 24, {ORANGE})
    left, right = mesh.vertices[:, 0].min(), mesh.vertices[:, 0].max()
    # From 0 to 6, of which cubes fill 1 + 2 + 1; the mirrored one is not inside out.
    assert volume(mesh) == pytest.approx(4 * ((right - left) / 6) ** 3)


@pytest.mark.parametrize(
    ("mode", "indices", "count"),
    [(4, [0, 1, 2, 0, 2, 3], 2), (5, [0, 1, 3, 2], 2), (6, [0, 1, 2, 3], 2), (6, None, 2)],
)
def test_strips_and_fans_cover_what_their_triangles_do(tmp_path, mode, indices, count):
    square = np.float32([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)])
    gltf = Gltf().part(positions=square, indices=indices, more={"mode": mode})
    mesh = gltf.read(tmp_path)
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    assert np.cross(b - a, c - a)[:, 2] == pytest.approx([2 * RADIUS**2] * count)


def test_points_lines_animations_and_unknown_looks_are_told(tmp_path, caplog):
    gltf = Gltf(extensionsUsed=["KHR_materials_unlit"], animations=[{}, {}])
    gltf.part(material=base(ORANGE_FACTOR)).part(indices=None, more={"mode": 0})
    cube(gltf.read(tmp_path), ORANGE)
    assert caplog.messages == [
        "mesh.glb: left out: 2 animations",
        "mesh.glb: left out: what 'KHR_materials_unlit' would change",
        "mesh.glb: left out: 1 part of points or lines",
    ]


def test_sparse_accessors_and_morph_targets_move_vertices(tmp_path, caplog):
    """The upper corners are moved up by 1, by 2 times one half, and by a joint."""
    top = np.flatnonzero(CUBE[:, 1] == 1)
    tall = CUBE * (1, 2, 1)
    sparse, morph, skin = Gltf(), Gltf(), Gltf()
    accessor = sparse.root.setdefault("accessors", [{}])
    changes = {
        "indices": {
            "bufferView": sparse.view(top.astype(np.uint8).tobytes()),
            "componentType": 5121,
        },
        "values": {"bufferView": sparse.view(tall[top].astype(np.float32).tobytes())},
    }
    accessor[0] = {
        "type": "VEC3",
        "componentType": 5126,
        "count": 8,
        "sparse": {"count": 4, **changes},
    }
    accessor[0]["bufferView"] = sparse.view(CUBE.tobytes())
    sparse.part(positions=0)
    morph.part(
        more={"targets": [{"POSITION": morph.values((2 * (tall - CUBE)).astype(np.float32))}]}
    )
    morph.root["meshes"][0]["weights"] = [0.5]
    joints, weights = np.zeros((8, 4), dtype=np.uint8), np.zeros((8, 4), dtype=np.float32)
    joints[top, 0], weights[:, 0] = 1, 1
    skin.part(
        {"skin": 0, "translation": [9, 9, 9]},
        JOINTS_0=skin.values(joints),
        WEIGHTS_0=skin.values(weights),
    )
    skin.add(
        "skins", joints=[skin.add("nodes", children=[2]), skin.add("nodes", translation=[0, 1, 0])]
    )
    lengths = (tall.max(0) - tall.min(0)) * 2 * RADIUS / math.sqrt(6)
    for gltf in (sparse, morph, skin):
        mesh = gltf.read(tmp_path)
        assert np.ptp(mesh.vertices, axis=0) == pytest.approx(lengths)
    assert (
        "mesh.glb: left out: morph targets but with the weights that it gives them"
        in caplog.messages
    )


def test_nodes_place_their_meshes_and_mirrors_keep_the_outside(tmp_path):
    gltf = Gltf()
    gltf.part({"scale": [-1, 1, 1], "rotation": [0, 0, math.sqrt(0.5), math.sqrt(0.5)]})
    cube(gltf.read(tmp_path), (255, 255, 255))
    matrix = [0, 2, 0, 0, 1, 0, 0, 0, 0, 0, 1, 0, 5, 6, 7, 1]
    mesh = Gltf().part({"matrix": matrix}).read(tmp_path)
    # Columns are stored one after another: x becomes 2 y.
    assert np.ptp(mesh.vertices, axis=0) == pytest.approx(
        np.array([1, 2, 1]) * 2 * RADIUS / math.sqrt(6)
    )
    assert volume(mesh) > 0
