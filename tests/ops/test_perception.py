"""The Warp operators against the plain torch oracle, the reference answers and their invariants."""

import itertools

import numpy as np
import pytest
import torch
from support.worlds import (
    assert_same,
    cotangents,
    degenerate_world,
    exact,
    random_mask,
    random_world,
    relative_error,
    rows_of,
    sides,
    with_gradients,
)

import npa_envs
from npa_envs import reference as oracle
from npa_envs.ops.perceive import NeighbourState
from npa_envs.ops.physics import Limits, Terms, make_physics

# The bound of the tests, then the worst error measured on CPUs and CUDA: a quarter of it at most.
FORWARD = {torch.float32: 8e-6, torch.float64: 2e-14}  # 1.9e-6, 3.8e-15 (CUDA)
GRADIENT = {torch.float32: 5e-6, torch.float64: 1e-14}  # 5e-7, 1e-15
POSITION_GRADIENT = {torch.float32: 2e-5, torch.float64: 4e-14}  # 7e-7, 8e-15

REFERENCE_FILES = ("2d_open", "2d_open_degenerate", "2d_periodic", "3d_open", "3d_periodic")

both_inverses = pytest.mark.parametrize("moment_inverse", ["threshold", "smooth"])


def assert_equal_to_the_oracle(x, s, eps, eps0, box=None, **options):
    """Compare the perception of every particle, and its gradients by positions and states."""

    def answers(perceive, *worlds):
        def both(x, s):
            return perceive(x, s, eps, eps0, box, detach_positions=False, **options)

        return with_gradients(both, *worlds)

    expected = answers(oracle.perceive, *exact(x, s))
    bounds = (FORWARD[x.dtype], POSITION_GRADIENT[x.dtype], GRADIENT[x.dtype])
    found = answers(npa_envs.perceive, x, s)
    for value, answer, bound in zip(found, expected, bounds, strict=True):
        assert value.isfinite().all()
        assert relative_error(value, answer) < bound


@pytest.mark.parametrize("name", REFERENCE_FILES)
def test_reference_answers_are_met(name, dtype, device, reference):
    """The bounds are the project's promise: 1e-5 and 1e-11, positions 1e-4 and 1e-10."""
    data = np.load(reference / f"perception_{name}.npz")

    def tensor(key):
        return torch.from_numpy(data[key])[None].to(device, dtype)

    eps, eps0, box = (float(data[key]) for key in ("eps", "eps0", "box"))
    box = box or None
    bound = 1e-5 if dtype == torch.float32 else 1e-11
    position_bound = 1e-4 if dtype == torch.float32 else 1e-10
    x, s = tensor("x"), tensor("s")
    fields = npa_envs.perception_fields(x, s, eps, box)
    for key, value in fields._asdict().items():
        assert relative_error(value, torch.from_numpy(data[key])[None]) < bound, key

    s.requires_grad_()
    z = npa_envs.perceive(x, s, eps, eps0, box)
    z.backward(tensor("cotangent_z"))
    assert relative_error(z, torch.from_numpy(data["z"])[None]) < bound
    assert relative_error(s.grad, torch.from_numpy(data["grad_s"])[None]) < bound

    s.grad = None
    x.requires_grad_()
    npa_envs.perceive(x, s, eps, eps0, box, detach_positions=False).backward(tensor("cotangent_z"))
    assert relative_error(s.grad, torch.from_numpy(data["grad_s_full"])[None]) < bound
    assert relative_error(x.grad, torch.from_numpy(data["grad_x_full"])[None]) < position_bound


@both_inverses
@pytest.mark.parametrize("state_dim", [1, 3, 16, 21])
@pytest.mark.parametrize("box", [None, "square", "oblong"])
def test_perception_and_its_adjoints_equal_the_oracle(
    dtype, space_dim, box, state_dim, moment_inverse, device
):
    x, s = random_world(3, 83, space_dim, state_dim, dtype=dtype, device=device)
    box = sides(box, space_dim)
    assert_equal_to_the_oracle(x, s, 0.3, 0.2, box, moment_inverse=moment_inverse)
    fields = npa_envs.perception_fields(x, s, 0.3, box, moment_inverse=moment_inverse)
    expected = oracle.fields(*exact(x, s), 0.3, box, moment_inverse=moment_inverse)
    for value, answer in zip(fields, expected, strict=True):
        assert relative_error(value, answer) < FORWARD[dtype]


@both_inverses
def test_degenerate_geometry_equals_the_oracle(dtype, space_dim, moment_inverse, device):
    x, s = degenerate_world(space_dim, 4, dtype=dtype, device=device)
    assert_equal_to_the_oracle(x, s, 0.15, 0.15, moment_inverse=moment_inverse)


@pytest.mark.parametrize("distance", [1e-8, 1e-12, 1e-16, 1e-19])
def test_particles_that_nearly_touch_have_finite_gradients(dtype, space_dim, distance, device):
    """Gradients by positions grow with 1 / distance; nothing on the way to them may overflow."""
    x = torch.zeros(1, 2, space_dim, dtype=dtype, device=device)
    x[0, 1, 0] = distance
    _, s = random_world(1, 2, space_dim, 4, dtype=dtype, device=device)
    assert_equal_to_the_oracle(x, s, 0.1, 0.1)


@pytest.mark.parametrize("box", [None, "oblong"])
def test_states_whose_squares_overflow_are_perceived(dtype, space_dim, box, device):
    """Lengths of gradients are computed without squares where squares would be infinite."""
    box = sides(box, space_dim)
    largest = 33 if dtype == torch.float32 else 300

    def logarithms(perceive):
        # The other columns are 1e33 times as large, and their gradients too.
        def columns(x, s):
            z = perceive(x, s, 0.3, 0.3, box, detach_positions=False)
            return z[..., 10 : 10 + 5 * space_dim]

        return columns

    for power in (largest // 2, largest // 2 + 3, largest):
        x, s = random_world(2, 83, space_dim, 5, dtype=dtype, device=device)
        s *= 10.0**power
        found, x_bar, s_bar = with_gradients(logarithms(npa_envs.perceive), x, s)
        expected, *bars = with_gradients(logarithms(oracle.perceive), *exact(x, s))
        assert relative_error(found, expected) < FORWARD[dtype]
        # The adjoint has |v| from L(v): a rounding of that is one of log |v|.
        magnified = float(expected.abs().max())
        error = relative_error(s_bar * 10.0**power, bars[1] * 10.0**power)
        assert error < magnified * GRADIENT[dtype]
        assert relative_error(x_bar, bars[0]) < magnified * POSITION_GRADIENT[dtype]


def test_a_clump_takes_no_more_memory_than_the_same_particles_apart(space_dim):
    """All are in one cell: time is quadratic in their number, memory is not."""

    def allocated(particle_count, side):
        x, s = random_world(1, particle_count, space_dim, 16, dtype=torch.float32, device="cpu")
        x, s = side * x, s.requires_grad_()
        with torch.profiler.profile(profile_memory=True) as profile:
            npa_envs.perceive(x, s, 0.1).sum().backward()
        return sum(max(event.self_cpu_memory_usage, 0) for event in profile.events())

    few, many = allocated(400, 0.03), allocated(800, 0.03)
    # What 800 particles are given and make: z alone has 800 (4 or 5) 16 numbers of 4 bytes.
    assert many > 800 * (2 + space_dim) * 16 * 4
    assert many < 2.1 * few
    assert many <= 1.1 * allocated(800, 1.0)


def observed(x, s, *, eps=0.2, eps0=0.2, box=None, limit=16.0, **terms):
    options = {"eps": eps, "eps0": eps0, "box": box, "terms": Terms(**terms)}
    physics = make_physics(x.shape[2], s.shape[2], x.dtype, **options)
    return NeighbourState(x, s, physics._replace(limits=Limits(perception=limit)))


@both_inverses
@pytest.mark.parametrize(
    ("space_dim", "state_dim", "box"),
    [(2, 16, None), (2, 5, (1.4, 1.9)), (2, 32, None), (3, 16, None), (3, 21, (1.4, 1.9, 1.5))],
)
def test_observation_is_perception_in_the_callers_order_and_clipped(
    space_dim, state_dim, box, moment_inverse, dtype, device
):
    x, s = random_world(3, 133, space_dim, state_dim, dtype=dtype, device=device)
    # On CUDA lists are for 64 neighbours: some of these particles have more, others fewer.
    x[:, :70] *= 0.1
    expected = oracle.perceive(*exact(x, s), 0.3, 0.2, box, moment_inverse=moment_inverse)
    neighbours = observed(x, s, eps=0.3, box=box, limit=1.5, moment_inverse=moment_inverse)
    assert (expected.abs() > 1.5).any()
    # The second time, a recorded launch runs.
    for _ in range(2):
        out = torch.full(expected.shape, float("nan"), dtype=dtype, device=device)
        assert neighbours.perceive(out) is out
        assert relative_error(out, expected.clamp(-1.5, 1.5)) < FORWARD[dtype]


@pytest.mark.parametrize(("count", "tagged"), [(133, 18), (4200, 2)])
def test_worlds_that_changed_are_perceived_as_they_are_after_an_update(count, tagged, device):
    """Exactly; small worlds on a CPU repeat the launches of the first update."""
    x, s = random_world(3, count, 2, 16, dtype=torch.float32, device=device)
    neighbours, species = observed(x, s), torch.arange(count, device=device) % tagged
    tags = torch.nn.functional.one_hot(species).to(x).repeat(3, 1, 1)
    for _ in range(3):
        x.copy_(0.9 * x.roll(5, dims=1))
        s.copy_(s.roll(1, dims=2))
        neighbours.update()
        assert torch.equal(neighbours.perceive(), observed(x, s).perceive())
        if device.type == "cpu":
            smoothed = npa_envs.perceive(x, tags, 0.2)[..., tagged : 2 * tagged]
            assert torch.equal(neighbours.smoothed_species(species, tagged), smoothed)


def answers(x, s, bars):
    """Return perception of environments and of rollouts, with its gradients, open and in a box."""
    results = [observed(x, s).perceive()]
    for box, detached in itertools.product((None, (1.4, 1.8)), (True, False)):
        leaves = [value.clone().requires_grad_() for value in (x, s)]
        z = npa_envs.perceive(*leaves, 0.2, box=box, detach_positions=detached)
        z.backward(bars)
        assert (leaves[0].grad is None) == detached
        results += [z.detach(), *(leaf.grad for leaf in leaves if leaf.grad is not None)]
    return results


@pytest.mark.parametrize("count", [83, 333, 2100])
def test_a_world_of_a_batch_equals_that_world_alone(count, device):
    """Exactly; the worlds begin anywhere within a CUDA warp, and large ones have longer lists."""
    x, s = random_world(5, count, 2, 16, dtype=torch.float32, device=device)
    (bars,) = cotangents([s.new_empty(5, count, 66)])
    together = answers(x, s, bars)
    for k in range(5):
        alone = answers(x[k : k + 1], s[k : k + 1], bars[k : k + 1])
        assert_same([value[0] for value in alone], [value[k] for value in together])


@pytest.mark.parametrize("box", [(1.22, 1.8), (1.62, 6.0), (8.0, 1.42)])
def test_particles_several_boxes_away_are_perceived_where_they_are_wrapped(box, device):
    x, s = random_world(2, 203, 2, 16, dtype=torch.float32, device=device)
    turns = torch.randint(-3, 4, x.shape, generator=torch.Generator().manual_seed(0))
    away = (x / 2.8 + turns.to(x)) * x.new_tensor(box)
    expected = oracle.perceive(*exact(away, s), 0.2, 0.2, box=box)
    # Positions of up to 15 are wrapped: worst error measured 3.5e-5 (CUDA).
    assert relative_error(npa_envs.perceive(away, s, 0.2, box=box), expected) < 1.5e-4


def test_smoothing_kernel_integrates_to_one():
    axis = torch.linspace(-0.3, 0.3, 121, dtype=torch.float64)
    for space_dim in (2, 3):
        grid = torch.cartesian_prod(*(axis,) * space_dim)
        weight = oracle.smoothing_kernel((grid**2).sum(-1), 0.25, space_dim)
        integral = float(weight.sum()) * (axis[1] - axis[0]) ** space_dim
        assert integral == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("density_gradient", [False, True])
@pytest.mark.parametrize("state_gradient", [False, True])
def test_skipped_groups_leave_the_others_and_their_gradients(
    state_gradient, density_gradient, device
):
    x, s = random_world(2, 60, 2, 5, dtype=torch.float64, device=device)
    kept = [*range(10), *range(10, 20 * state_gradient), *range(20, 22 * density_gradient)]
    terms = {"state_gradient": state_gradient, "density_gradient": density_gradient}

    def whole(x, s):
        return npa_envs.perceive(x, s, 0.3, detach_positions=False)[..., kept]

    def fewer(x, s):
        return npa_envs.perceive(x, s, 0.3, detach_positions=False, **terms)

    (z, *bars), (expected, *others) = (with_gradients(f, x, s) for f in (fewer, whole))
    assert torch.equal(z, expected)
    for bar, other in zip(bars, others, strict=True):
        assert relative_error(bar, other) < 1e-13


ACTIVE = [(2, 21, None), (2, 17, (0.6, 0.6)), (2, 5, (0.6, 2.9)), (3, 33, (0.6, 0.7, 0.9))]


@pytest.mark.parametrize(("space_dim", "state_dim", "box"), [*ACTIVE, (3, 4, None)])
@pytest.mark.parametrize("room", [0, 50, -9])
def test_rows_of_active_particles_equal_the_oracle(room, space_dim, state_dim, box, device):
    """With gradients for states and positions, an idle world, and poison beyond the last row.

    Active particles for which there is no room are left out.
    """
    x, s = random_world(3, 37, space_dim, state_dim, dtype=torch.float64, device=device)
    mask = random_mask(x, 0.4)
    mask[0] = 0
    active = mask.cpu().view(-1).nonzero()[:, 0]
    exact_x, exact_s = (t.requires_grad_() for t in exact(x, s))
    expected = oracle.perceive(exact_x, exact_s, 0.3, 0.2, box, detach_positions=False)
    width, count = expected.shape[-1], len(active) + min(room, 0)
    (cotangent,) = cotangents([expected.view(-1, width)])

    x, s = x.requires_grad_(), s.requires_grad_()
    size = {"width": width + 3, "capacity": len(active) + room}
    perception, rows = rows_of(x, s, mask, eps0=0.2, box=box, **size)
    assert (perception[:count, width] == 1).all()
    assert (perception[:count, width + 1 :] == 0).all()
    assert (perception[count:] == 0).all()
    source = rows.row_particle[:count].long().cpu()
    assert torch.equal((rows.row_of >= 0).nonzero()[:, 0].cpu(), source.sort().values)
    assert torch.isin(source, active).all()
    poisoned = torch.full_like(perception, float("nan"))
    poisoned[:count, :width] = cotangent[source].to(device)
    perception.backward(poisoned)
    wanted = expected.view(-1, width)[source]
    wanted.backward(cotangent[source])
    assert relative_error(perception[:count, :width], wanted) < 1e-14
    assert relative_error(s.grad, exact_s.grad) < 1e-14
    assert relative_error(x.grad, exact_x.grad) < 1e-14


CLOSE_PAIRS = ((-0.053246427, 1.3467536), (-0.7, 0.69999994), (-0.7, 0.6999998))


@pytest.mark.parametrize(("left", "right"), CLOSE_PAIRS)
def test_close_pairs_across_a_seam_have_the_right_density_gradient(left, right, device):
    """The box's rounding exceeds their distance across it: float32 alone has no direction here."""
    x = torch.tensor([[(left, 0.0), (right, 1e-9)]], dtype=torch.float32, device=device)
    s = torch.zeros(1, 2, 1, device=device)
    actual = npa_envs.perception_fields(x, s, 0.3, 1.4).drho
    side = float(torch.tensor(1.4, dtype=torch.float32))
    want = oracle.fields(x.cpu().double(), s.cpu().double(), 0.3, (side, side)).drho
    assert relative_error(actual, want) < 1e-6


@both_inverses
def test_rotation_turns_vectors_and_keeps_scalars(space_dim, moment_inverse, device):
    """What follows from other motions, orders and scales is in test_properties.py."""
    x, s = random_world(2, 120, space_dim, 5, dtype=torch.float64, device=device)
    generator = torch.Generator().manual_seed(3)
    turn = torch.linalg.qr(torch.randn(space_dim, space_dim, generator=generator).double()).Q.to(x)
    z = npa_envs.perceive(x, s, 0.3, moment_inverse=moment_inverse)
    turned = npa_envs.perceive(x @ turn.T, s, 0.3, moment_inverse=moment_inverse)
    assert relative_error(turned[..., :10], z[..., :10]) < 1e-13
    vectors = z[..., 10:].unflatten(-1, (-1, space_dim)) @ turn.T
    assert relative_error(turned[..., 10:], vectors.flatten(2)) < 1e-12


class TestGeometryLimits:
    """Any position is legal in open space; boxes may be as small as 2 eps."""

    def test_particles_far_outside_still_see_each_other(self, dtype, device):
        x, s = random_world(1, 50, 2, 3, dtype=dtype, device=device)
        near = npa_envs.perceive(x, s, 0.3)
        far = torch.cat((x, torch.full_like(x[:, :1], 1e30)), dim=1)
        other = torch.cat((s, s[:, :1]), dim=1)
        z = npa_envs.perceive(far, other, 0.3)
        scalars = torch.cat((near[..., :6], near[..., 6:12]), dim=-1)
        assert relative_error(z[:, :50, :12], scalars) < FORWARD[dtype]
        torch.testing.assert_close(z[0, 50, :3], s[0, 0])
        torch.testing.assert_close(z[0, 50, 3:6], s[0, 0])
        assert z[0, 50, 6:].abs().max() == 0

    @pytest.mark.parametrize("place", [3.0e8, -1.0e30, 3.4e38])
    def test_coincident_particles_far_away_are_neighbours(self, place, device):
        x = torch.full((1, 4, 2), place, device=device)
        s = torch.arange(4.0, device=device)[None, :, None]
        fields = npa_envs.perception_fields(x, s, 0.1)
        torch.testing.assert_close(fields.blur, torch.full_like(fields.blur, 1.5))
        assert fields.grad0.abs().max() == 0
        (gradient,) = torch.autograd.grad(npa_envs.perceive(x, s.requires_grad_(), 0.1)[0, 0, 1], s)
        torch.testing.assert_close(gradient, torch.full_like(s, 0.25))


def test_only_the_perception_by_threshold_jumps(device):
    """A particle sinks into the line through two others: the corner that it sees goes flat."""
    heights = torch.linspace(0.0, 0.03, 30_001, dtype=torch.float64)
    x = torch.zeros(len(heights), 3, 2, dtype=torch.float64, device=device)
    x[:, 1, 0], x[:, 2, 0], x[:, 2, 1] = 0.04, 0.05, heights.to(device)
    s = x.new_tensor([[0.0], [1.0], [-1.0]]).expand(len(heights), -1, -1)

    def largest_jump(moment_inverse):
        z = npa_envs.perceive(x, s, 0.1, moment_inverse=moment_inverse)
        return float(z[:, 0].diff(dim=0).abs().max())

    assert largest_jump("smooth") < 1e-2
    assert largest_jump("threshold") > 1.0


def test_density_of_thousands_of_neighbours_counts_each_once(device):
    x = torch.zeros(1, 9000, 2, dtype=torch.float64, device=device)
    s = x.new_zeros(1, 9000, 3)
    alone = npa_envs.perception_fields(x[:, :1], s[:, :1], 0.2).rho
    together = npa_envs.perception_fields(x, s, 0.2).rho
    torch.testing.assert_close(together, 9000 * alone.expand_as(together), rtol=1e-12, atol=0.0)


def test_a_backward_pass_refuses_perception_that_was_changed(device):
    x, s = random_world(1, 20, 2, 5, dtype=torch.float64, device=device)
    z = npa_envs.perceive(x, s.requires_grad_(), 0.3)
    z.zero_()
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        z.sum().backward()
