"""Species tags."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from wrapped_envs import STEPS, batched, single

import npa_envs  # noqa: F401 (registers the environments)
from npa_envs.errors import NPAError
from npa_envs.wrappers import NormalizePerception, SpeciesTags, VectorSpeciesTags

ACTION = np.full((64, 18), 0.1, np.float32)


def test_tags_stand_behind_the_observation():
    env, plain = SpeciesTags(single(), 2), single()
    observation, _ = env.reset(seed=0)
    np.testing.assert_array_equal(observation[:, :66], plain.reset(seed=0)[0])
    np.testing.assert_array_equal(env.species, np.repeat([0, 1], 32))
    np.testing.assert_array_equal(observation[:, 66:], np.eye(2, dtype=np.float32)[env.species])
    later, *_ = env.step(ACTION)
    np.testing.assert_array_equal(later[:, 66:], observation[:, 66:])
    assert env.observation_space.shape == (64, 68)
    assert env.observation_space.contains(later)
    assert env.observation_space.high[0, -1] == 1.0
    assert env.observation_space.low[0, -1] == 0.0


@pytest.mark.parametrize("assignment", ["blocks", "random"])
def test_fractions_are_kept_and_the_worlds_left_as_they_are(assignment):
    env = SpeciesTags(single(), 3, fractions=[2, 1, 1], assignment=assignment)
    plain = single()
    env.reset(seed=0)
    plain.reset(seed=0)
    assert np.bincount(env.species).tolist() == [32, 16, 16]
    for _ in range(3):
        np.testing.assert_array_equal(env.step(ACTION)[0][:, :66], plain.step(ACTION)[0])


def test_random_species_are_drawn_for_each_episode_and_hold_through_it():
    env = SpeciesTags(single(), 2, assignment="random")
    first, _ = env.reset(seed=4)
    species = env.species
    for _ in range(3):
        observation, *_ = env.step(ACTION)
        np.testing.assert_array_equal(observation[:, 66:], first[:, 66:])
    env.reset()
    assert (env.species != species).any()
    env.reset(seed=4)
    np.testing.assert_array_equal(env.species, species)


@pytest.mark.parametrize("mode", ["same-step", "next-step", "disabled"])
@pytest.mark.parametrize("output", ["numpy", "torch"])
def test_world_k_has_the_species_of_the_single_environment(mode, output):
    envs = VectorSpeciesTags(batched(autoreset_mode=mode, output=output), 3, assignment="random")
    wanted = []
    for k in range(3):
        env = SpeciesTags(single(), 3, assignment="random")
        env.reset(seed=20 + k)
        one = env.species
        env.reset()
        wanted.append((one, env.species))
    one, two = (np.stack(each) for each in zip(*wanted, strict=True))
    actions = np.stack([ACTION] * 3)
    observations, _ = envs.reset(seed=20)
    assert envs.single_observation_space.shape == (64, 69)
    assert envs.observation_space.contains(np.asarray(observations))
    np.testing.assert_array_equal(np.asarray(envs.species), one)
    for _ in range(STEPS):
        before = np.asarray(envs.species)
        observations, _, _, truncations, infos = envs.step(actions)
    np.testing.assert_array_equal(before, one)
    assert truncations.all()
    tags = np.asarray(observations)[..., 66:]
    if mode == "same-step":
        final = np.asarray(infos["final_obs"])[..., 66:]
        np.testing.assert_array_equal(final.argmax(axis=-1), one)
        np.testing.assert_array_equal(tags.argmax(axis=-1), two)
        np.testing.assert_array_equal(np.asarray(envs.species), two)
        return
    np.testing.assert_array_equal(tags.argmax(axis=-1), one)
    if mode == "next-step":
        observations, *_ = envs.step(actions)
    else:
        mask = np.array([True, False, True])
        observations, _ = envs.reset(options={"reset_mask": mask})
        two[1] = one[1]
    assert isinstance(observations, torch.Tensor) == (output == "torch")
    np.testing.assert_array_equal(np.asarray(observations)[..., 66:].argmax(axis=-1), two)


def test_tags_stand_behind_what_other_wrappers_make_of_the_rows():
    env, plain = SpeciesTags(NormalizePerception(single()), 2), NormalizePerception(single())
    observation, _ = env.reset(seed=0)
    np.testing.assert_array_equal(observation[:, :66], plain.reset(seed=0)[0])
    np.testing.assert_array_equal(observation[:, 66:].argmax(axis=1), env.species)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: SpeciesTags(single(), 0), "species_count must be a whole number"),
        (lambda: SpeciesTags(single(), 2, fractions=[1.0]), "fractions must be 2 numbers"),
        (lambda: SpeciesTags(single(), 2, fractions=[1.0, -1.0]), "greater than 0"),
        (lambda: SpeciesTags(single(), 2, fractions=[1, 1e-4]), "leave each species a particle"),
        (lambda: SpeciesTags(single(), 2, assignment="block"), "did you mean 'blocks'"),
        (
            lambda: SpeciesTags(gym.wrappers.FlattenObservation(single())),
            r"each of 64 particles.* put SpeciesTags under",
        ),
        (
            lambda: SpeciesTags(gym.wrappers.TimeAwareObservation(single(), flatten=False)),
            "a row for each of 64 particles, got Dict",
        ),
        (
            lambda: VectorSpeciesTags(
                gym.wrappers.vector.FlattenObservation(batched(autoreset_mode="disabled"))
            ),
            "put VectorSpeciesTags under",
        ),
    ],
)
def test_a_mistake_is_named(make, message):
    with pytest.raises(NPAError, match=message):
        make()
