"""Who uses the smooth inverse of moment matrices: rules and their files, training, environments."""

import gymnasium
import numpy as np
import pytest
import torch
from circle_task import CircleTask, circle_config
from training_runs import train
from worlds import random_world, relative_error

import npa_envs
from npa_envs import reference as oracle
from npa_envs.agents import RulePolicy
from npa_envs.envs import multispecies_v0
from npa_envs.training import load_config
from npa_envs.training.trainer import initial_rule


def strong_rule(device, dtype=torch.float64, **options):
    """A rule whose updates are large enough to matter."""
    torch.manual_seed(0)
    rule = npa_envs.NPARule(2, 5, 12, eps0=0.1, **options).to(device, dtype)
    with torch.no_grad():
        rule.output.weight *= 4.0
    return rule


@pytest.mark.parametrize("static", [False, True], ids=("moving", "static"))
def test_a_rollout_follows_the_rules_own_choice(static, device):
    """Static ones weigh their pairs once for all steps."""
    rule = strong_rule(device, moment_inverse="smooth", static=static)
    x, s = random_world(2, 150, 2, 5, dtype=torch.float64, device=device)
    steps = 4
    expected_x, expected_s = x.cpu(), s.cpu()
    twin = strong_rule("cpu", static=static)
    for _ in range(steps):
        z = oracle.perceive(expected_x, expected_s, 0.1, 0.1, moment_inverse="smooth")
        update = twin(z)
        moved = 0 if static else 2
        delta = update[..., :moved]
        reach = twin.alpha * 0.1
        if not static:
            expected_x = expected_x + reach * delta / (1.0 + delta.norm(dim=-1, keepdim=True))
        expected_s = expected_s + update[..., moved:]
    found_x, found_s = npa_envs.rollout(rule, x, s, steps, update_prob=1.0)
    assert relative_error(found_x, expected_x) < 1e-11
    assert relative_error(found_s, expected_s) < 1e-11
    rule.moment_inverse = "threshold"
    _, other = npa_envs.rollout(rule, x, s, steps, update_prob=1.0)
    assert relative_error(other, expected_s) > 1e-6


def test_gradients_of_a_static_rollout_are_those_of_one_that_sorts_in_every_step(device):
    rule = strong_rule(device, moment_inverse="smooth", static=True)
    x, s = random_world(2, 100, 2, 5, dtype=torch.float64, device=device)
    answers = []
    for detach_positions in (True, False):
        t = s.clone().requires_grad_()
        _, end = npa_envs.rollout(rule, x, t, 4, update_prob=1.0, detach_positions=detach_positions)
        answers.append(torch.autograd.grad(end.square().sum(), [t, *rule.parameters()]))
    for found, expected in zip(*answers, strict=True):
        assert relative_error(found[None], expected[None]) < 1e-11


def test_the_choice_is_saved_with_a_rule_and_files_without_it_mean_the_threshold(tmp_path):
    smooth, plain = npa_envs.NPARule(moment_inverse="smooth"), npa_envs.NPARule()
    npa_envs.save_rule(smooth, tmp_path / "smooth.safetensors")
    npa_envs.save_rule(plain, tmp_path / "plain.safetensors")
    assert npa_envs.load_rule(tmp_path / "smooth.safetensors").moment_inverse == "smooth"
    assert npa_envs.load_rule(tmp_path / "plain.safetensors").moment_inverse == "threshold"
    assert b"moment_inverse" not in (tmp_path / "plain.safetensors").read_bytes()
    assert npa_envs.load_rule("gecko").moment_inverse == "threshold"
    path = tmp_path / "smooth.safetensors"
    path.write_bytes(path.read_bytes().replace(b'\\"smooth\\"', b'\\"smoosh\\"'))
    with pytest.raises(npa_envs.NPAError, match="got 'smoosh'"):
        npa_envs.load_rule(path)


def test_species_must_agree(device):
    x, s = random_world(1, 20, 2, 16, dtype=torch.float32, device=device)
    rules = [npa_envs.NPARule(moment_inverse="smooth").to(device), npa_envs.NPARule().to(device)]
    with pytest.raises(npa_envs.NPAError, match="moment_inverse"):
        npa_envs.rollout_species(rules, x, s, 1, counts=(10, 10))


def test_training_gives_its_rule_the_choice(tmp_path):
    config = circle_config(tmp_path / "run", iterations=2, moment_inverse="smooth")
    train(config)
    assert npa_envs.load_rule(tmp_path / "run" / "rule.safetensors").moment_inverse == "smooth"
    assert load_config(tmp_path / "run" / "config.json", circle_config(tmp_path)) == config
    with pytest.raises(npa_envs.NPAError, match="moment_inverse must be one of threshold, smooth"):
        circle_config(tmp_path, moment_inverse="soft")


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
    with pytest.raises(
        npa_envs.NPAError, match="make the environment with moment_inverse='smooth'"
    ):
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
