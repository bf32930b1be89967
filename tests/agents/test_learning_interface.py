"""Problems, sets of rules, species in one array, budgets and curves: what all learners share."""

import dataclasses

import numpy as np
import pytest
import torch
from support.clock import Clock
from support.learning_problems import heart, species, wild_rules
from support.refusals import refused
from support.small_envs import begun

import npa_envs
from npa_envs.agents import SpreadPolicy
from npa_envs.agents.learning import Budget, Problem, Progress, RuleSet, method_options, train
from npa_envs.envs import multispecies_v0, particles_v0
from npa_envs.errors import DivergedError
from npa_envs.registration import ENVIRONMENTS
from npa_envs.rule.rule import NPARule

# Problems


@pytest.mark.parametrize("name", [r.id for r in ENVIRONMENTS] + list(multispecies_v0.ENVIRONMENTS))
def test_every_environment_is_a_problem_with_rules_that_fit(name):
    problem = Problem(env_id=name, episode_steps=4)
    again = Problem.from_json(problem.to_json())
    assert (again, again.counts) == (problem, problem.counts)
    assert problem != dataclasses.replace(problem, episode_steps=9)
    assert problem != dataclasses.replace(problem, keywords={"update_prob": 0.25})
    rules = RuleSet.new(problem, 0)
    assert [rule.perception_dim for rule in rules] == [problem.interface.perception_dim] * len(
        problem.counts
    )
    assert {rule.update_dim for rule in rules} == {problem.interface.action_dim}
    assert rules.spans[-1].stop == problem.particle_count


def test_rows_are_paid_where_that_is_asked_for():
    envs = heart().make_envs(particle_rewards="particle")
    observation, _ = envs.reset(seed=0)
    _, reward, _, _, infos = envs.step(wild_rules(heart()).policy()(observation))
    assert reward.abs().min() > 1e-3
    torch.testing.assert_close(infos["particle_reward"].mean(dim=1), reward, atol=1e-5, rtol=0.0)


# Sets of rules


@pytest.mark.parametrize("module", [multispecies_v0, particles_v0])
@pytest.mark.parametrize("output", ["numpy", "torch"])
@pytest.mark.parametrize("scripted", [False, True])
def test_a_policy_acts_for_agents_whoever_is_left(module, output, scripted):
    problem = species(particle_counts=(5, 7))
    given = {"deaths": ((0, 2),), "output": output, **problem.keywords}
    env = module.parallel_env(task="mixing", **given)
    policy = SpreadPolicy(env) if scripted else wild_rules(problem).policy()
    places = {"species_0": slice(0, 5), "species_1": slice(5, 12)}
    places |= {f"particle_{k}": slice(k, k + 1) for k in range(12)}
    observations, _ = env.reset(seed=0)
    for _ in range(3):
        together = np.zeros((12, problem.interface.perception_dim), np.float32)
        for agent, seen in observations.items():
            together[places[agent]] = seen
        everyone, actions = policy(together), policy(observations)
        assert list(actions) == env.agents
        for agent, action in actions.items():
            np.testing.assert_array_equal(np.atleast_2d(action), everyone[places[agent]])
            assert action.shape == env.action_space(agent).shape
            assert type(action) is type(observations[agent])
        observations, *_ = env.step(actions)
        # The dead have a last observation.
        observations = {agent: observations[agent] for agent in env.agents}
    assert len(env.agents) == (1 if module is multispecies_v0 else 7)
    assert policy({}) == {}
    wrong = np.zeros((5, 4), np.float32)
    if scripted:
        refused("observation must have shape", policy, {"species_0": wrong})
        return
    refused("be of agents of 2 species and 12 particles, got one", policy, {"agent_0": wrong})
    refused(r"observation\['species_1'\] must have shape \(7, ", policy, {"species_1": wrong})


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


def test_columns_of_single_species_leave_scripted_policies_as_they_are():
    actions = []
    for perception in ("shared", "per_species"):
        envs = species(perception=perception).make_envs()
        actions.append(SpreadPolicy(envs)(envs.reset(seed=0)[0]))
    assert torch.equal(*actions)
    assert actions[0].abs().max() > 1e-3


def test_files_keep_rules_bit_for_bit(tmp_path):
    problem = species(particle_counts=(20, 15))
    rules = wild_rules(problem)
    paths = rules.save(tmp_path / "new" / "folder")
    assert [path.name for path in paths] == ["rule-0.safetensors", "rule-1.safetensors"]
    for loaded in (RuleSet.load(paths[0].parent, problem), RuleSet.of(problem, paths[0].parent)):
        assert all(map(torch.equal, loaded.parameters(), rules.parameters()))


def test_a_shipped_rule_fits_where_the_world_is_like_its_own():
    wide = {"state_dim": 16, "eps0": 0.1, "eps": 0.2}
    rules = RuleSet.of(heart(**wide, particle_count=30, update_prob=0.7), "heart")
    assert torch.equal(next(iter(rules)).hidden.weight, npa_envs.load_rule("heart").hidden.weight)
    copies = RuleSet.of(species(**wide), npa_envs.load_rule("heart"))
    assert copies.rules[0] is not copies.rules[1]


# Species in one array


@pytest.mark.parametrize("deaths", [[], [[1, 2]], [[0, 1], [1, 3]]], ids=["none", "one", "both"])
def test_worlds_of_species_are_those_of_the_batched_environment_in_one_array(deaths):
    problem = species(
        "npa/CoMorphogenesis-v0", 4, particle_counts=(20, 15), resolution=16, deaths=deaths
    )
    envs, apart = problem.make_envs(), multispecies_v0.batched(
        "co_morphogenesis", world_count=3, max_cycles=4, output="torch", **problem.keywords
    )  # fmt: skip
    (observation, infos), (rows, own) = envs.reset(seed=1), apart.reset(seed=1)
    rules, length = wild_rules(problem), 3 if len(deaths) == 2 else 4

    def stacked(values):
        return torch.stack(list(values), dim=1)

    losses = stacked(info["loss"] for info in own.values())
    for step in range(6):
        assert torch.equal(observation, torch.cat(list(rows.values()), dim=1))
        assert torch.equal(infos["loss"], losses.mean(dim=1))
        action = rules.policy()(observation)
        observation, reward, terminated, truncated, infos = envs.step(action)
        by_species = {f"species_{k}": action[:, span] for k, span in enumerate(rules.spans)}
        rows, paid, _, _, own = apart.step(by_species)
        acted = stacked(info["acted"] for info in own.values())
        # A species that ended keeps its loss.
        losses = torch.where(acted, stacked(info["loss"] for info in own.values()), losses)
        assert torch.equal(reward, stacked(paid.values()).mean(dim=1))
        for name, values in (("particle_reward", stacked(paid.values())), ("acted", acted)):
            by_row = values.repeat_interleave(torch.tensor([20, 15]), dim=1)
            assert torch.equal(infos[name], by_row)
        over = step % length == length - 1
        assert terminated.tolist() == [over and len(deaths) == 2] * 3
        assert truncated.tolist() == [over and len(deaths) < 2] * 3
        if over:
            last = torch.cat([info["final_obs"] for info in own.values()], dim=1)
            assert torch.equal(infos["final_obs"], last)
            assert infos["_final_obs"].all()
            reason = "removed" if deaths else "time limit"
            assert infos["final_info"]["reason"].tolist() == [reason] * 3
    # It keeps it also where another world is reset; nothing has moved there.
    _, after = envs.reset(options={"reset_mask": torch.tensor([True, False, False])})
    assert after["loss"][0] != infos["loss"][0]
    assert torch.equal(after["loss"][1:], infos["loss"][1:])


@pytest.mark.parametrize("deaths", [[], [[0, 1]]], ids=["alone", "after a death"])
def test_a_species_that_left_its_world_is_the_reason_of_the_episode(deaths):
    problem = species(observation_limit=1.5, update_prob=1.0, deaths=deaths, species_count=3)
    envs = begun(problem.make_envs(2))
    action = torch.zeros(2, problem.particle_count, problem.interface.action_dim)
    # Its states grow in the first world alone.
    action[0, RuleSet.new(problem, 0).spans[1], 2:] = 1.0
    for step in range(problem.episode_steps):
        *_, infos = envs.step(action)
        assert ("final_info" in infos) == (step == problem.episode_steps - 1)
    other = "removed" if deaths else "time limit"
    assert infos["final_info"]["reason"].tolist() == ["left the world", other]
    # The next episode begins without the reasons of this one.
    for _ in range(problem.episode_steps):
        *_, infos = envs.step(torch.zeros_like(action))
    assert infos["final_info"]["reason"].tolist() == [other] * 2


# Budgets and learning curves


PROBLEM = heart(episode_steps=2)

ITERATION = 480
"""Particle-steps of an iteration of the learner below."""


@pytest.fixture
def rules():
    return RuleSet.new(PROBLEM, 0)


def progress_of(problem, curve_points, on_point=lambda _: None, **budget):
    options = {"evaluation_seeds": range(100, 103), "on_point": on_point}
    options["curve_points"] = curve_points
    return Progress(problem, Budget(**budget), device="cpu", **options)


@pytest.mark.parametrize(
    ("budget", "curve_points", "pause", "iterations"),
    [
        # At the start, and at the first iteration after each fifth.
        ({"particle_steps": 10_000}, 5, 0.0, [0, 5, 9, 13, 17, 21]),
        ({"seconds": 0.25}, 4, 1 / 64, [0, 4, 8, 12, 16]),
        # An iteration takes more than a third of the budget, or less.
        ({"seconds": 1 / 16}, 3, 1 / 32, [0, 1, 2]),
        ({"seconds": 1 / 16}, 3, 1 / 512, [0, 11, 22, 32]),
        # What is spent first ends it.
        ({"seconds": 1000.0, "particle_steps": 1000}, 1, 1.0, [0, 3]),
        ({"seconds": 2.0, "particle_steps": 1000}, 1, 1.0, [0, 2]),
    ],
)
def test_budgets_are_kept_up_to_one_iteration_and_evaluations_take_none_of_them(
    rules, monkeypatch, budget, curve_points, pause, iterations
):
    clock = Clock()
    monkeypatch.setattr("npa_envs.agents.learning.progress.time", clock)
    progress = progress_of(PROBLEM, curve_points, lambda _: clock.sleep(1.0), **budget)

    def iteration():
        clock.sleep(pause)
        return ITERATION

    assert progress.run(rules, iteration) is rules
    spent = [(entry.seconds, entry.particle_steps) for entry in progress.log]
    assert spent == [(count * pause, count * ITERATION) for count in iterations]


def test_what_is_out_of_turn_or_diverged_is_refused(rules):
    progress = progress_of(PROBLEM, 2, particle_steps=1000)
    refused("advance needs a start", progress.advance, 1)
    refused("look needs a start", progress.look, rules)
    progress.start(rules)
    refused("start once", progress.start, rules)
    # An entry needs particle-steps, and to be due or forced.
    assert not progress.look(rules, force=True)
    progress.advance(96)
    assert not progress.look(rules)
    assert progress.look(rules, force=True)
    assert len(progress.log) == 2
    with torch.no_grad():
        rules.rules[0].output.weight[3, 5] = torch.nan
    progress.advance(96)
    with pytest.raises(DivergedError, match=r"1 of \d+ in 'output.weight' of rule 0 .* after 192"):
        progress.look(rules, force=True)


def test_options_are_named_with_their_defaults_and_lists_serve_as_ranges():
    assert method_options("gradient")["num_envs"] == 8
    assert method_options("scripted").keys() == {"gains"}
    assert method_options("zero") == {}
    log = train("gradient", heart(), Budget(particle_steps=1), 0, steps=[2, 3], curve_points=1).log
    # Eight worlds of 48 particles, two steps.
    assert log[-1].particle_steps == 8 * 48 * 2
