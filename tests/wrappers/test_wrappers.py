"""Damage, species tags, rows of particles, and Gymnasium's own wrappers."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import wrappers
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import vector
from support.small_envs import assert_batch_of_singles, assert_same, begun
from support.wrapped_envs import ACTIONS, STEPS, batched, policy, single

import npa_envs  # noqa: F401 (registers the environments)
from npa_envs.tasks.damage import DamageEvent, parse_damage
from npa_envs.wrappers import (
    DamageEvents,
    NormalizePerception,
    ParticleRows,
    SpeciesTags,
    VectorDamageEvents,
    VectorSpeciesTags,
)


def test_an_event_is_written_as_it_is_read_and_has_the_usual_size_without_one():
    for text in ("100:cut", "0:wipe:0.25", "7:noise:0.01"):
        assert str(parse_damage(text)) == text
    assert parse_damage("5:clump").text == "clump 0.2"
    assert DamageEvent(5, "clump", 0.3).text == "clump 0.3"


def test_damage_comes_after_the_step_of_its_number_and_is_not_in_its_reward():
    plain, hurt = single(), DamageEvents(single(), "3:wipe:0.2")
    observation, _ = plain.reset(seed=5)
    np.testing.assert_array_equal(hurt.reset(seed=5)[0], observation)
    for step in range(1, 4):
        action = policy(observation)
        observation, reward, *_, expected = plain.step(action)
        hurt_observation, hurt_reward, *_, info = hurt.step(action)
        assert hurt_reward == reward
        assert ("loss_damage" in info) == (step == 3)
        if step < 3:
            np.testing.assert_array_equal(hurt_observation, observation)
    assert info["loss_damage"] != 0.0
    assert info["loss"] == pytest.approx(expected["loss"] + info["loss_damage"], abs=1e-6)
    assert info["loss_density"] + info["loss_colour"] == pytest.approx(info["loss"], rel=1e-6)
    x, s = plain.unwrapped.particles()
    hurt_x, hurt_s = hurt.unwrapped.particles()
    wiped = (hurt_s != s).any(dim=1)
    assert torch.equal(hurt_x, x)
    assert (hurt_s[wiped] == 0).all()
    assert 1 <= wiped.sum() < 64
    assert torch.pdist(x[wiped]).max() <= 0.4


def test_damage_leaves_the_randomness_of_later_steps_as_it_is():
    plain, hurt = single(), DamageEvents(single(), ["2:cut", "2:noise"])
    observation, _ = plain.reset(seed=1)
    hurt.reset(seed=1)
    for _ in range(2):
        action = policy(observation)
        observation, *_ = plain.step(action)
        damaged, *_ = hurt.step(action)
    assert not np.array_equal(damaged, observation)
    hurt.unwrapped.place_particles(*plain.unwrapped.particles())
    for _ in range(3):
        action = policy(observation)
        observation, *_ = plain.step(action)
        np.testing.assert_array_equal(hurt.step(action)[0], observation)


@pytest.mark.parametrize("kind", ["wipe:0.3", "cut", "clump:0.4", "noise"])
def test_a_stack_of_wrappers_damages_as_one_with_all_events(kind):
    events = [f"2:{kind}", "5:cut"]
    one, alone = DamageEvents(single(), [*events, f"2:{kind}"]), DamageEvents(single(), events[0])
    stack = DamageEvents(wrappers.ClipAction(DamageEvents(single(), events)), f"2:{kind}")
    begun(one, stack, alone, seed=6)
    for step in range(1, 6):
        action = np.random.default_rng(step).uniform(-1, 1, (64, ACTIONS)).astype(np.float32)
        expected, seen, lone = (env.step(action) for env in (one, stack, alone))
        np.testing.assert_array_equal(seen[0], expected[0])
        assert seen[4]["loss"] == expected[4]["loss"]
        lost = [info.get("loss_damage") for info in (seen[4], expected[4])]
        assert (lost == [None, None]) == (step not in (2, 5))
        assert lost[0] == (lost[1] and pytest.approx(lost[1], abs=1e-6))
        if step == 2:
            assert not np.array_equal(lone[0], expected[0]), "the two events damaged one place"


@pytest.mark.parametrize("output", ["numpy", "torch"])
def test_worlds_are_damaged_by_their_own_episodes_in_all_layers_of_a_stack(output):
    envs = VectorDamageEvents(VectorDamageEvents(batched(output=output), "2:cut"), "3:wipe:1")
    observations, _ = envs.reset(seed=0)
    envs.step(policy(observations))
    observations, _ = envs.reset(options={"reset_mask": np.array([True, False, False])})
    observations, *_, infos = envs.step(policy(observations))
    assert infos["_loss_damage"].tolist() == [False, True, True]
    observations, *_, infos = envs.step(policy(observations))
    assert infos["_loss_damage"].tolist() == [True, True, True]
    assert all(infos["loss_damage"].tolist())
    assert isinstance(infos["loss_damage"], torch.Tensor) == (output == "torch")
    assert isinstance(observations, torch.Tensor) == (output == "torch")


@pytest.mark.parametrize("mode", ["same-step", "next-step", "disabled"])
def test_an_episode_that_is_over_is_left_alone(mode):
    envs = VectorDamageEvents(batched(autoreset_mode=mode), [f"{STEPS}:wipe:3", "0:cut"])
    observations, infos = envs.reset(seed=0)
    assert infos["_loss_damage"].all()
    for _ in range(STEPS):
        observations, _, _, truncations, infos = envs.step(policy(observations))
    assert truncations.all()
    _, s = envs.unwrapped.particles()
    assert ("_loss_damage" in infos) == (mode == "same-step")
    assert bool((s == 0).all()) == (mode == "same-step")
    if mode == "next-step":
        *_, infos = envs.step(policy(observations))
        assert infos["_loss_damage"].all()


def test_reused_buffers_show_the_same():
    ways = []
    for copy in (True, False):
        envs = VectorDamageEvents(batched(copy=copy, reward="particle"), "2:clump:0.4")
        observations, _ = envs.reset(seed=4)
        way = []
        for _ in range(STEPS - 1):
            observations, rewards, _, _, infos = envs.step(policy(observations))
            way += [observations.copy(), rewards.copy(), infos["particle_reward"].copy()]
        ways.append(way)
    assert all((reward != 0).all() for reward in ways[0][1::3])
    assert_same(*ways)


def test_the_spec_says_what_is_done():
    env = DamageEvents(single(), ["3:cut", DamageEvent(5, "wipe", 0.3)])
    assert env.spec.additional_wrappers[-1].kwargs == {"events": ["3:cut", "5:wipe:0.3"]}


def test_infos_and_goals_of_a_damaged_garden_are_those_after_the_damage():
    keywords = {"particle_count": 64, "grow_steps": 32}
    env = begun(DamageEvents(gym.make("npa/Shepherd2DSmall-v0", **keywords), "1:clump:0.6"))
    env.action_space.seed(0)
    observation, *_, info = env.step(env.action_space.sample())
    assert info["loss_damage"] > 0.0
    assert info["lost"] == pytest.approx(float(observation["achieved_goal"][2]), rel=1e-5)
    worlds = gym.make_vec("npa/Shepherd2DSmall-v0", num_envs=2, **keywords)
    envs = begun(VectorDamageEvents(worlds, "1:clump:0.6"))
    envs.action_space.seed(0)
    observations, *_, infos = envs.step(envs.action_space.sample())
    lost = observations["achieved_goal"][:, 2]
    # What is observed stays within the space.
    largest = envs.observation_space["achieved_goal"].high[:, 2]
    np.testing.assert_allclose(np.minimum(infos["lost"], largest), lost, rtol=1e-5)


# World k is as the single one


STACK = (
    lambda env: DamageEvents(wrappers.ClipAction(DamageEvents(env, "2:cut")), "2:cut"),
    lambda env: VectorDamageEvents(vector.ClipAction(VectorDamageEvents(env, "2:cut")), "2:cut"),
)
DAMAGE, TAGS = (DamageEvents, VectorDamageEvents), (SpeciesTags, VectorSpeciesTags)
WRAPPERS = {
    "damage": (DAMAGE, (["3:cut", "5:wipe:0.3", "5:noise"],)),
    "damage of the start": (DAMAGE, ("0:clump:0.3",)),
    "a stack of damage": (STACK, ()),
    "tags": (TAGS, (3,)),
}


@pytest.mark.parametrize("mode", ["same-step", "next-step"])
@pytest.mark.parametrize("output", ["numpy", "torch"])
@pytest.mark.parametrize("kind", WRAPPERS)
def test_world_k_is_as_the_single_environment_over_autoresets(kind, output, mode):
    (one, many), arguments = WRAPPERS[kind]
    envs = many(batched(autoreset_mode=mode, output=output), *arguments)
    singles = [one(single(episode_steps=STEPS), *arguments) for _ in range(3)]
    envs.action_space.seed(0)
    actions = [envs.action_space.sample() for _ in range(2 * STEPS + 1)]
    reasons, _ = assert_batch_of_singles(envs, singles, actions, mode)
    assert reasons == {None, "time limit"}


# Species tags


@pytest.mark.parametrize(
    ("below", "counts"), [(lambda env: env, [32, 32]), (NormalizePerception, [21, 22, 21])]
)
def test_tags_stand_behind_what_wrappers_below_give(below, counts):
    count = len(counts)
    env, plain = SpeciesTags(below(single()), count), below(single())
    observation, _ = env.reset(seed=0)
    np.testing.assert_array_equal(observation[:, :66], plain.reset(seed=0)[0])
    np.testing.assert_array_equal(env.species, np.repeat(np.arange(count), counts))
    np.testing.assert_array_equal(observation[:, 66:], np.eye(count, dtype=np.float32)[env.species])
    later, *_ = env.step(np.full((64, ACTIONS), 0.1, np.float32))
    np.testing.assert_array_equal(later[:, 66:], observation[:, 66:])
    assert env.observation_space.shape == (64, 66 + count)
    assert env.observation_space.contains(later)
    assert env.observation_space.high[0, -1] == 1.0
    assert env.observation_space.low[0, -1] == 0.0


def test_partial_resets_pass_through_gymnasiums_statistics():
    env = begun(VectorDamageEvents(vector.RecordEpisodeStatistics(batched()), "0:cut"))
    options = {"reset_mask": np.array([True, False, False])}
    _, infos = env.reset(options=options)
    assert infos["_loss_damage"].tolist() == [True, False, False]
    assert "reset_mask" in options


# Particles as rows


def worlds_of(count=2, **keywords):
    return batched(count, autoreset_mode="next-step", **keywords)


@pytest.mark.parametrize("output", ["numpy", "torch"])
@pytest.mark.parametrize("reward", ["particle", "dense"])
def test_rows_are_the_particles_of_the_worlds_in_order(reward, output):
    keywords = {"reward": reward}
    rows, envs = ParticleRows(worlds_of(output=output, **keywords)), worlds_of(**keywords)
    assert rows.num_envs == 128
    assert rows.single_observation_space == gym.spaces.Box(-64.0, 64.0, (66,), np.float32)
    assert rows.action_space.shape == (128, ACTIONS)
    assert rows.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    seen, _ = rows.reset(seed=3)
    observation, _ = envs.reset(seed=3)
    for step in range(1, 2 * STEPS + 1):
        np.testing.assert_array_equal(seen, observation.reshape(128, 66))
        seen, rewards, ended, cut, infos = rows.step(policy(seen))
        observation, paid, _, truncations, world_infos = envs.step(policy(observation))
        by_particle = reward == "particle"
        expected = np.repeat(paid, 64)
        if by_particle:
            # In steps in which all worlds restart infos are those of resets.
            expected = world_infos.get("particle_reward", expected).ravel()
        np.testing.assert_array_equal(rewards, expected.astype(np.float64))
        np.testing.assert_array_equal(cut, np.repeat(truncations, 64))
        assert cut.all() == cut.any() == (step % (STEPS + 1) == STEPS)
        assert not ended.any()
        assert infos == {}


def test_gymnasiums_wrappers_lie_over_rows_and_close_them():
    rows = begun(vector.RecordEpisodeStatistics(ParticleRows(worlds_of())))
    for _ in range(STEPS):
        *_, infos = rows.step(np.zeros((128, ACTIONS), np.float32))
    assert infos["episode"]["l"].tolist() == [STEPS] * 128
    envs = worlds_of()
    listed = vector.DictInfoToList(ParticleRows(envs))
    assert listed.reset(seed=0)[1] == [{}] * 128
    assert not envs.closed
    listed.close()
    assert envs.closed
    listed.close()
