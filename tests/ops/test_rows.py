"""Rows of active particles and their states' gradients in float32, by other kernels on CUDA."""

import pytest
import torch
from support.worlds import (
    assert_same,
    cotangents,
    random_mask,
    random_world,
    relative_error,
    rows_of,
)

import npa_envs
from npa_envs.errors import NPAError
from npa_envs.ops import backend, launch, perception_passes
from npa_envs.ops.physics import Terms

# The worst errors measured were 1.2e-6 (CUDA), and in a box of two eps 2.1e-6 (CUDA).
BOUNDS = (5e-6, 1e-5)

all_or_half = pytest.mark.parametrize("masked", [False, True], ids=("all", "half"))


def rows_and_gradient(x, s, *, mask=None, spare_rows=0, spare_columns=0, **options):
    """Return the active particles' rows, and the states' gradient of random cotangents of them."""
    total = x.shape[0] * x.shape[1]
    active = total if mask is None else int(mask.sum())
    s = s.clone().requires_grad_()
    width = options.get("terms", Terms()).perception_dim(x.shape[2], s.shape[2])
    size = {"capacity": max(active, 1) + spare_rows, "width": width + spare_columns}
    perception, rows = rows_of(x, s, mask, eps0=0.2, **size, **options)
    source = rows.row_particle[:active].long()
    (cotangent,) = cotangents([perception.new_empty(total, width)])
    bar = torch.full_like(perception, float("nan"))
    bar[:active, :width] = cotangent[source]
    perception.backward(bar)
    by_particle = perception.new_zeros(total, width)
    by_particle[source] = perception.detach()[:active, :width]
    return by_particle, s.grad


def assert_equals_float64(x, s, masked=False, **options):
    """Compare rows with those of float64; half of the particles may be active, none of world 0."""
    if masked:
        mask = random_mask(x)
        mask[0] = 0
        options |= {"mask": mask, "spare_rows": 5}
    results = rows_and_gradient(x, s, **options)
    expected = rows_and_gradient(x.double(), s.double(), **options)
    for value, answer, bound in zip(results, expected, BOUNDS, strict=True):
        assert relative_error(value, answer) < bound
    assert_same(rows_and_gradient(x, s, **options), results)


@pytest.fixture(params=[0, 4096], ids=("one thread", "several threads"))
def shared(request, monkeypatch):
    """Set the maximum number of particles of worlds in which several threads share a particle."""
    monkeypatch.setattr(backend, "SHARED_WORLD", request.param)
    backend.choose.cache_clear()
    # Repeated launches would be those of the other choice.
    launch._thread.calls.clear()
    yield request.param
    backend.choose.cache_clear()


@all_or_half
@pytest.mark.parametrize("state_dim", [3, 8, 16, 20, 33])
@pytest.mark.parametrize("box", [None, (1.4, 1.9, 1.5), (0.6, 0.61, 0.7)])
def test_rows_equal_those_of_float64(space_dim, box, state_dim, masked, shared, device):
    x, s = random_world(3, 83, space_dim, state_dim, dtype=torch.float32, device=device)
    box = None if box is None else box[:space_dim]
    assert_equals_float64(x, s, masked, eps=0.3, box=box)


@all_or_half
@pytest.mark.parametrize("count", [40, 80, 140, 300, 900])
def test_rows_of_crowded_worlds_are_right(space_dim, count, masked, shared, device):
    """All particles are neighbours: on CUDA lists overflow, or only a thread's part of a list."""
    x, s = random_world(2, count, space_dim, 16, dtype=torch.float32, device=device)
    assert_equals_float64(0.03 * x, s, masked, eps=0.2)


def squeezed(x, box):
    """Return worlds in a box, in which some particles have more than 256 neighbours."""
    x = x / 1.4
    x[:, :200] *= 0.2
    return x


BOXES = [(1.22, 1.8), (1.42, 1.58), (1.62, 6.0), (8.0, 1.42)]
PLACED = {
    "a crowded box": (900, (1.0, 1.0), squeezed),
    # In cells of eps / 2; boxes of 7 cells have tiles.
    **{f"a box of {box}": (203, box, lambda x, box: x / 2.8 * x.new_tensor(box)) for box in BOXES},
    # On CUDA eight neighbours in the order of cells are one tile, however far apart they lie.
    "a line": (203, None, lambda x, _: x * x.new_tensor((20.0, 1e-3))),
    "another line": (203, None, lambda x, _: x * x.new_tensor((1e-3, 20.0))),
    "a wide world": (203, None, lambda x, _: x * 30.0),
    # Too large to be sorted by a block on CUDA, or by a thread of a CPU.
    "a large world": (5000, None, lambda x, _: x * 4.0),
    "many lines": (1000, None, lambda x, _: x * x.new_tensor((16.0, 2.0))),
    "a point": (200, None, lambda x, _: torch.full_like(x, 0.3)),
}


@all_or_half
@pytest.mark.parametrize("name", PLACED)
def test_rows_of_placed_particles_are_right(name, masked, device):
    count, box, place = PLACED[name]
    x, s = random_world(2, count, 2, 16, dtype=torch.float32, device=device)
    assert_equals_float64(place(x, box), s, masked, eps=0.2, box=box)


@pytest.mark.parametrize(
    "options",
    [
        *({"spare_columns": count, "masked": True} for count in (1, 2, 6)),
        {"terms": Terms(state_gradient=False)},
        {"terms": Terms(moment_inverse=None, density_gradient=False)},
    ],
    ids=str,
)
def test_rows_of_other_widths_and_fewer_groups_are_right(options, space_dim, device):
    x, s = random_world(2, 50, space_dim, 16, dtype=torch.float32, device=device)
    assert_equals_float64(x, s, eps=0.3, **options)


def test_without_active_particles_the_state_gradient_is_zero(device):
    x, s = random_world(2, 50, 2, 16, dtype=torch.float32, device=device)
    mask = torch.zeros(2, 50, dtype=torch.uint8, device=device)
    assert not rows_and_gradient(x, s, eps=0.3, mask=mask, spare_rows=7)[1].any()


def test_a_position_that_is_not_a_number_leaves_other_worlds_alone(device):
    x, s = random_world(2, 83, 2, 16, dtype=torch.float32, device=device)
    clean = rows_and_gradient(x, s, eps=0.2)
    x[0, 3] = float("nan")
    x[0, 4] = float("inf")
    for value, answer in zip(rows_and_gradient(x, s, eps=0.2), clean, strict=True):
        assert torch.equal(value.view(2, 83, -1)[1], answer.view(2, 83, -1)[1])


def test_gradients_that_kernels_could_not_index_are_rejected(monkeypatch):
    x, s = random_world(1, 20, 3, 5, dtype=torch.float64, device="cpu")
    z = npa_envs.perceive(x, s.requires_grad_(), 0.3)
    monkeypatch.setattr(perception_passes, "MAX_INDEX", 20 * 8 * 3)
    with pytest.raises(NPAError, match=r"gradients must stay below 480 .* split the batch"):
        z.sum().backward()
