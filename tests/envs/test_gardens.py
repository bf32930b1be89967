"""Living worlds: brushes, weather, spaces, seeds; tests run over the table of gardens."""

import warnings
from hashlib import sha256

import gymnasium
import numpy as np
import pytest
import torch
from small_envs import assert_same

import npa_envs
from npa_envs.envs.garden.brushes import BrushLayout, brushed, grid_places
from npa_envs.errors import DivergedError, NPAError
from npa_envs.registration import GARDEN_IDS, GARDENS
from npa_envs.registration import SMALL as SMALL_FORMS

IDS = [environment.id for environment in GARDENS]
GARDENER, SHEPHERD = IDS
SMALL = {
    "particle_count": 61,
    "eps": 0.2,
    "resolution": 16,
    "picture_size": 8,
    "render_size": 24,
    "seed_pool": 3,
    "grow_steps": 4,
    "rule_steps": 2,
}
TOOLS = ("push", "wipe", "inject", "rate")
every_id = pytest.mark.parametrize("name", IDS)


@pytest.fixture(autouse=True)
def _no_screen(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


def make(name, **keywords):
    return gymnasium.make(name, **(SMALL | keywords))


def make_vec(name, world_count, **keywords):
    return gymnasium.make_vec(
        name, world_count, vectorization_mode="vector_entry_point", **(SMALL | keywords)
    )


def rows(env):
    """Shape of the actions of a world."""
    return env.unwrapped.form.action_space.shape


def sampled(env, count, seed=0):
    """Actions of one world or of many."""
    env.action_space.seed(seed)
    return [env.action_space.sample() for _ in range(count)]


@every_id
def test_bad_actions_are_clear_errors_and_change_nothing(name):
    env, other = make(name), make(name)
    env.reset(seed=0)
    other.reset(seed=0)
    action = sampled(env, 1)[0]
    with pytest.raises(NPAError, match=r"action must be real numbers of shape \[K, W\]"):
        env.unwrapped.step(action[:1])
    with pytest.raises(DivergedError, match="action must be finite, got nan at world 0"):
        env.unwrapped.step(np.where(action == action[0, 0], np.nan, action).astype(np.float32))
    assert_same(env.step(action), other.step(action))
    chosen = make(name, actions="discrete")
    chosen.reset(seed=0)
    with pytest.raises(NPAError, match="action must choose below"):
        chosen.unwrapped.step(np.full(4, 99))
    with pytest.raises(NPAError, match="whole numbers of shape"):
        chosen.unwrapped.step(np.zeros(4, np.float32))


@pytest.mark.parametrize(
    "small", [row for row in SMALL_FORMS if row.id in GARDEN_IDS], ids=lambda row: row.id
)
def test_a_small_form_is_the_environment_with_other_keywords(small):
    quick = {"grow_steps": 4, "seed_pool": 1}
    usual = small.id.replace("Small", "")
    env = gymnasium.make(small.id, **quick)
    other = gymnasium.make(usual, **(dict(small.keywords) | quick))
    assert env.unwrapped.config == other.unwrapped.config
    assert env.spec.max_episode_steps == other.spec.max_episode_steps == 32
    batched = gymnasium.make_vec(small.id, 2, vectorization_mode="vector_entry_point", **quick)
    assert batched.config == env.unwrapped.config
    action = sampled(env, 1)[0]
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    for made in (env, other, again):
        made.reset(seed=3)
    first = env.step(action)
    assert_same(first, other.step(action))
    assert_same(first, again.step(action))


FROZEN = {
    "npa/Gardener2D-v0": {
        "particle_count": 512,
        "brush_radius": 0.6,
        "push_length": 0.15,
        "place_count": 4,
        "place_reach": 0.75,
        "gust_chance": 1.0,
        "gust_radius": 0.4,
        "gust_length": 0.4,
        "blight_chance": 0.5,
        "blight_radius": 0.3,
        "position_noise": 0.002,
    },
    "npa/Gardener2DSmall-v0": {
        "particle_count": 256,
        "brush_radius": 0.6,
        "push_length": 0.1,
        "place_count": 4,
        "place_reach": 0.75,
        "gust_chance": 0.5,
        "gust_radius": 0.6,
        "gust_length": 0.4,
        "blight_chance": 0.25,
        "blight_radius": 0.3,
        "position_noise": 0.002,
    },
    "npa/Shepherd2D-v0": {
        "particle_count": 512,
        "brush_radius": 0.6,
        "push_length": 0.1,
        "place_count": 2,
        "place_reach": 0.4,
        "aim": "move",
        "goal_reach": 0.6,
        "tolerance": 0.1,
        "lost_limit": 0.5,
        "reward_weight": 1.0,
    },
}
FROZEN["npa/Shepherd2DSmall-v0"] = FROZEN["npa/Shepherd2D-v0"] | {"particle_count": 256}
FOR_ALL = {
    "target": "heart",
    "rule": None,
    "grow_steps": 256,
    "seed_pool": 16,
    "rule_steps": 8,
    "tools": ("push",),
    "actions": "grid",
    "observe": "grid",
    "reward": "dense",
    "eps": 0.1,
    "resolution": 32,
}


@pytest.mark.parametrize("name", FROZEN)
def test_settings_stay_what_they_are_as_long_as_the_version_does(name):
    config = gymnasium.make(name).unwrapped.config
    for key, value in (FOR_ALL | FROZEN[name]).items():
        assert getattr(config, key) == value, key


def test_the_rule_that_runs_a_frozen_world_stays_what_it_is():
    rule = gymnasium.make("npa/Gardener2DSmall-v0").unwrapped.task.rule
    weights = b"".join(p.detach().cpu().numpy().tobytes() for p in rule.parameters())
    assert sha256(weights).hexdigest()[-12:] == "bfc570262e4d"
    assert not torch.equal(rule.hidden.weight, npa_envs.load_rule("heart").hidden.weight)


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"tell_updated": True}, "actions do not belong to particles"),
        ({"tools": ("pull",)}, "tools must be some of"),
        ({"tools": ("rate", "push")}, "in the order of"),
        ({"inject_channels": (16,)}, r"inject_channels must lie in \[-16, 15\]"),
        ({"inject_channels": (-1, 15)}, "inject_channels must be different"),
        ({"picture_size": 7}, "picture_size must divide resolution = 16"),
        ({"actions": "discreet"}, "did you mean 'discrete'"),
        ({"reward": "particle"}, "reward must be a known word"),
        ({"alpha": 0.25}, "alpha must be the rule's, 0.5, got 0.25"),
        ({"target": "ring"}, "no shipped rule grows 'ring'"),
        ({"rule": "seven-pictures", "state_dim": 24}, "rule must have code_dim=0"),
        ({"actions": "box"}, "actions must be a known word"),
        ({"place_count": 1}, "place_count must be"),
        ({"brush_radius": 0.0}, "brush_radius must be a finite number greater than 0"),
    ],
)
def test_bad_keywords_are_clear_errors(keywords, message):
    with pytest.raises(NPAError, match=message):
        make(GARDENER, **keywords)


def brush(config, **numbers):
    """The row of one brush at the middle, for a world."""
    row, columns = torch.zeros(1, 1, BrushLayout.of(config).width), BrushLayout.of(config)
    for tool, values in numbers.items():
        row[..., getattr(columns, tool)] = torch.tensor(values)
    return row


FREE = {"actions": "free", "tools": TOOLS, "brush_radius": 0.3, "push_length": 0.3}


def test_brushes_do_what_the_documentation_says():
    config = make(GARDENER, **FREE).unwrapped.config
    x = torch.tensor([[[0.0, 0.0], [0.15, 0.0], [0.5, 0.0]]])
    s, middle = torch.ones(1, 3, 16), torch.zeros(1, 2)
    held = torch.tensor([1.0, 0.5625, 0.0])
    moved, same, rate = brushed(x, s, brush(config, push=(0.0, 0.5)), middle, config)
    assert torch.allclose(moved - x, torch.stack((0.0 * held, 0.15 * held), dim=-1)[None])
    assert torch.equal(same, s)
    assert torch.equal(rate, torch.ones(1, 3, 1))
    _, wiped, _ = brushed(x, s, brush(config, wipe=0.5), middle, config)
    assert torch.allclose(wiped[0, :, 0], 1.0 - 0.5 * held)
    _, kept, _ = brushed(x, s, brush(config, wipe=-1.0), middle, config)
    assert torch.equal(kept, s)
    _, dosed, _ = brushed(x, s, brush(config, inject=(1.0, 0.0, -0.5)), middle, config)
    assert torch.allclose(dosed[0, :, -3], 1.0 + 0.5 * held)
    assert torch.allclose(dosed[0, :, -1], 1.0 - 0.25 * held)
    assert torch.equal(dosed[..., :-3], s[..., :-3])
    _, _, rate = brushed(x, s, brush(config, rate=-1.0), middle, config)
    assert torch.allclose(rate[0, :, 0], 1.0 - held)


def test_brushes_stand_on_the_grid_and_what_they_do_adds_up():
    config = make(GARDENER, place_count=3, place_reach=0.5, brush_radius=0.6).unwrapped.config
    places = grid_places(config)
    assert places.tolist() == [[a, b] for b in (-0.5, 0.0, 0.5) for a in (-0.5, 0.0, 0.5)]
    x, s = torch.tensor([[[1.0, 1.2], [1.25, 1.0]]]), torch.zeros(1, 2, 16)
    middle = torch.tensor([[1.0, 1.0]])
    everywhere = torch.tensor([0.4, -0.2]).expand(1, 9, 2)
    moved, _, _ = brushed(x, s, everywhere, middle, config)
    square = (x[0][:, None] - middle - places).square().sum(dim=-1)
    held = (1.0 - square / 0.36).clamp_min(0.0).square().sum(dim=1)
    assert torch.allclose(moved - x, 0.15 * held[None, :, None] * everywhere[0, 0], atol=1e-6)


def test_what_lacks_is_seen_where_it_lacks():
    env = make(GARDENER, particle_count=256, eps=0.1, resolution=32)
    env.reset(seed=0)
    task, target = env.unwrapped.task, env.unwrapped.task.goal.target
    whole = torch.cat((torch.zeros(256, 13), target.colours - 0.5), dim=1)
    seen = env.unwrapped.place_particles(target.points, whole)
    assert np.abs(seen).max() < 1e-3
    # Half of what is around one place goes to another, colours are lost at a third.
    places = grid_places(env.unwrapped.config)
    moved, grey = target.points.clone(), whole.clone()
    left, right = 5, 6
    near = (moved - places[left]).norm(dim=1) < 0.3
    moved[near] += places[right] - places[left]
    lack = task.lacking(moved[None], grey[None], torch.zeros(1, 2))[0]
    assert lack[left, 0] > 0.5
    assert lack[right, 0] < -0.5
    assert lack[left, 0] == pytest.approx(float(lack[:, 0].max()))
    # From the place beside it, they lack on the other side.
    assert lack[right, 1] < -0.1
    grey[:, -3:] = -0.5
    lack = task.lacking(target.points[None], grey[None], torch.zeros(1, 2))[0]
    assert float(lack[:, :3].abs().max()) < 1e-3
    assert bool((lack[:, 3:] >= 0.0).all())
    assert float(lack[:, 3].max()) > 0.5


def test_brushes_reach_across_the_edges_of_a_box_and_may_be_too_small_to_hold_anything():
    config = make(
        GARDENER,
        boundary="periodic",
        box_size=2.0,
        brush_radius=0.4,
        place_count=2,
        place_reach=0.9,
    ).unwrapped.config
    x = torch.tensor([[[-0.95, -0.9], [0.0, 0.0]]])
    s, middle = torch.zeros(1, 2, 16), torch.zeros(1, 2)
    # The last of the four places is across both edges.
    action = torch.zeros(1, 4, 2)
    action[0, 3, 0] = 1.0
    moved, _, _ = brushed(x, s, action, middle, config)
    held = (1.0 - (0.15**2 + 0.2**2) / 0.4**2) ** 2
    assert moved[0, 0].tolist() == pytest.approx([-0.95 + 0.15 * held, -0.9], abs=1e-6)
    assert moved[0, 1].tolist() == [0.0, 0.0]
    seen, _ = make(GARDENER, brush_radius=1e-3).reset(seed=0)
    assert np.isfinite(seen).all()


def test_a_world_that_is_stopped_stays_as_it_is():
    calm = {"gust_chance": 0.0, "blight_chance": 0.0, "position_noise": 0.0}
    env = make(GARDENER, **(FREE | {"brush_radius": 1e3} | calm))
    env.reset(seed=0)
    x, s = env.unwrapped.particles()
    action = np.zeros(env.action_space.shape, np.float32)
    env.step(action)
    assert not torch.equal(env.unwrapped.particles()[0], x)
    env.unwrapped.place_particles(x, s)
    action[0, -1] = -1.0
    _, reward, *_ = env.step(action)
    assert torch.allclose(env.unwrapped.particles()[0], x, atol=1e-5)
    assert torch.allclose(env.unwrapped.particles()[1], s, atol=1e-5)
    assert reward == pytest.approx(1.0, abs=1e-3)


def test_the_whole_world_is_differentiable_by_every_number_of_a_brush():
    """The directional derivative is that of differences, weather included.

    Perception stops the gradient of its correction of moments, by definition: it is left out here.
    """
    env = make(
        GARDENER, particle_count=96, blight_chance=0.0, **(FREE | {"brush_count": 4})
    ).unwrapped
    env.reset(seed=1)
    task, worlds = env.task, env.worlds
    x, s = (part.double() for part in (worlds.x, worlds.s))
    task.rule.double()
    task.rule.moment_correction = False
    generator = torch.Generator().manual_seed(0)
    shape = (1, *env.action_space.shape)
    action = torch.rand(shape, generator=generator, dtype=torch.float64) - 0.2

    def worth(action):
        new_x, new_s = task.step(x, s, action, npa_envs.WorldRandom([4]))
        return (torch.cat((new_x, new_s), dim=-1) * weights).sum()

    weights = torch.rand((1, 96, 18), generator=generator, dtype=torch.float64)
    given = action.clone().requires_grad_()
    (slope,) = torch.autograd.grad(worth(given), given)
    columns = BrushLayout.of(env.config)
    for column in range(columns.width):
        assert float(slope[0, :, column].abs().sum()) > 0.0, column
    way = torch.rand(shape, generator=generator, dtype=torch.float64) - 0.5
    step = 1e-6
    difference = (worth(action + step * way) - worth(action - step * way)) / (2.0 * step)
    assert float((slope * way).sum()) == pytest.approx(float(difference), rel=1e-4)


def goals(env, **moved):
    """What a shepherd sees of the creature, after its particles were placed elsewhere."""
    x, s = env.unwrapped.particles()
    middle = x.mean(dim=0)
    away = x - middle
    if "by" in moved:
        away = away + torch.tensor(moved["by"])
    if "turn" in moved:
        c, s_ = np.cos(moved["turn"]), np.sin(moved["turn"])
        away = away @ torch.tensor([[c, s_], [-s_, c]], dtype=torch.float32)
    if "stretch" in moved:
        away = away * torch.tensor(moved["stretch"])
    return env.unwrapped.place_particles(middle + away, s)


@pytest.mark.parametrize(
    ("aim", "moved", "difference"),
    [
        ("move", {"by": (0.3, -0.2)}, (0.3, -0.2)),
        ("turn", {"turn": 0.5}, (np.cos(1.0) - 1.0, np.sin(1.0))),
        ("reshape", {"stretch": (1.25, 0.8)}, (0.25, -0.2)),
    ],
)
def test_a_shepherd_sees_what_became_of_a_creature_that_stays_whole(aim, moved, difference):
    env = make(SHEPHERD, aim=aim, target="gecko", resolution=32, particle_count=256, eps=0.1)
    seen, _ = env.reset(seed=0)
    assert abs(seen["achieved_goal"][2]) < 1e-3
    assert env.unwrapped.compute_reward(seen["achieved_goal"], seen["desired_goal"], {}) < 0
    after = goals(env, **moved)
    assert after["achieved_goal"][:2] - seen["achieved_goal"][:2] == pytest.approx(
        difference, abs=1e-3
    )
    # The picture is only as fine as its pixels.
    assert abs(after["achieved_goal"][2]) < 0.1
    assert np.array_equal(after["desired_goal"], seen["desired_goal"])


@pytest.mark.parametrize("reward", ["dense", "sparse"])
def test_rewards_of_goals_are_those_of_steps_and_of_any_other_goals(reward):
    envs = make_vec(SHEPHERD, 3, reward=reward, tolerance=0.3, max_episode_steps=99)
    envs.reset(seed=0)
    compute = envs.unwrapped.compute_reward
    paid = set()
    for action in sampled(envs, 12):
        seen, rewards, _, _, infos = envs.step(action)
        again = compute(seen["achieved_goal"], seen["desired_goal"], infos)
        assert np.array_equal(rewards, again)
        if reward == "sparse":
            assert np.array_equal(rewards == 0.0, infos["is_success"])
        paid |= set(rewards)
        # As hindsight has it: what was achieved had been desired.
        assert (compute(seen["achieved_goal"], seen["achieved_goal"], infos) == 0.0).all()
    assert paid == {0.0, -1.0} if reward == "sparse" else len(paid) > 30


@pytest.mark.parametrize(("name", "warned"), [(GARDENER, True), (SHEPHERD, False)])
def test_only_rewards_that_come_in_the_last_step_can_be_missed(name, warned):
    env = make(name, reward="sparse")
    env.reset(seed=0)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        _, reward, *_ = env.step(env.action_space.sample())
        env.reset()
    assert any("last sparse reward" in str(one.message) for one in told) == warned
    # Away from its goal a creature is paid -1 in each step.
    assert reward == (0.0 if warned else -1.0)


def test_hindsight_experience_replay_runs_as_it_is():
    sb3 = pytest.importorskip("stable_baselines3")
    env = make(SHEPHERD, reward="sparse", max_episode_steps=6)
    model = sb3.SAC(
        "MultiInputPolicy",
        env,
        replay_buffer_class=sb3.HerReplayBuffer,
        learning_starts=12,
        buffer_size=100,
        seed=0,
        device="cpu",
    )
    model.learn(30)
    batch = model.replay_buffer.sample(64)
    assert 0.0 in batch.rewards


def test_weather_comes_as_often_as_it_is_told_to():
    still = {"position_noise": 0.0, "gust_length": 0.3}
    for chances, expected in (((1.0, 0.0), (1, 0)), ((0.0, 1.0), (0, 1)), ((0.0, 0.0), (0, 0))):
        env = make(GARDENER, gust_chance=chances[0], blight_chance=chances[1], **still)
        env.reset(seed=0)
        x, s = env.unwrapped.particles()
        task = env.unwrapped.task
        new_x, new_s = task.disturb(x[None], s[None], npa_envs.WorldRandom([3]))
        assert bool((new_x != x).any()) == bool(expected[0])
        assert bool((new_s != s).any()) == bool(expected[1])


def test_the_reward_is_one_for_a_whole_picture_and_zero_for_a_grey_one():
    env = make(GARDENER, particle_count=256, eps=0.1, grow_steps=48, rule_steps=8, seed_pool=1)
    _, info = env.reset(seed=0)
    worlds, task = env.unwrapped.worlds, env.unwrapped.task
    grey = sum(task.losses(worlds.x, torch.zeros_like(worlds.s)).values())
    assert grey > 1.2 * info["loss"]
    losses = torch.cat((grey, torch.tensor([info["loss"], info["loss"] - 1.0, 1e3])))
    earned = task.reward(worlds.x, worlds.s, losses, worlds.context.expand(4, -1))
    better = 1.0 + 1.0 / float(grey - info["loss"])
    assert torch.allclose(earned, torch.tensor([0.0, 1.0, better, -1.0]), rtol=1e-4, atol=1e-5)
