"""Means over worlds: exact values, independence of the batch, gradients."""

import pytest
import torch

from npa_envs.ops import world_mean

ERRORS = {torch.float32: 3e-7, torch.float64: 2e-15}
"""Largest difference from the mean in float64 of numbers of size about 3: one rounding (worst seen
1.2e-7 and 2.2e-16)."""


def numbers(*shape, dtype, device):
    generator = torch.Generator().manual_seed(4)
    return torch.randn(shape, generator=generator, dtype=torch.float64).to(device, dtype)


@pytest.mark.parametrize("count", [1, 2, 7, 333, 4097])
@pytest.mark.parametrize("width", [1, 2, 5])
def test_the_mean_is_right_and_the_same_in_every_batch(count, width, dtype, device):
    values = numbers(7, count, width, dtype=dtype, device=device)
    means = world_mean(values)
    assert means.shape == (7, width)
    assert float((means.double() - values.double().mean(dim=1)).abs().max()) <= ERRORS[dtype]
    for world in range(7):
        assert torch.equal(world_mean(values[world : world + 1]), means[world : world + 1])
    assert torch.equal(world_mean(values[2:5]), means[2:5])
    assert torch.equal(world_mean(values.mT.contiguous().mT), means)


def test_float32_values_are_added_in_float64(device):
    values = torch.ones(2, 10_001, 1, device=device)
    values[:, 0] = 2.0**26
    assert world_mean(values).tolist() == [[torch.tensor((2.0**26 + 1e4) / 10_001).item()]] * 2


def test_gradients_are_right_to_the_second_order(device):
    values = numbers(2, 5, 3, dtype=torch.float64, device=device).requires_grad_()
    assert torch.autograd.gradcheck(world_mean, values)
    assert torch.autograd.gradgradcheck(lambda v: world_mean(v) ** 2, values)
