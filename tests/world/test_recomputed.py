"""Recomputed steps: gradients are those of stored ones, or what changed meanwhile is refused."""

import pytest
import torch
from support.worlds import assert_same, lively_rule, random_world

import npa_envs

RECOMPUTED = ("recompute", "minimal")


class Own(npa_envs.NPARule):
    """A rule with a network of its own."""

    gain = 1.0

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.factor = 1.0

    def forward(self, perception):
        return self.factor * super().forward(perception)


def world(device):
    return random_world(1, 40, 2, 5, dtype=torch.float64, device=device)


def rule_of(name, device):
    plain = lively_rule(device, divides=name == "dividing", equivariant=name == "equivariant")
    if name != "own":
        return plain
    rule = Own(**plain.hyper_parameters()).to(device, torch.float64)
    rule.load_state_dict(plain.state_dict())
    return rule


def replace(value):
    value.data = value.data * 3.0


def replace_parameter(rule):
    rule.output.weight = torch.nn.Parameter(3.0 * rule.output.weight.detach())


CHANGES = {
    "weight.data": lambda rule: replace(rule.output.weight),
    "hidden.weight.data": lambda rule: replace(rule.hidden.weight),
    "weight in place": lambda rule: rule.output.weight.detach().mul_(3.0),
    "parameter": replace_parameter,
    "eps0": lambda rule: setattr(rule, "eps0", 0.3),
    "alpha": lambda rule: setattr(rule, "alpha", 0.1),
    "dead_zone": lambda rule: setattr(rule, "dead_zone", 0.2),
    "moment_correction": lambda rule: setattr(rule, "moment_correction", False),
}


def gradients(rule, x, s, memory, change):
    """Gradients by states and weights of a rollout, with a change before its backward pass."""
    s = s.clone().requires_grad_()
    weights = [s, *(p for p in rule.parameters())]
    generator = torch.Generator(x.device).manual_seed(0)
    new_x, new_s = npa_envs.rollout(rule, x, s, 4, memory=memory, generator=generator)
    change(rule)
    value = new_x.sum() + new_s.square().sum()
    return torch.autograd.grad(value, weights, allow_unused=True, materialize_grads=True)


@pytest.mark.parametrize("memory", RECOMPUTED)
@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("name", ["plain", "equivariant", "own", "dividing"])
def test_what_changes_before_the_backward_pass_is_refused_or_changes_nothing(
    name, change, memory, device
):
    x, s = world(device)
    expected = gradients(rule_of(name, device), x, s, "store", lambda rule: None)
    try:
        results = gradients(rule_of(name, device), x, s, memory, CHANGES[change])
    except (npa_envs.NPAError, RuntimeError) as error:
        message = str(error)
    else:
        for value, answer in zip(results, expected, strict=True):
            torch.testing.assert_close(value, answer, rtol=1e-10, atol=1e-12)
        return
    if "modified by an inplace operation" in message:
        # Torch itself sees it, in the last step, which is stored.
        assert change == "weight in place"
        return
    assert "must not change between a rollout that recomputes steps" in message
    changed = "weight" if change == "parameter" else change.removesuffix(".data")
    assert changed.split(" ")[0].split(".")[-1] in message
    assert name != "plain" or "weight" not in changed


@pytest.mark.parametrize("memory", RECOMPUTED)
@pytest.mark.parametrize("name", ["x", "s"])
def test_worlds_that_are_written_to_meanwhile_are_refused(name, memory, device):
    x, s = world(device)
    rule = rule_of("plain", device)
    new_x, new_s = npa_envs.rollout(rule, x, s, 4, memory=memory)
    (x if name == "x" else s).mul_(2.0)
    with pytest.raises(npa_envs.NPAError, match=f"^{name} must not change"):
        (new_x.sum() + new_s.sum()).backward()


@pytest.mark.parametrize("memory", RECOMPUTED)
def test_a_constant_of_an_own_network_that_changes_is_refused(memory, device):
    x, s = world(device)
    with pytest.raises(npa_envs.NPAError, match=r"factor of the rule must not change"):
        gradients(rule_of("own", device), x, s, memory, lambda rule: setattr(rule, "factor", 2.0))
    with pytest.raises(npa_envs.NPAError, match=r"training of the rule must not change"):
        gradients(rule_of("own", device), x, s, memory, lambda rule: rule.eval())


def test_a_retained_graph_gives_the_same_gradients_again(device):
    x, s = world(device)
    rule = rule_of("own", device)
    s.requires_grad_()
    value = npa_envs.rollout(rule, x, s, 7, memory="recompute")[1].square().sum()
    first = torch.autograd.grad(value, s, retain_graph=True)
    assert_same(torch.autograd.grad(value, s), first)


@pytest.mark.parametrize("memory", RECOMPUTED)
def test_species_refuse_it_too(memory, device):
    x, s = world(device)
    rules = [rule_of("plain", device), rule_of("own", device)]
    for change, name in (
        (lambda: setattr(rules[0], "alpha", 0.1), "alpha of rule 0"),
        (lambda: replace(rules[1].output.weight), "output.weight of rule 1"),
    ):
        _, new_s = npa_envs.rollout_species(rules, x, s, 4, counts=(25, 15), memory=memory)
        change()
        with pytest.raises(npa_envs.NPAError, match=f"^{name} must not change"):
            new_s.sum().backward()
