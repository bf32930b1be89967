"""One controller of few numbers: places interpolate its actions, a picture is what it observes."""

import gymnasium
import numpy as np
import pytest
import torch
from support.refusals import refused

from npa_envs.agents.learning import Problem, methods_for
from npa_envs.registration import CENTRAL

NAME = "npa/Morphogenesis2D-v0"
WORLD = {"particle_count": 5, "state_dim": 4, "update_prob": 1.0, "eps": 0.2}


def make(**fields):
    env = gymnasium.make(NAME, **WORLD | {"control": "central"} | fields).unwrapped
    env.reset(seed=0)
    return env


def test_an_action_of_one_place_is_that_of_every_particle():
    central, rows = make(place_count=1), make(control="particles")
    action = np.linspace(-0.5, 0.5, 6, dtype=np.float32)
    for _ in range(3):
        _, reward, *_ = central.step(action)
        assert reward == rows.step(np.tile(action, (5, 1)))[1]
    for left, right in zip(central.particles(), rows.particles(), strict=True):
        assert torch.equal(left, right)


def test_actions_are_interpolated_between_places_and_beyond_them_the_nearest():
    # Places at -0.5 and 0.5: lower left, lower right, upper left, upper right.
    env = make(place_count=2, place_reach=0.5, state_scale=1.0)
    x = torch.tensor([[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5], [0.0, 0.25], [3.0, 3.0]])
    env.place_particles(x, torch.zeros(5, 4))
    action = np.zeros((4, 6), np.float32)
    action[:, 2] = 0.1, 0.2, 0.3, 0.4
    env.step(action.ravel())
    _, s = env.particles()
    torch.testing.assert_close(s[:, 0], torch.tensor([0.1, 0.2, 0.3, 0.3, 0.4]))
    assert not s[:, 1:].any()


def test_the_picture_is_colour_and_density_pixel_by_pixel():
    env = make(picture_size=3, place_reach=0.5)
    x = torch.tensor([[-0.5, -0.5], [0.5, -0.5], [0.0, 0.5], [0.0, 0.5], [0.25, 0.0]])
    s = torch.zeros(5, 4)
    s[:, 1] = 0.5
    red, green, _, density = env.place_particles(x, s).reshape(3, 3, 4).transpose(2, 0, 1)
    # Particles that cover the square evenly have density 1.
    expected = np.array([[1.0, 0.0, 1.0], [0.0, 0.5, 0.5], [0.0, 2.0, 0.0]]) * 9 / 5
    np.testing.assert_allclose(density, expected, rtol=1e-6)
    np.testing.assert_allclose(red, expected, rtol=1e-6)
    np.testing.assert_allclose(green, 0.5 * expected, rtol=1e-6)


def test_wrong_central_actions_leave_the_world_and_some_worlds_have_no_centre():
    env = make(place_count=2)
    before = env.particles()
    refused(r"\[P² A\] = \(24,\), got \(5, 6\)", env.step, np.zeros((5, 6), np.float32))
    refused("action.*must be finite", env.step, np.full(24, np.nan, np.float32))
    assert all(map(torch.equal, before, env.particles()))
    refused("state_dim must be .* at least 3", make, state_dim=2)
    for name in ("Morphogenesis3D", "Pictures2D", "Gardener2D", "Shapeshifter2D"):
        rule = "control must be 'particles'"
        refused(rule, gymnasium.make, f"npa/{name}-v0", control="central")


@pytest.mark.parametrize("row", CENTRAL, ids=lambda row: row.id)
def test_the_small_forms_are_for_other_libraries_learners(row):
    problem = Problem(env_id=row.id, episode_steps=4)
    assert problem.controlled == "central"
    assert methods_for(problem) == {}


@pytest.mark.slow
@pytest.mark.parametrize("row", CENTRAL, ids=lambda row: row.id)
def test_ppo_of_another_library_learns_with_its_own_settings(row):
    sb3 = pytest.importorskip("stable_baselines3")
    env = gymnasium.make(row.id)
    model = sb3.PPO("MlpPolicy", env, seed=0, device="cpu").learn(12_288)
    returns = []
    for seed in range(1000, 1008):
        observation, _ = env.reset(seed=seed)
        returns.append(0.0)
        over = False
        while not over:
            action, _ = model.predict(observation, deterministic=True)
            observation, reward, terminated, truncated, _ = env.step(action)
            returns[-1] += reward
            over = terminated or truncated
    # Without actions a return is 0, and random ones get 0.05 and -0.3.
    assert np.mean(returns) > 0.2
