"""PPO in one file, in the style of CleanRL, learns to keep a heart whole.

    pip install npa-envs
    python examples/ppo_one_file.py

It needs torch and Gymnasium alone, and takes about four minutes of one core.
"""

import argparse
import json
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
from torch import nn
from torch.distributions import Normal

import npa_envs  # noqa: F401 (registers the ids)
from npa_envs.agents import evaluate_policy

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--steps", type=int, default=30_000, help="of all worlds together")
parser.add_argument("--curve", type=Path, default=Path("ppo_one_file.json"), help="to write")
given = parser.parse_args()

NAME = "npa/Gardener2DSmall-v0"
WORLDS, ROLLOUT, EPOCHS, MINIBATCH = 8, 128, 10, 64
GAMMA, LAMBDA, CLIP, RATE = 0.9, 0.95, 0.2, 1e-3
EVERY = 5  # rounds between evaluations

torch.set_num_threads(1)  # enough for small worlds
torch.manual_seed(0)
envs = gym.make_vec(NAME, num_envs=WORLDS)
test_envs = gym.make_vec(NAME, num_envs=16)
test_envs.action_space.seed(0)
observed, acted = (
    space.shape[0] for space in (envs.single_observation_space, envs.single_action_space)
)


def network(outputs, last_gain):
    layers = nn.Linear(observed, 64), nn.Linear(64, 64), nn.Linear(64, outputs)
    for layer, gain in zip(layers, (2**0.5, 2**0.5, last_gain), strict=True):
        nn.init.orthogonal_(layer.weight, gain)
        nn.init.zeros_(layer.bias)
    return nn.Sequential(layers[0], nn.Tanh(), layers[1], nn.Tanh(), layers[2])


actor, critic = network(acted, 0.01), network(1, 1.0)
# Pushes at random do more harm than no gardener: it explores by small ones.
log_std = nn.Parameter(-torch.ones(acted))
parameters = [*actor.parameters(), *critic.parameters(), log_std]
optimiser = torch.optim.Adam(parameters, lr=RATE, eps=1e-5)


def value(observations):
    return critic(observations).squeeze(-1)


def policy(observations):
    """Return the mean actions, clipped to the action space."""
    with torch.no_grad():
        return actor(torch.as_tensor(observations)).clamp(-1.0, 1.0).numpy()


def evaluation(policy):
    episodes = evaluate_policy(test_envs, policy, seeds=range(100, 116))
    return episodes.mean_return, episodes.standard_error


curve = []
rounds = max(1, given.steps // (WORLDS * ROLLOUT))
observation, _ = envs.reset(seed=0)
for k in range(rounds):
    if k % EVERY == 0:
        curve.append((k * WORLDS * ROLLOUT, *evaluation(policy)))
        print(f"{curve[-1][0]} steps: {curve[-1][1]:.2f}", flush=True)
    optimiser.param_groups[0]["lr"] = RATE * (1.0 - k / rounds)

    # Act: each entry is [ROLLOUT, WORLDS, ...].
    kept = {name: [] for name in ("seen", "action", "reward", "after", "terminated", "ended")}
    for _ in range(ROLLOUT):
        seen = torch.as_tensor(observation)
        with torch.no_grad():
            action = Normal(actor(seen), log_std.exp()).sample()
        observation, reward, terminated, truncated, infos = envs.step(
            action.clamp(-1.0, 1.0).numpy()
        )
        # Worlds restart by themselves: what an episode ends with is among the infos.
        ended, after = terminated | truncated, np.array(observation)
        for world in np.flatnonzero(ended):
            after[world] = infos["final_obs"][world]
        for entry, row in zip(kept, (seen, action, reward, after, terminated, ended), strict=True):
            kept[entry].append(torch.as_tensor(row, dtype=torch.float32))
    seen, action, reward, after, terminated, ended = map(torch.stack, kept.values())

    # Generalised advantage estimation; an episode that the step limit cuts off has a value.
    with torch.no_grad():
        old = Normal(actor(seen), log_std.exp()).log_prob(action).sum(-1)
        values = value(seen)
        error = reward + GAMMA * (1.0 - terminated) * value(after) - values
        advantage, later = torch.zeros_like(error), torch.zeros(WORLDS)
        for t in reversed(range(ROLLOUT)):
            later = error[t] + GAMMA * LAMBDA * (1.0 - ended[t]) * later
            advantage[t] = later
    batch = [part.flatten(0, 1) for part in (seen, action, old, advantage, advantage + values)]

    # Learn.
    for _ in range(EPOCHS):
        for chosen in torch.randperm(WORLDS * ROLLOUT).split(MINIBATCH):
            seen, action, old, advantage, target = (part[chosen] for part in batch)
            ratio = (Normal(actor(seen), log_std.exp()).log_prob(action).sum(-1) - old).exp()
            advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
            clipped = ratio.clamp(1.0 - CLIP, 1.0 + CLIP)
            policy_loss = -torch.min(ratio * advantage, clipped * advantage).mean()
            loss = policy_loss + 0.5 * (value(seen) - target).square().mean()
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(parameters, 0.5)
            optimiser.step()

curve.append((rounds * WORLDS * ROLLOUT, *evaluation(policy)))
results = {
    "learned": curve[-1][1:],
    "zero": evaluation(lambda seen: np.zeros((len(seen), acted), np.float32)),
    "random": evaluation(lambda _: test_envs.action_space.sample()),
}
given.curve.write_text(json.dumps({"env": NAME, "curve": curve, **results}), encoding="utf-8")
print("returns, " + ", ".join(f"{k}: {mean:.2f} ± {e:.2f}" for k, (mean, e) in results.items()))
