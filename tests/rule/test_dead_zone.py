"""Rules with a dead zone: updates, gradients, worlds at rest; those with the smooth inverse too."""

import gymnasium
import numpy as np
import pytest
import torch
from support.circle_task import CircleTask, circle_config
from support.refusals import refused
from support.training_runs import train
from support.worlds import assert_near, assert_same, lively_rule, random_world, seeded

import npa_envs
from npa_envs import NPAError, NPARule
from npa_envs import reference as oracle
from npa_envs.agents import RulePolicy
from npa_envs.envs import multispecies_v0
from npa_envs.training import load_config
from npa_envs.training.trainer import initial_rule
from npa_envs.world import rollout_execution
from npa_envs.world.randomness import uniform_draws

ZONE = 0.05


def without_zone(rule: NPARule) -> NPARule:
    other = NPARule(**rule.hyper_parameters() | {"dead_zone": 0.0}).to(rule.hidden.weight)
    other.load_state_dict(rule.state_dict())
    return other


def by_hand(rule, x, s, steps, eps):
    """Return (x, s) after `steps` in plain torch, in which all particles are updated."""
    for _ in range(steps):
        y = rule.output(torch.relu(rule.hidden(oracle.perceive(x, s, eps, rule.eps0))))
        y = torch.where(y.abs() > rule.dead_zone, y, torch.zeros_like(y))
        delta = y[..., : rule.space_dim]
        x = x + rule.alpha * eps * delta / (1.0 + delta.norm(dim=-1, keepdim=True))
        s = s + y[..., rule.space_dim :]
    return x, s


@pytest.mark.parametrize("space_dim", [2, 3])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=("float64", "float32"))
def test_numbers_in_the_zone_are_zero_and_others_stay(space_dim, dtype, device):
    rule = lively_rule(device, dtype, space_dim, dead_zone=ZONE)
    z = torch.randn(200, rule.perception_dim, generator=torch.Generator().manual_seed(1))
    raw, felt = without_zone(rule)(z.to(device, dtype)), rule(z.to(device, dtype))
    small = raw.abs() <= ZONE
    assert 0.1 < float(small.double().mean()) < 0.9
    assert torch.equal(felt, raw.masked_fill(small, 0.0))


@pytest.mark.parametrize("space_dim", [2, 3])
def test_a_rollout_follows_the_reference_and_so_do_its_gradients(space_dim, device):
    rule = lively_rule(device, space_dim=space_dim, dead_zone=ZONE)
    x, s = random_world(2, 40, space_dim, 5, dtype=torch.float64, device=device)
    ours = npa_envs.rollout(rule, x, s, 3, eps=0.3, update_prob=1.0)
    results = []
    for after in (ours, by_hand(rule, x, s, 3, 0.3)):
        loss = after[0].square().sum() + after[1].square().sum()
        results.append([*after, *torch.autograd.grad(loss, list(rule.parameters()))])
    assert_near(*results, 1e-10)
    plain = npa_envs.rollout(without_zone(rule), x, s, 3, eps=0.3, update_prob=1.0)
    assert float((plain[0] - ours[0]).detach().abs().max()) > 1e-3


def test_a_world_whose_updates_are_in_the_zone_stays_as_it_is(device):
    rule = lively_rule(device, torch.float32, dead_zone=1e6)
    x, s = random_world(2, 64, 2, 5, dtype=torch.float32, device=device)
    with torch.no_grad():
        # From the third call on worlds on a CPU are prepared, and those on CUDA are recorded.
        for _ in range(4):
            after = npa_envs.rollout(rule, x, s, 5, eps=0.3)
            assert_same(after, (x, s))
        rule.dead_zone = 0.0
        moved, _ = npa_envs.rollout(rule, x, s, 5, eps=0.3)
        assert not torch.equal(moved, x)


def test_species_have_zones_of_their_own(device):
    zones = (1e6, 0.0)
    rules = [lively_rule(device, torch.float32, dead_zone=zone) for zone in zones]
    x, s = random_world(1, 60, 2, 5, dtype=torch.float32, device=device)
    with torch.no_grad():
        after, _ = npa_envs.rollout_species(rules, x, s, 4, counts=(30, 30), eps=0.3)
    still = (after == x).all(dim=-1)[0]
    assert still[:30].all()
    assert still[30:].double().mean() < 0.5


@pytest.mark.parametrize("zone", [-1e-3, float("nan"), float("inf"), "wide"])
def test_zones_that_are_none_are_refused(zone, tmp_path):
    refused("dead_zone must be a", NPARule, dead_zone=zone)
    with pytest.raises(NPAError, match=r"dead_zone must be (a finite number|of type float)"):
        circle_config(tmp_path, dead_zone=zone)
    refused("an equivariant rule has no dead zone", NPARule, equivariant=True, dead_zone=0.001)
    # That of a preset is not for them.
    config = circle_config(tmp_path, dead_zone=0.001)
    assert initial_rule(config, NPARule(equivariant=True)).dead_zone == 0.0


@pytest.mark.parametrize(
    ("field", "begun", "chosen"),
    [
        ("dead_zone", 0.0, 0.01),
        ("dead_zone", 0.5, 0.01),
        ("moment_inverse", "threshold", "smooth"),
        ("moment_inverse", "smooth", "threshold"),
    ],
)
def test_training_gives_its_rule_the_zone_and_the_inverse(tmp_path, field, begun, chosen):
    untrained = CircleTask().make_rule(torch.Generator())
    initial = NPARule(**untrained.hyper_parameters() | {field: begun})
    npa_envs.save_rule(initial, tmp_path / "rule.safetensors")
    fields = {field: chosen, "initial_rule": str(tmp_path / "rule.safetensors")}
    config = circle_config(tmp_path / "run", iterations=2, **fields)
    if begun == "smooth":
        refused("differs in moment_inverse", initial_rule, config, untrained)
        return
    rule = initial_rule(config, untrained)
    assert getattr(rule, field) == chosen
    assert torch.equal(rule.hidden.weight, initial.hidden.weight)
    train(config)
    assert getattr(npa_envs.load_rule(tmp_path / "run"), field) == chosen
    assert load_config(tmp_path / "run" / "config.json", circle_config(tmp_path)) == config


def test_a_rule_acts_only_where_its_choice_is_observed():
    rule = NPARule(moment_inverse="smooth")
    env = gymnasium.make("npa/Morphogenesis2D-v0", particle_count=32)
    refused("the environment with the keyword moment_inverse='smooth'", RulePolicy, rule, env)
    env = gymnasium.make("npa/Morphogenesis2D-v0", particle_count=32, moment_inverse="smooth")
    RulePolicy(rule, env)
    with pytest.raises(
        NPAError, match="moment_inverse must be 'threshold' or 'smooth', got 'soft'"
    ):
        gymnasium.make("npa/Morphogenesis2D-v0", moment_inverse="soft")


def test_several_species_observe_what_they_are_told():
    observations = []
    for word in ("smooth", "threshold"):
        env = multispecies_v0.parallel_env(particle_count=40, moment_inverse=word)
        env.reset(seed=0)
        actions = {}
        for agent in env.agents:
            shape = env.action_space(agent).shape
            actions[agent] = np.linspace(-0.5, 0.5, np.prod(shape), dtype=np.float32).reshape(shape)
        observations.append(np.concatenate(list(env.step(actions)[0].values())))
    assert np.abs(observations[0] - observations[1]).max() > 1e-6


class TestRest:
    """Worlds that come to rest: each particle changes until its states are near 1, then stays."""

    @pytest.fixture(autouse=True)
    def short_parts_without_gradients(self, monkeypatch):
        monkeypatch.setattr(rollout_execution, "FIRST_PART", {"cpu": 64, "cuda": 64})
        with torch.no_grad():
            yield

    @pytest.fixture
    def rule(self, device):
        rule = NPARule(2, 4, 8, eps0=0.3, dead_zone=0.02)
        rule.hidden.weight.zero_()
        rule.output.weight.zero_()
        # Δs = 0.2 relu(1 - s), and a first step to the right as long as that lasts.
        for channel in range(4):
            rule.hidden.weight[channel, channel] = -1.0
            rule.hidden.bias[channel] = 1.0
            rule.output.weight[2 + channel, channel] = 0.2
        rule.output.weight[0] = 0.02
        return rule.to(device)

    @pytest.fixture
    def worlds(self, device):
        return random_world(2, 50, 2, 4, dtype=torch.float32, device=device)

    def test_worlds_at_rest_are_recognised(self, rule, worlds):
        assert not npa_envs.at_rest(rule, *worlds, eps=0.3).any()
        x, s = npa_envs.rollout(rule, *worlds, 200, eps=0.3)
        assert npa_envs.at_rest(rule, x, s, eps=0.3).all()
        s[1, 7, 2] = 0.0
        assert npa_envs.at_rest(rule, x, s, eps=0.3).tolist() == [True, False]

    @pytest.mark.parametrize("by_world", [False, True])
    def test_a_rollout_leaves_them_out_and_ends_and_draws_as_if_it_did_not(
        self, rule, worlds, device, monkeypatch, by_world
    ):
        results = []
        for fewest in (10**9, 256):
            monkeypatch.setattr(rollout_execution, "MIN_RESTING", fewest)
            generator = seeded(5, device)
            if by_world:
                generator = npa_envs.WorldRandom([3, 4], device=device)
            result, (x, s) = [], worlds
            # They come to rest within the first, and are so when the second begins.
            for steps in (600, 300, 1):
                x, s = npa_envs.rollout(rule, x, s, steps, eps=0.3, generator=generator)
                result += [x, s]
            results.append([*result, uniform_draws(generator, (2, 50), x)])
        assert_same(*results)

    @pytest.fixture
    def parts(self, monkeypatch):
        """The steps of each part without a watch; one of 1 step asks whether worlds are at rest."""
        parts, run_captured = [], rollout_execution.run_captured

        def noted(call, *args, **options):
            parts.append(call.steps)
            return run_captured(call, *args, **options)

        monkeypatch.setattr(rollout_execution, "run_captured", noted)
        return parts

    def test_it_runs_no_step_of_worlds_that_begin_at_rest(self, rule, worlds, parts):
        x, s = npa_envs.rollout(rule, *worlds, 200, eps=0.3)
        parts.clear()
        after = npa_envs.rollout(rule, x, s, 10_000, eps=0.3)
        assert parts == [1]
        assert_same(after, (x, s))
        after[0].zero_()
        assert x.any()

    def test_what_needs_each_step_runs_each_step(self, rule, worlds, parts):
        class Changed(NPARule):
            def forward(self, perception):
                return super().forward(perception)

        changed = Changed(**rule.hyper_parameters()).to(worlds[0].device)
        with torch.enable_grad():
            npa_envs.rollout(rule, *worlds, 256, eps=0.3)
        npa_envs.rollout(changed, *worlds, 256, eps=0.3)
        for options in (
            {"keep_every": 64},
            {"return_path_length": True},
            {"position_noise": 1e-3},
            {"on_divergence": "raise"},
        ):
            npa_envs.rollout(rule, *worlds, 256, eps=0.3, **options)
        assert parts == [256] * 5

    def test_worlds_that_diverge_are_returned_as_without_a_zone(self, rule, worlds, parts, device):
        # Beyond 3 a state grows more from step to step, and takes the particle along.
        rule.hidden.weight[7, 3] = 1.0
        rule.hidden.bias[7] = -3.0
        rule.output.weight[5, 7] = rule.output.weight[0, 7] = 2.0
        x, s = worlds
        s[1, 5, 3] = 4.0
        for zone in (0.02, 0.0):
            rule.dead_zone = zone
            after, _ = npa_envs.rollout(rule, x, s, 600, eps=0.3, generator=seeded(5, device))
            assert after.isfinite().flatten(1).all(dim=1).tolist() == [True, False]
        assert parts[:2] == [1, 64]
        assert parts[-1] == 600

    @pytest.mark.parametrize("steps", [257, 600])
    def test_static_worlds_that_begin_outside_of_a_box_end_as_if_each_step_ran(self, steps, device):
        rule = lively_rule(device, torch.float32, 2, 4, static=True, gain=2.0, dead_zone=1e-3)
        x, s = random_world(2, 50, 2, 4, dtype=torch.float32, device=device)
        options = {"eps": 0.3, "box": 1.4, "dt": 0.01}
        skipping, every = (
            npa_envs.rollout(
                rule, x + 3.3, 0.1 * s, steps, generator=seeded(5, device), **options, **more
            )
            for more in ({}, {"return_path_length": True})
        )
        assert_same(skipping, every[:2])
        assert float(skipping[0].abs().max()) <= 0.7
        assert float((skipping[1] - 0.1 * s).abs().max()) > 1e-3

    def test_rules_that_divide_are_refused(self, worlds):
        with pytest.raises(NPAError, match="at_rest is for rules whose particles do not divide"):
            npa_envs.at_rest(NPARule(2, 4, 8, divides=True), *worlds)
