"""Steps and rollouts: reference trajectories, gradients, randomness, memory modes."""

import sys

import numpy as np
import pytest
import torch
from support.slow import slow
from support.worlds import (
    assert_near,
    assert_same,
    cotangents,
    lively_rule,
    random_world,
    relative_error,
    seeded,
)

import npa_envs
from npa_envs import reference as oracle
from npa_envs.ops import splat
from npa_envs.ops.perceive import Rows
from npa_envs.ops.physics import make_physics
from npa_envs.ops.update import update_particles
from npa_envs.tasks.seeds import uniform_ball
from npa_envs.world.steps import row_capacity


def plain_rollout(rule, x, s, steps, *, eps, box, dt, masks, detach_positions):
    """The dynamics in plain torch over the oracle, with given update masks."""
    path = torch.zeros(x.shape[:2], dtype=x.dtype)
    for t in range(steps):
        with pytest.MonkeyPatch.context() as patch:
            if not rule.moment_correction:
                patch.setattr(oracle, "MOMENT_THRESHOLD", float("inf"))
            inverse = rule.moment_inverse
            z = oracle.perceive(x, s, eps, rule.eps0, box, detach_positions, inverse)
        y = rule(z)
        mask = 1.0 if masks is None else masks[t][..., None]
        if rule.static:
            s = s + mask * dt * y
            continue
        delta = y[..., :2]
        length = delta.norm(dim=-1, keepdim=True)
        step = mask * dt * rule.alpha * eps * delta / (1.0 + length)
        x, s = x + step, s + mask * dt * y[..., 2:]
        path = path + step.norm(dim=-1)
        if box is not None:
            sides = torch.tensor(box, dtype=x.dtype)
            x = x - sides * torch.floor(x.detach() / sides + 0.5)
    return x, s, path


@pytest.fixture
def aubergine(reference):
    return npa_envs.load_rule(f"{reference / 'authors_demo_aubergine.json'}#aubergine")


@pytest.mark.parametrize(
    ("dtype", "x_bound", "s_bound"),
    [(torch.float64, 1e-11, 1e-11), (torch.float32, 3e-5, 1.5e-4)],
    ids=("float64", "float32"),
)
def test_a_rule_of_the_authors_follows_its_trajectory(
    dtype, x_bound, s_bound, device, aubergine, reference
):
    data = np.load(reference / "rollout_aubergine_8_steps.npz")
    x = torch.from_numpy(data["x0"])[None].to(device, dtype)
    s = x.new_zeros(1, 1024, 16)
    rule = aubergine.to(device, dtype)
    with torch.no_grad():
        x, s = npa_envs.rollout(rule, x, s, int(data["steps"]), eps=0.1, update_prob=1.0)
    assert (x[0].cpu().double() - torch.from_numpy(data["x"])).abs().max() < x_bound
    assert (s[0].cpu().double() - torch.from_numpy(data["s"])).abs().max() < s_bound


@pytest.mark.slow
def test_a_rule_of_the_authors_grows_its_picture(device, aubergine, reference):
    data = np.load(reference / "aubergine_512_steps_picture.npz")
    expected = torch.from_numpy(data["picture"].astype(np.float32)).flip(0)  # y points up here
    rule = aubergine.to(device)
    for seed in range(4):
        generator = torch.Generator(device).manual_seed(seed)
        x = uniform_ball(1, int(data["particle_count"]), 2, 0.2, generator=generator, device=device)
        s = x.new_zeros(1, x.shape[1], 16)
        with torch.no_grad():
            x, s = npa_envs.rollout(rule, x, s, int(data["steps"]), generator=generator)
            size = {"resolution": int(data["resolution"]), "pixel_size": float(data["pixel_size"])}
            centred = x - x.mean(dim=1, keepdim=True)
            picture = splat(centred, rule.colour(s), **size)[0].cpu()
        psnr = -10.0 * torch.log10((picture - expected).square().mean())
        assert psnr >= 24.0, f"seed {seed}: {psnr:.1f} dB"


def pulled(values):
    """Return a random functional of values, of which some have no gradient."""
    return sum((bar * v).sum() for bar, v in zip(cotangents(values), values, strict=True))


@pytest.mark.parametrize("update_prob", [1.0, 0.4])
@pytest.mark.parametrize("static", [False, True])
@pytest.mark.parametrize("box", [None, (1.4, 1.8)])
@pytest.mark.parametrize("detach_positions", [True, False])
@pytest.mark.parametrize("inverse", ["none", "smooth", "threshold"])
def test_rollout_and_its_gradients_equal_plain_torch(
    inverse, box, detach_positions, static, update_prob, device
):
    x, s = random_world(2, 60, 2, 5, dtype=torch.float64, device="cpu")
    options = {"eps": 0.3, "box": box, "dt": 0.7, "detach_positions": detach_positions}
    terms = {"moment_correction": False} if inverse == "none" else {"moment_inverse": inverse}
    masks = None
    if update_prob < 1.0:
        draws = seeded(9, device)
        blank = torch.empty(2, 60, dtype=torch.uint8, device=device)
        masks = [blank.bernoulli_(update_prob, generator=draws).cpu().double() for _ in range(4)]

    def run(rollout, device, **more):
        rule = lively_rule(device, static=static, **terms)
        start, states = (value.to(device).clone().requires_grad_() for value in (x, s))
        result = rollout(rule, start, states, 4, **options, **more)
        inputs = [states, *rule.parameters()] + ([] if static and detach_positions else [start])
        return result, torch.autograd.grad(pulled(result), inputs, allow_unused=True)

    expected, expected_gradients = run(plain_rollout, "cpu", masks=masks)
    more = {"update_prob": update_prob, "generator": seeded(9, device), "return_path_length": True}
    result, gradients = run(npa_envs.rollout, device, **more)
    assert_near(result, expected, 1e-12)
    for value, answer in zip(gradients, expected_gradients, strict=True):
        assert relative_error(value, answer) < 1e-11


def test_memory_modes_recompute_as_many_steps_as_they_say(device, monkeypatch):
    advanced = []
    advance = npa_envs.world.steps.RuleStep.advance

    def counted(*args):
        advanced[-1] += 1
        return advance(*args)

    monkeypatch.setattr(npa_envs.world.steps.RuleStep, "advance", counted)
    rule = lively_rule(device, dtype=torch.float32)
    x, s = random_world(2, 200, 2, 5, dtype=torch.float32, device=device)
    for memory in ("store", "recompute", "minimal"):
        advanced.append(0)
        _, after = npa_envs.rollout(rule, x, s, 5, memory=memory)
        after.sum().backward()
    assert advanced == [5, 5 + 3, 5 + 4]


def test_position_noise_has_its_standard_deviation(device):
    rule = npa_envs.NPARule(2, 4, 8, eps0=0.2, static=True).to(device)
    x = torch.zeros(4, 5000, 2, device=device)
    x += torch.linspace(0, 100, 5000, device=device)[:, None]
    s = torch.zeros(4, 5000, 4, device=device)
    moved, _ = npa_envs.step(rule, x, s, position_noise=0.05)
    noise = moved - x
    assert float(noise.detach().std()) == pytest.approx(0.05, rel=0.02)
    assert abs(float(noise.detach().mean())) < 0.002


def test_particles_that_are_off_are_wrapped_too(device):
    rule = lively_rule(device)
    x, s = random_world(1, 60, 2, 5, dtype=torch.float64, device=device)
    wrapped, same = npa_envs.step(rule, x + 5.0, s, box=1.0, update_prob=1e-9)
    assert wrapped.abs().max() <= 0.5
    turns = (x + 5.0 - wrapped).round()
    torch.testing.assert_close(wrapped + turns, x + 5.0)
    assert torch.equal(same, s)


@pytest.mark.parametrize("box", [None, 1.4])
@pytest.mark.parametrize("moving", [True, False])
@pytest.mark.parametrize("state_dim", [5, 16])
def test_rows_and_columns_that_nothing_reads_change_nothing(
    space_dim, state_dim, moving, box, device
):
    """How wide a row is decides how many numbers are read and written at once."""
    x, s = random_world(3, 85, space_dim, state_dim, dtype=torch.float32, device=device)
    generator = torch.Generator().manual_seed(1)
    integers = {"dtype": torch.int32, "device": device}
    active = torch.randperm(255, generator=generator)[:120].to(device)
    row_particle = torch.cat((active.int(), torch.tensor([2**30, -(2**30)], **integers)))
    row_of = torch.full((255,), -1, **integers)
    row_of[active] = torch.arange(120, **integers)
    rows = Rows(row_of, row_particle, torch.tensor([0, 255 + 120], **integers), row_base=255)
    width = state_dim + space_dim * moving
    update = torch.randn(122, width, generator=generator).to(device)

    options = {"moving": moving, "alpha": 1.0, "dt": 0.7}
    physics = make_physics(space_dim, state_dim, x.dtype, eps=0.1, box=box, **options)

    def run(padding):
        padded = torch.nn.functional.pad(update, (0, padding), value=7.0).requires_grad_()
        moved = update_particles(padded, x, s, x.new_ones(3, 85), rows, physics)
        (bar,) = torch.autograd.grad(moved, padded, cotangents(moved))
        assert (bar[:120, :width] != 0).all()
        assert (bar[120:] == 0).all()
        assert (bar[:, width:] == 0).all()
        return *moved, bar[:, :width]

    plain = run(0)
    for padding in range(1, 5):
        assert_same(run(padding), plain)
    changed = row_of.view(3, 85) >= 0
    change = update.new_zeros(255, state_dim)
    change[active] = 0.7 * update[:120, width - state_dim :]
    assert relative_error(plain[1], s.double() + change.view_as(s)) < 1e-7
    assert torch.equal(plain[1][~changed], s[~changed])


@pytest.mark.parametrize("update_prob", [0.01, 0.05, 0.5, 0.95])
@pytest.mark.parametrize("particle_total", [16, 512, 32768])
def test_row_capacity_holds_far_more_than_ever_drawn(particle_total, update_prob):
    generator = torch.Generator().manual_seed(0)
    draws = torch.empty(200, particle_total).bernoulli_(update_prob, generator=generator).sum(1)
    capacity = row_capacity(particle_total, update_prob)
    assert draws.max() <= capacity <= particle_total
    if particle_total == 32768:
        assert capacity <= particle_total * update_prob + 12.0 * 181.0 * 0.5 + 24.0


@pytest.mark.parametrize("update_prob", [0.5, 1.0])
@pytest.mark.parametrize("box", [None, 1.0])
@torch.no_grad()
def test_rows_some_at_a_time_give_the_same_worlds(monkeypatch, device, box, update_prob):
    rule = npa_envs.load_rule("gecko", device=device)
    generator = torch.Generator(device).manual_seed(0)
    x = torch.rand(2, 311, 2, generator=generator, device=device) - 0.5
    s = 0.1 * torch.randn(2, 311, rule.state_dim, generator=generator, device=device)

    def grown(**options):
        draws = torch.Generator(device).manual_seed(1)
        return npa_envs.rollout(
            rule, x, s, 5, box=box, update_prob=update_prob, generator=draws, **options
        )

    # The check of each step takes the steps that are launched one by one.
    expected = grown(on_divergence="raise")
    monkeypatch.setattr(sys.modules["npa_envs.world.steps"], "MAX_STORED_ROWS", 100)
    monkeypatch.setattr(sys.modules["npa_envs.ops.perceive"], "ROWS_TOGETHER", 96)
    for ours, theirs in zip(grown(on_divergence="raise"), expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-6)
    if device.type == "cuda":
        # A row's updates follow from that row alone.
        for ours, theirs in zip(grown(cuda_graph=False), expected, strict=True):
            assert torch.equal(ours, theirs)


def test_a_rollout_of_no_steps_returns_worlds_of_its_own():
    rule = lively_rule("cpu", torch.float32)
    x, s = random_world(1, 20, 2, 5, dtype=torch.float32, device="cpu")
    before = x.clone(), s.clone()
    after = npa_envs.rollout(rule, x, s, 0)
    assert_same(after, before)
    for tensor in after:
        tensor.zero_()
    assert_same((x, s), before)


@pytest.mark.parametrize(
    ("gradients", "static", "options"),
    [
        slow(False, False, {}),
        (True, False, {}),
        slow(True, True, {}),
        slow(True, False, {"memory": "minimal", "box": 1.5, "eps": 0.25}),
    ],
    ids=("quiet", "stored", "static", "recomputed"),
)
def test_a_rollout_compiled_for_all_sizes_is_a_rollout(gradients, static, options):
    rule = lively_rule("cpu", torch.float32, static=static)

    def outcome(x, s, eps0):
        # Numbers that a compiler takes for variables.
        rule.eps0 = eps0
        return npa_envs.rollout(rule, x, s, 2, update_prob=1.0, **options)

    # Otherwise what is compiled too often already runs as it is.
    torch.compiler.reset()
    compiled = torch.compile(outcome, backend="aot_eager", dynamic=True)
    with torch.set_grad_enabled(gradients):
        for world_count, particle_count, eps0 in ((1, 20, 0.2), (2, 30, 0.2), (2, 30, 0.3)):
            shape = (world_count, particle_count, 2, 5)
            x, s = random_world(*shape, dtype=torch.float32, device="cpu")
            s.requires_grad_(gradients)
            result, expected = compiled(x, s, eps0), outcome(x, s, eps0)
            torch.testing.assert_close(result, expected, rtol=1e-5, atol=1e-6)
            if gradients:
                bars = [torch.autograd.grad(way[1].sum(), s)[0] for way in (result, expected)]
                torch.testing.assert_close(*bars, rtol=1e-4, atol=1e-5)
