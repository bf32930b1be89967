"""Copying numbers while noting whether all of them are finite."""

import math
import pickle

import pytest
import torch

from npa_envs.errors import NPAError
from npa_envs.sph.finite import CheckedCopy


def copier(shape, dtype, device):
    into = torch.full(shape, -7.0, dtype=dtype, device=device)
    finite = torch.ones(1, dtype=torch.uint8, device=device)
    return into, finite, CheckedCopy(into, finite)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=("float32", "float64"))
@pytest.mark.parametrize("count", [1, 7, 8, 9, 333])
def test_one_value_that_is_not_finite_is_found_wherever_it_lies(count, dtype, device):
    into, finite, copy = copier((count,), dtype, device)
    values = torch.linspace(-3.0, 3.0, count).to(device, dtype)
    values[0] = torch.finfo(dtype).max
    copy(values)
    assert finite.item() == 1
    assert torch.equal(into, values)
    for place in range(count):
        for wild in (math.nan, math.inf, -math.inf):
            changed = values.clone()
            changed[place] = wild
            copy(changed)
            assert finite.item() == 0
            assert torch.equal(into.nan_to_num(0.5), changed.nan_to_num(0.5))
            copy(values)
            assert finite.item() == 0
            finite.fill_(1)


@pytest.mark.parametrize("how", ["strided", "misaligned", "other dtype", "on the host"])
def test_values_may_lie_anywhere(how, device):
    into, finite, copy = copier((3, 4), torch.float32, device)
    wanted = torch.arange(12.0, device=device).view(3, 4)
    values = {
        "strided": wanted.mT.contiguous().mT,
        "misaligned": torch.cat((wanted.new_zeros(1), wanted.view(-1)))[1:].view(3, 4),
        "other dtype": wanted.double(),
        "on the host": wanted.cpu(),
    }[how]
    for _ in range(2):
        into.zero_()
        copy(values)
        assert torch.equal(into, wanted)
        assert finite.item() == 1
    values[2, 3] = math.nan
    copy(values)
    assert finite.item() == 0


def test_it_can_be_pickled_after_use():
    *_, copy = copier((5,), torch.float32, torch.device("cpu"))
    copy(torch.ones(5))
    again = pickle.loads(pickle.dumps(copy))
    again(torch.full((5,), 2.0))
    assert torch.equal(again._into, torch.full((5,), 2.0))


def test_tensors_that_do_not_fit_are_clear_errors():
    flag = torch.ones(1, dtype=torch.uint8)
    with pytest.raises(NPAError, match="into must be contiguous, float32 or float64"):
        CheckedCopy(torch.zeros(3, 2).mT, flag)
    with pytest.raises(NPAError, match=r"got torch\.int64"):
        CheckedCopy(torch.zeros(3, dtype=torch.int64), flag)
    with pytest.raises(NPAError, match="of 1 to"):
        CheckedCopy(torch.zeros(0, 3), flag)
    with pytest.raises(NPAError, match=r"finite must be torch.uint8 of shape \(1,\)"):
        CheckedCopy(torch.zeros(3), torch.ones(1))
    with pytest.raises(NPAError, match=r"values must have shape \(3,\)"):
        CheckedCopy(torch.zeros(3), flag)(torch.zeros(2))
