"""Who uses the smooth inverse of moment matrices: rules' files, training, environments.

Rollouts of rules that do are among those of tests/world/.
"""

import gymnasium
import numpy as np
import pytest
import torch
from circle_task import CircleTask, circle_config
from worlds import relative_error

import npa_envs
from npa_envs.agents import RulePolicy
from npa_envs.envs import multispecies_v0
from npa_envs.training.trainer import initial_rule


def test_the_choice_is_saved_with_a_rule(tmp_path):
    assert npa_envs.load_rule("gecko").moment_inverse == "threshold"
    assert npa_envs.load_rule("heart-first").dead_zone == 0.0
    path = tmp_path / "smooth.safetensors"
    npa_envs.save_rule(npa_envs.NPARule(moment_inverse="smooth"), path)
    path.write_bytes(path.read_bytes().replace(b'\\"smooth\\"', b'\\"smoosh\\"'))
    with pytest.raises(npa_envs.NPAError, match="got 'smoosh'"):
        npa_envs.load_rule(path)


@pytest.mark.parametrize("trained", ["threshold", "smooth"])
@pytest.mark.parametrize("chosen", ["threshold", "smooth"])
def test_training_goes_on_smoothly_but_never_back_unasked(tmp_path, trained, chosen):
    untrained = CircleTask().make_rule(torch.Generator())
    initial = npa_envs.NPARule(**(untrained.hyper_parameters() | {"moment_inverse": trained}))
    npa_envs.save_rule(initial, tmp_path / "rule.safetensors")
    config = circle_config(
        tmp_path / "run", initial_rule=str(tmp_path / "rule.safetensors"), moment_inverse=chosen
    )
    if (trained, chosen) == ("smooth", "threshold"):
        with pytest.raises(npa_envs.NPAError, match="differs in moment_inverse"):
            initial_rule(config, untrained)
    else:
        rule = initial_rule(config, untrained)
        assert rule.moment_inverse == chosen
        assert torch.equal(rule.hidden.weight, initial.hidden.weight)


@pytest.mark.parametrize("name", ["npa/Morphogenesis2D-v0", "npa/PointClassification-v0"])
def test_an_environment_observes_what_it_is_told(name, device):
    keywords = {"particle_count": 96, "output": "torch", "device": str(device)}
    env = gymnasium.make(name, moment_inverse="smooth", disable_env_checker=True, **keywords)
    observation, _ = env.reset(seed=3)
    world = env.unwrapped
    action = torch.rand(world.action_space.shape, generator=torch.Generator().manual_seed(1))
    observation, *_ = env.step((action - 0.5).to(device))
    x, s = world.worlds.x, world.worlds.s
    config = world.config
    smooth, threshold = (
        npa_envs.perceive(x, s, config.eps, config.eps0, moment_inverse=word)[0]
        for word in ("smooth", "threshold")
    )
    assert relative_error(observation, smooth) < 2e-6
    assert relative_error(observation, threshold) > 1e-4


def test_a_rule_acts_only_where_its_choice_is_observed():
    rule = npa_envs.NPARule(moment_inverse="smooth")
    env = gymnasium.make("npa/Morphogenesis2D-v0", particle_count=32)
    with pytest.raises(npa_envs.NPAError, match="the environment with moment_inverse='smooth'"):
        RulePolicy(rule, env)
    env = gymnasium.make("npa/Morphogenesis2D-v0", particle_count=32, moment_inverse="smooth")
    observation, _ = env.reset(seed=0)
    assert RulePolicy(rule, env)(observation).shape == env.action_space.shape
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
