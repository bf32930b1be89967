"""Cameras: where things appear on their pictures, and what is rejected."""

import math

import pytest
import torch

from npa_envs.ops import cameras_of_poses, look_at, orbit
from npa_envs.render.worlds import _projected

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
        places, near = _projected(points[None], azimuth, elevation)
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


def test_poses_of_nerf_are_inverted_with_y_up_and_z_out_of_the_scene():
    eyes = torch.randn(2, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    motions = look_at(eyes, (0.3, 0.1, -0.2))
    flip = torch.diag(motions.new_tensor([1.0, -1.0, -1.0, 1.0]))
    cameras = cameras_of_poses(torch.linalg.inv(motions) @ flip, 0.7, near=0.5, **SIZE)
    torch.testing.assert_close(cameras.world_to_camera, motions)
    assert (cameras.world_count, cameras.count, cameras.near) == (2, 3, 0.5)
    focal = 0.5 * 40 / math.tan(0.5 * 0.7)
    lens = torch.tensor([focal, focal, 20.0, 15.0]).double()
    torch.testing.assert_close(cameras.intrinsics, lens)
