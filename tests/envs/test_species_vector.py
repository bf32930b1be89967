"""Batches of worlds of several species: world k is the single environment, whoever dies."""

import pickle

import numpy as np
import pytest
import torch
from crowds import TASKS, drawn, make, small, still
from refusals import refused
from small_envs import assert_same, begun

from npa_envs.envs import multispecies_v0
from npa_envs.envs.core import state
from npa_envs.errors import NPAError

# Species leave, run out of bounds in their states, are removed, and are cut off.
DEADLY = {
    "species_count": 3,
    "particle_counts": (9, 3, 2),
    "seed_distance": 0.4,
    "position_limit": 0.66,
    "update_prob": 0.8,
    "position_noise": 0.01,
    "deaths": ((1, 9),),
    "max_cycles": 14,
}


def batch(task="mixing", world_count=3, autoreset_mode="same-step", **keywords):
    fields = small(task, **keywords)
    return multispecies_v0.batched(world_count=world_count, autoreset_mode=autoreset_mode, **fields)


def assert_info_equal(infos, agent, k, info):
    for name, value in info.items():
        got = infos[agent][name]
        got = got if name == "species" else got[k]
        assert got == (np.float32(value) if isinstance(value, float) else value), name


@pytest.mark.parametrize(
    ("task", "changes"),
    [
        *((task, {}) for task in TASKS),
        ("co_morphogenesis", {"reward": "team"}),
        ("segregation", {"perception": "per_species"}),
    ],
)
def test_a_batch_equals_single_environments_while_species_die_here_and_there(task, changes, where):
    keywords = DEADLY | changes | where
    envs = batch(task, 3, **keywords)
    singles = [make(task, **keywords) for _ in range(3)]
    observations, infos = envs.reset(seed=7)
    for k, env in enumerate(singles):
        seen, info = env.reset(seed=7 + k)
        for agent in env.agents:
            assert np.array_equal(observations[agent][k], seen[agent])
            assert_info_equal(infos, agent, k, info[agent])
    generator = np.random.default_rng(1)
    reasons, patterns = set(), set()
    for _ in range(45):
        actions = drawn(envs, generator)
        # They drift to where the world ends, each at its own pace.
        actions["species_2"][..., 0] = np.array([0.2, 0.6, 1.0])[:, None]
        observations, rewards, terminations, truncations, infos = envs.step(actions)
        for k, env in enumerate(singles):
            acted = env.agents
            seen, paid, ended, cut, info = env.step({a: actions[a][k] for a in acted})
            restarted = not env.agents
            for agent in env.possible_agents:
                assert infos[agent]["acted"][k] == (agent in acted)
                if agent not in acted:
                    assert rewards[agent][k] == 0.0
                    assert not terminations[agent][k]
                    assert not truncations[agent][k]
                    assert infos[agent]["loss"][k] == 0.0
                    if not restarted:
                        assert not observations[agent][k].any()
                    continue
                assert rewards[agent][k] == np.float32(paid[agent])
                assert terminations[agent][k] == ended[agent]
                assert truncations[agent][k] == cut[agent]
                assert_info_equal(infos, agent, k, info[agent])
                reasons.add(info[agent].get("reason"))
                last = infos[agent]["final_obs"] if restarted else observations[agent]
                assert np.array_equal(last[k], seen[agent])
            if restarted:
                seen, _ = env.reset()
                for agent in env.agents:
                    assert infos[agent]["_final_obs"][k]
                    assert np.array_equal(observations[agent][k], seen[agent])
            live = [agent for agent in env.possible_agents if infos[agent]["live"][k]]
            assert live == env.agents
            assert np.array_equal(envs.state()[k], env.state())
        patterns.add(tuple(tuple(infos[agent]["live"]) for agent in envs.agents))
    assert reasons >= {None, "removed", "left the world", "time limit"} - (
        {"time limit"} if task == "invasion" else set()
    )
    # Worlds had lost different species at the same time.
    assert any(len(set(zip(*pattern, strict=True))) > 1 for pattern in patterns)


def test_resetting_one_world_leaves_the_others_as_they_are(where):
    envs, untouched = begun(*(batch(autoreset_mode="disabled", **DEADLY | where) for _ in range(2)))
    generator = np.random.default_rng(0)
    for _ in range(10):
        actions = drawn(envs, generator)
        for e in (envs, untouched):
            e.step(actions)
    before = envs.state()
    assert not before[:, 9:12].any()
    mask = np.array([False, True, False])
    seen, infos = envs.reset(options={"reset_mask": mask})
    assert np.array_equal(envs.state()[~mask], before[~mask])
    assert envs.state()[1, :, -1].all()
    assert infos["species_1"]["live"].tolist() == [False, True, False]
    assert not seen["species_1"][~mask].any()
    single = begun(make(**DEADLY | where), seed=1)
    assert np.array_equal(seen["species_1"][1], single.reset()[0]["species_1"])
    actions = drawn(envs, generator)
    _, rewards, *_ = envs.step(actions)
    _, paid, *_ = untouched.step(actions)
    assert np.array_equal(rewards["species_0"][~mask], paid["species_0"][~mask])


def test_a_disabled_autoreset_waits_for_the_reset():
    envs = begun(batch(autoreset_mode="disabled", max_cycles=2))
    for _ in range(2):
        observations, _, terminations, truncations, infos = envs.step(still(envs))
    assert truncations["species_0"].all()
    assert not terminations["species_0"].any()
    assert infos["species_1"]["reason"].tolist() == ["time limit"] * 3
    assert "final_obs" not in infos["species_0"]
    assert observations["species_0"].any(axis=(1, 2)).all()
    refused(r"episodes of worlds \[0, 1, 2\] are over: reset them", envs.step, still(envs))
    envs.reset(options={"reset_mask": np.array([True, False, True])})
    refused(r"episodes of worlds \[1\] are over", envs.step, still(envs))


HOST = ("species", "reason")
"""What infos hold that is no tensor."""


def test_tensors_stay_on_the_device_where_asked_for(device):
    keywords = DEADLY | {"device": str(device)}
    arrays, tensors = batch(**keywords), batch(output="torch", **keywords)
    arrays.reset(seed=0)
    observations, _ = tensors.reset(seed=0)
    generator = np.random.default_rng(0)
    handed, bytes_then = [], []
    for _ in range(16):
        actions = drawn(arrays, generator)
        sent = {agent: torch.from_numpy(a).to(device) for agent, a in actions.items()}
        got = tensors.step(sent)
        assert_same(arrays.step(actions), got)
        told = [value for name, value in got[4]["species_2"].items() if name not in HOST]
        for value in (*(values["species_2"] for values in got[:4]), *told):
            assert value.device.type == device.type
        handed.append(got)
        bytes_then.append(pickle.dumps(got))
    # What was handed out stays as it was.
    assert_same(handed, [pickle.loads(then) for then in bytes_then])
    assert tensors.state().device.type == device.type
    assert observations["species_0"].shape == (3, 9, 66)
    assert got[1]["species_0"].dtype == torch.float32


@pytest.mark.parametrize("maker", [make, batch])
def test_a_copy_by_pickle_goes_on_alike(maker, device):
    env = begun(maker(**DEADLY, device=str(device)))
    generator = np.random.default_rng(0)
    for _ in range(10):
        env.step(drawn(env, generator))
    copy = pickle.loads(pickle.dumps(env))
    for _ in range(10 if maker is batch else 4):
        actions = drawn(env, generator)
        assert_same(env.step(actions), copy.step(actions))
    assert np.array_equal(env.state(), copy.state())
    assert_same(env.reset(), copy.reset())


def test_pictures_are_those_of_the_single_worlds():
    keywords = {"render_mode": "rgb_array", "deaths": ((0, 1),)}
    envs, single = batch(**keywords), make(**keywords)
    envs.reset(seed=4)
    single.reset(seed=5)
    envs.step(still(envs))
    single.step({agent: action[1] for agent, action in still(envs).items()})
    pictures = envs.render()
    assert len(pictures) == 3
    assert np.array_equal(pictures[1], single.render())
    assert pictures[1].min() < 200
    envs.close()


def test_telling_species_apart_needs_memory_of_its_own(monkeypatch):
    # 64 worlds of 41 particles: P is 66, and 8 species append 24 numbers, of which 4 copies live.
    free = state.needed_bytes(64, 41, batch().worlds.physics, torch.device("cpu"))
    monkeypatch.setattr(state, "free_bytes", lambda device: free + 4 * 4 * 64 * 41 * 24 - 1)
    assert batch(world_count=64, species_count=8).worlds.perception_dim == 66
    with pytest.raises(NPAError, match="particle_count must fit into memory"):
        batch(world_count=64, species_count=8, perception="per_species")
    monkeypatch.setattr(state, "free_bytes", lambda device: free + 4 * 4 * 64 * 41 * 24)
    envs = batch(world_count=64, species_count=8, perception="per_species")
    assert envs.worlds.perception_dim == 66 + 24


def test_a_first_reset_that_is_refused_leaves_the_next_one_random():
    states = []
    for _ in range(2):
        envs = batch()
        refused("one for each of 3 worlds", envs.reset, seed=[1, 2])
        envs.reset()
        states += list(envs.state())
    # Neither two worlds nor two environments are alike.
    assert len({state.tobytes() for state in states}) == 6
