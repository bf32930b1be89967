"""Rows of Stable-Baselines3: particles, worlds and particles of species; SuperSuit's as well."""

import functools

import gymnasium as gym
import numpy as np
import pytest
import torch
from support import wrapped_envs
from support.crowds import small
from support.refusals import refused
from support.small_envs import assert_same
from support.wrapped_envs import ACTIONS, STEPS, policy

from npa_envs.envs import multispecies_v0, particles_v0
from npa_envs.wrappers import VectorNormalizePerception, VectorSpeciesTags
from npa_envs.wrappers.base import as_tensor

sb3 = pytest.importorskip("stable_baselines3")
from stable_baselines3.common.monitor import Monitor  # noqa: E402

from npa_envs.wrappers import ParticleVecEnv, SpeciesVecEnv, WorldVecEnv  # noqa: E402


def batched(count=2, **keywords):
    return wrapped_envs.batched(count, **{"reward": "particle", **keywords})


@pytest.mark.parametrize(
    ("adapter", "reward"),
    [(ParticleVecEnv, "particle"), (ParticleVecEnv, "dense"), (WorldVecEnv, "particle")],
)
@pytest.mark.parametrize("output", ["numpy", "torch"])
def test_rows_are_those_of_the_worlds_in_order(adapter, reward, output):
    rows = adapter(batched(reward=reward, copy=False, output=output))
    envs = batched(reward=reward)
    each = 64 if adapter is ParticleVecEnv else 1
    assert rows.num_envs == 2 * each
    shapes = ((66,), (ACTIONS,)) if each == 64 else ((64, 66), (64, ACTIONS))
    assert rows.observation_space == gym.spaces.Box(-64.0, 64.0, shapes[0], np.float32)
    assert rows.action_space == gym.spaces.Box(-1.0, 1.0, shapes[1], np.float32)
    assert rows.seed(3) == [3] * each + [4] * each
    seen, (observation, _) = rows.reset(), envs.reset(seed=3)
    np.testing.assert_array_equal(seen, observation.reshape(-1, *shapes[0]))
    results, copies = [seen], [seen.copy()]
    for step in range(1, 2 * STEPS + 1):
        seen, rewards, done, infos = rows.step(policy(seen))
        observation, team, _, truncations, vector_infos = envs.step(policy(observation))
        np.testing.assert_array_equal(seen, observation.reshape(-1, *shapes[0]))
        assert done.all() == done.any() == truncations.all() == (step % STEPS == 0)
        last = vector_infos.get("final_info", vector_infos)
        own = each == 64 and reward == "particle"
        paid = last["particle_reward"].reshape(-1) if own else np.repeat(team, each)
        np.testing.assert_array_equal(rewards, paid)
        assert rewards.dtype == np.float32
        assert (rewards != 0).any()
        results += [seen, rewards, done]
        copies += [array.copy() for array in results[-3:]]
        if not done.any():
            assert infos == [{}] * rows.num_envs
            continue
        results.append(infos[0]["terminal_observation"])
        copies.append(results[-1].copy())
        final = np.stack(vector_infos["final_obs"]).reshape(-1, *shapes[0])
        for row in (0, each - 1, each, 2 * each - 1):
            np.testing.assert_array_equal(infos[row].pop("terminal_observation"), final[row])
            # These worlds have no success.
            assert infos[row] == {"TimeLimit.truncated": True}
            infos[row]["terminal_observation"] = final[row]
    # No later step writes to the environment's buffers through them.
    assert_same(results, copies)


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


@pytest.mark.parametrize("output", ["numpy", "torch"])
@pytest.mark.parametrize("name", ["npa/Gardener2DSmall-v0", "npa/Shepherd2DSmall-v0"])
def test_living_worlds_are_rows_too_and_their_dictionaries_are_kept(name, output):
    fields = {"grow_steps": 4, "rule_steps": 1, "seed_pool": 1, "max_episode_steps": 2}
    envs = [
        gym.make_vec(name, 3, vectorization_mode="vector_entry_point", output=way, **fields)
        for way in (output, "numpy")
    ]
    rows, plain = WorldVecEnv(envs[0]), envs[1]
    rows.seed(1)

    assert_same(rows.reset(), plain.reset(seed=1)[0])
    plain.action_space.seed(0)
    for _ in range(5):
        actions = plain.action_space.sample()
        seen, paid, done, infos = rows.step(actions)
        wanted, rewards, _, late, vector_infos = plain.step(actions)
        assert_same(seen, wanted)
        np.testing.assert_allclose(paid, rewards, rtol=1e-6)
        assert done.tolist() == late.tolist()
        for k in np.flatnonzero(done):
            assert infos[k]["TimeLimit.truncated"] is True
            assert_same(infos[k]["terminal_observation"], vector_infos["final_obs"][k])
            # A shepherd says whether it succeeded; a gardener has no success.
            final = vector_infos["final_info"].get("is_success", [None] * 3)
            assert infos[k].get("is_success") == final[k]


@pytest.mark.parametrize("adapter", [ParticleVecEnv, WorldVecEnv])
def test_success_is_no_time_limit(adapter):
    rows = adapter(batched(success_loss=1e6))
    seen = rows.reset()
    _, _, done, infos = rows.step(policy(seen))
    assert done.all()
    assert infos[1].pop("terminal_observation").shape == seen[1].shape
    assert infos[1] == {"is_success": True, "TimeLimit.truncated": False}


@pytest.mark.parametrize("keywords", [{}, {"success_loss": 0.0}])
def test_synchronous_worlds_have_is_success_only_where_success_is_possible(keywords):
    single = functools.partial(
        gym.make, "npa/Morphogenesis2D-v0", particle_count=16, max_episode_steps=1, **keywords
    )
    rows = WorldVecEnv(gym.vector.SyncVectorEnv([single] * 2, autoreset_mode="SameStep"))
    rows.reset()
    *_, infos = rows.step(np.zeros((2, *rows.action_space.shape), np.float32))
    assert [info.get("is_success", "none") for info in infos] == [not keywords and "none"] * 2


def test_without_bootstrapping_an_end_is_an_end():
    rows = ParticleVecEnv(batched(max_episode_steps=1, success_loss=0.0), bootstrap=False)
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
        refused("shared by all such rows", write, infos[5])
    copy = infos[5].copy()
    copy["a"] = 1
    assert infos[6] == {}


def test_attributes_and_methods_are_those_of_the_environment():
    envs = batched(render_mode="rgb_array", render_size=8)
    rows = ParticleVecEnv(VectorSpeciesTags(VectorNormalizePerception(envs)))
    assert rows.observation_space.shape == (68,)
    assert rows.reset()[63:65, 66:].tolist() == [[0.0, 1.0], [1.0, 0.0]]
    assert rows.get_attr("config", [0, 70]) == [envs.config] * 2
    assert len(rows.get_attr("training")) == 128
    rows.set_attr("training", False)
    assert rows.vector_env.env.training is False
    rows.set_attr("mark", 3)
    assert envs.mark == 3
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


# Particles of several species as rows


DEADLY = {"particle_counts": (3, 5), "update_prob": 1.0, "deaths": ((0, 2),), "max_cycles": 4}


def batch(task="mixing", world_count=2, **keywords):
    return multispecies_v0.batched(world_count=world_count, **small(task, **keywords))


COUNTS = {"species_0": 3, "species_1": 5}
OTHERS = np.full((2, 5, 18), 0.25, np.float32)


def by_hand(observations, names):
    """Rows of some species, world by world, with tags if all are rows."""
    worlds = []
    for k in range(2):
        for number, name in enumerate(names):
            rows = observations[name][k]
            tags = np.tile(np.eye(2)[number], (len(rows), 1))
            worlds.append(rows if len(names) == 1 else np.hstack((rows, tags)))
    return np.concatenate(worlds).astype(np.float32)


@pytest.mark.parametrize("names", [["species_0", "species_1"], ["species_0"]])
@pytest.mark.parametrize("output", ["numpy", "torch"])
def test_rows_are_the_particles_of_species_and_others_act_by_policies(names, output, device):
    seen_by_others = []

    def other(observations):
        seen_by_others.append(np.asarray(as_tensor(observations).cpu()))
        return OTHERS if output == "numpy" else torch.from_numpy(OTHERS).to(device)

    fields = DEADLY | {"device": str(device)}
    others = {"species_1": other} if len(names) == 1 else None
    rows, envs = SpeciesVecEnv(batch(**fields, output=output), others=others), batch(**fields)
    count = sum(COUNTS[name] for name in names)
    assert rows.num_envs == 2 * count
    assert rows.observation_space.shape == (68 if len(names) == 2 else 66,)
    assert rows.seed(3) == [3] * count + [4] * count
    seen = rows.reset()
    observations, _ = envs.reset(seed=3)
    assert np.array_equal(seen, by_hand(observations, names))
    assert all(rows.observation_space.contains(row) for row in seen)
    generator = np.random.default_rng(0)
    # Species 0 ends in the second of four steps.
    dead = np.tile([True] * 3 + [False] * (count - 3), 2)
    for step in range(1, 9):
        actions = generator.uniform(-1, 1, (2 * count, 18)).astype(np.float32)
        previous = observations
        seen, paid, done, infos = rows.step(actions)
        by_world = actions.reshape(2, count, 18)
        acting = {"species_0": by_world[:, :3], "species_1": by_world[:, 3:]}
        acting |= {} if others is None else {"species_1": OTHERS}
        observations, rewards, *_, vector_infos = envs.step(acting)
        if others is not None:
            assert np.array_equal(seen_by_others[-1], previous["species_1"])
        expected = [np.repeat(rewards[name][k], COUNTS[name]) for k in range(2) for name in names]
        assert np.array_equal(paid, np.concatenate(expected))
        shown = by_hand(observations, names)
        if step % 4 in (2, 3):
            shown[dead] = 0.0
        if step % 4 == 3:
            assert not paid[dead].any()
        assert np.array_equal(seen, shown)
        ends = {2: dead, 0: np.ones(2 * count, bool)}.get(step % 4, np.zeros(2 * count, bool))
        assert np.array_equal(done, ends)
        assert [bool(info) for info in infos] == ends.tolist()
        last = infos[count + 1].get("terminal_observation")
        if step % 4 == 2:
            assert infos[0]["TimeLimit.truncated"] is False
            assert np.array_equal(last[:66], observations["species_0"][1, 1])
        if step % 4 == 0:
            final = vector_infos["species_0"]["final_obs"]
            assert infos[0]["TimeLimit.truncated"] is False
            assert np.array_equal(last[:66], final[1, 1])
        if step % 4 == 0 and others is None:
            final = vector_infos["species_1"]["final_obs"]
            assert infos[3]["TimeLimit.truncated"] is True
            assert np.array_equal(infos[15]["terminal_observation"][:66], final[1, 4])


def test_rows_of_particles_that_are_agents_have_their_own_rewards_and_end_by_themselves():
    fields = {"task": "npa/SegregationParticlesSmall-v0", "position_limit": 0.3, "max_cycles": 6}
    rows, envs = (particles_v0.batched(world_count=2, **fields) for _ in range(2))
    rows = SpeciesVecEnv(rows)
    rows.seed(3)
    seen, (observations, infos) = rows.reset(), envs.reset(seed=3)
    tags = np.eye(2, dtype="f4")[[0] * 32 + [1] * 32]
    generator, early = np.random.default_rng(0), 0
    for step in range(1, 13):
        for k in range(2):
            whole = np.stack([observations[agent][k] for agent in envs.agents])
            live = np.array([[infos[agent]["live"][k]] for agent in envs.agents])
            shown = np.where(live, np.hstack((whole, tags)), 0.0)
            assert np.array_equal(seen.reshape(2, 64, -1)[k], shown)
        actions = generator.uniform(-1, 1, (128, 6)).astype("f4")
        seen, paid, done, _ = rows.step(actions)
        by_agent = dict(zip(envs.agents, actions.reshape(2, 64, 6).swapaxes(0, 1), strict=True))
        observations, rewards, ended, _, infos = envs.step(by_agent)
        assert np.array_equal(paid.reshape(2, 64).T, np.stack(list(rewards.values())))
        ends = np.stack(list(ended.values())).T.reshape(-1)
        early += ends.sum()
        assert np.array_equal(done, ends | (step % 6 == 0))
    assert 0 < early < 256
    model = sb3.PPO("MlpPolicy", rows, n_steps=4, batch_size=64, n_epochs=1, device="cpu")
    model.learn(4 * 128)
    action = rows.policy(model, "particle_40", deterministic=True)(observations["particle_40"])
    expected = model.predict(
        np.hstack((observations["particle_40"], tags[[40, 40]])), None, None, True
    )
    assert np.array_equal(action, expected[0])


def test_supersuit_trains_on_particles():
    supersuit = pytest.importorskip("supersuit")
    env = particles_v0.parallel_env(**small("mixing", particle_count=16, state_dim=4))
    rows = supersuit.pettingzoo_env_to_vec_env_v1(env)
    rows = supersuit.concat_vec_envs_v1(rows, 2, num_cpus=0, base_class="stable_baselines3")
    assert rows.num_envs == 32
    # SuperSuit's environments have no seed method, so the model gets no seed.
    model = sb3.PPO("MlpPolicy", rows, n_steps=12, batch_size=128, n_epochs=2, device="cpu")
    before = [weights.clone() for weights in model.policy.parameters()]
    model.learn(2 * 12 * rows.num_envs)
    assert model.num_timesteps == 768
    after = model.policy.parameters()
    assert any(not torch.equal(a, b) for a, b in zip(before, after, strict=True))
