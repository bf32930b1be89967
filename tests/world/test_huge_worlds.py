"""Worlds whose rows of perception are mapped some at a time, as if they were huge."""

import sys

import pytest
import torch

import npa_envs


@pytest.mark.parametrize("update_prob", [0.5, 1.0])
@pytest.mark.parametrize("box", [None, 1.0])
@torch.no_grad()
def test_rows_some_at_a_time_give_the_same_worlds(monkeypatch, device, box, update_prob):
    rule = npa_envs.load_rule("gecko", device=device)
    generator = torch.Generator(device).manual_seed(0)
    x = torch.rand(2, 311, 2, generator=generator, device=device) - 0.5
    s = 0.1 * torch.randn(2, 311, rule.state_dim, generator=generator, device=device)

    def grown(**options):
        draws = torch.Generator(device).manual_seed(1)
        return npa_envs.rollout(
            rule, x, s, 5, box=box, update_prob=update_prob, generator=draws, **options
        )

    # The check of each step takes the steps that are launched one by one.
    expected = grown(on_divergence="raise")
    monkeypatch.setattr(sys.modules["npa_envs.world.steps"], "ROWS_KEPT", 100)
    monkeypatch.setattr(sys.modules["npa_envs.ops.perceive"], "ROWS_TOGETHER", 96)
    for ours, theirs in zip(grown(on_divergence="raise"), expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-6)
    if device.type == "cuda":
        # A row's updates follow from that row alone.
        for ours, theirs in zip(grown(cuda_graph=False), expected, strict=True):
            assert torch.equal(ours, theirs)
