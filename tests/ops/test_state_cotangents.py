"""The adjoint of perception for states: on CUDA float32 takes another way than float64."""

import pytest
import torch
from worlds import degenerate_world, random_world, relative_error

from npa_envs.ops.perceive import Terms, perceive_rows

# Worst error measured, in a box of two eps: 2.1e-6 on CUDA, 1.3e-6 on the CPU.
BOUND = 5e-6


def state_gradient(x, s, *, eps, box=None, mask=None, terms=None, row_width=None, spare_rows=0):
    """Return the states' gradient of random cotangents of the active particles' rows."""
    terms = terms or Terms()
    width = terms.perception_dim(x.shape[2], s.shape[2])
    total = x.shape[0] * x.shape[1]
    active = total if mask is None else int(mask.sum())
    s = s.clone().requires_grad_()
    perception, rows = perceive_rows(
        x,
        s,
        mask=mask,
        row_capacity=max(active, 1) + spare_rows,
        row_width=row_width or width,
        eps=eps,
        eps0=0.2,
        box=box,
        terms=terms,
    )
    generator = torch.Generator().manual_seed(1)
    cotangent = torch.randn(total, width, generator=generator, dtype=torch.float64).to(perception)
    bar = torch.full_like(perception, float("nan"))
    bar[:active, :width] = cotangent[rows.row_source[:active].long()]
    perception.backward(bar)
    return s.grad


def assert_equals_float64(x, s, **options):
    got = state_gradient(x, s, **options)
    assert relative_error(got, state_gradient(x.double(), s.double(), **options)) < BOUND
    assert torch.equal(got, state_gradient(x, s, **options))


def half_of(x):
    """An update mask of about half of the particles, none of the first world's."""
    mask = torch.rand(x.shape[:2], generator=torch.Generator().manual_seed(4)) < 0.5
    mask[0] = False
    return mask.to(x.device, torch.uint8)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("state_dim", [3, 8, 16, 20, 33])
@pytest.mark.parametrize("box", [None, (1.4, 1.9, 1.5), (0.6, 0.61, 0.7)])
@pytest.mark.parametrize("space_dim", [2, 3])
def test_state_gradient_equals_that_of_float64(space_dim, box, state_dim, masked, device):
    x, s = random_world(3, 83, space_dim, state_dim, dtype=torch.float32, device=device)
    mask = half_of(x) if masked else None
    sides = None if box is None else box[:space_dim]
    assert_equals_float64(x, s, eps=0.3, box=sides, mask=mask, spare_rows=5 * masked)


@pytest.mark.parametrize("row_width", [66, 67, 68, 72])
def test_rows_of_perception_may_be_wider(row_width, device):
    x, s = random_world(2, 50, 2, 16, dtype=torch.float32, device=device)
    assert_equals_float64(x, s, eps=0.3, row_width=row_width, mask=half_of(x), spare_rows=3)


@pytest.mark.parametrize("space_dim", [2, 3])
@pytest.mark.parametrize(
    "terms", [Terms(state_gradient=False), Terms(moment_inverse=None, density_gradient=False)]
)
def test_state_gradient_of_fewer_groups_equals_that_of_float64(terms, space_dim, device):
    x, s = random_world(2, 50, space_dim, 16, dtype=torch.float32, device=device)
    assert_equals_float64(x, s, eps=0.3, terms=terms)


@pytest.mark.parametrize("neighbours", [40, 80, 140, 700])
@pytest.mark.parametrize("space_dim", [2, 3])
def test_state_gradient_of_dense_worlds_equals_that_of_float64(space_dim, neighbours, device):
    """Longer neighbourhoods than lists have room for are summed in several rounds."""
    x, s = random_world(2, neighbours, space_dim, 16, dtype=torch.float32, device=device)
    assert_equals_float64(0.03 * x, s, eps=0.2)
    assert_equals_float64(0.03 * x, s, eps=0.2, mask=half_of(x))


@pytest.mark.parametrize("space_dim", [2, 3])
def test_state_gradient_of_sparse_worlds_equals_that_of_float64(space_dim, device):
    """Particles that follow each other in the sorted order lie far apart, on other lines."""
    x, s = random_world(2, 1000, space_dim, 16, dtype=torch.float32, device=device)
    x *= torch.tensor([8.0, 1.0, 3.0][:space_dim], device=device)
    assert_equals_float64(x, s, eps=0.1)


@pytest.mark.parametrize("space_dim", [2, 3])
def test_state_gradient_of_degenerate_worlds_equals_that_of_float64(space_dim, device):
    x, s = degenerate_world(space_dim, 16, dtype=torch.float32, device=device)
    assert_equals_float64(x, s, eps=0.15)


@pytest.mark.parametrize("space_dim", [2, 3])
def test_particles_at_one_point_have_a_state_gradient(space_dim, device):
    x = torch.full((1, 200, space_dim), 0.3, device=device)
    s = torch.randn(1, 200, 16, generator=torch.Generator().manual_seed(2)).to(device)
    assert_equals_float64(x, s, eps=0.1)


def test_without_active_particles_the_state_gradient_is_zero(device):
    x, s = random_world(2, 50, 2, 16, dtype=torch.float32, device=device)
    mask = torch.zeros(2, 50, dtype=torch.uint8, device=device)
    assert not state_gradient(x, s, eps=0.3, mask=mask, spare_rows=7).any()


def test_state_gradient_of_a_world_does_not_depend_on_its_batch(device):
    """83 particles: the worlds' rows begin anywhere."""
    x, s = random_world(3, 83, 2, 16, dtype=torch.float32, device=device)
    weights = torch.randn(3, 83, 66, generator=torch.Generator().manual_seed(3)).to(device)

    def run(chosen):
        states = s[chosen].clone().requires_grad_()
        count = states.shape[0]
        perception, rows = perceive_rows(
            x[chosen],
            states,
            mask=None,
            row_capacity=count * 83,
            row_width=66,
            eps=0.2,
            eps0=0.2,
            box=None,
            terms=Terms(),
        )
        perception.backward(weights[chosen].view(-1, 66)[rows.row_source.long()])
        return states.grad

    together = run(slice(0, 3))
    for k in range(3):
        assert torch.equal(together[k], run(slice(k, k + 1))[0])


def test_a_position_that_is_not_a_number_leaves_other_worlds_alone(device):
    x, s = random_world(2, 83, 2, 16, dtype=torch.float32, device=device)
    clean = state_gradient(x, s, eps=0.2)
    x[0, 3] = float("nan")
    x[0, 4] = float("inf")
    assert torch.equal(state_gradient(x, s, eps=0.2)[1], clean[1])
