"""Rollouts of static rules: what follows from positions is computed once, nothing else changes."""

import pytest
import torch
from worlds import degenerate_world, random_world, relative_error

import npa_envs
from npa_envs import reference as oracle
from npa_envs.ops import launch as bridge
from npa_envs.ops import static as settled
from npa_envs.ops import static as settled_perception
from npa_envs.ops import static as settled_states_module
from npa_envs.ops import static as settled_steps
from npa_envs.ops import warmup
from npa_envs.ops.backend import Terms
from npa_envs.ops.static import (
    all_rows,
    perceive_settled,
    settled_rows,
    settled_states,
    unsettled_states,
)
from npa_envs.world import rollout as dynamics
from npa_envs.world.rollout import FEWEST_SETTLED

STEPS = 5


def static_rule(device, dtype, space_dim=2, state_dim=5, **options):
    """A static rule whose updates are large enough to matter."""
    torch.manual_seed(0)
    rule = npa_envs.NPARule(space_dim, state_dim, 12, eps0=0.2, static=True, **options)
    rule = rule.to(device, dtype)
    with torch.no_grad():
        rule.output.weight *= 4.0
    return rule


def outcome(rule, x, s, *, rebuilt=False, steps=STEPS, **options):
    """What a rollout returns, then the gradients of a random functional by states and weights.

    Rebuilt: cells, densities and weights of pairs are computed in every step.
    """
    s = s.clone().requires_grad_()
    generator = torch.Generator(x.device).manual_seed(3)
    given = {"eps": 0.3, "generator": generator, "detach_positions": not rebuilt}
    new_x, new_s, path = npa_envs.rollout(
        rule, x, s, steps, return_path_length=True, **given, **options
    )
    draws = torch.Generator().manual_seed(4)
    weights = torch.randn(new_s.shape, generator=draws, dtype=torch.float64).to(new_s)
    gradients = torch.autograd.grad((weights * new_s).sum(), [s, *rule.parameters()])
    return [new_x, new_s, path, *gradients]


def settled_calls(monkeypatch):
    """Return a list that grows by one with every rollout that computes pairs once."""
    calls = []
    settle = dynamics.settle

    def counted(*args, **options):
        calls.append(settle(*args, **options))
        return calls[-1]

    monkeypatch.setattr(dynamics, "settle", counted)
    return calls


def assert_alike(values, expected, bound):
    for value, answer in zip(values, expected, strict=True):
        assert value.shape == answer.shape
        if answer.norm() == 0.0:
            assert value.norm() == 0.0
        else:
            assert relative_error(value, answer) < bound


# Worst seen, over all cases: float64 2e-16, float32 3e-7 on the CPU; CUDA sums in another order.
BOUNDS = [(torch.float64, 1e-12), (torch.float32, 1e-5)]


@pytest.mark.parametrize(("dtype", "bound"), BOUNDS, ids=("float64", "float32"))
@pytest.mark.parametrize("update_prob", [0.5, 1.0])
@pytest.mark.parametrize("box", [False, True], ids=("open", "box"))
@pytest.mark.parametrize(
    ("world_count", "space_dim", "state_dim"), [(3, 2, 5), (1, 2, 16), (1, 3, 20), (3, 3, 8)]
)
def test_it_equals_rebuilding(
    world_count, space_dim, state_dim, box, update_prob, dtype, bound, device, monkeypatch
):
    calls = settled_calls(monkeypatch)
    rule = static_rule(device, dtype, space_dim, state_dim)
    x, s = random_world(world_count, 97, space_dim, state_dim, dtype=dtype, device=device)
    options = {"update_prob": update_prob, "dt": 0.7}
    if box:
        options["box"] = (1.4, 1.2, 1.3)[:space_dim]
    values = outcome(rule, x, s, **options)
    assert len(calls) == 1
    expected = outcome(rule, x, s, rebuilt=True, **options)
    assert len(calls) == 1
    assert_alike(values, expected, bound)


@pytest.mark.parametrize(
    "terms",
    [{"state_gradient": False}, {"moment_correction": False}, {"density_gradient": False}],
    ids=str,
)
def test_terms_that_are_left_out_are_left_out(terms, device):
    rule = static_rule(device, torch.float64, state_dim=4, **terms)
    x, s = random_world(2, 60, 2, 4, dtype=torch.float64, device=device)
    assert_alike(outcome(rule, x, s), outcome(rule, x, s, rebuilt=True), 1e-12)


@pytest.mark.parametrize("space_dim", [2, 3])
def test_hard_worlds_equal_rebuilding(space_dim, device):
    rule = static_rule(device, torch.float64, space_dim, 6)
    x, s = degenerate_world(space_dim, 6, dtype=torch.float64, device=device)
    assert_alike(outcome(rule, x, s), outcome(rule, x, s, rebuilt=True), 1e-11)


@pytest.mark.parametrize("capacity", [8, 16, 64])
@pytest.mark.parametrize("update_prob", [0.5, 1.0])
@pytest.mark.parametrize("space_dim", [2, 3])
def test_lists_without_room_are_searched_again(
    space_dim, update_prob, capacity, device, monkeypatch
):
    """On CUDA each list has as much room; here with less of it, on a CPU too."""
    calls = settled_calls(monkeypatch)
    rule = static_rule(device, torch.float64, space_dim)
    x, s = degenerate_world(space_dim, 5, dtype=torch.float64, device=device)
    expected = outcome(rule, x, s, rebuilt=True, update_prob=update_prob)
    for module in (settled, settled_perception):
        monkeypatch.setattr(module, "entries_ahead", lambda plan: 4)
    monkeypatch.setattr(settled, "list_capacity", lambda x: capacity)
    assert_alike(outcome(rule, x, s, update_prob=update_prob), expected, 1e-11)
    lengths = calls[0].tensors.lengths
    assert bool((lengths == -1).any()) == (capacity < 64)
    assert (lengths % 4 == 0).any()
    assert ((lengths % 4 == 0) | (lengths == -1)).all()


def test_perception_equals_the_oracle(device):
    x, s = random_world(2, 80, 2, 7, dtype=torch.float64, device=device)
    for box in (None, (1.4, 1.8)):
        worlds = settled.settle(x, 7, eps=0.3, eps0=0.2, box=box, terms=Terms())
        states = settled_states(worlds, s)
        z = perceive_settled(worlds, states, all_rows(worlds), row_width=30)
        expected = oracle.perceive(x.cpu(), s.cpu(), 0.3, 0.2, box).view(160, 30)
        source = worlds.tensors.source.cpu()
        # Worst seen 6e-16.
        assert relative_error(z.cpu(), expected[source]) < 1e-14
        assert torch.equal(unsettled_states(worlds, states), s)


def test_rows_follow_the_masks(device):
    x, s = random_world(2, 50, 2, 4, dtype=torch.float32, device=device)
    worlds = settled.settle(x, 4, eps=0.3, eps0=0.3, box=None, terms=Terms())
    states = settled_states(worlds, s)
    everything = perceive_settled(worlds, states, all_rows(worlds), row_width=20)
    numbers = torch.arange(100, device=device).view(2, 50)
    masks = [(numbers % count == 1).to(torch.uint8) for count in (3, 200, 7)]
    masks.append(torch.zeros_like(masks[0]))
    for mask, rows in zip(masks, settled_rows(worlds, masks, 40), strict=True):
        active = mask.view(-1)[worlds.tensors.source.long()].nonzero().view(-1)
        count = len(active)
        assert rows.row_capacity == (40 if device.type == "cuda" else max(count, 1))
        assert torch.equal(rows.row_place[:count].long(), active)
        expected = torch.full((100,), -1, device=device)
        expected[active] = torch.arange(count, device=device)
        assert torch.equal(rows.row_of.long(), expected)
        z = perceive_settled(worlds, states, rows, row_width=20)
        assert torch.equal(z[:count], everything[active])
        assert (z[count:] == 0.0).all()


def test_active_particles_beyond_the_rows_have_none(device):
    source = torch.arange(50, dtype=torch.int32, device=device).flip(0)
    masks = torch.ones(3, 1, 50, dtype=torch.uint8, device=device)
    masks[1, 0, :25] = 0
    row_of, row_place, before = settled_states_module._settled_rows(masks, source, 30)
    for step, count in enumerate((50, 25, 50)):
        active = min(count, 30)
        assert torch.equal(row_place[step, :active].long(), torch.arange(active, device=device))
        assert (row_of[step, :active] == row_place[step, :active]).all()
        assert (row_of[step, active:] == -1).all()
        assert int(before[step, -1]) == count


@pytest.mark.parametrize("ahead", [1, 2, 100])
def test_how_far_ahead_masks_are_drawn_changes_no_bit(ahead, device, monkeypatch):
    rule = static_rule(device, torch.float32)
    x, s = random_world(3, 40, 2, 5, dtype=torch.float32, device=device)
    for source in (lambda: torch.Generator(device).manual_seed(1), lambda: own_streams(device)):
        monkeypatch.setattr(settled_steps, "DRAWN_AHEAD", 3)
        expected = npa_envs.rollout(rule, x, s, STEPS, generator=source())[1]
        monkeypatch.setattr(settled_steps, "DRAWN_AHEAD", ahead)
        assert torch.equal(npa_envs.rollout(rule, x, s, STEPS, generator=source())[1], expected)


def own_streams(device):
    """Random streams of three worlds."""
    return npa_envs.WorldRandom([1, 2, 3], device=device)


@pytest.mark.parametrize("space_dim", [2, 3])
def test_gradients_equal_finite_differences(space_dim, device):
    rule = static_rule(device, torch.float64, space_dim, 3, moment_correction=False)
    x, s = random_world(2, 12, space_dim, 3, dtype=torch.float64, device=device)

    def after(states, weight, bias):
        generator = torch.Generator(device).manual_seed(0)
        rule.hidden.weight, rule.hidden.bias = weight, bias
        return npa_envs.rollout(rule, x, states, 3, eps=0.6, generator=generator)[1]

    inputs = [s, rule.hidden.weight.detach(), rule.hidden.bias.detach()]
    inputs = [value.clone().requires_grad_() for value in inputs]
    # As plain tensors, so that others can take their place.
    del rule.hidden.weight, rule.hidden.bias
    assert torch.autograd.gradcheck(after, inputs, fast_mode=True)


@pytest.mark.parametrize("memory", ["recompute", "minimal"])
def test_saving_memory_changes_no_bit(memory, device):
    rule = static_rule(device, torch.float32)
    x, s = random_world(2, 70, 2, 5, dtype=torch.float32, device=device)
    for value, expected in zip(
        outcome(rule, x, s, memory=memory), outcome(rule, x, s), strict=True
    ):
        assert torch.equal(value, expected)


def test_a_world_perceives_the_same_alone_and_in_a_batch(device):
    x, s = random_world(3, 200, 2, 6, dtype=torch.float32, device=device)

    def perceived(x, s):
        worlds = settled.settle(x, 6, eps=0.3, eps0=0.2, box=None, terms=Terms())
        states = settled_states(worlds, s)
        z = perceive_settled(worlds, states, all_rows(worlds), row_width=28)
        return z.view(x.shape[0], x.shape[1], -1)

    together = perceived(x, s)
    for k in range(3):
        assert torch.equal(perceived(x[k : k + 1], s[k : k + 1])[0], together[k])


def test_positions_are_returned_as_a_copy_and_pass_their_gradient(device):
    rule = static_rule(device, torch.float64)
    x, s = random_world(1, 30, 2, 5, dtype=torch.float64, device=device)
    x.requires_grad_()
    after, _, path = npa_envs.rollout(rule, x, s, STEPS, return_path_length=True)
    assert torch.equal(after, x)
    assert after.data_ptr() != x.data_ptr()
    assert (path == 0.0).all()
    weights = torch.randn_like(x)
    (gradient,) = torch.autograd.grad((weights * after).sum(), x)
    assert torch.equal(gradient, weights)
    inside, _ = npa_envs.rollout(rule, x + 5.0, s, STEPS, box=(1.4, 1.2))
    assert (inside[..., 0].abs() <= 0.7).all()
    assert (inside[..., 1].abs() <= 0.6).all()
    (gradient,) = torch.autograd.grad((weights * inside).sum(), x)
    assert torch.equal(gradient, weights)


def test_what_moves_or_is_short_or_too_large_is_rebuilt(device, monkeypatch):
    calls = settled_calls(monkeypatch)
    x, s = random_world(1, 40, 2, 5, dtype=torch.float64, device=device)
    rule = static_rule(device, torch.float64)
    moving = npa_envs.NPARule(2, 5, 12).to(device, torch.float64)
    npa_envs.rollout(moving, x, s, STEPS)
    npa_envs.rollout(rule, x, s, STEPS, position_noise=0.01)
    npa_envs.rollout(rule, x, s, STEPS, detach_positions=False)
    npa_envs.rollout(rule, x, s, FEWEST_SETTLED - 1)
    assert calls == []
    npa_envs.rollout(rule, x, s, FEWEST_SETTLED)
    assert len(calls) == 1
    for limit in ("LARGEST_LISTS", "LARGEST_INDEX"):
        with monkeypatch.context() as patch:
            patch.setattr(settled, limit, 40 * 15)
            values = outcome(rule, x, s)
        assert calls.pop() is None
        for value, expected in zip(values, outcome(rule, x, s, rebuilt=True), strict=True):
            assert torch.equal(value, expected)


def test_a_module_in_the_rules_place_is_run(device):
    rule = static_rule(device, torch.float64)
    x, s = random_world(1, 40, 2, 5, dtype=torch.float64, device=device)
    rule.hidden.register_forward_hook(lambda module, args, output: 2.0 * output)
    assert_alike(outcome(rule, x, s), outcome(rule, x, s, rebuilt=True), 1e-12)


def test_inputs_may_be_strided_and_gradients_absent(device):
    rule = static_rule(device, torch.float32)
    x, s = random_world(2, 60, 2, 5, dtype=torch.float32, device=device)
    strided_x = x.transpose(0, 1).contiguous().transpose(0, 1)
    strided_s = s.transpose(1, 2).contiguous().transpose(1, 2)
    values = outcome(rule, strided_x, strided_s)
    assert torch.equal(values[1], outcome(rule, x, s)[1])
    with torch.no_grad():
        generator = torch.Generator(device).manual_seed(3)
        _, states = npa_envs.rollout(rule, x, s, STEPS, eps=0.3, generator=generator)
    assert not states.requires_grad
    assert torch.equal(states, values[1])


def test_a_retained_graph_gives_the_same_gradient_twice(device):
    rule = static_rule(device, torch.float32)
    x, s = random_world(1, 60, 2, 5, dtype=torch.float32, device=device)
    s.requires_grad_()
    total = npa_envs.rollout(rule, x, s, STEPS)[1].square().sum()
    (first,) = torch.autograd.grad(total, s, retain_graph=True)
    (second,) = torch.autograd.grad(total, s)
    assert torch.equal(first, second)


def test_a_compiled_rollout_equals_the_eager_one(device):
    rule = static_rule(device, torch.float32)
    x, s = random_world(1, 40, 2, 5, dtype=torch.float32, device=device)

    def loss(s):
        return npa_envs.rollout(rule, x, s, 3, eps=0.3, update_prob=1.0)[1].square().sum()

    compiled = torch.compile(loss, backend="aot_eager")
    first, second = s.clone().requires_grad_(), s.clone().requires_grad_()
    value, expected = compiled(first), loss(second)
    assert torch.equal(value, expected)
    value.backward()
    expected.backward()
    assert relative_error(first.grad, second.grad) < 1e-6


def test_warmup_leaves_nothing_to_compile(device):
    warmup(device)
    rule = npa_envs.NPARule(static=True).to(device)
    x, s = random_world(1, 40, 2, 16, dtype=torch.float32, device=device)
    warm = set(bridge._launched)
    for update_prob in (0.5, 1.0):
        outcome(rule, x, s, update_prob=update_prob)
    assert not {(kernel.module.name, kernel.key) for kernel, _ in bridge._launched - warm}


def test_other_streams_and_recorded_graphs_give_the_same(device):
    if device.type != "cuda":
        pytest.skip("streams and graphs are CUDA's")
    rule = static_rule(device, torch.float32)
    x, s = random_world(2, 3000, 2, 5, dtype=torch.float32, device=device)
    generator = torch.Generator(device)

    def states():
        with torch.no_grad():
            return npa_envs.rollout(rule, x, s, 20, eps=0.1, box=1.4, generator=generator)[1]

    generator.manual_seed(3)
    expected = states()
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        generator.manual_seed(3)
        beside = states()
    torch.cuda.current_stream().wait_stream(stream)
    assert torch.equal(beside, expected)
    graph = torch.cuda.CUDAGraph()
    generator.manual_seed(3)
    graph.register_generator_state(generator)
    with torch.cuda.graph(graph, capture_error_mode="thread_local"):
        recorded = states()
    generator.manual_seed(3)
    graph.replay()
    torch.cuda.synchronize()
    assert torch.equal(recorded, expected)
