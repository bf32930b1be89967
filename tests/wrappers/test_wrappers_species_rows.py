"""Particles of several species as rows of Stable-Baselines3, and other libraries' own adapters."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from crowds import small

from npa_envs.envs import multispecies_v0, particles_v0
from npa_envs.errors import NPAError

sb3 = pytest.importorskip("stable_baselines3")

from npa_envs.wrappers import RowPolicy, SpeciesVecEnv  # noqa: E402

DEADLY = {"particle_counts": (3, 5), "update_prob": 1.0, "deaths": ((0, 2),), "max_cycles": 4}


def batch(task="mixing", world_count=2, **keywords):
    return multispecies_v0.batched(world_count=world_count, **small(task, **keywords))


def by_hand(observations, names, tags=None):
    """Rows of some species, world by world."""
    worlds = []
    for k in range(2):
        for number, name in enumerate(names):
            rows = observations[name][k]
            if tags:
                rows = np.hstack((rows, np.tile(np.eye(tags)[number], (len(rows), 1))))
            worlds.append(rows)
    return np.concatenate(worlds).astype(np.float32)


def still(observations):
    """A policy of five particles that change nothing."""
    return np.zeros((2, 5, 18), np.float32)


def test_rows_are_the_particles_of_all_species_with_tags():
    rows, envs = SpeciesVecEnv(batch(**DEADLY)), batch(**DEADLY)
    assert rows.num_envs == 16
    assert rows.observation_space.shape == (68,)
    assert rows.seed(3) == [3] * 8 + [4] * 8
    seen = rows.reset()
    observations, _ = envs.reset(seed=3)
    counts = {"species_0": 3, "species_1": 5}
    names = list(counts)
    assert np.array_equal(seen, by_hand(observations, names, tags=2))
    assert all(rows.observation_space.contains(row) for row in seen)
    generator = np.random.default_rng(0)
    dead = np.tile([True] * 3 + [False] * 5, 2)
    for step in range(1, 9):
        actions = generator.uniform(-1, 1, (16, 18)).astype(np.float32)
        seen, paid, done, infos = rows.step(actions)
        by_world = actions.reshape(2, 8, 18)
        observations, rewards, *_, vector_infos = envs.step(
            {"species_0": by_world[:, :3], "species_1": by_world[:, 3:]}
        )
        expected = np.concatenate(
            [np.repeat(rewards[name][k], n) for k in range(2) for name, n in counts.items()]
        )
        assert np.array_equal(paid, expected)
        shown = by_hand(observations, names, tags=2)
        if step % 4 in (2, 3):
            shown[dead] = 0.0
        if step % 4 == 3:
            assert not paid[dead].any()
        assert np.array_equal(seen, shown)
        ends = {2: dead, 0: np.ones(16, bool)}.get(step % 4, np.zeros(16, bool))
        assert np.array_equal(done, ends)
        assert [bool(info) for info in infos] == ends.tolist()
        if step % 4 == 2:
            assert infos[0]["TimeLimit.truncated"] is False
            assert np.array_equal(
                infos[9]["terminal_observation"][:66], observations["species_0"][1, 1]
            )
        if step % 4 == 0:
            last = vector_infos["species_1"]["final_obs"]
            assert infos[3]["TimeLimit.truncated"] is True
            assert infos[0]["TimeLimit.truncated"] is False
            assert np.array_equal(infos[15]["terminal_observation"][:66], last[1, 4])


def test_others_act_by_their_policies():
    asked = []

    def other(observations):
        asked.append(observations)
        return np.full((2, 5, 18), 0.25, np.float32)

    rows = SpeciesVecEnv(batch(**DEADLY), others={"species_1": other})
    envs = batch(**DEADLY)
    assert rows.num_envs == 6
    assert rows.observation_space.shape == (66,)
    rows.seed(5)
    seen = rows.reset()
    observations, _ = envs.reset(seed=5)
    actions = np.random.default_rng(0).uniform(-1, 1, (6, 18)).astype(np.float32)
    for step in range(6):
        expected = by_hand(observations, ["species_0"])
        # Species 0 ends in the second of four steps.
        assert np.array_equal(seen, expected if step % 4 < 2 else 0.0 * expected)
        previous = observations
        seen, paid, *_ = rows.step(actions)
        observations, rewards, *_ = envs.step(
            {
                "species_0": actions.reshape(2, 3, 18),
                "species_1": np.full((2, 5, 18), 0.25, np.float32),
            }
        )
        assert np.array_equal(asked[-1], previous["species_1"])
        assert np.array_equal(paid, np.repeat(rewards["species_0"], 3))


def test_tensors_give_the_same_rows(device):
    arrays = SpeciesVecEnv(batch(**DEADLY, device=str(device)))
    tensors = SpeciesVecEnv(batch(**DEADLY, device=str(device), output="torch"))
    generator = np.random.default_rng(0)
    for rows in (arrays, tensors):
        rows.seed(0)
    assert np.array_equal(arrays.reset(), tensors.reset())
    for _ in range(6):
        actions = generator.uniform(-1, 1, (16, 18)).astype(np.float32)
        mine, theirs = arrays.step(actions), tensors.step(actions)
        assert all(np.array_equal(a, b) for a, b in zip(mine[:3], theirs[:3], strict=True))


def test_what_belongs_to_no_batch_of_species_is_refused():
    with pytest.raises(NPAError, match=r"env must be a batch of worlds .* got MultiSpeciesEnv"):
        SpeciesVecEnv(multispecies_v0.parallel_env(**small("mixing")))
    with pytest.raises(NPAError, match="make it with autoreset_mode='same-step'"):
        SpeciesVecEnv(batch(autoreset_mode="disabled"))
    with pytest.raises(NPAError, match="others must name species, got 'species_7'"):
        SpeciesVecEnv(batch(), others={"species_7": still})
    with pytest.raises(NPAError, match="others must leave at least one species"):
        SpeciesVecEnv(batch(), others={"species_0": still, "species_1": still})
    with pytest.raises(NPAError, match="species must be one whose particles are rows"):
        SpeciesVecEnv(batch(), others={"species_0": still}).policy(None, "species_0")
    with pytest.raises(NPAError, match=r"got object for 'species_0': RowPolicy\(model\) makes one"):
        SpeciesVecEnv(batch(), others={"species_0": object()})


def test_rows_need_worlds_and_an_action_each():
    rows = SpeciesVecEnv(batch(**DEADLY), others={"species_1": still})
    with pytest.raises(NPAError, match="step needs worlds: call reset first"):
        rows.step(np.zeros((6, 18)))
    rows.reset()
    # As many numbers as wanted, but of twelve rows.
    with pytest.raises(NPAError, match=r"\[rows, A\] = \(6, 18\), got \(12, 9\): one for each row"):
        rows.step(np.zeros((12, 9)))
    assert rows.step(np.zeros((6, 18)))[1].shape == (6,)


LEARN = {"particle_count": 32, "state_dim": 4, "max_cycles": 16}
PPO = {"n_steps": 16, "batch_size": 512, "n_epochs": 4, "learning_rate": 1e-3, "gamma": 0.95}


def mean_return(task, policies):
    """What an agent is paid in an episode, mean of 32 worlds."""
    envs = batch(task, 32, **LEARN)
    seen, _ = envs.reset(seed=1000)
    paid = 0.0
    for _ in range(16):
        seen, rewards, *_ = envs.step({name: policies[name](seen[name]) for name in envs.agents})
        paid += float(np.mean(list(rewards.values())))
    return paid


@pytest.fixture
def one_thread():
    """Small products are faster on one thread."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.mark.slow
def test_one_policy_for_all_species_learns_to_mix(one_thread):
    rows = SpeciesVecEnv(batch("mixing", 32, **LEARN))
    model = sb3.PPO("MlpPolicy", rows, **PPO | {"batch_size": 1024}, seed=0, device="cpu")
    names = rows.rows_of
    before = mean_return("mixing", {name: rows.policy(model, name) for name in names})
    model.learn(12 * 16 * rows.num_envs)
    policies = {name: rows.policy(model, name, deterministic=True) for name in names}
    # 0.26, and 0.69 to 0.76 from four seeds, were seen.
    assert before < 0.4
    assert mean_return("mixing", policies) > 0.5


@pytest.mark.slow
def test_policies_of_their_own_learn_to_part_in_turn(one_thread):
    models = {}

    def beside(name):
        return lambda seen: RowPolicy(models[name])(seen)

    for name, other in (("species_0", "species_1"), ("species_1", "species_0")):
        rows = SpeciesVecEnv(batch("segregation", 8, **LEARN), others={other: beside(other)})
        models[name] = sb3.PPO("MlpPolicy", rows, **PPO, seed=0, device="cpu")
    before = mean_return("segregation", {name: RowPolicy(m) for name, m in models.items()})
    for _ in range(24):
        for model in models.values():
            model.learn(16 * model.n_envs, reset_num_timesteps=False)
    policies = {name: RowPolicy(model, deterministic=True) for name, model in models.items()}
    # 0.24, and after 30 rounds 0.63 to 0.81 from four seeds, were seen.
    assert before < 0.4
    assert mean_return("segregation", policies) > 0.5


def test_supersuit_trains_on_particles(one_thread):
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
