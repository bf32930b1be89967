"""Configurations: checks, overrides, files, presets."""

import dataclasses
import itertools
import json
import math
from pathlib import Path

import pytest
import torch
from support.refusals import refused

from npa_envs.errors import NPAError
from npa_envs.rule.files import load_rule
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.morphogenesis2d import Morphogenesis2DConfig
from npa_envs.training import (
    TASKS,
    TrainConfig,
    config_to_dict,
    load_config,
    override,
    preset,
    task_entry,
)
from npa_envs.training.trainer import initial_rule

PAPER = preset("paper")
PAIR = preset("tiny", "co_morphogenesis2d")


def test_paper_preset_is_the_designs_table():
    task = {"particle_count": 4096, "state_dim": 16, "hidden_dim": 128, "resolution": 256}
    task |= {"eps": 0.1, "alpha": 0.5, "update_prob": 0.5, "seed_radius": 0.2, "sigma": 1.0}
    task |= {"damage_radius": 0.1, "splat_weight": 2.0, "colour_weight": 5.0}
    task |= {"motion_weight": 0.01, "overflow_weight": 100.0, "bound_weight": 100.0}
    run = {"pool_size": 512, "world_count": 8, "steps": (32, 96), "seed_interval": 16}
    run |= {"iterations": 10_000, "repeats": 3, "milestones": (2_000, 4_000, 6_000, 8_000)}
    run |= {"learning_rate": 5e-4, "weight_decay": 0.0, "damage_share": 1.0}
    assert task.items() <= vars(PAPER.task).items()
    assert run.items() <= vars(PAPER).items()


def test_learning_rate_falls_at_milestones_and_starts_afresh_with_each_repeat():
    config = override(PAPER, iterations=10, milestones=[2, 5], learning_rate=1.0)
    rates = [config.learning_rate_at(k) for k in range(12)]
    assert rates == [1, 1, 0.3, 0.3, 0.3, 0.09, 0.09, 0.09, 0.09, 0.09, 1, 1]


@pytest.mark.parametrize("iterations", [10, 1000])
def test_learning_rate_rises_shortly_and_falls_along_a_cosine_whatever_the_length(iterations):
    config = override(PAPER, iterations=iterations, learning_rate=1.0, schedule="cosine")
    rates = [config.learning_rate_at(k) for k in range(2 * iterations)]
    assert rates[:iterations] == rates[iterations:]
    assert rates[0] == pytest.approx(min(1.0, 100 / iterations))
    assert rates[iterations // 2] == pytest.approx(0.505)
    last = math.pi * (iterations - 1) / iterations
    assert rates[-1] == pytest.approx(0.01 + 0.99 * (0.5 + 0.5 * math.cos(last)))
    top = rates.index(max(rates))
    assert top <= iterations // 100
    assert all(a > b for a, b in itertools.pairwise(rates[top:iterations]))


def test_a_cosine_falls_with_a_share_that_says_more_than_the_iterations():
    config = override(PAPER, iterations=100, learning_rate=1.0, schedule="cosine")
    assert config.learning_rate_at(40, 0.2) == config.learning_rate_at(40)
    assert config.learning_rate_at(10, 0.4) == config.learning_rate_at(40)
    assert config.learning_rate_at(10, 1.0) == pytest.approx(0.01)
    stepwise = override(PAPER, iterations=100, learning_rate=1.0, milestones=(40,))
    assert stepwise.learning_rate_at(10, 1.0) == 1.0


def test_override_reaches_fields_of_the_run_and_of_the_task():
    config = override(PAPER, iterations=7, target="heart", eps=1, out="elsewhere")
    assert (config.iterations, config.task.target, config.out) == (7, "heart", Path("elsewhere"))
    assert config.task.eps == 1.0
    assert isinstance(config.task.eps, float)
    assert (PAPER.iterations, PAPER.task.target) == (10_000, "gecko")


def test_no_field_of_the_run_hides_one_of_the_task():
    own, of_task = (dataclasses.fields(cls) for cls in (TrainConfig, Morphogenesis2DConfig))
    assert not {field.name for field in own} & {field.name for field in of_task}


REFUSED = [
    ({"iterations": 0}, "iterations must be a whole number of at least 1, got 0"),
    ({"iterations": True}, "iterations must be of type int, got True"),
    ({"learning_rate": math.nan}, "learning_rate must be a finite number greater than 0"),
    ({"learning_rate": "fast"}, "learning_rate must be of type float, got 'fast'"),
    ({"steps": [5, 5]}, "steps must be two whole numbers"),
    ({"steps": 5}, "steps must be a list, got 5"),
    ({"max_age_range": [5, 2]}, "max_age_range must be two whole numbers"),
    ({"damage_and_keep_share": 1.0}, "damage_and_keep_share must be below 1, got 1.0"),
    ({"damage_and_keep_share": 0.5}, "damage_and_keep_share needs max_age_range, got 0.5 without"),
    ({"stillness_weight": 64}, "stillness_weight needs max_age_range, got 64"),
    ({"wound_weight": 0.5}, "wound_weight needs max_age_range, got 0.5"),
    ({"wound_chance": 1.5}, "wound_chance must"),
    (
        {"max_age_range": [64, 128], "pool_size": 36},
        "pool_size must be a multiple of world_count where",
    ),
    ({"damage_share": 1.5}, "damage_share must be at most 1, got 1.5"),
    ({"vary_eps": (2.0, 1.0)}, r"vary_eps must be two factors .*lo <= hi"),
    ({"stillness_power": 0.5}, "stillness_power must be at least 1 and at most 8, got 0.5"),
    ({"schedule": "linear"}, "schedule must be 'milestones' or 'cosine', got 'linear'"),
    ({"milestones": [5, 2]}, "milestones must be positive and increasing"),
    ({"world_count": 1000}, "world_count must be at most pool_size"),
    ({"seed": -1}, r"seed must be a whole number of at least 0 and below 2\*\*63, got -1"),
    ({"seed": 2**63}, r"at least 0 and below 2\*\*63, got 9223372036854775808"),
    ({"picture_interval": -1}, "picture_interval must be a whole number of at least 0, got -1"),
    ({"memory": "disk"}, "memory must be 'store', 'recompute' or 'minimal', got 'disk'"),
    ({"device": "gpu"}, "device must name a device, got 'gpu'"),
    ({"target": ""}, "target must be a built-in name, an emoji or a path, got ''"),
    ({"update_prob": 0.0}, r"update_prob must lie in \(0, 1\], got 0.0"),
    ({"state_dim": 2}, "state_dim must be a whole number of at least 3, got 2"),
    ({"splat_weight": math.inf}, "splat_weight must be a finite number of at least 0"),
    ({"itertions": 5}, r"unknown field 'itertions': did you mean 'iterations'\?"),
]
REFUSED_TOGETHER = [
    ({"initial_rule": "gecko"}, "initial_rule is for one rule, got 'gecko'"),
    ({"initial_rules": ["gecko", ""]}, "initial_rules must be a tuple of names or files"),
    ({"frozen": [-1]}, r"frozen must be a tuple of species' numbers from 0, got \(-1,\)"),
    ({"species": [{}, {"alpa": 1}]}, r"unknown field 'species\[1\].alpa': did you mean 'alpha'"),
    ({"species": [3, {}]}, r"species\[0\] must be of type Morphogenesis2DConfig, got 3"),
]


@pytest.mark.parametrize(
    ("base", "fields", "message"),
    [(PAPER, *row) for row in REFUSED] + [(PAIR, *row) for row in REFUSED_TOGETHER],
)
def test_each_wrong_value_is_named(base, fields, message):
    refused(message, override, base, **fields)


@pytest.mark.parametrize(
    ("config", "field"),
    [(PAPER, "tensorboard"), (PAPER, "cuda_graph"), (PAPER.task, "keep_background")],
)
def test_flags_are_true_or_false(config, field):
    with pytest.raises(NPAError, match=f"{field} must be True or False, got 'no'"):
        dataclasses.replace(config, **{field: "no"})


def test_the_largest_seed_a_device_that_is_not_here_and_sections_are_accepted():
    config = override(PAPER, seed=2**63 - 1, device="cuda:7", max_age_range=[64, 128], pool_size=32)
    assert (config.seed, config.device, config.ages) == (2**63 - 1, "cuda:7", True)
    torch.Generator().manual_seed(config.seed + 2)
    assert not override(PAPER, pool_size=36).ages


def test_unknown_names_get_a_suggestion():
    refused("unknown preset 'papr' of morphogenesis2d: did you mean", preset, "papr")
    refused(r"did you mean 'morphogenesis[23]d'", task_entry, "morphogenesis")


FILES = {
    "run.yaml": "iterations: 5\nlearning_rate: 5e-4\nsteps: [2, 4]\ntarget: heart\n",
    "run.toml": 'iterations = 5\nlearning_rate = 5e-4\nsteps = [2, 4]\n[task]\ntarget = "heart"\n',
    "run.json": '{"iterations": 5, "learning_rate": 5e-4, "steps": [2, 4], "target": "heart"}',
}


@pytest.mark.parametrize("name", FILES)
def test_files_of_every_kind_set_the_same_fields(tmp_path, name):
    (tmp_path / name).write_text(FILES[name], encoding="utf-8")
    expected = override(preset("tiny"), iterations=5, steps=(2, 4), target="heart")
    expected = override(expected, learning_rate=5e-4)
    assert load_config(tmp_path / name, preset("tiny")) == expected
    (tmp_path / "empty.yml").write_text("", encoding="utf-8")
    assert load_config(tmp_path / "empty.yml", PAPER) == PAPER


@pytest.mark.parametrize(
    ("name", "text", "rule"),
    [
        ("a.toml", "[task]\ntarge = 'x'", "unknown field 'task.targe': did you mean 'target'"),
        ("a.yaml", "task: {1: 2}", "unknown field 'task.1': known: "),
        ("a.yaml", "- 5", "must hold field names and values at its top level, got list"),
        ("a.yaml", "a: [", "cannot be parsed"),
        ("a.toml", "a = ", "cannot be parsed"),
        ("a.json", "{", "cannot be parsed"),
        ("a.ini", "", "must end in .yaml, .yml, .toml, .json"),
        ("a.yaml", "iterations: none", "iterations must be of type int, got 'none'"),
    ],
)
def test_wrong_files_are_refused_with_their_name(tmp_path, name, text, rule):
    (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(NPAError, match=rule) as caught:
        load_config(tmp_path / name, PAPER)
    assert name in str(caught.value)
    with pytest.raises(NPAError, match=r"cannot read the configuration file .*none.yaml"):
        load_config(tmp_path / "none.yaml", PAPER)


SPECIES = [{}, {"alpha": 0.25}, {"target": "ring"}]


@pytest.mark.parametrize("name", TASKS["co_morphogenesis2d"].presets)
@pytest.mark.parametrize(
    ("task", "fields"),
    [("morphogenesis2d", {"target": "heart"}), ("co_morphogenesis2d", {"species": SPECIES})],
)
def test_a_configuration_survives_being_written_as_json(name, task, fields):
    config = preset(name, task, seed=3, **fields)
    plain = json.loads(json.dumps(config_to_dict(config)))
    assert override(preset("paper", task), **plain) == config


@pytest.mark.parametrize("task", TASKS)
def test_what_presets_begin_with_is_there_and_fits(task):
    for config in TASKS[task].presets.values():
        if config.initial_rule:
            own = TASKS[task].make(config.task, torch.device("cpu"))
            rule = initial_rule(config, own.make_rule(torch.Generator().manual_seed(0)))
            known = load_rule(config.initial_rule)
            z = torch.randn(64, known.perception_dim, generator=torch.Generator().manual_seed(1))
            with torch.no_grad():
                torch.testing.assert_close(rule(z), known(z), rtol=0.05, atol=0.05)
            with pytest.raises(NPAError, match="or from random weights, with the initial rule ''"):
                initial_rule(config, NPARule(2, 5, 7))
    assert not preset("fast", task).initial_rule


def test_mappings_are_laid_over_the_species_that_are_there_and_more_over_the_last():
    config = override(PAIR, species=[{"target": "gecko"}, {"alpha": "0.25"}, {"target": "flower"}])
    first, second = PAIR.task.species
    assert config.task.species == (
        dataclasses.replace(first, target="gecko"),
        dataclasses.replace(second, alpha=0.25),
        dataclasses.replace(second, target="flower"),
    )


def test_a_rule_with_codes_of_other_targets_is_refused_by_their_names():
    config = preset("fast", targets=("gecko", "heart"), initial_rule="seven-pictures")
    untrained = NPARule(state_dim=24, hidden_dim=128, code_dim=8, code_names=("gecko", "heart"))
    refused(r"code_names .*, here .*'gecko', 'heart'", initial_rule, config, untrained)
