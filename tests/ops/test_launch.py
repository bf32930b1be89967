"""Launches: tensors of any strides and sizes, one after the other, are described as they are."""

import torch

from npa_envs.ops.random_numbers import draw

WORLDS = 12
SELECTIONS = (
    slice(0, 4),
    slice(None, None, 3),
    slice(0, 5),
    slice(None, None, 2),
    slice(2, 8),
    slice(1, None, 5),
    slice(0, 1),
)


def test_tensors_with_and_without_strides_take_turns(device):
    keys = torch.arange(7, 7 + WORLDS, device=device)
    episodes = torch.arange(WORLDS, dtype=torch.int32, device=device)

    def drawn(*arguments):
        return draw(*arguments, 0, "uniform", 5, torch.float32, 0)

    expected = drawn(keys, episodes, episodes)
    assert len(expected.unique()) == expected.numel()
    for chosen in SELECTIONS * 2:
        results = drawn(keys[chosen], episodes[chosen], episodes[chosen].contiguous())
        assert torch.equal(results, expected[chosen])
