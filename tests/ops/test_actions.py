"""Applying actions: the formula, masks, noise, boxes, limits, errors."""

import math

import pytest
import torch
from support.worlds import assert_same, random_mask

from npa_envs.errors import NPAError
from npa_envs.ops import apply_actions
from npa_envs.ops.physics import Limits, make_physics
from npa_envs.ops.update import ActedWorlds, PreparedActions

B, N, C = 3, 77, 5
MAX_STEP, DT, STATE_SCALE = 0.07, 0.8, 0.6
ERRORS = {torch.float32: 1e-6, torch.float64: 3e-15}
"""Bound of differences from the formula, for values of size 3 (worst seen 2.2e-7 and 2.2e-16)."""


@pytest.fixture
def world(space_dim, dtype, device):
    """Return random actions, about half with displacements longer than 1; positions; states."""
    g = torch.Generator().manual_seed(1)
    action = torch.randn(B, N, space_dim + C, generator=g, dtype=torch.float64)
    x = 2.0 * torch.rand(B, N, space_dim, generator=g, dtype=torch.float64) - 1.0
    s = torch.randn(B, N, C, generator=g, dtype=torch.float64)
    return tuple(tensor.to(device, dtype) for tensor in (action, x, s))


def physics_of(
    x, *, moving=True, box=None, state_scale=STATE_SCALE, position_limit=50.0, state_limit=20.0
):
    limits = Limits(state_scale, position=position_limit, state=state_limit)
    physics = make_physics(x.shape[2], C, x.dtype, eps=0.1, box=box, moving=moving, dt=DT)
    return physics._replace(max_displacement=MAX_STEP, limits=limits)


def applied(action, x, s, mask=None, noise=None, enabled=None, diverged=None, **rules):
    """Return positions and states after actions on copies of x and s, and which worlds diverged."""
    x, s = x.clone(), s.clone()
    if diverged is None:
        diverged = torch.zeros(len(x), dtype=torch.uint8, device=x.device)
    tensors = {"mask": mask, "noise": noise, "enabled": enabled, "diverged": diverged}
    apply_actions(action, x, s, physics_of(x, **rules), **tensors)
    return x, s, diverged


def formula(action, x, s, mask=None, noise=None, moving=True, box=None):
    """Return the positions and states after actions, by the formula in float64, without limits."""
    action = action.double() if mask is None else action.double() * mask[..., None]
    x, s = x if noise is None else x + noise, s.double()
    x = x.double()
    if moving:
        direction, action = action[..., : x.shape[2]], action[..., x.shape[2] :]
        x = x + MAX_STEP * DT * direction / direction.norm(dim=-1, keepdim=True).clamp_min(1.0)
    if box is not None:
        sides = torch.tensor(box, dtype=x.dtype, device=x.device)
        x = x - sides * torch.floor(x / sides + 0.5)
    return x, s + DT * STATE_SCALE * action.clamp(-1.0, 1.0)


def assert_near(values, expected, dtype):
    for value, right in zip(values, expected, strict=True):
        assert value.dtype == dtype
        assert float((value.double() - right).abs().max()) <= ERRORS[dtype]


@pytest.mark.parametrize("moving", [True, False], ids=["moving", "static"])
@pytest.mark.parametrize("noisy", [False, True], ids=["quiet", "noisy"])
@pytest.mark.parametrize("masked", [False, True], ids=["all", "masked"])
def test_particles_follow_the_formula(masked, noisy, moving, world, dtype):
    """Outside of the mask only noise moves them, whatever their actions are."""
    action, x, s = world
    if not moving:
        action = action[..., :C].contiguous()
    mask = random_mask(x, 0.5 if masked else 1.0)
    noise = 0.01 * torch.randn_like(x) if noisy else None
    idle = mask == 0
    actions = torch.where(idle[..., None], torch.nan, action)
    options = {"noise": noise, "moving": moving}
    *moved, diverged = applied(actions, x, s, mask=mask if masked else None, **options)
    assert_near(moved, formula(action, x, s, mask, **options), dtype)
    assert diverged.tolist() == [0] * B
    resting = x if noise is None else x + noise
    assert_same([value[idle] for value in moved], [resting[idle], s[idle]])
    if not moving:
        assert torch.equal(moved[0], resting)
    elif not noisy:
        step = (moved[0] - x).norm(dim=-1)
        assert float(step.max()) == pytest.approx(MAX_STEP * DT, rel=1e-5)


def test_positions_are_wrapped_into_the_box(world, dtype, device):
    action, x, s = world
    box = (1.0, 1.5, 0.7)[: x.shape[2]]
    *moved, _ = applied(action, x, s, box=box)
    sides = torch.tensor(box, dtype=torch.float64, device=device)
    assert bool((moved[0].double().abs() <= sides / 2 + 1e-6).all())
    turn = (moved[0].double() - formula(action, x, s)[0]) / sides
    assert float((turn - turn.round()).abs().max()) <= 4.0 * ERRORS[dtype]
    assert float(turn.round().abs().max()) >= 1.0
    assert_near(moved[1:], formula(action, x, s)[1:], dtype)


def test_values_beyond_their_limits_are_held_and_mark_their_world_alone(world, device):
    action, x, s = world
    x[1, 3, 0], x[1, 4, 0], s[1, 5, 1] = 0.999, -0.999, -0.99
    action[1, 3:6] = 0.0
    action[1, 3, 0], action[1, 4, 0], action[1, 5, x.shape[2] + 1] = 2.0, -2.0, -1.0
    s.clamp_(-0.5, 0.5)
    s[1, 5, 1] = -0.99
    action[..., x.shape[2] :] *= 0.01
    action[1, 5, x.shape[2] + 1] = -1.0
    limits = {"position_limit": 1.02, "state_limit": 1.0}
    for world_index in (0, 2):
        x[world_index] *= 0.5
    moved, changed, diverged = applied(action, x, s, **limits)
    assert diverged.tolist() == [0, 1, 0]
    assert moved[1, 3, 0] == torch.tensor(1.02, dtype=x.dtype)
    assert moved[1, 4, 0] == torch.tensor(-1.02, dtype=x.dtype)
    assert changed[1, 5, 1] == -1.0
    free, free_states, _ = applied(action, x, s)
    assert torch.equal(moved, free.clamp(-1.02, 1.02))
    assert torch.equal(changed, free_states.clamp(-1.0, 1.0))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_actions_and_noise_that_are_no_numbers_do_not_reach_the_worlds(world, bad):
    action, x, s = world
    expected = applied(action, x, s)
    action[2, 9, 0] = action[0, 4, -1] = bad
    moved, changed, diverged = applied(action, x, s)
    # An infinite direction has no unit vector, inf / inf is not a number; an infinite change of a
    # state is clipped to the largest one.
    finite = not math.isnan(bad)
    assert diverged.tolist() == [int(not finite), 0, 1]
    assert moved[2, 9, 0] == 0.0
    assert finite or not moved[2, 9].any()
    right = float(s[0, 4, -1]) + math.copysign(DT * STATE_SCALE, bad) if finite else 0.0
    assert float(changed[0, 4, -1]) == pytest.approx(right, rel=1e-6)
    moved[2, 9], changed[0, 4, -1] = expected[0][2, 9], expected[1][0, 4, -1]
    assert_same((moved, changed), expected[:2])
    noise = torch.zeros_like(x)
    noise[1, 0, 1] = math.nan
    moved, _, diverged = applied(*world, noise=noise)
    assert moved[1, 0, 1] == 0.0
    assert diverged.tolist() == [int(not finite), 1, 1]


def test_nothing_happens_where_it_is_switched_off_and_marks_are_kept(world, device):
    action, x, s = world
    off, on = (torch.full((1,), k, dtype=torch.uint8, device=device) for k in (0, 1))
    marks = torch.tensor([1, 0, 0], dtype=torch.uint8, device=device)
    wild, options = torch.full_like(action, math.nan), {"noise": torch.ones_like(x)}
    held = applied(wild, x, s, enabled=off, diverged=marks.clone(), position_limit=0.1, **options)
    assert_same(held, [x, s, marks])
    *moved, _ = applied(*world)
    assert_same(applied(*world, enabled=on, diverged=marks.clone()), [*moved, marks])


def prepared(x, s):
    """Return `PreparedActions` on copies of a world, the copies, and its `enabled` tensor."""
    enabled = torch.ones(1, dtype=torch.uint8, device=x.device)
    diverged = torch.zeros(x.shape[0], dtype=torch.uint8, device=x.device)
    worlds = ActedWorlds(x.clone(), s.clone(), None, None, enabled, diverged)
    return PreparedActions(worlds, physics_of(x)), worlds[:2], enabled


LAYOUTS = {
    "plain": lambda a: a,
    "strided": lambda a: a.mT.contiguous().mT,
    "misaligned": lambda a: torch.cat((a.new_zeros(1), a.flatten()))[1:].view(a.shape),
    "other dtype": lambda a: a.to(torch.float64 if a.dtype == torch.float32 else a.dtype),
    "on the host": lambda a: a.cpu(),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_prepared_actions_are_the_same_wherever_they_lie(layout, world):
    action, x, s = world
    act, moved, enabled = prepared(x, s)
    expected = world[1:]
    for sign in (1.0, -1.0, 0.5):
        act(LAYOUTS[layout](sign * action))
        expected = applied(sign * action, *expected)[:2]
    assert_same(moved, expected)
    assert enabled.item() == 1


def test_one_number_that_is_not_finite_is_found_wherever_it_lies(world):
    action, x, s = (tensor[:1, :7] for tensor in world)
    act, moved, enabled = prepared(x, s)
    for place in range(action.numel()):
        for wild in (math.nan, math.inf, -math.inf):
            bad = action.contiguous().clone()
            bad.view(-1)[place] = wild
            act(bad)
            # Nothing but the caller switches them on again.
            for _ in range(2):
                assert enabled.item() == 0
                assert_same(moved, (x, s))
                act(action)
            enabled.fill_(1)
    act(torch.full_like(action, torch.finfo(action.dtype).max))
    assert enabled.item() == 1


def test_prepared_actions_of_another_shape_are_clear_errors(world):
    action, x, s = world
    with pytest.raises(NPAError, match="action must have shape"):
        prepared(x, s)[0](action[:, :-1])
