"""Worlds whose code the agent chooses: spaces, goals that change, seeds, batches."""

from itertools import pairwise

import gymnasium
import numpy as np
import pytest
import torch
from small_envs import assert_same

import npa_envs
from npa_envs.agents.shapeshifting import RecognisingShapeshifter
from npa_envs.errors import DivergedError, NPAError

ID = "npa/Shapeshifter2D-v0"
NAMES = ("heart", "ring", "letter-a")


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Keywords of small worlds, with a rule that has learned nothing."""
    torch.manual_seed(0)
    rule = npa_envs.NPARule(
        state_dim=8, hidden_dim=8, eps0=0.3, code_dim=3, code_names=NAMES
    ).requires_grad_(False)
    rule.output.weight *= 30.0
    path = tmp_path_factory.mktemp("rule") / "rule.safetensors"
    npa_envs.save_rule(rule, path)
    return {
        "rule": str(path), "state_dim": 8, "eps": 0.3, "eps0": 0.3, "particle_count": 48,
        "resolution": 16, "picture_size": 4, "render_size": 24, "seed_pool": 2, "grow_steps": 3,
        "rule_steps": 2, "hold_steps": 2,
    }  # fmt: skip


@pytest.fixture(autouse=True)
def _no_screen(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


def make(small, **keywords):
    return gymnasium.make(ID, **(small | keywords))


def make_vec(small, world_count, **keywords):
    return gymnasium.make_vec(
        ID, world_count, vectorization_mode="vector_entry_point", **(small | keywords)
    )


def sampled(env, count, seed=0):
    env.action_space.seed(seed)
    return [env.action_space.sample() for _ in range(count)]


def test_a_choice_is_the_code_of_that_number(small):
    by_number, by_code = make(small, actions="choice"), make(small)
    by_number.reset(seed=1)
    by_code.reset(seed=1)
    codes = by_code.unwrapped.task.codes.table
    left, right = by_number.step(2), by_code.step(codes[2].numpy())
    assert_same(left[:4], right[:4])
    _, s = by_code.unwrapped.particles()
    assert torch.equal(s[:, :3], codes[2].expand(48, 3))


def test_goals_change_after_they_were_held_and_are_never_the_same_twice_on_end(small):
    env = make(small)
    _, info = env.reset(seed=3)
    goals = [info["goal"]]
    for action in sampled(env, 40):
        goals.append(env.step(action)[4]["goal"])
    held = [goals[k] for k in range(0, len(goals), 2)]
    assert all(first == second for first, second in zip(goals[::2], goals[1::2], strict=False))
    assert all(first != second for first, second in pairwise(held))
    assert set(goals) == {0, 1, 2}


def test_a_step_is_paid_by_the_goal_that_was_seen_before_it(small):
    env = make(small)
    _, info = env.reset(seed=0)
    task = env.unwrapped.task
    for action in sampled(env, 4):
        goal = info["goal"]
        _, reward, _, _, info = env.step(action)
        x, s = (part[None] for part in env.unwrapped.particles())
        loss = sum(task.toward(torch.tensor([goal])).losses(x, s).values())
        blank = float(task.blank_losses[goal])
        assert reward == pytest.approx(max(-1.0, 1.0 - float(loss) / blank), rel=1e-5)


def test_a_goal_itself_earns_one_and_an_empty_picture_nothing(small):
    task = make(small, resolution=32).unwrapped.task
    single = task.goal.toward(torch.tensor([1]))
    context = torch.tensor([[1.0]])
    no_loss, blank = torch.zeros(1), task.blank_losses[1:2]
    x = s = torch.zeros(1, 1, 1)
    assert task.reward(x, s, no_loss, context).tolist() == [1.0]
    assert task.reward(x, s, blank, context).tolist() == [0.0]
    density = single.target_picture[..., 3]
    assert float(blank) == pytest.approx(float((density + density * density).mean()), rel=1e-6)


def test_the_goals_picture_is_seen_beside_the_worlds(small):
    env = make(small)
    seen, info = env.reset(seed=2)
    assert seen.shape == (128,)
    task = env.unwrapped.task
    target = task.goal.toward(torch.tensor([info["goal"]])).target_picture[0]
    coarse = target.view(4, 4, 4, 4, 4).mean(dim=(1, 3)).permute(2, 0, 1)
    assert seen[64:] == pytest.approx(coarse.flatten().numpy(), abs=1e-6)


@pytest.mark.parametrize("actions", ["code", "choice"])
def test_a_script_recognises_goals_and_says_their_codes(small, actions):
    env = make(small, actions=actions)
    policy = RecognisingShapeshifter(env)
    seen, info = env.reset(seed=0)
    for _ in range(6):
        goal = info["goal"]
        seen, _, _, _, info = env.step(policy(seen))
        _, s = env.unwrapped.particles()
        codes = env.unwrapped.task.codes.table
        assert s[0, :3].numpy() == pytest.approx(codes[goal].numpy(), abs=1e-6)
    batch = make_vec(small, 3, actions=actions)
    seen, _ = batch.reset(seed=0)
    assert RecognisingShapeshifter(batch)(seen).shape[0] == 3
    with pytest.raises(NPAError, match="env must be one whose agent chooses codes"):
        RecognisingShapeshifter(gymnasium.make("npa/Morphogenesis2D-v0", particle_count=32))


def test_bad_actions_are_clear_errors_and_change_nothing(small):
    env, other = make(small), make(small)
    env.reset(seed=0)
    other.reset(seed=0)
    with pytest.raises(NPAError, match=r"action must be real numbers of shape \[K\]"):
        env.unwrapped.step(np.zeros(4, np.float32))
    with pytest.raises(DivergedError, match="action must be finite"):
        env.unwrapped.step(np.full(3, np.nan, np.float32))
    action = np.full(3, 0.5, np.float32)
    assert_same(env.step(action), other.step(action))
    chosen = make(small, actions="choice")
    chosen.reset(seed=0)
    with pytest.raises(NPAError, match="number of one of 3 codes"):
        chosen.unwrapped.step(3)
    with pytest.raises(NPAError, match="whole numbers of shape"):
        chosen.unwrapped.step(0.5)


def test_rules_that_do_not_fit_are_refused(small):
    with pytest.raises(NPAError, match="one of two pictures or more, got 'gecko'"):
        make(small, rule="gecko")
    with pytest.raises(NPAError, match=r"state_dim must be the rule's, 8, got 9"):
        make(small, state_dim=9)
    with pytest.raises(NPAError, match="picture_size must divide"):
        make(small, picture_size=5)
