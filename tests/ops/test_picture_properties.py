"""What holds of every picture: order, place, scale and company of particles do not matter.

Likewise of every rule's file. The runs are those of test_properties.py.
"""

import math
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import hypothesis.strategies as st
import torch
from legal_worlds import GRID, UNIT, every, within
from torch import Tensor
from worlds import assert_same

import npa_envs
from npa_envs.ops import Cameras, orbit, periodic_splat, render_gaussians, splat
from npa_envs.rule.files import rule_metadata

PICTURE_BOUND = 200
"""Roundings of a pixel's sum, over the sum of what particles add to it at most."""


@dataclass(frozen=True)
class Picture:
    """2D worlds and how they are drawn."""

    x: Tensor
    colour: Tensor
    resolution: int
    pixel_size: float
    sigma: float
    lo: float
    hi: float
    periodic: bool
    cotangent: Tensor

    def drawn(self):
        """The pictures, and the gradients of a sum of them."""
        x, colour = self.x.clone().requires_grad_(), self.colour.clone().requires_grad_()
        picture = (periodic_splat if self.periodic else splat)(
            x, colour, resolution=self.resolution, pixel_size=self.pixel_size, sigma=self.sigma,
            lo=self.lo, hi=self.hi,
        )  # fmt: skip
        return picture.detach(), *torch.autograd.grad(picture, (x, colour), self.cotangent)

    @property
    def allowed(self):
        """How far rounding may move a pixel."""
        peak = (self.resolution * self.pixel_size / (self.hi - self.lo)) ** 2
        largest = float(self.colour.abs().max().clamp(min=1.0))
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
        x=x.to(device, dtype),
        colour=colour.to(device, dtype),
        resolution=resolution,
        pixel_size=draw(st.sampled_from((0.5, 1.0, 1.7))) * (hi - lo) / resolution,
        sigma=draw(st.sampled_from((0.5, 1.0, 2.0))),
        lo=lo,
        hi=hi,
        periodic=draw(st.booleans()),
        cotangent=cotangent.to(device, dtype),
    )


def permutation(count, like):
    return torch.randperm(count, generator=torch.Generator().manual_seed(count)).to(like.device)


@every(pictures)
def test_pictures_do_not_depend_on_the_order_of_particles(p):
    order = permutation(p.x.shape[1], p.x)
    picture, *bars = p.drawn()
    turned, *turned_bars = replace(p, x=p.x[:, order], colour=p.colour[:, order]).drawn()
    within(turned, picture, p.allowed)
    assert_same(turned_bars, [bar[:, order] for bar in bars])


@every(pictures)
def test_a_picture_in_a_batch_is_that_of_its_world(p):
    together = p.drawn()
    for k in range(p.x.shape[0]):
        only = slice(k, k + 1)
        alone = replace(p, x=p.x[only], colour=p.colour[only], cotangent=p.cotangent[only])
        assert_same([value[0] for value in alone.drawn()], [value[k] for value in together])


@every(lambda device: st.tuples(pictures(device), st.integers(-6, 6)))
def test_pictures_do_not_depend_on_the_unit_of_length(drawn):
    p, power = drawn
    factor = 2.0**power
    picture, x_bar, colour_bar = p.drawn()
    lengths = {name: getattr(p, name) * factor for name in ("x", "pixel_size", "lo", "hi")}
    assert_same(replace(p, **lengths).drawn(), (picture, x_bar / factor, colour_bar))


@every(lambda device: st.tuples(pictures(device), st.tuples(*[st.integers(-40, 40)] * 2)))
def test_periodic_pictures_turn_with_their_particles(drawn):
    p, pixels = drawn
    # A power of two of pixels, so that a shift by one of them rounds nothing.
    side = 2 ** max(3, round(math.log2(p.resolution)))
    cotangent = p.cotangent.new_ones(p.x.shape[0], side, side, 4)
    p = replace(p, periodic=True, resolution=side, cotangent=cotangent)
    shift = p.x.new_tensor(pixels) * ((p.hi - p.lo) / side)
    moved = replace(p, x=p.x + shift).drawn()[0]
    # Places are rounded where they are far from the first pixel.
    far = 1.0 + float((p.x.abs().max() + shift.abs().max()) * p.steepness)
    within(moved, p.drawn()[0].roll(tuple(reversed(pixels)), (1, 2)), far * p.allowed)


@dataclass(frozen=True)
class Scene:
    """3D worlds and how they are seen."""

    gaussians: tuple[Tensor, ...]
    """Means, scales, quaternions, opacities, colours."""
    cameras: Cameras
    cotangent: Tensor

    def drawn(self):
        """Image, alpha, and the gradients of a sum of the image."""
        leaves = [tensor.clone().requires_grad_() for tensor in self.gaussians]
        found = render_gaussians(*leaves, self.cameras)
        bars = torch.autograd.grad(found.image, leaves, self.cotangent)
        return [found.image.detach(), found.alpha.detach(), *bars]


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
    return Scene(made, cameras.to(device), cotangent.to(device, dtype))


@every(scenes)
def test_views_do_not_depend_on_the_order_of_gaussians(scene):
    order = permutation(scene.gaussians[0].shape[1], scene.gaussians[0])
    image, alpha, *bars = scene.drawn()
    turned = replace(scene, gaussians=tuple(part[:, order] for part in scene.gaussians)).drawn()
    assert torch.equal(turned[0], image)
    assert torch.equal(turned[1], alpha)
    assert_same(turned[2:], [bar[:, order] for bar in bars])


@every(scenes)
def test_a_view_in_a_batch_is_that_of_its_world(scene):
    together = scene.drawn()
    for k in range(scene.cotangent.shape[0]):
        parts = tuple(part[k : k + 1] for part in scene.gaussians)
        alone = replace(scene, gaussians=parts, cotangent=scene.cotangent[k : k + 1])
        assert_same([value[0] for value in alone.drawn()], [value[k] for value in together])


@every(lambda device: st.tuples(scenes(device), st.integers(-6, 6)))
def test_views_do_not_depend_on_the_unit_of_length(drawn):
    scene, power = drawn
    factor = 2.0**power
    motions = scene.cameras.world_to_camera.clone()
    motions[..., :3, 3] *= factor
    near = scene.cameras.near * factor
    means, scales, *rest = scene.gaussians
    scaled = replace(
        scene,
        gaussians=(means * factor, scales * factor, *rest),
        cameras=replace(scene.cameras, world_to_camera=motions, near=near),
    )
    (image, alpha, means_bar, scales_bar, *bars), found = scene.drawn(), scaled.drawn()
    expected = (image, alpha, means_bar / factor, scales_bar / factor, *bars)
    assert_same(found, expected)


@st.composite
def rules(draw, device):
    """Draw rules with every hyper-parameter."""
    sizes = st.integers(1, 20)
    readout = draw(st.sampled_from((0, 1, 7)))
    flags = ("static", "moment_correction", "state_gradient", "density_gradient")
    positive = st.floats(1e-6, 1e6)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(draw(st.integers(0, 2**31)))
        rule = npa_envs.NPARule(
            draw(st.sampled_from((2, 3))), draw(sizes), draw(sizes),
            eps0=draw(positive), alpha=draw(positive), readout_dim=readout,
            readout_hidden_dim=draw(sizes) if readout else 0, species_count=draw(st.integers(0, 3)),
            **{name: draw(st.booleans()) for name in flags},
        )  # fmt: skip
    return rule.to(device, draw(st.sampled_from(tuple(UNIT))))


WORDS = st.dictionaries(st.text("abc", min_size=1), st.text(max_size=8), max_size=2)


@every(lambda device: st.tuples(rules(device), WORDS))
def test_rules_survive_their_file_and_are_written_alike(drawn):
    rule, metadata = drawn
    with tempfile.TemporaryDirectory() as folder:
        first, second = Path(folder) / "first.safetensors", Path(folder) / "second.safetensors"
        npa_envs.save_rule(rule, first, metadata=metadata)
        loaded = npa_envs.load_rule(first)
        npa_envs.save_rule(loaded, second, metadata=metadata)
        assert metadata.items() <= rule_metadata(first).items()
        assert first.read_bytes() == second.read_bytes()
    assert loaded.hyper_parameters() == rule.hyper_parameters()
    for name, weight in rule.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], weight.cpu())
        assert loaded.state_dict()[name].dtype == weight.dtype
