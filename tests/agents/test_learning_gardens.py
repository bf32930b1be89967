"""Gardens behind the interface of learners: methods that learn nothing, SAC, PPO."""

from dataclasses import replace

import numpy as np
import pytest
from learning_problems import heart

from npa_envs.agents import evaluate_policy
from npa_envs.agents.evaluation import policy_in
from npa_envs.agents.learning import GARDEN_METHODS, Budget, Problem, methods_for, train
from npa_envs.errors import NPAError

SEEDS = range(1_000_000, 1_000_002)
STEP = 2 * 64 * 8
"""Particle-steps of a step of two worlds of 64 particles."""


def garden(name="Gardener2DSmall") -> Problem:
    keywords = {"particle_count": 64, "seed_pool": 1, "grow_steps": 4}
    return Problem(
        env_id=f"npa/{name}-v0", keywords=keywords, episode_steps=2, num_envs=2, hidden_dim=4
    )


def learned(method, problem, budget=1, seed=0, **options):
    return train(
        method, problem, Budget(particle_steps=budget), seed, evaluation_seeds=SEEDS, **options
    )


def test_a_problem_has_the_settings_that_its_id_is_registered_with():
    problem = garden()
    assert methods_for(problem) is GARDEN_METHODS
    assert problem.config.tools == ("push",)
    assert problem.make_envs().config == replace(problem.config, output="torch")


@pytest.mark.parametrize("name", ["Gardener2DSmall", "Shepherd2DSmall"])
def test_gardeners_that_learn_nothing_act_in_the_worlds_that_they_are_asked_about(name):
    problem, found = garden(name), {}
    for method in ("zero", "random", "scripted"):
        trained = learned(method, problem)
        assert (trained.rules, len(trained.log), trained.log[0].particle_steps) == (None, 1, 0)
        envs = problem.make_envs()
        again = evaluate_policy(envs, trained.policy, SEEDS)
        assert again.mean_return == trained.log[0].mean_return
        found[method] = policy_in(envs, trained.policy)(envs.reset(seed=0)[0]).abs().sum()
    assert found["zero"] == 0.0
    assert found["random"] > 0.0
    assert found["scripted"] > 0.0


@pytest.mark.parametrize("method", ["sac", "ppo_world"])
@pytest.mark.parametrize("name", ["Gardener2DSmall", "Shepherd2DSmall"])
def test_algorithms_as_they_come_learn_within_their_budget_and_can_be_loaded(
    name, method, tmp_path
):
    baselines = pytest.importorskip("stable_baselines3")
    problem = garden(name)
    options = {"learning_starts": 2} if method == "sac" else {"steps": 2, "batch_size": 4}
    trained = learned(method, problem, 6 * STEP, **options)
    assert trained.log[-1].particle_steps == 6 * STEP
    observation, _ = problem.make_envs().reset(seed=0)
    action = trained.policy(observation)
    assert action.shape == (2, *problem.make_envs().single_action_space.shape)
    (path,) = trained.save(tmp_path)
    kind = baselines.SAC if method == "sac" else baselines.PPO
    trained.policy.model = kind.load(path)
    assert np.array_equal(trained.policy(observation), action)


def test_a_policy_of_another_garden_or_a_file_of_something_else_is_refused(tmp_path):
    pytest.importorskip("stable_baselines3")
    from npa_envs.agents.learning.sb3 import GardenPolicy

    problem = garden()
    (path,) = learned("sac", problem, 1, learning_starts=2).save(tmp_path)
    seen, _ = problem.make_envs().reset(seed=0)
    assert GardenPolicy.load(path)(seen).shape[0] == 2
    seen, _ = garden("Shepherd2DSmall").make_envs().reset(seed=0)
    with pytest.raises(NPAError, match="observation must be of a garden like that which"):
        GardenPolicy.load(path)(seen)
    path.write_text("no archive", encoding="utf-8")
    with pytest.raises(NPAError, match=r"path must be of a file that sac's `save` wrote, got"):
        GardenPolicy.load(path)


def test_rounds_that_stable_baselines_cannot_learn_from_are_refused():
    pytest.importorskip("stable_baselines3")
    with pytest.raises(NPAError, match="batch_size must be a whole number of at least 2"):
        learned("ppo_world", garden(), batch_size=1)
    with pytest.raises(NPAError, match="steps must be at least 2 in a single world"):
        learned("ppo_world", replace(garden(), num_envs=1), steps=1)
    with pytest.raises(NPAError, match="minibatches must leave at least 2 of the 4 steps"):
        learned("ppo_world", heart(num_envs=1), steps=4)


def test_a_garden_is_learned_by_its_own_methods_and_from_no_rules():
    with pytest.raises(NPAError, match="method must be a known word, got 'evolution'"):
        learned("evolution", garden())
    with pytest.raises(NPAError, match="looks at worlds: call made_for"):
        learned("zero", garden()).policy(None)
