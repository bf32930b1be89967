"""Small files that would cost gigabytes, block for ever or start programs: cheaply rejected."""

import gzip
import json
import os
import re
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import EpsImagePlugin, Image
from support.processes import run_alone

from npa_envs import NPAError, NPARule, load_rule, save_rule
from npa_envs.measure.benchmark_records import read_record
from npa_envs.runtime import kernel_cache_folder, quiet_warp
from npa_envs.tasks.losses.texture import load_vgg_weights
from npa_envs.tasks.targets.digit_clouds import load_pictures, read_idx
from npa_envs.tasks.targets.images import open_image
from npa_envs.tasks.targets.meshes import load_mesh
from npa_envs.tasks.targets.picture_points import load_target, target_from_image
from npa_envs.tasks.targets.textures import load_texture
from npa_envs.tasks.targets.views import load_views
from npa_envs.training import load_config, preset
from npa_envs.training.checkpoint import load_checkpoint


def configure(path: Path) -> Any:
    return load_config(path, preset("tiny"))


READERS: dict[str, tuple[str, Callable[[Path], Any]]] = {
    "picture": (".png", open_image),
    "texture": (".png", load_texture),
    "mesh": (".ply", load_mesh),
    "rule": (".safetensors", load_rule),
    "state dict": (".pth", load_rule),
    "demo": (".json", load_rule),
    "YAML": (".yaml", configure),
    "TOML": (".toml", configure),
    "JSON": (".json", configure),
    "IDX": ("", read_idx),
    "checkpoint": (".pt", load_checkpoint),
    "VGG": (".pth", load_vgg_weights),
    "record": (".json", lambda path: read_record(path, {}, dict, command="bench")),
}
"""What reads files, and their suffix."""


@pytest.mark.skipif(not Path("/dev/ptmx").exists(), reason="no terminals here")
@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("device", ["/dev/zero", "/dev/random", "/dev/ptmx", "pipe"])
def test_a_device_is_rejected_at_once(tmp_path, reader, device):
    suffix, read = READERS[reader]
    path = tmp_path / f"device{suffix}"
    # To read from a pipe or a terminal would block.
    os.mkfifo(path) if device == "pipe" else path.symlink_to(device)
    with pytest.raises(NPAError, match="pipe or a device"):
        read(path)


# A first run finds no record.
@pytest.mark.parametrize("reader", [reader for reader in READERS if reader != "record"])
@pytest.mark.parametrize("name", ["a\0b", "x" * 300, "~\0", "\ud800"])
def test_names_that_no_file_has_are_rejected(tmp_path, reader, name):
    suffix, read = READERS[reader]
    with pytest.raises(NPAError) as caught:
        read(tmp_path / f"{name}{suffix}")
    assert len(str(caught.value)) < 1200


def test_postscript_that_is_called_a_picture_starts_nothing(tmp_path, monkeypatch):
    ran = []
    monkeypatch.setattr(EpsImagePlugin, "Ghostscript", lambda *a, **k: ran.append(a))
    text = "%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\nshowpage\n%%EOF\n"
    (tmp_path / "drawing.png").write_text(text, encoding="utf-8")
    with pytest.raises(NPAError, match="its content is none of these"):
        open_image(tmp_path / "drawing.png")
    assert not ran


def test_a_compressed_state_dict_is_rejected_unread(tmp_path):
    torch.save({"model.0.weight": torch.zeros(1000, 1000)}, tmp_path / "plain.pth")
    path = tmp_path / "rule.pth"
    with (
        zipfile.ZipFile(tmp_path / "plain.pth") as plain,
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed,
    ):
        for name in plain.namelist():
            packed.writestr(name, plain.read(name))
    for read in (load_rule, load_checkpoint, load_vgg_weights):
        with pytest.raises(NPAError, match=r"must not be compressed, but 40.* bytes are declared"):
            read(path)


@pytest.mark.parametrize(
    ("head", "message"),
    [
        (b"\0\0\x08\x02" + 2 * b"\0\0\xff\xff", "at most 600000000 bytes"),
        (b"\0\0\x08\x41" + 65 * b"\0\0\0\x01", "number of dimensions, 1 to 4"),
        (b"\0\0\x08\x01" + b"\0\0\0\x02", "must hold 2 bytes of data.*holds 2 and more"),
    ],
)
@pytest.mark.parametrize("pack", [bytes, gzip.compress])
def test_idx_files_are_unpacked_as_far_as_their_head_says(tmp_path, head, message, pack):
    (tmp_path / "idx").write_bytes(pack(head + bytes(10_000_000)))
    tracemalloc.start()
    with pytest.raises(NPAError, match=message):
        read_idx(tmp_path / "idx")
    assert tracemalloc.get_traced_memory()[1] < 1_000_000
    tracemalloc.stop()


ALIASES = "\n".join(
    [f"a0: &a0 [{','.join(9 * ['lol'])}]"]
    + [f"a{k + 1}: &a{k + 1} [{','.join(9 * [f'*a{k}'])}]" for k in range(30)]
)
MERGES = "\n".join(
    ["m0: &m0 {" + ", ".join(f"k{k}: 0" for k in range(9)) + "}"]
    + [f"m{k + 1}: &m{k + 1} {{<<: [{','.join(9 * [f'*m{k}'])}]}}" for k in range(12)]
)


TRIANGLE = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]


def test_a_mesh_that_covers_no_pixel_gives_empty_views(tmp_path):
    pytest.importorskip("trimesh")
    far = [*TRIANGLE, [0.0, 1e-2, 0.0], [1e-2, 0.0, 0.0], [10.0, 10.0, 10.0]]
    (tmp_path / "mesh.obj").write_text(
        "".join(f"v {x} {y} {z}\n" for x, y, z in far) + "f 1 4 5\nf 6 6 6\n", encoding="utf-8"
    )
    views = load_views(tmp_path / "mesh.obj", resolution=2, training_count=1, held_out_count=1)
    assert (views.training.pictures == 0.0).all()


@pytest.mark.parametrize(
    "error", [RuntimeError("Failed to load CPU module 'a'"), PermissionError(13, "no"), OSError()]
)
def test_a_damaged_kernel_cache_names_the_folder_and_the_hint(error):
    with pytest.raises(NPAError, match=str(kernel_cache_folder())), quiet_warp():
        raise error
    with pytest.raises(RuntimeError, match="another"), quiet_warp():
        raise RuntimeError("another")


def test_a_kernel_cache_that_cannot_be_made_is_named_with_its_hint(tmp_path):
    (tmp_path / "file").touch()
    start = "from npa_envs.runtime import start_warp; start_warp()"
    done = run_alone(start, WARP_CACHE_PATH=str(tmp_path / "file"))
    assert re.search(rf"NPAError: .*{tmp_path / 'file'}.*remove it.*WARP_CACHE_PATH", done.stderr)


# Small inputs that are rejected, briefly.

RED = (255, 0, 0, 255)


def corners(folder, side=300):
    picture = Image.new("RGBA", (side, side))
    for place in (0, side - 1):
        picture.putpixel((place, place), RED)
    return target_from_image(picture, name="corners")


def line(folder):
    picture = Image.new("RGBA", (6_000, 3), RED)
    return target_from_image(picture, name="line", point_count=64)


def large(folder):
    Image.new("1", (13_300, 13_300)).save(folder / "large.png")
    return open_image(folder / "large.png")


def expanded(folder):
    """Weights that are one number, shown as a matrix of gigabytes."""
    one = torch.zeros(1)
    layers = {f"model.{k}.weight": one.expand(40_000, 40_000) for k in (0, 2)}
    state = layers | {"model.0.bias": one.expand(40_000), "eps0": 0.1, "alpha": 0.1}
    torch.save(state, folder / "rule.pth")
    assert (folder / "rule.pth").stat().st_size < 5000
    return load_rule(folder / "rule.pth")


def wordy(folder):
    path = folder / "rule.safetensors"
    save_rule(NPARule(), path, metadata={"task": "x" * 100_000})
    path.write_bytes(path.read_bytes().replace(b"npa-envs rule", b"npa-envs mule"))
    return load_rule(path)


def text(suffix, content, read=configure):
    def load(folder):
        (folder / f"file{suffix}").write_text(content, encoding="utf-8")
        return read(folder / f"file{suffix}")

    return load


def scene(frame=(), **changes):
    def load(folder):
        view = {"file_path": "./a", "transform_matrix": torch.eye(4).tolist()} | dict(frame)
        content = json.dumps({"camera_angle_x": 0.7, "frames": [view]} | changes)
        # The files that a path out of the scene's folder leads to exist as well.
        for place in (folder, folder / "scene"):
            place.mkdir(exist_ok=True)
            Image.new("RGBA", (8, 8), RED).save(place / "a.png")
            for name in ("transforms_train.json", "transforms_test.json"):
                (place / name).write_text(content, encoding="utf-8")
        return load_views(folder / "scene", resolution=8)

    return load


def mesh(points, face):
    head = (
        f"ply\nformat ascii 1.0\nelement vertex {len(points)}\nproperty double x\n"
        "property double y\nproperty double z\nelement face 1\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    rows = [" ".join(map(repr, row)) for row in (*points, (len(face), *face))]

    def load(folder):
        pytest.importorskip("trimesh")
        return text(".ply", head + "\n".join(rows) + "\n", load_mesh)(folder)

    return load


def scaled(factor=1.0, shift=0.0):
    return [[c * factor + shift for c in point] for point in TRIANGLE]


MAX_POINTS = "point_count must be at most 16777216, got 1000000000"
OUTSIDE = r"must name a file in that folder|no null or invalid characters"
NUMBER = r"transform_matrix|camera_angle_x"
REJECTED = [
    (corners, "few and far apart: fill more of the picture"),
    (lambda folder: corners(folder, 2000), "few and far apart: fill more of the picture"),
    (line, "target 'line' is too thin"),
    (lambda _: load_target("gecko", point_count=10**9), MAX_POINTS),
    (lambda _: preset("tiny", target_point_count=10**9), f"target_{MAX_POINTS}"),
    (large, "at most 67108864 pixels, got 13300 x 13300"),
    (lambda _: load_texture("cells", resolution=16_384), "at most 2048"),
    (lambda _: load_views("duck", resolution=16_384), "at most"),
    (expanded, r"must hold all its numbers, got shape \(40000, 40000\)"),
    (text(".json", 100_000 * "[", load_rule), "this is no JSON text"),
    (text(".json", '{"a": ' + 5000 * "9" + "}", load_rule), "this is no JSON text"),
    (text(".yaml", f"{ALIASES}\niterations: *a30"), None),
    (text(".yaml", f"{ALIASES}\nsteps: *a30"), None),
    (text(".yaml", f"{MERGES}\ntask: *m12"), None),
    (text(".yaml", "steps: " + 3000 * "["), None),
    (text(".json", 100_000 * "["), None),
    (text(".toml", "steps = " + 10_000 * "["), None),
    (text(".yaml", "iterations: " + 5000 * "9"), None),
    (text(".json", '{"iterations": ' + 5000 * "9" + "}"), None),
    (text(".toml", "iterations = " + 5000 * "9"), None),
    (text(".yaml", "iterations: 2020-99-99"), None),
    (text(".yaml", "iterations: !!bool x"), None),
    (text(".yaml", f"iterations: {100_000 * 'x'}"), None),
    (text(".yaml", f"{100_000 * 'x'}: 1"), None),
    (text(".yaml", f"task: {{{100_000 * 'x'}: 1}}"), None),
    *(
        (scene(frame={"file_path": name}), OUTSIDE)
        for name in ("../a", "/etc/passwd", "/", ".", "a/../../a", "..", "a\0b")
    ),
    (scene(frame={"transform_matrix": [[10**400] * 4] * 4}), NUMBER),
    (scene(camera_angle_x=10**400), NUMBER),
    (mesh(TRIANGLE, [0, 1, 3]), "corners from 0 to 2, got 0 to 3"),
    (mesh(TRIANGLE, [0, 1, -1]), "corners from 0 to 2, got -1 to 1"),
    (mesh([[k, k, k] for k in range(3)], [0, 1, 2]), "every triangle lie on a line"),
    (mesh(scaled(1e200), [0, 1, 2]), "within 1e.30"),
    (mesh(scaled(1e-320), [0, 1, 2]), "at least 1e-30"),
    (mesh(scaled(shift=1e200), [0, 1, 2]), "within 1e.30"),
]
BRIEFLY = [(lambda _: load_pictures("x" * 10_000), None), (wordy, None)]


@pytest.mark.parametrize(
    ("call", "message", "most"),
    [(*row, 2500) for row in REJECTED] + [(*row, 600) for row in BRIEFLY],
)
def test_what_would_cost_gigabytes_or_for_ever_is_rejected_briefly(tmp_path, call, message, most):
    with pytest.raises(NPAError, match=message) as caught:
        call(tmp_path)
    assert len(str(caught.value)) < most
