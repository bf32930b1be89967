"""What policies, problems, methods and comparisons refuse, and what they say."""

import gymnasium
import numpy as np
import pytest
from support.learning_problems import heart, species
from support.refusals import refused

import npa_envs
from npa_envs.agents import (
    MendPolicy,
    PaintPolicy,
    RandomPolicy,
    RulePolicy,
    ZeroPolicy,
    evaluate_policy,
    garden_policies,
)
from npa_envs.agents.comparison.plan import ComparisonPlan
from npa_envs.agents.learning import Budget, Problem, Progress, RuleSet, train
from npa_envs.agents.learning.problem import world_seeds
from npa_envs.agents.search import SearchWorld
from npa_envs.agents.search.candidate_evaluation import SNAPSHOTS
from npa_envs.cli.compare import CompareOptions, make_plan
from npa_envs.envs import multispecies_v0

PICTURES, POINTS = "npa/Pictures2D-v0", "npa/PointClassificationSmall-v0"
GARDEN, SHAPESHIFTER = "npa/Gardener2DSmall-v0", "npa/Shapeshifter2D-v0"
QUICK = {"seed_pool": 1, "grow_steps": 4}


def make(name="npa/Morphogenesis2D-v0", **keywords):
    return gymnasium.make(name, **({"particle_count": 64} | keywords))


def make_vec(name="npa/Morphogenesis2D-v0", **keywords):
    given = {"vectorization_mode": "vector_entry_point", **keywords}
    return gymnasium.make_vec(name, 2, **given)


def fitted(rule, **keywords):
    return RulePolicy(npa_envs.NPARule(**rule), make(**keywords))


def observed(shape):
    return ZeroPolicy(make())(np.zeros(shape, np.float32))


def never(_):
    raise AssertionError("an episode was begun")


def evaluated(seeds=(0,), make=make_vec, **keywords):
    return evaluate_policy(make(**keywords), never, seeds)


def garden(policy, *, name=GARDEN, **keywords):
    own = {key: keywords.pop(key) for key in ("gain", "share", "width") if key in keywords}
    return policy(make_vec(name, **QUICK, **keywords), **own)


def trained(method, seed=0, problem=None, **options):
    if method.startswith("ppo_"):
        pytest.importorskip("stable_baselines3")
    return train(method, problem or heart(), Budget(particle_steps=1), seed, **options)


def entered(**given):
    named = {"evaluation_seeds": range(3)} | given
    return Progress(heart(), Budget(particle_steps=10), device="cpu", **named)


def problem(**fields):
    given = {"env_id": "npa/Morphogenesis2D-v0", "episode_steps": 4} | fields
    return Problem(**given)


def part(words):
    seconds = {"seconds": {"growth": 1.0}}
    given = {"tasks": {"growth": {}}, "methods": ["one"], "seeds": (0,), "budgets": seconds}
    return ComparisonPlan(**given, episodes=2).part(words)


def compared(**changes):
    return make_plan(CompareOptions(**changes))


def benched(**changes):
    pytest.importorskip("jsonschema")
    return make_plan(CompareOptions(suite="npa-bench-v0", commit="c0ffee", **changes))


def start_of(problem):
    return {"start": RuleSet.new(problem, 0)}


ALONE = problem(env_id=GARDEN, num_envs=1, keywords=QUICK)
WIDE = {"state_dim": 16, "eps0": 0.1}
APART = WIDE | {"perception": "per_species"}
INVASION, DYING = species("npa/Invasion-v0", seed_distance=0.5), species(deaths=[[0, 2]])
WARM = ("ppo", "ppo_world", "evolution", "gradient")
TIMED = {"learning_seconds": 1.0}

REFUSED = {
    fitted: [
        ({"rule": {}, "eps0": 0.2}, "eps0, 0.2, got 0.1: make .* with the keyword eps0=0.1"),
        ({"rule": {}, "alpha": 1.0}, "alpha, 1, got 0.5: make .* with the keyword alpha=0.5"),
        ({"rule": {}, "state_dim": 8}, "make the environment with the keyword state_dim=16"),
        ({"rule": {"space_dim": 3}}, "space_dim, 2, got 3"),
        ({"rule": {"static": True}}, "got one of static particles"),
        ({"rule": {"moment_correction": False}}, "moment_correction=True"),
        ({"rule": {"divides": True}}, "divides=True"),
        ({"rule": {"code_dim": 2, "code_names": ["ring"]}}, "code_dim=2"),
    ],
    lambda kind, name=None, **given: kind(make(**({"name": name} if name else {})), **given): [
        ({"kind": RandomPolicy, "seed": -1}, "seed must be an integer of at least 0"),
        ({"kind": PaintPolicy, "colour": (0.5,)}, "colour must have three numbers"),
        ({"kind": MendPolicy, "blank": "x"}, "blank must be a number, got 'x'"),
        ({"kind": PaintPolicy, "name": POINTS}, "colour must be given if env has no target"),
        ({"kind": ZeroPolicy, "name": SHAPESHIFTER}, "acts by rows of particles"),
        ({"kind": RandomPolicy, "name": SHAPESHIFTER}, "acts by rows of particles"),
    ],
    RulePolicy: [
        ({"rule": "gecko", "env": None}, "rule must be an NPARule, got str"),
        ({"rule": npa_envs.NPARule(), "state_scale": 0.0}, "state_scale must be positive"),
    ],
    observed: [({"shape": shape}, "P = 66") for shape in ((64,), (64, 65), (1, 1, 64, 66))],
    evaluated: [
        ({"seeds": []}, "seeds must have at least one seed"),
        ({"seeds": 7}, r"one for each episode, got 7: give seeds=range\(8\)"),
        ({"seeds": [0, 1, -1]}, "a seed must be an integer of at least 0, got -1"),
        ({"make": multispecies_v0.parallel_env}, r"one agent, got .*make_envs"),
        ({"make": make, "max_episode_steps": -1}, "max_episode_steps=256"),
        ({"max_episode_steps": None}, "max_episode_steps=256"),
    ],
    garden: [
        (
            {"policy": garden_policies.StillGardener, "actions": "discrete"},
            "must be a garden with actions",
        ),
        (
            {"policy": garden_policies.ScriptedGardener, "tools": ("wipe",)},
            "have brushes that push",
        ),
        ({"policy": garden_policies.ScriptedShepherd}, "env must be npa/Shepherd2D-v0"),
        ({"policy": garden_policies.ScriptedGardener, "gain": 0.0}, "gain must be positive"),
    ],
    problem: [
        ({"env_id": "npa/Mixng-v0"}, "did you mean 'npa/Mixing-v0'"),
        ({"env_id": "CartPole-v1"}, "env_id must be of an environment of many worlds"),
        ({"keywords": {"epsilon": 0.1}}, "unexpected keyword argument 'epsilon'"),
        ({"keywords": {"device": "cuda"}}, "given to train and make_envs"),
        ({"keywords": {"max_cycles": 3}}, "field episode_steps"),
        ({"keywords": {"reward": "particle"}}, "particle_rewards='particle'"),
        ({"keywords": {"box_size": {1, 2}}}, "JSON"),
        ({"keywords": [1]}, "keywords must map names"),
        ({"num_envs": 1.5}, "num_envs"),
        # Rules are not taught where rows show pictures.
        ({"env_id": PICTURES, "keywords": {"observe_target": True}}, "must not have 'observe_tar"),
    ],
    Problem.from_json: [({"text": t}, "text must be") for t in ("{", "[1]", '{"env": 1}')],
    heart(reward="sparse").make_envs: [({"particle_rewards": "particle"}, "particle_rewards")],
    RuleSet.of: [
        ({"problem": heart(), "source": "heart"}, "state_dim"),
        ({"problem": species(**APART), "source": "heart"}, "rule must distinguish 2 species"),
        ({"problem": species(**WIDE), "source": ["heart"] * 3}, "one for each of 2 species"),
        ({"problem": heart(), "source": "hart"}, "unknown rule"),
    ],
    Budget: [({}, "must say something"), ({"seconds": 0.0}, "seconds must be")],
    entered: [({"curve_points": 0}, "curve_points"), ({"evaluation_seeds": []}, "seed")],
    trained: [
        ({"method": "gradients"}, "did you mean 'gradient'"),
        ({"method": "gradient", "learning_rat": 1.0}, "did you mean 'learning_rate'"),
        ({"method": "zero", "device": "tpu"}, "device"),
        ({"method": "zero", "seed": 100}, "must be a whole number from 0 to 99, .* got 100"),
        ({"method": "zero", "evaluation_seeds": 4}, "seeds must be one for each episode, got 4"),
        ({"method": "zero", **start_of(heart())}, "start must be None"),
        ({"method": "scripted", "gains": [0.1, "a"]}, "gains must be a list of finite numbers"),
        ({"method": "gradient", "steps": 5}, "steps must be a range .* of two whole num.*, got 5"),
        ({"method": "gradient", "steps": [5, 2]}, "steps must be two whole numbers"),
        ({"method": "evolution", "population": 2}, "population must be a whole number of at lea"),
        ({"method": "evolution", "sigma": 0.0}, "sigma must be a finite number greater than 0"),
        ({"method": "clone"}, "teacher must be given"),
        ({"method": "clone", "teacher": "heart", "student_share": 1.5}, "student_share"),
        ({"method": "clone", "teacher": "heart"}, "state_dim"),
        ({"method": "ppo", "masked": "False"}, "masked must be True or False, got 'False'"),
        ({"method": "ppo", "ratio": "both"}, "'particle' or 'world', got 'both'"),
        (
            {"method": "ppo", "particle_rewards": "particle", "ratio": "world"},
            "needs ratio='particle'",
        ),
        ({"method": "ppo", "gamma": 0.0}, r"gamma must lie in \(0, 1\], got 0.0"),
        ({"method": "ppo", "critic": "all"}, "'particle' or 'central', got 'all'"),
        ({"method": "shac", "steps": 0}, "steps must be"),
        ({"method": "ppo", "problem": problem(env_id=SHAPESHIFTER)}, "'ppo' cannot learn codes"),
        ({"method": "gradient", "problem": INVASION}, "gradients .* each other's expense"),
        ({"method": "gradient", "problem": DYING}, "gradients must keep all particles"),
        ({"method": "evolution", "problem": problem(env_id=GARDEN)}, "known word, got 'evolution'"),
        ({"method": "ppo_world", "problem": ALONE, "steps": 1}, "at least 2 steps of worlds"),
        (
            {"method": "ppo_world", "problem": heart(num_envs=1), "steps": 4},
            "minibatches must have at",
        ),
        *(({"method": m, "start": npa_envs.NPARule()}, "start must be a RuleSet") for m in WARM),
        *(({"method": m, **start_of(heart(state_dim=8))}, "state_dim") for m in WARM),
    ],
    world_seeds: [({"seed": 0, "count": 10_001}, "at most 10000")],
    SearchWorld: [
        ({"steps": 20}, f"steps must be a multiple of {SNAPSHOTS}, got 20: take 32"),
        ({"state_dim": 2}, "state_dim must be a whole number of at least 3"),
    ],
    part: [({"words": words}, "must be K/N") for words in ("0/2", "3/2", "2", "a/b", "1/-2")],
    compared: [
        ({}, "needs a budget"),
        ({"learning_seconds": 0.0}, "seconds must be positive"),
        ({"particle_steps": 0.5}, "particle-steps must be positive"),
        (TIMED | {"seed_count": 0}, "--seed-count must be at least 1"),
        (TIMED | {"seed_count": 101}, "seed_count must be at most 100, got 101"),
        (TIMED | {"methods": ("a=zero", "a=random")}, "got a=zero and a=random: rename"),
        (TIMED | {"tasks": ("mixin",)}, "did you mean 'mixing'"),
        (TIMED | {"methods": ("pp",)}, "did you mean 'ppo'"),
        (TIMED | {"options": ("evolution=3",)}, "METHOD.NAME=VALUE"),
        (TIMED | {"options": ("evolutio.sigma=3",)}, "did you mean 'evolution'"),
        (TIMED | {"options": ("evolution.sigmas=3",)}, "did you mean 'sigma'"),
        (TIMED | {"device": "tpu"}, "tpu"),
    ],
    benched: [
        ({"learning_seconds": 1.0}, "--learning-seconds must not be given with --suite"),
        ({"particle_steps": 1.0}, "--particle-steps must not"),
        ({"episodes": 3}, "--episodes must not"),
        ({"options": ("sac.gamma=0.5",)}, "options of 'sac' are frozen"),
        ({"methods": ("ppo=ppo",)}, "must be new and of small letters"),
        ({"methods": ("mine=absent_module:train",)}, "import, got 'absent_module:train'"),
        ({"methods": ("mine=ppo",), "options": ("mine.bold=1",)}, "unknown option 'bold'"),
        ({"tasks": ("Gardener2DSmall-v1",)}, "did you mean 'Gardener2DSmall-v0'"),
        ({"methods": ("sacc",)}, "did you mean 'sac'"),
    ],
}
"""Callables, and what is said of their arguments."""


@pytest.mark.parametrize(
    ("call", "given", "message"), [(call, *row) for call in REFUSED for row in REFUSED[call]]
)
def test_wrong_arguments_are_refused(call, given, message):
    refused(message, call, **given)
