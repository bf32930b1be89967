"""Runs with different seeds learn in different worlds, and none in those of evaluations."""

from __future__ import annotations

import pytest
from learning_problems import heart

from npa_envs.agents.learning import EVALUATION_SEEDS, Budget, train
from npa_envs.agents.learning.problem import FIRST_EVALUATION_SEED, world_seeds
from npa_envs.envs.core.vector import NPAVectorEnv
from npa_envs.errors import NPAError

METHODS = {
    "ppo": {"steps": 4},
    "ppo_rows": {"steps": 4},
    "ppo_world": {"steps": 4, "minibatches": 4},
    "clone": {"collect_steps": 4},
    "scripted": {"gains": (0.03,)},
    "evolution": {"population": 4},
}


@pytest.fixture
def used(monkeypatch):
    """The seeds of all worlds that were reset."""
    seeds, reset = [], NPAVectorEnv.reset

    def watched(self, *, seed=None, options=None):
        single = isinstance(seed, int)
        seeds.extend(range(seed, seed + self.num_envs) if single else seed or ())
        return reset(self, seed=seed, options=options)

    monkeypatch.setattr(NPAVectorEnv, "reset", watched)
    return seeds


@pytest.mark.parametrize("method", METHODS)
def test_no_world_is_learned_in_from_two_seeds(method, used):
    if method.startswith("ppo_"):
        pytest.importorskip("stable_baselines3")
    if method == "evolution":
        pytest.importorskip("cma")
    problem, options = heart(), METHODS[method]
    if method == "clone":
        options = options | {"teacher": problem.new_rules(7)}
    learned_in = []
    for seed in range(3):
        used.clear()
        budget = Budget(particle_steps=3 * 48 * 16)
        train(method, problem, budget, seed, evaluation_seeds=EVALUATION_SEEDS[:3], **options)
        worlds = {number for number in used if number not in EVALUATION_SEEDS}
        assert worlds
        assert max(worlds) < FIRST_EVALUATION_SEED
        learned_in.append(worlds)
    assert len(set.union(*learned_in)) == sum(map(len, learned_in))


def test_worlds_of_one_seed_follow_each_other_and_end_before_those_of_the_next():
    assert list(world_seeds(0, 3)) == [0, 1, 2]
    assert world_seeds(3, 10_000).stop == world_seeds(4, 1).start
    assert world_seeds(99, 10_000).stop == EVALUATION_SEEDS.start


@pytest.mark.parametrize(
    ("seed", "count", "words"), [(100, 1, "seed must be below 100"), (0, 10_001, "at most 10000")]
)
def test_seeds_that_reach_other_worlds_are_refused(seed, count, words):
    with pytest.raises(NPAError, match=words):
        world_seeds(seed, count)
