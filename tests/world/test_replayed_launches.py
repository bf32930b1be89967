"""Prepared steps on a CPU: what they give is what launched ones give, bit for bit."""

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from support.worlds import assert_same, lively_rule, random_world

import npa_envs
from npa_envs.world import replayed_launches
from npa_envs.world.particles import Particles
from npa_envs.world.rollout import rollout_particles

BOX = (1.4, 1.4)


@pytest.fixture(autouse=True)
def _nothing_prepared(monkeypatch):
    for name in ("_groups", "_trained_groups"):
        monkeypatch.setattr(replayed_launches, name, type(replayed_launches._groups)())


def make_rule(dtype=torch.float32, seed=0, **options):
    return lively_rule("cpu", dtype, eps0=0.3, gain=1.0, seed=seed, **options)


def worlds(dtype=torch.float32, world_count=2, particle_count=40, seed=0):
    return random_world(world_count, particle_count, 2, 5, dtype=dtype, device="cpu", seed=seed)


@torch.no_grad()
def run(rule, x, s, steps=5, *, by_world=False, seed=3, **options):
    """Return what a rollout gives, and what its generator draws next."""
    generator = torch.Generator().manual_seed(seed)
    if by_world:
        generator = npa_envs.WorldRandom(range(seed, seed + len(x)))
    options = {"generator": generator, "return_path_length": True, **options}
    result = npa_envs.rollout(rule, x, s, steps, **options)
    return *result, generator.uniform(2) if by_world else torch.rand(2, generator=generator)


def steps_ready(groups="_groups"):
    return [steps for group in getattr(replayed_launches, groups).values() for steps in group.free]


def graph(rule, x, s, seed, steps=4, **options):
    """Return worlds after a rollout with gradients, and the tensors that get them."""
    inputs = [x.clone().requires_grad_(), s.clone().requires_grad_(), *rule.parameters()]
    options = {"generator": torch.Generator().manual_seed(seed), **options}
    return npa_envs.rollout(rule, *inputs[:2], steps, return_path_length=True, **options), inputs


def derivatives(after, inputs, **options):
    loss = sum((value**2).sum() for value in after)
    return torch.autograd.grad(loss, inputs, allow_unused=True, **options)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"box": BOX, "update_prob": 1.0},
        {"update_prob": 0.001, "keep_every": 2, "steps": 4},
        {"by_world": True, "dt": 0.5, "steps": 1},
        {"equivariant": True},
        {"position_noise": 0.01},
        {"position_noise": 0.01, "by_world": True, "keep_every": 1, "steps": 19},
    ],
    ids=["open", "box", "few", "by world", "equivariant", "noise", "noise by world"],
)
def test_replayed_rollouts_are_the_launched_ones(options, dtype):
    options = dict(options)
    chiral = options.pop("equivariant", False)
    rule, (x, s) = make_rule(dtype, equivariant=chiral, chiral=chiral), worlds(dtype)
    launched = [run(rule, x, s, seed=seed, **options) for seed in (3, 4)]
    assert not steps_ready()
    ready = [run(rule, x, s, seed=seed, **options) for seed in (3, 4)]
    assert len(steps_ready()) == 1
    assert_same(ready, launched)


def test_worlds_that_lie_otherwise_in_memory_are_stepped_alike():
    rule, (x, s) = make_rule(), worlds()
    others = worlds(seed=8)
    expected = [run(rule, x, s), run(rule, *others)]
    views = x.transpose(0, 1).contiguous().transpose(0, 1), s.mT.contiguous().mT
    assert not any(view.is_contiguous() for view in views)
    replayed_launches._groups.clear()
    for _ in range(4):
        assert_same(run(rule, *views), expected[0])
    # The same kind of worlds: what was prepared for views serves these too.
    assert_same(run(rule, *others), expected[1])


def test_weights_are_read_anew_and_results_stay():
    rules = [make_rule(seed=seed) for seed in range(3)]
    starts = [worlds(seed=seed) for seed in range(3)]
    launched = []
    for rule, start in zip(rules, starts, strict=True):
        replayed_launches._groups.clear()
        launched.append(run(rule, *start))
    for _ in range(2):
        run(rules[0], *starts[0])
    ready = [run(rule, *start) for rule, start in zip(rules, starts, strict=True)]
    assert len(steps_ready()) == 1
    assert_same(ready, launched)


def test_worlds_of_inference_mode_are_stepped_too():
    rule, (x, s) = make_rule(), worlds()
    launched = run(rule, x, s)
    for _ in range(3):
        with torch.inference_mode():
            ready = run(rule, x, s)
    assert len(steps_ready()) == 1
    assert_same((ready, run(rule, x, s)), (launched, launched))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize(
    ("form", "options"),
    [
        ({}, {}),
        ({}, {"box": BOX, "update_prob": 1.0}),
        ({"dead_zone": 0.02}, {"position_noise": 0.01, "update_prob": 0.3}),
    ],
    ids=["open", "box", "dead zone and noise"],
)
def test_replayed_gradients_are_the_launched_ones(form, options, dtype):
    rule, (x, s) = make_rule(dtype, **form), worlds(dtype)
    calls, launched = ((3, 4), (4, 2), (5, 6)), []
    for seed, steps in calls:
        replayed_launches._trained_groups.clear()
        after, inputs = graph(rule, x, s, seed, steps, **options)
        launched.append((*after, *derivatives(after, inputs)))
    assert not steps_ready("_trained_groups")
    for seed, steps in calls[:2]:
        graph(rule, x, s, seed, steps, **options)
    # Several graphs at a time, each with buffers of its own, and one of them used twice.
    graphs = [graph(rule, x, s, seed, steps, **options) for seed, steps in calls]
    derivatives(*graphs[1], retain_graph=True)
    replayed = [(*after, *derivatives(after, inputs)) for after, inputs in graphs]
    assert_same(replayed, launched)
    del graphs, after, inputs, replayed
    assert len(steps_ready("_trained_groups")) == len(calls)


def test_what_needs_gradients_or_a_rule_of_its_own_is_launched():
    class Own(npa_envs.NPARule):
        def forward(self, perception):
            return super().forward(perception)

    x, s = worlds()
    rule = make_rule()
    own = Own(2, 5, 12, eps0=0.3)
    for _ in range(4):
        run(own, x, s)
        _, after = npa_envs.rollout(rule, x, s, 2)
        assert after.requires_grad
    assert not steps_ready()


@pytest.mark.parametrize("particle_count", [5, 9])
def test_a_world_is_the_same_in_every_batch_where_the_network_runs_world_by_world(particle_count):
    # Torch's products of few rows depend on how many there are.
    rule, count = npa_envs.load_rule("heart-first"), 30
    x, s = random_world(count, particle_count, 2, 16, dtype=torch.float32, device="cpu", seed=0)

    def after(chosen):
        random = npa_envs.WorldRandom(range(count)).take(chosen)
        options = {"generator": random, "position_noise": 0.01, "world_by_world": True}
        return rollout_particles(rule, Particles(x[chosen], s[chosen]), 3, **options)

    with torch.no_grad():
        alone = [after(slice(k, k + 1)) for k in range(count)]
        # Launched, then replayed.
        together = [after(slice(count)) for _ in range(3)]
    for number in range(2):
        for worlds in together:
            assert_same(worlds[number], torch.cat([world[number] for world in alone]))


def test_threads_step_worlds_of_their_own():
    rule, starts = make_rule(), [worlds(seed=seed) for seed in range(4)]
    expected = [run(rule, *start) for start in starts]
    with ThreadPoolExecutor(len(starts)) as pool:
        result = pool.map(lambda start: [run(rule, *start) for _ in range(20)][-1], starts)
    assert_same(list(result), expected)
    assert 1 <= len(steps_ready()) <= len(starts)


def test_groups_are_forgotten_in_turn(monkeypatch):
    monkeypatch.setattr(replayed_launches, "MAX_REPLAYED_GROUPS", 2)
    rule = make_rule()
    for particle_count in (30, 31, 32):
        for _ in range(3):
            run(rule, *worlds(particle_count=particle_count))
    assert len(replayed_launches._groups) == len(steps_ready()) == 2


@pytest.mark.parametrize(("world_count", "particle_count"), [(1365, 3), (2048, 2), (1024, 4)])
def test_many_worlds_of_few_particles_are_what_they_were_in_every_call(world_count, particle_count):
    rule, (x, s) = make_rule(), worlds(world_count=world_count, particle_count=particle_count)
    first = run(rule, x, s)
    for _ in range(4):
        assert_same(run(rule, x, s), first)
    # Of more worlds the masks take too long to count in one launch, and torch does a part.
    assert bool(steps_ready()) == (world_count == 1024)
