"""Evolution by a library: CMA-ES finds a linear policy that all particles share.

    pip install 'npa-envs[evolution]'
    python examples/evolution.py

World k of the batch is that of candidate k, so a generation is one batch of episodes.
"""

import argparse
import json
from pathlib import Path

import cma
import gymnasium as gym
import numpy as np
import torch

import npa_envs  # noqa: F401 (registers the ids)
from npa_envs.agents import evaluate_policy

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--steps", type=int, default=80_000, help="of all worlds together")
parser.add_argument("--curve", type=Path, default=Path("evolution.json"), help="to write")
given = parser.parse_args()

NAME, LENGTH, CANDIDATES = "npa/Morphogenesis2DSmall-v0", 32, 32

torch.set_num_threads(1)  # enough for small worlds
envs = gym.make_vec(NAME, num_envs=CANDIDATES)
test_envs = gym.make_vec(NAME, num_envs=32)
test_envs.action_space.seed(0)
perceived, acted = envs.observation_space.shape[-1], envs.action_space.shape[-1]


def actions_of(candidates, observations):
    """Return actions [B, N, A] for B vectors of weights, and as many worlds' [B, N, P]."""
    weights = np.reshape(candidates, (-1, perceived + 1, acted)).astype(np.float32)
    return np.tanh(observations @ weights[:, :-1] + weights[:, -1:])


def returns_of(candidates, seed):
    """Return the return of each candidate's episode; all begin with the same seed."""
    observations, _ = envs.reset(seed=[seed] * CANDIDATES)
    total = np.zeros(CANDIDATES)
    for _ in range(LENGTH):
        observations, rewards, *_ = envs.step(actions_of(candidates, observations))
        total += rewards
    return total


def evaluation(policy):
    episodes = evaluate_policy(test_envs, policy, seeds=range(100, 132))
    return episodes.mean_return, episodes.standard_error


def policy(observations):
    """Act by the mean of all candidates."""
    return actions_of(strategy.mean, observations)


options = {"popsize": CANDIDATES, "CMA_diagonal": True, "seed": 1, "verbose": -9}
strategy = cma.CMAEvolutionStrategy(np.zeros((perceived + 1) * acted), 0.1, options)
curve = []
generations = max(1, given.steps // (CANDIDATES * LENGTH))
for k in range(generations):
    if k % 8 == 0:
        curve.append((k * CANDIDATES * LENGTH, *evaluation(policy)))
        print(f"{curve[-1][0]} steps: {curve[-1][1]:.2f}", flush=True)
    candidates = strategy.ask()
    strategy.tell(candidates, -returns_of(candidates, seed=1000 + k))

curve.append((generations * CANDIDATES * LENGTH, *evaluation(policy)))
results = {
    "learned": curve[-1][1:],
    "zero": evaluation(lambda _: np.zeros(test_envs.action_space.shape, np.float32)),
    "random": evaluation(lambda _: test_envs.action_space.sample()),
}
given.curve.write_text(json.dumps({"env": NAME, "curve": curve, **results}), encoding="utf-8")
print("returns, " + ", ".join(f"{k}: {mean:.2f} ± {e:.2f}" for k, (mean, e) in results.items()))
