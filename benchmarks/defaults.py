"""Stable-Baselines3's PPO and SAC by their own defaults, judged by each task's own metric.

python benchmarks/defaults.py npa/Gardener2DSmall-v0 PPO 0  # prints a line of JSON
"""

import json
import sys
import time

import gymnasium as gym
import numpy as np
import pettingzoo
import stable_baselines3 as sb3
import torch

from npa_envs.agents import load_policy
from npa_envs.envs import particles_v0

torch.set_num_threads(1)  # small worlds; a busy machine does not slow them down
ID, LEARNER, SEED, SECONDS = sys.argv[1], sys.argv[2], int(sys.argv[3]), 200
METRIC = {"She": "distance", "Poi": "accuracy"}.get(ID[4:7], "loss")
AGENTS = ID in particles_v0.SMALL
make = (lambda: pettingzoo.make("parallel", ID)) if AGENTS else (lambda: gym.make(ID))


def episode(env, policy, seed):
    """Return the return and the metric after the last step; of particles, their means."""
    (seen, info), total, over = env.reset(seed=seed), 0.0, False
    while not over:
        if AGENTS:
            actions = dict(zip(seen, policy(np.stack(list(seen.values()))), strict=True))
            seen, rewards, _, _, info = env.step(actions)
            total, over = total + np.mean(list(rewards.values())), not env.agents
        else:
            seen, reward, terminated, truncated, info = env.step(policy(seen))
            total, over = total + reward, terminated or truncated
    return total, np.mean([i[METRIC] for i in info.values()]) if AGENTS else info[METRIC]


def evaluation(env, policy):
    """Return means of 8 episodes from each of 5 groups of held-out seeds."""
    groups = [range(first, first + 8) for first in range(3_000_000, 3_005_000, 1000)]
    means = np.mean([[episode(env, policy, seed) for seed in group] for group in groups], axis=1)
    return {"return": means[:, 0].tolist(), METRIC: means[:, 1].tolist()}


env, seed = make(), SEED
if AGENTS:  # SuperSuit's rows have no seed method, so the model gets no seed.
    import supersuit

    sb3.common.utils.set_random_seed(SEED)
    env.reset(seed=SEED)
    env, seed = supersuit.pettingzoo_env_to_vec_env_v1(env), None
    env = supersuit.concat_vec_envs_v1(env, 1, base_class="stable_baselines3")
network = "MultiInputPolicy" if isinstance(env.observation_space, gym.spaces.Dict) else "MlpPolicy"
model = getattr(sb3, LEARNER)(network, env, seed=seed, device="cpu")
end = time.process_time() + SECONDS
model.learn(10**9, callback=lambda *_: time.process_time() < end)

test = make()
space = test.action_space(test.possible_agents[0]) if AGENTS else test.action_space
shape = (len(test.possible_agents), *space.shape) if AGENTS else space.shape
draw = np.random.default_rng(0)
policies = {
    "learned": lambda seen: model.predict(seen, deterministic=True)[0],
    "zero": lambda _: np.zeros(shape, np.float32),
    "random": lambda _: draw.uniform(-1, 1, shape).astype(np.float32),
}
if "Gardener2D" in ID or "Shepherd2D" in ID:
    policies["scripted"] = load_policy("scripted", test)
results = {name: evaluation(test, policy) for name, policy in policies.items()}
run = {"id": ID, "learner": LEARNER, "seed": SEED, "steps": model.num_timesteps}
print(json.dumps(run | results))
