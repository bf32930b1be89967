"""Budgets, learning curves, and the table of methods."""

import pytest
import torch
from clock import Clock
from learning_problems import heart, wild_rules

from npa_envs.agents import evaluate_policy
from npa_envs.agents.learning import METHODS, Budget, Progress, method_options, train
from npa_envs.agents.learning.progress import annealed
from npa_envs.errors import DivergedError, NPAError

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


@pytest.mark.parametrize(
    ("make", "fields", "message"),
    [
        (Budget, {}, "must say something"),
        (Budget, {"seconds": 0.0}, "seconds must be"),
        (Budget, {"seconds": float("nan")}, "seconds must be"),
        (Budget, {"particle_steps": -1}, "particle_steps must be"),
        (Budget, {"particle_steps": 1.5}, "particle_steps must be"),
        (progress_of, {"problem": PROBLEM, "particle_steps": 10, "entries": 0}, "entries"),
        (progress_of, {"problem": PROBLEM, "particle_steps": 10, "seeds": []}, "seed"),
        (progress_of, {"problem": PROBLEM, "particle_steps": 10, "seeds": ["a"]}, "seed"),
    ],
)
def test_a_budget_or_a_curve_that_means_nothing_is_refused(make, fields, message):
    with pytest.raises(NPAError, match=message):
        make(**fields)


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
def test_a_budget_of_seconds_makes_at_most_as_many_evaluations_as_it_says(
    rules, monkeypatch, clock, entries
):
    ran = []
    monkeypatch.setattr(
        "npa_envs.agents.learning.progress.evaluate_policy",
        lambda *given: ran.append(given) or evaluate_policy(*given),
    )
    # Each iteration takes more than one share of the budget, or less.
    for pause in (1 / 512, 1 / 32):
        progress = progress_of(PROBLEM, seconds=1 / 16, entries=entries)
        learn_nothing(progress, rules, lambda pause=pause: clock.sleep(pause))
        assert 2 <= len(ran) <= entries + 2
        ran.clear()


def test_whichever_is_spent_first_ends_it(rules, clock):
    for seconds, iterations in ((1000.0, 3), (2.0, 2)):
        progress = progress_of(PROBLEM, seconds=seconds, particle_steps=1000)
        log = learn_nothing(progress, rules, lambda: clock.sleep(1.0))
        assert log[-1].seconds == iterations
        assert log[-1].particle_steps == iterations * ITERATION


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


def test_a_forced_look_after_nothing_was_done_adds_no_entry(rules):
    progress = progress_of(PROBLEM, particle_steps=1000, entries=2)
    progress.start(rules)
    progress.look(rules, force=True)
    assert len(progress.log) == 1
    progress.advance(1)
    progress.look(rules)
    assert len(progress.log) == 1
    progress.look(rules, force=True)
    assert len(progress.log) == 2


def test_progress_has_to_start_first_and_once(rules):
    progress = progress_of(PROBLEM, particle_steps=1000)
    with pytest.raises(NPAError, match="advance needs a start"):
        progress.advance(1)
    with pytest.raises(NPAError, match="look needs a start"):
        progress.look(rules)
    progress.start(rules)
    with pytest.raises(NPAError, match="start once"):
        progress.start(rules)


def test_rules_that_diverged_are_reported(rules):
    progress = progress_of(PROBLEM, particle_steps=1000)
    progress.start(rules)
    with torch.no_grad():
        rules.rules[0].output.weight[3, 5] = torch.nan
    progress.advance(96)
    with pytest.raises(DivergedError, match=r"1 of \d+ in 'output.weight' of rule 0 .* after 96"):
        progress.look(rules, force=True)


def test_learning_rates_fall_from_the_first_to_the_last():
    rates = [annealed(2e-3, 0.1, share) for share in (0.0, 0.25, 0.5, 0.75, 1.0, 1.3)]
    assert rates[0] == 2e-3
    assert rates[2] == pytest.approx(1.1e-3)
    assert rates[-1] == rates[-2] == pytest.approx(2e-4)
    assert rates == sorted(rates, reverse=True)


@pytest.mark.parametrize(
    ("method", "options", "message"),
    [
        ("gradients", {}, "did you mean 'gradient'"),
        ("gradient", {"learning_rat": 1.0}, "did you mean 'learning_rate'"),
        ("zero", {"learning_rate": 1.0}, "has no option 'learning_rate'"),
        ("zero", {"device": "tpu"}, "device"),
        ("zero", {"seed": -1}, "seed must be a whole number from 0 to 99, .* got -1"),
        ("zero", {"seed": 100}, "seed must be a whole number from 0 to 99, .* got 100"),
        ("zero", {"evaluation_seeds": 4}, "evaluation_seeds must be one for each episode, got 4"),
        ("scripted", {"gains": 0.1}, "gains must be a list of finite numbers, got 0.1"),
        ("scripted", {"gains": [0.1, "a"]}, "gains must be a list of finite numbers"),
        ("ppo", {"masked": "False"}, "masked must be True or False, got 'False'"),
        ("gradient", {"steps": 5}, "steps must be a range .* of two whole numbers, got 5"),
        ("gradient", {"steps": [5, 2]}, "steps must be two whole numbers"),
        ("zero", {"start": heart().new_rules(0)}, "start must be None"),
        ("evolution", {"population": 2}, "population must be a whole number of at least 4"),
        ("evolution", {"sigma": 0.0}, "sigma must be a finite number greater than 0"),
        ("evolution", {"worlds_per_candidate": 0}, "worlds_per_candidate must be a whole number"),
        ("evolution", {"sigmas": 0.1}, "did you mean 'sigma'"),
        ("clone", {}, "teacher must be given"),
        ("clone", {"teacher": "heart", "student_share": 1.5}, "student_share"),
        ("clone", {"teacher": "heart", "kept_steps": 2}, "must be at least collect_steps"),
        ("clone", {"teacher": "heart", "updates": 0}, "updates"),
        ("clone", {"teacher": "heart"}, "state_dim"),
        ("ppo", {"ratio": "both"}, "ratio must be a known word, got 'both': known: particle, wo"),
        ("ppo", {"credit": "particle", "ratio": "world"}, "needs ratio='particle'"),
        ("ppo", {"gamma": 0.0}, r"gamma must lie in \(0, 1\], got 0.0"),
        ("gradient", {"last_rate": -3.0}, r"last_rate must lie in \(0, 1\], got -3.0"),
        ("clone", {"last_rate": 2.0}, r"last_rate must lie in \(0, 1\], got 2.0"),
        ("ppo", {"last_noise": 0.0}, r"last_noise must lie in \(0, 1\], got 0.0"),
        ("ppo", {"noise_decay_share": 0.0}, r"noise_decay_share must lie in \(0, 1\], got 0.0"),
        ("ppo", {"minibatches": 0}, "minibatches must be a whole number of at least 1"),
        ("ppo", {"worlds": 0}, "worlds must be a whole number of at least 1"),
        ("ppo", {"critic": "all"}, "must be a known word, got 'all': known: central, particle"),
    ],
)
def test_wrong_methods_and_options_are_refused(method, options, message):
    seed = options.get("seed", 0)
    options = {name: value for name, value in options.items() if name != "seed"}
    with pytest.raises(NPAError, match=message):
        train(method, heart(), Budget(particle_steps=10), seed, **options)


def test_a_problem_or_a_budget_that_is_none_is_refused_with_a_cure_that_works():
    match = r"budget must be a Budget, got 3: .* Budget\((.*)\)$"
    with pytest.raises(NPAError, match=match) as told:
        train("zero", heart(), 3, 0)
    assert str(told.value).endswith("Budget(particle_steps=10**6)")
    assert Budget(particle_steps=10**6).share(0.0, 10**6) == 1.0


def test_a_range_of_steps_may_be_a_list_as_command_lines_give_it():
    log = train("gradient", heart(), Budget(particle_steps=1), 0, steps=[2, 3], entries=1).log
    # Eight worlds of 48 particles, two steps.
    assert log[-1].particle_steps == 8 * 48 * 2


def test_options_are_named_with_their_defaults():
    assert method_options("gradient")["world_count"] == 8
    assert method_options("ppo")["ratio"] == "particle"
    assert method_options("scripted").keys() == {"gains"}
    assert method_options("zero") == {}


def test_a_method_of_ones_own_is_a_row_of_the_table(monkeypatch):
    monkeypatch.setitem(METHODS, "own", f"{__name__}:train_wildly")
    trained = train("own", heart(), Budget(particle_steps=10), 3, factor=2.0)
    assert trained.rules is not None
    assert len(trained.log) == 1
    assert torch.equal(
        trained.rules.rules[0].output.weight, wild_rules(heart(), 3, 2.0).rules[0].output.weight
    )


def train_wildly(progress, *, factor=1.0):
    rules = wild_rules(progress.problem, progress.seed, factor)
    progress.start(rules)
    return rules
