"""Sorting into cells: small worlds, which on CUDA a block sorts by itself, as all others."""

import pytest
import torch
from worlds import assert_same, random_mask, random_world

from npa_envs.ops import sort as cells
from npa_envs.ops.physics import physics
from npa_envs.ops.sort import plan_kernels, sort_worlds

MASKS = {"all": None, "some": 0.5, "none": 0.0, "full": 1.0}


@pytest.fixture
def sorted_twice(monkeypatch):
    """Sorts worlds as they come, and as if no block had room for them."""

    def sort(x, s, mask, row_capacity, box=None, *, with_states=True, with_rows=True):
        made = physics(x.shape[2], s.shape[2], x.dtype, eps=0.1, box=box)
        plan = plan_kernels(x, x.shape, s.shape[2], row_capacity, mask is not None, made)
        given = (plan, x, s if with_states else None, mask)
        found = sort_worlds(*given, with_rows=with_rows)
        monkeypatch.setattr(cells, "block_capacity", lambda *worlds: 0)
        return found, sort_worlds(*given, with_rows=with_rows)

    return sort


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
    world_count, particle_count, space_dim, box, state_dim, masked, device, sorted_twice
):
    """On CUDA a block sorts a small world by itself; elsewhere the two are the same kernels."""
    sizes = (world_count, particle_count, space_dim, state_dim)
    x, s = random_world(*sizes, dtype=torch.float32, device=device)
    x[0, : particle_count // 4] = 0.25
    x[-1, 0] = 1e6
    mask = None if MASKS[masked] is None else random_mask(x, MASKS[masked])
    total = world_count * particle_count
    active = total if mask is None else int(mask.sum())
    found, expected = sorted_twice(x, s, mask, max(active, 1), box)
    names = ("row_source", "row_place", "row_positions")
    for name, value in found._asdict().items():
        count = active if name in names else None
        assert torch.equal(value[:count], getattr(expected, name)[:count]), name


@pytest.mark.parametrize("particle_count", [300, 1500])
@pytest.mark.parametrize("options", [{"with_states": False}, {"with_rows": False}], ids=str)
def test_small_worlds_are_sorted_without_states_or_rows(
    options, particle_count, device, sorted_twice
):
    x, s = random_world(3, particle_count, 2, 16, dtype=torch.float32, device=device)
    # What no row is left for is left out.
    for mask, capacity in ((None, 3 * particle_count), (random_mask(x, 1.0), 2 * particle_count)):
        if mask is None or "with_rows" in options:
            assert_same(*sorted_twice(x, s, mask, capacity, **options))


def test_particles_in_one_cell_are_sorted_by_index(device, sorted_twice):
    x, s = random_world(2, 1100, 2, 16, dtype=torch.float32, device=device)
    x[:] = 0.3
    found, expected = sorted_twice(x, s, None, 2200)
    assert torch.equal(found.source.cpu(), torch.arange(2200, dtype=torch.int32))
    assert_same(found, expected)
