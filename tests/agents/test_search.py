"""The search for rules that differ: metrics of candidates, and what a search leaves."""

import json
import sys

import numpy as np
import pytest
import torch
from support.refusals import refused

from npa_envs import load_rule, rollout
from npa_envs.agents.search import Search, SearchWorld, tried_again
from npa_envs.agents.search.candidate_evaluation import (
    SEED_RADIUS,
    UPDATE_PROB,
    Candidates,
    quality_of,
)
from npa_envs.agents.search.quality_diversity import EMITTERS, RESULTS, import_ribs
from npa_envs.cli import main
from npa_envs.errors import MissingDependencyError
from npa_envs.rule.files import rule_metadata, save_rule
from npa_envs.tasks.seeds import uniform_ball
from npa_envs.training.task_of_rule import task_of_rule
from npa_envs.world.particles import Particles
from npa_envs.world.randomness import WorldRandom

CPU = torch.device("cpu")
SMALL = {"particle_count": 16, "steps": 16, "hidden_dim": 4}
OPTIONS = ["--particle-count", "16", "--steps", "16", "--hidden-dim", "4", "--batch-size", "4"]
BATCH_COST = 4 * 16 * 16


def candidates(device=CPU, **options):
    return Candidates(SearchWorld(**SMALL | options), device=device)


def solutions(tried, count, size=0.2, seed=0):
    return size * np.random.default_rng(seed).standard_normal((count, tried.weight_count))


def search(**options):
    world = SearchWorld(**SMALL | options.pop("world", {}))
    return Search(world, batch_size=4, device=CPU, **options)


# Worlds


def test_a_candidate_comes_to_the_same_alone_and_among_others_and_as_its_rule(device):
    tried = candidates(device)
    given = solutions(tried, 3)
    together = tried.try_all(given)
    for number, one in enumerate(given):
        random = WorldRandom([0], device=device)
        x = uniform_ball(1, 16, 2, SEED_RADIUS, generator=random, device=device)
        s, rule = x.new_zeros(1, 16, 4), tried.rule_of(one).to(device)
        x, s = rollout(rule, x, s, 16, update_prob=UPDATE_PROB, generator=random)
        torch.testing.assert_close(together.worlds.x[number], x, atol=1e-4, rtol=0.0)
        torch.testing.assert_close(together.worlds.s[number], s, atol=1e-4, rtol=1e-3)
        (alone,), among = tried.try_all(one[None]).found, together.found[number]
        # But for rounding: some processors add up products of other sizes in another order.
        assert alone.quality == pytest.approx(among.quality, abs=1e-6)
        assert alone.measures == pytest.approx(among.measures, abs=1e-6)


def test_dead_and_exploding_rules_are_nothing_and_descriptors_lie_within_their_axes():
    tried = candidates()
    dead, wild = np.zeros(tried.weight_count), np.full(tried.weight_count, 1e12)
    first, second, *others = tried.try_all(
        np.stack((dead, wild, *solutions(tried, 8, size=0.5)))
    ).found
    assert first is second is None
    assert others[0] is not None
    for found in filter(None, others):
        assert 0.0 < found.quality <= 1.0
        # A step's probability is met on average only.
        slack = (0.1, 0.0, 0.0)
        for axis, value, more in zip(tried.world.axes(), found.measures, slack, strict=True):
            assert axis.lowest <= value <= axis.highest + more


def test_crowding_is_one_in_one_place_and_zero_alone():
    tried = candidates()
    s = torch.zeros(1, 16, 4)
    together, _ = tried.crowding_and_mixing(Particles(torch.zeros(1, 16, 2), s))
    apart, _ = tried.crowding_and_mixing(Particles(torch.arange(32.0).view(1, 16, 2), s))
    assert (together, apart) == (pytest.approx(1.0, abs=1e-5), pytest.approx(0.0, abs=1e-5))


def test_quality_is_change_of_colour_less_excess():
    x = torch.zeros(2, 1, 5, 2)
    flicker = torch.zeros(2, 1, 5, 4)
    flicker[0] = -0.5
    flicker[1] = 0.5
    assert float(quality_of(Particles(x, flicker))) == pytest.approx(1.0)
    assert float(quality_of(Particles(x, torch.zeros_like(flicker)))) == 0.0
    # Half of the coordinates are 2 beyond the bounds.
    x[..., 0] = 3.0
    assert float(quality_of(Particles(x, flicker))) == pytest.approx(0.5)


# Searches. pyribs takes seconds to import, so that but one test of it runs with the fast ones.


def test_a_missing_library_is_named_with_its_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "cma", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'npa-envs\[search\]'"):
        import_ribs()


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("method", EMITTERS)
def test_a_stopped_search_goes_on_as_if_it_had_not_been(method, tmp_path):
    # Many weights, whose steps cma adapts otherwise by default.
    options = {"method": method, "seed": 3, "world": {"hidden_dim": 16}}
    whole, path = search(**options), tmp_path / RESULTS
    whole.run(4 * BATCH_COST)
    search(**options, path=path).run(2 * BATCH_COST)
    again = search(**options, path=path)
    assert again.evaluations == 8
    again.run(4 * BATCH_COST + 1)
    assert again.evaluations == 16
    assert again.growth == whole.growth
    for ours, theirs in zip(again.elites(), whole.elites(), strict=True):
        assert ours.cell == theirs.cell
        assert np.array_equal(ours.solution, theirs.solution)
    refused("results of other settings: seed was 3", search, **options | {"seed": 1}, path=path)
    content = json.loads(path.read_text(encoding="utf-8"))
    content["batches"][1]["fingerprint"] += 1
    path.write_text(json.dumps(content), encoding="utf-8")
    refused("batch 1 differs", search, **options, path=path)
    same, found = tried_again(whole, [0]), whole.growth[-1]
    assert same.qd_score == pytest.approx(found.qd_score)
    assert same.coverage == found.coverage
    assert tried_again(whole, [1]).qd_score != pytest.approx(found.qd_score)


def test_the_command_leaves_elites_that_other_commands_open(tmp_path, capsys):
    out = tmp_path / "found"
    words = ["search", *OPTIONS, "--no-progress", "--out", str(out), "--budget"]
    assert main([*words, str(2 * BATCH_COST)]) == 0
    assert main([*words, str(3 * BATCH_COST)]) == 0
    printed = capsys.readouterr().out
    assert "8 candidates were tried before\n12 candidates, " in printed
    files = sorted((out / "elites").glob("*.safetensors"))
    metadata = json.loads(rule_metadata(files[0])["found"])
    assert sorted(metadata) == ["crowding", "mixing", "quality", "speed"]
    page = (out / "atlas.html").read_text(encoding="utf-8")
    assert page.count("<img") == len(files)
    assert f'href="elites/{files[0].name}"' in page
    assert (out / "atlas.png").read_bytes().startswith(b"\x89PNG")
    rule = load_rule(files[0])
    trained = task_of_rule(str(files[0]), rule, CPU)
    assert trained.why_not_measurable == "its file does not say what it grows"
    assert trained.task.config.particle_count == 16
    assert main([*words, "10"]) == 2
    assert "budget must be finite and at least that of one batch" in capsys.readouterr().err


def test_a_damaged_world_of_a_rule_is_an_error(tmp_path):
    path = tmp_path / "odd.safetensors"
    rule = SearchWorld(**SMALL).make_rule()
    for metadata, words in (("[1]", "must be a JSON object, got"), ('{"sides": 3}', "sides")):
        save_rule(rule, path, metadata={"world": metadata})
        refused(words, task_of_rule, str(path), rule, CPU)
