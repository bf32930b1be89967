"""What operators reject, and what they say then."""

import math

import pytest
import torch

import npa_envs
from npa_envs import NPAError
from npa_envs.ops import (
    Cameras,
    apply_actions,
    cameras_of_poses,
    look_at,
    orbit,
    periodic_splat,
    render_gaussians,
    splat,
    world_mean,
)
from npa_envs.ops.physics import Limits, Physics
from npa_envs.ops.pictures.splat import picture_losses

SIZE = {"width": 40, "height": 30}
EYES = torch.eye(4)[None].repeat(2, 1, 1)
LENS = torch.tensor([50.0, 50.0, 20.0, 15.0])


def changed(row, column, value):
    motions = EYES.clone()
    motions[1, row, column] = value
    return {"world_to_camera": motions}


def made(**change):
    return Cameras(**{"world_to_camera": EYES, "intrinsics": LENS} | SIZE | change)


def turned(count=3, **change):
    return orbit(count, **SIZE | change)


def looking(eyes=(2, 3), targets=(0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0)):
    return look_at(torch.zeros(eyes), targets, up=up)


def posed(poses):
    return cameras_of_poses(poses, 0.7, **SIZE)


def lens(*numbers):
    return {"intrinsics": torch.tensor(numbers)}


def acting(**change):
    kwargs = {"action": torch.zeros(2, 4, 6), "x": torch.zeros(2, 4, 2), "s": torch.zeros(2, 4, 4)}
    kwargs |= {"diverged": torch.zeros(2, dtype=torch.uint8), "mask": None, "noise": None}
    limits = Limits(1.0, position=50.0, state=20.0)
    kwargs |= {"physics": Physics(2, 4, 1.0, 1.0, max_displacement=0.1, limits=limits)}
    apply_actions(**kwargs | {"enabled": None} | change)


def seeing(**change):
    kwargs = {"means": torch.zeros(1, 2, 3), "scales": torch.full((1, 2, 3), 0.1)}
    kwargs |= {"quaternions": torch.ones(1, 2, 4), "opacities": torch.ones(1, 2)}
    kwargs |= {"colours": torch.zeros(1, 2, 3), "cameras": orbit(1, width=8, height=8)}
    render_gaussians(**kwargs | change)


def drawing(**change):
    for draw in (splat, periodic_splat):
        kwargs = {"x": torch.zeros(1, 2, 2), "colour": torch.zeros(1, 2, 3), "resolution": 24}
        with pytest.raises(NPAError) as caught:
            draw(**kwargs | {"pixel_size": 0.11} | change)
    raise caught.value


def judging(**change):
    kwargs = {"x": torch.zeros(1, 2, 2), "states": torch.zeros(1, 2, 4)}
    kwargs |= {"target": torch.zeros(8, 8, 4), "goal": torch.zeros(2)} | change
    worlds = [kwargs.pop(name) for name in ("x", "states", "target")]
    picture_losses(*worlds, **{"shift": 0.5, "pixel_size": 0.1} | kwargs)


def perceiving(word):
    x, s = torch.zeros(1, 4, 2), torch.zeros(1, 4, 3)
    for call in (npa_envs.perceive, npa_envs.perception_fields):
        with pytest.raises(NPAError, match="moment_inverse must be 'threshold' or 'smooth', got"):
            call(x, s, 0.1, moment_inverse=word)
    npa_envs.NPARule(moment_inverse=word)


OWN = {"cameras": made(world_to_camera=torch.eye(4).repeat(3, 1, 1, 1))}


@pytest.mark.parametrize(
    ("call", "change", "message"),
    [
        (made, {"world_to_camera": torch.eye(4)}, r"\[V, 4, 4\].*world_to_camera\[None\]"),
        (made, {"world_to_camera": torch.zeros(2, 3, 4)}, r"got \(2, 3, 4\): reshape"),
        (made, {"world_to_camera": EYES.half()}, "must be float32 or float64, got torch.float16"),
        (made, {"world_to_camera": [[1.0]]}, "must be a torch tensor, got list"),
        (made, {"world_to_camera": torch.zeros(2, 4, 4)}, "neither singular.*as camera 0"),
        (made, changed(2, 2, 0.0), "neither singular.*as camera 1"),
        (made, changed(0, 0, 1.1), "nor scaled.*as camera 1"),
        (made, changed(0, 0, -1.0), "nor mirrored.*as camera 1"),
        (made, changed(0, 3, math.nan), "rigid motions.*as camera 1"),
        (made, changed(3, 0, 0.5), "rigid motions.*as camera 1"),
        (made, lens(0.0, 50.0, 20.0, 15.0), "positive focal lengths"),
        (made, lens(50.0, -50.0, 20.0, 15.0), "turn a flipped axis round"),
        (made, lens([50.0, 50.0, 0.0, 0.0], [1.0, 1.0, math.inf, 0.0]), "a 1:"),
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
        (looking, {}, "another point than its own"),
        (looking, {"eyes": (4,)}, r"eyes must be .* shape \[..., 3\]"),
        (looking, {"targets": torch.zeros(3, 3)}, "targets must have shape"),
        (looking, {"targets": (1.0, 0.0, 0.0), "up": (0.0, 1.0)}, "up must be 3 numbers"),
        (looking, {"targets": (0.0, 3.0, 0.0)}, "choose another up"),
        (posed, {"poses": torch.zeros(2, 3, 4)}, "camera_to_world must have shape"),
        (posed, {"poses": 2.0 * torch.eye(4)[None]}, "rigid motions"),
        (acting, {"action": torch.zeros(2, 4, 5)}, r"action must be torch.float32 .*\(2, 4, 6\)"),
        (acting, {"action": torch.zeros(2, 4, 6).double()}, "action must be torch.float32"),
        (acting, {"x": torch.zeros(2, 2, 4).mT}, "x must be contiguous"),
        (acting, {"mask": torch.zeros(2, 4)}, r"mask must be torch.uint8 of shape \(2, 4\)"),
        (acting, {"noise": torch.zeros(2, 4, 3)}, r"noise must be torch.float32 .*\(2, 4, 2\)"),
        (acting, {"enabled": torch.ones(1)}, r"enabled must be torch.uint8 of shape \(1,\)"),
        (acting, {"diverged": torch.zeros(3).byte()}, r"diverged must be torch.uint8"),
        (seeing, {"means": torch.zeros(2, 3)}, r"means must have shape \[B, N, 3\].*\[None\]"),
        (seeing, {"means": torch.zeros(1, 2, 2)}, r"got \(1, 2, 2\)"),
        (seeing, {"means": torch.zeros(1, 0, 3)}, "at least one world and one particle"),
        (seeing, {"means": torch.zeros(1, 2, 3).half()}, "means must be float32 or float64"),
        (seeing, {"means": [[0.0] * 3]}, "means must be a torch tensor"),
        (seeing, {"scales": torch.zeros(1, 3, 3)}, r"scales must .* \[B, N\] = \[1, 2\]"),
        (seeing, {"scales": torch.eye(3)[None, :2] - 0.1}, "must not be negative"),
        (seeing, {"scales": torch.zeros(1, 2, 3).double()}, "scales and means must share dtype"),
        (seeing, {"quaternions": torch.zeros(1, 2, 3)}, r"must have shape \[B, N, 4\]"),
        (seeing, {"opacities": torch.zeros(1, 2, 1)}, r"opacities must have shape \[B, N\]"),
        (seeing, {"colours": torch.zeros(1, 2, 5)}, r"colours must have .* K from 1 to 4"),
        (seeing, {"colours": torch.zeros(1, 2, 3, 3)}, r"\[B, N, 4, 3\]"),
        (seeing, {"cameras": torch.eye(4)}, "cameras must be Cameras, got Tensor"),
        (seeing, OWN, r"each of 1 worlds, got .* \(3, 1, 4, 4\)"),
        (seeing, {"background": torch.zeros(2)}, r"must broadcast to .* = \[1, 1, 8, 8, 3\]"),
        (seeing, {"background": torch.zeros(4, 1, 1, 1, 3)}, r"got \(4, 1, 1, 1, 3\)"),
        (seeing, {"dilation": -0.1}, "dilation must be finite and at least 0"),
        (seeing, {"dilation": math.nan}, "dilation must be finite"),
        (seeing, {"pairs_per_particle": 0}, "pairs_per_particle must be at least 1"),
        (seeing, {"pairs_per_particle": 2**30}, "split the batch or lower pairs_per_particle"),
        (seeing, {"pairs_per_particle": 10**5000}, "got pairs_per_particle=<int>"),
        (drawing, {"resolution": 1}, "resolution must be at least 2"),
        (drawing, {"x": torch.zeros(1, 2, 3)}, "x and colour must have shapes"),
        (drawing, {"x": torch.zeros(2, 2)}, r"x\[None\]"),
        (drawing, {"pixel_size": 0.0}, "pixel_size must be positive"),
        (drawing, {"sigma": math.nan}, "sigma must be positive"),
        (drawing, {"lo": 1.0}, "lo < hi"),
        (judging, {"states": torch.zeros(1, 2, 2)}, "x and states must .* C of at least 3"),
        (judging, {"target": torch.zeros(8, 9, 4)}, r"and \[2\], got \(8, 9, 4\)"),
        (judging, {"target": torch.zeros(())}, r"got \(\)"),
        (judging, {"goal": torch.zeros(3)}, r"and \(3,\)"),
        (judging, {"target": torch.zeros(1, 1, 4)}, "resolution must be at least 2"),
        (judging, {"sigma": 0.0}, "sigma must be positive"),
        (world_mean, {"values": torch.zeros(4, 3)}, r"values must .*\[B, M, F\] .*, got \(4, 3\)"),
        (world_mean, {"values": torch.zeros(4, 0, 3)}, r"got \(4, 0, 3\)"),
        (world_mean, {"values": torch.zeros(4, 2, 3).half()}, "or float64, got torch.float16"),
        (world_mean, {"values": torch.zeros(4, 2, 3).long()}, r"convert it with \.float\(\)"),
        (perceiving, {"word": None}, "moment_inverse must be 'threshold' or 'smooth', got None"),
        (perceiving, {"word": "soft"}, "must be 'threshold' or 'smooth', got 'soft'"),
    ],
)
def test_what_does_not_fit_is_rejected(call, change, message):
    assert made().count == 2
    with pytest.raises(NPAError, match=message):
        call(**change)
