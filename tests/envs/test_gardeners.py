"""Two gardeners with opposed aims: PettingZoo's checks, rewards, brushes that add up."""

import numpy as np
import pettingzoo
import pytest
import torch
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test

from npa_envs.agents.gardening import ScriptedGardener
from npa_envs.envs import gardeners_v0
from npa_envs.envs.gardener2d import Gardener2DEnv
from npa_envs.errors import NPAError

SMALL = {
    "particle_count": 61,
    "eps": 0.2,
    "resolution": 16,
    "picture_size": 8,
    "seed_pool": 2,
    "grow_steps": 4,
    "rule_steps": 2,
}


@pytest.mark.parametrize("form", [{}, {"actions": "discrete"}])
def test_pettingzoo_finds_nothing_to_complain_of(form):
    parallel_api_test(gardeners_v0.parallel_env(max_cycles=5, **SMALL, **form), num_cycles=12)
    parallel_seed_test(lambda: gardeners_v0.parallel_env(max_cycles=5, **SMALL, **form), 2)
    api_test(gardeners_v0.env(max_cycles=5, **SMALL, **form), num_cycles=12)


def test_policies_of_gardens_act_for_either_agent():
    env = gardeners_v0.parallel_env(**SMALL)
    seen, _ = env.reset(seed=0)
    script = ScriptedGardener(env.garden)
    left, right = (script(seen[agent]) for agent in env.agents)
    assert np.array_equal(left, right)
    assert np.abs(left).max() > 0.0
    # One undoes what the other does.
    x, _ = env.garden.particles()
    env.step({"keeper_0": left, "raider_0": -right})
    still = gardeners_v0.parallel_env(**SMALL)
    still.reset(seed=0)
    still.step(dict.fromkeys(still.agents, 0.0 * left))
    assert torch.allclose(env.garden.particles()[0], still.garden.particles()[0], atol=1e-5)
    assert not torch.allclose(env.garden.particles()[0], x, atol=1e-5)


@pytest.mark.skipif(not hasattr(pettingzoo, "make"), reason="PettingZoo has no registry yet")
def test_pettingzoo_makes_it():
    made = pettingzoo.make("parallel", "npa/Gardeners-v0", max_cycles=7, **SMALL)
    assert made.unwrapped.max_cycles == 7


def test_what_one_earns_the_other_loses_until_the_time_limit():
    env = gardeners_v0.parallel_env(max_cycles=3, **SMALL)
    env.reset(seed=0)
    for step in range(3):
        assert env.agents == ["keeper_0", "raider_0"]
        actions = {agent: env.action_space(agent).sample() for agent in env.agents}
        seen, rewards, ended, late, _ = env.step(actions)
        assert np.array_equal(seen["keeper_0"], seen["raider_0"])
        assert rewards["keeper_0"] == -rewards["raider_0"] != 0.0
        assert not any(ended.values())
        assert set(late.values()) == {step == 2}
    assert env.agents == []
    with pytest.raises(NPAError, match="actions must be given for the agents"):
        env.step(actions)


def test_brushes_of_both_add_up_and_without_a_raider_it_is_the_gardeners_world():
    both, alone = (
        gardeners_v0.parallel_env(**SMALL),
        Gardener2DEnv(gust_chance=0.0, blight_chance=0.0, **SMALL),
    )
    both.reset(seed=4)
    alone.reset(seed=4)
    half = np.full(alone.action_space.shape, 0.25, np.float32)
    _, rewards, *_ = both.step({"keeper_0": half, "raider_0": half})
    _, earned, *_ = alone.step(2.0 * half)
    assert rewards["keeper_0"] == pytest.approx(earned, abs=1e-5)
    _, rewards, *_ = both.step({"keeper_0": half, "raider_0": -half})
    _, earned, *_ = alone.step(0.0 * half)
    assert rewards["keeper_0"] == pytest.approx(earned, abs=1e-5)


def test_bad_agents_and_actions_are_clear_errors():
    env = gardeners_v0.parallel_env(**SMALL)
    env.reset(seed=0)
    with pytest.raises(
        NPAError, match=r"agent must be one that exists, got .*did you mean 'keeper_0'"
    ):
        env.action_space("keeper")
    with pytest.raises(NPAError, match=r"for the agents .* got some for"):
        env.step({"keeper_0": env.action_space("keeper_0").sample()})
    with pytest.raises(NPAError, match=r"action must be real numbers of shape \[K, W\]"):
        env.step({agent: np.zeros((3, 2), np.float32) for agent in env.agents})


@pytest.mark.parametrize("number", [0, -1, 1.5, None, True, "3"])
def test_a_wrong_number_of_steps_is_a_clear_error(number):
    with pytest.raises(NPAError, match="max_cycles must be a whole number of at least 1"):
        gardeners_v0.parallel_env(max_cycles=number, **SMALL)


def test_numpys_whole_numbers_of_steps_are_taken():
    assert gardeners_v0.parallel_env(max_cycles=np.int64(4), **SMALL).max_cycles == 4
