"""Wrappers with running statistics; torch versions of Gymnasium's are held to Gymnasium's own."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from support.small_envs import begun
from support.wrapped_envs import ACTIONS, STEPS, batched, policy, single

import npa_envs  # noqa: F401 (registers the environments)
from npa_envs.wrappers import (
    NormalizePerception,
    TorchNormalizeObservation,
    TorchNormalizeReward,
    TorchRecordEpisodeStatistics,
    VectorNormalizePerception,
)

C, D, P = 16, 2, 66


def expected_scales(z):
    """Mean and standard deviation of each entry by group, from all samples at once."""
    z = z.reshape(-1, P).astype(np.float64)
    mean, var = z.mean(axis=0), z.var(axis=0)
    gradients = (z[:, 2 * C : -D] ** 2).mean(axis=0).reshape(C, D).mean(axis=1)
    mean[2 * C :] = 0.0
    var[2 * C : -D] = gradients.repeat(D)
    var[-D:] = (z[:, -D:] ** 2).mean()
    return mean, np.sqrt(var)


def walked(env, plain, count, seed=0):
    """Step two environments alike; return their last observations, and all of the second one."""
    normal, (z, _) = env.reset(seed=seed)[0], plain.reset(seed=seed)
    seen = [z]
    for _ in range(count):
        action = policy(z)
        normal, z = env.step(action)[0], plain.step(action)[0]
        seen.append(z)
    return normal, z, seen


@pytest.mark.parametrize("kind", ["single", "vector", "torch"])
def test_statistics_are_those_of_everything_seen(kind):
    if kind == "single":
        env, plain = NormalizePerception(single()), single()
    else:
        output = "torch" if kind == "torch" else "numpy"
        env, plain = VectorNormalizePerception(batched(output=output)), batched()
    normal, z, seen = walked(env, plain, STEPS - 2, seed=2)
    mean, deviation = expected_scales(np.stack(seen))
    wanted = np.clip((z - mean) / deviation, -10, 10)
    assert isinstance(normal, torch.Tensor) == (kind == "torch")
    normal = np.asarray(normal)
    assert normal.dtype == np.float32
    np.testing.assert_allclose(normal, wanted, rtol=1e-3, atol=1e-3)
    assert env.observation_space.contains(normal)


def test_frozen_statistics_stay_and_can_be_saved_and_shared(tmp_path):
    env = VectorNormalizePerception(batched())
    z, _ = env.reset(seed=0)
    for _ in range(3):
        z, *_ = env.step(policy(z))
    torch.save(env.state_dict(), tmp_path / "statistics.pt")
    test = VectorNormalizePerception(batched(), training=False)
    test.load_state_dict(torch.load(tmp_path / "statistics.pt"))
    shared = VectorNormalizePerception(batched(), training=False)
    shared.statistics = env.statistics
    env.training = False
    state = env.state_dict()
    seen = [wrapper.reset(seed=9)[0] for wrapper in (env, test, shared)]
    np.testing.assert_array_equal(seen[0], seen[1])
    np.testing.assert_array_equal(seen[0], seen[2])
    for name, value in env.state_dict().items():
        assert torch.equal(value, state[name])


def expected_entries(z):
    """Likewise of each particle's entries, with a little of mean 0 and variance 1."""
    prior, count = 1e-4, len(z)
    mean, var = z.mean(axis=0, dtype=np.float64), z.var(axis=0, dtype=np.float64)
    total = prior + count
    var = (prior + var * count + mean**2 * prior * count / total) / total
    return mean * count / total, np.sqrt(var + 1e-8)


@pytest.mark.parametrize(("each", "output"), [(False, "numpy"), (False, "torch"), (True, "torch")])
def test_a_reset_of_one_world_counts_only_what_it_perceives(each, output):
    keywords = {"autoreset_mode": "disabled"}
    wrapper = TorchNormalizeObservation if each else VectorNormalizePerception
    env, plain = wrapper(batched(4, output=output, **keywords)), batched(4, **keywords)
    _, z, seen = walked(env, plain, 2, seed=3)
    options = {"reset_mask": np.array([False, True, False, False])}
    normal, (z, _) = env.reset(options=options)[0], plain.reset(options=options)
    moments, samples = (env.obs_rms, 1) if each else (env.statistics, 64)
    assert moments.count == pytest.approx(13 * samples, abs=1e-3)
    expected = expected_entries if each else expected_scales
    mean, deviation = expected(np.concatenate([*seen, z[1:2]]))
    wanted = (z - mean) / deviation
    wanted = wanted if each else np.clip(wanted, -10, 10)
    np.testing.assert_allclose(np.asarray(normal), wanted, rtol=1e-3, atol=1e-3)
    env.step(np.zeros((4, 64, ACTIONS), np.float32))
    assert moments.count == pytest.approx(17 * samples, abs=1e-3)


@pytest.mark.parametrize(
    "keywords", [{}, {"clip": 2.0, "epsilon": 0.5, "training": False}], ids=["defaults", "given"]
)
def test_an_environment_made_from_the_spec_is_wrapped_alike(keywords):
    env = NormalizePerception(single(), **keywords)
    spec = gym.envs.registration.EnvSpec.from_json(env.spec.to_json())
    rebuilt = gym.make(spec)
    assert isinstance(rebuilt, NormalizePerception)
    assert rebuilt.training is keywords.get("training", True)
    first, _ = env.reset(seed=1)
    np.testing.assert_array_equal(rebuilt.reset(seed=1)[0], first)
    for _ in range(3):
        action = policy(first)
        first, *_ = env.step(action)
        np.testing.assert_array_equal(rebuilt.step(action)[0], first)
    assert np.abs(first).max() <= keywords.get("clip", 10.0)


def test_blank_worlds_give_finite_numbers():
    env = NormalizePerception(single(), clip=2.0)
    normal, _ = env.reset(seed=0)
    assert np.isfinite(normal).all()
    assert (normal[:, : 2 * C] == 0).all()
    action = np.zeros((64, ACTIONS), np.float32)
    action[0, -1] = 1.0
    sizes = [np.abs(env.step(action)[0]).max() for _ in range(4)]
    assert max(sizes) == 2.0
    assert env.observation_space == gym.spaces.Box(-2.0, 2.0, (64, P), np.float32)


# Of observations, rewards and episodes, as Gymnasium has them


MODES = ["same-step", "next-step", "disabled"]


def actions(step):
    return np.random.default_rng(step).uniform(-1, 1, (3, 64, ACTIONS)).astype(np.float32)


@pytest.mark.parametrize("wrapper", [VectorNormalizePerception, TorchNormalizeObservation])
def test_final_observations_are_normalised_and_not_counted(wrapper):
    env, plain = wrapper(batched(output="torch")), batched(output="torch")
    _, z, _ = walked(env, plain, STEPS - 1, seed=1)
    infos, plain_infos = env.step(policy(z))[4], plain.step(policy(z))[4]
    perceived = wrapper is VectorNormalizePerception
    moments, samples = (env.statistics, 64) if perceived else (env.obs_rms, 1)
    assert moments.count == pytest.approx((STEPS + 1) * 3 * samples, abs=1e-3)
    assert torch.equal(infos["final_obs"], env.changed(plain_infos["final_obs"]))
    assert (infos["final_obs"] - plain_infos["final_obs"]).abs().max() > 0.1
    count = moments.count
    env.training = env.update_running_mean = False
    env.step(policy(z))
    assert moments.count == count


@pytest.mark.parametrize("mode", MODES)
def test_episodes_are_recorded_as_by_gymnasium(mode):
    ours = batched(autoreset_mode=mode, output="torch")
    ours = TorchRecordEpisodeStatistics(ours, buffer_length=5)
    theirs = RecordEpisodeStatistics(batched(autoreset_mode=mode), buffer_length=5)
    # World 1 falls out of step with the others.
    for env in (ours, theirs):
        env.reset(seed=0)
        for step in range(2):
            env.step(actions(step))
        env.reset(options={"reset_mask": np.array([False, True, False])})
    episodes = 0
    for step in range(3 * STEPS):
        *_, infos = ours.step(actions(step))
        *_, expected = theirs.step(actions(step))
        assert ("episode" in infos) == ("episode" in expected)
        if "episode" not in infos:
            continue
        episodes += int(expected["_episode"].sum())
        assert infos["_episode"].tolist() == expected["_episode"].tolist()
        assert infos["episode"]["l"].tolist() == expected["episode"]["l"].tolist()
        np.testing.assert_allclose(infos["episode"]["r"], expected["episode"]["r"], atol=1e-6)
        assert ((infos["episode"]["t"] > 0) == infos["_episode"]).all()
        if mode == "disabled":
            ours.reset(options={"reset_mask": infos["_episode"]})
            theirs.reset(options={"reset_mask": expected["_episode"].copy()})
    assert episodes == ours.episode_count == theirs.episode_count
    assert episodes >= 6
    np.testing.assert_allclose(ours.return_queue, theirs.return_queue, atol=1e-6)
    assert list(ours.length_queue) == list(theirs.length_queue)
    assert len(ours.time_queue) == 5


@pytest.mark.parametrize("mode", MODES)
def test_the_return_begins_again_with_each_episode(mode):
    plain, env = begun(
        batched(autoreset_mode=mode, output="torch"),
        TorchNormalizeReward(batched(autoreset_mode=mode, output="torch"), gamma=0.5),
    )
    returns, seen, fresh = torch.zeros(3, dtype=torch.float64), [], True
    for step in range(2 * STEPS + 1):
        _, rewards, _, truncations, _ = plain.step(actions(step))
        _, scaled, *_ = env.step(actions(step))
        if fresh or mode != "next-step":
            returns = returns * 0.5 + rewards
            seen.append(returns)
            # As Gymnasium has it.
            deviation = (env.return_rms.var + 1e-8).sqrt().float()
            torch.testing.assert_close(scaled, rewards / deviation)
        fresh = True
        if truncations.all():
            returns = torch.zeros(3, dtype=torch.float64)
            fresh = mode != "next-step"
            if mode == "disabled":
                env.reset()
                plain.reset()
    wanted = torch.cat(seen)
    assert env.return_rms.count == pytest.approx(len(wanted), abs=1e-3)
    torch.testing.assert_close(env.return_rms.var, wanted.var(correction=0), rtol=1e-4, atol=4e-6)


def test_they_stack_and_stay_on_the_device(device):
    env = TorchRecordEpisodeStatistics(batched(output="torch", device=str(device)))
    env = begun(TorchNormalizeReward(TorchNormalizeObservation(env)))
    for step in range(STEPS):
        observations, rewards, _, _, infos = env.step(actions(step))
    assert infos["episode"]["l"].tolist() == [STEPS] * 3
    assert observations.isfinite().all()
    assert observations.dtype == torch.float32
    assert env.observation_space.shape == observations.shape == (3, 64, 66)
    assert rewards.shape == (3,)
    for tensor in (observations, rewards, infos["_episode"], infos["episode"]["r"]):
        assert tensor.device.type == device.type
