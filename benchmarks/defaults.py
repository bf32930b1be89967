"""Learners of other libraries by their own defaults, judged by each task's own metric.

python benchmarks/defaults.py npa/Gardener2DSmall-v0 PPO 0 250  # id, learner, seed, CPU seconds
python benchmarks/defaults.py npa/Gardener2DSmall-v0 SAC 0 250 ent_coef=auto_0.01  # and settings

It prints a line of JSON. Learners are PPO and SAC of Stable-Baselines3, a clone's file
cleanrl/ppo_continuous_action.py of github.com/vwxyzjn/cleanrl, which runs as it is, and the
policies to compare with: zero, random, scripted. Where particles act, the script is the best of
some, by other worlds; where one controller acts for them, it acts by particles.
"""

import contextlib
import json
import runpy
import sys
import time

import gymnasium as gym
import numpy as np
import pettingzoo
import stable_baselines3 as sb3
import torch

from npa_envs.agents import load_policy
from npa_envs.agents.learning import Budget, Problem, train
from npa_envs.envs import particles_v0

torch.set_num_threads(1)  # enough for small worlds
ID, LEARNER, SEED, SECONDS = *sys.argv[1:3], int(sys.argv[3]), float(sys.argv[4])
SETTINGS = dict(setting.split("=") for setting in sys.argv[5:])
NAME = " ".join([LEARNER, *sys.argv[5:]])
AGENTS = ID in particles_v0.SMALL
METRIC = {"She": "distance", "Poi": "accuracy"}.get(ID[4:7], "loss")


def make():
    """Return a new environment, PettingZoo's where each particle is an agent."""
    return pettingzoo.make("parallel", ID) if AGENTS else gym.make(ID)


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


def learned_by_sb3():
    """Return the policy without noise, and how many steps all rows made."""
    env, seed = make(), SEED
    if AGENTS:  # SuperSuit's rows have no seed method, so the model gets no seed.
        import supersuit

        sb3.common.utils.set_random_seed(SEED)
        env.reset(seed=SEED)
        env, seed = supersuit.pettingzoo_env_to_vec_env_v1(env), None
        env = supersuit.concat_vec_envs_v1(env, 1, base_class="stable_baselines3")
    is_dict = isinstance(env.observation_space, gym.spaces.Dict)
    network = "MultiInputPolicy" if is_dict else "MlpPolicy"
    given = {name: value if "auto" in value else float(value) for name, value in SETTINGS.items()}
    model = getattr(sb3, LEARNER)(network, env, seed=seed, device="cpu", **given)
    end = time.process_time() + SECONDS
    model.learn(10**9, callback=lambda *_: time.process_time() < end)
    return lambda seen: model.predict(seen, deterministic=True)[0], model.num_timesteps


class SameStepVectorEnv(gym.vector.SyncVectorEnv):
    """Worlds restart within the step that ends them, as in Gymnasium 0.29, which CleanRL wants."""

    def __init__(self, functions):
        super().__init__(functions, autoreset_mode=gym.vector.AutoresetMode.SAME_STEP)

    def step(self, actions):
        """Step all worlds; infos are left out, as their form differs."""
        return *super().step(actions)[:4], {}


def learned_by_cleanrl():
    """Return the policy without noise, and its steps: as many as SECONDS seem to allow."""
    transform, space = gym.wrappers.TransformObservation, make().observation_space
    gym.wrappers.TransformObservation = lambda env, f: transform(env, f, env.observation_space)
    gym.vector.SyncVectorEnv = SameStepVectorEnv

    def run(steps):
        options = {"env-id": ID, "seed": SEED, "total-timesteps": steps, **SETTINGS}
        sys.argv = [LEARNER, "--no-cuda", *(f"--{name}={value}" for name, value in options.items())]
        with contextlib.redirect_stdout(sys.stderr):
            return runpy.run_path(LEARNER, run_name="__main__")

    run(2048)  # compiles kernels
    began = time.process_time()
    run(2048)
    steps = max(1, int(SECONDS / (time.process_time() - began))) * 2048
    made = run(steps)
    moments = made["envs"].envs[0].get_wrapper_attr("obs_rms")

    @torch.no_grad()
    def policy(seen):
        away = gym.spaces.flatten(space, seen) - moments.mean
        scaled = (away / np.sqrt(moments.var + 1e-8)).clip(-10, 10)
        row = torch.as_tensor(scaled, dtype=torch.float32)
        return made["agent"].actor_mean(row).numpy().clip(-1, 1)

    return policy, steps


def acting():
    """Return the policy of zeros or of random actions."""
    env, draw = make(), np.random.default_rng(SEED)
    space = env.action_space(env.possible_agents[0]) if AGENTS else env.action_space
    shape = (len(env.possible_agents), *space.shape) if AGENTS else space.shape
    limit = float(LEARNER == "random")
    return lambda _: draw.uniform(-limit, limit, shape).astype(np.float32)


def scripted():
    """Return the environment that a script acts in, and the script."""
    env = make()
    if ID[4:7] in ("Gar", "She"):
        return env, load_policy("scripted", env)
    given = {} if AGENTS else {"control": "particles"}
    length = env.max_cycles if AGENTS else env.spec.max_episode_steps
    problem = Problem(env_id=particles_v0.SMALL.get(ID, ID), keywords=given, episode_steps=length)
    best = train("scripted", problem, Budget(seconds=SECONDS), SEED).policy
    return (env if AGENTS else gym.make(ID, **given)), best


test, steps = make(), 0
if LEARNER == "scripted":
    test, policy = scripted()
elif LEARNER in ("zero", "random"):
    policy = acting()
else:
    policy, steps = learned_by_cleanrl() if LEARNER.endswith(".py") else learned_by_sb3()
# Means of 8 episodes from each of 5 groups of held-out seeds.
groups = [range(first, first + 8) for first in range(3_000_000, 3_005_000, 1000)]
means = np.mean([[episode(test, policy, seed) for seed in group] for group in groups], axis=1)
run = {"id": ID, "learner": NAME, "seed": SEED, "steps": steps}
print(json.dumps(run | {"return": means[:, 0].tolist(), METRIC: means[:, 1].tolist()}))
