"""Rules are tried under other conditions and damaged; recovery is measured by undamaged copies."""

import json
import math
from pathlib import Path

import pytest
import torch
from support.slow import slow

from npa_envs.cli import main
from npa_envs.measure.accuracy.trained_rule_checks import task_name
from npa_envs.measure.robustness import report, trials
from npa_envs.measure.robustness.trials import (
    BLOB_DISTANCE,
    CONDITIONS,
    PLANS,
    SHAPES,
    SIZE_FACTOR,
    RuleTrial,
    TrialPlan,
    disk,
    quick_plan,
)
from npa_envs.rule import files
from npa_envs.tasks.damage import random_particle
from npa_envs.training.task_of_rule import task_of_rule, trained_config
from npa_envs.world.brushes import nearest_image
from npa_envs.world.particles import combined
from npa_envs.world.randomness import WorldRandom

SIDE = 2.0
COUNT = 501
VALUES = {"eps": (1.0, 2.0), "particles": (1.0, 2.0), "update_prob": (0.25, 0.5)}
TINY = TrialPlan(grow_steps=8, heal_steps=(0, 4, 8), chunk=4, values=VALUES)


def trial_of(
    name: str, device: torch.device, plan: TrialPlan = TINY, particles: int = 128
) -> RuleTrial:
    return RuleTrial(name, device, plan, range(5, 7), particles)


def damaged(name: str, x: torch.Tensor, s: torch.Tensor, box=None, seeds=(1, 2, 3)):
    before = x.clone(), s.clone()
    found = trials.DAMAGES[name].apply(x, s, WorldRandom(list(seeds), device=x.device), box)
    assert torch.equal(x, before[0])
    assert torch.equal(s, before[1])
    return found


@pytest.fixture(params=[(2, False), (2, True), (3, False)], ids=["2d", "periodic", "3d"])
def worlds(request, device):
    space_dim, periodic = request.param
    draws = torch.Generator().manual_seed(0)
    x = SIDE * (torch.rand(3, COUNT, space_dim, generator=draws) - 0.5)
    s = torch.randn(3, COUNT, 4, generator=draws)
    return x.to(device), s.to(device), (SIDE,) * space_dim if periodic else None


# Damages


def plainly(name, x, s, random, box):
    """What a damage leaves of worlds, by its formula."""
    if name == "noise":
        return x, s + trials.STATE_NOISE * random.normal(*s.shape[1:])
    if name in ("half", "side"):
        key = random.uniform(COUNT) if name == "half" else x @ random.normal(x.shape[2])[..., None]
        key = key.view(3, COUNT)
        kept = key < key.sort(dim=1).values[:, COUNT // 2, None]
        return [part[kept].view(3, COUNT // 2, -1) for part in (x, s)]
    middle = name == "cut" and box is None
    centre = (x.mean(1) if middle else random_particle(x, random))[:, None]
    away = nearest_image(x - centre, box)
    near = away.norm(dim=-1, keepdim=True) <= 0.2
    if name == "wipe":
        return x, torch.where(near, 0.0, s)
    if name == "clump":
        return torch.where(near, centre, x), s
    normal = torch.nn.functional.normalize(random.normal(x.shape[2]), dim=1)[..., None]
    height = away @ normal
    # Who is nearer than the gap goes half of the way to its distance, and half a gap.
    side = torch.where(height < 0.0, -1.0, 1.0)
    shift = torch.where(height.abs() < 0.1, side * (0.05 - height.abs() / 2), 0.0)
    return x + shift * normal.mT, s


@pytest.mark.parametrize("name", trials.DAMAGES)
def test_a_damage_does_to_each_world_what_it_says(worlds, name):
    x, s, box = worlds
    found_x, found_s = damaged(name, x, s, box)
    expected_x, expected_s = plainly(name, x, s, WorldRandom([1, 2, 3], device=x.device), box)
    assert float(nearest_image(found_x - expected_x, box).abs().max()) < 1e-5
    assert torch.equal(found_s, expected_s)
    assert box is None or float(found_x.abs().max()) <= 0.5 * SIDE + 1e-6
    if name in ("cut", "clump"):
        assert 0.0 < float((expected_x != x).any(-1).float().mean()) < 0.4
    if name == "wipe":
        assert 3 < int((found_s == 0.0).all(-1).sum()) < 3 * COUNT // 2


# Seeds


@pytest.mark.parametrize("space_dim", [2, 3])
def test_seeds_of_other_shapes_are_where_they_should_be(space_dim, device):
    radius, count = 0.5, 4000
    found = {
        name: shape(count, space_dim, radius, WorldRandom([3, 4], device=device))
        for name, shape in {"disk": disk, **SHAPES}.items()
    }
    distance = {name: x.norm(dim=-1) for name, x in found.items()}
    assert all(x.shape == (2, count, space_dim) for x in found.values())
    outer = radius * 2.0 ** (1.0 / space_dim)
    assert radius - 1e-5 <= float(distance["ring"].min()) < 1.01 * radius
    assert 0.99 * outer < float(distance["ring"].max()) <= outer + 1e-5
    # Uniform: half of the area lies within half of the area.
    middle = radius * 1.5 ** (1.0 / space_dim)
    assert float((distance["ring"] < middle).float().mean()) == pytest.approx(0.5, abs=0.03)
    volume = math.pi * radius**2 if space_dim == 2 else 4.0 / 3.0 * math.pi * radius**3
    sides = found["square"].amax(1) - found["square"].amin(1)
    assert float(sides.mean()) ** space_dim == pytest.approx(volume, rel=0.02)
    for name, size in (("larger", radius * SIZE_FACTOR), ("smaller", radius / SIZE_FACTOR)):
        assert 0.98 * size < float(distance[name].max()) <= size + 1e-5
    small = radius * 0.5 ** (1.0 / space_dim)
    blobs = found["two blobs"].clone()
    assert float((blobs[..., 0] > 0.0).float().mean()) == 0.5
    blobs[..., 0] = blobs[..., 0].abs() - BLOB_DISTANCE * small
    assert 0.97 * small < float(blobs.norm(dim=-1).max()) <= small + 1e-5


# Recovery


@pytest.mark.parametrize(
    ("losses", "undamaged", "step"),
    [
        ([5.0, 3.0, 1.1, 1.0], [1.0, 1.0, 1.0, 1.0], 32),
        ([5.0, 3.0, 1.11, 1.0], [1.0, 1.0, 1.0, 1.0], 64),
        ([5.0, 3.0, 1.2, 1.2], [1.0, 1.0, 1.0, 1.0], None),
        ([1.0, 3.0, 3.0, 3.0], [1.0, 1.0, 1.0, 1.0], 0),
        # It is the undamaged copy of the same step that counts.
        ([4.0, 4.0, 4.0, 4.0], [1.0, 2.0, 3.0, 4.0], 64),
        ([math.nan, math.nan, math.nan, math.nan], [1.0, 1.0, 1.0, 1.0], None),
        ([2.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], 16),
        ([2.0, 0.1, 0.1, 0.1], [1.0, 0.0, 0.0, 0.0], None),
    ],
)
def test_recovery_is_the_first_step_within_a_tenth_of_the_undamaged_copy(losses, undamaged, step):
    curve = trials.LossCurve("wipe", (0, 16, 32, 64), (losses,), (undamaged,))
    assert curve.recovery_steps() == [step]


@pytest.mark.parametrize(
    ("near", "step", "cell"),
    [
        ([9.0, 2.0, 1.0, 0.5], 32, "1/1, 32"),
        # What comes back and goes again has not recovered.
        ([9.0, 0.5, 0.5, 1.1], None, "0/1"),
        ([9.0, 0.5, 1.5, 0.9], 64, "1/1, 64"),
        ([9.0, math.nan, math.nan, math.nan], None, "0/1"),
        # A damage that changed nothing does not count.
        ([0.9, 0.9, 0.9, 0.9], 0, "0/0"),
    ],
)
def test_recovery_near_a_wound_is_the_step_from_which_on_the_loss_is_within_its_bound(
    near, step, cell
):
    losses = ([1.0] * 4,)
    curve = trials.LossCurve("wipe", (0, 16, 32, 64), losses, losses, (near,))
    assert curve.recovery_steps() == [step]
    assert f"| heart | {cell} |" in report.tables([record(curve)])


def record(*found: trials.LossCurve, **changed) -> report.RuleRecord:
    values = [("eps", 1.0), ("eps", 2.0), ("particles", 1.0), ("update_prob", 0.5)]
    responses = tuple(report.Response(name, value, 8, (0.5, value)) for name, value in values)
    diverged = report.Response("eps", 4.0, 8, (0.5, math.nan))
    left_out = report.Response("particles", 2.0, 0, (), note="256 particles in all")
    fields = {"rule": "heart", "task": "morphogenesis2d", "metric": "loss", "update_prob": 0.5}
    fields |= {"curves": found, "responses": (*responses, diverged, left_out)}
    return report.RuleRecord({"a": 1}, **fields | changed)


# Where rules work


def responding(condition: str, *losses_by_value) -> report.RuleRecord:
    """A record of one condition beside the trained loss, which is 1 unless it says so."""
    responses = [report.Response(condition, value, 8, losses) for value, losses in losses_by_value]
    trained = () if condition == "eps" else (report.Response("eps", 1.0, 8, (0.5, 1.5)),)
    return record(responses=(*trained, *responses))


@pytest.mark.parametrize(
    ("condition", "losses_by_value", "text"),
    [
        # It is the mean that counts, over the trained one, where all seeds are finite.
        ("dt", [(0.5, (0.1, 3.8)), (1.0, (0.5, 1.5)), (2.0, (0.1, 4.0))], "0.5, 1"),
        ("dt", [(0.5, (0.1, math.nan)), (1.0, (0.5, 1.5)), (2.0, (0.1, 0.1))], "1, 2"),
        ("update_prob", [(0.2, (3.0, 3.0)), (0.5, (0.5, 1.5)), (1.0, (1.0, 1.0))], "0.5, 1"),
        ("noise", [(0.0, (0.5, 1.5)), (1e-3, (9.0, 9.0))], "0"),
        ("dt", [(0.5, (3.0, 3.0)), (1.0, (0.1, math.nan))], "nowhere"),
        (
            "particles",
            [(0.5, (1.0, 1.0)), (1.0, (0.5, 1.5)), (2.0, ()), (4.0, (1.0, 1.0)), (8.0, ())],
            "0.5, 1, 4 (not measured: 2, 8)",
        ),
        (
            "shape",
            [("trained", (0.5, 1.5)), ("ring", (3.0, 3.0)), ("square", (1.0, 2.0))],
            "trained, square",
        ),
        ("shape", [], ""),
        # Of losses of zero at most zero is twice as much.
        ("eps", [(1.0, (0.0, 0.0)), (2.0, (0.0, 0.1))], "1"),
    ],
)
def test_where_a_rule_works_follows_from_the_mean_loss_of_its_seeds(
    condition, losses_by_value, text
):
    assert report.where_it_works(responding(condition, *losses_by_value), condition) == text


# Measuring


@pytest.mark.parametrize("name", ["heart", slow("dots"), "digits"])
def test_damaged_worlds_go_beside_twins_with_the_same_masks(name, device):
    trial = trial_of(name, device)
    grown, trained = report.grow(trial)
    found = {course.damage: course for course in trials.healing(trial, grown)}
    static = name == "digits"
    assert set(found) == {
        trials.CONTROL,
        *(n for n, d in trials.DAMAGES.items() if d.static or not static),
    }
    undamaged = found["wipe"].undamaged
    assert undamaged == found[trials.CONTROL].undamaged == found["noise"].undamaged
    assert tuple(curve[0] for curve in undamaged) == pytest.approx(trained.losses, rel=1e-6)
    # Of a picture the loss near the wound counts, where there is one.
    near = {name for name, curve in found.items() if curve.near}
    assert near == ({"wipe", "cut", "clump"} if name == "heart" else set())
    assert all(torch.tensor(found[name].near).shape == (2, 3) for name in near)
    # At first the control is its undamaged copy; then masks are others.
    assert found[trials.CONTROL].ratios(0) == [1.0, 1.0]
    if not static:
        assert found[trials.CONTROL].losses != undamaged
        assert all(value != 1.0 for value in found["noise"].ratios(0))
    assert found["half"].undamaged == found["side"].undamaged != undamaged
    # Undamaged copies do what worlds do that run without damaged ones.
    _, losses = trial.run(grown, trial.random(1001), trial.plan.heal_steps)
    alone = trial.by_seed(losses).T
    assert torch.allclose(alone, torch.tensor(undamaged, dtype=torch.float64).to(alone), rtol=1e-5)


def test_conditions_are_grown_for_as_many_updates_and_left_out_where_too_large(device, monkeypatch):
    monkeypatch.setitem(report.MAX_PARTICLES, device.type, 300)
    trial = trial_of("heart", device)
    _, trained = report.grow(trial)
    found = list(report.responses(trial, trained))
    assert [(r.condition, r.value, r.steps) for r in found] == [
        ("eps", 1.0, 8),
        ("eps", 2.0, 8),
        ("particles", 1.0, 8),
        ("particles", 2.0, 0),
        ("update_prob", 0.25, 16),
        ("update_prob", 0.5, 8),
    ]
    assert found[0].losses == found[2].losses == found[5].losses == trained.losses
    assert found[3].losses == ()
    assert found[3].note == "512 particles in all"
    assert found[1].losses != trained.losses


def test_seeds_are_worlds_of_their_own_whatever_their_number(device):
    trial = trial_of("heart", device)
    two = trial.initial_worlds(shape="ring")
    one = RuleTrial("heart", device, TINY, range(6, 7), 128).initial_worlds(shape="ring")
    assert torch.equal(two.x[1:], one.x)
    assert not torch.equal(two.x[0], two.x[1])
    assert trial.initial_worlds(0.5).x.shape == (2, 64, 2)
    assert [trial.tasks_of(n)[0].config.target_point_count for n in (64, 128)] == [64, 128]


def test_worlds_of_another_radius_are_measured_at_their_trained_size(device):
    free, boxed = (trial_of(name, device) for name in ("heart", "dots"))
    for trial, scale in ((free, 2.0), (boxed, 1.0)):
        worlds, eps = trial.initial_worlds(), trial.task.eps
        larger = worlds._replace(x=scale * worlds.x)
        assert torch.equal(trial.losses(larger, 2.0 * eps), trial.losses(worlds, eps))


def test_seeds_of_a_rule_of_many_pictures_grow_them_in_turn(device):
    trial = RuleTrial("seven-pictures", device, TINY, range(5, 9), 128)
    names, eps = trial.rule.codes.names, trial.task.eps
    worlds = trial.initial_worlds()
    losses = trial.losses(worlds, eps)
    for k, seed in enumerate(range(5, 9)):
        assert torch.equal(worlds.s[k, :, :8], trial.rule.codes[names[seed % 7]].expand(128, 8))
        task = task_of_rule(
            "seven-pictures", trial.rule, device, particle_count=128, target=names[seed % 7]
        ).task
        assert torch.equal(losses[k], task.metric(worlds.x[k : k + 1], worlds.s[k : k + 1])[0])
    # Copies grow what their worlds grow, and a seed alone what it grows among others.
    twice = combined(torch.cat, [worlds, worlds])
    assert torch.equal(trial.losses(twice, eps), losses.repeat(2))
    one = RuleTrial("seven-pictures", device, TINY, range(8, 9), 128).initial_worlds(0.5)
    assert torch.equal(one.s, trial.initial_worlds(0.5).s[3:])
    # What takes codes away gives them back.
    curves = trials.healing(trial, report.grow(trial)[0])
    assert all(len(curve.losses) == 4 and not curve.near for curve in curves)


def test_a_world_that_diverges_stays_lost_and_leaves_the_others_as_they_are(device, monkeypatch):
    trial = trial_of("heart", device)
    grown, _ = report.grow(trial)
    _, whole = trial.run(grown, trial.random(9), (0, 4, 8))
    run = trials.RuleRunner.run

    def broken(runner, worlds, steps):
        worlds = run(runner, worlds, steps)
        if steps == 0:
            worlds = worlds._replace(s=worlds.s.clone())
            worlds.s[0, :, 0] = math.nan
        return worlds

    monkeypatch.setattr(trials.RuleRunner, "run", broken)
    _, losses = trial.run(grown, trial.random(9), (0, 4, 8))
    assert losses[:, 0].isnan().all()
    assert torch.equal(losses[:, 1], whole[:, 1])


def test_plans_are_whole_chunks_and_hold_what_was_trained():
    assert task_name("seven-pictures") == "morphogenesis2d"
    for name, path in files.shipped_rules().items():
        update_prob = trained_config(path, files.rule_metadata(path)).task.update_prob
        for plan in (PLANS[task_name(name)], quick_plan(task_name(name))):
            assert plan.heal_steps[0] == 0
            assert all(step % plan.chunk == 0 for step in (*plan.heal_steps, plan.grow_steps))
            assert set(plan.values) <= set(CONDITIONS)
            for condition, values in plan.values.items():
                as_trained = {"update_prob": update_prob, "noise": 0.0, "shape": "trained"}
                assert as_trained.get(condition, 1.0) in values
                assert condition == "shape" or list(values) == sorted(values)


# Records and the command


def test_stored_records_can_be_read_and_give_tables(tmp_path):
    results = Path(__file__).resolve().parents[2] / "benchmarks" / "results"
    records = []
    for text in (results / "robustness_h200.jsonl").read_text("utf-8").splitlines():
        (path := tmp_path / "one.json").write_text(text, "utf-8")
        records.append(report.RuleRecord(json.loads(text)["facts"], path).read())
    assert len(records) == 15
    assert all(record.done for record in records)
    text = report.tables(records)
    assert all(f"| {record.rule} | " in text for record in records)


def test_tables_say_what_was_not_measured_and_what_is_not_finite():
    course = trials.LossCurve("wipe", (0, 16), ((2.0, 1.0), (2.0, 3.0)), ((1.0, 1.0), (1.0, 1.0)))
    text = report.tables([record(course), record(rule="dots")])
    ranges = "1, 2 | 1 (not measured: 2) | 0.5 | – | – | – |"
    assert f"| heart | {ranges}\n| dots | {ranges}" in text
    for line in ("| heart | 1/2, 16 |", "| dots | – |"):
        assert line in text
    assert "| heart | 0.75 | 1 | 1.67 | nan |" in text


def test_records_come_back_as_they_were_written_and_curves_are_drawn_by_task(tmp_path):
    losses, undamaged = ((2.0, 1.0), (2.0, math.nan)), ((1.0, 1.0), (1.0, 1.0))
    curve = trials.LossCurve("wipe", (0, 16), losses, undamaged)
    records = [record(curve), record(curve, task="texture", rule="dots")]
    path = records[0].path = tmp_path / "robustness_heart.json"
    records[0].write()
    (stored,) = json.loads(path.read_text(encoding="utf-8"))["courses"]
    assert stored["recovery_steps"] == [16, None]
    found = report.RuleRecord({"a": 1}, path).read()
    assert repr((found.rows, found.curves)) == repr((records[0].rows, records[0].curves))
    assert found.about == records[0].about
    pytest.importorskip("matplotlib")
    drawn = report.pictures(records)
    assert set(drawn) == {"morphogenesis2d", "texture"}
    assert all(picture.startswith(b"\x89PNG") for picture in drawn.values())


def test_the_command_measures_writes_and_goes_on(tmp_path, capsys, monkeypatch):
    words = ["robustness", "heart", "--quick", "--no-progress", "--commit", "0"]
    words += ["--out", str(tmp_path)]
    path = tmp_path / "robustness_heart.json"
    # No time is left after the damages and three values.
    asked = iter([False] * 4)
    monkeypatch.setattr(
        "npa_envs.measure.benchmark_records.time_limit", lambda _: lambda: next(asked, True)
    )
    assert main(words) == 0
    assert capsys.readouterr().out == "1 rules are left: call again with the same options\n"
    part = json.loads(path.read_text(encoding="utf-8"))
    assert (part["done"], len(part["responses"])) == (False, 3)
    monkeypatch.undo()
    # The damages are not measured again.
    monkeypatch.setattr(report, "healing", lambda *_: pytest.fail("measured"))
    assert main(words) == 0
    first = capsys.readouterr().out
    stored = json.loads(path.read_text(encoding="utf-8"))
    assert stored["command"].startswith("npa-envs robustness heart --quick")
    assert str(tmp_path) not in stored["command"]
    # A rule that is trained again keeps its name, but not its weights.
    assert stored["facts"]["weights"] == files.rule_digest(files.load_rule("heart"))
    assert stored["facts"]["seeds"] == [1_000_000, 1_000_001]
    assert {row["condition"] for row in stored["responses"]} == set(CONDITIONS)
    assert all(math.isfinite(v) for row in stored["responses"] for v in row["losses"])
    assert (stored["courses"], stored["responses"][:3]) == (part["courses"], part["responses"])
    assert (tmp_path / "robustness.md").read_text(encoding="utf-8") in first
    monkeypatch.undo()
    # What was stopped ends as what was not.
    whole = tmp_path / "whole"
    assert main([*words[:-1], str(whole)]) == 0
    (path,) = whole.glob("*.json")
    whole = json.loads(path.read_text(encoding="utf-8"))
    assert (whole["courses"], whole["responses"]) == (stored["courses"], stored["responses"])


def test_a_rule_that_names_no_task_is_refused(tmp_path, capsys):
    files.save_rule(files.load_rule("heart"), tmp_path / "own.safetensors")
    assert main(["robustness", str(tmp_path / "own.safetensors"), "--quick"]) == 2
    assert "must name the task of its training" in capsys.readouterr().err
