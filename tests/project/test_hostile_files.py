"""Small files that would cost gigabytes, block for ever or start programs: refused, and cheaply."""

import gzip
import json
import os
import subprocess
import sys
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import EpsImagePlugin, Image

from npa_envs import NPAError, NPARule, load_rule, save_rule
from npa_envs.errors import shown
from npa_envs.measure.record import read_record
from npa_envs.tasks.losses.texture import load_vgg_weights
from npa_envs.tasks.targets.clouds import load_pictures, read_idx
from npa_envs.tasks.targets.images import open_image
from npa_envs.tasks.targets.meshes import load_mesh
from npa_envs.tasks.targets.points import load_target, target_from_image
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


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
@pytest.mark.parametrize("reader", READERS)
def test_a_pipe_is_refused_at_once(tmp_path, reader):
    suffix, read = READERS[reader]
    path = tmp_path / f"pipe{suffix}"
    os.mkfifo(path)
    with pytest.raises(NPAError, match="pipe or a device"):
        read(path)


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="no terminals here")
@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("device", ["/dev/zero", "/dev/random", "terminal"])
def test_a_device_is_refused_at_once(tmp_path, reader, device):
    suffix, read = READERS[reader]
    path, ends = tmp_path / f"device{suffix}", ()
    if device == "terminal":
        # Nobody types: to read from it would block.
        ends = os.openpty()
        device = os.ttyname(ends[1])
    path.symlink_to(device)
    try:
        with pytest.raises(NPAError, match="pipe or a device"):
            read(path)
    finally:
        for end in ends:
            os.close(end)


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("name", ["a\0b", "x" * 300, "~\0", "\ud800"])
def test_names_that_no_file_has_are_refused(tmp_path, reader, name):
    suffix, read = READERS[reader]
    if reader == "record":
        # A first run finds none.
        assert read(tmp_path / name) is None
        return
    with pytest.raises(NPAError) as caught:
        read(tmp_path / f"{name}{suffix}")
    assert len(str(caught.value)) < 1200


def test_two_far_pixels_are_no_target_of_gigabytes():
    for side in (300, 2000):
        image = Image.new("RGBA", (side, side))
        for corner in ((0, 0), (side - 1, side - 1)):
            image.putpixel(corner, (255, 0, 0, 255))
        with pytest.raises(NPAError, match="few and far apart: fill more of the picture"):
            target_from_image(image, name="corners")


def test_a_long_thin_picture_takes_no_square_of_its_length():
    image = Image.new("RGBA", (30_000, 3), (255, 0, 0, 255))
    with pytest.raises(NPAError, match="target 'line' is too thin"):
        target_from_image(image, name="line", point_count=64)


def test_more_points_than_any_grid_has_are_refused():
    with pytest.raises(NPAError, match="point_count must be at most 16777216, got 1000000000"):
        load_target("gecko", point_count=10**9)
    with pytest.raises(
        NPAError, match="target_point_count must be at most 16777216, got 1000000000"
    ):
        preset("tiny", target_point_count=10**9)


def test_large_pictures_are_refused_by_their_header(tmp_path):
    Image.new("1", (13_300, 13_300)).save(tmp_path / "large.png")
    with pytest.raises(NPAError, match="at most 67108864 pixels, got 13300 x 13300"):
        open_image(tmp_path / "large.png")


def test_postscript_that_is_called_a_picture_starts_nothing(tmp_path, monkeypatch):
    ran = []
    monkeypatch.setattr(EpsImagePlugin, "Ghostscript", lambda *a, **k: ran.append(a))
    text = "%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\nshowpage\n%%EOF\n"
    (tmp_path / "drawing.png").write_text(text, encoding="utf-8")
    with pytest.raises(NPAError, match="its content is none of these"):
        open_image(tmp_path / "drawing.png")
    assert not ran


@pytest.mark.parametrize(
    ("make", "message"), [(load_texture, "at most 2048"), (load_views, "at most")]
)
def test_resolutions_of_gigabytes_are_refused(make, message):
    with pytest.raises(NPAError, match=message):
        make({load_texture: "cells", load_views: "duck"}[make], resolution=16_384)


def expanded_state() -> dict[str, Any]:
    one = torch.zeros(1)
    return {
        "model.0.weight": one.expand(40_000, 40_000),
        "model.0.bias": one.expand(40_000),
        "model.2.weight": one.expand(40_000, 40_000),
        "eps0": 0.1,
        "alpha": 0.1,
    }


def test_expanded_weights_are_refused_before_they_are_made(tmp_path):
    torch.save(expanded_state(), tmp_path / "rule.pth")
    assert (tmp_path / "rule.pth").stat().st_size < 5000
    with pytest.raises(NPAError, match=r"must hold all its numbers, got shape \(40000, 40000\)"):
        load_rule(tmp_path / "rule.pth")


def test_a_compressed_state_dict_is_refused_unread(tmp_path):
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
BAD_CONFIGS = {
    "aliases": (".yaml", f"{ALIASES}\niterations: *a30"),
    "aliases of a list": (".yaml", f"{ALIASES}\nsteps: *a30"),
    "merges": (".yaml", f"{MERGES}\ntask: *m12"),
    "deep YAML": (".yaml", "steps: " + 3000 * "["),
    "deep JSON": (".json", 100_000 * "["),
    "deep TOML": (".toml", "steps = " + 10_000 * "["),
    "long YAML number": (".yaml", "iterations: " + 5000 * "9"),
    "long JSON number": (".json", '{"iterations": ' + 5000 * "9" + "}"),
    "long TOML number": (".toml", "iterations = " + 5000 * "9"),
    "no date": (".yaml", "iterations: 2020-99-99"),
    "no bool": (".yaml", "iterations: !!bool x"),
    "long text": (".yaml", f"iterations: {100_000 * 'x'}"),
    "long name": (".yaml", f"{100_000 * 'x'}: 1"),
    "long name of the task": (".yaml", f"task: {{{100_000 * 'x'}: 1}}"),
}


@pytest.mark.parametrize("case", BAD_CONFIGS)
def test_configurations_that_are_bombs_are_refused_briefly(tmp_path, case):
    suffix, text = BAD_CONFIGS[case]
    path = tmp_path / f"config{suffix}"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(NPAError) as caught:
        configure(path)
    assert len(str(caught.value)) < 2500


def test_what_came_is_shown_in_200_characters():
    nested: Any = ["lol"] * 9
    for _ in range(30):
        nested = [nested] * 9
    for value in (nested, 10**5000, "x" * 10**6, ValueError("x" * 10**6), np.zeros(10**6)):
        assert len(shown(value)) < 220
    assert shown("a") == "'a'"
    assert shown((1, 2.5, None)) == "(1, 2.5, None)"
    assert shown(10**5000) == "<int>"


def write_scene(folder: Path, **changes: Any) -> None:
    frame = {"file_path": "./a", "transform_matrix": torch.eye(4).tolist()}
    scene = {"camera_angle_x": 0.7, "frames": [frame | changes.pop("frame", {})]} | changes
    for name in ("transforms_train.json", "transforms_test.json"):
        (folder / name).write_text(json.dumps(scene), encoding="utf-8")
    Image.new("RGBA", (8, 8), (255, 0, 0, 255)).save(folder / "a.png")


@pytest.mark.parametrize("name", ["../a", "/etc/passwd", "/", ".", "a/../../a", "..", "a\0b"])
def test_pictures_of_a_scene_stay_in_its_folder(tmp_path, name):
    (tmp_path / "scene").mkdir()
    write_scene(tmp_path / "scene", frame={"file_path": name})
    write_scene(tmp_path)
    with pytest.raises(NPAError, match=r"must name a file in that folder|no characters"):
        load_views(tmp_path / "scene", resolution=8)


def test_numbers_of_a_scene_that_are_too_large_are_refused(tmp_path):
    for changes in (
        {"frame": {"transform_matrix": [[10**400] * 4] * 4}},
        {"camera_angle_x": 10**400},
    ):
        write_scene(tmp_path, **changes)
        with pytest.raises(NPAError, match=r"transform_matrix|camera_angle_x"):
            load_views(tmp_path, resolution=8)


def ply(corners: list[list[float]], face: list[int]) -> bytes:
    head = (
        f"ply\nformat ascii 1.0\nelement vertex {len(corners)}\nproperty double x\n"
        "property double y\nproperty double z\nelement face 1\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    rows = [" ".join(map(repr, corner)) for corner in corners]
    return (head + "\n".join([*rows, " ".join(map(str, (len(face), *face)))]) + "\n").encode()


TRIANGLE = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
BAD_MESHES = {
    "beyond": (ply(TRIANGLE, [0, 1, 3]), "corners from 0 to 2, got 0 to 3"),
    "negative": (ply(TRIANGLE, [0, 1, -1]), "corners from 0 to 2, got -1 to 1"),
    "a line": (ply([[0, 0, 0], [1, 1, 1], [2, 2, 2]], [0, 1, 2]), "every triangle lie on a line"),
    "huge": (ply([[c * 1e200 for c in p] for p in TRIANGLE], [0, 1, 2]), "within 1e.30"),
    "tiny": (ply([[c * 1e-320 for c in p] for p in TRIANGLE], [0, 1, 2]), "at least 1e-30"),
    "far": (ply([[c + 1e200 for c in p] for p in TRIANGLE], [0, 1, 2]), "within 1e.30"),
}


def test_a_mesh_that_covers_no_pixel_gives_empty_views(tmp_path):
    pytest.importorskip("trimesh")
    far = [*TRIANGLE, [0.0, 1e-2, 0.0], [1e-2, 0.0, 0.0], [10.0, 10.0, 10.0]]
    (tmp_path / "mesh.obj").write_text(
        "".join(f"v {x} {y} {z}\n" for x, y, z in far) + "f 1 4 5\nf 6 6 6\n", encoding="utf-8"
    )
    views = load_views(tmp_path / "mesh.obj", resolution=2, training_count=1, held_out_count=1)
    assert (views.training.pictures == 0.0).all()


@pytest.mark.parametrize("case", BAD_MESHES)
def test_meshes_that_cannot_be_drawn_are_refused(tmp_path, case):
    pytest.importorskip("trimesh")
    content, message = BAD_MESHES[case]
    (tmp_path / "mesh.ply").write_bytes(content)
    with pytest.raises(NPAError, match=message):
        load_mesh(tmp_path / "mesh.ply")


def test_a_rule_of_deep_or_long_json_is_refused(tmp_path):
    for text in (100_000 * "[", '{"a": ' + 5000 * "9" + "}"):
        (tmp_path / "models.json").write_text(text, encoding="utf-8")
        with pytest.raises(NPAError, match="this is no JSON text"):
            load_rule(tmp_path / "models.json")


def test_text_of_a_rule_is_echoed_briefly(tmp_path):
    save_rule(NPARule(), tmp_path / "rule.safetensors", metadata={"task": "x" * 100_000})
    content = (tmp_path / "rule.safetensors").read_bytes()
    (tmp_path / "rule.safetensors").write_bytes(content.replace(b"npa-envs rule", b"npa-envs mule"))
    with pytest.raises(NPAError) as caught:
        load_rule(tmp_path / "rule.safetensors")
    assert len(str(caught.value)) < 600


USE_KERNELS = """
import torch, npa_envs
try:
    npa_envs.perceive(torch.rand(1, 2, 2), torch.rand(1, 2, 1), 0.1)
except npa_envs.NPAError as error:
    assert "WARP_CACHE_PATH" in str(error), error
    print(error)
"""


def test_a_kernel_cache_that_cannot_be_made_names_the_folder_and_the_cure(tmp_path):
    (tmp_path / "file").touch()
    environment = os.environ | {"WARP_CACHE_PATH": str(tmp_path / "file")}
    done = subprocess.run(
        [sys.executable, "-c", USE_KERNELS],
        env=environment,
        capture_output=True,
        text=True,
        encoding="utf-8",
    )
    assert str(tmp_path / "file") in done.stdout, done.stderr
    assert "remove it" in done.stdout


@pytest.mark.parametrize(
    "error", [RuntimeError("Failed to load CPU module 'a'"), PermissionError(13, "no"), OSError()]
)
def test_a_damaged_kernel_cache_names_the_folder_and_the_cure(error):
    from npa_envs.runtime import kernel_cache_folder, quiet_warp

    with pytest.raises(NPAError, match=str(kernel_cache_folder())), quiet_warp():
        raise error
    with pytest.raises(RuntimeError, match="another"), quiet_warp():
        raise RuntimeError("another")


def test_data_by_a_long_name_are_refused_briefly():
    with pytest.raises(NPAError) as caught:
        load_pictures("x" * 10_000)
    assert len(str(caught.value)) < 600
