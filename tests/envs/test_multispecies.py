"""Species as agents: seeds, turns, deaths, pictures, errors."""

import pickle

import numpy as np
import pytest
import torch
from crowds import TASKS, drawn, make, placed, small, still
from small_envs import assert_same

import npa_envs
from npa_envs.envs import multispecies_v0, particles_v0
from npa_envs.errors import NPAError
from npa_envs.world.randomness import StreamId


def test_turns_lead_to_the_same_world_as_acting_at_once():
    together, turns = make(), multispecies_v0.env(**small("mixing"))
    together.reset(seed=3)
    turns.reset(seed=3)
    generator = np.random.default_rng(1)
    for _ in range(6):
        actions = drawn(together, generator)
        observations, rewards, *_ = together.step(actions)
        for agent, action in actions.items():
            assert turns.agent_selection == agent
            turns.step(action)
        for agent in actions:
            assert np.array_equal(turns.observe(agent), observations[agent])
            assert turns.rewards[agent] == rewards[agent]
    assert turns.truncations == {"species_0": True, "species_1": True}


def test_turns_clip_actions_that_are_too_large(recwarn):
    states = []
    for size in (3.0, 1.0):
        env = multispecies_v0.env(**small("mixing", update_prob=1.0))
        env.reset(seed=0)
        for agent in env.agents:
            env.step(np.full(env.action_space(agent).shape, size, np.float32))
        states.append(env.state())
    assert np.array_equal(*states)


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
    env = make(species_count=3, deaths=((1, 2),), update_prob=1.0)
    env.reset(seed=0)
    _, _, terminations, _, _ = env.step(still(env))
    assert not any(terminations.values())
    observations, rewards, terminations, truncations, infos = env.step(still(env))
    assert terminations == {"species_0": False, "species_1": True, "species_2": False}
    assert not any(truncations.values())
    assert infos["species_1"]["reason"] == "removed"
    assert "reason" not in infos["species_0"]
    assert rewards == dict.fromkeys(terminations, 0.0)
    assert env.agents == ["species_0", "species_2"]
    x, s = env.particles()
    assert x.shape == (27, 2)
    state = env.state()
    assert state[:, -1].tolist() == [1.0] * 14 + [0.0] * 14 + [1.0] * 13
    assert not state[14:28].any()
    z = npa_envs.perceive(x[None], s[None], 0.3, 0.1)[0].numpy()
    seen = np.concatenate([observations["species_0"], observations["species_2"]])
    np.testing.assert_allclose(seen, z, rtol=1e-5, atol=1e-6)
    observations, rewards, *_ = env.step(still(env))
    assert list(observations) == ["species_0", "species_2"]
    # That neighbours vanished is no merit and no fault.
    assert rewards == {"species_0": 0.0, "species_2": 0.0}
    with pytest.raises(NPAError, match="got one for species_1: agents that ended"):
        env.step(dict.fromkeys(("species_0", "species_1", "species_2"), np.zeros((14, 18))))
    env.reset()
    assert env.agents == ["species_0", "species_1", "species_2"]
    assert env.particles()[0].shape == (41, 2)


def test_the_last_observation_of_a_species_is_of_the_world_with_it():
    env = make(particle_counts=(1, 1), deaths=((1, 1),))
    env.reset(seed=0)
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
    assert infos["species_1"]["reason"] == "left the world"
    x, _ = env.particles()
    torch.testing.assert_close(x, torch.tensor([[0.7, 0.0], [0.15, 0.0]]))


@pytest.mark.parametrize("dead", [0, 1])
def test_an_invasion_is_over_when_one_side_is_gone(dead):
    env = make("invasion", deaths=((dead, 2),))
    env.reset(seed=0)
    env.step(still(env))
    _, rewards, terminations, _, infos = env.step(drawn(env, np.random.default_rng(0)))
    assert terminations == {"species_0": True, "species_1": True}
    assert infos[f"species_{dead}"]["reason"] == "removed"
    assert infos[f"species_{1 - dead}"]["reason"] == "no opponent"
    assert rewards["species_0"] == -rewards["species_1"] != 0.0
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
    with pytest.raises(NPAError, match="opponent must be a known word, got 'rnadom': did you mean"):
        make("invasion", opponent="rnadom")


@pytest.mark.parametrize("dead", [0, 1])
def test_an_episode_against_an_opponent_ends_when_one_side_is_gone(dead):
    env = make("invasion", opponent="random", deaths=((dead, 2),))
    env.reset(seed=0)
    for ended in (False, True):
        _, _, terminations, _, infos = env.step(still(env))
        assert terminations == {"species_0": ended}
    assert infos["species_0"]["reason"] == ("removed" if dead == 0 else "no opponent")
    assert env.agents == []


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
    env = make(deaths=((0, 1), (1, 1)), render_mode="rgb_array")
    env.reset(seed=0)
    env.step(still(env))
    assert env.agents == []
    assert env.render().min() == 255
    assert not env.state().any()
    # PettingZoo's loops may call this once more.
    assert env.step({}) == ({}, {}, {}, {}, {})
    with pytest.raises(NPAError, match="there is none: call reset first"):
        env.step({"species_0": np.zeros(1)})
    with pytest.raises(NPAError, match="actions must be a dict"):
        env.step(None)
    env.reset()
    with pytest.raises(NPAError, match="got none for species_0, species_1"):
        env.step({})


def test_pictures_tell_species_apart():
    keywords = {"particle_counts": (50, 50), "render_mode": "rgb_array", "render_size": 33}
    env = placed([[-0.5, 0.0]] * 50 + [[0.5, 0.0]] * 50, **keywords)
    picture = env.render().astype(int)
    left, right = picture[16, 8], picture[16, 24]
    assert left[0] > left[1] + 50
    assert right[1] > right[0] + 50
    grey = make(particle_counts=(1, 1), render_mode="rgb_array", render_style="particles")
    grey.reset(seed=0)
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
        with pytest.raises(NPAError, match="exclude each other"):
            make(particle_counts=counts, particle_count=50)
    named = make("co_morphogenesis", targets=np.array(["heart", "ring"])).config
    assert named.targets == ("heart", "ring")


def test_a_copy_by_pickle_goes_on_alike():
    env = make(deaths=((1, 3),))
    env.reset(seed=0)
    generator = np.random.default_rng(0)
    env.step(drawn(env, generator))
    copy = pickle.loads(pickle.dumps(env))
    while env.agents:
        actions = drawn(env, generator)
        assert_same(env.step(actions), copy.step(actions))
    assert_same(env.reset(), copy.reset())


REFUSED = {
    multispecies_v0.parallel_env: [
        ({"task": "mixin"}, "task must be a known word, got 'mixin': did you mean 'mixing'"),
        ({"task": 3}, "task must be a known word, got 3"),
        ({"species_count": 0}, "species_count must be a whole number of at least 1, got 0"),
        ({"species_count": 1}, "species_count must be at least 2 in this task, got 1"),
        ({"species_count": 65}, "species_count must be at most 64, got 65"),
        ({"particle_count": 1}, "particle_count must be at least species_count = 2, got 1"),
        ({"particle_counts": (3,)}, r"particle_counts must be 2 whole numbers .* got \(3,\)"),
        ({"particle_counts": (3, 0)}, "particle_counts must be 2 whole numbers of at least 1"),
        ({"particle_count": 9, "particle_counts": (3, 6)}, "exclude each other"),
        ({"seed_radius": 4.0}, "seed_radius and seed_distance must keep all disks within 4"),
        ({"seed_distance": -1.0}, "seed_distance must be a finite number of at least 0"),
        ({"deaths": ((2, 5),)}, "each species from 0 to 1 at most once, each step at least 1"),
        ({"deaths": ((1, 0),)}, r"deaths must be pairs .* got \(\(1, 0\),\)"),
        ({"deaths": ((1, 5), (1, 6))}, "deaths must be pairs"),
        ({"deaths": (1, 5)}, "deaths must be pairs"),
        ({"reward": "dense"}, "reward must be a known word, got 'dense'"),
        ({"task": "invasion", "reward": "team"}, "reward must be 'individual' in invasion"),
        ({"task": "co_morphogenesis", "targets": ("heart",)}, "targets must be 2 names"),
        ({"task": "symbiosis", "target": "hart"}, "did you mean 'heart'"),
        ({"task": "symbiosis", "state_dim": 2}, "state_dim must be a whole number of at least 3"),
        ({"render_style": "art"}, "render_style must be a known word"),
        ({"render_mode": "ansi"}, "render_mode must be a known word"),
        ({"boundary": "periodic", "box_size": "2"}, "box_size must be a finite number greater"),
        ({"task": "symbiosis", "sigma": 1e20}, r"sigma must be at most 1e\+09, got 1e\+20"),
        ({"task": "invasion", "colour_weight": 1e38}, "colour_weight must be at most"),
        ({"max_cycles": 0}, "max_cycles must be a whole number of at least 1"),
        ({"epsilon": 0.2}, "unexpected keyword argument 'epsilon': did you mean 'eps'"),
        ({"seed": 1}, r"unexpected keyword argument 'seed': give it to reset\(seed=...\)"),
        ({"eps": -0.1}, "eps must be a finite number greater than 0"),
        ({"perception": "own"}, r"perception must be a known word, got 'own'"),
        ({"on_divergence": "reset"}, "on_divergence must be a known word, got 'reset'"),
    ],
    multispecies_v0.batched: [
        ({"world_count": 0}, "world_count must be a whole number of at least 1, got 0"),
        ({"autoreset_mode": "next-step"}, "autoreset_mode must be 'same-step' or 'disabled'"),
        ({"autoreset_mode": "never"}, "autoreset_mode must be a known word, got 'never'"),
        ({"eps": -1.0}, "eps must be a finite number greater than 0"),
        ({"num_envs": 3}, "unexpected keyword argument 'num_envs'"),
        ({"world_count": 10**7, "particle_count": 10**4}, "particle_count is too large"),
    ],
    particles_v0.parallel_env: [
        ({"particle_count": 513}, "particle_count must be at most 512 .* got 513"),
        ({"particle_counts": (500, 20)}, "particle_count must be at most 512 .* got 520"),
        ({"species_count": 0}, "species_count must be a whole number of at least 1"),
        ({"task": "mixin"}, "did you mean 'mixing'"),
        ({"particles": 4}, "unexpected keyword argument 'particles': did you mean"),
    ],
}


@pytest.mark.parametrize(
    ("make", "keywords", "message"),
    [(make, *row) for make in REFUSED for row in REFUSED[make]],
)
def test_a_wrong_configuration_is_refused(make, keywords, message):
    with pytest.raises(NPAError, match=message):
        make(**keywords)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: a.pop("species_1"), "got none for species_1"),
        (lambda a: a.update(species_2=a["species_0"]), "got one for species_2"),
        (
            lambda a: a.update(species_1=np.zeros((3, 18))),
            r"actions\['species_1'\] must be real numbers of shape \(20, 18\), got \(3, 18\)",
        ),
        (lambda a: a.update(species_0="left"), r"actions\['species_0'\] must be real numbers"),
        (lambda a: a.update(species_0=None), r"actions\['species_0'\] must be real numbers"),
        (lambda a: a.update(species_0=a["species_0"] + 1j), "must be real numbers"),
        (
            lambda a: a["species_1"].__setitem__((4, 7), np.nan),
            r"actions\['species_1'\] must be finite, got nan \(1 such",
        ),
        (lambda a: a["species_1"].fill(np.inf), "must be finite, got inf"),
    ],
)
def test_a_wrong_action_is_refused_and_leaves_the_world_as_it_was(change, message):
    env, untouched = make(), make()
    for e in (env, untouched):
        e.reset(seed=0)
    actions = still(env)
    change(actions)
    before = env.state()
    with pytest.raises(NPAError, match=message):
        env.step(actions)
    assert np.array_equal(env.state(), before)
    actions = drawn(env, np.random.default_rng(0))
    assert env.step(actions)[1] == untouched.step(actions)[1]


def test_what_needs_a_world_says_so():
    env = make()
    for call in (env.state, env.render, lambda: env.step({}), lambda: env.place_particles(0, 0)):
        with pytest.raises(NPAError, match="call reset first"):
            call()
    env.reset()
    for x in ([[0.0, 0.0], [1.0]], "left", None, {}):
        with pytest.raises(NPAError, match="x must be numbers, got"):
            env.place_particles(x, np.zeros((41, 16)))
    with pytest.raises(NPAError, match=r"actions must be a dict .* got list"):
        env.step([])
    with pytest.raises(NPAError, match="agent must be one that exists, got 'species_9'"):
        env.action_space("species_9")
    env.close()
    env.close()


def test_a_species_that_is_gone_leaves_nothing_to_perceive():
    env = multispecies_v0.parallel_env(
        "mixing", species_count=3, particle_count=48, deaths=((1, 1),), perception="per_species"
    )
    first, _ = env.reset(seed=0)
    actions = {agent: np.zeros(env.action_space(agent).shape, np.float32) for agent in env.agents}
    env.step(actions)
    del actions["species_1"]
    observations, *_ = env.step(actions)
    width = first["species_0"].shape[1] - 9
    own = observations["species_0"][:, width:]
    assert np.all(own[:, 0] > 0.0)
    assert np.all(own[:, 1] == 0.0)
    assert np.all(own[:, 5:7] == 0.0)
    assert np.any(own[:, 3:5] != 0.0)
