"""Cameras: where things appear on their pictures, and what is refused."""

import dataclasses
import math

import pytest
import torch

from npa_envs import NPAError
from npa_envs.ops import Cameras, cameras_of_poses, look_at, orbit
from npa_envs.render.worlds import _seen_from

SIZE = {"width": 40, "height": 30}


def frames(cameras, points):
    """Return points [N, 3] in the frame of each camera, [V, N, 3]."""
    motions = cameras.world_to_camera
    return points.to(motions) @ motions[:, :3, :3].mT + motions[:, None, :3, 3]


def seen(cameras, points):
    """Return columns and rows [V, N, 2] of points [N, 3]."""
    places = frames(cameras, points)
    focal, middle = cameras.intrinsics.expand(cameras.count, 4)[:, None].chunk(2, dim=-1)
    return focal * places[..., :2] / places[..., 2:] + middle


@pytest.mark.parametrize("elevation", [-50.0, 0.0, 20.0])
def test_a_turntable_agrees_with_the_one_of_drawn_worlds(elevation):
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
    cameras = orbit(3, elevation, 4.0, 30.0, azimuth=15.0, **SIZE)
    for frame, azimuth in zip(frames(cameras, points), (15.0, 135.0, 255.0), strict=True):
        places, near = _seen_from(points[None], azimuth, elevation)
        expected = torch.cat((places * torch.tensor([1.0, -1.0]), 4.0 - near), dim=-1)[0]
        torch.testing.assert_close(frame, expected, rtol=0.0, atol=3e-6)


def test_a_turntable_goes_around_its_centre():
    centre = (0.5, -1.0, 2.0)
    cameras = orbit(5, 35.0, 2.5, 50.0, centre=centre, near=0.3, **SIZE)
    middle = torch.tensor([centre])
    torch.testing.assert_close(
        seen(cameras, middle), torch.tensor([20.0, 15.0]).expand(5, 1, 2), rtol=1e-5, atol=1e-4
    )
    torch.testing.assert_close(frames(cameras, middle)[..., 2], torch.full((5, 1), 2.5))
    assert (cameras.count, cameras.world_count, cameras.near) == (5, None, 0.3)


def test_the_angle_of_view_is_that_across_the_width():
    camera = orbit(1, 0.0, 2.0, 60.0, **SIZE)
    edge = torch.tensor([[2.0 * math.tan(math.radians(30.0)), 0.0, 0.0]])
    torch.testing.assert_close(seen(camera, edge)[0, 0], torch.tensor([40.0, 15.0]))


def test_look_at_has_its_target_in_the_middle_and_up_above():
    eyes = torch.randn(2, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    targets = eyes.flip(0) + 0.5
    motions = look_at(eyes, targets, up=(0.0, 0.0, 1.0))
    rotations, shifts = motions[..., :3, :3], motions[..., :3, 3]
    unit = torch.eye(3, dtype=torch.float64).expand(2, 3, 3, 3)
    torch.testing.assert_close(rotations @ rotations.mT, unit)
    assert bool((torch.linalg.det(rotations) > 0.99).all())
    ahead = (rotations @ targets[..., None])[..., 0] + shifts
    torch.testing.assert_close(ahead[..., :2], torch.zeros(2, 3, 2, dtype=torch.float64))
    torch.testing.assert_close(ahead[..., 2], (targets - eyes).norm(dim=-1))
    up = rotations @ eyes.new_tensor([0.0, 0.0, 1.0])
    torch.testing.assert_close(up[..., 0], torch.zeros(2, 3, dtype=torch.float64))
    assert bool((up[..., 1] < 0.0).all())


def test_poses_of_nerf_look_along_their_negative_z_axis():
    """Four units up the world's z axis, looking down: x to the right, y up in the picture."""
    pose = torch.eye(4)
    pose[2, 3] = 4.0
    camera = cameras_of_poses(pose[None], 0.8, **SIZE)
    focal = 0.5 * 40 / math.tan(0.4)
    torch.testing.assert_close(camera.intrinsics, torch.tensor([focal, focal, 20.0, 15.0]))
    points = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    expected = torch.tensor(
        [[[20.0, 15.0], [20.0 + 0.25 * focal, 15.0], [20.0, 15.0 - 0.25 * focal]]]
    )
    torch.testing.assert_close(seen(camera, points), expected)


def test_poses_of_nerf_are_inverted():
    eyes = torch.randn(2, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    motions = look_at(eyes, (0.3, 0.1, -0.2))
    flip = torch.diag(motions.new_tensor([1.0, -1.0, -1.0, 1.0]))
    cameras = cameras_of_poses(torch.linalg.inv(motions) @ flip, 0.7, near=0.5, **SIZE)
    torch.testing.assert_close(cameras.world_to_camera, motions)
    assert (cameras.world_count, cameras.count, cameras.near) == (2, 3, 0.5)
    assert cameras.intrinsics.dtype == torch.float64


def test_cameras_move_between_dtypes_and_stay_as_they_are():
    cameras = orbit(2, **SIZE)
    wide = cameras.to(torch.float64)
    assert wide.world_to_camera.dtype == wide.intrinsics.dtype == torch.float64
    assert torch.equal(wide.world_to_camera.float(), cameras.world_to_camera)
    assert (wide.width, wide.height, wide.near) == (40, 30, 0.01)
    with pytest.raises(dataclasses.FrozenInstanceError):
        cameras.near = 1.0


def changed(row, column, value):
    motions = torch.eye(4)[None].repeat(2, 1, 1)
    motions[1, row, column] = value
    return motions


def made(**change):
    motions = torch.eye(4)[None].repeat(2, 1, 1)
    given = {"world_to_camera": motions, "intrinsics": torch.tensor([50.0, 50.0, 20.0, 15.0])}
    return Cameras(**given | SIZE | change)


def turned(count=3, **change):
    return orbit(count, **SIZE | change)


def looking(eyes=(2, 3), targets=(0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0)):
    return look_at(torch.zeros(eyes), targets, up=up)


def posed(poses):
    return cameras_of_poses(poses, 0.7, **SIZE)


@pytest.mark.parametrize(
    ("make", "change", "message"),
    [
        (made, {"world_to_camera": torch.eye(4)}, r"\[V, 4, 4\].*world_to_camera\[None\]"),
        (made, {"world_to_camera": torch.zeros(2, 3, 4)}, r"got \(2, 3, 4\): reshape"),
        (
            made,
            {"world_to_camera": torch.eye(4)[None].half()},
            "must be a float32 or float64 tensor",
        ),
        (made, {"world_to_camera": [[1.0]]}, "must be a float32 or float64 tensor, got list"),
        (made, {"world_to_camera": torch.zeros(2, 4, 4)}, "neither singular.*as camera 0"),
        (made, {"world_to_camera": changed(2, 2, 0.0)}, "neither singular.*as camera 1"),
        (made, {"world_to_camera": changed(0, 0, 1.1)}, "nor scaled.*as camera 1"),
        (made, {"world_to_camera": changed(0, 0, -1.0)}, "nor mirrored.*as camera 1"),
        (made, {"world_to_camera": changed(0, 3, math.nan)}, "rigid motions.*as camera 1"),
        (made, {"world_to_camera": changed(3, 0, 0.5)}, "rigid motions.*as camera 1"),
        (made, {"intrinsics": torch.tensor([0.0, 50.0, 20.0, 15.0])}, "positive focal lengths"),
        (
            made,
            {"intrinsics": torch.tensor([50.0, -50.0, 20.0, 15.0])},
            "turn a flipped axis round",
        ),
        (
            made,
            {"intrinsics": torch.tensor([[50.0, 50.0, 0.0, 0.0], [1.0, 1.0, math.inf, 0.0]])},
            "a 1:",
        ),
        (made, {"intrinsics": torch.ones(3)}, r"in shape \[4\] or \[2, 4\] for .* got \(3,\)"),
        (made, {"intrinsics": torch.ones(3, 4)}, r"got \(3, 4\)"),
        (made, {"intrinsics": torch.ones(4).double()}, "must share dtype and device"),
        (made, {"width": 0}, r"width must lie in \[1, 16384\] pixels, got 0"),
        (made, {"height": 1 << 20}, "height must lie in"),
        (made, {"height": 2.5}, "height must be an integer"),
        (made, {"near": 0.0}, "near must be positive and finite"),
        (made, {"near": math.nan}, "near must be positive and finite"),
        (turned, {"count": 0}, "count must be at least 1"),
        (turned, {"elevation": 90.0}, "elevation must lie between -90 and 90"),
        (turned, {"elevation": math.nan}, "elevation must be finite"),
        (turned, {"radius": 0.0}, "radius must be positive"),
        (turned, {"fov": 180.0}, "between 0 and 180 degrees, got 180"),
        (turned, {"fov": 0.0}, "between 0 and 180 degrees"),
        (turned, {"centre": (0.0, 0.0)}, "centre must be 3 numbers"),
        (looking, {}, "another place than its own"),
        (looking, {"eyes": (4,)}, r"eyes must be .* shape \[..., 3\]"),
        (looking, {"targets": torch.zeros(3, 3)}, "targets must have shape"),
        (looking, {"targets": (1.0, 0.0, 0.0), "up": (0.0, 1.0)}, "up must be 3 numbers"),
        (looking, {"targets": (0.0, 3.0, 0.0)}, "choose another up"),
        (posed, {"poses": torch.zeros(2, 3, 4)}, "camera_to_world must have shape"),
        (posed, {"poses": 2.0 * torch.eye(4)[None]}, "rigid motions"),
    ],
)
def test_what_is_no_camera_is_refused(make, change, message):
    assert made().count == 2
    with pytest.raises(NPAError, match=message):
        make(**change)
