"""Captured rules with a network of their own: changes are followed, or they are launched."""

import functools

import pytest
import torch
from test_captured_rollouts import DEVICE, EPS, is_captured, run, same, worlds
from test_captured_rollouts import as_launched as follows
from torch import nn

import npa_envs
from npa_envs.world.capture_cache import _leaves
from npa_envs.world.rule_settings import is_observed, rule_settings

pytestmark = pytest.mark.usefixtures("nothing_captured")

CPU = torch.device("cpu")
as_launched = functools.partial(follows, calls=4)


class Scaled(npa_envs.NPARule):
    """A rule that reads all kinds of attributes."""

    def __init__(self, *args, **options):
        super().__init__(*args, **options)
        self.register_buffer("shift", torch.zeros(1))
        self.factor = torch.ones(1)
        self.number = 2.0
        self.listed = [1, {"word": None}]
        self.aside = [nn.Linear(1, 1)]

    def forward(self, perception):
        return self.number * self.factor * super().forward(perception) + self.shift


class Dropping(npa_envs.NPARule):
    """Changes of states are linear in `gain`: the gradient is the change over the gain."""

    def __init__(self, *args, **options):
        super().__init__(*args, **options)
        self.gain = nn.Parameter(torch.ones(()))

    def forward(self, perception):
        ones = torch.ones(len(perception), self.state_dim, device=perception.device)
        changes = nn.functional.dropout(ones, 0.5, self.training)
        return self.gain * torch.cat((torch.zeros_like(perception[:, :2]), changes), dim=1)


class Normed(npa_envs.NPARule):
    def __init__(self, *args, **options):
        super().__init__(*args, **options)
        self.norm = nn.BatchNorm1d(self.perception_dim)

    def forward(self, perception):
        return super().forward(self.norm(perception))


class Counting(npa_envs.NPARule):
    count = 0

    def forward(self, perception):
        self.count += 1
        return super().forward(perception) * (1.0 + 0.1 * self.count)


class Watching(npa_envs.NPARule):
    """Reads what nobody sees."""

    seen = 0

    def forward(self, perception):
        Watching.seen += 1
        return super().forward(perception) * (1.0 + 0.1 * Watching.seen)


def of_type(kind, **options):
    torch.manual_seed(0)
    rule = kind(2, 8, 32, eps0=EPS, **options)
    for parameter in rule.parameters():
        nn.init.normal_(parameter, std=0.1)
    rule = rule.to(DEVICE)
    if kind is Scaled:
        rule.factor = rule.factor.to(DEVICE)
    return rule


CHANGES = {
    "a number": lambda rule: setattr(rule, "number", 3.0),
    "a list": lambda rule: rule.listed.append(1),
    "a dictionary in a list": lambda rule: rule.listed[1].update(word=1),
    "a hook": lambda rule: rule.hidden.register_forward_hook(lambda _, __, output: 2.0 * output),
    "a mode": lambda rule: rule.eval(),
    "a tensor of a module aside": lambda rule: nn.init.ones_(rule.aside[0].weight),
    "a module": lambda rule: setattr(rule, "output", nn.Linear(32, 10)),
}


OBSERVERS = {
    "a hook": lambda rule: rule.hidden.register_forward_hook(lambda *_: None),
    "a backward hook": lambda rule: rule.register_full_backward_hook(lambda *_: None),
    "a forward of the object": lambda rule: setattr(rule, "forward", lambda z: z),
    "a compiled layer": lambda rule: setattr(rule, "hidden", torch.compile(rule.hidden)),
}


def written_in_place(rule):
    rule.factor.fill_(3.0)
    rule.shift.data.fill_(0.1)


@pytest.mark.parametrize("change", CHANGES)
def test_what_a_network_depends_on_is_seen(change):
    rule = Scaled(2, 8, 32, eps0=EPS)
    before = rule_settings(rule, CPU)
    assert rule_settings(rule, CPU) == before
    CHANGES[change](rule)
    assert rule_settings(rule, CPU) != before


@pytest.mark.parametrize("observe", OBSERVERS)
def test_rules_that_more_runs_with_than_forward_are_known(observe):
    rule = Scaled(2, 8, 32, eps0=EPS)
    assert not is_observed(rule)
    OBSERVERS[observe](rule)
    assert is_observed(rule)


def test_leaves_are_those_beyond_the_starts():
    first, second, third = (torch.ones(2, requires_grad=True) for _ in range(3))
    start = first * 2.0
    end = (start * second).sum() + (third * start.detach()).sum()
    assert _leaves([end], [start]) == {id(second), id(third)}
    assert _leaves([end], []) == {id(first), id(second), id(third)}
    assert _leaves([first.detach()], []) == set()


@pytest.mark.gpu
@pytest.mark.parametrize(
    "change", [written_in_place, *(made for name, made in CHANGES.items() if name != "a module")]
)
def test_a_changed_rule_is_followed(change):
    rule = of_type(Scaled)
    as_launched(rule)
    assert is_captured()
    change(rule)
    as_launched(rule)


@pytest.mark.gpu
@pytest.mark.parametrize("kind", [Scaled, npa_envs.NPARule])
def test_layers_of_another_size_are_no_error(kind):
    rule = of_type(kind)
    as_launched(rule)
    rule.hidden = nn.Linear(rule.hidden.in_features, 64).to(DEVICE)
    rule.output = nn.Linear(64, rule.output.out_features, bias=False).to(DEVICE)
    as_launched(rule)


@pytest.mark.gpu
@pytest.mark.parametrize("memory", ["store", "recompute", "minimal"])
def test_gradients_are_those_of_what_was_dropped(memory, caplog):
    rule = of_type(Dropping)
    x, s = worlds()
    drawn = []
    for _ in range(4):
        with torch.no_grad():
            rule.gain.fill_(1.0)
        after = npa_envs.rollout(rule, x, s, 6, memory=memory, cuda_graph=True)[1]
        change = (after - s).double().sum()
        (gradient,) = torch.autograd.grad(change, rule.gain)
        assert float(gradient) == pytest.approx(float(change), rel=1e-4)
        drawn.append(after.detach())
    assert not torch.equal(drawn[2], drawn[3])
    assert "forward draws from torch's own generator" in caplog.text


@pytest.mark.gpu
def test_gradients_are_those_of_what_was_dropped_within_a_graph_of_the_caller():
    rule = of_type(Dropping)
    with torch.no_grad():
        rule.gain.fill_(1.0)
    x, s = worlds()

    def gradient():
        after = npa_envs.rollout(rule, x, s, 6, memory="minimal")[1]
        change = (after - s).double().sum()
        return change.detach(), torch.autograd.grad(change, rule.gain)[0]

    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        gradient()
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        change, result = gradient()
    graph.replay()
    assert float(result) == pytest.approx(float(change), rel=1e-4)


@pytest.mark.gpu
def test_eval_ends_dropout():
    rule = of_type(Dropping)
    as_launched(rule.eval(), gradients=False)
    assert is_captured()
    x, s = worlds()
    seen = [npa_envs.rollout(rule.train(), x, s, 6, cuda_graph=True)[1] for _ in range(3)]
    assert not torch.equal(seen[1], seen[2])
    as_launched(rule.eval(), gradients=False)


@pytest.mark.gpu
@pytest.mark.parametrize("gradients", [True, False])
def test_running_statistics_go_on(gradients):
    states = []
    for cuda_graph in (False, True):
        rule = of_type(Normed)
        for call in range(5):
            options = {"update_prob": 1.0, "cuda_graph": cuda_graph}
            with torch.set_grad_enabled(gradients):
                npa_envs.rollout(rule, *worlds(seed=call), 70, **options)
        states.append([rule.norm.running_mean, rule.norm.running_var])
        assert int(rule.norm.num_batches_tracked) == 350
    same(*states)
    assert is_captured()


@pytest.mark.gpu
@pytest.mark.parametrize("kind", [Counting, Watching])
def test_a_rule_that_counts_its_calls_is_launched(kind, caplog):
    rule = of_type(kind)
    x, s = worlds()
    seen = []
    for cuda_graph in (False, True):
        rule.count = Watching.seen = 0
        calls = []
        for _ in range(4):
            with torch.no_grad():
                generator = torch.Generator(DEVICE).manual_seed(0)
                calls += npa_envs.rollout(rule, x, s, 3, generator=generator, cuda_graph=cuda_graph)
        seen.append(calls)
    if kind is Counting:
        same(*seen)
        assert not is_captured()
    else:
        # What captures it calls it too, so that its count differs, and is not held.
        assert not torch.equal(seen[1][-1], seen[1][-3])
        assert "a replay gives other numbers" in caplog.text


@pytest.mark.gpu
def test_hooks_run_in_every_call_unless_a_capture_is_asked_for():
    rule, seen = of_type(Scaled), []
    rule.output.register_forward_hook(lambda *_: seen.append(1))
    as_launched(rule)
    assert len(seen) == 8 * 7
    assert not is_captured()
    as_launched(rule, cuda_graph=True)
    assert is_captured()


class Steered(npa_envs.NPARule):
    """Its gradients depend on what nobody sees, and it may read another module."""

    factor, other, waits = 1.0, None, False

    def forward(self, perception):
        if Steered.waits and float(perception.sum()) == 0.5:
            return perception
        other = 0.0 if Steered.other is None else Steered.other.bias
        return Turned.apply(super().forward(perception)) + other


class Turned(torch.autograd.Function):
    @staticmethod
    def forward(ctx, values):
        return 1.0 * values

    @staticmethod
    def backward(ctx, bar):
        Steered.factor += 1.0
        return Steered.factor * bar


@pytest.mark.gpu
def test_other_gradients_are_found_too(caplog):
    Steered.factor = 1.0
    run(of_type(Steered), *worlds(), cuda_graph=False)
    rule = of_type(Steered)
    for _ in range(4):
        run(rule, *worlds())
    assert "a replay gives other numbers" in caplog.text
    assert not is_captured()


@pytest.mark.gpu
def test_parameters_of_others_keep_their_gradients(caplog, monkeypatch):
    monkeypatch.setattr(Turned, "backward", staticmethod(lambda ctx, bar: bar))
    monkeypatch.setattr(Steered, "other", nn.Linear(3, 10, device=DEVICE))
    rule, bias = of_type(Steered), Steered.other.bias
    gradients = []
    for _ in range(5):
        bias.grad = None
        generator = torch.Generator(DEVICE).manual_seed(0)
        npa_envs.rollout(rule, *worlds(), 4, generator=generator)[1].sum().backward()
        gradients.append(bias.grad)
    assert all(torch.equal(gradient, gradients[0]) for gradient in gradients)
    assert float(gradients[0].abs().max()) > 0.0
    assert "parameters that are not the rule's" in caplog.text


@pytest.mark.gpu
def test_a_rule_that_waits_for_the_device_is_launched(monkeypatch):
    monkeypatch.setattr(Turned, "backward", staticmethod(lambda ctx, bar: bar))
    monkeypatch.setattr(Steered, "waits", True)
    as_launched(of_type(Steered))
    assert not is_captured()
    as_launched(of_type(Scaled))
    assert is_captured()


@pytest.mark.gpu
def test_frozen_layers_are_followed():
    rule = of_type(Scaled)
    as_launched(rule)
    rule.hidden.requires_grad_(False)
    as_launched(rule)
    rule.hidden.requires_grad_(True)
    as_launched(rule, calls=1)


@pytest.mark.gpu
def test_within_autocast_own_networks_are_launched():
    rule = of_type(Scaled)
    with torch.autocast("cuda", dtype=torch.bfloat16):
        as_launched(rule)
    assert not is_captured()
    as_launched(rule)
    assert is_captured()
