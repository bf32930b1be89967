"""The metrics of a rule."""

import math
from dataclasses import astuple

import pytest
import torch
from support.circle_task import PARTICLE_COUNT, STATE_DIM, CircleTask

import npa_envs.measure.quality
from npa_envs.errors import NPAError
from npa_envs.measure.quality import evaluate, healing, psnr
from npa_envs.rule.rule import NPARule


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


def test_wiped_disk_blanks_states_of_the_grown_world(monkeypatch):
    seen = []

    def fill(rule, worlds, steps, **options):
        seen.append((worlds.s == 0).all(-1).float().mean(1).tolist())
        return worlds._replace(s=torch.ones_like(worlds.s))

    monkeypatch.setattr(npa_envs.measure.quality, "rollout_particles", fill)
    steps = dict.fromkeys(("grow_steps", "heal_steps", "every"), 1)
    healing(make_rule(0.0), CircleTask(), **steps, seeds=[0], wipe_radius=0.1)
    blank_after_cut, blank_after_erasure = seen[1][0], seen[2][0]
    assert blank_after_cut == 0
    assert 1 / PARTICLE_COUNT <= blank_after_erasure < 1


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
