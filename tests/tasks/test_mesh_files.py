"""Mesh files of other people's programs: shapes, colours and textures, and what is left out."""

import base64
import contextlib
import io
import json
import math
import struct

import numpy as np
import pytest
from PIL import Image, ImageCms

from npa_envs.errors import NPAError
from npa_envs.tasks.targets.mesh_parts import triangulated
from npa_envs.tasks.targets.meshes import RADIUS, load_mesh
from npa_envs.tasks.targets.views import load_views

CUBE = np.array([(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)], dtype=np.float32)
SIDES = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (1, 3, 7, 5), (0, 4, 6, 2)]
TRIANGLES = np.array([t for a, b, c, d in SIDES for t in ((a, b, c), (a, c, d))], dtype=np.uint16)
CUBE_AREA = 6 * (2 * RADIUS / math.sqrt(3)) ** 2
ORANGE = (200, 50, 20)
ORANGE_FACTOR = [0.57758044, 0.03189603, 0.00699541, 1.0]


def volume(mesh):
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return (a * np.cross(b, c)).sum() / 6


def shades(mesh):
    """Return the different colours of corners, 0 to 255."""
    return {tuple(map(int, row)) for row in (255 * mesh.colours).round().reshape(-1, 3)}


def cube(mesh, *colours):
    """Assert that a mesh is a cube of these colours."""
    area, _ = covered(mesh.vertices, mesh.faces)
    assert (len(mesh.faces), area) == (12, pytest.approx(CUBE_AREA))
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
VECTORS = {"componentType": 5126, "type": "VEC3"}
PRIMITIVE, DRACO = {"attributes": {"POSITION": 0}}, {"KHR_draco_mesh_compression": {}}


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
    rows, places = sparse.view(bytes(top.tolist())), sparse.view(np.float32(tall[top]).tobytes())
    changes = {
        "indices": {"bufferView": rows, "componentType": 5121},
        "values": {"bufferView": places},
    }
    sparse.part(positions=sparse.values(CUBE, sparse={"count": 4, **changes}))
    moved = morph.values(np.float32(2 * (tall - CUBE)))
    morph.part({"weights": [0.5]}, more={"targets": [{"POSITION": moved}]})
    joints, weights = np.zeros((8, 4), dtype=np.uint8), np.zeros((8, 4), dtype=np.float32)
    joints[top, 0], weights[:, 0] = 1, 1
    bones = {"JOINTS_0": skin.values(joints), "WEIGHTS_0": skin.values(weights)}
    skin.part({"skin": 0, "translation": [9, 9, 9]}, **bones)
    upper = {"translation": [0, 1, 0]}
    skin.add("skins", joints=[skin.add("nodes", children=[2]), skin.add("nodes", **upper)])
    lengths = np.array([1, 2, 1]) * 2 * RADIUS / math.sqrt(6)
    for gltf in (sparse, morph, skin):
        assert np.ptp(gltf.read(tmp_path).vertices, axis=0) == pytest.approx(lengths)
    told = "mesh.glb: left out: morph targets but with the weights that it gives them"
    assert caplog.messages.count(told) == 1


def test_nodes_place_their_meshes_and_mirrors_keep_the_outside(tmp_path):
    gltf = Gltf()
    gltf.part({"scale": [-1, 1, 1], "rotation": [0, 0, math.sqrt(0.5), math.sqrt(0.5)]})
    cube(gltf.read(tmp_path), (255, 255, 255))
    matrix = [0, 2, 0, 0, 1, 0, 0, 0, 0, 0, 1, 0, 5, 6, 7, 1]
    mesh = Gltf().part({"matrix": matrix}).read(tmp_path)
    # Columns are stored one after another: x becomes 2 y.
    lengths = np.array([1, 2, 1]) * 2 * RADIUS / math.sqrt(6)
    assert np.ptp(mesh.vertices, axis=0) == pytest.approx(lengths)
    assert volume(mesh) > 0


def test_skipped_transparency_and_light_are_told(tmp_path, caplog):
    gltf = Gltf()
    ghost = base([1, 1, 1, 0.0]) | {"alphaMode": "BLEND", "name": "ghost"}
    lamp = base([0, 0, 0, 1]) | {"emissiveFactor": ORANGE_FACTOR[:3]}
    gloss = {"KHR_materials_pbrSpecularGlossiness": {"diffuseFactor": [*ORANGE_FACTOR[:3], 0.4]}}
    glass = {"extensions": gloss, "alphaMode": "BLEND", **base([1, 1, 1, 1])}
    opaque = base([*ORANGE_FACTOR[:3], 0.1])
    for k, material in enumerate((opaque, ghost, lamp, glass)):
        gltf.part({"translation": [2 * k, 0, 0]}, material=material)
    mesh = gltf.read(tmp_path)
    assert (len(mesh.faces), shades(mesh)) == (36, {ORANGE})
    assert [text.split(": ", 2)[2] for text in caplog.messages] == [
        "the invisible triangles of material 'ghost'",
        "light: what a black material emits is read as its colour",
        "transparency: all is opaque",
    ]


def test_alpha_of_colours_of_vertices_is_told_and_hides_what_has_none(tmp_path, caplog):
    gltf = Gltf()
    for k, alpha in enumerate((0, 255, 100)):
        colours = gltf.values(np.tile((255, 0, 0, alpha), (8, 1)).astype(np.uint8), normalized=True)
        material = {"alphaMode": "BLEND", "name": f"m{k}"}
        gltf.part({"translation": [2 * k, 0, 0]}, material=material, COLOR_0=colours)
    mesh = gltf.read(tmp_path)
    assert (len(mesh.faces), shades(mesh)) == (24, {(255, 0, 0)})
    (tmp_path / "mesh.off").write_bytes(off("COFF\n8 6 0", (*ORANGE, 100)))
    cube(load_mesh(tmp_path / "mesh.off"), ORANGE)
    assert [text.partition(": left out: ")[2] for text in caplog.messages] == [
        "the invisible triangles of material 'm0'",
        *["transparency: all is opaque"] * 2,
    ]


def test_bytes_after_the_end_of_a_glb_file_are_not_read(tmp_path):
    path = Gltf().part(material=base([1, 0, 0, 1])).save(tmp_path / "mesh.glb")
    path.write_bytes(path.read_bytes() + b"later")
    cube(load_mesh(path), (255, 0, 0))


def test_colours_of_corners_replace_those_of_materials_with_a_word(tmp_path, caplog):
    (tmp_path / "m.mtl").write_text("newmtl m\nKd 0 1 0\n", encoding="utf-8")
    text = "mtllib m.mtl\nusemtl m\n" + obj_rows(UNIT) + OBJ_SIDES
    (tmp_path / "mesh.obj").write_text(text, encoding="utf-8")
    cube(load_mesh(tmp_path / "mesh.obj"), ORANGE)
    line = "mesh.obj: left out: colours of materials where corners have some"
    assert caplog.messages == [line]


def test_profiles_of_textures_are_ignored_in_gltf_alone(tmp_path):
    """As glTF 2.0 says; other formats say nothing of them."""
    swapped = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    swapped = swapped.replace(b"rXYZ", b"tXYZ").replace(b"bXYZ", b"rXYZ").replace(b"tXYZ", b"bXYZ")
    Image.new("RGB", (2, 2), (255, 0, 0)).save(tmp_path / "t.png", icc_profile=swapped)
    gltf = Gltf()
    texture = gltf.add("textures", source=gltf.add("images", uri="t.png"))
    gltf.part(material=base(index=texture), TEXCOORD_0=gltf.values(UV))
    assert gltf.read(tmp_path).textures[0].pixels[0, 0].tolist() == [255, 0, 0]
    head = "comment TextureFile t.png\n"
    rows = [[*corner, 0.5, 0.5] for corner in CORNERS]
    (tmp_path / "t.ply").write_bytes(ply(rows, QUADS, "float s, float t", comment=head))
    assert load_mesh(tmp_path / "t.ply").textures[0].pixels[0, 0, 2] > 200


def test_text_files_find_their_data_and_say_what_is_not_there(tmp_path, caplog):
    gltf = Gltf()
    gltf.part(material=base([0, 1, 0, 1], index=gltf.texture()), TEXCOORD_0=gltf.values(UV))
    gltf.root["images"][0] = {"uri": "Textures%20of%20it\\Red.PNG"}
    gltf.root["buffers"] = [{"byteLength": len(gltf.data), "uri": "parts/my%20data.bin"}]
    path = tmp_path / "mesh.gltf"
    path.write_text(json.dumps(gltf.root), encoding="utf-8")
    with pytest.raises(NPAError, match=r"needs 'parts/my%20data.bin', which is not there"):
        load_mesh(path)
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts/my data.bin").write_bytes(gltf.data)
    cube(load_mesh(path), (0, 255, 0))
    missing = "mesh.gltf: left out: a texture: 'Red.PNG' is not there: put it beside the file"
    assert caplog.messages == [missing]
    (tmp_path / "red.png").write_bytes(png(HALVES))
    assert len(load_mesh(path).textures) == 1
    (tmp_path / "red.png").write_bytes(b"no picture")
    assert load_mesh(path).textures == ()
    assert "'Red.PNG' must be a picture" in caplog.messages[-1]
    inline = base64.b64encode(gltf.data).decode()
    gltf.root["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{inline}"
    path.write_text(json.dumps(gltf.root), encoding="utf-8")
    cube(load_mesh(path), (0, 255, 0))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        ({"nodes": [{"mesh": 0, "children": [0]}]}, "nodes that form a tree"),
        ({"nodes": [{"children": [1]}, {"children": [0]}]}, "nodes that form a tree"),
        ({"accessors": [{"count": 2**40} | VECTORS]}, "at most 134217728 numbers"),
        (
            {"meshes": [{"primitives": 9000 * [PRIMITIVE]}], "nodes": 8 * [{"mesh": 0}]}
            | {"scenes": [{"nodes": list(range(8))}]},
            "at most 8388608 triangles, 65536 nodes and 65536 parts",
        ),
        ({"bufferViews": [{"buffer": 0, "byteLength": 10**9}]}, "must have all of bufferViews 0"),
        ({"asset": {"version": "1.0"}}, r"must be of glTF 2.0, got '1.0'"),
        ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "KHR_draco_mesh_compression"),
        ({"extensionsRequired": ["EXT_meshopt_compression"]}, "EXT_meshopt_compression"),
        ({"extensionsRequired": ["XX_new"]}, "XX_new"),
        (
            {"nodes": [{"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {"attributes": {}}}}]},
            "EXT_mesh_gpu_instancing",
        ),
        (
            {"accessors": [{"count": 8} | VECTORS]}
            | {"meshes": [{"primitives": [PRIMITIVE | {"extensions": DRACO}]}]},
            "KHR_draco_mesh_compression",
        ),
    ],
)
def test_what_is_damaged_or_not_read_of_gltf_is_refused_by_name(tmp_path, damage, message):
    gltf = Gltf().part()
    gltf.root |= damage
    with pytest.raises(NPAError, match=message):
        gltf.read(tmp_path)


def test_no_damage_of_a_byte_is_more_than_an_error(tmp_path):
    gltf = Gltf()
    gltf.part(material=base(index=gltf.texture()), TEXCOORD_0=gltf.values(UV))
    whole = gltf.save(tmp_path / "mesh.glb").read_bytes()
    random = np.random.default_rng(0)
    read = 0
    for _ in range(300):
        damaged = bytearray(whole)
        for place in random.integers(12, len(whole), 3):
            damaged[place] = random.integers(256)
        (tmp_path / "mesh.glb").write_bytes(damaged)
        with contextlib.suppress(NPAError):
            read += np.isfinite(load_mesh(tmp_path / "mesh.glb").vertices).all()
    assert 0 < read < 300


# Formats of text, and PLY.


def ply(vertices, faces, vertex="", face="", kind="ascii", count="uchar int", comment=""):
    """Return a PLY file; rows of numbers, a face's first is a list; properties are `type name`."""
    head = f"ply\nformat {kind} 1.0\n{comment}element vertex {len(vertices)}\n"
    names = ["float x", "float y", "float z", *filter(None, vertex.split(", "))]
    head += "".join(f"property {name}\n" for name in names) + f"element face {len(faces)}\n"
    extra = list(filter(None, face.split(", ")))
    head += f"property list {count} vertex_indices\n"
    head += "".join(f"property {name}\n" for name in extra) + "end_header\n"
    if kind == "ascii":
        rows = [*vertices, *([len(f), *f, *more] for f, *more in faces)]
        return (head + "".join(" ".join(map(str, row)) + "\n" for row in rows)).encode()
    codes = {"float": "f", "uchar": "B", "int": "i", "ushort": "H", "double": "d"}
    data = b"".join(
        struct.pack(">" + "".join(codes[name.split()[0]] for name in names), *row)
        for row in vertices
    )
    for corners, *more in faces:
        form = f">B{len(corners)}i" + "".join(codes[name.split()[0]] for name in extra)
        data += struct.pack(form, len(corners), *corners, *more)
    return head.encode() + data


RGB = "red, {0} green, {0} blue"
SIX = [(255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 0), (0, 255, 255), (255, 0, 255)]
CORNERS = CUBE.tolist()


def off(head, more=(), *, faces=()):
    rows = [[*corner, *more] for corner in CORNERS]
    sides = [[4, *side, *shade] for side, shade in zip(SIDES, faces or [()] * 6, strict=True)]
    return "\n".join(
        [head, "# corners", *(" ".join(map(str, row)) for row in (*rows, *sides))]
    ).encode()


def stl(words, head=b""):
    rows = (
        struct.pack("<12fH", 0, 0, 0, *CUBE[t].ravel(), w)
        for t, w in zip(TRIANGLES, words, strict=True)
    )
    return head.ljust(80) + struct.pack("<I", 12) + b"".join(rows)


ROWS = [[*corner, *ORANGE] for corner in CORNERS]
UNIT = [[*corner, 0.7843, 0.19608, 0.07843] for corner in CORNERS]
DEEP = [[*corner, 51400, 12850, 5140] for corner in CORNERS]
QUADS = [[side] for side in SIDES]
SIX_QUADS = [[side, *shade] for side, shade in zip(SIDES, SIX, strict=True)]
MIXED = [[side, *ORANGE] for side in (*SIDES[1:], *TRIANGLES[:2].tolist())]
BYTES, FLOATS = "uchar " + RGB.format("uchar"), "float " + RGB.format("float")
DIFFUSE = (
    BYTES.replace(" red", " diffuse_red").replace(" g", " diffuse_g").replace(" b", " diffuse_b")
)
SHORTS, BIG = "ushort " + RGB.format("ushort"), "binary_big_endian"


def obj_rows(rows, word="v"):
    return "".join(f"{word} {' '.join(map(str, row))}\n" for row in rows)


OBJ, OBJ_SIDES = obj_rows(CORNERS), obj_rows([[k + 1 for k in side] for side in SIDES], "f")
LIBRARY = "mtllib my colours.mtl\n"
MATERIALS = OBJ_SIDES.replace("f 1 ", "f 1/1 ").replace("\nf", "\nusemtl green\nf", 1)
BLOCKS = "".join(obj_rows([CORNERS[k] for k in side]) + "f -4 -3 \\\n-2 -1\n" for side in SIDES)
RED, BLUE = (255, 0, 0), (0, 0, 255)


@pytest.mark.parametrize(
    ("name", "content", "colours"),
    [
        ("a.ply", ply(ROWS, QUADS, BYTES), {ORANGE}),
        ("b.ply", ply(ROWS, QUADS, DIFFUSE), {ORANGE}),
        ("c.ply", ply(ROWS, QUADS, FLOATS), {ORANGE}),
        ("d.ply", ply(UNIT, QUADS, FLOATS), {ORANGE}),
        ("e.ply", ply(DEEP, QUADS, SHORTS, kind=BIG), {ORANGE}),
        ("f.ply", ply(CORNERS, SIX_QUADS, face=BYTES), set(SIX)),
        ("g.ply", ply(CORNERS, MIXED, face=BYTES, kind=BIG), {ORANGE}),
        ("a.off", off("COFF\n8 6 0", (*ORANGE, 255)), {ORANGE}),
        ("b.off", off("OFF 8 6 12", (0.7843, 0.19608, 0.07843, 1)), {ORANGE}),
        ("c.off", off("OFF\n8 6 0", faces=SIX), set(SIX)),
        ("d.off", off("CNOFF\n8 6 0", (0, 0, 1, *ORANGE, 255)), {ORANGE}),
        ("a.stl", stl([0x7C00 | 0x8000] * 11 + [0x801F]), {RED, BLUE}),
        ("b.stl", stl([0x8000] * 11 + [0x7C00], b"COLOR=" + bytes((*ORANGE, 255))), {ORANGE, BLUE}),
        ("a.obj", obj_rows(UNIT) + OBJ_SIDES, {ORANGE}),
        ("b.obj", LIBRARY + "usemtl the red\n" + OBJ + OBJ_SIDES, {RED}),
        ("c.obj", (LIBRARY + OBJ + "usemtl the red\n" + OBJ_SIDES).encode("utf-16"), {RED}),
        ("d.obj", LIBRARY + "vt 0 0\nusemtl the red\n" + OBJ + MATERIALS, {RED, (0, 255, 0)}),
        ("e.obj", LIBRARY + "usemtl the red\n" + BLOCKS, {RED}),
    ],
)
def test_colours_of_corners_polygons_and_materials_are_read(
    tmp_path, caplog, name, content, colours
):
    pytest.importorskip("trimesh")
    (tmp_path / "my colours.mtl").write_text(
        "newmtl the red\nKd 1 0 0\nnewmtl green\nKd 0 1 0\n", encoding="utf-8"
    )
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    cube(load_mesh(path), *colours)
    assert caplog.messages == []


def test_stl_files_may_have_more_at_their_end_but_not_less(tmp_path, caplog):
    pytest.importorskip("trimesh")
    path, content = tmp_path / "a.stl", stl([0x801F] * 12)
    path.write_bytes(content + b"more")
    cube(load_mesh(path), BLUE)
    assert caplog.messages == ["a.stl: left out: 4 bytes after the end"]
    path.write_bytes(content[:-50])
    with pytest.raises(NPAError, match="ends too early"):
        load_mesh(path)
    row = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\n"
    path.write_text(f"solid\n{row * 2}endsolid\n", encoding="utf-8")
    assert len(load_mesh(path).faces) == 2
    path.write_text(f"solid\n{row}{row.replace('0 1 0', '0 1,5 0')}endsolid\n", encoding="utf-8")
    with pytest.raises(NPAError, match="cannot be read as a mesh"):
        load_mesh(path)


def test_shapes_without_colours_are_grey_with_a_word(tmp_path, caplog):
    (tmp_path / "miss.obj").write_text(
        "mtllib none.mtl\n" + OBJ + "usemtl r\nl 1 2\n" + OBJ_SIDES, encoding="utf-8"
    )
    mesh = load_mesh(tmp_path / "miss.obj")
    cube(mesh, (153, 153, 153))
    assert mesh.summary == "miss.obj: 12 triangles, no colours"
    assert [text.split(": ", 2)[2] for text in caplog.messages] == [
        "1 element of lines",
        "the materials of 'none.mtl', which is not there",
        "the material 'r', which no .mtl file here has",
        "colours, as the file has none: all is grey",
    ]


def test_textures_of_obj_and_ply_files_have_v_upwards(tmp_path, caplog):
    for name in ("halves.png", "my halves.png"):
        (tmp_path / name).write_bytes(png(HALVES))
    (tmp_path / "t.mtl").write_text(
        "newmtl r\nKd 0 0 0\nmap_Kd -s 2 3 1 -clamp on my halves.png\nd 0.5\n", encoding="utf-8"
    )
    text = (
        "mtllib t.mtl\nusemtl r\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n"
    )
    (tmp_path / "t.obj").write_text(text, encoding="utf-8")
    mesh = load_mesh(tmp_path / "t.obj")
    assert mesh.uv.tolist() == [[[0, 1], [1, 1], [0, 0]]]
    assert np.array_equal(mesh.textures[0].pixels, HALVES)
    assert shades(mesh) == {(255, 255, 255)}
    assert mesh.summary == "t.obj: 1 triangle, texture 2 x 2, 1 material"
    assert [text.split(": ", 2)[2] for text in caplog.messages] == [
        "options of the texture '-s 2 3 1 -clamp on my halves.png'",
        "black of a material with a texture, as it would hide that",
        "transparency: all is opaque",
    ]
    square = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
    image = "comment TextureFile halves.png\n"
    rows = [[*corner, corner[0], corner[1]] for corner in square]
    (tmp_path / "a.ply").write_bytes(ply(rows, [[range(4)]], "float s, float t", comment=image))
    own = [[range(4), 8, *(k for row in square for k in row[:2])]]
    (tmp_path / "b.ply").write_bytes(
        ply(square, own, face="list uchar float texcoord", comment=image)
    )
    for name in ("a.ply", "b.ply"):
        mesh = load_mesh(tmp_path / name)
        assert mesh.uv[0].tolist() == [[0, 1], [1, 1], [1, 0]]
        assert mesh.textures[0].wrap == ("repeat", "repeat")


# Polygons.


def star(count, seed):
    """Return a polygon that is not convex, in a plane of space, and its area."""
    random = np.random.default_rng(seed)
    angle = np.sort(random.uniform(0, math.tau, count))
    flat = random.uniform(0.2, 1.0, (count, 1)) * np.stack((np.cos(angle), np.sin(angle)), axis=1)
    following = np.roll(flat, -1, axis=0)
    size = (flat[:, 0] * following[:, 1] - flat[:, 1] * following[:, 0]).sum() / 2
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    return flat @ turn[:2] + random.normal(size=3), size


def covered(points, triangles):
    """Return the sum of areas of triangles, and that of areas with the direction of the sum."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    outward = np.cross(b - a, c - a) / 2
    return np.linalg.norm(outward, axis=1).sum(), np.linalg.norm(outward.sum(axis=0))


@pytest.mark.parametrize("count", [4, 5, 9, 30, 300])
def test_polygons_that_are_not_convex_are_covered_once(count):
    stars = [star(count, seed) for seed in range(6)]
    counts = np.full(6, count)
    points = np.concatenate([points for points, _ in stars])
    triangles, owners = triangulated(points, counts)
    assert np.bincount(owners).tolist() == [count - 2] * 6
    for k, (_, size) in enumerate(stars):
        assert covered(points, triangles[owners == k]) == pytest.approx((size, size), rel=1e-9)


def test_a_hole_that_is_joined_to_the_outline_stays_open():
    outline = [(0, 0), (4, 0), (4, 4), (0, 4)]
    hole = [(1, 1), (1, 3), (3, 3), (3, 1)]
    ring = np.array([*outline, outline[0], *hole, hole[0]], dtype=float)
    points = np.pad(ring, ((0, 0), (0, 1)))
    triangles, _ = triangulated(points, np.array([len(points)]))
    assert covered(points, triangles) == pytest.approx((12, 12))
    middles = points[triangles].mean(axis=1)[:, :2]
    assert not ((middles > 1) & (middles < 3)).all(axis=1).any()


@pytest.mark.parametrize("suffix", ["obj", "ply", "off"])
def test_arrows_in_files_keep_their_area(tmp_path, suffix):
    """A dart has its notch at any of its four corners, an arrow with a shaft has seven."""
    dart = [(0, 0, 0), (2, 1, 0), (0, 2, 0), (0.5, 1, 0)]
    shaft = [(0, 1, 0), (2, 1, 0), (2, 0, 0), (4, 1.5, 0), (2, 3, 0), (2, 2, 0), (0, 2, 0)]
    for size, outline in [(1.5, dart[k:] + dart[:k]) for k in range(4)] + [(5.0, shaft)]:
        order = list(range(len(outline)))
        head, rows = f"OFF\n{len(outline)} 1 0", obj_rows(outline, "")
        content = {
            "obj": obj_rows(outline) + obj_rows([[k + 1 for k in order]], "f"),
            "ply": ply(outline, [[order]]).decode(),
            "off": f"{head}\n{rows}{len(order)} {obj_rows([order], '')}",
        }[suffix]
        (tmp_path / f"arrow.{suffix}").write_text(content, encoding="utf-8")
        mesh = load_mesh(tmp_path / f"arrow.{suffix}")
        scale = np.ptp(mesh.vertices[:, 0]) / np.ptp(np.array(outline)[:, 0])
        assert covered(mesh.vertices, mesh.faces) == pytest.approx((size * scale**2,) * 2)


def test_views_say_what_was_read(tmp_path):
    path = Gltf().part(material=base(ORANGE_FACTOR)).save(tmp_path / "box.glb")
    target = load_views(path, resolution=8, training_count=1, held_out_count=1)
    assert target.summary == "box.glb: 12 triangles, 1 material"
