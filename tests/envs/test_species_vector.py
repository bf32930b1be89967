"""Batches of worlds of several species: world k is the single environment, also after deaths."""

import numpy as np
import pytest
import torch
from support.crowds import TASKS, drawn, make, small
from support.refusals import refused

from npa_envs.envs import gardeners_v0, multispecies_v0, particles_v0
from npa_envs.envs.core import world_state
from npa_envs.envs.multi import AGENT_REASONS
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
        if name not in infos[agent]:
            assert not value, name
            continue
        value = AGENT_REASONS[value] if name == "reason" else value
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
def test_a_batch_equals_single_environments_while_species_die_here_and_there(task, changes, device):
    keywords = DEADLY | changes | {"device": str(device)}
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
                reasons.add(AGENT_REASONS[info[agent]["reason"]])
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


def test_telling_species_apart_needs_memory_of_its_own(monkeypatch):
    # 64 worlds of 41 particles: P is 66, and 8 species append 24 numbers; 4 copies exist.
    free = world_state.needed_bytes(64, 41, batch().worlds.physics, torch.device("cpu"))
    monkeypatch.setattr(world_state, "free_bytes", lambda device: free + 4 * 4 * 64 * 41 * 24 - 1)
    assert batch(world_count=64, species_count=8).worlds.perception_dim == 66
    with pytest.raises(NPAError, match="particle_count must fit into memory"):
        batch(world_count=64, species_count=8, perception="per_species")
    monkeypatch.setattr(world_state, "free_bytes", lambda device: free + 4 * 4 * 64 * 41 * 24)
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


GARDEN = {"max_cycles": 3, "particle_count": 64, "grow_steps": 8, "rule_steps": 2}


@pytest.mark.parametrize(
    ("module", "keywords"),
    [
        (particles_v0, {"task": "npa/SegregationSmall-v0", "max_cycles": 5}),
        # Particles leave the world one by one, and opponents are no agents.
        (particles_v0, {"task": "npa/InvasionSmall-v0", "position_limit": 0.62, "max_cycles": 8}),
        (gardeners_v0, GARDEN),
    ],
)
def test_worlds_of_particles_or_gardeners_equal_single_ones(module, keywords):
    envs = module.batched(world_count=3, **keywords)
    singles = [module.parallel_env(**keywords) for _ in range(3)]
    observations, _ = envs.reset(seed=7)
    for k, env in enumerate(singles):
        seen, _ = env.reset(seed=7 + k)
        assert list(seen) == list(envs.possible_agents)
        assert all(np.array_equal(observations[agent][k], seen[agent]) for agent in seen)
    generator, early = np.random.default_rng(1), 0
    for _ in range(17):
        actions = {
            agent: generator.uniform(-1, 1, (3, *space.shape)).astype(np.float32)
            for agent, space in singles[0].action_spaces.items()
        }
        observations, rewards, terminations, truncations, infos = envs.step(actions)
        for k, env in enumerate(singles):
            seen, paid, ended, cut, info = env.step({a: actions[a][k] for a in env.agents})
            early += sum(ended.values())
            for agent in paid:
                assert rewards[agent][k] == np.float32(paid[agent])
                assert (terminations[agent][k], truncations[agent][k]) == (ended[agent], cut[agent])
                if env.agents:
                    assert infos[agent]["loss"][k] == pytest.approx(info[agent]["loss"], rel=1e-6)
            seen = seen if env.agents else env.reset()[0]
            for agent in env.agents:
                assert np.array_equal(observations[agent][k], seen[agent])
            assert np.array_equal(envs.state()[k], env.state())
    assert (early > 0) == ("position_limit" in keywords)


@pytest.mark.parametrize(
    ("module", "keywords"),
    [
        (multispecies_v0, {"task": "npa/SegregationSmall-v0", "max_cycles": 3}),
        (particles_v0, {"task": "npa/SegregationParticlesSmall-v0", "max_cycles": 3}),
        (gardeners_v0, GARDEN),
    ],
)
def test_batches_of_all_kinds_of_agents_have_the_same_attributes(module, keywords):
    envs = module.batched(world_count=2, **keywords)
    assert (envs.world_count, envs.num_envs, envs.max_cycles) == (2, 2, 3)
    assert envs.metadata["name"] == module.parallel_env(**keywords).metadata["name"]
    observations, infos = envs.reset(0)
    assert all(infos[agent]["live"].all() for agent in envs.agents)
    for step in range(4):
        for agent, seen in observations.items():
            assert envs.observation_spaces[agent].contains(seen)
            assert envs.single_observation_spaces[agent].contains(seen[1])
        assert envs.single_state_space.contains(envs.state()[0])
        assert envs.state_space.contains(envs.state())
        actions = {agent: envs.action_spaces[agent].sample() for agent in envs.agents}
        observations, *_, infos = envs.step(actions)
        for agent in envs.agents:
            assert infos[agent]["acted"].tolist() == infos[agent]["live"].tolist() == [True, True]
            assert list(infos[agent].get("reason", ())) == ["time limit"] * (2 * (step == 2))


@pytest.mark.parametrize("output", ["numpy", "torch"])
def test_gardeners_say_in_which_worlds_they_act(output):
    for mode in ("next-step", "disabled"):
        envs = gardeners_v0.batched(world_count=2, autoreset_mode=mode, output=output, **GARDEN)
        _, infos = envs.reset(seed=0)
        seen = []
        for step in range(4):
            if step == 3 and mode == "disabled":
                _, infos = envs.reset(options={"reset_mask": np.array([True, False])})
                assert infos["raider_0"]["live"].tolist() == [True, False]
                break
            actions = {
                a: np.zeros((2, *s.shape), "f4") for a, s in envs.single_action_spaces.items()
            }
            *_, infos = envs.step(actions)
            own = infos["raider_0"]
            seen.append((own["acted"].tolist(), own["live"].tolist(), "reason" in own))
        yes, no = [True, True], [False, False]
        last = [(no, yes, False)] * (mode == "next-step")
        assert seen == [(yes, yes, False), (yes, yes, False), (yes, no, True), *last]


def test_ids_of_particles_are_the_worlds_of_the_ids_of_species():
    tasks = ("npa/InvasionParticlesSmall-v0", "npa/InvasionSmall-v0")
    env, same = (particles_v0.parallel_env(task, max_cycles=2) for task in tasks)
    assert repr(env) == "<ParticlesEnv npa_particles_v0: 64 agents, max_cycles=2>"
    batch = particles_v0.batched(tasks[0], world_count=2)
    assert repr(batch) == "<ParticlesVectorEnv invasion: 2 worlds of 64 agents, max_cycles=32>"
    env.reset(seed=3)
    same.reset(seed=3)
    assert np.array_equal(env.state(), same.state())
    envs = particles_v0.batched("npa/SegregationParticles-v0")
    _, infos = envs.reset(seed=0)
    assert [infos[agent]["species"] for agent in envs.agents] == [0] * 32 + [1] * 32
    refused("task must be a known word", particles_v0.batched, "npa/SegregationParticles-v1")
    refused("task must be a known word", particles_v0.batched, ["npa/SegregationParticles-v0"])


def test_gardeners_together_need_both_actions():
    envs = gardeners_v0.batched(world_count=2, **GARDEN)
    envs.reset(seed=0)
    with pytest.raises(NPAError, match="actions must be given for the agents"):
        envs.step({"keeper_0": np.zeros((2, *envs.single_action_space.shape), np.float32)})
