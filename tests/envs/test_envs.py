"""Every registered environment whose actions belong to particles: rewards, endings, targets."""

import subprocess
import sys

import gymnasium
import numpy as np
import pytest
import torch
from refusals import refused
from small_envs import IDS, assert_same, begun, make, make_vec

import npa_envs
from npa_envs.agents import RandomPolicy, ZeroPolicy
from npa_envs.tasks.targets.points import load_target
from npa_envs.world.randomness import StreamId

CLOSEST_CREDIT = 0.98
"""Correlation of marginal rewards with leave-one-out; the least measured over ids was 0.992."""

every_id = pytest.mark.parametrize("name", IDS)


def actions(env, count, seed=0, scale=1.0):
    random = np.random.default_rng(seed)
    low, high = -scale, scale
    return random.uniform(low, high, (count, *env.action_space.shape)).astype(np.float32)


@pytest.mark.parametrize(
    "program",
    [
        "import gymnasium; gymnasium.make('npa_envs:npa/Morphogenesis2D-v0', particle_count=8)",
        "import npa_envs, gymnasium; name = 'npa/Morphogenesis2D-v0'\n"
        "gymnasium.make(name, particle_count=8)\n"
        "gymnasium.make_vec(name, 2, vectorization_mode='vector_entry_point', particle_count=8)",
    ],
)
def test_ids_are_found_in_a_fresh_process(program):
    done = subprocess.run([sys.executable, "-W", "error", "-c", program], capture_output=True)
    assert done.returncode == 0, done.stderr.decode()


@pytest.mark.filterwarnings("ignore:an episode ended")
def test_sparse_reward_is_paid_at_whatever_limit_stands_around_the_environment():
    inner = make(IDS[0], reward="sparse", max_episode_steps=-1, episode_steps=2)
    limited = gymnasium.wrappers.TimeLimit(inner, 3)
    for env, last in ((inner, 2), (limited, 3), (inner, 2)):
        env.reset(seed=0)
        paid = [env.step(action)[1] != 0.0 for action in actions(env, 4, scale=0.2)]
        assert paid == [step + 1 == last for step in range(4)]


class Repeated(gymnasium.Wrapper):
    """Takes each action twice, as wrappers for video games do."""

    def step(self, action):
        self.env.step(action)
        return self.env.step(action)


def test_a_limit_that_counts_other_steps_ends_nothing_early():
    env = begun(gymnasium.wrappers.TimeLimit(Repeated(make(IDS[0], max_episode_steps=-1)), 3))
    ends = [env.step(action)[3] for action in actions(env, 3, scale=0.2)]
    assert ends == [False, False, True]


def test_sparse_reward_that_was_cut_off_is_told():
    env = begun(make(IDS[0], reward="sparse", max_episode_steps=-1))
    for action in actions(env, 3, scale=0.2):
        env.step(action)
    with pytest.warns(UserWarning, match="ended 3 steps after the last sparse reward"):
        env.reset()


@every_id
@pytest.mark.parametrize("reward_form", ["particle", "marginal"])
def test_particle_rewards_average_to_the_dense_reward(name, reward_form):
    env, dense = begun(make(name, reward=reward_form), make(name))
    for action in actions(env, 10, scale=0.2):
        _, reward, _, _, info = env.step(action)
        assert reward == dense.step(action)[1]
        parts = sum(v for k, v in info.items() if k.startswith("reward_"))
        assert parts == pytest.approx(reward, rel=1e-4, abs=1e-5)
        own = info["particle_reward"]
        assert own.shape == (61,)
        assert own.mean() == pytest.approx(reward, rel=1e-3, abs=2e-6)
        assert own.std() > 0


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
        task = task.toward(torch.full((24,), goal))

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


@every_id
@pytest.mark.parametrize(
    ("limits", "reason"),
    [
        ({"success_loss": 1e9}, "success"),
        ({"observation_limit": 1e-3}, "diverged"),
        ({"position_limit": 0.21}, "diverged"),
        ({"position_noise": 1e6}, "diverged"),
    ],
)
def test_an_episode_that_ends_says_why_and_divergence_does_not_pay(name, limits, reason):
    if "Texture" in name and limits.keys() & {"position_limit", "position_noise"}:
        pytest.skip("nobody leaves a periodic box")
    env = begun(make(name, update_prob=1.0, **limits))
    observation, reward, terminated, _, info = env.step(actions(env, 1)[0])
    assert terminated
    diverged = reason == "diverged"
    assert (info["success"], info["diverged"], info["reason"]) == (not diverged, diverged, reason)
    assert reward <= 0.0 or not diverged
    assert np.isfinite(observation).all()
    assert np.isfinite(info["loss"])


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
    _, reward, _, _, after = env.step(-0.1 * wild)
    parts = [sum(v for k, v in info.items() if k.startswith("loss_")) for info in (before, after)]
    assert before["loss"] > parts[0]
    assert reward == pytest.approx(before["loss"] - after["loss"], abs=1e-6)
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
    envs, env = begun(
        make_vec(name, 2, **given, max_episode_steps=3),
        make(name, **given, max_episode_steps=3),
        seed=4,
    )
    seen = []
    for action in actions(env, 7, scale=0.2):
        before = env.unwrapped.particles()[1]
        *_, over, info = env.step(action)
        after = env.unwrapped.particles()[1]
        assert torch.equal((after != before).any(-1).cpu(), torch.from_numpy(info["updated"]))
        *_, infos = envs.step(np.stack([action, action]))
        told = infos["final_info"] if over else infos
        assert np.array_equal(told["updated"][0], info["updated"])
        seen.append(info["updated"])
        if over:
            env.reset()
    share = np.mean(seen)
    assert share == 1.0 if update_prob == 1.0 else 0.35 < share < 0.65


@pytest.mark.parametrize("score", ["error", "cross_entropy", "accuracy"])
def test_digits_pay_the_score_that_is_asked_for_and_tell_class_and_accuracy(score):
    name = "npa/PointClassification-v0"
    given = {"score": score, "overflow_weight": 0.0, "max_episode_steps": 4, "update_prob": 1.0}
    env, envs = make(name, **given), make_vec(name, 3, **given)
    _, info = env.reset(seed=2)
    envs.reset(seed=1)
    label = info["label"]
    for action in actions(env, 3):
        _, _, _, _, info = env.step(action)
        *_, infos = envs.step(np.stack([action] * 3))
        assert info["label"] == label == infos["label"][1]
        assert infos["accuracy"][1] == info["accuracy"]
        assert infos["loss"][1] == info["loss"]
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
    for _ in range(3):
        env.unwrapped.step(loud)
    _, _, _, _, info = env.unwrapped.step(loud)
    assert info["accuracy"] > 0.9
    assert score == "error" or info["loss"] < before


def test_seed_pool_repeats_its_starts():
    env = make(IDS[0], seed_pool=3)
    starts = {env.reset(seed=seed)[0].tobytes() for seed in range(20)}
    assert len(starts) == 3


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
    config = env.unwrapped.config
    expected = npa_envs.perceive(2.0 * x[None], s[None], 0.3, config.eps0, config.box)[0]
    assert np.array_equal(observation, expected.numpy())
    _, reward, *_ = env.step(np.zeros(env.action_space.shape, np.float32))
    assert reward == 0.0


def test_pictures_with_a_read_out_show_what_it_says():
    shades = []
    for readout in ("", "duck"):
        keywords = {"particle_count": 256, "target": "duck", "state_dim": 24, "render_size": 32}
        env = make("npa/Morphogenesis3D-v0", readout=readout, render_mode="rgb_array", **keywords)
        env.reset(seed=0)
        red, green, blue = np.asarray(env.render()).reshape(-1, 3).min(axis=0).astype(float)
        shades.append((red - blue, green - blue))
    (grey, _), (yellow, also_green) = shades
    assert abs(grey) < 2
    assert yellow > 40
    assert also_green > 40


@pytest.mark.gpu
@pytest.mark.parametrize("name", ["npa/Morphogenesis2D-v0", "npa/Gardener2D-v0"])
def test_arrays_of_a_gpu_are_its_tensors_and_stay(name):
    traces = []
    for output in ("numpy", "torch"):
        env = make(name, device="cuda", output=output)
        trace = [env.reset(seed=3)]
        space = env.action_space
        space.seed(0)
        trace += [env.step(space.sample()) for _ in range(5)]
        copies = [np.array(seen) if output == "numpy" else seen.clone() for seen, *_ in trace]
        trace += [env.step(space.sample()) for _ in range(2)]
        assert_same(copies, [seen for seen, *_ in trace[:6]])
        traces.append(trace)
    assert_same(*traces)


# Several pictures in one environment


PICTURES = "npa/Pictures2D-v0"
TOLD = 4 * 4 * 4
"""Columns that tell of the target."""

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
        chosen = torch.linspace(0, target.point_count - 1, 400).round().long()
        s = torch.zeros(12, 400, 16)
        s[..., -3:] = target.colours[chosen] - 0.5
        envs.unwrapped.place_particles(target.points[chosen].expand(12, -1, -1), s)
        loss = envs.unwrapped.worlds.loss.numpy()
        assert loss[asked == number].max() < 0.25 * loss[asked != number].min()


def test_rows_end_with_the_picture_that_is_asked_for(device):
    where = {"device": str(device)}
    plain, told = (make_vec(PICTURES, 6, observe_target=on, **where) for on in (False, True))
    (rows, infos), (wide, _) = plain.reset(seed=0), told.reset(seed=0)
    assert wide.shape[-1] == rows.shape[-1] + TOLD
    assert_same(wide[..., :-TOLD], rows)
    task = told.unwrapped.task
    pictures = task.task.toward(torch.arange(2, device=device)).target_picture.cpu().numpy()
    for k, number in enumerate(infos["target"]):
        context_info = wide[k, :, -TOLD:].reshape(-1, 4, 4, 4)
        assert (context_info == context_info[0]).all()
        squares = pictures[number].reshape(4, 4, 4, 4, 4).mean(axis=(1, 3))
        np.testing.assert_allclose(context_info[0], squares.transpose(2, 0, 1), atol=1e-6)
    action = told.action_space.sample()
    assert_same(told.step(action)[0][..., :-TOLD], plain.step(action)[0])


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
    refused("observation must have shape", ZeroPolicy(env), observation[:, :-TOLD])
