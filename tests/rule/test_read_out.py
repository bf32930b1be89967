"""Rules with a read-out network, and tasks whose losses compare what it says."""

import copy

import pytest
import torch
from support.circle_task import STATE_DIM, CircleTask, circle_config, plain_rollout

from npa_envs.rule.rule import COLOUR_OFFSET, NPARule
from npa_envs.tasks.base import untrained_rule
from npa_envs.training import DivergedError, Trainer
from npa_envs.training.loss_statistics import diverged_worlds

GOAL = torch.tensor([0.9, -0.7])


class ReadOutTask(CircleTask):
    """The task that every particle's two outputs of the read-out are `GOAL`."""

    rule: NPARule | None = None

    def make_rule(self, generator):
        shape = {"state_dim": STATE_DIM, "hidden_dim": 16, "eps0": self.eps}
        return untrained_rule(generator, **shape, readout_dim=2, readout_hidden_dim=8)

    def for_rule(self, rule):
        bound = copy.copy(self)
        bound.rule = rule
        return bound

    def loss(self, worlds):
        error = self.metric(worlds.x, worlds.s).mean()
        return error, {"error": error}

    def metric(self, x, s):
        return (self.rule.read_out(s) - GOAL.to(s)).square().mean((1, 2))


def test_read_out_is_two_layers_of_every_particles_own_state():
    shape = {"state_dim": 5, "hidden_dim": 4, "readout_dim": 4, "readout_hidden_dim": 7}
    rule = untrained_rule(torch.Generator().manual_seed(0), static=True, **shape).double()
    assert rule.update_dim == 5
    states = torch.randn(2, 3, 5, dtype=torch.float64)
    first, last = rule.readout[0], rule.readout[2]
    hidden = torch.einsum("bnc,hc->bnh", states, first.weight) + first.bias
    expected = torch.einsum("bnh,kh->bnk", hidden.clamp(min=0.0), last.weight) + last.bias
    # Worst error measured: 0, of outputs of about 0.3.
    torch.testing.assert_close(rule.read_out(states), expected, rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(rule.colour(states), expected[..., 1:] + COLOUR_OFFSET)


def test_divergence_is_looked_for_with_the_rule_as_it_was(tmp_path):
    class Broken(ReadOutTask):
        def metric(self, x, s):
            return super().metric(x, s) + torch.where(x[:, 0, 0] > 0, torch.inf, 0.0).to(s)

    config = circle_config(tmp_path, iterations=6, milestones=[4])
    trainer = Trainer(Broken(), config, task_name="circle", rollout=plain_rollout)
    with pytest.raises(DivergedError, match="error was not in iteration"):
        trainer.run(progress=False)
    rule = ReadOutTask().make_rule(torch.Generator().manual_seed(0))
    good = torch.nn.utils.parameters_to_vector(rule.parameters()).detach()
    x, s, *_ = ReadOutTask().seed(3, generator=torch.Generator(), device=torch.device("cpu"))
    snapshot = {"x": x, "s": s, "parameters": good}
    assert diverged_worlds(ReadOutTask(), rule, snapshot) == []
    snapshot["parameters"] = good * torch.nan
    assert diverged_worlds(ReadOutTask(), rule, snapshot) == [0, 1, 2]
    assert rule.readout[0].weight.isfinite().all()
