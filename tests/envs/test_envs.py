"""Every registered environment: Gymnasium's rules, seeds, rewards, endings, bad input."""

import json
import pickle
import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
import torch
from small_envs import IDS, assert_same, make, make_vec, small

import npa_envs
from npa_envs.envs import multispecies_v0
from npa_envs.errors import NPAError
from npa_envs.world.randomness import StreamId

CLOSEST_CREDIT = 0.98
"""Correlation of marginal rewards with leave-one-out; the least measured over ids was 0.992."""

every_id = pytest.mark.parametrize("name", IDS)


@pytest.fixture(autouse=True)
def _no_screen(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


def actions(env, count, seed=0, scale=1.0):
    random = np.random.default_rng(seed)
    low, high = -scale, scale
    return random.uniform(low, high, (count, *env.action_space.shape)).astype(np.float32)


def episode(env, seed, count=12, beside=None):
    """What an environment returns, while another one, if there is, is stepped in turn with it."""
    trace = [env.reset(seed=seed)]
    if beside is not None:
        beside.reset(seed=seed + 1)
    for action in actions(env, count):
        trace.append(env.step(action))
        if beside is not None:
            beside.step(-action)
    return trace


@every_id
def test_spec_survives_pickling_and_json(name):
    spec = make(name).spec
    again = pickle.loads(pickle.dumps(spec))
    assert again == spec
    read = gymnasium.envs.registration.EnvSpec.from_json(spec.to_json())
    assert json.loads(read.to_json()) == json.loads(spec.to_json())
    assert_same(episode(gymnasium.make(read), 3, 2), episode(make(name), 3, 2))
    batched = pickle.loads(pickle.dumps(make_vec(name, 2).spec))
    assert gymnasium.make_vec(batched).num_envs == 2


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


@every_id
def test_an_episode_follows_from_its_seed_or_generator_and_from_nothing_else(name):
    first, second = make(name), make(name)
    trace = episode(first, 5)
    assert_same(trace, episode(second, 5, beside=make(name)))
    following = first.reset()
    assert_same(trace, episode(first, 5))
    assert_same(following, first.reset())
    assert not np.array_equal(following[0], trace[0][0])
    assert not np.array_equal(trace[-1][0], episode(second, 6)[-1][0])
    first.unwrapped.np_random = np.random.default_rng(5)
    assert np.array_equal(first.reset()[0], trace[0][0])


@every_id
@pytest.mark.parametrize("copy", [True, False])
def test_an_environment_survives_pickling_in_the_midst_of_an_episode(name, copy, device):
    """All that a step returns is the same after, beyond the end of the episode."""
    env = make(name, device=str(device)).unwrapped
    batch = make_vec(name, 2, device=str(device), copy=copy, max_episode_steps=5)
    env.reset(seed=0)
    batch.reset(seed=0)
    for action in actions(env, 3):
        env.step(action)
        batch.step(np.stack([action, action]))
    again, batch_again = pickle.loads(pickle.dumps((env, batch)))
    for action in actions(env, 4, seed=1):
        assert_same(env.step(action), again.step(action))
        both = np.stack([action, action])
        assert_same(batch.step(both), batch_again.step(both))


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
    env = gymnasium.wrappers.TimeLimit(Repeated(make(IDS[0], max_episode_steps=-1)), 3)
    env.reset(seed=0)
    ends = [env.step(action)[3] for action in actions(env, 3, scale=0.2)]
    assert ends == [False, False, True]


def test_reset_takes_numbers_of_numpy_of_one_world_and_of_many():
    single, vector = make(IDS[0]), make_vec(IDS[0], 2)
    single.reset(options={})
    with pytest.raises(NPAError, match="options must be a dict or None, got int"):
        single.unwrapped.reset(options=3)
    observation, _ = single.reset(seed=3)
    assert np.array_equal(single.reset(seed=np.int64(3))[0], observation)
    assert np.array_equal(vector.reset(seed=np.int64(3))[0][0], observation)
    species = multispecies_v0.parallel_env("mixing", particle_counts=[24, 17], eps=0.3)
    first, again = (species.reset(seed=kind(3))[0] for kind in (int, np.int64))
    assert all(np.array_equal(first[agent], again[agent]) for agent in first)


def test_sparse_reward_that_was_cut_off_is_told():
    env = make(IDS[0], reward="sparse", max_episode_steps=-1)
    env.reset(seed=0)
    for action in actions(env, 3, scale=0.2):
        env.step(action)
    with pytest.warns(UserWarning, match="ended 3 steps after the last sparse reward"):
        env.reset()


@every_id
@pytest.mark.parametrize("reward_form", ["particle", "marginal"])
def test_particle_rewards_average_to_the_dense_reward(name, reward_form):
    env, dense = make(name, reward=reward_form), make(name)
    env.reset(seed=0)
    dense.reset(seed=0)
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
    env = make(name, update_prob=1.0, **limits)
    env.reset(seed=0)
    observation, reward, terminated, _, info = env.step(actions(env, 1)[0])
    assert terminated
    diverged = reason == "diverged"
    assert (info["success"], info["diverged"], info["reason"]) == (not diverged, diverged, reason)
    assert reward <= 0.0 or not diverged
    assert np.isfinite(observation).all()
    assert np.isfinite(info["loss"])


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
    env = make(IDS[0], update_prob=0.5, alpha=0.5, state_scale=0.25, dt=0.5)
    env.reset(seed=0)
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
    envs = make_vec(name, 2, **given, max_episode_steps=3)
    env = make(name, **given, max_episode_steps=3)
    envs.reset(seed=4)
    env.reset(seed=4)
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


def test_a_test_split_grows_other_worlds_than_those_to_learn_from():
    name, given = "npa/Regeneration2D-v0", {"particle_count": 64, "grow_steps": 4, "seed_pool": 2}
    train, same, test = (
        gymnasium.make(name, **given, split=split).unwrapped.task.pooled(torch.arange(2)).x
        for split in ("train", "train", "test")
    )
    assert torch.equal(train, same)
    assert not any(torch.equal(old, new) for old in train for new in test)
    with pytest.raises(NPAError, match="split must be 'train' where seed_pool=0"):
        gymnasium.make(name, **(given | {"seed_pool": 0}), split="test")
    with pytest.raises(NPAError, match="split must be 'train' or 'test', got 'eval'"):
        gymnasium.make(name, **given, split="eval")
    # The millionth world is where those of the test split begin.
    with pytest.raises(NPAError, match="seed_pool must be at most 1000000, got 1000001"):
        gymnasium.make(name, **(given | {"seed_pool": 1_000_001}))


def test_regeneration_begins_with_many_worlds_and_evaluates_with_other_damage():
    tiny = {"particle_count": 32, "grow_steps": 2, "resolution": 16}
    starts = {}
    for count, given in ((4, {"seed_pool": 4}), (256, {})):
        env = gymnasium.make("npa/Regeneration2D-v0", **tiny, **given, damage="wipe")
        starts[count] = {
            env.reset(seed=seed) and env.unwrapped.particles()[0].numpy().tobytes()
            for seed in range(40)
        }
    assert (len(starts[4]), len(starts[256]) > 30) == (4, True)

    # Pictures are the same in both splits: what differs is the damage.
    tiny |= {"rule": "picture", "seed_pool": 1}
    for given, apart in (({"split_damage": False}, False), ({}, True)):
        train, test = (
            gymnasium.make("npa/Regeneration2D-v0", **tiny, **given, split=split)
            for split in ("train", "test")
        )
        for seed in range(3):
            train.reset(seed=seed), test.reset(seed=seed)
            damaged = zip(train.unwrapped.particles(), test.unwrapped.particles(), strict=True)
            assert all(torch.equal(one, other) for one, other in damaged) != apart


def test_a_world_of_a_pool_is_the_same_whenever_it_is_grown(device):
    given = {"particle_count": 32, "grow_steps": 2, "resolution": 16, "device": str(device)}
    alone, batch = (
        gymnasium.make("npa/Regeneration2D-v0", **given, seed_pool=8).unwrapped for _ in range(2)
    )
    whole = batch.task.pooled(torch.arange(8, device=device))
    for number in (5, 2, 5):
        one = alone.task.pooled(torch.tensor([number], device=device))
        assert torch.equal(one.x[0], whole.x[number])
        assert torch.equal(one.s[0], whole.s[number])


def test_regeneration_starts_grown_and_damaged():
    grown = npa_envs.load_rule("gecko-v0")
    env = gymnasium.make(
        "npa/Regeneration2D-v0", particle_count=512, grow_steps=48, seed_pool=1, damage="wipe"
    )
    env.reset(seed=0)
    x, s = env.unwrapped.particles()
    wiped = (s == 0).all(-1)
    assert 10 < int(wiped.sum()) < 400
    assert float((x.amax(0) - x.amin(0)).max()) > 1.0
    task = env.unwrapped.task
    random = npa_envs.WorldRandom([0]).substream(StreamId.GROWTH)
    start_x, start_s, _ = task.goal.seed(1, generator=random)
    growth = random.substream(StreamId.GROWTH)
    with torch.no_grad():
        expected = npa_envs.rollout(grown, start_x, start_s, 48, generator=growth)
    assert torch.equal(task.pooled(torch.tensor([0])).x, expected[0])
    assert torch.equal(x, expected[0][0])


@pytest.mark.parametrize("damage", ["wipe", "cut", "clump", "random"])
def test_every_damage_raises_the_loss(damage):
    env = gymnasium.make(
        "npa/Regeneration2D-v0", particle_count=256, rule="picture", damage=damage, damage_size=0.4
    )
    pool = env.unwrapped.task.pooled(torch.tensor([0]))
    whole = float(sum(env.unwrapped.task.losses(*pool[:2]).values())[0])
    for seed in range(6):
        _, info = env.reset(seed=seed)
        assert info["loss"] > 1.05 * whole
        start = env.unwrapped.task.start(npa_envs.WorldRandom([seed]))
        assert float(start.success_loss) == pytest.approx(
            0.8 * whole + 0.2 * info["loss"], rel=1e-5
        )


@every_id
def test_replaced_particles_are_perceived_and_pay_nothing(name):
    env = make(name)
    env.reset(seed=0)
    x, s = env.unwrapped.particles()
    observation = env.unwrapped.place_particles(x * 2.0, s)
    config = env.unwrapped.config
    expected = npa_envs.perceive(2.0 * x[None], s[None], 0.3, config.eps0, config.box)[0]
    assert np.array_equal(observation, expected.numpy())
    _, reward, *_ = env.step(np.zeros(env.action_space.shape, np.float32))
    assert reward == 0.0


@every_id
@pytest.mark.parametrize(
    ("x", "s", "message"),
    [
        (1, (61, 16), "x must have shape"),
        (61, (60, 16), "s must have shape"),
        (61, np.nan, "s must be finite and within observation_limit"),
        (9.0, (61, 16), "x must be finite and within position_limit"),
    ],
)
def test_particles_that_do_not_fit_are_refused(name, x, s, message):
    env = make(name).unwrapped
    env.reset(seed=0)
    space_dim = env.task_type.space_dim
    x = np.zeros((x, space_dim)) if isinstance(x, int) else np.full((61, space_dim), x)
    s = np.zeros(s) if isinstance(s, tuple) else np.full((61, 16), s)
    with pytest.raises(NPAError, match=message):
        env.place_particles(x, s)


def test_numbers_of_numpy_are_numbers():
    env = make(IDS[0], particle_count=np.int64(9), eps=np.float32(0.3))
    assert env.observation_space.shape == (9, 66)
    assert type(env.unwrapped.config.particle_count) is int


@every_id
@pytest.mark.parametrize("shape", [(61,), (60, 0), (61, -1), (1, 61, 0)])
def test_action_before_a_reset_or_of_another_shape_is_an_error(name, shape):
    env = make(name).unwrapped
    right = env.action_space.shape
    with pytest.raises(NPAError, match="call reset first"):
        env.step(np.zeros(right, np.float32))
    env.reset(seed=0)
    shape = shape if len(shape) == 1 else (*shape[:-1], right[1] + shape[-1])
    with pytest.raises(
        NPAError, match=rf"action must be real numbers of shape \[N, A\] = \(61, {right[1]}\)"
    ):
        env.step(np.zeros(shape, np.float32))
    for wrong in (
        "left",
        np.zeros(right, complex),
        torch.zeros(right, dtype=torch.complex64),
        np.zeros(right, str),
        np.full(right, "0.5"),
        np.zeros(right, "datetime64[s]"),
        np.zeros(right, "timedelta64[s]"),
        np.ma.masked_array(np.zeros(right), mask=np.eye(*right)),
    ):
        with pytest.raises(NPAError, match="action must be real numbers"):
            env.step(wrong)
    fixed = np.zeros(right, np.float32)
    fixed.flags.writeable = False
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env.step(fixed)


@every_id
def test_an_unknown_keyword_is_a_type_error_in_pythons_words(name):
    for many in (False, True):
        with pytest.raises(TypeError, match=r"got an unexpected keyword argument 'frameskip': "):
            make_vec(name, 2, frameskip=1) if many else make(name, frameskip=1)


@every_id
@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        (
            {"particle_coumt": 5},
            "unexpected keyword argument 'particle_coumt': did you mean 'particle_count'",
        ),
        ({"seed": 3}, "unexpected keyword argument 'seed': give it to reset"),
        ({"max_episode_step": 3}, "did you mean 'max_episode_steps'"),
        ({"episode_steps": 5}, "for longer or shorter episodes give max_episode_steps"),
        ({"target": "geko"}, "target must be a built-in "),
        ({"target": "nowhere.png"}, "nowhere.png"),
        ({"particle_count": 0}, "particle_count must be a whole number of at least 1, got 0"),
        ({"particle_count": 10**9}, "particle_count (is too large|must be at most 16777216)"),
        ({"particle_count": 1.5}, "particle_count must be a whole number"),
        ({"device": "cuda:99"}, "device must be one that torch sees"),
        ({"device": "tpu"}, "device must"),
        ({"reward": "denze"}, "did you mean 'dense'"),
        ({"output": "jax"}, "output must be a known word"),
        ({"on_divergence": "rest"}, "on_divergence must be a known word, got 'rest': did you"),
        ({"boundary": "wall"}, "boundary must be a known word"),
        ({"boundary": "periodic", "box_size": 0.1}, "box_size must be at least 2 eps"),
        ({"render_mode": "ansi"}, "render_mode must be a known word"),
        ({"eps": -1.0}, "eps must be"),
        ({"update_prob": 0.0}, "update_prob must lie in"),
        ({"seed_pool": -1}, "seed_pool must be"),
        ({"state_dim": 2}, "state_dim must be"),
        ({"boundary": "periodic", "box_size": 9.0}, "position_limit must be at least half of box"),
        ({"success_loss": 1e308}, "success_loss must be at most"),
    ],
)
def test_bad_keyword_is_a_clear_error(name, keywords, message):
    if "target" in keywords and "PointClassification" in name:
        keywords = {"data": keywords["target"]}
        message = "data must be a known data set or a folder"
    if "target" in keywords and "Pictures" in name:
        keywords = {"targets": (keywords["target"],)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for factory in (gymnasium.make, gymnasium.make_vec):
            with pytest.raises(NPAError, match=message):
                factory(name, **(small(name) | keywords))


@pytest.mark.parametrize(
    ("name", "keywords", "message"),
    [
        (IDS[0], {"target": "geko"}, "did you mean 'gecko'"),
        (IDS[1], {"seed_radius": 6.0}, "seed_radius must be below position_limit"),
        (IDS[1], {"damage": "burn"}, "damage must be a known kind"),
        (
            IDS[1],
            {"target": "ring", "rule": None},
            r"rule must say what .*\(butterfly, .*, octopus\)",
        ),
        (IDS[1], {"state_dim": 8, "rule": None}, "rule must have state_dim=8"),
        (IDS[1], {"rule": "geko"}, "gecko"),
        (IDS[1], {"healed_share": 0.0}, "healed_share must lie in"),
        ("npa/Texture-v0", {"target": "cels"}, "did you mean 'cells'"),
        ("npa/Texture-v0", {"boundary": "open"}, "boundary must be 'periodic' for textures"),
        ("npa/Texture-v0", {"loss": "swd"}, "did you mean 'patch_swd'|known: filter_ot"),
        ("npa/Texture-v0", {"resolution": 8}, "resolution must be a whole number of at least 12"),
        ("npa/PointClassification-v0", {"data": "mnisd"}, "did you mean 'mnist'"),
        ("npa/PointClassification-v0", {"boundary": "periodic"}, "boundary must be 'open' for"),
        ("npa/PointClassification-v0", {"split": "half"}, "split must be 'train' or 'test'"),
        ("npa/PointClassification-v0", {"state_dim": 9}, "state_dim must be a whole number of at"),
        ("npa/PointClassification-v0", {"rule": "gecko"}, "rule must have a read-out of state_dim"),
        ("npa/PointClassification-v0", {"class_count": 9}, "class_count must be more than the"),
        ("npa/Morphogenesis3D-v0", {"target": "rocke"}, "did you mean 'rocket'"),
        (
            "npa/Morphogenesis3D-v0",
            {"readout": "gecko"},
            "readout must be a rule with a read-out",
        ),
        ("npa/Morphogenesis3D-v0", {"readout": 3}, "for example readout='mushroom'"),
        ("npa/Morphogenesis3D-v0", {"opacity": 1.0}, "opacity must lie below 1"),
        ("npa/Morphogenesis3D-v0", {"seed_radius": 5.0}, "seed_radius must be below"),
    ],
)
def test_bad_keyword_of_one_environment_is_a_clear_error(name, keywords, message):
    with pytest.raises(NPAError, match=message):
        make(name, **keywords)


@pytest.mark.parametrize(
    "keywords", [{"particle_count": 10**5}, {"resolution": 4096}, {"seed_pool": 10**6}]
)
def test_worlds_beyond_memory_are_refused_before_they_are_made(keywords, monkeypatch):
    monkeypatch.setattr("npa_envs.envs.core.state.free_bytes", lambda device: 10**8)
    make(IDS[0])
    with pytest.raises(NPAError, match="particle_count must fit into memory: 1 world"):
        make(IDS[0], **keywords)


def test_memory_that_is_counted_is_what_worlds_take():
    from npa_envs.envs.core.state import free_bytes

    assert 2**26 < free_bytes(torch.device("cpu")) < 2**44


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


@every_id
@pytest.mark.parametrize("style", ["particles", "density", "states"])
def test_pictures_show_the_world(name, style):
    env = make(name, render_mode="rgb_array", render_style=style)
    env.reset(seed=0)
    picture = env.render()
    assert picture.shape == (24, 24, 3)
    assert picture.dtype == np.uint8
    assert (picture != 255).any()
    # Grown pictures leave the corners empty.
    assert (picture[0, 0] == 255).all() or env.unwrapped.config.box is not None


@every_id
def test_frames_come_as_a_list(name):
    env = make(name, render_mode="rgb_array_list")
    env.reset(seed=0)
    for action in actions(env, 3):
        env.step(action)
    frames = env.render()
    assert [(frame.shape, frame.dtype) for frame in frames] == [((24, 24, 3), np.uint8)] * 4
    assert (frames[0] != frames[-1]).any()


@every_id
@pytest.mark.parametrize("world_count", [None, 3])
def test_a_window_shows_worlds_side_by_side_and_closes_twice(name, world_count):
    one = world_count is None
    env = make(name, render_mode="human") if one else make_vec(name, 3, render_mode="human")
    env.reset(seed=0)
    env.step(np.zeros(env.action_space.shape, np.float32))
    assert env.render() is None
    env.close()
    env.close()


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
