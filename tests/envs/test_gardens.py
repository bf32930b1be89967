"""Gardens: brushes, disturbances, rewards; two gardeners; worlds whose code the agent chooses."""

import warnings
from itertools import pairwise

import numpy as np
import pettingzoo
import pytest
import torch
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test
from support.refusals import refused
from support.small_envs import assert_same, begun, make, make_vec, small

import npa_envs
from npa_envs.agents.garden_policies import RandomGardener
from npa_envs.agents.shapeshifter_policies import RecognisingShapeshifter
from npa_envs.envs import gardeners_v0, trained_rules
from npa_envs.envs.garden.base import StartLosses
from npa_envs.envs.garden.brush_actions import BrushLayout, apply_brushes, grid_places
from npa_envs.envs.gardener2d import Gardener2DEnv
from npa_envs.envs.multi import AGENT_REASONS
from npa_envs.registration import GARDENS
from npa_envs.world.particles import Particles

GARDENER, SHEPHERD = (environment.id for environment in GARDENS)
TOOLS = ("push", "wipe", "inject", "rate")


def sampled(env, count, seed=0):
    """Actions of one world or of many."""
    env.action_space.seed(seed)
    return [env.action_space.sample() for _ in range(count)]


def brush(config, **numbers):
    """The row of one brush at the middle, for a world."""
    columns = BrushLayout.for_config(config)
    row = torch.zeros(1, 1, columns.width)
    for tool, values in numbers.items():
        row[..., getattr(columns, tool)] = torch.tensor(values)
    return row


FREE = {"actions": "free", "tools": TOOLS, "brush_radius": 0.3, "push_length": 0.3}


def test_brushes_do_what_the_documentation_says():
    config = make(GARDENER, **FREE).unwrapped.config
    x = torch.tensor([[[0.0, 0.0], [0.15, 0.0], [0.5, 0.0]]])
    s, middle = torch.ones(1, 3, 16), torch.zeros(1, 2)
    held = torch.tensor([1.0, 0.5625, 0.0])  # (1 - (r / 0.3)²)² at r = 0 and 0.15; 0 beyond 0.3
    world = Particles(x, s)
    (moved, same, *_), rate = apply_brushes(world, brush(config, push=(0.0, 0.5)), middle, config)
    assert torch.allclose(moved - x, torch.stack((0.0 * held, 0.15 * held), dim=-1)[None])
    assert torch.equal(same, s)
    assert torch.equal(rate, torch.ones(1, 3, 1))
    (_, wiped, *_), _ = apply_brushes(world, brush(config, wipe=0.5), middle, config)
    assert torch.allclose(wiped[0, :, 0], 1.0 - 0.5 * held)
    (_, kept, *_), _ = apply_brushes(world, brush(config, wipe=-1.0), middle, config)
    assert torch.equal(kept, s)
    (_, dosed, *_), _ = apply_brushes(world, brush(config, inject=(1.0, 0.0, -0.5)), middle, config)
    assert torch.allclose(dosed[0, :, -3], 1.0 + 0.5 * held)
    assert torch.allclose(dosed[0, :, -1], 1.0 - 0.25 * held)
    assert torch.equal(dosed[..., :-3], s[..., :-3])
    _, rate = apply_brushes(world, brush(config, rate=-1.0), middle, config)
    assert torch.allclose(rate[0, :, 0], 1.0 - held)


@pytest.mark.parametrize(
    "fields", [{}, {"boundary": "periodic", "box_size": 1.5}], ids=["open", "box"]
)
def test_gusts_and_blights_are_the_same_with_a_gradient(fields):
    fields |= {"gust_chance": 0.6, "gust_radius": 0.8, "blight_radius": 0.6}
    task, random = make(GARDENER, **fields).unwrapped.task, npa_envs.WorldRandom(range(32))
    x, s = random.normal(50, 2), random.normal(50, 16)
    moved, wiped, *_ = task.disturb(Particles(x, s), random)
    slow = task.disturb(Particles(x.clone().requires_grad_(), s), random)
    torch.testing.assert_close((moved, wiped), (slow.x.detach(), slow.s))
    assert 0 < (moved != x).any(dim=2).any(dim=1).sum() < 32
    assert 0 < (wiped != s).any(dim=2).any(dim=1).sum() < 32


def test_actions_that_are_not_finite_change_neither_worlds_nor_their_random_numbers():
    envs = [make_vec(GARDENER, 2) for _ in range(2)]
    for env in envs:
        env.reset(seed=3)
    first, second = sampled(envs[0], 2)
    bad = np.where(np.arange(first.size).reshape(first.shape) == 5, np.inf, first)
    for action in (first, second):
        refused("action must be finite, got inf at world 0, row", envs[0].step, bad)
        assert_same(envs[0].step(action), envs[1].step(action))


@pytest.mark.parametrize("name", [GARDENER, SHEPHERD, "npa/Shapeshifter2D-v0"])
def test_a_world_is_the_same_alone_and_among_others_that_are_stepped_with_it(name, monkeypatch):
    count, fields = 5, {"particle_count": 250}
    # Four worlds together; from the third step on launches are replayed.
    monkeypatch.setattr(trained_rules, "STEPPED_TOGETHER", 1000)
    envs = make_vec(name, count, **fields)
    envs.reset(seed=3)
    actions = sampled(envs, 5)
    for action in actions:
        envs.step(action)
    x, s = envs.unwrapped.particles()
    for k in range(count):
        env = begun(make(name, **fields), seed=3 + k)
        for action in actions:
            env.step(action[k])
        assert torch.equal(env.unwrapped.particles()[0], x[k])
        assert torch.equal(env.unwrapped.particles()[1], s[k])


def test_brushes_stand_on_the_grid_and_what_they_do_adds_up():
    config = make(GARDENER, place_count=3, place_reach=0.5, brush_radius=0.6).unwrapped.config
    places = grid_places(config)
    assert places.tolist() == [[a, b] for b in (-0.5, 0.0, 0.5) for a in (-0.5, 0.0, 0.5)]
    x, s = torch.tensor([[[1.0, 1.2], [1.25, 1.0]]]), torch.zeros(1, 2, 16)
    middle = torch.tensor([[1.0, 1.0]])
    everywhere = torch.tensor([0.4, -0.2]).expand(1, 9, 2)
    (moved, *_), _ = apply_brushes(Particles(x, s), everywhere, middle, config)
    square = (x[0][:, None] - middle - places).square().sum(dim=-1)
    held = (1.0 - square / 0.36).clamp_min(0.0).square().sum(dim=1)
    assert torch.allclose(moved - x, 0.15 * held[None, :, None] * everywhere[0, 0], atol=1e-6)


@pytest.mark.parametrize("form", [{}, {"actions": "free", "brush_count": 3}])
@pytest.mark.parametrize("name", [GARDENER, SHEPHERD])
def test_actions_are_flat_or_rows_of_brushes_and_every_step_takes_both(name, form):
    many = {"action_shape": "brushes"} | form
    alone = [make(name, **form), make(name, **many)]
    batches = [make_vec(name, 2, **form), make_vec(name, 2, **many)]
    rows = alone[1].action_space.shape
    assert alone[0].action_space.shape == (rows[0] * rows[1],)
    for envs, count in ((alone, ()), (batches, (2,))):
        action = np.random.default_rng(0).uniform(-1.0, 1.0, (*count, *rows)).astype(np.float32)
        given = action, action.reshape(*count, -1)
        results = [begun(env, seed=1).step(one) for env in envs for one in given]
        for result in results[1:]:
            assert_same(results[0], result)
        for env in envs:
            acts = RandomGardener(env)(env.reset(seed=0)[0])
            assert env.action_space.contains(acts)


def test_what_lacks_is_seen_where_it_lacks():
    env = begun(make(GARDENER, particle_count=256, eps=0.1, resolution=32))
    task, target = env.unwrapped.task, env.unwrapped.task.task.target
    whole = torch.cat((torch.zeros(256, 13), target.colours - 0.5), dim=1)
    seen = env.unwrapped.place_particles(target.points, whole)
    assert np.abs(seen).max() < 1e-3
    # Half of what is around one place goes to another, colours are lost at a third.
    places = grid_places(env.unwrapped.config)
    moved, grey = target.points.clone(), whole.clone()
    left, right = 5, 6
    near = (moved - places[left]).norm(dim=1) < 0.3
    moved[near] += places[right] - places[left]
    lack = task.deficit(Particles(moved[None], grey[None]), torch.zeros(1, 2))[0]
    assert lack[left, 0] > 0.5
    assert lack[right, 0] < -0.5
    assert lack[left, 0] == pytest.approx(float(lack[:, 0].max()))
    # From the place next to it, they lack on the other side.
    assert lack[right, 1] < -0.1
    grey[:, -3:] = -0.5
    lack = task.deficit(Particles(target.points[None], grey[None]), torch.zeros(1, 2))[0]
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
    (moved, *_), _ = apply_brushes(Particles(x, s), action, middle, config)
    held = (1.0 - (0.15**2 + 0.2**2) / 0.4**2) ** 2
    assert moved[0, 0].tolist() == pytest.approx([-0.95 + 0.15 * held, -0.9], abs=1e-6)
    assert moved[0, 1].tolist() == [0.0, 0.0]
    seen, _ = make(GARDENER, brush_radius=1e-3).reset(seed=0)
    assert np.isfinite(seen).all()


def test_a_world_that_is_stopped_stays_as_it_is():
    calm = {"gust_chance": 0.0, "blight_chance": 0.0, "position_noise": 0.0}
    env = begun(make(GARDENER, **(FREE | {"brush_radius": 1e3} | calm)))
    x, s = env.unwrapped.particles()
    action = np.zeros(env.action_space.shape, np.float32)
    env.step(action)
    assert not torch.equal(env.unwrapped.particles()[0], x)
    env.unwrapped.place_particles(x, s)
    action[-1] = -1.0
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
    columns = BrushLayout.for_config(env.config)
    for column in range(columns.width):
        assert float(slope[0, column :: columns.width].abs().sum()) > 0.0, column
    way = torch.rand(shape, generator=generator, dtype=torch.float64) - 0.5
    step = 1e-6
    difference = (worth(action + step * way) - worth(action - step * way)) / (2.0 * step)
    assert float((slope * way).sum()) == pytest.approx(float(difference), rel=1e-4)


COSINE, SINE = np.cos(0.5), np.sin(0.5)


@pytest.mark.parametrize(
    ("aim", "matrix", "shift", "difference"),
    [
        ("move", np.eye(2), (0.3, -0.2), (0.3, -0.2)),
        ("turn", [[COSINE, SINE], [-SINE, COSINE]], 0.0, (np.cos(1.0) - 1.0, np.sin(1.0))),
        ("reshape", np.diag((1.25, 0.8)), 0.0, (0.25, -0.2)),
    ],
)
def test_a_shepherd_sees_what_became_of_a_creature_that_stays_whole(aim, matrix, shift, difference):
    env = make(SHEPHERD, aim=aim, target="gecko", resolution=32, particle_count=256, eps=0.1)
    seen, _ = env.reset(seed=0)
    assert list(seen) == list(env.observation_space)
    assert abs(seen["achieved_goal"][2]) < 1e-3
    assert env.unwrapped.compute_reward(seen["achieved_goal"], seen["desired_goal"], {}) < 0
    x, s = env.unwrapped.particles()
    away = (x - x.mean(dim=0)).numpy() @ np.float32(matrix) + np.float32(shift)
    after = env.unwrapped.place_particles(x.mean(dim=0) + torch.from_numpy(away), s)
    assert after["achieved_goal"][:2] - seen["achieved_goal"][:2] == pytest.approx(
        difference, abs=1e-3
    )
    # The picture is only as fine as its pixels.
    assert abs(after["achieved_goal"][2]) < 0.1
    assert np.array_equal(after["desired_goal"], seen["desired_goal"])


@pytest.mark.parametrize("reward", ["dense", "sparse"])
def test_rewards_of_goals_are_those_of_steps_and_of_any_other_goals(reward):
    envs = begun(make_vec(SHEPHERD, 3, reward=reward, tolerance=0.3, max_episode_steps=99))
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


@pytest.mark.parametrize(
    ("name", "warned"),
    [("npa/Morphogenesis2D-v0", True), (GARDENER, True), (SHEPHERD, False)],
)
def test_only_rewards_that_come_in_the_last_step_can_be_missed(name, warned):
    env = begun(make(name, reward="sparse", episode_steps=2))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        _, reward, *_ = env.step(env.action_space.sample())
        env.reset()
    assert any("before its sparse reward" in str(one.message) for one in caught) == warned
    # Away from its goal a creature is paid -1 in each step.
    assert reward == (0.0 if warned else -1.0)


def test_two_lengths_of_episodes_are_warned_of():
    with pytest.warns(UserWarning, match="episode_steps=2 and max_episode_steps=3 differ"):
        make_vec(GARDENER, 2, episode_steps=2, max_episode_steps=3)
    env = begun(make(GARDENER, episode_steps=33))
    while not env.step(env.action_space.sample())[3]:
        pass
    with pytest.warns(UserWarning, match="ended before step episode_steps=33: give that number"):
        env.reset()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env.step(env.action_space.sample())
        env.reset()
        make_vec(GARDENER, 2, episode_steps=3, max_episode_steps=3)


def test_growing_start_worlds_for_seconds_is_logged(monkeypatch, caplog):
    begun(make(GARDENER))
    assert not caplog.records
    monkeypatch.setattr(trained_rules, "LONG_GROWTH", 1)
    config = begun(make(GARDENER)).unwrapped.config
    sizes = f"{config.particle_count} particles in {config.grow_steps} steps"
    assert [record.message for record in caplog.records] == [
        f"growing 1 start worlds of {sizes} of a rule"
    ]


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


def test_weather_comes_as_often_as_configured():
    still = {"position_noise": 0.0, "gust_length": 0.3}
    for chances, expected in (((1.0, 0.0), (1, 0)), ((0.0, 1.0), (0, 1)), ((0.0, 0.0), (0, 0))):
        env = begun(make(GARDENER, gust_chance=chances[0], blight_chance=chances[1], **still))
        x, s = env.unwrapped.particles()
        task = env.unwrapped.task
        new_x, new_s, *_ = task.disturb(Particles(x[None], s[None]), npa_envs.WorldRandom([3]))
        assert bool((new_x != x).any()) == bool(expected[0])
        assert bool((new_s != s).any()) == bool(expected[1])


def test_the_reward_is_one_for_a_whole_picture_and_zero_for_a_grey_one():
    env = make(GARDENER, particle_count=256, eps=0.1, grow_steps=48, rule_steps=8, seed_pool=1)
    _, info = env.reset(seed=0)
    worlds, task = env.unwrapped.worlds, env.unwrapped.task
    grey = sum(task.losses(worlds.x, torch.zeros_like(worlds.s)).values())
    assert grey > 1.2 * info["loss"]
    losses = torch.cat((grey, torch.tensor([info["loss"], info["loss"] - 1.0, 1e3])))
    context = StartLosses(*(value.expand(4) for value in worlds.context))
    earned = task.reward(worlds.particles, losses, context)
    better = 1.0 + 1.0 / float(grey - info["loss"])
    assert torch.allclose(earned, torch.tensor([0.0, 1.0, better, -1.0]), rtol=1e-4, atol=1e-5)


# Two gardeners with opposed aims


GARDEN = small(GARDENER)


@pytest.mark.parametrize("form", [{}, {"actions": "discrete"}])
def test_pettingzoo_finds_nothing_to_complain_of(form):
    parallel_api_test(gardeners_v0.parallel_env(max_cycles=5, **GARDEN, **form), num_cycles=12)
    parallel_seed_test(lambda: gardeners_v0.parallel_env(max_cycles=5, **GARDEN, **form), 2)
    api_test(gardeners_v0.env(max_cycles=5, **GARDEN, **form), num_cycles=12)


@pytest.mark.skipif(not hasattr(pettingzoo, "make"), reason="PettingZoo has no registry yet")
def test_pettingzoo_makes_it():
    made = pettingzoo.make("parallel", "npa/Gardeners-v0", max_cycles=7, **GARDEN)
    assert made.unwrapped.max_cycles == 7


def test_what_one_earns_the_other_loses_until_the_time_limit():
    env = begun(gardeners_v0.parallel_env(max_cycles=3, **GARDEN))
    for step in range(3):
        assert env.agents == ["keeper_0", "raider_0"]
        actions = {agent: env.action_space(agent).sample() for agent in env.agents}
        seen, rewards, ended, late, _ = env.step(actions)
        assert np.array_equal(seen["keeper_0"], seen["raider_0"])
        assert rewards["keeper_0"] == -rewards["raider_0"] != 0.0
        assert not any(ended.values())
        assert set(late.values()) == {step == 2}
    assert env.agents == []
    refused("actions must be given for the agents", env.step, actions)


def test_two_gardeners_have_a_state_a_generator_and_the_same_numbers_in_all_infos():
    env = gardeners_v0.parallel_env(max_cycles=2, **GARDEN)
    refused("state needs a world: call reset first", env.state)
    _, infos = env.reset(seed=3)
    assert env.np_random.bit_generator.state == begun(env, seed=3).np_random.bit_generator.state
    names, reasons = set(infos["keeper_0"]), []
    while env.agents:
        x, s = env.garden.particles()
        assert np.array_equal(env.state(), torch.cat((x, s, torch.ones(61, 1)), dim=1))
        assert env.state_space.contains(env.state())
        *_, infos = env.step({agent: env.action_space(agent).sample() for agent in env.agents})
        assert set(infos["keeper_0"]) == set(infos["raider_0"]) == names
        assert all(isinstance(value, int | float) for value in infos["keeper_0"].values())
        reasons.append(AGENT_REASONS[infos["keeper_0"]["reason"]])
    assert reasons == [None, "time limit"]
    env.close()
    refused("step needs a world, which close has ended", env.step, {})


def test_brushes_of_both_add_up_and_without_a_raider_it_is_the_gardeners_world():
    both, alone = begun(
        gardeners_v0.parallel_env(**GARDEN),
        Gardener2DEnv(gust_chance=0.0, blight_chance=0.0, **GARDEN),
        seed=4,
    )
    half = np.full(alone.action_space.shape, 0.25, np.float32)
    _, rewards, *_ = both.step({"keeper_0": half, "raider_0": half})
    _, earned, *_ = alone.step(2.0 * half)
    assert rewards["keeper_0"] == pytest.approx(earned, abs=1e-5)
    _, rewards, *_ = both.step({"keeper_0": half, "raider_0": -half})
    _, earned, *_ = alone.step(0.0 * half)
    assert rewards["keeper_0"] == pytest.approx(earned, abs=1e-5)


# Worlds whose code the agent chooses


SHAPESHIFTER = "npa/Shapeshifter2D-v0"


def test_goals_change_after_they_were_held_and_are_never_the_same_twice_on_end(coded):
    env = make(SHAPESHIFTER, **coded)
    _, info = env.reset(seed=3)
    goals = [info["goal"]]
    for action in sampled(env, 40):
        goals.append(env.step(action)[4]["goal"])
    held = [goals[k] for k in range(0, len(goals), 2)]
    assert all(first == second for first, second in zip(goals[::2], goals[1::2], strict=False))
    assert all(first != second for first, second in pairwise(held))
    assert set(goals) == {0, 1, 2}


def test_a_step_is_paid_by_the_goal_that_was_seen_before_it(coded):
    env = make(SHAPESHIFTER, **coded)
    _, info = env.reset(seed=0)
    task = env.unwrapped.task
    for action in sampled(env, 4):
        goal = info["goal"]
        _, reward, _, _, info = env.step(action)
        x, s = (part[None] for part in env.unwrapped.particles())
        loss = sum(task.with_goal(torch.tensor([goal])).losses(x, s).values())
        blank = float(task.empty_losses[goal])
        assert reward == pytest.approx(max(-1.0, 1.0 - float(loss) / blank), rel=1e-5)


def test_an_empty_picture_has_the_loss_of_the_goals_density(coded):
    task = make(SHAPESHIFTER, **coded, resolution=32).unwrapped.task
    density = task.task.with_goal(torch.tensor([1])).target_picture[..., 3]
    loss = float((density + density * density).mean())
    assert float(task.empty_losses[1]) == pytest.approx(loss, rel=1e-6)


def test_the_goals_picture_is_seen_beside_the_worlds(coded):
    env = make(SHAPESHIFTER, **coded)
    seen, info = env.reset(seed=2)
    assert seen.shape == (128,)
    task = env.unwrapped.task
    target = task.task.with_goal(torch.tensor([info["goal"]])).target_picture[0]
    coarse = target.view(4, 4, 4, 4, 4).mean(dim=(1, 3)).permute(2, 0, 1)
    assert seen[64:] == pytest.approx(coarse.flatten().numpy(), abs=1e-6)


@pytest.mark.parametrize("actions", ["code", "choice"])
def test_a_script_recognises_goals_and_says_their_codes(coded, actions):
    env = make(SHAPESHIFTER, **coded, actions=actions)
    policy = RecognisingShapeshifter(env)
    seen, info = env.reset(seed=0)
    for _ in range(6):
        goal = info["goal"]
        seen, _, _, _, info = env.step(policy(seen))
        _, s = env.unwrapped.particles()
        codes = env.unwrapped.task.codes.table
        assert s[:, :3].numpy() == pytest.approx(codes[goal].expand(61, 3).numpy(), abs=1e-6)
    batch = make_vec(SHAPESHIFTER, 3, **coded, actions=actions)
    seen, _ = batch.reset(seed=0)
    assert RecognisingShapeshifter(batch)(seen).shape[0] == 3
    plain = make("npa/Morphogenesis2D-v0")
    refused("env must be one whose agent chooses codes", RecognisingShapeshifter, plain)


def test_slowed_particles_cross_the_edge_of_a_periodic_box_by_the_shortest_way():
    options = {"actions": "free", "tools": ("rate",), "boundary": "periodic", "box_size": 2.0}
    envs = make_vec(GARDENER, 2, **options, brush_radius=2.0)
    envs.reset(seed=0)
    worlds, task = envs.unwrapped.worlds, envs.unwrapped.worlds.task
    before = worlds.particles._replace(x=worlds.particles.x + 1.0)
    before = before._replace(x=before.x - 2.0 * (before.x / 2.0).round())
    action = torch.full((2, *envs.unwrapped.spaces.rows_shape), -0.5)
    after = task.brush_and_roll(before, action, worlds.random)
    moved = after.x - before.x
    moved -= 2.0 * (moved / 2.0).round()
    config = task.config
    most = config.rule_steps * task.rule.alpha * config.eps
    assert 0.0 < float(moved.norm(dim=-1).max()) <= most
    assert float(after.x.abs().max()) <= 1.0
