"""What holds of every legal world: order, place, scale and company of particles do not matter.

The quick run draws the same few examples each time; the thorough one (marked slow) draws new ones
and prints what reproduces a failure.
"""

import functools

import torch
from support.legal_worlds import (
    allowances,
    clear_of_threshold,
    every,
    perception_allowance,
    within,
    worlds,
)
from support.worlds import assert_same

import npa_envs

double_worlds = functools.partial(worlds, dtypes=(torch.float64,))

GRADIENT_BOUND = 1e-12
"""Largest error of float64 gradients over their largest number, or over 1 (worst seen 3e-15)."""
ROLLOUT_BOUND = 1e-10
"""Largest error of float64 worlds after a few steps (worst seen 5e-13)."""


def perceive(w, x=None, s=None, **options):
    x, s = w.x if x is None else x, w.s if s is None else s
    return npa_envs.perceive(x, s, w.eps, w.eps0, w.box, **options)


def fields_of(w):
    return npa_envs.perception_fields(w.x, w.s, w.eps, w.box)


def gradients(w, cotangent):
    x, s = w.x.clone().requires_grad_(), w.s.clone().requires_grad_()
    z = perceive(w, x, s, detach_positions=False)
    return torch.autograd.grad(z, (x, s), cotangent)


def alike(found, expected, bound):
    for value, answer in zip(found, expected, strict=True):
        within(value, answer, bound * float(answer.abs().max().clamp(min=1.0)))


def rule_of(w, seed=0, **options):
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(w.seed + seed)
        rule = npa_envs.NPARule(w.shape[2], w.s.shape[2], 8, eps0=w.eps0, **options).to(w.x)
    with torch.no_grad():
        rule.output.weight *= 4.0
    return rule


def run(w, rule, steps=3, **options):
    with torch.no_grad():
        return npa_envs.rollout(rule, w.x, w.s, steps, eps=w.eps, box=w.box, **options)


def streams(w):
    seeds = [w.seed + 7 * k for k in range(w.shape[0])]
    return npa_envs.WorldRandom(seeds, device=w.x.device)


def assert_near(w, found, expected):
    """Compare positions, by the shortest way in a box, and states after a few steps."""
    away = found[0] - expected[0]
    if w.box is not None:
        sides = torch.tensor(w.box).to(away)
        away = away - sides * (away / sides).round()
    within(away, torch.zeros_like(away), ROLLOUT_BOUND * w.eps)
    alike(found[1:], expected[1:], ROLLOUT_BOUND)


def assert_moved(w, moved, order=slice(None)):
    """Compare perception, and its gradients in float64, with that of moved or reordered worlds."""
    z = perceive(w)
    within(perceive(moved), z[:, order], perception_allowance(w)[:, order])
    if z.dtype == torch.float64:
        cotangent = w.normal(*z.shape)
        expected = [bar[:, order] for bar in gradients(w, cotangent)]
        alike(gradients(moved, cotangent[:, order]), expected, GRADIENT_BOUND)


@every(worlds)
def test_fields_perception_and_gradients_follow_the_order_of_particles(w):
    clear_of_threshold(w)
    order = w.permutation()
    moved = w.ordered(order)
    for value, answer, allowed in zip(fields_of(moved), fields_of(w), allowances(w), strict=True):
        within(value, answer[:, order], allowed[:, order])
    assert_moved(w, moved, order)


@every(worlds)
def test_perception_and_gradients_do_not_depend_on_the_place(w):
    clear_of_threshold(w)
    assert_moved(w, w.moved())


@every(worlds)
def test_fields_scale_with_lengths_bit_for_bit(w):
    """ρ as 1 / length^D, ∇s as 1 / length, ∇ρ as 1 / length^(D+1); s̄ and M not at all."""
    dim = w.shape[2]
    powers = (-dim, 0, -1, 0, -1, -1 - dim)
    for value, answer, power in zip(fields_of(w.scaled()), fields_of(w), powers, strict=True):
        assert torch.equal(value, answer * w.factor**power)
    # Perceived at a larger radius than it was trained at, a larger world looks the same.
    assert torch.equal(perceive(w.scaled()), perceive(w))


@every(worlds)
def test_a_batch_perceives_as_its_worlds_do(w):
    z = perceive(w)
    cotangent = w.normal(*z.shape)
    together = z, *fields_of(w), *gradients(w, cotangent)
    for k in range(w.shape[0]):
        alone = w.alone(k)
        found = perceive(alone), *fields_of(alone), *gradients(alone, cotangent[k : k + 1])
        assert_same([value[0] for value in found], [value[k] for value in together])


@every(double_worlds)
def test_a_rollout_follows_the_order_of_particles(w):
    clear_of_threshold(w)
    rule, order = rule_of(w), w.permutation()
    expected = [value[:, order] for value in run(w, rule, 1, update_prob=1.0)]
    assert_near(w, run(w.ordered(order), rule, 1, update_prob=1.0), expected)


@every(double_worlds)
def test_a_rollout_does_not_depend_on_the_place(w):
    clear_of_threshold(w)
    rule, options = rule_of(w), {"steps": 1, "position_noise": 0.1 * w.eps}
    x, s = run(w, rule, generator=streams(w), **options)
    moved = run(w.moved(), rule, generator=streams(w), **options)
    assert_near(w, moved, (x + w.shift().to(x), s))


@every(worlds)
def test_a_rollout_does_not_depend_on_the_unit_of_length(w):
    rule = rule_of(w, static=w.seed % 3 == 0)
    results = []
    for world in (w, w.scaled()):
        results.append(run(world, rule, generator=streams(w), position_noise=0.1 * world.eps))
    (x, s), (scaled_x, scaled_s) = results
    assert_same((scaled_x, scaled_s), (x * w.factor, s))


@every(double_worlds)
def test_a_world_goes_in_a_batch_as_it_goes_alone(w):
    """Up to rounding: a matrix product may round rows differently where there are more of them."""
    clear_of_threshold(w)
    rule = rule_of(w, static=w.seed % 3 == 0)
    together = run(w, rule, 1, generator=streams(w))
    for k in range(w.shape[0]):
        alone = run(w.alone(k), rule, 1, generator=streams(w).take(slice(k, k + 1)))
        assert_near(w, alone, [value[k : k + 1] for value in together])


@every(worlds)
def test_species_have_a_share_of_the_fields_in_any_order_and_company(w):
    counts, fields, allowed = w.split(2), fields_of(w), allowances(w)
    shares = npa_envs.species_fields(w.x, counts, eps=w.eps, box=w.box)
    within(shares.rho.sum(2), fields.rho, 2.0 * allowed.rho)
    within(shares.drho.sum(2), fields.drho, 2.0 * allowed.drho + 1e-30)
    ends = torch.arange(w.shape[1], device=w.x.device).split(counts)
    order = torch.cat([part.flip(0) for part in ends])
    turned = npa_envs.species_fields(w.x[:, order], counts, eps=w.eps, box=w.box)
    within(turned.rho, shares.rho[:, order], allowed.rho[:, order, None])
    within(turned.drho, shares.drho[:, order], allowed.drho[:, order, None] + 1e-30)
    for k in range(w.shape[0]):
        alone = npa_envs.species_fields(w.x[k : k + 1], counts, eps=w.eps, box=w.box)
        assert_same([value[0] for value in alone], [value[k] for value in shares])


@every(double_worlds)
def test_species_go_their_way_in_any_order_and_unit_of_length(w):
    clear_of_threshold(w)
    counts = w.split(2)
    rules = [rule_of(w, number) for number in range(len(counts))]

    def go(world, x, s):
        with torch.no_grad():
            return npa_envs.rollout_species(
                rules, x, s, 1, counts=counts, eps=world.eps, box=world.box, update_prob=1.0
            )

    x, s = go(w, w.x, w.s)
    larger = w.scaled()
    assert_same(go(larger, larger.x, larger.s), (x * w.factor, s))
    ends = torch.arange(w.shape[1], device=w.x.device).split(counts)
    order = torch.cat([part.flip(0) for part in ends])
    assert_near(w, go(w, w.x[:, order], w.s[:, order]), (x[:, order], s[:, order]))
