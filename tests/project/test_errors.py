"""Errors name what came in a few words, never a whole tensor, and suggest the nearest name."""

import numpy as np
import pytest
import torch

from npa_envs.errors import shown, suggest


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (torch.zeros(64, 3), "a float32 tensor of shape (64, 3)"),
        (np.zeros((3, 4)), "a float64 array of shape (3, 4)"),
        (torch.zeros(3, 2).tolist(), "3 x 2 numbers"),
        ([torch.zeros(9), 1], "[a float32 tensor of shape (9,), 1]"),
        (torch.zeros(2, device="meta"), "a float32 tensor of shape (2,)"),
        (torch.tensor([1.0, 2.0]), "tensor([1., 2.])"),
        ((0.5, 0.5), "(0.5, 0.5)"),
        (torch.Tensor, "<class 'torch.Tensor'>"),
    ],
)
def test_of_many_numbers_an_error_shows_the_shape(value, text):
    assert shown(value) == text


@pytest.mark.parametrize(
    ("name", "known", "nearest"),
    [
        ("morphogenesis", ["co_morphogenesis2d", "morphogenesis3d", "morphogenesis2d"], 2),
        ("morph", ["co_morphogenesis2d", "morphogenesis3d", "morphogenesis2d"], 2),
        ("GEKO", ["heart", "gecko"], 1),
        ("num_particles", ["particle_count", "position_noise", "species_count"], 0),
        ("target", ["stretch", "state_dim"], None),
        ("lizard", ["gecko", "heart"], None),
        (None, ["gecko"], None),
    ],
)
def test_an_unknown_name_is_answered_by_the_nearest_known_one(name, known, nearest):
    hint = "" if nearest is None else f"did you mean {known[nearest]!r}? "
    assert suggest(name, known) == f"{hint}known: {', '.join(sorted(known))}"


def test_an_error_lists_at_most_forty_known_names():
    text = suggest("a", [f"name{number:03}" for number in range(100)])
    assert text.endswith("name039 and 60 more")
