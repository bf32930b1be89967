"""Rules whose network was changed by hand: worlds follow what the module says."""

import pytest
import torch
from worlds import lively_rule, random_world

import npa_envs


def nothing(z):
    return z.new_zeros(*z.shape[:-1], 12)


@pytest.mark.parametrize("equivariant", [False, True])
@pytest.mark.parametrize("gradients", [False, True])
def test_a_layer_whose_forward_was_replaced_is_used_as_it_is(equivariant, gradients, device):
    rule = lively_rule(device, equivariant=equivariant)
    x, s = random_world(1, 50, 2, 5, dtype=torch.float64, device=device)
    with torch.set_grad_enabled(gradients):
        _, moved = npa_envs.rollout(rule, x, s, 2, update_prob=1.0)
        rule.hidden.forward = nothing
        assert not rule.has_network()
        _, still = npa_envs.rollout(rule, x, s, 2, update_prob=1.0)
        del rule.hidden.forward
        assert rule.has_network()
        _, again = npa_envs.rollout(rule, x, s, 2, update_prob=1.0)
    assert float((moved - s).abs().max().detach()) > 1e-3
    assert torch.equal(still, s)
    assert torch.equal(again, moved)


@pytest.mark.parametrize("equivariant", [False, True])
def test_a_hidden_layer_without_biases_is_as_one_whose_biases_are_zero(equivariant, device):
    rule = lively_rule(device, equivariant=equivariant)
    x, s = random_world(1, 50, 2, 5, dtype=torch.float64, device=device)
    torch.nn.init.zeros_(rule.hidden.bias)
    _, expected = npa_envs.rollout(rule, x, s, 2, update_prob=1.0)
    rule.hidden.bias = None
    assert not rule.has_network()
    _, found = npa_envs.rollout(rule, x, s, 2, update_prob=1.0)
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-13)


class Called(npa_envs.NPARule):
    def __call__(self, perception):
        return 2.0 * super().__call__(perception)


class Weighted(npa_envs.NPARule):
    @property
    def update_weight(self):
        return 2.0 * super().update_weight


class Fated(npa_envs.NPARule):
    def division_probabilities(self, states):
        divide, die = super().division_probabilities(states)
        return 0.0 * divide, 0.0 * die + 1.0


class Halved(torch.nn.Module):
    def forward(self, weight):
        return 0.5 * weight


def doubled_output(rule, module):
    return lambda own, inputs, output: 2.0 * output if own is module else None


def test_hooks_of_all_modules_are_called(device):
    rule = lively_rule(device)
    x, s = random_world(1, 50, 2, 5, dtype=torch.float64, device=device)
    _, once = npa_envs.step(rule, x, s, update_prob=1.0)
    hooks = torch.nn.modules.module
    for module in (rule, rule.hidden, rule.output):
        seen = []
        handles = [
            hooks.register_module_forward_hook(doubled_output(rule, module)),
            hooks.register_module_forward_pre_hook(lambda own, inputs: seen.append(own)),  # noqa: B023
        ]
        try:
            assert not rule.is_plain()
            _, twice = npa_envs.step(rule, x, s, update_prob=1.0)
        finally:
            for handle in handles:
                handle.remove()
        assert rule.is_plain()
        assert module in seen
        if module is not rule.hidden:
            torch.testing.assert_close(twice - s, 2.0 * (once - s), rtol=1e-12, atol=1e-13)
        else:
            assert float((twice - once).detach().abs().max()) > 1e-3


def test_backward_hooks_of_all_modules_are_called(device):
    rule = lively_rule(device)
    x, s = random_world(1, 50, 2, 5, dtype=torch.float64, device=device)
    seen = []
    handle = torch.nn.modules.module.register_module_full_backward_hook(
        lambda own, bars, output_bars: seen.append(own)
    )
    try:
        assert not rule.is_plain()
        npa_envs.step(rule, x, s.requires_grad_())[1].sum().backward()
    finally:
        handle.remove()
    assert {rule, rule.hidden, rule.output} <= set(seen)


def test_a_subclass_that_overrides_call_is_called(device):
    plain = lively_rule(device)
    rule = Called(**plain.hyper_parameters()).to(device, torch.float64)
    rule.load_state_dict(plain.state_dict())
    x, s = random_world(1, 50, 2, 5, dtype=torch.float64, device=device)
    _, once = npa_envs.step(plain, x, s, update_prob=1.0)
    for gradients in (False, True):
        with torch.set_grad_enabled(gradients):
            _, twice = npa_envs.step(rule, x, s, update_prob=1.0)
        torch.testing.assert_close(twice - s, 2.0 * (once - s), rtol=1e-12, atol=1e-13)
    assert not rule.is_plain()


@pytest.mark.parametrize("kind", [Called, Weighted])
def test_a_subclass_that_changes_what_a_step_runs_is_not_plain(kind):
    assert not kind(2, 4, 8).is_plain()
    assert not kind(2, 4, 8, equivariant=True).has_network()


def test_a_subclass_that_changes_nothing_of_a_step_is_plain():
    class Named(npa_envs.NPARule):
        name = "gecko"

        def colour(self, states):
            return states[..., :3]

    assert Named(2, 4, 8).is_plain()


@pytest.mark.parametrize("how", ["override", "attribute", "hook", "layer"])
def test_fates_of_their_own_make_a_rule_that_is_not_plain(how):
    rule = (Fated if how == "override" else npa_envs.NPARule)(2, 4, 8, divides=True)
    division_probabilities = npa_envs.NPARule(2, 4, 8, divides=True).division_probabilities
    assert npa_envs.NPARule(2, 4, 8, divides=True).is_plain()
    if how == "attribute":
        rule.division_probabilities = lambda states: division_probabilities(states)[::-1]
    elif how == "hook":
        rule.fate.register_forward_hook(lambda own, inputs, output: -output)
    elif how == "layer":
        rule.fate = torch.nn.Sequential(rule.fate)
    assert not rule.is_plain()


@pytest.mark.parametrize("layer", ["hidden", "output"])
def test_a_parametrised_layer_is_run_as_the_module_that_it_is(layer, device):
    rule = lively_rule(device)
    x, s = random_world(1, 50, 2, 5, dtype=torch.float64, device=device)
    _, once = npa_envs.step(rule, x, s, update_prob=1.0)
    torch.nn.utils.parametrize.register_parametrization(getattr(rule, layer), "weight", Halved())
    assert not rule.is_plain()
    _, halved = npa_envs.step(rule, x, s, update_prob=1.0)
    if layer == "output":
        torch.testing.assert_close(halved - s, 0.5 * (once - s), rtol=1e-12, atol=1e-13)
    else:
        assert float((halved - once).detach().abs().max()) > 1e-3
