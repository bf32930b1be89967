"""Problems, sets of rules, species in one array, budgets and curves: what all learners share."""

import dataclasses

import numpy as np
import pytest
import torch
from clock import Clock
from learning_problems import digits, heart, species, wild_rules
from refusals import refused
from small_envs import begun

import npa_envs
from npa_envs.agents import RandomPolicy, SpreadPolicy, evaluate_policy
from npa_envs.agents.learning import (
    METHODS,
    Budget,
    Problem,
    Progress,
    RuleSet,
    method_options,
    train,
)
from npa_envs.agents.learning.progress import annealed
from npa_envs.envs import multispecies_v0, particles_v0
from npa_envs.errors import DivergedError
from npa_envs.registration import ENVIRONMENTS
from npa_envs.rule.rule import NPARule

STEP_TOLERANCE = 2e-6
"""As that of RulePolicy: largest difference of positions and states after a step."""


def same_rules(ours, theirs):
    pairs = zip(ours.state_dict().items(), theirs.state_dict().items(), strict=True)
    return all(a == b and torch.equal(v, w) for (a, v), (b, w) in pairs)


# Problems


@pytest.mark.parametrize("name", [r.id for r in ENVIRONMENTS] + list(multispecies_v0.ENVIRONMENTS))
def test_every_environment_is_a_problem_with_rules_that_fit(name):
    problem = Problem(env_id=name, episode_steps=4)
    again = Problem.from_json(problem.to_json())
    assert (again, hash(again), again.counts) == (problem, hash(problem), problem.counts)
    assert problem != dataclasses.replace(problem, episode_steps=9)
    assert problem != dataclasses.replace(problem, keywords={"update_prob": 0.25})
    rules = problem.new_rules(0)
    assert [rule.perception_dim for rule in rules] == [problem.interface.perception_dim] * len(
        problem.counts
    )
    assert {rule.update_dim for rule in rules} == {problem.interface.action_dim}
    assert rules.spans[-1].stop == problem.particle_count


def test_rows_are_paid_where_that_is_asked_for():
    problem = heart()
    rules = wild_rules(problem).policy()
    envs = problem.make_envs(row_rewards="particle")
    observation, _ = envs.reset(seed=0)
    _, reward, _, _, infos = envs.step(rules(observation))
    assert reward.abs().min() > 1e-3
    torch.testing.assert_close(infos["particle_reward"].mean(dim=1), reward, atol=1e-5, rtol=0.0)


# Sets of rules


@pytest.mark.parametrize("module", [multispecies_v0, particles_v0])
@pytest.mark.parametrize("output", ["numpy", "torch"])
@pytest.mark.parametrize("kind", ["rules", "script"])
def test_a_policy_acts_for_agents_whoever_is_left(module, output, kind):
    problem = species(particle_counts=(5, 7))
    given = {"deaths": ((0, 2),), "output": output, **problem.keywords}
    env = module.parallel_env(task="mixing", **given)
    policy = wild_rules(problem).policy() if kind == "rules" else SpreadPolicy(env)
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
    if kind == "script":
        refused("observation must have shape", policy, {"species_0": wrong})
        return
    refused("be of agents of 2 species and 12 particles, got one", policy, {"agent_0": wrong})
    refused(r"observation\['species_1'\] must have shape \(7, ", policy, {"species_1": wrong})


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
    ],
    ids=["two", "told apart", "three"],
)
def test_every_step_of_an_episode_is_a_step_of_the_rules_rollout(problem):
    rules, envs = wild_rules(problem), problem.make_envs(1)
    observation, _ = envs.reset(seed=5)
    random = npa_envs.WorldRandom(5)
    x, s, *_ = problem.make_task().start(random)
    names = ("eps", "box", "update_prob", "dt", "position_noise")
    options = {name: getattr(problem.physics, name) for name in names}
    options |= {"generator": random, "counts": problem.counts}
    options["perception"] = problem.config.perception
    for _ in range(problem.episode_steps - 1):
        observation, *_ = envs.step(rules.policy()(observation))
        with torch.no_grad():
            x, s = npa_envs.rollout_species(list(rules), x, s, 1, **options)
    state = envs.state()
    assert (s - state[..., 2:-1]).abs().max() < 8 * STEP_TOLERANCE
    assert (x - state[..., :2]).abs().max() < 8 * STEP_TOLERANCE
    assert s.abs().mean() > 0.01


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


def test_species_that_ended_keep_their_loss_where_another_world_is_reset():
    problem = species(particle_counts=[30, 18], deaths=[[1, 2]])
    envs = begun(problem.make_envs(2))
    still = torch.zeros(2, 48, problem.interface.action_dim)
    for _ in range(4):
        *_, infos = envs.step(still)
    mask = torch.tensor([True, False])
    _, told = envs.reset(options={"reset_mask": mask})
    assert told["loss"][1] == infos["loss"][1] > 0.0
    assert told["loss"][0] != infos["loss"][0]
    # Nothing has moved there.
    assert envs.step(still)[-1]["loss"][1] == infos["loss"][1]


@pytest.mark.parametrize("deaths", [[], [[0, 1]]], ids=["alone", "after a death"])
def test_a_species_that_left_its_world_is_the_reason_of_the_episode(deaths):
    problem = species(observation_limit=1.5, update_prob=1.0, deaths=deaths, species_count=3)
    envs = begun(problem.make_envs(2))
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


@pytest.mark.parametrize("dying", [False, True])
def test_episodes_of_species_end_with_their_last_observations(dying):
    deaths = [[0, 1], [1, 3]] if dying else []
    problem = species(episode_steps=8 if dying else 3, deaths=deaths)
    envs, policy = problem.make_envs(2), wild_rules(problem).policy()
    observation, start = envs.reset(seed=0)
    total, losses, acting = torch.zeros(2), [], []
    for step in range(3):
        observation, reward, terminated, truncated, infos = envs.step(policy(observation))
        total += reward
        assert terminated.tolist() == [dying and step == 2] * 2
        assert truncated.tolist() == [not dying and step == 2] * 2
        losses.append(infos["loss"])
        acting.append(infos["acted"].float().mean().item())
    assert infos["_final_obs"].all()
    reason = "removed" if dying else "time limit"
    assert infos["final_info"]["reason"].tolist() == [reason] * 2
    assert acting == [1.0, 0.5 if dying else 1.0, 0.5 if dying else 1.0]
    if dying:
        # The last species has a loss of 1, and the one that ended keeps its loss.
        assert (losses[2] > 0.6).all()
    else:
        torch.testing.assert_close(start["loss"] - infos["final_info"]["loss"], total)
    # What comes back is where the next episodes start: all states are zero again.
    assert infos["final_obs"][..., :4].abs().sum() > 0.0
    assert observation[..., :4].abs().sum() == 0.0


# Budgets and learning curves


PROBLEM = heart(episode_steps=2)

ITERATION = 480
"""Particle-steps of an iteration of the learner below."""


@pytest.fixture
def rules():
    return PROBLEM.new_rules(0)


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr("npa_envs.agents.learning.progress.time", clock)
    return clock


def progress_of(problem, seeds=range(100, 103), **given):
    budget = Budget(**{k: given.pop(k) for k in ("seconds", "particle_steps") if k in given})
    return Progress(problem, budget, device="cpu", evaluation_seeds=seeds, **given)


def learn_nothing(progress, rules, pause=lambda: None):
    """Spend a budget as a learner does."""

    def iteration():
        pause()
        return ITERATION

    assert progress.run(rules, iteration) is rules
    return progress.log


def test_particle_steps_are_kept_up_to_one_iteration(rules):
    log = learn_nothing(progress_of(PROBLEM, particle_steps=10_000, entries=5), rules)
    assert 10_000 <= log[-1].particle_steps < 10_000 + ITERATION
    # At the start, and at the first iteration after each fifth.
    assert [entry.particle_steps for entry in log] == [0, 2400, 4320, 6240, 8160, 10080]


def test_time_is_kept_and_evaluations_take_none_of_it(rules, clock):
    progress = progress_of(PROBLEM, seconds=0.25, entries=4, on_entry=lambda _: clock.sleep(1.0))
    log = learn_nothing(progress, rules, lambda: clock.sleep(1 / 64))
    assert [entry.seconds for entry in log] == [0.0, 0.0625, 0.125, 0.1875, 0.25]
    assert clock.now == 5 * 1.0 + 0.25


@pytest.mark.parametrize("entries", [1, 3])
@pytest.mark.parametrize("pause", [1 / 512, 1 / 32])
def test_a_budget_of_seconds_makes_at_most_as_many_evaluations_as_it_says(
    rules, clock, entries, pause
):
    # An iteration takes more than one share of the budget, or less.
    progress = progress_of(PROBLEM, seconds=1 / 16, entries=entries)
    assert 2 <= len(learn_nothing(progress, rules, lambda: clock.sleep(pause))) <= entries + 2


def test_whichever_is_spent_first_ends_it(rules, clock):
    for seconds, iterations in ((1000.0, 3), (2.0, 2)):
        progress = progress_of(PROBLEM, seconds=seconds, particle_steps=1000)
        log = learn_nothing(progress, rules, lambda: clock.sleep(1.0))
        assert (log[-1].seconds, log[-1].particle_steps) == (iterations, iterations * ITERATION)


def test_entries_are_evaluations_from_the_seeds_given():
    problem = heart()
    rules = wild_rules(problem)
    log = learn_nothing(progress_of(problem, particle_steps=1000, entries=1), rules)
    episodes = evaluate_policy(problem.make_envs(), rules.policy(), range(100, 103))
    for entry in log:
        assert entry.mean_return == episodes.mean_return
        assert entry.standard_error == episodes.standard_error
        assert entry.final_loss == pytest.approx(episodes.final_losses.mean())
    assert len(log) == 2


def test_what_is_out_of_turn_or_diverged_is_refused(rules):
    progress = progress_of(PROBLEM, particle_steps=1000, entries=2)
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


@pytest.mark.parametrize("method", ["ppo", "ppo_world", "evolution"])
def test_rules_of_other_numbers_of_particles_begin_with_those_of_the_problem(method):
    if method == "ppo_world":
        pytest.importorskip("stable_baselines3")
    problem = species(particle_counts=(20, 15))
    start = species(particle_counts=(6, 8)).new_rules(0)
    options = {"population": 4} if method == "evolution" else {"steps": 2, "minibatches": 1}
    trained = train(method, problem, Budget(particle_steps=1), 0, start=start, **options)
    assert (trained.rules.counts, start.counts) == ((20, 15), (6, 8))


def test_learning_rates_fall_from_the_first_to_the_last():
    rates = [annealed(2e-3, 0.1, share) for share in (0.0, 0.25, 0.5, 0.75, 1.0, 1.3)]
    assert rates[0] == 2e-3
    assert rates[2] == pytest.approx(1.1e-3)
    assert rates[-1] == rates[-2] == pytest.approx(2e-4)
    assert rates == sorted(rates, reverse=True)


def test_options_are_named_with_their_defaults_and_lists_serve_as_ranges():
    assert method_options("gradient")["world_count"] == 8
    assert method_options("ppo")["ratio"] == "particle"
    assert method_options("scripted").keys() == {"gains"}
    assert method_options("zero") == {}
    log = train("gradient", heart(), Budget(particle_steps=1), 0, steps=[2, 3], entries=1).log
    # Eight worlds of 48 particles, two steps.
    assert log[-1].particle_steps == 8 * 48 * 2


def train_wildly(progress, *, factor=1.0):
    rules = wild_rules(progress.problem, progress.seed, factor)
    progress.start(rules)
    return rules


def test_a_method_of_ones_own_is_a_row_of_the_table(monkeypatch):
    monkeypatch.setitem(METHODS, "own", f"{__name__}:train_wildly")
    trained = train("own", heart(), Budget(particle_steps=10), 3, factor=2.0)
    assert len(trained.log) == 1
    assert same_rules(trained.rules, wild_rules(heart(), 3, 2.0))
