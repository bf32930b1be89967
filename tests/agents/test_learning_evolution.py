"""Evolution: many candidates at once are each candidate by itself, and their mean gets better."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from learning_problems import digits, heart, species

from npa_envs.agents import evaluate_policy
from npa_envs.agents.learning import Budget, Problem, RuleSet, train
from npa_envs.agents.learning.evolution import RulePopulation, costs, fitness

GROWTH = {"eps": 0.2, "eps0": 0.2, "colour_weight": 20.0, "resolution": 32, "state_scale": 0.1}
SMALL = {
    "growth": heart(**GROWTH),
    "points": digits(particle_count=40, state_dim=16, eps=0.2, eps0=0.2),
    "mixing": species(episode_steps=6, particle_counts=[24, 17], perception="per_species"),
}
PROBLEMS = {name: replace(problem, hidden_dim=12) for name, problem in SMALL.items()}


@pytest.fixture(params=PROBLEMS)
def problem(request):
    if request.param == "points":
        pytest.importorskip("sklearn")
    return PROBLEMS[request.param]


def candidates_of(problem: Problem, device: torch.device, count: int):
    """A population, and the weights of some candidates that differ much, one a row."""
    population = RulePopulation(problem.new_rules(0).to(device))
    draws = np.random.default_rng(1)
    spread = draws.standard_normal((count, len(population.vector()))) * population.scales()
    weights = population.vector() + 0.5 * spread
    return population, torch.as_tensor(weights, dtype=torch.float32, device=device)


def rules_of(problem: Problem, device: torch.device, weights: torch.Tensor) -> RuleSet:
    rules = problem.new_rules(5).to(device)
    RulePopulation(rules).put(weights.cpu().double().numpy())
    return rules


def test_scales_are_those_that_layers_are_drawn_with():
    problem = PROBLEMS["growth"]
    rules = problem.new_rules(0)
    (rule,) = rules
    torch.nn.init.xavier_normal_(rule.hidden.weight)
    torch.nn.init.xavier_normal_(rule.output.weight)
    torch.nn.init.zeros_(rule.hidden.bias)
    population = RulePopulation(rules)
    drawn = population.vector() / population.scales()
    hidden, output = rule.hidden.weight.numel(), rule.output.weight.numel()
    assert drawn[:hidden].std() == pytest.approx(1.0, abs=0.15)
    assert drawn[-output:].std() == pytest.approx(1.0, abs=0.3)


def test_a_candidate_acts_in_its_own_worlds_as_its_rules_do(problem, device):
    population, weights = candidates_of(problem, device, 3)
    envs = problem.make_envs(6, device=device)
    observation, _ = envs.reset(seed=3)
    for _ in range(2):
        actions = population.actions(weights, observation)
        for k, own in enumerate(weights):
            mine = slice(2 * k, 2 * k + 2)
            alone = rules_of(problem, device, own).policy()(observation[mine])
            assert torch.allclose(actions[mine], alone, atol=1e-5)
        assert not torch.allclose(actions[:2], actions[2:4], atol=1e-2)
        observation, *_ = envs.step(actions)


def test_candidates_have_the_dead_zone_of_their_rules(problem, device):
    rules = problem.new_rules(0).to(device)
    weights = 0.5 * torch.randn(2, len(RulePopulation(rules).vector()), device=device)
    population = RulePopulation(rules)
    envs = problem.make_envs(4, device=device)
    observation, _ = envs.reset(seed=3)
    assert population.actions(weights, observation).any()
    for rule in rules:
        rule.dead_zone = 1e6
    assert not population.actions(weights, observation).any()


def test_candidates_act_alike_however_many_are_computed_at_once(monkeypatch, device):
    problem = PROBLEMS["mixing"]
    population, weights = candidates_of(problem, device, 5)
    observation, _ = problem.make_envs(10, device=device).reset(seed=3)
    together = population.actions(weights, observation)
    monkeypatch.setattr("npa_envs.agents.learning.evolution.MOST_HIDDEN", 2 * 2 * 24 * 12)
    assert torch.allclose(population.actions(weights, observation), together, atol=1e-6)


def test_the_fitness_of_a_population_is_that_of_one_candidate_after_the_other(problem, device):
    population, weights = candidates_of(problem, device, 3)
    seeds = [11, 7]
    envs = problem.make_envs(6, device=device, copy=False)
    found = fitness(envs, population, weights, seeds, problem.episode_steps)
    alone = problem.make_envs(2, device=device)
    for k, own in enumerate(weights):
        episodes = evaluate_policy(alone, rules_of(problem, device, own).policy(), seeds)
        assert float(found[k]) == pytest.approx(episodes.mean_return, rel=1e-3, abs=1e-3)
    assert float(found.std()) > 0.01


def test_what_comes_after_an_episode_is_over_does_not_count(device):
    # Every step succeeds, so that a world begins a new episode with each.
    problem = replace(heart(**GROWTH, success_loss=1e6), hidden_dim=12)
    population, weights = candidates_of(problem, device, 2)
    envs = problem.make_envs(2, device=device)
    found = fitness(envs, population, weights, [4], problem.episode_steps)
    alone = problem.make_envs(1, device=device)
    for k, own in enumerate(weights):
        episodes = evaluate_policy(alone, rules_of(problem, device, own).policy(), [4])
        assert episodes.steps.tolist() == [1]
        assert float(found[k]) == pytest.approx(episodes.mean_return, abs=1e-4)


def test_candidates_without_a_finite_return_are_the_worst():
    assert costs(np.array([1.0, np.nan, 3.0, -np.inf])) == [-1.0, 0.0, -3.0, 0.0]
    assert costs(np.array([np.nan, np.nan])) == [0.0, 0.0]


def test_evolution_gets_better(device):
    pytest.importorskip("cma")
    problem = replace(PROBLEMS["growth"], episode_steps=16, num_envs=8)
    budget = Budget(particle_steps=40 * 16 * 48 * 16)
    trained = train("evolution", problem, budget, 0, device=device, population=16, entries=4)
    first, last = trained.log[0], trained.log[-1]
    assert last.particle_steps == budget.particle_steps
    assert last.mean_return > first.mean_return + 0.2
    assert last.mean_return > 3.0 * last.standard_error > 0.0


def test_a_start_is_the_first_mean_and_stays_as_it_is():
    pytest.importorskip("cma")
    start = PROBLEMS["growth"].new_rules(9)
    before = RulePopulation(start).vector()
    options = {"population": 4, "sigma": 0.01, "evaluation_seeds": range(2)}
    trained = train(
        "evolution", PROBLEMS["growth"], Budget(particle_steps=1), 1, start=start, **options
    )
    assert np.array_equal(RulePopulation(start).vector(), before)
    far = np.abs(RulePopulation(trained.rules).vector() - before) / RulePopulation(start).scales()
    assert 0.0 < far.max() < 0.1
