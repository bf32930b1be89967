"""Datasets of Minari: episodes as they were, to be played again and to be learned from."""

from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from support.learning_problems import heart, wild_rules
from support.refusals import refused

from npa_envs.agents import evaluate_policy
from npa_envs.agents.learning import Budget, train
from npa_envs.agents.learning.problem import registration_of, world_seeds
from npa_envs.cli import main
from npa_envs.cli.common import problem_of
from npa_envs.cli.record_dataset import RecordOptions, policy_of
from npa_envs.errors import DivergedError, NPAError

minari = pytest.importorskip("minari")
pytest.importorskip("h5py")
from npa_envs.wrappers.minari import (  # noqa: E402 (it needs Minari)
    ROOT,
    read_pairs,
    record_episodes,
    spec_of,
    write_dataset,
)


@pytest.fixture(autouse=True)
def root(tmp_path, monkeypatch):
    monkeypatch.setenv(ROOT, str(tmp_path))
    return tmp_path


def recorded(problem, rules, name="npa/test-v0", seeds=range(5)):
    spec = spec_of(problem.env_id, dict(problem.keywords), problem.episode_steps)
    episodes = record_episodes(problem.make_envs(), rules.policy(), seeds)
    write_dataset(name, spec, episodes, algorithm="wild", description="a test")
    return minari.load_dataset(name)


def test_a_recorded_episode_is_what_happened_and_can_be_played_again():
    problem = heart(episode_steps=3)
    rules = wild_rules(problem)
    dataset = recorded(problem, rules)
    expected = evaluate_policy(problem.make_envs(), rules.policy(), range(5))
    assert (dataset.total_episodes, dataset.total_steps) == (5, 15)
    env = dataset.recover_environment()
    for k, episode in enumerate(dataset.iterate_episodes()):
        assert episode.rewards.sum() == pytest.approx(expected.returns[k], abs=1e-5)
        assert episode.infos["loss"][0] == pytest.approx(expected.start_losses[k])
        assert episode.infos["loss"][-1] == pytest.approx(expected.final_losses[k])
        assert episode.truncations.tolist() == [False, False, True]
        seen = [env.reset(seed=k)[0]]
        seen += [env.step(action)[0] for action in episode.actions]
        assert np.array_equal(np.stack(seen), episode.observations)
    # Pairs are all that was seen with what was done then.
    seen, done = read_pairs("npa/test-v0")
    assert seen.shape == (15, problem.particle_count, problem.interface.perception_dim)
    assert (rules.policy()(seen) - done).abs().max() < 1e-5


def test_gardens_are_recorded_in_the_shape_of_their_actions():
    keywords = {"particle_count": 64, "seed_pool": 1, "grow_steps": 4}
    for shape in ("flat", "brushes"):
        fields = {"num_envs": 2, "max_episode_steps": 2, **keywords, "action_shape": shape}
        envs = gymnasium.make_vec("npa/Gardener2DSmall-v0", **fields)
        for policy in (lambda seen: np.ones((2, 32)), lambda seen: np.ones((2, 16, 2))):
            (episode, _) = record_episodes(envs, policy, range(2))
            assert episode.actions.shape == (2, *envs.single_action_space.shape)


def test_a_dataset_is_written_whole_or_not_at_all(root):
    problem = heart(episode_steps=2)
    rules = wild_rules(problem)

    def broken():
        yield from record_episodes(problem.make_envs(), rules.policy(), range(2))
        raise KeyboardInterrupt

    spec = spec_of(problem.env_id, dict(problem.keywords), 2)
    with pytest.raises(KeyboardInterrupt):
        write_dataset("npa/test-v0", spec, broken(), algorithm="wild", description="a test")
    assert not list(root.iterdir())
    recorded(problem, rules)
    refused("'npa/test-v0' exists already", recorded, problem, rules)
    refused("there is no dataset 'npa/other-v0'", read_pairs, "npa/other-v0")
    with pytest.raises(NPAError, match="must be an id with a version, got 'no version'"):
        recorded(problem, rules, "no version")
    assert not list(root.glob(".*"))


def test_a_policy_that_diverges_while_it_is_recorded_is_told_as_that(root):
    problem = heart(episode_steps=3)
    spec = spec_of(problem.env_id, {}, 3)
    episodes = record_episodes(problem.make_envs(), lambda seen: seen[..., :6] * np.nan, range(2))
    with pytest.raises(DivergedError, match=r"^action must be finite"):
        write_dataset("npa/test-v0", spec, episodes, algorithm="wild", description="a test")
    assert list(root.iterdir()) == []


def test_rules_learn_from_a_dataset_without_a_world(monkeypatch):
    problem = heart(episode_steps=4)
    teacher = wild_rules(problem)
    recorded(problem, teacher)
    options = {"dataset": "npa/test-v0", "batch_worlds": 4, "updates": 8}
    steps = 4 * 8 * problem.particle_count
    trained = train(
        "clone", problem, Budget(particle_steps=60 * steps), 0, curve_points=1, **options
    )
    seen, done = read_pairs("npa/test-v0")
    error = (trained.policy(seen) - done).square().mean() / done.var()
    assert error < 0.1
    assert trained.log[-1].particle_steps == 60 * steps
    with pytest.raises(NPAError, match="teacher must be None with a dataset"):
        train("clone", problem, Budget(particle_steps=1), 0, teacher=list(teacher), **options)
    other = heart(particle_count=32)
    refused(
        "record it in this problem", train, "clone", other, Budget(particle_steps=1), 0, **options
    )


def recording(env, policy, dataset, words):
    """Return the exit status of a command that records small worlds."""
    command = f"record-dataset npa/{env}-v0 --policy {policy} --dataset npa/{dataset} {words}"
    command += " --no-progress --keywords particle_count=32 seed_pool=1"
    return main(command.split())


@pytest.mark.parametrize(
    ("env", "policy", "names"),
    [
        ("Gardener2DSmall", "zero", None),
        ("Shepherd2DSmall", "scripted", {"observation", "achieved_goal", "desired_goal"}),
    ],
)
def test_the_command_records_any_policy(root, capsys, env, policy, names):
    assert recording(env, policy, f"{policy}-v0", f"--episodes 3 --num-envs 2 --root {root}") == 0
    assert "3 episodes, mean return" in capsys.readouterr().out
    dataset = minari.load_dataset(f"npa/{policy}-v0")
    assert (dataset.total_episodes, dataset.total_steps) == (3, 96)
    first = dataset[0]
    assert bool(first.actions.any()) == (policy != "zero")
    assert names is None or first.observations.keys() == names


@pytest.mark.parametrize("words", ["--root={0}", "--root {0}/./"])
def test_the_folder_of_datasets_is_not_published_however_it_is_given(root, words, capsys):
    garden = "Gardener2DSmall", "zero"
    assert recording(*garden, "it-v0", f"--episodes 1 {words.format(root)}") == 0
    described = minari.load_dataset("npa/it-v0").storage.metadata["description"]
    assert str(root) not in described
    assert "ROOT" in described
    (root / "file").touch()
    assert recording(*garden, "it-v2", f"--episodes 1 --root {root}/file") == 2
    assert "root must be a folder that can be" in capsys.readouterr().err


def test_episodes_of_an_environment_of_ones_own_are_as_long_as_it_is_registered():
    small = gymnasium.spec("npa/Morphogenesis2DSmall-v0")
    gymnasium.register(
        id="mine/Growth-v0",
        entry_point=small.entry_point,
        vector_entry_point=small.vector_entry_point,
        max_episode_steps=3,
        kwargs=small.kwargs,
    )
    try:
        assert registration_of("mine/Growth-v0").steps == 3
        words = "record-dataset mine/Growth-v0 --policy zero --episodes 2 --no-progress"
        assert main([*words.split(), "--dataset", "npa/own-v0"]) == 0
        assert minari.load_dataset("npa/own-v0").total_steps == 6
    finally:
        del gymnasium.registry["mine/Growth-v0"]


@pytest.mark.parametrize(
    ("first", "count", "seed"), [(0, 16, 1), (9_999, 1, 1), (9_999, 2, 2), (2_000_000, 16, 0)]
)
def test_a_scripted_policy_is_chosen_in_worlds_that_are_not_recorded(
    first, count, seed, monkeypatch
):
    seeds = []
    monkeypatch.setattr(
        "npa_envs.agents.learning.train",
        lambda method, problem, budget, seed, **_: seeds.append(seed) or SimpleNamespace(policy=0),
    )
    fields = {"env": "npa/Morphogenesis2DSmall-v0", "dataset": "a/b-v0", "policy": "scripted"}
    options = RecordOptions(**fields, first_seed=first, episodes=count)
    policy_of(options, problem_of(options, 1))
    assert seeds == [seed]
    assert set(world_seeds(seed, 16)).isdisjoint(range(first, first + count))
