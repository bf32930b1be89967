"""What rules do to each other, in numbers that can be checked."""

import dataclasses
import functools
import json
import math

import pytest
import torch
from PIL import Image, ImageDraw

from npa_envs.cli import main
from npa_envs.errors import NPAError
from npa_envs.measure import rule_interaction as interaction
from npa_envs.rule.files import save_rule
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.morphogenesis2d import Morphogenesis2D, Morphogenesis2DConfig
from npa_envs.world.randomness import WorldRandom

COUNT = 40
SMALL = {"state_dim": 4, "eps": 0.15, "resolution": 24}


@functools.cache
def task_of(count):
    config = {"particle_count": count, "target_point_count": count, **SMALL}
    return Morphogenesis2D(Morphogenesis2DConfig(target="ring", **config))


def make_rule(seed=0, scale=0.3, eps0=0.15):
    rule = NPARule(2, 4, 16, eps0=eps0).requires_grad_(False)
    generator = torch.Generator().manual_seed(seed)
    for parameter in rule.parameters():
        parameter.uniform_(-scale, scale, generator=generator)
    return rule


def named(name="a", **options):
    return interaction.RuleUnderTest(name, make_rule(**options), task_of(COUNT))


def settings(**options):
    usual = {"particle_count": COUNT, "distances": (0.0,), "steps": 12, "seed_count": 3}
    return interaction.InteractionSettings(**usual | options)


def meeting(first, second, progress=lambda _: None, **options):
    """The rows and pictures of two rules in one world."""
    encounters = interaction.Encounters([first, second], settings(**options), progress)
    return encounters.meet(first, second)


@pytest.mark.parametrize(
    ("change", "mixing", "margin", "expected"),
    [
        (0.79, 0.0, 0.2, "cooperates"),
        (0.81, 0.0, 0.2, "undisturbed"),
        (0.81, 0.0, 0.1, "cooperates"),
        (1.19, interaction.MIXED - 1e-9, 0.2, "undisturbed"),
        (1.19, 0.0, 0.1, "disrupted"),
        (1.21, interaction.MIXED, 0.2, "disrupted, mixes"),
        (0.5, 1.0, 0.2, "cooperates, mixes"),
        (math.inf, 0.0, 0.2, "disrupted"),
        (math.nan, 0.0, 0.2, "disrupted"),
    ],
)
def test_a_verdict_follows_from_the_change_and_the_mixing(change, mixing, margin, expected):
    assert interaction.verdict(change, mixing, margin) == expected


def test_the_mixing_index_of_known_worlds():
    pair = torch.zeros(1, 2, 2)
    assert interaction.mixing_index(pair, [1, 1], eps=0.1).item() == pytest.approx(1.0)
    apart = torch.tensor([[[0.0, 0.0], [5.0, 0.0]]])
    assert interaction.mixing_index(apart, [1, 1], eps=0.1).item() == 0.0
    # Three of one species and one of another at one place: the entropy of 3/4 and 1/4.
    heap = torch.zeros(1, 4, 2)
    entropy = -(0.75 * math.log(0.75) + 0.25 * math.log(0.25)) / math.log(2.0)
    assert interaction.mixing_index(heap, [3, 1], eps=0.1).item() == pytest.approx(
        entropy, rel=1e-6
    )


def test_a_rule_within_reach_is_measured_by_its_own_particles():
    rows, _ = meeting(named(), named("b", seed=1), distances=(0.0, 0.3))
    assert len({row.alone for row in rows}) == 1
    assert rows[0].mixing > 0.3 > rows[1].mixing > 0.0
    for row in rows:
        assert row.together != row.alone
        assert row.change == pytest.approx(row.together / row.alone, rel=1e-12)
        assert row.displacement > 1e-3
        assert row.verdict == interaction.verdict(row.change, row.mixing, 0.2)


def test_still_rules_leave_their_seeds_and_the_metric_is_the_tasks():
    still = [named(name, scale=0.0) for name in "ab"]
    ((row,), _) = meeting(*still, distances=(0.2,))
    assert (row.change, row.displacement) == (1.0, 0.0)
    task = task_of(COUNT // 2)
    x, s, *_ = task.seed(3, generator=WorldRandom([1_000_000, 1_000_001, 1_000_002]))
    assert row.alone == pytest.approx(task.metric(x, s).mean().item(), rel=1e-6)
    # A rule beside itself has seeds of its own: else every particle would see both alike.
    rows, _ = meeting(still[0], still[0], ratios=(0.5, 0.001, 0.999))
    assert 0.5 < rows[0].mixing < 0.99
    # A small fraction leaves one particle.
    assert 0.0 < rows[1].mixing < 0.3 > rows[2].mixing > 0.0


def test_pictures_are_taken_along_the_way_and_steps_are_counted():
    done = []
    _, frames = meeting(named(), named("b", seed=1), done.append, steps=40, distances=(0.0, 1.0))
    # What is grown alone is grown once.
    assert sum(done) == 40 + 2 * 40
    steps = [round(40 * time) for time in interaction.FRAME_TIMES]
    assert list(frames) == [f"d {d}, r 0.5, step {step}" for d in (0, 1) for step in steps]
    # Two disks side by side, one at first.
    narrow, wide = ((frames[f"d {d}, r 0.5, step 0"] < 250).any(axis=(0, 2)).sum() for d in (0, 1))
    assert wide > narrow


def test_a_world_that_blows_up_is_disrupted_and_the_study_goes_on():
    bomb = named("b", seed=1)
    bomb.rule.output.weight.mul_(1e38)
    rows, _ = meeting(named(), bomb)
    assert rows[0].together == math.inf
    assert rows[0].verdict.startswith("disrupted")
    assert math.isfinite(rows[0].alone)


def test_the_interval_of_a_ratio_is_that_of_its_worlds():
    ones = torch.ones(4)
    assert interaction.ratio_interval(2.0 * ones, ones) == (2.0, 2.0)
    # Both numbers of a world are drawn together.
    assert interaction.ratio_interval(torch.arange(1.0, 5.0), torch.arange(1.0, 5.0)) == (
        1.0,
        1.0,
    )
    above = torch.randn(200, generator=torch.Generator().manual_seed(0)) + 3.0
    low, high = interaction.ratio_interval(above, torch.ones(200))
    half = 1.96 * above.std().item() / math.sqrt(200)
    assert low == pytest.approx(above.mean().item() - half, abs=0.2 * half)
    assert high == pytest.approx(above.mean().item() + half, abs=0.2 * half)
    low, high = interaction.ratio_interval(torch.tensor([1.0, 1.0, 1.0, math.inf]), ones)
    assert (low, high) == (1.0, math.inf)
    assert interaction.ratio_interval(ones, torch.zeros(4)) == (math.inf, math.inf)


def test_a_larger_radius_mixes_more_and_figures_lie_in_their_intervals():
    slow = named(scale=0.02), named("b", seed=1, scale=0.02)
    (usual, wide), _ = meeting(*slow, eps_factors=(1.0, 2.0), distances=(0.2,))
    assert (usual.eps_factor, wide.eps_factor) == (1.0, 2.0)
    assert wide.alone != usual.alone
    assert wide.mixing > usual.mixing
    assert usual.mixing_low <= usual.mixing <= usual.mixing_high
    assert usual.change_low <= usual.change <= usual.change_high


def test_a_heat_map_is_drawn_of_rows_with_gaps_and_infinities():
    pytest.importorskip("matplotlib")
    row = interaction.InteractionRow("a", "b", 0.0, 0.5, 0.1, 0.2, 2.0, 0.1, 0.0, "disrupted")
    infinite = dataclasses.replace(row, rule="b", beside="a", change=math.inf)
    rows = [row, infinite, dataclasses.replace(row, distance=1.0, eps_factor=2.0)]
    assert interaction.interaction_map(rows).startswith(b"\x89PNG")


def test_rules_that_cannot_share_a_world_are_named():
    with pytest.raises(NPAError, match=r"a and b cannot share a world: .*eps0, got 0\.15 .* 0\.2"):
        interaction.Encounters([named(), named("b", eps0=0.2)], settings())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"particle_count": 1}, "particle_count must be a whole number of at least 2, got 1"),
        ({"steps": 0}, "steps must be a whole number of at least 1, got 0"),
        ({"distances": (-1.0,)}, r"finite and not negative, one or more, got \(-1\.0,\)"),
        ({"ratios": (0.5, 1.0)}, r"ratios and margin must lie in \(0, 1\), got \(0\.5, 1\.0\)"),
        ({"eps_factors": (math.inf,)}, "eps_factors must be finite and .*inf"),
        ({"margin": 0.0}, r"ratios and margin must lie in \(0, 1\)"),
        ({"distances": ()}, "one or more"),
    ],
)
def test_wrong_settings_are_clear_errors(options, message):
    with pytest.raises(NPAError, match=message):
        settings(**options)


# The command


def save(folder, **seeds):
    """Write rules that grow the picture in the folder."""
    config = {"target": str(folder / "disk.png"), "particle_count": COUNT, "hidden_dim": 16}
    metadata = {"task": "morphogenesis2d", "config": json.dumps(config | SMALL)}
    for name, seed in seeds.items():
        save_rule(make_rule(seed), folder / f"{name}.safetensors", metadata=metadata)


@pytest.fixture
def rules(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rules")
    picture = Image.new("RGBA", (16, 16))
    ImageDraw.Draw(picture).ellipse((3, 3, 12, 12), fill="#30a050")
    picture.save(folder / "disk.png")
    save(folder, one=0, two=1)
    return folder


def words_of(rules, out, *more):
    paths = [str(rules / f"{name}.safetensors") for name in ("one", "two")]
    return ["rule-interaction", *paths, "--out", str(out), "--no-progress", *more]


def record_in(folder):
    return json.loads((folder / "interactions.json").read_text(encoding="utf-8"))


def test_mistakes_are_refused_and_nothing_is_written(rules, tmp_path, capsys):
    out, unknown = tmp_path / "out", tmp_path / "unknown.safetensors"
    save_rule(make_rule(), unknown)
    one = str(rules / "one.safetensors")
    for words, message in (
        (
            ["rule-interaction", one, "--no-itself", "--out", str(out)],
            "more without itself, got one",
        ),
        (
            ["rule-interaction", str(unknown), "--out", str(out)],
            "does not say what it grows: leave it",
        ),
    ):
        assert main(words) == 2
        assert message in capsys.readouterr().err
        assert not out.exists()


def test_every_pair_is_measured_and_a_stopped_run_ends_as_one_that_was_not(
    rules, tmp_path, capsys, monkeypatch
):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    few = ["--seed-count", "2", "--steps", "6", "--distances", "0", "2"]
    assert main(words_of(rules, whole, *few)) == 0
    pairs = [(a, b) for a in ("one", "two") for b in ("one", "two")]
    rows = record_in(whole)["rows"]
    assert [(row["rule"], row["beside"]) for row in rows[::2]] == pairs
    assert record_in(whole)["settings"]["particle_count"] == COUNT
    for a, b in pairs:
        with Image.open(whole / f"{a}+{b}.png") as strip:
            assert strip.width > strip.height
    assert "undisturbed" in capsys.readouterr().out
    meet, met = interaction.Encounters.meet, []

    def stopped(self, first, second):
        met.append((first.name, second.name))
        if len(met) == 3:
            raise KeyboardInterrupt
        return meet(self, first, second)

    monkeypatch.setattr(interaction.Encounters, "meet", stopped)
    assert main(words_of(rules, parts, *few)) == 130
    assert len(record_in(parts)["rows"]) == 4
    capsys.readouterr()
    assert main(words_of(rules, parts, *few)) == 0
    assert "2 of 4 pairs were measured before" in capsys.readouterr().out
    assert met[3:] == pairs[2:]
    assert record_in(whole) == record_in(parts)
    # Results of other settings are not mixed with these.
    assert main(words_of(rules, parts, *few, "--margin", "0.9")) == 2
    error = capsys.readouterr().err
    assert "margin was 0.2, now 0.9: remove it, or choose another folder with" in error
    save(rules, two=5)
    assert main(words_of(rules, parts, *few)) == 2
    assert "has results of other settings: rules was" in capsys.readouterr().err
