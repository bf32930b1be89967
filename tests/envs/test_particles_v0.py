"""Particles as agents: rewards that add up, ends of single particles."""

import numpy as np
import pytest
from crowds import HALF_WAY, TASKS, drawn, few, still

from npa_envs.envs import multispecies_v0, particles_v0
from npa_envs.errors import NPAError


def make(task="mixing", **keywords):
    return particles_v0.parallel_env(**few(task, **keywords))


def test_every_particle_is_an_agent_and_is_told_its_species():
    env = make(particle_counts=(2, 3))
    observations, infos = env.reset(seed=0)
    assert env.agents == [f"particle_{k}" for k in range(5)]
    assert [infos[agent]["species"] for agent in env.agents] == [0, 0, 1, 1, 1]
    assert env.observation_space("particle_4").shape == (66,)
    assert env.action_space("particle_4").shape == (18,)
    assert env.action_space("particle_4") is not env.action_space("particle_3")
    assert observations["particle_4"].shape == (66,)
    assert len(particles_v0.parallel_env().possible_agents) == 64
    assert len(make(particle_counts=np.array([2, 3])).possible_agents) == 5


@pytest.mark.parametrize("task", TASKS)
def test_the_world_is_that_of_species_as_agents(task):
    crowd, species = make(task), multispecies_v0.parallel_env(**few(task))
    seen, _ = crowd.reset(seed=3)
    there, _ = species.reset(seed=3)
    generator = np.random.default_rng(0)
    for _ in range(4):
        actions = drawn(species, generator)
        rows = np.concatenate(list(actions.values()))
        seen, rewards, *_ = crowd.step(dict(zip(crowd.agents, rows, strict=True)))
        there, payment, *_ = species.step(actions)
        assert np.array_equal(np.stack(list(seen.values())), np.concatenate(list(there.values())))
        assert np.array_equal(crowd.state(), species.state())
        paid = np.array(list(rewards.values()))
        means = {"species_0": paid[:5].mean(), "species_1": paid[5:].mean()}
        if task == "symbiosis":
            # A species is paid for the whole picture, a particle for its own share of it.
            means = dict.fromkeys(means, paid.mean())
        if task == "invasion":
            # Means of five and of four particles.
            means["species_1"] *= 4 / 5
            assert paid.sum() == pytest.approx(0.0, abs=1e-12)
        assert payment == pytest.approx(means, abs=2e-6)
        assert paid.std() > 0.0


def test_a_particle_is_paid_for_its_own_entropy_or_for_that_of_all():
    for reward in ("individual", "team"):
        env = make(particle_counts=(1, 2), update_prob=1.0, reward=reward)
        env.reset(seed=0)
        env.place_particles([[0.0, 0.0], [0.15, 0.0], [2.0, 2.0]], np.zeros((3, 16)))
        actions = still(env)
        actions["particle_1"][0] = 1.0
        _, rewards, _, _, infos = env.step(actions)
        own = [-HALF_WAY, -HALF_WAY, 0.0]
        expected = own if reward == "individual" else [np.mean(own)] * 3
        assert list(rewards.values()) == pytest.approx(expected, abs=1e-6)
        assert infos["particle_1"]["reward_separation"] == pytest.approx(-HALF_WAY, abs=1e-6)
        assert infos["particle_2"]["loss"] == pytest.approx(1.0, abs=1e-6)


def test_a_particle_that_leaves_ends_alone():
    env = make(particle_counts=(2, 1), position_limit=0.7, update_prob=1.0)
    env.reset(seed=0)
    env.place_particles([[0.0, 0.0], [0.65, 0.0], [0.1, 0.0]], np.zeros((3, 16)))
    actions = still(env)
    actions["particle_1"][0] = 1.0
    observations, _, terminations, _, infos = env.step(actions)
    assert terminations == {"particle_0": False, "particle_1": True, "particle_2": False}
    assert infos["particle_1"]["reason"] == "left the world"
    assert set(observations) == set(terminations)
    assert env.agents == ["particle_0", "particle_2"]
    assert env.state()[:, -1].tolist() == [1.0, 0.0, 1.0]
    with pytest.raises(NPAError, match="got one for particle_1: agents that ended"):
        env.step(actions)
    observations, *_ = env.step(still(env))
    assert set(observations) == {"particle_0", "particle_2"}


def test_particles_of_a_removed_species_end_together():
    env = make("co_morphogenesis", deaths=((0, 1),))
    env.reset(seed=0)
    _, _, terminations, _, _ = env.step(still(env))
    assert list(terminations.values()) == [True] * 5 + [False] * 4
    assert env.agents == [f"particle_{k}" for k in range(5, 9)]
    _, rewards, *_ = env.step(drawn(env, np.random.default_rng(0)))
    assert len(rewards) == 4
    assert all(rewards.values())


def test_a_wrong_action_is_refused():
    env = make()
    env.reset(seed=0)
    with pytest.raises(NPAError, match="got none for particle_0, particle_1, particle_2 and 6"):
        env.step({})
    with pytest.raises(NPAError, match=r"'particle_7'\] must be real numbers of shape \(18,\)"):
        env.step(still(env) | {"particle_7": np.zeros((1, 18))})
