"""Gardeners and shepherds: scripts help and are simple; the gradient's plans are worth more."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from support.refusals import refused
from support.small_envs import begun

import npa_envs
from npa_envs.agents import evaluate_policy
from npa_envs.agents.evaluation import bound_to
from npa_envs.agents.garden_policies import (
    GradientGardener,
    RandomGardener,
    ScriptedGardener,
    ScriptedShepherd,
    StillGardener,
)
from npa_envs.agents.learning import Budget, Problem, train

GARDENER, SHEPHERD = "npa/Gardener2DSmall-v0", "npa/Shepherd2DSmall-v0"
QUICK = {"seed_pool": 2, "grow_steps": 128}


def make_vec(name, world_count, **keywords):
    return gymnasium.make_vec(
        name, world_count, vectorization_mode="vector_entry_point", **(QUICK | keywords)
    )


@pytest.mark.parametrize(
    ("name", "make", "keywords"),
    [
        (GARDENER, ScriptedGardener, {}),
        (GARDENER, ScriptedGardener, {"actions": "free", "push_length": 0.3}),
        (SHEPHERD, ScriptedShepherd, {}),
        (SHEPHERD, ScriptedShepherd, {"aim": "reshape"}),
    ],
)
def test_scripts_do_better_than_nobody_and_nobody_than_chance(name, make, keywords):
    envs = make_vec(name, 2, rule_steps=4, max_episode_steps=12, **keywords)
    still, chance, scripted = (
        evaluate_policy(envs, policy(envs), [0, 1]).mean_return / 12
        for policy in (StillGardener, RandomGardener, make)
    )
    assert scripted > still + 0.1
    assert still > chance


@pytest.mark.parametrize("output", ["numpy", "torch"])
@pytest.mark.parametrize(
    ("name", "make"), [(GARDENER, ScriptedGardener), (SHEPHERD, ScriptedShepherd)]
)
def test_episodes_of_one_world_are_those_of_many(name, make, output):
    quick = {"max_episode_steps": 3, "rule_steps": 1, "output": output}
    many = make_vec(name, 2, **quick)
    one = gymnasium.make(name, disable_env_checker=True, **QUICK, **quick)
    left, right = (evaluate_policy(env, make(env), range(3)) for env in (many, one))
    assert np.allclose(left.returns, right.returns, atol=1e-6)
    assert np.array_equal(left.final_losses, right.final_losses)


def test_a_plan_by_the_gradient_is_worth_more_than_the_script_that_it_begins_with():
    envs = begun(make_vec(GARDENER, 2, rule_steps=2), seed=1)
    for _ in range(3):
        envs.step(np.zeros(envs.action_space.shape, np.float32))
    planner, script = GradientGardener(envs, horizon=1, iterations=8), ScriptedGardener(envs)
    planned, scripted = (
        planner.planned_rewards(policy.act()[None], npa_envs.WorldRandom([7, 8])).detach()
        for policy in (planner, script)
    )
    assert bool((planned > scripted).all())


# Behind the interface of learners


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


@pytest.mark.parametrize("name", ["Gardener2DSmall", "Shepherd2DSmall"])
def test_gardeners_that_learn_nothing_act_in_the_worlds_that_they_are_asked_about(name):
    problem, pushes = garden(name), {}
    assert problem.make_envs().config == replace(problem.config, output="torch")
    for method in ("zero", "random", "scripted"):
        trained = learned(method, problem)
        assert (trained.rules, len(trained.log), trained.log[0].particle_steps) == (None, 1, 0)
        envs = problem.make_envs()
        again = evaluate_policy(envs, trained.policy, SEEDS)
        assert again.mean_return == trained.log[0].mean_return
        pushes[method] = bound_to(envs, trained.policy)(envs.reset(seed=0)[0]).abs().sum()
    assert pushes["zero"] == 0.0
    assert min(pushes["random"], pushes["scripted"]) > 0.0
    refused("reads the worlds: call made_for", trained.policy, None)


@pytest.mark.parametrize("method", ["sac", "ppo_world"])
@pytest.mark.parametrize("name", ["Gardener2DSmall", "Shepherd2DSmall"])
def test_algorithms_as_they_come_learn_within_their_budget_and_can_be_loaded(
    name, method, tmp_path
):
    from npa_envs.agents.learning.sb3 import GardenPolicy

    problem = garden(name)
    options = {"learning_starts": 2} if method == "sac" else {"steps": 2, "batch_size": 4}
    trained = learned(method, problem, 6 * STEP, **options)
    assert trained.log[-1].particle_steps == 6 * STEP
    observation, _ = problem.make_envs().reset(seed=0)
    action = trained.policy(observation)
    assert action.shape == (2, *problem.make_envs().single_action_space.shape)
    # Policies of one shape of actions act where the other is the environment's.
    rows = replace(problem, keywords={**problem.keywords, "action_shape": "brushes"})
    assert rows.make_envs().single_action_space.shape != action.shape[1:]
    same, other = (evaluate_policy(p.make_envs(), trained.policy, SEEDS) for p in (problem, rows))
    assert np.array_equal(same.returns, other.returns)
    (path,) = trained.save(tmp_path)
    loaded = GardenPolicy.load(path)
    assert np.array_equal(loaded(observation), action)
    (other,) = {"Gardener2DSmall", "Shepherd2DSmall"} - {name}
    observation, _ = garden(other).make_envs().reset(seed=0)
    refused("of the garden that the policy was trained in", loaded, observation)
    path.write_text("no archive", encoding="utf-8")
    refused("path must be of a file that .*'s `save` wrote, got", GardenPolicy.load, path)
