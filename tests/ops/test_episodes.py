"""Rewards and endings of worlds, against the same said in torch."""

import itertools

import pytest
import torch

from npa_envs.ops.rewards_and_ends import (
    DIVERGED,
    NOT_FINITE,
    SUCCESS,
    TIME_LIMIT,
    EpisodeRules,
    EpisodeUpdate,
)

B, PARTS = 64, 3


def worlds(device):
    """Return random arguments of `EpisodeUpdate`: diverged, successful and late worlds."""
    generator = torch.Generator().manual_seed(0)

    def draw(*shape):
        return torch.randn(*shape, generator=generator).to(device)

    parts = draw(PARTS, B)
    parts[1, 3], parts[0, 4] = torch.nan, torch.inf
    numbers = draw(2 + 2 * PARTS, B)
    numbers[1, 5] = torch.nan
    return {
        "parts": parts,
        "broken": (draw(B) > 1.0).byte(),
        "diverged": (draw(B) > 0.5).byte(),
        "first_loss": draw(B),
        "success_loss": torch.where(draw(B) > 0.0, draw(B), -torch.inf),
        "elapsed": torch.arange(B, dtype=torch.int32, device=device) % 12,
        "numbers": numbers,
        "flags": torch.ones(4, B, dtype=torch.bool, device=device),
    }


def expected(rules, arguments):
    """Return `numbers`, `flags` and `endings` that `EpisodeUpdate` should write."""
    parts, diverged = arguments["parts"], arguments["diverged"].bool()
    penalised = diverged & (rules.on_divergence != "ignore")
    ended = diverged & (rules.on_divergence == "terminate")
    loss = parts[0] + parts[1] + parts[2]
    loss = torch.where(penalised, torch.maximum(loss, arguments["first_loss"]), loss)
    step = arguments["elapsed"] + 1
    success = (loss <= arguments["success_loss"]) & ~penalised
    late = step >= rules.last_step if rules.last_step else torch.zeros_like(diverged)
    improvement = arguments["numbers"][1] - loss
    reward = improvement
    if rules.rewarded_step is not None:
        reward = torch.where(success | ended | (step == rules.rewarded_step), -loss, 0.0)
    fallen = arguments["numbers"][2 : 2 + PARTS] - parts
    flags = torch.stack((success | ended, late, success, diverged))
    unfit = ~improvement.isfinite() | (arguments["broken"].bool() & ~penalised)
    bits = SUCCESS * success.int() + DIVERGED * diverged.int() + TIME_LIMIT * late.int()
    return torch.cat((reward[None], loss[None], parts, fallen)), flags, bits + NOT_FINITE * unfit


@pytest.mark.device
@pytest.mark.parametrize("happened", [True, False])
@pytest.mark.parametrize(
    "rules",
    [
        EpisodeRules(last, paid, way)
        for last, paid, way in itertools.product(
            (None, 8), (None, 8), ("ignore", "terminate", "reset", "raise")
        )
    ],
)
def test_rewards_and_endings_equal_those_by_torch(rules, happened, device):
    arguments = worlds(device)
    before = {name: value.clone() for name, value in arguments.items()}
    endings = torch.zeros(B + 1, dtype=torch.uint8, device=device)
    update = EpisodeUpdate(
        rules,
        enabled=torch.full((1,), happened, dtype=torch.uint8, device=device),
        ending_bits=endings,
        **{name: arguments[name] for name in arguments.keys() - {"parts", "broken"}},
    )
    update(arguments["parts"], arguments["broken"])
    if happened:
        numbers, flags, bits = expected(rules, before)
        assert torch.equal(arguments["elapsed"], before["elapsed"] + 1)
    else:
        numbers, flags, bits = before["numbers"], before["flags"], torch.zeros_like(endings[:-1])
        assert torch.equal(arguments["elapsed"], before["elapsed"])
    assert torch.equal(arguments["numbers"].nan_to_num(7.5), numbers.nan_to_num(7.5))
    assert torch.equal(arguments["flags"], flags)
    assert torch.equal(endings[:-1], bits.byte())
    assert bool(endings[-1]) == happened
