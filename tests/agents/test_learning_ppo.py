"""PPO in its forms: on the device, and Stable-Baselines3's."""

import itertools
import math
import weakref
from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.distributed as dist
from support.learning_problems import heart, progress_of, wild_rules
from support.slow import slow

from npa_envs.agents import RandomPolicy, evaluate_policy
from npa_envs.agents.learning import Budget, Problem, RuleSet, ppo, train
from npa_envs.agents.learning.actor_critic import Critic, GaussianRules
from npa_envs.agents.learning.ppo import (
    PPOLearner,
    PPOOptions,
    clipped_objective,
    generalised_advantages,
    particle_means,
    standardised,
    total_num_envs,
    world_bytes,
)
from npa_envs.rule.rule import NPARule
from npa_envs.world.cuda_graph import no_garbage_collection

HEART = heart(
    episode_steps=16, num_envs=8, particle_count=64, eps=0.2, eps0=0.1, seed_radius=0.45,
    colour_weight=20.0, state_scale=0.1, resolution=32,
)  # fmt: skip
ROUND = 16 * 8 * 64
FEW = replace(HEART, num_envs=2)
"""As HEART, in a quarter of its worlds."""
MIXING = Problem(
    env_id="npa/Mixing-v0",
    keywords={"particle_counts": [12, 20], "eps": 0.3, "state_dim": 4, "state_scale": 0.1},
    episode_steps=8,
    num_envs=4,
)
DYING = replace(MIXING, keywords=dict(MIXING.keywords) | {"deaths": [[1, 5]]}, episode_steps=9)
SEEDS = range(100, 116)

BY_WORLDS = {"ratio": "world", "critic": "central"}
FORMS = {
    "device": ("ppo", {}),
    "device, by worlds": ("ppo", BY_WORLDS),
    "Stable-Baselines3": ("ppo_world", {}),
    "Stable-Baselines3, central critic": ("ppo_world", {"critic": "central"}),
}
TWICE = "device, by worlds", "Stable-Baselines3, central critic"
EVERY_FORM = pytest.mark.parametrize("form", [slow(f) if f in TWICE else f for f in FORMS])


def learner(problem=HEART, **options):
    return PPOLearner(progress_of(problem), PPOOptions(**options))


def improved(problem, **options):
    """Return rules that learned from a round of four steps."""
    given = learner(problem, steps=4, **options)
    given.play()
    given.improve(1.0)
    return given.actor


def run(form, problem, budget, seed=0, **keywords):
    method, options = FORMS[form]
    given = {"evaluation_seeds": SEEDS, "curve_points": 1} | options | keywords
    return train(method, problem, Budget(particle_steps=budget), seed, **given)


@EVERY_FORM
def test_every_form_learns_to_grow_and_colour_particles(form):
    rounds = 12 if form.startswith("device") else 8
    # In so few rounds small changes of the policy are the safer ones.
    first, last = run(form, HEART, rounds * ROUND, target_kl=0.05).log
    envs = HEART.make_envs()
    by_chance = evaluate_policy(envs, RandomPolicy(envs), SEEDS)
    # Doing nothing gives 0, and the best of all learners about 2.
    assert last.particle_steps == rounds * ROUND
    assert first.mean_return == 0.0
    error = math.hypot(last.standard_error, by_chance.standard_error)
    assert last.mean_return > max(0.05, by_chance.mean_return + 5.0 * error, 5.0 * error)


def test_advantages_are_the_sums_of_the_definition_within_episodes():
    generator = torch.Generator().manual_seed(0)
    steps, worlds, gamma, gae_lambda = 12, 40, 0.9, 0.8
    rewards, values, following = torch.randn(
        3, steps, worlds, generator=generator, dtype=torch.float64
    )
    terminated, truncated = torch.rand(2, steps, worlds, generator=generator) < 0.15
    ended = terminated | truncated
    advantages = generalised_advantages(
        rewards, values, following, terminated, ended, gamma=gamma, gae_lambda=gae_lambda
    )
    assert (terminated & truncated).any()
    errors = rewards + gamma * torch.where(terminated, 0.0, following) - values
    for step, world in itertools.product(range(steps), range(worlds)):
        ends = ended[step:, world].nonzero()
        count = int(ends[0]) + 1 if len(ends) else steps - step
        weights = (gamma * gae_lambda) ** torch.arange(count, dtype=torch.float64)
        total = (weights * errors[step : step + count, world]).sum()
        assert float(advantages[step, world]) == pytest.approx(float(total), abs=1e-12)


def test_worlds_that_are_cut_off_are_worth_what_the_critic_says_of_their_last_observation():
    given = learner(steps=20, gamma=0.5, gae_lambda=1.0)
    with torch.no_grad():
        given.critic.value.bias.fill_(3.0)
    batch = given.play()
    # Step 16 ends all episodes: its target is its reward and half of what comes after.
    rewards = batch.targets.view(20, 8, 64)[15] - 0.5 * 3.0
    assert rewards.abs().max() < 0.5
    assert (batch.targets.view(20, 8, 64) - 3.0 * 0.5**5 < 3.5).all()
    torch.testing.assert_close(rewards, rewards[:, :1].expand(-1, 64))


def test_likelihoods_are_those_of_gaussians_and_a_world_s_is_their_mean():
    actor = GaussianRules(RuleSet.new(MIXING, 0), 0.2)
    with torch.no_grad():
        actor.log_std.add_(0.3 * torch.randn(actor.log_std.shape))
    observation = torch.randn(5, 32, MIXING.interface.perception_dim)
    action, log_prob = actor.sample(observation)
    normal = torch.distributions.Normal(actor.rules.mean(observation), actor.row_log_std().exp())
    by_hand = normal.log_prob(action).sum(dim=-1)
    torch.testing.assert_close(log_prob, by_hand)
    torch.testing.assert_close(actor.log_prob(observation, action), by_hand)
    for k, span in enumerate(actor.rules.spans):
        assert torch.equal(
            actor.row_log_std()[span], actor.log_std[k].expand(span.stop - span.start, -1)
        )
        rows = (part[:, span].flatten(0, 1) for part in (observation, action))
        torch.testing.assert_close(actor.row_log_prob(k, *rows), by_hand[:, span].flatten())
    world = particle_means(by_hand, torch.ones(5, 32))
    torch.testing.assert_close(world, by_hand.mean(dim=1, keepdim=True))


@pytest.mark.parametrize("problem", [HEART, MIXING], ids=["heart", "mixing"])
def test_a_world_s_policy_in_stable_baselines_acts_by_its_rules_and_means_over_particles(problem):
    from npa_envs.agents.learning.sb3 import KL_FACTOR, WorldRulePolicy, world_kl
    from npa_envs.wrappers import WorldVecEnv

    rules = wild_rules(problem, factor=20.0)
    worlds = WorldVecEnv(problem.make_envs())
    worlds.seed(3)
    spaces = (worlds.observation_space, worlds.action_space)
    policy, observation = WorldRulePolicy(*spaces, lambda _: 1e-3, rules=rules), worlds.reset()
    wanted = rules.policy()(observation)
    assert np.abs(wanted).max() > 0.1
    np.testing.assert_allclose(
        policy.predict(observation, deterministic=True)[0], wanted, atol=1e-6
    )
    observation = torch.from_numpy(observation)
    action, value, log_prob = policy(observation)
    deviation = policy.actor.row_log_std().exp()
    normal = torch.distributions.Normal(policy.actor.rules.mean(observation), deviation)
    torch.testing.assert_close(log_prob, normal.log_prob(action).sum(dim=-1).mean(dim=-1))
    values, again, entropy = policy.evaluate_actions(observation, action.flatten(1))
    assert value.shape == values.shape == (problem.num_envs, 1)
    torch.testing.assert_close(again, log_prob)
    torch.testing.assert_close(entropy, normal.entropy().sum(dim=-1).mean(dim=-1))
    # A world's log-ratio is close to minus the divergence of its particles.
    assert KL_FACTOR * world_kl(0.02) == pytest.approx(math.expm1(-0.02) + 0.02, rel=0.01)


def test_gains_are_clipped_where_the_ratio_has_gone_where_it_pays():
    log_ratio = torch.tensor([[0.5], [0.5], [-0.5], [-0.5], [0.0]]).requires_grad_()
    advantages = torch.tensor([[1.0], [-1.0], [1.0], [-1.0], [2.0]])
    weights = torch.tensor([[1.0], [1.0], [1.0], [1.0], [0.0]])
    gain = clipped_objective(log_ratio, advantages, weights, weights.sum(), clip=0.2)
    wanted = 1.2 - math.exp(0.5) + math.exp(-0.5) - 0.8
    assert float(gain.detach()) == pytest.approx(wanted / 4.0, abs=1e-6)
    gain.backward()
    assert (log_ratio.grad != 0).flatten().tolist() == [False, True, True, False, False]


def test_standardised_numbers_are_compared_within_a_step_and_have_mean_0_and_deviation_1():
    for worlds in (1, 6):
        values, weights = torch.randn(7, worlds, 5), (torch.rand(7, worlds, 5) < 0.7).float()
        result = standardised(3.0 * values + 2.0, weights)
        assert torch.equal(result != 0.0, weights > 0.0)
        assert float(result.sum()) == pytest.approx(0.0, abs=1e-4)
        assert float(result[weights > 0].square().mean()) == pytest.approx(1.0, abs=1e-5)
    # A step that is good for all worlds alike is nobody's merit.
    for rows in (1, 5):
        values, weights = torch.randn(7, 6, rows), torch.ones(7, 6, 5)
        result = standardised(values + 3.0 * torch.arange(7.0)[:, None, None], weights)
        torch.testing.assert_close(result, standardised(values, weights), rtol=1.3e-6, atol=2e-5)
        torch.testing.assert_close(result.mean(dim=(1, 2)), torch.zeros(7), rtol=0.0, atol=2e-5)


def test_a_critic_keeps_its_values_when_its_scale_changes_and_sees_its_world_if_central():
    critic = Critic(6, (3, 5), "central")
    with torch.no_grad():
        critic.value.weight.normal_()
    seen = torch.randn(4, 8, 6)
    before = critic(seen)
    critic.rescale(torch.full((10,), 7.0))
    assert float(critic.scale) == pytest.approx(7.0)
    torch.testing.assert_close(critic(seen), before)
    changed = seen.clone()
    changed[:, -1] += 1.0
    assert not torch.allclose(critic(changed)[:, 0], before[:, 0])
    alone = Critic(6, (3, 5), "particle")
    torch.testing.assert_close(alone(changed)[:, :-1], alone(seen)[:, :-1])


@pytest.mark.parametrize("steps", [5, 8], ids=["at the end of a round", "within a round"])
def test_a_species_that_ends_is_worth_nothing_more_and_its_particles_do_not_count(steps):
    given = learner(DYING, steps=steps, gamma=0.5, gae_lambda=1.0, critic="central")
    with torch.no_grad():
        given.critic.value.bias.fill_(3.0)
    batch = given.play()
    acted, targets = (part.view(steps, 4, 32) for part in (batch.acted, batch.targets))
    # The one that dies in the fifth step gets that step's reward; the other one goes on.
    assert targets[4, :, 12:].abs().max() < 0.5
    assert targets[4, :, :12].min() > 0.1
    assert acted[:, :, :12].all()
    assert acted[:5, :, 12:].all()
    assert not acted[5:, :, 12:].any()
    given.improve(1.0)
    assert all(torch.isfinite(weight).all() for weight in given.actor.parameters())


def test_rules_that_have_gone_far_enough_stay_for_the_rest_of_a_round():
    def after(epochs, target_kl):
        actor = improved(HEART, epochs=epochs, target_kl=target_kl)
        return actor.rules.rules[0].output.weight

    # The first minibatch steps, as nothing has moved yet.
    assert after(1, 1e-6).abs().max() > 0.0
    assert torch.equal(after(1, 1e-6), after(3, 1e-6))
    assert not torch.equal(after(1, 1e6), after(3, 1e6))


def test_entropy_is_rewarded_and_gradients_are_clipped():
    certain = improved(FEW).log_std.mean()
    assert improved(FEW, entropy_weight=1.0).log_std.mean() > certain + 1e-3
    clipped = improved(FEW, max_gradient_norm=1e-4).parameters()
    norms = [weight.grad.norm() for weight in clipped if weight.grad is not None]
    assert 0.9e-4 < torch.stack(norms).norm() < 1.1e-4


@pytest.mark.parametrize(
    ("problem", "options"),
    [
        pytest.param(HEART, {}, id="particles"),
        pytest.param(HEART, BY_WORLDS, id="worlds"),
        pytest.param(HEART, {"target_kl": 1e-6}, id="rules that stay"),
        pytest.param(DYING, {}, id="species"),
        pytest.param(DYING, BY_WORLDS, id="species, by worlds"),
        pytest.param(HEART, {"steps": 4, "minibatches": 2, "shared": True}, id="shared"),
    ],
)
def test_captured_rounds_are_those_of_kernels_one_by_one(
    problem, options, device, tmp_path, monkeypatch
):
    if device.type != "cuda":
        pytest.skip("rounds are captured on CUDA only")
    options = {"critic_rounds": 3, **options}
    if shared := options.pop("shared", False):
        store = dist.FileStore(str(tmp_path / "store"), 1)
        dist.init_process_group("cpu:gloo,cuda:nccl", store=store, rank=0, world_size=1)

    def learned():
        given = PPOLearner(progress_of(problem, device), PPOOptions(**options))
        # The third call of a captured function is the first replay after all captures.
        for share_left in (1.0, 0.9, 0.7, 0.5, 0.3, 0.1):
            batch = given.play()
            given.improve(share_left)
        return [*batch, *given.actor.parameters(), *given.critic.parameters()]

    try:
        captured = learned()
        monkeypatch.setattr(ppo, "GraphedCallable", lambda function, *_, **__: function)
        for value, wanted in zip(captured, learned(), strict=True):
            assert float(wanted.detach().norm()) > 0.0
            torch.testing.assert_close(value, wanted, rtol=1e-3, atol=1e-5)
    finally:
        if shared:
            dist.destroy_process_group()


@pytest.mark.parametrize("problem", [HEART, MIXING], ids=["one", "two species"])
def test_a_learner_and_its_buffers_are_freed_at_once(problem):
    given = learner(problem, steps=4)
    given.play()
    given.improve(1.0)
    worlds = given.envs.worlds if problem is HEART else given.envs
    parts = (given, given.buffers, given.envs, worlds, *given.actor.parameters())
    references = [weakref.ref(part) for part in parts]
    with no_garbage_collection():
        del given, worlds, parts
        assert [reference() for reference in references if reference() is not None] == []


@EVERY_FORM
def test_read_outs_and_frozen_layers_stay_as_they_are(form):
    rule = NPARule(2, 4, 16, readout_dim=10, readout_hidden_dim=8)
    rule.hidden.requires_grad_(False)
    with torch.no_grad():
        rule.readout[2].weight.normal_()
    start = RuleSet.of(FEW, rule)
    (found,) = run(form, FEW, 3 * ROUND // 4, start=start, critic_rounds=1).rules
    assert torch.equal(found.hidden.weight, rule.hidden.weight)
    assert torch.equal(found.readout[2].weight, rule.readout[2].weight)
    assert not torch.equal(found.output.weight, rule.output.weight)
    assert found.output.weight.grad is None


@pytest.mark.parametrize(
    ("gibibytes", "device", "options", "budget", "least", "most"),
    [
        # 2^17 particles, 64 of them in each world.
        (100, "cuda:0", {}, {"seconds": 1.0}, 2048, 2048),
        (100, "cpu", {}, {"seconds": 1.0}, 8, 8),
        (100, "cuda:0", {"num_envs": 3}, {"seconds": 1.0}, 3, 3),
        (100, "cuda:0", {}, {"particle_steps": 128 * 16 * 64 * 100}, 100, 100),
        (1, "cuda:0", {}, {"seconds": 1.0}, 9, 2047),
        (0, "cuda:0", {}, {"seconds": 1.0}, 8, 8),
    ],
)
def test_a_gpu_is_kept_busy_where_neither_memory_nor_budget_forbids(
    monkeypatch, gibibytes, device, options, budget, least, most
):
    free, options, device = gibibytes * 2**30, PPOOptions(**options), torch.device(device)
    monkeypatch.setattr(ppo, "free_bytes", lambda _: free)
    progress = progress_of(HEART)
    progress.device, progress.budget = device, Budget(**budget)
    worlds = total_num_envs(progress, options)
    assert least <= worlds <= most
    assert gibibytes != 1 or worlds * world_bytes(HEART, options, device) <= free / 4


@pytest.fixture(scope="module")
def taught():
    budget = Budget(particle_steps=4 * ROUND)
    return train("gradient", HEART, budget, 0, curve_points=1, evaluation_seeds=SEEDS).rules


@pytest.mark.parametrize("form", ["device", slow("Stable-Baselines3")])
def test_fine_tuning_does_not_undo_what_rules_can_do(form, taught):
    first, last = run(form, HEART, 6 * ROUND, start=taught).log
    assert first.mean_return > 0.5
    assert last.mean_return > first.mean_return - 3.0 * first.standard_error
    # Rules stay as they are in the first rounds, in which the critic learns alone.
    rules = run(form, HEART, 2 * ROUND // 4, start=taught, steps=4).rules
    assert all(map(torch.equal, rules.parameters(), taught.parameters()))


@pytest.mark.parametrize(("form", "kept"), [slow(f, 6) if f in TWICE else (f, 4) for f in FORMS])
def test_in_every_form_the_noise_falls_towards_the_end(form, kept, monkeypatch):
    left, decay_share = [1.0], 1.0 - kept / 8
    set_noise = GaussianRules.set_noise

    def spy(actor, share):
        before = actor.log_std.exp()
        set_noise(actor, share)
        torch.testing.assert_close(actor.log_std.exp(), share / left[-1] * before)
        left.append(share)

    monkeypatch.setattr(GaussianRules, "set_noise", spy)
    options = {"last_noise": 0.1, "noise_decay_share": decay_share}
    run(form, FEW, 8 * ROUND // 4, critic_rounds=0, **options)
    left = np.array(left[1:])
    assert left[:kept] == pytest.approx(1.0)
    assert (np.diff(left[kept:]) < 0.0).all()
    # The last of eight rounds begins with an eighth of the budget.
    assert left[7] == pytest.approx(0.1 ** (1.0 - 0.125 / decay_share))
    assert 0.1 <= left[-1] <= left[7]
