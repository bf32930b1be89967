"""Small and large forms of environments: frozen settings, checkers, batches."""

import hashlib
import json
import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import parallel_api_test
from small_envs import assert_same, world_of

from npa_envs.agents.learning import Budget, Problem, train
from npa_envs.envs import multispecies_v0
from npa_envs.envs.grown import GrownConfig, growing_rule
from npa_envs.envs.regeneration2d import Regeneration2DEnvConfig
from npa_envs.registration import ALL, ENVIRONMENTS, SIZES, SPECIES_SIZES
from npa_envs.rule.files import rule_file, shipped_rules

FROZEN = json.loads(Path(__file__).with_name("frozen_sizes.json").read_text(encoding="utf-8"))
"""Steps of an episode and keywords by id, as they were when the ids were made."""

FROZEN_RULES = json.loads(Path(__file__).with_name("frozen_rules.json").read_text(encoding="utf-8"))
"""SHA-256 of the file of the rule that runs or grows the worlds of an id, or of a target."""

FEW = {"particle_count": 64, "resolution": 16, "view_count": 2}
"""What makes a check of a form quick that is not small already."""

every_form = pytest.mark.parametrize("row", SIZES, ids=lambda row: row.id)
every_id = pytest.mark.parametrize("row", ALL, ids=lambda row: row.id)
of_species = pytest.mark.parametrize("row", SPECIES_SIZES, ids=lambda row: row.id)


def test_settings_are_what_they_were():
    now = {row.id: {"steps": row.max_episode_steps, **row.keywords} for row in SIZES}
    now |= {row.id: {"task": row.task, **row.keywords} for row in SPECIES_SIZES}
    assert json.loads(json.dumps(now)) == FROZEN


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
    assert found == FROZEN_RULES


def quick(row):
    """Keywords with which a check of an id is quick; those of small ids are as registered."""
    config = Problem(env_id=row.id, episode_steps=4).config
    return {} if "Small" in row.id else {key: n for key, n in FEW.items() if hasattr(config, key)}


def quick_species(row):
    """The same for species."""
    if "Small" in row.id:
        return {}
    shared = "particle_counts" in row.keywords
    return {"particle_counts": (48, 16)} if shared else {"particle_count": FEW["particle_count"]}


@every_form
def test_an_id_is_the_environment_of_its_name_with_other_keywords(row):
    usual = row.id.replace("Small", "").replace("Large", "")
    assert usual in {registered.id for registered in ENVIRONMENTS}
    spec = gymnasium.spec(row.id)
    assert (spec.entry_point, spec.vector_entry_point) == (
        row.entry_point, row.vector_entry_point,
    ) == (gymnasium.spec(usual).entry_point, gymnasium.spec(usual).vector_entry_point)  # fmt: skip
    sized = Problem(env_id=row.id, episode_steps=row.max_episode_steps)
    told = Problem(env_id=usual, keywords=dict(row.keywords), episode_steps=4)
    assert sized.config == told.config
    changed = Problem(env_id=row.id, keywords={"update_prob": 0.25}, episode_steps=4)
    assert changed.config.update_prob == 0.25
    assert changed.config.particle_count == sized.config.particle_count


@every_id
def test_gymnasium_finds_nothing_to_complain_of(row):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gymnasium.make(row.id, **quick(row)).unwrapped, skip_render_check=True)


@every_id
def test_stable_baselines3_finds_nothing_to_complain_of(row):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        checker.check_env(gymnasium.make(row.id, **quick(row)).unwrapped, skip_render_check=True)
    # Actions and observations have rows: it advises to flatten both.
    assert [str(w.message) for w in caught if "flatten" not in str(w.message)] == []


@every_id
def test_a_batch_equals_single_environments_to_the_end_of_their_episodes(row):
    limit = {"max_episode_steps": 5} | quick(row)
    envs = gymnasium.make_vec(
        row.id, 2, vectorization_mode="vector_entry_point", autoreset_mode="same-step", **limit
    )
    singles = [gymnasium.make(row.id, **limit) for _ in range(2)]
    seen, _ = envs.reset(seed=4)
    random = np.random.default_rng(0)
    for k, env in enumerate(singles):
        assert_same(world_of(seen, k), env.reset(seed=4 + k)[0])
    for step in range(5):
        action = random.uniform(-1, 1, envs.action_space.shape).astype(np.float32)
        seen, paid, ended, cut, infos = envs.step(action)
        for k, env in enumerate(singles):
            alone = env.step(action[k])
            whole = infos["final_obs"] if step == 4 else seen
            assert_same(world_of(whole, k), alone[0])
            assert (np.float32(paid[k]), ended[k], cut[k]) == (np.float32(alone[1]), *alone[2:4])
            assert cut[k] == (step == 4)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["ppo", "ppo_world"])
def test_ppo_is_above_random_zero_and_scripted_policies_in_a_small_world(method):
    if method == "ppo_world":
        pytest.importorskip("stable_baselines3")
    problem = Problem(env_id="npa/Morphogenesis2DSmall-v0", episode_steps=32, hidden_dim=64)

    def returned(method, seed):
        budget = Budget(particle_steps=1_000_000)
        return train(method, problem, budget, seed, entries=1).log[-1].mean_return

    learned = np.array([returned(method, seed) for seed in range(3)])
    others = max(0.0, *(returned(name, 0) for name in ("random", "scripted")))
    assert learned.mean() - 3.0 * learned.std(ddof=1) / np.sqrt(3) > others


@of_species
def test_species_of_an_id_pass_the_checker_and_a_batch_equals_them(row):
    few = quick_species(row)
    parallel_api_test(multispecies_v0.parallel_env(row.id, max_cycles=4, **few), num_cycles=6)
    env = multispecies_v0.parallel_env(row.id, **few)
    envs = multispecies_v0.batched(row.id, world_count=2, **few)
    steps = row.keywords["max_cycles"]
    assert Problem(env_id=row.id, episode_steps=steps).config.max_cycles == steps
    problem = Problem(env_id=row.id, keywords=few, episode_steps=steps)
    assert env.worlds.task.config == envs.config == problem.config
    (seen, _), (alone, _) = envs.reset(seed=3), env.reset(seed=4)
    random = np.random.default_rng(0)
    for _ in range(3):
        actions = {
            agent: random.uniform(-1, 1, space.shape).astype(np.float32)
            for agent, space in envs.action_spaces.items()
        }
        assert_same(world_of(seen, 1), alone)
        seen, paid, *_ = envs.step(actions)
        alone, own, *_ = env.step({agent: action[1] for agent, action in actions.items()})
        assert {a: np.float32(paid[a][1]) for a in own} == {
            a: np.float32(v) for a, v in own.items()
        }
