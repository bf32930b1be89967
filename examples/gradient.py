"""The gradient through the world: a policy descends the environment's loss, and grows a heart.

    pip install npa-envs
    python examples/gradient.py

The policy is a rule, a small network that each particle runs on what it perceives. Torch
differentiates all steps of an episode, so that no reward has to be explored.
"""

import argparse
import json
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch

import npa_envs
from npa_envs.agents import RulePolicy, evaluate_policy

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--steps", type=int, default=40_000, help="of all worlds together")
parser.add_argument("--curve", type=Path, default=Path("gradient.json"), help="to write")
given = parser.parse_args()

NAME, LENGTH, WORLDS, RATE = "npa/Morphogenesis2DSmall-v0", 32, 8, 4e-3
# A step may change a state by as much as the rule says, and is not clipped.
TASK = {"target": "heart", "state_scale": 1.0}

torch.set_num_threads(1)  # enough for small worlds
torch.manual_seed(0)
envs = gym.make_vec(NAME, num_envs=WORLDS, **TASK).unwrapped
test_envs = gym.make_vec(NAME, num_envs=32, **TASK)
test_envs.action_space.seed(0)
config, task = envs.task.config, envs.task
rule = npa_envs.NPARule(2, state_dim=config.state_dim, hidden_dim=64, eps0=config.eps0)
optimiser = torch.optim.Adam(rule.parameters(), lr=RATE)
policy = RulePolicy(rule, test_envs)


def evaluation(policy):
    episodes = evaluate_policy(test_envs, policy, seeds=range(100, 132))
    return episodes.mean_return, episodes.standard_error


curve = []
rounds = max(1, given.steps // (LENGTH * WORLDS))
for k in range(rounds):
    if k % 16 == 0:
        curve.append((k * LENGTH * WORLDS, *evaluation(policy)))
        print(f"{curve[-1][0]} steps: {curve[-1][1]:.2f}", flush=True)
    optimiser.param_groups[0]["lr"] = RATE * (1.0 - k / rounds)

    # The worlds of new episodes, and where the rule brings them.
    envs.reset(seed=1000 + WORLDS * k)
    x, s = envs.worlds.x.clone(), envs.worlds.s.clone()
    physics = {"eps": config.eps, "update_prob": config.update_prob}
    random = npa_envs.WorldRandom(range(WORLDS * k, WORLDS * (k + 1)))
    x, s = npa_envs.rollout(rule, x, s, LENGTH, generator=random, **physics)

    # An episode's return is the loss at its start less that at its end.
    loss = sum(task.losses(x, s).values()).mean()
    optimiser.zero_grad()
    loss.backward()
    torch.nn.utils.clip_grad_norm_(rule.parameters(), 1.0)
    optimiser.step()

curve.append((rounds * LENGTH * WORLDS, *evaluation(policy)))
results = {
    "learned": curve[-1][1:],
    "zero": evaluation(lambda _: np.zeros(test_envs.action_space.shape, np.float32)),
    "random": evaluation(lambda _: test_envs.action_space.sample()),
}
given.curve.write_text(json.dumps({"env": NAME, "curve": curve, **results}), encoding="utf-8")
print("returns, " + ", ".join(f"{k}: {mean:.2f} ± {e:.2f}" for k, (mean, e) in results.items()))
npa_envs.save_rule(rule, given.curve.with_suffix(".safetensors"))
