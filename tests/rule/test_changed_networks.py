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
