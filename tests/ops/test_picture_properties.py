"""What holds of every picture: order, place, scale and company of particles do not matter.

The runs are those of test_properties.py.
"""

import math
from dataclasses import dataclass, replace

import hypothesis.strategies as st
import torch
from support.legal_worlds import GRID, UNIT, every, within
from support.worlds import assert_same
from torch import Tensor

from npa_envs.ops import Cameras, orbit, periodic_splat, render_gaussians, splat

PICTURE_BOUND = 200
"""Roundings of a pixel's sum, over the sum of what particles add to it at most."""


@dataclass(frozen=True)
class Drawing:
    """Random worlds, with the window or cameras that draw them."""

    particles: tuple[Tensor, ...]
    """What particles are, shape [B, N, ...] each."""
    cotangent: Tensor

    def ordered(self, order):
        return replace(self, particles=tuple(value[:, order] for value in self.particles))

    def alone(self, k):
        particles = tuple(value[k : k + 1] for value in self.particles)
        return replace(self, particles=particles, cotangent=self.cotangent[k : k + 1])


@dataclass(frozen=True)
class Picture(Drawing):
    """2D worlds, positions and colours, and their window."""

    resolution: int
    pixel_size: float
    sigma: float
    lo: float
    hi: float
    periodic: bool

    @property
    def x(self):
        return self.particles[0]

    def drawn(self):
        """Return the pictures, and gradients of a random sum of them with respect to particles."""
        leaves = [value.clone().requires_grad_() for value in self.particles]
        picture = (periodic_splat if self.periodic else splat)(
            *leaves, resolution=self.resolution, pixel_size=self.pixel_size, sigma=self.sigma,
            lo=self.lo, hi=self.hi,
        )  # fmt: skip
        return [picture.detach()], torch.autograd.grad(picture, leaves, self.cotangent)

    def scaled(self, factor):
        lengths = {name: getattr(self, name) * factor for name in ("pixel_size", "lo", "hi")}
        return replace(self, particles=(self.x * factor, self.particles[1]), **lengths)

    @property
    def allowed(self):
        """Return the error of a pixel that rounding may cause."""
        peak = (self.resolution * self.pixel_size / (self.hi - self.lo)) ** 2
        largest = float(self.particles[1].abs().max().clamp(min=1.0))
        return PICTURE_BOUND * UNIT[self.x.dtype] * self.x.shape[1] * peak * largest

    @property
    def steepness(self):
        """Pixels of a length unit over those of a spot's standard deviation, at least 1."""
        return max(1.0, 1.0 / (self.sigma * self.pixel_size), self.resolution / (self.hi - self.lo))


@st.composite
def pictures(draw, device, *, dtypes=tuple(UNIT)):
    """Draw pictures, with particles that coincide, lie on edges, on pixels, and outside."""
    dtype = draw(st.sampled_from(dtypes))
    shape = draw(st.integers(1, 3)), draw(st.integers(1, 24))
    resolution = draw(st.sampled_from((2, 8, 13, 16, 32)))
    lo = draw(st.integers(-2048, 1024)) * GRID
    hi = lo + draw(st.sampled_from((256, 1024, 2048))) * GRID
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**31)))
    overhang = draw(st.sampled_from((0, 100, 4096)))
    first, last = round(lo / GRID) - overhang, round(hi / GRID) + overhang
    x = torch.randint(first, last + 1, (*shape, 2), generator=generator) * GRID
    if draw(st.booleans()):
        x = x.clamp(lo, hi)
    colour = torch.randn(*shape, 3, generator=generator, dtype=torch.float64)
    cotangent = torch.randn(
        shape[0], resolution, resolution, 4, generator=generator, dtype=torch.float64
    )
    return Picture(
        (x.to(device, dtype), colour.to(device, dtype)),
        cotangent.to(device, dtype),
        resolution=resolution,
        pixel_size=draw(st.sampled_from((0.5, 1.0, 1.7))) * (hi - lo) / resolution,
        sigma=draw(st.sampled_from((0.5, 1.0, 2.0))),
        lo=lo,
        hi=hi,
        periodic=draw(st.booleans()),
    )


@every(lambda device: st.tuples(pictures(device), st.tuples(*[st.integers(-40, 40)] * 2)))
def test_periodic_pictures_turn_with_their_particles(drawn):
    p, pixels = drawn
    # A power of two of pixels, so that a shift by one of them rounds nothing.
    side = 2 ** max(3, round(math.log2(p.resolution)))
    cotangent = p.cotangent.new_ones(p.x.shape[0], side, side, 4)
    p = replace(p, periodic=True, resolution=side, cotangent=cotangent)
    shift = p.x.new_tensor(pixels) * ((p.hi - p.lo) / side)
    (moved,), _ = replace(p, particles=(p.x + shift, p.particles[1])).drawn()
    # Places are rounded where they are far from the first pixel.
    far = 1.0 + float((p.x.abs().max() + shift.abs().max()) * p.steepness)
    (picture,), _ = p.drawn()
    within(moved, picture.roll(tuple(reversed(pixels)), (1, 2)), far * p.allowed)


@dataclass(frozen=True)
class Scene(Drawing):
    """3D worlds (means, scales, quaternions, opacities and colours) and their cameras."""

    cameras: Cameras
    allowed: float = 0.0
    """How far rounding may move a pixel: Gaussians are drawn in the order of their depths."""

    def drawn(self):
        """Return image and alpha, and the gradients of a sum of the image."""
        leaves = [tensor.clone().requires_grad_() for tensor in self.particles]
        results = render_gaussians(*leaves, self.cameras)
        bars = torch.autograd.grad(results.image, leaves, self.cotangent)
        return [results.image.detach(), results.alpha.detach()], bars

    def scaled(self, factor):
        motions = self.cameras.world_to_camera.clone()
        motions[..., :3, 3] *= factor
        cameras = replace(self.cameras, world_to_camera=motions, near=self.cameras.near * factor)
        means, scales, *others = self.particles
        return replace(self, particles=(means * factor, scales * factor, *others), cameras=cameras)


@st.composite
def scenes(draw, device):
    """Draw scenes; no two Gaussians of a world are as far away as each other."""
    dtype = draw(st.sampled_from(tuple(UNIT)))
    lead = draw(st.integers(1, 3)), draw(st.integers(1, 16))
    views, width, height = (draw(st.integers(1, high)) for high in (3, 24, 24))
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**31)))

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    channels = draw(st.sampled_from(((1,), (3,), (4,), (4, 3))))
    gaussians = (
        normal(*lead, 3),
        draw(st.sampled_from((0.0, 0.05, 0.5))) * normal(*lead, 3).abs(),
        normal(*lead, 4),
        torch.rand(lead, generator=generator, dtype=torch.float64),
        normal(*lead, *channels),
    )
    elevation, radius = draw(st.integers(-80, 80)), draw(st.sampled_from((0.5, 3.0, 20.0)))
    fov = draw(st.sampled_from((20.0, 45.0, 120.0)))
    cameras = orbit(views, elevation, radius, fov, width=width, height=height)
    cotangent = normal(lead[0], views, height, width, channels[-1])
    made = tuple(tensor.to(device, dtype) for tensor in gaussians)
    return Scene(made, cotangent.to(device, dtype), cameras.to(device))


def both(device):
    return st.tuples(pictures(device), scenes(device))


@every(both)
def test_pictures_do_not_depend_on_the_order_of_particles(drawn):
    for p in drawn:
        images, bars = p.drawn()
        generator = torch.Generator().manual_seed(bars[0].shape[1])
        order = torch.randperm(bars[0].shape[1], generator=generator).to(bars[0].device)
        turned, turned_bars = p.ordered(order).drawn()
        for image, answer in zip(turned, images, strict=True):
            within(image, answer, p.allowed)
        assert_same(turned_bars, [bar[:, order] for bar in bars])


@every(both)
def test_a_picture_in_a_batch_is_that_of_its_world(drawn):
    for p in drawn:
        images, bars = p.drawn()
        for k in range(len(p.cotangent)):
            alone = p.alone(k).drawn()
            expected = [value[k : k + 1] for value in (*images, *bars)]
            assert_same(alone, expected)


@every(lambda device: st.tuples(both(device), st.integers(-6, 6)))
def test_pictures_do_not_depend_on_the_unit_of_length(drawn):
    (picture, scene), power = drawn
    factor = 2.0**power
    # What has a length: positions, means, scales.
    for p, lengths in ((picture, 1), (scene, 2)):
        images, bars = p.drawn()
        expected = [bar / factor for bar in bars[:lengths]] + [*bars[lengths:]]
        assert_same(p.scaled(factor).drawn(), (images, expected))
