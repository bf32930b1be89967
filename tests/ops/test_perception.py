"""The Warp operators against the plain torch oracle, the reference answers and their invariants."""

import numpy as np
import pytest
import torch
from worlds import degenerate_world, random_world, relative_error

import npa_envs
from npa_envs import reference as oracle
from npa_envs.ops import backend as passes
from npa_envs.ops import sort as cells
from npa_envs.ops.perceive import Terms, perceive_rows, survey
from npa_envs.ops.sort import make_plan, sort_worlds

# Worst error measured on CPU and CUDA, then the bound of the test: a few times larger.
FORWARD = {torch.float32: 2e-6, torch.float64: 5e-15}  # 3.1e-7, 5e-16
GRADIENT = {torch.float32: 5e-6, torch.float64: 1e-14}  # 5e-7, 1e-15
POSITION_GRADIENT = {torch.float32: 2e-5, torch.float64: 2e-14}  # 7e-7, 2e-15

DTYPES = (torch.float32, torch.float64)
BOXES = (None, "square", "oblong")
REFERENCE_FILES = (
    "perception_2d_open",
    "perception_2d_open_degenerate",
    "perception_2d_periodic",
    "perception_3d_open",
    "perception_3d_periodic",
)


def sides(box, space_dim):
    if box is None:
        return None
    return (1.4,) * space_dim if box == "square" else (1.4, 1.9, 1.5)[:space_dim]


@pytest.mark.parametrize("dtype", DTYPES, ids=("float32", "float64"))
@pytest.mark.parametrize("name", REFERENCE_FILES)
def test_reference_answers_are_met(name, dtype, device, reference):
    """The bounds are the project's promise: 1e-5 and 1e-11, positions 1e-4 and 1e-10."""
    data = np.load(reference / f"{name}.npz")

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


@pytest.mark.parametrize("state_dim", [1, 3, 16, 21])
@pytest.mark.parametrize("box", BOXES)
@pytest.mark.parametrize("space_dim", [2, 3])
@pytest.mark.parametrize("dtype", DTYPES, ids=("float32", "float64"))
def test_perception_and_its_adjoints_equal_the_oracle(dtype, space_dim, box, state_dim, device):
    x, s = random_world(3, 83, space_dim, state_dim, dtype=dtype, device=device)
    box = sides(box, space_dim)
    exact_x, exact_s = (t.cpu().double().clone().requires_grad_() for t in (x, s))
    expected = oracle.perceive(exact_x, exact_s, 0.3, 0.2, box, detach_positions=False)
    cotangent = torch.randn(
        expected.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1)
    )
    expected.backward(cotangent)

    x.requires_grad_()
    s.requires_grad_()
    z = npa_envs.perceive(x, s, 0.3, 0.2, box, detach_positions=False)
    z.backward(cotangent.to(z))
    assert relative_error(z, expected) < FORWARD[dtype]
    assert relative_error(s.grad, exact_s.grad) < GRADIENT[dtype]
    assert relative_error(x.grad, exact_x.grad) < POSITION_GRADIENT[dtype]


@pytest.mark.parametrize("space_dim", [2, 3])
@pytest.mark.parametrize("dtype", DTYPES, ids=("float32", "float64"))
def test_degenerate_geometry_equals_the_oracle(dtype, space_dim, device):
    x, s = degenerate_world(space_dim, 4, dtype=dtype, device=device)
    exact_x, exact_s = (t.cpu().double().clone().requires_grad_() for t in (x, s))
    expected = oracle.perceive(exact_x, exact_s, 0.15, 0.15, detach_positions=False)
    expected.backward(torch.ones_like(expected))
    x.requires_grad_()
    s.requires_grad_()
    z = npa_envs.perceive(x, s, 0.15, 0.15, detach_positions=False)
    z.backward(torch.ones_like(z))
    assert torch.isfinite(z).all()
    assert torch.isfinite(x.grad).all()
    assert relative_error(z, expected) < FORWARD[dtype]
    assert relative_error(s.grad, exact_s.grad) < GRADIENT[dtype]
    assert relative_error(x.grad, exact_x.grad) < POSITION_GRADIENT[dtype]


@pytest.mark.parametrize("distance", [1e-8, 1e-12, 1e-16, 1e-19])
@pytest.mark.parametrize("space_dim", [2, 3])
@pytest.mark.parametrize("dtype", DTYPES, ids=("float32", "float64"))
def test_particles_that_nearly_touch_have_finite_gradients(dtype, space_dim, distance, device):
    """Gradients by positions grow with 1 / distance; nothing on the way to them may overflow."""
    x = torch.zeros(1, 2, space_dim, dtype=dtype, device=device)
    x[0, 1, 0] = distance
    _, s = random_world(1, 2, space_dim, 4, dtype=dtype, device=device)
    exact_x, exact_s = (t.cpu().double().clone().requires_grad_() for t in (x, s))
    expected = oracle.perceive(exact_x, exact_s, 0.1, 0.1, detach_positions=False)
    weights = torch.linspace(-1.0, 1.0, expected.numel(), dtype=torch.float64).view_as(expected)
    (expected * weights).sum().backward()
    x.requires_grad_()
    z = npa_envs.perceive(x, s, 0.1, detach_positions=False)
    (z * weights.to(z)).sum().backward()
    assert relative_error(z, expected) < FORWARD[dtype]
    assert relative_error(x.grad, exact_x.grad) < POSITION_GRADIENT[dtype]


@pytest.mark.parametrize("box", [None, "oblong"])
@pytest.mark.parametrize("space_dim", [2, 3])
@pytest.mark.parametrize("dtype", DTYPES, ids=("float32", "float64"))
def test_states_whose_squares_overflow_are_perceived(dtype, space_dim, box, device):
    """Lengths of gradients are taken without their squares where those are no numbers."""
    box = sides(box, space_dim)
    largest = 33 if dtype == torch.float32 else 300
    for power in (largest // 2, largest // 2 + 3, largest):
        x, s = random_world(2, 83, space_dim, 5, dtype=dtype, device=device)
        s *= 10.0**power
        exact_x, exact_s = (t.cpu().double().clone().requires_grad_() for t in (x, s))
        expected = oracle.perceive(exact_x, exact_s, 0.3, 0.3, box, detach_positions=False)
        # The other columns are 1e33 times as large, and their gradients too.
        logarithms = expected[..., 10 : 10 + 5 * space_dim]
        cotangent = torch.linspace(-1.0, 1.0, logarithms.numel(), dtype=torch.float64)
        cotangent = cotangent.view_as(logarithms)
        (logarithms * cotangent).sum().backward()
        x.requires_grad_()
        s.requires_grad_()
        z = npa_envs.perceive(x, s, 0.3, box=box, detach_positions=False)
        found = z[..., 10 : 10 + 5 * space_dim]
        (found * cotangent.to(z)).sum().backward()
        assert relative_error(found, logarithms) < FORWARD[dtype]
        # The adjoint has |v| from L(v): a rounding of that is one of log |v|.
        magnified = float(logarithms.detach().abs().max())
        assert relative_error(found, logarithms) < FORWARD[dtype]
        error = relative_error(s.grad * 10.0**power, exact_s.grad * 10.0**power)
        assert error < magnified * GRADIENT[dtype]
        assert relative_error(x.grad, exact_x.grad) < magnified * POSITION_GRADIENT[dtype]


@pytest.mark.parametrize("space_dim", [2, 3])
def test_a_clump_takes_no_more_memory_than_the_same_particles_apart(space_dim):
    """All in one cell: time is quadratic in them, but nothing is kept for each pair."""

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


@pytest.mark.parametrize("space_dim", [2, 3])
def test_gradients_pass_gradcheck(space_dim, device):
    x, s = random_world(1, 9, space_dim, 3, dtype=torch.float64, device=device)
    x, s = (0.4 * x).requires_grad_(), s.requires_grad_()
    # Without the moment correction: that is a stopped gradient, which differences would see.
    assert torch.autograd.gradcheck(
        lambda x, s: npa_envs.perceive(x, s, 0.3, detach_positions=False, moment_correction=False),
        (x, s),
    )


@pytest.mark.parametrize("dtype", DTYPES, ids=("float32", "float64"))
@pytest.mark.parametrize(
    ("space_dim", "state_dim", "box"),
    [(2, 16, None), (2, 5, (1.4, 1.9)), (2, 32, None), (3, 16, None), (3, 21, (1.4, 1.9, 1.5))],
)
def test_observation_is_perception_in_the_callers_order_and_clipped(
    space_dim, state_dim, box, dtype, device
):
    x, s = random_world(3, 83, space_dim, state_dim, dtype=dtype, device=device)
    expected = oracle.perceive(x.cpu().double(), s.cpu().double(), 0.3, 0.2, box)
    surveyed = survey(x, s, eps=0.3, eps0=0.2, box=box, terms=Terms(), limit=1.5)
    assert (expected.abs() > 1.5).any()
    # The second time, a recorded launch is repeated.
    for _ in range(2):
        out = torch.full(expected.shape, float("nan"), dtype=dtype, device=device)
        assert surveyed.perceive(out) is out
        assert relative_error(out, expected.clamp(-1.5, 1.5)) < FORWARD[dtype]


@pytest.mark.parametrize(
    ("space_dim", "state_dim", "box"),
    [(2, 20, (1.5, 1.7)), (2, 5, None), (3, 16, None), (3, 33, (1.5, 1.7, 1.6))],
)
@pytest.mark.parametrize("shared", [0, 4096], ids=("one thread", "several threads"))
def test_rows_are_right_however_many_threads_share_them(
    space_dim, state_dim, box, shared, device, monkeypatch
):
    monkeypatch.setattr(passes, "SHARED_WORLD", shared)
    x, s = random_world(3, 211, space_dim, state_dim, dtype=torch.float32, device=device)
    z = npa_envs.perceive(x, s, 0.3, 0.3, box=box)
    expected = oracle.perceive(x.cpu().double(), s.cpu().double(), 0.3, 0.3, box)
    assert relative_error(z, expected) < FORWARD[torch.float32]
    for k in range(3):
        alone = npa_envs.perceive(x[k : k + 1], s[k : k + 1], 0.3, 0.3, box=box)
        assert torch.equal(z[k], alone[0])


@pytest.mark.parametrize("count", [333, 2100])
def test_observation_of_a_world_does_not_depend_on_its_batch(count, device):
    """The worlds begin anywhere within a CUDA warp; large ones have longer lists."""
    x, s = random_world(5, count, 2, 16, dtype=torch.float32, device=device)

    def run(x, s):
        return survey(x, s, eps=0.2, eps0=0.2, box=None, terms=Terms(), limit=16.0).perceive()

    together = run(x, s)
    for k in range(5):
        assert torch.equal(together[k], run(x[k : k + 1], s[k : k + 1])[0])


@pytest.mark.parametrize("masked", [False, True], ids=("all", "active"))
@pytest.mark.parametrize("count", [40, 130, 300, 900])
@pytest.mark.parametrize("shared", [0, 4096], ids=("one thread", "several threads"))
def test_rows_of_crowded_worlds_are_right(count, masked, shared, device, monkeypatch):
    """Everybody sees everybody: on CUDA, lists overflow, and before that a lane's share of one."""
    monkeypatch.setattr(passes, "SHARED_WORLD", shared)
    x, s = random_world(2, count, 2, 16, dtype=torch.float32, device=device)
    x *= 0.05
    generator = torch.Generator().manual_seed(2)
    mask = (torch.rand(2, count, generator=generator) < 0.5).to(torch.uint8) if masked else None
    rows, places = perceive_rows(
        x,
        s,
        mask=None if mask is None else mask.to(device),
        row_capacity=2 * count,
        row_width=68,
        eps=0.2,
        eps0=0.2,
        box=None,
        terms=Terms(),
    )
    expected = oracle.perceive(x.cpu().double(), s.cpu().double(), 0.2, 0.2).view(-1, 66)
    active = torch.ones(2 * count, dtype=torch.bool) if mask is None else mask.view(-1).bool()
    row_of = places.row_of.cpu().long()
    assert torch.equal(row_of >= 0, active)
    assert (
        relative_error(rows.cpu()[row_of[active], :66], expected[active]) < FORWARD[torch.float32]
    )


def test_neighbourhoods_may_be_longer_than_lists(device):
    """On CUDA lists are for 64 neighbours here: some of these particles have more, others fewer."""
    x, s = random_world(3, 333, 2, 16, dtype=torch.float32, device=device)
    x[:, :100] *= 0.1
    neighbours = (torch.cdist(x, x) < 0.2).sum(-1)
    assert neighbours.min() < 20
    assert neighbours.max() > 100

    def run(x, s):
        return survey(x, s, eps=0.2, eps0=0.2, box=None, terms=Terms(), limit=16.0).perceive()

    together = run(x, s)
    expected = oracle.perceive(x.cpu().double(), s.cpu().double(), 0.2, 0.2).clamp(-16.0, 16.0)
    assert relative_error(together, expected) < FORWARD[torch.float32]
    assert torch.equal(together[1], run(x[1:2], s[1:2])[0])


MASKS = {"all": None, "some": 0.5, "none": 0.0, "full": 1.0}


def sorted_twice(x, s, mask, row_capacity, box, monkeypatch, **options):
    """Sort worlds as they come, and as if no block had room for them."""
    plan = make_plan(x, x.shape, s.shape[2], row_capacity, mask is not None, 0.1, box)
    given = options.pop("with_states", True)
    found = sort_worlds(plan, x, s if given else None, mask, **options)
    monkeypatch.setattr(cells, "_block_capacity", lambda *worlds: 0)
    expected = sort_worlds(plan, x, s if given else None, mask, **options)
    return found, expected


@pytest.mark.parametrize("masked", MASKS)
@pytest.mark.parametrize("state_dim", [5, 16, 20])
@pytest.mark.parametrize(
    ("world_count", "particle_count", "space_dim", "box"),
    [
        (1, 1, 2, None),
        (3, 83, 3, None),
        (2, 1000, 2, (1.3, 0.9)),
        (3, 1024, 2, None),
        (150, 129, 2, None),
        (2, 1500, 3, (1.4, 1.5, 0.9)),
        (5, 4096, 2, None),
    ],
)
def test_small_worlds_are_sorted_as_others_are(
    world_count, particle_count, space_dim, box, state_dim, masked, device, monkeypatch
):
    """On CUDA a block sorts a small world by itself; elsewhere the two are the same kernels."""
    x, s = random_world(
        world_count, particle_count, space_dim, state_dim, dtype=torch.float32, device=device
    )
    x[0, : particle_count // 4] = 0.25
    x[-1, 0] = 1e6
    mask = None
    if MASKS[masked] is not None:
        generator = torch.Generator().manual_seed(2)
        mask = torch.rand(x.shape[:2], generator=generator) < MASKS[masked]
        mask = mask.to(device, torch.uint8)
    total = world_count * particle_count
    active = total if mask is None else int(mask.sum())
    found, expected = sorted_twice(x, s, mask, max(active, 1), box, monkeypatch)
    names = ("row_source", "row_place", "row_positions")
    for name, value in found._asdict().items():
        count = active if name in names else None
        assert torch.equal(value[:count], getattr(expected, name)[:count]), name


@pytest.mark.parametrize("particle_count", [300, 1500])
@pytest.mark.parametrize(
    ("with_states", "with_rows"), [(False, False), (True, False), (False, True)]
)
def test_small_worlds_are_sorted_without_states_or_rows(
    with_states, with_rows, particle_count, device, monkeypatch
):
    x, s = random_world(3, particle_count, 2, 16, dtype=torch.float32, device=device)
    options = {"with_states": with_states, "with_rows": with_rows}
    found, expected = sorted_twice(x, s, None, 3 * particle_count, None, monkeypatch, **options)
    for value, wanted in zip(found, expected, strict=True):
        assert torch.equal(value, wanted)


def test_small_worlds_leave_out_what_no_row_is_left_for(device, monkeypatch):
    x, s = random_world(3, 500, 2, 16, dtype=torch.float32, device=device)
    mask = torch.ones(3, 500, dtype=torch.uint8, device=device)
    found, expected = sorted_twice(x, s, mask, 700, None, monkeypatch)
    for value, wanted in zip(found, expected, strict=True):
        assert torch.equal(value, wanted)


def test_particles_in_one_cell_are_sorted_by_index(device, monkeypatch):
    x, s = random_world(2, 1100, 2, 16, dtype=torch.float32, device=device)
    x[:] = 0.3
    found, expected = sorted_twice(x, s, None, 2200, None, monkeypatch)
    assert torch.equal(found.source.cpu(), torch.arange(2200, dtype=torch.int32))
    for value, wanted in zip(found, expected, strict=True):
        assert torch.equal(value, wanted)


def test_detached_positions_get_no_gradient(device):
    x, s = random_world(1, 20, 2, 4, dtype=torch.float32, device=device)
    x.requires_grad_()
    s.requires_grad_()
    npa_envs.perceive(x, s, 0.3).sum().backward()
    assert x.grad is None
    assert s.grad.abs().sum() > 0


def test_isolated_particle_sees_itself_only(device):
    x = torch.zeros(1, 1, 2, dtype=torch.float64, device=device)
    s = torch.tensor([[[0.3, -2.0]]], dtype=torch.float64, device=device)
    z = npa_envs.perceive(x, s, 0.1)
    expected = torch.tensor([0.3, -2.0, 0.3, -2.0, 0, 0, 0, 0, 0, 0], dtype=torch.float64)
    torch.testing.assert_close(z[0, 0].cpu(), expected, rtol=1e-15, atol=0)


def test_smoothing_kernel_integrates_to_one():
    axis = torch.linspace(-0.3, 0.3, 121, dtype=torch.float64)
    for space_dim in (2, 3):
        grid = torch.cartesian_prod(*(axis,) * space_dim)
        weight = oracle.smoothing_kernel((grid**2).sum(-1), 0.25, space_dim)
        integral = float(weight.sum()) * (axis[1] - axis[0]) ** space_dim
        assert integral == pytest.approx(1.0, abs=1e-4)


def test_skipped_groups_leave_the_others_unchanged(device):
    x, s = random_world(2, 60, 2, 5, dtype=torch.float64, device=device)
    full = npa_envs.perceive(x, s, 0.3)
    no_density = npa_envs.perceive(x, s, 0.3, density_gradient=False)
    no_gradient = npa_envs.perceive(x, s, 0.3, state_gradient=False)
    neither = npa_envs.perceive(x, s, 0.3, state_gradient=False, density_gradient=False)
    assert torch.equal(no_density, full[..., :20])
    assert torch.equal(no_gradient, torch.cat((full[..., :10], full[..., 20:]), dim=-1))
    assert torch.equal(neither, full[..., :10])


def test_gradients_of_skipped_groups_equal_those_of_zero_cotangents(device):
    x, s = random_world(2, 60, 2, 5, dtype=torch.float64, device=device)
    gradients = []
    for options, columns in (({"state_gradient": False}, 12), ({}, 22)):
        s_, x_ = s.clone().requires_grad_(), x.clone().requires_grad_()
        z = npa_envs.perceive(x_, s_, 0.3, detach_positions=False, **options)
        assert z.shape[-1] == columns
        (z[..., :10].square().sum() + z[..., -2:].square().sum()).backward()
        gradients.append((x_.grad, s_.grad))
    assert relative_error(gradients[0][0], gradients[1][0]) < 1e-13
    assert relative_error(gradients[0][1], gradients[1][1]) < 1e-13


@pytest.mark.parametrize(
    ("space_dim", "state_dim", "box"),
    [
        (2, 21, None),
        (2, 17, (0.6, 0.6)),
        (2, 5, (0.6, 2.9)),
        (3, 33, (0.6, 0.7, 0.9)),
        (3, 4, None),
    ],
)
@pytest.mark.parametrize("spare_rows", [False, True])
def test_rows_of_active_particles_equal_the_oracle(spare_rows, space_dim, state_dim, box, device):
    """With gradients for states and positions, an idle world, and poison beyond the last row."""
    x, s = random_world(3, 37, space_dim, state_dim, dtype=torch.float64, device=device)
    mask = torch.rand(3, 37, generator=torch.Generator().manual_seed(4)) < 0.4
    mask[0] = False
    mask = mask.to(device)
    active = int(mask.sum())
    exact_x, exact_s = x.cpu().requires_grad_(), s.cpu().requires_grad_()
    expected = oracle.perceive(exact_x, exact_s, 0.3, 0.2, box, detach_positions=False)
    width = expected.shape[-1]
    cotangent = torch.randn(
        expected.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1)
    )
    (expected * cotangent * mask.cpu()[..., None]).sum().backward()

    x, s = x.detach().clone().requires_grad_(), s.detach().clone().requires_grad_()
    perception, rows = perceive_rows(
        x,
        s,
        mask=mask.to(torch.uint8),
        row_capacity=111 if spare_rows else active,
        row_width=width + 3,
        eps=0.3,
        eps0=0.2,
        box=box,
        terms=Terms(),
    )
    assert (perception[:active, width] == 1).all()
    assert (perception[:active, width + 1 :] == 0).all()
    assert (perception[active:] == 0).all()
    source = rows.row_source[:active].long()
    assert torch.equal(source.sort().values, mask.view(-1).nonzero()[:, 0])
    poisoned = torch.full_like(perception, float("nan"))
    poisoned[:active, :width] = cotangent.view(-1, width).to(device)[source]
    perception.backward(poisoned)
    wanted = expected.view(-1, width)[source.cpu()]
    assert relative_error(perception[:active, :width], wanted) < 1e-14
    assert relative_error(s.grad, exact_s.grad) < 1e-14
    assert relative_error(x.grad, exact_x.grad) < 1e-14


def test_particles_beyond_the_row_capacity_are_left_out_cleanly(device):
    x, s = random_world(2, 30, 2, 4, dtype=torch.float64, device=device)
    s.requires_grad_()
    perception, rows = perceive_rows(
        x,
        s,
        mask=torch.ones(2, 30, dtype=torch.uint8, device=device),
        row_capacity=41,
        row_width=18,
        eps=0.3,
        eps0=0.3,
        box=None,
        terms=Terms(),
    )
    assert int((rows.row_of >= 0).sum()) == 41
    assert int(rows.row_of.max()) == 40
    source = rows.row_source.long().cpu()
    exact = s.detach().cpu().requires_grad_()
    expected = oracle.perceive(x.cpu(), exact, 0.3, 0.3).view(-1, 18)[source]
    assert relative_error(perception, expected) < 1e-14
    (got,) = torch.autograd.grad(perception.square().sum(), s)
    (want,) = torch.autograd.grad(expected.square().sum(), exact)
    assert relative_error(got, want) < 1e-14


@pytest.mark.parametrize(
    "pair",
    [
        ((-0.053246427, 0.0), (1.3467536, 1e-9)),
        ((-0.7, 0.0), (0.69999994, 1e-9)),
        ((-0.7, 0.0), (0.6999998, 1e-9)),
    ],
)
def test_close_pairs_across_a_seam_have_the_right_density_gradient(pair, device):
    """The box's rounding exceeds their distance across it: float32 alone has no direction here."""
    x = torch.tensor([pair], dtype=torch.float32, device=device)
    s = torch.zeros(1, 2, 1, device=device)
    got = npa_envs.perception_fields(x, s, 0.3, 1.4).drho
    side = float(torch.tensor(1.4, dtype=torch.float32))
    want = oracle.fields(x.cpu().double(), s.cpu().double(), 0.3, (side, side)).drho
    assert relative_error(got, want) < 1e-6


class TestInvariance:
    """What must not change when a world is moved, turned or renumbered."""

    @pytest.fixture
    def world(self, device):
        return random_world(2, 120, 2, 5, dtype=torch.float64, device=device)

    def test_permutation(self, world):
        x, s = world
        order = torch.randperm(120, generator=torch.Generator().manual_seed(3)).to(x.device)
        z = npa_envs.perceive(x, s, 0.3)
        permuted = npa_envs.perceive(x[:, order], s[:, order], 0.3)
        assert relative_error(permuted, z[:, order]) < 1e-14

    def test_translation(self, world):
        x, s = world
        moved = npa_envs.perceive(x + torch.tensor([37.2, -18.9]).to(x), s, 0.3)
        assert relative_error(moved, npa_envs.perceive(x, s, 0.3)) < 1e-12

    def test_translation_through_the_seam_of_a_box(self, world):
        x, s = world
        z = npa_envs.perceive(x, s, 0.3, box=(1.4, 2.0))
        moved = npa_envs.perceive(x + torch.tensor([0.9, 3.1]).to(x), s, 0.3, box=(1.4, 2.0))
        assert relative_error(moved, z) < 1e-12

    def test_rotation_turns_vectors_and_keeps_scalars(self, world):
        x, s = world
        turn = torch.tensor([[0.6, -0.8], [0.8, 0.6]], dtype=torch.float64).to(x)
        z = npa_envs.perceive(x, s, 0.3)
        turned = npa_envs.perceive(x @ turn.T, s, 0.3)
        assert relative_error(turned[..., :10], z[..., :10]) < 1e-13
        vectors = z[..., 10:].unflatten(-1, (-1, 2)) @ turn.T
        assert relative_error(turned[..., 10:], vectors.flatten(2)) < 1e-12

    def test_common_scale_of_lengths(self, world):
        """With c = 1 only the density gradient keeps a length; the state gradient another."""
        x, s = world
        fields = npa_envs.perception_fields(x, s, 0.3)
        scaled = npa_envs.perception_fields(8.0 * x, s, 2.4)
        assert relative_error(scaled.rho * 64.0, fields.rho) < 1e-13
        assert relative_error(scaled.blur, fields.blur) < 1e-13
        assert relative_error(scaled.moment, fields.moment) < 1e-13
        assert relative_error(scaled.grad1 * 8.0, fields.grad1) < 1e-12
        assert relative_error(scaled.drho * 512.0, fields.drho) < 1e-12


class TestDeterminism:
    """Exact equality: same sums in the same order, whatever else is in the batch."""

    @pytest.mark.parametrize("dtype", DTYPES, ids=("float32", "float64"))
    @pytest.mark.parametrize("space_dim", [2, 3])
    def test_runs_are_bit_identical(self, space_dim, dtype, device):
        x, s = random_world(3, 700, space_dim, 16, dtype=dtype, device=device)
        results = []
        for _ in range(3):
            x_, s_ = x.clone().requires_grad_(), s.clone().requires_grad_()
            z = npa_envs.perceive(x_, s_, 0.2, detach_positions=False)
            z.square().sum().backward()
            results.append((z.detach(), s_.grad, x_.grad))
        for other in results[1:]:
            assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))

    @pytest.mark.parametrize("box", [None, (1.4, 1.8)])
    def test_a_world_of_a_batch_equals_that_world_alone(self, box, device):
        x, s = random_world(5, 333, 2, 16, dtype=torch.float32, device=device)
        cotangent = torch.randn(5, 333, 66, generator=torch.Generator().manual_seed(2)).to(x)

        def run(x, s, cotangent):
            x, s = x.clone().requires_grad_(), s.clone().requires_grad_()
            z = npa_envs.perceive(x, s, 0.2, box=box, detach_positions=False)
            z.backward(cotangent)
            return z.detach(), s.grad, x.grad

        together = run(x, s, cotangent)
        for k in range(5):
            alone = run(x[k : k + 1], s[k : k + 1], cotangent[k : k + 1])
            for batched, single in zip(together, alone, strict=True):
                assert torch.equal(batched[k], single[0])


class TestGeometryLimits:
    """Any position is legal in open space; boxes may be as small as 2 eps."""

    @pytest.mark.parametrize("dtype", DTYPES, ids=("float32", "float64"))
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

    def test_coincident_particles_far_away_are_neighbours(self, device):
        x = torch.full((1, 4, 2), 3.0e8, device=device)
        s = torch.arange(4.0, device=device)[None, :, None]
        fields = npa_envs.perception_fields(x, s, 0.1)
        torch.testing.assert_close(fields.blur, torch.full_like(fields.blur, 1.5))
        assert fields.grad0.abs().max() == 0

    def test_neighbours_across_a_million_are_found(self, device):
        generator = torch.Generator().manual_seed(5)
        x = (torch.rand(1, 200, 2, generator=generator, dtype=torch.float64) * 0.6).to(device)
        s = torch.randn(1, 200, 4, generator=generator, dtype=torch.float64).to(device)
        near = npa_envs.perception_fields(x, s, 0.1)
        far = npa_envs.perception_fields(x + 2.0**20, s, 0.1)
        assert relative_error(far.rho, near.rho) < 1e-7

    @pytest.mark.parametrize("space_dim", [2, 3])
    def test_a_box_of_exactly_two_eps_counts_every_pair_once(self, space_dim, device):
        x, s = random_world(2, 64, space_dim, 4, dtype=torch.float64, device=device)
        box = (0.6,) * space_dim
        expected = oracle.perceive(x.cpu(), s.cpu(), 0.3, 0.3, box)
        assert relative_error(npa_envs.perceive(x, s, 0.3, box=box), expected) < 1e-13

    def test_positions_outside_a_box_are_wrapped(self, device):
        x, s = random_world(1, 80, 2, 4, dtype=torch.float64, device=device)
        shift = torch.tensor([1.5, -3.0]).to(x)
        z = npa_envs.perceive(x, s, 0.3, box=1.5)
        assert relative_error(npa_envs.perceive(x + shift, s, 0.3, box=1.5), z) < 1e-12

    def test_a_clump_of_all_particles_is_handled(self, device):
        s = torch.randn(1, 500, 3, generator=torch.Generator().manual_seed(0)).to(device)
        x = torch.zeros(1, 500, 2, device=device)
        fields = npa_envs.perception_fields(x, s, 0.1)
        torch.testing.assert_close(
            fields.blur, s.mean(dim=1, keepdim=True).expand_as(s), rtol=1e-4, atol=1e-6
        )


class TestTorchGlue:
    """Non-contiguous input, other streams, retained graphs, no_grad and torch.compile."""

    def test_non_contiguous_inputs_and_cotangents(self, device):
        x, s = random_world(2, 64, 2, 6, dtype=torch.float64, device=device)
        z = npa_envs.perceive(x, s, 0.3)
        x_strided = x.permute(2, 1, 0).contiguous().permute(2, 1, 0)
        s_strided = s.permute(2, 1, 0).contiguous().permute(2, 1, 0).requires_grad_()
        strided = npa_envs.perceive(x_strided, s_strided, 0.3)
        assert torch.equal(strided, z)
        strided.sum().backward()  # an expanded cotangent of stride 0
        s_ = s.clone().requires_grad_()
        npa_envs.perceive(x, s_, 0.3).backward(torch.ones_like(z))
        assert torch.equal(s_strided.grad, s_.grad)

    def test_a_retained_graph_gives_the_same_gradient_twice(self, device):
        x, s = random_world(1, 64, 2, 6, dtype=torch.float32, device=device)
        s.requires_grad_()
        loss = npa_envs.perceive(x, s, 0.3).square().sum()
        (first,) = torch.autograd.grad(loss, s, retain_graph=True)
        (second,) = torch.autograd.grad(loss, s)
        assert torch.equal(first, second)

    def test_nothing_is_recorded_without_gradients(self, device):
        x, s = random_world(1, 64, 2, 6, dtype=torch.float32, device=device)
        s.requires_grad_()
        with torch.no_grad():
            assert npa_envs.perceive(x, s, 0.3).grad_fn is None

    def test_compiled_function_equals_eager(self, device):
        x, s = random_world(1, 64, 2, 6, dtype=torch.float32, device=device)

        def loss(x, s):
            return npa_envs.perceive(x, s, 0.3).square().sum()

        compiled = torch.compile(loss, backend="aot_eager")
        s1, s2 = s.clone().requires_grad_(), s.clone().requires_grad_()
        value, expected = compiled(x, s1), loss(x, s2)
        value.backward()
        expected.backward()
        assert torch.equal(value, expected)
        assert torch.equal(s1.grad, s2.grad)

    def test_a_compiled_function_takes_worlds_of_several_sizes(self, device):
        compiled = torch.compile(
            lambda x, s: npa_envs.perceive(x, s, 0.3).square().sum(), backend="aot_eager"
        )
        for particle_count in (20, 31, 44):
            x, s = random_world(1, particle_count, 2, 6, dtype=torch.float32, device=device)
            expected = npa_envs.perceive(x, s, 0.3).square().sum()
            assert torch.equal(compiled(x, s), expected)

    def test_another_stream_gives_the_same_result(self, device):
        if device.type != "cuda":
            pytest.skip("streams are CUDA's")
        x, s = random_world(2, 2000, 2, 16, dtype=torch.float32, device=device)
        expected = npa_envs.perceive(x, s, 0.1)
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            z = npa_envs.perceive(x, s, 0.1)
        torch.cuda.current_stream().wait_stream(stream)
        assert torch.equal(z, expected)
