"""The renderer of 3D Gaussians and its adjoint against plain torch, and what must hold of both."""

import dataclasses
import math

import pytest
import torch
from support import reference_gaussians as oracle
from support.worlds import assert_same, cotangents, relative_error, with_gradients

from npa_envs.ops import render_gaussians
from npa_envs.ops.pictures.cameras import Cameras, look_at, orbit

# Worst error measured over all scenes, then the bound.
PICTURE_BOUND = {torch.float32: 1e-5, torch.float64: 1e-13}  # 2e-6, 3e-15
GRADIENT_BOUND = {torch.float32: 3e-5, torch.float64: 1e-12}  # 5e-6, 8e-15


@dataclasses.dataclass(frozen=True)
class Scene:
    """Sizes and options of a random scene of Gaussians."""

    worlds: int = 1
    particles: int = 50
    views: int = 1
    size: tuple[int, int] = (45, 37)
    spread: float = 1.2
    scales: tuple[float, float] = (0.02, 0.2)
    opacities: tuple[float, float] = (0.0, 1.0)
    channels: int | None = 3
    """None: spherical harmonics."""
    own_cameras: bool = False
    own_intrinsics: str = "shared"
    radius: float = 3.0
    dilation: float = 0.3
    near: float = 0.2

    @property
    def gaussians(self):
        """Means, scales, quaternions, opacities and colours in float64 on the CPU."""
        generator = torch.Generator().manual_seed(self.particles + self.views)
        lead = (self.worlds, self.particles)

        def uniform(low, high, *shape):
            numbers = torch.rand(*lead, *shape, generator=generator, dtype=torch.float64)
            return low + (high - low) * numbers

        return [
            uniform(-self.spread, self.spread, 3),
            uniform(*self.scales, 3),
            torch.randn(*lead, 4, generator=generator, dtype=torch.float64),
            uniform(*self.opacities),
            uniform(0.0, 1.0, self.channels) if self.channels else uniform(-1.0, 1.0, 4, 3),
        ]

    @property
    def cameras(self):
        """Cameras of a turntable; where worlds have their own, all of them differ."""
        count = self.views * (self.worlds if self.own_cameras else 1)
        width, height = self.size
        cameras = orbit(
            count, 20.0, self.radius, 45.0, width=width, height=height, azimuth=10.0, near=self.near
        )
        motions = cameras.world_to_camera.double()
        if self.own_cameras:
            motions = motions.unflatten(0, (self.worlds, self.views))
        lenses = cameras.intrinsics.double()
        if self.own_intrinsics != "shared":
            shape = motions.shape[:-2] if self.own_intrinsics == "each" else motions.shape[-3:-2]
            factors = torch.linspace(0.8, 1.3, shape.numel(), dtype=torch.float64)
            lenses = lenses * factors.view(*shape, 1)
        return dataclasses.replace(cameras, world_to_camera=motions, intrinsics=lenses)

    def of(self, dtype, device):
        """Return Gaussians that require gradients, and cameras."""
        gaussians = [t.to(device, dtype).requires_grad_() for t in self.gaussians]
        return gaussians, self.cameras.to(device).to(dtype)


SCENES = {
    "one world": Scene(),
    "batch": Scene(worlds=3, views=2),
    "a camera for each": Scene(worlds=3, views=2, own_cameras=True, own_intrinsics="each"),
    "shared lenses": Scene(worlds=2, views=2, own_cameras=True, own_intrinsics="views"),
    "harmonics": Scene(worlds=2, views=2, channels=None),
    "four channels": Scene(channels=4),
    "one channel": Scene(channels=1),
    "whole tiles": Scene(size=(32, 16)),
    "one pixel": Scene(size=(1, 1)),
    "a row": Scene(size=(70, 1)),
    "thick": Scene(particles=300, opacities=(0.8, 1.0), scales=(0.1, 0.4), size=(20, 33)),
    "tiny": Scene(scales=(1e-4, 1e-3), opacities=(0.5, 1.0)),
    "thin": Scene(scales=(1e-3, 0.5), dilation=0.05),
    "no dilation": Scene(scales=(0.05, 0.3), dilation=0.0),
    "off-screen": Scene(particles=120, spread=4.0, scales=(0.1, 1.0), views=2, size=(40, 30)),
    "among them": Scene(particles=80, radius=0.5, near=0.3, views=2),
}


def expected_pictures(gaussians, cameras, *, background=None, dilation=0.3):
    worlds, views = gaussians[0].shape[0], cameras.count
    motions = cameras.world_to_camera.expand(worlds, views, 4, 4)
    lenses = cameras.intrinsics.expand(worlds, views, 4)
    size = {"width": cameras.width, "height": cameras.height, "near": cameras.near}
    drawn = [
        oracle.draw(
            *(tensor[world] for tensor in gaussians),
            view=motions[world, view],
            intrinsics=lenses[world, view],
            dilation=dilation,
            **size,
        )
        for world in range(worlds)
        for view in range(views)
    ]
    parts = zip(*drawn, strict=True)
    image, passing = (torch.stack(part).unflatten(0, (worlds, views)) for part in parts)
    if background is not None:
        image = image + passing[..., None] * background
    return image, 1.0 - passing


def gradients_of(image, alpha, inputs):
    """Return gradients of image and alpha for random cotangents, then of only alpha."""
    bars = cotangents((image, alpha))
    both = torch.autograd.grad((image, alpha), inputs, bars, retain_graph=True)
    return [*both, *torch.autograd.grad(alpha, inputs[:4], bars[1])]


@pytest.mark.parametrize("name", SCENES)
def test_pictures_and_adjoints_equal_the_oracle(name, dtype, device):
    scene = SCENES[name]
    exact, exact_cameras = scene.of(torch.float64, "cpu")
    behind = torch.linspace(0.2, 0.9, scene.channels or 3, dtype=torch.float64).requires_grad_()
    drawn = expected_pictures(exact, exact_cameras, background=behind, dilation=scene.dilation)
    expected = gradients_of(*drawn, [*exact, behind])

    gaussians, cameras = scene.of(dtype, device)
    background = behind.detach().to(device, dtype).requires_grad_()
    pictures = render_gaussians(*gaussians, cameras, background=background, dilation=scene.dilation)
    actual = (pictures.image, pictures.alpha)
    gradients = gradients_of(*actual, [*gaussians, background])
    assert not pictures.overflow.any()
    for value, wanted in zip(actual, drawn, strict=True):
        assert relative_error(value, wanted) < PICTURE_BOUND[dtype]
    for value, wanted in zip(gradients, expected, strict=True):
        assert float(wanted.norm()) > 0.0
        assert relative_error(value, wanted) < GRADIENT_BOUND[dtype]


def frontal(width, height, focal=50.0, dtype=torch.float64, device="cpu"):
    """Return a camera at the origin that looks along z, the picture's middle at the centre."""
    lens = torch.tensor([focal, focal, 0.5 * width, 0.5 * height], dtype=dtype, device=device)
    motion = torch.eye(4, dtype=dtype, device=device)[None]
    return Cameras(world_to_camera=motion, intrinsics=lens, width=width, height=height)


def single(mean, *, scale=(0.1, 0.1, 0.1), device):
    values = (mean, scale, (1.0, 0.0, 0.0, 0.0), 0.5, (1.0, 0.5, 0.25))
    return [torch.tensor(v, dtype=torch.float64, device=device)[None, None] for v in values]


def test_a_footprint_has_the_covariance_of_projected_samples(device):
    """Against perspective itself, which the affine approximation follows near the mean."""
    generator = torch.Generator().manual_seed(3)
    scale = torch.tensor([0.03, 0.01, 0.02], dtype=torch.float64)
    quaternion = torch.tensor([0.9, 0.2, -0.3, 0.4], dtype=torch.float64)
    mean = torch.tensor([0.25, -0.1, 2.0], dtype=torch.float64)
    normal = torch.randn(400_000, 3, generator=generator, dtype=torch.float64)
    w, *axis = quaternion / quaternion.norm()
    axis = torch.stack(axis).expand_as(normal)
    stretched = normal * scale
    turned = torch.linalg.cross(axis, torch.linalg.cross(axis, stretched) + w * stretched)
    places = mean + stretched + 2.0 * turned
    pixels = 400.0 * places[:, :2] / places[:, 2:] + 50.0
    covariance = torch.cov((pixels - pixels.mean(0)).T) + 0.3 * torch.eye(2)

    camera = frontal(120, 100, focal=400.0, device=device)
    lens = torch.tensor([400.0, 400.0, 50.0, 50.0], dtype=torch.float64, device=device)
    camera = dataclasses.replace(camera, intrinsics=lens)
    gaussians = single(tuple(mean.tolist()), scale=tuple(scale.tolist()), device=device)
    gaussians[2] = quaternion.to(device)[None, None]
    alpha = render_gaussians(*gaussians, camera).alpha[0, 0].cpu()
    rows, columns = torch.nonzero(alpha, as_tuple=True)
    away = torch.stack((columns + 0.5, rows + 0.5), -1) - pixels.mean(0)
    power = -0.5 * (away @ torch.linalg.inv(covariance) * away).sum(-1)
    assert relative_error(alpha[rows, columns], 0.5 * torch.exp(power)) < 0.01  # 5e-3


def test_harmonics_colour_a_gaussian_by_where_it_is_seen_from(device):
    """Kerbl's signs and order: with r the direction from the camera, -y, z and -x."""
    factors = (0.5 / math.sqrt(math.pi), 0.5 * math.sqrt(3.0 / math.pi))
    coefficients = torch.zeros(4, 3, dtype=torch.float64, device=device)
    coefficients[0] = coefficients.new_tensor([0.4, -0.2, -5.0])
    coefficients[1:, 0] = coefficients.new_tensor([0.3, 0.5, -0.2])
    gaussians = single((0.0, 0.0, 0.0), device=device)
    gaussians[4] = coefficients[None, None]
    eyes = torch.tensor([[0.0, 0.0, 2.0], [2.0, 0.0, 0.0], [1.0, 1.5, 0.7]], dtype=torch.float64)
    cameras = dataclasses.replace(frontal(33, 33), world_to_camera=look_at(eyes, (0.0, 0.0, 0.0)))
    image = render_gaussians(*gaussians, cameras.to(device)).image[0, :, 16, 16].cpu()
    x, y, z = (-eyes / eyes.norm(dim=-1, keepdim=True)).unbind(-1)
    red = 0.5 + factors[0] * 0.4 + factors[1] * (-0.3 * y + 0.5 * z + 0.2 * x)
    torch.testing.assert_close(image[:, 0], 0.5 * red, rtol=1e-9, atol=0.0)
    green = torch.full_like(red, 0.5 - 0.2 * factors[0])
    torch.testing.assert_close(image[:, 1], 0.5 * green, rtol=1e-9, atol=0.0)
    assert float(image[:, 2].abs().max()) == 0.0


def test_without_visible_gaussians_there_is_the_background(device):
    scene = Scene(worlds=2, views=2, size=(20, 18))
    gaussians, cameras = scene.of(torch.float32, device)
    with torch.no_grad():
        gaussians[0][..., 1] -= 50.0
        gaussians[3][1] = 0.003
        gaussians[0][1, ..., 1] += 50.0
    background = torch.rand(2, 2, 18, 20, 3, device=device).requires_grad_()
    pictures = render_gaussians(*gaussians, cameras, background=background)
    assert torch.equal(pictures.image, background)
    assert float(pictures.alpha.detach().abs().max()) == 0.0
    gradients = torch.autograd.grad(pictures.image.sum(), [*gaussians, background])
    assert all(float(gradient.abs().max()) == 0.0 for gradient in gradients[:5])
    assert torch.equal(gradients[5], torch.ones_like(background))


def test_equally_deep_gaussians_lie_in_the_order_of_their_indices(device):
    """Hundreds at one depth: the first is on top, on every run."""
    exact = Scene(particles=300, scales=(0.1, 0.3)).gaussians
    exact[0][..., 2] = 3.0
    camera = frontal(40, 40, dtype=torch.float32, device=device)
    gaussians = [tensor.to(device, torch.float32) for tensor in exact]
    image = render_gaussians(*gaussians, camera).image
    expected, _ = expected_pictures(exact, frontal(40, 40))
    assert relative_error(image, expected) < PICTURE_BOUND[torch.float32]
    reversed_image = render_gaussians(*(tensor.flip(1) for tensor in gaussians), camera).image
    assert relative_error(reversed_image, expected) > 0.01
    assert torch.equal(render_gaussians(*gaussians, camera).image, image)


def test_a_zero_quaternion_is_no_rotation_and_has_no_gradient(device):
    gaussians = single((0.1, 0.2, 2.0), scale=(0.3, 0.1, 0.2), device=device)
    camera = frontal(30, 30, device=device)
    expected = render_gaussians(*gaussians, camera).image
    gaussians[2] = torch.zeros_like(gaussians[2]).requires_grad_()
    image = render_gaussians(*gaussians, camera).image
    assert torch.equal(image, expected)
    (gradient,) = torch.autograd.grad(image.square().sum(), gaussians[2])
    assert float(gradient.abs().max()) == 0.0


NAMES = ("means", "scales", "quaternions", "opacities", "colours")
HOSTILE = [
    *((name, value) for name in NAMES for value in (math.nan, math.inf)),
    *((name, 1e30) for name in ("means", "scales")),
]


@pytest.mark.parametrize(("name", "value"), HOSTILE)
def test_gaussians_that_are_not_finite_leave_the_picture_alone(name, value, device):
    gaussians, cameras = SCENES["batch"].of(torch.float32, device)
    drawn = lambda *gaussians: render_gaussians(*gaussians, cameras)[:2]  # noqa: E731
    expected = with_gradients(drawn, *gaussians)
    hostile = [torch.cat((t.detach()[:, :1], t.detach()), dim=1) for t in gaussians]
    hostile[NAMES.index(name)][:, 0] = value
    actual = with_gradients(drawn, *hostile)
    assert_same([*actual[:2], *(bar[:, 1:] for bar in actual[2:])], expected)
    assert not any(bar[:, 0].any() for bar in actual[2:])


def test_without_room_the_farthest_are_missing(device):
    """A picture has room for a limited number of pairs of a tile and a Gaussian."""
    scene = Scene(worlds=2, particles=40, size=(64, 64), scales=(0.1, 0.2), spread=0.8)
    gaussians, cameras = scene.of(torch.float32, device)
    with torch.no_grad():
        gaussians[1][1] = 1e-3  # the second world needs little room
    full = render_gaussians(*gaussians, cameras, pairs_per_particle=16)
    pictures = render_gaussians(*gaussians, cameras, pairs_per_particle=3)
    assert pictures.overflow.tolist() == [[True], [False]]
    assert torch.equal(pictures.image[1], full.image[1])
    assert bool(pictures.image.isfinite().all())
    (gradient,) = torch.autograd.grad(pictures.image.sum(), gaussians[4])
    drawn = gradient[0].abs().amax(-1) > 0.0
    motion = cameras.world_to_camera[0]
    opacities = gaussians[3][0].detach()
    depths = (gaussians[0][0].detach() @ motion[:3, :3].mT + motion[:3, 3])[:, 2]
    assert 5 < int(drawn.sum()) < 35
    assert float(depths[drawn].max()) < float(depths[~drawn & (opacities > 0.1)].min())
    nearest = [t.detach()[:1, drawn] for t in gaussians]
    assert torch.equal(render_gaussians(*nearest, cameras).image[0], pictures.image[0])


@pytest.mark.parametrize("pairs", [None, 12])
def test_a_compiled_function_equals_the_eager_one(pairs, device):
    def loss(*gaussians):
        pictures = render_gaussians(*gaussians, cameras, pairs_per_particle=pairs)
        return pictures.image.square().sum() + pictures.alpha.sum()

    gaussians, cameras = SCENES["batch"].of(torch.float32, device)
    compiled = torch.compile(loss, backend="aot_eager", fullgraph=True)
    assert_same(with_gradients(compiled, *gaussians), with_gradients(loss, *gaussians))
