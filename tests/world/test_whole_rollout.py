"""Rollouts of small worlds in one kernel: the numbers, draws and errors of launched steps."""

import itertools
import math

import pytest
import torch
from support.worlds import relative_error

import npa_envs
from npa_envs import reference
from npa_envs.kernels.cuda.whole_rollout import SHARED_BYTES, fits_block
from npa_envs.ops.backend import KernelRequest, choose
from npa_envs.ops.random_numbers import mask_increment, torch_masks
from npa_envs.ops.whole_rollout import VARIANTS, world_variant

DEVICE, EPS = torch.device("cuda", 0), 0.1

hopper = pytest.mark.gpu


@pytest.fixture(autouse=True)
def only_where_it_runs(request):
    """Skip tests of the kernel on other GPUs."""
    if request.node.get_closest_marker("gpu") and torch.cuda.get_device_capability() != (9, 0):
        pytest.skip("needs compute capability 9.0")


def worlds(count, particles, channels=16, spread=1.0, offset=0.0):
    generator = torch.Generator(DEVICE).manual_seed(particles)
    x = torch.rand(count, particles, 2, generator=generator, device=DEVICE) - 0.5
    s = torch.randn(count, particles, channels, generator=generator, device=DEVICE)
    return x * (1.4 * spread * math.sqrt(particles / 4096)) + offset, 0.1 * s


def make_rule(channels=16, hidden=128, std=0.1, **options):
    torch.manual_seed(0)
    rule = npa_envs.NPARule(2, channels, hidden, eps0=EPS, **options)
    for parameter in rule.parameters():
        torch.nn.init.normal_(parameter, std=std)
    return rule.to(DEVICE)


def whole(rule, x, s, steps, seed=0, generator=None, **options):
    """A rollout in one kernel; the same worlds with paths cannot run in one, and do not."""
    generator = generator or torch.Generator(DEVICE).manual_seed(seed)
    with torch.no_grad():
        return npa_envs.rollout(
            rule, x, s, steps, generator=generator, cuda_graph="whole", **options
        )


def launched(rule, x, s, steps, seed=0, generator=None, **options):
    generator = generator or torch.Generator(DEVICE).manual_seed(seed)
    with torch.no_grad():
        return npa_envs.rollout(rule, x, s, steps, generator=generator, cuda_graph=False, **options)


def test_every_variant_fits_into_shared_memory():
    for size, hidden, count in itertools.product(VARIANTS, (8, 128, 256), (1, 66, 400, 5000)):
        assert fits_block(size, 16, hidden)
        variant = world_variant(count, size, 16, hidden, 132)
        assert variant.memory(hidden) <= SHARED_BYTES
        assert (variant.size, variant.threads <= 512) == (size, True)


def test_worlds_that_one_kernel_does_not_serve_are_launched(monkeypatch):
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (9, 0))
    served = KernelRequest(
        torch.device("cuda", 7), torch.float32, 256, space_dim=2, hidden_dim=128, rollout=True,
        state_dim=16,
    )  # fmt: skip
    assert choose("rollout", served).name == "whole"
    others = (
        {"dtype": torch.float64}, {"particle_count": 513}, {"particle_count": 31},
        {"space_dim": 3}, {"hidden_dim": 512}, {"state_dim": 17}, {"boundary": "periodic"},
    )  # fmt: skip
    for change in others:
        assert choose("rollout", served._replace(**change)).name == "steps", change


@hopper
@pytest.mark.parametrize("spread", [1.0, 4.0, 0.3])
@pytest.mark.parametrize("particles", [512, 256, 100, 40])
def test_perception_is_that_of_the_reference(particles, spread):
    x, s = worlds(3, particles, spread=spread, offset=5.0)
    expected = reference.perceive(x.double(), s.double(), EPS, EPS)
    rule = npa_envs.NPARule(2, 16, 32, eps0=EPS).to(DEVICE)
    columns = []
    # Rules that add two hidden units for each column to a state: z = relu(z) - relu(-z).
    for first in range(0, rule.perception_dim, 16):
        last = min(first + 16, rule.perception_dim)
        for parameter in rule.parameters():
            torch.nn.init.zeros_(parameter)
        with torch.no_grad():
            for k in range(last - first):
                for unit, sign in ((2 * k, 1.0), (2 * k + 1, -1.0)):
                    rule.hidden.weight[unit, first + k] = rule.output.weight[2 + k, unit] = sign
        _, after = whole(rule, x, s, 1, update_prob=1.0, dt=2.0**40)
        columns.append((after - s)[..., : last - first] / 2.0**40)
    assert relative_error(torch.cat(columns, dim=-1), expected) < 1e-6


@hopper
@pytest.mark.parametrize(
    ("particles", "form", "options"),
    [
        (256, {}, {}),
        (500, {}, {"position_noise": 0.002}),
        (130, {"channels": 5, "hidden": 40}, {"update_prob": 1.0, "dt": 0.5}),
        (60, {"channels": 8, "moment_inverse": "smooth"}, {"eps": 0.07}),
        (200, {"density_gradient": False}, {"box": 0.32, "boundary": "reflecting"}),
        (90, {"state_gradient": False}, {"position_noise": 0.01}),
    ],
)
def test_updates_are_as_accurate_as_those_of_launched_steps(particles, form, options):
    rule = make_rule(**form)
    x, s = worlds(5, particles, channels=rule.state_dim)
    exact = launched(make_rule(**form).double(), x.double(), s.double(), 1, **options)
    ours, theirs = whole(rule, x, s, 1, **options), launched(rule, x, s, 1, **options)
    # Normal numbers of float64 are other ones.
    for k in (1,) if "position_noise" in options else (0, 1):
        start = (x, s)[k]
        errors = [relative_error(v[k].double() - start, exact[k] - start) for v in (ours, theirs)]
        assert errors[0] < 3.0 * errors[1] + 1e-7
    # Lively rules amplify any rounding.
    calm = make_rule(std=0.02, **form)
    pairs = zip(whole(calm, x, s, 20, **options), launched(calm, x, s, 20, **options), strict=True)
    for one, other in pairs:
        assert relative_error(one, other) < 1e-5


@hopper
@pytest.mark.parametrize("particles", [400, 256, 128, 64])
def test_a_world_has_the_same_bits_in_every_batch_and_every_time(particles):
    x, s = worlds(700, particles)
    rule, seeds = make_rule(std=0.2), range(700)
    every = whole(rule, x, s, 40, generator=npa_envs.WorldRandom(seeds, device=DEVICE))
    assert every[1].isfinite().all()
    for count in (1, 60, 150, 300, 700):
        streams = npa_envs.WorldRandom(seeds[:count], device=DEVICE)
        some = whole(rule, x[:count], s[:count], 40, generator=streams)
        assert all(
            torch.equal(one, all_of[:count]) for one, all_of in zip(some, every, strict=True)
        )


@hopper
@pytest.mark.parametrize("by_world", [False, True])
@pytest.mark.parametrize("noise", [0.0, 0.002])
def test_draws_are_those_of_launched_steps(by_world, noise):
    x, s = worlds(50, 100)
    rule, results = make_rule(std=0.02), []
    for run in (whole, launched):
        generator = torch.Generator(DEVICE).manual_seed(3)
        if by_world:
            generator = npa_envs.WorldRandom(range(50), device=DEVICE)
        after = run(rule, x, s, 20, generator=generator, position_noise=noise)
        if by_world:
            generator.advance()
            drawn = generator.uniform(5)
        else:
            drawn = torch.rand(5, device=DEVICE, generator=generator)
        results.append((*after, drawn))
    assert relative_error(results[0][0], results[1][0]) < 1e-5
    assert relative_error(results[0][1], results[1][1]) < 1e-5
    assert torch.equal(results[0][2], results[1][2])


@pytest.mark.gpu
@pytest.mark.parametrize("count", [7, 6400, 270_336, 3_000_001])
def test_masks_are_those_of_torch(count):
    increment = mask_increment(DEVICE, count)
    assert increment is not None
    generator = torch.Generator(DEVICE).manual_seed(5)
    torch.rand(9, device=DEVICE, generator=generator)
    masks = torch.full((3, count), 2, dtype=torch.uint8, device=DEVICE)
    torch_masks(masks, 0.3, 5, generator.get_offset())
    for mask in masks:
        assert torch.equal(mask, torch.empty_like(mask).bernoulli_(0.3, generator=generator))


@hopper
def test_positions_that_are_not_finite_are_an_error_that_draws_nothing():
    x, s = worlds(4, 100)
    x[2, 3] = math.nan
    generator = torch.Generator(DEVICE).manual_seed(1)
    before = generator.get_offset()
    with pytest.raises(npa_envs.NPAError, match="world 2, particle 3"):
        whole(make_rule(), x, s, 9, generator=generator)
    assert generator.get_offset() == before


@hopper
def test_it_can_be_part_of_a_graph():
    x, s = worlds(10, 100)
    rule = make_rule()

    def streams():
        return npa_envs.WorldRandom(range(10), device=DEVICE)

    expected, captured = whole(rule, x, s, 4, generator=streams()), streams()
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        after = whole(rule, x, s, 4, generator=captured)
    graph.replay()
    assert all(map(torch.equal, after, expected))
