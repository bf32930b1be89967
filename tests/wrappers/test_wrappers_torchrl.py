"""Batches of worlds in TorchRL; skipped where it is missing."""

import numpy as np
import pytest
import torch
from support import wrapped_envs
from support.refusals import refused
from support.small_envs import make_vec
from support.wrapped_envs import STEPS, policy

torchrl = pytest.importorskip("torchrl.envs")
from tensordict import TensorDict  # noqa: E402
from tensordict.nn import TensorDictModule  # noqa: E402
from torchrl.collectors import Collector  # noqa: E402

from npa_envs.wrappers import NPATorchRLEnv, VectorNormalizePerception  # noqa: E402

pytestmark = pytest.mark.filterwarnings(
    "ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning"
)
IDS = ["npa/Morphogenesis2D-v0", "npa/Regeneration2D-v0", "npa/PointClassification-v0"]
TORCH = {"output": "torch", "autoreset_mode": "disabled"}
ACTING = TensorDictModule(policy, ["observation"], ["action"])


def wrapped(count=3, *, rows=False, **keywords):
    return NPATorchRLEnv(wrapped_envs.batched(count, **TORCH, **keywords), rows=rows)


@pytest.mark.parametrize("rows", [False, True])
@pytest.mark.parametrize("id", IDS)
def test_specs_are_those_of_what_comes(id, rows):
    env = NPATorchRLEnv(make_vec(id, 2, max_episode_steps=3, **TORCH), rows=rows)
    torchrl.check_env_specs(env)
    assert env.batch_size == ((2, 61) if rows else (2,))
    rolled = env.rollout(7, break_when_any_done=False)
    assert rolled.batch_size == (*env.batch_size, 7)
    over = rolled["next", "done"].reshape(-1, 7)
    assert over.all(dim=0).tolist() == over.any(dim=0).tolist() == [k % 3 == 2 for k in range(7)]


@pytest.mark.parametrize("name", ["npa/Shepherd2D-v0", "npa/Gardener2D-v0"])
def test_worlds_with_brushes_have_their_own_observations_and_no_rows(name):
    envs = make_vec(name, 2, max_episode_steps=3, **TORCH)
    env = NPATorchRLEnv(envs)
    torchrl.check_env_specs(env)
    env.set_seed(4)
    rolled = env.rollout(5, break_when_any_done=False)
    single = make_vec(name, 2, max_episode_steps=3, **TORCH)
    seen, _ = single.reset(seed=4)
    for t in range(3):
        named = seen if isinstance(seen, dict) else {"observation": seen}
        for key, value in named.items():
            assert torch.equal(rolled[key][:, t], value)
        seen, rewards, *_ = single.step(rolled["action"][:, t])
        assert torch.equal(rolled["next", "reward"][:, t, 0], rewards)
    refused("rows need an environment that gives", NPATorchRLEnv, envs, rows=True)
    discrete = make_vec(name, 2, actions="discrete", **TORCH)
    refused("env must have actions that are numbers", NPATorchRLEnv, discrete)


def test_a_rollout_is_what_single_environments_give():
    env = wrapped(2)
    env.set_seed(5)
    rolled = env.rollout(2 * STEPS + 2, ACTING, break_when_any_done=False)
    for k in range(2):
        single = wrapped_envs.single()
        observation, _ = single.reset(seed=5 + k)
        for t in range(2 * STEPS + 2):
            assert np.array_equal(rolled["observation"][k, t].numpy(), observation)
            observation, reward, _, truncated, _ = single.step(policy(observation))
            # What the last step led to, also where the next one begins an episode.
            assert np.array_equal(rolled["next", "observation"][k, t].numpy(), observation)
            assert rolled["next", "reward"][k, t].item() == np.float32(reward)
            assert rolled["next", "truncated"][k, t].item() is truncated
            assert not rolled["next", "terminated"][k, t]
            if truncated:
                observation, _ = single.reset()


def test_a_mask_restarts_worlds_alone_and_leaves_the_others_where_they_are():
    env = wrapped(3)
    before = env.rollout(3, ACTING)["next"][:, -1]
    mask = torch.tensor([[False], [True], [False]])
    restarted = env.reset(before.select("observation").set("_reset", mask))
    same = (restarted["observation"] == before["observation"]).flatten(1).all(dim=1)
    assert same.tolist() == [True, False, True]
    rolled = env.rollout(
        STEPS, ACTING, auto_reset=False, tensordict=restarted, break_when_any_done=False
    )
    ends = rolled["next", "truncated"][..., 0].int().argmax(dim=1)
    assert ends.tolist() == [STEPS - 4, STEPS - 1, STEPS - 4]


def test_reached_success_is_a_termination_and_no_truncation():
    env = wrapped(2, success_loss=1e6)
    last = env.rollout(STEPS, ACTING)["next"][:, -1]
    assert last["terminated"].all()
    assert last["done"].all()
    assert not last["truncated"].any()


def test_seeds_are_taken_by_the_next_reset_of_all_worlds():
    env, envs = wrapped(2), wrapped_envs.batched(2, **TORCH)
    env.reset()
    env.set_seed(7)
    env.reset(TensorDict({"_reset": torch.tensor([[True], [False]])}, batch_size=[2]))
    everyone = TensorDict({"_reset": torch.ones(2, 1, dtype=torch.bool)}, batch_size=[2])
    expected, _ = envs.reset(seed=7)
    assert torch.equal(env.reset(everyone)["observation"], expected)
    assert not torch.equal(env.reset()["observation"], expected)


@pytest.mark.parametrize("own", [False, True])
def test_rows_are_paid_for_themselves_or_what_their_world_is(own):
    keywords = {"reward": "particle"} if own else {}
    env, envs = wrapped(2, rows=True, **keywords), wrapped_envs.batched(2, **TORCH, **keywords)
    env.set_seed(1)
    rolled = env.rollout(3, ACTING)
    observation, _ = envs.reset(seed=1)
    for t in range(3):
        observation, rewards, _, _, infos = envs.step(policy(observation))
        expected = infos["particle_reward"] if own else rewards[:, None].expand(-1, 64)
        assert torch.equal(rolled["next", "reward"][:, :, t, 0], expected)
        assert (expected != 0).any()
        assert torch.equal(rolled["next", "observation"][:, :, t], observation)


def test_a_collector_goes_on_over_the_ends_of_episodes():
    env = wrapped(2, rows=True)
    frames = 2 * 64 * (STEPS + 4)
    batches = list(Collector(env, ACTING, frames_per_batch=frames, total_frames=2 * frames))
    assert [batch.batch_size for batch in batches] == [(2, 64, STEPS + 4)] * 2
    # Episodes of 8 steps in 24 steps.
    assert sum(batch["next", "done"].sum().item() for batch in batches) == 3 * 2 * 64
    first, second = (batch["observation"] for batch in batches)
    assert torch.equal(batches[0]["next", "observation"][:, :, -1], second[:, :, 0])
    assert not torch.equal(batches[0]["next", "observation"][:, :, STEPS - 1], first[:, :, STEPS])


def test_wrapped_worlds_are_seen_as_wrappers_show_them():
    envs = VectorNormalizePerception(wrapped_envs.batched(2, **TORCH))
    env = NPATorchRLEnv(envs)
    torchrl.check_env_specs(env)
    assert env.observation_spec["observation"].high.max() == float(
        envs.single_observation_space.high.max()
    )


def test_what_is_refused():
    disabled = {"autoreset_mode": "disabled"}
    for envs, message in (
        (wrapped_envs.batched(2, **disabled), "needs torch tensors, got output='numpy'"),
        (wrapped_envs.batched(output="torch", copy=False, **disabled), "with copy=True"),
        (wrapped_envs.batched(2, output="torch"), "make it with autoreset_mode='disabled'"),
        (wrapped_envs.single(), "env must be a vector environment of npa_envs, got"),
    ):
        refused(message, NPATorchRLEnv, envs)
    env = wrapped(2, rows=True)
    env.reset()
    some = torch.zeros(2, 64, 1, dtype=torch.bool)
    some[1, :5] = True
    mask = TensorDict({"_reset": some}, batch_size=[2, 64])
    refused("_reset must choose all particles of a world or none", env.reset, mask)
