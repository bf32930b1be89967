"""PPO and SHAC by several processes: the same curve for any number of them."""

import json
import os
import shutil
import signal

import pytest
import torch
from support.learning_problems import heart, progress_of, species
from support.processes import on_ranks
from support.refusals import refused

from npa_envs.agents.learning import Budget, RuleSet, ppo, shac, train
from npa_envs.rule.files import load_rule
from npa_envs.training.checkpoint import load_checkpoint, save_checkpoint

HEART = heart(num_envs=4, episode_steps=6)
DYING = species(episode_steps=6, deaths=[[1, 3]])

FORMS = {
    "PPO": (HEART, ppo, {"steps": 5, "masked": True, "minibatches": 2, "epochs": 2}),
    "PPO by worlds": (HEART, ppo, {"steps": 4, "ratio": "world", "critic": "central"}),
    "PPO of species that die": (DYING, ppo, {"num_envs": 4, "steps": 4, "epochs": 2}),
    "SHAC": (HEART, shac, {"steps": 2, "num_envs": 4}),
}


def learner_of(form):
    """The learner of this process, whose numbers are float64; worlds themselves are float32."""
    problem, method, options = FORMS[form]
    if method is ppo:
        learner = ppo.PPOLearner(progress_of(problem), ppo.PPOOptions(**options))
    else:
        learner = shac.SHACLearner(progress_of(problem), shac.SHACOptions(**options))
    for module in learner.modules.values():
        module.double()
    if method is ppo:
        observation = learner.buffers.observations[-1].double()
        width = problem.interface.action_dim
        learner.buffers = ppo.RoundBuffers(learner.options, observation, width)
        learner.graphed = ppo.GraphedFunctions(learner)
        learner.critic.updates.zero_()
        learner.critic.observe(observation, learner.processes)
        return learner
    new_worlds = learner._new_worlds
    learner._new_worlds = lambda worlds: new_worlds(worlds).map(
        lambda part: part.double() if part.is_floating_point() else part
    )
    learner.resume(0, 0)
    return learner


def learned(form):
    """What a process has learned in some rounds, and what it has learned it from."""
    learner, means = learner_of(form), []
    for share_left in (1.0, 0.5):
        if isinstance(learner, ppo.PPOLearner):
            batch = learner.play()
            learner.improve(share_left)
            values = batch.advantages.square().mean(), batch.targets.mean()
        else:
            values = learner.play().losses[-1].mean(), learner.objective(learner.play())
            learner.learn(0.01 * share_left)
        means.append([float(part.detach()) for part in values])
    weights = [
        weight for module in learner.modules.values() for weight in module.state_dict().values()
    ]
    return means, [
        weight.flatten().tolist() for weight in weights if isinstance(weight, torch.Tensor)
    ]


@pytest.fixture(scope="module", autouse=True)
def loaded_kernels(request):
    """Load once what each forked process would have to load by itself.

    By the fixture `device` all tests here would be run on a GPU as well, where a process that has
    used CUDA cannot be forked.
    """
    for form in QUICK if request.config.getoption("--device") == "cpu" else ():
        learned(form)


QUICK = ("PPO of species that die", "SHAC")


@pytest.mark.parametrize(
    "form",
    [form if form in QUICK else pytest.param(form, marks=pytest.mark.slow) for form in FORMS],
)
def test_two_processes_learn_what_one_does(form, tmp_path):
    ((one, weights),) = on_ranks(1, lambda: learned(form), tmp_path)
    both = on_ranks(2, lambda: learned(form), tmp_path)
    assert both[0][1] == both[1][1]
    for ours, theirs in zip(both[0][1], weights, strict=True):
        assert ours == pytest.approx(theirs, rel=1e-9, abs=1e-11)
    # Each has seen half of the worlds.
    for first, second, whole in zip(both[0][0], both[1][0], one, strict=True):
        means = [(a + b) / 2 for a, b in zip(first, second, strict=True)]
        assert means == pytest.approx(whole, rel=1e-9, abs=1e-11)


METHODS = {"ppo": {"num_envs": 4, "steps": 3}, "shac": {"num_envs": 4, "steps": 2}}
ROUND = {"ppo": 3 * 4 * 48, "shac": 2 * 4 * 48}
"""Particle-steps of an iteration."""


def run_in(method, out, rounds, **options):
    """Learn for some rounds; what is learned, and the particle-steps of the curve's entries."""
    budget, options = Budget(particle_steps=rounds * ROUND[method]), METHODS[method] | options
    options = {"evaluation_seeds": range(500, 502), "curve_points": 2, "out": out} | options
    trained = train(method, HEART, budget, 0, **options)
    weights = [weight.flatten().tolist() for weight in trained.rules.parameters()]
    return weights, [entry.particle_steps // ROUND[method] for entry in trained.log]


@pytest.mark.parametrize(
    "method", [pytest.param("ppo", marks=pytest.mark.slow), "shac"], ids=["ppo", "shac"]
)
def test_a_run_of_two_processes_goes_on_alike_with_any_number_of_processes(method, tmp_path):
    run = tmp_path / "run"
    one, other = on_ranks(2, lambda: run_in(method, run, 4), tmp_path)
    assert one == other
    assert one[1] == [0, 2, 4]
    assert sorted(path.name for path in run.iterdir()) == [
        ".lock", "checkpoint.pt", "log.jsonl", "rule-0.safetensors"
    ]  # fmt: skip
    ends = []
    for count in (1, 2):
        copy = shutil.copytree(run, tmp_path / str(count))
        ends += on_ranks(count, lambda out=copy: run_in(method, out, 8, resume=True), tmp_path)
    # Within what float32 makes of sums in another order.
    for ours, theirs in zip(ends[1][0], ends[0][0], strict=True):
        assert ours == pytest.approx(theirs, rel=1e-3, abs=1e-5)
    # A process that has no others draws otherwise.
    weights, steps = run_in(method, run, 8, resume=True)
    # It has gone on from where it was, with the entries that there were.
    assert steps == [0, 2, 4, 8]
    assert weights != one[0]
    lines = (run / "log.jsonl").read_text(encoding="utf-8").splitlines()
    assert [json.loads(line)["particle_steps"] // ROUND[method] for line in lines] == steps
    rule = load_rule(run / "rule-0.safetensors")
    assert [weight.flatten().tolist() for weight in rule.parameters()] == weights


def test_a_run_that_is_asked_to_stop_can_be_resumed(tmp_path, monkeypatch):
    improve = ppo.PPOLearner.improve

    def asked(learner, share_left):
        improve(learner, share_left)
        if learner.rounds == 3 and not learner.processes.rank:
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(ppo.PPOLearner, "improve", asked)
    start = RuleSet.new(HEART, 3)
    # Seeds of evaluations are read once.
    seeds = iter([500, 501])
    assert run_in("ppo", tmp_path, 8, start=start, evaluation_seeds=seeds)[1] == [0, 3]
    assert load_checkpoint(tmp_path / "checkpoint.pt")["iteration"] == 3
    monkeypatch.undo()
    assert run_in("ppo", tmp_path, 8, start=start, resume=True)[1] == [0, 3, 4, 8]


def test_a_shared_run_that_goes_on_by_seconds_evaluates_at_their_shares(tmp_path):
    def learn(seconds, **options):
        budget, options = Budget(seconds=seconds), METHODS["ppo"] | options
        options |= {"evaluation_seeds": [500], "curve_points": 2, "out": tmp_path / "run"}
        return len(train("ppo", HEART, budget, 0, **options).log)

    def resumed():
        spent = load_checkpoint(tmp_path / "run" / "checkpoint.pt")["seconds"]
        return learn(1.6 * spent, resume=True)

    # Of the first, of two shares, and at the end: that is where the second share ends.
    (first,) = on_ranks(1, lambda: learn(0.5), tmp_path)
    # Five eighths are spent: there is one more share, and no look before it.
    assert on_ranks(1, resumed, tmp_path) == [first + 1]


@pytest.fixture
def finished(tmp_path):
    """The folder of a run of one round."""
    run_in("ppo", tmp_path, 1)
    return tmp_path


@pytest.mark.parametrize(
    ("method", "options", "message"),
    [
        ("ppo", {}, "holds one: resume it"),
        ("ppo", {"resume": True, "start": RuleSet.new(HEART, 3), **METHODS["ppo"]}, "in started"),
        ("shac", {"resume": True}, "differs in method, options"),
        ("evolution", {"resume": True}, "cannot be kept in a folder"),
    ],
)
def test_a_folder_with_another_run_is_refused(method, options, message, finished):
    refused(message, train, method, HEART, Budget(particle_steps=1), 0, out=finished, **options)


def test_a_checkpoint_that_was_changed_is_refused(finished):
    content = load_checkpoint(finished / "checkpoint.pt")
    spoilt = [{"curve": []}, {"iteration": -1}, {"resumptions": "x"}, {"optimisers": {"actor": {}}}]
    name = next(iter(content["modules"]["actor"]))
    modules = content["modules"] | {"actor": content["modules"]["actor"] | {name: torch.ones(1)}}
    for change in (*spoilt, {"modules": modules}):
        save_checkpoint(finished / "checkpoint.pt", content | change)
        refused("must hold all that a run needs", run_in, "ppo", finished, 2, resume=True)


@pytest.mark.parametrize(
    ("method", "options", "message"),
    [
        ("evolution", {}, "'evolution' cannot be shared by processes: take one of ppo, shac"),
        (
            "ppo",
            {"num_envs": 3},
            "num_envs must be a multiple of the number of processes, got 3 and 2",
        ),
    ],
)
def test_what_cannot_be_shared_is_refused(method, options, message, tmp_path):
    def learn():
        train(method, HEART, Budget(particle_steps=1), 0, **options)

    first, second = on_ranks(2, learn, tmp_path)
    assert message in first
    assert message in second
