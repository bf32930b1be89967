"""The metrics of a rule, and its healing."""

import math
from dataclasses import astuple, replace

import pytest
import torch
from support.circle_task import STATE_DIM, CircleTask
from support.training_runs import grown, heart_task

import npa_envs.measure.quality
from npa_envs.errors import NPAError
from npa_envs.measure.benchmark_records import table_text
from npa_envs.measure.quality import evaluate, healing, psnr, step_count, tables_of
from npa_envs.measure.wounds import LocalLoss, part_names, wounded
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.damage import Wound
from npa_envs.tasks.morphogenesis3d import Morphogenesis3D
from npa_envs.tasks.seeds import spread_points
from npa_envs.training import TASKS, preset
from npa_envs.world.particles import Particles


def make_rule(scale):
    rule = NPARule(2, STATE_DIM, 16, eps0=CircleTask.eps)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in rule.parameters():
            parameter.uniform_(-scale, scale, generator=generator)
    return rule


def test_psnr_of_known_errors():
    pictures = torch.stack([torch.full((2, 2, 4), v) for v in (0.5, 0.9, 7.0)])
    values = psnr(pictures, torch.ones(2, 2, 4)).tolist()
    assert values == [pytest.approx(6.0206, abs=1e-4), pytest.approx(20.0, abs=1e-4), math.inf]


def test_the_psnr_on_white_is_that_of_each_world_and_largest_for_the_target_itself():
    task = TASKS["morphogenesis2d"].make(preset("tiny", target="heart").task, torch.device("cpu"))
    points, colours = task.target.points[None], task.target.colours[None]
    s = torch.cat((torch.zeros(1, points.shape[1], 13), colours - 0.5), dim=-1)
    x, s = torch.cat((points, points, 3.0 * points)), torch.cat((s, torch.zeros_like(s), s))
    own, blank, large = npa_envs.measure.quality.psnr_on_white(task, x, s).tolist()
    assert own > 60
    assert blank < 20
    assert large < 12


def test_rule_that_does_nothing_leaves_the_seed_at_every_checkpoint():
    task = CircleTask()
    rows = evaluate(make_rule(0.0), task, checkpoints=[1, 3], seeds=[5, 6, 7])
    worlds = [
        task.seed(1, generator=torch.Generator().manual_seed(k), device=torch.device("cpu"))[:2]
        for k in (5, 6, 7)
    ]
    x, s = (torch.cat(parts) for parts in zip(*worlds, strict=True))
    losses = task.metric(x, s)
    ratios = psnr(task.picture(x, s), task.target_picture)
    sides = (x.amax(1) - x.amin(1)).amax(1)
    figures = (losses.mean(), losses.max(), ratios.mean(), ratios.min(), 0.0, sides.mean())
    for row, step in zip(rows, (1, 3), strict=True):
        assert astuple(row) == pytest.approx((step, *map(float, figures)), rel=1e-6)


def test_rule_is_run_for_as_many_steps_as_the_table_says(monkeypatch):
    def count(rule, worlds, steps, **options):
        return worlds._replace(s=worlds.s + steps)

    monkeypatch.setattr(npa_envs.measure.quality, "rollout_particles", count)
    done = []
    rows = evaluate(
        make_rule(0.0), CircleTask(), checkpoints=[2, 5, 30], seeds=[0], progress=done.append
    )
    # States count the steps, and all above 1 is overflow.
    assert [(row.step, row.overflow) for row in rows] == [(2, 1.0), (5, 4.0), (30, 29.0)]
    assert done == [2, 3, 25]


def shrink(rate):
    """A rollout that brings every particle to the circle, its distance times `rate` a step."""

    def rollout(rule, worlds, steps, **options):
        goal = worlds.x / worlds.x.norm(dim=-1, keepdim=True) * 0.5
        return worlds._replace(x=goal + (worlds.x - goal) * rate**steps)

    return rollout


def test_healing_counts_the_steps_until_the_loss_is_back(monkeypatch):
    monkeypatch.setattr(npa_envs.measure.quality, "rollout_particles", shrink(0.98))
    steps = {"grow_steps": 100, "heal_steps": 205, "every": 25}
    cut, wiped = healing(make_rule(0.0), CircleTask(), **steps, seeds=[0, 1, 2], cut_gap=1.0)
    assert (cut.damage, wiped.damage) == ("cut, gap 1", "wiped disk, radius 0.2")
    # The loss is the mean square of the distances, so 25 steps multiply it by 0.98**50.
    needed = math.log(1.2 * cut.before / cut.after) / math.log(0.98) / 2
    assert cut.after > 3 * cut.before
    assert cut.steps_to_heal == 25 * math.ceil(needed / 25)
    assert (cut.worlds_healed, cut.world_count) == (3, 3)
    assert cut.end == pytest.approx(cut.after * 0.98**410, rel=1e-3)
    # Only states were wiped, which this task's loss does not see.
    assert wiped.after == wiped.before == cut.before
    assert wiped.steps_to_heal == 0


def test_rule_that_does_nothing_never_heals_a_cut():
    cut, wiped = healing(
        make_rule(0.0), CircleTask(), grow_steps=1, heal_steps=4, every=2, seeds=[0, 1], cut_gap=3.0
    )
    assert cut.after > 1.2 * cut.before
    assert cut.end == pytest.approx(cut.after)
    assert (cut.steps_to_heal, cut.worlds_healed, wiped.steps_to_heal) == (None, 0, 0)


def test_worlds_that_run_away_have_not_healed(monkeypatch):
    monkeypatch.setattr(npa_envs.measure.quality, "rollout_particles", shrink(1.05))
    steps = {"grow_steps": 10, "heal_steps": 100, "every": 25}
    for row in healing(make_rule(0.0), CircleTask(), **steps, seeds=[0, 1, 2], cut_gap=0.1):
        assert row.after < 1.2 * row.before
        assert row.end > 10.0 * row.before
        assert (row.steps_to_heal, row.worlds_healed) == (None, 0)


@pytest.mark.parametrize(
    ("measured", "options", "rule"),
    [
        *(
            (evaluate, {"checkpoints": steps}, "checkpoints must be whole numbers of at least 1")
            for steps in ([], [5, 5], [0, 5])
        ),
        (evaluate, {"seeds": []}, "seeds must have at least one number"),
        *((healing, {name: 0}, name) for name in ("grow_steps", "heal_steps", "every")),
    ],
)
def test_wrong_arguments_are_named(measured, options, rule):
    with pytest.raises(NPAError, match=rule):
        measured(make_rule(0.0), CircleTask(), **options)


# Healing near wounds: which pixels count, what is healed, and of which rules.


@pytest.fixture(scope="module")
def task():
    return heart_task()


def test_distances_from_wounds_are_those_from_what_is_moved_or_wiped():
    points = torch.tensor([[[0.0, 0.0], [0.5, 0.0], [0.0, 0.5]]])
    centre = torch.tensor([[0.1, 0.0]])
    wipe = Wound("wipe", centre, 0.2).distance(points)
    expected = torch.tensor([[-0.1, 0.2, math.hypot(0.1, 0.5) - 0.2]])
    torch.testing.assert_close(wipe, expected)
    slit = Wound("cut", centre, 0.1, torch.tensor([[2.0, 0.0]])).distance(points)
    torch.testing.assert_close(slit, torch.tensor([[0.0, 0.3, 0.0]]))


def test_places_are_far_from_each_other():
    points = torch.rand(400, 2, generator=torch.Generator().manual_seed(0))
    chosen = spread_points(points, 9)
    apart = torch.cdist(chosen, chosen) + torch.eye(9)
    # A square of side 1 has room for nine places half a side from each other.
    assert float(apart.min()) > 0.3
    assert all(bool((points == place).all(-1).any()) for place in chosen)


def test_the_loss_near_a_wound_is_the_mean_over_its_pixels_and_the_bound_follows_the_rule(task):
    before = grown(task, 1, 0.005)
    centre = task.spread_places(4, before)[:, 2]
    in_target = centre[0] - before.x[0].mean(0) + task.target.points.mean(0)
    at = torch.linspace(-1.0, 1.0, 64)
    away = ((at[None, :] - in_target[0]) ** 2 + (at[:, None] - in_target[1]) ** 2).sqrt()
    near = away < 0.2 + 0.5 * task.eps
    loss = LocalLoss(task, before, Wound("wipe", centre, 0.2))
    density, colour = (errors[0] for errors in task.splat_errors(*before[:2]))
    errors = density + task.config.colour_weight * colour
    local, whole = float(errors[near].mean()), float(task.metric(*before[:2]))
    assert float(loss.before) == pytest.approx(local, rel=1e-4)
    assert float(loss(before)) == pytest.approx(local, rel=1e-4)
    assert float(loss.bound) == pytest.approx(max(1.25 * local, local + 0.1 * whole), rel=1e-4)
    hurt = wounded(task, before, Wound("wipe", centre, 0.2))
    blank = (hurt.s[0] == 0.0).all(-1)
    assert torch.equal(blank, (before.x[0] - centre[0]).norm(dim=-1) <= 0.2)
    assert float(loss(hurt)) > 2.0 * float(loss.bound)


def test_what_happens_elsewhere_does_not_count(task):
    before = grown(task, 1, 0.005)
    first, second = task.spread_places(2, before).unbind(1)
    assert float((first - second).norm()) > 1.0
    loss = LocalLoss(task, before, Wound("wipe", first, 0.2))
    elsewhere = wounded(task, before, Wound("wipe", second, 0.2))
    assert float(loss(elsewhere)) == pytest.approx(float(loss.before), rel=1e-5)


def test_turned_worlds_are_wounded_at_the_same_places_of_the_picture():
    task = heart_task(equivariant=True, seed_across=0.5)
    before = grown(task, 1, 0.005)
    cos, sin = math.cos(2.0), math.sin(2.0)
    turned = before._replace(x=before.x @ torch.tensor([[cos, sin], [-sin, cos]]))
    losses = []
    for worlds in (before, turned):
        wound = Wound("wipe", task.spread_places(3, worlds)[:, 1], 0.2)
        loss = LocalLoss(task, worlds, wound)
        losses.append((float(loss.before), float(loss(wounded(task, worlds, wound)))))
    assert losses[0] == pytest.approx(losses[1], rel=0.15)
    assert losses[0][1] > 2.0 * losses[0][0]


def healed_by(monkeypatch, task, courses, **options):
    """Rows where the rule leaves the seed as it is, and wounded worlds are what `courses` say.

    They are, for each check after a wound, "whole" or "hurt".
    """
    start = grown(task, 1, 0.005)
    monkeypatch.setattr(task, "seed", lambda *_, **__: start)
    later = iter(courses)

    def rollout(rule, worlds, steps, **options):
        if len(worlds.x) == 1 or next(later) == "hurt":
            return worlds
        return start.map(lambda value: value.expand(len(worlds.x), -1, -1))

    monkeypatch.setattr(npa_envs.measure.quality, "rollout_particles", rollout)
    rule = NPARule(2, task.config.state_dim, 8, eps0=task.eps)
    return healing(rule, task, places=5, seeds=[0], **options)


@pytest.mark.parametrize(
    ("courses", "healed"),
    [
        (["whole", "whole"] * 2, (5, 5)),
        (["hurt", "whole"] * 2, (0, 0)),
        (["whole", "whole", "hurt", "hurt"], (5, 0)),
    ],
)
def test_wounds_are_healed_where_they_are_within_the_bound_at_both_checks(
    monkeypatch, courses, healed
):
    rows = healed_by(monkeypatch, heart_task(), courses)
    assert [(row.damage, row.wounds, row.changed) for row in rows] == [
        ("cut, gap 0.1", 5, 5),
        ("wipe, radius 0.2", 5, 5),
    ]
    assert tuple(row.healed for row in rows) == healed
    for row, last in zip(rows, courses[1::2], strict=True):
        assert row.after > 2.0 * row.before
        assert row.end == pytest.approx(row.before if last == "whole" else row.after)
    assert rows[0].summary == (
        f"cut, gap 0.1: 5 of 5 wounds left a mark, and {healed[0]} of these healed"
    )


def test_wounds_that_change_nothing_do_not_count(monkeypatch):
    rows = healed_by(monkeypatch, heart_task(), ["whole"] * 4, wipe_radius=0.0, cut_gap=1e-6)
    assert [(row.wounds, row.changed, row.healed) for row in rows] == [(5, 0, 0)] * 2
    assert table_text(rows).split("\n")[1].count("too small") == 3
    assert rows[0].summary.startswith("cut, gap 1e-06: too small to measure: none of 5 wounds")


def test_a_cpu_has_six_places_in_one_world_and_every_number_is_checked():
    task = heart_task()
    rule = NPARule(2, task.config.state_dim, 8, eps0=task.eps)
    rows = healing(rule, task, grow_steps=2, heal_steps=2, seeds=[3, 4])
    assert [row.wounds for row in rows] == [6, 6]
    rows = healing(rule, task, grow_steps=2, heal_steps=2, seeds=[3, 4], places=2)
    assert [row.wounds for row in rows] == [4, 4]
    with pytest.raises(NPAError, match="places must be whole numbers of at least 1"):
        healing(rule, task, places=0)


def test_in_3d_the_pixels_are_those_that_show_the_wound():
    config = preset("tiny", "morphogenesis3d").task
    task = Morphogenesis3D(replace(config, particle_count=4000, sigma=0.05))
    x = torch.randn(4000, 3, generator=torch.Generator().manual_seed(0))
    x = 0.6 * x / x.norm(dim=-1, keepdim=True)
    world = Particles(x[None], torch.zeros(1, 4000, task.config.state_dim))
    cameras = task.target.held_out.cameras
    # Where a camera stands; what it sees of the ball is the near side.
    motion = cameras.world_to_camera[0]
    eye = -(motion[:3, :3].T @ motion[:3, 3])
    front = 0.6 * eye / eye.norm()
    seen, hidden = (
        task.pixels_near(world, Wound("wipe", side[None], 0.3).distance, 0.1)[0, 0]
        for side in (front, -front)
    )
    assert seen.shape == (32, 32)
    assert bool(seen[15:17, 15:17].all())
    assert not seen[0].any()
    assert 0.03 < float(seen.float().mean()) < 0.4
    assert not hidden[12:20, 12:20].any()
    places = task.spread_places(6, world)
    assert float((torch.cdist(places[0], places[0]) + torch.eye(6)).min()) > 0.5
    errors = task.pixel_errors(*world[:2])
    assert errors.shape == (1, 4, 32, 32)
    assert float(errors.mean()) == pytest.approx(float(task.metric(*world[:2])), rel=1e-4)


def test_parts_of_a_body_are_named_as_they_are_seen():
    at = torch.tensor([0.0, 0.5, 1.0])
    places = torch.stack(torch.meshgrid(at, at, indexing="xy"), dim=-1).flatten(0, 1)
    x = 3.0 * torch.tensor([[0.0, 0.0], [1.0, 1.0]]).expand(9, -1, -1)
    names = part_names(x, 3.0 * places, torch.ones(9, dtype=torch.bool))
    assert names == [
        "bottom left", "bottom", "bottom right", "left", "middle", "right", "top left", "top",
        "top right",
    ]  # fmt: skip
    assert part_names(x, 3.0 * places, torch.arange(9) == 6) == ["top left"]


@pytest.mark.parametrize("changed", [False, True])
def test_progress_bars_know_how_many_steps_a_measurement_takes(changed, task, monkeypatch):
    monkeypatch.setattr(npa_envs.measure.quality, "rollout_particles", lambda _, now, *a, **k: now)
    digits = preset("tiny", "point_classification", particle_count=16).task
    for one in (task, TASKS["point_classification"].make(digits, torch.device("cpu"))):
        rule = one.make_rule(torch.Generator().manual_seed(0))
        done: list[int] = []
        steps = {"checkpoints": (4, 8), "changed": changed}
        tables_of(rule, one, **steps, seeds=(0,), progress=done.append)
        assert sum(done) == step_count(one, **steps)
