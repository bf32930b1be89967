"""Environments whose walls reflect particles."""

import numpy as np
import pytest
import torch
from small_envs import make

from npa_envs import reference
from npa_envs.envs import multispecies_v0

WALLS = {"boundary": "reflecting", "box_size": 0.8}
EVERYONE = {"update_prob": 1.0, "alpha": 3.0}
"""Steps of up to 0.9."""


@pytest.mark.parametrize("name", ["npa/Morphogenesis2D-v0", "npa/Morphogenesis3D-v0"])
def test_a_step_is_the_formula_folded_at_the_walls(name):
    env = make(name, **WALLS, **EVERYONE).unwrapped
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
    found = env.particles()[0].double()
    assert float((found - expected).abs().max()) < 2e-6
    assert not terminated
    assert not info["diverged"]


def test_species_live_between_walls():
    env = multispecies_v0.parallel_env(
        "mixing", particle_count=24, seed_radius=0.1, seed_distance=0.2, **WALLS, **EVERYONE
    )
    env.reset(seed=0)
    for _ in range(4):
        env.step({agent: env.action_space(agent).sample() for agent in env.agents})
    assert env.agents
    assert (env.particles()[0].abs() <= 0.4).all()
