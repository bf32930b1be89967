"""Particles that divide and die: slots, fates, what the dead do to the living, and gradients."""

import pytest
import torch
from support.worlds import assert_near, assert_same, lively_rule, random_world, seeded

import npa_envs
from npa_envs.errors import NPAError
from npa_envs.rule.rule import LIFE, with_division
from npa_envs.world.division import Births, divided, living
from npa_envs.world.particles import Particles

EPS = 0.3


def dividing_rule(device, odds=(0.0, -8.0), **options):
    rule = lively_rule(device, state_dim=6, eps0=EPS, divides=True, gain=4.0, **options)
    with torch.no_grad():
        rule.fate.bias.copy_(torch.tensor(odds))
        rule.fate.weight.normal_(std=0.1, generator=torch.Generator(device).manual_seed(0))
    return rule


def third_full(device, particle_count=64, space_dim=2):
    """Two worlds in which every third slot holds a living particle."""
    x, s = random_world(2, particle_count, space_dim, 6, dtype=torch.float64, device=device)
    s[..., LIFE] = (torch.arange(particle_count) % 3 == 0).to(s)
    return x, s


def births_of(x, chance=0.5, seed=3):
    generator = torch.Generator().manual_seed(seed)
    direction = torch.randn(x.shape, generator=generator, dtype=torch.float64).to(x)
    return Births(x.new_full(x.shape[:2], chance), direction)


def divide(x, s, dividing=(), dying=(), updated=None):
    """One division in which the given slots divide or die."""
    odds = torch.zeros(2, *x.shape[:2], dtype=x.dtype, device=x.device)
    odds[0, :, list(dividing)] = 1.0
    odds[1, :, list(dying)] = 1.0
    updated = living(s) if updated is None else updated
    fates = {"division_probabilities": tuple(odds), "updated": updated, "births": births_of(x)}
    after = divided(Particles(x, s, torch.ones_like(x[..., 0])), eps=EPS, **fates)
    return after.per_particle()


@pytest.mark.parametrize("update_prob", [0.5, 1.0])
def test_what_lies_in_dead_slots_influences_nothing(update_prob, device):
    rule = dividing_rule(device)
    x, s = third_full(device)
    dead = ~living(s)[..., None]
    result = []
    for seed in range(2):
        other = random_world(2, 64, 2, 6, dtype=x.dtype, device=device, seed=seed)
        other[1][..., LIFE] = 0.0
        given = [torch.where(dead, new, own) for new, own in zip(other, (x, s), strict=True)]
        options = {"update_prob": update_prob, "return_path_length": True}
        result.append(npa_envs.rollout(rule, *given, 6, generator=seeded(1, device), **options))
    assert_same(*result)
    assert int(living(result[0][1]).sum()) > int(living(s).sum())


def test_not_a_number_in_dead_slots_leaves_gradients_finite(device):
    rule = dividing_rule(device)
    x, s = third_full(device)
    gradients = []
    for fill in (0.0, float("nan")):
        start = torch.where(living(s)[..., None], s, fill).requires_grad_()
        after = npa_envs.rollout(rule, x, start, 3, generator=seeded(1, device))
        loss = sum(part.square().sum() for part in after)
        weights = [start, rule.hidden.weight, rule.fate.weight]
        gradients.append(torch.autograd.grad(loss, weights))
    assert_same(*gradients)


@pytest.mark.parametrize("space_dim", [2, 3])
def test_the_living_do_what_they_would_in_a_world_without_the_dead(space_dim, device):
    rule = dividing_rule(device, (-50.0, -50.0), density_gradient=False, space_dim=space_dim)
    plain = rule.hyper_parameters() | {"divides": False}
    alone = npa_envs.NPARule(**plain).to(device, torch.float64)
    alone.load_state_dict(rule.state_dict(), strict=False)
    with torch.no_grad():
        # A rule does not change life; a plain one has to be told.
        alone.output.weight[space_dim + LIFE] = 0.0
    x, s = third_full(device, space_dim=space_dim)
    alive = living(s)[0]
    after = npa_envs.rollout(rule, x, s, 8, update_prob=1.0)
    expected = npa_envs.rollout(alone, x[:, alive], s[:, alive], 8, update_prob=1.0)
    assert_near([part[:, alive] for part in after], expected, 1e-12)
    assert_same(living(after[1]), living(s))


def test_children_take_the_first_dead_slots_in_order(device):
    x, s = third_full(device, 9)
    parents = [3, 6]
    after_x, after_s, path_length = divide(x, s, parents)
    assert_same(after_s[:, [1, 2], LIFE], s[:, parents, LIFE])
    assert not after_s[:, [1, 2], LIFE + 1 :].any()
    half_way = 0.25 * EPS / 2**0.5 * births_of(x).direction[:, parents]
    assert_near([after_x[:, [1, 2]]], [x[:, parents] + half_way], 1e-12)
    assert_near([after_x[:, parents]], [x[:, parents] - half_way], 1e-12)
    assert_same(after_s[:, [0, 3, 6]], s[:, [0, 3, 6]])
    assert_same(after_x[:, 0], x[:, 0])
    assert living(after_s).sum(dim=1).tolist() == [5, 5]
    assert path_length[0].tolist() == [1, 0, 0, 1, 0, 0, 1, 0, 0]


def test_a_full_world_has_no_children_and_only_updated_particles_divide(device):
    x, s = third_full(device, 9)
    everyone = range(9)
    s[..., LIFE] = 1.0
    assert_same(divide(x, s, everyone)[:2], (x, s))
    s[:, 1, LIFE] = 0.0
    after_x, after_s, _ = divide(x, s, everyone)
    assert living(after_s).all()
    assert after_s[:, 1, LIFE + 1 :].abs().max() == 0.0
    assert_same(after_x[:, 2:], x[:, 2:])
    nobody = torch.zeros(2, 9, dtype=torch.bool, device=device)
    assert living(divide(x, s, everyone, updated=nobody)[1]).sum().item() == 16
    assert living(divide(x, s, dying=[3, 4], updated=nobody)[1]).sum().item() == 16


def test_the_dead_have_no_state_and_lie_amidst_the_living(device):
    x, s = third_full(device, 9)
    after_x, after_s, path_length = divide(x, s, dying=[3])
    assert living(after_s).nonzero()[:, 1].tolist() == [0, 6, 0, 6]
    assert not after_s[:, [1, 2, 3, 4, 5, 7, 8]].any()
    middle = x[:, [0, 6]].mean(dim=1)
    assert_near([npa_envs.world_mean(after_x)], [middle], 1e-14)
    assert path_length[:, 3].tolist() == [0, 0]


def test_the_last_living_particle_does_not_die(device):
    x, s = third_full(device, 9)
    assert_same(living(divide(x, s, dying=range(9))[1]), living(s))


def test_odds_of_fates_are_a_softmax_of_the_states(device):
    rule = dividing_rule(device, (0.3, -0.2))
    s = torch.randn(1, 4, 6, dtype=torch.float64).to(device)
    logits = (s @ rule.fate.weight.T + rule.fate.bias).detach()
    odds = torch.stack((logits[..., 0], 0 * logits[..., 0], logits[..., 1])).softmax(0)
    assert_near(rule.division_probabilities(s), (odds[0], odds[2]), 1e-15)


def test_gradients_flow_from_children_to_their_parents_places(device):
    x, s = third_full(device, 7)
    life, rest = s[..., : LIFE + 1], s[..., LIFE + 1 :].clone().requires_grad_()

    def after(x, rest):
        x, s, _ = divide(x, torch.cat((life, rest), dim=-1), [3], [6])
        return x, s[..., LIFE + 1 :]

    assert torch.autograd.gradcheck(after, (x.clone().requires_grad_(), rest))


def test_life_has_the_gradient_of_the_expected_number(device):
    count = 40_000
    x = torch.zeros(1, count, 2, dtype=torch.float64, device=device)
    s = torch.zeros(1, count, 6, dtype=torch.float64, device=device)
    s[:, : count // 4, LIFE] = 1.0
    odds = torch.tensor([0.35, 0.25], dtype=torch.float64, device=device).requires_grad_()
    generator = torch.Generator().manual_seed(0)
    after = s
    for _ in range(2):
        chance = torch.rand(1, count, generator=generator, dtype=x.dtype).to(device)
        after = divided(
            Particles(x, after, x[..., 0]),
            division_probabilities=tuple(odds.expand(1, count, 2).unbind(-1)),
            updated=living(after), births=Births(chance, torch.zeros_like(x)), eps=EPS,
        ).s  # fmt: skip
    expected = count // 4 * (1.0 + odds[0] - odds[1]) ** 2
    assert abs(living(after).sum().item() / expected.item() - 1.0) < 0.05
    gradient, expected_gradient = (
        torch.autograd.grad(number, odds)[0] for number in (after[..., LIFE].sum(), expected)
    )
    assert_near([gradient / expected_gradient], [torch.ones(2)], 0.05)


def test_where_there_is_no_slot_nothing_is_learned_of_dividing(device):
    x, s = third_full(device, 9)
    s[..., LIFE] = 1.0
    s[:, 4, LIFE] = 0.0
    odds = x.new_tensor([0.6, 0.1])[:, None, None].repeat(1, 2, 9).requires_grad_()
    fates = {"division_probabilities": tuple(odds), "updated": living(s), "births": births_of(x)}
    after = divided(Particles(x, s, x[..., 0]), eps=EPS, **fates)
    (result,) = torch.autograd.grad(after.s[..., LIFE].sum(), odds)
    # All would divide; the first does, and both particles that come of it stand for it.
    expected = torch.zeros_like(result[0])
    expected[:, 0] = 2.0 / 1.5
    assert_near([result[0]], [expected], 1e-12)


def test_one_particle_fills_its_world_and_stays_within_it(device):
    rule = dividing_rule(device, (1.0, -4.0))
    x = torch.zeros(2, 60, 2, dtype=torch.float64, device=device)
    s = torch.zeros(2, 60, 6, dtype=torch.float64, device=device)
    s[:, 0, LIFE] = 1.0
    x, s = npa_envs.rollout(rule, x, s, 100, keep_every=5, generator=seeded(5, device))
    assert (x.shape, s.shape) == ((20, 2, 60, 2), (20, 2, 60, 6))
    number = living(s).sum(dim=-1)
    assert number[0].max() < 30
    assert number[-1].min() > 50
    assert torch.isfinite(x).all()
    assert torch.isfinite(s).all()
    assert ((s[..., LIFE] == 0.0) | (s[..., LIFE] == 1.0)).all()


def test_a_rule_learns_to_divide_with_the_weights_it_has(device):
    plain = lively_rule(device, state_dim=6, eps0=EPS)
    divider = with_division(plain)
    assert divider.divides
    assert_same([divider.state_dict()[name] for name in plain.state_dict()], plain.state_dict())
    odds = divider.division_probabilities(torch.randn(3, 6, dtype=torch.float64).to(device))
    assert_near(odds, [part[:1].expand(3) for part in odds], 1e-15)


def test_rules_that_divide_refuse_what_they_cannot_be(device):
    rule, (x, s) = dividing_rule(device), third_full(device)
    for call, message in (
        (lambda: npa_envs.rollout(rule, x, s, 1, box=2.0), "box must be None where part.* divide"),
        (lambda: npa_envs.rollout_species([rule], x, s, 1, counts=(64,)), "must not divide, got d"),
        (lambda: npa_envs.NPARule(static=True, divides=True), "got static=True"),
        (lambda: npa_envs.NPARule(divides=torch.zeros(2)), "divides must be True or False"),
    ):
        with pytest.raises(NPAError, match=message):
            call()
