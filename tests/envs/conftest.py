"""Fixtures of the tests of environments."""

import pytest
import torch

import npa_envs


@pytest.fixture(autouse=True)
def _no_screen(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


@pytest.fixture(scope="session")
def coded(tmp_path_factory):
    """Keywords of worlds with a rule of three pictures that has learned nothing."""
    torch.manual_seed(0)
    codes = {"code_dim": 3, "code_names": ("heart", "ring", "letter-a")}
    rule = npa_envs.NPARule(state_dim=8, hidden_dim=8, eps0=0.3, **codes).requires_grad_(False)
    rule.output.weight *= 30.0
    path = tmp_path_factory.mktemp("rule") / "rule.safetensors"
    npa_envs.save_rule(rule, path)
    return {"rule": str(path), "state_dim": 8, "eps0": 0.3}
