"""The cache of captures, with graphs that a CPU emulates: a replay runs the function again.

Its numbers are those of launches; a network's Python code runs in each replay, unlike on CUDA.
"""

import contextlib
import gc

import pytest
import torch
from support.worlds import assert_same, random_world
from torch import nn

import npa_envs
from npa_envs.world import capture_cache, captured_rollout

EPS = 0.3


class Emulated:
    """A graph, whose replays call a function."""

    def __init__(self, function):
        self.replay = function
        function()


@pytest.fixture
def replays(monkeypatch):
    """Emulate CUDA graphs; return a list that gets an entry for each replay."""
    seen = []

    def capture(function, device, **options):
        graph = Emulated(function)
        graph.replay = lambda: seen.append(1) or function()
        return graph

    def warm_up(rollout, steps, call):
        with torch.no_grad():
            torch._foreach_copy_(rollout._inputs, rollout._inputs_of(call))
        rollout._draws_per_step = 0

    cls = captured_rollout.CapturedRollout
    monkeypatch.setattr(captured_rollout, "capture", capture)
    monkeypatch.setattr(captured_rollout, "_views", lambda tensors: tensors)
    # As on CUDA, the graph checks positions, and its threads report.
    monkeypatch.setattr(captured_rollout, "is_slow", lambda x: False)
    monkeypatch.setattr(cls, "_warm_up", warm_up)
    monkeypatch.setattr(cls, "_wait_for_last_use", lambda rollout: None)
    monkeypatch.setattr(capture_cache, "_may_capture", lambda x: True)
    monkeypatch.setattr(capture_cache, "_make_room", lambda device: True)
    monkeypatch.setattr(capture_cache, "_groups", capture_cache.CallGroups())
    monkeypatch.setattr(torch.cuda, "graph_pool_handle", lambda: None)
    monkeypatch.setattr(torch.cuda, "memory_reserved", lambda device: 0)
    monkeypatch.setattr(torch.cuda, "device", lambda device: contextlib.nullcontext())
    return seen


class Own(npa_envs.NPARule):
    """A network with another layer, a buffer that it writes to, and a tensor that it reads."""

    def __init__(self, *args, **options):
        super().__init__(*args, **options)
        self.middle = nn.Linear(self.hidden_dim, self.hidden_dim)
        self.register_buffer("mean", torch.zeros(self.perception_dim))
        self.gain, self.aside = torch.ones(1), None

    def forward(self, z):
        with torch.no_grad():
            self.mean.lerp_(z.mean(dim=0), 0.1)
        return self.gain * self.output(torch.relu(self.middle(torch.relu(self.hidden(z)))))


def make_rule(kind=Own):
    torch.manual_seed(0)
    rule = kind(2, 8, 32, eps0=EPS)
    for parameter in rule.parameters():
        nn.init.normal_(parameter, std=0.1)
    return rule


def run(rule, call, *, gradients=True, steps=5, **options):
    """Return worlds, paths, gradients and buffers after a rollout."""
    x, s = random_world(2, 31, 2, 8, dtype=torch.float32, device="cpu", seed=call)
    x, s = x.requires_grad_(gradients), s.requires_grad_(gradients)
    generator = npa_envs.WorldRandom([call, call + 1])
    with torch.set_grad_enabled(gradients):
        results = npa_envs.rollout(
            rule, x, s, steps, generator=generator, return_path_length=True, **options
        )
    result = list(results)
    if gradients:
        loss = sum(value.sin().sum() for value in results)
        weights = [weight for weight in rule.parameters() if weight.requires_grad]
        result += torch.autograd.grad(loss, [x, s, *weights])
    return [*result, *(buffer.clone() for buffer in rule.buffers()), generator.uniform(2)]


def follows(rules, calls, **options):
    """Run the first rule as usual and the second launched, and compare; return their results."""
    seen = []
    for call in calls:
        found = run(rules[0], call, **options)
        expected = run(rules[1], call, **options | {"cuda_graph": False})
        assert_same(found, expected)
        seen.append((found, [value.detach().clone() for value in found]))
    return seen


@pytest.mark.parametrize(
    "options", [{}, {"gradients": False, "steps": 70, "keep_every": 5}], ids=str
)
@pytest.mark.parametrize("kind", [Own, npa_envs.NPARule])
def test_replays_have_the_results_of_launches(kind, options, replays):
    rules = make_rule(kind), make_rule(kind)
    kept = follows(rules, range(2), **options)
    assert not replays
    # In all these ways a network may change between calls.
    for call in range(2, 12):
        for rule in rules:
            with torch.no_grad():
                for parameter in rule.parameters():
                    parameter.mul_(1.01)
            if call == 6:
                rule.hidden.weight = nn.Parameter(0.9 * rule.hidden.weight.detach())
            if call == 7:
                rule.hidden.weight.requires_grad_(False)
            if call == 8 and kind is Own:
                rule.gain.fill_(2.0)
        kept += follows(rules, [call], **options)
    assert replays
    for found, copies in kept:
        assert_same([value.detach() for value in found], copies)


def test_another_dtype_is_another_capture(replays):
    rules = make_rule(), make_rule()
    follows(rules, range(4))
    assert len(capture_cache._groups) == 1
    rules[0].double()
    x, s = random_world(2, 31, 2, 8, dtype=torch.float64, device="cpu")
    rules[0].gain = rules[0].gain.double()
    npa_envs.rollout(rules[0], x, s, 5, generator=npa_envs.WorldRandom([0, 1]))
    assert len(capture_cache._groups) == 2


def test_hooks_run_in_every_call(replays):
    rules, seen = (make_rule(), make_rule()), []
    rules[0].middle.register_forward_hook(lambda *_: seen.append(1))
    follows(rules, range(5))
    assert len(seen) == 5 * 5
    assert not replays


def test_one_warning_says_why_a_rule_stays_launched(replays, caplog):
    class Counting(Own):
        def forward(self, z):
            Counting.runs += 1
            return super().forward(z) * (1.0 + 0.1 * Counting.runs)

    Counting.runs = 0
    rule = make_rule(Counting)
    for call in range(6):
        run(rule, call)
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "a replay gives other numbers" in caplog.text


def test_parameters_of_other_modules_keep_their_gradients(replays, caplog):
    other = nn.Linear(8, 10)

    class Reading(Own):
        def forward(self, z):
            return super().forward(z) + other.bias

    rule = make_rule(Reading)
    for call in range(6):
        other.bias.grad = None
        x, s = random_world(2, 31, 2, 8, dtype=torch.float32, device="cpu", seed=call)
        generator = npa_envs.WorldRandom([0, 1])
        npa_envs.rollout(rule, x, s, 5, generator=generator)[1].sum().backward()
        assert float(other.bias.grad.abs().max()) > 0.0
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "parameters that are not the rule's" in caplog.text


def test_what_a_rule_changes_or_cannot_copy_leaves_it_launched(replays, caplog):
    class Changing(Own):
        def forward(self, z):
            self.latest = len(z)
            return super().forward(z)

    class Uncopied(Own):
        def __deepcopy__(self, memo):
            raise TypeError("this is unique")

    for kind in (Changing, Uncopied):
        rule = make_rule(kind)
        for call in range(4):
            run(rule, call)
    assert not replays
    assert not caplog.records


def test_a_capture_is_in_use_until_its_backward_pass(replays):
    rule = make_rule()
    x, s = random_world(1, 31, 2, 8, dtype=torch.float32, device="cpu")
    generator = npa_envs.WorldRandom([0])
    roll = lambda: npa_envs.rollout(rule, x, s, 3, generator=generator)[1]  # noqa: E731
    for _ in range(3):
        roll().sum().backward()
    (group,) = capture_cache._groups.values()
    first, second = roll(), roll()
    assert len(group.captures) == 2
    (first * second).sum().backward()
    del first, second
    gc.collect()
    roll()
    assert len(group.captures) == 2


def test_positions_that_are_not_finite_are_refused(replays):
    rule = make_rule()
    x, s = random_world(1, 31, 2, 8, dtype=torch.float32, device="cpu")
    generator = npa_envs.WorldRandom([0])
    with torch.no_grad():
        for _ in range(4):
            npa_envs.rollout(rule, x, s, 3, generator=generator)
        x[0, 7, 0] = torch.nan
        with pytest.raises(npa_envs.NPAError, match=r"x must be finite.*particle 7"):
            npa_envs.rollout(rule, x, s, 3, generator=generator)
    assert replays
