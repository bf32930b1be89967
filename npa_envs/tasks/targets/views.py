"""Views of a 3D target: pictures with alpha from known cameras, some of them held out.

They are drawn of meshes, points and Gaussians, or read from folders of pictures and cameras in the
formats of NeRF-synthetic (Mildenhall et al. 2020) and of instant-ngp and nerfstudio.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from npa_envs.atomic_files import home_path, read_json
from npa_envs.checks import check_count, is_real
from npa_envs.errors import NPAError, shown, suggest
from npa_envs.ops import Cameras, cameras_of_poses, look_at, orbit
from npa_envs.ops.pictures.triangles import WRAP_NUMBERS, TexturedFaces, nearest_triangles
from npa_envs.tasks.targets.images import (
    BACKGROUND_TOLERANCE,
    FloatImage,
    cut_out,
    is_cut_out,
    open_image,
    scaled_square,
)
from npa_envs.tasks.targets.meshes import RADIUS, Mesh, linear_light, load_mesh, srgb_values
from npa_envs.tasks.targets.notes import left_out
from npa_envs.tasks.targets.splat_files import GaussianCloud, draw_splats, ply_kind, read_splats

DISTANCE = 3.2
"""Distance of cameras from the origin [length units]."""

MAX_PIXELS = 2**27
"""Maximum number of pixels of all views of a target; a pixel takes 16 bytes."""

ANGLE = 40.0
"""Angle of view of cameras [degrees]: the unit ball fits into the picture."""


@dataclass(frozen=True, eq=False)
class Views:
    """Pictures and the cameras that took them."""

    cameras: Cameras
    """Poses and lenses of V cameras."""
    pictures: Tensor
    """Red, green and blue, each times alpha, and alpha, dimensionless, shape [V, H, W, 4]; the
    first row is the upper one."""

    def to(self, device: str | torch.device) -> Views:
        """Return a copy on another device."""
        return Views(self.cameras.to(torch.device(device)), self.pictures.to(device))


@dataclass(frozen=True, eq=False)
class ViewTarget:
    """A 3D target: pictures of it from all sides."""

    name: str
    """The built-in name, or the file's or folder's name."""
    training: Views
    """The views that the loss compares."""
    held_out: Views
    """The views that metrics compare."""
    summary: str = ""
    """What was read, in one line; empty for a built-in target."""

    def to(self, device: str | torch.device) -> ViewTarget:
        """Return a copy on another device."""
        training, held_out = self.training.to(device), self.held_out.to(device)
        return replace(self, training=training, held_out=held_out)


def load_views(
    source: str | Path,
    *,
    resolution: int = 192,
    training_count: int = 48,
    held_out_count: int = 12,
) -> ViewTarget:
    """Make a target from a built-in mesh, a mesh file, a PLY file of points, or a folder of views.

    Meshes, point clouds and trained Gaussians (3DGS) are drawn from cameras all around. A folder is
    in the format of NeRF-synthetic, instant-ngp or nerfstudio; of a single `transforms.json` every
    eighth view is held out. Evenly spaced views are taken, at most `training_count` and
    `held_out_count`. Lenses are undistorted, and pictures become squares. The scene is rotated so
    that y is up, and scaled into the ball of radius 0.85. Opaque pictures lose the plain background
    around the thing. Views have `resolution` pixels along each side.
    """
    if not isinstance(source, str | Path) or not str(source):
        raise NPAError(
            "target must be a built-in mesh, a mesh file or a folder of views, got "
            f"{shown(source)}: for example 'mushroom'"
        )
    counts = {"training_count": training_count, "held_out_count": held_out_count}
    for name, value in {"resolution": resolution, **counts}.items():
        check_count(name, value)
    pixels = (training_count + held_out_count) * resolution**2
    if pixels > MAX_PIXELS:
        raise NPAError(
            f"all views together must have at most {MAX_PIXELS} pixels, got {shown(pixels)} of "
            f"resolution={shown(resolution)}: lower it, or take fewer views"
        )
    folder = home_path(source)
    if os.path.isdir(folder):
        return _read_view_folder(folder, resolution, training_count, held_out_count)
    shape: GaussianCloud | Mesh
    if folder.suffix.lower() == ".ply" and folder.is_file() and ply_kind(folder) != "triangles":
        shape = read_splats(folder)
    else:
        shape = load_mesh(source)
    return drawn_views(shape, folder.stem, resolution, training_count, held_out_count)


def drawn_views(
    shape: GaussianCloud | Mesh,
    name: str,
    resolution: int,
    training_count: int,
    held_out_count: int,
) -> ViewTarget:
    """Return views of what fits into the ball of radius 0.85, from cameras all around."""
    views = []
    for count, turn in ((training_count, 0.0), (held_out_count, 0.5)):
        cameras = surrounding_cameras(count, resolution, turn=turn)
        if isinstance(shape, Mesh):
            pictures = torch.from_numpy(draw_mesh(shape, cameras))
        else:
            pictures = draw_splats(shape, cameras)
        views.append(Views(cameras, pictures))
    return ViewTarget(name, views[0], views[1], shape.summary)


def surrounding_cameras(count: int, resolution: int, *, turn: float = 0.0) -> Cameras:
    """Return cameras on a Fibonacci spiral around the origin, at which they point.

    The spiral is rotated by `turn` turns around the y axis.
    """
    k = torch.arange(count, dtype=torch.float64)
    height = (2.0 * k + 1.0) / count - 1.0
    angle = math.tau * (k * (0.5 * (math.sqrt(5.0) - 1.0)) + turn)
    flat = (1.0 - height * height).sqrt()
    outward = torch.stack((flat * angle.sin(), height, flat * angle.cos()), dim=-1)
    # Only the intrinsics of this camera are used.
    lens = orbit(1, 0.0, DISTANCE, ANGLE, width=resolution, height=resolution)
    return Cameras(
        world_to_camera=look_at(DISTANCE * outward, (0.0, 0.0, 0.0)).float(),
        intrinsics=lens.intrinsics,
        width=resolution,
        height=resolution,
    )


def composited(views: Tensor, background: Tensor) -> Tensor:
    """Return the colours [..., 3] of views [..., 4] in front of a background [..., 3]."""
    return views[..., :3] + (1.0 - views[..., 3:]) * background


def some_views(views: Views, index: Tensor) -> Views:
    """Return the views with these indices, int64, shape [any]."""
    cameras = views.cameras
    intrinsics = cameras.intrinsics
    chosen = replace(
        cameras,
        world_to_camera=cameras.world_to_camera.index_select(0, index),
        intrinsics=intrinsics if intrinsics.ndim == 1 else intrinsics.index_select(0, index),
    )
    return Views(chosen, views.pictures.index_select(0, index))


def nearest_camera(cameras: Cameras, elevation: float) -> int:
    """Return the index of the camera nearest to the front (+z) at an elevation [degrees]."""
    motions = cameras.world_to_camera.double().cpu()
    positions = -(motions[:, :3, :3].mT @ motions[:, :3, 3:])[..., 0]
    tilt = math.radians(elevation)
    front = positions.new_tensor((0.0, math.sin(tilt), math.cos(tilt)))
    return int((positions @ front / positions.norm(dim=1)).argmax())


# Folders of views.

TRAINING_FILE = "transforms_train.json"
HELD_OUT_FILES = ("transforms_test.json", "transforms_val.json")

SINGLE_FILE = "transforms.json"
"""File of instant-ngp and nerfstudio, which has all views."""

HELD_OUT_INTERVAL = 8
"""Every eighth view of a `SINGLE_FILE` is held out, from the first."""

OPAQUE_ALPHA = 0.5
"""Alpha above which a pixel belongs to the scene."""

UPRIGHT = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
"""Rotation from the format's coordinates, z up, to ours, y up."""

PLAIN = 0.9
"""Share of the pixels at the edges of opaque pictures that must have the background's colour."""

LENS_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE")
"""Values of `camera_model`: pinholes with OpenCV's distortion by k1, k2, p1 and p2."""

_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")
_DISTORTION = ("k1", "k2", "p1", "p2")
_NUMBERS = ("camera_angle_x", "camera_angle_y", "fl_x", "fl_y", "cx", "cy", "w", "h", *_DISTORTION)
_UNUSABLE = ("k3", "k4", "k5", "k6", "is_fisheye", "ftheta_p0", "latlong", "equirectangular")
_LENS = ("camera_model", *_NUMBERS, *_UNUSABLE, "rolling_shutter")
_NEEDLESS = (
    "frames", "file_path", "transform_matrix", "rotation", "sharpness", "aabb_scale", "scale",
    "offset", "n_frames", "colmap_im_id", "applied_transform", "applied_scale", "ply_file_path",
    "time", "x_fov", "y_fov",
)  # fmt: skip
"""Names in the files that say nothing more about pictures and cameras."""


class FolderView(NamedTuple):
    """A picture and its camera, as a file describes them."""

    where: str
    """The frame's name in errors."""
    picture: Path
    """The picture's file."""
    pose: Tensor
    """Camera to world, z up, shape [4, 4], float64."""
    lens: Mapping[str, Any]
    """The file's values of `_LENS`, those of the frame first."""


def _read_view_folder(
    folder: Path, resolution: int, training_count: int, held_out_count: int
) -> ViewTarget:
    """Return the target in a folder of views, as `load_views` describes."""
    frames, others = _read_splits(folder)
    frames, others = _thinned(frames, training_count), _thinned(others, held_out_count)
    background = _plain_background(folder, frames + others)
    training, measured = (_views_of(each, resolution, background) for each in (frames, others))
    radius = max(scene_radius(training), scene_radius(measured))
    if radius == 0.0:
        raise NPAError(
            f"views must show something, but no picture of {shown(str(folder))} has a pixel of "
            f"alpha above {OPAQUE_ALPHA}: give pictures with a transparent background"
        )
    for views in (training, measured):
        views.cameras.world_to_camera[:, :3, 3] *= RADIUS / radius
    first, how = open_image(frames[0].picture, upright=False), "alpha"
    if background is not None:
        how = f"their plain background, sRGB {background.astype(int).tolist()}"
    counts = f"{len(frames)} views to train with, {len(others)} held out"
    summary = f"{folder.name}: {counts}, {first.width} x {first.height}, cut out by {how}"
    return ViewTarget(folder.name, training, measured, summary)


def scene_radius(views: Views) -> float:
    """Return a lower bound on the scene's radius [length units].

    It is the largest distance from the origin of a camera ray on which something is visible. A
    point is at least as far from the origin as the rays on which it is visible; with many views,
    one of these rays nearly touches the farthest point.
    """
    cameras, radius = views.cameras, 0.0
    lenses = cameras.intrinsics.double().expand(cameras.count, 4)
    for motion, lens, picture in zip(
        cameras.world_to_camera.double(), lenses, views.pictures, strict=True
    ):
        row, column = (picture[..., 3] > OPAQUE_ALPHA).nonzero(as_tuple=True)
        if len(row) == 0:
            continue
        pixel = torch.stack((column, row), dim=-1) + 0.5
        ray = torch.nn.functional.pad((pixel - lens[2:]) / lens[:2], (0, 1), value=1.0)
        ray /= ray.norm(dim=1, keepdim=True)
        # The origin in the camera's frame, and its distance from each ray.
        away = torch.linalg.cross(ray, motion[:3, 3].expand_as(ray)).norm(dim=1)
        radius = max(radius, float(away.max()))
    return radius


# What the files say.


def _read_splits(folder: Path) -> tuple[list[FolderView], list[FolderView]]:
    """Return the frames of a folder to train with, and others to measure by."""
    held_out = next((folder / name for name in HELD_OUT_FILES if (folder / name).is_file()), None)
    if held_out is not None and (folder / TRAINING_FILE).is_file():
        return _read_frames(folder / TRAINING_FILE), _read_frames(held_out)
    if not (folder / SINGLE_FILE).is_file():
        raise NPAError(
            f"a folder of views must hold {TRAINING_FILE}, and {' or '.join(HELD_OUT_FILES)}, or "
            f"{SINGLE_FILE}, {shown(str(folder))} does not: views to measure by must be others "
            "than those trained with"
        )
    frames = _read_frames(folder / SINGLE_FILE)
    if len(frames) < 2:
        raise NPAError(
            f"frames in {shown(str(folder / SINGLE_FILE))} must be at least two, one to train with "
            "and one to measure by, got 1"
        )
    others = [frame for k, frame in enumerate(frames) if k % HELD_OUT_INTERVAL]
    return others, frames[::HELD_OUT_INTERVAL]


def _read_frames(path: Path) -> list[FolderView]:
    """Return the frames of a `transforms*.json`."""
    file = shown(str(path))
    try:
        content = read_json(path)
    except NPAError as error:
        raise NPAError(f"cannot read {file} as JSON: {error}") from error
    content = content if isinstance(content, dict) else {}
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise NPAError(f"frames in {file} must be a list with at least one view")
    found = [_read_frame(path, k, frame, content) for k, frame in enumerate(frames)]
    names = {name for values in (content, *frames) for name in values}
    unused = sorted(str(name) for name in names - {*_LENS, *_NEEDLESS})
    if unused:
        left_out(str(path), ", ".join(unused))
    if len({str(frame.get("time")) for frame in frames}) > 1:
        raise NPAError(
            f"the views of {file} must show a thing at rest, got frames with other times"
        )
    return found


def _read_frame(path: Path, number: int, frame: Any, content: dict[str, Any]) -> FolderView:
    """Return a frame of a `transforms*.json` with this content."""
    frame, where = frame if isinstance(frame, dict) else {}, f"frame {number} in {shown(str(path))}"
    name, matrix = frame.get("file_path"), frame.get("transform_matrix")
    if not isinstance(name, str) or not name:
        raise NPAError(f"{where} must have a file_path, got {shown(name)}")
    pose = torch.empty(0)
    with contextlib.suppress(TypeError, ValueError, RuntimeError, OverflowError):
        pose = torch.tensor(matrix, dtype=torch.float64)
    if pose.shape != (4, 4):
        raise NPAError(f"transform_matrix of {where} must be 4 x 4 numbers, got {shown(matrix)}")
    inside = os.path.normpath(name.replace("\\", "/"))
    if os.path.isabs(name) or inside == os.curdir or inside.split(os.sep)[0] == os.pardir:
        raise NPAError(
            f"file_path of {where} must name a file in that folder, got {shown(name)}: put the "
            "pictures next to it"
        )
    file = path.parent / inside
    if file.suffix.lower() not in _SUFFIXES and not file.is_file():
        # NeRF-synthetic's file_path has no suffix.
        files = [file.with_name(file.name + suffix) for suffix in _SUFFIXES]
        file = next((each for each in files if each.is_file()), files[0])
    values = {key: frame.get(key, content.get(key)) for key in _LENS}
    given = {key: value for key, value in values.items() if value is not None}
    return FolderView(where, file, pose, given)


def _lens_of(
    frame: FolderView, size: tuple[int, int]
) -> tuple[NDArray[np.float64], tuple[float, ...]]:
    """Return the lens in front of a picture of this width and height [pixels].

    It is a pinhole's fx, fy, cx and cy [pixels], shape [4], and k1, k2, p1 and p2 of its distortion
    (dimensionless).
    """
    given, where = frame.lens, frame.where
    model = str(given.get("camera_model", "PINHOLE")).upper()
    if model not in LENS_MODELS:
        raise NPAError(
            f"camera_model of {where} must be a pinhole with distortion k1, k2, p1, p2, got "
            f"{shown(model)}: undistort the pictures; {suggest(model, LENS_MODELS)}"
        )
    unusable = [name for name in (*_UNUSABLE, "rolling_shutter") if np.any(given.get(name))]
    if unusable:
        raise NPAError(
            f"{unusable[0]} of {where} must be 0, got {shown(given[unusable[0]])}: undistort the "
            "pictures, only k1, k2, p1 and p2 are used"
        )
    for name in _NUMBERS:
        if not is_real(given.get(name, 0)):
            raise NPAError(f"{name} of {where} must be a number, got {shown(given[name])}")
    width, height = given.get("w", size[0]), given.get("h", size[1])
    if min(width, height) <= 0 or abs(width / height * size[1] / size[0] - 1.0) > 0.01:
        raise NPAError(
            f"w and h of {where} must be those of its picture, {size[0]} and {size[1]}, or in that "
            f"ratio, got {shown(width)} and {shown(height)}"
        )
    lengths = []
    for axis, side in (("x", width), ("y", height)):
        focal, angle = given.get(f"fl_{axis}"), given.get(f"camera_angle_{axis}")
        if focal is not None and not focal > 0.0:
            raise NPAError(f"fl_{axis} of {where} must be positive [pixels], got {shown(focal)}")
        if angle is not None and not 0.0 < angle < math.pi:
            raise NPAError(
                f"camera_angle_{axis} of {where} must be an angle between 0 and pi radians, "
                f"got {shown(angle)}"
            )
        if focal is None and angle is not None:
            focal = 0.5 * side / math.tan(0.5 * angle)
        lengths.append(focal)
    across, down = lengths
    if across is None and down is None:
        raise NPAError(
            f"camera_angle_x of {where} must be an angle between 0 and pi radians, got None; fl_x "
            "is not there either"
        )
    middle = given.get("cx", 0.5 * width), given.get("cy", 0.5 * height)
    pinhole = np.array((across or down, down or across, *middle), dtype=np.float64)
    distortion = tuple(float(given.get(name, 0.0)) for name in _DISTORTION)
    return pinhole * np.tile(np.divide(size, (width, height)), 2), distortion


# Pictures.


def _thinned(frames: Sequence[FolderView], count: int) -> list[FolderView]:
    """Return at most `count` evenly spaced frames."""
    count = min(count, len(frames))
    return [frames[k * len(frames) // count] for k in range(count)]


def _plain_background(folder: Path, frames: Sequence[FolderView]) -> FloatImage | None:
    """Return the colour behind the thing in opaque pictures, [3]; None: they have transparency."""
    edges = []
    for frame in frames:
        image = open_image(frame.picture, upright=False)
        if is_cut_out(image):
            return None
        rgb = np.asarray(image.convert("RGB"))
        edges.append(np.concatenate([rgb[0], rgb[-1], rgb[:, 0], rgb[:, -1]]))
    border = np.concatenate(edges).astype(np.float32)
    background: FloatImage = np.median(border, axis=0).round()
    share = (np.abs(border - background).max(axis=1) <= BACKGROUND_TOLERANCE).mean()
    if share < PLAIN:
        raise NPAError(
            f"views must have a transparent background, or a plain one to cut out, but no picture "
            f"of {shown(str(folder))} has transparency, and only {share:.0%} of the pixels at "
            "their edges have one colour: remove the background, and save PNG files"
        )
    return background


def _views_of(
    frames: Sequence[FolderView], resolution: int, background: FloatImage | None
) -> Views:
    """Return the views of frames, rotated so that y is up."""
    pictures, lenses = [], []
    for frame in frames:
        picture, lens = _square_view(frame, resolution, background)
        pictures.append(torch.from_numpy(picture))
        lenses.append(lens)
    poses = torch.stack([frame.pose for frame in frames])
    poses[:, :3] = torch.tensor(UPRIGHT, dtype=poses.dtype) @ poses[:, :3]
    intrinsics = torch.from_numpy(np.stack(lenses)).float()
    try:
        # Only the poses of these cameras are used.
        cameras = cameras_of_poses(poses.float(), 1.0, width=resolution, height=resolution)
    except NPAError as error:
        raise NPAError(f"{frames[0].where} or another one: {error}") from error
    same = bool((intrinsics == intrinsics[0]).all())
    cameras = replace(cameras, intrinsics=intrinsics[0] if same else intrinsics)
    return Views(cameras, torch.stack(pictures))


def _square_view(
    frame: FolderView, resolution: int, background: FloatImage | None
) -> tuple[FloatImage, NDArray[np.float64]]:
    """Return the picture of a frame, [R, R, 4], without distortion, and its fx, fy, cx and cy."""
    # Cameras are those of the pixels as stored.
    image = open_image(frame.picture, upright=False)
    size, (pinhole, distortion) = image.size, _lens_of(frame, image.size)
    if background is not None or any(distortion):
        # No larger than needed, as what follows takes time.
        factor = max(min(size) // (4 * resolution), 1)
        image = image.convert("RGBa").reduce(factor).convert("RGBA")
        pinhole = pinhole * np.tile(np.divide(image.size, size), 2)
    if background is not None:
        image = cut_out(image, background)
    elif not is_cut_out(image):
        text = "the background of pictures without transparency, as others have some"
        left_out(str(frame.picture.parent), f"{text}; it counts as the thing", what="not cut out")
    if any(distortion):
        image = _undistorted(image, pinhole, distortion)
    width, height = image.size
    alpha = np.asarray(image.getchannel("A"))
    sides = (alpha[:, [0, -1]] if height > width else alpha[[0, -1]]).max()
    # Where the thing lies within the picture it is shown whole, else a square of the picture.
    side = max(width, height) if sides < 255 * OPAQUE_ALPHA else min(width, height)
    left, top = (width - side) // 2, (height - side) // 2
    square = image.crop((left, top, left + side, top + side))
    return scaled_square(square, resolution), (pinhole - (0, 0, left, top)) * resolution / side


@np.errstate(all="ignore")
def _undistorted(
    image: Image.Image, pinhole: NDArray[np.float64], distortion: tuple[float, ...]
) -> Image.Image:
    """Return a picture as a pinhole with the same numbers shows it, transparent beyond its edges.

    A ray (x, y, 1) is seen at x (1 + k1 r² + k2 r⁴) + 2 p1 x y + p2 (r² + 2 x²), and alike in y, of
    the distorted picture.
    """
    (fx, fy, cx, cy), (k1, k2, p1, p2) = pinhole, distortion
    width, height = image.size
    x = ((np.arange(width) + 0.5 - cx) / fx)[None]
    y = ((np.arange(height) + 0.5 - cy) / fy)[:, None]
    squares = x * x + y * y
    radial = 1.0 + k1 * squares + k2 * squares * squares
    column = fx * (x * radial + 2.0 * p1 * x * y + p2 * (squares + 2.0 * x * x)) + cx
    row = fy * (y * radial + p1 * (squares + 2.0 * y * y) + 2.0 * p2 * x * y) + cy
    # Beyond the first radius where the distortion turns back, nothing was seen.
    roots = np.roots((5.0 * k2, 3.0 * k1, 1.0))
    turns = [float(t.real) for t in roots if abs(t.imag) < 1e-9 and t.real > 0.0]
    column[squares > min(turns, default=math.inf)] = -2.0 * width
    grid = np.stack((2.0 * column / width - 1.0, 2.0 * row / height - 1.0), axis=-1)
    source = np.asarray(image.convert("RGBa")).astype(np.float32)
    sampled = torch.nn.functional.grid_sample(
        torch.from_numpy(source).movedim(-1, 0)[None],
        torch.from_numpy(grid)[None].float(),
        align_corners=False,
    )
    pixels = sampled[0].movedim(0, -1).round().clamp(0.0, 255.0).to(torch.uint8).numpy()
    return Image.fromarray(pixels, "RGBa").convert("RGBA")


# Pictures of meshes.

LIGHT = (0.35, 0.80, 0.50)
"""Direction towards the light, fixed in the world; it need not have length 1."""

AMBIENT = 0.6
"""Brightness of a surface that faces away from the light, where 1 is one that faces it."""

SAMPLES = 2
"""Number of samples along each side of a pixel."""

MAX_TEXELS, MAX_ALL_TEXELS = 2**24, 2**26
"""Maximum number of pixels of a texture, 4096 x 4096, and of all textures of a mesh together: those
with more are halved."""

BATCH_LIMIT = 2**22
"""Maximum number of samples, and of vertices, of the views that are drawn in one batch; a single
view may have more."""


def halved(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return an sRGB picture [H, W, 3] at half its size, averaged in linear light."""
    size, channels = (max(pixels.shape[1] // 2, 1), max(pixels.shape[0] // 2, 1)), []
    for k in range(3):
        channel = Image.fromarray(_BRIGHTNESS.astype(np.float32)[pixels[..., k]])
        half = np.asarray(channel.resize(size, Image.Resampling.BOX))
        channels.append((255.0 * srgb_values(half)).round().astype(np.uint8))
    return np.stack(channels, axis=-1)


_BRIGHTNESS = linear_light(np.arange(256) / 255.0)


def _textured_faces(mesh: Mesh, light: NDArray[np.float64]) -> TexturedFaces | None:
    """Return a mesh's textures with all their levels; `light`: brightness of each corner."""
    if mesh.texture_of_face is None or mesh.uv is None or (mesh.texture_of_face < 0).all():
        return None
    limit = min(MAX_TEXELS, MAX_ALL_TEXELS // len(mesh.textures))
    texels: list[NDArray[np.uint8]] = []
    headers: list[list[tuple[int, int, int]]] = []
    total = 0
    for texture in mesh.textures:
        pixels = texture.pixels
        while pixels[..., 0].size > limit:
            pixels = halved(pixels)
        headers.append([])
        while not headers[-1] or texels[-1].size > 3:
            headers[-1].append((total, pixels.shape[1], pixels.shape[0]))
            texels.append(pixels.reshape(-1, 3))
            total += len(texels[-1])
            pixels = halved(pixels)
    depth = max(map(len, headers))
    levels = [header + [(0, 0, 0)] * (depth - len(header)) for header in headers]
    wrap = [[WRAP_NUMBERS[side] for side in texture.wrap] for texture in mesh.textures]
    return TexturedFaces(
        torch.from_numpy(np.concatenate(texels)),
        torch.tensor(levels, dtype=torch.int32),
        torch.tensor(wrap, dtype=torch.int32),
        torch.from_numpy(_BRIGHTNESS),
        torch.from_numpy(mesh.texture_of_face.astype(np.int32)),
        torch.from_numpy(np.nan_to_num(mesh.uv).astype(np.float64, order="C").clip(-1e9, 1e9)),
        torch.from_numpy(light),
    )


def draw_mesh(mesh: Mesh, cameras: Cameras) -> NDArray[np.float32]:
    """Return pictures of a mesh by V cameras, [V, H, W, 4]: colours times alpha, alpha, in [0, 1].

    Surfaces are matt and lit from a direction fixed in the world. Textures finer than pixels are
    averaged in linear light. Both sides of triangles are visible. Triangles with a vertex nearer
    than `cameras.near` are left out. The top row is first.
    """
    light = np.asarray(LIGHT) / np.linalg.norm(LIGHT)
    lit = AMBIENT + (1.0 - AMBIENT) * (mesh.normals() @ light).clip(0.0, 1.0)
    light = lit[mesh.faces]
    colours_of_corners = mesh.colours * light[..., None]
    textures = _textured_faces(mesh, light)
    if textures is not None:
        textured = textures.of_face.numpy() >= 0
        colours_of_corners[textured] = linear_light(mesh.colours[textured])
    # Copies: torch accepts no arrays with negative strides or read-only ones.
    colours, vertices = (
        torch.from_numpy(np.array(values, dtype=np.float64, order="C"))
        for values in (colours_of_corners, mesh.vertices)
    )
    faces = torch.from_numpy(np.array(mesh.faces, dtype=np.int64, order="C"))
    motions = cameras.world_to_camera.double().cpu()
    lenses = SAMPLES * cameras.intrinsics.double().cpu().expand(len(motions), 4)[:, None]
    height, width = SAMPLES * cameras.height, SAMPLES * cameras.width
    batch_size = max(1, BATCH_LIMIT // max(height * width, len(vertices), 3 * len(faces)))
    pictures = []
    batches = (torch.split(each, batch_size) for each in (motions, lenses))
    for motion, lens in zip(*batches, strict=True):
        local = vertices @ motion[:, :3, :3].mT + motion[:, None, :3, 3]
        depth = local[..., 2].clamp(min=cameras.near)
        fine = nearest_triangles(
            local[..., :2] / depth[..., None] * lens[..., :2] + lens[..., 2:],
            1.0 / depth,
            colours,
            faces,
            (local[..., 2] >= cameras.near)[:, faces].all(dim=-1),
            textures,
            width=width,
            height=height,
        )
        coarse = fine.view(-1, cameras.height, SAMPLES, cameras.width, SAMPLES, 4)
        pictures.append(coarse.mean(dim=(2, 4)).float())
    return torch.cat(pictures).numpy()
