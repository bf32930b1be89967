"""Species and particles as agents: turns, deaths, opponents, pictures, PettingZoo's tests."""

from copy import deepcopy

import numpy as np
import pettingzoo
import pytest
import torch
from pettingzoo.test import api_test, parallel_api_test, render_test, seed_test
from pettingzoo.test.max_cycles_test import max_cycles_test
from pettingzoo.test.seed_test import parallel_seed_test
from pettingzoo.test.state_test import state_test
from support.crowds import TASKS, drawn, few, make, module_of, placed, small, still
from support.refusals import refused
from support.slow import slow
from support.small_envs import begun

import npa_envs
from npa_envs.envs import multispecies_v0, particles_v0
from npa_envs.envs.multi import AGENT_REASONS as REASONS
from npa_envs.envs.multi import TASKS as TABLE
from npa_envs.world.randomness import StreamId


def test_turns_clip_actions_and_lead_to_the_same_world_as_acting_at_once(recwarn):
    together, turns = begun(make(), multispecies_v0.env(**small("mixing")), seed=3)
    generator = np.random.default_rng(1)
    for _ in range(6):
        drawings = drawn(together, generator)
        actions = {agent: np.clip(1.5 * a, -1.0, 1.0) for agent, a in drawings.items()}
        observations, rewards, *_ = together.step(actions)
        for agent, action in actions.items():
            assert turns.agent_selection == agent
            turns.step(np.where(np.abs(action) < 1.0, action, 3.0 * action))
        for agent in actions:
            assert np.array_equal(turns.observe(agent), observations[agent])
            assert turns.rewards[agent] == rewards[agent]
    assert turns.truncations == {"species_0": True, "species_1": True}


def test_turns_are_checked_as_pettingzoo_checks_them():
    turns = particles_v0.env(**few("mixing"))
    assert not hasattr(turns, "agents")
    for call in (turns.render, turns.state, turns.agent_iter, lambda: turns.step(None)):
        with pytest.raises(AssertionError, match=r"reset\(\) needs to be called"):
            call()
    turns.reset(seed=0)
    for width, value, message in ((18, np.nan, "a nan action"), (17, 0.0, "should have shape")):
        with pytest.raises(AssertionError, match=message):
            turns.step(np.full(width, value, np.float32))


def test_species_have_spaces_of_their_own_sizes_and_the_state_shows_all():
    env = make(species_count=2, particle_counts=[3, 5])
    observations, _ = env.reset(seed=0)
    assert env.observation_space("species_1").shape == (5, 66)
    assert env.action_space("species_0").shape == (3, 18)
    assert observations["species_1"].dtype == np.float32
    x, s = env.particles()
    wanted = np.concatenate((x, s, np.ones((8, 1))), axis=1).astype(np.float32)
    assert np.array_equal(env.state(), wanted)
    assert env.state_space.contains(env.state())


def test_a_species_that_is_removed_is_gone():
    each = {"perception": "per_species"}
    env = begun(make(species_count=3, deaths=(("species_1", 2),), update_prob=1.0, **each))
    _, _, terminations, _, _ = env.step(still(env))
    assert not any(terminations.values())
    observations, rewards, terminations, truncations, infos = env.step(still(env))
    assert terminations == {"species_0": False, "species_1": True, "species_2": False}
    assert not any(truncations.values())
    assert REASONS[infos["species_1"]["reason"]] == "removed"
    assert infos["species_0"]["reason"] == 0
    assert rewards == dict.fromkeys(terminations, 0.0)
    assert env.agents == ["species_0", "species_2"]
    x, s = env.particles()
    assert x.shape == (27, 2)
    state = env.state()
    assert state[:, -1].tolist() == [1.0] * 14 + [0.0] * 14 + [1.0] * 13
    assert not state[14:28].any()
    z = npa_envs.perceive(x[None], s[None], 0.3, 0.1)[0].numpy()
    seen = np.concatenate([observations["species_0"], observations["species_2"]])
    np.testing.assert_allclose(seen[:, :66], z, rtol=1e-5, atol=1e-6)
    # Densities of three species, then their gradients.
    own = observations["species_0"][:, 66:]
    assert (own[:, 0] > 0.0).all()
    assert own[:, 3:5].any()
    assert not own[:, [1, 5, 6]].any()
    # An action of the species that is gone is ignored.
    observations, rewards, *_ = env.step(still(env) | {"species_1": np.ones((14, 18))})
    assert list(observations) == ["species_0", "species_2"]
    # That neighbours vanished is no merit and no fault.
    assert rewards == {"species_0": 0.0, "species_2": 0.0}
    refused("got one for species_3: see", env.step, still(env) | {"species_3": np.zeros((14, 18))})
    env.reset()
    assert env.agents == ["species_0", "species_1", "species_2"]
    assert env.particles()[0].shape == (41, 2)


def test_the_last_observation_of_a_species_is_of_the_world_with_it():
    env = begun(make(particle_counts=(1, 1), deaths=((1, 1),)))
    s = np.zeros((2, 16))
    s[0, 0] = 1.0
    env.place_particles([[0.0, 0.0], [0.15, 0.0]], s)
    observations, *_ = env.step(still(env))
    share = 0.75**3 / (1.0 + 0.75**3)
    assert observations["species_1"][0, 16] == pytest.approx(share, abs=1e-6)
    assert observations["species_0"][0, 16] == pytest.approx(1.0, abs=1e-6)


def test_a_species_ends_when_all_of_its_particles_have_left():
    points = [[0.65, 0], [0.0, 0.0], [0.65, 0.3], [0.6, 0.6]]
    env = placed(points, particle_counts=(2, 2), position_limit=0.7)
    actions = still(env)
    for action in actions.values():
        action[:, 0] = 1.0
    _, _, terminations, _, infos = env.step(actions)
    assert terminations == {"species_0": False, "species_1": True}
    assert REASONS[infos["species_1"]["reason"]] == "left the world"
    x, _ = env.particles()
    torch.testing.assert_close(x, torch.tensor([[0.7, 0.0], [0.15, 0.0]]))


@pytest.mark.parametrize("opponent", [None, "random"])
@pytest.mark.parametrize("dead", [0, 1])
def test_an_invasion_is_over_when_one_side_is_gone(dead, opponent):
    env = begun(make("invasion", opponent=opponent, deaths=((dead, 2),)))
    _, _, terminations, _, _ = env.step(still(env))
    assert not any(terminations.values())
    _, rewards, terminations, _, infos = env.step(drawn(env, np.random.default_rng(0)))
    assert terminations == dict.fromkeys(env.possible_agents, True)
    for agent in env.possible_agents:
        is_dead = agent == f"species_{dead}"
        reason = REASONS[infos[agent]["reason"]]
        assert reason == ("removed" if is_dead else "no opponent")
    assert rewards["species_0"] != 0.0
    assert opponent or rewards["species_0"] == -rewards["species_1"]
    assert env.agents == []


def test_an_opponent_acts_as_agents_would_that_act_uniformly_at_random(device):
    where = {"device": str(device)}
    both, alone = make("invasion", **where), make("invasion", opponent="random", **where)
    assert alone.possible_agents == ["species_0"]
    agents = both.possible_agents
    for env in (both, alone):
        env.reset(seed=3)
    generator = np.random.default_rng(0)
    moved = 0.0
    for _ in range(4):
        actions = drawn(both, generator)
        shape = sum(len(actions[agent]) for agent in agents), actions["species_1"].shape[1]
        random = both.worlds.random.substream(StreamId.OPPONENT)
        invaders = (2.0 * random.uniform(*shape)[0] - 1.0).cpu()
        actions["species_1"] = invaders[len(actions["species_0"]) :]
        moved += float(actions["species_1"].abs().mean())
        expected, paid, *_ = both.step(actions)
        seen, own, *_ = alone.step({"species_0": actions["species_0"]})
        assert np.array_equal(seen["species_0"], expected["species_0"])
        assert own == {"species_0": paid["species_0"]}
        assert torch.equal(alone.particles()[0], both.particles()[0])
    assert moved / 4 == pytest.approx(0.5, abs=0.05)


def test_particles_of_one_species_can_be_agents_against_an_opponent():
    env = particles_v0.parallel_env("invasion", opponent="random", particle_counts=(3, 5))
    observations, _ = env.reset(seed=0)
    assert list(observations) == ["particle_0", "particle_1", "particle_2"]
    assert len(env.particles()[0]) == 8
    before = env.particles()[0]
    env.step(still(env))
    moved = (env.particles()[0] != before).any(dim=1)
    assert not moved[:3].any()
    assert moved[3:].any()


def test_a_world_without_particles_can_be_drawn_and_described():
    env = begun(make(deaths=((0, 1), (1, 1)), render_mode="rgb_array"))
    env.step(still(env))
    assert env.agents == []
    assert env.render().min() == 255
    assert not env.state().any()
    # PettingZoo's loops may call this once more.
    assert env.step({}) == ({}, {}, {}, {}, {})
    refused("there is none: call reset first", env.step, {"species_0": np.zeros(1)})
    refused("actions must be a dict", env.step, None)
    env.reset()
    refused("got none for species_0, species_1", env.step, {})


def test_pictures_tell_species_apart():
    keywords = {"particle_counts": (50, 50), "render_mode": "rgb_array", "render_size": 33}
    env = placed([[-0.5, 0.0]] * 50 + [[0.5, 0.0]] * 50, **keywords)
    picture = env.render().astype(int)
    left, right = picture[16, 8], picture[16, 24]
    assert left[0] > left[1] + 50
    assert right[1] > right[0] + 50
    grey = begun(make(particle_counts=(1, 1), render_mode="rgb_array", render_style="particles"))
    assert np.ptp(grey.render().astype(int), axis=2).max() <= 1


@pytest.mark.parametrize("task", TASKS)
def test_pictures_of_a_periodic_box_show_the_box_and_nothing_more(task):
    keywords = {"boundary": "periodic", "box_size": 4.0, "seed_distance": 2.4}
    keywords |= {"particle_counts": (30, 30), "render_mode": "rgb_array"}
    # On a corner, a quarter of a particle is seen in each of them.
    env = placed(np.full((60, 2), -2.0), task, **keywords)
    picture = env.render().astype(int)
    assert picture[0, 0].max() < 200
    assert picture[12, 12].min() > 250
    for mirrored in (picture[::-1], picture[:, ::-1]):
        assert np.abs(picture - mirrored).max() < 9


def test_arrays_and_tensors_are_taken_for_tuples():
    for counts in ([30, 20], np.array([30, 20]), torch.tensor([30, 20])):
        config = make(particle_counts=counts, deaths=np.array([[1, 5]])).config
        assert config.counts == (30, 20)
        assert config.deaths == ((1, 5),)
        refused("exclude each other", make, particle_counts=counts, particle_count=50)
    named = make("co_morphogenesis", targets=np.array(["heart", "ring"])).config
    assert named.targets == ("heart", "ring")


# Particles as agents


def crowd(task="mixing", **keywords):
    return particles_v0.parallel_env(**few(task, **keywords))


def test_every_particle_is_an_agent_and_reports_its_species():
    env = crowd(particle_counts=(2, 3))
    observations, infos = env.reset(seed=0)
    assert env.agents == [f"particle_{k}" for k in range(5)]
    assert [infos[agent]["species"] for agent in env.agents] == [0, 0, 1, 1, 1]
    assert env.observation_space("particle_4").shape == (66,)
    assert env.action_space("particle_4").shape == (18,)
    assert env.action_space("particle_4") is not env.action_space("particle_3")
    assert observations["particle_4"].shape == (66,)
    assert len(particles_v0.parallel_env().possible_agents) == 64
    assert len(crowd(particle_counts=np.array([2, 3])).possible_agents) == 5


@pytest.mark.parametrize("task", TASKS)
def test_the_world_is_that_of_species_as_agents(task):
    apart, species = crowd(task), multispecies_v0.parallel_env(**few(task))
    seen, _ = apart.reset(seed=3)
    there, _ = species.reset(seed=3)
    generator = np.random.default_rng(0)
    for _ in range(4):
        actions = drawn(species, generator)
        rows = np.concatenate(list(actions.values()))
        seen, rewards, *_ = apart.step(dict(zip(apart.agents, rows, strict=True)))
        there, payment, *_ = species.step(actions)
        assert np.array_equal(np.stack(list(seen.values())), np.concatenate(list(there.values())))
        assert np.array_equal(apart.state(), species.state())
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


def test_a_particle_that_leaves_ends_alone():
    env = begun(crowd(particle_counts=(2, 1), position_limit=0.7, update_prob=1.0))
    env.place_particles([[0.0, 0.0], [0.65, 0.0], [0.1, 0.0]], np.zeros((3, 16)))
    actions = still(env)
    actions["particle_1"][0] = 1.0
    observations, _, terminations, _, infos = env.step(actions)
    assert terminations == {"particle_0": False, "particle_1": True, "particle_2": False}
    assert REASONS[infos["particle_1"]["reason"]] == "left the world"
    assert set(observations) == set(terminations)
    assert env.agents == ["particle_0", "particle_2"]
    assert env.state()[:, -1].tolist() == [1.0, 0.0, 1.0]
    observations, *_ = env.step(actions)
    assert set(observations) == {"particle_0", "particle_2"}


def test_particles_of_a_removed_species_end_together():
    env = begun(crowd("co_morphogenesis", deaths=((0, 1),)))
    _, _, terminations, _, _ = env.step(still(env))
    assert list(terminations.values()) == [True] * 5 + [False] * 4
    assert env.agents == [f"particle_{k}" for k in range(5, 9)]
    _, rewards, *_ = env.step(drawn(env, np.random.default_rng(0)))
    assert len(rewards) == 4
    assert all(rewards.values())


def test_losses_of_particles_are_of_the_world_as_it_is_also_after_deaths():
    env = begun(crowd(species_count=3, deaths=((1, 3),), max_cycles=7))
    for step in range(6):
        *_, infos = env.step(drawn(env, np.random.default_rng(step)))
        # The losses of the step of a death are those before it.
        if step != 2:
            losses = env.worlds.task.particle_losses(env.worlds.population(0))["separation"]
            assert [info["loss"] for info in infos.values()] == losses[0].tolist()


# PettingZoo's own tests


pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:pettingzoo")

KINDS = {"species": (multispecies_v0, small), "particle": (particles_v0, few)}
"""Modules by what their agents are called, and keywords of small worlds."""

every_kind = pytest.mark.parametrize("kind", KINDS)


@every_kind
@pytest.mark.parametrize("form", [np.ndarray.tolist, np.float64, np.float16, torch.from_numpy])
def test_actions_of_any_form_and_order_lead_to_the_same_world(form, kind):
    module, keywords = KINDS[kind]
    envs = [begun(module.parallel_env(**keywords("mixing")), seed=3) for _ in range(2)]
    # In halves, which all types have.
    drawings = drawn(envs[0], np.random.default_rng(0))
    actions = {agent: np.round(2.0 * action) / 2.0 for agent, action in drawings.items()}
    envs[0].step(actions)
    envs[1].step({agent: form(action) for agent, action in reversed(actions.items())})
    assert np.array_equal(envs[0].state(), envs[1].state())


@every_kind
def test_results_are_plain_and_do_not_change_when_a_caller_keeps_them(kind):
    module, keywords = KINDS[kind]
    settings, generator = keywords("mixing", max_cycles=8), np.random.default_rng(0)
    env, turns = module.parallel_env(**settings), module.env(**settings)
    kept, observed = [env.reset(seed=0)], []
    turns.reset(seed=0)
    copies = deepcopy(kept)
    while env.agents:
        actions = drawn(env, generator)
        for agent in env.agents:
            observed.append(turns.observe(agent))
            turns.step(actions[agent].copy())
        kept.append(env.step(actions))
        copies.append(deepcopy(kept[-1]))
        # Nor does the world read an action later.
        for action in actions.values():
            action[:] = 1.0
        _, *values, infos = kept[-1]
        assert [{type(v) for v in part.values()} for part in values] == [{float}, {bool}, {bool}]
        assert {type(v) for info in infos.values() for v in info.values()} <= {int, float, str}
    np.testing.assert_equal(kept, copies)
    seen = [observation for outcome in kept[:-1] for observation in outcome[0].values()]
    assert all(map(np.array_equal, observed, seen))


@every_kind
@pytest.mark.parametrize("task", [TASKS[0], *map(slow, TASKS[1:])])
def test_passes_all_tests_of_pettingzoo(task, kind, capsys, recwarn):
    module, keywords = KINDS[kind]
    given, deadly = keywords(task), keywords(task, deaths=((1, 3),))
    parallel_api_test(module.parallel_env(**deadly), num_cycles=8)
    api_test(module.env(**deadly), num_cycles=8)
    api_test(module.raw_env(**given), num_cycles=8)
    parallel_seed_test(lambda: module.parallel_env(**given), num_cycles=5)
    seed_test(lambda: module.env(**given), num_cycles=5)
    render_test(lambda **mode: module.env(**given, **mode))
    state_test(module.env(**given), module.parallel_env(**given), num_cycles=3)
    max_cycles_test(module_of(module, **given))


@every_kind
@pytest.mark.parametrize("api", ["parallel", "aec"])
@pytest.mark.skipif(not hasattr(pettingzoo, "make"), reason="PettingZoo has no registry yet")
def test_the_registry_of_pettingzoo_makes_every_task(kind, api):
    module, keywords = KINDS[kind]
    assert tuple(module.ENVIRONMENTS.values()) == TASKS == tuple(TABLE)
    for name, task in module.ENVIRONMENTS.items():
        given = keywords(task)
        del given["task"]
        env = begun(pettingzoo.make(api, name, **given))
        assert type(env.unwrapped.worlds.task) is TABLE[task]
        assert env.possible_agents == [f"{kind}_{k}" for k in range(2 if kind == "species" else 9)]
        assert pettingzoo.spec(api, name).id == name
