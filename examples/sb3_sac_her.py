"""Stable-Baselines3's SAC with Hindsight Experience Replay carries a heart to places.

    pip install 'npa-envs[sb3]'
    python examples/sb3_sac_her.py

The reward is sparse: 0 where the heart is at its goal and whole, otherwise -1.
"""

import argparse
import json
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3 import SAC, HerReplayBuffer

import npa_envs  # noqa: F401 (registers the ids)
from npa_envs.agents import evaluate_policy
from npa_envs.agents.garden_policies import ScriptedShepherd

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--steps", type=int, default=15_000)
parser.add_argument("--curve", type=Path, default=Path("sb3_sac_her.json"), help="to write")
given = parser.parse_args()

torch.set_num_threads(1)  # enough for small worlds
name = "npa/Shepherd2DSmall-v0"
env = gym.make(name, reward="sparse")
count = min(32, 2 + given.steps // 500)  # held-out episodes
test_envs = gym.make_vec(name, num_envs=count, reward="sparse")
test_envs.action_space.seed(0)
model = SAC(
    "MultiInputPolicy",
    env,
    gamma=0.95,
    replay_buffer_class=HerReplayBuffer,
    learning_starts=min(1_000, given.steps),
    seed=0,
    device="cpu",
)


def policy(observations):
    return model.predict(observations, deterministic=True)[0]


def evaluation(policy):
    episodes = evaluate_policy(test_envs, policy, seeds=range(100, 100 + count))
    return episodes.mean_return, episodes.standard_error


def note():
    curve.append((model.num_timesteps, *evaluation(policy)))
    print(f"{curve[-1][0]} steps: return {curve[-1][1]:.2f}", flush=True)


def tell(*_):
    if model.num_timesteps % 500 == 0:
        print(f"{model.num_timesteps} steps", flush=True)
    return True


curve = []
note()
while model.num_timesteps < given.steps:
    model.learn(min(3_000, given.steps), callback=tell, reset_num_timesteps=False)
    note()

results = {
    "learned": curve[-1][1:],
    "zero": evaluation(lambda _: np.zeros(test_envs.action_space.shape, np.float32)),
    "random": evaluation(lambda _: test_envs.action_space.sample()),
    "scripted": evaluation(ScriptedShepherd(test_envs)),
}
given.curve.write_text(json.dumps({"env": name, "curve": curve, **results}), encoding="utf-8")
print("returns, " + ", ".join(f"{k}: {mean:.2f} ± {e:.2f}" for k, (mean, e) in results.items()))

observations, _ = test_envs.reset(seed=100)
for _ in range(32):
    observations, _, _, _, infos = test_envs.step(policy(observations))
print(f"arrived and whole: {infos['final_info']['is_success'].mean():.2f}")
