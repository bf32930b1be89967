"""Problems, sets of rules and species in one array: what all learners share."""

import dataclasses

import numpy as np
import pytest
import torch
from learning_problems import digits, heart, species, wild_rules

import npa_envs
from npa_envs.agents import RandomPolicy, SpreadPolicy
from npa_envs.agents.learning import Budget, Problem, RuleSet, train
from npa_envs.envs import multispecies_v0, particles_v0
from npa_envs.errors import NPAError
from npa_envs.registration import ENVIRONMENTS
from npa_envs.rule.rule import NPARule

STEP_TOLERANCE = 2e-6
"""As that of RulePolicy: largest difference of positions and states after a step."""


def same_rules(ours, theirs):
    pairs = zip(ours.state_dict().items(), theirs.state_dict().items(), strict=True)
    return all(a == b and torch.equal(v, w) for (a, v), (b, w) in pairs)


# Problems


@pytest.mark.parametrize(
    "problem",
    [heart(), digits(), species(particle_counts=(20, 15), targets=("heart", "ring"),
                                name="npa/CoMorphogenesis-v0")],
    ids=lambda p: p.env_id,
)  # fmt: skip
def test_json_keeps_a_problem(problem):
    again = Problem.from_json(problem.to_json())
    assert again == problem
    assert hash(again) == hash(problem)
    assert again.counts == problem.counts
    assert problem != dataclasses.replace(problem, episode_steps=9)
    assert problem != dataclasses.replace(problem, keywords={**problem.keywords, "eps": 0.2})


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"env_id": "npa/Mixng-v0"}, "did you mean 'npa/Mixing-v0'"),
        ({"env_id": "CartPole-v1"}, "env_id must be of an environment of many worlds"),
        ({"keywords": {"epsilon": 0.1}}, "unexpected keyword argument 'epsilon'"),
        ({"keywords": {"eps": -0.1}}, "eps must be"),
        ({"keywords": {"device": "cuda"}}, "given to train and make_envs"),
        ({"keywords": {"max_cycles": 3}}, "field episode_steps"),
        ({"keywords": {"reward": "particle"}}, "row_rewards='particle'"),
        ({"keywords": {"box_size": {1, 2}}}, "JSON"),
        ({"keywords": [1]}, "keywords must map names"),
        ({"episode_steps": 0}, "episode_steps"),
        ({"num_envs": 1.5}, "num_envs"),
    ],
)
def test_a_wrong_problem_is_refused_when_it_is_made(fields, message):
    with pytest.raises(NPAError, match=message):
        Problem(**({"env_id": "npa/Morphogenesis2D-v0", "episode_steps": 4} | fields))


@pytest.mark.parametrize("text", ["{", "[1]", '{"env": 1}'])
def test_json_of_something_else_is_refused(text):
    with pytest.raises(NPAError, match="text must be"):
        Problem.from_json(text)


@pytest.mark.parametrize("name", [r.id for r in ENVIRONMENTS] + list(multispecies_v0.ENVIRONMENTS))
def test_every_environment_is_a_problem_with_rules_that_fit(name):
    problem = Problem(env_id=name, episode_steps=4)
    rules = problem.new_rules(0)
    assert [rule.perception_dim for rule in rules] == [problem.interface.perception_dim] * len(
        problem.counts
    )
    assert {rule.update_dim for rule in rules} == {problem.interface.action_dim}
    assert problem.new_rules(0).spans[-1].stop == problem.particle_count


def test_rows_are_paid_where_that_is_asked_for():
    problem = heart()
    rules = wild_rules(problem).policy()
    envs = problem.make_envs(row_rewards="particle")
    observation, _ = envs.reset(seed=0)
    _, reward, _, _, infos = envs.step(rules(observation))
    assert reward.abs().min() > 1e-3
    torch.testing.assert_close(infos["particle_reward"].mean(dim=1), reward, atol=1e-5, rtol=0.0)
    with pytest.raises(NPAError, match="row_rewards"):
        heart(reward="sparse").make_envs(row_rewards="particle")


# Sets of rules


@pytest.mark.parametrize("module", [multispecies_v0, particles_v0])
def test_the_policy_of_rules_acts_for_agents_whoever_is_left(module):
    problem = species(particle_counts=(5, 7))
    env = module.parallel_env(task="mixing", **problem.keywords, deaths=((0, 2),))
    policy = wild_rules(problem).policy()
    observations, _ = env.reset(seed=0)
    for _ in range(3):
        together = np.zeros((12, problem.interface.perception_dim), np.float32)
        places = {"species_0": slice(0, 5), "species_1": slice(5, 12)}
        places |= {f"particle_{k}": slice(k, k + 1) for k in range(12)}
        for agent, seen in observations.items():
            together[places[agent]] = seen
        everyone, actions = policy(together), policy(observations)
        assert list(actions) == env.agents
        for agent, action in actions.items():
            np.testing.assert_array_equal(np.atleast_2d(action), everyone[places[agent]])
        observations, *_ = env.step(actions)
        # The dead have a last observation.
        observations = {agent: observations[agent] for agent in env.agents}
    assert len(env.agents) == (1 if module is multispecies_v0 else 7)
    with pytest.raises(NPAError, match="must be of agents of 2 species and 12 particles, got one"):
        policy({"agent_0": np.zeros((5, 4), np.float32)})
    with pytest.raises(NPAError, match=r"observation\['species_1'\] must have shape \(7, "):
        policy({"species_1": np.zeros((5, 4), np.float32)})


@pytest.mark.parametrize("problem", [heart(state_scale=0.1), digits(), species()])
def test_the_mean_is_what_the_policy_does_but_for_clipping(problem):
    rules, envs = wild_rules(problem, factor=30.0), problem.make_envs()
    observation, _ = envs.reset(seed=0)
    observation, *_ = envs.step(RandomPolicy(envs)(observation))
    mean = rules.mean(observation)
    torch.testing.assert_close(mean.clamp(-1.0, 1.0), rules.policy()(observation))
    assert mean.abs().max() > 1.0
    (bar,) = torch.autograd.grad(mean.sum(), [rules.rules[0].output.weight])
    assert bar.abs().sum() > 0.0


@pytest.mark.parametrize(
    "problem",
    [
        species(particle_counts=(20, 15)),
        species(particle_counts=(20, 15), perception="per_species", boundary="periodic"),
        species("npa/Segregation-v0", species_count=3, alpha=0.3, update_prob=1.0),
        heart(dt=0.5, position_noise=0.01, eps=0.2),
    ],
    ids=["two", "told apart", "three", "alone"],
)
def test_every_step_of_an_episode_is_a_step_of_the_rules_rollout(problem):
    rules, envs = wild_rules(problem), problem.make_envs(1)
    observation, _ = envs.reset(seed=5)
    random = npa_envs.WorldRandom(5)
    x, s, *_ = problem.make_task().start(random)
    names = ("eps", "box", "update_prob", "dt", "position_noise")
    options = {name: getattr(problem.physics, name) for name in names}
    options |= {"generator": random, "counts": problem.counts}
    options["perception"] = getattr(problem.config, "perception", "shared")
    for _ in range(problem.episode_steps - 1):
        observation, *_ = envs.step(rules.policy()(observation))
        with torch.no_grad():
            x, s = npa_envs.rollout_species(list(rules), x, s, 1, **options)
    own_x, own_s = particles(problem, envs)
    assert (s - own_s).abs().max() < 8 * STEP_TOLERANCE
    assert (x - own_x).abs().max() < 8 * STEP_TOLERANCE
    assert own_s.abs().mean() > 0.01


def particles(problem, envs):
    if not problem.is_species:
        return envs.particles()
    state = envs.species_env.state()
    return state[..., :2], state[..., 2:-1]


def test_rules_that_tell_species_apart_may_perceive_less_besides():
    problem = species(perception="per_species")
    envs = problem.make_envs()
    observation, _ = envs.reset(seed=0)
    observation, *_ = envs.step(wild_rules(problem).policy()(observation))
    rule = NPARule(
        2, 4, 16, eps0=0.25, state_gradient=False, density_gradient=False, species_count=2
    )
    # Own and mean states, then densities and their gradients of both species.
    update = rule(torch.cat((observation[..., :8], observation[..., 18:]), dim=-1))
    displacement = update[..., :2] / (1.0 + update[..., :2].norm(dim=-1, keepdim=True))
    mean = RuleSet.of(problem, rule).mean(observation)
    torch.testing.assert_close(mean, torch.cat((displacement, update[..., 2:]), dim=-1))


def test_what_is_context_info_species_leaves_scripted_policies_as_they_are():
    for step in range(3):
        acting = {}
        for perception in ("shared", "per_species"):
            problem = species(perception=perception)
            envs = problem.make_envs()
            observation, _ = envs.reset(seed=step)
            acting[perception] = SpreadPolicy(envs)(observation)
        assert torch.equal(acting["shared"], acting["per_species"])
        assert acting["shared"].abs().max() > 1e-3


def test_files_keep_rules_bit_for_bit(tmp_path):
    problem = species(particle_counts=(20, 15))
    rules = wild_rules(problem)
    paths = rules.save(tmp_path / "new" / "folder")
    assert [path.name for path in paths] == ["rule-0.safetensors", "rule-1.safetensors"]
    assert same_rules(RuleSet.load(tmp_path / "new" / "folder", problem), rules)
    assert same_rules(RuleSet.of(problem, tmp_path / "new" / "folder"), rules)
    # Each is an ordinary rule's file.
    first = npa_envs.load_rule(paths[0])
    assert torch.equal(first.hidden.weight, rules.rules[0].hidden.weight)


def test_a_shipped_rule_fits_where_the_world_is_like_its_own():
    wide = {"state_dim": 16, "eps0": 0.1, "eps": 0.2}
    rules = RuleSet.of(heart(**wide, particle_count=30, update_prob=0.7), "heart")
    assert torch.equal(next(iter(rules)).hidden.weight, npa_envs.load_rule("heart").hidden.weight)
    copies = RuleSet.of(species(**wide), npa_envs.load_rule("heart"))
    assert copies.rules[0] is not copies.rules[1]


@pytest.mark.parametrize(
    ("problem", "source", "message"),
    [
        (heart(), "heart", "state_dim"),
        (heart(state_dim=16), "heart", "eps0"),
        (digits(state_dim=16), "heart", "static"),
        (species(state_dim=16, eps0=0.1, perception="per_species"), "heart", "species apart"),
        (species(state_dim=16, eps0=0.1), ["heart"] * 3, "one for each of 2 species"),
        (heart(), "hart", "unknown rule"),
    ],
)
def test_rules_that_do_not_fit_are_refused(problem, source, message):
    with pytest.raises(NPAError, match=message):
        RuleSet.of(problem, source)


# Species in one array


def test_a_world_is_paid_the_mean_of_its_species_and_rows_what_their_species_is():
    problem = species("npa/CoMorphogenesis-v0", particle_counts=(20, 15), resolution=16)
    envs, apart = problem.make_envs(), multispecies_v0.batched(
        "co_morphogenesis", world_count=3, max_cycles=8, output="torch", **problem.keywords
    )  # fmt: skip
    observation, infos = envs.reset(seed=1)
    rows, own = apart.reset(seed=1)
    assert torch.equal(observation, torch.cat(list(rows.values()), dim=1))
    assert torch.equal(infos["loss"], (own["species_0"]["loss"] + own["species_1"]["loss"]) / 2)
    policy = wild_rules(problem).policy()
    for _ in range(3):
        action = policy(observation)
        observation, reward, _, _, infos = envs.step(action)
        rows, paid, _, _, own = apart.step(
            {f"species_{k}": action[:, span] for k, span in enumerate(problem.new_rules(0).spans)}
        )
    assert torch.equal(observation, torch.cat(list(rows.values()), dim=1))
    assert torch.equal(reward, (paid["species_0"] + paid["species_1"]) / 2)
    assert reward.abs().min() > 0.0
    by_row = infos["particle_reward"]
    assert torch.equal(by_row[:, :20], paid["species_0"][:, None].expand(-1, 20))
    assert torch.equal(by_row[:, 20:], paid["species_1"][:, None].expand(-1, 15))
    assert infos["acted"].all()


def test_episodes_of_species_end_with_their_last_observations():
    problem = species(episode_steps=3)
    envs = problem.make_envs(2)
    policy = wild_rules(problem).policy()
    observation, start = envs.reset(seed=0)
    total = torch.zeros(2)
    for step in range(3):
        observation, reward, terminated, truncated, infos = envs.step(policy(observation))
        total += reward
        assert truncated.tolist() == [step == 2] * 2
        assert not terminated.any()
    assert infos["_final_obs"].all()
    assert infos["final_info"]["reason"].tolist() == ["time limit"] * 2
    torch.testing.assert_close(start["loss"] - infos["final_info"]["loss"], total)
    # What comes back is where the next episodes start: all states are zero again.
    assert infos["final_obs"][..., :4].abs().sum() > 0.0
    assert observation[..., :4].abs().sum() == 0.0


def test_species_that_ended_keep_their_loss_where_another_world_is_reset():
    problem = species(particle_counts=[30, 18], deaths=[[1, 2]])
    envs = problem.make_envs(2)
    envs.reset(seed=0)
    still = torch.zeros(2, 48, problem.interface.action_dim)
    for _ in range(4):
        *_, infos = envs.step(still)
    mask = torch.tensor([True, False])
    _, told = envs.reset(options={"reset_mask": mask})
    assert told["loss"][1] == infos["loss"][1] > 0.0
    assert told["loss"][0] != infos["loss"][0]
    # Nothing has moved there.
    assert envs.step(still)[-1]["loss"][1] == infos["loss"][1]


def test_a_world_terminates_where_its_last_species_ends():
    problem = species(deaths=[[0, 2], [1, 4]], episode_steps=8)
    envs = problem.make_envs(2)
    policy = wild_rules(problem).policy()
    observation, _ = envs.reset(seed=0)
    endings, losses, acting = [], [], []
    for _ in range(4):
        observation, _, terminated, truncated, infos = envs.step(policy(observation))
        endings.append((bool(terminated.all()), bool(truncated.any())))
        losses.append(infos["loss"])
        acting.append(infos["acted"].float().mean().item())
    assert endings == [(False, False)] * 3 + [(True, False)]
    assert acting == [1.0, 1.0, 0.5, 0.5]
    assert infos["final_info"]["reason"].tolist() == ["removed"] * 2
    # Who is alone has a loss of 1, and the species that is gone keeps the one that it had.
    assert (losses[3] > 0.6).all()


@pytest.mark.parametrize("deaths", [[], [[0, 1]]], ids=["alone", "after a death"])
def test_a_species_that_left_its_world_is_the_reason_of_the_episode(deaths):
    problem = species(observation_limit=1.5, update_prob=1.0, deaths=deaths, species_count=3)
    envs = problem.make_envs(2)
    envs.reset(seed=0)
    action = torch.zeros(2, problem.particle_count, problem.interface.action_dim)
    # Its states grow in the first world alone.
    action[0, problem.new_rules(0).spans[1], 2:] = 1.0
    for step in range(problem.episode_steps):
        *_, infos = envs.step(action)
        assert ("final_info" in infos) == (step == problem.episode_steps - 1)
    other = "removed" if deaths else "time limit"
    assert infos["final_info"]["reason"].tolist() == ["left the world", other]
    # The next episode begins without the reasons of this one.
    for _ in range(problem.episode_steps):
        *_, infos = envs.step(torch.zeros_like(action))
    assert infos["final_info"]["reason"].tolist() == [other] * 2


# Rules to begin with


@pytest.mark.parametrize("method", ["ppo", "ppo_world", "evolution", "gradient"])
def test_every_method_refuses_to_begin_with_what_does_not_fit(method):
    problem, budget = heart(), Budget(particle_steps=1)
    if method.startswith("ppo_"):
        pytest.importorskip("stable_baselines3")
    with pytest.raises(NPAError, match="start must be a RuleSet"):
        train(method, problem, budget, 0, start=next(iter(problem.new_rules(0))))
    with pytest.raises(NPAError, match="state_dim"):
        train(method, problem, budget, 0, start=heart(state_dim=8).new_rules(0))


@pytest.mark.parametrize("method", ["ppo", "ppo_world", "evolution"])
def test_rules_of_other_numbers_of_particles_begin_with_those_of_the_problem(method):
    if method.startswith("ppo_"):
        pytest.importorskip("stable_baselines3")
    problem = species(particle_counts=(20, 15))
    start = species(particle_counts=(6, 8)).new_rules(0)
    options = {"population": 4} if method == "evolution" else {"steps": 2, "minibatches": 1}
    trained = train(method, problem, Budget(particle_steps=1), 0, start=start, **options)
    assert [span.stop - span.start for span in trained.rules.spans] == [20, 15]
    assert [span.stop - span.start for span in start.spans] == [6, 8]
