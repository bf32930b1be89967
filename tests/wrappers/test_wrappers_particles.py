"""Particles as rows of a Stable-Baselines3 environment."""

import subprocess
import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest
import wrapped_envs
from wrapped_envs import ACTIONS, SMALL, STEPS, policy

import npa_envs
from npa_envs.errors import MissingDependencyError, NPAError
from npa_envs.wrappers import VectorDamageEvents, VectorNormalizePerception, VectorSpeciesTags

sb3 = pytest.importorskip("stable_baselines3")
from stable_baselines3.common.monitor import Monitor  # noqa: E402
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize  # noqa: E402

from npa_envs.wrappers import ParticleVecEnv  # noqa: E402


def batched(count=2, **keywords):
    return wrapped_envs.batched(count, **{"reward": "particle", **keywords})


def test_rows_are_the_particles_of_the_worlds_in_order():
    rows, envs = ParticleVecEnv(batched()), batched()
    assert rows.num_envs == 128
    assert rows.observation_space == gym.spaces.Box(-64.0, 64.0, (66,), np.float32)
    assert rows.action_space == gym.spaces.Box(-1.0, 1.0, (18,), np.float32)
    assert rows.seed(3) == [3] * 64 + [4] * 64
    seen, (observation, _) = rows.reset(), envs.reset(seed=3)
    np.testing.assert_array_equal(seen, observation.reshape(128, 66))
    for step in range(1, 2 * STEPS + 1):
        seen, rewards, done, infos = rows.step(policy(seen))
        observation, _, _, truncations, vector_infos = envs.step(policy(observation))
        np.testing.assert_array_equal(seen, observation.reshape(128, 66))
        assert done.all() == done.any() == truncations.all() == (step % STEPS == 0)
        last = vector_infos.get("final_info", vector_infos)
        np.testing.assert_array_equal(rewards, last["particle_reward"].reshape(128))
        assert (rewards != 0).any()
        if done.any():
            final = vector_infos["final_obs"].reshape(128, 66)
            for row in (0, 63, 64, 127):
                assert infos[row].keys() == {
                    "terminal_observation",
                    "TimeLimit.truncated",
                    "is_success",
                }
                np.testing.assert_array_equal(infos[row]["terminal_observation"], final[row])
                assert infos[row]["TimeLimit.truncated"] is True
        else:
            assert infos == [{}] * 128


def test_rows_of_finished_worlds_alone_have_infos_and_a_terminal_observation():
    envs = batched(3)
    rows = ParticleVecEnv(envs)
    seen = rows.reset()
    envs.reset(options={"reset_mask": np.array([True, False, True])})
    for _ in range(3):
        seen, *_ = rows.step(policy(seen))
    envs.reset(options={"reset_mask": np.array([True, False, True])})
    for _ in range(STEPS - 3):
        seen, _, done, infos = rows.step(policy(seen))
    assert done.reshape(3, 64).all(axis=1).tolist() == [False, True, False]
    assert done.reshape(3, 64).any(axis=1).tolist() == [False, True, False]
    assert [bool(info) for info in infos] == done.tolist()


def test_success_is_no_time_limit():
    rows = ParticleVecEnv(batched(success_loss=1e6))
    seen = rows.reset()
    _, _, done, infos = rows.step(policy(seen))
    assert done.all()
    assert infos[0]["is_success"] is True
    assert infos[0]["TimeLimit.truncated"] is False
    assert infos[0]["terminal_observation"].shape == (66,)


def test_a_team_reward_goes_to_every_particle():
    rows, envs = ParticleVecEnv(batched(reward="dense")), batched(reward="dense")
    rows.seed(0)
    seen, _ = rows.reset(), envs.reset(seed=0)
    _, rewards, _, _ = rows.step(policy(seen))
    _, team, *_ = envs.step(policy(seen).reshape(2, 64, ACTIONS))
    np.testing.assert_array_equal(rewards, np.repeat(team, 64))
    assert rewards.dtype == np.float32


@pytest.mark.parametrize("output", ["numpy", "torch"])
def test_what_was_handed_out_is_not_overwritten(output):
    rows = ParticleVecEnv(batched(copy=False, output=output))
    seen = rows.reset()
    kept, copies = [seen], [seen.copy()]
    for _ in range(STEPS + 1):
        seen, rewards, _, _ = rows.step(policy(seen))
        kept += [seen, rewards]
        copies += [seen.copy(), rewards.copy()]
    for array, copy in zip(kept, copies, strict=True):
        np.testing.assert_array_equal(array, copy)


def test_torch_environments_give_the_same_rows():
    ways = []
    for output in ("numpy", "torch"):
        rows = ParticleVecEnv(batched(output=output))
        rows.seed(7)
        seen = rows.reset()
        way = [seen]
        for _ in range(STEPS + 2):
            seen, rewards, done, infos = rows.step(policy(seen))
            way += [seen, rewards, done]
            if done.any():
                way.append(np.stack([info["terminal_observation"] for info in infos]))
        ways.append(way)
    for one, other in zip(*ways, strict=True):
        np.testing.assert_array_equal(one, other)


def test_without_bootstrapping_an_end_is_an_end():
    rows = ParticleVecEnv(batched(max_episode_steps=1), bootstrap=False)
    _, _, done, infos = rows.step(policy(rows.reset()))
    assert done.all()
    assert infos == [{"is_success": False}] * 128
    infos[0]["mine"] = 1
    assert infos[1] == {"is_success": False}


def test_the_shared_info_cannot_be_written_to():
    rows = ParticleVecEnv(batched())
    *_, infos = rows.step(policy(rows.reset()))
    for write in (
        lambda info: info.update(a=1),
        lambda info: info.setdefault("a", 1),
        lambda info: info.__setitem__("a", 1),
    ):
        with pytest.raises(NPAError, match="shared by all such rows"):
            write(infos[5])
    own = infos[5].copy()
    own["a"] = 1
    assert infos[6] == {}


def test_attributes_and_methods_are_those_of_the_environment():
    envs = batched(render_mode="rgb_array", render_size=8)
    rows = ParticleVecEnv(VectorNormalizePerception(envs))
    rows.reset()
    assert rows.get_attr("config", [0, 70]) == [envs.config] * 2
    assert len(rows.get_attr("training")) == 128
    rows.set_attr("training", False)
    assert rows.vector_env.training is False
    rows.set_attr("mark", 3)
    assert envs.mark == 3
    with pytest.raises(NPAError, match="indices must be all rows"):
        rows.set_attr("training", True, indices=[0])
    with pytest.raises(AttributeError, match="no attribute 'absent'"):
        rows.get_attr("absent")
    assert not rows.has_attr("absent")
    particles = rows.env_method("particles", indices=0)
    assert [x.shape for x in particles[0]] == [(2, 64, 2), (2, 64, 16)]
    assert rows.env_is_wrapped(VectorNormalizePerception, [0]) == [True]
    assert rows.env_is_wrapped(Monitor) == [False] * 128
    assert rows.render().shape == (8 * 2, 8, 3) or rows.render().shape == (8, 8 * 2, 3)
    assert rows.spec.id == "npa/Morphogenesis2D-v0"
    rows.close()
    rows.close()


def test_wrappers_beneath_are_seen():
    envs = VectorSpeciesTags(VectorDamageEvents(batched(), "2:clump"), 3)
    rows = ParticleVecEnv(envs)
    assert rows.observation_space.shape == (69,)
    seen = rows.reset()
    np.testing.assert_array_equal(seen[:, 66:].argmax(axis=1), envs.species.reshape(-1))


@pytest.mark.parametrize("mode", ["next-step", "disabled"])
def test_other_autoreset_modes_are_refused(mode):
    with pytest.raises(NPAError, match="autoreset_mode='same-step'"):
        ParticleVecEnv(batched(autoreset_mode=mode))


def test_other_environments_are_refused():
    with pytest.raises(NPAError, match="vector_entry_point"):
        ParticleVecEnv(gym.make("npa/Morphogenesis2D-v0", **SMALL))


def test_monitor_and_normalize_work_on_top():
    rows = VecNormalize(VecMonitor(ParticleVecEnv(batched())), gamma=0.9)
    rows.seed(0)
    seen, total = rows.reset(), np.zeros(128)
    for _ in range(STEPS):
        seen, _, done, infos = rows.step(policy(seen))
        total += rows.get_original_reward()
    assert done.all()
    assert infos[9]["episode"]["l"] == STEPS
    assert infos[9]["episode"]["r"] == pytest.approx(total[9], abs=1e-5)
    assert np.abs(infos[9]["terminal_observation"]).max() <= 10.0
    assert np.std(seen) == pytest.approx(1.0, abs=0.7)


def test_ppo_learns_on_the_rows():
    rows = VecMonitor(ParticleVecEnv(batched()))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        options = {"n_steps": 4, "batch_size": 128, "n_epochs": 1, "seed": 0, "device": "cpu"}
        model = sb3.PPO("MlpPolicy", rows, **options)
        model.learn(2 * STEPS * 64)
    assert model.num_timesteps == 2 * STEPS * 64
    assert len(model.ep_info_buffer) == 100
    assert model.ep_info_buffer[0]["l"] == STEPS
    for weights in model.policy.parameters():
        assert weights.isfinite().all()


def test_without_stable_baselines3_the_error_names_the_extra():
    code = (
        "import sys\n"
        "sys.modules['stable_baselines3'] = None\n"
        "import npa_envs.wrappers as wrappers\n"
        "wrappers.VectorDamageEvents\n"
        "from npa_envs.errors import MissingDependencyError\n"
        "try:\n"
        "    wrappers.ParticleVecEnv\n"
        "except MissingDependencyError as error:\n"
        "    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "pip install 'npa-envs[sb3]'" in done.stdout
    assert issubclass(MissingDependencyError, ImportError)


def test_a_star_imports_every_wrapper_that_needs_no_extra():
    code = (
        "import sys\n"
        "sys.modules['stable_baselines3'] = None\n"
        "from npa_envs.wrappers import *\n"
        "print(DamageEvents.__name__, VectorSpeciesTags.__name__, TorchNormalizeReward.__name__)\n"
        "assert 'ParticleVecEnv' not in globals()\n"
        "import npa_envs.wrappers as wrappers\n"
        "assert 'ParticleVecEnv' in dir(wrappers)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["DamageEvents", "VectorSpeciesTags", "TorchNormalizeReward"]


def test_an_unknown_wrapper_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'Absent'"):
        npa_envs.wrappers.Absent  # noqa: B018


def test_importing_the_wrappers_imports_no_trainer():
    code = (
        "import sys, npa_envs.wrappers as wrappers\n"
        "assert 'torch' not in sys.modules\n"
        "wrappers.DamageEvents, wrappers.TorchNormalizeReward\n"
        "assert 'stable_baselines3' not in sys.modules\n"
        "assert set(wrappers.__all__) <= set(dir(wrappers))\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
