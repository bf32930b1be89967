"""Particles as rows of RSL-RL; skipped where it is missing."""

import pytest
import torch
from support import wrapped_envs
from support.refusals import refused
from support.small_envs import begun
from support.wrapped_envs import ACTIONS, STEPS, policy

from npa_envs.errors import NPAError

pytest.importorskip("rsl_rl.env")
from rsl_rl.runners import OnPolicyRunner

from npa_envs.wrappers import RslRlParticleEnv


def batched(count=2, **keywords):
    return wrapped_envs.batched(count, output="torch", **keywords)


@pytest.mark.parametrize("own", [False, True])
def test_rows_are_the_particles_of_the_worlds_in_order(own):
    keywords = {"reward": "particle"} if own else {}
    rows, envs = RslRlParticleEnv(batched(**keywords), seed=3), batched(**keywords)
    assert (rows.num_envs, rows.num_actions) == (128, ACTIONS)
    assert rows.max_episode_length == STEPS
    observation, _ = envs.reset(seed=3)
    seen = rows.get_observations()["policy"]
    for step in range(1, 2 * STEPS + 1):
        assert torch.equal(seen, observation.reshape(128, 66))
        entries, rewards, dones, extras = rows.step(policy(seen))
        observation, paid, _, truncations, infos = envs.step(policy(observation))
        seen = entries["policy"]
        own_paid = infos.get("final_info", infos).get("particle_reward")
        expected = own_paid.reshape(-1) if own else paid.repeat_interleave(64)
        assert torch.equal(rewards, expected)
        assert (rewards != 0).any()
        assert torch.equal(dones.bool(), truncations.repeat_interleave(64))
        assert torch.equal(extras["time_outs"], dones.bool())
        assert rows.episode_length_buf.tolist() == [step % STEPS] * 128
        assert ("log" in extras) == (step % STEPS == 0)
        if "log" in extras:
            loss = infos["final_info"]["loss"].mean()
            assert extras["log"]["Episode/loss"].item() == pytest.approx(loss.item())
            assert extras["log"]["Episode/success"].item() == 0.0


def test_logs_are_means_over_the_worlds_that_ended():
    envs = batched(3)
    rows = RslRlParticleEnv(envs, seed=0)
    rows.step(torch.zeros(192, ACTIONS))
    envs.reset(options={"reset_mask": torch.tensor([True, False, True])})
    for _ in range(STEPS - 1):
        *_, dones, extras = rows.step(torch.zeros(192, ACTIONS))
    assert dones.reshape(3, 64).all(dim=1).tolist() == [False, True, False]
    alone = begun(batched(1), seed=1)
    for _ in range(STEPS):
        *_, infos = alone.step(torch.zeros(1, 64, ACTIONS))
    expected = infos["final_info"]["loss"].item()
    assert extras["log"]["Episode/loss"].item() == pytest.approx(expected, rel=1e-6)


def test_success_is_no_time_limit():
    rows = RslRlParticleEnv(batched(success_loss=1e6), seed=0)
    *_, dones, extras = rows.step(torch.zeros(128, ACTIONS))
    assert dones.all()
    assert not extras["time_outs"].any()
    assert extras["log"]["Episode/success"].item() == 1.0


def test_steps_in_inference_mode_leave_no_tensors_that_cannot_be_written_to():
    envs = batched(2, reward="particle")
    rows = RslRlParticleEnv(envs, seed=0)
    with torch.inference_mode():
        for _ in range(STEPS):
            seen, rewards, dones, _ = rows.step(torch.zeros(128, ACTIONS))
    worlds = envs.unwrapped.worlds
    kept = (worlds.x, worlds.s, worlds.elapsed, worlds.particle_rewards.reward, seen["policy"])
    assert not any(tensor.is_inference() for tensor in (*kept, rewards, dones))


def test_the_runner_of_rsl_rl_updates_the_policy():
    model = {"class_name": "MLPModel", "hidden_dims": [8]}
    actor = model | {"distribution_cfg": {"class_name": "GaussianDistribution"}}
    config = {
        "actor": actor,
        "critic": model,
        "algorithm": {"class_name": "PPO"},
        "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
        "num_steps_per_env": STEPS + 2,
        "save_interval": 100,
    }
    rows = RslRlParticleEnv(batched(2), seed=0)
    runner = OnPolicyRunner(rows, config, device="cpu")
    before = [p.detach().clone() for p in runner.alg.actor.parameters()]
    runner.learn(2)
    after = list(runner.alg.actor.parameters())
    assert all(not torch.equal(old, new) for old, new in zip(before, after, strict=True))
    assert all(bool(p.isfinite().all()) for p in after)
    with pytest.raises(NPAError, match="call learn with init_at_random_ep_len=False"):
        runner.learn(1, init_at_random_ep_len=True)


def test_what_is_refused():
    refused("needs torch tensors, got output='numpy'", RslRlParticleEnv, wrapped_envs.batched(2))
    refused("make the environment with copy=True", RslRlParticleEnv, batched(copy=False))
    next_step = batched(autoreset_mode="next-step")
    refused("make it with autoreset_mode='same-step'", RslRlParticleEnv, next_step)
    step = RslRlParticleEnv(batched(2)).step
    shape = r"actions must have shape \[rows, A\] = \(128, 18\), got"
    refused(shape, step, torch.zeros(2, 64, ACTIONS))
