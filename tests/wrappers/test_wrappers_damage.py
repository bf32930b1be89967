"""Damage on a schedule, in single and vector environments."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from small_envs import assert_same
from wrapped_envs import STEPS, batched, policy, single

import npa_envs  # noqa: F401 (registers the environments)
from npa_envs.errors import NPAError
from npa_envs.tasks.damage import DamageEvent, parse_damage
from npa_envs.wrappers import (
    DamageEvents,
    NormalizePerception,
    VectorDamageEvents,
    VectorNormalizePerception,
)


def episodes_of_one(seed, events, count=2, **keywords):
    """Observation, reward and info of every step of some episodes, the first reset included."""
    env = DamageEvents(single(), events, **keywords)
    for k in range(count):
        observation, info = env.reset(seed=seed if k == 0 else None)
        yield observation, None, info
        done = False
        while not done:
            observation, reward, terminated, truncated, info = env.step(policy(observation))
            done = terminated or truncated
            yield observation, reward, info


def test_an_event_is_written_as_it_is_read_and_has_the_usual_size_without_one():
    for text in ("100:cut", "0:wipe:0.25", "7:noise:0.01"):
        assert str(parse_damage(text)) == text
    assert (parse_damage("5:clump").extent, parse_damage("5:clump").text) == (0.2, "clump 0.2")
    assert DamageEvent(5, "clump", 0.3).extent == 0.3


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: DamageEvent(1, "burn"), "unknown damage 'burn'"),
        (lambda: DamageEvent(-1, "cut"), "whole number of at least 0"),
        (lambda: DamageEvent(1, "cut", 0.0), "positive and finite"),
        (lambda: parse_damage("1:cut:nan"), "STEP:KIND"),
        (lambda: parse_damage("1:cut:0.1:2"), "STEP:KIND"),
        (lambda: DamageEvents(single(), []), "at least one event"),
        (lambda: DamageEvents(single(), ["3:burn"]), "unknown damage 'burn'"),
        (lambda: DamageEvents(single(), [3]), "text or a DamageEvent"),
        (lambda: DamageEvents(single(), 5), "text or a DamageEvent, got int"),
        (lambda: DamageEvents(single(), None), "text or a DamageEvent, got NoneType"),
        (lambda: DamageEvents(single(), "3:cut", every=0), "every must be a whole number"),
        (lambda: DamageEvents(batched(), "3:cut"), "use VectorDamageEvents"),
        (lambda: VectorDamageEvents(single(), "3:cut"), "use DamageEvents for a single"),
        (lambda: DamageEvents(gym.make("CartPole-v1"), "3:cut"), "environment of npa_envs"),
        (
            lambda: DamageEvents(NormalizePerception(single()), "3:cut"),
            "put DamageEvents under the wrappers",
        ),
        (
            lambda: VectorDamageEvents(VectorNormalizePerception(batched()), "3:cut"),
            "put VectorDamageEvents under the wrappers",
        ),
    ],
)
def test_a_mistake_is_named(make, message):
    with pytest.raises(NPAError, match=message):
        make()


def test_damage_comes_after_the_step_of_its_number_and_not_before():
    plain, hurt = single(), DamageEvents(single(), "3:wipe:0.2")
    observation, _ = plain.reset(seed=5)
    np.testing.assert_array_equal(hurt.reset(seed=5)[0], observation)
    for step in range(1, 4):
        action = policy(observation)
        expected, seen = plain.step(action), hurt.step(action)
        assert seen[1] == expected[1]
        assert ("loss_damage" in seen[4]) == (step == 3)
        observation = expected[0]
        if step < 3:
            np.testing.assert_array_equal(seen[0], observation)
    x, s = plain.unwrapped.particles()
    hurt_x, hurt_s = hurt.unwrapped.particles()
    wiped = (hurt_s != s).any(dim=1)
    assert torch.equal(hurt_x, x)
    assert (hurt_s[wiped] == 0).all()
    assert 1 <= wiped.sum() < 64
    assert torch.pdist(x[wiped]).max() <= 0.4


def test_damage_gives_no_reward_and_info_says_how_much_was_lost():
    losses, rewards, damage = [], [], []
    for _, reward, info in episodes_of_one(2, "4:clump:0.5", count=1):
        losses.append(info["loss"])
        rewards.append(reward)
        damage.append(info.get("loss_damage", 0.0))
        parts = info["loss_density"] + info["loss_colour"]
        assert parts == pytest.approx(info["loss"], rel=1e-6)
    assert damage[4] != 0.0
    assert sum(value != 0 for value in damage) == 1
    for k in range(1, STEPS + 1):
        assert rewards[k] == pytest.approx(losses[k - 1] - losses[k] + damage[k], abs=1e-5)


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
    one = DamageEvents(single(), [f"2:{kind}", "5:cut", f"2:{kind}"])
    stack = DamageEvents(single(), [f"2:{kind}", "5:cut"])
    stack = DamageEvents(gym.wrappers.ClipAction(stack), f"2:{kind}")
    envs = VectorDamageEvents(batched(2), [f"2:{kind}", "5:cut"])
    envs = VectorDamageEvents(gym.wrappers.vector.ClipAction(envs), f"2:{kind}")
    alone = DamageEvents(single(), f"2:{kind}")
    for env in (one, stack, alone):
        observation, _ = env.reset(seed=6)
    envs.reset(seed=6)
    for step in range(1, 6):
        action = policy(observation)
        expected, *_, info = one.step(action)
        seen, *_, stack_info = stack.step(action)
        batch, *_, infos = envs.step(np.stack([action] * 2))
        lone, *_ = alone.step(action)
        np.testing.assert_array_equal(seen, expected)
        np.testing.assert_array_equal(batch[0], expected)
        assert ("loss_damage" in stack_info) == ("loss_damage" in info) == (step in (2, 5))
        if step == 2:
            assert not np.array_equal(lone, expected), "the two events damaged one place"
        if step in (2, 5):
            assert stack_info["loss_damage"] == pytest.approx(info["loss_damage"], abs=1e-6)
            assert infos["loss_damage"][0] == pytest.approx(info["loss_damage"], abs=1e-6)
            assert infos["_loss_damage"].tolist() == [True, True]
        assert stack_info["loss"] == infos["loss"][0] == info["loss"]
        observation = expected


@pytest.mark.parametrize("output", ["numpy", "torch"])
def test_a_stack_tells_of_worlds_that_only_one_of_its_wrappers_damaged(output):
    envs = VectorDamageEvents(batched(output=output), "2:cut")
    envs = VectorDamageEvents(envs, "3:wipe:1")
    observations, _ = envs.reset(seed=0)
    envs.step(policy(observations))
    observations, _ = envs.reset(options={"reset_mask": np.array([True, False, False])})
    observations, *_ = envs.step(policy(observations))
    observations, *_, infos = envs.step(policy(observations))
    assert infos["_loss_damage"].tolist() == [True, True, True]
    assert all(infos["loss_damage"].tolist())
    assert isinstance(infos["loss_damage"], torch.Tensor) == (output == "torch")
    assert isinstance(observations, torch.Tensor) == (output == "torch")


@pytest.mark.parametrize(
    ("events", "every"),
    [
        (["3:cut", "5:wipe:0.3", "5:noise"], None),
        ("0:clump:0.3", None),
        (["2:wipe:0.2"], 3),
    ],
)
def test_world_k_is_damaged_as_the_single_environment(events, every):
    envs = VectorDamageEvents(batched(), events, every=every)
    singles = [list(episodes_of_one(11 + k, events, every=every)) for k in range(3)]
    observations, infos = envs.reset(seed=11)
    first = [(0, observations, None, infos)]
    second = []
    for t in range(1, 2 * STEPS):
        observations, rewards, _, truncations, infos = envs.step(policy(observations))
        where = first if t <= STEPS else second
        if truncations.all():
            where.append((t, infos["final_obs"], rewards, infos["final_info"]))
            # The same step returns the next episode's first observation, damaged where it is due.
            second.append((t + 1, observations, None, infos))
        else:
            where.append((t if t < STEPS else t + 1, observations, rewards, infos))
    assert len(first) == STEPS + 1
    damaged = 0
    for index, observation, reward, info in first + second:
        for k in range(3):
            expected_observation, expected_reward, expected_info = singles[k][index]
            np.testing.assert_array_equal(observation[k], expected_observation)
            if reward is not None:
                assert reward[k] == expected_reward
            assert info["loss"][k] == expected_info["loss"]
            hurt = info.get("_loss_damage", np.zeros(3, bool))[k]
            assert hurt == ("loss_damage" in expected_info)
            if hurt:
                assert info["loss_damage"][k] == expected_info["loss_damage"]
                assert info["loss"].dtype == np.float64
                damaged += 1
    assert damaged >= 6


def test_worlds_are_damaged_by_their_own_episodes():
    envs = VectorDamageEvents(batched(), "3:cut")
    observations, _ = envs.reset(seed=0)
    for _ in range(2):
        observations, *_ = envs.step(policy(observations))
    observations, _ = envs.reset(options={"reset_mask": np.array([False, True, False])})
    seen = []
    for _ in range(4):
        observations, _, _, _, infos = envs.step(policy(observations))
        seen.append(infos.get("_loss_damage", np.zeros(3, bool)).tolist())
    none = [False] * 3
    assert seen == [[True, False, True], none, [False, True, False], none]


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
        envs = VectorDamageEvents(batched(copy=copy, reward="particle"), "2:clump:0.4", every=2)
        observations, _ = envs.reset(seed=4)
        way = []
        for _ in range(STEPS - 1):
            observations, rewards, _, _, infos = envs.step(policy(observations))
            way += [observations.copy(), rewards.copy(), infos["particle_reward"].copy()]
        ways.append(way)
    assert all((reward != 0).all() for reward in ways[0][1::3])
    assert_same(*ways)


def test_the_spec_says_what_is_done():
    env = DamageEvents(single(), ["3:cut", DamageEvent(5, "wipe", 0.3)], every=4)
    wrapper = env.spec.additional_wrappers[-1]
    assert wrapper.kwargs == {"events": ["3:cut", "5:wipe:0.3"], "every": 4}


def test_what_is_context_info_a_damaged_world_is_context_info_it_as_it_is():
    keywords = {"particle_count": 64, "grow_steps": 32}
    env = DamageEvents(gym.make("npa/Shepherd2DSmall-v0", **keywords), "1:clump:0.6")
    env.reset(seed=0)
    env.action_space.seed(0)
    observation, *_, info = env.step(env.action_space.sample())
    assert info["loss_damage"] > 0.0
    assert info["lost"] == pytest.approx(float(observation["achieved_goal"][2]), rel=1e-5)
    vector = gym.make_vec("npa/Shepherd2DSmall-v0", num_envs=2, **keywords)
    envs = VectorDamageEvents(vector, "1:clump:0.6")
    envs.reset(seed=0)
    envs.action_space.seed(0)
    observations, *_, infos = envs.step(envs.action_space.sample())
    lost = observations["achieved_goal"][:, 2]
    # What is observed stays within the space.
    largest = envs.observation_space["achieved_goal"].high[:, 2]
    np.testing.assert_allclose(np.minimum(infos["lost"], largest), lost, rtol=1e-5)


def test_vector_environments_show_no_world_before_there_is_one():
    envs = gym.make_vec("npa/Morphogenesis2DSmall-v0", num_envs=2, render_mode="rgb_array")
    with pytest.raises(NPAError, match="render needs worlds: call reset first"):
        envs.render()
    envs.reset(seed=0)
    assert len(envs.render()) == 2
