"""Particles as rows of a vector environment of Gymnasium's."""

import gc

import gymnasium as gym
import numpy as np
import pytest
import wrapped_envs
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics
from wrapped_envs import ACTIONS, STEPS, policy

from npa_envs.errors import NPAError
from npa_envs.wrappers import ParticleRows


def batched(count=2, **keywords):
    return wrapped_envs.batched(count, autoreset_mode="next-step", **keywords)


@pytest.mark.parametrize("output", ["numpy", "torch"])
@pytest.mark.parametrize("own", [False, True])
def test_rows_are_the_particles_of_the_worlds_in_order(own, output):
    keywords = {"reward": "particle"} if own else {}
    rows, envs = ParticleRows(batched(output=output, **keywords)), batched(**keywords)
    assert rows.num_envs == 128
    assert rows.single_observation_space == gym.spaces.Box(-64.0, 64.0, (66,), np.float32)
    assert rows.action_space.shape == (128, ACTIONS)
    assert rows.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    seen, _ = rows.reset(seed=3)
    observation, _ = envs.reset(seed=3)
    for step in range(1, 2 * STEPS + 1):
        np.testing.assert_array_equal(seen, observation.reshape(128, 66))
        seen, rewards, ended, cut, infos = rows.step(policy(seen))
        observation, paid, _, truncations, own_infos = envs.step(policy(observation))
        expected = own_infos["particle_reward"].reshape(-1) if own else np.repeat(paid, 64)
        np.testing.assert_array_equal(rewards, expected.astype(np.float64))
        np.testing.assert_array_equal(cut, np.repeat(truncations, 64))
        assert cut.all() == cut.any() == (step % (STEPS + 1) == STEPS)
        assert not ended.any()
        assert infos == {}


def test_gymnasiums_wrappers_lie_over_rows():
    rows = RecordEpisodeStatistics(ParticleRows(batched()))
    rows.reset(seed=0)
    for _ in range(STEPS):
        *_, infos = rows.step(np.zeros((128, ACTIONS), np.float32))
    assert infos["episode"]["l"].tolist() == [STEPS] * 128
    listed = DictInfoToList(ParticleRows(batched()))
    assert listed.reset(seed=0)[1] == [{}] * 128


@pytest.mark.filterwarnings("error::pytest.PytestUnraisableExceptionWarning")
def test_what_is_refused():
    with pytest.raises(NPAError, match="make it with autoreset_mode='next-step'"):
        ParticleRows(wrapped_envs.batched(2))
    gc.collect()
    with pytest.raises(NPAError, match="env must be a vector environment of npa_envs, got"):
        ParticleRows(wrapped_envs.single())
    rows = ParticleRows(batched(2))
    rows.reset()
    with pytest.raises(NPAError, match=r"actions must have shape \[rows, A\] = \(128, 18\), got"):
        rows.step(np.zeros((2, 64, ACTIONS), np.float32))


def test_rows_close_their_worlds_once():
    envs = batched(2)
    rows = ParticleRows(envs)
    assert not envs.closed
    rows.close()
    assert envs.closed
    rows.close()


@pytest.mark.parametrize("name", ["Gardener2DSmall", "Shepherd2DSmall"])
def test_environments_without_rows_are_refused(name):
    envs = gym.make_vec(f"npa/{name}-v0", num_envs=2, autoreset_mode="next-step")
    with pytest.raises(NPAError, match="rows need an environment that gives and takes one for"):
        ParticleRows(envs)
