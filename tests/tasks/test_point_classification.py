"""Self-classifying point clouds: task, goals that stay with their worlds, training, measures."""

import json
import sys
from dataclasses import asdict
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from support.training_runs import make_cycle
from support.worlds import seeded

from npa_envs.cli import main
from npa_envs.errors import NPAError
from npa_envs.measure.quality import (
    _chimera,
    _cut,
    _partners,
    accuracies,
    changes_of_mind,
    hidden_states,
)
from npa_envs.render.world_film import film_states, in_the_plane
from npa_envs.rule.files import load_rule, save_rule
from npa_envs.tasks.point_classification import (
    PALETTE,
    UNDECIDED,
    PointClassification,
    PointClassificationConfig,
    class_colours,
    majority,
)
from npa_envs.training import preset, train
from npa_envs.training.task_of_rule import has_data, task_of_rule
from npa_envs.world.particles import Particles
from npa_envs.world.rollout import rollout

SMALL = {"class_count": 3, "particle_count": 24, "state_dim": 6, "hidden_dim": 8, "eps": 0.3}


def task_of(folder, device="cpu", **fields):
    config = PointClassificationConfig(data=str(folder), **SMALL, **fields)
    return PointClassification(config, device=device)


@pytest.fixture
def task(folder, device):
    return task_of(folder, device, readout_hidden_dim=5)


def small_config(folder, out, **fields):
    return preset("tiny", "point_classification", data=str(folder), out=out, **(SMALL | fields))


def assert_goals_fit(x, goals, clouds):
    """Each world is a cloud, and of no other class."""
    for cloud, goal in zip(x, goals, strict=True):
        same = (clouds.x == cloud).flatten(1).all(1)
        assert set(clouds.label[same].tolist()) == {int(goal)}


def test_pictures_have_room_around_the_ink():
    task = PointClassification(PointClassificationConfig(particle_count=64, resolution=32))
    x, s, *_ = task.seed(32, generator=seeded())
    assert float(x.amax()) > 0.99
    density = task.picture(x, s)[..., 3]
    inner = density[:, 1:-1, 1:-1]
    edges = torch.nn.functional.pad(torch.zeros_like(inner), (1, 1, 1, 1), value=1.0) * density
    assert float(edges.amax()) < 0.4 < float(inner.amax())


def test_worlds_are_clouds_of_their_class_with_blank_states(task, device):
    x, s, *_, goal = task.seed(50, generator=seeded(1, device), device=device)
    assert s.shape == (50, 24, 6)
    assert not s.any()
    assert_goals_fit(x, goal, task.clouds)
    assert set(goal.tolist()) == {0, 1, 2}


def test_test_clouds_are_others_and_never_varied(folder):
    task = task_of(folder, rotation=90.0, jitter=0.1)
    for part, count in ((task, 36), (task.held_out(), 18)):
        assert len(part.clouds.label) == count
        x, *_ = part.seed(5, generator=seeded())
        is_cloud = [bool((part.clouds.x == cloud).flatten(1).all(1).any()) for cloud in x]
        assert is_cloud == [part is not task] * 5


def test_loss_is_the_error_to_the_class_and_the_overflow(task, device):
    rule = task.make_rule(seeded()).to(device).double()
    goal = torch.tensor([2, 0], device=device)
    aimed = task.for_rule(rule).with_goal(goal)
    s = 2.0 * torch.randn(2, 24, 6, dtype=torch.float64, device=device)
    x = torch.rand(2, 24, 2, dtype=torch.float64, device=device)
    total, parts = aimed.loss(Particles(x, s, x[..., 0]))
    wanted = torch.nn.functional.one_hot(goal, 3)[:, None]
    outputs = rule.readout(s)
    error = (outputs - wanted).square().mean()
    overflow = torch.relu(s.abs() - 1.0).mean()
    # Worst error measured: 1e-16.
    torch.testing.assert_close(parts["error"], error, rtol=1e-12, atol=0)
    torch.testing.assert_close(parts["overflow"], overflow, rtol=1e-12, atol=0)
    torch.testing.assert_close(total, error + overflow, rtol=1e-12, atol=0)
    right = (outputs.argmax(-1) == goal[:, None]).double().mean()
    assert parts["accuracy"].item() == pytest.approx(right.item())
    torch.testing.assert_close(aimed.metric(x, s).mean(), error, rtol=1e-6, atol=0)
    # The goals are read when they are asked for.
    goal.copy_(torch.tensor([1, 1]))
    assert aimed.loss(Particles(x, s, x[..., 0]))[1]["error"] != error


def test_without_read_out_the_last_channels_are_the_classes(task, device):
    s = torch.zeros(1, 24, 6, device=device)
    s[..., 4] = 1.0
    goals = [torch.tensor([k], device=device) for k in range(3)]
    errors = [task.with_goal(goal).metric(s, s).item() for goal in goals]
    assert errors == pytest.approx([2 / 3, 0.0, 2 / 3])
    with pytest.raises(NPAError, match="goals must be given first"):
        task.metric(s, s)
    with pytest.raises(NPAError, match="at least as many outputs as there are classes, 3, got 2"):
        task.outputs(s[..., :2])


def test_majority_counts_votes_and_colours_are_of_the_class():
    votes = torch.tensor([[0, 1, 1, 2], [0, 0, 2, 2], [2, 2, 0, 0]])
    outputs = torch.nn.functional.one_hot(votes, 3).float()
    # Ties are broken by certainty.
    outputs[0, 0, 0] = 50.0
    outputs[1, 3, 2] = outputs[2, 2, 0] = 1.5
    assert majority(outputs).tolist() == [1, 2, 0]
    outputs = torch.tensor([[[0.0, 1.0, 0.2], [0.0, 0.0, 0.0], [0.1, 0.2, 0.5]]])
    half = [(a + b) / 2 for a, b in zip(PALETTE[2], UNDECIDED, strict=True)]
    torch.testing.assert_close(
        class_colours(outputs)[0], torch.tensor([PALETTE[1], UNDECIDED, half])
    )


def cycle_of(folder, tmp_path, **fields):
    config = small_config(folder, tmp_path, **{"steps": (2, 4), "pool_size": 10, **fields})
    return make_cycle(config, PointClassification(config.task))


@pytest.mark.parametrize("mutated_share", [0.0, 0.6])
@pytest.mark.parametrize("runaway_limit", [10.0, 1e-6])
def test_classes_stay_with_their_worlds(
    folder, tmp_path, monkeypatch, mutated_share, runaway_limit
):
    monkeypatch.setattr("npa_envs.training.cycle.LARGEST_VALUE", runaway_limit)
    cycle, _ = cycle_of(folder, tmp_path, mutated_share=mutated_share, world_count=6)
    before = cycle.pool.worlds.x.clone()
    for iteration in range(5):
        cycle.run(iteration)
        assert_goals_fit(cycle.pool.worlds.x, cycle.pool.worlds.goal, cycle.task.clouds)
        assert torch.equal(cycle.batch.end.x, cycle.batch.start.x)
    assert not torch.equal(cycle.pool.worlds.x, before)


@pytest.mark.parametrize(("fraction", "count"), [(0.0, 1), (0.5, 3), (1.0, 6)])
def test_so_many_worlds_of_a_batch_are_fresh_clouds(folder, tmp_path, fraction, count):
    cycle, _ = cycle_of(folder, tmp_path, fresh_share=fraction, world_count=6, damage_share=0.0)
    cycle.pool.worlds.s.add_(0.5)
    cycle.run(0)
    blank = (cycle.batch.start.s == 0.0).flatten(1).all(1)
    assert blank.tolist() == [True] * count + [False] * (6 - count)


def test_mutated_worlds_keep_their_states(folder):
    task = task_of(folder, mutated_share=0.5)
    x, s, *_, goal = task.seed(200, generator=seeded(1))
    s = s + torch.arange(200.0)[:, None, None]
    new_x, new_s, _, new_goal = task.damage(Particles(x, s, goal=goal), seeded(2))
    assert torch.equal(new_s, s)
    moved = (new_x != x).flatten(1).any(1)
    # Half of 200, less one in 36 that becomes what it was: 97 ± 7.
    assert 65 < int(moved.sum()) < 130
    assert torch.equal(new_goal[~moved], goal[~moved])
    assert_goals_fit(new_x, new_goal, task.clouds)


def test_a_quarter_on_one_side_is_moved_out_of_sight_of_the_rest(folder, device):
    task = task_of(folder, device, cut_share=0.5)
    worlds = task.seed(200, generator=seeded(1, device), device=device)
    cut = task.damage(worlds, seeded(2, device))
    assert torch.equal(cut.goal, worlds.goal)
    assert torch.equal(cut.s, worlds.s)
    away = torch.linalg.vector_norm(cut.x - worlds.x, dim=-1)
    moved = away > 0.0
    hit = moved.any(1)
    # Half of 200: 100 ± 7.
    assert 65 < int(hit.sum()) < 135
    assert (moved.sum(1)[hit] == 6).all()
    torch.testing.assert_close(away[moved], torch.full_like(away[moved], 2.0 * task.eps))
    apart = torch.cdist(cut.x, cut.x)[moved[:, :, None] & ~moved[:, None] & hit[:, None, None]]
    assert float(apart.min()) > task.eps


def test_accuracies_are_those_of_a_rollout(folder, device):
    task = task_of(folder, device, readout_hidden_dim=5, update_prob=1.0).held_out()
    rule = task.make_rule(seeded(3))
    with torch.no_grad():
        for parameter in rule.parameters():
            parameter.mul_(10.0)
    rows = accuracies(rule, task, checkpoints=(1, 4))
    x, label = task.clouds.x, task.clouds.label
    s = x.new_zeros(18, 24, 6)
    rule = rule.to(x.device)
    for steps, row in zip((1, 3), rows, strict=True):
        _, s = rollout(rule, x, s, steps, eps=task.eps, update_prob=1.0)
        says = rule.readout(s).argmax(-1)
        most = says.mode(dim=1).values
        assert row.particle == pytest.approx((says == label[:, None]).double().mean().item())
        assert row.majority == pytest.approx((most == label).double().mean().item())
        assert row.agreement == pytest.approx((says == most[:, None]).double().mean().item())
        error = rule.readout(s) - torch.nn.functional.one_hot(label, 3)[:, None]
        assert row.loss == pytest.approx(error.square().mean().item(), rel=1e-5)
    assert rows[1].step == 4


def test_clouds_are_cut_and_mutated_as_told():
    label = torch.tensor([2, 0, 1, 0, 2, 1, 0])
    partner = _partners(label)
    assert sorted(partner.tolist()) == list(range(7))
    assert (label[partner] != label).all()
    with pytest.raises(NPAError, match="more than half of the clouds, got 3 of 4"):
        _partners(torch.tensor([1, 1, 0, 1]))
    x, other = torch.rand(5, 8, 2), torch.rand(5, 8, 2)
    s = x.sum(-1, keepdim=True)
    cut_x, cut_s = _cut(x, s, seeded())
    assert cut_x.shape == (5, 6, 2)
    torch.testing.assert_close(cut_x.sum(-1, keepdim=True), cut_s)
    new_x, new_s = _chimera(x, s, other)
    assert torch.equal(new_x[:, :4, 1], x[..., 1].sort(1).values[:, :4])
    assert torch.equal(new_x[:, 4:, 1], other[..., 1].sort(1).values[:, 4:])
    torch.testing.assert_close(new_x[:, :4].sum(-1, keepdim=True), new_s[:, :4])
    assert torch.equal(new_s.sort(1).values, s.sort(1).values)


def trained(folder, out, iterations):
    """Train a rule to tell three shapes; return the run's folder."""
    fields = {"particle_count": 32, "hidden_dim": 32, "readout_hidden_dim": 16, "world_count": 16}
    fields |= {"milestones": (200,), "steps": (5, 9), "picture_interval": 0}
    fields |= {"rotation": 10.0, "jitter": 0.005, "mutated_share": 0.3, "iterations": iterations}
    return train(small_config(folder, out, **fields), "point_classification", progress=False).folder


@pytest.mark.slow
def test_particles_learn_to_say_what_they_form(folder, tmp_path):
    run = trained(folder, tmp_path, 250)
    rule = load_rule(run / "rule.safetensors")
    config = json.loads((run / "config.json").read_text(encoding="utf-8"))
    task = PointClassification(PointClassificationConfig(**config["task"])).held_out()
    (row,) = accuracies(rule, task, checkpoints=(16,))
    assert row.majority >= 0.9
    assert row.particle >= 0.85
    changes = {(row.change, row.steps): row for row in changes_of_mind(rule, task, steps=(0, 16))}
    assert changes["all mutated", 0].majority_before >= 0.9
    assert changes["all mutated", 16].majority >= 0.7
    assert changes["all mutated", 16].majority > changes["upper half mutated", 16].majority
    with pytest.raises(NPAError, match=r"steps must be .* at least 0, .* got \(0, 32, 16\)"):
        changes_of_mind(rule, task, steps=(0, 32, 16))


def test_the_commands_measure_and_film_a_rule_that_classifies(folder, tmp_path, capsys):
    rule = str(trained(folder, tmp_path / "run", 2) / "rule.safetensors")
    figures = tmp_path / "figures.json"
    options = ["--checkpoints", "4", "8", "--json", str(figures), "--no-progress"]
    assert main(["evaluate", rule, *options]) == 0
    text = capsys.readouterr().out
    assert "18 test clouds, loss: mean squared error to the class" in text
    assert "all mutated" in text
    written = json.loads(figures.read_text(encoding="utf-8"))
    assert [row["step"] for row in written["accuracy"]] == [4, 8]
    changes = {row["change"] for row in written["changes"]}
    assert changes == {"25% cut off", "upper half mutated", "all mutated"}
    folder = tmp_path / "film"
    assert main(["rollout", rule, "--steps", "8", "--out", str(folder), "--no-progress"]) == 0
    text = capsys.readouterr().out
    assert "most particles say" in text
    assert (folder / "growth.gif").is_file()


def test_a_static_rule_of_no_known_task_is_refused(task, tmp_path, capsys):
    path = tmp_path / "rule.safetensors"
    save_rule(task.make_rule(seeded()), path)
    assert main(["evaluate", str(path), "--no-progress"]) != 0
    message = "runs moving rules in the 2D worlds of morphogenesis2d, got space_dim=2, static=True"
    assert message in capsys.readouterr().err


def test_a_rule_without_its_data_runs_on_built_in_digits_and_is_not_measured(
    folder, tmp_path, capsys
):
    pytest.importorskip("sklearn")
    config = PointClassificationConfig(data="mnist", **SMALL | {"class_count": 10})
    rule, path = PointClassification(config).make_rule(seeded()), tmp_path / "rule.safetensors"
    stored = {"task": "point_classification", "config": json.dumps({"task": asdict(config)})}
    save_rule(rule, path, metadata=stored)
    assert not has_data(str(path))
    assert has_data("digits")
    assert has_data("gecko")
    device = torch.device("cpu")
    trained = task_of_rule(str(path), rule, device)
    assert trained.task.config.data == "digits"
    assert trained.task.split == "test"
    assert "MNIST is not in the folder 'data'" in trained.why_not_measurable
    assert main(["evaluate", str(path), "--no-progress"]) == 2
    assert "or name its folder: give --data\n" in capsys.readouterr().err
    with pytest.raises(NPAError, match="data must be a known data set or a folder"):
        task_of_rule(str(path), rule, device, data="nowhere")
    chosen = task_of_rule(str(path), rule, device, data=str(folder))
    assert chosen.why_not_measurable is None
    assert len(chosen.task.clouds.label) == 18


# Pictures of hidden states.


def test_hidden_states_are_those_of_a_rollout(folder):
    task = task_of(folder, readout_hidden_dim=5, update_prob=1.0).held_out()
    rule = task.make_rule(seeded(3))
    states, label = hidden_states(rule, task, steps=(1, 4), cloud_count=2, particle_count=4)
    assert label.tolist() == [0] * 8 + [1] * 8 + [2] * 8
    chosen = [torch.nonzero(task.clouds.label == kind)[:2, 0] for kind in range(3)]
    x = task.clouds.x[torch.cat(chosen)]
    s = x.new_zeros(6, 24, 6)
    for steps, now in zip((1, 3), states, strict=True):
        _, s = rollout(rule, x, s, steps, eps=task.eps, update_prob=1.0)
        torch.testing.assert_close(now, s[:, ::6].flatten(0, 1))


GROUPS = torch.arange(3).repeat_interleave(20)


def two_steps():
    """Return states of three groups, first all alike, then far from each other."""
    noise = 0.01 * torch.randn(2, 60, 5, generator=seeded())
    return noise + torch.stack((torch.zeros(60, 5), torch.eye(5)[GROUPS]))


@pytest.mark.parametrize("method", ["t-SNE", "components"])
def test_states_of_a_group_are_neighbours_in_the_plane(method, monkeypatch):
    monkeypatch.setitem(sys.modules, "umap", None)
    if method == "t-SNE":
        pytest.importorskip("sklearn")
    else:
        monkeypatch.setitem(sys.modules, "sklearn.manifold", None)
    place = in_the_plane(two_steps()[1])
    away = torch.cdist(place, place) + 1e9 * torch.eye(60)
    assert torch.equal(GROUPS[away.argmin(1)], GROUPS)
    assert torch.equal(place, in_the_plane(two_steps()[1]))


def test_umap_is_taken_where_it_is_installed_and_films_show_classes_draw_together(monkeypatch):
    made = []

    class UMAP:
        """Takes two coordinates."""

        def __init__(self, **options):
            made.append(options)

        def fit_transform(self, values):
            return values[:, :2]

    monkeypatch.setitem(sys.modules, "umap", SimpleNamespace(UMAP=UMAP))
    states = two_steps()
    frames, strip = film_states(states, GROUPS, (2, 9), between=3)
    assert made == [{"n_jobs": 1, "random_state": 0}]
    assert len(frames) == 5
    assert np.array_equal(strip, [frames[0], frames[4]])
    inked = [(frame.min(axis=2) < 200).nonzero() for frame in strip]
    # Below the text the dots are at one place, then in two corners.
    before, after = (np.ptp(columns[rows > 48]) for rows, columns in inked)
    assert before < 80 < 160 < after
    # The last frame has names where the dots are.
    pure, mixed = (np.abs(frames[k] - np.array([230.0, 26.0, 74.0])).max(2).min() for k in (3, 0))
    assert pure < 30 < 60 < mixed
