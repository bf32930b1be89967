"""Every registered environment whose actions belong to particles: rewards, endings, targets."""

import gymnasium
import numpy as np
import pytest
import torch
from support.refusals import refused
from support.small_envs import IDS, assert_same, begun, make, make_vec

import npa_envs
from npa_envs import reference
from npa_envs.agents import RandomPolicy, ZeroPolicy
from npa_envs.tasks.targets.picture_points import load_target
from npa_envs.world.randomness import StreamId

CLOSEST_CREDIT = 0.98
"""Correlation of marginal rewards with leave-one-out; the least measured over ids was 0.992."""

every_id = pytest.mark.parametrize("name", IDS)


def actions(env, count, seed=0, scale=1.0):
    random = np.random.default_rng(seed)
    low, high = -scale, scale
    return random.uniform(low, high, (count, *env.action_space.shape)).astype(np.float32)


@pytest.mark.parametrize("limit", [-1, 2, 3])
def test_an_environment_with_episode_steps_rewards_and_ends_its_last_step(limit):
    env = make(IDS[0], reward="sparse", max_episode_steps=limit, episode_steps=2)
    for _ in range(2):
        env.reset(seed=0)
        first, last = (env.step(action) for action in actions(env, 2, scale=0.2))
        assert (first[1], first[3], "reason" in first[4]) == (0.0, False, False)
        assert (last[1], last[3], last[4]["reason"]) == (-last[4]["loss"], True, "time limit")


def test_sparse_rewards_are_refused_without_the_step_that_they_come_in():
    fault, sparse = "episode_steps must be given.*max_episode_steps", {"reward": "sparse"}
    for limit in (None, -1, 64):
        refused(fault, make, IDS[0], max_episode_steps=limit, **sparse)
    refused(fault, make_vec, IDS[0], 2, max_episode_steps=-1, **sparse)
    envs = make_vec(IDS[0], 2, max_episode_steps=3, episode_steps=2, **sparse)
    assert envs.unwrapped.worlds.episode_steps == 2


@every_id
def test_marginal_rewards_are_what_the_world_would_have_lost_without_an_action(name):
    """Leave-one-out, by the loss itself: as the first to act and as the last, averaged."""
    env = make(name, reward="marginal", particle_count=24, tell_updated=True).unwrapped
    env.reset(seed=1)
    env.step(actions(env, 1, scale=0.2)[0])
    before = env.particles()
    *_, info = env.step(actions(env, 1, seed=1, scale=0.2)[0])
    after = env.particles()
    task = env.task
    goal = info.get("label", info.get("target"))
    if goal is not None:
        task = task.with_goal(torch.full((24,), goal))

    def losses(others, own):
        """The loss of 24 worlds, in each of which one particle is as in `own`."""
        x, s = (
            torch.where(torch.eye(24, dtype=torch.bool)[..., None], mine, theirs)
            for theirs, mine in zip(others, own, strict=True)
        )
        return sum(task.losses(x, s).values())

    first = losses(before, before) - losses(before, after)
    last = losses(after, before) - losses(after, after)
    wanted = 24 * (first + last).numpy() / 2
    own = info["particle_reward"]
    assert np.corrcoef(own, wanted)[0, 1] > CLOSEST_CREDIT
    assert np.polyfit(own, wanted, 1)[0] == pytest.approx(1.0, abs=0.15)
    # Those that did nothing share what is missed alike.
    assert len(set(own[~info["updated"]].tolist())) == 1


def test_a_step_after_divergence_rewards_particles_by_their_losses_and_the_world_by_its_own():
    """The loss that a diverged episode ends with may exceed the sum of its parts."""
    env = begun(make(IDS[0], reward="particle", observation_limit=0.5, state_scale=1.0))
    still = np.zeros(env.action_space.shape, np.float32)
    target = env.unwrapped.task.task.target
    s = torch.full((61, 16), 0.4)
    s[:, -3:] = (target.colours - 0.5).clamp(-0.4, 0.4)
    env.unwrapped.place_particles(target.points, s)
    wild = still.copy()
    wild[:, 2] = 1.0
    *_, before = env.step(wild)
    assert before["diverged"]
    back = -0.1 * wild
    back[:30, 0] = 1.0
    _, reward, _, _, after = env.step(back)
    parts = [sum(v for k, v in info.items() if k.startswith("loss_")) for info in (before, after)]
    assert before["loss"] > parts[0]
    assert reward == pytest.approx(before["loss"] - after["loss"], abs=1e-6)
    assert after["particle_reward"].std() > 0.0
    assert after["particle_reward"].mean() == pytest.approx(parts[0] - parts[1], abs=1e-5)


@every_id
def test_zero_actions_leave_the_world_as_it_is_up_to_the_registered_limit(name):
    env = make(name, success_loss=0.0)
    start, _ = env.reset(seed=0)
    still = np.zeros(env.action_space.shape, np.float32)
    steps = [env.step(still) for _ in range(env.spec.max_episode_steps)]
    assert [step[3] for step in steps] == [False] * (len(steps) - 1) + [True]
    for observation, reward, *_ in steps:
        assert np.array_equal(start, observation)
        assert reward == 0.0


def test_action_moves_masked_particles_by_the_documented_amount():
    env = begun(make(IDS[0], update_prob=0.5, alpha=0.5, state_scale=0.25, dt=0.5))
    x, s = env.unwrapped.particles()
    action = np.zeros(env.action_space.shape, np.float32)
    action[:, 0], action[:, 1], action[:, 2:] = 3.0, 4.0, -1.0
    env.step(action)
    new_x, new_s = env.unwrapped.particles()
    moved = (new_x != x).any(-1)
    assert 10 < int(moved.sum()) < 51
    step = torch.tensor([0.6, 0.8]) * 0.5 * 0.3 * 0.5
    assert torch.allclose((new_x - x)[moved], step.expand(int(moved.sum()), 2), atol=1e-6)
    assert torch.allclose((new_s - s)[moved], torch.tensor(-0.125))
    assert torch.equal(new_s[~moved], s[~moved])


@every_id
@pytest.mark.parametrize("update_prob", [0.5, 1.0])
def test_info_tells_which_particles_the_step_updated(name, update_prob, device):
    given = {"tell_updated": True, "update_prob": update_prob, "device": str(device)}
    env, updated = begun(make(name, **given), seed=4), []
    for action in actions(env, 7, scale=0.2):
        before = env.unwrapped.particles()[1]
        *_, info = env.step(action)
        after = env.unwrapped.particles()[1]
        assert torch.equal((after != before).any(-1).cpu(), torch.from_numpy(info["updated"]))
        updated.append(info["updated"])
    fraction = np.mean(updated)
    assert fraction == 1.0 if update_prob == 1.0 else 0.35 < fraction < 0.65


@pytest.mark.parametrize("score", ["error", "cross_entropy", "accuracy"])
def test_digits_pay_the_score_that_is_asked_for_and_tell_class_and_accuracy(score):
    name = "npa/PointClassification-v0"
    given = {"score": score, "overflow_weight": 0.0, "max_episode_steps": 4, "update_prob": 1.0}
    env = make(name, **given)
    _, info = env.reset(seed=2)
    label = info["label"]
    for action in actions(env, 3):
        _, _, _, _, info = env.step(action)
        assert info["label"] == label
        said = env.unwrapped.particles()[1][:, -10:].double()
        right = (said.argmax(dim=1) == label).double().mean()
        assert info["accuracy"] == pytest.approx(float(right), abs=1e-6)
        expected = {
            "error": (said - torch.eye(10)[label]).square().mean(),
            "cross_entropy": -torch.log_softmax(4.0 * said, dim=1)[:, label].mean(),
            "accuracy": 1.0 - right,
        }[score]
        assert info[f"loss_{score}"] == pytest.approx(float(expected), rel=1e-5)
    # A policy that says the class loudly is right.
    loud = np.zeros(env.action_space.shape, np.float32)
    loud[:, -10 + label] = 1.0
    before = info["loss"]
    for _ in range(4):
        _, _, _, _, info = env.unwrapped.step(loud)
    assert info["accuracy"] > 0.9
    assert score == "error" or info["loss"] < before


def regenerating(**keywords):
    """Small worlds, grown by the rule that is shipped for their target."""
    given = {"particle_count": 32, "grow_steps": 2, "resolution": 16, **keywords}
    return gymnasium.make("npa/Regeneration2D-v0", **given).unwrapped


def test_a_world_of_a_pool_follows_from_its_number_and_split(device):
    given = {"seed_pool": 8, "device": str(device)}
    alone, test = regenerating(**given).task, regenerating(**given, split="test").task
    whole = regenerating(**given).task.pooled(torch.arange(8, device=device))
    for number in (5, 2, 5):
        one = alone.pooled(torch.tensor([number], device=device))
        assert torch.equal(one.x[0], whole.x[number])
        assert torch.equal(one.s[0], whole.s[number])
    others = test.pooled(torch.arange(2, device=device)).x
    assert not any(torch.equal(old, new) for old in whole.x for new in others)


def test_regeneration_begins_with_many_worlds_and_evaluates_with_other_damage():
    starts = {}
    for count, given in ((4, {"seed_pool": 4}), (256, {})):
        env = regenerating(**given, damage="wipe")
        starts[count] = {
            env.reset(seed=seed) and env.particles()[0].numpy().tobytes() for seed in range(40)
        }
    assert (len(starts[4]), len(starts[256]) > 30) == (4, True)

    # Pictures are the same in both splits: what differs is the damage.
    pictures = {"rule": "picture", "seed_pool": 1}
    for given, apart in (({"split_damage": False}, False), ({}, True)):
        train, test = (regenerating(**pictures, **given, split=s) for s in ("train", "test"))
        for seed in range(3):
            begun(train, test, seed=seed)
            damaged = zip(train.particles(), test.particles(), strict=True)
            assert all(torch.equal(one, other) for one, other in damaged) != apart


def test_regeneration_starts_grown_and_damaged():
    grown = npa_envs.load_rule("gecko-v0")
    given = {"particle_count": 512, "grow_steps": 48, "resolution": 64}
    env = begun(regenerating(**given, seed_pool=1, damage="wipe"))
    x, s = env.particles()
    wiped = (s == 0).all(-1)
    assert 10 < int(wiped.sum()) < 400
    assert float((x.amax(0) - x.amin(0)).max()) > 1.0
    random = npa_envs.WorldRandom([0]).substream(StreamId.GROWTH)
    start_x, start_s, *_ = env.task.task.seed(1, generator=random)
    growth = random.substream(StreamId.GROWTH)
    with torch.no_grad():
        expected = npa_envs.rollout(grown, start_x, start_s, 48, generator=growth)
    assert torch.equal(env.task.pooled(torch.tensor([0])).x, expected[0])
    assert torch.equal(x, expected[0][0])


@pytest.mark.parametrize("damage", ["wipe", "cut", "clump", "random"])
def test_every_damage_raises_the_loss(damage):
    given = {"particle_count": 256, "rule": "picture", "resolution": 64}
    env = regenerating(**given, damage=damage, damage_size=0.4)
    pool = env.task.pooled(torch.tensor([0]))
    whole = float(sum(env.task.losses(*pool[:2]).values())[0])
    for seed in range(6):
        _, info = env.reset(seed=seed)
        assert info["loss"] > 1.05 * whole
        start = env.task.start(npa_envs.WorldRandom([seed]))
        healed = 0.8 * whole + 0.2 * info["loss"]
        assert float(start.success_loss) == pytest.approx(healed, rel=1e-5)


@every_id
def test_replaced_particles_are_perceived_and_pay_nothing(name):
    env = begun(make(name))
    x, s = env.unwrapped.particles()
    observation = env.unwrapped.place_particles(x * 2.0, s)
    envs = begun(make_vec(name, 2))
    placed = envs.unwrapped.place_particles(2.0 * x[None], s[None], worlds=[1])
    assert np.array_equal(placed[1], observation)
    config = env.unwrapped.config
    expected = npa_envs.perceive(2.0 * x[None], s[None], 0.3, config.eps0, config.box)[0]
    assert np.array_equal(observation, expected.numpy())
    _, reward, *_ = env.step(np.zeros(env.action_space.shape, np.float32))
    assert reward == 0.0


@pytest.mark.parametrize("readout", ["", "duck"])
def test_pictures_with_a_read_out_show_what_it_says(readout):
    keywords = {"particle_count": 256, "target": "duck", "state_dim": 24, "render_size": 32}
    env = make("npa/Morphogenesis3D-v0", readout=readout, render_mode="rgb_array", **keywords)
    red, green, blue = np.asarray(begun(env).render()).reshape(-1, 3).min(axis=0).astype(float)
    if readout:
        assert min(red, green) > blue + 40
    else:
        assert abs(red - blue) < 2


@pytest.mark.parametrize("name", ["npa/Morphogenesis2D-v0", "npa/Morphogenesis3D-v0"])
def test_a_step_is_the_formula_folded_at_the_walls(name):
    walls = {"boundary": "reflecting", "box_size": 0.8}
    # Steps of up to 0.9.
    env = make(name, update_prob=1.0, alpha=3.0, **walls).unwrapped
    env.reset(seed=0)
    draws = np.random.default_rng(0)
    space_dim = env.task.space_dim
    # Some begin outside, up to five boxes away.
    x = draws.uniform(-2.0, 2.0, (61, space_dim)).astype(np.float32)
    env.place_particles(x, np.zeros((61, 16), np.float32))
    action = draws.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32)
    *_, terminated, _, info = env.step(action)
    moves = action[:, :space_dim].astype(np.float64)
    moves /= np.maximum(1.0, np.linalg.norm(moves, axis=1, keepdims=True))
    free = torch.from_numpy(x + 0.9 * moves)[None]
    expected = reference.reflected(free, (0.8,) * space_dim)[0]
    moved = env.particles()[0].double()
    assert float((moved - expected).abs().max()) < 2e-6
    assert not terminated
    assert not info["diverged"]


# Several pictures in one environment


PICTURES = "npa/Pictures2D-v0"
TARGET_DIM = 4 * 4 * 4
"""Columns of the target in an observation."""

TARGETS = {"train": ("heart", "ring"), "test": ("letter-a", "gecko")}


@pytest.mark.parametrize("split", TARGETS)
def test_each_split_asks_for_all_of_its_pictures_and_for_no_other(split):
    given = {"targets": TARGETS["train"], "test_targets": TARGETS["test"]}
    envs = make_vec(PICTURES, 60, split=split, **given)
    _, infos = envs.reset(seed=0)
    assert envs.unwrapped.task.names == TARGETS[split]
    counts = np.bincount(infos["target"])
    assert len(counts) == 2
    assert counts.min() > 15


def test_a_world_is_paid_for_its_own_picture():
    envs = make_vec(PICTURES, 12, particle_count=400, resolution=32)
    _, infos = envs.reset(seed=1)
    asked = infos["target"]
    assert set(asked) == {0, 1}
    for number, name in enumerate(TARGETS["train"]):
        target = load_target(name, point_count=400)
        chosen = torch.linspace(0, len(target.points) - 1, 400).round().long()
        s = torch.zeros(12, 400, 16)
        s[..., -3:] = target.colours[chosen] - 0.5
        envs.unwrapped.place_particles(target.points[chosen].expand(12, -1, -1), s)
        loss = envs.unwrapped.worlds.loss.numpy()
        assert loss[asked == number].max() < 0.25 * loss[asked != number].min()


def test_rows_end_with_the_picture_that_is_asked_for(device):
    plain, wider = (
        make_vec(PICTURES, 6, observe_target=on, device=str(device)) for on in (False, True)
    )
    (rows, infos), (wide, _) = plain.reset(seed=0), wider.reset(seed=0)
    assert wide.shape[-1] == rows.shape[-1] + TARGET_DIM
    assert_same(wide[..., :-TARGET_DIM], rows)
    task = wider.unwrapped.task
    pictures = task.task.with_goal(torch.arange(2, device=device)).target_picture.cpu().numpy()
    for k, number in enumerate(infos["target"]):
        context_info = wide[k, :, -TARGET_DIM:].reshape(-1, 4, 4, 4)
        assert (context_info == context_info[0]).all()
        squares = pictures[number].reshape(4, 4, 4, 4, 4).mean(axis=(1, 3))
        np.testing.assert_allclose(context_info[0], squares.transpose(2, 0, 1), atol=1e-6)
    action = wider.action_space.sample()
    assert_same(wider.step(action)[0][..., :-TARGET_DIM], plain.step(action)[0])


def test_a_world_keeps_its_picture_and_a_pool_knows_those_of_its_worlds():
    env = make(PICTURES, seed_pool=4)
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
    env = make(PICTURES, observe_target=True)
    observation, _ = env.reset(seed=0)
    assert not ZeroPolicy(env)(observation).any()
    assert RandomPolicy(env)(observation).shape == env.action_space.shape
    refused("observation must have shape", ZeroPolicy(env), observation[:, :-TARGET_DIM])
