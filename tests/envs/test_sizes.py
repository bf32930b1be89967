"""Small and large forms of environments: their settings, Gymnasium's checker, batches."""

import hashlib
import json
from pathlib import Path

import gymnasium
import pytest
from pettingzoo.test import parallel_api_test

from npa_envs.agents.learning import Problem
from npa_envs.envs import multispecies_v0
from npa_envs.envs.regeneration2d import Regeneration2DEnvConfig
from npa_envs.envs.trained_rules import GrownConfig, growing_rule
from npa_envs.registration import ALL, CENTRAL, SIZES, SMALL, SPECIES_SIZES
from npa_envs.rule.files import rule_file, shipped_rules

FROZEN = json.loads(Path(__file__).with_name("frozen.json").read_text(encoding="utf-8"))
"""What ids had when they were made: settings of gardens; SHA-256 of the steps and keywords of other
sizes, and of the file of the rule that runs or grows the worlds of an id, or of a target."""


def check_frozen(part, found):
    """Check that a part of the file has the rows `found`; say which ones a new id needs."""
    rows = {name: digest for name, digest in found.items() if name not in FROZEN[part]}
    assert found == FROZEN[part], f'new rows of "{part}" in frozen.json: {json.dumps(rows)}'


def test_settings_are_what_they_were():
    now = {row.id: {"steps": row.max_episode_steps, **row.keywords} for row in (*SIZES, *CENTRAL)}
    now |= {row.id: {"task": row.task, **row.keywords} for row in SPECIES_SIZES}
    hashes = {
        name: hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()
        for name, settings in now.items()
    }
    check_frozen("sizes", hashes)
    for name, settings in FROZEN["gardens"].items():
        config = Problem(env_id=name, episode_steps=4).config
        found = {key: getattr(config, key) for key in settings}
        assert json.loads(json.dumps(found)) == settings, name


def test_a_rule_that_is_trained_anew_changes_no_environment():
    """The file that grows an id's worlds has the hash that it had when the id was made."""
    grown = {
        f"target={name}": Regeneration2DEnvConfig(target=name)
        for name in shipped_rules("morphogenesis2d")
    }
    configs = {row.id: Problem(env_id=row.id, episode_steps=4).config for row in ALL} | grown
    rules = {
        name: growing_rule(config) if isinstance(config, GrownConfig) else config.rule
        for name, config in configs.items()
        if getattr(config, "rule", "") != ""
    }
    found = {
        name: hashlib.sha256(rule_file(rule).read_bytes()).hexdigest()
        for name, rule in rules.items()
        if rule != "picture"
    }
    check_frozen("rules", found)


@pytest.mark.parametrize("row", [*SMALL, *SIZES, *CENTRAL], ids=lambda row: row.id)
def test_an_id_is_the_environment_of_its_name_with_other_keywords(row):
    usual = f"npa/{row.name}-v0"
    spec, of_usual = gymnasium.spec(row.id), gymnasium.spec(usual)
    assert spec.entry_point == row.entry_point == of_usual.entry_point
    assert spec.vector_entry_point == row.vector_entry_point == of_usual.vector_entry_point
    assert spec.max_episode_steps == row.max_episode_steps
    sized = Problem(env_id=row.id, episode_steps=row.max_episode_steps)
    by_keywords = Problem(env_id=usual, keywords=dict(row.keywords), episode_steps=4)
    assert sized.config == by_keywords.config
    changed = Problem(env_id=row.id, keywords={"update_prob": 0.25}, episode_steps=4)
    assert changed.config.update_prob == 0.25
    assert changed.config.particle_count == sized.config.particle_count


@pytest.mark.parametrize("row", SPECIES_SIZES, ids=lambda row: row.id)
def test_species_of_an_id_pass_the_checker_and_have_its_settings_in_every_form(row):
    few = {} if "Small" in row.id else {"particle_count": 64}
    if few and "particle_counts" in row.keywords:
        few = {"particle_counts": (48, 16)}
    parallel_api_test(multispecies_v0.parallel_env(row.id, max_cycles=4, **few), num_cycles=6)
    env = multispecies_v0.parallel_env(row.id, **few)
    envs = multispecies_v0.batched(row.id, world_count=2, **few)
    problem = Problem(env_id=row.id, keywords=few, episode_steps=row.keywords["max_cycles"])
    assert env.worlds.task.config == envs.config == problem.config
    assert env.max_cycles == row.keywords["max_cycles"]
