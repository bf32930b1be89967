"""What a training iteration does before and after the rollout, recorded and replayed; wounds."""

import pytest
import torch
from support.circle_task import CircleTask, circle_config
from support.small_digits import write_idx
from support.training_runs import Recording, grown, heart_task, make_cycle, runaway
from support.worlds import assert_same

from npa_envs.errors import NPAError
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D
from npa_envs.tasks.point_classification import PointClassification
from npa_envs.training import preset, train
from npa_envs.training.iteration import EagerIteration, GraphedIteration
from npa_envs.world.brushes import cut, wipe_state
from npa_envs.world.particles import Particles
from npa_envs.world.rollout import rollout_particles

WOUNDED = {"max_age_range": (4, 400), "damage_share": 0.25, "cut_gap": 0.1, "cut_anywhere": True}
WOUNDED |= {"wound_chance": 0.5, "wound_min_age": 4, "wound_weight": 0.5}


def circle_cycle(tmp_path, **fields):
    fields = {"seed_interval": 3, "iterations": 5, "repeats": 2, "milestones": [2]} | fields
    return make_cycle(circle_config(tmp_path, **fields), CircleTask(), rollout=runaway)


def tiny_cycle(tmp_path, **fields):
    config = preset("tiny", out=tmp_path, **fields)
    return make_cycle(config, Morphogenesis2D(config.task))


def world_cycle(tmp_path, **fields):
    """Worlds that draw by themselves, as several processes need it."""
    config = preset("tiny", out=tmp_path, steps=(2, 4), seed_interval=3, **fields)
    return make_cycle(
        config, Morphogenesis2D(config.task), rollout=jittered, per_world_streams=True
    )


def jittered(rule, worlds, steps, generator, **options):
    """The engine's rollout, but without gradients, where it would wait for a CPU, a jitter."""
    if torch.is_grad_enabled():
        return rollout_particles(rule, worlds, steps, generator=generator, **options)
    for _ in range(steps):
        generator.advance()
    x = worlds.x + 0.01 * generator.normal(*worlds.x.shape[1:], dtype=worlds.x.dtype)
    return worlds._replace(x=x).with_zero_paths()


def clouds_cycle(tmp_path, per_world_streams=False, **fields):
    """Worlds with goals, which mutate and are varied."""
    data = {"data": str(write_idx(tmp_path / "idx")), "class_count": 3}
    data |= {"steps": (2, 4)}
    varied = {"mutated_share": 0.3, "rotation": 20.0, "stretch": 0.1, "jitter": 0.01}
    config = preset("tiny", "point_classification", out=tmp_path, **data, **varied, **fields)
    return make_cycle(config, PointClassification(config.task), per_world_streams=per_world_streams)


@pytest.mark.parametrize(
    ("make", "fields"),
    [
        (circle_cycle, {}),
        (circle_cycle, {"dtype": "float64", "damage_share": 0.0}),
        (tiny_cycle, {}),
        (clouds_cycle, {"pool_size": 10}),
        (tiny_cycle, {"max_age_range": (4, 40), "damage_share": 0.5}),
        (clouds_cycle, {"pool_size": 16, "max_age_range": (2, 6), "damage_share": 0.5}),
        (tiny_cycle, {"max_age_range": (4, 40), "damage_share": 0.5, "damage_and_keep_share": 0.5}),
        (tiny_cycle, {"max_age_range": (4, 40), "damage_share": 0.0, "damage_and_keep_share": 0.5}),
        (tiny_cycle, {"vary_eps": (0.5, 2.0)}),
        (tiny_cycle, WOUNDED),
        (world_cycle, WOUNDED | {"damage_and_keep_share": 0.5}),
        (world_cycle, {"damage_share": 0.5}),
        (world_cycle, {"max_age_range": (4, 400), "vary_eps": (0.5, 2.0)}),
        (clouds_cycle, {"per_world_streams": True, "pool_size": 16}),
    ],
)
def test_replayed_operations_train_the_same_rule_as_called_ones(tmp_path, make, fields):
    (called, called_rule), (replayed, replayed_rule) = (make(tmp_path, **fields) for _ in range(2))
    names = "_graphed_draw", "_graphed_store", "_graphed_record"
    for name in names:
        setattr(replayed, name, Recording(getattr(replayed, name)))
    for iteration in range(8):
        for cycle in (called, replayed):
            cycle.run(iteration)
            cycle.statistics.send()
        assert replayed.statistics.receive() == called.statistics.receive()
        assert_same(replayed.batch.start, called.batch.start)
        assert_same(replayed_rule.state_dict(), called_rule.state_dict())
    assert_same(replayed.state_dict(), called.state_dict())
    assert all(len(getattr(replayed, name).recorded) > 5 for name in names)


@pytest.mark.gpu
def test_captured_iterations_take_means_over_processes_where_eager_ones_do(tmp_path):
    escaping = {"escape_share": 0.2, "escape_weight": 10.0, "cuda_graph": False}
    config = preset("tiny", out=tmp_path, device="cuda", **escaping)
    task = Morphogenesis2D(config.task, device="cuda")
    device = torch.device("cuda")
    rule = task.make_rule(torch.Generator().manual_seed(1)).to(device)
    with torch.no_grad():
        for weights in rule.parameters():
            weights.add_(0.05 * torch.randn_like(weights))
    generator = torch.Generator(device)
    x, s, *_ = task.seed(4, generator=generator.manual_seed(2), device=device)
    results = []
    for cls in (EagerIteration, GraphedIteration):
        counts = []

        def take_means(values, counts=counts):
            counts.append(float(values[0]))
            values[0] *= 2.0

        arguments = task, rule, config, Particles(x, s), generator, rollout_particles
        iteration = cls(*arguments, take_means=take_means)
        for number in range(3):
            escaped = x.clone()
            escaped[:, : 5 + number] += 3.0
            iteration.start.x.copy_(escaped)
            generator.manual_seed(number)
            iteration.run(6 + number % 2)
            rows = [*iteration.gradients, iteration.terms, iteration.end.x, iteration.end.s]
            results.append([row.clone() for row in rows])
        # The first capture is after a run that loads kernels.
        assert counts[-3:] == [20.0, 24.0, 28.0]
    assert float(results[0][len(iteration.gradients)][iteration.term_names.index("stray")]) > 0.0
    for eager, graphed in zip(results[:3], results[3:], strict=True):
        for one, other in zip(eager, graphed, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)


# Worlds of several radii.


def test_seeds_are_as_large_as_eps_makes_them(tmp_path):
    def sizes(*vary_eps):
        cycle, _ = tiny_cycle(tmp_path, vary_eps=vary_eps, pool_size=64)
        radius = preset("tiny").task.seed_radius
        return cycle.pool.worlds.x.norm(dim=-1).amax(dim=1) / radius

    plain, varied, nearly = sizes(1.0, 1.0), sizes(0.5, 2.0), sizes(1.999, 2.0)
    assert 0.8 < float(plain.min()) <= float(plain.max()) <= 1.0
    assert 0.4 < float(varied.min()) < 0.7
    assert 1.5 < float(varied.max()) <= 2.0
    torch.testing.assert_close(nearly, sizes(2.0, 2.0), rtol=2e-3, atol=0.0)


@pytest.mark.parametrize(
    ("task", "fields", "message"),
    [
        ("texture", {}, "vary_eps needs particles that move in open space, got a periodic box"),
        ("morphogenesis2d", {"division": True}, "vary_eps needs .*, got a rule that divides"),
        ("co_morphogenesis2d", {}, "vary_eps is for runs of one rule"),
    ],
)
def test_eps_is_varied_only_where_it_can_be(tmp_path, task, fields, message):
    config = preset("tiny", task, out=tmp_path, vary_eps=(0.5, 2.0), **fields)
    with pytest.raises(NPAError, match=message):
        train(config, task, progress=False)


# The loss near a world's last wound: which pixels count, how much, and for how long.


AGED = {"max_age_range": (8, 64), "damage_share": 0.0, "wound_weight": 0.5}


@pytest.fixture(scope="module")
def task():
    return heart_task()


def distances(task, centre):
    """How far the pixels of a picture lie from a point of the target, shape [R, R]."""
    at = torch.linspace(-1.0, 1.0, task.config.resolution)
    return ((at[None, :] - centre[0]).square() + (at[:, None] - centre[1]).square()).sqrt()


def test_wounds_are_the_pixels_of_the_centred_picture_that_a_damage_changes(task):
    before = grown(task, 2, 0.0)
    centre = before.x[:, 100]
    s = wipe_state(*before[:2], centre=centre, radius=0.2)
    s[1] = before.s[1]
    wounds = task.wounds_between(before, before._replace(s=s))
    assert wounds.shape == (2, 64, 64)
    assert wounds.dtype == torch.uint8
    away = distances(task, task.target.points[100])
    inside = (task.target_picture[..., 3] > 0.5) & (away < 0.15)
    assert int(inside.sum()) > 30
    assert bool(wounds[0][inside].all())
    assert not wounds[0][away > 0.2 + 0.5 * task.eps + 0.15].any()
    assert not wounds[1].any()
    # A world that is elsewhere as a whole has no place that hurts.
    assert not task.wounds_between(before, before._replace(x=before.x + 0.3)).any()
    normal = torch.tensor([[1.0, 0.0]]).expand(2, 2)
    slit = Particles(*cut(*before[:2], centre=before.x.mean(1), normal=normal, gap=0.1))
    assert 0.05 < float(task.wounds_between(before, slit).float().mean()) < 0.35


def test_the_loss_adds_the_mean_over_the_wound(task):
    worlds = grown(task, 2, 0.0)
    x = worlds.x.clone().requires_grad_()
    s = worlds.s + 0.1
    wounds = torch.zeros(2, 64, 64, dtype=torch.uint8)
    wounds[0, 20:40, 24:40] = 1
    plain, parts = task.compare(Particles(x, s))
    total, terms = task.with_wounds(wounds, 0.5).compare(Particles(x, s))
    density, colour = task.splat_errors(x, s)
    errors = density + task.config.colour_weight * colour
    expected = 0.5 * errors[0, 20:40, 24:40].mean()
    torch.testing.assert_close(terms["wound"], expected)
    torch.testing.assert_close(total, plain + task.config.splat_weight * 0.5 * expected)
    torch.testing.assert_close(terms["density"], parts["density"])
    (gradient,) = torch.autograd.grad(terms["wound"], x)
    assert bool((gradient[0] != 0.0).any())
    assert not gradient[1].any()


def test_the_pool_remembers_a_wound_until_the_world_is_replaced(tmp_path):
    fields = AGED | {"wound_chance": 0.3, "wound_min_age": 8, "damage_radius": 0.3}
    config = preset("tiny", out=tmp_path, **fields, steps=(4, 5), learning_rate=1e-9)
    cycle, _ = make_cycle(config, Morphogenesis2D(config.task))
    new = kept = 0
    for iteration in range(80):
        stored, states = cycle.pool.wounds.clone(), cycle.pool.worlds.s.clone()
        cycle.run(iteration)
        index, age = cycle._index, cycle._age
        unlike = (states[index] != cycle.batch.start.s).flatten(1).any(dim=1)
        hits = (unlike & (age > 0)).tolist()
        assert not any(hits[k] for k, number in enumerate(index) if number % 2 == 0)
        for old, now, hit, years in zip(
            stored[index], cycle.pool.wounds[index], hits, age, strict=True
        ):
            if int(years) < 8:
                assert not now.any()
            elif not hit:
                assert torch.equal(now, old)
                kept += bool(old.any())
            else:
                new += not torch.equal(now, old)
        assert torch.equal(cycle.pool.wounds[index], cycle.batch.wounds)
    assert new > 5
    assert kept > 5


@pytest.mark.parametrize(
    ("name", "fields"),
    [("morphogenesis3d", {}), ("texture", {}), ("morphogenesis2d", {"equivariant": True})],
)
def test_worlds_without_an_upright_picture_have_no_loss_of_wounds(tmp_path, name, fields):
    fields = AGED | {"wound_chance": 0.5, "wound_min_age": 8, "iterations": 4} | fields
    result = train(preset("tiny", name, out=tmp_path, **fields), name, progress=False)
    assert result.iteration == 4
    assert "wound" not in result.record
