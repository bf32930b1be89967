"""Policies: a rule's episodes are its rollouts, and what the scripted ones do and achieve."""

import functools
import re

import gymnasium
import numpy as np
import pytest
import torch
from support.refusals import refused
from support.small_envs import begun

import npa_envs
from npa_envs.agents import (
    Interface,
    MendPolicy,
    PaintPolicy,
    RandomPolicy,
    RulePolicy,
    SpreadPolicy,
    ZeroPolicy,
    evaluate_policy,
    interface_of,
    load_policy,
)
from npa_envs.agents.learning import Problem
from npa_envs.envs import gardeners_v0, multispecies_v0, particles_v0
from npa_envs.errors import NPAError
from npa_envs.rule.rule import COLOUR_OFFSET

MORPHOGENESIS = "npa/Morphogenesis2D-v0"
REGENERATION = "npa/Regeneration2D-v0"

STEP_TOLERANCE = 2e-6
"""Largest difference after one step from the same world; measured over 64 steps of each case below
from four seeds: 1.2e-7, and none at all in states where matrix products round alike."""


@pytest.fixture(scope="module")
def gecko():
    # It has grown the worlds of `npa/Regeneration2D`, and no action of it is clipped.
    return npa_envs.load_rule("gecko-v0")


def make(environment=MORPHOGENESIS, **keywords):
    return gymnasium.make(environment, **keywords)


def make_vector(environment=MORPHOGENESIS, world_count=2, **keywords):
    given = {"vectorization_mode": "vector_entry_point", **keywords}
    return gymnasium.make_vec(environment, num_envs=world_count, **given)


def rolled(rule, x, s, env, random):
    """One step of a rollout in the worlds of an environment."""
    names = ("eps", "box", "update_prob", "dt", "position_noise")
    options = {name: getattr(env.unwrapped.config, name) for name in names}
    with torch.no_grad():
        return npa_envs.rollout(rule, x, s, 1, generator=random, **options)


def seeded(env, seed):
    """Reset, and return the observation, the same worlds and the streams they came from."""
    observation, _ = env.reset(seed=seed)
    random = npa_envs.WorldRandom(seed)
    x, s, *_ = env.unwrapped.task.fresh(random)
    for ours, theirs in zip(env.unwrapped.particles(), (x, s), strict=True):
        assert torch.equal(ours, theirs[0])
    return observation, x, s, random


def difference(env, x, s):
    own_x, own_s = env.unwrapped.particles()
    return max(float((own_x - x[0]).abs().max()), float((own_s - s[0]).abs().max()))


class Replaced(npa_envs.NPARule):
    """A rule that is not just its two layers."""

    def forward(self, perception):
        return torch.tanh(super().forward(perception))


def wild_rule(kind=npa_envs.NPARule, **keywords):
    """A random rule that moves particles about as much as a trained one."""
    torch.manual_seed(0)
    rule = kind(2, 16, 64, **keywords)
    with torch.no_grad():
        rule.output.weight *= 5.0
    return rule


WILD = {
    "no state gradient": wild_rule(state_gradient=False),
    "no density gradient": wild_rule(density_gradient=False),
    "no gradients": wild_rule(state_gradient=False, density_gradient=False),
    "not plain": wild_rule(kind=Replaced),
    "equivariant": wild_rule(equivariant=True, chiral=True),
    "other radius": wild_rule(eps0=0.15, alpha=0.3),
    "dead zone": wild_rule(dead_zone=0.05),
    "smooth inverse": wild_rule(moment_inverse="smooth"),
}
SHARED = ("eps0", "alpha", "moment_inverse")
"""Fields that a rule and its environment share."""


@pytest.mark.parametrize(
    ("name", "keywords"),
    [
        ("gecko", {}),
        ("gecko", {"eps": 0.12}),
        ("gecko", {"position_noise": 0.002}),
        ("gecko", {"boundary": "periodic", "box_size": 1.0}),
        ("gecko", {"update_prob": 1.0, "state_scale": 2.0}),
        ("gecko", {"dt": 0.5, "particle_count": 301}),
        *((name, {field: getattr(rule, field) for field in SHARED}) for name, rule in WILD.items()),
    ],
    ids=str,
)
def test_every_step_of_a_rules_episode_is_a_step_of_its_rollout(gecko, name, keywords):
    env = make(**{"particle_count": 256, **keywords})
    rule = WILD.get(name, gecko)
    policy = RulePolicy(rule, env)
    observation, x, s, random = seeded(env, 3)
    start = s
    for _ in range(8 if name in WILD else 24):
        env.step(policy(observation))
        x, s = rolled(rule, x, s, env, random)
        assert difference(env, x, s) < STEP_TOLERANCE
        observation = env.unwrapped.place_particles(x[0], s[0])
    assert (s - start).abs().mean() > 0.01


def test_policies_give_back_the_kind_and_shape_that_they_are_given(gecko):
    env, envs = make(particle_count=64), make_vector(particle_count=64)
    observations = envs.reset(seed=0)[0]
    observations.setflags(write=False)
    tensors = torch.from_numpy(observations.copy())
    for maker in (ZeroPolicy, RandomPolicy, SpreadPolicy, PaintPolicy, MendPolicy):
        batched, single = maker(envs), maker(env)
        actions = batched(observations)
        assert isinstance(actions, np.ndarray)
        assert (actions.dtype, actions.shape) == (np.float32, (2, 64, 18))
        assert actions in envs.action_space
        from_tensors = maker(envs)(tensors)
        assert isinstance(from_tensors, torch.Tensor)
        assert torch.equal(from_tensors, torch.from_numpy(actions))
        assert np.array_equal(single(observations[0]), actions[0])
    rule = RulePolicy(gecko, envs)
    actions = rule(observations)
    assert actions in envs.action_space
    assert np.array_equal(rule(tensors).numpy(), actions)
    np.testing.assert_allclose(RulePolicy(gecko, env)(observations[0]), actions[0], atol=1e-5)
    assert not rule(tensors).requires_grad


def test_a_rules_action_is_its_bounded_update():
    env = make(particle_count=64, state_scale=4.0)
    wrapped = gymnasium.wrappers.RecordEpisodeStatistics(env)
    assert RulePolicy(wild_rule(), wrapped).interface.state_scale == 4.0
    rule = wild_rule()
    observation = torch.randn(5, 66)
    with torch.no_grad():
        update = rule(observation)
        rule.output.weight *= 3.0
    delta, state_step = 3.0 * update[:, :2], 3.0 * update[:, 2:]
    action = RulePolicy(rule, state_scale=0.25)(observation)
    torch.testing.assert_close(action[:, :2], delta / (1.0 + delta.norm(dim=1, keepdim=True)))
    torch.testing.assert_close(action[:, 2:], (4.0 * state_step).clamp(-1.0, 1.0))
    assert (action[:, 2:].abs() == 1.0).any()


def test_random_actions_repeat_by_seed_and_each_world_has_its_own():
    envs = make_vector(particle_count=32)
    observations = np.zeros((2, 32, 66), np.float32)
    first, again, shifted = (RandomPolicy(envs, seed) for seed in (5, 5, 6))
    steps = [first(observations) for _ in range(3)]
    assert all(np.array_equal(step, again(observations)) for step in steps)
    assert np.array_equal(shifted(observations)[0], steps[0][1])
    assert not np.array_equal(steps[0], steps[1])
    assert abs(np.mean(steps)) < 0.05
    assert np.std(steps) == pytest.approx(3**-0.5, abs=0.02)
    # They are not the numbers that an environment with this seed draws.
    random = npa_envs.WorldRandom(5)
    random.advance()
    assert abs(np.corrcoef(steps[0][0].ravel(), random.uniform(32, 18).ravel())[0, 1]) < 0.1


def test_the_density_gradient_is_read_off_an_observation():
    env = make(particle_count=200, eps=0.12)
    observation, _ = env.reset(seed=0)
    x, s = env.unwrapped.particles()
    drho = npa_envs.perception_fields(x[None], s[None], eps=0.12).drho[0]
    read = interface_of(env).density_gradient(torch.from_numpy(observation))
    torch.testing.assert_close(read, drho * 1.2**3 / 200, rtol=1e-4, atol=1e-4)
    lonely = interface_of(env).density_gradient(torch.zeros(1, 66))
    assert torch.equal(lonely, torch.zeros(1, 2))


def test_spreading_moves_particles_apart():
    env = begun(make(particle_count=64, update_prob=1.0))
    far = torch.linspace(-3.5, 3.5, 64)
    x = torch.stack((far, torch.full_like(far, 3.0)), dim=1)
    x[0], x[1] = torch.tensor([0.0, 0.0]), torch.tensor([0.03, 0.0])
    observation = env.unwrapped.place_particles(x, torch.zeros(64, 16))
    env.step(SpreadPolicy(env)(observation))
    moved, s = env.unwrapped.particles()
    assert moved[0, 0] < x[0, 0]
    assert moved[1, 0] > x[1, 0]
    assert torch.equal(moved[2:], x[2:])
    assert not s.any()


def test_painting_ends_in_the_targets_mean_colour():
    env = make(particle_count=256)
    policy = PaintPolicy(env)
    observation, _ = env.reset(seed=0)
    before = env.unwrapped.particles()[0].norm(dim=1).mean()
    for _ in range(24):
        observation, *_ = env.step(policy(observation))
    x, s = env.unwrapped.particles()
    mean = env.unwrapped.task.task.target.colours.mean(dim=0) - COLOUR_OFFSET
    torch.testing.assert_close(s[:, -3:], mean.expand(256, 3), atol=1e-5, rtol=0.0)
    assert not s[:, :-3].any()
    assert x.norm(dim=1).mean() > 1.5 * before


def test_mending_gives_blank_particles_their_neighbours_mean_state():
    env = begun(make(particle_count=64, update_prob=1.0))
    x, s = env.unwrapped.particles()
    s = torch.full_like(s, 0.5)
    s[:10] = 0.0
    observation = env.unwrapped.place_particles(x, s)
    env.step(MendPolicy(env)(observation))
    mended = env.unwrapped.particles()[1]
    blur = npa_envs.perception_fields(x[None], s[None], eps=0.1).blur[0]
    torch.testing.assert_close(mended[:10], blur[:10], atol=1e-5, rtol=0.0)
    assert mended[:10].min() > 0.05
    assert torch.equal(mended[10:], s[10:])


FORMS = {
    "one world": {"world_count": 1},
    "three worlds of tensors": {"world_count": 3, "output": "torch"},
    "next-step": {"autoreset_mode": "next-step"},
    "disabled": {"autoreset_mode": "disabled"},
    "sync": {"vectorization_mode": "sync"},
    "async": {"vectorization_mode": "async"},
    "single": {},
    "single of tensors": {"output": "torch", "disable_env_checker": True},
}


# Two of four worlds succeed.
SEEDS, STOPPING = (4, 1, 2, 7), {"particle_count": 32, "max_episode_steps": 40, "success_loss": 0.9}


@pytest.fixture(scope="module")
def expected():
    env = make_vector(**STOPPING)
    return evaluate_policy(env, PaintPolicy(env), SEEDS)


@pytest.mark.parametrize("form", FORMS)
def test_episodes_are_the_same_in_every_form_of_an_environment(form, expected):
    env = (make if form.startswith("single") else make_vector)(**STOPPING, **FORMS[form])
    policy = PaintPolicy(make_vector(**STOPPING) if form == "async" else env)
    # Seeds may be anything that gives one after the other.
    found = evaluate_policy(env, policy, iter(SEEDS))
    env.close()
    assert found.endings == expected.endings
    assert set(found.endings) == {"success", "time limit"}
    assert found.steps.tolist() == expected.steps.tolist()
    assert len(set(found.returns.tolist())) == 4
    for name in ("returns", "start_losses", "final_losses"):
        near = 1e-5 if "world" in form else 1e-6
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=near)
    np.testing.assert_allclose(found.returns, found.start_losses - found.final_losses, atol=1e-5)


def test_policies_of_a_single_world_may_answer_with_or_without_its_dimension():
    env = make(particle_count=9, max_episode_steps=2)
    zeros = np.zeros((9, env.action_space.shape[1]), np.float32)
    bare, batched = (evaluate_policy(env, lambda _, z=z: z, [3]) for z in (zeros, zeros[None]))
    assert bare.returns.tolist() == batched.returns.tolist()
    refused(r"\[N, A\] = \(9, 18\), got \(8, 18\)", evaluate_policy, env, lambda _: zeros[:8], [3])


@pytest.mark.parametrize("module", [multispecies_v0, particles_v0])
def test_policies_act_in_batches_of_agents(module, gecko):
    envs = module.batched("segregation", world_count=2, particle_count=8, state_dim=4)
    observations, _ = envs.reset(seed=0)
    for policy in (RandomPolicy(envs), load_policy("random", envs)):
        actions = policy(observations)
        assert all(envs.action_spaces[agent].contains(actions[agent]) for agent in envs.agents)
        assert len({a.tobytes() for a in actions.values()}) == len(envs.agents)
        envs.step(actions)
    assert not any(a.any() for a in load_policy("zero", envs)(observations).values())
    refused("rule must have the environment's state_dim, 4", RulePolicy, gecko, envs)


@pytest.mark.parametrize("module", [multispecies_v0, particles_v0, gardeners_v0])
def test_evaluation_takes_one_agent_and_names_what_it_takes(module):
    small, named = {"particle_count": 16}, "Problem(env_id='npa/MixingSmall-v0', episode_steps=32)"
    for env in (module.batched(world_count=2, **small), module.parallel_env(**small)):
        wanted = f"one agent, got {type(env).__name__} with {len(env.possible_agents)}: .*"
        refused(wanted + re.escape(named), evaluate_policy, env, abs, [0])
    envs = eval(named, {"Problem": Problem}).make_envs(1)
    assert evaluate_policy(envs, ZeroPolicy(envs), [0]).endings == ("time limit",)


def test_policies_of_particles_name_those_of_other_actions():
    env = gymnasium.make("npa/Shapeshifter2D-v0", particle_count=16)
    for word, policy in {"random": RandomPolicy, "zero": ZeroPolicy}.items():
        refused(rf"use .*load_policy\('{word}', env\)", policy, env)
        assert env.action_space.contains(load_policy(word, env)(env.observation_space.sample()))


def test_the_error_about_foreign_environments_says_how_to_make_ours():
    single = functools.partial(gymnasium.make, "CartPole-v1")
    foreign = gymnasium.vector.SyncVectorEnv([single, single])
    for use in (interface_of, ZeroPolicy, lambda env: evaluate_policy(env, None, [0])):
        with pytest.raises(NPAError, match="got SyncVectorEnv: make it with gymnasium") as caught:
            use(foreign)
    hint = str(caught.value).split("make it with ")[1]
    assert interface_of(eval(hint, {"gymnasium": gymnasium})) == Interface(2, 16, True, 1.0)
    elsewhere = gymnasium.vector.AsyncVectorEnv([single])
    refused("must contain environments of npa_envs", evaluate_policy, elsewhere, abs, [0])
    elsewhere.close()
    refused("policy must be a function .* got int: of a model", evaluate_policy, make(), 3, [0])
    refused(r"got CartPoleEnv.*gymnasium\.make\('npa", interface_of, single().unwrapped)
