"""Several pictures in one environment: which is asked for, what is paid, what is told."""

import gymnasium
import numpy as np
import pytest
import torch
from small_envs import assert_same, make, make_vec

from npa_envs import NPAError
from npa_envs.agents import RandomPolicy, ZeroPolicy
from npa_envs.agents.learning import Problem
from npa_envs.tasks.targets.points import load_target

NAME = "npa/Pictures2D-v0"
TOLD = 4 * 4 * 4
"""Columns that tell of the target."""

TARGETS = {"train": ("heart", "ring"), "test": ("letter-a", "gecko")}


@pytest.mark.parametrize("split", TARGETS)
def test_each_split_asks_for_all_of_its_pictures_and_for_no_other(split):
    given = {"targets": TARGETS["train"], "test_targets": TARGETS["test"]}
    envs = make_vec(NAME, 60, split=split, **given)
    _, infos = envs.reset(seed=0)
    assert envs.unwrapped.task.names == TARGETS[split]
    counts = np.bincount(infos["target"])
    assert len(counts) == 2
    assert counts.min() > 15


def test_a_world_is_paid_for_its_own_picture():
    envs = make_vec(NAME, 12, particle_count=400, resolution=32)
    _, infos = envs.reset(seed=1)
    asked = infos["target"]
    assert set(asked) == {0, 1}
    for number, name in enumerate(TARGETS["train"]):
        target = load_target(name, point_count=400)
        chosen = torch.linspace(0, target.point_count - 1, 400).round().long()
        s = torch.zeros(12, 400, 16)
        s[..., -3:] = target.colours[chosen] - 0.5
        envs.unwrapped.place_particles(target.points[chosen].expand(12, -1, -1), s)
        loss = envs.unwrapped.worlds.loss.numpy()
        assert loss[asked == number].max() < 0.25 * loss[asked != number].min()


def test_rows_end_with_the_picture_that_is_asked_for(device):
    where = {"device": str(device)}
    plain, told = (make_vec(NAME, 6, observe_target=on, **where) for on in (False, True))
    (rows, infos), (wide, _) = plain.reset(seed=0), told.reset(seed=0)
    assert wide.shape[-1] == rows.shape[-1] + TOLD
    assert_same(wide[..., :-TOLD], rows)
    task = told.unwrapped.task
    pictures = task.goal.toward(torch.arange(2, device=device)).target_picture.cpu().numpy()
    for k, number in enumerate(infos["target"]):
        context_info = wide[k, :, -TOLD:].reshape(-1, 4, 4, 4)
        assert (context_info == context_info[0]).all()
        squares = pictures[number].reshape(4, 4, 4, 4, 4).mean(axis=(1, 3))
        np.testing.assert_allclose(context_info[0], squares.transpose(2, 0, 1), atol=1e-6)
    action = told.action_space.sample()
    assert_same(told.step(action)[0][..., :-TOLD], plain.step(action)[0])


def test_a_world_keeps_its_picture_and_a_pool_knows_those_of_its_worlds():
    env = make(NAME, seed_pool=4)
    asked = {}
    for seed in range(30):
        _, info = env.reset(seed=seed)
        start = env.unwrapped.particles()[0].numpy().tobytes()
        assert asked.setdefault(start, info["target"]) == info["target"]
    assert len(asked) == 4
    env.unwrapped.place_particles(*env.unwrapped.particles())
    *_, after = env.step(env.action_space.sample())
    assert after["target"] == info["target"]


def test_policies_act_by_what_particles_perceive():
    env = make(NAME, observe_target=True)
    observation, _ = env.reset(seed=0)
    assert not ZeroPolicy(env)(observation).any()
    assert RandomPolicy(env)(observation).shape == env.action_space.shape
    with pytest.raises(NPAError, match="observation must have shape"):
        ZeroPolicy(env)(observation[:, :-TOLD])


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"targets": ("heart",), "test_targets": ("heart",)}, "among targets, got 'heart' in both"),
        ({"targets": ()}, "targets and test_targets must name a picture each"),
        ({"targets": ("heart", "heart")}, "targets must have different names, got 'heart' twice"),
        ({"test_targets": "heart"}, "targets must be a tuple of names"),
        ({"picture_size": 5}, "picture_size must divide resolution = 64"),
        ({"observe_target": 1}, "observe_target must be True or False"),
        ({"split": "tset"}, "split must be a known word, got 'tset': did you mean 'test'"),
        ({"target": "heart"}, "unexpected keyword argument 'target': did you mean 'targets'"),
    ],
)
def test_a_wrong_choice_of_pictures_is_refused(keywords, message):
    with pytest.raises(NPAError, match=message):
        gymnasium.make(NAME, **keywords)


def test_rules_are_not_taught_where_rows_tell_of_pictures():
    with pytest.raises(NPAError, match="keywords must not have 'observe_target'"):
        Problem(env_id=NAME, episode_steps=4, keywords={"observe_target": True})
