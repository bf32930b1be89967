"""Gardeners and shepherds: scripts help and are simple; the gradient's plans are worth more."""

import gymnasium
import numpy as np
import pytest

import npa_envs
from npa_envs.agents import evaluate_policy
from npa_envs.agents.gardening import (
    GradientGardener,
    RandomGardener,
    ScriptedGardener,
    ScriptedShepherd,
    StillGardener,
)
from npa_envs.errors import NPAError

GARDENER, SHEPHERD = "npa/Gardener2DSmall-v0", "npa/Shepherd2DSmall-v0"
QUICK = {"seed_pool": 2, "grow_steps": 128}


def make_vec(name, world_count, **keywords):
    return gymnasium.make_vec(
        name, world_count, vectorization_mode="vector_entry_point", **(QUICK | keywords)
    )


def earned(envs, policy, steps):
    """Mean reward of a step."""
    seen, _ = envs.reset(seed=0)
    total = 0.0
    for _ in range(steps):
        seen, rewards, *_ = envs.step(policy(seen))
        total += float(np.mean(rewards)) / steps
    return total


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
    envs = make_vec(name, 2, rule_steps=4, **keywords)
    still, chance, scripted = (
        earned(envs, policy(envs), 12) for policy in (StillGardener, RandomGardener, make)
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


def test_what_a_scripted_gardener_does_is_linear_in_what_is_seen():
    envs = make_vec(GARDENER, 8, rule_steps=1)
    policy = ScriptedGardener(envs, gain=0.05, share=0.05)
    seen, done = [], []
    observation, _ = envs.reset(seed=0)
    for _ in range(30):
        action = policy(observation)
        seen.append(observation)
        done.append(action.reshape(len(action), -1))
        observation, *_ = envs.step(np.zeros_like(action))
    seen, done = np.concatenate(seen), np.concatenate(done)
    fitted, *_ = np.linalg.lstsq(seen[:200], done[:200], rcond=None)
    np.testing.assert_allclose(seen[200:] @ fitted, done[200:], atol=1e-5)


def test_a_plan_by_the_gradient_is_worth_more_than_the_script_that_it_begins_with():
    envs = make_vec(GARDENER, 2, rule_steps=2)
    envs.reset(seed=1)
    for _ in range(3):
        envs.step(np.zeros(envs.action_space.shape, np.float32))
    planner, script = GradientGardener(envs, horizon=1, iterations=8), ScriptedGardener(envs)
    planned, scripted = (
        planner.worth(policy.act(2)[None], npa_envs.WorldRandom([7, 8])).detach()
        for policy in (planner, script)
    )
    assert bool((planned > scripted).all())


def test_gardeners_need_a_garden_whose_brushes_are_numbers():
    with pytest.raises(NPAError, match="env must be a garden with actions='grid' or 'free'"):
        StillGardener(make_vec(GARDENER, 2, actions="discrete"))
    with pytest.raises(NPAError, match="env must have brushes that push"):
        ScriptedGardener(make_vec(GARDENER, 2, tools=("wipe",)))
    with pytest.raises(NPAError, match="env must be npa/Shepherd2D-v0"):
        ScriptedShepherd(make_vec(GARDENER, 2))
    for given in ({"gain": 0.0}, {"share": -1.0}, {"width": float("nan")}):
        with pytest.raises(NPAError, match=f"{next(iter(given))} must be positive"):
            ScriptedGardener(make_vec(GARDENER, 2), **given)


@pytest.mark.slow
def test_ppo_learns_to_garden_as_it_comes():
    sb3 = pytest.importorskip("stable_baselines3")
    model = sb3.PPO("MlpPolicy", gymnasium.make(GARDENER), gamma=0.9, seed=0, device="cpu")
    model.learn(12_000)
    envs = gymnasium.make_vec(GARDENER, 8)

    def learned(seen):
        return model.predict(seen, deterministic=True)[0]

    episodes = [
        evaluate_policy(envs, policy, seeds=range(1000, 1008))
        for policy in (StillGardener(envs), learned)
    ]
    still, taught = (np.asarray(one.returns) / 32 for one in episodes)
    error = np.std(taught - still, ddof=1) / np.sqrt(len(still))
    assert np.mean(taught - still) > max(0.3, 3.0 * error)
