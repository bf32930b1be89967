"""Gymnasium's own wrappers over the environments."""

import numpy as np
import pytest
from gymnasium import spaces, wrappers
from gymnasium.wrappers import vector
from wrapped_envs import ACTIONS, STEPS, batched, single

from npa_envs.wrappers import VectorDamageEvents


def actions(step, *shape):
    return np.random.default_rng(step).uniform(-1, 1, (*shape, 64, ACTIONS)).astype(np.float32)


ROW = spaces.Box(-1.0, 1.0, (64 * ACTIONS,))
BINS = np.arange(64 * ACTIONS) % 5
ACTION = actions(0)


@pytest.mark.parametrize(
    ("wrap", "given", "expected"),
    [
        (wrappers.ClipAction, 3 * ACTION, np.clip(3 * ACTION, -1, 1)),
        (
            lambda env: wrappers.RescaleAction(env, np.float32(0.0), np.float32(1.0)),
            (ACTION + 1) / 2,
            ACTION,
        ),
        # The middles of five bins of [-1, 1].
        pytest.param(
            lambda env: wrappers.DiscretizeAction(env, bins=5, multidiscrete=True),
            BINS,
            (0.4 * BINS - 0.8).astype(np.float32).reshape(64, ACTIONS),
            marks=pytest.mark.skipif(
                not hasattr(wrappers, "DiscretizeAction"), reason="Gymnasium before 1.2"
            ),
        ),
        # In one row, as RLlib takes them.
        (
            lambda env: wrappers.TransformAction(env, lambda a: a.reshape(64, ACTIONS), ROW),
            ACTION.ravel(),
            ACTION,
        ),
    ],
    ids=["clipped", "rescaled", "numbers of bins", "one row"],
)
def test_actions_of_other_forms(wrap, given, expected):
    env, plain = wrap(single()), single()
    env.reset(seed=0)
    plain.reset(seed=0)
    np.testing.assert_allclose(env.step(given)[0], plain.step(expected)[0], atol=1e-4)


def test_record_video(tmp_path):
    pytest.importorskip("moviepy")
    env = wrappers.RecordVideo(single(render_mode="rgb_array", render_size=32), str(tmp_path))
    env.reset(seed=0)
    for step in range(STEPS):
        env.step(actions(step))
    env.close()
    assert [path.suffix for path in tmp_path.glob("*.mp4")] == [".mp4"]


def test_partial_resets_pass_through_gymnasiums_statistics():
    env = VectorDamageEvents(vector.RecordEpisodeStatistics(batched()), "0:cut")
    env.reset(seed=0)
    options = {"reset_mask": np.array([True, False, False])}
    _, infos = env.reset(options=options)
    assert infos["_loss_damage"].tolist() == [True, False, False]
    assert "reset_mask" in options
