"""Stable-Baselines3's PPO learns to keep a heart whole.

pip install 'npa-envs[sb3]'
python examples/sb3_ppo.py
"""

import argparse
import json
from pathlib import Path

import gymnasium as gym
import torch
from stable_baselines3 import PPO

import npa_envs  # noqa: F401 (registers the ids)
from npa_envs.agents import NetworkPolicy, evaluate_policy, load_policy
from npa_envs.envs.garden.base import GardenTask
from npa_envs.render import write_webp

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--steps", type=int, default=30_000)
parser.add_argument("--env", default="npa/Gardener2DSmall-v0", help="whose actions are flat")
parser.add_argument("--curve", type=Path, default=Path("sb3_ppo.json"), help="to write")
parser.add_argument("--policy", type=Path, help="to write: the policy, .safetensors")
given = parser.parse_args()

torch.set_num_threads(1)  # enough for small worlds
name = given.env
env = gym.make(name, render_mode="rgb_array")
count = min(16, 2 + given.steps // 2000)  # held-out episodes
test_envs = gym.make_vec(name, num_envs=count)
test_envs.action_space.seed(0)
piece = min(2048, given.steps)  # steps before PPO learns from them
network = "MultiInputPolicy" if isinstance(env.observation_space, gym.spaces.Dict) else "MlpPolicy"
model = PPO(network, env, gamma=0.9, n_steps=piece, seed=0, device="cpu")


def policy(observations):
    return model.predict(observations, deterministic=True)[0]


def evaluation(policy):
    episodes = evaluate_policy(test_envs, policy, seeds=range(100, 100 + count))
    return episodes.mean_return, episodes.standard_error


def note():
    curve.append((model.num_timesteps, *evaluation(policy)))
    print(f"{curve[-1][0]} steps: return {curve[-1][1]:.2f}", flush=True)


def tell(*_):
    if model.num_timesteps % 512 == 0:
        print(f"{model.num_timesteps} steps", flush=True)
    return True


curve = []
note()
while model.num_timesteps < given.steps:
    model.learn(2 * piece, callback=tell, reset_num_timesteps=False)
    note()

results = {
    "learned": curve[-1][1:],
    "zero": evaluation(load_policy("zero", test_envs)),
    "random": evaluation(lambda _: test_envs.action_space.sample()),
}
if isinstance(env.unwrapped.task, GardenTask):
    results["scripted"] = evaluation(load_policy("scripted", test_envs))
if given.policy:
    command = f"python examples/sb3_ppo.py --env {name} --steps {given.steps}"
    NetworkPolicy.of_sb3(model).save(given.policy, {"command": command})
given.curve.write_text(json.dumps({"env": name, "curve": curve, **results}), encoding="utf-8")
print("returns, " + ", ".join(f"{k}: {mean:.2f} ± {e:.2f}" for k, (mean, e) in results.items()))

observation, _ = env.reset(seed=100)
frames = [env.render()]
for _ in range(32):
    observation, *_ = env.step(policy(observation))
    frames.append(env.render())
write_webp(given.curve.with_suffix(".webp"), frames, fps=8)
