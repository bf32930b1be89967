"""What environments do about a world whose numbers run away, and that no other world notices."""

import numpy as np
import pytest
from small_envs import IDS, make, make_vec

from npa_envs.envs import multispecies_v0
from npa_envs.errors import DivergedError

NAME = "npa/Morphogenesis2D-v0"
WAYS = ("reset", "terminate", "ignore")
LIMIT, LAST = 3.5, 4
"""States grow by 1 a step where they are pushed, and so leave the limit in step 4."""


def pushed(env, world=1):
    """Return actions that do nothing but push all states of one world."""
    shape = env.action_space.shape
    action = np.zeros(shape, dtype=np.float32)
    (action if len(shape) == 2 else action[world])[:, -env.unwrapped.config.state_dim :] = 1.0
    return action


def vector(device, way, name=NAME, **keywords):
    keywords = {"observation_limit": LIMIT, "update_prob": 1.0, "device": str(device)} | keywords
    return make_vec(name, 3, on_divergence=way, **keywords)


def stepped(envs, count=LAST, seed=5):
    """Return what the last of some steps gave, the states of one world pushed."""
    envs.reset(seed=seed)
    for _ in range(count):
        result = envs.step(pushed(envs))
    return result


@pytest.mark.parametrize(
    ("name", "way"), [(name, "reset") for name in IDS] + [(NAME, way) for way in WAYS[1:]]
)
def test_a_world_that_diverges_changes_no_other_and_says_so(name, way, device):
    envs, calm = vector(device, way, name), vector(device, way, name)
    observations, _, terminations, truncations, infos = stepped(envs)
    calm.reset(seed=5)
    for _ in range(LAST):
        expected, *_ = calm.step(0.0 * pushed(calm))
    assert np.array_equal(observations[[0, 2]], expected[[0, 2]])
    assert np.isfinite(observations).all()
    told = infos["final_info"] if way == "terminate" else infos
    assert told["diverged"].tolist() == [False, True, False]
    assert terminations.tolist() == [False, way == "terminate", False]
    assert not truncations.any()
    if way == "terminate":
        assert told["reason"].tolist() == [None, "diverged", None]


@pytest.mark.parametrize("name", [NAME, "npa/Texture-v0"])
def test_an_error_names_world_step_number_and_cure(name, device):
    envs = vector(device, "raise", name)
    with pytest.raises(DivergedError) as caught:
        stepped(envs)
    text = str(caught.value)
    assert "observation_limit = 3.5, but left them in world 1 in step 4: states channel" in text
    assert "of particle 0 got to 3.5 (" in text
    assert "on_divergence='terminate' or 'reset'" in text
    observations, _ = envs.reset(seed=5)
    assert np.array_equal(observations, vector(device, "raise", name).reset(seed=5)[0])


def test_a_world_that_left_is_named_by_its_coordinate(device):
    env = make(NAME, on_divergence="raise", position_limit=0.21, update_prob=1.0)
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape, dtype=np.float32)
    action[:, 1] = 1.0
    # Half of eps in a step takes particles of a disk of radius 0.2 out of 0.21.
    with pytest.raises(DivergedError, match="in step 1: positions coordinate 1 of particle"):
        env.step(action)


@pytest.mark.parametrize(
    ("name", "reward"), [(name, "dense") for name in IDS] + [(NAME, "particle"), (NAME, "sparse")]
)
def test_a_reset_world_begins_its_next_episode_within_this_one(name, reward, device):
    keywords = {"max_episode_steps": LAST + 2, "reward": reward}
    envs, other = vector(device, "reset", name, **keywords), vector(device, "terminate", name)
    observations, rewards, _, _, infos = stepped(envs)
    other.reset(seed=5)
    first, start = other.reset(options={"reset_mask": np.array([False, True, False])})
    assert np.array_equal(observations[1], first[1])
    assert infos["loss"][1] == start["loss"][1]
    assert infos["diverged"][1]
    if reward == "dense":
        assert rewards[1] == stepped(other)[1][1] <= 0.0
    if reward == "particle":
        assert infos["particle_reward"][1] == pytest.approx(rewards[1])
    if reward == "sparse":
        assert rewards.tolist() == [0.0, 0.0, 0.0]
    still = 0.0 * pushed(envs)
    _, rewards, terminations, truncations, infos = envs.step(still)
    assert not infos["diverged"].any()
    assert not (terminations | truncations).any()
    if reward == "dense":
        assert rewards[1] == start["loss"][1] - infos["loss"][1]
    *_, truncations, infos = envs.step(still)
    assert truncations.all()
    assert infos["final_info"]["reason"].tolist() == ["time limit"] * 3


def test_an_ignored_world_goes_on_held_at_the_limits_and_rewards_telescope(device):
    envs = vector(device, "ignore")
    _, start = envs.reset(seed=5)
    paid = 0.0
    for t in range(1, 9):
        _, rewards, terminations, _, infos = envs.step(pushed(envs))
        paid += rewards
        assert not terminations.any()
        assert infos["diverged"].tolist() == [False, t >= LAST, False]
    assert (envs.unwrapped.particles()[1][1] == LIMIT).all()
    assert paid == pytest.approx(start["loss"] - infos["loss"], abs=1e-5)


# ----------------------------------------------------------------------------------------------
# Several species: an agent has diverged once none of its particles is within bounds


def species_actions(count, width, world_count=None):
    """Return actions of two species that push all states of the second one."""
    shape = (count, width) if world_count is None else (world_count, count, width)
    still, pushing = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    pushing[..., 2:] = 1.0
    return {"species_0": still, "species_1": pushing}


SPECIES = {"particle_count": 40, "state_dim": 4, "observation_limit": LIMIT, "update_prob": 1.0}


def test_species_that_diverge_are_terminated_told_or_let_be(device):
    for way in ("terminate", "ignore"):
        keywords = SPECIES | {"on_divergence": way, "device": str(device)}
        env = multispecies_v0.parallel_env("mixing", **keywords)
        env.reset(seed=0)
        for _ in range(LAST):
            observations, _, terminations, *_ = env.step(species_actions(20, 6))
        assert terminations == {"species_0": False, "species_1": way == "terminate"}
        assert env.agents == ["species_0"] + ["species_1"] * (way == "ignore")
        assert all(np.isfinite(rows).all() for rows in observations.values())
    assert (env.particles()[1][20:] == LIMIT).all()


def test_an_error_names_species_and_world(device):
    keywords = SPECIES | {"on_divergence": "raise", "device": str(device)}
    envs = multispecies_v0.batched("mixing", world_count=2, **keywords)
    envs.reset(seed=0)
    action = species_actions(20, 6, 2)
    action["species_1"][0] = 0.0
    for _ in range(LAST - 1):
        envs.step(action)
    with pytest.raises(DivergedError, match="species_1 of world 1 had none after step 4: take"):
        envs.step(action)
