"""The short-horizon actor-critic: targets, windows, gains, and that it learns to grow."""

import pytest
import torch
from learning_problems import digits, heart, species, wild_rules

from npa_envs.agents.learning import Budget, Problem, train
from npa_envs.agents.learning.shac import SHACLearner, SHACOptions, td_lambda_targets, values
from npa_envs.errors import NPAError

CPU = torch.device("cpu")


def learner(problem, **options):
    given = SHACOptions(**{"world_count": 3} | options)
    return SHACLearner(problem, given, 0, CPU, wild_rules(problem))


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
    if problem == digits():
        pytest.importorskip("sklearn")
    made = learner(problem, steps=4, gamma=1.0, value_weight=1.0)
    window = made.play()
    assert window.losses.shape == (5, 3)
    fell = window.losses[0] - window.losses[-1]
    torch.testing.assert_close(made.gain(window), fell.mean())
    with torch.no_grad():
        made.target.value.bias.fill_(0.25)
    torch.testing.assert_close(made.gain(window), fell.mean() + 0.25)
    assert window.losses.requires_grad
    # The next window begins where this one ended, but where an episode of two windows was over; no
    # gradient leads back.
    x, s, _, goal = made.worlds
    assert not x.requires_grad
    assert not s.requires_grad
    now = made.task.world_losses(x, s) if goal is None else made.play().losses[0]
    torch.testing.assert_close(now[1], window.losses[-1, 1])
    assert ((now - window.losses[-1]).abs()[[0, 2]] > 1e-3).all()


def test_worlds_begin_anew_where_their_episode_is_over():
    made = learner(heart(episode_steps=10), steps=4, world_count=4)
    # Three windows of four steps: twelve steps are the fewest that are enough.
    assert (made.window, made.window_count) == (4, 3)
    assert made.windows_left == [1, 2, 3, 1]
    fresh = made.task.world_losses(made.worlds.x, made.worlds.s)
    for _ in range(4):
        made.learn(0.05)
    now = made.task.world_losses(made.worlds.x, made.worlds.s)
    begun = [left == 3 for left in made.windows_left]
    assert begun == [True, False, False, True]
    assert (now[begun] - fresh[begun]).abs().max() < (now - fresh).abs()[[1, 2]].min()


def test_the_critic_learns_what_is_paid_and_its_copy_follows():
    made = learner(heart(), steps=4, critic_epochs=40, target_rate=0.5)
    window = made.play()
    window = type(window)(*(part.detach() for part in window))
    made.learn_values(window)
    seen = window.features[:-1].flatten(0, 1)
    paid = td_lambda_targets(window.rewards, torch.zeros(4, 3), gamma=0.9, td_lambda=0.95)
    with torch.no_grad():
        learned, followed = values(made.critic, seen), values(made.target, seen)
    spread = (paid.flatten() - paid.mean()).square().mean()
    assert (learned - paid.flatten()).square().mean() < 0.5 * (spread + paid.mean().square())
    assert 0.0 < followed.abs().mean() < learned.abs().mean()


@pytest.mark.parametrize(
    ("problem", "windows", "left"),
    [(heart(), 40, 0.9), (species(perception="per_species"), 15, 0.9)],
    ids=["grows", "mixes"],
)
def test_it_leaves_a_share_of_the_loss_after_a_few_windows(problem, windows, left):
    budget = Budget(particle_steps=windows * 4 * 4 * problem.particle_count)
    options = {"world_count": 4, "steps": 4, "learning_rate": 1e-2}
    seeds = range(500, 503)
    log = train("shac", problem, budget, 0, evaluation_seeds=seeds, entries=1, **options).log
    assert log[-1].final_loss < left * log[0].final_loss


@pytest.mark.slow
def test_it_grows_a_heart_nearly_as_well_as_the_whole_gradient():
    small = {"target": "heart", "particle_count": 64, "eps": 0.2, "eps0": 0.1, "state_dim": 4}
    keywords = small | {"state_scale": 0.1, "seed_radius": 0.4, "colour_weight": 20.0}
    problem = Problem(env_id="npa/Morphogenesis2D-v0", keywords=keywords, episode_steps=32)
    budget = Budget(particle_steps=1_000_000)
    returns = [
        train(m, problem, budget, 0, entries=1).log[-1].mean_return for m in ("shac", "zero")
    ]
    assert returns[0] > 1.5
    assert returns[1] == 0.0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"steps": 0}, "steps must be"),
        ({"gamma": 1.5}, "gamma must lie"),
        ({"critic": "all"}, "critic must be"),
    ],
)
def test_wrong_options_are_refused(options, words):
    with pytest.raises(NPAError, match=words):
        train("shac", heart(), Budget(particle_steps=1), 0, **options)
