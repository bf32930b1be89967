"""The adjoint of perception for states: on CUDA float32 takes another way than float64."""

import pytest
import torch
from worlds import cotangents, degenerate_world, random_mask, random_world, relative_error, rows_of

import npa_envs
from npa_envs.errors import NPAError
from npa_envs.ops import passes
from npa_envs.ops.physics import Terms

# Worst error measured, in a box of two eps: 2.1e-6 on CUDA, 1.3e-6 on the CPU.
BOUND = 1e-5


def state_gradient(x, s, *, mask=None, spare_rows=0, **options):
    """Return the states' gradient of random cotangents of the active particles' rows."""
    active = x.shape[0] * x.shape[1] if mask is None else int(mask.sum())
    s = s.clone().requires_grad_()
    capacity = max(active, 1) + spare_rows
    perception, rows = rows_of(x, s, mask, eps0=0.2, capacity=capacity, **options)
    width = options.get("terms", Terms()).perception_dim(x.shape[2], s.shape[2])
    (cotangent,) = cotangents([perception.new_empty(x.shape[0] * x.shape[1], width)])
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
    mask = random_mask(x)
    mask[0] = 0
    return mask


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("state_dim", [3, 8, 16, 20, 33])
@pytest.mark.parametrize("box", [None, (1.4, 1.9, 1.5), (0.6, 0.61, 0.7)])
def test_state_gradient_equals_that_of_float64(space_dim, box, state_dim, masked, device):
    x, s = random_world(3, 83, space_dim, state_dim, dtype=torch.float32, device=device)
    mask = half_of(x) if masked else None
    sides = None if box is None else box[:space_dim]
    assert_equals_float64(x, s, eps=0.3, box=sides, mask=mask, spare_rows=5 * masked)


@pytest.mark.parametrize("neighbours", [40, 80, 140, 700])
def test_state_gradient_of_dense_worlds_equals_that_of_float64(space_dim, neighbours, device):
    """Longer neighbourhoods than lists have room for are summed in several rounds."""
    x, s = random_world(2, neighbours, space_dim, 16, dtype=torch.float32, device=device)
    assert_equals_float64(0.03 * x, s, eps=0.2)
    assert_equals_float64(0.03 * x, s, eps=0.2, mask=half_of(x))


@pytest.mark.parametrize(
    "options",
    [
        *({"width": spare} for spare in (0, 1, 2, 6)),
        {"terms": Terms(state_gradient=False)},
        {"terms": Terms(moment_inverse=None, density_gradient=False)},
    ],
    ids=str,
)
def test_state_gradient_of_wider_rows_and_fewer_groups_equals_that_of_float64(
    options, space_dim, device
):
    x, s = random_world(2, 50, space_dim, 16, dtype=torch.float32, device=device)
    if "width" in options:
        width = Terms().perception_dim(space_dim, 16) + options["width"]
        options = {"width": width, "mask": half_of(x), "spare_rows": 3}
    assert_equals_float64(x, s, eps=0.3, **options)


@pytest.mark.parametrize("hard", ["degenerate", "at one point", "sparse"])
def test_state_gradient_of_hard_worlds_equals_that_of_float64(space_dim, hard, device):
    x, s = degenerate_world(space_dim, 16, dtype=torch.float32, device=device)
    if hard == "at one point":
        x, s = random_world(1, 200, space_dim, 16, dtype=torch.float32, device=device)
        x[:] = 0.3
    elif hard == "sparse":
        # Particles that follow each other in the sorted order lie far apart, on other lines.
        x, s = random_world(2, 1000, space_dim, 16, dtype=torch.float32, device=device)
        x *= torch.tensor([8.0, 1.0, 3.0][:space_dim], device=device)
    assert_equals_float64(x, s, eps=0.1 if hard == "sparse" else 0.15)


def test_without_active_particles_the_state_gradient_is_zero(device):
    x, s = random_world(2, 50, 2, 16, dtype=torch.float32, device=device)
    mask = torch.zeros(2, 50, dtype=torch.uint8, device=device)
    assert not state_gradient(x, s, eps=0.3, mask=mask, spare_rows=7).any()


def test_a_position_that_is_not_a_number_leaves_other_worlds_alone(device):
    x, s = random_world(2, 83, 2, 16, dtype=torch.float32, device=device)
    clean = state_gradient(x, s, eps=0.2)
    x[0, 3] = float("nan")
    x[0, 4] = float("inf")
    assert torch.equal(state_gradient(x, s, eps=0.2)[1], clean[1])


def test_gradients_that_kernels_could_not_index_are_refused(monkeypatch):
    x, s = random_world(1, 20, 3, 5, dtype=torch.float64, device="cpu")
    z = npa_envs.perceive(x, s.requires_grad_(), 0.3)
    monkeypatch.setattr(passes, "MAX_INDEX", 20 * 8 * 3)
    with pytest.raises(NPAError, match=r"gradients must stay below 480 .* split the batch"):
        z.sum().backward()
