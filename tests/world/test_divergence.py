"""Worlds that diverge: found on the device, named on the host, and kept from the others."""

import math
import re

import pytest
import torch
from support.worlds import random_world
from torch.utils._python_dispatch import TorchDispatchMode

import npa_envs
from npa_envs import DivergedError, NPAError, NPARule

STATE_DIM = 4


class CountOperators(TorchDispatchMode):
    """Counts the torch operators that are run, and those that read a number on the host."""

    def __init__(self):
        super().__init__()
        self.count = self.reads = 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        self.count += 1
        self.reads += "_local_scalar_dense" in str(function)
        return function(*args, **(kwargs or {}))


def make_rule(device, *, growth=1.0, static=False):
    """Return a rule under which each state c, updated, becomes (1 + growth) c."""
    rule = NPARule(2, STATE_DIM, 2 * STATE_DIM, static=static).to(device)
    with torch.no_grad():
        for parameter in rule.parameters():
            parameter.zero_()
        offset = 0 if static else 2
        for c in range(STATE_DIM):
            for sign, unit in ((1.0, c), (-1.0, STATE_DIM + c)):
                rule.hidden.weight[unit, c] = sign
                rule.output.weight[offset + c, unit] = sign * growth
    return rule


def worlds(device, dtype=torch.float32):
    return random_world(3, 40, 2, STATE_DIM, dtype=dtype, device=device)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_number_that_is_not_finite_is_found_in_its_world(dtype, value, device):
    for k in (0, 1):
        x, s = worlds(device, dtype=dtype)
        (x, s)[k][1, 7, 1] = value
        with CountOperators() as operators:
            flags = npa_envs.divergence(x, s)
        assert operators.reads == 0, "flags are read by the host"
        assert flags.non_finite.device == x.device
        assert flags.non_finite.tolist() == [False, True, False]
        assert flags.runaway.tolist() == [False, False, False]


def test_a_world_has_run_away_beyond_the_limit_and_not_at_it(device):
    x, s = worlds(device)
    s[0, 3, 2] = -100.0
    x[2, 5, 0] = 100.5
    flags = npa_envs.divergence(x, s, limit=100.0)
    assert flags.runaway.tolist() == [False, False, True]
    assert not flags.non_finite.any()
    s[2, 0, 0] = math.inf
    flags = npa_envs.divergence(x, s, limit=100.0)
    assert flags.non_finite.tolist() == [False, False, True]
    assert not flags.runaway.any()


def test_a_report_names_world_particle_term_and_value(device):
    x, s = worlds(device)
    assert npa_envs.describe_divergence(x, s) == ""
    s[1, 7, 3] = s[1, 9, 0] = math.nan
    x[2, 5, 1] = -2e6
    assert npa_envs.describe_divergence(x, s).splitlines() == [
        "world 1: states channel 3 of particle 7 is nan (2 such numbers in 2 particles)",
        "world 2: positions coordinate 1 of particle 5 is -2e+06, beyond 1e+06 (1 such number in "
        "1 particle)",
    ]
    x, s = random_world(11, 5, 2, 3, dtype=torch.float32, device=device)
    s[1:] = math.inf
    lines = npa_envs.describe_divergence(x, s).splitlines()
    assert (len(lines), lines[-1]) == (9, "and 2 more worlds")


def test_limits_and_words_that_are_none_are_refused(device):
    for limit in (0.0, -1.0, math.nan):
        with pytest.raises(NPAError, match="limit must be positive, got"):
            npa_envs.divergence(*worlds(device), limit=limit)
    with pytest.raises(NPAError, match="on_divergence must be 'ignore' or 'raise', got 'stop'"):
        npa_envs.rollout(make_rule(device), *worlds(device), 1, on_divergence="stop")


moving_and_static = pytest.mark.parametrize("static", [False, True], ids=("moving", "static"))


@moving_and_static
def test_a_rollout_says_in_which_step_and_where_a_world_diverged(static, device):
    """States become 1e3 times as large in a step: from 1.5e30 on, the third is no number."""
    rule = make_rule(device, growth=999.0, static=static)
    x, s = worlds(device)
    s = s.clamp(-1.0, 1.0)
    s[1, 7, 3] = 1.5e30
    s[2, 4, 0] = -1.5e33
    # Alone, lest sums over neighbours overflow first.
    x[1, 7] = x[2, 4] = 5.0
    with torch.no_grad(), pytest.raises(DivergedError) as caught:
        npa_envs.rollout(rule, x, s, 5, update_prob=1.0, on_divergence="raise")
    second = "world 2: states channel 0 of particle 4 was -inf in step 2"
    third = "world 1: states channel 3 of particle 7 was inf in step 3"
    message = rf"worlds must stay finite, but 2 of 3 did not, .*\n?.*{second}.*\n?.*{third}"
    assert re.search(message, str(caught.value))
    assert "world 0" not in str(caught.value)


@moving_and_static
@pytest.mark.parametrize("steps", [0, 5])
def test_what_was_not_finite_before_the_first_step_is_called_so(steps, static, device):
    x, s = worlds(device)
    s[0, 17, 2] = math.inf
    with pytest.raises(DivergedError, match="channel 2 of particle 17 was inf before the first"):
        npa_envs.rollout(make_rule(device, static=static), x, s, steps, on_divergence="raise")


def test_an_ignored_world_is_refused_by_the_next_call(device):
    """The default is as it was: what has become of positions is seen at the door."""
    rule = make_rule(device)
    x, s = worlds(device)
    s[1, 7, 0] = math.nan
    x, s = npa_envs.rollout(rule, x, s, 3)
    assert npa_envs.divergence(x, s).non_finite.tolist() == [False, True, False]
    x[1, 7, 0] = math.nan
    with pytest.raises(NPAError, match="at world 1, particle 7"):
        npa_envs.rollout(rule, x, s, 1)


def test_the_host_reads_no_more_in_watched_steps_and_nothing_is_run_for_others(device):
    rule = make_rule(device)
    x, s = worlds(device)

    def operators(steps, **options):
        with torch.no_grad(), CountOperators() as counted:
            npa_envs.rollout(rule, x, s, steps, update_prob=1.0, cuda_graph=False, **options)
        return counted.count, counted.reads

    plain, watched = operators(5), operators(5, on_divergence="raise")
    assert operators(5, on_divergence="ignore") == plain
    assert watched[0] > plain[0]
    assert operators(9)[1] == plain[1]
    assert operators(9, on_divergence="raise")[1] == watched[1]


def test_steps_and_species_are_watched_as_well(device):
    rule = make_rule(device, growth=999.0)
    x, s = worlds(device)
    s[1, 30, 3] = 1e38
    x[1, 30] = 5.0
    with pytest.raises(DivergedError, match="world 1: states channel 3 of particle 30 was inf in"):
        npa_envs.step(rule, x, s, update_prob=1.0, on_divergence="raise")
    for density_counts in (None, (15, 25)):
        with pytest.raises(DivergedError, match="particle 30 was inf in step 1"):
            npa_envs.rollout_species(
                (rule, rule), x, s, 2, counts=(15, 25), update_prob=1.0,
                density_counts=density_counts, on_divergence="raise",
            )  # fmt: skip
