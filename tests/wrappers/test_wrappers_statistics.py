"""Torch versions of Gymnasium's statistics wrappers, held to Gymnasium's own."""

import numpy as np
import pytest
import torch
from gymnasium.wrappers.vector import (
    NormalizeObservation,
    NormalizeReward,
    RecordEpisodeStatistics,
)
from wrapped_envs import ACTIONS, STEPS, batched

import npa_envs  # noqa: F401 (registers the environments)
from npa_envs.errors import NPAError
from npa_envs.wrappers import (
    TorchNormalizeObservation,
    TorchNormalizeReward,
    TorchRecordEpisodeStatistics,
)

MODES = ["same-step", "next-step", "disabled"]


def pair(torch_wrapper, wrapper, mode="same-step", **keywords):
    """The same worlds, with tensors under ours and with arrays under Gymnasium's."""
    ours = torch_wrapper(batched(autoreset_mode=mode, output="torch"), **keywords)
    return ours, wrapper(batched(autoreset_mode=mode), **keywords)


def actions(step):
    return np.random.default_rng(step).uniform(-1, 1, (3, 64, ACTIONS)).astype(np.float32)


@pytest.mark.parametrize("mode", MODES)
def test_episodes_are_recorded_as_by_gymnasium(mode):
    ours, theirs = pair(
        TorchRecordEpisodeStatistics, RecordEpisodeStatistics, mode, buffer_length=5
    )
    ours.reset(seed=0)
    theirs.reset(seed=0)
    # World 1 falls out of step with the others.
    for step in range(2):
        ours.step(actions(step))
        theirs.step(actions(step))
    mask = np.array([False, True, False])
    ours.reset(options={"reset_mask": mask})
    theirs.reset(options={"reset_mask": mask})
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


def test_returns_are_the_sum_of_the_rewards():
    env = TorchRecordEpisodeStatistics(batched(output="torch"))
    env.reset(seed=0)
    total = torch.zeros(3, dtype=torch.float64)
    for step in range(STEPS):
        _, rewards, _, _, infos = env.step(actions(step))
        total += rewards
    assert torch.equal(infos["episode"]["r"], total)
    assert list(env.return_queue) == total.tolist()
    assert (env.episode_returns == 0).all()


def test_observations_are_normalised_as_by_gymnasium():
    ours, theirs = pair(TorchNormalizeObservation, NormalizeObservation, "next-step")
    one, _ = ours.reset(seed=0)
    other, _ = theirs.reset(seed=0)
    np.testing.assert_allclose(one, other, atol=1e-3)
    for step in range(2 * STEPS):
        one, *_ = ours.step(actions(step))
        other, *_ = theirs.step(actions(step))
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-3)
    ours.update_running_mean = False
    mean = ours.obs_rms.mean
    ours.step(actions(0))
    assert torch.equal(ours.obs_rms.mean, mean)
    assert one.dtype == torch.float32
    assert ours.observation_space.shape == (3, 64, 66)


def test_a_reset_of_one_world_counts_only_that_world():
    ours = TorchNormalizeObservation(batched(4, autoreset_mode="disabled", output="torch"))
    plain = batched(4, autoreset_mode="disabled", output="torch")
    seen = [plain.reset(seed=0)[0]]
    ours.reset(seed=0)
    for step in range(2):
        action = np.concatenate((actions(step), actions(step + 100)[:1]))
        ours.step(action)
        seen.append(plain.step(action)[0])
    options = {"reset_mask": np.array([False, False, True, False])}
    one, _ = ours.reset(options=options)
    other, _ = plain.reset(options=options)
    wanted = torch.cat((*seen, other[2:3])).double()
    rms = ours.obs_rms
    assert rms.count == pytest.approx(13, abs=1e-3)
    torch.testing.assert_close(rms.mean, wanted.mean(dim=0), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(
        one, ((other - rms.mean) / (rms.var + 1e-8).sqrt()).float(), rtol=1e-4, atol=1e-4
    )


def test_final_observations_are_normalised_too():
    env = TorchNormalizeObservation(batched(output="torch"))
    plain = batched(output="torch")
    env.reset(seed=0)
    plain.reset(seed=0)
    for step in range(STEPS):
        *_, infos = env.step(actions(step))
        *_, expected = plain.step(actions(step))
    rms = env.obs_rms
    wanted = (expected["final_obs"] - rms.mean) / (rms.var + 1e-8).sqrt()
    torch.testing.assert_close(infos["final_obs"], wanted.float(), rtol=1e-4, atol=1e-4)


def test_rewards_are_normalised_as_by_gymnasium():
    ours, theirs = pair(TorchNormalizeReward, NormalizeReward, gamma=0.9)
    ours.reset(seed=0)
    theirs.reset(seed=0)
    for step in range(3 * STEPS):
        _, one, *_ = ours.step(actions(step))
        _, other, *_ = theirs.step(actions(step))
        np.testing.assert_allclose(one, other, rtol=1e-4)
    assert one.dtype == torch.float32
    assert float(ours.return_rms.var) == pytest.approx(theirs.return_rms.var, rel=1e-4)


@pytest.mark.parametrize("mode", MODES)
def test_the_return_begins_anew_with_each_episode(mode):
    plain = batched(autoreset_mode=mode, output="torch")
    env = TorchNormalizeReward(batched(autoreset_mode=mode, output="torch"), gamma=0.5)
    env.reset(seed=0)
    plain.reset(seed=0)
    returns, seen, fresh = torch.zeros(3, dtype=torch.float64), [], True
    for step in range(2 * STEPS + 1):
        _, rewards, _, truncations, _ = plain.step(actions(step))
        env.step(actions(step))
        if fresh or mode != "next-step":
            returns = returns * 0.5 + rewards
            seen.append(returns)
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


def test_they_stack():
    env = TorchNormalizeReward(
        TorchNormalizeObservation(TorchRecordEpisodeStatistics(batched(output="torch")))
    )
    env.reset(seed=0)
    for step in range(STEPS):
        observations, rewards, _, _, infos = env.step(actions(step))
    assert infos["episode"]["l"].tolist() == [STEPS] * 3
    assert observations.isfinite().all()
    assert rewards.shape == (3,)


@pytest.mark.parametrize(
    "wrapper", [TorchRecordEpisodeStatistics, TorchNormalizeObservation, TorchNormalizeReward]
)
def test_numpy_environments_are_sent_to_gymnasium(wrapper):
    env = wrapper(batched())

    def use():
        env.reset(seed=0)
        env.step(actions(0))

    with pytest.raises(NPAError, match=f"vector.{wrapper.__name__.removeprefix('Torch')}"):
        use()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda env: TorchRecordEpisodeStatistics(env, 0), "buffer_length must be"),
        (lambda env: TorchNormalizeObservation(env, epsilon=0.0), "epsilon must be"),
        (lambda env: TorchNormalizeReward(env, gamma=1.5), r"gamma must lie in \[0, 1\]"),
    ],
)
def test_a_mistake_is_named(make, message):
    with pytest.raises(NPAError, match=message):
        make(batched(output="torch"))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_everything_stays_on_the_device():
    env = TorchNormalizeReward(
        TorchNormalizeObservation(
            TorchRecordEpisodeStatistics(batched(output="torch", device="cuda"))
        )
    )
    env.reset(seed=0)
    for step in range(STEPS):
        observations, rewards, _, _, infos = env.step(actions(step))
    for tensor in (observations, rewards, infos["_episode"], infos["episode"]["r"]):
        assert tensor.is_cuda
