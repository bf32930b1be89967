"""Running normalisation of perception."""

import json

import gymnasium as gym
import numpy as np
import pytest
import torch
from wrapped_envs import ACTIONS, STEPS, batched, policy, single

import npa_envs  # noqa: F401 (registers the environments)
from npa_envs.errors import NPAError
from npa_envs.wrappers import (
    NormalizePerception,
    SpeciesTags,
    VectorNormalizePerception,
)
from npa_envs.wrappers.statistics import PerceptionStatistics

C, D, P = 16, 2, 66


def expected_scales(z):
    """Mean and standard deviation of each entry by group, from all samples at once."""
    z = z.reshape(-1, P).astype(np.float64)
    mean, var = z.mean(axis=0), z.var(axis=0)
    gradients = (z[:, 2 * C : -D] ** 2).mean(axis=0).reshape(C, D).mean(axis=1)
    mean[2 * C :] = 0.0
    var[2 * C : -D] = gradients.repeat(D)
    var[-D:] = (z[:, -D:] ** 2).mean()
    return mean, np.sqrt(var)


@pytest.mark.parametrize("kind", ["single", "vector", "torch"])
def test_statistics_are_those_of_everything_seen(kind):
    if kind == "single":
        env, plain = NormalizePerception(single()), single()
    else:
        output = "torch" if kind == "torch" else "numpy"
        env, plain = VectorNormalizePerception(batched(output=output)), batched()
    normal, _ = env.reset(seed=2)
    z, _ = plain.reset(seed=2)
    seen = [z]
    for _ in range(STEPS - 2):
        action = policy(z)
        normal, *_ = env.step(action)
        z, *_ = plain.step(action)
        seen.append(z)
    mean, deviation = expected_scales(np.stack(seen))
    wanted = np.clip((z - mean) / deviation, -10, 10)
    assert isinstance(normal, torch.Tensor) == (kind == "torch")
    normal = np.asarray(normal)
    assert normal.dtype == np.float32
    np.testing.assert_allclose(normal, wanted, rtol=1e-3, atol=1e-3)
    assert env.observation_space.contains(normal)


def test_directions_stay_what_they_are():
    env, plain = NormalizePerception(single()), single()
    env.reset(seed=0)
    z, _ = plain.reset(seed=0)
    for _ in range(3):
        action = policy(z)
        normal, *_ = env.step(action)
        z, *_ = plain.step(action)
    for before, after in (
        (z[:, 2 * C : -D].reshape(64, C, D), normal[:, 2 * C : -D].reshape(64, C, D)),
        (z[:, -D:], normal[:, -D:]),
    ):
        assert np.abs(before).max() > 0.1
        cross = before[..., 0] * after[..., 1] - before[..., 1] * after[..., 0]
        np.testing.assert_allclose(cross, 0.0, atol=2e-5)
        assert ((before * after).sum(axis=-1) >= 0).all()


def test_particles_are_scaled_alike():
    statistics = PerceptionStatistics(single().unwrapped.worlds.physics)
    z = np.random.default_rng(0).normal(size=(64, P)).astype(np.float32)
    statistics.update(z)
    order = np.random.default_rng(1).permutation(64)
    np.testing.assert_array_equal(statistics.normalize(z)[order], statistics.normalize(z[order]))


def test_batches_add_up_whatever_their_sizes():
    z = np.random.default_rng(0).normal(3.0, 2.0, size=(1000, P)).astype(np.float32)
    physics = single().unwrapped.worlds.physics
    whole, parts = PerceptionStatistics(physics), PerceptionStatistics(physics)
    whole.update(z)
    for part in np.split(z, [10, 11, 500]):
        parts.update(part)
    for name, value in whole.moments.state_dict().items():
        torch.testing.assert_close(parts.moments.state_dict()[name], value, rtol=1e-6, atol=1e-6)
    assert whole.moments.count == pytest.approx(1000, abs=1e-3)


def test_frozen_statistics_stay_and_can_be_saved_and_shared(tmp_path):
    env = VectorNormalizePerception(batched())
    z, _ = env.reset(seed=0)
    for _ in range(3):
        z, *_ = env.step(policy(z))
    torch.save(env.state_dict(), tmp_path / "statistics.pt")
    test = VectorNormalizePerception(batched(), training=False)
    test.load_state_dict(torch.load(tmp_path / "statistics.pt"))
    shared = VectorNormalizePerception(batched(), training=False, statistics=env.statistics)
    env.training = False
    state = env.state_dict()
    seen = [wrapper.reset(seed=9)[0] for wrapper in (env, test, shared)]
    np.testing.assert_array_equal(seen[0], seen[1])
    np.testing.assert_array_equal(seen[0], seen[2])
    for name, value in env.state_dict().items():
        assert torch.equal(value, state[name])


@pytest.mark.parametrize("output", ["numpy", "torch"])
def test_a_reset_of_one_world_counts_only_that_world(output):
    keywords = {"autoreset_mode": "disabled", "output": output}
    env = VectorNormalizePerception(batched(4, **keywords))
    plain = batched(4, autoreset_mode="disabled")
    env.reset(seed=3)
    z, _ = plain.reset(seed=3)
    seen = [z]
    for _ in range(2):
        action = policy(z)
        env.step(action)
        z, *_ = plain.step(action)
        seen.append(z)
    options = {"reset_mask": np.array([False, True, False, False])}
    normal, _ = env.reset(options=options)
    z, _ = plain.reset(options=options)
    assert env.statistics.moments.count == pytest.approx(13 * 64, abs=1e-3)
    mean, deviation = expected_scales(np.concatenate([*seen, z[1:2]]))
    wanted = np.clip((z - mean) / deviation, -10, 10)
    np.testing.assert_allclose(np.asarray(normal), wanted, rtol=1e-3, atol=1e-3)
    z, *_ = plain.step(policy(z))
    env.step(np.zeros((4, 64, ACTIONS), np.float32))
    assert env.statistics.moments.count == pytest.approx(17 * 64, abs=1e-3)


@pytest.mark.parametrize(
    "keywords", [{}, {"clip": 2.0, "epsilon": 0.5, "training": False}], ids=["defaults", "given"]
)
def test_an_environment_made_from_the_spec_is_wrapped_alike(keywords):
    env = NormalizePerception(single(), **keywords)
    spec = gym.envs.registration.EnvSpec.from_json(env.spec.to_json())
    made = gym.make(spec)
    assert isinstance(made, NormalizePerception)
    assert made.training is keywords.get("training", True)
    first, _ = env.reset(seed=1)
    np.testing.assert_array_equal(made.reset(seed=1)[0], first)
    for _ in range(3):
        action = policy(first)
        first, *_ = env.step(action)
        np.testing.assert_array_equal(made.step(action)[0], first)
    assert np.abs(first).max() <= keywords.get("clip", 10.0)


def test_the_spec_of_shared_statistics_holds_their_numbers_and_not_themselves():
    trained = NormalizePerception(single(), clip=3.0, epsilon=0.1)
    trained.reset(seed=0)
    env = NormalizePerception(single(), training=False, statistics=trained.statistics)
    kwargs = env.spec.additional_wrappers[-1].kwargs
    assert kwargs == {"clip": 3.0, "epsilon": 0.1, "training": False}
    assert json.loads(env.spec.to_json())["additional_wrappers"][-1]["kwargs"] == kwargs
    made = gym.make(env.spec)
    assert made.statistics.clip == 3.0
    made.load_state_dict(env.state_dict())
    np.testing.assert_array_equal(made.reset(seed=4)[0], env.reset(seed=4)[0])
    vector = VectorNormalizePerception(batched(), statistics=trained.statistics)
    assert vector.statistics is trained.statistics
    assert vector._saved_kwargs == {"clip": 3.0, "epsilon": 0.1, "training": True}


def shared(wrapper, make, **keywords):
    return wrapper(make(), statistics=NormalizePerception(single()).statistics, **keywords)


def test_final_observations_are_normalised_and_not_counted():
    env, plain = VectorNormalizePerception(batched()), batched()
    env.reset(seed=1)
    z, _ = plain.reset(seed=1)
    for _ in range(STEPS):
        action = policy(z)
        *_, infos = env.step(action)
        z, *_, plain_infos = plain.step(action)
    assert env.statistics.moments.count == pytest.approx((STEPS + 1) * 3 * 64, abs=1e-3)
    np.testing.assert_array_equal(
        infos["final_obs"], env.statistics.normalize(plain_infos["final_obs"])
    )
    assert np.abs(infos["final_obs"] - plain_infos["final_obs"]).max() > 0.1


def test_blank_worlds_give_finite_numbers():
    env = NormalizePerception(single(), clip=2.0)
    normal, _ = env.reset(seed=0)
    assert np.isfinite(normal).all()
    assert (normal[:, : 2 * C] == 0).all()
    action = np.zeros((64, ACTIONS), np.float32)
    action[0, -1] = 1.0
    sizes = [np.abs(env.step(action)[0]).max() for _ in range(4)]
    assert max(sizes) == 2.0
    assert env.observation_space == gym.spaces.Box(-2.0, 2.0, (64, P), np.float32)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: NormalizePerception(single(), clip=0.0), "clip must be a finite number"),
        (lambda: NormalizePerception(single(), epsilon=-1.0), "epsilon must be"),
        (lambda: NormalizePerception(batched()), "use VectorNormalizePerception"),
        (lambda: VectorNormalizePerception(single()), "use NormalizePerception"),
        (lambda: NormalizePerception(SpeciesTags(single())), "normalise before other wrappers"),
        (
            lambda: NormalizePerception(gym.wrappers.FlattenObservation(single())),
            "normalise before other wrappers",
        ),
        (lambda: shared(NormalizePerception, single, clip=10.0), "clip belongs to statistics"),
        (lambda: shared(NormalizePerception, single, epsilon=1e-3), "epsilon belongs to stat"),
        (lambda: shared(VectorNormalizePerception, batched, clip=5.0), "has 10, got 5.0 as well"),
        (lambda: NormalizePerception(single(), statistics={}), "got dict: give wrapper.statistics"),
        (lambda: NormalizePerception(single()).load_state_dict({}), "missing statistic"),
        (
            lambda: NormalizePerception(single()).load_state_dict(
                {"mean": torch.zeros(3), "var": torch.zeros(3), "count": 1.0}
            ),
            r"mean must have shape \(49,\), got \(3,\)",
        ),
    ],
)
def test_a_mistake_is_named(make, message):
    with pytest.raises(NPAError, match=message):
        make()
