"""Marking whether all numbers are finite."""

import math

import pytest
import torch

from npa_envs.errors import NPAError
from npa_envs.sph.finite import mark_finite


def marked(values, before=0):
    finite = torch.full((1,), before, dtype=torch.uint8, device=values.device)
    mark_finite(values, finite)
    return finite.item()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=("float32", "float64"))
@pytest.mark.parametrize("count", [1, 7, 8, 9, 333])
def test_one_value_that_is_not_finite_is_found_wherever_it_lies(count, dtype, device):
    values = torch.linspace(-3.0, 3.0, count).to(device, dtype)
    values[0] = torch.finfo(dtype).max
    assert marked(values) == 1
    for place in range(count):
        for wild in (math.nan, math.inf, -math.inf):
            changed = values.clone()
            changed[place] = wild
            assert marked(changed, before=1) == 0


def test_no_values_are_finite(device):
    assert marked(torch.zeros(0, 3, device=device)) == 1


def test_tensors_that_do_not_fit_are_clear_errors():
    flag = torch.ones(1, dtype=torch.uint8)
    with pytest.raises(NPAError, match="values must be contiguous, float32 or float64"):
        mark_finite(torch.zeros(3, 2).mT, flag)
    with pytest.raises(NPAError, match=r"got torch\.int64"):
        mark_finite(torch.zeros(3, dtype=torch.int64), flag)
    with pytest.raises(NPAError, match=r"finite must be torch.uint8 of shape \(1,\)"):
        mark_finite(torch.zeros(3), torch.ones(1))
