"""Rules whose network was changed by hand or has a read-out: worlds follow what the module says."""

import contextlib
import copy
import functools

import pytest
import torch
from support.circle_task import STATE_DIM, CircleTask, circle_config, plain_rollout
from support.worlds import lively_rule, random_world

import npa_envs
from npa_envs.rule.rule import COLOUR_OFFSET, NPARule
from npa_envs.tasks.base import untrained_rule
from npa_envs.training import DivergedError, Trainer
from npa_envs.training.loss_statistics import diverged_worlds


def world(device):
    return random_world(1, 50, 2, 5, dtype=torch.float64, device=device)


def nothing(z):
    return z.new_zeros(*z.shape[:-1], 12)


@pytest.mark.parametrize("equivariant", [False, True])
@pytest.mark.parametrize("gradients", [False, True])
def test_a_layer_whose_forward_was_replaced_is_used_as_it_is(equivariant, gradients, device):
    rule, (x, s) = lively_rule(device, equivariant=equivariant), world(device)
    run = functools.partial(npa_envs.rollout, rule, x, s, 2, update_prob=1.0)
    with torch.set_grad_enabled(gradients):
        _, moved = run()
        rule.hidden.forward = nothing
        assert not rule.has_network()
        assert torch.equal(run()[1], s)
        del rule.hidden.forward
        assert rule.has_network()
        assert torch.equal(run()[1], moved)
    assert float((moved - s).abs().max().detach()) > 1e-3


@pytest.mark.parametrize("equivariant", [False, True])
def test_a_hidden_layer_without_biases_is_as_one_whose_biases_are_zero(equivariant, device):
    rule, (x, s) = lively_rule(device, equivariant=equivariant), world(device)
    torch.nn.init.zeros_(rule.hidden.bias)
    _, expected = npa_envs.rollout(rule, x, s, 2, update_prob=1.0)
    rule.hidden.bias = None
    assert not rule.has_network()
    _, after = npa_envs.rollout(rule, x, s, 2, update_prob=1.0)
    torch.testing.assert_close(after, expected, rtol=1e-12, atol=1e-13)


class Overridden(npa_envs.NPARule):
    def forward(self, perception):
        return 2.0 * super().forward(perception)


class Called(npa_envs.NPARule):
    def __call__(self, perception):
        return 2.0 * super().__call__(perception)


class Weighted(npa_envs.NPARule):
    @property
    def update_weight(self):
        return 2.0 * super().update_weight


class Fated(npa_envs.NPARule):
    def division_probabilities(self, states):
        divide, die = super().division_probabilities(states)
        return 0.0 * divide, 0.0 * die + 1.0


class Twofold(torch.nn.Module):
    def forward(self, weight):
        return 2.0 * weight


def remade(rule, cls):
    changed = cls(**rule.hyper_parameters()).to(rule.hidden.weight)
    changed.load_state_dict(rule.state_dict())
    return changed


def doubled(module, inputs, output):
    return 2.0 * output


def parametrised(layer):
    torch.nn.utils.parametrize.register_parametrization(layer, "weight", Twofold())


CHANGED = {
    "forward": lambda rule: remade(rule, Overridden),
    "call": lambda rule: remade(rule, Called),
    "a hook": lambda rule: rule.register_forward_hook(doubled) and None,
    "a hook of the output": lambda rule: rule.output.register_forward_hook(doubled) and None,
    "a parametrised output": lambda rule: parametrised(rule.output),
    "a hook of the hidden layer": lambda rule: rule.hidden.register_forward_hook(doubled) and None,
    "a parametrised hidden layer": lambda rule: parametrised(rule.hidden),
}
"""Rules that say twice what they said, or what twice the hidden layer makes of it."""


def assert_changed(how, s, once, twice):
    if "hidden" in how:
        assert float((twice - once).detach().abs().max()) > 1e-3
    else:
        torch.testing.assert_close(twice - s, 2.0 * (once - s), rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("gradients", [False, True])
@pytest.mark.parametrize("how", CHANGED)
def test_a_changed_network_is_run_as_the_module_that_it_is(how, gradients, device):
    rule, (x, s) = lively_rule(device), world(device)
    with torch.set_grad_enabled(gradients):
        _, once = npa_envs.step(rule, x, s, update_prob=1.0)
        changed = CHANGED[how](rule) or rule
        _, twice = npa_envs.step(changed, x, s, update_prob=1.0)
    assert not changed.is_plain()
    assert_changed(how, s, once, twice)


@pytest.mark.parametrize("name", ["", "hidden", "output"])
def test_hooks_of_all_modules_are_called(name, device):
    rule, (x, s) = lively_rule(device), world(device)
    module, calls, registered = getattr(rule, name) if name else rule, [], []
    _, once = npa_envs.step(rule, x, s, update_prob=1.0)
    hooks = {
        "forward_hook": lambda called, inputs, output: 2.0 * output if called is module else None,
        "forward_pre_hook": lambda called, inputs: calls.append(called),
        "full_backward_hook": lambda called, *bars: calls.append((called, "back")),
    }
    with contextlib.ExitStack() as stack:
        for hook_name, hook in hooks.items():
            register = getattr(torch.nn.modules.module, f"register_module_{hook_name}")
            # One of them alone is enough.
            with register(hook):
                assert not rule.is_plain()
            registered.append(functools.partial(register, hook))
        for register in registered:
            stack.enter_context(register())
        _, twice = npa_envs.step(rule, x, s.requires_grad_(), update_prob=1.0)
        twice.sum().backward()
    assert rule.is_plain()
    assert {module, (module, "back")} <= set(calls)
    assert_changed(name, s, once, twice)


def test_a_subclass_that_changes_no_step_is_plain():
    class Named(npa_envs.NPARule):
        name = "gecko"

        def colour(self, states):
            return states[..., :3]

    assert Named(2, 4, 8).is_plain()
    for cls in (Called, Weighted):
        assert not cls(2, 4, 8, equivariant=True).has_network()


def reversed_fates(rule):
    division_probabilities = rule.division_probabilities
    rule.division_probabilities = lambda states: division_probabilities(states)[::-1]


NOT_PLAIN = {
    "weight": lambda rule: remade(rule, Weighted),
    "fates": lambda rule: remade(rule, Fated),
    "an output with biases": lambda rule: setattr(rule, "output", torch.nn.Linear(8, 6)),
    "replaced fates": reversed_fates,
    "a hook of the fates": lambda rule: rule.fate.register_forward_hook(doubled) and None,
    "a wrapped fate": lambda rule: setattr(rule, "fate", torch.nn.Sequential(rule.fate)),
}


@pytest.mark.parametrize("how", NOT_PLAIN)
def test_what_changes_a_step_or_a_fate_is_not_plain(how):
    rule = npa_envs.NPARule(2, 4, 8, divides=True)
    assert rule.is_plain()
    assert not (NOT_PLAIN[how](rule) or rule).is_plain()


# Read-outs.


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
