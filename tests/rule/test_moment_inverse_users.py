"""Environments with the smooth inverse of moment matrices; rollouts are tested in tests/world/."""

import gymnasium
import numpy as np
import pytest

import npa_envs
from npa_envs.agents import RulePolicy
from npa_envs.envs import multispecies_v0


def test_a_rule_acts_only_where_its_choice_is_observed():
    rule = npa_envs.NPARule(moment_inverse="smooth")
    env = gymnasium.make("npa/Morphogenesis2D-v0", particle_count=32)
    with pytest.raises(npa_envs.NPAError, match="the environment with moment_inverse='smooth'"):
        RulePolicy(rule, env)
    env = gymnasium.make("npa/Morphogenesis2D-v0", particle_count=32, moment_inverse="smooth")
    RulePolicy(rule, env)
    with pytest.raises(npa_envs.NPAError, match="moment_inverse must be a known word, got 'soft'"):
        gymnasium.make("npa/Morphogenesis2D-v0", moment_inverse="soft")


def test_several_species_observe_what_they_are_told():
    observations = []
    for word in ("smooth", "threshold"):
        env = multispecies_v0.parallel_env(particle_count=40, moment_inverse=word)
        env.reset(seed=0)
        actions = {}
        for agent in env.agents:
            shape = env.action_space(agent).shape
            actions[agent] = np.linspace(-0.5, 0.5, np.prod(shape), dtype=np.float32).reshape(shape)
        observations.append(np.concatenate(list(env.step(actions)[0].values())))
    assert np.abs(observations[0] - observations[1]).max() > 1e-6
