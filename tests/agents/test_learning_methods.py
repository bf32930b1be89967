"""The gradient, cloning, SHAC, evolution, and methods that learn nothing: all do as they should."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from support.learning_problems import digits, heart, progress_of, species, wild_rules
from support.refusals import refused
from support.slow import slow

import npa_envs
from npa_envs.agents import (
    MendPolicy,
    PaintPolicy,
    RandomPolicy,
    SpreadPolicy,
    ZeroPolicy,
    evaluate_policy,
)
from npa_envs.agents.learning import EVALUATION_SEEDS, Budget, Problem, RuleSet, train
from npa_envs.agents.learning.clone import unexplained_variance
from npa_envs.agents.learning.evolution import RuleWeights, candidates_actions, costs, fitness
from npa_envs.agents.learning.problem import FIRST_EVALUATION_SEED, DifferentiableTask, world_seeds
from npa_envs.agents.learning.rule_set import ClampedRule
from npa_envs.agents.learning.shac import SHACLearner, SHACOptions, td_lambda_targets, world_values
from npa_envs.envs.core.vector import NPAVectorEnv
from npa_envs.envs.morphogenesis2d import PictureEnvTask
from npa_envs.rule.rule import NPARule
from npa_envs.world.particles import Particles

GROWTH = {"eps": 0.2, "eps0": 0.2, "colour_weight": 20.0, "resolution": 32, "state_scale": 0.1}


STEP_TOLERANCE = 2e-6
"""Largest difference of positions and states; measured: 2e-7."""


def run(problem, method="gradient", iterations=30, seed=0, worlds=4, **options):
    """Train with a budget of so many iterations of a batch of worlds for a whole episode."""
    steps = iterations * worlds * problem.particle_count * problem.episode_steps
    budget = Budget(particle_steps=steps)
    seeds = range(500, 503)
    return train(method, problem, budget, seed, evaluation_seeds=seeds, curve_points=1, **options)


def damaged(**keywords):
    keywords = heart(**keywords).keywords | {"rule": "picture", "damage": "wipe"}
    return replace(heart(), env_id="npa/Regeneration2D-v0", keywords=keywords)


# The gradient


def test_clamped_numbers_are_clipped_and_let_gradients_lead_back():
    values = torch.tensor([-3.0, -3.0, 0.5, 3.0, 3.0], requires_grad=True)
    rule = ClampedRule(NPARule(2, 5, 4, static=True), 1.0)
    clamped = rule.clamped(values)
    assert clamped.tolist() == [-1.0, -1.0, 0.5, 1.0, 1.0]
    clamped.backward(torch.tensor([2.0, -2.0, 2.0, 2.0, -2.0]))
    # A step against the gradient would lead the first and the last further out.
    assert values.grad.tolist() == [0.0, -2.0, 2.0, 2.0, 0.0]


@pytest.mark.parametrize(
    "problem",
    [
        heart(state_scale=0.1, position_noise=0.01),
        digits(state_scale=0.1, dt=0.5),
        species(state_scale=0.1, perception="per_species", particle_counts=(20, 15)),
        species("npa/Segregation-v0", species_count=3, boundary="periodic", state_scale=0.1),
    ],
    ids=lambda p: p.env_id,
)
def test_what_is_differentiated_is_the_environments_own_episode(problem):
    rules, envs = wild_rules(problem), problem.make_envs(1)
    observation, infos = envs.reset(seed=5)
    largest = 0.0
    task, random = DifferentiableTask(problem, torch.device("cpu")), npa_envs.WorldRandom(5)
    x, s, *rest = problem.make_task().start(random)
    if rest and rest[1] is not None:
        task = task.with_goal(rest[1])
    steps = problem.episode_steps - 1
    for _ in range(steps):
        largest = max(largest, rules.mean(observation).abs().max().item())
        observation, _, _, _, infos = envs.step(rules.policy()(observation))
    # State steps were clipped, and what follows is clamped alike.
    assert largest > 1.5
    after = task.rollout(
        rules, Particles(x, s), steps,
        eps=task.eps, box=task.box, update_prob=task.update_prob,
        memory="store", generator=random, return_path_length=True,
    )  # fmt: skip
    for ours, theirs in ((envs.worlds.x, after.x), (envs.worlds.s, after.s)):
        torch.testing.assert_close(ours, theirs.detach(), atol=STEP_TOLERANCE, rtol=0.0)
    loss, _ = task.loss(after)
    assert loss.item() == pytest.approx(infos["loss"][0].item(), abs=2e-4)
    bars = torch.autograd.grad(loss, [rule.output.weight for rule in rules])
    assert all(bar.abs().sum() > 0.0 for bar in bars)


@pytest.mark.parametrize("cuda_graph", ["auto", True])
def test_repeated_rollouts_stay_clamped_where_they_are_captured(cuda_graph, device):
    problem = heart(state_scale=0.1)
    rules, task = wild_rules(problem).to(device), DifferentiableTask(problem, device)
    worlds = task.seed(2, generator=torch.Generator(device).manual_seed(0), device=device)
    found = []
    for _ in range(4):
        _, after, *_ = task.rollout(
            rules, worlds, 3,
            eps=task.eps, box=task.box, update_prob=1.0, memory="store",
            generator=torch.Generator(device).manual_seed(1), return_path_length=True,
            cuda_graph=cuda_graph,
        )  # fmt: skip
        found.append(after.detach())
    assert found[0].abs().max() > 0.29
    assert all(after.abs().max() <= 0.3001 for after in found)
    assert all(torch.allclose(after, found[0], atol=1e-5) for after in found)


GRADIENT = {"num_envs": 4, "learning_rate": 1e-2}
SHAC = {"method": "shac", "steps": 4, **GRADIENT}
PIECES = {"steps": (3, 7), "pool_size": 8, "fresh_share": 0.5, **GRADIENT}
EVOLUTION = {"method": "evolution", "iterations": 40, "worlds": 16, "population": 16}
EVOLVING = replace(heart(episode_steps=16, num_envs=8, **GROWTH), hidden_dim=12)
APART = {"perception": "per_species"}
LEARNED = {
    "grows": (heart(), 0.55, 0.4, GRADIENT),
    "learns long episodes in pieces": (heart(episode_steps=12), 0.7, 0.0, PIECES),
    "mixes": (species(**APART), 0.5, 0.0, GRADIENT),
    "parts": (species("npa/Segregation-v0", seed_distance=0, **APART), 0.6, 0.0, GRADIENT),
    # States that say nothing have a loss of 0.1.
    "tells digits": (digits(), 0.93, 0.0, {"iterations": 60, **GRADIENT}),
    "heals": (damaged(), 1.0, 0.01, {"iterations": 40, **GRADIENT}),
    "grows by SHAC": (heart(), 0.9, 0.0, {"iterations": 20, **SHAC}),
    "mixes by SHAC": (species(**APART), 0.9, 0.0, {"iterations": 8, **SHAC}),
    "evolves": (EVOLVING, 1.0, 0.2, EVOLUTION),
}
"""Problems, what is left of the loss, how much more is returned, and by which method."""
TWICE = "evolves", "parts", "mixes by SHAC"


@pytest.mark.parametrize("case", [slow(c) if c in TWICE else c for c in LEARNED])
def test_what_is_learned_leaves_a_share_of_the_loss_and_raises_the_return(case, device):
    problem, share, gain, options = LEARNED[case]
    first, last = run(problem, device=device, **options).log
    assert last.final_loss < share * first.final_loss
    assert last.mean_return - first.mean_return > gain


LEARNERS = {
    "gradient": {"num_envs": 4},
    "shac": {"num_envs": 4, "steps": 2, "critic_epochs": 1},
    "ppo": {"steps": 4},
    "ppo_world": {"steps": 4, "minibatches": 4},
    "clone": {"collect_steps": 4},
    "evolution": {"population": 4},
}


def learner(method, problem):
    return LEARNERS[method] | ({"teacher": RuleSet.new(problem, 7)} if method == "clone" else {})


@pytest.fixture
def used(monkeypatch):
    """The seeds of all worlds that were reset."""
    seeds, reset = [], NPAVectorEnv.reset

    def watched(self, *, seed=None, options=None):
        single = isinstance(seed, int)
        seeds.extend(range(seed, seed + self.num_envs) if single else seed or ())
        return reset(self, seed=seed, options=options)

    monkeypatch.setattr(NPAVectorEnv, "reset", watched)
    return seeds


@pytest.mark.parametrize("method", ["scripted", *LEARNERS])
def test_a_run_follows_from_its_seed_and_learns_in_worlds_of_its_own(method, used):
    problem = heart(episode_steps=4)
    options = {"gains": (0.03,)} if method == "scripted" else learner(method, problem)
    rules, worlds = [], []
    for seed in (0, 0, 1):
        used.clear()
        rules.append(run(problem, method, iterations=3, seed=seed, **options).rules)
        worlds.append({number for number in used if number not in range(500, 503)})
    assert worlds[0] == worlds[1]
    assert not worlds[0] & worlds[2]
    assert all(max(numbers, default=0) < FIRST_EVALUATION_SEED for numbers in worlds)
    # Methods that differentiate worlds draw them otherwise.
    assert bool(worlds[0]) == (method not in ("gradient", "shac"))
    if method != "scripted":
        first, again, other = (one.rules[0].output.weight for one in rules)
        assert torch.equal(first, again)
        assert not torch.equal(first, other)


@pytest.mark.parametrize("method", LEARNERS)
def test_a_run_begins_with_its_start_which_stays_as_it_is(method):
    problem = species(episode_steps=4, particle_counts=(20, 15))
    # Numbers of particles may differ.
    start = wild_rules(species(particle_counts=(6, 8)))
    before = copy.deepcopy(start)
    trained = run(problem, method, iterations=1, start=start, **learner(method, problem))
    policy = RuleSet.of(problem, list(before)).policy()
    episodes = evaluate_policy(problem.make_envs(), policy, range(500, 503))
    for name in ("mean_return", "standard_error"):
        found, wanted = (getattr(one, name) for one in (trained.log[0], episodes))
        assert found == pytest.approx(wanted, rel=1e-6)
    assert trained.log[0].final_loss == pytest.approx(episodes.final_losses.mean(), rel=1e-6)
    assert all(map(torch.equal, start.parameters(), before.parameters()))
    assert trained.rules.counts == (20, 15)


def test_a_loss_without_a_gradient_is_refused(monkeypatch):
    def counted(self, x, s):
        return {"far": (x.norm(dim=-1) > 0.5).float().mean(dim=1)}

    monkeypatch.setattr(PictureEnvTask, "losses", counted)
    refused("losses of PictureEnvTask must be differentiable", run, heart())


# Cloning


@pytest.mark.parametrize(
    ("problem", "iterations", "largest"),
    [slow(heart(episode_steps=6), 40, 0.05), (species(episode_steps=6), 20, 0.2)],
    ids=["heart", "species"],
)
def test_a_clone_does_what_its_teacher_does(problem, iterations, largest):
    teacher = wild_rules(problem, seed=1)
    options = {"collect_steps": 6, "worlds": 3, "teacher": teacher}
    rules = run(problem, "clone", iterations=iterations, **options).rules
    envs = problem.make_envs()
    observation, _ = envs.reset(seed=900)
    for _ in range(4):
        observation, *_ = envs.step(teacher.policy()(observation))
    assert unexplained_variance(rules, observation, teacher.policy()(observation)) < largest
    taught, clone, untaught = (
        evaluate_policy(envs, one.policy(), range(900, 906)).mean_return
        for one in (teacher, rules, RuleSet.new(problem, 0))
    )
    assert abs(clone - taught) < 0.1 * abs(untaught - taught)


# Nothing to learn


def test_methods_that_learn_nothing_evaluate_once():
    problem = heart(state_scale=0.1)
    random, zero = (run(problem, method) for method in ("random", "zero"))
    assert random.rules is None
    assert isinstance(random.policy, RandomPolicy)
    assert len(random.log) == len(zero.log) == 1
    assert zero.log[0].mean_return == 0.0
    assert random.log[0].mean_return != 0.0


@pytest.mark.parametrize(
    ("problem", "gains", "cls"),
    [
        (heart(episode_steps=16), (0.03, -0.03), PaintPolicy),
        (species(episode_steps=16), (0.03, -0.03), SpreadPolicy),
        (species("npa/Symbiosis-v0", episode_steps=16, resolution=16), (0.03, -0.03), PaintPolicy),
        (damaged(particle_count=200, eps=0.15), (0.001, -0.001), MendPolicy),
        # No script helps.
        (digits(), (0.01, -0.01), ZeroPolicy),
    ],
    ids=lambda p: getattr(p, "env_id", ""),
)
def test_the_scripted_policy_that_fits_is_found(problem, gains, cls):
    trained = run(problem, "scripted", gains=gains)
    assert type(trained.policy) is cls
    nothing, best = trained.log
    assert nothing.mean_return == 0.0
    assert (best.mean_return > 0.0) == (cls is not ZeroPolicy)
    # Zero and two gains of each policy played 3 episodes.
    episode = 3 * problem.particle_count * problem.episode_steps
    tries, rest = divmod(best.particle_steps, episode)
    assert (tries % 2, rest) == (1, 0)
    assert tries >= 3
    cut_off = run(problem, "scripted", iterations=2, worlds=3, gains=gains).log[-1]
    assert cut_off.particle_steps == 2 * episode


# Seeds: every run learns in worlds of its own


def test_worlds_of_one_seed_follow_each_other_and_end_before_those_of_the_next():
    assert list(world_seeds(0, 3)) == [0, 1, 2]
    assert world_seeds(3, 10_000)[-1] + 1 == world_seeds(4, 1)[0]
    assert world_seeds(99, 10_000)[-1] + 1 == EVALUATION_SEEDS.start
    # Parts of a run have others, until they come round.
    assert world_seeds(1, 3, 2) == [10_006, 10_007, 10_008]
    assert world_seeds(0, 6_000, 1)[3_999:4_001] == [9_999, 0]


# The short-horizon actor-critic


def actor_critic(problem, **options):
    given = SHACOptions(**{"num_envs": 3} | options)
    return SHACLearner(progress_of(problem, initial=wild_rules(problem)), given)


@pytest.mark.parametrize("td_lambda", [0.0, 0.7, 1.0])
def test_targets_are_weighted_means_of_sums_over_one_step_two_steps_and_so_on(td_lambda):
    generator = torch.Generator().manual_seed(0)
    rewards, following = torch.randn(2, 4, 3, generator=generator)
    gamma = 0.9
    found = td_lambda_targets(rewards, following, gamma=gamma, td_lambda=td_lambda)
    for t in range(4):
        sums, paid = [], torch.zeros(3)
        for k in range(t, 4):
            paid = paid + gamma ** (k - t) * rewards[k]
            sums.append(paid + gamma ** (k - t + 1) * following[k])
        weights = [(1.0 - td_lambda) * td_lambda**k for k in range(len(sums) - 1)]
        weights.append(1.0 - sum(weights))
        wanted = sum(w * value for w, value in zip(weights, sums, strict=True))
        torch.testing.assert_close(found[t], wanted)


@pytest.mark.parametrize("problem", [heart(), species(), digits()], ids=lambda p: p.env_id)
def test_an_undiscounted_gain_is_what_the_windows_took_off_the_loss_and_what_is_foreseen(problem):
    made = actor_critic(problem, steps=4, gamma=1.0, value_weight=1.0)
    window = made.play()
    assert window.losses.shape == (5, 3)
    fell = window.losses[0] - window.losses[-1]
    torch.testing.assert_close(made.objective(window), fell.mean())
    with torch.no_grad():
        made.target.value.bias.fill_(0.25)
    torch.testing.assert_close(made.objective(window), fell.mean() + 0.25)
    assert window.losses.requires_grad
    # The next window begins where this one ended, but where an episode of two windows was over; no
    # gradient leads back.
    assert not made.worlds.x.requires_grad
    assert not made.worlds.s.requires_grad
    now = made.task.world_losses(made.worlds)
    torch.testing.assert_close(now[1], window.losses[-1, 1])
    assert ((now - window.losses[-1]).abs()[[0, 2]] > 1e-3).all()


def test_the_critic_learns_what_is_paid_and_its_copy_follows():
    made = actor_critic(heart(), steps=4, critic_epochs=40, target_rate=0.5)
    window = made.play()
    window = type(window)(*(part.detach() for part in window))
    made.learn_values(window)
    seen = window.features[:-1].flatten(0, 1)
    paid = td_lambda_targets(window.rewards, torch.zeros(4, 3), gamma=0.9, td_lambda=0.95)
    with torch.no_grad():
        learned, followed = world_values(made.critic, seen), world_values(made.target, seen)
    spread = (paid.flatten() - paid.mean()).square().mean()
    assert (learned - paid.flatten()).square().mean() < 0.5 * (spread + paid.mean().square())
    assert 0.0 < followed.abs().mean() < learned.abs().mean()


# Evolution


SMALL = {
    "growth": heart(**GROWTH),
    "points": digits(particle_count=40, state_dim=16, eps=0.2, eps0=0.2),
    "mixing": species(episode_steps=6, particle_counts=[24, 17], perception="per_species"),
}
PROBLEMS = {name: replace(problem, hidden_dim=12) for name, problem in SMALL.items()}


def candidates_of(problem: Problem, device: torch.device, count: int):
    """Rules, and the weights of some candidates that differ much, one a row."""
    rules = RuleSet.new(problem, 0).to(device)
    weights, draws = RuleWeights(rules), np.random.default_rng(1)
    spread = draws.standard_normal((count, len(weights.vector()))) * weights.scales()
    candidates = weights.vector() + 0.5 * spread
    return rules, torch.as_tensor(candidates, dtype=torch.float32, device=device)


def policy_of(problem: Problem, weights: torch.Tensor):
    rules = RuleSet.new(problem, 5).to(weights.device)
    RuleWeights(rules).set_vector(weights.cpu().double().numpy())
    return rules.policy()


@pytest.mark.parametrize("problem", PROBLEMS.values(), ids=PROBLEMS)
def test_a_candidate_acts_in_its_own_worlds_as_its_rules_do(problem, device, monkeypatch):
    rules, weights = candidates_of(problem, device, 3)
    observation, _ = problem.make_envs(6, device=device).reset(seed=3)
    together = candidates_actions(rules, weights, observation)
    for k, own in enumerate(weights):
        worlds = slice(2 * k, 2 * k + 2)
        alone = policy_of(problem, own)(observation[worlds])
        assert torch.allclose(together[worlds], alone, atol=1e-5)
    assert not torch.allclose(together[:2], together[2:4], atol=1e-2)
    # Few candidates may be computed at once.
    monkeypatch.setattr("npa_envs.agents.learning.evolution.MAX_HIDDEN", 2 * 2 * 24 * 12)
    few = candidates_actions(rules, weights, observation)
    assert torch.allclose(few, together, rtol=2e-5, atol=2e-6)
    # They have the dead zone of their rules.
    for rule in rules:
        rule.dead_zone = 1e6
    assert not candidates_actions(rules, weights, observation).any()


# Where every step succeeds, a world begins a new episode with each, which does not count.
OVER = replace(heart(**GROWTH, success_loss=1e6), hidden_dim=12)


@pytest.mark.parametrize("problem", [*PROBLEMS.values(), OVER], ids=[*PROBLEMS, "over at once"])
def test_the_fitness_of_a_population_is_that_of_one_candidate_after_the_other(problem, device):
    rules, weights = candidates_of(problem, device, 3)
    envs = problem.make_envs(6, device=device, copy=False)
    returns = fitness(envs, rules, weights, [11, 7], problem.episode_steps)
    alone = problem.make_envs(2, device=device)
    for k, own in enumerate(weights):
        episodes = evaluate_policy(alone, policy_of(problem, own), [11, 7])
        assert float(returns[k]) == pytest.approx(episodes.mean_return, rel=1e-3, abs=1e-3)
        assert (episodes.steps == 1).all() == (problem is OVER)
    assert problem is OVER or float(returns.std()) > 0.01


def test_candidates_without_a_finite_return_are_the_worst():
    assert costs(np.array([1.0, np.nan, 3.0, -np.inf])) == [-1.0, 0.0, -3.0, 0.0]
    assert costs(np.array([np.nan, np.nan])) == [0.0, 0.0]
