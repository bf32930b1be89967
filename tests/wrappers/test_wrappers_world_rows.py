"""Worlds as rows of a Stable-Baselines3 environment."""

from __future__ import annotations

import numpy as np
import pytest
import wrapped_envs
from wrapped_envs import ACTIONS, STEPS, policy

from npa_envs.agents.learning import Problem
from npa_envs.errors import NPAError

pytest.importorskip("stable_baselines3")

from npa_envs.wrappers import WorldVecEnv


def test_rows_are_the_worlds_in_order():
    rows, envs = WorldVecEnv(wrapped_envs.batched(2)), wrapped_envs.batched(2)
    assert rows.num_envs == 2
    assert rows.observation_space.shape == (64, 66)
    assert rows.action_space.shape == (64, ACTIONS)
    assert rows.seed(3) == [3, 4]
    seen, (observation, _) = rows.reset(), envs.reset(seed=3)
    np.testing.assert_array_equal(seen, observation)
    for step in range(1, 2 * STEPS + 1):
        seen, rewards, done, infos = rows.step(policy(seen))
        observation, paid, _, truncated, told = envs.step(policy(observation))
        np.testing.assert_array_equal(seen, observation)
        np.testing.assert_array_equal(rewards, paid)
        assert (rewards != 0).any()
        assert done.all() == done.any() == truncated.all() == (step % STEPS == 0)
        if done.any():
            for world in range(2):
                info = infos[world]
                np.testing.assert_array_equal(
                    info["terminal_observation"], told["final_obs"][world]
                )
                assert info["TimeLimit.truncated"] is True
                assert info["is_success"] is False
        else:
            assert infos == [{}] * 2


def test_success_is_no_time_limit():
    rows = WorldVecEnv(wrapped_envs.batched(2, success_loss=1e6))
    _, _, done, infos = rows.step(policy(rows.reset()))
    assert done.all()
    assert infos[1]["is_success"] is True
    assert infos[1]["TimeLimit.truncated"] is False


def test_species_stand_one_after_the_other_in_a_world():
    problem = Problem(
        env_id="npa/Mixing-v0",
        keywords={"particle_counts": [3, 5], "eps": 0.3, "state_dim": 4},
        episode_steps=2,
    )
    rows, envs = WorldVecEnv(problem.make_envs(2)), problem.make_envs(2)
    rows.seed(1)
    seen, (observation, _) = rows.reset(), envs.reset(seed=1)
    np.testing.assert_array_equal(seen, observation.numpy())
    actions = np.random.default_rng(0).uniform(-1, 1, (2, *rows.action_space.shape))
    actions = actions.astype(np.float32)
    for _ in range(2):
        seen, rewards, done, infos = rows.step(actions)
        observation, paid, *_, told = envs.step(observation.new_tensor(actions))
        np.testing.assert_array_equal(seen, observation.numpy())
        np.testing.assert_array_equal(rewards, paid.numpy())
    assert done.all()
    np.testing.assert_array_equal(infos[1]["terminal_observation"], told["final_obs"][1].numpy())


def test_what_has_no_row_for_each_particle_is_refused():
    with pytest.raises(NPAError, match="single_observation_space of env must be a box with a row"):
        WorldVecEnv(wrapped_envs.single())


def test_actions_of_another_shape_are_refused():
    rows = WorldVecEnv(wrapped_envs.batched(2))
    rows.reset()
    with pytest.raises(NPAError, match=r"got \(2, 63, 18\)"):
        rows.step(np.zeros((2, 63, ACTIONS), np.float32))
