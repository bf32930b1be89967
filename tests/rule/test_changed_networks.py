"""Rules whose network was changed by hand: worlds follow what the module says."""

import contextlib
import functools

import pytest
import torch
from support.worlds import lively_rule, random_world

import npa_envs


def world(device):
    return random_world(1, 50, 2, 5, dtype=torch.float64, device=device)


def nothing(z):
    return z.new_zeros(*z.shape[:-1], 12)


@pytest.mark.parametrize("equivariant", [False, True])
@pytest.mark.parametrize("gradients", [False, True])
def test_a_layer_whose_forward_was_replaced_is_used_as_it_is(equivariant, gradients, device):
    rule, (x, s) = lively_rule(device, equivariant=equivariant), world(device)
    run = functools.partial(npa_envs.rollout, rule, x, s, 2, update_prob=1.0)
    with torch.set_grad_enabled(gradients):
        _, moved = run()
        rule.hidden.forward = nothing
        assert not rule.has_network()
        assert torch.equal(run()[1], s)
        del rule.hidden.forward
        assert rule.has_network()
        assert torch.equal(run()[1], moved)
    assert float((moved - s).abs().max().detach()) > 1e-3


@pytest.mark.parametrize("equivariant", [False, True])
def test_a_hidden_layer_without_biases_is_as_one_whose_biases_are_zero(equivariant, device):
    rule, (x, s) = lively_rule(device, equivariant=equivariant), world(device)
    torch.nn.init.zeros_(rule.hidden.bias)
    _, expected = npa_envs.rollout(rule, x, s, 2, update_prob=1.0)
    rule.hidden.bias = None
    assert not rule.has_network()
    _, after = npa_envs.rollout(rule, x, s, 2, update_prob=1.0)
    torch.testing.assert_close(after, expected, rtol=1e-12, atol=1e-13)


class Overridden(npa_envs.NPARule):
    def forward(self, perception):
        return 2.0 * super().forward(perception)


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


class Twofold(torch.nn.Module):
    def forward(self, weight):
        return 2.0 * weight


def remade(rule, cls):
    changed = cls(**rule.hyper_parameters()).to(rule.hidden.weight)
    changed.load_state_dict(rule.state_dict())
    return changed


def doubled(module, inputs, output):
    return 2.0 * output


def parametrised(layer):
    torch.nn.utils.parametrize.register_parametrization(layer, "weight", Twofold())


CHANGED = {
    "forward": lambda rule: remade(rule, Overridden),
    "call": lambda rule: remade(rule, Called),
    "a hook": lambda rule: rule.register_forward_hook(doubled) and None,
    "a hook of the output": lambda rule: rule.output.register_forward_hook(doubled) and None,
    "a parametrised output": lambda rule: parametrised(rule.output),
    "a hook of the hidden layer": lambda rule: rule.hidden.register_forward_hook(doubled) and None,
    "a parametrised hidden layer": lambda rule: parametrised(rule.hidden),
}
"""Rules that say twice what they said, or what twice the hidden layer makes of it."""


def assert_changed(how, s, once, twice):
    if "hidden" in how:
        assert float((twice - once).detach().abs().max()) > 1e-3
    else:
        torch.testing.assert_close(twice - s, 2.0 * (once - s), rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("gradients", [False, True])
@pytest.mark.parametrize("how", CHANGED)
def test_a_changed_network_is_run_as_the_module_that_it_is(how, gradients, device):
    rule, (x, s) = lively_rule(device), world(device)
    with torch.set_grad_enabled(gradients):
        _, once = npa_envs.step(rule, x, s, update_prob=1.0)
        changed = CHANGED[how](rule) or rule
        _, twice = npa_envs.step(changed, x, s, update_prob=1.0)
    assert not changed.is_plain()
    assert_changed(how, s, once, twice)


@pytest.mark.parametrize("name", ["", "hidden", "output"])
def test_hooks_of_all_modules_are_called(name, device):
    rule, (x, s) = lively_rule(device), world(device)
    module, calls, registered = getattr(rule, name) if name else rule, [], []
    _, once = npa_envs.step(rule, x, s, update_prob=1.0)
    hooks = {
        "forward_hook": lambda called, inputs, output: 2.0 * output if called is module else None,
        "forward_pre_hook": lambda called, inputs: calls.append(called),
        "full_backward_hook": lambda called, *bars: calls.append((called, "back")),
    }
    with contextlib.ExitStack() as stack:
        for hook_name, hook in hooks.items():
            register = getattr(torch.nn.modules.module, f"register_module_{hook_name}")
            # One of them alone is enough.
            with register(hook):
                assert not rule.is_plain()
            registered.append(functools.partial(register, hook))
        for register in registered:
            stack.enter_context(register())
        _, twice = npa_envs.step(rule, x, s.requires_grad_(), update_prob=1.0)
        twice.sum().backward()
    assert rule.is_plain()
    assert {module, (module, "back")} <= set(calls)
    assert_changed(name, s, once, twice)


def test_a_subclass_that_changes_no_step_is_plain():
    class Named(npa_envs.NPARule):
        name = "gecko"

        def colour(self, states):
            return states[..., :3]

    assert Named(2, 4, 8).is_plain()
    for cls in (Called, Weighted):
        assert not cls(2, 4, 8, equivariant=True).has_network()


def reversed_fates(rule):
    division_probabilities = rule.division_probabilities
    rule.division_probabilities = lambda states: division_probabilities(states)[::-1]


NOT_PLAIN = {
    "weight": lambda rule: remade(rule, Weighted),
    "fates": lambda rule: remade(rule, Fated),
    "an output with biases": lambda rule: setattr(rule, "output", torch.nn.Linear(8, 6)),
    "replaced fates": reversed_fates,
    "a hook of the fates": lambda rule: rule.fate.register_forward_hook(doubled) and None,
    "a wrapped fate": lambda rule: setattr(rule, "fate", torch.nn.Sequential(rule.fate)),
}


@pytest.mark.parametrize("how", NOT_PLAIN)
def test_what_changes_a_step_or_a_fate_is_not_plain(how):
    rule = npa_envs.NPARule(2, 4, 8, divides=True)
    assert rule.is_plain()
    assert not (NOT_PLAIN[how](rule) or rule).is_plain()
