"""The gradient, cloning, and the methods that learn nothing: each learns what it should."""

import copy
from dataclasses import replace

import pytest
import torch
from learning_problems import digits, heart, species, wild_rules

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
from npa_envs.agents.learning.clone import Demonstrations, unexplained
from npa_envs.agents.learning.gradient import ClampedRule, EnvironmentTask, clamp_inward
from npa_envs.agents.learning.problem import FIRST_EVALUATION_SEED, world_seeds
from npa_envs.envs.core.vector import NPAVectorEnv
from npa_envs.envs.morphogenesis2d import PictureEnvTask
from npa_envs.envs.multi.task import Population
from npa_envs.errors import NPAError

GRADIENT_TOLERANCE = 1e-6
"""Of a directional derivative in float64 against a central difference; measured: 2e-9."""


def run(problem, method="gradient", iterations=30, seed=0, worlds=4, **options):
    """Train with a budget of so many iterations of a batch of worlds for a whole episode."""
    steps = iterations * worlds * problem.particle_count * problem.episode_steps
    budget = Budget(particle_steps=steps)
    seeds = range(500, 503)
    return train(method, problem, budget, seed, evaluation_seeds=seeds, entries=1, **options)


def damaged(**keywords):
    keywords = heart(**keywords).keywords | {"rule": "picture", "damage": "wipe"}
    return replace(heart(), env_id="npa/Regeneration2D-v0", keywords=keywords)


def learned(problem, **options):
    """Return the first and the last point of the gradient's learning curve."""
    first, last = run(problem, world_count=4, learning_rate=1e-2, **options).log
    return first, last


# The gradient


@pytest.mark.parametrize("name", ["npa/Mixing-v0", "npa/Segregation-v0"])
@pytest.mark.parametrize("boundary", ["open", "periodic"])
def test_the_entropy_of_species_has_the_gradient_of_its_differences(name, boundary):
    problem = species(name, particle_counts=(20, 15), eps=0.15, boundary=boundary)
    task = problem.make_task()
    x, s = (t.double() for t in task.start(npa_envs.WorldRandom([1, 2])))
    kinds = torch.arange(2).repeat_interleave(torch.tensor(problem.counts))

    def loss(x):
        parts = task.losses(Population(x, s, problem.counts, kinds))
        return sum(part.mean() for part in parts.values())

    (bar,) = torch.autograd.grad(loss(x.requires_grad_()), x)
    assert torch.isfinite(bar).all()
    generator = torch.Generator().manual_seed(0)
    along = torch.randn(x.shape, dtype=x.dtype, generator=generator)
    with torch.no_grad():
        difference = (loss(x + 1e-6 * along) - loss(x - 1e-6 * along)) / 2e-6
    assert abs(difference) > 1e-2
    assert abs((bar * along).sum() - difference) < GRADIENT_TOLERANCE


def test_clamped_numbers_are_clipped_and_let_gradients_lead_back():
    values = torch.tensor([-3.0, -3.0, 0.5, 3.0, 3.0], requires_grad=True)
    clamped = clamp_inward(values, 1.0)
    assert clamped.tolist() == [-1.0, -1.0, 0.5, 1.0, 1.0]
    clamped.backward(torch.tensor([2.0, -2.0, 2.0, 2.0, -2.0]))
    # A step against the gradient would lead the first and the last further out.
    assert values.grad.tolist() == [0.0, -2.0, 2.0, 2.0, 0.0]


def test_a_clamped_rule_shares_its_weights():
    (rule,) = wild_rules(heart())
    clamped = ClampedRule(rule, 0.1)
    assert [id(p) for p in clamped.parameters()] == [id(p) for p in rule.parameters()]
    z = torch.randn(50, rule.perception_dim)
    torch.testing.assert_close(clamped(z)[:, :2], rule(z)[:, :2])
    torch.testing.assert_close(clamped(z)[:, 2:], rule(z)[:, 2:].clamp(-0.1, 0.1))
    assert (clamped(z)[:, 2:].abs() == 0.1).float().mean() > 0.3


@pytest.mark.parametrize(
    "problem",
    [
        heart(state_scale=0.1, position_noise=0.01),
        digits(state_scale=0.1, dt=0.5),
        species(state_scale=0.1, perception="per_species", particle_counts=(20, 15)),
    ],
    ids=lambda p: p.env_id,
)
def test_what_is_differentiated_is_the_environments_own_episode(problem):
    rules, envs = wild_rules(problem), problem.make_envs(1)
    observation, infos = envs.reset(seed=5)
    largest = 0.0
    task, random = EnvironmentTask(problem, torch.device("cpu")), npa_envs.WorldRandom(5)
    x, s, *rest = problem.make_task().start(random)
    if rest and rest[1] is not None:
        task = task.toward(rest[1])
    steps = problem.episode_steps - 1
    for _ in range(steps):
        largest = max(largest, rules.mean(observation).abs().max().item())
        observation, _, _, _, infos = envs.step(rules.policy()(observation))
    # State steps were clipped, and what follows is clamped alike.
    assert largest > 1.5
    x, s, path_length = task.rollout(
        rules, x, s, steps,
        eps=task.eps, box=task.box, update_prob=task.update_prob,
        memory="store", generator=random, return_path_length=True,
    )  # fmt: skip
    loss, _ = task.loss(x, s, path_length)
    assert loss.item() == pytest.approx(infos["loss"][0].item(), abs=2e-4)
    bars = torch.autograd.grad(loss, [rule.output.weight for rule in rules])
    assert all(bar.abs().sum() > 0.0 for bar in bars)


@pytest.mark.parametrize("cuda_graph", ["auto", True])
def test_repeated_rollouts_stay_clamped_where_they_are_recorded(cuda_graph, device):
    problem = heart(state_scale=0.1)
    rules, task = wild_rules(problem).to(device), EnvironmentTask(problem, device)
    x, s, _ = task.seed(2, generator=torch.Generator(device).manual_seed(0), device=device)
    found = []
    for _ in range(4):
        _, after, _ = task.rollout(
            rules, x, s, 3,
            eps=task.eps, box=task.box, update_prob=1.0, memory="store",
            generator=torch.Generator(device).manual_seed(1), return_path_length=True,
            cuda_graph=cuda_graph,
        )  # fmt: skip
        found.append(after.detach())
    assert found[0].abs().max() > 0.29
    assert all(after.abs().max() <= 0.3001 for after in found)
    assert all(torch.allclose(after, found[0], atol=1e-5) for after in found)


@pytest.mark.parametrize(
    ("problem", "share", "gain", "options"),
    [
        (heart(), 0.55, 0.4, {}),
        (heart(episode_steps=12), 0.7, 0.0, {"steps": (3, 7), "pool_size": 8, "fresh_share": 0.5}),
        (species(perception="per_species"), 0.5, 0.0, {}),
        (species("npa/Segregation-v0", seed_distance=0, perception="per_species"), 0.6, 0.0, {}),
        # States that say nothing have a loss of 0.1.
        (digits(), 0.93, 0.0, {"iterations": 60}),
        (damaged(), 1.0, 0.01, {"iterations": 40}),
    ],
    ids=["grows", "learns long episodes in pieces", "mixes", "parts", "tells digits", "heals"],
)
def test_the_gradient_leaves_a_share_of_the_loss_and_raises_the_return(
    problem, share, gain, options
):
    if problem == digits():
        pytest.importorskip("sklearn")
    first, last = learned(problem, **options)
    assert last.final_loss < share * first.final_loss
    assert last.mean_return - first.mean_return > gain


def test_what_was_learned_is_better_in_another_world_than_nothing_and_gets_better_still():
    rules = run(heart(), world_count=4, learning_rate=1e-2).rules
    changed = heart(eps=0.22, particle_count=36, update_prob=0.8)
    start = RuleSet.of(changed, list(rules))
    before = copy.deepcopy(start.state_dict())
    warm = run(changed, world_count=4, learning_rate=5e-3, iterations=15, start=start).log
    cold = run(changed, world_count=4, learning_rate=5e-3, iterations=15).log
    assert warm[0].final_loss < 0.8 * cold[0].final_loss
    assert warm[-1].mean_return > warm[0].mean_return + warm[0].standard_error
    assert warm[-1].final_loss < cold[-1].final_loss
    assert all(torch.equal(before[name], weight) for name, weight in start.state_dict().items())


LEARNERS = {
    "gradient": {"world_count": 4},
    "shac": {"world_count": 4, "steps": 2, "critic_epochs": 1},
    "ppo": {"steps": 4},
    "ppo_world": {"steps": 4, "minibatches": 4},
    "clone": {"collect_steps": 4},
    "evolution": {"population": 4},
}


def learner(method, problem):
    """Return the options of a method that is there."""
    if method == "ppo_world":
        pytest.importorskip("stable_baselines3")
    if method == "evolution":
        pytest.importorskip("cma")
    return LEARNERS[method] | ({"teacher": problem.new_rules(7)} if method == "clone" else {})


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
        trained = run(problem, method, iterations=3, seed=seed, **options)
        rules.append(trained.rules)
        worlds.append({number for number in used if number not in range(500, 503)})
    assert worlds[0] == worlds[1]
    assert not worlds[0] & worlds[2]
    assert all(max(numbers, default=0) < FIRST_EVALUATION_SEED for numbers in worlds)
    # Methods that differentiate worlds draw them otherwise.
    assert bool(worlds[0]) == (method not in ("gradient", "shac"))
    if method != "scripted":
        ours, theirs, other = (given.rules[0].output.weight for given in rules)
        assert torch.equal(ours, theirs)
        assert not torch.equal(ours, other)


def test_what_cannot_be_descended_is_refused():
    with pytest.raises(NPAError, match=r"that follows gradients .* each other's expense"):
        run(species("npa/Invasion-v0", seed_distance=0.5))
    with pytest.raises(NPAError, match="a method that follows gradients must keep all particles"):
        run(species(deaths=[[0, 2]]))


def test_no_method_learns_what_code_to_say():
    problem = Problem(env_id="npa/Shapeshifter2D-v0", episode_steps=4)
    with pytest.raises(NPAError, match="'ppo' learns no codes"):
        train("ppo", problem, Budget(particle_steps=1), 0)


def test_a_loss_without_a_gradient_is_refused(monkeypatch):
    def counted(self, x, s):
        return {"far": (x.norm(dim=-1) > 0.5).float().mean(dim=1)}

    monkeypatch.setattr(PictureEnvTask, "losses", counted)
    with pytest.raises(NPAError, match="losses of PictureEnvTask must be differentiable"):
        run(heart())


# Cloning


def test_a_clone_does_what_its_teacher_does():
    problem = heart(episode_steps=6)
    teacher = wild_rules(problem, seed=1)
    options = {"collect_steps": 6, "worlds": 3, "teacher": teacher}
    rules = run(problem, "clone", iterations=40, **options).rules
    envs = problem.make_envs()
    observation, _ = envs.reset(seed=900)
    for _ in range(4):
        observation, *_ = envs.step(teacher.policy()(observation))
    left = unexplained(rules, observation, teacher.policy()(observation))
    assert left < 0.05
    seeds = range(900, 906)
    taught, clone, untaught = (
        evaluate_policy(envs, one.policy(), seeds).mean_return
        for one in (teacher, rules, problem.new_rules(0))
    )
    assert abs(clone - taught) < 0.1 * abs(untaught - taught)


def test_species_are_cloned_each_by_its_own_rule():
    problem = species(episode_steps=6)
    teacher = wild_rules(problem, seed=1)
    options = {"collect_steps": 6, "worlds": 3, "teacher": teacher}
    rules = run(problem, "clone", iterations=20, **options).rules
    observation, _ = problem.make_envs().reset(seed=900)
    action = teacher.policy()(observation)
    assert unexplained(rules, observation, action) < 0.2
    swapped = RuleSet(list(rules)[::-1], problem.counts, problem.interface)
    assert unexplained(swapped, observation, action) > 1.0


def test_demonstrations_keep_the_last_worlds():
    seen, done = torch.zeros(2, 3, 4), torch.zeros(2, 3, 2)
    shown = Demonstrations(5, seen, done)
    generator = torch.Generator().manual_seed(0)
    for number in range(1, 5):
        shown.add(seen + number, done - number)
        observation, action = shown.draw(64, generator)
        kept = set(range(1, number + 1)) if number < 3 else set(range(number - 2, number + 1))
        assert {int(k) for k in observation[:, 0, 0]} == kept
        assert torch.equal(observation[:, 0, 0], -action[:, 0, 0])


def test_what_is_unexplained_is_0_for_the_teacher_and_1_for_its_mean():
    problem = heart()
    rules = wild_rules(problem)
    observation, _ = problem.make_envs().reset(seed=0)
    action = rules.mean(observation).detach()
    assert unexplained(rules, observation, action).item() == 0.0
    shifted = action + action.flatten(0, 1).std(dim=0, correction=0)
    assert unexplained(rules, observation, shifted).item() == pytest.approx(1.0, abs=1e-3)


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
    ("problem", "gains", "kind"),
    [
        (heart(episode_steps=16), (0.03, -0.03), PaintPolicy),
        (species(episode_steps=16), (0.03, -0.03), SpreadPolicy),
        (species("npa/Symbiosis-v0", episode_steps=16, resolution=16), (0.03, -0.03), PaintPolicy),
        (damaged(particle_count=200, eps=0.15), (0.001, -0.001), MendPolicy),
    ],
    ids=lambda p: getattr(p, "env_id", ""),
)
def test_the_scripted_policy_that_fits_is_found(problem, gains, kind):
    trained = run(problem, "scripted", gains=gains)
    assert type(trained.policy) is kind
    nothing, best = trained.log
    assert nothing.mean_return == 0.0
    assert best.mean_return > 0.0
    # Zero and two gains of each policy played 3 episodes.
    tries, rest = divmod(best.particle_steps, 3 * problem.particle_count * problem.episode_steps)
    assert (tries % 2, rest) == (1, 0)
    assert tries >= 3


def test_the_search_for_a_script_ends_with_its_budget():
    trained = run(heart(), "scripted", iterations=2, worlds=3, gains=(0.03, 0.01, 0.003))
    assert trained.log[-1].particle_steps == 2 * 3 * 48 * 8
    assert trained.log[-1].mean_return > 0.0


def test_where_no_script_helps_nothing_is_done():
    pytest.importorskip("sklearn")
    trained = run(digits(), "scripted", gains=(0.01,))
    assert type(trained.policy) is ZeroPolicy
    assert trained.log[-1].mean_return == 0.0
    assert trained.log[-1].particle_steps > 0


# Seeds: every run learns in worlds of its own


def test_worlds_of_one_seed_follow_each_other_and_end_before_those_of_the_next():
    assert list(world_seeds(0, 3)) == [0, 1, 2]
    assert world_seeds(3, 10_000)[-1] + 1 == world_seeds(4, 1)[0]
    assert world_seeds(99, 10_000)[-1] + 1 == EVALUATION_SEEDS.start
    # Parts of a run have others, until they come round.
    assert world_seeds(1, 3, 2) == [10_006, 10_007, 10_008]
    assert world_seeds(0, 6_000, 1)[3_999:4_001] == [9_999, 0]


@pytest.mark.parametrize(
    ("seed", "count", "words"),
    [(100, 1, "seed must be a whole number"), (0, 10_001, "at most 10000")],
)
def test_seeds_that_reach_other_worlds_are_refused(seed, count, words):
    with pytest.raises(NPAError, match=words):
        world_seeds(seed, count)
