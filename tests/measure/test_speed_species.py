"""What one species costs beside `rollout`: two calls that are timed in turn."""

import time
from functools import partial

import torch

from npa_envs.measure.speed import suites
from npa_envs.measure.speed.session import Session
from npa_envs.measure.speed.skips import roll_one_species
from npa_envs.measure.speed.timing import compare
from npa_envs.measure.speed.workloads import Workload
from npa_envs.world.rollout import rollout


def test_calls_are_compared_in_turn_and_each_pair_the_other_way_round(device):
    calls = []

    def call(name, seconds):
        calls.append(name)
        time.sleep(seconds)

    source = torch.Generator(device)
    first, second = partial(call, "a", 0.01), partial(call, "b", 0.02)
    # A graph holds nothing of a call that launches nothing.
    compared = compare((first, source), (second, source), device, repeats=4, graph=False)
    assert "".join(calls)[4:] == "abbaabba"
    # Who sleeps on a busy machine oversleeps, but never wakes early.
    assert 10_000 <= compared.first.median < compared.second.median
    assert compared.second.median >= 20_000
    assert 1.2 < compared.ratio < 3.5


def test_one_species_is_compared_with_the_rollout_that_it_is():
    here = Session(torch.device("cpu"), repeats=1, small=True)
    rows = suites.SUITES["species"].run(here)["one_species"]
    assert [(row.what, row.calls) for row in rows] == [
        ("inference", "eager"),
        ("training", "eager"),
    ]
    for row in rows:
        assert row.workload == "2D (1, 256, 2)"
        assert row.rollout_us.median > 0
        # What it costs is measured; that it is not another rollout is known.
        assert 1 / 3 < row.ratio < 3
    workload = Workload(2, 2, 150, 2, hidden_dim=16, eps=0.2)
    x, s = workload.worlds(here.device)
    rule = workload.rule(here.device)
    outcomes = [
        roll(rule, x, s, 2, update_prob=0.5, generator=torch.Generator().manual_seed(1))
        for roll in (rollout, roll_one_species)
    ]
    for value, expected in zip(*outcomes, strict=True):
        assert torch.equal(value, expected)
